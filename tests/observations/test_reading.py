# Licensed under a 3-clause BSD style license - see LICENSE
"""Bad tables: one line that names the file, the place and what is allowed."""

import datetime
import re
import time
import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import EarthLocation, SkyCoord
from astropy.table import QTable, Table, vstack
from astropy.utils.masked import Masked

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations import Observations, example_table
from astropolcal.observations.reading import numeric_column


@pytest.fixture
def table():
    return example_table()


def from_file(table, folder):
    """Write a table as it is and read it as observations."""
    path = folder / "night.ecsv"
    table.write(path, format="ascii.ecsv", overwrite=True)
    return Observations.read(path)


def test_copies_of_frames_in_a_file_are_told_of(table, tmp_path):
    rng = np.random.default_rng(1)
    for name in ("flux_right", "flux_left"):
        table[name] *= rng.uniform(0.9, 1.1, len(table))
    from_file(table, tmp_path)
    again = table[table["frame"] == 2]
    again["frame"] = 7
    with pytest.warns(AstropolcalWarning, match="1 frame with exactly .*frame 7 those of frame 2"):
        from_file(vstack([table, again]), tmp_path)


def refuse(table, match):
    with pytest.raises(ObservationError, match=match) as info:
        Observations.from_table(table, path="night.ecsv")
    message = str(info.value)
    assert message.startswith("night.ecsv")
    assert "\n" not in message
    return message


def set_row(table, name, row, value):
    """Return a table of which one value is replaced, whatever its type."""
    column = np.array(getattr(table[name], "value", table[name]), dtype=float)
    column[row] = value
    unit = getattr(table[name], "unit", None)
    table[name] = column if unit is None else column * unit
    return table


# ---- files -----------------------------------------------------------------------------------


def test_what_is_no_file(tmp_path):
    with pytest.raises(ObservationError, match=r"nowhere.ecsv: no such file"):
        Observations.read(tmp_path / "nowhere.ecsv")
    with pytest.raises(ObservationError, match="is a folder, not a file"):
        Observations.read(tmp_path)
    for path in [None, 7, "a\0b"]:
        with pytest.raises(ObservationError, match="cannot be read"):
            Observations.read(path)


def test_not_a_table(tmp_path):
    for content, match in [
        (b"", "not an ECSV table; its first line must start with '# %ECSV'"),
        (b"frame,bin\n0,0\n", "not an ECSV table"),
        (b"\x80\x04\x95\x10pickle", "not a text file"),
        (b"\x89PNG\r\n\x1a\n\0\0\xff", "not a text file"),
        (b"# %ECSV 1.0\n", "not a readable ECSV table"),
        (b"# %ECSV 1.0\n# ---\n", "its header describes no columns"),
        (b"# %ECSV 1.0\n# ---\n# datatype: [\n", "not a readable ECSV table"),
        (b"# %ECSV 1.0\n# ---\n# {a: *b}\nframe\n", "not a readable ECSV table"),
        (
            b"# %ECSV 1.0\n# ---\n# datatype:\n# - {name: a, datatype: int64}\na\nx\n",
            "row 1: a = x, all",
        ),
        (b"# %ECSV 1.0\n# ---\n# datatype:\n# - {name: a, datatype: int64}\na\n1\n", "missing col"),
    ]:
        path = tmp_path / "night.ecsv"
        path.write_bytes(content)
        with pytest.raises(ObservationError, match=match) as info:
            Observations.read(path)
        assert str(info.value).startswith(str(path)), (content, match)
        assert "\n" not in str(info.value), (content, match)


def test_a_table_that_was_cut_off(tmp_path, table):
    path = tmp_path / "night.ecsv"
    table.write(path, format="ascii.ecsv")
    lines = path.read_text().splitlines()
    lines[-2] = lines[-2].rsplit(" ", 1)[0]
    path.write_text("\n".join(lines))
    with pytest.raises(ObservationError, match=r"inconsistent with data columns .* at data line"):
        Observations.read(path)
    # in the header
    table.write(path, format="ascii.ecsv", overwrite=True)
    text = path.read_text()
    path.write_text(text[: text.index("meta")])
    with pytest.raises(ObservationError, match="not a readable ECSV table"):
        Observations.read(path)


def test_a_huge_header_is_refused_at_once(tmp_path):
    path = tmp_path / "night.ecsv"
    column = "# - {name: c, datatype: float64}\n"
    path.write_text("# %ECSV 1.0\n# ---\n# datatype:\n" + column * 10**5 + "c\n1\n")
    start = time.perf_counter()
    with pytest.raises(ObservationError, match="the header is longer than the 262144 characters"):
        Observations.read(path)
    assert time.perf_counter() - start < 2


def test_a_header_that_would_explode_is_refused(tmp_path):
    levels = ["# a0: &a0 {x: 1, y: 2}"]
    levels += [f"# a{i}: &a{i} {{<<: [*a{i - 1}, *a{i - 1}, *a{i - 1}]}}" for i in range(1, 40)]
    path = tmp_path / "night.ecsv"
    path.write_text("\n".join(["# %ECSV 1.0", "# ---", *levels, "c", "1"]))
    with pytest.raises(ObservationError, match="merge keys"):
        Observations.read(path)


def test_a_header_that_promises_giant_arrays_is_refused(tmp_path):
    path = tmp_path / "night.ecsv"
    column = "{name: c, datatype: string, subtype: 'float64[1000000000,1000]'}"
    path.write_text(f"# %ECSV 1.0\n# ---\n# datatype:\n# - {column}\nc\n[1]\n")
    start = time.perf_counter()
    with pytest.raises(ObservationError, match=r"night.ecsv"):
        Observations.read(path)
    assert time.perf_counter() - start < 2


def test_a_header_that_calls_python_is_refused(tmp_path):
    path, trace = tmp_path / "night.ecsv", tmp_path / "trace"
    call = (
        f"!!python/object/apply:pathlib.Path.touch [!!python/object/apply:pathlib.Path [{trace}]]"
    )
    column = "{name: c, datatype: int64}"
    path.write_text(f"# %ECSV 1.0\n# ---\n# datatype:\n# - {column}\n# meta: {call}\nc\n1\n")
    with pytest.raises(ObservationError, match="not a readable ECSV table"):
        Observations.read(path)
    assert not trace.exists()


def test_columns_of_objects_are_refused(tmp_path, table):
    table["extra"] = np.array([{"a": 1}] * len(table), dtype=object)
    with pytest.raises(ObservationError, match="column extra has type object; allowed are numbers"):
        from_file(table, tmp_path)


def test_numbers_that_only_python_reads_are_refused(tmp_path, table):
    """Underscores and digits of other scripts, with either delimiter; texts may have them."""
    path = tmp_path / "night.ecsv"
    table["file"] = [f"2025_10_05_{i}.fits" for i in table["frame"]]
    for delimiter in (" ", ","):
        table.write(path, format="ascii.ecsv", delimiter=delimiter, overwrite=True)
        text = path.read_text()
        assert Observations.read(path).n_frames
        lines = text.splitlines()
        cells = lines[-2].split(delimiter)
        for column in ("frame", "hwp", "flux_right"):
            place = table.colnames.index(column)
            for value in ("4_5", "\u0664\u0665", "\uff14"):
                spoiled = [*cells[:place], value, *cells[place + 1 :]]
                path.write_text("\n".join([*lines[:-2], delimiter.join(spoiled), lines[-1]]))
                with pytest.raises(ObservationError) as caught:
                    Observations.read(path)
                words = f"{path}, row {len(table) - 1}: {column} = {value}, allowed are numbers"
                assert str(caught.value).startswith(words)


def test_dates_of_the_meta_are_read_or_refused(tmp_path, table):
    path = tmp_path / "night.ecsv"
    for date in ("2025-10-05", "20251005", 60953, datetime.date(2025, 10, 5)):
        table.meta["date"] = date
        table.write(path, format="ascii.ecsv", overwrite=True)
        assert Observations.read(path).meta["date"] == "2025-10-05"
    for date in ("2025-10", None, " "):
        table.meta["date"] = date
        assert Observations.from_table(table).meta["date"] == date
    for date in ("5 Oct 2025", "2025-10-05T25:00", "0000-00-00", 5):
        table.meta["date"] = date
        assert repr(date) in refuse(table, "date in the meta = .* is not a date; allowed are 2025")
        table.write(path, format="ascii.ecsv", overwrite=True)
        with pytest.raises(ObservationError, match="is not a date") as caught:
            Observations.read(path)
        assert str(caught.value).startswith(f"{path}: date")


# ---- columns ---------------------------------------------------------------------------------


def test_not_a_table_in_memory():
    with pytest.raises(ObservationError, match="x: a dict, an astropy Table is needed"):
        Observations.from_table({}, name="x")


def test_all_missing_columns_are_named(table):
    table.remove_columns(["hwp", "bin", "flux_left"])
    message = refuse(table, "missing columns bin, flux_left; it has frame, wavelength")
    assert "derotator" in message
    # a table without rows
    refuse(example_table()[:0], "the table is empty, at least one row")
    # a table without columns
    refuse(QTable(), "missing columns frame, .*; it has none")


def test_columns_without_unit():
    for name in ["wavelength", "hwp", "derotator", "flux_left", "flux_right_err"]:
        table = example_table()
        table[name] = table[name].value
        refuse(table, f"column {name} has no unit, a unit such as ")


def test_columns_with_a_wrong_unit():
    for name, unit, match in [
        ("wavelength", u.deg, "column wavelength has unit deg, a unit such as um is needed"),
        ("wavelength", u.Hz, "column wavelength has unit Hz"),
        ("hwp", u.um, "column hwp has unit um, a unit such as deg is needed"),
        ("derotator", u.s, "column derotator has unit s"),
        ("flux_left", u.Jy, "left has unit Jy, a unit such as adu is needed, as flux_right has it"),
        ("flux_left_err", u.deg, "column flux_left_err has unit deg"),
        ("flux_right", u.mag, "column flux_(right|left)"),
    ]:
        table = example_table()
        table[name] = table[name].value * unit
        refuse(table, match)


def test_an_unknown_unit_in_a_file(tmp_path, table):
    path = tmp_path / "night.ecsv"
    table.write(path, format="ascii.ecsv")
    path.write_text(path.read_text().replace("unit: um", "unit: furlongs"))
    with pytest.raises(ObservationError, match="column wavelength has unit furlongs"):
        Observations.read(path)


def test_fluxes_may_lack_a_unit_together(table):
    for name in table.colnames[-4:]:
        table[name] = table[name].value
    obs = Observations.from_table(table)
    assert obs.flux_unit == u.dimensionless_unscaled
    assert np.isfinite(obs.variance_right).all()


def test_the_left_flux_is_converted_to_the_unit_of_the_right(table):
    table["flux_left"] = (table["flux_left"].value / 1000) * (1000 * u.adu)
    obs = Observations.from_table(table)
    np.testing.assert_allclose(obs.flux_left, Observations.from_table(example_table()).flux_left)


def test_columns_that_are_not_numbers():
    for name in ["frame", "bin", "wavelength", "hwp", "flux_right"]:
        table = example_table()
        table[name] = [f"x{i}" for i in range(len(table))]
        refuse(table, f"column {name} has type <U3, numbers are needed")
    # complex and boolean columns
    table = example_table()
    table["flux_right"] = table["flux_right"] * (1 + 0j)
    refuse(table, "column flux_right has type complex128")
    table["flux_right"] = np.ones(len(table), bool)
    refuse(table, "column flux_right has type bool")
    # coordinates are not numbers
    table = example_table()
    table["hwp"] = SkyCoord([0] * len(table) * u.deg, [0] * len(table) * u.deg)
    refuse(table, "column hwp has type SkyCoord, numbers are needed")
    # columns with more than one value a row
    table = example_table()
    table["flux_right"] = np.ones((len(table), 2)) * u.adu
    refuse(table, r"column flux_right has shape \(12, 2\), one value per row is allowed")
    # fluxes are linear
    table["flux_right"] = u.Magnitude(np.ones(len(table)) * u.adu)
    refuse(table, r"column flux_right has unit mag\(adu\), a linear unit such as adu is needed")
    for unit in (u.mag, u.dex, u.dB):
        for name in [name for name in table.colnames if name.startswith("flux")]:
            table[name] = np.ones(len(table)) * unit
        refuse(table, f"column flux_right has unit {unit}, a linear unit such as adu is needed")


def test_some_of_the_errors(table):
    for one, other in [("flux_right_err", "flux_left_err")]:
        table.remove_column(other)
        refuse(table, f"missing column {other}; it has {one}")
    # of the single ones
    table = example_table()
    table["single_sum_err"] = table["flux_right_err"]
    table.remove_columns(["flux_right_err", "flux_left_err"])
    refuse(table, "missing column single_difference_err; it has single_sum_err")


def test_no_errors_at_all(table):
    table.remove_columns(["flux_right_err", "flux_left_err"])
    obs = Observations.from_table(table)
    assert np.isnan(obs.variance_right).all()
    assert not obs.mask.any()


def test_errors_of_beams_difference_and_sum_tell_what_the_beams_share(table):
    right, left = (table[f"flux_{beam}_err"] for beam in ("right", "left"))
    shared = 0.2 * right * left
    table["single_difference_err"] = np.sqrt(right**2 + left**2 - 2 * shared)
    table["single_sum_err"] = np.sqrt(right**2 + left**2 + 2 * shared)
    obs = Observations.from_table(table)
    alone = Observations.from_table(
        table[
            "frame",
            "bin",
            "wavelength",
            "hwp",
            "derotator",
            "flux_right",
            "flux_left",
            "flux_right_err",
            "flux_left_err",
        ]
    )
    for name in ("variance_right", "variance_left"):
        np.testing.assert_allclose(getattr(obs, name), getattr(alone, name))
    np.testing.assert_allclose(
        obs.covariance, 0.2 * np.sqrt(obs.variance_right * obs.variance_left), rtol=1e-9
    )
    # those of the beams win
    table["single_sum_err"] = table["single_difference_err"] = 9 * right
    with pytest.warns(AstropolcalWarning, match="single_sum_err add up to .* not to twice as much"):
        obs = Observations.from_table(table)
    np.testing.assert_allclose(obs.variance_right, obs.flux_right)
    assert (obs.covariance == 0).all()


# ---- rows ------------------------------------------------------------------------------------


def test_values_that_must_be_finite():
    for name in ["frame", "bin", "wavelength", "hwp", "derotator"]:
        for value in [np.nan, np.inf, -np.inf]:
            table = example_table()
            refuse(set_row(table, name, 4, value), rf"row 5: {name} = {value}( um)?, allowed are ")


def test_angles_on_sky_must_be_finite_angles():
    for name in ["parallactic", "altitude"]:
        table = example_table()
        table[name] = np.ones(len(table)) * u.deg
        refuse(set_row(table, name, 1, np.nan), f"row 2: {name} = nan, allowed are finite angles")
        table[name] = np.ones(len(table)) * u.m
        refuse(table, f"column {name} has unit m, a unit such as deg")
    # angles keep their digits
    refuse(
        set_row(example_table(), "hwp", 0, 1e9),
        r"row 1: hwp = 1000000000.0, allowed are .* 1e\+06 deg",
    )


def test_masked_values_that_must_be_finite(tmp_path):
    for name in ["frame", "hwp", "wavelength"]:
        table = example_table()
        mask = np.arange(len(table)) == 2
        column = table[name]
        table[name] = np.ma.MaskedArray(column, mask) if name == "frame" else Masked(column, mask)
        with pytest.raises(ObservationError, match=rf"night.ecsv, row 3: {name} = nan"):
            from_file(table, tmp_path)


def test_frames_are_whole_numbers(table):
    refuse(set_row(table, "frame", 3, 0.5), "row 4: frame = 0.5, allowed are whole numbers")
    table = example_table()
    table["frame"] = table["frame"].astype(float)
    assert Observations.from_table(table).frames["frame"].dtype == np.int64


def test_wavelengths_are_positive(table):
    for value in [0.0, -1.6, 1e-300, 1e300]:
        match = re.escape(f"row 1: wavelength = {value:g} um, allowed are lengths above zero")
        refuse(set_row(table, "wavelength", 0, value), match)


def test_a_cell_given_twice(table):
    table["frame"][7] = 1
    table["hwp"][7] = 22.5 * u.deg
    refuse(table, "row 8: frame = 1, bin = 1 is given already in row 5; one row per frame and bin")


def test_a_bin_with_two_wavelengths(table):
    table["wavelength"][5] += 1e-4 * u.um
    refuse(table, r"row 6: wavelength = 2.2001 um in bin 2, other rows of this bin have 2.2 um")
    # rounded wavelengths are the same
    table = example_table()
    table["wavelength"][5] *= 1 + 5e-7
    assert Observations.from_table(table).wavelength[2].value == 2.2


def test_how_near_two_bins_may_be(table):
    for unit in [u.nm, u.um, u.m]:
        for ratio, distinct in [(1 + 5e-7, False), (1 + 5e-6, True)]:
            table["wavelength"] = np.array([1.2, 1.6, 1.6 * ratio])[table["bin"]] * u.um
            table["wavelength"] = table["wavelength"].to(unit)
            if distinct:
                assert Observations.from_table(table).n_bins == 3, (ratio, distinct, unit)
            else:
                refuse(table, r"row 3: wavelength = .* of bin 2 is also that of bin 1")


def test_columns_of_frames_are_constant():
    for name in ["hwp", "derotator"]:
        table = example_table()
        table[name][4] += 1 * u.deg
        refuse(
            table, rf"row 5: {name} = .* deg in frame 1, but .* deg in row 4; one value per frame"
        )
    # other columns
    table = example_table()
    table["file"] = [f"cube{i}" for i in range(len(table))]
    refuse(table, "row 2: file = cube1 in frame 0, but cube0 in row 1; one value per frame")


def test_coordinates_of_frames(tmp_path, table):
    right_ascension = np.where(table["frame"] == 0, 10.0, 20.0) * u.deg
    table["target"] = SkyCoord(right_ascension, np.zeros(len(table)) * u.deg)
    obs = from_file(table, tmp_path)
    assert obs.frames["target"].ra.to_value(u.deg).tolist() == [10.0, 20.0, 20.0, 20.0]
    assert len(obs.content_hash) == 64
    table["target"] = SkyCoord(np.arange(len(table)) * u.deg, np.zeros(len(table)) * u.deg)
    refuse(table, "row 2: target = .* in frame 0, but ")


def test_structured_columns_are_refused(table):
    table["site"] = EarthLocation.from_geodetic(*np.zeros((2, len(table))) * u.deg)
    refuse(table, "column site has type .*'x', '<f8'.*; allowed are numbers, strings and times")


def test_unknown_values_of_frames_agree(table):
    table["seeing"] = np.where(table["frame"] == 1, np.nan, 0.5) * u.arcsec
    table["comment"] = np.ma.MaskedArray(["clear"] * len(table), table["frame"] == 0)
    frames = Observations.from_table(table).frames
    assert np.isnan(frames["seeing"][1])
    assert frames["comment"].mask.tolist() == [True, False, False, False]
    table["comment"].mask[0] = False
    refuse(table, "row 2: comment = ")


def test_negative_errors(table):
    table["flux_left_err"][8] *= -1
    refuse(table, r"row 9: flux_left_err = -.*, allowed are errors above zero")


def test_a_grid_that_is_nearly_all_holes():
    n = 5000
    table = QTable(
        {
            "frame": np.arange(n),
            "bin": np.arange(n),
            "wavelength": np.linspace(1, 2, n) * u.um,
            "hwp": np.zeros(n) * u.deg,
            "derotator": np.zeros(n) * u.deg,
            "flux_right": np.ones(n) * u.adu,
            "flux_left": np.ones(n) * u.adu,
        }
    )
    refuse(table, "5000 rows for 5000 frames and 5000 bins; at least one in 20")


# ---- masked cells ----------------------------------------------------------------------------


def test_bad_cells_are_masked_with_a_reason():
    for name, value, reason in [
        ("flux_right", np.nan, "flux not finite"),
        ("flux_left", np.inf, "flux not finite"),
        ("flux_left", 1e300, "flux not finite"),
        ("flux_left_err", 1e-320, "error not positive"),
        ("flux_right", 0.0, "flux not positive"),
        ("flux_left", -3.0, "flux not positive"),
        ("flux_right_err", np.nan, "error not finite"),
        ("flux_left_err", np.inf, "error not finite"),
        ("flux_left_err", 0.0, "error not positive"),
    ]:
        # rows 5 and 8: frames 1 and 2, bin 1
        table = example_table()
        for row in (4, 7):
            table = set_row(table, name, row, value)
        match = (
            rf"night: 2 cells masked, {reason} \(first: row 5: .*{re.escape(f'{name} = {value:g}')}"
        )
        with pytest.warns(AstropolcalWarning, match=match) as record:
            obs = Observations.from_table(table, name="night")
        assert len(record) == 1, (name, value, reason)
        assert np.argwhere(obs.mask).tolist() == [[1, 1], [2, 1]], (name, value, reason)
        assert obs.mask_reasons == {reason: 2}, (name, value, reason)
        assert np.isnan(obs.flux_right[1, 1]), (name, value, reason)
        assert np.isnan(obs.flux_left[1, 1]), (name, value, reason)
        assert np.isnan(obs.variance_left[1, 1]), (name, value, reason)
        assert np.isfinite(obs.variance_left[~obs.mask]).all(), (name, value, reason)


def test_masked_values_of_a_file_are_masked(tmp_path, table):
    table["flux_left"] = Masked(table["flux_left"], np.arange(len(table)) == 1)
    with pytest.warns(AstropolcalWarning, match="1 cell masked, flux not finite"):
        obs = from_file(table, tmp_path)
    assert np.argwhere(obs.mask).tolist() == [[0, 1]]


def test_one_warning_for_each_reason(table):
    table["flux_left"][0] = np.nan
    table["flux_left"][1] = 0 * u.adu
    with pytest.warns(AstropolcalWarning) as record:
        obs = Observations.from_table(table)
    assert [re.search("masked, ([a-z ]+)", str(w.message))[1].strip() for w in record] == [
        "flux not finite",
        "flux not positive",
    ]
    assert obs.mask_reasons == {"flux not finite": 1, "flux not positive": 1}


def test_missing_rows_are_masked(table):
    table.remove_rows([5, 6])
    with pytest.warns(
        AstropolcalWarning, match=r"2 cells masked, missing \(first: frame 1, bin 2 has no row"
    ):
        obs = Observations.from_table(table)
    assert obs.mask_reasons == {"missing": 2}
    assert np.argwhere(obs.mask).tolist() == [[1, 2], [2, 0]]


def test_all_cells_masked(table):
    table["flux_left"][:] = np.nan
    with pytest.warns(AstropolcalWarning, match="12 cells masked"):
        refuse(table, r"all 12 cells are masked \(flux not finite\), at least one usable cell")


def test_a_column_of_reasons_must_be_text(table):
    table["mask_reason"] = 1
    refuse(table, "column mask_reason has type int64, strings are needed")


def test_numeric_column_copies(table):
    values = numeric_column(table, "hwp", "x", u.deg)
    values[:] = 1
    assert table["hwp"][0] == 0


# ---- damaged files ---------------------------------------------------------------------------


VALUES = "nan inf -inf 0 -1 1e308 1e-320 0.1 45 180 -0.0 2 x True 99999999999999999999".split()


@pytest.mark.slow
def test_wrong_values_end_in_an_error_or_a_sound_table(tmp_path):
    table = example_table()
    path, copy = tmp_path / "night.ecsv", tmp_path / "copy.ecsv"
    Table(table).write(path, format="ascii.ecsv", overwrite=True)
    head, body = path.read_text().split("\nframe")
    rows = [line.split(" ") for line in body.splitlines()]
    rng = np.random.default_rng(0)
    sound = 0
    for _ in range(100):
        wrong = [list(row) for row in rows]
        row, column = rng.integers(1, len(rows)), rng.integers(len(rows[0]))
        for index in range(1, len(rows)) if rng.random() < 0.4 else [row]:
            wrong[index][column] = VALUES[rng.integers(len(VALUES))]
        path.write_text(head + "\nframe" + "\n".join(" ".join(row) for row in wrong))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropolcalWarning)
            try:
                obs = Observations.read(path)
            except ObservationError as error:
                assert str(error).startswith(str(path)), str(error)  # noqa: PT017
                continue
        obs.write(copy, overwrite=True)
        assert Observations.read(copy).content_hash == obs.content_hash
        assert (obs.variance_right[~obs.mask] > 0).all()
        sound += 1
    assert 5 < sound < 60


PRINTABLE = list(b" \n\t#:{}[]-.,eE0123456789\"'&*!|%")


def damaged(content, rng, start=0):
    """Return the bytes of a file after a few random accidents behind ``start``."""
    data = bytearray(content)
    for _ in range(rng.integers(1, 4)):
        if len(data) <= start:
            break
        at = int(rng.integers(start, len(data)))
        match rng.integers(8):
            case 0:
                data[at] = int(rng.integers(256))
            case 1:
                del data[at : at + int(rng.integers(1, 30))]
            case 2:
                data[at:at] = data[at : at + int(rng.integers(1, 60))]
            case 3 if rng.random() < 0.3:
                del data[at:]
            case _:
                data[at] = int(rng.choice(PRINTABLE))
    return bytes(data)


@pytest.mark.slow
def test_damaged_files_end_in_one_kind_of_error(tmp_path):
    for part in ["anywhere", "rows"]:
        table = example_table()
        table["file"] = [f"cube{frame}.fits" for frame in table["frame"]]
        path = tmp_path / "night.ecsv"
        Table(table).write(path, format="ascii.ecsv", overwrite=True)
        content = path.read_bytes()
        start = content.index(b"\nframe") if part == "rows" else 0
        rng = np.random.default_rng(0)
        messages = []
        for _ in range(100):
            path.write_bytes(damaged(content, rng, start))
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                warnings.simplefilter("ignore", AstropolcalWarning)
                try:
                    obs = Observations.read(path)
                    assert len(obs.content_hash) == 64, part
                    assert obs.summary().startswith("night: "), part
                    assert np.isfinite(obs.flux_right[~obs.mask]).all(), part
                    obs.pairs()
                except ObservationError as error:
                    messages.append(str(error))
        # damage in a value may go unseen, damage of the structure may not
        assert 20 < len(messages) < 100, part
        assert all(message.startswith(f"{path}") and "\n" not in message for message in messages), (
            part
        )
