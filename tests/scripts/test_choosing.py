# Licensed under a 3-clause BSD style license - see LICENSE
"""Which calibration frames are corrected with, from their headers."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from astropy.io import fits

from astropolcal import Calibration, instruments
from astropolcal.calibration.result.validity import with_validity
from astropolcal.converters.calibration import content_hash
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, ObservationError
from astropolcal.pipeline.library import Library
from astropolcal.scripts._choosing import choose_calibration, configured, read_night

OLD = Path(__file__).parents[1] / "calibration" / "data" / "calibration-1.0.0.asdf"
CHARIS = instruments.get("charis")


@pytest.fixture
def night(tmp_path):
    """Function that writes headers, one a call of keywords, and returns the files."""

    def write(*headers):
        files = []
        for i, changes in enumerate(headers):
            cards = {"INSTRUME": "CHARIS", "RET-ANG1": 0.0, "D_IMRANG": 45.0, "MJD": 60982.5}
            cards["FILTNAME"] = "broadband JHK"
            header = fits.Header({k: v for k, v in (cards | changes).items() if v is not None})
            files.append(tmp_path / f"CRSA{i + 1:08d}_cube.fits")
            fits.PrimaryHDU(header=header).writeto(files[-1])
        return files

    return write


def chosen(calibration, files, **options):
    """Return the provenance of what is chosen, with the options of the command."""
    known = {"calibration": str(calibration), "instrument": None, "optics_in": None}
    known |= {"any_date": False, "filter": None, "max_age": None} | options
    return choose_calibration(SimpleNamespace(**known), files)[2]


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """Two calibrations that follow each other on 2025-12-01."""
    folder = tmp_path_factory.mktemp("library")
    known, base = Library(folder), Calibration.read(OLD)
    known.add(base, name="a.asdf", valid_from="2025-10-01", valid_until="2025-12-01")
    known.add(base, name="b.asdf", valid_from="2025-12-01")
    return folder


# ---- what headers tell -----------------------------------------------------------------


def test_first_and_last_date_whatever_the_order(night):
    files = night({"MJD": 60983.0}, {"MJD": 60982.5}, {"MJD": 60982.75})
    found = read_night(files, CHARIS)
    assert [date[:16] for date in found.dates] == ["2025-11-03T12:00", "2025-11-04T00:00"]


def test_one_date_is_named_once(night):
    assert len(read_night(night({}, {}), CHARIS).dates) == 1


def test_frames_without_date_or_mode_say_nothing(night):
    found = read_night(night({"MJD": None, "FILTNAME": None}), CHARIS)
    assert (found.dates, found.mode) == ([], None)


def test_frames_of_two_modes_are_refused(night):
    files = night({"FILTNAME": "Broadband"}, {"FILTNAME": "J"}, {"FILTNAME": None})
    words = r"1_cube.fits is in mode 'Broadband', .*2_cube.fits in 'J': correct apart"
    with pytest.raises(ObservationError, match=words):
        read_night(files, CHARIS)
    assert read_night(files[1:], CHARIS).mode == "J"


def test_instrument_without_file_layout_is_refused(night):
    bare = SimpleNamespace(name="bare", files=None)
    with pytest.raises(AstropolcalError, match="bare: it is not known how its files look"):
        read_night(night({}), bare)


@pytest.mark.parametrize("files", [[], ["nowhere.fits"], [__file__]])
def test_files_that_cannot_be_read_leave_the_instrument_as_it_is(files):
    assert configured(CHARIS, files) is CHARIS


# ---- a single calibration --------------------------------------------------------------


def test_file_that_holds_is_taken_with_its_hash(night):
    found = chosen(OLD, night({}), optics_in=["nbs"])
    assert found["calibration"] == str(OLD)
    assert found["calibration_hash"] == content_hash(Calibration.read(OLD))


def test_file_for_another_date_is_taken_if_that_is_wanted(night):
    assert chosen(OLD, night({"MJD": 60500.0}), any_date=True, optics_in=["nbs"])


def test_file_for_another_date_is_refused(night):
    words = r"was taken 2024-07-09, but .* holds for .*; --any-date takes it all the same"
    with pytest.raises(AstropolcalError, match=words):
        chosen(OLD, night({"MJD": 60500.0}, {"MJD": 60500.5}), optics_in=["nbs"])


def test_another_mode_is_refused_unless_it_is_the_same(night, tmp_path):
    path = tmp_path / "c.asdf"
    with_validity(Calibration.read(OLD), mode="Broadband").write(path)
    files = night({"FILTNAME": "J"}, {"FILTNAME": "BROADBAND"})
    words = r"in mode 'J', but .*c.asdf holds for .*; if it is the same by .* --filter 'Broadband'"
    with pytest.raises(AstropolcalError, match=words):
        chosen(path, files[:1], optics_in=["nbs"])
    assert chosen(path, files[:1], optics_in=["nbs"], filter="Broadband")
    # the spelling of a mode does not matter
    assert chosen(path, files[1:], optics_in=["nbs"])


def test_mode_that_is_stated_is_that_of_the_file(night, tmp_path):
    path = tmp_path / "c.asdf"
    with_validity(Calibration.read(OLD), mode="broadband JHK").write(path)
    files = night({"FILTNAME": "J"})
    with pytest.raises(AstropolcalError, match=r"mode 'foo', but .*--filter 'broadband JHK'"):
        chosen(path, files, optics_in=["nbs"], filter="foo")
    assert chosen(path, files, optics_in=["nbs"], filter="Broadband  jhk")


def test_mode_is_not_compared_where_the_file_holds_for_any(night, monkeypatch):
    from astropolcal.calibration.result import validity

    monkeypatch.setattr(validity, "validity_of", lambda _: validity.Validity("charis"))
    assert chosen(OLD, night({"FILTNAME": "J"}), optics_in=["nbs"], filter="foo")


def test_frames_that_do_not_say_enough(night, tmp_path):
    bare = {"MJD": None, "FILTNAME": None}
    for lacking, option in (
        ({"MJD"}, {"any_date": True}),
        ({"FILTNAME"}, {"filter": "broadband JHK"}),
    ):
        (file,) = night({key: value for key, value in bare.items() if key in lacking})
        with pytest.raises(AstropolcalError, match=r"cube.fits: its \w+ is not known, .*--(an|fi)"):
            chosen(OLD, [file], optics_in=["nbs"])
        assert chosen(OLD, [file], optics_in=["nbs"], **option)
        file.unlink()


def test_calibration_that_is_old(night):
    early, late = night({"MJD": 60990.0}, {"MJD": 61313.5})
    with pytest.raises(AstropolcalError, match=r"M3 was coated anew between .*--any-date"):
        chosen(OLD, [early, late], optics_in=["nbs"])
    with pytest.warns(AstropolcalWarning, match="0.1 yr from the data"):
        chosen(OLD, [early], optics_in=["nbs"], max_age=0.01)


# ---- a library -------------------------------------------------------------------------


@pytest.mark.parametrize(("mjd", "name"), [(60982.5, "a.asdf"), (61050.0, "b.asdf")])
def test_library_gives_what_holds_for_the_date(night, library, mjd, name):
    found = chosen(library, night({"MJD": mjd}), optics_in=["nbs"])
    assert Path(found["calibration"]).name == name


def test_night_across_a_change_is_refused(night, library):
    files = night({"MJD": 60982.5}, {"MJD": 61050.0})
    words = r"the frames from 2025-11-03.* to 2026-01-10.* need two calibrations, .*a.asdf and .*b"
    with pytest.raises(AstropolcalError, match=words):
        chosen(library, files, optics_in=["nbs"])


def test_library_needs_a_date(night, library):
    with pytest.raises(ObservationError, match="no date in its header to choose a calibration by"):
        chosen(library, night({"MJD": None}), optics_in=["nbs"])


def test_options_are_named_where_a_library_needs_to_know_more(night, tmp_path):
    for mode in ("J", "H"):
        with_validity(Calibration.read(OLD), mode=mode).write(tmp_path / f"{mode}.asdf")
    with pytest.raises(AstropolcalError, match=r"say which mode is meant \(--filter MODE\)"):
        chosen(tmp_path, night({"FILTNAME": None}), optics_in=["nbs"])


def test_no_calibration_holds_for_the_date(night, library):
    with pytest.raises(AstropolcalError, match="2020"):
        chosen(library, night({"MJD": 59000.0}), optics_in=["nbs"])
