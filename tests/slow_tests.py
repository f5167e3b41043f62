# Licensed under a 3-clause BSD style license - see LICENSE
"""
Write the list of slow tests, which ``pytest -m "not slow"`` leaves out.

Run the tests with ``--junitxml=times.xml``, and ``python tests/slow_tests.py times.xml``.
A test is slow if all its cases together, or one of them, take longer than the limits.
"""

import sys
import xml.etree.ElementTree as ElementTree
from collections import defaultdict
from pathlib import Path

#: The longest case, and all cases of a test together, in seconds.
ONE, ALL = 0.1, 0.4
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
    LIST.write_text("".join(f"{name}\n" for name in slow_tests(sys.argv[1])), encoding="utf-8")
