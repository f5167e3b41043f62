# Licensed under a 3-clause BSD style license - see LICENSE
"""Polarimetric efficiency: how much of the linear polarization of the sky an observation measures.

What a retarder turns into circular polarization is lost for an instrument that measures linear
polarization only. The efficiency is the degree of linear polarization that a cycle of the
half-wave plate measures of a source that is completely polarized (McIntosh et al. 2026, Sec. 7.1):
of the normalized double differences at 0 and 22.5 deg, downstream of an ideal beam splitter. The
modulation efficiency of the real one does not enter.

Of any sequence of frames, of any polarimeter, `demodulation` gives the modulation matrix, what
turns the fluxes into Stokes parameters with the least noise, and the efficiencies of each of these.
"""

from dataclasses import dataclass

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal import instruments
from astropolcal.chain import join, leaves, stages, system_mueller
from astropolcal.exceptions import ChainError, ParameterError
from astropolcal.instruments import SkyLaw
from astropolcal.observations.pointings import horizontal, tracked
from astropolcal.optics import COORDINATES, Rotator
from astropolcal.optics.positions import finite_position
from astropolcal.propagation import Propagator
from astropolcal.simulation import beams_of_frames, stage_positions
from astropolcal.units import (
    angle_to_rad,
    canonical_factor,
    check_seed,
    length_to_um,
    to_unit,
    wavelengths_of,
)
from astropolcal.words import check_choice, counted

__all__ = ["best_derotator", "best_modulation", "demodulation", "polarimetric_efficiency"]

# plus and minus angles of the half-wave plate, and where a modulator has exchanged the beams
_CYCLE = [0, 45, 22.5, 67.5] * u.deg
_EXCHANGED = [45, 0, 67.5, 22.5] * u.deg
_SKY = {"parallactic", "altitude"}
_MOST_CELLS = 2_000_000


def sky_path(chain):
    """Return the optics from the sky to the beam splitter, without either.

    Of an internal source what stands before the first optic on a stage belongs to the source.
    """
    found = leaves(chain)
    # what treats the light of the two beams differently upstream of the splitter is no part of it
    split = next((i for i, leaf in enumerate(found) if leaf.splits_light), 0)
    found = [leaf for leaf in found[:split] if not leaf.depends_on_beam] + found[split:]
    end = next((i for i, leaf in enumerate(found) if leaf.depends_on_beam), len(found))
    moving = (i for i, leaf in enumerate(found) if leaf.stage and leaf.stage not in COORDINATES)
    train = list(found[next(moving, end) : end])
    if not train:
        raise ChainError("the chain has no optic on a stage upstream of a beam splitter")
    last = found[end] if end < len(found) else None
    # the frame of a beam splitter that does not stand straight, or turns
    if last is not None and (last.theta.value or (last.splits_light and last.stage)):
        mount = last.mount if last.splits_light else None
        train.append(Rotator(theta=last.theta.quantity, mount=mount, name="analyser"))
    return join(train)


def has_derotator(chain):
    """Return whether a chain has a derotator: an optic on a stage that is not the plate's."""
    return bool(_turning(sky_path(chain)))


def has_plate(chain):
    """Return whether cycles of a half-wave plate modulate a chain, and no device with states."""
    return "hwp" in stages(chain) and not any("=" in stage for stage in stages(chain))


def _turning(path):
    """Return the stages with angles that are neither the plate's nor those of the sky."""
    return {stage for stage in stages(path) if stage not in COORDINATES} - {*_SKY, "hwp"}


def polarimetric_efficiency(
    chain,
    wavelength,
    *,
    derotator=None,
    altitude=None,
    parallactic=None,
    aolp=90 * u.deg,
    instrument=None,
    mode=None,
    law=None,
):
    r"""
    Return the degree of linear polarization measured of a completely polarized source.

    For a linear retarder :math:`\Delta` at the angle D downstream of an ideal half-wave plate it is
    :math:`\sqrt{\cos^2 2D + \sin^2 2D \cos^2\Delta}`, at all angles of polarization: least at
    45 and 135 deg. Telescope and half-wave plate change that by a few percent.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        A calibrated chain, from the sky or of an internal source, see ``sky_path``.
    wavelength : `~astropy.units.Quantity`
        Shape (n_wavelengths,); that of the chain's parameters where these are given per wavelength.
    derotator : `~astropy.units.Quantity`, optional
        Angle of the derotator, regardless of the name of its stage; needed if there is one. The
        angles broadcast against each other.
    altitude, parallactic : `~astropy.units.Quantity`, optional
        Where the telescope points; needed for a chain from the sky, the altitude only if it
        turns an optic. The half-wave plate then follows the tracking law.
    aolp : `~astropy.units.Quantity` or None
        Angle of the source's polarization, on sky or downstream of an internal source; 90 deg, the
        paper's choice, is -Q. With None the angle that is measured worst.
    instrument : str or Instrument, optional
        Whose half-wave plate it is: its ``sky_law`` is the tracking law. Without it that of
        `~astropolcal.instruments.SkyLaw`.
    mode : str, optional
        What the derotator stabilizes, such as ``"field"``; needed where the law of the plate
        depends on it.
    law : (float, float), optional
        Another tracking law of the half-wave plate: factors of parallactic angle and altitude.

    Returns
    -------
    `~numpy.ndarray`
        Of the broadcast shape of the angles and (n_wavelengths,); between 0 and 1, up to the
        polarization that the optics make themselves.

    Raises
    ------
    ChainError
        If the chain has no half-wave plate, or a stage that has no position here.
    ParameterError
        If an angle is missing or not finite, or too many values are asked for.
    ObservationError
        If the altitude is not above 0 to 90 deg.
    InstrumentError
        If the instrument or the mode is unknown.

    Notes
    -----
    A modulator on the stage ``flc_state`` is averaged over both of its states.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.efficiency import polarimetric_efficiency
    >>> from astropolcal import instruments
    >>> charis = instruments.get("charis")
    >>> chain = charis.on_sky(charis.published())
    >>> efficiency = polarimetric_efficiency(chain, charis.wavelength, derotator=[45, 90] * u.deg,
    ...                                      altitude=60 * u.deg, parallactic=94 * u.deg,
    ...                                      instrument=charis)
    >>> efficiency.shape, efficiency[:, 9].round(2).tolist()
    ((2, 22), [0.28, 0.99])
    """
    path = sky_path(chain)
    if not has_plate(path):
        raise ChainError(
            "the chain has no cycle of a half-wave plate with two beams (stage hwp); "
            "astropolcal.efficiency.demodulation gives the efficiencies of its frames"
        )
    _check_shapes(derotator=derotator, altitude=altitude, parallactic=parallactic)
    if law is None:
        # it only counts on sky
        law = _law_of(instrument).plate_law(mode) if _SKY & set(stages(path)) else (0.0, 0.0)
    elif to_unit(law, None, "law").shape != (2,):
        raise ParameterError(
            f"law = {law}; two factors, of parallactic angle and altitude, are needed"
        )
    positions = _positions(path, derotator, altitude, parallactic, law)
    lam = np.atleast_1d(wavelengths_of(wavelength))
    shape = np.broadcast_shapes(*(np.shape(angle) for angle in positions.values()))
    if np.prod(shape, dtype=float) * lam.size > _MOST_CELLS:
        raise ParameterError(
            f"{shape} angles at {lam.size} wavelengths are too many; allowed are {_MOST_CELLS}"
        )
    flat = {stage: np.broadcast_to(a, shape).ravel() * u.rad for stage, a in positions.items()}
    cycles = [(_CYCLE, flat)]
    if "flc_state" in stages(path):
        count = len(flat["hwp"])
        states = (flat | {"flc_state": np.full(count, state)} for state in (0.0, 1.0))
        cycles = zip((_CYCLE, _EXCHANGED), states, strict=True)
    # rows I and Q at the four angles of the plate, mean over the states of a modulator
    found = []
    for angles, at in cycles:
        turned = (at | {"hwp": at["hwp"] + further} for further in angles)
        found.append([system_mueller(path, lam, one)[..., :2, :] for one in turned])
    return _measured(np.mean(found, axis=0), aolp).reshape(*shape, lam.size)


def _check_shapes(**angles):
    shapes = {name: np.shape(angle) for name, angle in angles.items() if angle is not None}
    try:
        np.broadcast_shapes(*shapes.values())
    except ValueError:
        words = ", ".join(f"{name} has shape {shape}" for name, shape in shapes.items())
        raise ParameterError(f"{words}; they must broadcast against each other") from None


def _law_of(instrument):
    if instrument is None:
        return SkyLaw()
    return (instruments.get(instrument) if isinstance(instrument, str) else instrument).sky_law


def _derotator_stage(path):
    """Return the stage that turns with the derotator, None where there is none."""
    angles = _turning(path)
    if "derotator" in angles or not angles:
        return "derotator" if angles else None
    return angles.pop() if len(angles) == 1 else None


def _positions(path, derotator, altitude, parallactic, law):
    """Return the position of every stage in radian."""
    wanted = {stage for stage in stages(path) if stage not in COORDINATES}
    turning = _derotator_stage(path)
    found = {"hwp": 0.0}
    if derotator is not None:
        found[turning or "derotator"] = angle_to_rad(derotator, "derotator")
    elif turning is not None:
        raise ParameterError(f"the chain has an optic on the stage {turning}: derotator= is needed")
    if _SKY & wanted:
        needs_altitude = "altitude" in wanted or (law[1] and "hwp" in wanted)
        if parallactic is None or (altitude is None and needs_altitude):
            lacking = "altitude= and parallactic=" if needs_altitude else "parallactic="
            raise ParameterError(f"a chain from the sky needs {lacking}")
        a, p = horizontal(90 * u.deg if altitude is None else altitude, parallactic)
        found |= {"altitude": a, "parallactic": p, "hwp": tracked(0.0, p, a, law)}
    unknown = wanted - set(found)
    if unknown:
        raise ChainError(f"no position of the stages {', '.join(sorted(unknown))}")
    return {stage: found[stage] for stage in {"derotator", *wanted} & set(found)}


def _measured(rows, aolp):
    """Return the degree of polarization of a cycle, from rows I and Q at its four angles."""
    if aolp is not None:
        if np.ndim(aolp):
            raise ParameterError(f"aolp has shape {np.shape(aolp)}; one angle is needed")
        angle = 2 * finite_position(aolp, "aolp")
        light = np.array([1.0, np.cos(angle), np.sin(angle), 0.0])
        total, difference = np.moveaxis(rows @ light, -1, 0)
        # (2, ...): q from 0 and 45 deg, u from 22.5 and 67.5 deg
        double = (difference[0::2] - difference[1::2]) / (total[0::2] + total[1::2])
        return np.hypot(*double)
    # to first order of what the optics polarize themselves
    total = rows[0::2, ..., 0, 0] + rows[1::2, ..., 0, 0]
    difference = rows[0::2, ..., 1, 1:3] - rows[1::2, ..., 1, 1:3]
    response = np.moveaxis(difference / total[..., None], 0, -2)
    # the worst angle of polarization is the direction of the least singular value
    return np.linalg.svd(response, compute_uv=False)[..., -1]


# ---- planning --------------------------------------------------------------------------------


@dataclass
class BestDerotator:
    """
    Offsets of the derotator for an observation, and the efficiency each gives.

    Parameters
    ----------
    offset : `~astropy.units.Quantity`
        The best offset.
    table : `~astropy.table.QTable`
        One row an offset: ``offset``; ``mean`` and ``least``, efficiency over the observation and
        the wavelengths, at the worst angle of polarization; and ``now``, the same at the first
        moment.
    law : str
        What the derotator stabilizes.

    Examples
    --------
    >>> from astropolcal.efficiency import BestDerotator
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> BestDerotator(65 * u.deg, QTable(), "pupil").offset
    <Quantity 65. deg>
    """

    offset: u.Quantity
    table: QTable
    law: str


def best_derotator(
    chain,
    wavelength,
    altitude,
    parallactic,
    *,
    law="pupil",
    offsets=None,
    by="least",
    instrument=None,
):
    """
    Find the offset of the derotator that loses least polarization in an observation.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        A calibrated chain from the sky.
    wavelength : `~astropy.units.Quantity`
        The wavelengths that count, on the grid of the chain's parameters.
    altitude, parallactic : `~astropy.units.Quantity`
        Over the observation, shape (n_times,); `~astropolcal.observations.pointing` gives them for
        target, time and site.
    law : str
        What the derotator stabilizes, usually ``"pupil"`` or ``"field"``: one of the modes of the
        instrument's law.
    offsets : `~astropy.units.Quantity`, optional
        Offsets to try, by default 0 to 179 deg in steps of 1 deg.
    by : {"least", "mean"}
        Whether the worst or the mean moment and wavelength decides.
    instrument : str or Instrument, optional
        Whose plate and derotator they are: its ``sky_law`` counts, without it
        that of `~astropolcal.instruments.SkyLaw` at a Nasmyth focus.

    Returns
    -------
    ``BestDerotator``

    Raises
    ------
    ParameterError
        If a choice is unknown, or offsets or times are none, or in more than one row.
    ChainError
        If the chain, or the instrument, has no derotator.
    ObservationError
        If the target is below the horizon.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.efficiency import best_derotator
    >>> from astropolcal import instruments
    >>> charis = instruments.get("charis")
    >>> best = best_derotator(charis.on_sky(charis.published()), charis.wavelength,
    ...                       [60, 65] * u.deg, [-30, -20] * u.deg,
    ...                       offsets=range(0, 180, 5) * u.deg)
    >>> bool(best.table["least"].max() > 0.9)
    True
    """
    sky_law = _law_of(instrument)
    if not sky_law.derotator or _derotator_stage(sky_path(chain)) is None:
        raise ChainError("there is no derotator whose offset could be chosen")
    if law not in sky_law.derotator or by not in ("least", "mean"):
        allowed = ", ".join(sky_law.derotator)
        raise ParameterError(f"law = {law!r}, by = {by!r}; allowed are {allowed}, and least, mean")
    offsets = np.atleast_1d(np.arange(180) * u.deg if offsets is None else offsets)
    finite_position(offsets, "offsets")
    _check_shapes(altitude=altitude, parallactic=parallactic)
    a, p = (np.atleast_1d(angle) * u.rad for angle in horizontal(altitude, parallactic))
    for name, angle in (("offsets", offsets), ("altitude", a), ("parallactic", p)):
        if angle.ndim != 1 or not angle.size:
            raise ParameterError(f"{name} has shape {angle.shape}; some in one row are needed")
    f, g = sky_law.derotator_law(law)
    efficiency = polarimetric_efficiency(
        chain,
        wavelength,
        # (n_offsets, n_times)
        derotator=offsets[:, None] + f * p + g * a,
        altitude=a,
        parallactic=p,
        aolp=None,
        law=sky_law.plate_law(law),
    )
    table = QTable({"offset": offsets.to(u.deg)})
    table["mean"] = efficiency.mean(axis=(1, 2))
    table["least"] = efficiency.min(axis=(1, 2))
    table["now"] = efficiency[:, 0].min(axis=1)
    return BestDerotator(table["offset"][np.argmax(table[by])], table, law)


# ---- modulation of any sequence of frames --------------------------------------------------------

#: Below this a Stokes parameter is not modulated.
_LEAST = 1e-3
_COMPONENTS = ("IQU", "IQUV")
_STARTS = 8


@dataclass(frozen=True)
class Demodulation:
    r"""
    How a sequence of frames modulates Stokes parameters, and how these are found again.

    A measurement is one beam of one frame, :math:`I_m = O\,S`; what has least noise is
    :math:`S = D\,I_m` with the pseudo-inverse :math:`D = (O^T W O)^{-1} O^T W` for the inverse
    variances W.

    Parameters
    ----------
    components : str
        ``"IQU"`` or ``"IQUV"``.
    modulation : `~numpy.ndarray`
        O, shape (n_wavelengths, n_measurements, n_components): right and left beam of each frame
        in turn, or each single beam; for light of unit intensity.
    matrix : `~numpy.ndarray`
        D, shape (n_wavelengths, n_components, n_measurements).
    efficiency : `~numpy.ndarray`
        Shape (n_wavelengths, n_components): :math:`\epsilon_i = (n \sum_j D_{ij}^2)^{-1/2}` with
        the mean of the first column of O as the unit, at best 1 for I and :math:`\sum \epsilon^2
        = 1` for the others.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.efficiency import Demodulation
    >>> two = np.array([[[0.5, 0.5], [0.5, -0.5]]])
    >>> Demodulation("IQ", two, np.linalg.inv(two), np.ones((1, 2))).stokes([[1.5, 0.5]]).tolist()
    [[2.0, 1.0]]
    """

    components: str
    modulation: np.ndarray
    matrix: np.ndarray
    efficiency: np.ndarray

    def stokes(self, fluxes):
        """Return Stokes parameters, (n_wavelengths, n_components), of fluxes (n_wavelengths, n)."""
        fluxes = np.asarray(fluxes, dtype=float)
        return np.einsum("wkn,wn->wk", self.matrix, fluxes)


def demodulation(chain, wavelength, frames, *, components="IQUV", variance=None):
    """
    Return the modulation of a sequence of frames, its optimal demodulation and efficiencies.

    Efficiencies are those of del Toro Iniesta & Collados (2000), Appl. Opt. 39, 1637,
    doi:10.1364/AO.39.001637.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The optics from the light that is to be measured to the detector, without a source.
    wavelength : `~astropy.units.Quantity`
        Shape (n_wavelengths,).
    frames : `~astropy.table.QTable`
        One row per frame with the position or state of every stage, as
        `~astropolcal.simulation.simulate` takes it.
    components : {"IQUV", "IQU"}
        What is solved for; without V it is taken as zero.
    variance : array_like, optional
        Of the measurements, relative to each other, (n_measurements,); by default all alike.

    Returns
    -------
    ``Demodulation``

    Raises
    ------
    ParameterError
        If an efficiency is below 0.001, or a choice is unknown.
    ChainError
        If the position of a stage is missing.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from astropolcal import optics
    >>> from astropolcal.efficiency import demodulation
    >>> chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp") | optics.WollastonPrism()
    >>> cycle = QTable({"hwp": [0, 45, 22.5, 67.5] * u.deg})
    >>> demodulation(chain, [1.6] * u.um, cycle, components="IQU").efficiency.round(3).tolist()
    [[1.0, 0.707, 0.707]]
    """
    check_choice("components", components, _COMPONENTS, ParameterError)
    found = _demodulated(_modulation(chain, wavelength, frames), components, variance)
    weak = ~(found.efficiency >= _LEAST)
    if weak.any():
        w, k = np.argwhere(weak)[0]
        lam = np.atleast_1d(u.Quantity(wavelength))[w]
        raise ParameterError(
            f"the efficiency of {components[k]} is {np.nan_to_num(found.efficiency[w, k]):.2g} at "
            f"{lam:.6g}; {_LEAST:g} is needed: the {counted(len(frames), 'frame')} do not "
            "modulate it"
        )
    return found


def _modulation(chain, wavelength, frames):
    """Return the rows of all measurements, (n_wavelengths, n_measurements, 4)."""
    names, frames, _ = beams_of_frames(chain, frames, None)
    lam, positions = length_to_um(wavelength), stage_positions(chain, frames)
    if not positions:
        positions = {"frame": np.zeros(len(frames))}
    light = [Propagator(chain, np.atleast_1d(lam), positions, one) for one in np.eye(4)]
    # (4, beams, n_wavelengths, n_frames)
    fluxes = np.stack([one.fluxes()[: len(names)] for one in light])
    return np.moveaxis(fluxes, (2, 3, 1), (0, 1, 2)).reshape(fluxes.shape[2], -1, 4)


def _demodulated(rows, components, variance=None):
    """Return the demodulation of rows, the efficiency zero where they do not determine it."""
    rows = rows[..., : len(components)]
    count = rows.shape[1]
    variance = np.ones(count) if variance is None else np.asarray(variance, dtype=float)
    if variance.shape != (count,) or not np.all(np.isfinite(variance) & (variance > 0)):
        raise ParameterError(
            f"variance of shape {variance.shape}; {count} numbers above zero are needed"
        )
    root = 1 / np.sqrt(variance)
    # a flux that never comes is no unit
    unit = np.maximum(rows[..., 0].mean(axis=1), np.finfo(float).tiny)
    normal = rows / unit[:, None, None]
    # singular values far below what an efficiency may be
    matrix = np.linalg.pinv(normal * root[:, None], rcond=_LEAST**2) * root
    noise = count * np.sum(matrix**2, axis=2)
    # of a parameter that is not modulated the pseudo-inverse gives only a part
    told = np.einsum("wkn,wnk->wk", matrix, normal)
    whole = (np.abs(told - 1) < _LEAST) & (noise > 0)
    efficiency = np.where(whole, 1 / np.sqrt(np.where(noise > 0, noise, 1.0)), 0.0)
    return Demodulation(components, rows, matrix / unit[:, None, None], efficiency)


def best_modulation(chain, wavelength, frames, free, *, components="IQUV", seed=0):
    """
    Find angles, or retardances, with which a sequence modulates Stokes parameters best.

    What is least is the noise of the Stokes parameters but I, the sum of the inverse squares of
    their efficiencies, over the wavelengths, from several random starts.

    Parameters
    ----------
    chain, wavelength, frames, components
        As for `demodulation`.
    free : sequence of str
        Stages whose angles in all frames are free, such as ``"qwp"``, and parameters that are,
        such as ``"lcvr_A.retardance"``; scalars within their bounds.
    seed : int
        Of the starts; the first is as given.

    Returns
    -------
    chain : `~astropy.modeling.CompoundModel`
        A copy with the parameters found.
    frames : `~astropy.table.QTable`
        A copy with the angles found, 0 to 180 deg.
    best : ``Demodulation``

    Raises
    ------
    ParameterError
        If nothing free is known by that name, or no start modulates all.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.table import QTable
    >>> from astropolcal import optics
    >>> from astropolcal.efficiency import best_modulation
    >>> chain = (optics.LinearRetarder(retardance=132 * u.deg, mount="qwp", name="qwp")
    ...          | optics.LinearPolarizer(name="analyser"))
    >>> frames = QTable({"qwp": [-50, -15, 15, 50] * u.deg})
    >>> best_modulation(chain, [0.6] * u.um, frames, ["qwp"])[2].efficiency.round(2).tolist()
    [[1.0, 0.58, 0.58, 0.58]]
    """
    from scipy.optimize import minimize

    # refuses what is no table
    beams_of_frames(chain, frames, None)
    chain, frames, rng = chain.copy(), frames.copy(), np.random.default_rng(check_seed(seed))
    settings = [_setting(chain, frames, name) for name in free]
    sizes = np.cumsum([value.size for value, *_ in settings])[:-1]
    start = np.concatenate([value for value, *_ in settings]) if settings else np.zeros(0)
    low, high = (
        np.concatenate([np.full(v.size, ends[i]) for v, ends, _ in settings]) for i in (0, 1)
    )

    def noise(values):
        for (*_, put), own in zip(settings, np.split(values, sizes), strict=True):
            put(own)
        found = _demodulated(_modulation(chain, wavelength, frames), components)
        return float(np.mean(np.sum(1 / np.maximum(found.efficiency[:, 1:], _LEAST) ** 2, axis=1)))

    tried = [start, *rng.uniform(low, high, (_STARTS, start.size))]
    ends = [minimize(noise, one, bounds=list(zip(low, high, strict=True))) for one in tried]
    noise(min(ends, key=lambda one: one.fun).x)
    return chain, frames, demodulation(chain, wavelength, frames, components=components)


def _setting(chain, frames, name):
    """Return value (radian or canonical), ends, and what sets it, of a stage or a parameter."""
    optic, _, key = name.partition(".")
    if not key and name in stages(chain) and name not in COORDINATES and name in frames.colnames:

        def turn(values):
            frames[name] = np.rad2deg(values) % 180 * u.deg

        return angle_to_rad(frames[name], name), (-np.pi, np.pi), turn
    known = {leaf.name: leaf for leaf in leaves(chain)}
    if optic not in known or key not in known[optic].param_names:
        raise ParameterError(
            f"free = {name!r} is neither a column of frames with the angle of a stage nor "
            "optic.parameter of the chain"
        )
    parameter = getattr(known[optic], key)
    factor = canonical_factor(parameter.unit)
    ends = [np.nan if end is None else end * factor for end in parameter.bounds]
    if parameter.size > 1 or not np.all(np.isfinite(ends)):
        raise ParameterError(f"free = {name!r} must be one number with bounds")

    def put(values):
        parameter.value = float(values[0] / factor)

    return np.atleast_1d(parameter.value * factor), tuple(ends), put
