# Licensed under a 3-clause BSD style license - see LICENSE
"""Simulated observations: beam fluxes of any chain, with photon and read noise."""

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table

from astropolcal.chain import check_states, leaves, stages, states_of
from astropolcal.exceptions import ParameterError
from astropolcal.observations import Observations
from astropolcal.observations.pointings import in_state, modulator_states
from astropolcal.optics.positions import finite_position
from astropolcal.propagation import Propagator, splits
from astropolcal.units import check_seed, length_to_um, to_unit, wavelengths_of
from astropolcal.words import check_type

__all__ = ["half_wave_plate_cycles", "simulate"]

#: The angles of a calibration run of CHARIS (paper, Sec. 5.1).
_CYCLE = np.array([0, 45, 11.25, 56.25, 22.5, 67.5, 33.75, 78.75])

# of unit flux: products of a dozen Mueller matrices in doubles stay far below
_ROUNDING = 1e-12
_MOST_ELECTRONS = 1e18


def half_wave_plate_cycles(hwp=_CYCLE * u.deg, derotator=45 * u.deg):
    """
    Return the frames of half-wave-plate cycles at several derotator angles.

    Parameters
    ----------
    hwp : `~astropy.units.Quantity`
        Angles of one cycle, in the order taken; by default the eight of the CHARIS calibrations.
    derotator : `~astropy.units.Quantity`
        Derotator angles, one cycle at each.

    Returns
    -------
    `~astropy.table.QTable`
        Columns ``hwp`` and ``derotator``, one row per frame.

    Raises
    ------
    ParameterError
        If there is no angle, or one that is not finite or has no unit of an angle.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.simulation import half_wave_plate_cycles
    >>> len(half_wave_plate_cycles(derotator=[45, 57.5] * u.deg))
    16
    """
    for name, angles in (("hwp", hwp), ("derotator", derotator)):
        if not finite_position(angles, name).size:
            raise ParameterError(f"{name} = {angles}; at least one angle is needed")
    hwp, derotator = (np.ravel(u.Quantity(angles)) for angles in (hwp, derotator))
    return QTable(
        {"hwp": np.tile(hwp, derotator.size), "derotator": np.repeat(derotator, hwp.size)}
    )


def simulate(
    chain,
    wavelength,
    frames,
    *,
    flux=1e7,
    lamp=None,
    gain=1.0,
    read_noise=0.0,
    noise=True,
    source=(1.0, 0.0, 0.0, 0.0),
    seed=None,
    meta=None,
    name="simulated",
):
    """
    Simulate the beam fluxes that a chain gives in a list of frames.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        The true chain. Without a beam splitter there is one beam, or one for each
        ``mount="beam=NAME"`` of an `~astropolcal.optics.StateAnalyser`.
    wavelength : `~astropy.units.Quantity`
        Shape (n_wavelengths,).
    frames : `~astropy.table.QTable`
        One row per frame: the position of every stage (``hwp``, ``derotator``,
        ...) and any other column of the table.
    flux : float, array_like or `~astropy.units.Quantity`
        Flux that enters the chain, in adu; scalar or one value per wavelength.
    lamp : array_like, optional
        Relative brightness of the source in each frame.
    gain : float
        Electrons per adu.
    read_noise : float
        Standard deviation per beam and frame, in electrons.
    noise : bool
        Whether to draw noise; the errors are given either way.
    source : sequence of float
        Stokes vector of the source.
    seed : int or `~numpy.random.Generator`, optional
        Seed of the noise.
    meta : dict, optional
        Meta of the table.
    name : str
        Name of the dataset.

    Returns
    -------
    Observations
        With errors, on all frames and wavelengths.

    Raises
    ------
    ParameterError
        If flux, gain, lamp or noise are not positive, too large or of the wrong shape,
        the chain gives negative flux, the seed is none, there are no frames, or the chain
        has values per wavelength and the wavelengths do not ascend.
    ChainError
        If the position of a stage is missing in ``frames``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 90] * u.deg)
    >>> simulate(charis.chain(), charis.wavelength, frames, seed=1).n_frames
    16
    """
    wavelength, seed = np.atleast_1d(wavelengths_of(wavelength)), check_seed(seed)
    values = (getattr(leaf, key).size for leaf in leaves(chain) for key in leaf.param_names)
    if np.any(np.diff(wavelength) <= 0) and max(values, default=1) > 1:
        raise ParameterError(
            f"wavelength = {wavelength}: values per wavelength are those of ascending wavelengths"
        )
    # for unit source, (n_wavelengths, n_frames)
    names, frames, lamp = beams_of_frames(chain, frames, lamp)
    fluxes = expected_fluxes(chain, wavelength, frames, source)[: len(names)]
    scale = entering_flux(flux, lamp, len(frames), len(wavelength))
    # photons arrive in electrons, whatever a camera counts in
    gain = _positive("gain", gain, u.electron / u.adu)
    read_noise = _positive("read_noise", read_noise, u.electron, zero=True)
    electrons = np.stack([flux.T * scale for flux in fluxes]) * gain
    check_electrons(electrons)
    # of the expectation: an error from the drawn flux would be too small where that is low
    variance = electrons + read_noise**2
    if noise:
        rng = np.random.default_rng(seed)
        # one read noise a beam and frame, not a pixel
        drawn = rng.poisson(electrons) + rng.normal(0.0, 1.0, electrons.shape) * read_noise
        electrons = drawn.astype(float)
    table = _table(wavelength, frames, names, electrons / gain, np.sqrt(variance) / gain)
    # meta that are given go before it
    table.meta = {"simulated": True, **(meta or {})}
    return Observations.from_table(table, name=name)


def beams_of_frames(chain, frames, lamp):
    """Return the columns of the fluxes, and the frames and their lamp, one for each beam."""
    wanted = "a table is needed, such as half_wave_plate_cycles() gives"
    check_type("frames", frames, Table, wanted, ParameterError)
    if not len(frames):
        raise ParameterError("frames is a table without rows; at least one frame is needed")
    if splits(leaves(chain)):
        return ("flux_right", "flux_left"), frames, lamp
    beams = states_of(chain).get("beam")
    if not beams or "beam" in frames.colnames:
        return ("flux",), frames, lamp
    count = len(beams)
    repeated = frames[np.repeat(np.arange(len(frames)), count)]
    if "group" not in frames.colnames:
        repeated["group"] = np.repeat(np.arange(len(frames)), count)
    repeated["beam"] = np.tile(beams, len(frames))
    return ("flux",), repeated, None if lamp is None else np.repeat(lamp, count)


def expected_fluxes(chain, wavelength, frames, source=(1.0, 0.0, 0.0, 0.0)):
    """
    Return the noiseless fluxes of both beams, (n_wavelengths, n_frames) each, not negative.

    ``frames`` has the position of every stage, one row per frame; a column such as ``hwp_true``
    goes before ``hwp``. ``source`` is the Stokes vector of the light that enters.
    """
    positions = stage_positions(chain, frames)
    propagator = Propagator(chain, length_to_um(wavelength), positions, source)
    shape = (len(wavelength), len(frames))
    right, left = (np.broadcast_to(flux, shape) for flux in propagator.fluxes())
    # a beam that is extinguished may be below zero by a rounding error
    least = np.min([right, left])
    # written so that NaN is refused
    if not least >= -_ROUNDING:
        what = "flux that is not a number" if np.isnan(least) else "negative flux"
        raise ParameterError(f"the chain gives {what}: it is not physical", argument="chain")
    return right.clip(0.0), left.clip(0.0)


def stage_positions(chain, frames):
    """Return the position of each stage of a chain that frames have, canonical, (n_frames,)."""
    check_states(chain, frames.columns, "frames")
    # where the true angle of a stage is known, it is that at which it stands
    known = {stage: f"{stage}_true" for stage in stages(chain)}
    columns = {s: true if true in frames.colnames else s for s, true in known.items()}
    # a stage without a column is refused by the propagator, which knows whether it is needed
    positions = {
        stage: modulator_states(frames, "frames")
        if stage == "flc_state"
        else finite_position(frames[column], column)
        for stage, column in columns.items()
        if column in frames.colnames
    }
    return positions | {s: in_state(frames, s, "frames") for s in known if "=" in s}


def _positive(name, value, unit=u.one, zero=False):
    # a plain number is in that unit
    value = to_unit(value, unit if hasattr(value, "unit") else u.one, name)
    if not np.all(np.isfinite(value)) or np.any(value < 0) or (not zero and np.any(value == 0)):
        raise ParameterError(
            f"{name} = {value} must be finite and {'not negative' if zero else 'positive'}"
        )
    if np.any(value > _MOST_ELECTRONS):
        raise ParameterError(f"{name} = {value}: allowed is up to {_MOST_ELECTRONS:g}")
    return value


def check_electrons(electrons):
    """Refuse more electrons than can be drawn."""
    most = np.max(electrons)
    # numpy draws 64-bit integers
    if most > _MOST_ELECTRONS:
        raise ParameterError(
            f"flux and gain give {most:.3g} electrons in a frame, allowed are up to "
            f"{_MOST_ELECTRONS:g}"
        )


def entering_flux(flux, lamp, n_frames, n_wavelengths):
    """
    Return the flux that enters a chain in every frame, shape (n_frames, n_wavelengths).

    The flux is a scalar or one value per wavelength, the brightness of the lamp is relative, one
    per frame or None.
    """
    flux = _positive("flux", flux, u.adu)
    lamp = _positive("lamp", np.ones(n_frames) if lamp is None else lamp)
    if flux.shape not in ((), (n_wavelengths,)) or lamp.shape != (n_frames,):
        raise ParameterError(
            f"flux has shape {flux.shape} and lamp {lamp.shape}; allowed are a scalar or "
            f"({n_wavelengths},), and ({n_frames},)"
        )
    # (n_frames, 1) times (n_wavelengths,)
    return lamp[:, None] * np.broadcast_to(flux, (n_wavelengths,))


def _table(wavelength, frames, names, fluxes, errors):
    n_frames, n_wavelengths = fluxes.shape[1:]
    table = QTable()
    table["frame"] = np.repeat(np.arange(n_frames), n_wavelengths)
    table["bin"] = np.tile(np.arange(n_wavelengths), n_frames)
    table["wavelength"] = np.tile(wavelength, n_frames)
    for column in frames.colnames:
        if column != "frame":
            table[column] = np.repeat(frames[column], n_wavelengths)
    for name, flux, error in zip(names, fluxes, errors, strict=True):
        table[name] = flux.ravel() * u.adu
        table[f"{name}_err"] = error.ravel() * u.adu
    return table
