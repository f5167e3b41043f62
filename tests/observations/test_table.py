# Licensed under a 3-clause BSD style license - see LICENSE
"""Observations: arrays, masks, selection, hash and round trips."""

from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable, Table
from astropy.time import Time

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations import Observations, example_table
from astropolcal.observations.observables import get_observable

SHARED = Path(__file__).resolve().parents[2].parent / "shared"
CHARIS = SHARED / "data" / "charis"
needs_shared = pytest.mark.skipif(
    not CHARIS.is_dir(), reason="needs the folder 'shared' with real tables beside the repository"
)
INTERNAL = (
    "dataset1_polarized_2025-07-15",
    "dataset3_polarized_2025-10-05",
    "dataset4_unpolarized_2025-10-05",
)
# bins and frames of each star
STARS = {
    "hd293396_unpolarized_standard_2025-11-03": (92, 22),
    "hd30675_polarized_standard_2025-02": (100, 15),
    "hd35532_unpolarized_standard": (100, 22),
}


@pytest.fixture
def table():
    table = example_table(derotator=(45.0, 90.0))
    table["flux_right"] *= np.linspace(1.0, 1.3, len(table))
    table["file"] = [f"cube{frame}.fits" for frame in table["frame"]]
    table["time"] = Time(60000.0 + np.asarray(table["frame"]) / 1440.0, format="mjd")
    return table


@pytest.fixture
def obs(table):
    return Observations.from_table(table, name="night")


def assert_same(first, second):
    for name in ("bin", "flux_right", "flux_left", "variance_right", "covariance", "mask"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert (first.wavelength == second.wavelength).all()
    assert first.frames.colnames == second.frames.colnames
    for name in first.frames.colnames:
        assert np.all(first.frames[name] == second.frames[name])
    assert first.meta == second.meta
    assert first.mask_reasons == second.mask_reasons
    assert first.content_hash == second.content_hash


def test_shapes_and_values(obs, table):
    assert (obs.n_frames, obs.n_bins, len(obs)) == (8, 3, 8)
    assert obs.bin.tolist() == [0, 1, 2]
    assert obs.wavelength.to_value(u.um).tolist() == [1.2, 1.6, 2.2]
    assert obs.flux_right.shape == obs.mask.shape == (8, 3)
    assert obs.flux_unit == u.adu
    for row in table:
        cell = row["frame"], row["bin"]
        assert obs.flux_right[cell] == row["flux_right"].value
        assert obs.flux_left[cell] == row["flux_left"].value
        assert obs.variance_left[cell] == row["flux_left_err"].value ** 2
    assert not obs.mask.any()
    assert obs.mask_reasons == {}
    assert np.isfinite(obs.variance_right).any()


def test_frames_hold_what_belongs_to_frames(obs):
    assert obs.frames.colnames == ["frame", "hwp", "derotator", "file", "time"]
    assert obs.frames["file"][3] == "cube3.fits"
    assert isinstance(obs.frames["time"], Time)
    # a copy: changing it changes nothing
    obs.frames["hwp"][0] = 99 * u.deg
    assert obs.position("hwp")[0] == 0


def test_names_and_meta(obs, table):
    assert (obs.name, obs.path) == ("night", None)
    assert (obs.instrument, obs.source) == ("example polarimeter", "polarized")
    assert obs.meta == {"instrument": "example polarimeter", "source": "polarized"}
    # absent or odd meta is none
    table.meta = {"instrument": 7}
    obs = Observations.from_table(table)
    assert obs.instrument is None
    assert obs.source is None


def test_position_is_in_radian(obs):
    np.testing.assert_allclose(obs.position("hwp")[:4], np.deg2rad([0, 22.5, 45, 67.5]))
    np.testing.assert_allclose(obs.position("derotator"), np.deg2rad([45.0] * 4 + [90.0] * 4))
    # position of another column
    with pytest.raises(ObservationError, match=r"night: no column 'rotator'.* are hwp, derotator"):
        obs.position("rotator")
    with pytest.raises(ObservationError, match="column file is not an angle"):
        obs.position("file")


def test_arrays_cannot_be_changed(obs):
    for array in (obs.flux_right, obs.flux_left, obs.mask, obs.variance_right, obs.pairs()):
        with pytest.raises(ValueError, match="read-only"):
            array[0, 0] = 1


def test_the_table_given_is_left_alone(table):
    before = table.copy()
    Observations.from_table(table).with_mask(np.ones((8, 3), bool) & [[True, False, False]], "x")
    assert (table == before).all()
    table["flux_right"][:] = 1 * u.adu
    assert before["flux_right"][0] != 1 * u.adu


def test_a_plain_table_works(obs, table):
    assert_same(Observations.from_table(Table(table)), obs)
    # the order of columns does not matter
    other = Observations.from_table(table[table.colnames[::-1]])
    assert other.content_hash == obs.content_hash
    # other units are the same content
    for name, unit in {"wavelength": u.nm, "hwp": u.arcmin, "derotator": u.rad}.items():
        table[name] = table[name].to(unit)
    assert Observations.from_table(table).content_hash == obs.content_hash


def test_the_order_of_rows_does_not_matter(obs, table):
    for seed in range(5):
        order = np.random.default_rng(seed).permutation(len(table))
        assert_same(Observations.from_table(table[order]), obs)


def test_wavelengths_ascend_whatever_the_order_of_the_bins(obs, table):
    table["bin"] = np.array([4, 9, 2])[table["bin"]]
    with pytest.warns(AstropolcalWarning, match="the wavelengths of its bins do not ascend"):
        found = Observations.from_table(table)
    np.testing.assert_array_equal(found.wavelength, obs.wavelength)
    np.testing.assert_array_equal(found.flux_left, obs.flux_left)
    # what is written needs no warning
    assert_same(Observations.from_table(found.to_table()), found)


def test_the_hash_sees_every_number_mask_selection_and_source(obs, table):
    hashes = {obs.content_hash, obs.with_mask(obs.position("hwp") == 0, "test").content_hash}
    hashes.add(obs.select([0, 1]).content_hash)
    other = table.copy()
    other.meta["source"] = "unpolarized"
    hashes.add(Observations.from_table(other).content_hash)
    assert len(hashes) == 4
    # which may change after it was asked for
    again = Observations.from_table(table)
    assert again.content_hash == obs.content_hash
    again.meta["source"] = "unpolarized"
    assert again.content_hash == Observations.from_table(other).content_hash
    for name in ["flux_right", "flux_left_err", "hwp", "wavelength"]:
        where = (table["frame"] == 0) if name == "hwp" else (table["bin"] == 0)
        table[name][where] += 1e-3 * table[name].unit
        assert Observations.from_table(table).content_hash != obs.content_hash, name


def test_the_hash_ignores_how_numbers_are_written(tmp_path, obs):
    obs.write(tmp_path / "one.ecsv")
    text = (tmp_path / "one.ecsv").read_text()
    assert " 22.5 " in text
    (tmp_path / "two.ecsv").write_text(text.replace(" 22.5 ", " 2.2500e+01 "))
    two = Observations.read(tmp_path / "two.ecsv")
    assert two.content_hash == obs.content_hash
    # nor in which scale moments are
    table, moments = obs.to_table(), Time(60000 + obs.to_table()["frame"] / 1440, format="mjd")
    found = []
    for time in (moments, moments.tai, moments + 37 * u.s):
        table["time"] = time
        found.append(Observations.from_table(table).content_hash)
    assert found[0] == found[1] != found[2]


def test_round_trip(tmp_path, obs):
    path = tmp_path / "copy.ecsv"
    obs.write(path)
    again = Observations.read(path)
    assert_same(again, obs)
    assert (again.name, again.path) == ("copy", path)
    assert list(tmp_path.iterdir()) == [path]
    assert "# - {name: hwp, unit: deg, datatype: float64}" in path.read_text()


def test_round_trip_with_masked_cells(tmp_path, obs):
    masked = obs.with_mask(obs.flux_right > 800, "too bright")
    masked = masked.with_mask(np.arange(8) == 1, "plate stuck")
    path = tmp_path / "masked.ecsv"
    masked.write(path)
    # declared reasons need no warning
    assert_same(Observations.read(path), masked)
    assert set(masked.mask_reasons) == {"too bright", "plate stuck"}


def test_round_trip_with_a_missing_cell(tmp_path, table):
    with pytest.warns(AstropolcalWarning, match="1 cell masked, missing"):
        obs = Observations.from_table(table[:-1])
    obs.write(tmp_path / "missing.ecsv")
    assert_same(Observations.read(tmp_path / "missing.ecsv"), obs)


def test_a_wavelength_without_a_usable_cell_is_left_out(obs, table):
    table["mask_reason"] = np.where(table["bin"] == 1, "absorbed", "")
    with pytest.warns(AstropolcalWarning, match=r"no usable cell at 1600 nm; left out"):
        left = Observations.from_table(table)
    assert_same(left, obs.select_bins([True, False, True]))


def test_round_trip_with_single_errors(tmp_path, table):
    table["single_difference_err"] = table["flux_right_err"] * 1.1
    table["single_sum_err"] = table["flux_right_err"]
    table.remove_columns(["flux_right_err", "flux_left_err"])
    obs = Observations.from_table(table)
    obs.write(tmp_path / "single.ecsv")
    assert (obs.covariance < 0).all()
    assert_same(Observations.read(tmp_path / "single.ecsv"), obs)


def test_write_replaces_only_when_told(tmp_path, obs):
    path = tmp_path / "file.ecsv"
    path.write_text("precious")
    with pytest.raises(ObservationError, match=r"file.ecsv: exists already; .*overwrite=True"):
        obs.write(path)
    assert path.read_text() == "precious"
    obs.write(path, overwrite=True)
    assert Observations.read(path).content_hash == obs.content_hash


def test_a_failed_write_leaves_the_old_file(tmp_path, table):
    path = tmp_path / "file.ecsv"
    path.write_text("precious")
    table.meta["culprit"] = object()
    with pytest.raises(ObservationError, match=r"file.ecsv: cannot be written"):
        Observations.from_table(table).write(path, overwrite=True)
    assert path.read_text() == "precious"
    assert list(tmp_path.iterdir()) == [path]


def test_with_mask(obs):
    where = np.zeros((8, 3), bool)
    where[2, 1] = True
    masked = obs.with_mask(where, " hot pixel ")
    assert masked.mask_reasons == {"hot pixel": 1}
    np.testing.assert_array_equal(masked.mask, where)
    for name in ("flux_right", "flux_left", "variance_right", "variance_left", "covariance"):
        np.testing.assert_array_equal(np.isnan(getattr(masked, name)), where)
    assert not obs.mask.any()
    assert masked.name == obs.name


def test_cells_keep_their_first_reason(obs):
    first = obs.with_mask(obs.position("hwp") == 0, "first")
    second = first.with_mask(obs.position("derotator") > 1, "second")
    assert second.mask_reasons == {"first": 6, "second": 9}
    assert second.with_mask(np.arange(8) == 1, "first").mask_reasons == {"first": 9, "second": 9}


def test_with_mask_refuses(obs):
    for mask, reason, match in [
        (np.zeros((3, 8), bool), "x", r"shape \(3, 8\); allowed are booleans of shape \(8, 3\)"),
        (np.zeros(8, int), "x", "mask of type int64"),
        (np.zeros(8, bool), " ", "reason = ' ', some words"),
        (np.zeros(8, bool), None, "reason = None"),
        (np.ones(8, bool), "cloud", "masking 'cloud' would leave no usable cell of 24"),
    ]:
        with pytest.raises(ObservationError, match=match):
            obs.with_mask(mask, reason)


def test_select_by_boolean_and_index(obs):
    chosen = obs.select(obs.position("derotator") > 1)
    assert chosen.frames["frame"].tolist() == [4, 5, 6, 7]
    assert_same(chosen, obs.select([7, -2, 5, 4]))
    np.testing.assert_array_equal(chosen.flux_right, obs.flux_right[4:])
    np.testing.assert_array_equal(chosen.variance_left, obs.variance_left[4:])
    assert chosen.pairs().tolist() == [[0, 2], [1, 3]]


def test_select_keeps_masks(obs):
    masked = obs.with_mask(np.arange(8) < 2, "test")
    assert masked.select([1, 2]).mask_reasons == {"test": 3}
    assert masked.select([5, 6]).mask_reasons == {}


def test_select_refuses(obs):
    for frames, match in [
        ([8], "frame index 8, allowed are 0 to 7"),
        ([1, 1], "frame index 1 is given twice"),
        ([-1, 7], "frame index 7 is given twice"),
        ([0.5], "frames of type float64"),
        ([True], r"bool and shape \(1,\); allowed are 8 booleans"),
        ([0, 1], "the 2 frames selected have no usable cell"),
    ]:
        with pytest.raises(ObservationError, match=match):
            obs.with_mask(np.arange(8) < 2, "test").select(frames)
    with pytest.raises(ObservationError, match="the 0 frames selected"):
        obs.select(np.zeros(8, bool))


def test_pairs_are_kept(obs):
    assert obs.pairs().tolist() == [[0, 2], [1, 3], [4, 6], [5, 7]]
    assert obs.pairs() is obs.pairs(0.3 * u.deg)
    assert obs.pairs(share=True) is not obs.pairs()


def test_pairs_warn_once(obs):
    lacking = obs.select([0, 1, 2, 4, 5, 6, 7])
    with pytest.warns(AstropolcalWarning, match=r"night: 1 of 7 .* frame 1 \(hwp 22.5 deg\)"):
        lacking.pairs()
    assert lacking.pairs().tolist() == [[0, 2], [3, 5], [4, 6]]


def test_pairs_name_file_and_row(tmp_path, obs):
    obs.write(tmp_path / "night.ecsv")
    lacking = Observations.read(tmp_path / "night.ecsv").select([0, 2, 3])
    # frame 3 starts in row 10 of the file
    with pytest.raises(ObservationError, match=r"night.ecsv, row 10: hwp = 67.5 deg has no part"):
        lacking.pairs()


def test_pairs_allow_half_a_degree_of_derotator_drift():
    table = example_table(hwp=(0.0, 45.0), wavelength=(1.6,))
    table["derotator"] = [90.0, 90.45] * u.deg
    assert Observations.from_table(table).pairs().tolist() == [[0, 1]]
    table["derotator"] = [90.0, 90.55] * u.deg
    obs = Observations.from_table(table)
    with pytest.warns(AstropolcalWarning), pytest.raises(ObservationError, match="can be paired"):
        obs.pairs()
    assert obs.pairs(derotator_tolerance=1 * u.deg).tolist() == [[0, 1]]


def test_pairs_respect_time_and_modulator():
    table = example_table(hwp=(0.0, 45.0, 45.0, 0.0), wavelength=(1.6,))
    assert Observations.from_table(table).pairs().tolist() == [[0, 1], [3, 2]]
    table["time"] = [0.0, 9.0, 1.0, 8.0] * u.s
    assert Observations.from_table(table).pairs().tolist() == [[0, 2], [3, 1]]
    table["flc_state"] = ["A", "A", "B", "B"]
    assert Observations.from_table(table).pairs().tolist() == [[0, 1], [3, 2]]
    # times as text are left to the sequence
    table = example_table(hwp=(0.0, 45.0, 45.0, 0.0), wavelength=(1.6,))
    table["time"] = ["2025-10-05T09", "2025-10-05T01", "x", "y"]
    assert Observations.from_table(table).pairs().tolist() == [[0, 1], [3, 2]]


def test_repr_and_summary(obs):
    masked = obs.with_mask(np.arange(8) == 0, "cloud")
    assert repr(masked) == (
        "<Observations 'night': example polarimeter, polarized, 8 frames x 3 bins, 3 cells masked>"
    )
    page = masked._repr_html_()
    assert page.startswith("<p>Observations &#x27;night&#x27;: example polarimeter")
    assert "<th>derotator</th>" in page
    lines = masked.summary().splitlines()
    assert "derotator: 45, 90 deg" in lines
    assert "errors: flux_right_err and flux_left_err" in lines
    assert "masked, cloud: 3 cells" in lines
    # many angles are a range
    table = example_table(hwp=np.arange(0, 180, 11.25))
    assert "hwp: 0 to 168.75 deg" in Observations.from_table(table).summary()


@needs_shared
def test_internal_datasets_pair_as_in_the_paper():
    for name in INTERNAL:
        obs = Observations.read(CHARIS / f"{name}.ecsv")
        assert (obs.n_frames, obs.n_bins) == (64, 22), name
        plus, minus = obs.pairs().T
        assert len(plus) == 32, name
        hwp, derotator = np.rad2deg(obs.position("hwp")), np.rad2deg(obs.position("derotator"))
        assert sorted(set(hwp[plus].round(6))) == [0, 11.25, 22.5, 33.75], name
        np.testing.assert_allclose(hwp[minus] - hwp[plus], 45.0)
        np.testing.assert_array_equal(derotator[plus], derotator[minus])
        assert obs.instrument == "SCExAO/CHARIS", name
        assert obs.source == name.split("_")[1], name


@needs_shared
def test_stars_pair_within_a_cycle():
    for name in STARS:
        obs = Observations.read(CHARIS / f"{name}.ecsv")
        assert (obs.n_frames, obs.n_bins) == STARS[name], name
        plus, minus = obs.pairs().T
        assert sorted(set(np.rad2deg(obs.position("hwp"))[plus].round(6))) == [0, 22.5], name
        # HWP 0, 45, 22.5, 67.5 in this order: a pair is two exposures in a row
        np.testing.assert_array_equal(minus, plus + 1)
        assert 2 * len(plus) == obs.n_frames, name
        assert np.isfinite(obs.position("parallactic")).all(), name
        assert np.ptp(obs.position("altitude")) > 0, name


@pytest.mark.slow
@needs_shared
def test_real_tables_survive_everything(tmp_path):
    for name in [*INTERNAL, *STARS]:
        table = QTable.read(CHARIS / f"{name}.ecsv")
        obs = Observations.read(CHARIS / f"{name}.ecsv")
        shuffled = table[np.random.default_rng(3).permutation(len(table))]
        assert_same(Observations.from_table(shuffled), obs)
        obs.write(tmp_path / "copy.ecsv", overwrite=True)
        assert_same(Observations.read(tmp_path / "copy.ecsv"), obs)
        # var(R) + var(L) is the mean square of the errors that the authors give
        cell = table["frame"][100] - table["frame"].min(), table["bin"][100] - table["bin"].min()
        both = (obs.variance_right + obs.variance_left)[cell]
        errors = [table[error][100].value for error in ("single_difference_err", "single_sum_err")]
        assert both == pytest.approx(np.mean(np.square(errors)), rel=1e-12)


@needs_shared
def test_normalized_double_difference_of_dataset_3():
    obs = Observations.read(CHARIS / "dataset3_polarized_2025-10-05.ecsv")
    frames = obs.pairs().T
    right, left = (np.swapaxes(f[frames], 1, 2) for f in (obs.flux_right, obs.flux_left))
    x = get_observable("normalized_double_difference").evaluate(right, left)
    assert x.shape == (22, 32)
    # by hand from rows 1 and 2: derotator 45 deg, HWP 0 and 45 deg, 1159.56 nm
    r, left = (634878.4902422975, 1423733.4334362894), (1318996.3010501417, 610180.1966679624)
    expected = ((r[0] - left[0]) - (r[1] - left[1])) / (sum(r) + sum(left))
    assert x[0, 0] == pytest.approx(expected, rel=1e-12)


@needs_shared
def test_simulated_cases_read():
    for source in ["polarized", "unpolarized"]:
        path = SHARED / "gap-cases" / "case000" / f"{source}.ecsv"
        obs = Observations.read(path)
        assert (obs.source, obs.pairs().shape) == (source, (32, 2)), source
        assert (obs.covariance == 0).all(), source
