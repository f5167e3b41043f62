# Licensed under a 3-clause BSD style license - see LICENSE
r"""
What each frame measures of the light that enters: the rows of the measurement matrix.

The flux of a beam is :math:`d = \mathbf a \cdot \mathbf S`, where :math:`\mathbf a` is the
first row of the system Mueller matrix of that beam, frame and wavelength.
"""

from functools import partial

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.calibration.identifiability.sky import chain_from_sky, known_instrument
from astropolcal.calibration.system import Rows, free_of, match_wavelengths
from astropolcal.chain import check_states, join, leaves, stages, warn_beyond
from astropolcal.exceptions import ChainError, ParameterError, warn
from astropolcal.observations.pointings import in_state
from astropolcal.optics import COORDINATES
from astropolcal.optics.positions import finite_position
from astropolcal.pipeline.headers import inner_optics, telescope_optics
from astropolcal.units import length_to_um, to_unit, wavelengths_of

__all__ = ["ideal_chain", "measurement_rows"]

# four turns: a plate that follows the sky reaches three, degrees mostly are beyond
_MOST_RADIAN = 8 * np.pi


def sky_chain(calibration, *, optics_in=None, beam=None, label="the calibration", date=None):
    """Return the optics from the sky to the detector, with calibrated values.

    The chain of a star that was calibrated, without the star; if there is none, the instrument's
    chain from the sky with the calibrated optics inside. Without a telescope it begins with the
    first optic on a stage. Of several chains it is that of the optics in the beam: ``optics_in``
    (all of them), ``beam`` (single ones, see `Instrument.optics_of`). ``date`` is that of the
    frames, for a telescope that changed.
    """
    if not hasattr(calibration, "datasets"):
        return chain_from_sky([calibration])[0]
    inner = inner_optics(calibration, optics_in, beam, label)
    chain = join([*telescope_optics(calibration, label), *inner])
    instrument = known_instrument(calibration.instrument)
    return chain_from_sky([chain], instrument, calibration.wavelength, date)[0]


class RowModel(Rows):
    """Measurement rows of a calibration, or a chain, at given positions, and how they move.

    Positions are (n_frames,), or (nodes, n_frames) at the Gauss-Legendre nodes of the exposures;
    without a unit in radian. Parameters known at the calibrated wavelengths only are interpolated
    linearly between them, with a warning, if ``interpolate``; else a wavelength off them is
    refused.
    """

    def __init__(self, calibration, positions, wavelength, *, chain=None, interpolate=False):
        chain = sky_chain(calibration) if chain is None else chain
        self.wavelength = np.atleast_1d(wavelengths_of(wavelength))
        self.calibration = calibration if hasattr(calibration, "covariance") else None
        names = [
            f"{leaf.name}.{key}"
            for leaf in leaves(chain)
            for key, value in zip(leaf.param_names, leaf.canonical_values(), strict=True)
            if value.size > 1
        ]
        free = mix = None
        if self.calibration is not None:
            free = free_of(calibration)
            grid = calibration.wavelength
            _, mix = match_wavelengths(grid, chain, self.wavelength, interpolate)
            if names and not np.isin(mix, (0.0, 1.0)).all():
                warn(
                    f"interpolated linearly between the {grid.size} calibrated wavelengths: "
                    f"{', '.join(names)}",
                    stacklevel=3,
                )
        check_states(chain, positions, "positions")
        placed, nodes = _placed(positions, stages(chain))
        warn_beyond(chain, placed)
        super().__init__(chain, length_to_um(self.wavelength), placed, free, mix, nodes)

    @property
    def held(self):
        """Names of parameters of optics in the chain that have no error: they were not free."""
        return [name for name in self._named.values() if self._slot(name) is None]


def measurement_rows(calibration, positions, wavelength, *, chain=None, interpolate=False):
    """
    Return what each beam, wavelength and frame measures of the light that enters.

    Parameters
    ----------
    calibration : Calibration or `~astropy.modeling.CompoundModel`
        The calibration, or a chain with known values.
    positions : dict of str to `~astropy.units.Quantity` or `~numpy.ndarray`
        Position of every stage in each frame, shape (n_frames,), or (nodes, n_frames) at the
        Gauss-Legendre nodes of the exposures. Angles without a unit are in radian.
    wavelength : `~astropy.units.Quantity`
        Of the science data.
    chain : `~astropy.modeling.CompoundModel`, optional
        From the sky to the detector, with optics named as the calibrated ones.
    interpolate : bool
        Whether parameters known at the calibrated wavelengths only are interpolated linearly
        between them. Else each wavelength must be one of the calibrated.

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
    return RowModel(calibration, positions, wavelength, chain=chain, interpolate=interpolate).rows()


def _placed(positions, wanted):
    """Return the positions of all columns in canonical floats, and the weights of the nodes."""
    placed = {}
    for name in wanted:
        column, _, state = name.partition("=")
        if name not in positions and state and column in positions:
            placed[name] = in_state(positions, name, "positions")
            continue
        if name not in positions:
            raise ChainError(
                f"no position of {name!r}, which the chain needs; there is "
                f"{', '.join(sorted(positions)) or 'none'}"
            )
        value = positions[name]
        if not isinstance(value, u.Quantity) and name not in COORDINATES:
            value = to_unit(value, None, name)
            if np.any(np.abs(value) > _MOST_RADIAN):
                raise ParameterError(
                    f"{name} = {np.abs(value).max():g} without a unit would be in radian; allowed "
                    f"are {_MOST_RADIAN:.3g} at most, and angles with their unit, such as deg"
                )
            value = value * u.rad
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


# ---- the instrument without errors ---------------------------------------------------------------
# With it a correction can be restricted to the instrumental polarization, as was done before there
# were models of the crosstalk.

_IDENTITY, _HALF_WAVE = np.eye(4), np.diag([1.0, 1.0, -1.0, -1.0])
# a half-wave plate at 45 deg: Q and V change sign
_FLIP = np.diag([1.0, -1.0, 1.0, -1.0])


def ideal_chain(chain, wavelength):
    """
    Return a chain of perfect optics at the places and angles of those of a chain.

    What turns with a stage is a half-wave plate (a derotator of an odd number of mirrors
    included), a splitter is perfect, and what is static is what it comes closest to: a
    mirror, a flip of the image, or nothing. Rotations stay.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        From the sky to the detector.
    wavelength : `~astropy.units.Quantity`
        Where fixed optics are looked at.

    Returns
    -------
    `~astropy.modeling.CompoundModel`

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.correction import ideal_chain
    >>> charis = instruments.get("charis")
    >>> ideal = ideal_chain(charis.on_sky(charis.published()), charis.wavelength)
    >>> float(ideal["wollaston"].efficiency.value), ideal["hwp"].retardance.quantity
    (1.0, <Quantity 180. deg>)
    """
    lam = np.atleast_1d(wavelengths_of(wavelength))
    found = (_ideal(leaf, lam) for leaf in leaves(chain))
    return join(leaf for leaf in found if leaf is not None)


def _ideal(leaf, wavelength):
    plate = partial(optics.LinearRetarder, retardance=180 * u.deg, name=leaf.name)
    theta = leaf.theta.quantity
    if leaf.rotates_frame:
        return leaf
    if leaf.splits_light:
        return optics.WollastonPrism(name=leaf.name, mount=leaf.mount, theta=theta)
    # drifts, stray light and gains of the beams are faults
    if leaf.stage in COORDINATES or leaf.depends_on_beam:
        return None
    if leaf.stage:
        return plate(mount=leaf.mount, theta=theta)
    # its matrices in its own axes, without its losses
    own = leaf.canonical_values()[1 : len(type(leaf).param_names)]
    matrix = np.reshape(leaf._matrix(leaf._dispersion(wavelength.to_value(u.um)), *own), (-1, 4, 4))
    # the mean over wavelengths: which of the three is nearest must not change along a spectrum
    matrix = np.mean(matrix / matrix[:, :1, :1], axis=0)
    nearest = min((_IDENTITY, _HALF_WAVE, _FLIP), key=lambda m: np.abs(m - matrix).max())
    if nearest is _IDENTITY:
        return None
    return plate(mount=None, theta=theta + (0 if nearest is _HALF_WAVE else 45) * u.deg)
