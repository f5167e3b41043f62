# Licensed under a 3-clause BSD style license - see LICENSE
"""A calibration file gives back what was written, or says in one line why not."""

import dataclasses
import io
from importlib.util import find_spec

import asdf
import astropy.units as u
import numpy as np
import pytest

from astropolcal import Calibration, calibrate, optics
from astropolcal.calibration.posterior import Posterior
from astropolcal.calibration.result.calibration import DatasetRecord
from astropolcal.calibration.uncertainty.covariance import Covariance
from astropolcal.chain import join, leaves
from astropolcal.converters.calibration import calibration_from_node, node_from_calibration
from astropolcal.exceptions import CalibrationFileError
from astropolcal.measurement import Normal, Tie
from astropolcal.measurement.parameters import Uniform
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1.2, 1.6, 2.2] * u.um


def make_chain(flip=False):
    """Polarizer, half-wave plate, derotator and Wollaston: 4 + 2 x 3 free parameters."""
    train = [
        optics.LinearPolarizer(
            theta=90 * u.deg, name="polarizer", fixed={"theta": False}, bounds={"theta": (0, None)}
        ),
        optics.TwoLayerWaveplate(
            w_sio2=1.65 * u.mm, w_mgf2=1.29 * u.mm, mount="hwp", name="hwp", fixed={"theta": False}
        ),
        optics.LinearRetarder(
            retardance=[-220, -110, -57] * u.deg, mount="derotator", name="derotator"
        ),
        optics.WollastonPrism(efficiency=[0.97, 0.98, 0.99], name="wollaston"),
    ]
    if flip:
        train.insert(3, optics.ParityFlip(name="flip"))
    return join(train)


def make_nights():
    """Observations of two nights, without and with a flip."""
    frames = half_wave_plate_cycles(derotator=[45, 60, 80, 100] * u.deg)
    metas = ({"date": "2025-05-01", "instrument": "bench"}, {"date": "2025-10-02", "n": 3})
    return [
        simulate(make_chain(flip=i), WAVELENGTH, frames, seed=i, meta=metas[i], name=f"night{i}")
        for i in range(2)
    ]


def make_calibration(**options):
    """Calibrate two nights in two steps, with a tie."""
    chains, nights = [make_chain(), make_chain(flip=True)], make_nights()
    options = {
        "strategy": "two-step",
        "ties": {"derotator.theta": Tie("hwp.theta", 0.5, 0.1 * u.deg)},
        "instrument": "bench",
    } | options
    return calibrate(chains, nights, **options)


@pytest.fixture(scope="module")
def calibration():
    return make_calibration()


def make_posterior(calibration, n_steps=900, **options):
    """Samples about the fit, of two parameters and one of three values of a third."""
    names = ["polarizer.theta", "hwp.w_sio2", "derotator.retardance[1]"]
    places = [calibration.covariance.names.index(name) for name in names]
    units = [calibration.covariance.units[i] for i in places]
    chain = (
        np.random.default_rng(3).normal(size=(n_steps, 8, 3)) * calibration.covariance.stds[places]
    )
    options = {
        "acceptance": np.linspace(0.2, 0.3, 8),
        "fitted": np.zeros(3),
        "thin": 2,
        "seed": 5,
        "settings": {"noise": {"from": "given", "least": 1e-5}, "moves": [["DEMove", 0.8]]},
    } | options
    return Posterior(names, units, chain, -0.5 * np.sum(chain**2, axis=2), **options)


@pytest.fixture(scope="module")
def sampled(calibration):
    """The calibration with a posterior."""
    return dataclasses.replace(calibration, posterior=make_posterior(calibration))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "calibration.asdf"


@pytest.fixture(scope="module")
def content(calibration, tmp_path_factory):
    """Bytes of a good file."""
    path = tmp_path_factory.mktemp("good") / "calibration.asdf"
    calibration.write(path)
    return path.read_bytes()


def assert_same(one, other):
    """Compare all of two calibrations, numbers to the last bit."""
    assert node_from_calibration(one)["checksum"] == node_from_calibration(other)["checksum"]
    assert other.to_dict() == one.to_dict()
    assert other.summary() == one.summary()
    assert other.covariance == one.covariance
    assert other.ties == one.ties


def assert_refused(path, content, message):
    path.write_bytes(content)
    with pytest.raises(CalibrationFileError, match=message) as caught:
        Calibration.read(path)
    text = str(caught.value)
    assert text.startswith(f"{path}: ")
    assert "\n" not in text


def replaced(content, old, new, count=1):
    """Return the file with text replaced; the old text must be there."""
    assert old in content
    return content.replace(old, new, count)


# ---- what comes back -----------------------------------------------------------------


def test_chains_arrays_and_tables_come_back(calibration, path):
    calibration.write(path)
    again = Calibration.read(path)
    for old_chain, new_chain in zip(calibration.chains, again.chains, strict=True):
        for old, new in zip(leaves(old_chain), leaves(new_chain), strict=True):
            assert type(new) is type(old)
            assert new._settings() == old._settings()
            for key in old.param_names:
                a, b = getattr(old, key), getattr(new, key)
                assert np.array_equal(a.value, b.value)
                assert (a.unit, a.fixed, a.bounds) == (b.unit, b.fixed, b.bounds)
    assert again.chain["polarizer"].theta.bounds == (0, None)
    shared = [chain["derotator"].retardance.value for chain in again.chains]
    assert np.array_equal(*shared)
    assert again.wavelength.unit == calibration.wavelength.unit
    assert np.array_equal(again.wavelength, calibration.wavelength)
    for key in ("singular_values", "null_vectors", "identifiable"):
        old, new = (getattr(c.identifiability, key) for c in (calibration, again))
        assert new.dtype == old.dtype
        assert np.array_equal(new, old)
    for old, new in zip(calibration.datasets, again.datasets, strict=True):
        assert new.meta == old.meta
        assert new.content_hash == old.content_hash
        assert new.accuracy.colnames == old.accuracy.colnames
        for name in old.accuracy.colnames:
            np.testing.assert_array_equal(new.accuracy[name], old.accuracy[name])
            assert getattr(new.accuracy[name], "unit", None) == old.accuracy[name].unit
    assert again.measurement is None
    with pytest.raises(CalibrationFileError, match="holds no observations"):
        _ = again.residuals


@pytest.mark.slow
def test_predictions_come_back(calibration, path):
    calibration.write(path)
    frames = half_wave_plate_cycles(derotator=[50, 70] * u.deg)
    new = simulate(make_chain(), WAVELENGTH, frames, seed=5)
    old, again = (c.measurement_of(new).residuals() for c in (calibration, Calibration.read(path)))
    assert np.array_equal(old, again)


@pytest.mark.slow
def test_what_is_not_determined_comes_back(path):
    # one derotator angle, everything free: parameters at bounds, NaN in the covariance
    chain = make_chain()
    chain["derotator"].theta.fixed = False
    frames = half_wave_plate_cycles(derotator=[45] * u.deg)
    table = simulate(chain, WAVELENGTH, frames, seed=3)
    calibration = calibrate(chain, table, search=False, cross_validate=False)
    assert np.isnan(calibration.covariance.matrix).any()
    assert calibration.identifiability.directions
    calibration.write(path)
    again = Calibration.read(path)
    assert_same(calibration, again)
    assert again.identifiability.directions == calibration.identifiability.directions
    assert again.at_bound == calibration.at_bound


def test_chain_of_one_optic_comes_back(path):
    chain = optics.WollastonPrism(efficiency=0.9, name="wollaston")
    frames = half_wave_plate_cycles(derotator=[45, 60] * u.deg)
    table = simulate(chain, WAVELENGTH, frames, seed=3, source=[1, 0.5, 0, 0])
    calibration = calibrate(chain, table, search=False, observable="normalized_single_difference")
    calibration.write(path)
    assert repr(Calibration.read(path).chain) == repr(calibration.chain)


def test_name_of_a_chain_comes_back(calibration, path):
    changed = dataclasses.replace(calibration, chains=[c.copy() for c in calibration.chains])
    changed.chains[0].name = "bench in May"
    changed.write(path)
    assert [chain.name for chain in Calibration.read(path).chains] == ["bench in May", None]


def test_file_of_a_file_is_the_same(calibration, sampled, path):
    for what, cal in {"fit": calibration, "posterior": sampled}.items():
        cal.write(path, overwrite=True)
        content = path.read_bytes()
        assert (b"posterior" in content) == (what == "posterior")
        assert b"priors" not in content, what
        again = Calibration.read(path)
        words = ", 3 sampled" * (what == "posterior")
        assert repr(again).endswith(f"10 free parameters, rank 10{words}>"), what
        again.write(path, overwrite=True)
        assert path.read_bytes() == content, what


def test_no_field_is_forgotten(calibration, sampled):
    fields = {field.name for field in dataclasses.fields(Calibration)} - {"measurement"}
    node = node_from_calibration(sampled)
    message = "write and read every field in converters/calibration.py, and bump the schema"
    posterior = set(sampled.posterior.to_dict()) - {"burn_in"}
    assert set(node["posterior"]) == posterior | {"converged", "words", "kept"}, message
    known = {field.name for field in dataclasses.fields(sampled.posterior.convergence)}
    assert set(node["posterior"]["convergence"]) == known, message
    assert set(node) - {"checksum", "validity", "written_with"} == fields, message
    record = {field.name for field in dataclasses.fields(DatasetRecord)}
    assert set(node["datasets"][0]) == record, message
    tie = {field.name for field in dataclasses.fields(Tie)}
    assert set(node["ties"][0]) == tie | {"target"}, message
    finding = {field.name for field in dataclasses.fields(calibration.identifiability)}
    assert set(node["identifiability"]) == finding, message
    # the open directions go by another name, as null is nothing in YAML
    known = set(vars(calibration.covariance)) - {"null"} | {"open"}
    assert set(node["covariance"]) == known, message
    assert set(node["stages"][0]) == set(calibration.stages[0]), message
    # calibration of the test has what is to be tested
    assert calibration.stages
    assert calibration.ties
    assert len(calibration.datasets) == 2
    assert calibration.fit["seconds"] > 0


# ---- the posterior -------------------------------------------------------------------


@pytest.mark.slow
def test_posterior_comes_back_thinned(sampled, path):
    sampled.write(path)
    again = Calibration.read(path)
    assert_same(sampled, again)
    assert again.posterior == sampled.posterior.thinned()
    assert again.posterior.log_prob.size < 4000 < sampled.posterior.log_prob.size
    assert again.posterior.report() == sampled.posterior.report()
    assert repr(again).endswith("10 free parameters, rank 10, 3 sampled>")


def test_summaries_mention_the_posterior(calibration, sampled):
    assert sampled.to_dict()["posterior"] == sampled.posterior.report()
    first = sampled.posterior.words().splitlines()[0]
    assert first in sampled.summary(full=True)
    assert calibration.to_dict()["posterior"] is None
    assert "walkers" not in calibration.summary(full=True)


@pytest.mark.slow
def test_file_keeps_as_many_samples_as_it_is_told(sampled, path):
    told = dataclasses.replace(sampled, posterior=sampled.posterior.thinned(draws=10**6))
    told.write(path)
    again = Calibration.read(path).posterior
    assert again == told.posterior
    assert again.log_prob.size > 4000


def test_posterior_says_in_the_file_what_it_is(sampled, path):
    sampled.write(path)
    with asdf.open(path, _force_raw_types=True) as file:
        node = file["calibration"]["posterior"]
        assert node["words"] == sampled.posterior.words()
        assert node["kept"].startswith("Of 7152 samples 3576 are kept, one step in 4;")
        assert node["converged"] is True
        assert node["units"] == ["deg", "mm", "deg"]
        assert node["thin"] == sampled.posterior.thinned().thin


def test_posterior_of_a_number_and_without_anything_optional_comes_back(calibration, path):
    chain = 0.9 + 0.01 * np.random.default_rng(1).normal(size=(2, 4, 1))
    posterior = Posterior(["wollaston.efficiency[0]"], [None], chain, chain[..., 0])
    dataclasses.replace(calibration, posterior=posterior).write(path)
    again = Calibration.read(path).posterior
    assert again == posterior.thinned()
    assert again.units == [None]
    assert again.acceptance is None


def test_inconsistent_posterior_is_not_written(sampled, path):
    for change, message in [
        ({"names": ["polarizer.theta", "hwp.colour", "hwp.theta"]}, "posterior of 'hwp.colour'"),
        ({"names": ["hwp.theta", "hwp.w_sio2", "hwp.theta"]}, "a parameter is named twice"),
        ({"units": ["deg", "um", "deg"]}, "posterior of hwp.w_sio2 is in um, allowed is mm"),
        ({"chain": np.full((900, 8, 3), np.nan)}, "samples must be finite"),
        ({"log_prob": np.full((900, 8), -np.inf)}, "log_prob must be finite"),
        ({"settings": {"by": len}}, "posterior.settings.by is a builtin_function_or_method"),
    ]:
        parts = sampled.posterior.to_dict() | change
        with np.errstate(invalid="ignore"):
            changed = dataclasses.replace(sampled, posterior=Posterior.from_dict(parts))
            assert_not_written(changed, path, message)


@pytest.mark.slow
def test_changed_posterior_is_refused(sampled, path):
    sampled.write(path)
    content = path.read_bytes()
    for old, new, message in [
        (b"    converged: true", b"    converged: false", "checksum"),
        (b"seed: 5", b"seed: 6", "checksum"),
        (b"seed: 5", b"seed: five", "invalid at .*posterior.seed"),
        (b"    log_prob:", b"    log_porb:", "invalid at .*posterior"),
        (b"    words: '1800", b"    sworn: '1800", "invalid at .*posterior"),
        (b"    words: '1800", b"    words: '1900", "checksum"),
        (b"    thin: ", b"    thin: -", "invalid at .*posterior.thin"),
        (b"n_draws: ", b"n_draws: -", "invalid at .*n_draws"),
        (b"r_hat: !core/ndarray", b"r_hat: !core/quantity", "unknown kind"),
    ]:
        if old.startswith(b"r_hat") and find_spec("arviz_stats") is None:
            # without it there is no such array in the file
            continue
        assert_refused(path, replaced(content, old, new), message)


def test_inconsistent_posterior_with_a_right_checksum(sampled):
    for change, message in [
        ({"names": ["polarizer.theta", "hwp.w_sio2"]}, "posterior: chain of 2 names and 3 units"),
        (
            {"names": ["polarizer.theta", "hwp.w_sio2", "x"]},
            "posterior of 'x', which is not a free",
        ),
        ({"log_prob": np.zeros((2, 2))}, r"posterior: log_prob has shape \(2, 2\)"),
        ({"acceptance": np.zeros(2)}, r"posterior: acceptance has shape \(2,\)"),
        ({"convergence": {"times": np.full(3, np.inf)}}, "posterior: times must be finite"),
    ]:
        from astropolcal.converters.calibration import _checksum

        node = node_from_calibration(sampled)
        for key, value in change.items():
            inner = node["posterior"][key] if isinstance(value, dict) else {}
            node["posterior"][key] = inner | value if inner else value
        node["checksum"] = _checksum(node)
        with pytest.raises(CalibrationFileError, match=message):
            calibration_from_node(node)


# ---- priors --------------------------------------------------------------------------


def with_priors(**priors):
    """A calibration of one night with priors on what is named ``optic__parameter``."""
    chain = make_chain()
    for name, prior in priors.items():
        optic, key = name.split("__")
        getattr(chain[optic], key).prior = prior
    return calibrate(chain, make_nights()[0], cross_validate=False)


@pytest.mark.slow
def test_priors_come_back(path):
    from scipy.stats import truncnorm

    truncated = truncnorm(-5, 0, loc=1, scale=0.03)
    calibration = with_priors(
        hwp__theta=Normal(0 * u.deg, 6 * u.arcmin),
        hwp__w_sio2=Uniform(1.6 * u.mm, 1.7 * u.mm),
        wollaston__efficiency=truncated,
    )
    calibration.write(path)
    again = Calibration.read(path)
    assert_same(calibration, again)
    assert again.chain["hwp"].theta.prior == Normal(0 * u.deg, 6 * u.arcmin)
    assert again.chain["hwp"].w_sio2.prior == Uniform(1.6 * u.mm, 1.7 * u.mm)
    prior = again.chain["wollaston"].efficiency.prior
    assert prior.logpdf(0.98) == truncated.logpdf(0.98)
    # writing leaves the calibration as it is
    assert calibration.chain["hwp"].theta.prior == Normal(0 * u.deg, 6 * u.arcmin)
    again.write(path, overwrite=True)
    assert_same(calibration, Calibration.read(path))


def test_priors_act_after_reading(path):
    night = make_nights()[0]
    calibration = with_priors(hwp__theta=Normal(0.2 * u.deg, 0.1 * u.deg))
    calibration.write(path)
    again = Calibration.read(path).with_observations(night)
    old, new = calibration.measurement, again.measurement
    assert new.n_priors == old.n_priors == 1
    vector = old.vector() + 1e-4
    assert new.free.prior_residuals(vector) == old.free.prior_residuals(vector)


def test_unreadable_date_of_an_older_file_is_refused(content, path, monkeypatch):
    """Such files could be written once; they would hold from any date on."""
    from astropolcal.calibration.result.calibration import validity_of
    from astropolcal.converters import calibration as converter
    from astropolcal.pipeline import Library

    monkeypatch.setattr(converter, "_checksum", lambda node: node["checksum"])
    path.write_bytes(replaced(content, b"date: '2025-10-02'", b"date: 2 Oct 2025"))
    with pytest.raises(
        CalibrationFileError, match=r"night1: .*'2 Oct 2025' is not a date"
    ) as caught:
        Calibration.read(path)
    assert str(caught.value).startswith(f"{path}: ")
    with pytest.raises(CalibrationFileError, match=rf"{path}: .*'2 Oct 2025' is not a date"):
        Library(path.parent).find(date="2025-11-01")
    # of older files also: what can be read counts, and no date at all is fine
    path.write_bytes(replaced(content, b"date: '2025-10-02'", b"date: '20250102'"))
    assert validity_of(Calibration.read(path)).valid_from == "2025-01-02"


# ---- with the observations again --------------------------------------------------------


@pytest.mark.slow
def test_observations_are_brought_back(calibration, content, path):
    path.write_bytes(content)
    again = Calibration.read(path).with_observations(make_nights()[::-1])
    np.testing.assert_allclose(again.residuals, calibration.residuals, rtol=0, atol=1e-12)
    assert again.measurement.free.names == calibration.measurement.free.names
    assert [d.observations.name for d in again.measurement.datasets] == ["night0", "night1"]
    before = [record.accuracy["s_cv"].copy() for record in again.datasets]
    again.cross_validate()
    for record, old in zip(again.datasets, before, strict=True):
        np.testing.assert_allclose(record.accuracy["s_cv"], old, rtol=1e-4)
    again.write(path, overwrite=True)
    assert_same(again, Calibration.read(path))


@pytest.mark.slow
def test_noise_of_the_fit_is_brought_back(path):
    for weights in [None, "wavelength", "errors", 0.003, [0.002, 0.003, 0.004]]:
        from astropolcal.calibration.noise.weighting import weighting_of

        night = make_nights()[0]
        calibration = calibrate(make_chain(), night, weights=weights, cross_validate=False)
        calibration.write(path, overwrite=True)
        again = Calibration.read(path).with_observations(night)
        old, new = weighting_of(calibration), weighting_of(again)
        assert new.choice == old.choice
        # noise from residuals is found again, to the thousandth at which its rounds end
        np.testing.assert_allclose(new.sigma, old.sigma, rtol=3e-3)


@pytest.mark.slow
def test_reading_again_does_not_change_what_was_read(content, path):
    path.write_bytes(content)
    alone = Calibration.read(path)
    again = alone.with_observations(make_nights())
    again.datasets[0].accuracy["s_cv"] = 1 * u.percent
    again.chain["hwp"].w_sio2 = 1 * u.mm
    assert_same(alone, Calibration.read(path))
    assert alone.measurement is None


def test_observations_are_all_those_of_the_fit(calibration):
    frames = half_wave_plate_cycles(derotator=[45, 60] * u.deg)
    other = simulate(make_chain(), WAVELENGTH, frames, seed=9, name="other")
    message = (
        rf"other: the calibration was not made from this table, whose content hash is "
        rf"{other.content_hash[:12]}; it was made from night0 \([0-9a-f]{{12}}\), night1"
    )
    with pytest.raises(CalibrationFileError, match=message):
        calibration.with_observations([*make_nights(), other])
    message = r"also made from night1 \(content hash [0-9a-f]{12}\): give that table"
    with pytest.raises(CalibrationFileError, match=message):
        calibration.with_observations(make_nights()[0])


def test_stages_elsewhere_than_the_columns_say(path):
    """Positions that a table does not hold must be given again."""
    night = make_nights()[0]
    positions = {
        "hwp": night.position("hwp"),
        "derotator": night.position("derotator") + np.deg2rad(3),
    }
    calibrate(make_chain(), night, positions=[positions], cross_validate=False).write(path)
    again = Calibration.read(path)
    with pytest.raises(CalibrationFileError, match=r"night0: the residuals are not those .*posit"):
        again.with_observations(night)
    assert again.with_observations(night, positions).residuals.size == 48
    with pytest.raises(CalibrationFileError, match="2 positions for 1 tables"):
        again.with_observations(night, [positions] * 2)


def test_file_says_for_what_it_holds(content, path):
    with asdf.open(io.BytesIO(content), _force_raw_types=True) as file:
        node = file["calibration"]
    assert node["validity"] == {
        "instrument": "bench",
        "mode": None,
        "valid_from": "2025-05-01",
        "valid_until": None,
        "optics_in": None,
        "dates": ["2025-05-01", "2025-10-02"],
        "optics_in_beam": [
            ["polarizer", "hwp", "derotator", "wollaston"],
            ["polarizer", "hwp", "derotator", "flip", "wollaston"],
        ],
    }
    assert node["written_with"]["asdf"] == asdf.__version__
    assert set(node["written_with"]) == {"astropolcal", "asdf", "asdf-astropy", "astropy"}
    assert node["datasets"][1]["meta"]["n"] == 3
    # it is no place to state it
    for old, new in (
        (b"valid_until: null", b"valid_until: '2026-01-01'"),
        (b"valid_from: '2025-05-01'", b"valid_from: '2024-05-01'"),
        (b"mode: null", b"mode: H"),
    ):
        before, key, after = content.rpartition(b"\n  validity:")
        assert after.count(old) == 1, old
        path.write_bytes(before + key + after.replace(old, new))
        words = "validity: .* = '.*', but its content says .*: it was changed after"
        with pytest.raises(CalibrationFileError, match=words):
            Calibration.read(path)


@pytest.mark.slow
def test_file_rewritten_with_asdf_in_another_layout_is_the_same(calibration, content, path):
    # all arrays in compressed blocks: other bytes, same content
    with asdf.open(io.BytesIO(content)) as file, asdf.config_context() as config:
        config.array_inline_threshold = 0
        file.write_to(path, all_array_compression="zlib")
    assert path.read_bytes() != content
    assert_same(calibration, Calibration.read(path))


@pytest.mark.slow
def test_works_without_entry_points(calibration, path):
    with asdf.config_context() as config:
        config.remove_extension(package="astropolcal")
        config.remove_resource_mapping(package="astropolcal")
        calibration.write(path)
        assert_same(calibration, Calibration.read(path))


def test_settings_of_the_user_do_not_matter(calibration, path):
    with asdf.config_context() as config:
        config.array_inline_threshold = 10**6
        config.all_array_storage = "external"
        config.validate_on_read = False
        config.warn_on_failed_conversion = True
        calibration.write(path)
        assert_refused(path, replaced(path.read_bytes(), b"unit: deg", b"unit: rad"), "invalid at")
        assert config.all_array_storage == "external"


# ---- what is refused on writing ----------------------------------------------------------


def assert_not_written(calibration, path, message, **options):
    before = sorted(path.parent.iterdir()) if path.parent.is_dir() else None
    with pytest.raises(CalibrationFileError, match=message) as caught:
        calibration.write(path, **options)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)
    if before is not None:
        assert sorted(path.parent.iterdir()) == before


@pytest.mark.slow
def test_existing_file_is_kept(calibration, path):
    path.write_text("precious")
    assert_not_written(calibration, path, "exists already; remove it, name another")
    assert path.read_text() == "precious"
    calibration.write(path, overwrite=True)
    assert_same(calibration, Calibration.read(path))


def test_failure_leaves_nothing(calibration, path):
    def refuse(*args):
        raise PermissionError(13, "Permission denied")

    def stop(self, obj, tag, ctx):
        raise RuntimeError("no more")

    converter = "astropolcal.converters.extension.OpticConverter.to_yaml_tree"
    for place, fail, words in (
        ("os.replace", refuse, "Permission denied"),
        (converter, stop, "RuntimeError: no more"),
    ):
        path.write_text("precious")
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(place, fail)
            assert_not_written(calibration, path, f"cannot be written: {words}", overwrite=True)
        assert path.read_text() == "precious", place


def test_inconsistent_calibration_is_not_written(calibration, path):
    for change, message in [
        ({"at_bound": ["hwp.thickness"]}, "at_bound names 'hwp.thickness'"),
        ({"datasets": []}, "2 chains but 0 datasets"),
        ({"wavelength": [1.2, 1.6] * u.um}, "has 3 values; allowed are 1 or 2"),
        ({"wavelength": 1.2 * u.um}, "must be a list of positive lengths"),
        ({"wavelength": [-1, 1, 2] * u.um}, "must be a list of positive lengths"),
        ({"wavelength": [1, 2, 3] * u.deg}, "invalid at .*wavelength.unit: 'deg' is not one of"),
        ({"ties": {"derotator.theta": Tie("polarizer.retardance")}}, "no parameter 'polarizer"),
        ({"ties": {"hwp.colour": Tie("hwp.theta")}}, "no parameter 'hwp.colour'"),
        ({"covariance": Covariance(["hwp.theta"], [u.deg], [[1]])}, "covariance of 1 parameters"),
        ({"settings": {"fitter": len}}, "settings.fitter is a builtin_function_or_method"),
        ({"settings": {}}, "invalid at .*settings: 'observable' is a required property"),
        ({"fit": {"seconds": "long", "n_data": 1, "converged": True}}, "invalid at .*fit.seconds"),
    ]:
        assert_not_written(dataclasses.replace(calibration, **change), path, message)


def test_only_names_that_a_folder_is_searched_for_are_written(calibration, tmp_path):
    for name in ("cal.fits", "cal", "cal.asdf.gz"):
        assert_not_written(calibration, tmp_path / name, f"{name}: the name must end with .asdf")


def test_identifiability_of_another_size_is_not_written(calibration, path):
    for key in ["singular_values", "null_vectors", "identifiable"]:
        wrong = dataclasses.replace(calibration.identifiability, **{key: np.zeros((2, 2))})
        changed = dataclasses.replace(calibration, identifiability=wrong)
        assert_not_written(changed, path, f"{key} have shape")


def test_accuracy_without_a_column_is_not_written(calibration, path):
    record = dataclasses.replace(
        calibration.datasets[0], accuracy=calibration.datasets[0].accuracy["wavelength", "n"]
    )
    changed = dataclasses.replace(calibration, datasets=[record, calibration.datasets[1]])
    assert_not_written(changed, path, "night0 has no column k, s_res, s_mean, s_cv")


# ---- what is refused on reading ----------------------------------------------------------


def test_what_cannot_be_opened(path, tmp_path, content, monkeypatch):
    with pytest.raises(CalibrationFileError, match="no such file") as caught:
        Calibration.read(path)
    assert str(path) in str(caught.value)
    with pytest.raises(CalibrationFileError, match="is a folder, not a file"):
        Calibration.read(tmp_path)

    def refuse(self):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(type(path), "read_bytes", refuse)
    assert_refused(path, content, "Permission denied")


def test_not_asdf(path):
    for junk in [b"", b"#AS", b"SIMPLE  =  T", b"\x00" * 100, b"{'a': 1}\n...\n"]:
        assert_refused(path, junk, "not an ASDF file")


def test_asdf_of_something_else(path):
    asdf.AsdfFile({"data": np.arange(3)}).write_to(path)
    content = path.read_bytes()
    assert_refused(path, content, "not an astropolcal calibration: it has no 'calibration'|trunc")
    asdf.AsdfFile({"calibration": {"a": 1}}).write_to(path)
    content = path.read_bytes()
    assert_refused(path, content, "not an astropolcal calibration: 'calibration' has no tag")
    asdf.AsdfFile({"calibration": np.arange(99)}).write_to(path)
    assert_refused(path, path.read_bytes(), "not an astropolcal calibration: .*ndarray")


def test_other_versions(path, content):
    for old, new, message in (
        (b"calibration-1.1.0>", b"calibration-2.0.0>", "calibration of version 2.0.0; this"),
        (b"calibration-1.1.0>", b"calibration-1.0.1>", "reads version 1.0.0, 1.1.0$"),
        (b"linear_polarizer-1.0.0>", b"linear_polarizer-1.1.0>", "unknown kind or version"),
        (b"linear_polarizer-1.0.0>", b"circular_polarizer-1.0.0>", "damaged: .*not recognized"),
    ):
        assert_refused(path, replaced(content, old, new), message)


@pytest.mark.slow
def test_changed_file(path, content):
    for old, new, message in [
        (b"unit: deg", b"unit: rad", r"invalid at .*theta\.unit: 'rad' is not one of \['deg'\]"),
        (b"unit: mm", b"unit: um", r"invalid at .*unit: 'um' is not one of \['mm'\]"),
        (b"unit: nm", b"unit: deg", r"invalid at .*wavelength"),
        (b"n_data: ", b"n_data: -", "invalid at .*n_data"),
        (b"strategy: two-step", b"strategy: joint", "does not match its checksum"),
        (b"night1", b"night2", "does not match its checksum"),
        (b"mount: hwp", b"mount: hwq", "does not match its checksum"),
        (b"fixed: true", b"fixed: false", "does not match its checksum"),
        (b"fixed: true", b"fixed: maybe", "'maybe' is not of type 'boolean'"),
        (b"  stages:", b"  phases:", "'phases' was unexpected|'stages' is a required property"),
        (b"shape: [3]", b"shape: [4]", "damaged|invalid"),
        (b"shape: [10, 10]", b"shape: [5, 20]", "checksum"),
        (b"source: 0", b"source: 'http://localhost/other.asdf'", "refers to another file"),
        (b"mount: hwp", b"mount: {$ref: 'other.asdf#/name'}", "refers to another file"),
        (b"mount: hwp", b"mount: !!python/object/apply:os.getpid []", "unknown kind"),
        (b"mount: hwp", b"mount: !!python/name:os.getpid ''", "unknown kind"),
        (b"mount: hwp", b"mount: !<tag:example.org:thing-1.0.0> {}", "unknown kind"),
        (b"mount: hwp", b"mount: [unclosed", "damaged"),
        (b"mount: hwp", b"mount: *missing", "damaged"),
        (b"calibration:", b"calibration: &loop {a: *loop}\nold:", "refers to itself"),
        (b"calibration:", b"calibration: &loop {}\nold:", "not an astropolcal calibration"),
    ]:
        assert_refused(path, replaced(content, old, new), message)


def test_a_schema_from_elsewhere_lets_nothing_pass(path, content):
    """Of a schema that cannot be read ASDF itself only warns, and takes the node for valid."""
    path.write_bytes(content)
    uri = "asdf://astropolcal.org/astropolcal/schemas/calibration-1.1.0"
    with asdf.config_context() as config:
        config.add_resource_mapping({uri: b"a: &twice 1\nb: &twice 2\n"})
        Calibration.read(path)
        assert_refused(path, replaced(content, b"n_data: ", b"n_data: -"), "invalid at .*n_data")


def test_changed_number_in_a_block(path, content, sampled):
    sampled.write(path)
    other = path.read_bytes()
    sample = other.index(sampled.posterior.thinned().chain.tobytes()) + 100
    for whole, place in ((content, content.index(b"\xd3BLK") + 54 + 8), (other, sample)):
        changed = whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :]
        assert_refused(path, changed, "checksum")


def test_truncation_at_any_byte(path, content):
    # by far most lengths are seen at the end of the file; the others are those to test
    ends = [n for n in range(len(content)) if content[:n].endswith(b"\n...\n")]
    assert ends, "arrays in blocks come after the end of the tree"
    spread = np.linspace(0, len(content) - 1, 100).astype(int).tolist()
    for n in [*ends, *spread, len(content) - 1]:
        assert_refused(path, content[:n], "truncated|not an ASDF file|damaged")


def refusal(path, content, expected):
    """Return why a file is refused, or None if it gives the calibration expected."""
    path.write_bytes(content)
    try:
        again = Calibration.read(path)
    except CalibrationFileError as error:
        return str(error)
    # what changed was in the header, or in the padding
    assert again.to_dict() == expected
    return None


@pytest.mark.slow
def test_spoiled_file_is_refused_or_the_same(calibration, path, content):
    rng = np.random.default_rng(11)
    expected = calibration.to_dict()
    reasons = []
    # what YAML can read gets further than any byte
    for allowed in (np.arange(256), np.frombuffer(b"0123456789.-eabcn: []{}\n", np.uint8)):
        for _ in range(50):
            changed = np.frombuffer(content, np.uint8).copy()
            places = rng.integers(len(content), size=rng.integers(1, 4))
            changed[places] = rng.choice(allowed, size=len(places))
            reasons.append(refusal(path, changed.tobytes(), expected))
    reasons = [reason for reason in reasons if reason]
    assert len(reasons) > 67
    assert any("does not match its checksum" in reason for reason in reasons)
    assert any("invalid at" in reason for reason in reasons)
    assert not any("\n" in reason for reason in reasons)
    # cut out and doubled pieces
    rng = np.random.default_rng(12)
    reasons = []
    for _ in range(30):
        first, last = np.sort(rng.integers(len(content), size=2))
        last = min(last, first + 200)
        piece = content[first:last] * int(rng.choice([0, 2]))
        reasons.append(refusal(path, content[:first] + piece + content[last:], expected))
    reasons = [reason for reason in reasons if reason]
    assert len(reasons) > 20
    assert not any("\n" in reason for reason in reasons)
