# Licensed under a 3-clause BSD style license - see LICENSE
"""The accuracies of the paper by hand, their limits, and four of them side by side."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, Table
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.calibration import calibrate
from astropolcal.calibration.noise.scatter import groups_by, leave_out_groups
from astropolcal.calibration.validation import paper_accuracies
from astropolcal.calibration.validation.targets import propagate_accuracy
from astropolcal.exceptions import FitError, ParameterError
from astropolcal.measurement import Measurement
from astropolcal.observations.observables import get_observable

LAM = [1.2, 1.6, 2.2] * u.um
PERCENT = st.floats(0, 5)


def accuracy(*values, wavelength=LAM, column="s_mean"):
    return QTable({"wavelength": wavelength, column: np.array(values) * u.percent})


def percent(quantity):
    return quantity.to_value(u.percent)


# --- equations of Sec. 2.3 ----------------------------------------------------------


def test_equations_by_hand():
    """P = 10 %, chi = 15 deg: |q| = 0.0866, |u| = 0.05; s_rel = 1 %, s_abs = 0.05 %."""
    found = propagate_accuracy(0.1, 15 * u.deg, 1 * u.percent, 0.05 * u.percent)
    assert percent(found["s_Q"]) == pytest.approx(0.1366025, abs=1e-7)
    assert percent(found["s_U"]) == pytest.approx(0.1)
    # (0.0075 * 0.1366025^2 + 0.0025 * 0.01) / 0.01 = 0.0164952
    assert percent(found["s_p"]) == pytest.approx(0.1284338, abs=1e-6)
    # sqrt(0.0075 * 1e-6 + 0.0025 * 1.8660254e-6) / 0.02 = 0.0055148 rad
    assert found["s_chi"].to_value(u.rad) == pytest.approx(0.0055148, abs=1e-7)


def test_unpolarized_target_has_the_absolute_accuracy():
    for aolp in [0, 17, 45, 50, 90, -120] * u.deg:
        found = propagate_accuracy([0, 1e-9], aolp, 0.3 * u.percent, 0.05 * u.percent)
        np.testing.assert_allclose(percent(found["s_p"]), 0.05, rtol=1e-8)
        assert np.isinf(found["s_chi"][0])
        # s_chi goes to s_abs / 2 p
        assert found["s_chi"][1].to_value(u.rad) == pytest.approx(0.0005 / 2e-9, rel=1e-6)


@given(st.floats(1e-3, 1), st.floats(-360, 360), PERCENT, PERCENT)
def test_accuracies_as_the_paper_writes_them(p, angle, rel, absolute):
    chi = np.deg2rad(angle)
    q, u_ = np.abs(p * np.cos(2 * chi)), np.abs(p * np.sin(2 * chi))
    s_q, s_u = (absolute + rel * q) / 100, (absolute + rel * u_) / 100
    found = propagate_accuracy(p, angle * u.deg, rel * u.percent, absolute * u.percent)
    s_p = np.sqrt((q**2 * s_q**2 + u_**2 * s_u**2) / (q**2 + u_**2))
    s_chi = np.sqrt(q**2 * s_u**2 + u_**2 * s_q**2) / (2 * (q**2 + u_**2))
    np.testing.assert_allclose(found["s_p"].to_value(u.one), s_p, rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(found["s_chi"].to_value(u.rad), s_chi, rtol=1e-9, atol=1e-12)


@given(st.floats(0, 1), st.floats(-90, 90), PERCENT, PERCENT)
def test_accuracy_of_the_degree_lies_between_those_of_q_and_u(p, angle, rel, absolute):
    found = propagate_accuracy(p, angle * u.deg, rel * u.percent, absolute * u.percent)
    low, high = sorted(percent(found[key]) for key in ("s_Q", "s_U"))
    assert low * (1 - 1e-9) - 1e-15 <= percent(found["s_p"]) <= high * (1 + 1e-9) + 1e-15
    turned = propagate_accuracy(p, (angle + 45) * u.deg, rel * u.percent, absolute * u.percent)
    # a turn by 45 deg exchanges q and u
    np.testing.assert_allclose(turned["s_p"], found["s_p"], rtol=1e-6, atol=1e-15 * u.percent)


def test_impossible_targets_are_refused():
    for arguments, message in [
        ((1.5, 0 * u.deg, 0.1, 0.1), "dolp = 1.5; allowed are 0 to 1"),
        ((-1 * u.percent, 0 * u.deg, 0.1, 0.1), "dolp = -1.0 %; allowed are 0 to 1"),
        ((0.1, 0 * u.deg, -0.1, 0.1), "s_rel = -0.1; allowed are numbers from 0"),
        ((0.1, 1 * u.um, 0.1, 0.1), "aolp"),
    ]:
        with pytest.raises(ParameterError, match=message):
            propagate_accuracy(*arguments)


# --- tables -------------------------------------------------------------------------


def test_paper_range_for_a_target_of_1_percent(charis_data, shared_data):
    """
    Published: s_p from 0.02 to 0.12 % for 1 % at 50 deg (Sec. 7.2).

    s_rel is the published one of Dataset 3 and s_unpol of Dataset 4. For s_sky, which
    is not published, stands the scatter of the star HD 293396 about a line in altitude for
    each plate angle, with k = 4 as in the paper. Found: 0.021 to 0.094 %, and 0.54 to 2.66
    deg, of which the paper states 0.5 to 3.2.
    """
    reference = shared_data / "reference"
    fits = Table.read(reference / "charis_published_fits.ecsv")
    mirror = Table.read(reference / "charis_fold_mirror.ecsv")
    wavelength = np.array(fits["wavelength"]) * u.nm
    unpol = [np.mean(mirror["s_unpol"][mirror["bin"] == b]) for b in range(22)]
    parts = {
        "polarized": fits["s_rel_elliptical_dataset3"],
        "unpolarized": unpol,
        "unpolarized standard star": _scatter_of_star(charis_data("hd293396_")),
    }
    tables = [(kind, accuracy(*part, wavelength=wavelength)) for kind, part in parts.items()]
    cal = _calibration(tables, [None] * 3, wavelength)
    (table,) = paper_accuracies(cal, [(1 * u.percent, 50 * u.deg)])
    s_p = percent(table["s_p"])
    assert 0.015 < s_p.min() < 0.025
    assert 0.08 < s_p.max() < 0.14
    # the paper: 0.5 to 3.2 deg
    assert 0.4 < table["s_chi"].to_value(u.deg).min() < 0.7
    assert 2.3 < table["s_chi"].to_value(u.deg).max() < 3.8


def test_printed_ranges_of_the_paper_belong_together(shared_data):
    """
    Published: s_p from 0.02 to 0.12 % and s_chi from 0.5 to 3.2 deg, 1 % at 50 deg (Sec. 7.2).

    s_sky is not published. The s_abs that gives the printed s_p, within its rounding and
    with the published s_rel of some wavelength, must give the printed s_chi within its own.
    """
    fits = Table.read(shared_data / "reference" / "charis_published_fits.ecsv")
    s_rel = np.array(fits["s_rel_elliptical_dataset3"]) * u.percent

    def at(s_abs):
        return propagate_accuracy(1 * u.percent, 50 * u.deg, s_rel, s_abs * u.percent)

    for s_p, s_chi in [(0.02, 0.5), (0.12, 3.2)]:
        low, high = np.zeros(len(s_rel)), np.zeros(len(s_rel))
        for edge, target in ((low, s_p - 0.005), (high, s_p + 0.005)):
            inside = np.zeros(len(s_rel)), np.full(len(s_rel), 1.0)
            for _ in range(40):
                middle = (inside[0] + inside[1]) / 2
                above = percent(at(middle)["s_p"]) > target
                inside = np.where(above, inside[0], middle), np.where(above, middle, inside[1])
            edge[:] = at(inside[0])["s_chi"].to_value(u.deg)
        fit = (low < s_chi + 0.05) & (high > s_chi - 0.05)
        assert fit.any(), (s_p, s_chi)
        # the largest errors are those of the J band, as the paper says
        if s_p == 0.12:
            assert (np.flatnonzero(fit) < 5).all(), (s_p, s_chi)


# --- targets of a calibration ----------------------------------------------------------


def _calibration(tables, chains, wavelength=LAM):
    """What the accuracies of a calibration are made of: sources, tables and chains."""
    records = [SimpleNamespace(source=source, accuracy=table) for source, table in tables]
    return SimpleNamespace(datasets=records, chains=chains, wavelength=wavelength)


SOURCES = {
    "polarized": "polarized",
    "unpolarized": "unpolarized",
    "unpolarized standard star": "on_sky",
    "Unpolarized, on sky": "on_sky",
}


def test_kind_of_calibration_follows_from_the_source(chain):
    for source in SOURCES:
        cal = _calibration([(source, accuracy(1, 2, 3))], [chain])
        (table,) = paper_accuracies(cal, [(0.1, 15 * u.deg)])
        kind = SOURCES[source]
        assert table.meta["missing"] == [
            k for k in ("polarized", "unpolarized", "on_sky") if k != kind
        ]
        assert "lower limits" in table.meta["words"]
        parts = {"polarized": "s_rel", "unpolarized": "s_unpol", "on_sky": "s_sky"}
        for one, column in parts.items():
            expected = [1, 2, 3] if one == kind else [np.nan] * 3
            np.testing.assert_allclose(percent(table[column]), expected)
        both = ([1, 2, 3], 0.0) if kind == "polarized" else (0.0, [1, 2, 3])
        expected = propagate_accuracy(0.1, 15 * u.deg, *(part * u.percent for part in both))
        np.testing.assert_allclose(table["s_p"], expected["s_p"])


def test_a_source_that_is_not_stated_is_told_by_its_polarizer(chain):
    known = _calibration([(None, accuracy(1, 2, 3))], [chain])
    assert "polarized" not in paper_accuracies(known)[0].meta["missing"]
    for source, train in (
        (None, chain["hwp"]),
        ("polarized standard star", chain),
        ("moon on sky", chain),
    ):
        assert paper_accuracies(_calibration([(source, accuracy(1, 2, 3))], [train])) == []


def test_default_targets_are_the_paper_s_at_any_angle(chain):
    tables = [("polarized", accuracy(1, 2, 3)), ("unpolarized", accuracy(0.3, 0.04, 0.5)),
              ("unpolarized standard star", accuracy(0.4, 0.03, 1.2))]  # fmt: skip
    cal = _calibration(tables, [chain] * 3)
    found = paper_accuracies(cal)
    assert [table.meta["dolp"] for table in found] == [1 * u.percent, 30 * u.percent]
    for table in found:
        np.testing.assert_allclose(percent(table["s_abs"]), [0.5, 0.05, 1.3])
        each = [
            propagate_accuracy(table.meta["dolp"], angle * u.deg, table["s_rel"], table["s_abs"])
            for angle in np.linspace(-90, 90, 721)
        ]
        for key in ("s_Q", "s_U", "s_p", "s_chi"):
            worst = np.max([one[key].value for one in each], axis=0)
            np.testing.assert_allclose(table[key].value, worst, rtol=1e-12)


def test_several_calibrations_of_a_kind_count_by_their_rms(chain):
    first, second = accuracy(3, 2, np.nan), accuracy(4, wavelength=LAM[:1])
    cal = _calibration([("polarized", first), ("polarized", second)], [chain] * 2)
    (table,) = paper_accuracies(cal, [(1.0, 0 * u.deg)])
    np.testing.assert_allclose(percent(table["s_rel"]), [np.sqrt(12.5), 2, np.nan])
    assert np.isnan(table["s_p"][2])


def test_impossible_targets_of_a_calibration_are_refused(chain):
    cal = _calibration([("polarized", accuracy(1, 2, 3))], [chain])
    for target in ((2.0, None), (np.nan, None), (0.5, 1 * u.um)):
        with pytest.raises(ParameterError):
            paper_accuracies(cal, [target])


def _scatter_of_star(observations):
    pairs = observations.pairs()
    fluxes = (
        f.T[:, pairs.T].transpose(1, 0, 2)
        for f in (observations.flux_right, observations.flux_left)
    )
    x = get_observable("normalized_double_difference").evaluate(*fluxes).T
    plate = np.rint(np.rad2deg(observations.position("hwp"))[pairs[:, 0]]) == 0
    altitude = observations.position("altitude")[pairs[:, 0]]
    lines = np.stack([np.ones_like(altitude), altitude - altitude.mean()], axis=1)
    design = np.hstack([lines * plate[:, None], lines * ~plate[:, None]])
    residuals = x - design @ np.linalg.lstsq(design, x, rcond=None)[0]
    n = len(pairs)
    return 100 * np.sqrt(np.sum(residuals**2, axis=0) / (n - 4) / n)


# --- groups -------------------------------------------------------------------------


def test_cycles_end_where_an_angle_comes_again(make, chain):
    data = make.observe(chain, make.frames([45, 45, 45, 80] * u.deg), LAM, seed=1)
    m = Measurement(chain, data)
    np.testing.assert_array_equal(groups_by(m, "cycle")[m.bins == 0], np.repeat(np.arange(4), 4))
    assert sorted(set(groups_by(m, "derotator"))) == [0, 1]
    # that of a modulator holds both states
    frames = make.frames([45, 45] * u.deg)
    frames = frames[np.repeat(np.arange(16), 2)]
    frames["flc_state"] = np.tile(["A", "B"], 16)
    m = Measurement(chain, make.observe(chain, frames, LAM, seed=1))
    groups = groups_by(m, "cycle")
    assert np.bincount(groups[m.bins == 0]).tolist() == [8, 8]
    # cycles may be given
    frames = make.frames([45, 80, 110] * u.deg)
    frames["cycle"] = np.repeat([7, 7, 3], 8)
    m = Measurement(chain, make.observe(chain, frames, LAM, seed=1))
    assert np.bincount(groups_by(m, "cycle")).tolist() == [4 * 3, 8 * 3]


def test_datasets_are_groups(make, chain, measurement):
    other = make.observe(chain, wavelength=LAM, seed=2)
    both = Measurement(chain, [measurement.datasets[0].observations, other])
    np.testing.assert_array_equal(groups_by(both, "dataset"), np.repeat([0, 1], 96))
    assert len(set(groups_by(both, "derotator"))) == 16
    # groups by derotator are those of the accuracy
    np.testing.assert_array_equal(groups_by(measurement), leave_out_groups(measurement))


def test_groups_with_a_single_member_are_named(make, chain, measurement):
    data = measurement.datasets[0].observations
    pairs = data.pairs()
    keep = np.concatenate([pairs[:9].ravel(), pairs[12:].ravel()])
    few = Measurement(chain, data.select(keep))
    message = r"group derotator 70 deg of simulated has a single member"
    with pytest.raises(FitError, match=message):
        groups_by(few, "derotator")
    with pytest.raises(FitError, match="group cycle number 2 of simulated has a single member"):
        groups_by(few, "cycle")
    # a night
    night = measurement.datasets[0].observations
    pair = night.pairs()[0]
    short = night.select(pair)
    both = Measurement(chain, [night, make.observe(chain, wavelength=LAM, seed=2).select(pair)])
    with pytest.raises(FitError, match="group dataset number 1 of simulated has a single member"):
        groups_by(both, "dataset")
    with pytest.raises(FitError, match="all data are in one group"):
        groups_by(Measurement(chain, short), "dataset")
    # one group and unknown groups are refused
    with pytest.raises(FitError, match="all data are in one group, dataset number 0"):
        groups_by(measurement, "dataset")
    with pytest.raises(FitError, match="groups = 'moon'; allowed are derotator, cycle, dataset"):
        groups_by(measurement, "moon")


def test_nights_predict_each_other(make, chain, measurement):
    nights = [measurement.datasets[0].observations, make.observe(chain, wavelength=LAM, seed=2)]
    cal = calibrate(chain, nights, cross_validate=False).cross_validate("dataset")
    for i, other in ((0, 1), (1, 0)):
        alone = calibrate(chain, nights[other], cross_validate=False)
        residuals = alone.measurement_of(nights[i]).residuals()
        rms = [np.sqrt(np.mean(residuals[cal.measurement.bins[:96] == b] ** 2)) for b in range(3)]
        found = percent(cal.datasets[i].accuracy["s_cv"])
        np.testing.assert_allclose(found, 100 * np.array(rms), rtol=1e-4)
