# Licensed under a 3-clause BSD style license - see LICENSE
"""
Write the list of slow tests, which ``pytest -m "not slow"`` leaves out.

Run the tests with ``--junitxml=times.xml``, and ``python tests/slow_tests.py times.xml``.
A test is slow if all its cases together, or one of them, take longer than the limits.

What a fixture takes is counted for the first test that uses it. If that one is left out,
the next one pays: run the quick part in the same way, and add what is slow in it with
``python tests/slow_tests.py --add times.xml``, until nothing is added any more.
"""

import sys
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from pathlib import Path

#: The longest case, and all cases of a test together, in seconds.
ONE, ALL = 0.04, 0.15
LIST = Path(__file__).with_name("slow_tests.txt")


def slow_tests(report):
    """Return the names of the slow tests of a report, sorted."""
    times = defaultdict(list)
    for case in ElementTree.parse(report).iter("testcase"):
        module = case.get("classname").replace(".", "/") + ".py"
        if module.startswith("tests/"):
            name = f"{module}::{case.get('name').partition('[')[0]}"
            times[name].append(float(case.get("time")))
    return sorted(n for n, taken in times.items() if max(taken) > ONE or sum(taken) > ALL)


if __name__ == "__main__":
    *options, report = sys.argv[1:]
    known = LIST.read_text(encoding="utf-8").split() if options == ["--add"] else []
    names = sorted({*known, *slow_tests(report)})
    LIST.write_text("".join(f"{name}\n" for name in names), encoding="utf-8")
    print(f"{len(names)} slow tests, {len(names) - len(known)} of them new")
