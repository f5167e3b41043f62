# Licensed under a 3-clause BSD style license - see LICENSE
"""
Stokes algebra: degrees and angle of polarization, their errors and their bias.

A Stokes vector is (I, Q, U, V) with Q = vertical - horizontal,
U = (+45) - (-45) and V = right - left, so that the angle of linear
polarization runs counter-clockwise from vertical when looking into the beam.
Lower-case q, u are Q / I and U / I.

Bad input (a NaN, an intensity that is not positive, a negative error) raises
`~astropolcal.exceptions.ParameterError`; it never comes back as a number.
"""

from astropolcal.stokes.bias import aolp_interval, debias_dolp
from astropolcal.stokes.errors import aolp_error, dolp_error, transverse_error
from astropolcal.stokes.vectors import (
    angle_of_linear_polarization,
    degree_of_linear_polarization,
    degree_of_polarization,
    is_physical_stokes,
    polarization_angle,
    stokes_from_dolp_aolp,
)

__all__ = [
    "angle_of_linear_polarization",
    "aolp_error",
    "aolp_interval",
    "debias_dolp",
    "degree_of_linear_polarization",
    "degree_of_polarization",
    "dolp_error",
    "is_physical_stokes",
    "polarization_angle",
    "stokes_from_dolp_aolp",
    "transverse_error",
]
