# Licensed under a 3-clause BSD style license - see LICENSE
"""What a model holds, or has at a bound or in a wrong branch, hides nothing."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import optics
from astropolcal.gap import diagnose
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1.2, 1.4, 1.6, 1.8, 2.0, 2.2] * u.um
TURN = half_wave_plate_cycles(np.arange(16) * 11.25 * u.deg, [0] * u.deg)


def plate_chain(retardance=180.0, free=False):
    """Return polarizer, plate and Wollaston prism, all held but the polarizer's angle."""
    polarizer = optics.LinearPolarizer(theta=20 * u.deg, name="polarizer")
    polarizer.theta.bounds = (10, 30)
    plate = optics.LinearRetarder(retardance=retardance * u.deg, mount="hwp", name="hwp")
    prism = optics.WollastonPrism(name="wollaston")
    for optic in (polarizer, plate, prism):
        for key in optic.param_names:
            getattr(optic, key).fixed = True
    polarizer.theta.fixed = not free
    return polarizer | plate | prism


@pytest.mark.parametrize(("true", "free"), [(176.0, False), (176.0, True), (184.0, True)])
def test_half_a_wave_hides_nothing(true, free):
    data = simulate(plate_chain(true), WAVELENGTH, TURN, flux=1e6, seed=1, name="turn")
    found = diagnose(plate_chain(free=free), data)
    (cause,) = found.causes
    assert cause.name == "hwp_retardance" or cause.cell.name == "in:hwp/retardance_h/constant"
    ((size, _, unit, _),) = found.improved.sizes(cause.name).values()
    # data do not tell which side of half a wave it is
    degrees = np.abs(size[0]) if unit == u.deg else np.rad2deg(np.abs(size[0]))
    assert degrees == pytest.approx(4.0, abs=0.3)
    assert found.remainder_p_value > 1e-3


def test_half_a_wave_that_is_one_is_no_cause():
    data = simulate(plate_chain(), WAVELENGTH, TURN, flux=1e6, seed=2, name="turn")
    assert diagnose(plate_chain(free=True), data).causes == []
