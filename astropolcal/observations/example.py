# Licensed under a 3-clause BSD style license - see LICENSE
"""
A small table for documentation, tests and first steps.
"""

import astropy.units as u
import numpy as np
from astropy.table import QTable

__all__ = ["example_table"]


def example_table(
    hwp=(0.0, 22.5, 45.0, 67.5), derotator=(90.0,), wavelength=(1.2, 1.6, 2.2), polarization=0.5
):
    """
    Return what an ideal dual-beam polarimeter measures of light with positive Q.

    Fluxes follow R, L = I (1 +- p cos 4 (hwp - derotator)) / 2: half-wave plate,
    derotator (half a wave as well) and Wollaston prism are all ideal.

    Parameters
    ----------
    hwp, derotator : sequence of float
        Angles in degree; there is a frame for every combination.
    wavelength : sequence of float
        Micrometre.
    polarization : float
        Degree of polarization, p.

    Returns
    -------
    `~astropy.table.QTable`
        As `~astropolcal.observations.Observations.from_table` takes it, with the
        errors of photon noise.

    Examples
    --------
    >>> from astropolcal.observations import example_table
    >>> example_table().colnames[:5]
    ['frame', 'bin', 'wavelength', 'hwp', 'derotator']
    """
    # "ij": the wavelength runs fastest, then the plate, then the derotator
    stages, plates, bins = np.meshgrid(derotator, hwp, np.arange(len(wavelength)), indexing="ij")
    frame = np.repeat(np.arange(len(hwp) * len(derotator)), len(wavelength))
    # each half-wave plate turns polarization by twice its angle, and both act in turn
    signal = polarization * np.cos(4 * np.deg2rad(plates - stages)).ravel()
    # photons, so that the errors of a few percent can be seen in a plot
    intensity = 1000.0
    right, left = intensity * (1 + signal) / 2, intensity * (1 - signal) / 2
    return QTable(
        {
            "frame": frame,
            "bin": bins.ravel(),
            "wavelength": np.asarray(wavelength, dtype=float)[bins.ravel()] * u.um,
            "hwp": plates.ravel() * u.deg,
            "derotator": stages.ravel() * u.deg,
            "flux_right": right * u.adu,
            "flux_left": left * u.adu,
            "flux_right_err": np.sqrt(right) * u.adu,
            "flux_left_err": np.sqrt(left) * u.adu,
        },
        meta={"instrument": "example polarimeter", "source": "polarized"},
    )
