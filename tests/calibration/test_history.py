# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibrations over the years: what changed, how surely, and refits of that alone."""

import dataclasses
import warnings

import astropy.units as u
import numpy as np
import pytest
from scipy import stats

from astropolcal import calibrate, instruments
from astropolcal.calibration import target_accuracies
from astropolcal.chain import leaves
from astropolcal.converters.calibration import content_hash
from astropolcal.exceptions import (
    AstropolcalError,
    AstropolcalWarning,
    FitError,
    InstrumentError,
    ParameterError,
)
from astropolcal.measurement import Normal, Tie
from astropolcal.observations import Observations
from astropolcal.pipeline.history import (
    Change,
    _log_p,
    changes,
    courses,
    parameter_history,
    restart,
    significance,
)
from astropolcal.pipeline.library import Library
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength[[9, 12, 16]]
DATES = ("2025-02-01", "2025-10-05", "2025-12-10")
FRAMES = half_wave_plate_cycles(derotator=[50, 62.5, 80, 100] * u.deg)


def make_chain(derotator="linear", shift=0.0):
    chain = CHARIS.chain("polarized", ["nbs"], derotator=derotator, wavelength=WAVELENGTH)
    chain["hwp"].theta.fixed = chain["derotator"].theta.fixed = derotator == "linear"
    if shift:
        chain["derotator"].retardance = chain["derotator"].retardance.quantity + shift * u.deg
    return chain


def observe(seed, date, shift=0.0, derotator="linear"):
    meta = CHARIS.published_meta() | {"date": date, "yjh50_dichroic": "out"}
    truth = make_chain(derotator, shift)
    return simulate(truth, WAVELENGTH, FRAMES, seed=seed, meta=meta, name=f"run{seed}")


def fit(table, derotator="linear", **options):
    options = {"instrument": "charis", "search": False, "cross_validate": False} | options
    return calibrate(make_chain(derotator), table, **options)


@pytest.fixture(scope="module")
def years():
    """Three runs; before the last the derotator was recoated."""
    return [fit(observe(i, date, 0.3 * (i == 2))) for i, date in enumerate(DATES)]


# ---- the table ---------------------------------------------------------------------------


def test_table_has_a_row_a_value(years):
    table = parameter_history(years[::-1])
    assert len(table) == 3 * (3 + 2 * 3)
    assert [t.iso[:10] for t in table["date"][::9]] == list(DATES)
    own = table[(table["parameter"] == "derotator.retardance") & (table["calibration"] == "run1")]
    known = years[1].parameter_values()["derotator.retardance"]
    np.testing.assert_array_equal(own["value"], known["value"])
    np.testing.assert_array_equal(own["std"], known["std"])
    assert own["wavelength"].to_value(u.nm) == pytest.approx(WAVELENGTH.value)
    assert set(own["unit"]) == {"deg"}


def test_optic_stands_for_its_parameters_also_fixed_ones(years):
    table = parameter_history(years, ["hwp"])
    assert set(table["parameter"]) == {"hwp.theta", "hwp.w_sio2", "hwp.w_mgf2"}
    assert set(table["fixed"][table["parameter"] == "hwp.theta"]) == {True}
    with pytest.raises(ParameterError, match="no calibration has a parameter 'hwp"):
        parameter_history(years, ["hwp.thickness"])


def test_library_and_unknown_dates(years, tmp_path):
    library = Library(tmp_path)
    for calibration in years:
        library.add(calibration)
    table = parameter_history(library, ["hwp.w_sio2"])
    assert [name.split("_")[2] for name in table["calibration"]] == list(DATES)
    record = dataclasses.replace(years[0].datasets[0], meta={})
    undated = dataclasses.replace(years[0], datasets=[record])
    table = parameter_history([undated, years[1]], ["hwp.w_sio2"])
    assert table["date"].mask.tolist() == [True, False]
    (tmp_path / "bad.asdf").write_bytes(b"#ASDF")
    with pytest.raises(ParameterError, match=r"bad.asdf: truncated"):
        parameter_history(Library(tmp_path))


# ---- significance ------------------------------------------------------------------------


def test_change_is_found_where_it_is(years):
    table = changes(years)
    assert len(table) == 2 * 5
    for row in table:
        changed = row["what"] in ("all", "derotator") and row["before"] == "run1"
        assert (row["sigma"] > 15) == changed, row
        if not changed:
            assert row["sigma"] < 3.5
    words = str(significance(years[1:], ["derotator"]))
    assert words.startswith("derotator.retardance: changed from run1 to run2 at ")
    assert "no change seen" in str(significance(years[:2]))


def test_chi_square_is_that_of_the_difference(years, monkeypatch):
    """Two calibrations, by hand from their covariance matrices."""
    # of errors that rest on the four angles of the derotator, in one of them and so in both
    monkeypatch.setitem(years[0].fit["model_error"], "settings", 4)
    found = significance(years[:2], ["hwp", "derotator"])
    names = found.parameters
    places = [c.covariance.names.index(n) for c in years[:1] for n in names]
    values = [np.array([_value(c, n) for n in names]) for c in years[:2]]
    own = (c.covariance.matrix[np.ix_(places, places)] for c in years[:2])
    total = (1 + 8 / 4) * sum(own)
    difference = values[1] - values[0]
    assert found.chi2 == pytest.approx(difference @ np.linalg.solve(total, difference), rel=1e-6)
    assert found.dof == len(names) == 5
    assert found.p_value == pytest.approx(stats.chi2.sf(found.chi2, 5), rel=1e-9)


def _value(calibration, name):
    row = calibration.parameters[calibration.parameters["name"] == name]
    return row["value"][0]


def test_three_together_are_tested_for_one_value(years):
    found = significance(years, ["wollaston"])
    assert found.dof == 3 * 2
    assert found.sigma < 3.5
    assert significance(years, ["derotator"]).sigma > 10


def equal_runs(seed):
    """Two runs of one instrument whose derotator stands 0.15 deg from each of its four angles."""
    random, chain, found = np.random.default_rng(seed), make_chain(), []
    for i in range(2):
        true = half_wave_plate_cycles(derotator=np.array([45, 67.5, 90, 112.5]) * u.deg)
        stated = np.repeat(true["derotator"].value, 3)
        true["derotator"] += np.repeat(random.normal(0, 0.15, 4), 8) * u.deg
        table = simulate(chain, WAVELENGTH, true, seed=seed + i, name=f"run{i}").to_table()
        table["derotator"] = stated * u.deg
        found.append(fit(Observations.from_table(table, name=f"run{i}")))
    return found


def test_hidden_errors_of_few_settings_are_no_change():
    # 5.6 sigma if the errors counted as known
    assert significance(equal_runs(14)).sigma < 3


@pytest.mark.long
def test_chi_square_is_right_over_many_runs():
    chi2 = []
    for seed in range(20):
        # with errors that rest on no settings
        tables = [observe(1000 * (i + 1) + seed, date) for i, date in enumerate(DATES[:2])]
        pair = [fit(table, errors="white") for table in tables]
        found = significance(pair)
        chi2.append(found.chi2)
    assert found.dof == 9
    # 20 times 9 degrees of freedom
    assert stats.chi2.sf(sum(chi2), 180) > 1e-3
    assert stats.chi2.cdf(sum(chi2), 180) > 1e-3
    assert stats.kstest(chi2, stats.chi2(9).cdf).pvalue > 1e-3


def test_open_directions_do_not_count():
    """Misalignments are known up to a common turn, in which two gauges may differ."""
    free = "elliptical"
    first = fit(observe(1, DATES[0], derotator=free), free)
    turned = make_chain(free)
    turned["hwp"].theta = 1.0 * u.deg
    second = calibrate(
        turned, observe(2, DATES[1], derotator=free), instrument="charis", search=False, gauge=None
    )
    thetas = [c.chain["hwp"].theta.value for c in (first, second)]
    assert abs(thetas[1] - thetas[0]) > 0.1
    found = significance([first, second])
    assert found.n_open >= 1
    assert found.sigma < 4
    alone = significance([first, second], ["hwp.theta"])
    assert (alone.dof, alone.p_value, alone.sigma) == (0, 1.0, 0.0)
    assert "nothing that is determined" in str(alone)


@pytest.mark.slow
def test_what_is_open_in_all_takes_no_more_with_each_run_nor_in_another_gauge():
    """What is open turns a little from fit to fit; of seven runs nothing was left to compare."""
    free, moved, runs = "elliptical", 0.5 * u.deg, []
    for i in range(7):
        truth = make_chain(free)
        if i > 3:
            truth["derotator"].horizontal = truth["derotator"].horizontal.quantity + moved
        meta = CHARIS.published_meta() | {"date": f"202{i}-02-01", "yjh50_dichroic": "out"}
        data = simulate(truth, WAVELENGTH, FRAMES, seed=i, meta=meta, name=f"run{i}")
        start, gauge = make_chain(free), "minimal"
        if i == 1:
            start["hwp"].theta, gauge = 3.0 * u.deg, None
        runs.append(calibrate(start, data, instrument="charis", search=False, gauge=gauge))
    assert abs(runs[1].chain["hwp"].theta.value - runs[0].chain["hwp"].theta.value) > 1
    for k in range(2, 8):
        found = significance(runs[:k])
        assert (found.n_open, found.dof) == (2, 15 * (k - 1))
        assert (found.sigma > 15) == (k > 4), found
        assert (found.sigma < 4) == (k < 5), found
    (row,) = courses(runs, ["derotator"])
    assert row["course"] == "steps"
    assert row["when"] == "2023-02-01 to 2024-02-01"


def test_what_a_prior_closes_does_not_count():
    """All optics turned by a degree: only the prior says where they are, and always the same."""
    found = []
    for i, turn in enumerate((0.0, 1.0)):
        truth, start = make_chain(), make_chain()
        for name in ("calibration_polarizer", "hwp", "derotator", "wollaston"):
            truth[name].theta = truth[name].theta.quantity + turn * u.deg
            start[name].theta.fixed = False
        start["wollaston"].theta.bounds = (-5, 5)
        start["wollaston"].theta.prior = Normal(0 * u.deg, 0.5 * u.deg)
        data = simulate(truth, WAVELENGTH, FRAMES, seed=i, name=f"run{i}")
        found.append(calibrate(start, data, search=False, cross_validate=False))
    assert "by priors" in found[0].parameters["status"]
    told = significance(found, ["calibration_polarizer.theta"])
    assert (told.dof, told.n_open) == (0, 1)
    assert significance(found).n_open == 1
    assert significance(found, ["hwp"]).dof == 2


def test_probability_far_in_the_tail():
    for dof in (1, 4, 24):
        for chi2 in (dof, 80.0, 900.0):
            assert _log_p(chi2, dof) == pytest.approx(stats.chi2.logsf(chi2, dof), rel=1e-6)
        # beyond what a float holds, and without a step
        near, far = _log_p(1300.0, dof), _log_p(1400.0, dof)
        assert far == pytest.approx(near - 50 + (dof / 2 - 1) * np.log(1400 / 1300), rel=2e-3)
    one = Change(["a", "b"], ["m3.diattenuation"], 36.0, 1, 2e-9)
    assert one.sigma == pytest.approx(6.0, rel=1e-6)


def test_what_cannot_be_compared(years):
    with pytest.raises(FitError, match="1 calibration: at least two"):
        significance(years[:1])
    with pytest.raises(FitError, match="at least two"):
        changes(years[:1])
    again = dataclasses.replace(years[0], settings=dict(years[0].settings))
    with pytest.raises(FitError, match="run0 and run0 were both made from run0"):
        significance([years[0], again])
    with pytest.raises(ParameterError, match="run0: no free parameter 'hwp"):
        significance(years, ["hwp.theta"])
    other = dataclasses.replace(years[0], wavelength=years[0].wavelength * 1.01)
    with pytest.raises(ParameterError, match="different wavelengths"):
        significance([other, years[1]])
    assert significance([other, years[1]], ["hwp"]).dof == 2


def test_values_at_a_bound_are_left_out(years):
    stuck = dataclasses.replace(years[0], at_bound=["wollaston.efficiency[1]"])
    found = significance([stuck, years[1]], ["wollaston"])
    assert found.left_out == ["wollaston.efficiency[1]"]
    assert found.dof == 2


# ---- refit what changed ------------------------------------------------------------------


def test_restart_frees_what_is_named_and_holds_the_rest(years):
    new = restart(years[0], observe(7, "2026-03-01", 0.3), ["derotator"], cross_validate=False)
    assert new.covariance.names == [f"derotator.retardance[{i}]" for i in range(3)]
    for old, now in zip(leaves(years[0].chain), leaves(new.chain), strict=True):
        for key in old.param_names:
            same = np.array_equal(getattr(old, key).value, getattr(now, key).value)
            assert same == (f"{old.name}.{key}" != "derotator.retardance")
    moved = new.chain["derotator"].retardance.value - years[0].chain["derotator"].retardance.value
    assert np.abs(moved - 0.3).max() < 0.1
    told = {"from": content_hash(years[0]), "free": ["derotator"], "date": DATES[0]}
    assert new.settings["restarted"] == told
    assert not years[0].chain["hwp"].w_sio2.fixed
    assert new.converged


@pytest.mark.slow
def test_what_is_held_errs_on_sky_as_before(years, tmp_path):
    """The orientation of the lamp's polarizer is nothing to the sky."""
    targets = [(p * u.percent, None) for p in (30, 1, 0.1)]
    # an error of the model is that of the data, which are others
    fit_of_old = {key: x for key, x in years[0].fit.items() if key != "model_error"}
    old = target_accuracies(dataclasses.replace(years[0], fit=fit_of_old), targets)
    new, lamp = years[0], "calibration_polarizer.theta"
    for seed in (7, 8):
        new = restart(new, observe(seed, "2026-03-01"), [lamp], cross_validate=False)
        new.fit["model_error"] |= {"relative_percent": [0.0] * 3, "absolute_percent": [0.0] * 3}
        for before, after in zip(old, target_accuracies(new, targets), strict=True):
            for key in ("s_p", "s_chi"):
                assert np.all(before[key] > 0)
                np.testing.assert_allclose(after[key], before[key], rtol=0.3)
            assert "those of what was held" in after.meta["words"]
    new.write(tmp_path / "new.asdf")
    assert type(new).read(tmp_path / "new.asdf").fit["model_error"] == new.fit["model_error"]


def test_what_was_open_is_not_known_because_it_is_held():
    wavelength = CHARIS.wavelength[::8]
    chain = CHARIS.chain(wavelength=wavelength)
    frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    first, second = (simulate(chain, wavelength, frames, seed=seed) for seed in (2, 3))
    old = calibrate(chain, first, cross_validate=False)
    assert "AoLP on sky is open" in old.verdict().words[0]
    found = restart(old, second, ["hwp.theta"], cross_validate=False).verdict()
    assert not found.usable
    assert "open in the calibration before: calibration_polarizer.theta" in found.reasons[0]
    assert "unknown" in found.words[1]
    # of a calibration without anything open the errors are those of a part
    chain = CHARIS.chain(wavelength=wavelength, derotator="linear")
    old = calibrate(chain, simulate(chain, wavelength, frames, seed=2), cross_validate=False)
    new = simulate(chain, wavelength, frames, seed=4)
    # of the efficiency the angle on sky does not depend, which does not make it unknown
    for free in ("hwp.theta", "wollaston"):
        found = restart(old, new, [free], cross_validate=False).verdict()
        assert found.usable, free
        assert found.cautions == ["errors of parameters lack those of what is held"]


def test_change_about_a_restart_is_said_to_be_unsure(years):
    """What it holds errs too: 55 to 95 of 100 comparisons with a third one said changed."""
    new = restart(years[0], observe(7, "2026-03-01"), ["derotator"], cross_validate=False)
    for other in years[:2]:
        with pytest.warns(AstropolcalWarning, match="whose errors are not in its own"):
            changes([other, new], ["derotator"])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        changes(years[:2], ["derotator"])


def test_restart_of_a_parameter_and_from_a_file(years, tmp_path):
    from astropolcal.pipeline.loading import load

    years[0].write(tmp_path / "old.asdf")
    new = restart(load(tmp_path / "old.asdf"), observe(7, "2026-03-01"), "HWP.theta")
    assert new.covariance.names == ["hwp.theta"]
    new.write(tmp_path / "new.asdf")
    assert load(tmp_path / "new.asdf").calibration.settings["restarted"]["free"] == ["HWP.theta"]


def test_new_star_brings_its_own_parameters(years):
    meta = CHARIS.published_meta() | {"yjh50_dichroic": "out", "source": "star", "object": "HD 1"}
    frames = FRAMES.copy()
    frames["altitude"] = np.linspace(40, 70, len(frames)) * u.deg
    frames["parallactic"] = np.linspace(-60, 40, len(frames)) * u.deg
    truth = CHARIS.chain(
        "star", ["nbs"], derotator="linear", wavelength=WAVELENGTH, star="star_HD1"
    )
    table = simulate(truth, WAVELENGTH, frames, seed=3, meta=meta | {"date": "2026-03-01"})
    new = restart(years[0], table, ["m3"], cross_validate=False)
    assert {name.partition("[")[0] for name in new.covariance.names} == {
        "star_HD1.q", "star_HD1.u", "m3.diattenuation", "m3.theta",
    }  # fmt: skip


@pytest.mark.slow
def test_a_mirror_that_no_new_frame_saw_is_not_known_as_it_was(years):
    """Published values took its place, with the errors that the old ones had: off by 30 of them."""
    stars, meta = FRAMES.copy(), CHARIS.published_meta() | {"yjh50_dichroic": "out"}
    stars["altitude"] = np.linspace(40, 70, len(stars)) * u.deg
    stars["parallactic"] = np.linspace(-60, 40, len(stars)) * u.deg
    stars["hwp_true"] = stars["hwp"] + 0.5 * stars["parallactic"] + stars["altitude"]
    kind = {"source": "unpolarized standard star"}
    chains = [
        make_chain(),
        CHARIS.chain(*kind.values(), ["nbs"], derotator="linear", wavelength=WAVELENGTH),
    ]
    chains[1]["hwp"].theta.fixed = chains[1]["derotator"].theta.fixed = True
    star = simulate(chains[1], WAVELENGTH, stars, seed=1, meta=meta | kind | {"date": DATES[1]})
    tables = [observe(2, DATES[1]), star]
    positions = [CHARIS.positions(*pair) for pair in zip(tables, chains, strict=True)]
    old = calibrate(chains, tables, positions=positions, instrument="charis", cross_validate=False)
    new = observe(3, "2025-11-10")
    how = {"chain": chains, "cross_validate": False}
    with_star = restart(old, [new, star], ["wollaston"], **how)
    assert with_star.verdict().usable
    cautions = with_star.verdict().cautions
    assert any(f"of what is held, as of {DATES[1]}" in one for one in cautions)
    np.testing.assert_array_equal(
        with_star.chains[1]["m3"].diattenuation, old.chains[1]["m3"].diattenuation
    )
    how["chain"] = make_chain()
    alone = restart(old, new, ["wollaston"], **how)
    for one in (alone, restart(alone, observe(4, "2025-11-12"), ["hwp"], **how)):
        assert one.verdict().reasons[0] == "none of these data saw m3: add the star's table"
        assert "unknown" in one.verdict().words[1]
        assert one.settings["restarted"]["date"] == DATES[1]


def test_restart_keeps_ties_of_what_is_free(years):
    tie = {"derotator.theta": Tie("hwp.theta", 0.5)}
    chain = make_chain()
    chain["hwp"].theta.fixed = False
    old = calibrate(chain, observe(1, DATES[0]), ties=tie, instrument="charis", search=False)
    held = restart(old, observe(7, "2026-03-01"), ["wollaston"])
    assert held.ties == {}
    assert held.chain["derotator"].theta.value == old.chain["derotator"].theta.value
    free = restart(old, observe(7, "2026-03-01"), ["hwp.theta"])
    assert list(free.ties) == ["derotator.theta"]


def test_restart_takes_positions_that_are_given(years, monkeypatch):
    table, chain = observe(7, "2026-03-01"), make_chain()
    given = [CHARIS.positions(table, chain)]
    usual = restart(years[0], table, ["derotator"], positions=None, cross_validate=False)

    def cannot(*arguments):
        raise InstrumentError("no positions of this table")

    monkeypatch.setattr(type(CHARIS), "positions", cannot)
    new = restart(years[0], table, ["derotator"], positions=given, cross_validate=False)
    np.testing.assert_array_equal(
        new.chain["derotator"].retardance, usual.chain["derotator"].retardance
    )


def test_restart_on_bad_input(years):
    table = observe(7, "2026-03-01")
    with pytest.raises(ParameterError, match="free: no 'm3' in the chains; optics are "):
        restart(years[0], table, ["m3"])
    with pytest.raises(FitError, match="nothing to fit"):
        restart(years[0], table, [])
    with pytest.raises(ParameterError, match="1 chains for 2 datasets"):
        restart(years[0], [table, table], ["hwp"], chain=make_chain())
    other = CHARIS.wavelength[[8, 12, 16]]
    chain = CHARIS.chain("polarized", ["nbs"], derotator="linear", wavelength=other)
    meta = table.meta
    shifted = simulate(chain, other, FRAMES, seed=3, meta=meta)
    with pytest.raises(AstropolcalError, match="wavelength"):
        restart(years[0], shifted, ["hwp"])
