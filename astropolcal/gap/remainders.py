# Licensed under a 3-clause BSD style license - see LICENSE
"""
What no pattern describes: a few shapes of the remainder, and frames at odds with the run.

A remainder that is real has structure: a few singular vectors of the table of
wavelengths and frames stand above what noise gives (Tracy & Widom 1996,
doi:10.1007/BF02099545; Johnstone 2001, doi:10.1214/aos/1009210544). A frame at
odds with the others speaks of the lamp or of the exposure, not of the optics.
"""

import warnings
from dataclasses import dataclass

import numpy as np
from astropy.table import QTable
from scipy import stats

from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.gap.channels import CHANNELS
from astropolcal.gap.patterns import frame_blocks, frame_patterns
from astropolcal.observations.quality import MAD_TO_SIGMA, robust_curve

__all__ = ["Component", "outlying_frames", "remainder"]

_ALPHA = 1e-3
_MOST = 4
# the Tracy-Widom law of order one as a shifted gamma law (Chiani 2014,
# doi:10.1016/j.jmva.2014.04.002)
_TW_SHAPE, _TW_SCALE, _TW_SHIFT = 46.446, 0.186054, 9.84801
# robust standard deviations beyond which a frame is at odds with the others
_FAR = 6.0
# a real departure of a frame moves nearly all wavelengths the same way, noise half of them
_SAME_SIGN = 0.9
_LARGEST_DRIFT = 4
_LEAST_SHARE = 0.01
_CLEARLY = 0.02
# below half of its variance a pattern does not describe a shape
_PLAIN = 0.5


@dataclass
class Component:
    """
    One shape of the remainder: a spectrum times a function of the frame.

    Parameters
    ----------
    dataset, channel : str
        Where it was found.
    share : float
        Of the excess of all residuals over the noise.
    p_value : float
        Probability that noise gives a singular value as large.
    spectrum : `~numpy.ndarray`
        Shape in wavelength, in units of the noise, (W,).
    frames : `~numpy.ndarray`
        Function of the frame, of mean square one, (F,).
    words : str
        Where it lies.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.remainders import Component
    >>> Component("a", "difference", 0.6, 1e-9, np.ones(2), np.ones(3), "everywhere").share
    0.6
    """

    dataset: str
    channel: str
    share: float
    p_value: float
    spectrum: np.ndarray
    frames: np.ndarray
    words: str


def remainder(model, *, alpha=_ALPHA):
    """
    Describe what a fitted model leaves by a few shapes.

    Parameters
    ----------
    model : Model
        The fitted model.
    alpha : float
        Probability of a false shape, over all tables.

    Returns
    -------
    list of Component
        Largest first; empty if the remainder is noise.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.remainders import remainder
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> model = nominal_model([chain], [simulate(chain, charis.wavelength, frames, seed=1)])
    >>> remainder(model)
    []
    """
    problem, residual = model.problem, model.residual
    freedom = problem.n_data - problem.tangent(model.fit.coefficients).shape[1]
    scale = max(residual @ residual - freedom, np.sqrt(2 * max(freedom, 1)))
    found = []
    # Bonferroni: two channels of every dataset are looked at
    looks = 2 * len(problem.datasets)
    for dataset, channel, rows in zip(
        problem.datasets, problem.channels, problem.segments, strict=True
    ):
        tables = residual[rows].reshape(channel.shape)
        wavelength = problem.wavelength[dataset.bins]
        for name, table in zip(CHANNELS, tables, strict=True):
            found += _shapes(table, name, dataset.observations, wavelength, alpha / looks)
    for one in found:
        one.share = float(np.clip(one.share / scale, 0, 1))
    found = [one for one in found if one.share > _LEAST_SHARE]
    return sorted(found, key=lambda one: -one.share)


def _shapes(table, channel, observations, wavelength, alpha):
    left, singular, right = np.linalg.svd(table, full_matrices=False)
    n, m = table.shape
    found = []
    for k in range(min(_MOST, len(singular))):
        # what is left once k shapes are out is a table with as many rows and columns less
        p = _chance(singular[k] ** 2, n - k, m - k)
        if p > alpha:
            break
        spectrum = left[:, k] * singular[k] / np.sqrt(m)
        frames = right[k] * np.sqrt(m)
        # a pair of singular vectors has any sign: the spectrum is positive where it is strongest
        sign = np.sign(spectrum[ranked(np.abs(spectrum))[0]])
        spectrum, frames = sign * spectrum, sign * frames
        # the square of a singular value that stands out is that of the signal and n + m of noise
        square = max(singular[k] ** 2 - n - m, 0.0)
        words = _words(spectrum, frames, channel, observations, wavelength)
        found.append(Component(observations.name, channel, square, p, spectrum, frames, words))
    return found


def _chance(square, n, m):
    """Return the probability that the largest squared singular value of noise is as large."""
    if min(n, m) < 2:
        return float(stats.chi2.sf(square, n * m))
    root = np.sqrt(m - 1) + np.sqrt(n)
    spread = root * (1 / np.sqrt(m - 1) + 1 / np.sqrt(n)) ** (1 / 3)
    score = (square - root**2) / spread
    return float(stats.gamma.sf((score + _TW_SHIFT) / _TW_SCALE, _TW_SHAPE))


def _words(spectrum, frames, channel, observations, wavelength):
    where = _range(spectrum, wavelength)
    title, agreement = _likeness(frames, observations)
    beams = "differences" if channel == "difference" else "sums"
    tail = (
        f"follows {title} ({100 * agreement:.0f} % of its variance over the frames)"
        if agreement > _PLAIN
        else f"follows no angle and no trend (nearest: {title}, {100 * agreement:.0f} %)"
    )
    return f"{beams} of {observations.name}, strongest at {where}; {tail}"


def _range(spectrum, wavelength):
    """Return the shortest range of wavelengths that holds half of the power."""
    order = np.argsort(wavelength)
    power = np.concatenate([[0], np.cumsum(spectrum[order] ** 2)])
    pairs = [
        (b - a, a, b)
        for a in range(len(order))
        for b in range(a + 1, len(order) + 1)
        if power[b] - power[a] >= 0.5 * power[-1]
    ]
    _, a, b = min(pairs)
    first, last = (1000 * wavelength[order[i]] for i in (a, b - 1))
    return f"{first:.0f} nm" if b - a == 1 else f"{first:.0f}-{last:.0f} nm"


def _likeness(frames, observations):
    """Return the words of the pattern nearest to a function of the frame, and its share."""
    best, share = "nothing", -np.inf
    total, n = frames @ frames, frames.size
    for (_, words), columns in frame_patterns(observations).items():
        left, singular, _ = np.linalg.svd(columns.T, full_matrices=False)
        span = left[:, singular > 1e-6 * singular[0]]
        # adjusted for the number of columns, lest the richest pattern win always
        k = span.shape[1]
        missed = 1 - np.sum((span.T @ frames) ** 2) / total
        adjusted = 1 - missed * n / max(n - k, 1)
        # the simpler ones come first
        if adjusted > share + _CLEARLY:
            best, share = words, float(adjusted)
    return best, max(share, 0.0)


# ---- frames at odds with the run ---------------------------------------------------------------


def outlying_frames(model):
    """
    Find frames, or runs of frames at one derotator angle, that are at odds with the others.

    A frame is taken for an outlier if the brightness common to all wavelengths
    departs from a smooth drift of the lamp by six robust standard deviations,
    or if the difference of the beams departs by as much, to one side at nine
    wavelengths of ten. A run is named as one if half of its frames are.

    Parameters
    ----------
    model : Model
        The fitted model.

    Returns
    -------
    `~astropy.table.QTable`
        Worst first: ``dataset``, ``frames`` (numbers as text), ``channel``,
        ``deviation`` (largest, in the logarithm of the flux or in the normalized
        difference), ``sigma`` (in robust standard deviations) and ``words``.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.remainders import outlying_frames
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> lamp = np.where(np.arange(24) == 5, 0.9, 1.0)
    >>> data = simulate(chain, charis.wavelength, frames, lamp=lamp, seed=3)
    >>> outlying_frames(nominal_model([chain], [data]))["frames"].tolist()
    ['5']
    """
    rows = []
    problem = model.problem
    for dataset, channel, gap in zip(
        problem.datasets, problem.channels, problem.differences(model.fit.coefficients), strict=True
    ):
        for name, table in zip(CHANNELS, gap, strict=True):
            rows += _runs(dataset.observations, name, *_far_off(channel, name, table))
    rows.sort(key=lambda row: -row["sigma"])
    names = ("dataset", "frames", "channel", "deviation", "sigma", "words")
    if not rows:
        return QTable(names=names, dtype=("U1", "U1", "U1", float, float, "U1"))
    return QTable({name: [row[name] for row in rows] for name in names})


def off_the_drift(model):
    """
    Find frames whose brightness is off the drift of the lamp.

    Parameters
    ----------
    model : Model
        The fitted model.

    Returns
    -------
    list of tuple
        One a dataset: the observations, which frames are far off, by how much (logarithm of
        the flux) and in robust standard deviations, (F,) each.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.model import nominal_model
    >>> from astropolcal.gap.remainders import off_the_drift
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> lamp = np.where(np.arange(24) == 5, 0.9, 1.0)
    >>> data = simulate(chain, charis.wavelength, frames, lamp=lamp, seed=3)
    >>> (_, far, *_), = off_the_drift(nominal_model([chain], [data]))
    >>> np.flatnonzero(far).tolist()
    [5]
    """
    gaps = model.problem.differences(model.fit.coefficients)
    return [
        (dataset.observations, *_far_off(channel, "sum", gap[1]))
        for dataset, channel, gap in zip(
            model.problem.datasets, model.problem.channels, gaps, strict=True
        )
    ]


def _far_off(channel, name, table):
    """Return which frames are far off in a channel, by how much, and by how many sigma."""
    sigma = channel.sigma[CHANNELS.index(name)]
    known = channel.valid & np.isfinite(sigma)
    with warnings.catch_warnings():
        # a frame that is masked at all wavelengths has no median
        warnings.simplefilter("ignore", RuntimeWarning)
        common, error, agree = _common(np.where(known, table, np.nan), sigma)
    curve = _drift(channel.sequence, common, _LARGEST_DRIFT if name == "sum" else 0)
    spread = max(MAD_TO_SIGMA * np.nanmedian(np.abs(common - curve)), np.nanmedian(error))
    score = (common - curve) / spread
    far = np.abs(np.nan_to_num(score)) > _FAR
    far &= agree if name == "difference" else True
    return far, common - curve, score


def _common(table, sigma):
    """Return what is common to all wavelengths of a frame, its error, and whether signs agree."""
    centred = table - np.nanmedian(table, axis=1, keepdims=True)
    common = np.nanmedian(centred, axis=0)
    same = np.nanmean(np.sign(centred) == np.sign(common), axis=0)
    count = np.maximum(np.isfinite(table).sum(axis=0), 1)
    # the variance of a median of n is pi / 2 times that of their mean: 1.25 squared
    return common, np.nanmedian(sigma, axis=0) * 1.25 / np.sqrt(count), same >= _SAME_SIGN


def _drift(sequence, values, largest):
    """Return the curve whose median deviation is least for what its degree costs."""
    best, chosen, n = np.inf, None, np.isfinite(values).sum()
    for degree in range(min(largest, max(n // 4, 0)) + 1):
        curve = robust_curve(2 * sequence - 1, values, degree)
        middle = max(np.nanmedian(np.abs(values - curve)), 1e-12)
        score = n * np.log(middle) + degree * np.log(max(n, 2))
        if score < best:
            best, chosen = score, curve
    return chosen


def _runs(observations, channel, far, deviation, score):
    """Return one row a run of which half is far off, and one a single frame."""
    blocks = frame_blocks(observations)
    size = np.bincount(blocks)
    whole = (np.bincount(blocks, far) >= np.maximum(size / 2, 3))[blocks]
    groups = [np.flatnonzero(blocks == b) for b in np.unique(blocks[whole])]
    groups += [np.array([f]) for f in np.flatnonzero(far & ~whole)]
    return [_row(observations, channel, group, deviation, score) for group in groups]


def _row(observations, channel, group, deviation, score):
    worst = group[np.nanargmax(np.abs(score[group]))]
    numbers = f"{group[0]}-{group[-1]}" if len(group) > 1 else f"{group[0]}"
    where = f"frames {numbers}" if len(group) > 1 else f"frame {numbers}"
    if "derotator" in observations.frames.colnames:
        angle = np.rad2deg(observations.position("derotator")[worst])
        where = f"derotator {angle:.4g} deg ({where} of {observations.name})"
    else:
        where = f"{where} of {observations.name}"
    size = 100 * abs(np.expm1(deviation[worst]) if channel == "sum" else deviation[worst])
    words = (
        f"lamp unstable at {where}: off its drift by up to {size:.2g} %"
        if channel == "sum"
        else f"all wavelengths depart together at {where}: differences off by up to {size:.2g} %"
    )
    return {
        "dataset": observations.name,
        "frames": numbers,
        "channel": channel,
        "deviation": float(deviation[worst]),
        "sigma": float(abs(score[worst])),
        "words": words,
    }
