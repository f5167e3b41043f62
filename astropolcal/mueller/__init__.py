# Licensed under a 3-clause BSD style license - see LICENSE
"""
Mueller algebra: pure functions on arrays of shape (..., 4, 4).

Three parts: the elementary matrices and their rotation (``elements``), the
polar decomposition and the scalars drawn from a matrix (``decomposition``), and
which matrices nature allows (``physicality``).

An optic of matrix M turned by an angle is ``T(-angle) M T(angle)``; a matrix
acts on Stokes vectors (I, Q, U, V) in the sense of `astropolcal.stokes`.
"""

from astropolcal.mueller.decomposition import (
    LuChipman,
    depolarization_index,
    diattenuation,
    diattenuation_vector,
    lu_chipman,
    polarizance,
    polarizance_vector,
    retardance_vector,
)
from astropolcal.mueller.elements import (
    compose,
    depolarizer,
    diattenuator,
    diattenuator_retarder,
    elliptical_retarder,
    linear_polarizer,
    linear_retarder,
    rotate,
    rotation_matrix,
)
from astropolcal.mueller.physicality import (
    coherency_eigenvalues,
    coherency_matrix,
    is_passive,
    is_physical,
    mueller_from_coherency,
    nearest_physical,
)

__all__ = [
    "LuChipman",
    "coherency_eigenvalues",
    "coherency_matrix",
    "compose",
    "depolarization_index",
    "depolarizer",
    "diattenuation",
    "diattenuation_vector",
    "diattenuator",
    "diattenuator_retarder",
    "elliptical_retarder",
    "is_passive",
    "is_physical",
    "linear_polarizer",
    "linear_retarder",
    "lu_chipman",
    "mueller_from_coherency",
    "nearest_physical",
    "polarizance",
    "polarizance_vector",
    "retardance_vector",
    "rotate",
    "rotation_matrix",
]
