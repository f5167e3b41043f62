# Licensed under a 3-clause BSD style license - see LICENSE
"""Tables of measured frames: columns, masks, errors, files."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table

from astropolcal.exceptions import ObservationError
from astropolcal.observations import Observations
from astropolcal.observations.reading import write_table
from astropolcal.reduction.frames import Frame
from astropolcal.reduction.photometry import Photometry
from astropolcal.reduction.tables import photometry_table, reduced_table

N = 4


def frame(number, hwp=0.0, *, failed=(), covariance=0.0, unit="adu", **values):
    """Return a frame whose fluxes tell frame, beam and slice."""
    result = Photometry.empty(N)
    result.flux[:] = 1000.0 * (number or 1) + np.array([[100.0], [200.0]]) + np.arange(N)
    result.variance[:] = [[16.0], [9.0]]
    result.covariance[:] = covariance
    result.x[:], result.y[:] = [[70.0], [30.0]], [[85.0], [50.0]]
    result.scale[:], result.scale_err[:] = 1.02, 0.001
    for k in failed:
        result.flag(np.arange(N) == k, "saturated")
    name = "plain.fits" if number is None else f"CRSA{number:08d}.fits"
    known = {"hwp": hwp, "derotator": 45.0} | values
    return Frame(name, number, known, unit=unit, photometry=result)


def test_one_row_a_frame_and_wavelength(small):
    table = reduced_table([frame(3), frame(7, 45.0)], small, {"source": "polarized"})
    assert table["frame"].tolist() == [0] * N + [1] * N
    assert table["bin"].tolist() == list(range(N)) * 2
    assert table["number"].tolist() == [3] * N + [7] * N
    assert u.allclose(table["wavelength"][:N].quantity, small.wavelength)
    assert table["flux_right"][N + 2] == 7102.0
    assert table["flux_left"][1] == 3201.0
    assert table["flux_right_err"][0] == 4.0
    assert table["flux_left_err"][0] == 3.0
    assert table.meta == {"source": "polarized"}
    assert "mask_reason" not in table.colnames


def test_shared_noise_is_in_the_errors_of_difference_and_sum(small):
    table = reduced_table([frame(1, covariance=2.0)], small, {})
    # var(R) + var(L) -+ 2 cov
    assert table["single_difference_err"][0] == pytest.approx(np.sqrt(25 - 4))
    assert table["single_sum_err"][0] == pytest.approx(np.sqrt(25 + 4))
    # and how it is divided in those of the beams
    assert (table["flux_right_err"][0], table["flux_left_err"][0]) == (4.0, 3.0)
    # what the beams share wholly is no noise of their difference
    shared = reduced_table([frame(1, covariance=12.5)], small, {})
    assert shared["single_difference_err"][0] == 0


def test_covariance_of_failed_cells_does_not_count(small):
    one = frame(1, failed=[2])
    one.photometry.covariance[2] = 5.0
    assert "flux_right_err" in reduced_table([one], small, {}).colnames


def test_failed_cells_are_masked_with_their_reason(small):
    table = reduced_table([frame(1, failed=[1]), frame(2, 45.0)], small, {})
    assert np.flatnonzero(table["flux_left"].mask).tolist() == [1]
    assert np.flatnonzero(table["flux_right_err"].mask).tolist() == [1]
    assert table["mask_reason"].tolist() == ["", "saturated"] + [""] * 6
    obs = Observations.from_table(table)
    assert obs.mask_reasons == {"saturated": 1}


def test_column_that_all_frames_know_is_in_the_table(small):
    for name, column, unit in [
        ("hwp_true", "hwp_true", u.deg),
        ("parallactic", "parallactic", u.deg),
        ("altitude", "altitude", u.deg),
        ("exposure_time", "exposure_time", u.s),
        ("mjd", "time", u.day),
    ]:
        both = reduced_table([frame(1, **{name: 2.0}), frame(2, **{name: 3.0})], small, {})
        assert both[column].quantity.to_value(unit).tolist() == [2.0] * N + [3.0] * N, (
            name,
            column,
            unit,
        )
        one = reduced_table([frame(1, **{name: 2.0}), frame(2)], small, {})
        assert column not in one.colnames, (name, column, unit)


def test_numbers_and_states_too_need_all_frames(small):
    frames = [frame(1, flc_state="A"), frame(2, flc_state="B")]
    assert reduced_table(frames, small, {})["flc_state"].tolist() == ["A"] * N + ["B"] * N
    assert "flc_state" not in reduced_table([*frames, frame(3)], small, {}).colnames
    assert "number" not in reduced_table([frame(1), frame(None)], small, {}).colnames


def test_fluxes_have_the_unit_of_the_files(small):
    table = reduced_table([frame(1, unit="electron")], small, {})
    assert table["flux_right"].unit == u.electron
    assert table["flux_left_err"].unit == u.electron
    assert (
        photometry_table([frame(1, unit="electron")], small)["background_left"].unit == u.electron
    )


def test_photometry_adds_places_and_corrections(small):
    table = photometry_table([frame(1, failed=[3])], small)
    assert table["x_right"][0] == 70.0
    assert table["y_left"].unit == u.pix
    assert table["x_left"][0] == 30.0
    assert table["scale"][:3].tolist() == [1.02] * 3
    assert table["scale_err"][0] == 0.001
    for name in ("x_right", "fwhm_left", "radius_right", "background_left", "scale"):
        assert np.flatnonzero(table[name].mask).tolist() == [3]


def test_no_frames_make_an_empty_table(small):
    assert len(reduced_table([], small, {})) == len(photometry_table([], small)) == 0


def test_file_is_not_replaced_unasked(small, tmp_path):
    path, table = tmp_path / "run.ecsv", reduced_table([frame(1), frame(2, 45.0)], small, {})
    write_table(table, path)
    with pytest.raises(ObservationError, match=r"run\.ecsv: exists already; remove it, name"):
        write_table(table[:N], path)
    assert len(Table.read(path)) == 2 * N
    write_table(table[:N], path, overwrite=True)
    assert len(Table.read(path)) == N
    assert [p.name for p in tmp_path.iterdir()] == ["run.ecsv"]


def test_impossible_places_are_named(tmp_path):
    for place, words in [(".", "is a folder; name a file in it"), ("no/run.ecsv", "no folder")]:
        with pytest.raises(ObservationError, match=words):
            write_table(Table({"bin": [0]}), tmp_path / place)
