# Licensed under a 3-clause BSD style license - see LICENSE
"""
Do the tests notice when the code is wrong? Kill rate of random mutants.

``python tests/mutants.py astropolcal/optics tests/optics -n 20 -o optics.json`` changes one
expression or statement of the package at a time, in a copy of the tree, and runs the quick
tests of the given folders until one of them fails. It writes what was changed and which test
failed; one that survives either changes nothing, or a test is missing. ``--again optics.json``
makes the same mutants after a change of the tests; those whose lines are gone count as such.
"""

import argparse
import ast
import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from coverage import CoverageData

ROOT = Path(__file__).resolve().parents[1]
OPPOSITE = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot,
    ast.IsNot: ast.Is, ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.Pow: ast.Mult, ast.And: ast.Or, ast.Or: ast.And,
}  # fmt: skip


def mutated(node):
    """What may stand in place of a node, as source, or None."""
    match node:
        case ast.Compare(ops=[operator, *rest]) if type(operator) in OPPOSITE:
            new = ast.Compare(node.left, [OPPOSITE[type(operator)](), *rest], node.comparators)
        case ast.BinOp() if type(node.op) in OPPOSITE:
            new = ast.BinOp(node.left, OPPOSITE[type(node.op)](), node.right)
        case ast.BoolOp():
            new = ast.BoolOp(OPPOSITE[type(node.op)](), node.values)
        case ast.UnaryOp(op=ast.Not() | ast.USub()):
            new = node.operand
        case ast.Constant(value=bool()):
            new = ast.Constant(not node.value)
        case ast.Constant(value=int() | float()):
            new = ast.Constant(node.value + 1)
        case ast.Return(value=ast.expr()):
            return "return None"
        case ast.Raise() | ast.AugAssign() | ast.Expr(value=ast.Call()):
            return "pass"
        case _:
            return None
    return f"({ast.unparse(new)})"


def mutants_of(path):
    """All mutants of a file: what they are, the whole lines they change, and the new lines."""
    source = path.read_text(encoding="utf-8")
    lines = source.splitlines(keepends=True)
    functions = [n for n in ast.walk(ast.parse(source)) if isinstance(n, ast.FunctionDef)]
    inside = {id(n): n for f in functions for s in f.body for n in ast.walk(s)}
    # parts of an f-string have no places of their own
    strings = [n for n in inside.values() if isinstance(n, ast.JoinedStr)]
    left_out = {id(n) for s in strings for n in ast.walk(s)}
    for node in inside.values():
        new = None if id(node) in left_out else mutated(node)
        if new is None:
            continue
        before = "".join(lines[node.lineno - 1 : node.end_lineno])
        head = lines[node.lineno - 1].encode()[: node.col_offset].decode()
        tail = lines[node.end_lineno - 1].encode()[node.end_col_offset :].decode()
        if source.count(before) == 1:
            yield {"file": str(path.relative_to(ROOT)), "line": node.lineno, "before": before,
                   "after": head + new + tail, "kind": type(node).__name__}  # fmt: skip


def run(tree, arguments, seconds=None):
    """Which quick test fails in a copy of the tree: None if none does, and the output."""
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "--tb=no"]
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run(
            [*command, "-m", "not slow", *arguments],
            cwd=tree, env=environment, capture_output=True, text=True, timeout=seconds,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return "out of time", ""
    failed = [line for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    # other codes mean that there is no such test
    return (failed[0] if failed else "?") if done.returncode in (1, 2) else None, done.stdout


def tests_by_line(tree, package, folders):
    """Function: the tests that run a line of a file, the fewest first."""
    options = [f"--cov={package}", "--cov-context=test", "--cov-report=", "--cov-fail-under=0"]
    failed, output = run(tree, [*options, *folders])
    if failed:
        raise SystemExit(f"the tests have to pass before anything is changed: {output}")
    data = CoverageData(str(tree / ".coverage"))
    data.read()

    def tests(file, line):
        known = data.contexts_by_lineno(str(tree / file)).get(line, [])
        return sorted({name.partition("|")[0] for name in known} - {""})

    return tests


def survives(tree, mutant, tests, folders):
    """The test that fails: of an earlier one, those that run the line, and all; or None."""
    path = tree / mutant["file"]
    source = path.read_text(encoding="utf-8")
    path.write_text(source.replace(mutant["before"], mutant["after"]), encoding="utf-8")
    chosen = tests(mutant["file"], source[: source.index(mutant["before"])].count("\n") + 1)
    (tree / "chosen.txt").write_text("\n".join(chosen), encoding="utf-8")
    try:
        for names in [mutant.get("killed by")], ["@chosen.txt"] * bool(chosen), folders:
            failed, _ = run(tree, names, 600) if any(names) else (None, "")
            if failed:
                return failed.removeprefix("FAILED ").partition(" - ")[0]
    finally:
        path.write_text(source, encoding="utf-8")
    return None


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("package", help="folder or file to change")
    parser.add_argument("tests", nargs="+", help="folders or files of the tests")
    parser.add_argument("-n", type=int, default=20, help="number of mutants")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--again", type=Path, help="make the mutants of this earlier output")
    parser.add_argument("-o", "--output", type=Path, required=True)
    options = parser.parse_args()
    package = ROOT / options.package
    files = [package] if package.is_file() else sorted(package.rglob("*.py"))
    mutants = [mutant for file in files for mutant in mutants_of(file)]
    mutants = random.Random(options.seed).sample(mutants, min(options.n, len(mutants)))
    if options.again:
        mutants = json.loads(options.again.read_text(encoding="utf-8"))
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder, "tree")
        shutil.copytree(ROOT, tree, ignore=shutil.ignore_patterns(".git"))
        tests = tests_by_line(tree, options.package, options.tests)
        for mutant in mutants:
            there = (tree / mutant["file"]).read_text(encoding="utf-8").count(mutant["before"]) == 1
            mutant["killed by"] = survives(tree, mutant, tests, options.tests) if there else "gone"
            print(mutant["file"], mutant["line"], mutant["kind"], mutant["killed by"], flush=True)
    options.output.write_text(json.dumps(mutants, indent=1), encoding="utf-8")
    killed = sum(m["killed by"] not in (None, "gone") for m in mutants)
    print(f"{killed} of {len(mutants) - sum(m['killed by'] == 'gone' for m in mutants)} killed")


if __name__ == "__main__":
    main()
