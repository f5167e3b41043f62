# Licensed under a 3-clause BSD style license - see LICENSE
"""Data laid out for figures: settings of the plate, models between the data, wavelengths."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest

from astropolcal import calibrate, instruments
from astropolcal.exceptions import WavelengthRangeError
from astropolcal.plotting.residuals import DataGrid
from astropolcal.reduction.cubes import both_states
from astropolcal.simulation import half_wave_plate_cycles, simulate

MINUS = "\N{MINUS SIGN}"
FIELDS = [610, 670, 720] * u.nm


@pytest.fixture(scope="module")
def grid(masked):
    return DataGrid(masked, 0)


@pytest.fixture(scope="module")
def modulated():
    """Frames of a ferroelectric modulator, whose two states make the difference."""
    chain = instruments.get("vampires").chain(wavelength=FIELDS, derotator="linear")
    table = both_states(half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg))
    meta = {"instrument": "vampires", "source": "polarized", "pairing": "flc_state"}
    data = simulate(chain, FIELDS, table, flux=1e6, seed=1, meta=meta, name="lamp")
    return DataGrid(calibrate(chain, data, search=False, cross_validate=False), 0)


# ---- grids ---------------------------------------------------------------------------------


def test_grids_hold_each_datum_at_its_place(grid):
    part = grid.part
    known = np.isfinite(grid.observed)
    np.testing.assert_array_equal(known, part.valid)
    np.testing.assert_allclose(grid.observed[known], part.observed)
    np.testing.assert_allclose(grid.sigma[known], part.sigma)
    # two masked cells and a masked frame take their pairs along
    assert np.sum(~known) == 1 + len(grid.wavelength)


def test_residual_is_observed_less_model(grid):
    vector = grid.part.values if hasattr(grid.part, "values") else None
    assert vector is not None
    near = np.abs(grid.residual) < 6 * grid.sigma
    assert near[np.isfinite(grid.residual)].all()


def test_series_are_the_settings_of_the_plate(grid):
    series = grid.series()
    pairs = [("0°", "45°"), ("11.25°", "56.25°"), ("22.5°", "67.5°"), ("33.75°", "78.75°")]
    assert [one.label for one in series] == [f"{a} {MINUS} {b}" for a, b in pairs]
    together = np.concatenate([one.data for one in series])
    assert sorted(together) == list(range(grid.observed.shape[1]))
    for one in series:
        plate = np.rad2deg(grid.position("hwp")[0, one.data])
        assert np.ptp(plate) < 0.5
        assert set(one.positions) == {"hwp"}


def test_series_of_a_modulator_name_its_states(modulated):
    labels = [one.label for one in modulated.series()]
    assert labels[0] == f"0°, A {MINUS} B"
    assert len(labels) == 8
    assert all(label.endswith(f", A {MINUS} B") for label in labels)


# ---- the model between the data ------------------------------------------------------------


@pytest.mark.parametrize("which", ["grid", "modulated"])
def test_the_curve_goes_through_the_model_at_the_data(which, request):
    grid = request.getfixturevalue(which)
    bins = np.arange(len(grid.wavelength))
    for one in grid.series():
        curve = grid.curve(one, bins, grid.derotator[one.data])
        model = grid.observed[:, one.data] - grid.residual[:, one.data]
        known = np.isfinite(model)
        np.testing.assert_allclose(curve[known], model[known], atol=1e-9)


def test_a_stage_that_moves_leaves_no_curve(grid):
    moving = SimpleNamespace(positions={"hwp": np.deg2rad([[0.0, 0.2, 3.0]])})
    fake = SimpleNamespace(part=moving)
    assert DataGrid._steady(fake, np.array([True, True, True])) is None
    steady = DataGrid._steady(fake, np.array([True, True, False]))
    assert np.rad2deg(steady["hwp"]) == pytest.approx([0.1])


# ---- wavelengths ---------------------------------------------------------------------------


def lambdas(wavelength, known=None):
    """A grid with these wavelengths (nm), some of them without data."""
    new = object.__new__(DataGrid)
    new.wavelength = np.asarray(wavelength, float)
    known = np.ones(len(wavelength), dtype=bool) if known is None else np.asarray(known)
    new.observed = np.where(known[:, None], 0.1, np.nan) * np.ones((1, 3))
    new.part = SimpleNamespace(observations=SimpleNamespace(name="run"))
    return new


def test_wavelengths_are_spread_over_the_range():
    found = lambdas(np.linspace(1200, 2400, 22)).spread_bins(4)
    assert len(found) == 4
    steps = np.diff(found)
    assert steps.max() - steps.min() <= 1
    # away from the ends, where the data are poor
    assert found[0] > 0
    assert found[-1] < 21


def test_few_wavelengths_are_all_drawn_in_order():
    assert lambdas([1600, 1200, 2200]).spread_bins(4).tolist() == [1, 0, 2]
    assert lambdas([1600, 1200, 2200, 1900, 1400]).spread_bins(4).tolist() == [1, 4, 3, 2]


def test_a_wavelength_without_data_is_not_drawn():
    known = np.arange(5) != 2
    assert 2 not in lambdas(np.arange(5) + 1200.0, known).spread_bins(5)


def test_nearest_wavelengths_come_once_and_as_asked():
    found = lambdas([1200, 1400, 1600]).nearest_bins([1.59, 1.21, 1.61] * u.um)
    assert found.tolist() == [2, 0]


@pytest.mark.parametrize("wavelength", [1100 * u.nm, 1.7 * u.um])
def test_wavelengths_outside_the_range_are_refused(wavelength):
    with pytest.raises(WavelengthRangeError, match=r"nm; run has 1200\.0 to 1600\.0 nm"):
        lambdas([1200, 1400, 1600]).nearest_bins(wavelength)
