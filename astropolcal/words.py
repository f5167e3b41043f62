# Licensed under a 3-clause BSD style license - see LICENSE
"""
Words that messages share: near matches of a name, and numbers with their nouns.
"""

import difflib

__all__ = []

# difflib's own default: from this similarity on, 1 being the same, a name is suggested
_SIMILAR = 0.6


def did_you_mean(name, known, *, most=1, cutoff=_SIMILAR, show=repr):
    """
    Return the end of a message that suggests what may have been meant.

    Parameters
    ----------
    name : object
        What was asked for.
    known : iterable of str
        The names that exist.
    most : int
        How many to suggest at the most.
    cutoff : float
        How similar a name must be, from 0 (not at all) to 1 (the same).
    show : callable
        Returns what the message says of a name; names shown alike are suggested once.

    Returns
    -------
    str
        Empty where nothing is near.

    Examples
    --------
    >>> from astropolcal.words import did_you_mean
    >>> did_you_mean("wolaston", ["hwp", "wollaston"])
    "; did you mean 'wollaston'?"
    >>> did_you_mean("xyz", ["hwp", "wollaston"])
    ''
    """
    # a dictionary is a sequence of its keys here
    near = difflib.get_close_matches(str(name), list(known), n=most, cutoff=cutoff)
    shown = list(dict.fromkeys(show(match) for match in near))
    return f"; did you mean {' or '.join(shown)}?" if shown else ""


def counted(number, noun, plural=None):
    """
    Return a number and its noun, which is singular for one only.

    Parameters
    ----------
    number : int
        How many.
    noun : str
        The singular.
    plural : str, optional
        By default the singular and an s.

    Returns
    -------
    str

    Examples
    --------
    >>> from astropolcal.words import counted
    >>> counted(1, "frame"), counted(0, "frame"), counted(2, "axis", "axes")
    ('1 frame', '0 frames', '2 axes')
    """
    return f"{number} {noun if number == 1 else plural or noun + 's'}"
