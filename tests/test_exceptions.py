# Licensed under a 3-clause BSD style license - see LICENSE
"""Errors: one root, and what they carry besides their words."""

import pickle

from astropolcal import exceptions

ERRORS = [getattr(exceptions, name) for name in exceptions.__all__ if not name.endswith("Warning")]


def test_errors_carry_the_argument_that_they_are_about():
    for error in ERRORS:
        made = error("mode = 'x'; allowed are J and H", argument="mode")
        assert isinstance(made, exceptions.AstropolcalError), error
        assert str(made) == "mode = 'x'; allowed are J and H", error
        # workers send them to the process that asked
        again = pickle.loads(pickle.dumps(made))
        assert (type(again), str(again), again.argument) == (error, str(made), "mode"), error
        assert error("no argument is wrong").argument is None, error
