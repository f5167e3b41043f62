# Licensed under a 3-clause BSD style license - see LICENSE
"""Which calibration of many holds for a frame; versions of the file."""

import dataclasses
import datetime
import json
import multiprocessing
import sys
from pathlib import Path

import astropy.units as u
import pytest
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import Calibration, calibrate, instruments
from astropolcal.calibration.library import Entry, Library
from astropolcal.calibration.validity import Validity, content_hash, validity_of, with_validity
from astropolcal.exceptions import CalibrationFileError
from astropolcal.simulation import half_wave_plate_cycles, simulate

OLD = Path(__file__).parent / "data" / "calibration-1.0.0.asdf"
CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength[[9, 12, 16]]


@pytest.fixture(scope="module")
def calibration():
    """Of October 2025, beam switcher in."""
    chain = CHARIS.chain("polarized", ["nbs"], derotator="linear", wavelength=WAVELENGTH)
    frames = half_wave_plate_cycles(derotator=[50, 62.5, 80, 100] * u.deg)
    meta = CHARIS.published_meta() | {"date": "2025-10-05", "yjh50_dichroic": "out"}
    table = simulate(chain, WAVELENGTH, frames, seed=5, meta=meta, name="night1")
    return calibrate(chain, table, instrument="charis")


@pytest.fixture
def library(tmp_path):
    return Library(tmp_path)


def refused(message):
    return pytest.raises(CalibrationFileError, match=message)


# ---- validity ----------------------------------------------------------------------------


def test_validity_comes_from_the_datasets(calibration):
    assert validity_of(calibration).to_dict() == {
        "instrument": "charis",
        "mode": "broadband JHK",
        "valid_from": "2025-10-05",
        "valid_until": None,
        "optics_in": [["nbs"]],
    }


def test_what_is_stated_counts_and_is_kept_in_the_file(calibration, tmp_path):
    stated = with_validity(
        calibration, valid_from="2025-10-01", valid_until="2025-12-01", optics_in=[[], ["nbs"]]
    )
    stated.write(tmp_path / "cal.asdf")
    held = validity_of(Calibration.read(tmp_path / "cal.asdf"))
    assert (held.valid_from, held.valid_until) == ("2025-10-01", "2025-12-01")
    assert held.optics_in == ((), ("nbs",))
    assert held.mode == "broadband JHK"
    assert validity_of(calibration).valid_until is None
    text = (tmp_path / "cal.asdf").read_bytes()
    assert b"calibration-1.1.0" in text
    assert b"valid_until: '2025-12-01'" in text or b"valid_until: 2025-12-01" in text


def test_statement_is_covered_by_the_checksum(calibration, tmp_path):
    path = tmp_path / "cal.asdf"
    with_validity(calibration, valid_until="2025-12-01").write(path)
    path.write_bytes(path.read_bytes().replace(b"2025-12-01", b"2035-12-01"))
    with refused("does not match its checksum"):
        Calibration.read(path)


def test_hash_is_that_of_the_content(calibration, tmp_path):
    calibration.write(tmp_path / "cal.asdf")
    assert content_hash(Calibration.read(tmp_path / "cal.asdf")) == content_hash(calibration)
    assert content_hash(with_validity(calibration, mode="J")) != content_hash(calibration)


def test_end_is_not_included():
    held = Validity(valid_from="2025-10-01", valid_until="2025-12-01")
    assert held.holds("2025-10-01")
    assert held.holds("2025-11-30T23:59:59")
    assert not held.holds("2025-12-01")
    assert not held.holds("2025-09-30T23:59:59")


@given(st.datetimes(datetime.datetime(1990, 1, 1), datetime.datetime(2090, 1, 1)))
def test_moments_compare_as_times_do(moment):
    start = Time("2025-10-05T09:30:00.250")
    held = Validity(valid_from=start)
    # text holds milliseconds
    moment = moment.replace(microsecond=moment.microsecond // 1000 * 1000)
    assert held.holds(moment) == (moment >= start.datetime)


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({"valid_from": "yesterday"}, "valid_from = 'yesterday' is not a date"),
        ({"valid_from": "2025-02-30"}, "is not a date"),
        ({"valid_from": "2026", "valid_until": "2025-01-01"}, "2026|not a date"),
        ({"valid_from": "2025-10-02", "valid_until": "2025-10-02"}, "is not after"),
        ({"optics_in": "nbs"}, "names of optics are needed"),
        ({"optics_in": [3]}, "names of optics are needed"),
        ({"mode": 3}, "mode = 3; text is needed"),
        ({"until": "2025-10-02"}, "no 'until'; allowed are mode, valid_from"),
    ],
)
def test_statement_that_makes_no_sense(calibration, stated, message):
    with refused(message):
        with_validity(calibration, **stated)


def test_validity_of_an_unknown_instrument(calibration):
    other = dataclasses.replace(calibration, settings=calibration.settings | {"instrument": "lab"})
    assert validity_of(other).optics_in is None
    assert "not known" in str(validity_of(other))


def test_month_alone_is_its_first_day(calibration):
    record = dataclasses.replace(calibration.datasets[0], meta={"date": "2025-02"})
    assert validity_of(dataclasses.replace(calibration, datasets=[record])).valid_from == (
        "2025-02-01"
    )


# ---- looking up --------------------------------------------------------------------------


def test_newest_that_holds_wins(calibration, library):
    first = library.add(calibration, valid_from="2025-01-01", optics_in=[])
    second = library.add(calibration, valid_from="2025-10-01", optics_in=[])
    third = library.add(calibration, valid_from="2025-10-01", optics_in=["nbs"])
    assert len(library) == 3

    def found(date, optics):
        return library.find("SCExAO/CHARIS", date=date, optics_in=optics).path

    assert found("2025-06-01", []) == first.resolve()
    assert found("2025-11-01", []) == second.resolve()
    assert found("2025-11-01", ["nbs"]) == third.resolve()
    assert found(Time("2025-11-01"), ("nbs",)) == third.resolve()


def test_nothing_holds(calibration, library):
    with refused("holds none"):
        library.find("charis")
    library.add(calibration, name="cal.asdf", valid_until="2026-01-01")
    for wanted, message in (
        (
            {"date": "2025-10-04"},
            "charis for date 2025-10-04; there is cal.asdf",
        ),
        ({"date": "2026-01-01"}, "for date 2026-01-01"),
        ({"optics_in": ["nbs", "dichroic"]}, r"optics_in nbs\+dichroic; .*with nbs"),
        ({"optics_in": []}, "optics_in none"),
        ({"mode": "high resolution J"}, "mode high resolution J; .*broadband JHK"),
    ):
        with refused(message):
            library.find("charis", **wanted)
    with refused("no calibration of vampires; there is cal.asdf"):
        library.find("vampires")


def test_overlap_names_both(calibration, library):
    library.add(calibration, name="a.asdf", valid_from="2025-01-01", valid_until="2026-01-01")
    with refused(r"a.asdf .* and b.asdf .* overlap"):
        library.add(calibration, name="b.asdf", valid_from="2025-06-01")
    assert len(library) == 1
    # somebody copied it there
    with_validity(calibration, valid_from="2025-06-01").write(library.source / "b.asdf")
    again = Library(library.source)
    with refused(r"a.asdf .* and b.asdf .* overlap"):
        again.find("charis", date="2025-07-01")
    assert again.find("charis", date="2025-02-01").name == "a.asdf"
    assert again.find("charis", date="2026-02-01").name == "b.asdf"
    assert len(again.overlaps()) == 1


def test_two_of_one_start_are_an_overlap_and_copies_are_not(calibration, library):
    path = library.add(calibration)
    assert library.add(calibration) == path
    (library.source / "copy.asdf").write_bytes(path.read_bytes())
    again = Library(library.source)
    assert len(again) == 2
    assert again.find("charis", date="2026-01-01").content_hash == content_hash(calibration)
    with refused("overlap"):
        again.add(dataclasses.replace(calibration, fit=calibration.fit | {"seconds": 0.5}))


def test_replaced_one_does_not_come_back(calibration, library):
    library.add(calibration, name="a.asdf", valid_from="2025-01-01")
    library.add(calibration, name="b.asdf", valid_from="2025-03-01", valid_until="2025-04-01")
    assert library.find("charis", date="2025-03-15").name == "b.asdf"
    with refused("b.asdf .* had replaced a.asdf .* and has ended"):
        library.find("charis", date="2025-05-01")


def test_open_choice_is_refused(calibration, library):
    library.add(calibration, name="a.asdf", optics_in=[])
    library.add(calibration, name="b.asdf", optics_in=["nbs"])
    with refused("a.asdf .*b.asdf .*say which optics_in") as caught:
        library.find("charis", date="2026-01-01")
    assert caught.value.argument == "optics_in"
    library.add(calibration, name="c.asdf", optics_in=["nbs"], valid_from="2026-01-01")
    with refused("b.asdf, c.asdf: a date is needed"):
        library.find("charis", optics_in=["nbs"])


def test_unreadable_file_might_be_the_one(calibration, library):
    path = library.add(calibration)
    (library.source / "bad.asdf").write_bytes(path.read_bytes()[:500])
    again = Library(library.source)
    assert len(again) == 1
    assert list(again.problems) == [library.source / "bad.asdf"]
    with refused("bad.asdf: truncated.*remove or repair"):
        again.find("charis")


def test_library_of_files_and_of_one(calibration, library, tmp_path):
    path = library.add(calibration)
    assert Library([path]).find("charis").path == path.resolve()
    assert Library(str(path)).find().path == path.resolve()
    with refused("only a folder can be added to"):
        Library(path).add(calibration)
    with refused("no such file or folder"):
        Library(tmp_path / "nowhere")


def test_changed_file_is_read_again(calibration, library):
    path = library.add(calibration, name="cal.asdf")
    with_validity(calibration, mode="J").write(path, overwrite=True)
    assert Library(library.source).find("charis").validity.mode == "J"


def test_table_says_how_good_they_are(calibration, library):
    library.add(calibration)
    (row,) = library.table()
    accuracy = calibration.accuracy
    assert row["s_res"] == pytest.approx(sorted(accuracy["s_res"].value)[1])
    assert (row["valid_from"], row["optics_in"]) == ("2025-10-05", "nbs")
    assert row["content_hash"] == content_hash(calibration)
    assert isinstance(library.entries[0], Entry)


def write_two(base, folder, number, barrier):
    barrier.wait(60)
    Library(folder).add(base, valid_from=f"20{number}-01-01")
    Library(folder).add(base, valid_from="2010-01-01", mode=f"of {number}")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_concurrent_writers(tmp_path):
    """Two of three write the same at the same time; each file is whole, and there once."""
    folder = tmp_path / "library"
    folder.mkdir()
    base = Calibration.read(OLD)
    # a fork need not import anything again
    context = multiprocessing.get_context("fork" if sys.platform == "linux" else "spawn")
    barrier = context.Barrier(3)
    jobs = [
        context.Process(target=write_two, args=(base, folder, number, barrier))
        for number in ("11", "12", "11")
    ]
    for job in jobs:
        job.start()
    for job in jobs:
        job.join(100)
        assert job.exitcode == 0
    library = Library(folder)
    assert not library.problems
    assert not library.overlaps()
    told = sorted((e.validity.valid_from, e.validity.mode) for e in library.entries)
    assert told == [
        ("2010-01-01", "of 11"),
        ("2010-01-01", "of 12"),
        ("2011-01-01", "broadband JHK"),
        ("2012-01-01", "broadband JHK"),
    ]
    assert {p.suffix for p in folder.iterdir() if p.name != ".lock"} == {".asdf"}


# ---- versions of the file ----------------------------------------------------------------


def test_file_of_version_1_0_0_reads(tmp_path):
    assert b"calibration-1.0.0>" in OLD.read_bytes()
    calibration = Calibration.read(OLD)
    assert calibration.converged
    assert calibration.chain["hwp"].w_sio2.value == 1.6269473956136098
    assert validity_of(calibration).valid_from == "2025-10-05"
    assert list(calibration.ties) == ["derotator.theta"]
    assert json.dumps(calibration.to_dict(), allow_nan=False)
    # written again, it is of the newest version and has the same content
    calibration.write(tmp_path / "new.asdf")
    assert b"calibration-1.1.0>" in (tmp_path / "new.asdf").read_bytes()
    again = Calibration.read(tmp_path / "new.asdf")
    assert content_hash(again) == content_hash(calibration)
    assert content_hash(again).encode() in OLD.read_bytes()


def test_changed_file_of_version_1_0_0_is_refused(tmp_path):
    path = tmp_path / "old.asdf"
    path.write_bytes(OLD.read_bytes().replace(b"strategy: two-step", b"strategy: joint"))
    with refused("does not match its checksum"):
        Calibration.read(path)


def test_newer_version_is_refused_with_clear_words(calibration, tmp_path):
    path = tmp_path / "cal.asdf"
    calibration.write(path)
    path.write_bytes(path.read_bytes().replace(b"calibration-1.1.0>", b"calibration-1.2.0>"))
    with refused(r"version 1\.2\.0; this astropolcal reads version 1\.0\.0, 1\.1\.0: .*newer"):
        Calibration.read(path)
