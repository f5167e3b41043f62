# Licensed under a 3-clause BSD style license - see LICENSE
"""Diagnosis of stars: everything held, angles that follow the sky, wrong signs, a real star."""

import sys
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest

sys.path.append(str(Path(__file__).parent.parent))

from star_data import WAVELENGTH, observe_star, star_chain

from astropolcal import calibrate, instruments
from astropolcal.chain import join, leaves
from astropolcal.gap import diagnose
from astropolcal.gap.effects import EFFECTS
from astropolcal.instruments.telescope import published_mirror
from astropolcal.observations import Observations


def held(chain, without=(), free=()):
    """Return the chain with everything held but some optics, and some taken out."""
    train = [leaf.copy() for leaf in leaves(chain) if leaf.name not in without]
    for leaf in train:
        for key in leaf.param_names:
            getattr(leaf, key).fixed = leaf.name not in free or key == "theta"
    return join(train)


def true_chain(source="unpolarized standard star", **options):
    chain = star_chain(source, **options)
    chain["m3"].diattenuation = published_mirror().diattenuation(WAVELENGTH)
    return chain


def names(found):
    return [name for cause in found.causes for name in (cause.name, *cause.aliases)]


def test_mirror_that_a_chain_without_free_parameters_lacks():
    chain = true_chain()
    star = observe_star(chain, seed=3, parallactic=(-60, 60))
    found = diagnose(held(chain, without=["m3"]), star)
    assert found.verdict == "effect"
    assert found.causes[0].name == "m3_diattenuation"
    measured = found.chains[0]["gap_m3_diattenuation"].diattenuation.value
    np.testing.assert_allclose(measured, chain["m3"].diattenuation.value, atol=3e-4)
    assert found.gap_after_percent < 0.2 * found.gap_before_percent


def test_nothing_is_missing():
    chain = true_chain()
    found = diagnose(held(chain), observe_star(chain, seed=4))
    assert (found.verdict, found.causes) == ("none", [])


def test_standard_that_is_polarized():
    truth = true_chain("star")
    truth["star"].q = np.array([0.002, 0.003, 0.003])
    truth["star"].u = np.array([-0.003, -0.002, -0.001])
    star = observe_star(truth, seed=5, parallactic=(-60, 60))
    nominal = held(true_chain(), free=["m3"])
    found = diagnose(nominal, star)
    assert found.causes[0].name == "standard_polarization"


@pytest.mark.parametrize("name", ["altitude_sign", "hwp_tracking_parallactic_sign"])
def test_wrong_sign(name):
    truth = true_chain("star")
    truth["star"].q, truth["star"].u = np.full((2, 3), [[0.02], [-0.01]])
    wrong = EFFECTS[name].edit([truth], None).chains[0]
    star = observe_star(wrong, seed=6, source="star", parallactic=(-60, 60))
    found = diagnose(held(truth, free=["star"]), star)
    assert found.causes[0].effect.kind == "discrete"
    assert name in names(found)


@pytest.mark.slow
def test_real_star_misses_flat_field_and_mirror(shared_data):
    charis, folder = instruments.get("charis"), shared_data / "data" / "charis"
    lamp = Observations.read(folder / "dataset3_polarized_2025-10-05.ecsv")
    star = Observations.read(folder / "hd293396_unpolarized_standard_2025-11-03.ecsv")
    inside = calibrate(charis.chain(*charis.setup(lamp)), lamp, cross_validate=False).chains[0]
    start = [leaf.name for leaf in leaves(inside)].index("hwp")
    outside = leaves(charis.chain(*charis.setup(star)))[:4]
    chain = held(join([*outside, *leaves(inside)[start:]]), without=["m3"])
    found = diagnose(chain, star)
    assert [cause.name for cause in found.causes][:2] == ["beam_gain", "m3_diattenuation"]
    measured = found.chains[0]["gap_m3_diattenuation"].diattenuation.value
    published = published_mirror().diattenuation(star.wavelength.to(u.um))
    assert np.sqrt(np.mean((measured - published) ** 2)) < 0.0015
    assert found.gap_after_percent < 0.15 * found.gap_before_percent
