# Licensed under a 3-clause BSD style license - see LICENSE
"""Mirrors beside metals, and stars against the catalogue."""

import json
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from star_data import CHARIS, WAVELENGTH, observe_star, star_chain

from astropolcal import Calibration, calibrate, instruments, standards
from astropolcal.calibration import star_check
from astropolcal.calibration.result.summary import summary, to_dict
from astropolcal.calibration.uncertainty.derived import mirror_names, mirror_values
from astropolcal.calibration.validation.stars import add_star_check
from astropolcal.chain import leaves, replace_optic
from astropolcal.exceptions import (
    AstropolcalWarning,
    ChainError,
    FitError,
    InstrumentError,
    ObservationError,
)
from astropolcal.instruments.telescope import k_mirror, star_source
from astropolcal.optics import MetalMirror, PowerLawMirror
from astropolcal.plotting import plot_mirrors, plot_star_check, plot_target_accuracy, save_all
from astropolcal.simulation import half_wave_plate_cycles, simulate


def only(chain, name, keys):
    for leaf in leaves(chain):
        for key in leaf.param_names:
            getattr(leaf, key).fixed = leaf.name != name or key not in keys
            getattr(leaf, key).prior = getattr(leaf, key).prior if leaf.name == name else None
    return chain


def calibrated(m3, keys, **values):
    chain = only(star_chain(m3=m3), "m3", keys)
    truth = chain.copy()
    for key, value in values.items():
        setattr(truth["m3"], key, value)
    return calibrate(chain, observe_star(truth, 12, seed=1), cross_validate=False), truth


@pytest.fixture(scope="module")
def free():
    return calibrated("free", ["diattenuation"], diattenuation=[0.017, 0.014, 0.012])


@pytest.fixture(scope="module")
def metal():
    return calibrated("metal", ["n_scale"], n_scale=2.0)


def test_values_of_a_mirror_free_at_each_wavelength(free):
    cal, truth = free
    table = mirror_values(cal, "m3")
    off = table["diattenuation"].value - 100 * truth["m3"].diattenuation.value
    assert (np.abs(off) < 4 * table["diattenuation_err"].value).all()
    assert table.meta["held"]
    assert np.isnan(table["retardance_err"]).all()


def test_values_of_a_law_have_errors(metal):
    cal, truth = metal
    table = mirror_values(cal, "m3")
    for key, true in (
        ("diattenuation", 100 * truth["m3"].diattenuation(cal.wavelength)),
        ("retardance", truth["m3"].retardance(cal.wavelength).to_value(u.deg)),
    ):
        std = table[f"{key}_err"].value
        assert (std > 0).all()
        assert (np.abs(table[key].value - true) < 4 * std).all()


def test_slopes_of_a_law_are_those_of_differences():
    for make in [PowerLawMirror, MetalMirror]:
        mirror = make(incidence=50 * u.deg)
        values = {"film_thickness": 60 * u.nm} if make is MetalMirror else {}
        mirror = mirror.with_parameters(**values)
        slopes = {law: found for law, (_, found) in mirror._laws_at(WAVELENGTH).items()}
        for key in mirror.own_names:
            parameter, ends = getattr(mirror, key), []
            step, unit = 1e-5 * max(abs(parameter.value), 1), parameter.unit or 1
            for sign in (1, -1):
                moved = mirror.with_parameters(**{key: (parameter.value + sign * step) * unit})
                ends.append((moved.diattenuation(WAVELENGTH), moved.retardance(WAVELENGTH).value))
            for name, high, low in zip(slopes, *ends, strict=True):
                np.testing.assert_allclose(
                    slopes[name][key], (high - low) / (2 * step), rtol=1e-4, atol=1e-9
                )


def test_mirror_without_a_film_has_errors():
    """The thickness ends at or next to zero, below which there is nothing."""
    cal, _ = calibrated("metal", ["n_scale", "film_thickness"], film_thickness=0 * u.nm)
    table = mirror_values(cal, "m3")
    assert np.isfinite(table["diattenuation"].value).all()


def test_metals_are_bare_mirrors(free):
    table = mirror_values(free[0], "m3", incidence=40 * u.deg)
    silver = MetalMirror(material="silver", incidence=40 * u.deg)
    np.testing.assert_allclose(
        table["diattenuation_silver"].value, 100 * silver.diattenuation(free[0].wavelength)
    )


def test_plates_derotators_and_relays_are_not_mirrors():
    for name, source, mirrors in (
        ("irdis", "star", ["ut", "m4"]),
        ("vampires", "unpolarized", ["fold_mirror"]),
        ("charis", "star", ["m3"]),
    ):
        chains = [instruments.get(name).chain(source)]
        assert mirror_names(SimpleNamespace(chains=chains)) == mirrors, name


def test_unknown_mirror_is_refused(free):
    assert mirror_names(free[0]) == ["m3"]
    with pytest.raises(ChainError, match="no mirror 'm4'; the calibration has m3"):
        mirror_values(free[0], "m4")


def test_summary_and_json_have_the_mirrors(free):
    text = summary(free[0], full=True)
    assert "Diattenuation in percent; the metals bare, at 45 deg" in text
    (entry,) = to_dict(free[0])["mirrors"]
    assert entry["name"] == "m3"
    assert entry["retardance_err_deg"] == [None] * 3
    json.dumps(entry, allow_nan=False)


@pytest.mark.slow
def test_figures_of_mirrors_and_targets(free, metal, tmp_path, unpainted):
    top, bottom = plot_mirrors(free[0]).axes
    lines = " ".join(str(line.get_label()) for line in top.get_lines())
    assert all(metal in lines for metal in ("silver", "gold", "aluminium"))
    assert bottom.get_ylabel() == "retardance (°)"
    assert len(plot_mirrors(metal[0], reference={}).axes) == 2
    assert len(plot_target_accuracy(free[0]).axes) == 3
    found = {path.name for path in save_all(free[0], tmp_path)}
    assert {"mirrors.png", "targets.png"} <= found


# --- a star that no fit saw -------------------------------------------------------------------


def night(truth, name="HD 30675", scale=1.0, cycles=6, **options):
    known = standards.get(name).stokes(WAVELENGTH)
    chain = replace_optic(truth, "star", star_chain("star")["star"])
    chain["star"].q, chain["star"].u = scale * known.q, scale * known.u
    options = {"parallactic": (10, 60), "source": "polarized standard star"} | options
    return observe_star(chain, cycles, target=name, **options)


@pytest.mark.slow
def test_a_standard_comes_out_as_the_catalogue_has_it(free):
    cal, truth = free
    table = star_check(cal, star_chain("star"), night(truth, seed=3))
    known = standards.get("HD 30675").stokes(WAVELENGTH)
    np.testing.assert_allclose(table["q_known"].to_value(u.one), known.q)
    np.testing.assert_allclose(table["dolp_error"].to_value(u.percent), 0, atol=0.05)
    np.testing.assert_allclose(table["aolp_error"].to_value(u.deg), 0, atol=2.5)
    assert (table["dolp_known_err"].to_value(u.percent) > 0.01).all()
    assert table.meta["star"] == "HD 30675"


def test_a_star_that_is_not_as_the_catalogue_has_it(free):
    cal, truth = free
    table = star_check(cal, star_chain("star"), night(truth, scale=2.0, seed=3))
    known = table["dolp_known"].to_value(u.percent)
    np.testing.assert_allclose(table["dolp_error"].to_value(u.percent), known, atol=0.05)


def test_only_errors_that_are_known_are_named(free):
    """A single cycle has no scatter, and a wavelength may have no cycle."""
    cal, truth = free
    star = night(truth, seed=3)
    masked = star.with_mask(np.arange(len(WAVELENGTH)) == np.ones((star.n_frames, 1)), "cloud")
    table = star_check(cal, star_chain("star"), masked)
    assert np.isfinite(table["dolp_err"]).tolist() == [True, False, True]
    assert np.isfinite(table["dolp_error"]).tolist() == [True, False, True]
    for cycles in (6, 1):
        ends = {"parallactic": (10, 10 + 8 * cycles), "altitude": (55, 55 + 2 * cycles)}
        star = night(truth, seed=3, cycles=cycles, **ends)
        table = star_check(cal, star_chain("star"), star)
        assert np.isfinite(table["dolp_err"]).all() == (cycles > 1)
        whose = "star, calibration and catalogue" if cycles > 1 else "calibration and catalogue"
        assert table.meta["words"].count(f"times the errors of {whose}") == 2


@pytest.mark.slow
def test_check_is_kept_in_file_summary_and_json(free, tmp_path):
    cal, truth = free
    add_star_check(cal, star_chain("star"), night(truth, seed=3))
    add_star_check(cal, star_chain("star"), night(truth, seed=3))
    assert len(cal.fit["stars"]) == 1
    cal.write(tmp_path / "cal.asdf")
    back = Calibration.read(tmp_path / "cal.asdf")
    assert back.fit["stars"] == cal.fit["stars"]
    assert "HD 30675 against the catalogue" in summary(back, full=True)
    assert to_dict(back)["stars"][0]["dolp_percent"] == cal.fit["stars"][0]["dolp_percent"]
    assert len(plot_star_check(back).axes) == 4


def test_what_is_no_check_is_refused(free):
    cal, truth = free
    fitted = observe_star(truth, 12, seed=1)
    with pytest.raises(FitError, match="not an independent standard"):
        star_check(cal, star_chain("star"), fitted)
    nameless = observe_star(truth, 6, seed=5, target=None)
    with pytest.raises(ObservationError, match="no entry 'object'"):
        star_check(cal, star_chain("star"), nameless)


def test_no_star_no_figure(metal):
    with pytest.raises(ObservationError, match="checked with no star"):
        plot_star_check(metal[0])


# --- standards that the table names -----------------------------------------------------------


def test_unknown_polarized_standard_is_refused():
    with pytest.raises(InstrumentError, match="HD 999999 as a polarized standard star"):
        star_source("polarized standard star", WAVELENGTH, target="HD 999999")


def test_unknown_unpolarized_standard_is_taken_at_its_word():
    with pytest.warns(AstropolcalWarning, match="unpolarized according to the table"):
        star = star_source("unpolarized standard star", WAVELENGTH, target="HD 999999")
    assert float(star.q.prior.std()) == pytest.approx(1e-3)


def test_standard_of_the_other_kind_is_refused():
    with pytest.raises(InstrumentError, match="HD 30675 is polarized according to the catalogue"):
        star_source("unpolarized standard star", WAVELENGTH, target="HD 30675")


# --- the derotator as three mirrors -----------------------------------------------------------


def test_k_mirror_comes_back():
    frames = half_wave_plate_cycles(derotator=[45, 58, 70, 85, 100, 116] * u.deg)
    chain = CHARIS.chain(derotator="kmirror")
    truth = chain.copy()
    truth["derotator"].film_thickness = 255 * u.nm
    truth["derotator"].n_scale, truth["derotator"].k_scale = 1.3, 0.95
    truth["derotator"].theta = 0.4 * u.deg
    data = simulate(truth, CHARIS.wavelength, frames, seed=2)
    cal = calibrate(chain, data, cross_validate=False)
    assert cal.converged
    known = cal.parameter_values()
    for key, true in (
        ("film_thickness", 255), ("n_scale", 1.3), ("k_scale", 0.95), ("theta", 0.4)
    ):  # fmt: skip
        entry = known[f"derotator.{key}"]
        assert abs(entry["value"] - true) < 4 * entry["std"]
    assert known["derotator.film_thickness"]["std"] < 0.1


def test_k_mirror_is_free_where_it_should_be():
    mirror = k_mirror(fixed={"theta": False}, bounds={"theta": (-5, 5)}, name="derotator")
    free = {key for key in mirror.param_names if not getattr(mirror, key).fixed}
    assert free == {"theta", "film_thickness", "n_scale", "k_scale"}
    assert mirror.n_scale.prior.std() == 0.5
    assert mirror.theta.bounds == (-5, 5)
