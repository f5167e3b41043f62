# Licensed under a 3-clause BSD style license - see LICENSE
"""The words of a report."""

import re
import textwrap

import numpy as np

from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.gap.cells import Cell, _kind_words, _place_words, _when, alike
from astropolcal.gap.selection import REMAINDER
from astropolcal.words import counted, listed, p_words

# a size is determined if the data narrow it to this share of its physical limit
_DETERMINED = 0.1
# above this probability the sum of squares alone is not
# conspicuous
_CONSPICUOUS = 0.01
_WIDTH = 80
# so many causes are named in a sentence, in a title, and in place of another
_NAMED, _IN_TITLE, _ALIASES = 3, 2, 4
# a course that explains so much more of the gap than all causes is named before them
_MORE = 0.1
# more single data than this are counted
_SINGLE = 5
# so many lines say where the gap lies, and so many has the summary
_WHERE, _SUMMARY = 5, 24
# an alias at another place is the same thing if it is this probable against the best
_SAME = 0.5
#: A cause is one thing, and not one of several, from this share on
ONE = 0.9
# of causes less probable than this the table is enough
_UNLIKELY = 0.1
# a share of a signal below this is none
_CANCELS = 0.02
# so many targets on sky stand in the summary
_TARGETS = 2
_ONE_THING = {
    "course": " Both follow the same thing: they may be one that no table has.",
    "action": " Both are of one place and kind: they may be one thing with a course of its own.",
    "optic": " Both are one optic of oblique axes or an elliptical one, or one cause of two laws.",
    "": "",
}
# what no table has, by place and kind of what does the same, and whether that changes: in
# simulations up to 93 % of the signal of added light, 92 to 99 % of that of a scale, 99.5 % of that
# of other wavelengths
_NOT_ASKED = (
    ("after:", "depolarization", True, "Added light, such as a background, that changes so"),
    ("in:", "retardance_h", True, "A wavelength scale that changes so"),
    ("", "depolarization", False, "Light of other wavelengths in the same pixels"),
)
_ELLIPSIS = "\N{HORIZONTAL ELLIPSIS}"
# what the amplitude of a cell is, by its dependence
_AMPLITUDES = {
    "harmonic": "amplitude of the cosine",
    "time": "change in half of the run",
    "time2": "bend",
    "step": "step",
    "direction": "change after moves backwards",
    "move": "change with a move of one radian",
    "brightness": "change where the source is twice as bright",
}
# what the parameter "right" is of what a detector does, by the kind of its cell: no sum tells a
# background of one beam from the lamp
_BEAMS = dict.fromkeys(("nonlinearity", "persistence"), "both beams")
_BEAMS["background_of_one_beam"] = "right beam, or the left with the other sign"


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
    """Return a p-value for a column of a table."""
    return p_words(value).removeprefix("p ").removeprefix("= ")


def share(value):
    """Return a share as percent; what another cause takes back may be more than all."""
    if value > 1.005:
        return "more than 100 %"
    return "less than 1 %" if 0 < value <= 0.005 else f"{100 * value:.0f} %"


def short_share(value):
    """Return a share as percent, for a column of a table; a dash if there is none."""
    words = "-" if value is None else share(value)
    return words.replace("less than", "<").replace("more than", ">")


def change(old, new, digits=2):
    """Return a value before and after."""
    return f"{percent(old, digits)} -> {percent(new, digits)}"


# ---- names -----------------------------------------------------------------------------------


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


def sizes(entry):
    """Return a line per parameter of a cause: its size, its error, how much the data tell of it."""
    pairs = zip(labels(entry), entry["size"].values(), strict=True)
    return [f"{label}: {_size(**size)}" for label, size in pairs]


def labels(entry):
    """Return what the parameters of a cause are called."""
    keys = [name.split(".") for name in entry["size"]]
    single = len({key for _, key in keys}) == len(keys)
    known = {}
    if entry["cell"]:
        kind = entry["cell"]["dependence"].partition(":")[0]
        of = " (half the difference of the beams)" * (entry["cell"]["kind"] == "gain")
        known = {"amplitude": _AMPLITUDES.get(kind, "size"), "quadrature": "amplitude of the sine"}
        known = {key: words + of for key, words in known.items()}
        known |= {"right": _BEAMS.get(entry["cell"]["kind"])}
        # of what follows a course the coefficient of its law is free
        known |= {key: known["amplitude"] for _, key in keys if key.endswith(("_c1", "_amplitude"))}
    words = [known.get(key) or (key if single else f"{key} of {optic}") for optic, key in keys]
    return [one.replace("_", " ") for one in words]


def _size(value, std, unit, limit, degree=None):
    several = isinstance(value, list)
    values, errors = (np.array(one, dtype=float, ndmin=1) for one in (value, std))
    known = is_determined(errors, limit)
    if not known.any():
        return "not determined by these data" + (" at any wavelength" if several else "")
    # shares are given in percent
    values, errors = (one[known] * (1 if unit else 100) for one in (values, errors))
    ends, digits = f" {unit or '%'}", decimals(np.median(errors))
    middle, low, high = (f"{f(values):.{digits}f}" for f in (np.median, np.min, np.max))
    least, most = (percent(f(errors), 2) for f in (np.min, np.max))
    text = f"{low} to {high}{ends}, median {middle}, errors {least} to {most}{ends}"
    if low == high:
        text = f"{middle} +- {np.max(errors):.{digits}f}{ends}"
        text += " at every wavelength" if several else ""
    elif degree is not None:
        text += f", if it is nearly a polynomial of degree {degree} in wavelength"
    if known.all():
        return text
    return f"{text}; determined at {known.sum()} of {known.size} wavelengths"


def is_determined(std, limit):
    """Return whether the data narrow a size to a small part of what is possible."""
    # what is not known is None, and NaN among numbers
    return np.array(std, dtype=float) <= _DETERMINED * limit


def decimals(std):
    """Return the decimals that show two digits of an error."""
    # an error of 0.0123 is written with three decimals
    return max(0, 1 - int(np.floor(np.log10(std)))) if std > 0 else 3


def has_sizes(entry):
    """Return whether the data determine each parameter of a cause somewhere, a list."""
    return [bool(np.any(is_determined(s["std"], s["limit"]))) for s in entry["size"].values()]


# ---- what a cause is, and what else it may be ----------------------------------------------------


def _cell(one):
    """Return the cell of what has no name; machines know fewer kinds."""
    return Cell(*one["name"].split("/", 2))


def _outline(one):
    """Return kind and dependence of a cell, the name of what has one."""
    cell = None if one["effect"] or not one["cell"] else _cell(one)
    return (cell.kind, cell.dependence) if cell else one["name"]


def _title(group):
    """Return the title of cells of one outline, with all their places."""
    if len(group) == 1:
        return group[0]["title"]
    cell = _cell(group[0])
    return f"{_kind_words(cell)} {_places(group, 'of')}{_when(cell.dependence)}"


def _places(group, of):
    places = (one["cell"]["place"] for one in group)
    own = {"source": "at the source"}
    return listed((own.get(p) or re.sub("^of ", f"{of} ", _place_words(p)) for p in places), "or")


def _alike(entry):
    """Return a cause, and those of its aliases that are the same thing at another place."""
    least = _SAME * entry["share"]
    same = [a for a in entry["aliases"] if _outline(a) == _outline(entry)]
    return [entry, *(a for a in same if a["probability"] >= least)]


def title(entry):
    """Return the title of a cause, with all places at which it may as well be."""
    return _title(_alike(entry))


def own_share(entry):
    """Return how probable a cause is among its aliases, regardless of its place and name."""
    return entry["share"] + sum(one["probability"] for one in _same(entry))


def _same(entry):
    """Return the aliases that are the same thing: at another place, or without the name."""
    nameless = [a for a in entry["aliases"] if a["cell"] and a["cell"] == entry["cell"]]
    return [*_alike(entry)[1:], *(a for a in nameless if entry["effect"] and not a["effect"])]


def others(entry, ranks):
    """Return titles and probabilities of what else a cause may be, those of one kind as one."""
    groups, same = {}, _same(entry)
    for one in entry["aliases"]:
        if one not in same and one["name"] not in ranks:
            groups.setdefault(_outline(one), []).append(one)
    found = [(_title(g), sum(one["probability"] for one in g)) for g in groups.values()]
    found = [found[i] for i in ranked([chance for _, chance in found])]
    return [f"{words} ({share(chance)})" for words, chance in found]


def cause(entry):
    """Return what is to be said of one cause, in a few sentences."""
    return " ".join([_found(entry), *entry["details"]])


def _found(entry):
    chance = share(entry["probability"])
    if own_share(entry) < ONE and others(entry, {}):
        first = f"{title(entry)} ({share(own_share(entry))})"
        several = listed([first, *others(entry, {})], "or", _NAMED)
        return f"The model lacks one of several things ({chance}): {several}."
    if entry["effect"] or not entry["cell"]:
        return f"The model lacks one effect: {entry['title']} ({chance})."
    cell, places = _cell(entry), _places(_alike(entry), "in")
    begin = "The detector shows" if cell.place == "detector" else f"Something {places} causes"
    begin = "The data show another" if cell.kind == "brightness" else begin
    words = f"{_kind_words(cell)}{_when(cell.dependence)}"
    return f"{begin} {words} ({chance}); no name is known for it."


def details(entry, ranks):
    """
    Return what is to be said of a cause beside its title, a list of sentences.

    ``ranks`` gives the rank of every cause by its name: an alias may be a cause too.
    """
    text = f"It explains {share(entry['explained'])} of what exceeds the noise"
    errors = (entry["left_out_before_percent"], entry["left_out_after_percent"])
    text += "" if None in errors else f" (left-out frames: {change(*errors, 3)} %)"
    kept = entry["double_difference_share"]
    if kept is not None and kept < _CANCELS:
        text += "; it cancels in the double differences"
    elif kept is not None:
        text += f"; {share(kept)} of its signal is in the double differences"
    texts = [f"{text}."]
    if alternatives := others(entry, ranks):
        texts.append(
            f"These data hardly tell it ({share(own_share(entry))}) from "
            f"{listed(alternatives, 'or', _ALIASES)}."
        )
    both = [f"cause {ranks[a['name']]}" for a in entry["aliases"] if a["name"] in ranks]
    if both:
        texts.append(
            f"It resembles {listed(both)}: the data ask for both, "
            "but how much belongs to which is uncertain."
        )
    likely = [entry, *(one for one in entry["aliases"] if one["probability"] > _UNLIKELY)]
    cells = [one["cell"] for one in likely if one["cell"]]
    for place, kind, changes, what in _NOT_ASKED:
        seen = (c for c in cells if c["place"].startswith(place) and c["kind"].startswith(kind))
        if any(c["dependence"].startswith(("constant", "dataset")) != changes for c in seen):
            texts.append(f"{what} may do the same.")
    if entry["kind"] == "discrete":
        return [*texts, "It is an alternative to the model and has no size."]
    strength, rest = entry["significance"], entry["trades_with"]
    if strength is not None:
        texts.append(f"Its size as a whole is {strength:.0f} standard errors from zero.")
    if not entry["physical"]:
        texts.append("The size is physically impossible: it stands for something else.")
    elif entry["at_bound"]:
        n = np.sum([np.size(one["value"]) for one in entry["size"].values()])
        texts.append(f"The size is at a bound of the optic at {entry['at_bound']} of {n} values.")
    known = has_sizes(entry)
    if not all(known):
        what = "all of its size" if any(known) else "its size"
        why = f"can be exchanged for changes of {listed(rest)}" if rest else "hardly shows"
        texts.append(f"The data need it but do not tell {what}: a part {why}.")
    return texts


# ---- the summary -------------------------------------------------------------------------------


def sentences(content, several=False):
    """
    Return frames to distrust, what causes the gap, how large it is, and what is left.

    Frames are named with their datasets where there are several.
    """
    faults = _faults(content["frames"], several)
    first = f"Some frames are not what their table says: {'; '.join(faults)}." if faults else ""
    tails = {(fault["dataset"], fault["frame"]) for fault in content["in_tails"]}
    noise = f"Data of {counted(len(tails), 'frame')} that are far off are left out: the noise has "
    noise = f"{noise}wide tails." if tails else ""
    rest = (
        part(content)
        for part in (_what, _unusable, _against_prior, _instead, _how_large, _what_is_left, _on_sky)
    )
    return [words for words in (first, noise, *rest) if words]


def _faults(frames, several):
    """Return what is wrong with each of some frames; of many single data only how many they are."""
    single = [fault for fault in frames if fault["what"] == "one wavelength"]
    single = single if len(single) > _SINGLE else []
    told = [
        f"{fault['dataset']}, {words}" if several else words
        for fault in frames
        if fault not in single and (words := fault["words"].rstrip("."))
    ]
    if single:
        count = len({(fault["dataset"], fault["frame"]) for fault in single})
        told.append(f"{len(single)} data in {count} of them are off the wavelengths beside them")
    return told


def correct(entry):
    """Return what is to be done with a table of which the angles are misread."""
    return f"Correct the table first: {title(entry)} ({share(entry['probability'])})."


def fails(name):
    """Return that a part of a run does not fit, and what may be the matter."""
    return (
        f'The model does not fit "{name}": without it the double differences are off by a tenth '
        "of that at most. Look at what changed there first, such as a frame that is missing or "
        "angles that are not those of the table."
    )


def _what(content):
    causes, verdict = content["causes"], content["verdict"]
    if verdict == "none":
        if content["gap_p_value"] < REMAINDER:
            return (
                "No cause is found of what the model leaves. It is more than noise as rough as its "
                f"residuals ({p_words(content['gap_p_value'])}), and no table states the noise: "
                "neighbouring frames or wavelengths may share it, or something is lacking."
            )
        return "The model agrees with the measurements: it lacks nothing that these data show."
    # in the order of what they explain, not of when they were found
    largest = sorted(causes, key=lambda entry: -entry["explained"])
    names = []
    for one in largest:
        like = " or what looks the same" if own_share(one) < ONE and others(one, {}) else ""
        names.append(f"{title(one)}{like} ({share(one['probability'])})")
    if verdict != "unexplained":
        nameless = "" if verdict == "named" else ", not all of which have a name"
        many = f"The model lacks {len(causes)} things{nameless}: "
        return _found(causes[0]) if len(causes) == 1 else f"{many}{listed(names, most=_NAMED)}."
    text = "I do not know what the model lacks"
    if _is_one(content):
        return f"{text}."
    if causes:
        text += f": what helps most, {names[0]}, "
        text += "needs others beside it." if len(causes) > 1 else "is not probable enough."
        text += _ONE_THING[alike([entry["cell"] and Cell(**entry["cell"]) for entry in causes])]
    else:
        text += f": none of the {content['n_effects']} causes that were tried explains the gap."
    where = content["where_left"] or content["where"]
    of = "what is left" if content["where_left"] else "the gap"
    return f"{text} {where_words(where[0], of)}." if where and not _courses(content) else text


def _unusable(content):
    """Return why `calibrate` with this model has no usable result."""
    found = content["accuracy_after"]["unusable"]
    # the most telling first
    more = f", and {len(found) - 1} more" * (len(found) > 1)
    return f"Its calibration is not usable as it is ({found[0]}{more})." if found else ""


def _against_prior(content):
    """Return which parameter has a value that what was known of it excludes."""
    entry = content["accuracy_after"]["against_prior"]
    if not entry:
        return ""
    return (
        f"What was known of {entry['parameter']} disagrees: it is {entry['sigma']:.0f} standard "
        "deviations from its prior, and may stand for something that the model lacks."
    )


def _courses(content):
    found = [one for one in content["where"] if one["axis"] == "course"]
    return found if content["verdict"] != "none" else []


def _is_one(content):
    """Whether one perturbation of any course does more than all causes together."""
    found = _courses(content) if content["verdict"] == "unexplained" else []
    return bool(found) and found[0]["share"] > 1 - content["left_share"] + _MORE


def _instead(content):
    """Return what one perturbation of any course does in place of the causes."""
    found, causes = _courses(content), content["causes"]
    if not found:
        return ""
    more, others = "", [one["detail"].partition(",")[0] for one in found[1:]]
    if others:
        more = f" These data do not tell it from such a course of {listed(others, 'or', _NAMED)}."
    instead = " instead" if causes and not _is_one(content) else ""
    text = f"It may be one thing{instead}: {found[0]['detail']}."
    if causes:
        those = "the cause that helps most" if len(causes) == 1 else "all causes together"
        does = f"It does more than {those}" if _is_one(content) else f"It does as well as {those}"
        text += f" {does} and explains {share(found[0]['share'])} of the gap."
    return f"{text}{more}"


def where_words(entry, of=None):
    """Return a sentence on where a part of the gap lies; without ``of`` its end."""
    verb = "follows" if entry["kind"] == "pattern" else "lies in"
    verb = "lies at" if entry["axis"] == "wavelength" else verb
    whole = f"{share(entry['share'])} of {of} " if of else ""
    return f"{whole}{verb} {entry['detail']}"


def is_single(content):
    """Return whether all data are intensities of a single beam."""
    return content["accuracy_before"]["observable"] == "intensity"


def unit(content):
    """Return in percent of what a gap is."""
    return f"percent of {'the mean of their group' if is_single(content) else 'polarization'}"


def _how_large(content):
    them = "it" if len(content["causes"]) == 1 else "them"
    if _is_one(content):
        # what helps more is no part of the improved model
        them = "the causes of the table"

    def gaps(before, after, noise):
        more = f", with {them} by {percent(after)} %" if content["causes"] else ""
        worse = ", which is worse" if more and after > before else ""
        return f"{percent(before)} %{more}{worse} (noise {percent(noise)} %)"

    keys, double = ("before_percent", "after_percent"), content["double_difference"]
    text = (
        f"In {'intensities' if is_single(content) else 'single differences'} the model is off by "
    )
    if double:
        text = "In double differences, which calibrate fits, the model is off by "
        text += f"{gaps(*(double[key] for key in keys), double['noise_percent'])}; "
        text += "in single differences by "
    text += gaps(*(content[f"gap_{key}"] for key in keys), content["noise_floor_percent"])
    frames = "frames left out of the fit" if content["cross_validated"] else "the frames of the fit"
    text += f": {unit(content)}, {'the frames' if content['exchanged'] else frames}."
    if not content["converged"]:
        text += " The nominal fit did not converge; its last steps gained less than 2 %."
    if content["verdict"] == "none":
        return text
    chance = content["gap_p_value"]
    noise = f"({p_words(chance)})"
    # a pattern can be certain where the sum of squares is not conspicuous
    if chance > _CONSPICUOUS:
        return f"{text} The residuals are no larger than noise {noise}, but have a pattern."
    if not (content["causes"] or content["where"] or content["frames"]):
        times = content["gap_before_percent"] / content["noise_floor_percent"]
        return (
            f"{text} It is more than noise of the stated size {noise}, but no pattern in angle, "
            "time, wavelength or beam is seen in it: it may be noise that is "
            f"{times:.1f} times as large."
        )
    return f"{text} The gap is real {noise}."


def _what_is_left(content):
    if content["verdict"] == "none":
        return (
            "What is below the noise, or what the parameters absorb entirely, does not show: a gap "
            f"of up to {percent(content['hidden_percent'])} % (rms, 95 %)."
        )
    if not content["causes"]:
        return "Nothing should be added to the model before its cause is known."
    where, part = content["where_left"], content["left_share"]
    text = f"What is left, {share(part)} of the gap, is more than" if part else "What is left is"
    text += f" noise ({p_words(content['remainder_p_value'])})"
    if not part:
        most = np.ceil(100 * content["left_share_limit"])
        text += f", which may hide up to {most:.0f} % of the gap (95 %)"
    elif where and content["verdict"] != "unexplained":
        text += f": {where_words(where[0], 'it')}"
    if content.get("nested_percent") is not None:
        text += (
            "; frames that took no part in the choice of the causes are predicted to "
            f"{percent(content['nested_percent'])} %"
        )
    strange = [entry["title"] for entry in content["causes"] if not entry["physical"]]
    return text + (f"; physically impossible is the size of {listed(strange)}." if strange else ".")


def _on_sky(content):
    """Return what calibrate claims with the nominal and with the improved model."""
    before, after = (content[f"accuracy_{when}"]["targets"] for when in ("before", "after"))
    if not before or not after or content["verdict"] not in ("named", "located"):
        return ""
    targets = [
        f"target of {old['dolp_percent']:g} %: {change(old['s_p_percent'], new['s_p_percent'])} %, "
        f"{change(old['s_chi_deg'], new['s_chi_deg'])} deg"
        for old, new in zip(before[:_TARGETS], after[:_TARGETS], strict=True)
    ]
    known = " if the undetermined parameters were known" if "as if" in before[0]["words"] else ""
    return (
        "Errors on sky that calibrate claims, with the nominal -> with the improved model"
        f"{known}: {'; '.join(targets)}."
        f"{'' if content.get('misread') else ' --save keeps the improved one.'}"
    )


# ---- for the terminal ------------------------------------------------------------------------


def text(content, frames=(), written=()):
    """
    Return a report as text of at most 80 columns, the summary first.

    ``frames`` are lines on those not used, ``written`` the files that were.
    """
    causes = content["causes"]
    following = [exposure(entry, causes) for entry in content["next_observations"]]
    files = [f"Written: {', '.join(map(str, written))}"] if written else []
    # as much as the summary has room for
    for rows, take in ((len(causes), 2), (len(causes), 1), (3, 1)):
        table, first = _table_lines(causes, rows), _numbered("Observe next", following[:take])
        summary = _joined([content["sentences"], table, first, files])
        if summary.count("\n") < _SUMMARY:
            break
    parts = []
    for one in (one for one in causes if one["probability"] >= _UNLIKELY):
        known = [*(f"  {line}" for line in one["details"]), *(f"  - {line}" for line in sizes(one))]
        parts.append([f"Cause {one['rank']}: {title(one)} ({share(one['probability'])})", *known])
    parts.append(_numbered("Or observe", following[take:], take))
    for name, where in (("the gap of the nominal model", "where"), ("what is left", "where_left")):
        worth = worth_reading(content[where])
        lines = [f"{share(one['share']):>6}  {where_words(one)}" for one in worth]
        parts.append([f"Of {name}", *lines] if lines else [])
    parts += [[f"Nominal model: {content['nominal']}"], list(frames)]
    return f"{summary}\n\n{_joined(parts)}"


def short(content, ends):
    """Return the lines of a terminal: what is found and its causes, then the given ones."""
    causes, room = content["causes"], _SUMMARY - 2 - len(ends)
    for most in (len(causes), _NAMED, 1, 0):
        lines = _joined([content["sentences"], _table_lines(causes, most)]).split("\n")
        if len(lines) <= room:
            break
    else:
        lines = [*lines[: room - 1], f"and {len(lines) - room + 1} more lines"]
    return [*lines, "", *ends]


def _joined(parts):
    return "\n\n".join("\n".join(_wrapped(part)) for part in parts if part)


def _wrapped(lines):
    for line in lines:
        # continued lines begin under the words, not under the bullet, the number or the share
        ends = " " * len(re.match(r"\s*(?:- |\d+\. |\d+ %  )?", line).group())
        # a number stays with its unit
        kept = re.sub(r"(?<=\d) (?=(%|deg)\b|%)", "\N{NO-BREAK SPACE}", line)
        # and the name of a file stays whole
        whole = {"break_on_hyphens": False, "break_long_words": False}
        broken = textwrap.wrap(kept, _WIDTH, subsequent_indent=ends, **whole)
        yield from (one.replace("\N{NO-BREAK SPACE}", " ") for one in broken or [""])


def _table_lines(causes, most):
    """Return a line per cause: rank, probability, what it explains, what double differences see."""
    if not causes[:most]:
        return []
    more = [f"and {len(causes) - most} more"] if len(causes) > most else []
    rows = [("", "probability", "explains", "in double diff.", "cause")]
    for entry in causes[:most]:
        shares = (entry[key] for key in ("probability", "explained", "double_difference_share"))
        rows.append((str(entry["rank"]), *map(short_share, shares), entry["name"]))
    *widths, _ = (max(map(len, column)) for column in zip(*rows, strict=True))
    room = _WIDTH - sum(widths) - 2 * len(widths)
    lines = ["  ".join([*map(str.rjust, r, widths), shortened(r[-1], room)]) for r in rows]
    return lines + more


def exposure(entry, causes):
    """Return an exposure in words, and what it is for, causes by their ranks."""
    ranks = {one["name"]: one["rank"] for one in causes}
    among = {alias["name"]: one["rank"] for one in causes for alias in one["aliases"]}
    known = [f"cause {ranks[name]}" for name in entry["separates"] if name in ranks]
    aliases = (name for name in entry["separates"] if name in among and name not in ranks)
    others = list(dict.fromkeys(f"cause {among[name]}" for name in aliases))
    if entry["exposure"] is None or not (known or others):
        return entry["words"]
    for_what = f"tells {listed(known)} " if known else f"tells apart what {listed(others)} may be "
    for_what += "from what it may be " * bool(known and others)
    gain = f"{entry['gain']:.0f}" if entry["gain"] >= 10 else f"{entry['gain']:.1f}"
    return f"{entry['exposure']}: {for_what}({gain} standard deviations)"


def _numbered(title, texts, before=0):
    lines = [f"{i:>3}. {words}" for i, words in enumerate(texts, before + 1)]
    return [title, *lines] if lines else []


def worth_reading(where):
    """Return the first patterns, and the first places, of where a gap lies."""
    patterns = [one for one in where if one["kind"] == "pattern"]
    places = [one for one in where if one["kind"] != "pattern"]
    return (patterns[: max(_WHERE - len(places), (_WHERE + 1) // 2)] + places)[:_WHERE]
