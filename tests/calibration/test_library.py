# Licensed under a 3-clause BSD style license - see LICENSE
"""Which calibration of many holds for a frame; versions of the file."""

import dataclasses
import datetime
import hashlib
import json
import multiprocessing
import os
import sys
import zipfile
from itertools import combinations, product
from pathlib import Path

import astropy.units as u
import pytest
from astropy.time import Time
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import Calibration, calibrate, instruments
from astropolcal.calibration.result.calibration import Validity, validity_of, with_validity
from astropolcal.converters.calibration import content_hash
from astropolcal.exceptions import AstropolcalWarning, CalibrationFileError
from astropolcal.pipeline import fetch, health, import_context, parameter_history
from astropolcal.pipeline import library as module
from astropolcal.pipeline.library import Entry, Library
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


@pytest.mark.slow
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


@given(st.datetimes(datetime.datetime(1990, 1, 1), datetime.datetime(2090, 1, 1)))
def test_moments_compare_as_times_do(moment):
    start = Time("2025-10-05T09:30:00.250")
    held = Validity(valid_from=start)
    # text holds milliseconds
    moment = moment.replace(microsecond=moment.microsecond // 1000 * 1000)
    assert held.holds(moment) == (moment >= start.datetime)


def test_statement_that_makes_no_sense(calibration):
    for stated, message in [
        ({"valid_from": "yesterday"}, "valid_from = 'yesterday' is not a date"),
        ({"valid_from": "2025-02-30"}, "is not a date"),
        ({"valid_from": "2026", "valid_until": "2025-01-01"}, "2026|not a date"),
        ({"valid_from": "2025-10-02", "valid_until": "2025-10-02"}, "is not after"),
        ({"optics_in": "nbs"}, "names of optics are needed"),
        ({"optics_in": [3]}, "names of optics are needed"),
        ({"mode": 3}, "mode = 3; text is needed"),
        ({"until": "2025-10-02"}, "= 'until'; allowed are mode, valid_from"),
    ]:
        with refused(message):
            with_validity(calibration, **stated)


def test_validity_of_an_unknown_instrument(calibration):
    other = dataclasses.replace(calibration, settings=calibration.settings | {"instrument": "lab"})
    assert validity_of(other).optics_in is None
    assert "not known" in str(validity_of(other))


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
    assert library.add(calibration, name=path.name) == path
    with pytest.warns(
        AstropolcalWarning, match=f"name = 'other.asdf': .* there .*, as {path.name}"
    ):
        assert library.add(calibration, name="other.asdf") == path
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


@pytest.mark.slow
def test_open_choice_is_refused(calibration, library):
    library.add(calibration, name="a.asdf", optics_in=[])
    library.add(calibration, name="b.asdf", optics_in=["nbs"])
    with refused("a.asdf .*b.asdf .*say which optics_in") as caught:
        library.find("charis", date="2026-01-01")
    assert caught.value.argument == "optics_in"
    library.add(calibration, name="c.asdf", optics_in=["nbs"], valid_from="2026-01-01")
    with refused("b.asdf and c.asdf: a date is needed"):
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
    for name in ("nowhere", "n" * 300, "a\0b"):
        with refused("no such file or folder"):
            Library(tmp_path / name)
    with refused("is a device"):
        Library(os.devnull)


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


# ---- the index ---------------------------------------------------------------------------


@pytest.fixture(scope="module")
def known():
    """Calibrations by the content of their files, and hashes by calibration: what takes long."""
    return {}, {}


@pytest.fixture
def look(monkeypatch, known):
    """Look up as a new process does; return the file's name, and which files were read."""
    # the files of a test are young
    monkeypatch.setattr(module, "_SETTLED", -(10**12))
    names, read, (contents, hashes) = [], module.read_calibration, known

    def counted(path):
        names.append(path.name)
        content = path.read_bytes()
        if content not in contents:
            contents[content] = read(path)
            hashes[id(contents[content])] = content_hash(contents[content])
        return contents[content]

    def look(folder, date="2025-02-15"):
        names.clear()
        module._read.cache_clear()
        return Library(folder).find("charis", date=date).name, sorted(names)

    monkeypatch.setattr(module, "read_calibration", counted)
    monkeypatch.setattr(module, "content_hash", lambda c: hashes.get(id(c)) or content_hash(c))
    look.read = names
    return look


@pytest.fixture(scope="module")
def months(calibration, tmp_path_factory):
    """Content of files that hold for January to April, and one for February in another mode."""
    folder, base = tmp_path_factory.mktemp("months"), calibration
    contents = {}
    for name, month, mode in zip("abcde", (1, 2, 3, 4, 2), (None,) * 4 + ("J",), strict=True):
        stated = {"valid_from": f"2025-0{month}-01", "valid_until": f"2025-0{month + 1}-01"}
        path = folder / f"{name}.asdf"
        with_validity(base, mode=mode, **stated).write(path)
        contents[path.name] = path.read_bytes()
    return contents


@pytest.fixture
def folder(months, tmp_path):
    """January to April."""
    for name, content in months.items():
        if name != "e.asdf":
            (tmp_path / name).write_bytes(content)
    return tmp_path


def told_of(library):
    """Return all that is told of the files without a look-up."""
    held = [(e.path, e.validity, e.content_hash) for e in library.entries]
    return held, [str(row) for row in library.table()], library.overlaps(), library.problems


@pytest.mark.slow
def test_look_up_reads_what_it_chooses_and_what_has_changed(folder, months, look):
    every = sorted(set(months) - {"e.asdf"})
    assert look(folder) == ("b.asdf", every)
    assert look(folder) == ("b.asdf", ["b.asdf"])
    assert look(folder, "2025-04-02") == ("d.asdf", ["d.asdf"])
    (folder / "d.asdf").write_bytes(months["e.asdf"])
    (folder / "c.asdf").unlink()
    assert look(folder, "2025-01-15") == ("a.asdf", ["a.asdf", "d.asdf"])
    assert look(folder, "2025-01-15") == ("a.asdf", ["a.asdf"])
    # what is told of files that are not read is what reading them tells
    look.read.clear()
    module._read.cache_clear()
    told = told_of(Library(folder))
    assert not look.read
    (folder / module._INDEX).unlink()
    assert told_of(Library(folder)) == told
    assert len(look.read) == 3
    # an unreadable file is read each time
    (folder / "d.asdf").write_bytes(b"#ASDF")
    for _ in range(2):
        with refused("d.asdf: truncated"):
            look(folder)
        assert "d.asdf" in look.read


def test_file_in_the_place_of_another_is_noticed(folder, months, look):
    """Of the same size and time of change, under the same name."""
    look(folder)
    path = folder / "a.asdf"
    old, size = path.stat(), len(months["a.asdf"])
    new = months["b.asdf"].replace(b"\n...\n", b"\n...\n", 1)
    assert len(new) == size, "the months have files of the same size"
    path.write_bytes(new)
    os.utime(path, ns=(old.st_atime_ns, old.st_mtime_ns))
    assert path.stat().st_mtime_ns == old.st_mtime_ns
    with refused("for date 2025-01-15"):
        look(folder, "2025-01-15")


def test_index_keeps_nothing_young_or_large(folder, look, monkeypatch):
    for key, value in (("_SETTLED", 10**15), ("_MOST_BYTES", 100)):
        with monkeypatch.context() as patch:
            patch.setattr(module, key, value)
            for _ in range(2):
                assert len(look(folder)[1]) == 4
            assert not (folder / module._INDEX).exists()
    assert len(look(folder)[1]) == 4
    assert len(look(folder)[1]) == 1


def test_links_to_calibrations(folder, months, look, tmp_path_factory):
    target = tmp_path_factory.mktemp("elsewhere").resolve() / "x.asdf"
    target.write_bytes((folder / "b.asdf").read_bytes())
    (folder / "b.asdf").unlink()
    (folder / "b.asdf").symlink_to(target)
    assert look(folder)[0] == "x.asdf"
    assert look(folder) == ("x.asdf", ["x.asdf"])
    assert Library(folder).find("charis", date="2025-02-15").path == target
    target.write_bytes(months["e.asdf"])
    assert Library(folder).find("charis", date="2025-02-15").validity.mode == "J"


def forged(files, name, **changes):
    return module._index(files | {name: files[name] | changes})


def wrong_indexes(files):
    """Return words and content of indexes that are not what they should be."""
    good = module._index(files)
    first = files["a.asdf"]
    yield "empty", b""
    yield "cut off", json.dumps(good).encode()[:-20]
    yield "another year", json.dumps(good).replace("2025-02", "2035-02").encode()
    yield "no JSON", b"\xff\x00"
    yield "deep", b"[" * 100_000
    yield "large", b" " * 10**6 + json.dumps(good).encode()
    yield "list", b"[]"
    for key in good:
        yield f"no {key}", json.dumps({k: v for k, v in good.items() if k != key}).encode()
        yield f"other {key}", json.dumps(good | {key: 7}).encode()
    # with a checksum that is right
    for value in (None, [], 5, "x", {"x": 1}):
        yield f"file is {value!r}", json.dumps(module._index(files | {"b.asdf": value})).encode()
        for key in first:
            content = json.dumps(forged(files, "b.asdf", **{key: value})).encode()
            yield f"{key} is {value!r}", content
        for key in set(first["validity"]) - {"instrument"}:
            held = files["b.asdf"]["validity"] | {key: value}
            yield f"{key} is {value!r}", json.dumps(forged(files, "b.asdf", validity=held)).encode()
    for value in (5, [], {}):
        held = files["b.asdf"]["validity"] | {"instrument": value}
        yield "no instrument", json.dumps(forged(files, "b.asdf", validity=held)).encode()
    # each in the place of the other
    both = forged(files, "a.asdf", validity=files["b.asdf"]["validity"])["files"]
    yield "exchanged", json.dumps(forged(both, "b.asdf", validity=first["validity"])).encode()
    yield "hash", json.dumps(forged(files, "b.asdf", content_hash="0" * 64)).encode()


@pytest.mark.slow
def test_wrong_index_chooses_nothing_wrong(folder, look):
    """And it is written anew."""
    look(folder)
    path = folder / module._INDEX
    right = json.loads(path.read_text())
    assert set(right["files"]) == {"a.asdf", "b.asdf", "c.asdf", "d.asdf"}
    for words, content in wrong_indexes(right["files"]):
        path.write_bytes(content)
        assert look(folder)[0] == "b.asdf", words
        assert look(folder, "2025-01-15")[0] == "a.asdf", words
        assert json.loads(path.read_text())["files"]["b.asdf"] == right["files"]["b.asdf"], words


def test_index_of_other_software_is_not_used(folder, look, monkeypatch):
    look(folder)
    with monkeypatch.context() as patch:
        patch.setattr(module, "our_version", "0.0.1")
        assert len(look(folder)[1]) == 4
    # an instrument may know the optics in the beam, another version of it others
    with monkeypatch.context() as patch:
        patch.setattr(module, "_plugins", lambda: [("bench", "bench:Bench", "1.0")])
        assert len(look(folder)[1]) == 4
    assert len(look(folder)[1]) == 4
    assert len(look(folder)[1]) == 1


def test_without_a_place_for_the_index(folder, look, monkeypatch, tmp_path_factory):
    """What stands in its place is left alone; a folder that cannot be written to is no matter."""
    path, victim = folder / module._INDEX, tmp_path_factory.mktemp("other") / "victim"
    victim.write_text("mine")
    for make in (path.mkdir, lambda: os.mkfifo(path), lambda: path.symlink_to(victim)):
        make()
        before = path.lstat()
        assert [len(look(folder)[1]) for _ in range(2)] == [4, 4]
        assert path.lstat() == before
        path.rmdir() if path.is_dir() else path.unlink()
    assert victim.read_text() == "mine"

    def denied(*_):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(os, "replace", denied)
    assert [look(folder)[0] for _ in range(2)] == ["b.asdf", "b.asdf"]
    assert {path.suffix for path in folder.iterdir()} == {".asdf"}


def test_file_that_changed_after_the_library_was_read(folder, months, look):
    look(folder)
    library = Library(folder)
    (old,) = [entry for entry in library.entries if entry.name == "b.asdf"]
    module._read.cache_clear()
    (folder / "b.asdf").write_bytes(months["e.asdf"])
    with refused("b.asdf: holds something else"):
        old.calibration  # noqa: B018
    found = library.find("charis", date="2025-02-15")
    assert found.validity.mode == validity_of(found.calibration).mode == "J"
    (folder / "b.asdf").unlink()
    library = Library(folder)
    (folder / "b.asdf").write_bytes(months["b.asdf"])
    (folder / "a.asdf").unlink()
    with refused("for date 2025-01-15"):
        library.find("charis", date="2025-01-15")
    assert library.find("charis", date="2025-02-15").name == "b.asdf"


def test_calibration_is_there_only_if_its_file_says_so(calibration, folder, look):
    """An index that tells of it is not enough to leave it out."""
    look(folder)
    path = folder / module._INDEX
    files = json.loads(path.read_text())["files"]
    new = with_validity(calibration, valid_from="2025-07-01")
    path.write_text(json.dumps(forged(files, "a.asdf", content_hash=content_hash(new))))
    module._read.cache_clear()
    written = Library(folder).add(new)
    assert written.name not in files
    assert content_hash(Calibration.read(written)) == content_hash(new)


# ---- what is written ---------------------------------------------------------------------


@pytest.mark.slow
def test_names_that_can_be_added(calibration, library, tmp_path_factory):
    outside = tmp_path_factory.mktemp("outside")
    wrong = [str(outside / "x.asdf"), "../x.asdf", f"../{outside.name}/x.asdf", "sub/x.asdf"]
    wrong += ["..\\x.asdf", "C:x.asdf", "x", "x.fits", ".x.asdf", ".asdf", "", "..", "x.asdf/"]
    wrong += ["a\0.asdf", "a\n.asdf", "a\x1b[2J.asdf", "\ud800.asdf", "x" * 251 + ".asdf", 5]
    wrong += ["é" * 126 + ".asdf"]
    (library.source / "sub").mkdir()
    for name in wrong:
        with refused("^name = .*allowed are .*suffix .asdf$"):
            library.add(calibration, name=name)
    assert not list(library.source.rglob("*.asdf"))
    assert not list(outside.iterdir())
    for i, name in enumerate(("x" * 250 + ".asdf", "Nacht 2025-10-05T09:30 é.asdf")):
        assert library.add(calibration, name=name, mode=f"{i}").name == name
    # a name of its own is such a name, whatever the mode is called
    path = library.add(calibration, mode="../" + "x" * 300)
    assert path.parent == library.source
    odd = dataclasses.replace(calibration, settings=calibration.settings | {"instrument": ".lab"})
    assert library.add(odd).name.startswith("lab_")
    assert len(Library(library.source)) == 4


def test_lock_is_a_file_and_keeps_what_is_in_it(calibration, library, tmp_path_factory):
    lock, victim = library.source / ".lock", tmp_path_factory.mktemp("other") / "victim"
    victim.write_text("mine")
    for make in (
        lambda: lock.symlink_to(victim),
        lambda: lock.symlink_to(victim.parent / "new"),
        lambda: os.mkfifo(lock),
        lock.mkdir,
    ):
        make()
        with refused(r"\.lock: is a link or not a regular file"):
            library.add(calibration)
        lock.rmdir() if not lock.is_symlink() and lock.is_dir() else lock.unlink()
    assert victim.read_text() == "mine"
    assert list(victim.parent.iterdir()) == [victim]
    assert not Library(library.source).entries
    lock.write_text("1234")
    library.add(calibration)
    assert lock.read_text() == "1234"


def test_overlaps_are_those_of_all_pairs():
    dates = (None, "2025-01-01", "2025-03-01T12:00:00.000", "2025-06-01")
    kinds = product(("charis", None), ("J", "j ", None), (None, [["nbs"], []], ["nbs"]))
    ranges = [(a, b) for a, b in product(dates, dates) if None in (a, b) or a < b]
    library = Library([])
    for i, (kind, (start, end)) in enumerate(product(list(kinds)[::2], ranges[::2])):
        held = Validity(kind[0], kind[1], start, end, kind[2])
        library.entries.append(Entry(f"{i:03}.asdf", object(), held, f"{i % 50}"))
    library.entries.sort(
        key=lambda e: (e.validity.instrument or "", e.validity.valid_from or "", e.path)
    )
    expected = []
    for pair in combinations(library.entries, 2):
        # two alone, where there is nothing to leave out
        two = Library([])
        two.entries = list(pair)
        expected += two.overlaps()
    assert 100 < len(expected) < len(library) * (len(library) - 1) / 2
    assert library.overlaps() == expected


def test_one_of_many_open_choices_is_said_in_a_line():
    library = Library([])
    for i in range(50):
        held = Validity("lab", f"mode {i}", "2025-01-01")
        library.entries.append(Entry(f"{i:03}.asdf", object(), held, str(i)))
    with refused("000.asdf.*and 46 more: say which mode") as caught:
        library.find("lab", date="2026-01-01")
    assert len(str(caught.value)) < 500


def write_two(base, folder, number, barrier):
    barrier.wait(60)
    Library(folder).add(base, valid_from=f"20{number}-01-01")
    Library(folder).add(base, valid_from="2010-01-01", mode=f"of {number}")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_concurrent_writers(tmp_path, monkeypatch):
    """Two of three write the same at the same time; each file is whole, and there once."""
    # the index is written each time
    monkeypatch.setattr(module, "_SETTLED", -(10**12))
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
    others = {p.name for p in folder.iterdir() if p.suffix != ".asdf"}
    assert others == {".lock", ".astropolcal-index.json"}
    # no writer has left the index of another in pieces
    index = json.loads((folder / ".astropolcal-index.json").read_text())
    assert set(index["files"]) <= {e.name for e in library.entries}


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


# ---- why, supersession, contexts -----------------------------------------------------------


@pytest.fixture
def years(calibration, library):
    """A library of three years, the second of which was made again."""
    for year in (2025, 2026, 2027):
        library.add(calibration, f"{year}.asdf", valid_from=f"{year}-01-01")
    library.add(calibration, "again.asdf", supersedes=["2026.asdf"], valid_from="2026-01-02")
    return library


def test_a_choice_is_explained(calibration, years):
    years.add(calibration, "other.asdf", valid_from="2025-06-01", mode="K")
    mode = validity_of(calibration).mode
    table = years.explain("charis", date="2026-06-01", mode=mode, beam={"nbs": True})
    why = dict(zip(table["name"], table["why"], strict=True))
    assert table["name"][0] == "again.asdf"
    assert years.find("charis", date="2026-06-01", mode=mode).name == "again.asdf"
    for name, words in {
        "again.asdf": "chosen",
        "2025.asdf": "replaced by again.asdf",
        "2026.asdf": "superseded by again.asdf",
        "2027.asdf": "begins 2027-01-01",
        "other.asdf": "of mode K",
    }.items():
        assert why[name].startswith(words), name
    assert not table.meta["problem"]
    # where there is no choice, the reasons of all are there
    none = years.explain("charis", date="2020-01-01")
    assert "no calibration of charis for date 2020-01-01" in none.meta["problem"]
    assert not any(words.startswith("chosen") for words in none["why"])
    (years.source / "bad.asdf").write_text("bad")
    assert "unreadable" in str(Library(years.source).explain("charis")["why"][-1])


def test_what_is_superseded_is_kept_but_not_chosen(calibration, years):
    assert years.find("charis", date="2026-01-03").name == "again.asdf"
    # neither for the days for which only the superseded one held
    assert years.find("charis", date="2026-01-01").name == "2025.asdf"
    assert "2026.asdf" in years.table()["name"]
    assert Library(years.source).find("charis", date="2026-01-03").name == "again.asdf"
    # nor is it a state of the instrument
    names = {"2025.asdf", "again.asdf", "2027.asdf"}
    assert set(parameter_history(years)["calibration"]) == names
    (group,) = health(years)["groups"]
    assert {each["name"] for each in group["calibrations"]} == names
    assert "2026.asdf is superseded" in group["left_out"]
    with refused("supersedes: no 'gone.asdf'"):
        years.add(calibration, supersedes="gone.asdf", valid_from="2031-01-01")


def test_context_is_what_it_was(calibration, years, tmp_path):
    with refused("allowed are up to 100 letters"):
        years.freeze("../outside")
    years.freeze("spring")
    with refused("spring"):
        years.freeze("spring")
    years.add(calibration, "late.asdf", supersedes=["again.asdf"], valid_from="2026-01-04")
    now, then = Library(years.source), Library(years.source, context="spring")
    assert now.find("charis", date="2026-06-01").name == "late.asdf"
    assert then.find("charis", date="2026-06-01").name == "again.asdf"
    assert now.contexts == ["spring"]
    with refused("context = 'autumn'; allowed are spring"):
        Library(years.source, context="autumn")
    kept = (years.source / "2025.asdf").read_bytes()
    (years.source / "2025.asdf").write_bytes(kept + b" ")
    with refused("context spring: 2025.asdf is not what it was"):
        Library(years.source, context="spring")
    (years.source / "2025.asdf").unlink()
    with refused("context spring: 2025.asdf is missing"):
        Library(years.source, context="spring")
    for content in ("", "[]", '{"version": 1, "files": {"../x.asdf": "00"}}'):
        (years.source / "spring.context.json").write_text(content)
        with refused("is not a context"):
            Library(years.source, context="spring")


def test_archive_of_a_context(years, tmp_path_factory):
    folder, other = (tmp_path_factory.mktemp("archives") for _ in range(2))
    years.freeze("spring")
    with refused("spring.tar: the name must end with .zip"):
        years.export("spring", folder / "spring.tar")
    path = years.export("spring", folder / "spring.zip")
    assert import_context(path, other / "new") == "spring"
    for name in ("2025.asdf", "again.asdf", "spring.context.json"):
        assert (other / "new" / name).read_bytes() == (years.source / name).read_bytes()
    # the same again changes nothing, something else in its place is left alone
    assert import_context(path, other / "new") == "spring"
    (other / "new" / "2025.asdf").write_text("mine")
    with refused("another file 2025.asdf"):
        import_context(path, other / "new")
    assert (other / "new" / "2025.asdf").read_text() == "mine"
    # a folder in the place of a file
    (other / "odd" / "2025.asdf").mkdir(parents=True)
    with refused("2025.asdf: is a folder, not a file"):
        import_context(path, other / "odd")


def test_forged_archives_write_nothing(years, tmp_path_factory):
    folder = tmp_path_factory.mktemp("forged")
    years.freeze("spring")
    good = years.export("spring", folder / "spring.zip")

    def forged(change):
        path = folder / "forged.zip"
        with zipfile.ZipFile(good) as source, zipfile.ZipFile(path, "w") as target:
            for name in source.namelist():
                for new, content in change(name, source.read(name)):
                    target.writestr(new, content)
        return path

    for change, message in (
        (lambda n, c: [(n, c + b" " * n.endswith(".asdf"))], "does not have its checksum"),
        (lambda n, c: [(n, c), ("../evil.asdf", b"")][: 1 + n.endswith("json")], "differ"),
        (lambda n, c: [(n, c)] * (n != "2025.asdf"), "differ"),
        (lambda n, c: [(n, c)] * n.endswith(".asdf"), "is not an archive"),
        (lambda n, c: [(n, b"{}" if n.endswith("json") else c)], "is not a context"),
        (lambda n, c: [(f"../{n}" if n.endswith("json") else n, c)], "allowed are up to"),
    ):
        with refused(message):
            import_context(forged(change), folder / "there")
    # a bit of what is packed
    content = bytearray(good.read_bytes())
    content[len(content) // 2] ^= 1
    (folder / "damaged.zip").write_bytes(content)
    with refused("damaged.zip: is not an archive"):
        import_context(folder / "damaged.zip", folder / "there")
    assert not (folder / "there").exists()
    (folder / "none.zip").write_bytes(b"PK")
    for path in (folder / "none.zip", folder / "missing.zip"):
        with pytest.raises(CalibrationFileError):
            import_context(path, folder / "there")


def test_fetched_has_the_checksum(years, tmp_path_factory, monkeypatch):
    pytest.importorskip("fsspec")
    folder = tmp_path_factory.mktemp("remote")
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder / "cache"))
    (folder / "cache" / "astropy").mkdir(parents=True)
    years.freeze("spring")
    path = years.export("spring", folder / "spring.zip")
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    url = path.as_uri()
    with refused("has the checksum"):
        fetch(url, folder / "library", sha256="0" * 64)
    assert not (folder / "library").exists()
    assert fetch(url, folder / "library", sha256=digest) == "spring"
    assert Library(folder / "library", "spring").find("charis", date="2025-03-01")
    path.unlink()
    # from the cache
    assert fetch(url, folder / "again", sha256=digest) == "spring"
    one = years.source / "2025.asdf"
    digest = hashlib.sha256(one.read_bytes()).hexdigest()
    for where in ("again", "new"):
        assert fetch(one.as_uri(), folder / where, sha256=digest).name == "2025.asdf"
    with refused("cannot be fetched"):
        fetch((folder / "gone.asdf").as_uri(), folder / "again", sha256="1" * 64)
    with refused("cannot be fetched"):
        fetch("nowhere://gone.asdf", folder / "again", sha256="1" * 64)
