# Licensed under a 3-clause BSD style license - see LICENSE
r"""
What each frame measures of the light that enters: the rows of the measurement matrix.

The flux of a beam is :math:`d = \mathbf a \cdot \mathbf S`, where :math:`\mathbf a` is the
first row of the system Mueller matrix of that beam, frame and wavelength.
"""

import warnings

import astropy.units as u
import numpy as np

from astropolcal.calibration.identifiability.sky import chain_from_sky, known_instrument
from astropolcal.calibration.system import Rows
from astropolcal.chain import join, leaves, stages
from astropolcal.exceptions import (
    AstropolcalWarning,
    ChainError,
    WavelengthRangeError,
)
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.observations import SAME_WAVELENGTH
from astropolcal.optics import COORDINATES
from astropolcal.optics.core import finite_position
from astropolcal.pipeline.headers import inner_optics, telescope_optics
from astropolcal.units import length_to_um

__all__ = ["RowModel", "check_optics", "measurement_rows", "sky_chain"]


def sky_chain(
    calibration, dataset=None, *, optics_in=None, beam=None, label="the calibration", date=None
):
    """
    Return the optics from the sky to the detector, with calibrated values.

    The chain of a star that was calibrated, without the star itself; if there is none, the
    instrument's chain from the sky, with the calibrated values of the optics inside. A chain
    of an instrument without a telescope begins with the first optic on a stage.

    Parameters
    ----------
    calibration : Calibration or `~astropy.modeling.CompoundModel`
        The calibration, or a chain.
    dataset : int, optional
        Which of the calibration's chains; by default the one of the optics in the beam.
    optics_in : sequence of str, optional
        All optional optics in the beam; needed if the calibration has several sets of them.
    beam : dict of str to bool, optional
        Single ones that are known to be in the beam or not, as
        `~astropolcal.instruments.Instrument.optics_of` tells them.
    label : str
        What messages call the calibration.
    date : str, `~astropy.time.Time` or sequence of them, optional
        Of the frames, for an instrument whose telescope changed.

    Returns
    -------
    `~astropy.modeling.CompoundModel`

    Raises
    ------
    ChainError
        If no optic stands on a stage, or the calibration has no chain of the optics in the
        beam, or several.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.correction.rows import sky_chain
    >>> charis = instruments.get("charis")
    >>> [optic.name for optic in sky_chain(charis.on_sky(charis.published()))][:4]
    ['parallactic', 'm3', 'altitude', 'hwp']
    """
    chains = getattr(calibration, "chains", [calibration])
    if dataset is not None:
        chains = [chains[dataset]]
    elif hasattr(calibration, "datasets"):
        inner = inner_optics(calibration, optics_in, beam, label)
        chains = [join([*(telescope_optics(calibration) or ()), *inner])]
    instrument = known_instrument(getattr(calibration, "instrument", None))
    wavelength = getattr(calibration, "wavelength", None)
    return chain_from_sky(chains, instrument, wavelength, date)[0]


def check_optics(chain, optics_in):
    """
    Raise if an optic that is in the beam is absent from the chain.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        The chain.
    optics_in : sequence of str
        Names of optics that were in the beam.

    Raises
    ------
    ChainError
        Naming the optic.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.correction.rows import check_optics
    >>> check_optics(instruments.get("charis").published(), ["dichroic", "nbs"])
    """
    known = [leaf.name for leaf in leaves(chain)]
    absent = [name for name in optics_in if name not in known]
    if absent:
        raise ChainError(
            f"{', '.join(absent)} was in the beam, but is not in the calibrated chain "
            f"({', '.join(filter(None, known))})"
        )


class RowModel(Rows):
    """
    Measurement rows of a calibration at given positions and wavelengths, and how they move.

    Parameters
    ----------
    calibration : Calibration or `~astropy.modeling.CompoundModel`
        The calibration, or a chain with known values, which has no errors.
    positions : dict of str to `~astropy.units.Quantity` or `~numpy.ndarray`
        Position of every stage in each frame, shape (n_frames,), or (nodes, n_frames) at the
        Gauss-Legendre nodes of the exposures. Angles without a unit are in radian.
    wavelength : `~astropy.units.Quantity`
        Of the science data.
    chain : `~astropy.modeling.CompoundModel`, optional
        From the sky to the detector, with optics named as the calibrated ones; by default
        that of `sky_chain`.
    interpolate : bool
        Whether parameters known at the calibrated wavelengths only are interpolated linearly
        between them. Else each wavelength must be one of the calibrated.

    Raises
    ------
    WavelengthRangeError
        If a wavelength is not one at which the calibration is known.
    ChainError
        If the position of a stage is missing, or the frames of the stages differ in number.

    Warns
    -----
    AstropolcalWarning
        If parameters are interpolated; it names them.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.correction import RowModel
    >>> charis = instruments.get("charis")
    >>> positions = {"hwp": [0, 22.5, 45, 67.5] * u.deg, "derotator": [60] * 4 * u.deg,
    ...              "parallactic": [10] * 4 * u.deg, "altitude": [70] * 4 * u.deg}
    >>> RowModel(charis.on_sky(charis.published()), positions, charis.wavelength).rows().shape
    (2, 22, 4, 4)
    """

    def __init__(self, calibration, positions, wavelength, *, chain=None, interpolate=False):
        chain = sky_chain(calibration) if chain is None else chain
        self.wavelength = np.atleast_1d(u.Quantity(wavelength))
        self.calibration = calibration if hasattr(calibration, "covariance") else None
        lam, free = length_to_um(self.wavelength), None
        if self.calibration is not None:
            grid = len(calibration.wavelength)
            free = FreeParameters(calibration.chains, grid, calibration.ties)
        mix = self._mixing(chain, lam, interpolate)
        placed, nodes = _placed(positions, stages(chain))
        super().__init__(chain, lam, placed, free, mix, nodes)
        self.n_frames = self._shape[1]

    def _mixing(self, chain, lam, interpolate):
        """Return weights of the calibrated wavelengths, (n_wavelengths, n_grid), or None."""
        names = [
            f"{leaf.name}.{key}"
            for leaf in leaves(chain)
            for key, value in zip(leaf.param_names, leaf.canonical_values(), strict=True)
            if value.size > 1
        ]
        if not names or self.calibration is None:
            return None
        grid = np.atleast_1d(self.calibration.wavelength.to_value(u.um))
        nearest = np.abs(lam[:, None] - grid).argmin(axis=1)
        off = np.abs(lam / grid[nearest] - 1) > SAME_WAVELENGTH
        if not off.any():
            return np.eye(len(grid))[nearest]
        if not interpolate:
            raise WavelengthRangeError(_not_calibrated(self.wavelength, off, grid, names))
        return _between(lam, self.wavelength, grid, names)

    @property
    def start(self):
        """Values of the calibration's free parameters, canonical; shape (n_free,)."""
        return self.free.start()

    @property
    def held(self):
        """Names of parameters of optics in the chain that have no error: they were not free."""
        return [name for name in self._names() if self._slot(name) is None]


def measurement_rows(calibration, positions, wavelength, *, chain=None, interpolate=False):
    """
    Return what each beam, wavelength and frame measures of the light that enters.

    Parameters
    ----------
    calibration, positions, wavelength, chain, interpolate
        As for `RowModel`, which also has the derivatives.

    Returns
    -------
    `~numpy.ndarray`
        Shape (2, n_wavelengths, n_frames, 4), the right beam first.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import optics
    >>> from astropolcal.correction import measurement_rows
    >>> chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    >>> chain = chain | optics.WollastonPrism(name="wollaston")
    >>> rows = measurement_rows(chain, {"hwp": [0, 22.5] * u.deg}, [1.6] * u.um)
    >>> (rows[0, 0] - rows[1, 0]).round(12).tolist()
    [[0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]
    """
    model = RowModel(calibration, positions, wavelength, chain=chain, interpolate=interpolate)
    return model.rows()


def _not_calibrated(wavelength, off, grid, names):
    return (
        f"wavelength = {wavelength[off][0]:.7g} is none of the {len(grid)} calibrated from "
        f"{grid.min():.6g} to {grid.max():.6g} um, and {names[0]} is known at these only; "
        "interpolate=True interpolates it linearly"
    )


def _between(lam, wavelength, grid, names):
    """Return the weights of linear interpolation, and say that there is one."""
    order = np.argsort(grid)
    beyond = (lam < grid.min() * (1 - SAME_WAVELENGTH)) | (lam > grid.max() * (1 + SAME_WAVELENGTH))
    if beyond.any():
        raise WavelengthRangeError(
            f"wavelength = {wavelength[beyond][0]:.7g} is outside the calibrated range of "
            f"{names[0]}, {grid.min():.6g} to {grid.max():.6g} um"
        )
    warnings.warn(
        f"interpolated linearly between the {len(grid)} calibrated wavelengths: {', '.join(names)}",
        AstropolcalWarning,
        stacklevel=4,
    )
    units = np.eye(len(grid))[order]
    return np.stack([np.interp(lam, grid[order], column) for column in units.T], axis=1)


def _placed(positions, wanted):
    """Return the positions of all columns in canonical floats, and the weights of the nodes."""
    placed = {}
    for name in wanted:
        if name not in positions:
            raise ChainError(
                f"no position of {name!r}, which the chain needs; there is "
                f"{', '.join(sorted(positions)) or 'none'}"
            )
        value = positions[name]
        if not isinstance(value, u.Quantity) and name not in COORDINATES:
            value = np.asarray(value, dtype=float) * u.rad
        placed[name] = np.atleast_1d(finite_position(value, name))
    nodes = {name: len(v) for name, v in placed.items() if v.ndim == 2}
    if not nodes:
        return placed, np.ones(1)
    if len(set(nodes.values())) > 1:
        raise ChainError(f"the stages have different numbers of nodes: {nodes}")
    _, weights = np.polynomial.legendre.leggauss(next(iter(nodes.values())))
    spread = {n: v.ravel() if v.ndim == 2 else np.tile(v, len(weights)) for n, v in placed.items()}
    # the weights of Gauss and Legendre add up to the length of [-1, 1], a mean needs one
    return spread, weights / 2
