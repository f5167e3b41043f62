# Licensed under a 3-clause BSD style license - see LICENSE
r"""
What the errors of a calibration do to corrected Stokes parameters.

A change of the parameters changes the solution by :math:`\delta\hat{\mathbf S} = -G\,\delta A\,
\mathbf S`, a 4 x 4 matrix times the Stokes vector, the same for all pixels. So the errors
of all pixels and wavelengths, and their correlations, are a few small matrices. What the model
of the instrument lacks (``model_error`` in the ``fit`` of a calibration) is a few more of them.
"""

from dataclasses import dataclass, field
from numbers import Integral, Real

import astropy.units as u
import numpy as np

from astropolcal.calibration.identifiability.linearized import led
from astropolcal.calibration.system import model_error
from astropolcal.calibration.uncertainty.covariance import full_covariance
from astropolcal.correction.solve import estimator
from astropolcal.exceptions import ParameterError, warn
from astropolcal.units import check_seed

__all__ = ["Systematic"]


@dataclass
class Systematic:
    """
    Change of the Stokes parameters for one sigma along each independent direction.

    Attributes
    ----------
    factor : `~numpy.ndarray`
        Shape (n_directions, n_wavelengths, n_components, n_components): the last axis is the
        true Stokes vector, the one before what is found.
    open : `~numpy.ndarray` of bool
        Where the calibration does not determine how they change, (n_wavelengths, n_components,
        n_components).
    method : str
        ``"linear"`` or ``"sampled"``.
    held : list of str
        Parameters that were not free in the calibration, so that no error of them counts.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.correction import Systematic
    >>> one = Systematic(np.diag([0, 1e-3, 1e-3])[None, None], np.zeros((1, 3, 3), bool), "linear")
    >>> np.sqrt(np.diag(one.covariance([1, 0.1, 0.02], 0))).tolist()
    [0.0, 0.0001, 2e-05]
    """

    factor: np.ndarray
    open: np.ndarray
    method: str
    held: list = field(default_factory=list)

    def covariance(self, stokes, wavelength):
        """
        Return the covariance of Stokes parameters at one wavelength.

        Parameters
        ----------
        stokes : array_like
            Shape (n_components, ...).
        wavelength : int
            Index.

        Returns
        -------
        `~numpy.ndarray`
            Shape (n_components, n_components, ...); infinite on the diagonal for what is open,
            NaN beside it.
        """
        stokes = np.nan_to_num(np.asarray(stokes, dtype=float))
        flat = stokes.reshape(len(stokes), -1)
        factor = self.factor[:, wavelength]
        # cov(S_a, S_b) = sum over directions r of (F_ac S_c)(F_bd S_d): small, and the same for all
        # pixels, which only need the products S_c S_d
        tensor = np.einsum("rac,rbd->abcd", factor, factor)
        products = flat[:, None] * flat[None, :]
        covariance = np.einsum("abcd,cdp->abp", tensor, products, optimize=True)
        # what is open does not matter where there is no such light
        is_open = np.einsum("ac,cp->ap", self.open[wavelength].astype(float), np.abs(flat)) > 0
        if is_open.any():
            covariance[is_open[:, None] | is_open[None, :]] = np.nan
            diagonal = np.arange(len(flat))
            covariance[diagonal, diagonal] = np.where(
                is_open, np.inf, covariance[diagonal, diagonal]
            )
        return covariance.reshape(len(flat), len(flat), *stokes.shape[1:])

    def between(self, stokes):
        """
        Return the covariance of a spectrum between its wavelengths.

        Parameters
        ----------
        stokes : array_like
            Shape (n_components, n_wavelengths).

        Returns
        -------
        `~numpy.ndarray`
            Shape (n_components, n_wavelengths, n_components, n_wavelengths), of what is not open.
        """
        # r: directions, w and v: wavelengths, a and b: components
        moved = np.einsum("rwac,cw->raw", self.factor, np.nan_to_num(stokes))
        return np.einsum("raw,rbv->awbv", moved, moved)

    @property
    def is_open(self):
        """Whether something is not determined at some wavelength."""
        return bool(self.open.any())


def check_choices(open_directions, n_samples, seed):
    """Refuse a wrong choice of how systematic errors are found."""
    number = isinstance(open_directions, Real) and 0 <= open_directions < np.inf
    if not number and open_directions not in ("infinite", "ignore"):
        raise ParameterError(
            f"open_directions = {open_directions!r}; allowed are infinite, ignore, and numbers "
            "from zero"
        )
    if n_samples and not (isinstance(n_samples, Integral) and n_samples >= 2):
        raise ParameterError(f"n_samples = {n_samples!r}; allowed are whole numbers from 2, and 0")
    check_seed(seed)


def linear_systematic(model, solution, *, mode="stokes", open_directions="infinite"):
    """Return the systematic errors by the exact derivatives of the rows.

    For ``open_directions`` see `correct`.
    """
    light = _light(mode, len(solution.components))
    known, along, is_open = _moved(model, solution, light, open_directions)
    return _with_model_error(known, along, is_open, "linear", model, light)


def sampled_systematic(
    model, solution, *, n_samples, seed=None, mode="stokes", open_directions="infinite"
):
    """Return the systematic errors by solving again for samples of the parameters.

    The samples are those of the calibration's posterior, if it holds all free parameters, else
    drawn from its covariance. These stay where they are along directions that the calibration does
    not determine, whose errors are those of `linear_systematic`. There is a warning if a posterior
    is narrower than the scatter of the residuals allows.
    """
    rng = np.random.default_rng(seed)
    n = len(solution.components)
    found = np.empty((n_samples, len(solution.gain), n, n))
    for i, vector in enumerate(_draws(model, n_samples, rng)):
        rows = model.rows(vector) * solution.scale[..., None]
        if mode == "ip":
            rows = np.concatenate([rows[..., :1], solution.rows[..., 1:]], axis=-1)
        gain = estimator(rows, **solution.settings).gain
        found[i] = np.einsum("wkbf,bwfs->wks", np.nan_to_num(gain), solution.rows[..., :n])
    # so that the sum over samples of the products is the unbiased covariance
    factor = (found - found.mean(axis=0)) / np.sqrt(n_samples - 1)
    light = _light(mode, n)
    _, along, is_open = _moved(model, solution, light, open_directions)
    if _has_samples(model):
        # the samples have walked along all directions
        along, is_open = along[:0], np.zeros_like(is_open)
        if narrow := model.calibration.posterior.scatter:
            warn(f"systematic errors are too small: {narrow}", stacklevel=4)
    return _with_model_error(factor, along, is_open, "sampled", model, light)


def _moved(model, solution, light, open_directions):
    """Return changes for one sigma along each known and open direction, and what is open."""
    n = len(light)
    gain = np.nan_to_num(solution.gain)
    shape = (len(gain), n, n)
    changes = model.changes(gain, n, solution.scale[..., None]) * light[:, None]
    flat = changes.reshape(-1, model.free.size)
    covariance = full_covariance(model.calibration)
    spread = covariance._spread(flat)
    # open: along a direction that no datum fixes; blind: of a parameter without any error
    is_open = (spread.is_open | spread.is_blind).reshape(shape)
    along = np.zeros((0, *shape))
    if open_directions != "infinite":
        is_open = np.zeros_like(is_open)
    if not isinstance(open_directions, str):
        axes = covariance._axes()
        # rows in which the leading parameter moves by one step: degree, micrometre, percent
        steps = np.array([row for row, _ in led(model.free, axes.open)])
        steps = steps.reshape(-1, flat.shape[1])
        along = (float(open_directions) * steps @ (flat * axes.steps).T).reshape(-1, *shape)
    return spread.moved.T.reshape(-1, *shape), along, is_open


def _light(mode, n):
    """Return which of the true Stokes parameters count, (n,): of offsets only the intensity."""
    return (np.arange(n) < (1 if mode == "ip" else n)).astype(float)


def _with_model_error(known, along, is_open, method, model, light):
    lacking = model_error(model.calibration.fit, model.wavelength.to_value(u.um), len(light))
    factor = np.concatenate([np.where(is_open, 0.0, known), along, lacking * light])
    return Systematic(factor, is_open, method, model.held)


def _has_samples(model):
    """Return whether the calibration has samples of all its free parameters."""
    posterior = model.calibration.posterior
    return posterior is not None and set(model.free.names) <= set(posterior.names)


def _draws(model, count, rng):
    """Yield values of all free parameters in canonical units."""
    start, factors = model.free.start(), model.free.factors()
    if _has_samples(model):
        posterior = model.calibration.posterior
        samples = posterior.samples()
        columns = [posterior.index(name) for name in model.free.names]
        for row in samples[rng.integers(len(samples), size=count)]:
            yield row[columns] * factors
        return
    axes = full_covariance(model.calibration)._axes()
    # one row a direction of the covariance, one sigma long, in declared units
    known = axes.known * axes.sigmas[:, None] * axes.steps
    for _ in range(count):
        yield start + rng.standard_normal(len(known)) @ known * factors
