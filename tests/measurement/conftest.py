# Licensed under a 3-clause BSD style license - see LICENSE
"""A small instrument whose parameters all matter, and frames to look through it."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import optics
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1.2, 1.6, 2.2] * u.um


def small_chain(wavelength=WAVELENGTH, flip=False):
    """Polarizer, half-wave plate, elliptical derotator and Wollaston, 3 + 5 W parameters."""
    n = np.size(wavelength)
    chain = optics.LinearPolarizer(theta=90 * u.deg, name="polarizer", fixed={"theta": False})
    chain = chain | optics.TwoLayerWaveplate(
        w_sio2=1.65 * u.mm, w_mgf2=1.29 * u.mm, mount="hwp", name="hwp"
    )
    chain = chain | optics.EllipticalRetarder(
        horizontal=np.linspace(-230, -55, n) * u.deg,
        diagonal=np.linspace(4, 2, n) * u.deg,
        circular=np.linspace(-1, 3, n) * u.deg,
        mount="derotator",
        name="derotator",
    )
    if flip:
        chain = chain | optics.ParityFlip(name="flip")
    return chain | optics.WollastonPrism(efficiency=np.full(n, 0.97), name="wollaston")


@pytest.fixture
def chain():
    return small_chain()


@pytest.fixture
def make_chain():
    return small_chain


@pytest.fixture
def frames():
    return half_wave_plate_cycles(derotator=[45, 62, 80, 97, 118] * u.deg)


@pytest.fixture
def observations(chain, frames):
    return simulate(chain, WAVELENGTH, frames, seed=1)
