# Licensed under a 3-clause BSD style license - see LICENSE
"""
Stokes vectors of many frames and wavelengths through Mueller matrices.

Light has shape (n_wavelengths, n_columns, 4); an axis has length 1 as long as nothing has
depended on it. Q and U of a column lie side by side, so that they are also the complex
number Q + iU, which a rotation of the frame by an angle multiplies by exp(-2i angle), its
phase; None is a phase of 1. A matrix has shape (n_wavelengths, 4, 4), or (n_wavelengths,
n_columns, 4, 4) where it changes from frame to frame.
"""

import cmath

import numpy as np

__all__ = ["act", "act_back", "inverse", "phase_of", "plane", "turned"]


def phase_of(stage, theta):
    """Return what Q + iU is multiplied by at the entrance of an optic, or None for 1."""
    if np.ndim(theta):
        # one value a wavelength goes along the first axis, positions along the second
        turn = np.exp(-2j * theta)[:, None]
    elif theta:
        turn = cmath.exp(-2j * theta)
    else:
        return stage
    return turn if stage is None else stage * turn


def inverse(phase):
    """Return the phase of the way back."""
    return None if phase is None else phase.conjugate()


def turned(light, phase, in_place=False):
    """Return T(angle) applied to the light, for the phase exp(-2i angle)."""
    if phase is None:
        return light
    rows, columns, _ = light.shape
    dimensions = np.ndim(phase)
    if dimensions:
        # the shape of the product, without asking numpy for it
        columns = max(columns, phase.shape[-1])
        rows = max(rows, phase.shape[0]) if dimensions == 2 else rows
    if not in_place or (rows, columns) != light.shape[:2]:
        out = np.empty((rows, columns, 4))
        out[:] = light
        light = out
    both = plane(light)
    np.multiply(both, phase, out=both)
    return light


def plane(light):
    """Return Q + iU as a view."""
    return light[..., 1:3].view(complex)[..., 0]


def act(matrix, light):
    """Return matrix times light."""
    if matrix.ndim == 4:
        return np.einsum("wcij,wcj->wci", matrix, light)
    return light @ np.ascontiguousarray(matrix.swapaxes(1, 2))


def act_back(matrix, adjoint):
    """Return the adjoint times matrix."""
    if matrix.ndim == 4:
        return np.einsum("wci,wcij->wcj", adjoint, matrix)
    return adjoint @ matrix
