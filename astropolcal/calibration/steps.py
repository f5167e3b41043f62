# Licensed under a 3-clause BSD style license - see LICENSE
"""
Calibrations in steps, each of which holds what the steps before have found.

Two-step: the polarized internal source as in McIntosh et al. (2026, Sec. 5.2). Sequential: one
dataset after another, as the paper goes from the polarized source to the unpolarized one
and to the star.
"""

from itertools import groupby

import astropy.units as u
import numpy as np

from astropolcal.chain import join, leaves
from astropolcal.exceptions import FitError
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.observations.quality import is_star

__all__ = ["copy_fitted", "kind_of_source", "sequential", "telescope_alone", "two_step"]

_ORDER = ("polarized", "unpolarized", "star")


def kind_of_source(source, chain=None):
    """
    Return what a dataset calibrates.

    Parameters
    ----------
    source : str or None
        As the table says.
    chain : Optic or `~astropy.modeling.CompoundModel`, optional
        Decides where the table does not say: a polarizer in front is "polarized".

    Returns
    -------
    {"polarized", "unpolarized", "star"}

    Examples
    --------
    >>> from astropolcal.calibration.steps import kind_of_source
    >>> kind_of_source("unpolarized standard star"), kind_of_source("unpolarized")
    ('star', 'unpolarized')
    """
    if is_star(source):
        return "star"
    return "unpolarized" if "unpolarized" in (source or "").lower() else "polarized"


def two_step(measurement, weighting, joint, run, options):
    """
    Fit per wavelength with misalignments held, then global, then per wavelength again.

    Parameters
    ----------
    measurement : Measurement
        Fitted in place.
    weighting : Weighting
        Noise of the data.
    joint, run : callable
        Take a measurement and a weighting, fit in place, with and without a search of
        branches; return how it went, and the noise.
    options : dict
        Further arguments of the measurements of each step.

    Returns
    -------
    outcome : dict
        How it went.
    weighting : Weighting
        The noise.
    stages : list of dict
        Values after each step.

    Raises
    ------
    FitError
        If no dataset is of a polarized source.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> data = simulate(chain, charis.wavelength, frames, seed=2)
    >>> cal = calibrate(chain, data, strategy="two-step", cross_validate=False)
    >>> [stage["title"] for stage in cal.stages][:2]
    ['per wavelength, misalignments held', 'global']
    """
    parts = [dataset.observations for dataset in measurement.datasets]
    _check_polarized(parts)
    single = {slot.name for slot in measurement.free.slots if not slot.per_wavelength}
    several = {slot.name for slot in measurement.free.slots if slot.per_wavelength}
    ties = measurement.free.ties
    measurement.put_back()
    options = options | {"wavelength": measurement.wavelength * u.um}
    stages = []

    # in the first step each wavelength has its own retardance, also of a plate that follows a law
    loose = [_loosened(chain, measurement.wavelength * u.um) for chain in measurement.chains]
    first = _step_of(loose, single, parts, ties, options)
    outcome, weighting = joint(first, weighting)
    outcomes = [outcome]
    stages.append(_stage("per wavelength, misalignments held", first))
    _copy_values(first.put_back(), measurement.chains)

    for title, held in (("global", several), ("per wavelength, global parameters held", single)):
        step = _step_of(measurement.chains, held, parts, ties, options)
        if step.free.size:
            outcome, weighting = run(step, weighting)
            outcomes.append(outcome)
        stages.append(_stage(title, step))
        _copy_values(step.put_back(), measurement.chains)
    measurement.parameters = measurement.free.start()
    return _worst(outcomes), weighting, stages


def _check_polarized(parts):
    if not any(kind_of_source(part.source) == "polarized" for part in parts):
        stated = ", ".join(sorted({repr(part.source) for part in parts}))
        raise FitError(
            f"strategy 'two-step' is for a polarized source, but the source is {stated}; "
            "allowed here are 'joint' and 'sequential'"
        )


def sequential(measurement, weights, joint, run, options):
    """
    Fit one kind of source after another and hold what was found.

    First the polarized internal source, then the unpolarized one, then stars; datasets of one
    kind are fitted together. Errors of the steps before do not enter the later ones, and the
    later data do not improve what is held: that is the paper's procedure.

    Parameters
    ----------
    measurement : Measurement
        Of all datasets; its parameters are set.
    weights : callable
        Takes the measurement of a step, returns its first weighting.
    joint, run, options
        As for `two_step`; the first step searches branches, the others go downhill.

    Returns
    -------
    outcome : dict
        How it went.
    stages : list of dict
        Values after each step.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> sources = ["polarized", "unpolarized"]
    >>> chains = [charis.chain(source, derotator="linear") for source in sources]
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> data = [simulate(chain, charis.wavelength, frames, seed=2, meta={"source": source})
    ...         for chain, source in zip(chains, sources)]
    >>> cal = calibrate(chains, data, strategy="sequential", cross_validate=False)
    >>> [stage["title"] for stage in cal.stages]
    ['polarized', 'unpolarized, what came before held']
    """
    measurement.put_back()
    ties, chains = measurement.free.ties, measurement.chains
    positions = options["positions"] or [None] * len(chains)
    options = options | {"wavelength": measurement.wavelength * u.um}
    parts = [d.observations for d in measurement.datasets]
    kinds = [kind_of_source(o.source) for o in parts]
    # stable: datasets of one kind keep their order
    order = sorted(range(len(parts)), key=lambda i: _ORDER.index(kinds[i]))
    held, outcomes, stages = set(), [], []
    for kind, group in groupby(order, key=lambda i: kinds[i]):
        rows = list(group)
        own = [chains[i] for i in rows]
        known = {"positions": [positions[i] for i in rows]}
        present = {n: tie for n, tie in ties.items() if n in parameter_table(own)}
        step = _step_of(own, held, [parts[i] for i in rows], present, options | known)
        if step.free.size:
            outcome, _ = (run if stages else joint)(step, weights(step))
            outcomes.append(outcome)
        stages.append(_stage(f"{kind}, what came before held" if stages else kind, step))
        _copy_values(step.put_back(), chains)
        # what this step has found is known for the next ones
        held |= {slot.name for slot in step.free.slots}
    measurement.parameters = measurement.free.start()
    return _worst(outcomes), stages


def telescope_alone(measurement, options):
    """
    Return the fit of what stars alone see and all wavelengths share, such as a law of M3.

    Such parameters can be nearly degenerate, so that a fit takes hundreds of steps. With all
    others held these are cheap, and bring the fit of everything near its end.

    Parameters
    ----------
    measurement : Measurement
        Of all datasets.
    options : dict
        As for `two_step`.

    Returns
    -------
    Measurement or None
        None where there is nothing of the kind.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration.steps import telescope_alone
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 80] * u.deg)
    >>> lamp = Measurement(charis.chain(), simulate(charis.chain(), charis.wavelength, frames))
    >>> telescope_alone(lamp, {"positions": None}) is None
    True
    """
    chains, parts = measurement.put_back(), [d.observations for d in measurement.datasets]
    seen = [kind_of_source(part.source) == "star" for part in parts]
    rows = [i for i, star in enumerate(seen) if star]
    if not rows or all(seen):
        return None
    # what a lamp sees as well is found better with it
    lamps = {name for i, star in enumerate(seen) if not star for name in parameter_table(chains[i])}
    own = {s.name for s in measurement.free.slots if not s.per_wavelength} - lamps
    # what has a prior is not degenerate
    if own <= {slot.name for slot, _ in measurement.free.priors}:
        return None
    held = {slot.name for slot in measurement.free.slots} - own
    positions = options["positions"]
    options = options | {
        "wavelength": measurement.wavelength * u.um,
        "positions": None if positions is None else [positions[i] for i in rows],
    }
    stars = [chains[i] for i in rows]
    return _step_of(stars, held, [parts[i] for i in rows], measurement.free.ties, options)


def copy_fitted(origin, target):
    """
    Give a measurement the values that another one has found, name by name.

    Parameters
    ----------
    origin, target : Measurement
        The second is changed.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration.steps import copy_fitted
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 80] * u.deg)
    >>> data = simulate(charis.chain(), charis.wavelength, frames)
    >>> first, second = (Measurement(charis.chain(), data) for _ in range(2))
    >>> first.parameters = 1.01 * first.vector()
    >>> copy_fitted(first, second)
    >>> bool((first.vector() == second.vector()).all())
    True
    """
    vector = target.vector()
    for slot in origin.free.slots:
        known = target.free.by_name.get(slot.name)
        if known is not None and known.size == slot.size:
            vector[known.slice] = origin.vector()[slot.slice]
    target.parameters = vector


def _worst(outcomes):
    """Return the first step that did not arrive, which spoils those behind it, or the last."""
    return next((o for o in outcomes if not o["converged"]), outcomes[-1])


def _step_of(chains, held, parts, ties, options):
    """Return the measurement of one step; what follows a held parameter is held too."""
    known = set(parameter_table(chains))
    # a tie needs a source that is free in this step
    live = {n: tie for n, tie in ties.items() if n in known and tie.source in known - held}
    return Measurement(_held(chains, held | (set(ties) - set(live))), parts, ties=live, **options)


def _loosened(chain, wavelength):
    return join(leaf.loosened(wavelength) for leaf in leaves(chain.copy()))


def _held(chains, names):
    """Return copies of the chains with more parameters fixed."""
    copies = [chain.copy() for chain in chains]
    for name, parameters in parameter_table(copies).items():
        if name in names:
            for parameter in parameters:
                parameter.fixed = True
    return copies


def _copy_values(origin, target):
    """Copy the values of parameters that both have, name by name."""
    known = parameter_table(origin)
    for name, parameters in parameter_table(target).items():
        for parameter in parameters:
            if name in known and np.shape(known[name][0].value) == np.shape(parameter.value):
                parameter.value = known[name][0].value


def _stage(title, measurement):
    """Record the values of one stage, with units, and its residuals."""
    measurement.put_back()
    values = {slot.name: measurement.free.values_of(slot.name) for slot in measurement.free.slots}
    rms = float(np.sqrt(np.mean(measurement.residuals() ** 2)))
    return {"title": title, "parameters": values, "residual_rms": rms}
