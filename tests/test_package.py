# Licensed under a 3-clause BSD style license - see LICENSE
"""What `import astropolcal` gives, and what it costs."""

import importlib
import subprocess
import sys

import pytest

import astropolcal


def test_name_is_there_and_listed():
    for name in astropolcal.__all__:
        assert getattr(astropolcal, name) is not None, name
        assert name in dir(astropolcal), name


def test_no_more_names_than_a_user_keeps_in_mind():
    assert len(set(astropolcal.__all__) - {"__version__"}) <= 20


def test_every_name_knows_where_it_comes_from():
    """What is listed is what is looked up, and nothing else."""
    known = {*astropolcal._WHERE, *astropolcal._ROOMS, "__version__"}
    assert known == set(astropolcal.__all__)


def test_name_is_that_of_its_module():
    for name, module in astropolcal._WHERE.items():
        there = importlib.import_module(f"astropolcal.{module}")
        assert getattr(astropolcal, name) is getattr(there, name), (name, module)
        assert name in there.__all__, (name, module)


def test_modules_are_attributes_without_an_import_of_their_own():
    """In a process in which nothing else has imported them."""
    code = "import astropolcal; print(*(getattr(astropolcal, n).__name__ for n in {!r}))"
    names = sorted(astropolcal._ROOMS)
    command = [sys.executable, "-c", code.format(names)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.split() == [f"astropolcal.{name}" for name in names]


def test_names_are_listed_once():
    """Also those of modules that were imported meanwhile."""
    importlib.import_module("astropolcal.optics")
    assert sorted(set(dir(astropolcal))) == dir(astropolcal)


def test_star_import_gives_the_names():
    names = {}
    exec("from astropolcal import *", names)
    assert set(astropolcal.__all__) <= set(names)


def test_unknown_name():
    with pytest.raises(AttributeError, match="'astropolcal' has no attribute 'no_such_name'"):
        _ = astropolcal.no_such_name


def test_import_loads_none_of_the_heavy_packages():
    code = (
        "import sys, astropolcal; "
        "print(*sorted({'numpy', 'astropy', 'scipy', 'asdf', 'matplotlib'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""
