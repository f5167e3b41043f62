# Licensed under a 3-clause BSD style license - see LICENSE
"""Modulation matrices, optimal demodulation and efficiencies of sequences of frames."""

from functools import partial

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal import optics
from astropolcal.efficiency import best_modulation, demodulation
from astropolcal.exceptions import ChainError, ParameterError

LAM = [0.5, 0.6, 0.7] * u.um
STATES = {"A": (315, 305.264), "B": (315, 54.736), "C": (225, 125.264), "D": (225, 234.736)}


def crystal():
    chain = optics.LinearPolarizer(name="analyser")
    for state, (first, second) in reversed(STATES.items()):
        for name, value, theta in (("lc2", second, 45), ("lc1", first, 0)):
            plate = optics.StateRetarder(
                retardance=value * u.deg,
                theta=theta * u.deg,
                mount=f"lcvr={state}",
                name=f"{name}_{state}",
            )
            chain = plate | chain
    return chain


def plate(retardance, *behind):
    optic = optics.LinearRetarder(retardance=retardance * u.deg, mount="plate", name="plate")
    return optic | (behind[0] if behind else optics.LinearPolarizer(name="analyser"))


def test_efficiencies_are_the_published_ones():
    # IMaX: Martinez Pillet et al. 2011, Sol. Phys. 268, 57; all are one over root three
    found = demodulation(crystal(), LAM, QTable({"lcvr": list("ABCD")}))
    np.testing.assert_allclose(found.efficiency, [[1, *[3**-0.5] * 3]] * 3, atol=1e-5)
    # a half-wave plate at four angles shares the light between Q and U
    frames = QTable({"plate": [0, 22.5, 45, 67.5] * u.deg})
    for chain in (plate(180), plate(180, optics.WollastonPrism())):
        found = demodulation(chain, LAM, frames, components="IQU")
        np.testing.assert_allclose(found.efficiency, [[1, 0.5**0.5, 0.5**0.5]] * 3, atol=1e-12)
    # three polarizers 60 deg apart do the same
    three = QTable({"polarizer": [0, 60, 120] * u.deg})
    found = demodulation(optics.LinearPolarizer(mount="polarizer"), LAM, three, components="IQU")
    np.testing.assert_allclose(found.efficiency, [[1, 0.5**0.5, 0.5**0.5]] * 3, atol=1e-12)


def test_demodulation_gives_back_the_light_with_the_noise_of_the_efficiencies():
    frames = QTable({"plate": [3, 31, 74, 120, 155] * u.deg})
    found = demodulation(plate(130), LAM, frames)
    light = np.array([2.0, 0.3, -0.2, 0.1])
    fluxes = found.modulation @ light
    np.testing.assert_allclose(found.stokes(fluxes), [light] * 3, atol=1e-12)
    # del Toro Iniesta & Collados 2000, Eq. 28, for rows of unit intensity
    matrix = found.matrix * found.modulation[:, :, 0].mean(axis=1)[:, None, None]
    np.testing.assert_allclose(found.efficiency, (5 * np.sum(matrix**2, axis=2)) ** -0.5)
    weights = [1, 1, 1, 1, 100]
    noisy = demodulation(plate(130), LAM, frames, variance=weights)
    spread = [np.sum(d.matrix**2 * weights, axis=2) for d in (noisy, found)]
    assert np.all(spread[0] < spread[1])


def test_what_is_not_modulated_is_named():
    four = QTable({"plate": [0, 22.5, 45, 67.5] * u.deg})
    with pytest.raises(ParameterError, match=r"efficiency of V is 0 at 0.5 um; 0.001 is needed"):
        demodulation(plate(180), LAM, four)
    with pytest.raises(ParameterError, match=r"efficiency of U is 0 at 0.5 um.* the 2 frames do"):
        demodulation(plate(180), LAM, four[::2], components="IQU")
    with pytest.raises(ChainError, match="stage 'plate'"):
        demodulation(plate(180), LAM, QTable({"polarizer": [0, 45] * u.deg}))
    for frames in ({"plate": [0, 45] * u.deg}, [0, 45], None):
        for call in (demodulation, partial(best_modulation, free=["plate"])):
            with pytest.raises(ParameterError, match=r"frames is of type .*; a table is needed"):
                call(plate(180), LAM, frames)
    with pytest.raises(ParameterError, match="components = 'IV'; allowed are IQU, IQUV"):
        demodulation(plate(100), LAM, four, components="IV")
    with pytest.raises(ParameterError, match=r"variance of shape \(3,\); 4 numbers above zero"):
        demodulation(plate(100), LAM, four, variance=[1, 1, 1])


@pytest.mark.slow
def test_a_search_finds_the_best_angles_and_retardances():
    frames = QTable({"plate": [1, 20, 90, 130] * u.deg})
    _, at, best = best_modulation(plate(132), LAM, frames, ["plate"])
    # the optimum of four angles (Sabatke et al. 2000, Opt. Lett. 25, 802)
    np.testing.assert_allclose(best.efficiency[:, 1:], 3**-0.5, atol=0.01)
    assert not np.array_equal(at["plate"], frames["plate"])
    chain, _, best = best_modulation(plate(80), LAM, frames, ["plate", "plate.retardance"])
    assert np.sum(best.efficiency[0, 1:] ** 2) > 0.999
    # its retardance is 131.8 deg, or as far on the other side of half a turn
    assert np.cos(chain["plate"].retardance.quantity).value == pytest.approx(-2 / 3, abs=0.02)
    for name in ("lamp", "plate.mount", "analyser"):
        with pytest.raises(ParameterError, match=f"free = '{name}' is neither"):
            best_modulation(plate(132), LAM, frames, [name])
