# Licensed under a 3-clause BSD style license - see LICENSE
"""The wavelengths that several datasets have in common."""

import astropy.units as u
import numpy as np

__all__ = ["SAME_WAVELENGTH", "common_wavelengths"]

#: Wavelengths of two tables are the same when they agree to this share.
SAME_WAVELENGTH = 1e-5


def common_wavelengths(observations, wavelength=None):
    """
    Return the wavelength grid of several datasets, in micrometre.

    Parameters
    ----------
    observations : sequence of Observations
        The datasets.
    wavelength : `~astropy.units.Quantity`, optional
        The grid, if it is not the union of the datasets'.

    Returns
    -------
    `~numpy.ndarray`
        Ascending, shape (n_wavelengths,).

    Examples
    --------
    >>> from astropolcal.observations import Observations, common_wavelengths, example_table
    >>> night = Observations.from_table(example_table())
    >>> common_wavelengths([night, night]).tolist()
    [1.2, 1.6, 2.2]
    """
    if wavelength is not None:
        return np.atleast_1d(u.Quantity(wavelength).to_value(u.um))
    merged = np.sort(np.concatenate([obs.wavelength.to_value(u.um) for obs in observations]))
    return merged[np.diff(merged, prepend=-np.inf) > SAME_WAVELENGTH * merged]
