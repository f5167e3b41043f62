# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal correct`` without cubes: what headers become, and the numbers of the report."""

from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal import instruments
from astropolcal.exceptions import ObservationError
from astropolcal.reduction.headers import FrameHeader
from astropolcal.scripts import _correct
from astropolcal.scripts._correct import _headers, _middle, _plain, _point, _position_angles

CHARIS = instruments.get("charis")


@pytest.fixture
def told(monkeypatch):
    """Function that returns what is made of headers with these values."""

    def tell(*frames, centre=(70.0, 85.0)):
        files = [f"CRSA{i:08d}_cube.fits" for i in range(len(frames))]
        known = dict(zip(files, frames, strict=True))
        monkeypatch.setattr(
            _correct, "_frames", lambda *_: [FrameHeader(f, values=dict(known[f])) for f in files]
        )
        return _headers(files, CHARIS, SimpleNamespace(raw=None, centre=centre))

    return tell


# ---- headers ---------------------------------------------------------------------------


def test_angles_that_some_frame_knows_are_columns(told):
    table, centres, scale, left = told({"hwp": 0.0, "altitude": 60.0}, {"hwp": 45.0})
    assert table["hwp"].to_value(u.deg).tolist() == [0.0, 45.0]
    assert np.isnan(table["altitude"].value).tolist() == [False, True]
    assert set(table.colnames) == {"hwp", "altitude"}
    assert centres == (70.0, 85.0)
    assert scale is None
    # one file holds both beams
    assert left == [1.0, 1.0]


def test_true_plate_angle_is_used_of_all_frames_or_of_none(told):
    both = told({"hwp": 0.0, "hwp_true": 10.0}, {"hwp": 45.0, "hwp_true": 55.0})[0]
    assert both["hwp_true"].to_value(u.deg).tolist() == [10.0, 55.0]
    assert "hwp_true" not in told({"hwp": 0.0, "hwp_true": 10.0}, {"hwp": 45.0})[0].colnames


def test_states_of_a_modulator(told):
    table = told({"hwp": 0.0, "flc_state": "A"}, {"hwp": 0.0, "flc_state": "B"})[0]
    assert table["flc_state"].tolist() == ["A", "B"]


@pytest.mark.parametrize(
    ("seconds", "scale"),
    [
        ((10.0, 10.0, 10.0), None),
        # rounding of a header
        ((10.0, 10.000001, 10.0), None),
        ((10.0, 20.0, 10.0), [1.0, 2.0, 1.0]),
        ((5.0, 10.0, 20.0), [0.5, 1.0, 2.0]),
        # what one header does not say is not guessed
        ((10.0, None, 20.0), None),
    ],
)
def test_frames_are_as_bright_as_their_exposures(told, seconds, scale):
    frames = [{"hwp": 0.0} | ({} if s is None else {"exposure_time": s}) for s in seconds]
    found = told(*frames)[2]
    assert found is None if scale is None else found.tolist() == scale


def test_star_that_is_not_found_names_the_file(monkeypatch):
    def frame(file):
        x = np.full((2, 3), np.nan if "1_cube" in file else 70.0)
        found = FrameHeader(file, values={"hwp": 0.0})
        found.photometry = SimpleNamespace(x=x, y=x + 15.0)
        return found

    monkeypatch.setattr(_correct, "_frames", lambda files, *_: [frame(file) for file in files])
    files = [f"CRSA0000000{i}_cube.fits" for i in range(3)]
    arguments = SimpleNamespace(raw=None, centre=None)
    words = "CRSA00000001_cube.fits: the star was not found; give its place with --centre"
    with pytest.raises(ObservationError, match=words):
        _headers(files, CHARIS, arguments)
    centres = _headers([files[0], files[2]], CHARIS, arguments)[1]
    # x and y in the right and in the left beam
    assert [c.tolist() for c in centres] == [[[70.0, 85.0]] * 2] * 2


# ---- options -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("rotation", "camera", "angles"),
    [
        ("none", 12.0, None),
        ("fixed", 12.0, [12.0, 12.0]),
        ("pupil", 12.0, [32.0, 36.0]),
        ("pupil", -90.0, [-70.0, -66.0]),
    ],
)
def test_position_angle_of_the_camera(rotation, camera, angles):
    table = QTable({"parallactic": [20.0, 24.0] * u.deg})
    arguments = SimpleNamespace(rotation=rotation, camera_angle=camera)
    found = _position_angles(table, arguments)
    assert found is None if angles is None else found.to_value(u.deg).tolist() == angles


def test_pupil_needs_the_parallactic_angle():
    arguments = SimpleNamespace(rotation="pupil", camera_angle=0.0)
    with pytest.raises(ObservationError, match="--rotation pupil needs the parallactic angle of"):
        _position_angles(QTable({"hwp": [0.0] * u.deg}), arguments)


@pytest.mark.parametrize(("text", "place"), [("70,85", (70.0, 85.0)), ("69.9, 1e2", (69.9, 100.0))])
def test_place_of_a_star(text, place):
    assert _point(text) == place


# ---- the report --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ([1.0, 2.0, 30.0], "2.0 deg"),
        ([1.0, None, 3.0], "2.0 deg"),
        # neighbours across 180 deg, whose plain median would be 90
        ([179.0, 1.0], "0.0 deg"),
        ([178.0, 179.0, 2.0], "179.0 deg"),
        ([178.0, 2.0, 3.0], "2.0 deg"),
        # rounds to half a turn, which is none
        ([179.97, 179.97], "0.0 deg"),
        ([-0.01, -0.01], "0.0 deg"),
        ([89.0, 91.0], "90.0 deg"),
        ([None, None], "not known"),
        ([], "not known"),
    ],
)
def test_middle_of_angles(values, words):
    assert _middle(values, ".1f", " deg", turns=True) == words


@pytest.mark.parametrize(
    ("values", "words"), [([0.01, 0.03], "0.0200"), ([None, 0.5], "0.5000"), ([None], "not known")]
)
def test_middle_of_numbers(values, words):
    assert _middle(values, ".4f", "") == words


@pytest.mark.parametrize(
    ("systematic", "words"),
    [
        (None, "not known"),
        (SimpleNamespace(is_open=False), "not known"),
        (SimpleNamespace(is_open=True), "infinite"),
    ],
)
def test_report_has_units(capsys, systematic, words):
    aperture = {"radius": 10.0, "dolp": [0.0099], "aolp": [30.0]}
    aperture |= {"s_p_statistical": [0.0012], "s_chi_statistical": [2.0]}
    aperture |= {"s_p_systematic": [None], "s_chi_systematic": [None]}
    summary = {
        "output": "o.fits", "n_frames": 4, "mode": "stokes", "calibration": "c.asdf",
        "components": "IQU", "condition": [1.5, None, 1.6], "poorly_determined": {},
        "aperture": aperture,
    }  # fmt: skip
    _correct._report(summary, systematic)
    lines = capsys.readouterr().out.splitlines()
    assert "  condition number of the solution for IQU: 1.5 to 1.6" in lines
    assert "    degree of linear polarization: 0.99 %" in lines
    assert "      statistical error: 0.12 %" in lines
    assert "    angle of linear polarization: 30.0 deg" in lines
    assert "      statistical error: 2 deg" in lines
    assert lines.count(f"      systematic error: {words}") == 2


def test_what_is_not_finite_is_null():
    assert _plain([1.0, np.nan, np.inf, np.float32(2.0)]) == [1.0, None, None, 2.0]
