# Licensed under a 3-clause BSD style license - see LICENSE
"""
Ways to spoil a file: bytes, words, cells, and nodes of a tree.

Each takes a random generator first and gives bytes back. What they put in is what
breaks parsers: numbers at the ends of their ranges, words of the wrong kind, links,
loops, deep nests and claims of great size.
"""

import copy
import json
import re

import numpy as np
import yaml

__all__ = [
    "HOSTILE",
    "mutate_bytes",
    "mutate_cells",
    "mutate_json",
    "mutate_words",
    "mutate_yaml",
    "some",
]

NUMBERS = (
    *("nan", "inf", "-inf", ".nan", ".inf", "1e308", "-1e308", "1e999", "5e-324", "0", "-0.0"),
    *("-1", "1", "2", "3.5", "1e-30", "1e30", "2147483648", "9223372036854775808", "999999999"),
    *("0x10", "1_000", "1e", "--1", "+", "0o7", "12:30:45"),
)
WORDS = (
    *("", "null", "~", "true", "no", "[]", "{}", "x", "''", '"', "\\", "\x00", "é", "\u202e", "💥"),
    *("deg", "mm", "um", "m2", "K", "mag", "deg_C", "dex(adu)", "2 adu", "1/0", "hwp", "hwp.theta"),
    *("object", "complex128", "int8", "float128", "bool", "string", "datetime64", "json", "O"),
    *("2025-10-05", "2025-13-45", "9999-12-31T23:59:60", "-4713-01-01", "1" * 400, "a" * 3000),
    *("__class__", "__init__", "canary", "canary.h5", "file:///etc/passwd", "../canary.txt"),
    *("!!python/object/apply:os.system ['touch pwned']", "!!python/name:os.system", "*loop", "&a"),
    *("<<: *a", "$ref", "{$ref: 'canary.asdf#/calibration'}", "%", "@", "`", "- ", ": ", "?", "|"),
    *("__import__('os').system('touch pwned')", "${HOME}", "{0.__class__}", "%s%s%n", "../" * 40),
)
HOSTILE = NUMBERS + WORDS
_NUMBER = re.compile(rb"(?<![A-Za-z_])-?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
_WORD = re.compile(rb"[A-Za-z_][\w./-]*|-?\d[\d.eE+-]*|\S")
_TEXT = np.frombuffer(b"0123456789.-+eabcn: []{}\n,\"'#!&*<>|%\t", np.uint8)
DEPTHS = (3, 40, 400, 5000, 100_000)


def some(rng, items):
    """Return one of the items."""
    return items[int(rng.integers(len(items)))]


# ---- bytes -------------------------------------------------------------------------


def mutate_bytes(rng, content):
    """Flip, set, insert, remove, double, swap or cut bytes."""
    content = bytearray(content or b"\0")
    kind = some(rng, ("flip", "set", "text", "insert", "remove", "double", "swap", "cut", "zero"))
    place, n = int(rng.integers(len(content))), int(2 ** rng.uniform(0, 9))
    piece = bytes(content[place : place + n])
    if kind in ("flip", "set", "text"):
        for i in rng.integers(len(content), size=rng.integers(1, 5)):
            new = {"flip": content[i] ^ (1 << int(rng.integers(8))), "set": rng.integers(256)}
            content[i] = int(new.get(kind, some(rng, _TEXT)))
    elif kind == "insert":
        content[place:place] = rng.bytes(n)
    elif kind == "remove":
        del content[place : place + n]
    elif kind == "double":
        content[place:place] = piece * int(rng.integers(1, 4))
    elif kind == "swap":
        other = int(rng.integers(len(content)))
        content[place : place + n] = content[other : other + n]
    elif kind == "cut":
        del content[place:]
    else:
        content[place : place + n] = some(rng, (b"\0", b"\xff", b" ", b"9")) * len(piece)
    return bytes(content)


def mutate_words(rng, content):
    """Replace words or numbers of a text by hostile ones, or move its lines about."""
    kind = some(rng, ("number", "number", "word", "line", "swap", "deep"))
    if kind in ("line", "swap"):
        return _lines(rng, content, kind)
    pattern = _NUMBER if kind == "number" else _WORD
    found = list(pattern.finditer(content))
    if not found:
        return mutate_bytes(rng, content)
    new = some(rng, NUMBERS if kind == "number" else HOSTILE).encode()
    if kind == "deep":
        depth = some(rng, DEPTHS)
        new = b"[" * depth + b"]" * depth * int(rng.integers(2))
    for match in sorted(rng.choice(len(found), size=rng.integers(1, 3)), reverse=True):
        start, end = found[match].span()
        content = content[:start] + new + content[end:]
    return content


def _lines(rng, content, kind):
    lines = content.splitlines(keepends=True)
    i, j = (int(k) for k in rng.integers(len(lines), size=2))
    if kind == "swap":
        lines[i], lines[j] = lines[j], lines[i]
    elif rng.random() < 0.5:
        del lines[i]
    else:
        lines[i:i] = [lines[j]] * some(rng, (1, 2, 2000))
    return b"".join(lines)


def mutate_cells(rng, content, separator=b","):
    """Change a table of text: cells, columns, rows."""
    rows = [line.split(separator) for line in content.split(b"\n")]
    kind = some(rng, ("cell", "cell", "cell", "column", "drop", "twice", "short", "long", "head"))
    i = int(rng.integers(len(rows)))
    j = int(rng.integers(len(rows[i])))
    if kind == "cell":
        rows[i][j] = some(rng, HOSTILE).encode()
    elif kind == "head":
        rows[0][int(rng.integers(len(rows[0])))] = some(rng, (*rows[0], b"", b"x"))
    elif kind == "column":
        new = some(rng, HOSTILE).encode()
        rows[1:] = [[*r[:j], new, *r[j + 1 :]] if len(r) > j else r for r in rows[1:]]
    elif kind == "drop":
        rows = [r[:j] + r[j + 1 :] for r in rows]
    elif kind == "twice":
        rows = [r[: j + 1] + r[j:] for r in rows]
    elif kind == "short":
        rows[i] = rows[i][:j]
    else:
        rows[i] = rows[i] * some(rng, (2, 500))
    return b"\n".join(separator.join(row) for row in rows)


# ---- JSON --------------------------------------------------------------------------


def mutate_json(rng, content):
    """Change a value, a key or the form of one of the lines of JSON."""
    lines = content.splitlines()
    i = int(rng.integers(len(lines)))
    try:
        tree = json.loads(lines[i])
    except ValueError:
        return mutate_words(rng, content)
    for _ in range(int(rng.integers(1, 3))):
        tree = _json_step(rng, tree)
    text = json.dumps(tree)
    depth = some(rng, DEPTHS)
    lines[i] = text.replace('"DEEP"', "[" * depth + "]" * depth).encode()
    return b"\n".join(lines) + b"\n"


def _json_places(tree):
    found, waiting = [], [tree]
    while waiting:
        node = waiting.pop()
        keys = node if isinstance(node, dict) else range(len(node))
        for key in keys:
            found.append((node, key))
            if isinstance(node[key], dict | list):
                waiting.append(node[key])
    return found


def _json_step(rng, tree):
    strange = [None, True, -1, 0, 10**400, 1e308, float("nan"), float("inf"), "x", "", [], {}]
    strange += ["DEEP", [[]], {"a": 1}, "nan", "1", [1] * 5000, 10**9, "\ud800"]
    places = _json_places(tree) if isinstance(tree, dict | list) else []
    if not places or rng.random() < 0.05:
        return some(rng, strange)
    parent, key = some(rng, places)
    kind = some(rng, ("set", "set", "delete", "move", "wrap", "key", "add"))
    if kind == "delete":
        del parent[key]
    elif kind == "move":
        other, name = some(rng, places)
        parent[key] = copy.deepcopy(other[name])
    elif kind == "wrap":
        parent[key] = some(rng, ([parent[key]], {"x": parent[key]}, [parent[key]] * 3))
    elif kind in ("key", "add") and isinstance(parent, dict):
        parent[some(rng, HOSTILE)] = parent.pop(key) if kind == "key" else some(rng, strange)
    else:
        parent[key] = some(rng, strange)
    return tree


# ---- YAML --------------------------------------------------------------------------


def mutate_yaml(rng, text, tags=None, strange=()):
    """
    Change nodes of a YAML document, and give back its text without its marks.

    Parameters
    ----------
    rng : `~numpy.random.Generator`
        Chance.
    text : bytes
        The document.
    tags : dict, optional
        Handles of tags.
    strange : sequence of str
        More tags to give to nodes.
    """
    root = yaml.compose(text, Loader=yaml.CSafeLoader)
    for _ in range(int(rng.integers(1, 4))):
        places = list(_yaml_places(root))
        _yaml_step(rng, some(rng, places), places, strange)
    try:
        new = yaml.serialize(
            root, Dumper=yaml.CSafeDumper, tags=tags, width=1000, allow_unicode=True
        ).encode()
    except (yaml.YAMLError, UnicodeEncodeError):
        # some tags and words cannot be spelled
        return mutate_words(rng, text)
    depth = some(rng, DEPTHS)
    opening, closing = some(rng, ((b"[", b"]"), (b"{a: ", b"}")))
    return new.replace(b"DEEP", opening * depth + closing * depth)


def _yaml_places(root):
    waiting, seen = [(None, 0, root)], set()
    while waiting:
        place = waiting.pop()
        parent, _, node = place
        if parent is not None:
            yield place
        if id(node) in seen or isinstance(node, yaml.ScalarNode):
            continue
        seen.add(id(node))
        for i, child in enumerate(node.value):
            waiting.append((node, i, child[1] if isinstance(child, tuple) else child))


def _scalar(text):
    resolver = yaml.resolver.Resolver()
    return yaml.ScalarNode(resolver.resolve(yaml.ScalarNode, text, (True, False)), text)


def _put(parent, i, node):
    old = parent.value[i]
    parent.value[i] = (old[0], node) if isinstance(old, tuple) else node


def _yaml_step(rng, place, places, strange):
    parent, i, node = place
    if i >= len(parent.value):
        return
    kinds = ("scalar", "scalar", "number", "delete", "double", "move", "share", "tag", "key")
    kind = some(rng, (*kinds, "wrap", "deep", "grow", "cycle", "laughs", "merge", "swap"))
    if kind in ("scalar", "number"):
        _put(parent, i, _scalar(some(rng, HOSTILE if kind == "scalar" else NUMBERS)))
    elif kind == "delete":
        del parent.value[i]
    elif kind == "double":
        parent.value.insert(i, parent.value[i])
    elif kind in ("move", "share"):
        other = some(rng, places)[2]
        _put(parent, i, copy.deepcopy(other) if kind == "move" else other)
    elif kind == "swap":
        other, j, sibling = some(rng, places)
        if j < len(other.value):
            _put(parent, i, sibling)
            _put(other, j, node)
    elif kind == "tag":
        node.tag = some(rng, (*strange, "tag:yaml.org,2002:python/object/apply:os.system"))
    elif kind == "cycle":
        _put(parent, i, parent)
    else:
        _yaml_form(rng, kind, parent, i, node)


def _yaml_form(rng, kind, parent, i, node):
    """Change the form of the tree about a node."""
    sequence = "tag:yaml.org,2002:seq"
    if kind == "key" and isinstance(parent.value[i], tuple):
        parent.value[i] = (_scalar(some(rng, HOSTILE)), node)
    elif kind == "wrap":
        new = yaml.SequenceNode(sequence, [node] * int(rng.integers(0, 4)))
        _put(parent, i, new)
    elif kind == "deep":
        _put(parent, i, _scalar("DEEP"))
    elif kind == "grow" and isinstance(node, yaml.SequenceNode):
        node.value *= some(rng, (0, 2, 50))
    elif kind == "laughs":
        # each list holds the one before it several times: small in the file, immense when walked
        for _ in range(some(rng, (5, 12, 40))):
            node = yaml.SequenceNode(sequence, [node] * 8, flow_style=True)
        _put(parent, i, node)
    elif kind == "merge" and isinstance(parent, yaml.MappingNode):
        parent.value.append((_scalar("<<"), node))
