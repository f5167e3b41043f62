# Licensed under a 3-clause BSD style license - see LICENSE
"""
What the data determine: rank, null directions in words, honest errors.

A parameter is *identifiable* if no combination of parameters that leaves all
data unchanged moves it. An error is given for identifiable parameters only:
a pseudo-inverse would return a small and wrong number for the others.
"""

from dataclasses import dataclass, field

import astropy.units as u
import numpy as np

from astropolcal.calibration.harmonics import harmonic_words
from astropolcal.calibration.mirrors import mirror_solutions
from astropolcal.calibration.sky import sky_consequences

__all__ = [
    "Identifiability",
    "analyse",
    "complete",
    "examine",
    "null_space",
    "physical_scale",
]

# singular values below this share of the largest count as zero
_RANK_TOLERANCE = 1e-9
# and so do those below this: a rounding error, as the error would be 1e12 degrees
_NOTHING = 1e-12
# a parameter that moves by less than this share along a null direction stands still
_STILL = 1e-5
# what is worth a word in a null direction, as a share of its largest component
_WORTH_A_WORD = 0.02


@dataclass
class Identifiability:
    """
    Rank of a calibration and what it leaves undetermined.

    Parameters
    ----------
    names : list of str
        Names of the free parameters, one an element of the flat vector.
    rank : int
        Rank of the Jacobian.
    singular_values : `~numpy.ndarray`
        With columns scaled to a degree, a micrometre or a percent.
    null_vectors : `~numpy.ndarray`
        Shape (n_free - rank, n_free), in degree, micrometre or percent.
    identifiable : `~numpy.ndarray`
        Whether each parameter is determined, shape (n_free,).
    directions : list of dict
        For each null direction its ``words``, the ``parameters`` that move, and
        what it does to the ``sky``, see `sky_consequences`.
    sampling : list of str
        Harmonics that the half-wave-plate angles cannot separate.
    mirrors : list of str
        Discrete mirror solutions within the bounds.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.calibration import Identifiability
    >>> Identifiability(["a.theta"], 1, np.ones(1), np.zeros((0, 1)), np.ones(1, bool)).n_free
    1
    """

    names: list
    rank: int
    singular_values: np.ndarray
    null_vectors: np.ndarray
    identifiable: np.ndarray
    directions: list = field(default_factory=list)
    sampling: list = field(default_factory=list)
    mirrors: list = field(default_factory=list)

    @property
    def n_free(self):
        """Number of free parameters."""
        return len(self.names)

    def __str__(self):
        lines = [f"The data determine {self.rank} combinations of {self.n_free} free parameters."]
        lines += [f"  - {direction['words']}" for direction in self.directions]
        lines += [f"  - {words}" for words in self.sampling]
        lines += [f"  - mirror solution: {words}" for words in self.mirrors]
        return "\n".join(lines)


def null_space(free, jacobian):
    """
    Return the directions in which no datum changes.

    Parameters
    ----------
    free : FreeParameters
        The free parameters.
    jacobian : `~numpy.ndarray`
        Whitened derivative of the data, shape (n_free, n_data).

    Returns
    -------
    `~numpy.ndarray`
        Orthonormal rows, shape (n_free - rank, n_free), in steps of a degree,
        a micrometre or a percent.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal import optics
    >>> from astropolcal.calibration import null_space
    >>> from astropolcal.measurement import FreeParameters
    >>> free = FreeParameters([optics.WollastonPrism(name="wollaston")], 1)
    >>> null_space(free, np.zeros((1, 4))).shape
    (1, 1)
    """
    _, right, rank = _decompose((jacobian * physical_scale(free)[:, None]).T)
    return right[rank:]


def analyse(free, jacobian, held=None, priors=None):
    """
    Find the rank, the null directions and the unscaled covariance.

    Parameters
    ----------
    free : FreeParameters
        The free parameters.
    jacobian : `~numpy.ndarray`
        Whitened derivative of the data, shape (n_free, n_data).
    held : `~numpy.ndarray`, optional
        True for parameters that sit at a bound; they count as fixed.
    priors : `~numpy.ndarray`, optional
        Derivative of the priors' residuals in units of the noise, shape
        (n_free, n_priors). They enter the covariance, not the rank.

    Returns
    -------
    identifiability : Identifiability
        What the data alone determine.
    covariance : `~numpy.ndarray`
        Shape (n_free, n_free), canonical units, for unit noise; NaN in the
        rows and columns of parameters that are held, or that data and priors
        together do not determine.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.calibration import analyse
    >>> from astropolcal.measurement import FreeParameters
    >>> import numpy as np
    >>> free = FreeParameters([optics.WollastonPrism(name="wollaston")], 1)
    >>> analyse(free, np.ones((1, 4)))[0].rank
    1
    """
    held = np.zeros(free.size, dtype=bool) if held is None else held
    scale = physical_scale(free)
    scaled = (jacobian * scale[:, None]).T
    singular, right, rank = _decompose(scaled)
    null = right[rank:]
    identifiable = (np.abs(null) < _STILL).all(axis=0) & ~held
    if priors is not None and priors.size:
        scaled = np.concatenate([scaled, (priors * scale[:, None]).T])
    covariance = _covariance(scaled, held, scale)
    finding = Identifiability(
        names=free.names,
        rank=rank,
        singular_values=singular,
        null_vectors=null,
        identifiable=identifiable,
        directions=_directions(free, null),
    )
    return finding, covariance


def examine(measurement, weights=None):
    """
    Say what a measurement can determine, before anything is fitted.

    Parameters
    ----------
    measurement : Measurement
        Chains and observations; the current values count, so give plausible ones.
    weights : `~numpy.ndarray`, optional
        Weight of each datum, shape (n_data,).

    Returns
    -------
    Identifiability
        As in the result of a fit.

    Examples
    --------
    Before a run is taken, on simulated frames:

    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import examine
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.published()
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    >>> planned = simulate(chain, charis.wavelength, frames, noise=False)
    >>> finding = examine(Measurement(chain, planned))
    >>> finding.rank, finding.n_free
    (91, 93)
    """
    vector = measurement.vector()
    jacobian = measurement.jacobian(vector) * (1.0 if weights is None else weights)
    finding, _ = analyse(measurement.free, jacobian)
    return complete(finding, measurement, vector)


def complete(finding, measurement, vector):
    """
    Add to a finding what it means on sky, the sampling and the mirror solutions.

    Parameters
    ----------
    finding : Identifiability
        As `analyse` gives it; it is changed.
    measurement : Measurement
        The measurement.
    vector : `~numpy.ndarray`
        The solution, canonical values, shape (n_free,).

    Returns
    -------
    Identifiability
        The same object.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import analyse, complete
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    >>> observations = simulate(charis.published(), charis.wavelength, frames, seed=1)
    >>> measurement = Measurement(charis.chain(optics_in=["nbs"]), observations)
    >>> vector = measurement.vector()
    >>> finding, _ = analyse(measurement.free, measurement.jacobian(vector))
    >>> complete(finding, measurement, vector).directions[0]["sky"]["aolp_deg"]
    [1.0, 1.0]
    """
    free = measurement.free
    scaled = [vector for vector, _ in _reduced(free, finding.null_vectors)]
    canonical = np.array(scaled).reshape(-1, free.size) * physical_scale(free)
    consequences = sky_consequences(measurement, vector, canonical)
    for direction, sky in zip(finding.directions, consequences, strict=True):
        if sky is not None:
            direction["sky"] = sky
            direction["words"] += _sky_words(sky)
    angles = {
        round(float(angle), 6)
        for dataset in measurement.datasets
        for angle in dataset.observations.position("hwp")
    }
    finding.sampling = harmonic_words(np.array(sorted(angles)))
    finding.mirrors = mirror_solutions(measurement, vector)
    return finding


def _sky_words(sky):
    turn, gain = sky["aolp_deg"], sky["dolp_percent"]
    return (
        f"; on sky this turns the AoLP by {_range(turn)} deg and changes the DoLP by "
        f"{_range(gain)} % of itself"
    )


def _range(span):
    low, high = span
    if max(abs(low), abs(high)) < 0.005:
        return "less than 0.01"
    return f"{low:+.2g}" if high - low < 0.005 else f"{low:+.2g} to {high:+.2g}"


def _decompose(scaled):
    """Return all singular values, all right vectors, and the rank."""
    n_data, n_free = scaled.shape
    _, singular, right = np.linalg.svd(scaled, full_matrices=n_data < n_free)
    singular = np.pad(singular, (0, n_free - singular.size))
    threshold = max(_RANK_TOLERANCE * singular.max(initial=0.0), _NOTHING)
    return singular, right, int(np.sum(singular > threshold))


def _covariance(scaled, held, scale):
    """Return the covariance for unit noise, NaN for what is held or not determined."""
    live = np.flatnonzero(~held)
    out = np.full((scale.size, scale.size), np.nan)
    if live.size:
        singular, right, rank = _decompose(scaled[:, live])
        half = right[:rank] / singular[:rank, None] * scale[live]
        known = (np.abs(right[rank:]) < _STILL).all(axis=0)
        out[np.ix_(live[known], live[known])] = (half.T @ half)[np.ix_(known, known)]
    return out


def physical_scale(free):
    """
    Return one degree, one micrometre or one percent of each parameter, canonical.

    Parameters
    ----------
    free : FreeParameters
        The free parameters.

    Returns
    -------
    `~numpy.ndarray`
        Shape (n_free,).

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.calibration import physical_scale
    >>> from astropolcal.measurement import FreeParameters
    >>> physical_scale(FreeParameters([optics.WollastonPrism(name="wollaston")], 1)).tolist()
    [0.01]
    """
    kinds = [_step(slot.unit)[0] for slot in free.slots]
    return np.repeat(kinds, [slot.size for slot in free.slots])


def _step(unit):
    """Return the step of a parameter in canonical units, its size and its unit in words."""
    if unit is None:
        return 0.01, 0.01, ""
    if u.Unit(unit).is_equivalent(u.rad):
        return np.deg2rad(1.0), 1.0, " deg"
    return 1.0, 1.0, " um"


def _directions(free, null):
    """Rewrite the null directions so that each is led by one parameter; say them in words."""
    directions = []
    for vector, lead in _reduced(free, null):
        moved = {}
        for slot in free.slots:
            part = vector[slot.slice] * _step(slot.unit)[1]
            if np.abs(vector[slot.slice]).max() > _WORTH_A_WORD:
                moved[slot.name] = part[0] if slot.size == 1 else part
        directions.append({"words": _words(free, moved, lead), "parameters": _plain(moved)})
    return directions


def _reduced(free, null):
    """Yield each null vector, led by a parameter that the others do not move."""
    if not len(null):
        return
    leads = _leads(free, null)
    for vector, lead in zip(np.linalg.solve(null[:, leads], null), leads, strict=True):
        yield vector, free.names[lead]


def _leads(free, null):
    """Choose a leading parameter for each null direction, those for all wavelengths first."""
    order = np.argsort(
        [slot.per_wavelength for slot in free.slots for _ in range(slot.size)], kind="stable"
    )
    columns, leads = null.copy(), []
    while len(leads) < len(null):
        size = np.linalg.norm(columns, axis=0)
        single = size[order[: _n_single(free)]]
        # the first that moves about as much as any: small changes of the data do not reorder
        pool = order[: _n_single(free)] if single.size and single.max() > 1e-3 else order
        lead = next(i for i in pool if size[i] > 0.3 * size[pool].max())
        direction = columns[:, lead] / size[lead]
        columns -= np.outer(direction, direction @ columns)
        leads.append(int(lead))
    return leads


def _n_single(free):
    return sum(not slot.per_wavelength for slot in free.slots)


def _words(free, moved, lead):
    others = [
        _change(free, name, value) for name, value in moved.items() if name != lead.split("[")[0]
    ]
    stem = lead.split("[")[0]
    step = _step(free.by_name[stem].unit)
    size = f"{step[1]:g}{step[2]}"
    if not others:
        return f"{lead} changes no datum: it cannot be determined"
    return f"{lead} by +{size} cannot be told from {', '.join(others)}"


def _change(free, name, value):
    unit = _step(free.by_name[name].unit)[2]
    if np.ndim(value) == 0:
        return f"{name} by {value:+.3g}{unit}"
    low, high = np.min(value), np.max(value)
    return f"{name} by {low:+.3g} to {high:+.3g}{unit} over the wavelengths"


def _plain(moved):
    return {
        name: float(value) if np.ndim(value) == 0 else [float(v) for v in value]
        for name, value in moved.items()
    }
