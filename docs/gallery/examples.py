# Licensed under a 3-clause BSD style license - see LICENSE
"""The examples of docstrings, as objects: what stands on the page of an optic."""

import contextlib
import doctest
import inspect
import io


def example_of(cls):
    """
    Return the first optic of a class that the example in its docstring makes.

    Parameters
    ----------
    cls : type
        Class of an optic.

    Returns
    -------
    Optic
        As made, before the example changes or uses it; one of the defaults if it makes none.
    """
    made = []
    original = cls.__init__

    def recording(self, *args, **kwargs):
        original(self, *args, **kwargs)
        if type(self) is cls and not made:
            # a copy, as the example may change the optic later
            made.append(self.copy())

    cls.__init__ = recording
    try:
        _run(cls)
    finally:
        cls.__init__ = original
    return made[0] if made else cls()


def _run(cls):
    names = {}
    for example in doctest.DocTestParser().get_examples(inspect.getdoc(cls)):
        with contextlib.redirect_stdout(io.StringIO()):
            exec(compile(example.source, cls.__name__, "single"), names)
