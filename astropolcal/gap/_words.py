# Licensed under a 3-clause BSD style license - see LICENSE
"""The words of a report."""

import re
import textwrap

import numpy as np

# a size is determined if the data narrow it to this share of its physical limit
_DETERMINED = 0.1
_TINY = 1e-99
# below this the residuals are more than noise
_REMAINDER = 1e-4
# above this the sum of squares alone is not conspicuous
_CONSPICUOUS = 0.01
_WIDTH = 80
# the longest name of an effect in a table
_LONGEST = 26
# so many effects are named in a sentence, and in a title
_NAMED, _IN_TITLE = 3, 2
_ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"


# ---- numbers ---------------------------------------------------------------------------------


def number(value, digits=3):
    """Return a number as short text, a dash if there is none."""
    if value is None or not np.isfinite(value):
        return "-"
    return f"{value:.{digits}g}"


def percent(value, digits=3):
    """Return a number with so many digits, zeros at its end included."""
    if value is None or not np.isfinite(value):
        return "-"
    return f"{value:.0f}" if abs(value) >= 10**digits else f"{value:#.{digits}g}".removesuffix(".")


def p(value):
    """Return a probability as short text."""
    return f"< {_TINY:g}" if value < _TINY else f"{value:.2g}"


def p_is(value):
    """Return a probability with its letter: ``p = 0.3``."""
    return f"p {p(value)}" if value < _TINY else f"p = {p(value)}"


def share(value):
    """Return a share as percent."""
    return "less than 1 %" if 0 < value <= 0.005 else f"{100 * value:.0f} %"


def short_share(value):
    """Return a share as percent, for a column of a table."""
    return share(value).replace("less than", "<")


def change(old, new, digits=2):
    """Return a value before and after."""
    return f"{percent(old, digits)} -> {percent(new, digits)}"


# ---- names -----------------------------------------------------------------------------------


def listed(texts, word="and", most=None):
    """Return texts as a list in words; beyond ``most`` their number."""
    texts = list(texts)
    if most is not None and len(texts) > most:
        return f"{', '.join(texts[:most])} {word} {len(texts) - most} more"
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} {word} {texts[-1]}"


def in_title(texts):
    """Return the first texts, as many as a title holds, and the number of the others."""
    return listed(texts, most=_IN_TITLE) if texts else ""


def shortened(name, width):
    """Return a name of at most so many characters, its middle left out; a date stays whole."""
    if len(name) <= width:
        return name
    ends = [len(name) - i for i, letter in enumerate(name, 1) if letter in "_ "]
    # what stands after a separator, if enough is left for a beginning
    tail = max((n for n in ends if 0 < n <= 2 * (width - 1) // 3), default=(width - 1) // 2)
    return f"{name[: width - 1 - tail]}{_ELLIPSIS}{name[len(name) - tail :]}"


# ---- sizes -----------------------------------------------------------------------------------


def sizes(parameters):
    """Return a line a parameter: its size, its error, and how much the data tell of it."""
    return [f"{name}: {_size(**entry)}" for name, entry in parameters.items()]


def _size(value, std, unit, limit):
    ends = f" {unit}" if unit else ""
    several = isinstance(value, list)
    pairs = list(zip(value, std, strict=True)) if several else [(value, std)]
    good = [(v, s) for v, s in pairs if is_determined(s, limit)]
    if not good:
        return "not determined by these data" + (" at any wavelength" if several else "")
    values, errors = np.array(good).T
    digits = _digits(np.median(errors))
    if not several:
        return f"{value:.{digits}f} +- {std:.{digits}f}{ends}"
    middle, low, high = (f"{f(values):.{digits}f}" for f in (np.median, np.min, np.max))
    least, most = (percent(f(errors), 2) for f in (np.min, np.max))
    text = f"median {middle}, from {low} to {high}{ends}; errors {least} to {most}{ends}"
    if low == high and least == most:
        text = f"{middle} +- {errors[0]:.{digits}f}{ends} at every wavelength"
    if len(good) < len(value):
        text += f"; determined at {len(good)} of {len(value)} wavelengths"
    return text


def is_determined(std, limit):
    """Return whether the data narrow a size to a small part of what is possible."""
    return std is not None and std <= _DETERMINED * limit


def _digits(std):
    """Return the decimals that show two digits of an error."""
    # an error of 0.0123 is written with three decimals
    return max(0, 1 - int(np.floor(np.log10(std)))) if std > 0 else 3


def has_sizes(entry):
    """Return whether the data determine each parameter of a cause somewhere, a list."""
    return [
        any(is_determined(std, one["limit"]) for std in np.ravel(np.array(one["std"], object)))
        for one in entry["size"].values()
    ]


# ---- a cause ---------------------------------------------------------------------------------


def cause(entry, ranks):
    """Return what is to be said of one cause, in a few sentences."""
    title = entry["title"][0].upper() + entry["title"][1:]
    parts = [f"{title} ({entry['place']})."]
    parts.append(f"It explains {share(entry['explained'])} of what exceeds the noise.")
    if None not in (entry["left_out_before_percent"], entry["left_out_after_percent"]):
        parts.append(
            f"Left-out frames: {percent(entry['left_out_before_percent'])} % without it, "
            f"{percent(entry['left_out_after_percent'])} % with it."
        )
    parts.append(f"Its probability is {share(entry['probability'])}.")
    return " ".join([*parts, *details(entry, ranks)])


def details(entry, ranks):
    """
    Return what a table does not say of a cause, a list of sentences.

    ``ranks`` gives the rank of every cause by its name: an alias may be a cause too.
    """
    return [*_of_aliases(entry, ranks), *_of_size(entry)]


def open_aliases(entry, ranks):
    """Return the titles of the aliases of a cause that are no causes themselves."""
    return [one["title"] for one in entry["aliases"] if one["name"] not in ranks]


def _of_aliases(entry, ranks):
    found, others = [], open_aliases(entry, ranks)
    if others:
        found.append(f"These data cannot tell it from: {'; '.join(others)}.")
    both = [f"cause {ranks[a['name']]}" for a in entry["aliases"] if a["name"] in ranks]
    if both:
        found.append(
            f"It resembles {listed(both)}: the data ask for both, "
            "but how much belongs to which is uncertain."
        )
    return found


def _of_size(entry):
    if entry["kind"] == "discrete":
        return ["It is an alternative to the model and has no size."]
    found, strength = [], entry["significance"]
    if strength is not None:
        found.append(f"Its size as a whole is {strength:.0f} standard errors from zero.")
    found.append(
        f"The size is physically possible{_at_bound(entry)}."
        if entry["physical"]
        else "The size is physically impossible: it stands for something that the library lacks."
    )
    known = has_sizes(entry)
    if not all(known):
        others = entry.get("trades_with")
        found.append(
            f"The data need the effect but do not tell {'all of ' if any(known) else ''}its size: "
            f"a part of it {_exchanged(others) if others else 'hardly changes them'}."
        )
    return found


def _at_bound(entry):
    """Return at how many of its values a size is at a bound of the optic, in words."""
    n = np.sum([np.size(one["value"]) for one in entry["size"].values()])
    at = entry.get("at_bound")
    if not at:
        return ""
    return f": at a bound of the optic{'' if n == 1 else f' at {at} of {n} values'}"


def _exchanged(others):
    return f"can be exchanged for changes of {listed(others)}"


# ---- three sentences -------------------------------------------------------------------------


def sentences(content):
    """Return the three sentences: how large the gap is, what causes it, what is left."""
    return [_how_large(content), _what(content), _what_is_left(content)]


def _of_frames(content):
    return "frames left out of the fit" if content["cross_validated"] else "the frames of the fit"


def _of_differences(frames):
    # calibrate gives double differences, which hide a part of the gap
    return f"the single differences of {frames}"


def _how_large(content):
    frames = "the frames" if content["exchanged"] else _of_frames(content)
    chance = p_is(content["gap_p_value"])
    before, noise = (percent(content[f"{key}_percent"]) for key in ("gap_before", "noise_floor"))
    if content["verdict"] == "none":
        return (
            f"The model agrees with the measurements: it predicts {_of_differences(frames)} to "
            f"{before} % of polarization, and the noise is {noise} % (residuals as large "
            f"by noise alone: {chance})."
        )
    real = f"the gap is real (residuals as large by noise alone: {chance})"
    # a pattern can be certain where the sum of squares is not conspicuous
    if content["gap_p_value"] > _CONSPICUOUS:
        real = f"the residuals are no larger than noise ({chance}), but their pattern is not one"
    return (
        f"The model misses {_of_differences(frames)} by {before} % of polarization where the "
        f"noise is {noise} %; "
        f"{real}."
    )


def _what(content):
    causes = content["causes"]
    if content["verdict"] == "none":
        return _nothing(content)
    if not causes:
        return (
            f"None of the {content['n_effects']} effects that were tried explains it: "
            "the cause is not in the library."
        )
    explained = share(sum(entry["explained"] for entry in causes))
    # in the order of what they explain, not of when they were found
    largest = sorted(causes, key=lambda entry: -entry["explained"])
    named = listed([entry["title"] for entry in largest], most=_NAMED)
    if content["verdict"] == "unexplained":
        return (
            f"The effects that help ({named}) explain only "
            f"{explained} of what exceeds the noise: the cause is not in the library."
        )
    ends = f"{explained} of what exceeds the noise"
    if len(causes) > 1:
        return f"The model lacks {len(causes)} effects, which explain {ends}: {named}" + (
            f"{_doubt(causes)}."
        )
    if causes[0]["aliases"]:
        group = [causes[0]["title"], *(one["title"] for one in causes[0]["aliases"])]
        several = listed(group, "or", _NAMED)
        return (
            "The model lacks one of these, which the data cannot tell apart: "
            f"{several}, which explains {ends}."
        )
    return f"The model lacks one effect: {causes[0]['title']}, which explains {ends}."


def _doubt(causes):
    """Return how many of several causes may as well be other effects."""
    names = {entry["name"] for entry in causes}
    several = sum(bool(open_aliases(entry, names)) for entry in causes)
    if not several:
        return ""
    one = "one of them may as well be another effect"
    many = f"{several} of them may as well be other effects"
    return f" ({one if several == 1 else many}, as listed)"


def _clearest(content):
    if not content["where"]:
        return ""
    first = content["where"][0]
    return f"; the clearest part of it is {first['detail']} ({share(first['share'])} of the gap)"


def _nothing(content):
    if not content["scores"]:
        return "There was no cause to try that the model does not contain."
    return f"None of the {content['n_effects']} causes that were tried is needed."


def _what_is_left(content):
    verdict, causes = content["verdict"], content["causes"]
    if verdict == "none":
        return (
            "An effect below the noise, or one that the parameters of the model take up "
            "entirely, would not show."
        )
    if not causes:
        return (
            f"Nothing should be added to the model before its cause is known{_clearest(content)}."
        )
    shrunk, left = content["shrinkage_percent"], content["remainder_p_value"]
    details = [] if shrunk["value"] is None else [f"mean square lower by {shrunk['value']:.0f} %"]
    if shrunk["low"] is not None:
        details.append(f"68 % interval {shrunk['low']:.0f} to {shrunk['high']:.0f} %")
    rest = "is noise" if left > _REMAINDER else "is more than noise and unexplained"
    # such a size stands for an effect that the library does not have
    strange = [entry["title"] for entry in causes if not entry["physical"]]
    doubt = f"; physically impossible is the size of {listed(strange)}" if strange else ""
    return (
        f"With {'it' if len(causes) == 1 else 'them'} the model predicts {_of_frames(content)} to "
        f"{percent(content['gap_after_percent'])} %{' (' if details else ''}{', '.join(details)}"
        f"{')' if details else ''}, and what remains {rest} ({p_is(left)}){doubt}."
    )


# ---- for the terminal ------------------------------------------------------------------------


def text(content, accuracies, frames=()):
    """Return a report as text of at most 80 columns; ``frames`` are lines on those not used."""
    parts = [
        content["sentences"],
        _table_lines(content),
        *(_cause_lines(cause, called(content)) for cause in content["causes"]),
        _numbered("What to observe next", [e["words"] for e in content["next_observations"]]),
        _where_lines(content["where"]),
        _accuracy_lines(content, accuracies),
        [f"Nominal model: {content['nominal']}"],
        list(frames),
    ]
    return "\n\n".join("\n".join(_wrapped(part)) for part in parts if part)


def _wrapped(lines):
    for line in lines:
        # continued lines begin under the words, not under the bullet, the number or the share
        indent = len(re.match(r"\s*(?:- |\d+\. |\d+ %  )?", line).group())
        ends = " " * indent
        yield from textwrap.wrap(
            line, _WIDTH, subsequent_indent=ends, break_on_hyphens=False, drop_whitespace=True
        ) or [""]


def called(content):
    """Return what the causes are called: they are none where they leave the gap unexplained."""
    return "Effect" if content["verdict"] == "unexplained" else "Cause"


def _table_lines(content):
    """Return a line a cause: rank, name, place, share, errors on left-out frames."""
    causes = content["causes"]
    if not causes:
        return []
    rows = [("effect", "place", "explains", "left-out (%)")]
    for entry in causes:
        errors = (entry["left_out_before_percent"], entry["left_out_after_percent"])
        told = "-" if errors == (None, None) else " -> ".join(map(percent, errors))
        rows.append((entry["name"], entry["place"], short_share(entry["explained"]), told))
    # the place has what the other columns leave of the width
    a, _, c, d = (max(map(len, column)) for column in zip(*rows, strict=True))
    a = min(a, _LONGEST)
    b = _WIDTH - a - c - d - 6
    lines = [
        f"{i or '':>2} {shortened(one, a):<{a}} {shortened(two, b):<{b}} {three:>{c}} {four:>{d}}"
        for i, (one, two, three, four) in enumerate(rows)
    ]
    title = "Causes" if called(content) == "Cause" else "Effects that help"
    return [f"{title}; prediction errors on left-out frames without -> with each", *lines]


def _cause_lines(entry, called):
    lines = [f"  Probability {share(entry['probability'])}."]
    lines += [f"  {sentence}" for sentence in entry["details"]]
    return [
        f"{called} {entry['rank']}: {entry['title']} ({entry['name']})",
        *lines,
        *(f"  - {line}" for line in sizes(entry["size"])),
    ]


def _numbered(title, texts):
    lines = [f"{i:>3}. {words}" for i, words in enumerate(texts, 1)]
    return [title, *lines] if lines else []


def _where_lines(where):
    lines = [
        f"{share(e['share']):>6}  {e['detail']}"
        + ("" if e["p_value"] < _TINY else f" ({p_is(e['p_value'])})")
        for e in where
    ]
    # the patterns are taken in one after the other, the places are the same gap seen again
    title = (
        "Where the gap of the nominal model lies, share of the excess over the noise "
        f"(p < {_TINY:g} where no p is given). Patterns come first: each has the share that those "
        "before it have left. Places overlap with them and with one another: the shares of both "
        "lists together do not add up"
    )
    return [title, *lines] if lines else []


def _accuracy_lines(content, keys):
    """Return the accuracies of each dataset and for targets, before and after."""
    heads = "".join(f"{key:^19}" for key in keys).rstrip()
    rows = ["Accuracy of single differences before -> after, percent, median over wavelengths"]
    rows.append(f"  {'':<20}{heads}")
    for old, new in _pairs(content, "datasets"):
        cells = (_arrow(old[f"{key}_percent"], new[f"{key}_percent"]) for key in keys)
        rows.append(f"  {shortened(old['name'], 19):<20}{''.join(cells)}".rstrip())
    for old, new in _pairs(content, "targets"):
        rows.append(
            f"  target of {old['dolp_percent']:g} % by {old['column']}: s_p "
            f"{change(old['s_p_percent'], new['s_p_percent'])} %, s_chi "
            f"{change(old['s_chi_deg'], new['s_chi_deg'])} deg"
        )
    return rows


def _pairs(content, key):
    return zip(content["accuracy_before"][key], content["accuracy_after"][key], strict=True)


def _arrow(old, new):
    return f"{percent(old):>7} -> {percent(new):<8}"
