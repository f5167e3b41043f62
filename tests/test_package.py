# Licensed under a 3-clause BSD style license - see LICENSE
"""What `import astropolcal` gives, and what it costs."""

import subprocess
import sys

import pytest

import astropolcal


@pytest.mark.parametrize("name", astropolcal.__all__)
def test_name_is_there_and_listed(name):
    assert getattr(astropolcal, name) is not None
    assert name in dir(astropolcal)


def test_no_more_names_than_a_user_keeps_in_mind():
    assert len(astropolcal.__all__) <= 20


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
