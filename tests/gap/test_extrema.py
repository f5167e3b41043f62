# Licensed under a 3-clause BSD style license - see LICENSE
"""What a model holds, or has at a bound or in a wrong branch, hides nothing."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from gap_data import WAVELENGTH as DATA_WAVELENGTH
from gap_data import chain, clean_model, observed
from gap_setups import cassegrain

from astropolcal import instruments, optics
from astropolcal.chain import join, leaves
from astropolcal.gap import diagnose
from astropolcal.gap.cells import Cell
from astropolcal.gap.effects import get_effect
from astropolcal.gap.effects.effect import CellEffect
from astropolcal.gap.model import nominal_model
from astropolcal.gap.report import Fitted
from astropolcal.reduction.cubes import both_states
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


@pytest.mark.long
def test_half_a_wave_hides_nothing():
    for true, free in [(176.0, False), (176.0, True), (184.0, True)]:
        data = simulate(plate_chain(true), WAVELENGTH, TURN, flux=1e6, seed=1, name="turn")
        found = diagnose(plate_chain(free=free), data)
        (cause,) = found.causes
        assert cause.name == "hwp_retardance" or cause.cell.name == "in:hwp/retardance_h/constant"
        (size,) = Fitted(found.improved).sizes(cause.name).values()
        assert size["unit"] == "deg"
        # data do not tell which side of half a wave it is
        assert np.abs(np.mean(size["value"])) == pytest.approx(4.0, abs=0.3)
        assert found.remainder_p_value > 1e-3


def test_half_a_wave_that_is_one_is_no_cause():
    data = simulate(plate_chain(), WAVELENGTH, TURN, flux=1e6, seed=2, name="turn")
    assert diagnose(plate_chain(free=True), data).causes == []


def test_a_fit_does_not_stay_at_half_a_wave(own_instruments):
    """There the derivative to the retardance is so short that steps along it lead far astray."""
    setup = cassegrain()
    cell = Cell("source", "diattenuation_c", "harmonic:hwp:2")
    data = setup.observed(setup.with_cell(cell, 0.0228, 0.0114), seed=101)
    nominal = nominal_model([setup.nominal], [data])
    # it looks like a gain of one beam
    better = nominal.with_effect(get_effect("beam_gain"), steps=24, share=1e-3)
    assert better.fit.chi2 < 0.3 * nominal.fit.chi2


@pytest.mark.long
def test_a_parameter_beyond_its_bound_is_named():
    true, narrow = chain(), chain()
    true["hwp"].theta = 2 * u.deg
    narrow["hwp"].theta.bounds = (-0.5, 0.5)
    narrow["calibration_polarizer"].theta.fixed = narrow["derotator"].theta.fixed = True
    found = diagnose(narrow, observed(true), cells=False)
    assert found.verdict == "named"
    assert found.causes[0].name == "hwp_angle_bound"


@pytest.mark.parametrize("bins", [(3,), (2, 3), (0,)])
@pytest.mark.parametrize("kind", ["linear", "elliptical"])
def test_a_wavelength_in_the_wrong_branch_is_brought_back(kind, bins):
    true = instruments.get("charis").chain(wavelength=DATA_WAVELENGTH, derotator=kind)
    wrong = true.copy()
    key = "retardance" if kind == "linear" else "horizontal"
    values = getattr(wrong["derotator"], key).value.copy()
    values[list(bins)] *= -1
    setattr(wrong["derotator"], key, values * u.deg)
    model = nominal_model([wrong], [observed(true)])
    assert model.mean_square < 1.3
    found = getattr(model.chains[0]["derotator"], key).value
    expected = getattr(true["derotator"], key).value
    np.testing.assert_allclose(np.cos(np.deg2rad(found - expected)), 1, atol=1e-2)


def test_no_size_makes_more_polarization_than_there_is():
    for kind, size, possible in [
        ("depolarization_linear", 0.05, True),
        # the prism's efficiency of 0.985 has room for less depolarization, but not for that much
        ("depolarization_linear", -0.01, True),
        ("depolarization_linear", -0.05, False),
        ("diattenuation_h", -0.05, True),
    ]:
        for place in ["source", "in:derotator", "after:derotator"]:
            cell = CellEffect(Cell(place, kind, "constant"), 0)
            model = clean_model().with_effect(cell, steps=0)
            model.fit.coefficients[model.problem.slices[model.added[cell.name][0].name]] = size
            assert model.keeps_polarization(cell.name) is possible, (kind, size, possible, place)


@pytest.mark.long
def test_a_held_source_is_looked_at_like_all_others():
    """VAMPIRES with a lamp of which the model says that it knows the polarization."""
    for q, u_ in [(0.87, 0.1), (0.9, 0.13)]:
        fields = [610, 670, 720] * u.nm
        known = leaves(instruments.get("vampires").chain(wavelength=fields, derotator="linear"))[1:]
        for optic in known[:1]:
            for key in optic.param_names:
                getattr(optic, key).fixed = True
        lamp = optics.PolarizedSource(q=np.full(3, 0.9), u=np.full(3, 0.1), name="lamp")
        lamp.q.fixed = lamp.u.fixed = True
        model = join([lamp, *known])
        true = model.copy()
        true["lamp"].q, true["lamp"].u = np.full(3, q), np.full(3, u_)
        table = both_states(half_wave_plate_cycles(derotator=[45, 60, 75, 90] * u.deg))
        meta = {"instrument": "vampires", "source": "polarized", "pairing": "flc_state"}
        data = simulate(true, fields, table, flux=1e6, seed=1, meta=meta, name="run")
        found = diagnose(model, data, cross_validate=False)
        (cause,) = found.causes
        group = [cause, *(one for one, _ in cause.aliases)]
        assert any(
            one.cell and (one.cell.place, one.cell.dependence) == ("source", "constant")
            for one in group
        )
        source = {"standard_polarization", "source/diattenuation_d/constant"}
        assert source & {one.name for one in group}
        assert found.remainder_p_value > 1e-3


@pytest.mark.long
def test_a_retarder_beside_a_plate_that_is_pressed_to_half_a_wave():
    """No derivative shows it there; what a derivative shows instead was given 99 %."""
    wavelength = np.linspace(0.5, 0.9, 6) * u.um
    law = (176 + 3 * np.linspace(-1, 1, 6) ** 2) * u.deg
    table = QTable({"calibrator": np.repeat(np.arange(6) * 30.0, 8) * u.deg})
    table["hwp"] = np.tile(np.arange(8) * 11.25, 6) * u.deg
    lamp = optics.LinearPolarizer(mount="calibrator", name="calibrator")
    prism = optics.WollastonPrism(efficiency=np.full(6, 0.98), name="wollaston")
    plate, known = (
        optics.LinearRetarder(retardance=one, mount="hwp", name="hwp")
        for one in (law, np.full(6, 178) * u.deg)
    )
    some = optics.LinearRetarder(retardance=3 * u.deg, theta=45 * u.deg, name="window")
    truth = join([lamp, plate, some, prism])
    for seed in (0, 2):
        run = simulate(truth, wavelength, table, flux=1e6, seed=seed, name="lamp")
        found = diagnose(join([lamp, known, prism]), run, cross_validate=False)
        (cause,) = found.causes
        assert cause.name == "after:hwp/retardance_d/constant", (seed, found)
        assert cause.probability > 0.9
        assert found.remainder_p_value > 0.01
