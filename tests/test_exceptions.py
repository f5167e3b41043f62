# Licensed under a 3-clause BSD style license - see LICENSE
"""Errors: one root, and what they carry besides their words."""

import pickle

import pytest

from astropolcal import exceptions

ERRORS = [getattr(exceptions, name) for name in exceptions.__all__ if not name.endswith("Warning")]


@pytest.mark.parametrize("error", ERRORS, ids=lambda error: error.__name__)
def test_errors_carry_the_argument_that_they_are_about(error):
    made = error("mode = 'x'; allowed are J and H", argument="mode")
    assert isinstance(made, exceptions.AstropolcalError)
    assert str(made) == "mode = 'x'; allowed are J and H"
    # workers send them to the process that asked
    again = pickle.loads(pickle.dumps(made))
    assert (type(again), str(again), again.argument) == (error, str(made), "mode")
    assert error("no argument is wrong").argument is None
