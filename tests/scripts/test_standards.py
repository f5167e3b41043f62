# Licensed under a 3-clause BSD style license - see LICENSE
"""``astropolcal standards``."""

import json

import astropy.units as u
import pytest
from astropy.table import QTable

from astropolcal import standards
from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.observations import pointings
from astropolcal.scripts.main import build_parser, main

NIGHT = ["--site", "subaru", "--night", "2025-11-03"]


def call(*argv):
    arguments = build_parser().parse_args(["standards", *argv])
    arguments.run(arguments)


def printed(capsys, *argv):
    call(*argv)
    return capsys.readouterr().out


def test_everything_is_listed_in_80_columns(capsys):
    lines = printed(capsys).splitlines()
    assert len(lines) == 1 + len(standards.names())
    assert max(map(len, lines)) <= 80


def test_selection_by_kind_magnitude_and_position(capsys):
    text = printed(capsys, "--kind", "unpolarized", "--magnitude", "9,10", "--band", "H")
    assert "HD 293396" in text
    assert " polarized" not in text
    near = printed(capsys, "--near", "05:26:06,+16:42:00", "--radius", "3").splitlines()
    assert near[1].startswith("HD 35532")
    assert near[1].endswith("0.0")
    assert near == printed(capsys, "--near", "81.525,16.7", "--radius", "3").splitlines()


def test_a_night_adds_angles_and_the_score(capsys):
    text = printed(capsys, "--kind", "unpolarized", "--magnitude", "9,10", *NIGHT)
    lines = text.splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[0].split()[-3:] == ["hours", "M3", "score"]
    scores = [float(line.split()[-1]) for line in lines[1:3]]
    assert scores == sorted(scores)
    assert lines[1].startswith("HD 14069")
    # a site may be a place
    text = printed(capsys, "HD 293396", "--site=-155.476,19.8255,4139", "--night", "2025-11-03")
    assert "above 30 deg" in text


def test_one_star_with_all_that_is_known(capsys):
    text = printed(capsys, "hd30675", *NIGHT)
    assert max(map(len, text.splitlines())) <= 80
    for words in ("3.9 +- 0.03 %", "0.52 +- 0.01 um", "Whittet et al. 1992", "highest", "M3 error"):
        assert words in text
    # numbers from memory are marked
    assert "partly from memory" in printed(capsys, "HD 212311")
    assert "memory" not in printed(capsys, "HD 293396")


def test_json_of_one_star(capsys, tmp_path):
    path = tmp_path / "star.json"
    call("HD 30675", *NIGHT, "--json", str(path))
    content = json.loads(path.read_text())
    seen = standards.observability("HD 30675", "subaru", "2025-11-03")
    assert content["law"]["p_max_percent"] == pytest.approx(3.9)
    assert content["measurements"][0]["p_percent"] == 3.37
    assert content["altitude_deg"] == pytest.approx(list(seen.altitude.value))
    assert content["m3_error"] == pytest.approx(seen.information(32).diattenuation)
    assert content["night"] == "2025-11-03"


def test_json_of_many_to_the_standard_output(capsys):
    text = printed(capsys, "--kind", "unpolarized", *NIGHT, "--json", "-")
    content = json.loads(text)
    names = [star["name"] for star in content["stars"]]
    assert names == list(
        standards.search(kind="unpolarized", site="subaru", night="2025-11-03")["name"]
    )
    # what is not determined is null, not a number
    assert None in [star["m3_error"] for star in content["stars"]]
    assert {"altitude_min_deg", "parallactic_max_deg", "hours"} <= set(content["stars"][0])


def test_bad_input_is_refused_with_what_is_allowed(tmp_path, monkeypatch):
    for argv, words in [
        (["HD 30676"], "did you mean HD 30675"),
        (["HD 30675", "--kind", "polarized"], "--kind polarized cannot be combined with NAME"),
        (["HD 30675", "--site", "subaru"], "--site subaru needs --night YYYY-MM-DD"),
        (["HD 30675", "--site", "subaru", "--night", "2025-02-30"], "night = '2025-02-30'"),
        (["HD 30675", "--site", "atlantis", "--night", "2025-11-03"], "--site atlantis: not known"),
        (["--site", "3", "--night", "2025-11-03"], "--site 3: .*, or LON,LAT,HEIGHT in deg, deg"),
        (["--site", "subaro", "--night", "2025-11-03"], "did you mean 'subaru'"),
        (["HD 30675", "--site", "1,2,three", "--night", "2025-11-03"], "--site 1,2,three"),
        (["HD 30675", "--site=10,95,0", "--night", "2025-11-03"], "--site 10,95,0"),
        (["Cha F7", *NIGHT], "does not rise above 30 deg"),
        (["--magnitude", "30,31"], "no standard star fits"),
        (["--near=0,-80", *NIGHT], "no standard star above 30 deg"),
        (["--radius", "5"], "--radius 5 needs --near RA,DEC"),
        (["--min-altitude", "30"], "--min-altitude 30 needs --night"),
        (["HD 30675", "--band", "H"], "--band H cannot be combined with NAME"),
        (["--near", "north"], "--near north"),
        (["--near", "400,0"], "--near 400,0: .* a right ascension from -360 to 360 deg"),
        (["--band", "Z"], "band = 'Z'"),
        ([*NIGHT, "--min-altitude", "91"], "min_altitude = 91 deg"),
    ]:
        monkeypatch.chdir(tmp_path)
        with pytest.raises(ParameterError, match=words):
            call(*argv)
        assert list(tmp_path.iterdir()) == [], (argv, words)


def test_a_range_of_magnitudes_is_two_numbers(capsys):
    for text in ("5", "5,nan"):
        with pytest.raises(SystemExit):
            call("--magnitude", text)
        assert f"'{text}' is not 2 numbers" in capsys.readouterr().err


def test_an_unknown_folder_leaves_no_file(tmp_path):
    with pytest.raises(AstropolcalError, match="no folder"):
        call("HD 30675", "--json", str(tmp_path / "no" / "star.json"))
    assert list(tmp_path.iterdir()) == []


# ---- how many are listed ---------------------------------------------------------------


def stars_in(text):
    """Return the names listed, and the lines behind the table."""
    head, *lines = text.splitlines()
    end = lines.index("") if "" in lines else len(lines)
    assert head.startswith("name")
    return [line[:15].strip() for line in lines[:end]], lines[end:]


@pytest.mark.slow
def test_a_night_lists_the_best_and_says_how_many_more(capsys):
    names, rest = stars_in(printed(capsys, *NIGHT))
    every = standards.search(site="subaru", night="2025-11-03")["name"]
    assert names == list(every[:20])
    assert rest[-1] == f"{len(every) - 20} more stars; --limit {len(every)} lists all"


def test_limit_is_taken_by_lists_of_any_kind(capsys):
    names, rest = stars_in(printed(capsys, *NIGHT, "--limit", "2"))
    assert len(names) == 2
    assert "more stars" in rest[-1]
    names, rest = stars_in(printed(capsys, "--limit", "3"))
    assert len(names) == 3
    assert rest == [
        "",
        f"{len(standards.names()) - 3} more stars; --limit {len(standards.names())} lists all",
    ]
    # one more is one star
    n = len(standards.search(kind="unpolarized", magnitude=(9, 10), band="H"))
    words = ["--kind", "unpolarized", "--magnitude", "9,10", "--band", "H", "--limit", str(n - 1)]
    assert printed(capsys, *words).splitlines()[-1] == f"1 more star; --limit {n} lists all"
    assert "more star" not in printed(capsys, *words[:-1], str(n))


def test_machines_get_all_unless_they_ask_for_fewer(capsys):
    every = json.loads(printed(capsys, *NIGHT, "--json", "-"))["stars"]
    few = json.loads(printed(capsys, *NIGHT, "--json", "-", "--limit", "3"))["stars"]
    assert len(every) > 20
    assert few == every[:3]


def test_impossible_limits():
    for argv, words in [
        (["--limit", "0"], "--limit 0: allowed are whole numbers from 1 up"),
        (["--limit", "-2"], "--limit -2"),
        (["HD 30675", "--limit", "2"], "--limit 2 cannot be combined with NAME"),
    ]:
        with pytest.raises(ParameterError, match=words):
            call(*argv)


def test_a_column_of_zero_has_no_sign():
    from astropolcal.scripts._standards import _night_table

    columns = {"name": ["A"], "kind": ["polarized"], "magnitude": [4.0] * u.mag}
    columns |= {"magnitude_band": ["V"], "hours": [2.0] * u.h, "m3_error": [0.1], "m3_score": [0.1]}
    for end, value in (("min", -0.2), ("max", 0.2)):
        columns[f"altitude_{end}"] = [30.0] * u.deg
        columns[f"parallactic_{end}"] = [value] * u.deg
    line = _night_table(QTable(columns))[1]
    assert "   0 to    0" in line


def test_what_is_of_another_band_is_said(capsys):
    words = ["--kind", "unpolarized", "--magnitude", "9,10"]
    text = printed(capsys, *words, "--band", "H")
    head, *lines = text.splitlines()
    assert head.endswith("p (%) in H")
    n = len(standards.search(kind="unpolarized", magnitude=(9, 10), band="H"))
    note = f"{n} of {n} have no magnitude in H: V instead, by which --magnitude selects them."
    assert note in lines
    # the catalogue has no unpolarized star in the infrared
    assert all("*" in line for line in lines[:n])
    assert lines[-1] == "* no polarization in H: p is of the band nearest to V"
    assert "no magnitude in H" in printed(capsys, *words, "--band", "H", *NIGHT)
    plain = printed(capsys, *words)
    assert "*" not in plain
    assert "no magnitude" not in plain
    # what is of the band needs no note
    lines = printed(capsys, "--band", "H", "--near", "72.7,28.3", "--radius", "1").splitlines()
    assert lines[0].split()[-4:] == ["(%)", "in", "H", "deg"]
    assert len(lines) == 2
    assert " H " in lines[1]
    assert "*" not in lines[1]


@pytest.mark.filterwarnings("always")
def test_a_far_night_is_warned_of_in_one_line(capsys, no_network):
    for options in (["--limit", "2"], ["HD 7927"]):
        pointings._SAID.clear()
        assert main(["standards", *options, "--site", "subaru", "--night", "2031-11-03"]) == 0
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith("astropolcal: warning: times after ")


def test_new_tables_are_fetched_where_that_is_asked_for(capsys, monkeypatch):
    from astropy.utils import iers
    from astropy_iers_data import IERS_A_FILE

    asked, usual = [], iers.earth_orientation_table.get()
    command = ["standards", "HD 7927", "--site", "subaru", "--night", "2025-11-03", "--online"]

    def fetch(url, **options):
        asked.append(url)
        return IERS_A_FILE

    def refuse(url, **options):
        raise OSError("no route to the host")

    monkeypatch.setattr(pointings, "download_file", fetch)
    used = []
    monkeypatch.setattr(
        pointings, "_warn_of_uncovered", lambda _: used.append(iers.earth_orientation_table.get())
    )
    assert main(command) == 0
    assert asked == [iers.conf.iers_auto_url]
    assert used[0] is not usual
    assert iers.earth_orientation_table.get() is usual
    monkeypatch.setattr(pointings, "download_file", refuse)
    assert main(command) == 2
    assert "no route to the host" in capsys.readouterr().err
