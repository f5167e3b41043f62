# Licensed under a 3-clause BSD style license - see LICENSE
"""Whether a calibration can be used, and why not, in five lines; and a page for 80 columns."""

import textwrap
from dataclasses import dataclass

import astropy.units as u
import numpy as np

from astropolcal.calibration.identifiability.sky import chain_from_sky, known_instrument
from astropolcal.calibration.noise.scatter import kind_of_source
from astropolcal.calibration.uncertainty.covariance import APART, STATUSES
from astropolcal.calibration.uncertainty.derived import mirror_names, mirror_values
from astropolcal.calibration.validation.stars import fitted_stars
from astropolcal.calibration.validation.targets import TARGETS, target_accuracies
from astropolcal.chain import leaves, stages
from astropolcal.measurement.parameters import are_outside, limits
from astropolcal.optics import COORDINATES, WollastonPrism
from astropolcal.units import median_of_known
from astropolcal.words import HEIGHT, WIDTH, counted, listed, p_words, shortened

__all__ = ["Verdict"]

# what may send the light
_KINDS = ("polarized", "unpolarized", "star")
# what holds at more than this share of the wavelengths holds of the calibration
_MOST = 0.5
# bare metals polarize by a few percent at most, coated ones by little more
_NO_MIRROR = 30 * u.percent
#: Beam splitters separate polarization with an efficiency of 0.9 or more.
NO_SPLITTER = 0.5
# residuals at least as large happen by chance less often
_UNLIKELY = 0.01
# the mounts are known better than this before any fit, and it turns 6 % of Q into U
_ABSURD_ANGLE = 10 * u.deg
# real data of three instruments leave 0.1 to 1.5 %, exchanged beams of the example 1.1 to 2.2 %
_MISFIT, _MAYBE = 1.5 * u.percent, 1.0 * u.percent
# a turn or a change of the DoLP by less, in degree or percent of itself, does not show
_SHOWS = 0.005
# residuals of so many times the noise are worth a word: the noise is not known better
_CLEARLY = 2
# values farther from the minimum, in units of the errors there, have larger errors
_OFF = 0.5
# data or priors at odds with the fit that move a parameter by more of its errors spoil it
_MOVED = 2
# errors that rest on fewer numbers are themselves known to a third or worse
_FEW_FREEDOM, _FEW_SETTINGS = 5, 6


@dataclass
class Verdict:
    """
    Whether a calibration can be used.

    Parameters
    ----------
    usable : bool
        Whether nothing was found that makes the result unusable as it is.
    reasons : list of str
        Why it is not usable; the most telling first.
    cautions : list of str
        What to mind in one that is.
    words : list of str
        Five lines of at most 80 columns: the verdict, the accuracy on sky, what is
        determined, what is not, and which observation would help most.
    advice : str, optional
        Which observation would help most, in full.

    Examples
    --------
    >>> from astropolcal.calibration.result import Verdict
    >>> Verdict(False, ["the fit did not converge"], [], ["NOT USABLE AS IT IS: ..."]).usable
    False
    """

    usable: bool
    reasons: list
    cautions: list
    words: list
    advice: str = ""

    def to_dict(self):
        """
        Return it for machines.

        Returns
        -------
        dict
            Keys ``usable``, ``reasons``, ``cautions``, ``words``.
        """
        return {key: value for key, value in vars(self).items() if key != "advice"}


def verdict(calibration, targets=TARGETS):
    """Return whether a calibration can be used, and why not; ``targets`` are (DoLP, AoLP)."""
    known, free = _known_and_free(calibration)
    tables = target_accuracies(calibration, targets)
    # whether it is usable does not hang on what was asked for
    bright = tables[:1] if targets is TARGETS else target_accuracies(calibration, TARGETS[:1])
    found = {}
    for lead, change in _open_leads(calibration, free).items():
        for what in _seen(change):
            found.setdefault(what, []).append(lead)
    # what leads at a single wavelength opens that one only
    many = _MOST * len(calibration.wavelength)
    sky = {
        what: leads
        for what, leads in found.items()
        if any("[" not in lead for lead in leads) or len(leads) > many
    }
    unseen = [] if bright else ["Q and U on sky are unknown: the frames do not measure them"]
    on_sky = [_open_words(sky), *_too_far(bright, sky)], unseen
    reasons, wrong = _reasons(calibration, known, free, on_sky)
    before = calibration.settings.get("restarted", {})
    cautions = []
    if not reasons:
        excess = _excess(calibration)
        at_bound = [n for n, e in free.items() if not e["value"].ndim and e["at_bound"]]
        if excess > _CLEARLY:
            why = f"astropolcal diagnose: {_suspected(calibration)}"
            cautions.append(f"residuals {excess:.2g} times the noise ({why})")
        cautions += [f"at its bound: {', '.join(at_bound)}"] if at_bound else []
        off = calibration.fit.get("off_minimum") or {"errors": 0.0}
        if off["errors"] > _OFF:
            cautions.append(f"{off['parameter']} is {off['errors']:.2g} errors off the minimum")
        if before:
            of = f", as of {str(before['date'])[:10]}" if before.get("date") else ""
            cautions.append(f"errors of parameters lack those of what is held{of}")
        cautions += [*_of_one_table(calibration), *_elsewhere(calibration)]
        cautions += [*_few(calibration), *_of_lamp(calibration), *_badly_predicted(calibration)]
        # a fit minds the bounds of what leads only
        tied = {name: entry for name, entry in known.items() if entry["tied"]}
        beyond = [n for n, e in tied.items() if are_outside(e["value"], *limits(e["bounds"])).any()]
        cautions += [f"tied beyond its bounds: {', '.join(beyond)}"] if beyond else []
        cautions += what_differs(calibration)
        if disagrees_with_priors(calibration):
            told = calibration.fit.get("against_prior")
            which = f": {told['parameter']} by {told['sigma']:.0f} sigma" if told else ""
            cautions.append(f"data and priors disagree{which}")
    advice = _next(calibration, free, wrong, sky)
    words = [
        _first(reasons, cautions),
        _UNKNOWN_ON_SKY if wrong or {*before} & {"open", "lost"} else _accuracy(tables, sky),
        *_determined(calibration, free),
        f"Next        {advice}",
    ]
    return Verdict(not reasons, reasons, cautions, [shortened(line) for line in words], advice)


def faults(calibration):
    """Return why a calibration is not usable but for what is open on sky, which its errors tell."""
    return _reasons(calibration, *_known_and_free(calibration))[0]


def _known_and_free(calibration):
    known = calibration.parameter_values()
    return known, {n: e for n, e in known.items() if not (e["fixed"] or e["tied"])}


def _reasons(calibration, known, free, on_sky=((), ())):
    """Return why a calibration is not usable, and whether something must be wrong.

    ``on_sky`` are the reasons on sky, those before and those after the orientations at a bound.
    """
    # what must be wrong with the set-up or its description comes before what is not known
    wrong = [_nothing(calibration), _angles(calibration, free)]
    wrong += [*_mirrors(calibration, known), *_splitters(calibration, known)]
    wrong += [_misfit(calibration), _carried_off(calibration), _drawn(calibration)]
    # the constants of laws are where inputs are zero, far from all frames
    trains = map(leaves, calibration.chains)
    laws = {f"{leaf.name}.{key}" for train in trains for leaf in train for key in leaf._follows}
    usual = {name: entry for name, entry in free.items() if name not in laws}
    unknown = [*_absurd(usual), *on_sky[0], _hanging(free)]
    before, words = calibration.settings.get("restarted", {}), "held, and open in the calibration"
    unknown += [f"{words} before: {', '.join(before['open'])}"] if "open" in before else []
    if "lost" in before:
        unknown.append(f"none of these data saw {', '.join(before['lost'])}: add the star's table")
    unknown += on_sky[1]
    stuck, arrived = _stuck(free), "" if calibration.converged else "the fit did not converge"
    reasons = [words for words in (*wrong, *unknown, stuck, arrived) if words]
    # what is not known runs to its bounds, too
    return reasons, any(wrong) or bool(stuck and not any(unknown))


_UNKNOWN_ON_SKY = "On sky      unknown, as something is wrong"


def _first(reasons, cautions):
    told = reasons or cautions
    head = "NOT USABLE AS IT IS" if reasons else "Usable"
    line = f"{head}: {'; '.join(told)}" if told else head
    if len(line) <= WIDTH or len(told) == 1:
        return line
    more = f" (and {len(told) - 1} more)"
    return shortened(f"{head}: {told[0]}", WIDTH - len(more)) + more


# ---- reasons ------------------------------------------------------------------------------


def _nothing(calibration):
    finding = calibration.identifiability
    if finding.rank == 0:
        return "no free parameter changes any datum"
    n_data = calibration.fit.get("n_data", np.inf)
    return "no datum is left over to tell the noise" if n_data <= finding.rank else ""


def _carried_off(calibration):
    """Name the parameter that the data at odds with the fit move by more than it is known."""
    moved = calibration.fit.get("outliers_move") or {"errors": 0.0}
    if not moved["errors"] > _MOVED:
        return ""
    return f"frames at odds move {moved['parameter']} by {moved['errors']:.2g} of its errors"


def _of_lamp(calibration):
    """Name the parameter that the brightness of frames moves by more than its other errors."""
    moved = calibration.fit.get("lamp_moves") or {}
    if not moved.get("counts"):
        return []
    counted = "not" if calibration.settings["errors"] == "white" else "now"
    return [
        "frames are not as bright as the model has them, for the lamp or an optic that it lacks, "
        f"which moves {moved['parameter']} by {moved['errors']:.2g} errors, {counted} in them "
        "(observable per_frame_double_difference)"
    ]


def _drawn(calibration):
    """Name the prior that the data exclude, where it moves another optic by more than is known."""
    told = calibration.fit.get("against_prior")
    if not told or not told["moves"]["errors"] > _MOVED:
        return ""
    moved = "which moves {parameter} by {errors:.2g} of its errors".format(**told["moves"])
    return f"{told['parameter']} is {told['sigma']:.0f} sigma off its prior, {moved}"


def _stuck(free):
    """Name the parameters that are at a bound nearly everywhere."""
    stuck = [
        f"{name} ({np.sum(entry['at_bound'])} of {entry['value'].size})"
        for name, entry in free.items()
        if entry["value"].ndim and np.mean(entry["at_bound"]) > _MOST
    ]
    return f"at a bound at most wavelengths: {', '.join(stuck)}" if stuck else ""


def _orientations(free):
    """Return the free angles common to all wavelengths."""
    return {
        name: entry
        for name, entry in free.items()
        if not entry["value"].ndim
        and entry["unit"] is not None
        and u.Unit(entry["unit"]).is_equivalent(u.rad)
    }


def _angles(calibration, free):
    """Say that most of the angles are at a bound, and the residuals larger than the noise."""
    angles = _orientations(free)
    stuck = [name for name, entry in angles.items() if entry["at_bound"]]
    if len(stuck) <= _MOST * len(angles) or not _excess(calibration):
        return ""
    where = "most angles at their bounds" if len(stuck) > 1 else f"{stuck[0]} is at its bound"
    named = f"{', '.join(stuck)}; " if len(stuck) > 1 else ""
    return (
        f"{where}: are beams or signs exchanged? ({named}"
        f"residuals {_excess(calibration):.3g} times the noise)"
    )


def _excess(calibration):
    """Return by how many times the residuals exceed the noise for certain; 0 where they do not."""
    tests = calibration.fit.get("lack_of_fit") or []
    # errors that stand on the noise given are as wrong as that
    tests = [test for test in tests if test.get("noise") == "given"] or tests
    # what is far above a noise from few numbers, and may be chance, is excused by no other noise
    far = [test for test in tests if test["times_noise"] > _CLEARLY]
    tests = [test for test in tests if test["p_value"] < _UNLIKELY or test not in far]
    times = [test["times_noise"] for test in tests if test["p_value"] < _UNLIKELY]
    # with several estimates of the noise that which excuses most
    return min(times) if times and len(times) == len(tests) else 0.0


def _really(calibration, is_polarized):
    """Return the datasets with a polarized source, or the others, and their sources in words."""
    both = ((r, kind_of_source(r.source) == "polarized") for r in calibration.datasets)
    found = ((r.name, str(r.source)) for r, own in both if own == is_polarized)
    return " or ".join(f"{name} really {source!r}" for name, source in found)


def _mirrors(calibration, known):
    """Say of each mirror that polarizes as no mirror does, where the source is not to."""
    told = _really(calibration, is_polarized=False)
    for name in mirror_names(calibration) if told else ():
        if known.get(f"{name}.diattenuation", {"fixed": False})["fixed"]:
            continue
        table = mirror_values(calibration, name)
        # without an error where it is at a bound, and where only a product with another is known
        error = np.nan_to_num(table["diattenuation_err"].value, posinf=np.inf)
        least = np.abs(table["diattenuation"].value) - 3 * error
        # with certainty, at most wavelengths
        if np.mean(least * table["diattenuation"].unit > _NO_MIRROR) > _MOST:
            yield (
                f"{name} polarizes by more than {_NO_MIRROR.value:g} %, as no mirror does: is "
                f"{told}?"
            )


def _splitters(calibration, known):
    """Say of each beam splitter that it hardly is one, where the source is polarized."""
    told = _really(calibration, is_polarized=True)
    optics = (leaf for chain in calibration.chains for leaf in leaves(chain))
    names = dict.fromkeys(leaf.name for leaf in optics if isinstance(leaf, WollastonPrism))
    for entry in (known.get(name := f"{own}.efficiency") for own in names if told):
        if entry is None or entry["fixed"]:
            continue
        error = np.where(entry["at_bound"], 0.0, np.nan_to_num(entry["std"], nan=np.inf))
        most = entry["value"] + 3 * error
        if np.mean(most < NO_SPLITTER) > _MOST:
            yield f"{name} is below {100 * NO_SPLITTER:.0f} %, as of no prism: is {told}?"


def _of_one_table(calibration):
    """Name what has values of its own in the tables: the sky is that of one of them."""
    own, chains = calibration.settings.get("own") or {}, calibration.chains
    seen = next((i for i, chain in enumerate(chains) if "parallactic" in stages(chain)), 0)
    on_sky = {leaf.name for leaf in leaves(chain_from_sky([chains[seen]])[0])} if own else set()
    names = [name for name, copies in own.items() if on_sky & {c.split(".")[0] for c in copies}]
    if names:
        yield f"on sky as in {calibration.datasets[seen].name}: own values of {', '.join(names)}"


def _elsewhere(calibration):
    """Name what is far from here in other minima, which the data do not exclude."""
    names = dict.fromkeys(calibration.fit.get("minima") or ())
    if names:
        yield f"another minimum fits nearly as well, with another {listed(names, 'or', 2)}"


def _badly_predicted(calibration):
    """Say which data that no fit saw are farther off than left-out frames, or have no such."""
    sources = {record.source for record in calibration.datasets}
    for one in calibration.fit.get("standards") or []:
        if one["source"] not in sources:
            off = median_of_known(one["s_standard_percent"])
            yield f"{one['name']} is off by {off:.2g} %, and nothing like it was fitted"
        elif (times := median_of_known(one["chi"])) > _CLEARLY:
            yield f"{one['name']} is {times:.2g} times as far off as left-out frames"


def _apart(calibration):
    """Return the entries of the angle in which a dataset differs most surely, and of its rivals."""
    found = calibration.fit.get("disagreements") or []
    # which angle it is, is told as surely as that there is a difference
    least = found[0]["sigma"] ** 2 - APART**2 if found else 0.0
    return [o for o in found if o["dataset"] == found[0]["dataset"] and o["sigma"] ** 2 > least]


def what_differs(calibration):
    """Say in which dataset an angle differs from that of the others, in a list; empty if none."""
    if not (apart := _apart(calibration)):
        return []
    moves = listed([f"{one['change_deg']:+.2g}" for one in apart], "or")
    which = f"{listed([one['parameter'] for one in apart], 'or')} differs"
    return [f"{which} in {apart[0]['dataset']} by {moves} deg ({apart[0]['sigma']:.0f} sigma)"]


def _few(calibration):
    """Say that errors rest on few numbers, which makes them lower limits."""
    fit, weights = calibration.fit, calibration.settings.get("weights")
    freedom = fit.get("n_data", np.inf) - calibration.identifiability.rank
    if weights in (None, "wavelength") and freedom < _FEW_FREEDOM:
        degrees = counted(freedom, "degree of freedom", "degrees of freedom")
        yield f"errors rest on {degrees} only"
    settings = (fit.get("model_error") or {}).get("settings", _FEW_SETTINGS)
    if settings < _FEW_SETTINGS:
        yield f"errors are lower limits: {settings} settings tell what residuals share"


def _misfit(calibration):
    """Say that the model does not describe the data at all."""
    worst = _worst(calibration, "s_res")
    if not worst > _MISFIT.value or not _excess(calibration):
        return ""
    return f"the model misses the data by {worst:.2g} %, {_excess(calibration):.2g} times the noise"


def _suspected(calibration):
    """Ask about the mistake of a table that residuals of more than a percent look like."""
    if calibration.fit.get("outliers"):
        return "wrong frames?"
    if not _worst(calibration, "s_res") > _MAYBE.value:
        return "why"
    return "why" if calibration.settings.get("observable") == "intensity" else "beams exchanged?"


def _absurd(free):
    """Name orientations and other parameters whose errors say that nothing is known."""
    told = []
    for name, entry in _orientations(free).items():
        std = float(entry["std"]) * u.Unit(entry["unit"])
        if std > _ABSURD_ANGLE:
            told.append(f"{name} is known to {std.to_value(u.deg):.3g} deg only")
    wide = [
        name
        for name, entry in free.items()
        if None not in entry["bounds"]
        and np.mean(entry["std"] > entry["bounds"][1] - entry["bounds"][0]) > _MOST
    ]
    return [*told, f"errors larger than the bounds: {', '.join(wide)}"] if wide else told


def _hanging(free):
    """Name the orientations at a bound on which others hang: these are where the bound is."""
    angles = _orientations(free)
    told = [str(e["conditional_on"]) for e in angles.values() if e["status"] == "conditional"]
    names = dict.fromkeys(name for by in told for name in by.split(", ") if name in angles)
    return f"orientations depend on the bound of {', '.join(names)}" if names else ""


def _open_leads(calibration, free):
    """Return what leads the open directions, and their change on sky, None where not known."""
    found = {}
    for direction in calibration.identifiability.directions:
        lead = direction["words"].partition(" ")[0]
        stem, _, index = lead.rstrip("]").partition("[")
        # a prior or a bound may have closed what the data leave open
        if stem in free and np.ravel(free[stem]["status"])[int(index or 0)] == "open":
            found[lead] = direction.get("sky")
    return found


def _seen(sky):
    """Return what of AoLP and DoLP changes by what shows, as far as that is known."""
    kinds = (("aolp_deg", "AoLP"), ("dolp_percent", "DoLP"))
    return [what for key, what in kinds if sky and max(map(abs, sky[key])) >= _SHOWS]


def _open_words(sky):
    if not sky:
        return ""
    what, lead = " and ".join(sky), next(iter(sky.values()))[0]
    return f"{what} on sky {'are' if len(sky) > 1 else 'is'} open ({lead})"


def _too_far(tables, sky):
    """Say what of a bright target is known too badly to be called known."""
    for table in tables:
        dolp = u.Quantity(table.meta["dolp"]).to_value(u.percent)
        limits = (("s_p", "DoLP", "%", dolp), ("s_chi", "AoLP", "deg", _ABSURD_ANGLE.value))
        for key, what, unit, most in limits:
            value = median_of_known(table[key])
            # what is open has been said, with its name
            if value > most and what not in sky:
                known = f"known to {value:.2g} {unit} only" if np.isfinite(value) else "open"
                yield f"the {what} of {dolp:g} % on sky is {known}"


# ---- accuracy, what is determined, what to do -----------------------------------------------


def _accuracy(tables, sky):
    """Return what is known of light from the sky, medians over the wavelengths."""
    if not tables:
        return "On sky      unknown: the frames do not measure Q and U"
    dolps = ", ".join(f"{u.Quantity(t.meta['dolp']).to_value(u.percent):.3g}" for t in tables)
    s_p, s_chi = (
        [_number(median_of_known(t[key]), what in sky, *limits) for t in tables]
        for key, what, limits in (("s_p", "DoLP", (3, 100)), ("s_chi", "AoLP", (2, 45)))
    )
    degree, angle = _listed(s_p, "%"), _listed(s_chi, "deg")
    return f"On sky      {dolps} % {'' if degree == 'open' else 'to '}{degree}, AoLP {angle}"


def _number(value, is_open, decimals, most):
    """Return two digits with at most some decimals; what is infinite is open."""
    if is_open or np.isinf(value):
        return "open"
    least = 10.0**-decimals
    if not least <= value <= most:
        return "-" if np.isnan(value) else f"<{least:g}" if value < least else f">{most}"
    return f"{round(float(f'{value:.2g}'), decimals):g}"


def _listed(numbers, unit):
    alike = len(set(numbers)) == 1
    unit = "" if alike and numbers[0] in ("open", "-") else f" {unit}"
    return (numbers[0] if alike else ", ".join(numbers)) + unit


def _determined(calibration, free):
    """Say how many parameters are determined, and how many are not and why, by name."""
    total = sum(entry["value"].size for entry in free.values())
    good, names = _with_status(free, "determined")
    held, _ = _with_status(free, "by priors")
    more = f", {held} with priors" if held else ""
    signs = sum("tell the sign" in words for words in calibration.identifiability.mirrors)
    more += f", {signs} but for the sign" if signs else ""
    yield f"Determined  {good} of {total}{more}{': ' if good else ''}{names}"
    # what is open comes first
    bad = {s: _with_status(free, s) for s in (*STATUSES[3:6], STATUSES[2])}
    counts = [f"{n} {status}" for status, (n, _) in bad.items() if n]
    leads = _open_leads(calibration, free).values()
    if bad["open"][0] and all(sky and not _seen(sky) for sky in leads):
        counts[0] += " (not seen on sky)"
    names = ", ".join(names for n, names in bad.values() if n)
    yield f"Not         {', '.join(counts)}: {names}" if counts else "Not         none"


def _with_status(free, status):
    """Return how many elements have a status, and the parameters they belong to."""
    counts = {name: int(np.sum(entry["status"] == status)) for name, entry in free.items()}
    shown = [
        name if n == free[name]["value"].size else f"{name} ({n})"
        for name, n in counts.items()
        if n
    ]
    return sum(counts.values()), ", ".join(shown)


def _next(calibration, free, wrong, sky):
    """Return the one thing that would help most."""
    kinds = {kind_of_source(r.source) for r in calibration.datasets}
    instrument = known_instrument(calibration.settings.get("instrument"))
    # of a chain without an instrument it is not known what there is
    offered = {kind_of_source(source) for source in instrument.sources} if instrument else set()
    missing = (offered or set(_KINDS)) - kinds
    turning = {stage for chain in calibration.chains for stage in stages(chain)}
    angles = {s for s in turning if s not in COORDINATES} - {"parallactic", "altitude"}
    derotator, named = "derotator" in turning, {"derotator": "derotator", "hwp": "half-wave plate"}
    moved = [words for stage, words in named.items() if stage in angles]
    moved += sorted(angles - set(named))
    published = instrument and instrument.has_telescope
    telescope = "counts as published, without error" if published else "is not in the model"
    unknown = any(_absurd(free)) or bool(sky)
    at_odds = calibration.fit.get("outliers") and calibration.settings.get("loss") == "linear"
    if apart := [one["parameter"] for one in _apart(calibration)]:
        own = apart[0] if len(apart) == 1 else "with the one that did"
        apart = f"did {listed(apart, 'or')} move between datasets? --own {own} gives each its own"
    mask = "the frames at odds: mask them (mask_reason), or --loss bisquare"
    advice = (
        (_carried_off(calibration), mask),
        (_drawn(calibration), "check the star's name, source and times, and what priors state"),
        (calibration.identifiability.rank == 0, "check that every optic that turns has its mount="),
        (wrong, "check mounts, beams, angles, source; or run astropolcal diagnose"),
        (
            unknown and "polarized" in missing,
            f"the internal source with its polarizer{', at several derotator angles' * derotator}",
        ),
        (_hanging(free), "a polarized standard star, or bounds as wide as what is not known"),
        ("AoLP" in sky, f"a polarized standard star{_mount(calibration, free, sky)}"),
        (unknown or not calibration.converged, f"more angles of {listed(moved or ['the sky'])}"),
        (_excess(calibration) > _CLEARLY and at_odds, mask),
        (apart, apart),
        ("star" in missing, f"an unpolarized standard star; the telescope {telescope}"),
        ("unpolarized" in missing, "the internal source without its polarizer"),
        (
            any(entry["status"] == "by priors" for entry in _orientations(free).values()),
            "a polarized standard star: the AoLP rests on how optics are mounted",
        ),
        (_excess(calibration) > _CLEARLY, "astropolcal diagnose: what does the model lack?"),
        (True, "a dataset that no fit saw, as a test (--standard FILE)"),
    )
    return next(words for applies, words in advice if applies)


def _mount(calibration, free, sky):
    """Return the angle to hold where the zero of the AoLP is open: the last that takes part."""
    moved = [
        direction["parameters"]
        for direction in calibration.identifiability.directions
        for lead in sky.get("AoLP", [])[:1]
        if direction["words"].startswith(f"{lead} ")
    ]
    angles = [name for names in moved for name in names if name in _orientations(free)]
    return f", or --fix {angles[-1]} if its mount is known" if angles else ""


# ---- a summary that fits a terminal of 80 columns and 24 lines ----


HINT = "--full (full=True) adds tables per wavelength, the gauge and mirror solutions"
_COLUMN = 28
# estimates of the noise, in few words
_NOISES = {"errors": "stated errors", "given": "the noise given"}


def compact_lines(calibration, found, height=HEIGHT):
    """Return the verdict, the parameters, the fit and its goodness in so many lines."""
    stars = fitted_stars(calibration)
    known = without_stars(calibration.parameter_values(), stars)
    single = parameter_lines(known, several=False)
    found_of = (shortened(f"  {star.meta['words']}") for star in stars)
    rows = [*single, *found_of, *parameter_lines(known)[len(single) :]]
    names = [record.name for record in calibration.datasets]
    more = f" and {len(names) - 1} more" if len(names) > 1 else ""
    title = f"Calibration of {calibration.instrument or 'an instrument'} from {names[0]}{more}"
    rest = [title, *_fit(calibration)]
    room = height - len(found.words) - len(rest) - 2
    if len(rows) > room:
        rows = [*rows[: room - 1], f"  and {len(rows) - room + 1} more lines"]
    return [*found.words, "", *rows, "", *(shortened(line) for line in rest)]


def _fit(calibration):
    """Say how the fit ended, and how good it is."""
    fit, n = calibration.fit, len(calibration.covariance)
    yield (
        f"Fit         {counted(n, 'parameter')}, {fit['n_data']} data, rank "
        f"{calibration.identifiability.rank}, {calibration.settings['strategy']}, "
        + ("converged" if calibration.converged else "NOT CONVERGED")
        + ("" if calibration.posterior is None else ", sampled")
    )
    outliers = sorted(fit.get("outliers") or [], key=lambda one: -one["sigma"])
    for one in outliers[:1]:
        what = "frames" if "," in one["frames"] else "frame"
        more = f"; {len(outliers) - 1} more" if len(outliers) > 1 else ""
        told = f"{what} {one['frames']} of {one['dataset']}{at_wavelength(one)}"
        told += f", by {one['sigma']:.0f} robust sigma"
        yield f"At odds     {told}{more}"
    s_res, s_cv = (_worst(calibration, key) for key in ("s_res", "s_cv"))
    left_out = f", s_cv {s_cv:.2g} %" if np.isfinite(s_cv) else ""
    datasets = "worst dataset, " if len(calibration.datasets) > 1 else ""
    told = f"s_res {s_res:.2g} %" if np.isfinite(s_res) else "no degree of freedom left for s_res"
    yield f"Residuals   {told}{left_out} ({datasets}median wavelength)"
    told = [
        f"{test['times_noise']:.2g} x {_NOISES.get(test['noise'], test['noise'])} "
        f"({p_words(test['p_value'])})"
        for test in fit.get("lack_of_fit") or []
    ]
    if told:
        yield f"Scatter     {', '.join(told)}"
    # what no fit saw is why it was given
    for entry in fit.get("standards", []):
        yield f"Predicted   {entry['name']}: {entry['words']}"
    for entry in fit.get("stars", []):
        yield f"Catalogue   {entry['words']}"


def disagrees_with_priors(calibration):
    """Return whether a fit is farther from its priors than chance makes probable."""
    tests = calibration.fit.get("lack_of_fit") or []
    return any("disagree with the priors" in test["words"] for test in tests)


def at_wavelength(outlier):
    """Return where frames are at odds with the fit, empty if they are at all wavelengths."""
    nm = outlier.get("wavelength_nm", np.nan)
    return f" at {nm:.5g} nm" if np.isfinite(nm) else ""


def _worst(calibration, key):
    """Return the largest of the datasets' medians over the wavelengths; NaN where none is known."""
    tables = (record.accuracy for record in calibration.datasets)
    medians = [median_of_known(table[key]) for table in tables if key in table.colnames]
    return np.fmax.reduce(medians, initial=np.nan)


# ---- parameters -----------------------------------------------------------------------------


def without_stars(known, stars):
    """Return the parameters that are not those of a standard star, which say it in many numbers."""
    names = tuple(f"{star.meta['name']}." for star in stars)
    return {name: entry for name, entry in known.items() if not name.startswith(names)}


def parameter_lines(known, several=True):
    """Return a line for each free parameter, those given per wavelength last, if at all."""
    lines, rows = [], []
    for name, entry in known.items():
        head = f"  {name:<{_COLUMN}}"
        if entry["fixed"]:
            continue
        if entry["value"].ndim:
            rows.append(shortened(head + _range(entry)))
        else:
            indent = " " * (_COLUMN + 5)
            lines += textwrap.wrap(
                head + number(entry), WIDTH, subsequent_indent=indent, break_on_hyphens=False
            )
    return lines + rows if several else lines


def number(entry):
    """Return value, error, unit and status of a parameter common to all wavelengths."""
    value, std, unit = float(entry["value"]), float(entry["std"]), str(entry["unit"] or "")
    status = str(entry["status"])
    # z: what rounds to zero has no sign
    text = f"{value:z12.5f}"
    if status == "tied":
        return f"{text} {unit} (follows {entry['tied']})"
    if status == "at bound":
        inward = inward_words(entry, value, float(entry["std_inward"]))
        return f"{text} {unit} ({'; '.join(filter(None, ['at its bound', inward]))})"
    if not np.isfinite(std):
        return f"{text} {unit} ({'open: not determined alone' if status == 'open' else status})"
    error = f"{std:.5f}" if std < 10 else f"{std:.4g}"
    text = f"{text} +- {error} {unit}".rstrip()
    if status == "conditional":
        released = float(entry["std_released"])
        without = f"{released:.2g}" if np.isfinite(released) else "open"
        by = entry["conditional_on"]
        return f"{text} (conditional on {by} at its bound; without it {without})"
    return text if status == "determined" else f"{text} ({status})"


def inward_words(entry, value, inward):
    """Say how far what is at a bound may go inward at one sigma; empty where that is not known."""
    if not np.isfinite(inward):
        return "not limited" if np.isinf(inward) else ""
    low, high = entry["bounds"]
    at_low = high is None or (low is not None and value - low < high - value)
    # two digits of the way inward
    digits = max(2, 1 - int(np.floor(np.log10(inward)))) if inward > 0 else 5
    return f"below {value + inward:.{digits}f}" if at_low else f"above {value - inward:.{digits}f}"


def _range(entry):
    """Return least and largest value over the wavelengths, and how many have which status."""
    values, unit = entry["value"], str(entry["unit"] or "")
    digits = 2 if entry["unit"] else 4
    text = f"{values.min():z.{digits}f} to {values.max():z.{digits}f} {unit}".rstrip()
    statuses, counts = np.unique(entry["status"], return_counts=True)
    std = entry["std"][np.isfinite(entry["std"])]
    error = f" +- {np.median(std):.2g}" if std.size else ""
    if len(statuses) == 1:
        return f"{text}{error} ({statuses[0]})"
    told = (f"{n} {s}" for s, n in zip(statuses, counts, strict=True) if s != "determined")
    return f"{text}{error} ({', '.join(told)})"
