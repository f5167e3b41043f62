# Licensed under a 3-clause BSD style license - see LICENSE
"""What a pipeline loads: system Mueller matrices from headers, with their errors."""

import copy
import dataclasses
import subprocess
import sys
import warnings
from contextlib import suppress
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import QTable

from astropolcal import calibrate, instruments
from astropolcal.calibration import propagate
from astropolcal.calibration.result.calibration import with_validity
from astropolcal.calibration.uncertainty.covariance import full_covariance
from astropolcal.chain import (
    insert_optic,
    join,
    leaves,
    system_mueller,
    system_mueller_derivatives,
    with_beam,
)
from astropolcal.correction import ScienceFrames, correct
from astropolcal.exceptions import (
    AstropolcalWarning,
    CalibrationFileError,
    ChainError,
    InstrumentError,
    ObservationError,
    ParameterError,
    WavelengthRangeError,
)
from astropolcal.optics import LinearRetarder
from astropolcal.pipeline.library import Library
from astropolcal.pipeline.loading import load
from astropolcal.simulation import half_wave_plate_cycles, simulate

OLD = Path(__file__).parent / "data" / "calibration-1.0.0.asdf"
CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength[[9, 12, 16]]
HEADER = {
    "INSTRUME": "CHARIS",
    "MJD": 60988.5,
    "RET-ANG1": 22.5,
    "D_IMRANG": 60.0,
    "ALTITUDE": 55.0,
    "PARANG": -30.0,
    "FILTNAME": "broadband JHK",
}
POSITIONS = {"hwp": 22.5 * u.deg, "derotator": 60 * u.deg}


def meta(source, **more):
    known = CHARIS.published_meta() | {"date": "2025-10-05", "yjh50_dichroic": "out"}
    return known | {"source": source} | more


def observe(source, seed, optics_in=("nbs",), name=None, derotator="linear"):
    chain = CHARIS.chain(source, optics_in, derotator=derotator, wavelength=WAVELENGTH)
    frames = half_wave_plate_cycles(derotator=[50, 62.5, 80, 100] * u.deg)
    if "star" in source:
        n = len(frames)
        frames["altitude"] = np.linspace(40, 70, n) * u.deg
        frames["parallactic"] = np.linspace(-60, 40, n) * u.deg
    table = simulate(chain, WAVELENGTH, frames, seed=seed, meta=meta(source), name=name or source)
    return chain, table


@pytest.fixture(scope="module")
def calibration():
    """Internal source and an unpolarized star together: the telescope is calibrated."""
    pairs = [observe("polarized", 1), observe("unpolarized standard star", 2)]
    chains, tables = zip(*pairs, strict=True)
    chains = [chain.copy() for chain in chains]
    for chain in chains:
        for name in ("hwp", "derotator"):
            chain[name].theta.fixed = True
    positions = [CHARIS.positions(t, c) for t, c in zip(tables, chains, strict=True)]
    return calibrate(chains, tables, positions=positions, instrument="charis", cross_validate=False)


@pytest.fixture(scope="module")
def path(calibration, tmp_path_factory):
    path = tmp_path_factory.mktemp("loading") / "charis.asdf"
    calibration.write(path)
    return path


@pytest.fixture(scope="module")
def loaded(path):
    return load(path)


def expected(calibration, light="sky", beam="right"):
    """The matrix by hand, for a frame of HEADER."""
    chain = leaves(calibration.chains[1])
    start = 1 if light == "sky" else 4
    chain = with_beam(join(chain[start:]), beam)
    # tracking law of the half-wave plate
    hwp = 22.5 + 0.5 * -30.0 + 55.0 if light == "sky" else 22.5
    angles = {"hwp": hwp, "derotator": 60.0, "parallactic": -30.0, "altitude": 55.0}
    return system_mueller(chain, WAVELENGTH, {k: v * u.deg for k, v in angles.items()})


# ---- values ------------------------------------------------------------------------------


def test_matrix_of_a_frame(calibration, path):
    for light in ["sky", "internal"]:
        for beam in ["right", "left"]:
            loaded = load(path, HEADER)
            found = loaded.system_mueller(fits.Header(HEADER), light=light, beam=beam)
            assert found.value.shape == (3, 4, 4), (light, beam)
            np.testing.assert_allclose(found.value, expected(calibration, light, beam), atol=1e-14)
            assert found.beam == beam, (light, beam)
            assert found.assumed == (), (light, beam)


def test_frames_have_an_axis_of_their_own(loaded):
    other = HEADER | {"RET-ANG1": 67.5}
    both = loaded.system_mueller([HEADER, other])
    assert both.value.shape == (2, 3, 4, 4)
    assert both.covariance.shape == (2, 3, 16, 16)
    assert both.positions["hwp"].to_value(u.deg) == pytest.approx([62.5, 107.5])
    np.testing.assert_allclose(both.value[1], loaded.system_mueller(other).value, atol=1e-15)


def test_the_chain_is_a_model_from_the_sky_with_the_values_found(calibration, loaded):
    chain = loaded.chain
    assert [leaf.name for leaf in leaves(chain)][:4] == ["parallactic", "m3", "altitude", "hwp"]
    assert chain["hwp"].w_sio2 == calibration.chains[0]["hwp"].w_sio2
    angles = {"hwp": 10.0, "derotator": 50.0, "parallactic": 20.0, "altitude": 60.0}
    positions = {stage: angle * u.deg for stage, angle in angles.items()}
    seen = system_mueller(with_beam(chain, "right"), WAVELENGTH, positions)
    wanted = loaded.system_mueller(positions=positions).value
    np.testing.assert_allclose(np.squeeze(seen), np.squeeze(wanted))
    chain["hwp"].w_sio2 = 1 * u.mm
    assert loaded.chain["hwp"].w_sio2.value > 1


def test_positions_in_place_of_headers(loaded):
    angles = {"hwp": 62.5, "derotator": 60.0, "parallactic": -30.0, "altitude": 55.0}
    positions = {key: value * u.deg for key, value in angles.items()}
    one = loaded.system_mueller(positions=positions)
    np.testing.assert_allclose(one.value, loaded.system_mueller(HEADER).value, atol=1e-14)


def test_true_angle_of_the_half_wave_plate_comes_first(loaded):
    found = loaded.system_mueller(HEADER | {"RET-POS1": 242.5})
    np.testing.assert_allclose(found.value, loaded.system_mueller(HEADER).value, atol=1e-12)
    assert found.positions["hwp"].to_value(u.deg) == pytest.approx(242.5)


@pytest.mark.slow
def test_pointing_is_computed_where_the_header_lacks_it(loaded):
    header = {k: v for k, v in HEADER.items() if k not in ("ALTITUDE", "PARANG")}
    header |= {"MJD": 60982.55, "RA": "05:18:00", "DEC": "-01:00:00"}
    angles = loaded.system_mueller(header).positions
    assert angles["altitude"].to_value(u.deg) == pytest.approx(69, abs=1.5)


# ---- errors ------------------------------------------------------------------------------


def test_covariance_is_that_of_the_parameters(calibration, loaded):
    """Against central differences along the directions of the covariance."""
    angles = {"hwp": 62.5, "derotator": 60.0, "parallactic": -30.0, "altitude": 55.0}
    positions = {key: value * u.deg for key, value in angles.items()}

    def matrix(*chains):
        return system_mueller(join(leaves(chains[1])[1:]), WAVELENGTH, positions)

    found = loaded.system_mueller(HEADER)
    known = propagate(calibration, matrix)
    np.testing.assert_allclose(found.std, known.std, rtol=1e-5, atol=1e-12)
    assert found.std.max() > 1e-6
    whole = found.factor.reshape(48, -1)
    np.testing.assert_allclose(whole @ whole.T, known.covariance(), rtol=1e-4, atol=1e-14)
    for i in range(3):
        block = known.covariance()[16 * i : 16 * i + 16, 16 * i : 16 * i + 16]
        np.testing.assert_allclose(found.covariance[i], block, rtol=1e-4, atol=1e-14)


def test_errors_of_many_frames_are_those_of_a_dense_jacobian(calibration, loaded):
    """Worked out by settings, wavelengths and blocks of frames, nothing changes."""
    rng = np.random.default_rng(5)
    settings = {name: rng.uniform(20, 70, 290) for name in ("hwp", "derotator", "parallactic")}
    # some settings occur twice, and one stage stands
    positions = {name: np.append(angle, angle[:20]) * u.deg for name, angle in settings.items()}
    positions["altitude"] = 55 * u.deg
    found = loaded.system_mueller(positions=positions)
    chain, lam = with_beam(join(leaves(calibration.chains[1])[1:]), "right"), found.wavelength
    np.testing.assert_array_equal(found.value, system_mueller(chain, lam, positions))
    covariance = full_covariance(calibration)
    dense = np.zeros((310, 3, 16, len(covariance.names)))
    for name, slope in system_mueller_derivatives(chain, lam, positions).items():
        slope = slope.value if hasattr(slope, "unit") else slope
        for i, full in enumerate(covariance.names):
            bare, _, bin_ = full.removesuffix("]").partition("[")
            if bare == name:
                at = slice(None) if not bin_ else int(bin_)
                dense[:, at, :, i] = slope[:, at].reshape(dense[:, at, :, i].shape)
    moved = dense @ covariance.factor.T
    std = np.sqrt(np.sum(moved**2, axis=-1)).reshape(found.value.shape)
    np.testing.assert_allclose(found.std, std, rtol=1e-12, atol=1e-15)
    whole = moved @ moved.swapaxes(-1, -2)
    np.testing.assert_allclose(found.covariance_in_gauge, whole, rtol=1e-12, atol=1e-15)
    factor = found.factor.reshape(310, 48, -1)
    far = np.einsum("ir,jr->ij", factor[0], factor[300])
    expected_far = np.einsum("ir,jr->ij", *(moved[i].reshape(48, -1) for i in (0, 300)))
    np.testing.assert_allclose(far, expected_far, rtol=1e-12, atol=1e-15)
    some = found[[300, 2]]
    np.testing.assert_allclose(some.covariance, found.covariance[[300, 2]], rtol=1e-12, atol=1e-18)
    assert some.positions["altitude"].shape == (2,)
    np.testing.assert_array_equal(found[3].std, found[3:4].std[0])
    with pytest.raises(ParameterError, match="single frame"):
        found[3][0]


@pytest.mark.slow
def test_covariance_agrees_with_samples(calibration, loaded):
    rng = np.random.default_rng(3)
    found = loaded.system_mueller(HEADER)
    from astropolcal.measurement.parameters import FreeParameters

    chains = [chain.copy() for chain in calibration.chains]
    free = FreeParameters(chains, 3, calibration.ties)
    start, factor = free.start(), calibration.covariance.factor * free.factors()
    draws = []
    for _ in range(500):
        free.put_back(start + rng.normal(size=len(factor)) @ factor)
        changed = dataclasses.replace(calibration, chains=chains)
        draws.append(expected(changed))
    std = np.std(draws, axis=0)
    certain = found.std > 1e-6
    assert certain.sum() > 20
    assert np.abs(std[certain] / found.std[certain] - 1).max() < 0.12


def test_what_is_open_has_an_infinite_error(tmp_path):
    chain, table = observe("polarized", 1, derotator="elliptical")
    calibrate(chain, table, instrument="charis", cross_validate=False).write(tmp_path / "a.asdf")
    loaded = load(tmp_path / "a.asdf")
    # the misalignments of plate and derotator are known up to a common turn
    found = loaded.system_mueller(HEADER, light="internal")
    assert np.isinf(found.std).any()
    diagonal = np.diagonal(found.covariance, axis1=-2, axis2=-1).reshape(3, 4, 4)
    np.testing.assert_allclose(np.sqrt(diagonal), found.std, rtol=1e-14)
    assert np.isnan(found.covariance).any()
    # as far as the data determine it, and in the gauge of the calibration
    known = found.covariance_in_gauge
    assert np.isfinite(known).all()
    certain = np.isfinite(found.covariance)
    np.testing.assert_array_equal(known[certain], found.covariance[certain])


def test_published_mirror_is_said(tmp_path):
    chain, table = observe("polarized", 1)
    calibrate(chain, table, instrument="charis", cross_validate=False).write(tmp_path / "a.asdf")
    with pytest.warns(AstropolcalWarning, match=r"a.asdf: m3 not calibrated, published"):
        found = load(tmp_path / "a.asdf").system_mueller(HEADER)
    assert found.assumed == ("m3",)


# ---- what it holds for -------------------------------------------------------------------


def test_what_is_no_header_is_refused(path):
    with pytest.raises(ObservationError, match=r"frame\.fits: no such file"):
        load(path, "frame.fits")
    for header in [60960.5, ["a", "b"]]:
        with pytest.raises(
            ParameterError, match=r"header = .* is of type \w+; a FITS header or a map"
        ):
            load(path, header)


def test_calibration_in_memory(calibration, loaded):
    here = load(calibration, HEADER)
    assert here.content_hash == loaded.content_hash
    np.testing.assert_array_equal(
        here.system_mueller(HEADER).value, loaded.system_mueller(HEADER).value
    )
    with pytest.raises(CalibrationFileError, match="calibration in memory"):
        load(calibration, HEADER | {"MJD": 60400.0})


def test_calibration_in_memory_has_optics_that_files_cannot_hold(calibration):
    class Homemade(LinearRetarder):
        """A retarder of a user."""

    window = Homemade(retardance=20 * u.deg, fixed={"retardance": True}, name="window")
    chains = [insert_optic(chain, window, before="wollaston") for chain in calibration.chains]
    own = dataclasses.replace(calibration, chains=chains)
    found = own.system_mueller(positions=POSITIONS, light="internal").value
    expected = system_mueller(chains[0][1:], WAVELENGTH, POSITIONS)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12)
    assert load(own).content_hash != load(calibration).content_hash
    with pytest.raises(CalibrationFileError, match="Homemade, which files cannot hold"):
        own.write("homemade.asdf")


@pytest.mark.slow
def test_what_is_wrong_with_a_calibration_is_told_as_by_correct(calibration, tmp_path):
    """A fit that did not converge, and neighbours in the library that differ."""
    bad = copy.deepcopy(calibration)
    bad.fit["converged"] = False
    words = "NOT USABLE AS IT IS: the fit did not converge"
    with pytest.warns(AstropolcalWarning, match=f"calibration in memory: {words}"):
        load(bad)
    fluxes = np.ones((1, len(WAVELENGTH)))
    frames = ScienceFrames.from_arrays(fluxes, fluxes, WAVELENGTH, {}, date="2025-10-05")
    with (
        pytest.warns(AstropolcalWarning, match=f"the calibration: {words}"),
        # they have no mode
        suppress(CalibrationFileError),
    ):
        correct(bad, frames)
    library = Library(tmp_path)
    library.add(calibration, name="a.asdf", valid_until="2025-12-01")
    for chain in bad.chains:
        chain["hwp"].w_sio2.value *= 1.01
    library.add(bad, name="b.asdf", valid_from="2025-12-01")
    with pytest.warns(AstropolcalWarning, match=r"a.asdf differs from b.asdf by \d+ \(hwp by"):
        assert load(library, HEADER).path.name == "a.asdf"


@pytest.mark.slow
def test_what_changes_from_month_to_month_is_in_the_errors(tmp_path):
    """The derotator scatters by 3 deg; its retardances are not determined alone."""
    wanted = {"mode": "broadband JHK", "date": "2025-04-05"}
    frames = half_wave_plate_cycles(derotator=[45, 62.5, 80, 100] * u.deg)
    positions = {"hwp": [0, 22.5, 45, 67.5] * u.deg, "derotator": [50, 65, 80, 95] * u.deg}
    for size in (0.0, 3.0):
        folder = tmp_path / f"{size:g}"
        folder.mkdir()
        library = Library(folder)
        nominal = CHARIS.chain("polarized", ["nbs"], wavelength=WAVELENGTH)
        for month, shift in enumerate((0.0, size, -size / 2, size), start=1):
            truth, date = nominal.copy(), {"date": f"2025-0{month}-05"}
            truth["derotator"].horizontal.value += shift
            if month == 4:
                # no calibration is of that month
                break
            data = simulate(truth, WAVELENGTH, frames, seed=month, meta=meta("polarized") | date)
            own = calibrate(nominal, data, instrument="charis", cross_validate=False)
            library.add(own, valid_from=date["date"])
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            last = load(library, **wanted)
        told = [str(one.message) for one in said if "differs from" in str(one.message)]
        assert bool(told) == bool(size), told
        assert all("(derotator by " in words and "among the errors" in words for words in told)
        found = last.system_mueller(positions=positions, light="internal")
        true = system_mueller(join(leaves(truth)[1:]), WAVELENGTH, positions)
        error = np.sqrt(np.einsum("...ii->...i", found.covariance_in_gauge))
        off = (found.value - true).reshape(error.shape)
        # what nothing moves is neither wrong nor uncertain
        pulls = (off / np.where(error > 1e-9, error, np.inf))[..., 1:4]
        assert 0.2 < np.sqrt(np.mean(pulls[pulls != 0] ** 2)) < 2, size


@pytest.mark.slow
def test_library_is_looked_up_by_the_header(calibration, tmp_path):
    library = Library(tmp_path)
    early = library.add(calibration, valid_from="2025-01-01", valid_until="2025-10-05")
    late = library.add(calibration)
    assert load(tmp_path, HEADER).path == late.resolve()
    assert load(tmp_path, HEADER | {"MJD": 60950.0}).path == early.resolve()
    assert load(library, HEADER, date="2025-10-03").path == early.resolve()
    iso = {k: v for k, v in HEADER.items() if k != "MJD"}
    iso |= {"UTC-DATE": "2025-11-01", "UTC-TIME": "10:11:12"}
    assert load(tmp_path, iso).path == late.resolve()
    with pytest.raises(CalibrationFileError, match="no calibration of charis for date 2024-"):
        load(tmp_path, HEADER | {"MJD": 60400.0})
    with pytest.raises(CalibrationFileError, match="date 'x' cannot"):
        load(tmp_path, HEADER | {"MJD": "x"})


def test_frame_for_which_it_does_not_hold_is_refused(loaded):
    for change, message in (
        ({"MJD": 60400.0}, "frame 1 was taken 2024-.*charis.asdf holds for charis"),
        ({"INSTRUME": "HICIAO"}, "frame 1 is of HICIAO"),
        ({"FILTNAME": "K"}, "frame 1 is in mode 'K'.*broadband JHK"),
    ):
        with pytest.raises(CalibrationFileError, match=message):
            loaded.system_mueller([HEADER, HEADER | change])


def test_what_the_user_states_comes_before_the_header(path):
    header = HEADER | {"FILTNAME": "Broadband"}
    with pytest.raises(CalibrationFileError, match="for mode Broadband"):
        load(path, header)
    assert load(path, header, mode="broadband JHK").system_mueller(header).value.shape == (3, 4, 4)


def test_frame_that_does_not_say_enough(path):
    for lacking, stated in (
        ("MJD", {"date": "2025-11-09"}),
        ("FILTNAME", {"mode": "broadband JHK"}),
    ):
        header = {key: value for key, value in HEADER.items() if key != lacking}
        (word,) = stated
        for refused in (
            lambda header=header: load(path, header),
            lambda header=header: load(path).system_mueller(header),
            lambda header=header: load(path).system_mueller([HEADER, header]),
        ):
            with pytest.raises(CalibrationFileError, match=rf"its {word} is not known.*{word}="):
                refused()
        matrices = load(path, header, **stated).system_mueller(header)
        np.testing.assert_array_equal(matrices.value, load(path).system_mueller(HEADER).value)


def test_age(calibration, tmp_path):
    """The M3 that these headers need is assumed not to have changed, which its date contradicts."""
    internal = {"light": "internal"}
    later = HEADER | {"MJD": 61318.0 + 365}  # 2026-10-05 and a year
    path = tmp_path / "a.asdf"
    calibration.write(path)
    with pytest.warns(AstropolcalWarning, match=r"2.0 yr from the data of a.asdf.*old after 365 d"):
        loaded = load(path, later)
    with pytest.warns(AstropolcalWarning, match=r"frame 1 was taken 2027-.*max_age"):
        loaded.system_mueller([HEADER, later], **internal)
    with pytest.warns(AstropolcalWarning, match="old after 10 d"):
        load(path, HEADER, max_age=10 * u.day)
    # an age that is allowed, and an end that was stated
    load(path, later, max_age=3 * u.yr).system_mueller(later, **internal)
    held = with_validity(calibration, valid_until="2028-01-01")
    load(held, later).system_mueller(later, **internal)
    for bad in (-1 * u.yr, 3, 1 * u.m, np.nan * u.yr):
        with pytest.raises(ParameterError, match="max_age"):
            load(path, HEADER, max_age=bad)


def test_dated_change(path):
    """No calibration of 2025 holds behind the mirror that was coated in December, or before NBS."""
    recoated = HEADER | {"MJD": 61060.0}
    loaded = load(path, recoated)
    assert loaded.system_mueller(recoated, light="internal").value.shape == (3, 4, 4)
    with pytest.raises(CalibrationFileError, match=r"frame 1, .*M3 was recoated between.*2026-01"):
        loaded.system_mueller([HEADER, recoated])
    with pytest.raises(CalibrationFileError, match=r"the frame.* M3 was recoated"):
        load(path, date="2026-03-01").system_mueller(positions=POSITIONS)
    # the caller may know better
    stated = load(path, recoated, date="2025-11-09")
    np.testing.assert_array_equal(
        stated.system_mueller(recoated).value, loaded.system_mueller(HEADER).value
    )


def test_instrument_must_be_told(path):
    header = {k: v for k, v in HEADER.items() if k != "INSTRUME"}
    with pytest.raises(InstrumentError, match="the header does not say it; give instrument="):
        load(path, header)
    assert load(path, header, instrument="charis").path == path.resolve()


def test_optics_in_the_beam(tmp_path):
    pairs = [observe("polarized", 1), observe("polarized", 2, (), name="before")]
    chains, tables = zip(*pairs, strict=True)
    tables[1].meta["nasmyth_beam_switcher"] = "not installed"
    cal = calibrate(list(chains), list(tables), instrument="charis", cross_validate=False)
    cal.write(tmp_path / "a.asdf")
    values = {}
    for optics in ((), ("nbs",)):
        loaded = load(tmp_path / "a.asdf", optics_in=optics)
        values[optics] = loaded.system_mueller(HEADER, light="internal").value
    assert np.abs(values[()] - values[("nbs",)]).max() > 0.5
    with pytest.raises(ChainError, match=r"apart: (none or nbs|nbs or none)"):
        load(tmp_path / "a.asdf").system_mueller(positions=POSITIONS, light="internal")
    # the date tells: the beam switcher came in 2025
    stated = load(tmp_path / "a.asdf", date="2025-12-01", instrument="charis")
    for optics, mjd in (((), 60800.0), (("nbs",), 60988.5)):
        told = stated.system_mueller(HEADER | {"MJD": mjd}, light="internal")
        np.testing.assert_array_equal(told.value, values[optics])
    with pytest.raises(ChainError, match="nbs was in the beam in frame 0, and not in frame 1"):
        stated.system_mueller([HEADER, HEADER | {"MJD": 60800.0}], light="internal")
    with pytest.raises(CalibrationFileError, match=r"optics_in dichroic\+nbs"):
        load(tmp_path / "a.asdf", optics_in=("dichroic", "nbs"))


# ---- bad input ---------------------------------------------------------------------------


def test_wavelengths(loaded):
    two = loaded.system_mueller(HEADER, wavelength=WAVELENGTH[[2, 0]].to(u.um))
    whole = loaded.system_mueller(HEADER)
    np.testing.assert_allclose(two.value, whole.value[[2, 0]], atol=1e-14)
    np.testing.assert_allclose(two.covariance, whole.covariance[[2, 0]], atol=1e-16)
    with pytest.raises(WavelengthRangeError, match=r"1500.00 nm is none of the 3 .*m3\.diatt"):
        loaded.system_mueller(HEADER, wavelength=1500 * u.nm)
    with pytest.raises(ParameterError, match="needs a unit"):
        loaded.system_mueller(HEADER, wavelength=1500)


def test_wavelengths_in_between_are_interpolated_if_asked_for(calibration, loaded):
    lam = [1700, 1900] * u.nm
    words = r"1700.00 nm is none .* the nearest is \d+.\d\d nm; interpolate=True"
    with pytest.raises(WavelengthRangeError, match=words):
        loaded.system_mueller(HEADER, wavelength=lam)
    found = loaded.system_mueller(HEADER, wavelength=lam, interpolate=True)
    rows = measurement_rows_between(calibration, found.positions, lam)
    np.testing.assert_allclose(found.value[:, 0], rows, atol=1e-12)
    grid = loaded.system_mueller(HEADER, wavelength=WAVELENGTH, interpolate=True)
    np.testing.assert_allclose(grid.std, loaded.system_mueller(HEADER).std, rtol=1e-9)
    # between two values, their independent errors are those of a mean
    assert 0 < found.std.max() < 1.5 * grid.std.max()
    with pytest.raises(WavelengthRangeError, match="outside the calibrated range"):
        loaded.system_mueller(HEADER, wavelength=3 * u.um, interpolate=True)


def measurement_rows_between(calibration, positions, lam):
    """The rows that a correction of frames uses, which interpolates by itself."""
    from astropolcal.correction import measurement_rows

    with pytest.warns(AstropolcalWarning, match="interpolated linearly"):
        return measurement_rows(calibration, positions, lam, interpolate=True)[0, :, 0]


def test_a_file_has_a_header(path, tmp_path, loaded):
    fits.PrimaryHDU(header=fits.Header(HEADER)).writeto(tmp_path / "a.fits")
    from_file = load(path, tmp_path / "a.fits").system_mueller(str(tmp_path / "a.fits"))
    np.testing.assert_array_equal(from_file.value, loaded.system_mueller(HEADER).value)
    with pytest.raises(ObservationError, match=r"b\.fits: no such file"):
        loaded.system_mueller([HEADER, tmp_path / "b.fits"])


# ---- Stokes cubes ------------------------------------------------------------------------


def test_a_stokes_cube_is_corrected_with_its_errors(calibration, loaded):
    headers = [HEADER | {"RET-ANG1": angle} for angle in (0.0, 45.0, 22.5, 67.5, 90.0, 135.0)]
    true = np.array([1000.0, 20.0, -10.0, 3.0])[:, None] * [1, 2, 3]

    def measured(values):
        right, left = (np.einsum("fws,sw->fw", value[..., 0, :], true) for value in values)
        x, total = right - left, right + left
        # three of Q, two of U: least squares of both
        plus = ((x[0] - x[1]) / 2 + (x[4] - x[5]) / 2) / 2
        return np.stack([total.mean(axis=0), plus, (x[2] - x[3]) / 2])

    beams = [loaded.system_mueller(headers, beam=beam) for beam in ("right", "left")]
    cube = measured([beam.value for beam in beams])
    # V that is known, and that is taken for zero
    given = np.concatenate([cube, true[3:]])
    stokes, systematic = loaded.correct(given, headers)
    np.testing.assert_allclose(stokes, true, atol=1e-9)
    assert not systematic[3].any()
    without, _ = loaded.correct(cube, headers)
    assert 0 < np.abs(without[1:] - true[1:3]).max() < 3 * 3
    flipped, _ = loaded.correct(given * [[1], [-1], [-1], [1]], headers, difference="left-right")
    np.testing.assert_allclose(flipped, true, atol=1e-9)
    # a matrix that errs by one direction, corrected as if it did not
    squares = 0
    for r in range(beams[0].factor.shape[-1]):
        moved = measured([beam.value + 1e-3 * beam.factor[..., r] for beam in beams])
        shift = loaded.correct(np.concatenate([moved, true[3:]]), headers)[0] - stokes
        squares = squares + (1e3 * shift[:3]) ** 2
    # beside it, in proportion to the light, what the model lacks
    known = {"wavelength_nm": calibration.wavelength.to_value(u.nm).tolist()}
    for relative, absolute in [(0.0, 0.0), (2.0, 0.5)]:
        lacking = known | {"relative_percent": [relative] * 3, "absolute_percent": [absolute] * 3}
        fit = calibration.fit | {"model_error": lacking}
        _, found = load(dataclasses.replace(calibration, fit=fit)).correct(given, headers)
        own = np.hypot(absolute * true[0], relative * np.hypot(true[1], true[2])) / 100
        expected = np.sqrt(squares + np.array([0, 1, 1])[:, None] * own**2)
        np.testing.assert_allclose(found[:3], expected, rtol=1e-3)


def test_stokes_cubes_that_cannot_be_corrected(loaded):
    headers, cube = [HEADER, HEADER | {"RET-ANG1": 67.5}], np.ones((3, 3, 2, 2))
    for stokes, options, message in [
        (cube[:2], {}, r"shape \(2, 3, 2, 2\); needed are I, Q, U \(and V\) at 3 wavelengths"),
        (cube[:, :2], {}, "at 3 wavelengths"),
        (cube, {}, "do not tell Q and U apart"),
        (cube, {"difference": "both"}, "allowed are right-left, left-right"),
        (cube, {"hwp": [0, 22.5, 45] * u.deg}, "hwp = .*; 2 finite angles are needed"),
        (cube, {"hwp": [0, np.nan] * u.deg}, "hwp = .*; 2 finite angles are needed"),
        (cube, {"hwp": [0, 22.5]}, "hwp = .* needs a unit"),
    ]:
        with pytest.raises(ParameterError, match=message):
            loaded.correct(stokes, headers, **options)
    with pytest.raises(ParameterError, match="either header or positions"):
        loaded.correct(cube)
    # true angles of the plate are not those by which a pipeline takes differences
    sky = {"parallactic": [-30, -30] * u.deg, "altitude": [55, 55] * u.deg}
    positions = {"hwp": [40, 62.5] * u.deg, "derotator": [60, 60] * u.deg} | sky
    with pytest.raises(ParameterError, match=r"hwp = None: .* the commanded angles are needed"):
        loaded.correct(cube, positions=positions)
    loaded.correct(cube, positions=positions, hwp=[0, 22.5] * u.deg)
    loaded.correct(cube, positions=positions, light="internal")


def test_masked_pixels_of_a_cube_and_positions_of_other_frames_give_no_numbers(loaded):
    headers = [HEADER | {"RET-ANG1": angle} for angle in (0.0, 45.0, 22.5, 67.5)]
    hidden = np.ma.array(np.ones((3, 3, 2, 2)), mask=False)
    hidden[1, 0, 0, 0] = np.ma.masked
    stokes, _ = loaded.correct(hidden, headers)
    assert np.isnan(stokes[:, 0, 0, 0]).all()
    assert np.isfinite(stokes[:, 1:]).all()
    positions = {"hwp": [0, 1, 2] * u.deg, "derotator": [60, 61] * u.deg}
    with pytest.raises(ParameterError, match="positions: 3 of hwp, 2 of derotator; one number"):
        loaded.system_mueller(positions=positions, light="internal")


def test_a_cube_of_a_polarimeter_without_a_half_wave_plate_is_refused():
    """Q and U by double differences are of no plate that goes by another name."""
    from astropolcal import optics

    plate = optics.LinearRetarder(retardance=95 * u.deg, mount="qwp", name="qwp")
    chain = plate | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    frames = QTable({"qwp": np.arange(0, 180, 22.5) * u.deg})
    lamp = optics.LinearPolarizer(name="lamp") | chain
    known = load(calibrate(lamp, simulate(lamp, WAVELENGTH, frames, seed=1), cross_validate=False))
    where = {"positions": {"qwp": [0, 45, 22.5, 67.5] * u.deg}, "light": "internal"}
    with pytest.raises(ParameterError, match=r"hwp = None: no half-wave plate.* there are qwp$"):
        known.correct(np.ones((3, len(WAVELENGTH), 2, 2)), **where)


def test_laws_in_wavelength_allow_others_within_the_range(tmp_path):
    from astropolcal import optics

    chain = (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer")
        | optics.TwoLayerWaveplate(mount="hwp", name="hwp")
        | optics.WollastonPrism(efficiency=0.98, name="wollaston")
    )
    frames = half_wave_plate_cycles(derotator=[50] * u.deg)
    cal = calibrate(chain, simulate(chain, WAVELENGTH, frames, seed=1), cross_validate=False)
    cal.write(tmp_path / "a.asdf")
    loaded = load(tmp_path / "a.asdf")
    options = {"positions": {"hwp": 10 * u.deg}, "light": "internal"}
    found = loaded.system_mueller(wavelength=1700 * u.nm, **options)
    hand = system_mueller(join(leaves(cal.chain)[1:]), 1700 * u.nm, {"hwp": 10 * u.deg})
    np.testing.assert_allclose(found.value[0], hand, atol=1e-14)
    assert found.std.max() > 0
    with pytest.raises(WavelengthRangeError, match=r"3000.* outside the calibrated"):
        loaded.system_mueller(wavelength=3000 * u.nm, **options)
    with pytest.raises(InstrumentError, match="has no map of header keywords"):
        loaded.system_mueller(HEADER, light="internal")
    with pytest.raises(ChainError, match="calibrates no telescope"):
        loaded.system_mueller(positions={"hwp": 10 * u.deg})


def test_either_header_or_positions(loaded):
    for arguments in ({}, {"header": HEADER, "positions": {}}):
        with pytest.raises(ParameterError, match="either header or positions"):
            loaded.system_mueller(**arguments)
    with pytest.raises(ObservationError, match=r"needs its pointing.*\(there is no PARANG\)"):
        loaded.system_mueller({k: v for k, v in HEADER.items() if k != "PARANG"})
    with pytest.raises(ParameterError, match="light = 'lamp'"):
        loaded.system_mueller(HEADER, light="lamp")
    with pytest.raises(ChainError, match="altitude"):
        loaded.system_mueller(positions={"hwp": 1 * u.deg, "parallactic": 1 * u.deg})


# ---- what it needs -----------------------------------------------------------------------

_BLOCKED = """
import re, sys, warnings
from importlib.metadata import packages_distributions, requires

def needed(names):
    found, waiting = set(), list(names)
    while waiting:
        name = waiting.pop().lower().replace("_", "-")
        if name in found:
            continue
        found.add(name)
        try:
            lines = requires(name) or []
        except ImportError:
            continue
        waiting += [re.match(r"[A-Za-z0-9_.-]+", r)[0] for r in lines if "extra ==" not in r]
    return found

allowed = needed(["numpy", "astropy", "asdf"])
blocked = []
for module, owners in packages_distributions().items():
    ours = module == "astropolcal" or module in sys.stdlib_module_names
    if not ours and not {o.lower().replace("_", "-") for o in owners} & allowed:
        sys.modules[module] = None
        blocked.append(module)
assert {"matplotlib", "photutils", "specutils", "jinja2", "scipy"} <= set(blocked), blocked

from astropolcal.pipeline.loading import load
from astropolcal.calibration.result.calibration import with_validity
from astropolcal.calibration.uncertainty.covariance import full_covariance
header = {"INSTRUME": "CHARIS", "MJD": 60988.5, "RET-ANG1": 22.5, "D_IMRANG": 60.0,
          "FILTNAME": "broadband JHK"}
calibration = load(sys.argv[1], header)
mueller = calibration.system_mueller([header] * 2, light="internal")
assert mueller.covariance.shape == (2, 3, 16, 16)

from astropolcal.pipeline.export import mueller_table, write_mueller
write_mueller(mueller_table(calibration, header, light="internal"), sys.argv[2])
print(repr(float(mueller.value[0, 0, 0, 1])))
"""


@pytest.mark.slow
def test_nothing_else_is_needed(tmp_path):
    command = [sys.executable, "-c", _BLOCKED, str(OLD), str(tmp_path / "m.fits")]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    value = load(OLD).system_mueller(HEADER, light="internal").value[0, 0, 1]
    assert done.stdout.strip() == repr(float(value))
    assert (tmp_path / "m.fits").exists()


_HEAVY = """
import sys
from astropolcal.pipeline import load
load(sys.argv[1])
print(*sorted({"matplotlib", "specutils", "scipy.optimize", "scipy.stats"} & set(sys.modules)))
"""


@pytest.mark.slow
def test_loading_imports_nothing_that_draws_or_fits():
    """ASDF would import the plug-ins of every package that is installed."""
    command = [sys.executable, "-c", _HEAVY, str(OLD)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == ""


@pytest.mark.slow
def test_beam_that_the_library_lacks(calibration, tmp_path):
    """The date of the frame says that the beam switcher was not there yet."""
    Library(tmp_path).add(calibration, valid_from="2025-01-01")
    with pytest.raises(CalibrationFileError, match=r"for a beam without nbs; there is .* with nbs"):
        load(tmp_path, HEADER | {"MJD": 60800.0})
    with pytest.raises(CalibrationFileError, match="beam switcher was installed between"):
        load(tmp_path, HEADER | {"MJD": 60800.0}, optics_in=["nbs"])


def test_what_a_header_tells_of_optics():
    for header, told in [
        ({"MJD": 60800.0}, {"nbs": False}),
        ({"UTC-DATE": "2025-10-05"}, {"nbs": True}),
        ({"UTC-DATE": "2025-09-01"}, {}),
        ({"MJD": "soon"}, {}),
        ({}, {}),
    ]:
        assert CHARIS.optics_of(header) == told
