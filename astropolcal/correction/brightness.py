# Licensed under a 3-clause BSD style license - see LICENSE
"""How bright each frame was, from its own light: clouds, seeing, exposure times."""

import numpy as np

from astropolcal.correction.solve import estimator
from astropolcal.exceptions import ObservationError

__all__ = ["frame_brightness"]

# a step shrinks the error by the instrumental polarization, some percent: ten suffice mostly
_STEPS, _SETTLED = 50, 1e-13


def frame_brightness(rows, fluxes, **settings):
    r"""
    Return the relative brightness of frames from the light of both beams.

    The sum of both beams follows the light that enters, but also, by a little, its
    polarization. So brightness and Stokes parameters are found in turn until they settle.

    Parameters
    ----------
    rows : `~numpy.ndarray`
        As `measurement_rows` gives them.
    fluxes : array_like
        Of the whole image of each beam, (2, n_frames, n_wavelengths); NaN where there is none,
        which gives the brightness one.
    **settings
        Of `estimator`, without ``scale``.

    Returns
    -------
    `~numpy.ndarray`
        Shape (n_wavelengths, n_frames), for ``scale`` of `ScienceFrames`; its mean over the
        frames is one.

    Raises
    ------
    ObservationError
        If a frame has no light, or the brightness does not settle.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import optics
    >>> from astropolcal.correction import frame_brightness, measurement_rows
    >>> chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    >>> chain = chain | optics.WollastonPrism(name="wollaston")
    >>> rows = measurement_rows(chain, {"hwp": [0, 45, 22.5, 67.5] * u.deg}, [1.6] * u.um)
    >>> clouds = np.array([0.8, 1.0, 1.2, 1.0])
    >>> fluxes = np.moveaxis(rows @ [1, 0.02, 0.01, 0], 1, 2) * clouds[:, None]
    >>> frame_brightness(rows, fluxes).round(6).tolist()
    [[0.8, 1.0, 1.2, 1.0]]
    """
    fluxes = np.asarray(fluxes, dtype=float)
    # shape (n_wavelengths, n_frames), as the scale of an estimator
    totals = fluxes.sum(axis=0).T
    missing = np.isnan(totals)
    dark = ~(totals > 0) & ~missing
    if dark.any():
        wavelength, frame = np.argwhere(dark)[0]
        raise ObservationError(
            f"frame {frame} has no light at wavelength {wavelength}: the sum of both beams is "
            f"{totals[wavelength, frame]:.4g}"
        )
    if missing.any():
        weights = settings.get("weights")
        weights = 1.0 if weights is None else np.asarray(weights, dtype=float)
        settings["weights"] = np.broadcast_to(weights, (2, *totals.shape)) * ~missing
        fluxes = np.nan_to_num(fluxes)
    # at a wavelength where not even I is determined, the sums have the last word
    unknown = ~estimator(rows, **settings).determined[:, 0]
    scale = _shared(totals, missing)
    for _ in range(_STEPS):
        stokes = estimator(rows, scale=scale, **settings).apply(fluxes)
        # the light of an undetermined component is not known, and small
        expected = np.einsum("bwfs,sw->wf", rows[..., : len(stokes)], np.nan_to_num(stokes))
        expected[unknown] = 1.0
        if not np.all(expected[~missing] > 0):
            break
        new = _shared(totals / expected, missing)
        change, scale = np.abs(new - scale).max(), new
        if change < _SETTLED:
            return scale
    raise ObservationError(
        "the brightness of the frames does not settle: there is too little light, or it is not "
        "that of one source in all frames"
    )


def _shared(brightness, missing):
    """Return brightness over its mean: only ratios are measured, the mean is the source's."""
    known = np.where(missing, 0.0, brightness)
    mean = known.sum(axis=1, keepdims=True) / np.maximum((~missing).sum(axis=1, keepdims=True), 1)
    return np.where(missing | (mean == 0), 1.0, known / np.where(mean == 0, 1.0, mean))
