# Licensed under a 3-clause BSD style license - see LICENSE
"""
Words that messages share: near matches of a name, numbers with their nouns, and p-values.

And how many of them a terminal shows.
"""

import difflib
import math
import re
from collections.abc import Hashable
from html import escape
from numbers import Integral

__all__ = []

# difflib's own default: from this similarity on, 1 being the same, a name is suggested
_SIMILAR = 0.6
# the same for one word of a name, such as double of normalized_double_difference
_SIMILAR_WORD = 0.8
# smaller p-values depend on the far wings of a law that nobody knows
_LEAST_P = 1e-6
# the terminal's columns, and its 24 lines less the prompt
WIDTH, HEIGHT = 80, 23


def did_you_mean(name, known, *, most=1, cutoff=_SIMILAR, show=repr):
    """
    Return the end of a message that suggests what may have been meant, empty where nothing is near.

    Up to ``most`` names of a similarity from ``cutoff`` on (1 is the same), else up to two names of
    which one word is near; ``show`` returns what the message says of a name.
    """
    # a dictionary is a sequence of its keys here
    known = list(known)
    near = difflib.get_close_matches(str(name), known, n=most, cutoff=cutoff)
    if not near:
        words = {word for one in known for word in re.split(r"[\W_]+", str(one)) if len(word) > 3}
        found = difflib.get_close_matches(str(name), words, n=1, cutoff=_SIMILAR_WORD)
        near = [one for one in known if found and found[0] in re.split(r"[\W_]+", str(one))][:2]
    shown = list(dict.fromkeys(show(match) for match in near))
    return f"; did you mean {' or '.join(shown)}?" if shown else ""


def check_choice(what, value, allowed, error):
    """Raise an error unless a value is one of those allowed, which its message names."""
    if not isinstance(value, Hashable) or value not in allowed:
        known = [str(one) for one in allowed]
        message = f"{what} = {value!r}; allowed are {', '.join(known) or 'none'}"
        raise error(message + did_you_mean(value, known))


def is_whole(value):
    """Return whether a value is a whole number, Python's or numpy's."""
    return isinstance(value, Integral)


def check_type(what, value, kinds, wanted, error):
    """Raise an error unless a value is of one of some types; ``wanted`` says what is needed."""
    if not isinstance(value, kinds):
        raise error(f"{what} is of type {type(value).__name__}; {wanted}")


def counted(number, noun, plural=None):
    """Return a number and its noun, which is singular for one only: "1 frame", "0 frames"."""
    return f"{number} {noun if number == 1 else plural or noun + 's'}"


def listed(texts, word="and", most=None):
    """Return texts as a list in words; beyond ``most`` their number."""
    texts = list(texts)
    if most is not None and len(texts) > most:
        return f"{', '.join(texts[:most])} {word} {len(texts) - most} more"
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} {word} {texts[-1]}"


def shortened(line, width=WIDTH):
    """Cut a line off at a word; blanks at its begin and inside stay."""
    if len(line) <= width:
        return line
    return line[: width - 3].rpartition(" ")[0].rstrip(",;: ") + " ..."


def html(text, table=None):
    """Return a text, such as a repr, and a table of astropy as a notebook shows them."""
    shown = "" if table is None else table._repr_html_()
    return f"<p>{escape(text.removeprefix('<').removesuffix('>'))}</p>{shown}"


def with_error(value, form, error=math.nan):
    """Return a number with its error, as far as they are known: "1.52 +- 0.03", "1.52" or "-"."""
    if not math.isfinite(value):
        return "-"
    return f"{value:{form}}" + (f" +- {error:{form}}" if math.isfinite(error) else "")


def p_words(value):
    """Return a p-value as all messages have it: "p = 0.02", or "p < 1e-6"."""
    return f"p = {value:.2g}" if not value < _LEAST_P else "p < 1e-6"
