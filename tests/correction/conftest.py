# Licensed under a 3-clause BSD style license - see LICENSE
"""A disk and a star seen through the real chain of CHARIS."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest

from astropolcal import calibrate, instruments
from astropolcal.correction import measurement_rows
from astropolcal.correction.rows import sky_chain
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")


@pytest.fixture(scope="session")
def charis():
    return CHARIS


@pytest.fixture(scope="session")
def sky(charis):
    return charis.on_sky(charis.published())


@pytest.fixture(scope="session")
def calibration(charis):
    """A calibration without open directions."""
    frames = half_wave_plate_cycles(derotator=[45, 52, 60, 68, 75, 82, 90] * u.deg)
    chain = charis.chain(derotator="linear")
    data = simulate(chain, charis.wavelength, frames, flux=1e6, seed=2)
    return calibrate(chain, data, instrument="charis")


@pytest.fixture(scope="session")
def open_calibration(charis):
    frames = half_wave_plate_cycles(derotator=[45, 60, 75, 90] * u.deg)
    data = simulate(charis.published(), charis.wavelength, frames, seed=2)
    return calibrate(charis.published(), data, instrument="charis")


def tracked_positions(cycles=4):
    """Positions of a star that moves over the sky while the field stands still."""
    n = 4 * cycles
    hwp = np.tile([0, 45, 22.5, 67.5], cycles) * u.deg
    parallactic, altitude = np.linspace(-30, 40, n) * u.deg, np.linspace(60, 75, n) * u.deg
    positions = {
        "hwp": hwp + 0.5 * parallactic + altitude,
        "derotator": np.linspace(55, 80, n) * u.deg,
        "parallactic": parallactic,
        "altitude": altitude,
    }
    return hwp, positions


@pytest.fixture(scope="session")
def track():
    return tracked_positions


def disk(n_wavelengths, size=21):
    """Stokes parameters of a disk about a star, (3, n_wavelengths, size, size), north up."""
    rows, columns = np.indices((size, size)) - (size - 1) / 2
    radius, angle = np.hypot(rows, columns), np.arctan2(-columns, rows)
    ring = np.exp(-0.5 * ((radius - size / 3.5) / 1.6) ** 2)
    star = 50 * np.exp(-0.5 * (radius / 2.0) ** 2)
    colour = np.linspace(1.0, 2.0, n_wavelengths)[:, None, None]
    # brighter in the north-east
    ring = ring * (1 + 0.5 * np.cos(angle - 0.8))
    light = (20 + star + 10 * ring) * colour
    polarized = 4 * ring * colour
    return np.stack([light, -polarized * np.cos(2 * angle), -polarized * np.sin(2 * angle)])


@pytest.fixture(scope="session")
def scene():
    return disk


@pytest.fixture(scope="session")
def seen():
    """Function that gives what the beams see: (2, n_frames, n_wavelengths, ...)."""

    def look(calibration, positions, wavelength, stokes):
        rows = measurement_rows(calibration, positions, wavelength)[..., : len(stokes)]
        return np.einsum("bwfs,sw...->bfw...", rows, stokes)

    return look


@pytest.fixture(scope="session")
def star(sky, charis, track, seen):
    """A star with a little polarization, its fluxes and positions."""
    hwp, positions = track()
    stokes = np.array([1e5, 1.3e3, -0.7e3])[:, None] * np.linspace(1, 2, 22)
    right, left = seen(sky, positions, charis.wavelength, stokes)
    return SimpleNamespace(
        stokes=stokes, hwp=hwp, positions=positions, right=right, left=left, chain=sky_chain(sky)
    )
