# Licensed under a 3-clause BSD style license - see LICENSE
"""Polarimetric efficiency: closed forms, the paper's dips, and planning."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from star_data import CHARIS

from astropolcal import instruments, optics
from astropolcal.chain import join, leaves, replace_optic
from astropolcal.efficiency import (
    best_derotator,
    has_derotator,
    polarimetric_efficiency,
    sky_path,
)
from astropolcal.exceptions import ChainError, InstrumentError, ObservationError, ParameterError
from astropolcal.instruments import Instrument, SkyLaw

LAM = [1.6] * u.um


def bench(retardance, efficiency=0.7, analyser=0.0):
    """An ideal half-wave plate and a derotator behind a lamp."""
    return (
        optics.LinearPolarizer(name="polarizer")
        | optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(retardance=retardance * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(efficiency=efficiency, theta=analyser * u.deg, name="wollaston")
    )


@pytest.mark.slow
@given(st.floats(-180, 180), st.floats(0, 360), st.floats(0, 180))
def test_linear_retarder_has_a_closed_form(derotator, retardance, aolp):
    found = polarimetric_efficiency(
        bench(retardance), LAM, derotator=derotator * u.deg, aolp=aolp * u.deg
    )
    d, delta = np.deg2rad([2 * derotator, retardance])
    assert found[0] == pytest.approx(np.hypot(np.cos(d), np.sin(d) * np.cos(delta)), abs=1e-9)


@pytest.mark.slow
@given(st.floats(-180, 180), st.floats(0, 360))
def test_worst_angle_is_no_better_than_any(derotator, retardance):
    kwargs = {"derotator": derotator * u.deg}
    worst = polarimetric_efficiency(bench(retardance), LAM, aolp=None, **kwargs)
    any_ = polarimetric_efficiency(bench(retardance), LAM, aolp=20 * u.deg, **kwargs)
    assert worst[0] <= any_[0] + 1e-9


def test_beam_splitter_does_not_count_but_its_orientation_does():
    kwargs = {"derotator": 30 * u.deg}
    a, b = (polarimetric_efficiency(bench(120, eta), LAM, **kwargs) for eta in (0.5, 1.0))
    np.testing.assert_allclose(a, b)
    turned = polarimetric_efficiency(bench(120, analyser=30), LAM, **kwargs)
    straight = polarimetric_efficiency(bench(120), LAM, derotator=0 * u.deg)
    np.testing.assert_allclose(turned, straight)
    # one that turns stands at an angle that nobody gives
    turning = bench(120)
    turning["wollaston"].mount = "prism"
    with pytest.raises(ChainError, match="no position of the stages prism"):
        polarimetric_efficiency(turning, LAM, **kwargs)


def test_path_ends_before_the_beam_splitter():
    assert [leaf.name for leaf in leaves(sky_path(bench(90)))] == ["hwp", "derotator"]
    with pytest.raises(ChainError, match="no optic on a stage"):
        sky_path(optics.WollastonPrism(name="wollaston"))


# --- CHARIS -----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def sky():
    return CHARIS.on_sky(CHARIS.published())


def test_least_near_45_and_135_deg_whatever_the_pointing(sky):
    """Paper, Fig. of the efficiency, at the four pointings that it shows."""
    for parallactic, altitude in [(32, 48), (94, 60), (126, 60), (24, 67)]:
        angles = np.arange(0, 180, 3)
        found = polarimetric_efficiency(
            sky,
            CHARIS.wavelength,
            derotator=angles * u.deg,
            altitude=altitude * u.deg,
            parallactic=parallactic * u.deg,
        )
        # where the derotator is a quarter-wave plate
        column = found[:, np.abs(CHARIS.wavelength.to_value(u.nm) - 1575).argmin()]
        first, second = angles[column[:30].argmin()], angles[30 + column[30:].argmin()]
        assert abs(first - 45) <= 6, (parallactic, altitude)
        assert abs(second - 135) <= 6, (parallactic, altitude)
        assert column.min() < 0.35, (parallactic, altitude)
        assert found[[0, 30]].min() > 0.95, (parallactic, altitude)


def test_pointing_changes_it_by_a_few_percent(sky):
    kwargs = {"derotator": 70 * u.deg, "altitude": 60 * u.deg}
    angles = np.arange(-180, 180, 20) * u.deg
    found = polarimetric_efficiency(sky, CHARIS.wavelength, parallactic=angles, **kwargs)
    assert found.shape == (18, 22)
    assert 0.005 < np.ptp(found, axis=0).max() < 0.3


def test_angles_broadcast(sky):
    found = polarimetric_efficiency(
        sky,
        CHARIS.wavelength,
        derotator=[45, 90] * u.deg,
        altitude=[[30], [50], [70]] * u.deg,
        parallactic=0 * u.deg,
    )
    assert found.shape == (3, 2, 22)
    assert np.all((found >= 0) & (found <= 1 + 1e-9))


def test_impossible_requests_are_errors(sky):
    kwargs = {"derotator": 45 * u.deg, "parallactic": 0 * u.deg}
    with pytest.raises(ObservationError, match=r"altitude = 95 deg; allowed is above 0 to 90"):
        polarimetric_efficiency(sky, CHARIS.wavelength, altitude=95 * u.deg, **kwargs)
    with pytest.raises(ParameterError, match="needs altitude= and parallactic="):
        polarimetric_efficiency(sky, CHARIS.wavelength, **kwargs)
    with pytest.raises(ParameterError, match="too many"):
        polarimetric_efficiency(bench(90), LAM, derotator=np.zeros(3_000_000) * u.deg, aolp=None)
    chain = optics.LinearRetarder(mount="other", name="x") | bench(90)
    with pytest.raises(ChainError, match="no position of the stages other"):
        polarimetric_efficiency(chain, LAM, derotator=0 * u.deg)
    kwargs["altitude"] = 60 * u.deg
    for wrong, words in [
        ({"aolp": [0, 90] * u.deg}, r"aolp has shape \(2,\); one angle is needed"),
        ({"aolp": np.nan * u.deg}, "aolp = nan deg must be finite"),
        ({"law": (1,)}, r"law = \(1,\); two factors"),
        ({"law": "pupil"}, "law = 'pupil' is not a number"),
        ({"parallactic": [0, 1] * u.deg, "altitude": [50, 60, 70] * u.deg}, "must broadcast"),
        ({"parallactic": [0, 1] * u.deg, "derotator": [50, 60, 70] * u.deg}, "must broadcast"),
    ]:
        with pytest.raises(ParameterError, match=words):
            polarimetric_efficiency(sky, CHARIS.wavelength, **kwargs | wrong)
    for altitude, offsets, words in [
        ([50, 60], [] * u.deg, r"offsets has shape \(0,\); some in one row"),
        ([50, 60], [[1, 2]] * u.deg, r"offsets has shape \(1, 2\); some in one row"),
        ([50, 60], [1, 2], "offsets = .* needs a unit"),
        ([50, 60], [1, np.nan] * u.deg, "offsets = .* must be finite"),
        ([50, 60, 70], None, r"altitude has shape \(3,\), parallactic has shape \(2,\)"),
        ([[50, 60]], None, r"altitude has shape \(1, 2\); some in one row"),
    ]:
        with pytest.raises(ParameterError, match=words):
            best_derotator(sky, LAM, altitude * u.deg, [0, 1] * u.deg, offsets=offsets)
    with pytest.raises(ParameterError, match=r"altitude has shape \(0,\); some in one row"):
        best_derotator(sky, LAM, [] * u.deg, [] * u.deg)


# --- other instruments ------------------------------------------------------------------------


def cassegrain(retardance=180.0):
    """Sky, a mirror and an ideal splitter, with a plate that stays where it is put."""
    return (
        optics.Rotator(mount="parallactic", name="sky")
        | optics.LinearRetarder(retardance=60 * u.deg, name="relay")
        | optics.LinearRetarder(retardance=retardance * u.deg, mount="hwp", name="hwp")
        | optics.WollastonPrism(name="wollaston")
    )


class Cassegrain(Instrument):
    name = "cassegrain"
    sky_law = SkyLaw(plate=(0, 0), derotator={})

    def chain(self, source="star", optics_in=(), *, wavelength=None):
        return cassegrain()

    def setup(self, observations):
        return "star", ()


def test_instrument_without_a_derotator_and_with_a_plate_that_stands():
    """The sky turns in front of a retarder: sqrt(cos^2 2x + sin^2 2x cos^2 delta)."""
    p = np.arange(0, 180, 10)
    found = polarimetric_efficiency(
        cassegrain(), LAM, parallactic=p * u.deg, aolp=30 * u.deg, instrument=Cassegrain()
    )
    x = np.deg2rad(2 * (30 - p))
    np.testing.assert_allclose(
        found[:, 0], np.hypot(np.cos(x), np.sin(x) * np.cos(np.deg2rad(60))), atol=1e-12
    )
    assert not has_derotator(cassegrain())
    with pytest.raises(ChainError, match="no derotator whose offset"):
        best_derotator(cassegrain(), LAM, [60] * u.deg, [0] * u.deg, instrument=Cassegrain())
    # another law turns the plate
    with pytest.raises(ParameterError, match="needs altitude= and parallactic="):
        polarimetric_efficiency(cassegrain(), LAM, parallactic=p * u.deg)
    with pytest.raises(ParameterError, match="needs parallactic="):
        polarimetric_efficiency(cassegrain(), LAM, instrument=Cassegrain())


def test_law_of_the_instrument_counts():
    """A plate that is no half-wave plate measures more or less, as it follows the sky."""
    chain, p = cassegrain(150), np.arange(0, 180, 10) * u.deg
    options = {"parallactic": p, "altitude": 50 * u.deg, "aolp": 10 * u.deg}
    own = polarimetric_efficiency(chain, LAM, instrument=Cassegrain(), **options)
    stated = polarimetric_efficiency(chain, LAM, law=(0, 0), **options)
    other = polarimetric_efficiency(chain, LAM, law=(0.5, 1), **options)
    np.testing.assert_array_equal(own, stated)
    assert np.abs(own - other).max() > 0.02


def test_derotator_may_have_another_name():
    chain = bench(120)
    moved = leaves(bench(120))[2].copy()
    moved.mount = "rotator"
    named = replace_optic(chain, "derotator", moved)
    angles = [10, 40, 80] * u.deg
    np.testing.assert_array_equal(
        polarimetric_efficiency(named, LAM, derotator=angles),
        polarimetric_efficiency(chain, LAM, derotator=angles),
    )
    with pytest.raises(ParameterError, match="on the stage rotator: derotator= is needed"):
        polarimetric_efficiency(named, LAM)


def test_offset_of_irdis_keeps_the_derotator_off_45_deg():
    for mode in ["field", "pupil"]:
        irdis = instruments.get("irdis")
        sky = irdis.on_sky(irdis.published(), coating="after")
        altitude, parallactic = [60, 63, 66] * u.deg, [-40, -30, -20] * u.deg
        best = best_derotator(
            sky, irdis.wavelength, altitude, parallactic, law=mode, instrument="irdis"
        )
        f, g = irdis.sky_law.derotator_law(mode)
        derotator = np.mod((best.offset + f * parallactic + g * altitude).to_value(u.deg), 90)
        assert np.all(np.minimum(derotator, 90 - derotator) < 12), mode
        with pytest.raises(InstrumentError, match="mode = None; allowed are field, pupil"):
            polarimetric_efficiency(
                sky,
                irdis.wavelength,
                derotator=0 * u.deg,
                altitude=60 * u.deg,
                parallactic=0 * u.deg,
                instrument=irdis,
            )


def test_both_states_of_a_liquid_crystal_are_one_measurement():
    crystal = optics.FerroelectricLiquidCrystal(
        retardance=180 * u.deg, switching_angle=45 * u.deg, mount="flc_state", name="flc"
    )
    whole = join([*leaves(bench(120))[:3], crystal, *leaves(bench(120))[3:]])
    angles = [0, 20, 45] * u.deg
    np.testing.assert_allclose(
        polarimetric_efficiency(whole, LAM, derotator=angles),
        polarimetric_efficiency(bench(120), LAM, derotator=angles),
    )
    crystal.switching_angle = 40 * u.deg
    whole = join([*leaves(bench(120))[:3], crystal, *leaves(bench(120))[3:]])
    less = polarimetric_efficiency(whole, LAM, derotator=0 * u.deg, aolp=90 * u.deg)
    assert less[0] == pytest.approx((1 + np.cos(np.deg2rad(20))) / 2, abs=0.01)


# --- planning ---------------------------------------------------------------------------------


def test_best_offset_keeps_the_derotator_off_the_dips(sky):
    altitude, parallactic = [60, 62, 64] * u.deg, [-10, 0, 10] * u.deg
    best = best_derotator(sky, CHARIS.wavelength, altitude, parallactic)
    assert len(best.table) == 180
    derotator = np.mod((best.offset + 0.5 * altitude).to_value(u.deg), 90)
    assert np.all(np.minimum(derotator, 90 - derotator) < 8)
    least = best.table["least"]
    assert least.max() > 0.9
    assert least.min() < 0.1
    assert best.table["offset"][least.argmax()] == best.offset


def test_laws_of_the_derotator(sky):
    kwargs = {"offsets": [60, 70] * u.deg}
    pointing = [40, 60] * u.deg, [-60, 60] * u.deg
    found = [
        best_derotator(sky, CHARIS.wavelength, *pointing, law=law, **kwargs).table["least"]
        for law in SkyLaw().derotator
    ]
    assert np.abs(found[0] - found[1]).max() > 0.05
    with pytest.raises(ParameterError, match=r"law = 'sky'.*allowed are pupil, field"):
        best_derotator(sky, CHARIS.wavelength, *pointing, law="sky")
