# Licensed under a 3-clause BSD style license - see LICENSE
"""What stands between a header and a Mueller matrix: wavelengths, chains, angles, statements."""

from dataclasses import replace
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.time import Time

from astropolcal import instruments, optics
from astropolcal.calibration import with_validity
from astropolcal.calibration.identifiability.sky import known_instrument
from astropolcal.calibration.result.calibration import (
    Validity,
    beam_words,
    optics_sets,
    optics_words,
    validity_of,
)
from astropolcal.calibration.system import at_wavelengths, match_wavelengths, split_chain
from astropolcal.exceptions import (
    CalibrationFileError,
    ChainError,
    InstrumentError,
    ObservationError,
    ParameterError,
    WavelengthRangeError,
)
from astropolcal.observations import pointing
from astropolcal.observations.pointings import sky_angles
from astropolcal.pipeline.headers import (
    FrameAngles,
    describe,
    inner_optics,
    telescope_optics,
    told_beam,
)

CHARIS = instruments.get("charis")
GRID = np.array([1200.0, 1600.0, 2200.0]) * u.nm


def _several():
    """Efficiency at each wavelength of the grid, retardance by one number for all."""
    hwp = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    return hwp | optics.WollastonPrism(efficiency=np.array([0.9, 0.95, 1.0]), name="wollaston")


def _law():
    hwp = optics.TwoLayerWaveplate(mount="hwp", name="hwp")
    return hwp | optics.WollastonPrism(name="wollaston")


# --- wavelengths ------------------------------------------------------------------------------


def test_without_a_wish_all_wavelengths_are_taken():
    lam, mix = match_wavelengths(GRID, _several(), None)
    assert lam is GRID
    np.testing.assert_array_equal(mix, np.eye(3))


def test_wavelengths_are_recognized_in_any_unit_and_order():
    for wanted, bins in [
        (1.6 * u.um, [1]),
        ([2200, 1200] * u.nm, [2, 0]),
        (GRID[1] * (1 + 5e-7), [1]),
        ([1.2e-6] * u.m, [0]),
    ]:
        lam, found = match_wavelengths(GRID, _several(), wanted)
        np.testing.assert_array_equal(found, np.eye(3)[bins])
        np.testing.assert_allclose(lam.to_value(u.nm), GRID.value[bins], rtol=1e-6)


def test_between_the_grid_a_law_answers_and_a_table_does_not():
    lam, mix = match_wavelengths(GRID, _law(), [1400, 1600] * u.nm)
    assert mix is None
    np.testing.assert_allclose(lam.value, [1400, 1600])
    with pytest.raises(WavelengthRangeError, match=r"1400\.00 nm is none of the 3.*wollaston\.eff"):
        match_wavelengths(GRID, _several(), [1400, 1600] * u.nm)
    # beyond the grid nothing answers
    for wanted in [1100, 2300]:
        with pytest.raises(
            WavelengthRangeError, match=rf"{wanted}\.00 nm is outside.*1200\.00 nm to 2200"
        ):
            match_wavelengths(GRID, _law(), wanted * u.nm)
    # a wavelength has a unit of length
    for wanted in [1600, "H", 1600 * u.s]:
        with pytest.raises(ParameterError, match="needs a unit such as nm"):
            match_wavelengths(GRID, _several(), wanted)


def test_a_chain_at_some_wavelengths_has_their_values():
    chain = _several()
    part = at_wavelengths(chain, np.eye(3)[[2, 0]], 3)
    assert part["wollaston"].efficiency.value.tolist() == [1.0, 0.9]
    assert part["hwp"].retardance.value == 180
    assert part["hwp"].mount == "hwp"
    # a copy, also where nothing is cut
    whole = at_wavelengths(chain, np.eye(3), 3)
    whole["wollaston"].efficiency = [0.5] * 3
    assert chain["wollaston"].efficiency.value.tolist() == [0.9, 0.95, 1.0]


# --- chains -----------------------------------------------------------------------------------


def test_a_chain_is_split_where_the_instrument_begins():
    outer, inner = split_chain(CHARIS.published())
    assert [leaf.name for leaf in outer] == ["calibration_polarizer"]
    assert inner[0].name == "hwp"
    outer, inner = split_chain(CHARIS.on_sky(CHARIS.published()))
    # the axes of the telescope are stages, but not the instrument's
    assert [leaf.name for leaf in outer] == ["parallactic", "m3", "altitude"]
    assert inner[0].name == "hwp"
    # a chain without stages is all instrument
    outer, inner = split_chain(optics.Diattenuator(name="a") | optics.WollastonPrism(name="b"))
    assert [len(outer), len(inner)] == [0, 2]


def _calibration(*chains, instrument=None, metas=None):
    metas = [{}] * len(chains) if metas is None else metas
    records = [
        SimpleNamespace(name=f"night {i}", meta=m, source=m.get("source"))
        for i, m in enumerate(metas)
    ]
    return SimpleNamespace(
        chains=list(chains), datasets=records, instrument=instrument, settings={}
    )


def test_instrument_of_a_calibration():
    for name, known in [("charis", "charis"), ("own", None), (None, None)]:
        found = known_instrument(name)
        assert (found and found.name) == known, (name, known)


def test_telescope_of_a_calibration_begins_behind_its_star():
    sky = CHARIS.on_sky(CHARIS.published())
    star = optics.PolarizedSource(q=0.01, name="star") | sky
    found = telescope_optics(_calibration(CHARIS.published(), star))
    assert [leaf.name for leaf in found] == ["parallactic", "m3", "altitude"]
    assert telescope_optics(_calibration(CHARIS.published())) == []


def _with_and_without():
    plate = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    window = optics.Diattenuator(diattenuation=0.01, name="window")
    splitter = optics.WollastonPrism(name="wollaston")
    return _calibration(plate | window | splitter, plate.copy() | splitter.copy())


def test_optics_in_the_beam_tell_chains_apart():
    for choice, names in [
        ({"optics_in": ["window"]}, ["hwp", "window", "wollaston"]),
        ({"beam": {"window": False}}, ["hwp", "wollaston"]),
        ({"beam": {"window": True}}, ["hwp", "window", "wollaston"]),
    ]:
        assert [leaf.name for leaf in inner_optics(_with_and_without(), **choice)] == names


def test_chains_that_cannot_be_told_apart_are_named():
    with pytest.raises(ChainError, match=r"which optics are in the beam.*: window or none"):
        inner_optics(_with_and_without())
    with pytest.raises(ChainError, match=r"mine: no chain with lens; it holds for"):
        inner_optics(_with_and_without(), ["lens"], label="mine")
    with pytest.raises(ChainError, match="no chain without hwp"):
        inner_optics(_with_and_without(), beam={"hwp": False})
    # equal chains are one
    cal = _with_and_without()
    cal.chains = [cal.chains[0], cal.chains[0].copy()]
    assert len(inner_optics(cal)) == 3


class _Beam:
    def optics_of(self, header):
        return header


def test_frames_must_agree_on_the_beam():
    told = [{"nbs": True}, {"nbs": True, "lens": False}, {}]
    assert told_beam(told, _Beam()) == {"nbs": True, "lens": False}
    with pytest.raises(ChainError, match="nbs was in the beam in frame 0, and not in frame 1"):
        told_beam([{"nbs": True}, {"nbs": False}], _Beam())
    with pytest.raises(ChainError, match="nbs was not in the beam in a, and in it in b"):
        told_beam([{"nbs": False}, {"nbs": True}], _Beam(), labels=["a", "b"])


# --- headers ------------------------------------------------------------------------------------


def _header(**changes):
    header = {"INSTRUME": "CHARIS", "MJD": 60988.5, "RET-ANG1": 22.5, "D_IMRANG": 60.0}
    header |= {
        key.replace("_", "-") if key.startswith("RET") else key: v for key, v in changes.items()
    }
    return {key: value for key, value in header.items() if value is not None}


def test_a_header_tells_instrument_and_date():
    told = describe(_header())
    assert told["instrument"] == "charis"
    assert told["stated"] is None
    # MJD 60988.5 is noon of 9 November 2025
    assert told["date"].startswith("2025-11-09T12:00:00")


def test_what_the_user_states_is_not_looked_for():
    assert describe(_header(), "charis", {"date"})["date"] is None
    # what another instrument wrote is told as it stands, unless the user vouches for it
    assert describe(_header(INSTRUME="HICIAO"), "charis")["stated"] == "HICIAO"
    assert describe(_header(INSTRUME="HICIAO"), "charis", {"instrument"})["stated"] is None


def test_an_unknown_instrument_is_asked_for():
    for header, words in [
        ({}, "the header does not say it; give instrument=, one of charis"),
        ({"INSTRUME": "CIAO"}, "the header says 'CIAO', which is not known"),
    ]:
        with pytest.raises(InstrumentError, match=words):
            describe(header)


def test_a_package_that_cannot_be_imported_hides_no_instrument(monkeypatch):
    """Its name comes first, so that it is asked before the one whose frame it is."""

    def fail():
        raise ModuleNotFoundError("No module named 'missing'")

    broken = SimpleNamespace(name="broken", load=fail)
    monkeypatch.setattr(instruments, "entry_points", lambda group: [broken])
    assert describe(_header())["instrument"] == "charis"
    with pytest.raises(InstrumentError, match="'CIAO', which is not known"):
        describe({"INSTRUME": "CIAO"})


def test_a_date_that_is_none_is_shown():
    with pytest.raises(CalibrationFileError, match="date 'yesterday' cannot be understood"):
        describe(_header(MJD="yesterday"))


def test_angles_of_frames_are_in_radian():
    frames = FrameAngles([_header(), _header(RET_ANG1=67.5, D_IMRANG="61.5")], CHARIS)
    assert frames.n_frames == 2
    np.testing.assert_allclose(frames.position("hwp"), np.deg2rad([22.5, 67.5]))
    np.testing.assert_allclose(frames.position("derotator"), np.deg2rad([60, 61.5]))
    assert isinstance(frames.frames["time"], Time)
    # a copy: a pipeline may write into it
    frames.frames["hwp"][0] = 0 * u.deg
    np.testing.assert_allclose(frames.position("hwp")[0], np.deg2rad(22.5))
    # two turns are the most an encoder counts
    frames = FrameAngles([_header(D_IMRANG=-720.0), _header(D_IMRANG=720.0)], CHARIS)
    np.testing.assert_allclose(frames.position("derotator"), [-4 * np.pi, 4 * np.pi])
    # cards of a real header will do
    header = fits.Header(_header().items())
    assert describe(header)["instrument"] == "charis"
    np.testing.assert_allclose(FrameAngles([header], CHARIS).position("hwp"), np.deg2rad(22.5))


def test_angles_that_cannot_be_used():
    for headers, error, words in [
        ([], ObservationError, "no header: at least one frame"),
        ([_header(RET_ANG1="fast")], ObservationError, "frame 0: RET-ANG1 = 'fast', a number"),
        ([_header(), _header(RET_ANG1=721.0)], ObservationError, "frame 1: RET-ANG1 = 721.0, all"),
        ([_header(ALTITUDE=91)], ObservationError, "frame 0: ALTITUDE = 91, allowed are 0 to 90"),
        ([_header(), _header(D_IMRANG=None)], ObservationError, "frame 1: no D_IMRANG in the hea"),
        ([_header(D_IMRANG="")] * 2, ObservationError, "position of 'derotator': no D_IMRANG"),
    ]:
        with pytest.raises(error, match=words):
            FrameAngles(headers, CHARIS).position("derotator")
    # a stage without a keyword
    with pytest.raises(ObservationError, match="'wheel': no keyword is known for it"):
        FrameAngles([_header()], CHARIS).position("wheel")
    # an instrument without files has no map
    instrument = SimpleNamespace(name="lab", files=None, headers=None)
    with pytest.raises(InstrumentError, match="lab: no map of header keywords; give positions"):
        FrameAngles([_header()], instrument)


def test_columns_of_a_user_may_hold_what_is_no_angle():
    files = replace(CHARIS.files, keywords=CHARIS.files.keywords | {"slit": "SLIT", "lamp": "LAMP"})
    lab = SimpleNamespace(name="lab", files=files)
    for slit, lamp, angles in [
        ("open", True, {}),
        (30.0, "off", {"slit": 30}),
        ("12", 1, {"slit": 12, "lamp": 1}),
    ]:
        frames = FrameAngles([_header(SLIT=slit, LAMP=lamp)] * 2, lab)
        for name, angle in angles.items():
            np.testing.assert_allclose(frames.position(name), np.deg2rad([angle, angle]))
        np.testing.assert_allclose(frames.position("hwp"), np.deg2rad([22.5, 22.5]))
    with pytest.raises(ObservationError, match=r"frame 0: SLIT = 1000\.0, allowed"):
        FrameAngles([_header(SLIT=1e3)], lab)


def test_positions_on_sky_may_be_sexagesimal_or_degrees():
    """6 h and 90 deg are the same right ascension."""
    text, number = (
        FrameAngles([_header(RA=ra, DEC=dec)], CHARIS).frames
        for ra, dec in (("06:00:00", "-30:30:00"), (90.0, -30.5))
    )
    for key, expected in (("right_ascension", 90), ("declination", -30.5)):
        for frames in (text, number):
            assert frames[key][0].to_value(u.deg) == pytest.approx(expected)
    with pytest.raises(ObservationError, match="right_ascension: "):
        FrameAngles([_header(RA="north", DEC="0")], CHARIS)


def test_sky_of_headers_is_that_of_the_middle_of_the_exposure():
    known = {"RA": 90.0, "DEC": 10.0, "EXPTIME": 1200.0, "TIMESYS": "UTC", "EQUINOX": 2000.0}
    known |= {"ALTITUDE": None, "PARANG": None, "MJD": None, "UT": None}
    target, start = SkyCoord(90 * u.deg, 10 * u.deg), "2025-10-05T14:00:00"
    angles = sky_angles(
        FrameAngles([_header(**known | {"DATE-OBS": start})], CHARIS), CHARIS.location
    )
    middle = pointing(target, Time(start) + 600 * u.s, CHARIS.location)
    np.testing.assert_allclose(angles, u.Quantity(middle).to_value(u.rad)[:, None], rtol=1e-9)
    for changed, words in [
        # a date alone is no moment
        ({"DATE-OBS": "2025-10-05"}, "missing: a column time"),
        ({"DATE-OBS": start, "TIMESYS": "TAI"}, "missing: TIMESYS = 'TAI': times in UTC"),
        ({"DATE-OBS": start, "EQUINOX": 1950.0}, "missing: EQUINOX = 1950.0: times in UTC"),
    ]:
        with pytest.raises(ObservationError, match=words):
            sky_angles(FrameAngles([_header(**known | changed)], CHARIS), CHARIS.location)


# --- statements ---------------------------------------------------------------------------------


def test_sets_of_optics_have_one_form():
    for given, sets, words in [
        (None, None, "optics in the beam not known"),
        ([], ((),), "no optional optics"),
        (["nbs", "a", "nbs"], (("a", "nbs"),), "with a + nbs"),
        ([["nbs"], []], ((), ("nbs",)), "no optional optics or with nbs"),
        ([["b", "a"], ("a", "b")], (("a", "b"),), "with a + b"),
    ]:
        assert optics_sets(given) == sets, words
        assert optics_words(sets) == words, words
    # what is no set of optics
    for given in ["nbs", [1], ["nbs", ["a"]], [["a", 2]]]:
        with pytest.raises(CalibrationFileError, match="names of optics are needed"):
            optics_sets(given)


def test_a_beam_in_words():
    for beam, words in [
        ({"nbs": True, "a": True}, "with a + nbs"),
        ({"nbs": False}, "without nbs"),
        ({"b": False, "a": True, "c": False}, "with a, without b + c"),
    ]:
        assert beam_words(beam) == words, words


def test_validity_in_words_and_as_a_dictionary():
    held = Validity("lab", "J", "2025-10-01", "2026-01-01T12:00", ["nbs"])
    assert str(held) == "lab, J, from 2025-10-01 until 2026-01-01T12:00:00.000, with nbs"
    again = held.to_dict()
    assert again["optics_in"] == [["nbs"]]
    assert Validity(**again) == held
    assert (
        str(Validity()) == "an instrument, any mode, from any date on, optics in the beam not known"
    )


def test_range_of_a_validity():
    for date, inside in [
        ("2025-09-30T23:59:59.999", False),
        ("2025-10-01", True),
        (Time("2025-11-01"), True),
        ("2025-12-31T23:59:59", True),
        ("2026-01-01", False),
    ]:
        assert Validity(valid_from="2025-10-01", valid_until="2026-01-01").holds(date) == inside, (
            inside
        )
    # without limits every moment is inside
    assert Validity().holds("1999-01-01")
    assert Validity(valid_until="2000-01-01").holds("1999-01-01")
    assert not Validity(valid_until="2000-01-01").holds("2001-01-01")


def test_start_is_the_first_date_that_is_one():
    for dates, start in [
        (["2025-10-05", "2025-09-30"], "2025-09-30"),
        (["2025-10", None], "2025-10-01"),
        (["20251005", 60952], "2025-10-04"),
        (["2025-10-06", "2025-10-05T09:30"], "2025-10-05T09:30:00.000"),
        ([" ", None], None),
        ([], None),
    ]:
        chain = _several()
        cal = _calibration(*[chain] * len(dates), metas=[{"date": d} for d in dates])
        assert validity_of(cal).valid_from == start, start
    # date that cannot be read does not pass for any date
    cal = _calibration(
        _several(), _several(), metas=[{"date": "2025-10-05"}, {"date": "5 Oct 2025"}]
    )
    with pytest.raises(CalibrationFileError, match=r"night 1: .*'5 Oct 2025' is not a date"):
        validity_of(cal)


def test_mode_is_that_of_all_datasets():
    for modes, mode in [(["J", "J"], "J"), (["J", "H"], None), (["J", None], None), ([3], None)]:
        cal = _calibration(*[_several()] * len(modes), metas=[{"mode": m} for m in modes])
        assert validity_of(cal).mode == mode, mode


def test_nonsense_in_a_file_is_told():
    cal = _calibration(_several())
    cal.settings = {"validity": {"mode": "J", "color": "red"}}
    with pytest.raises(CalibrationFileError, match="allowed are mode, valid_from, valid_until"):
        validity_of(cal)
    with pytest.raises(CalibrationFileError, match="validity = 'color'; allowed are mode"):
        with_validity(cal, color="red")
    # stating nothing changes nothing
    cal = _calibration(_several())
    assert with_validity(cal) is cal
