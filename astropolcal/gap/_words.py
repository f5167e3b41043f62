# Licensed under a 3-clause BSD style license - see LICENSE
"""The words of a report."""

import numpy as np

# a size is determined if the data narrow it to this share of its physical limit
_DETERMINED = 0.1
_TINY = 1e-99
# below this the residuals are more than noise
_REMAINDER = 1e-4


# ---- numbers ---------------------------------------------------------------------------------


def number(value, digits=3):
    """Return a number as short text, a dash if there is none."""
    if value is None or not np.isfinite(value):
        return "-"
    return f"{value:.{digits}g}"


def p(value):
    """Return a probability as short text."""
    return f"< {_TINY:g}" if value < _TINY else f"{value:.2g}"


def p_is(value):
    """Return a probability with its letter: ``p = 0.3``."""
    return f"p {p(value)}" if value < _TINY else f"p = {p(value)}"


def share(value):
    """Return a share as percent."""
    return f"{100 * value:.0f} %"


def change(old, new, digits=2):
    """Return a value before and after."""
    return f"{number(old, digits)} -> {number(new, digits)}"


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
    digits = _digits(min(s for _, s in good))
    if not several:
        return f"{value:.{digits}f} +- {std:.{digits}f}{ends}"
    (low, high), errors = ([f(x) for f in (min, max)] for x in zip(*good, strict=True))
    text = f"{low:.{digits}f} to {high:.{digits}f}{ends}"
    text += f", errors {errors[0]:.{digits}f} to {errors[1]:.{digits}f}"
    if len(good) < len(value):
        text += f", determined at {len(good)} of {len(value)} wavelengths"
    return text


def is_determined(std, limit):
    """Return whether the data narrow a size to a small part of what is possible."""
    return std is not None and std <= _DETERMINED * limit


def _digits(std):
    """Return the decimals that show two digits of an error."""
    return max(0, 1 - int(np.floor(np.log10(std)))) if std > 0 else 3


# ---- a cause ---------------------------------------------------------------------------------


def cause(entry):
    """Return what is to be said of one cause, in a few sentences."""
    title = entry["title"][0].upper() + entry["title"][1:]
    parts = [f"{title} ({entry['place']})."]
    parts.append(f"It explains {share(entry['explained'])} of what exceeds the noise.")
    if entry["kind"] != "discrete":
        parts.append(f"In the scan, corrected for the number of effects: {p_is(entry['p_value'])}.")
    if None not in (entry["gap_cv_before_percent"], entry["gap_cv_after_percent"]):
        parts.append(
            f"Left-out frames: {number(entry['gap_cv_before_percent'])} % without it, "
            f"{number(entry['gap_cv_after_percent'])} % with it."
        )
    if entry["aliases"]:
        parts.append(f"These data cannot tell it from: {'; '.join(entry['alias_titles'])}.")
    return " ".join([*parts, *_of_size(entry)])


def _of_size(entry):
    if entry["kind"] == "discrete":
        return ["It is an alternative to the model and has no size."]
    found = []
    if entry["significance"] is not None:
        found.append(f"Its size as a whole is {entry['significance']:.0f} times its error.")
    if entry["physical"]:
        return [*found, "The size is physically possible."]
    return [
        *found,
        "The size is physically impossible: it stands for something that the library lacks.",
    ]


# ---- three sentences -------------------------------------------------------------------------


def sentences(content):
    """Return the three sentences: how large the gap is, what causes it, what is left."""
    return [_how_large(content), _what(content), _what_is_left(content)]


def _of_frames(content):
    return "frames left out of the fit" if content["cross_validated"] else "the frames of the fit"


def _how_large(content):
    frames = "the frames" if content["exchanged"] else _of_frames(content)
    chance = p_is(content["gap_p_value"])
    before, noise = (number(content[f"{key}_percent"]) for key in ("gap_before", "noise_floor"))
    if content["verdict"] == "none":
        return (
            f"The model agrees with the measurements: it predicts {frames} to {before} % of "
            f"polarization, and the noise is {noise} % (residuals as large by noise alone: "
            f"{chance})."
        )
    real = f"the gap is real (residuals as large by noise alone: {chance})"
    if content["gap_p_value"] > content["alpha"]:
        real = f"the residuals are no larger than noise ({chance}), but their pattern is not one"
    return (
        f"The model misses {frames} by {before} % of polarization where the noise is {noise} %; "
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
    if content["verdict"] == "unexplained":
        return (
            f"The effects that help ({_listed([_named(c) for c in causes])}) explain only "
            f"{explained} of what exceeds the noise: the cause is not in the library."
        )
    if len(causes) > 1:
        texts = [f"({i}) {_named(entry)}" for i, entry in enumerate(causes, 1)]
        return (
            f"The model misses {len(causes)} effects, {_listed(texts)}, which explain "
            f"{explained} of what exceeds the noise."
        )
    ends = f", which explains {explained} of what exceeds the noise"
    if causes[0]["aliases"]:
        several = _listed([causes[0]["title"], *causes[0]["alias_titles"]], "or")
        return f"The model misses one of these, which the data cannot tell apart: {several}{ends}."
    return f"The model misses one effect: {causes[0]['title']}{ends}."


def _clearest(content):
    if not content["where"]:
        return ""
    first = content["where"][0]
    return f"; the clearest part of it is {first['detail']} ({share(first['share'])} of the gap)"


def _named(entry):
    if not entry["aliases"]:
        return entry["title"]
    several = _listed(entry["alias_titles"], "or")
    return f"{entry['title']} (the data cannot tell it from {several})"


def _listed(texts, word="and"):
    return texts[0] if len(texts) == 1 else f"{', '.join(texts[:-1])} {word} {texts[-1]}"


def _nothing(content):
    least = min((s["p_value"] for s in content["scores"]), default=None)
    if least is None:
        return "There was no effect to try that the model does not contain."
    return (
        f"None of the {content['n_effects']} effects that were tried is needed (the least, "
        f"corrected for their number: {p_is(least)})."
    )


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
    strange = [entry["title"] for entry in causes if not entry["physical"]]
    doubt = f"; physically impossible is the size of {_listed(strange)}" if strange else ""
    return (
        f"With {'it' if len(causes) == 1 else 'them'} the model predicts {_of_frames(content)} to "
        f"{number(content['gap_after_percent'])} %{' (' if details else ''}{', '.join(details)}"
        f"{')' if details else ''}, and what remains {rest} ({p_is(left)}){doubt}."
    )
