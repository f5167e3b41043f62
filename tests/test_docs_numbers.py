# Licensed under a 3-clause BSD style license - see LICENSE
"""The numbers on pages are those that come out, or were measured."""

import json
import re
import runpy
import warnings
from datetime import datetime
from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import Table

from astropolcal import Observations, calibrate, instruments
from astropolcal.calibration import star_check
from astropolcal.calibration.validation import star_stokes
from astropolcal.calibration.validation.targets import paper_accuracies
from astropolcal.efficiency import polarimetric_efficiency
from astropolcal.exceptions import AstropolcalWarning

CHARIS = instruments.get("charis")
PAGE = Path(__file__).resolve().parents[1] / "docs" / "charis.rst"
NM = CHARIS.wavelength.to_value(u.nm)
#: Parallactic angle and altitude of the paper's figure of the efficiency.
POINTINGS = ((32, 48), (94, 60), (126, 60), (24, 67))


def _rows(title):
    """Cells of the list-table of a section, by the first of them."""
    text = PAGE.read_text(encoding="utf-8")
    section = re.search(rf"^{title}\n-+\n(.*?)(?:^\S[^\n]*\n-+\n|\Z)", text, re.S | re.M).group(1)
    table = section.split(".. list-table::")[1]
    rows = re.split(r"^   \* - ", table, flags=re.M)[1:]
    cells = (
        [" ".join(cell.split()) for cell in re.split(r"^     - ", row, flags=re.M)] for row in rows
    )
    return {first: rest for first, *rest in cells}


ROWS = _rows("Number by number")


#: Medians of the accuracy that the table of the fits states, of Datasets 3 and 1.
OF_JOINT_FITS = dict(
    zip(
        (3, 1),
        re.search(
            r"^astropolcal, joint fit \(the default\) +9 +(\S+) +(\S+)$",
            PAGE.with_name("charis_fits.rst").read_text(encoding="utf-8"),
            re.M,
        ).groups(),
        strict=True,
    )
)


def _cell(start):
    (row,) = [cells for name, cells in ROWS.items() if name.startswith(start)]
    return row[1]


def _numbers(text):
    return [float(number) for number in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", text)]


def _states(start, *expected):
    """Whether a cell has these numbers, rounded as it rounds them."""
    cell = _cell(start)
    found = [n for n in re.findall(r"(?<![\w.])-?\d+(?:\.\d+)?", cell)]
    for value in expected:
        rounded = {f"{value:.{len(n.partition('.')[2])}f}" for n in found}
        assert rounded & set(found), f"docs/charis.rst, {start}: {cell!r}, found is {value:.4g}"


def as_published(tables, **options):
    """Calibrate as the paper: stars exactly unpolarized, mirrors straight, independent data."""
    chains = CHARIS.chains_for(tables, exact=True, **options)
    return calibrate(chains, tables, errors="white", cross_validate=False)


@pytest.fixture(scope="module")
def data(shared_data):
    def read(name):
        (path,) = (shared_data / "data" / "charis").glob(f"{name}*.ecsv")
        with warnings.catch_warnings():
            # frames of the warming lamp are masked, which is said
            warnings.simplefilter("ignore", AstropolcalWarning)
            return CHARIS.prepare(Observations.read(path))

    return read


@pytest.fixture(scope="module")
def lamps(data):
    """Joint fits of Datasets 1 and 3."""
    tables = {number: data(f"dataset{number}") for number in (1, 3)}
    return {number: as_published([table]) for number, table in tables.items()}


@pytest.fixture(scope="module")
def joint_data(data):
    return [data(name) for name in ("dataset3", "dataset4", "hd293396")]


@pytest.fixture(scope="module")
def joint(joint_data):
    return as_published(joint_data)


def _percent(column):
    return column.to_value(u.percent)


def _s_mean(cal):
    return _percent(cal.accuracy["s_mean"])


def test_rows_are_read():
    assert len(ROWS) == 21
    assert ROWS["Quantity"] == ["Paper", "Here", "Difference"]
    assert all(len(cells) == 3 and all(cells) for cells in ROWS.values())


def test_differences_of_numbers_are_right():
    """Where paper and page have one number each, and the difference is one."""
    checked = 0
    for name, (paper, here, difference) in ROWS.items():
        if re.fullmatch(r"[+-]\d[\d.]*", difference):
            theirs, ours = _numbers(paper)[0], _numbers(here)[0]
            assert ours - theirs == pytest.approx(float(difference), abs=1e-9), name
            checked += 1
    assert checked >= 3


def test_numbers_of_the_paper_are_stated(shared_data):
    """Those of its tables, its abstract and its conclusions, as it writes them."""
    for number in [
        *("1.653", "1.291", "-0.02", "-0.04", "0.03", "0.18", "0.996", "3.186", "1.040", "15.56"),
        *("9.69", "0.12", "3.2", "93", "23", "64.0", "67.0"),
    ]:
        source = (shared_data / "paper" / "charis_recalibration.tex").read_text(encoding="utf-8")
        assert number.removeprefix("-") in source, number
        stated = " ".join(cells[0] for cells in ROWS.values())
        assert re.search(rf"(?<![\d.]){re.escape(number)}(?![\d.]*\d)", stated), number


@pytest.mark.slow
def test_numbers_of_the_polarized_lamp(lamps, data, shared_data):
    cal = lamps[3]
    _states("data of a wavelength", len(data("dataset3").pairs()))
    _states("parameters", len(cal.covariance), cal.accuracy["k"][0], cal.identifiability.rank)
    for start, name in (("quartz", "w_sio2"), ("MgF", "w_mgf2")):
        value = getattr(cal.chain["hwp"], name).quantity
        _states(start, value.to_value(u.mm), cal.covariance.std(f"hwp.{name}").to_value(u.mm))
    for number in (1, 3):
        rounded = f"{np.median(_s_mean(lamps[number])):.3f}"
        assert rounded == OF_JOINT_FITS[number], number
    short = NM < 1400
    published = Table.read(shared_data / "reference" / "charis_published_fits.ecsv")
    theirs = published["s_rel_elliptical_dataset3"] - published["s_rel_elliptical_dataset1"]
    ours = _s_mean(cal) - _s_mean(lamps[1])
    name = ":math:`s_\\mathrm{rel}` with"
    _states(name, ours[short].mean(), theirs[short].mean())
    # beyond the dichroic's band the order of the two is the other way round
    assert ours[~short].mean() < 0


@pytest.mark.slow
def test_angle_of_the_polarizer_with_the_others_straight(data):
    held = {"hwp.theta": 0 * u.deg, "derotator.theta": 0 * u.deg}
    table = data("dataset3")
    cal = calibrate(
        CHARIS.chains_for([table]), table, fix=held, errors="white", cross_validate=False
    )
    off = cal.chain["calibration_polarizer"].theta.value - 90
    _states("derotator, half-wave", off, cal.covariance.std("calibration_polarizer.theta").value)


@pytest.mark.slow
def test_retardance_of_the_plate_near_1300_nm(data, lamps):
    """Fitted alone it leaves the law where the derotator is a half-wave retarder."""
    table = data("dataset3")
    chains = CHARIS.chains_for([table])
    steps = calibrate(chains, table, strategy="two-step", cross_validate=False)
    alone = np.abs(steps.stages[0]["parameters"]["hwp.retardance"].to_value(u.deg))
    law = np.abs(lamps[3].chain["hwp"].retardance(CHARIS.wavelength).to_value(u.deg))
    worst = np.argmax(np.abs(alone - law))
    assert NM[worst] == pytest.approx(1329, abs=1)
    _states("half-wave plate near", np.abs(alone - law)[worst], round(NM[worst]))


@pytest.mark.slow
def test_numbers_of_the_star(joint, joint_data):
    star = joint_data[2]
    altitude = np.rad2deg(star.position("altitude"))
    _states("HD 293396, altitude", altitude.min(), altitude.max())
    found = star_stokes(joint, joint.chains[2], star)
    dolp = np.hypot(_percent(found["q"]), _percent(found["u"]))
    _states("HD 293396, cycles", found["n_cycles"].max())
    _states("HD 293396, DoLP", np.median(dolp), dolp.max())


@pytest.mark.slow
def test_numbers_of_a_target(joint):
    (table,) = paper_accuracies(joint, [(1 * u.percent, 50 * u.deg)])
    s_p, s_chi = _percent(table["s_p"]), table["s_chi"].to_value(u.deg)
    _states(":math:`s_p`", s_p.min(), s_p.max())
    _states(":math:`s_\\chi`", s_chi.min(), s_chi.max())
    s_rel, s_unpol, s_abs = (_percent(table[f"s_{name}"]) for name in ("rel", "unpol", "abs"))
    _states(":math:`s_\\mathrm{unpol}`", np.median(s_unpol), np.median(s_rel))
    equal = 100 * s_abs / s_rel
    short = NM < 1340
    _states("DoLP above", equal[short].min(), equal[short].max(), np.median(equal))


@pytest.mark.long
def test_numbers_of_the_law_of_m3(joint_data):
    """Which of many equal sets comes out hangs on rounding; that none is determined does not."""
    cal = as_published(joint_data, m3="power law")
    known = cal.parameter_values()
    numbers = [known[f"m3.{name}"] for name in ("m1", "m2", "b1", "b2")]
    # what ends exactly at its bound has no error
    assert all(number["at_bound"] or number["std"] > 1 for number in numbers)
    assert "none determined" in _cell(":math:`m_1")
    diattenuation = cal.chains[2]["m3"].diattenuation(CHARIS.wavelength)
    _states(":math:`m_1", 100 * diattenuation[0], 100 * diattenuation[-1])


@pytest.mark.slow
def test_numbers_of_the_efficiency():
    sky = CHARIS.on_sky(CHARIS.published())
    angles = np.arange(0, 180, 1.0)
    found = np.array(
        [
            polarimetric_efficiency(
                sky,
                CHARIS.wavelength,
                derotator=angles * u.deg,
                altitude=altitude * u.deg,
                parallactic=parallactic * u.deg,
            )
            for parallactic, altitude in POINTINGS
        ]
    )
    at = np.abs(NM - 1575).argmin()
    first, second = found[:, :90, at].argmin(axis=1), 90 + found[:, 90:, at].argmin(axis=1)
    _states("derotator angles", first.min(), first.max(), second.min(), second.max())
    change = 100 * np.ptp(found[:, [45, 135]], axis=0)
    _states("change of these dips", np.median(change), change.max())


@pytest.mark.slow
def test_numbers_of_the_polarized_standard(data):
    """The calibration of February 2025, and the standard that it has not seen."""
    tables = [data("dataset1"), data("hd35532")]
    cal = as_published(tables)
    star = data("hd30675")
    (chain,) = CHARIS.chains_for([star])
    found = star_check(cal, chain, star)
    nm = found["wavelength"].to_value(u.nm)
    dolp = _percent(found["dolp"])[nm < 1760]
    _states("HD 30675", dolp.min(), dolp.max())


def test_text_of_the_challenges_is_that_of_their_tables():
    """The sentences below the tables repeat sums of their rows."""
    rates, causes = (
        Table.read(PAGE.with_name(f"challenge_{name}.csv"), format="csv")
        for name in ("rates", "reliability")
    )
    text = " ".join(PAGE.with_name("challenge.rst").read_text(encoding="utf-8").split())
    count, mean, right = (np.asarray(causes[name], float) for name in causes.colnames[1:4])
    sure = np.array([float(row.split()[0]) >= 80 for row in causes[causes.colnames[0]]])
    share = [np.average(of[sure], weights=count[sure]) for of in (right, mean)]
    assert f"first {rates['Number'][0]} challenges" in text
    assert f"Of the {count[sure].sum():.0f} causes that were given with 80 %" in text
    assert "more, {:.1f} % are right, and their mean probability is {:.0f} %".format(*share) in text
    doubtful = np.array([50 <= float(row.split()[0]) < 80 for row in causes[causes.colnames[0]]])
    right, mean = (np.average(of[doubtful], weights=count[doubtful]) for of in (right, mean))
    words = f"Of the {count[doubtful].sum():.0f} between 50 and 80 %, {right:.0f} % are right"
    assert f"{words}, and their mean probability is {mean:.0f} %" in text
    wrong = {row[0]: round(row["Number"] * row["Wrong (%)"] / 100) for row in rates}
    where = ["all", "mechanism", "pair", "SNR 10 to 20", "SNR 40 to 80"]
    assert [kind for kind, n in wrong.items() if n] == where
    assert wrong["all"] == 3
    none = dict(zip(rates[rates.colnames[0]], rates["Number"], strict=True))["none"]
    assert f"nothing in all {none} challenges without a fault" in text
    assert "Three answers are wrong: a course of a depolarization as two steps" in text
    absorbed = dict(zip(rates[rates.colnames[0]], rates["Number"], strict=True))["absorbed"]
    assert f"nor in the {absorbed} whose fault" in text
    seeds = Table.read(PAGE.with_name("challenge_seeds.csv"), format="csv")
    scores = sum(seeds[f"{score} (%)"] for score in ("Right", "Silent", "Wrong"))
    np.testing.assert_allclose(scores, 100, atol=0.15)


def test_effects_that_the_model_lacks_are_within_the_claims_that_the_page_states():
    runs = Table.read(PAGE.with_name("unlisted_effects.csv"), format="csv")
    text = " ".join(PAGE.with_name("noise.rst").read_text(encoding="utf-8").split())
    bright, faint = (runs[f"real_{dolp}"] / runs[f"stated_{dolp}"] for dolp in (30, 1))
    within = [[round(100 * np.mean(one <= n)) for n in (1, 2, 3)] for one in (bright, faint)]
    assert f"Each of {len(runs)} simulated runs" in text
    shares = (
        "{} % of the errors of the DoLP are within the claim, {} % within twice and {} % within"
    )
    assert shares.format(*within[0]) in text
    assert "for one of 1 % these are {}, {} and {} %".format(*within[1]) in text
    assert "{:.0f} and {:.0f} times".format(*np.sort(bright)[-2:]) in text


@pytest.mark.slow
def test_a_run_with_an_effect_that_the_model_lacks_is_that_of_the_table():
    runs = Table.read(PAGE.with_name("unlisted_effects.csv"), format="csv")
    measure = runpy.run_path(PAGE.with_name("measure_unlisted.py"))["measure"]
    for row in runs[[1, 132]]:
        found = measure(int(row["seed"]))
        assert found[:4] == [str(row[name]) for name in runs.colnames[:4]]
        np.testing.assert_allclose([float(x) for x in found[4:]], list(row)[4:], rtol=0.05)


def test_speed_is_that_of_one_run_on_the_machine_that_the_page_names():
    """What the text says of the machine is what the measurement of the growth wrote down."""
    machine = Table.read(PAGE.with_name("speed_scaling.ecsv")).meta
    text = " ".join(PAGE.with_name("speed.rst").read_text(encoding="utf-8").split())
    versions = {name: machine[name].rpartition(".")[0] for name in ("python", "numpy", "scipy")}
    for words in ("Python {python}", "numpy {numpy}", "scipy {scipy}"):
        assert words.format(**versions) in text
    assert f"in {datetime.fromisoformat(machine['date'] + '-01'):%B %Y}" in text
    rows = Table.read(PAGE.with_name("speed.csv"), format="csv")
    others = " ".join(str(name) for name in rows["Beside"])
    assert all(name in others for name in ("katsu", "py_pol", "scipy", "photutils", "emcee"))


def test_damaged_files_of_every_reader_are_counted_and_none_failed():
    counts = Table.read(PAGE.with_name("fuzz_counts.csv"), format="csv")
    assert not counts["Failed"].any()
    assert (counts["Refused"] + counts["Valid"] == 1000).all()
    assert "For a thousand damaged files" in PAGE.with_name("trust.rst").read_text(encoding="utf-8")


def test_costs_of_an_archive_are_those_of_its_record():
    """What the page derives for a million frames follows from what was measured."""
    record = json.loads(PAGE.with_name("archives.json").read_text(encoding="utf-8"))
    text = " ".join(PAGE.with_name("archives.rst").read_text(encoding="utf-8").split())
    million, hour = 1e6, 3600.0
    sequences = million / record["frames_per_sequence"]
    small = sequences * record["seconds_per_sequence"]
    cubes = million * record["cube_seconds_per_frame"]
    # milliseconds each: seconds of a million are a thousand times the number
    first, again = (1e3 * record[f"{k}header_milliseconds"] for k in ("", "unchanged_"))
    for words in (
        f"{record['sequences']} sequences of {record['frames_per_sequence']} small CHARIS frames "
        f"({record['megabytes_per_frame']} MB each",
        f"local cluster of {record['cluster_workers']} workers, one of which was killed "
        f"{record['workers_killed']} times. All {record['done']} products",
        f"{record['differing']} of them differ in a bit",
        f"{record['cores']} cores and was shared; its load was {record['load']}",
        f"reading a header into the index {record['header_milliseconds']} ms",
        f"has not changed {record['unchanged_header_milliseconds']} ms",
        f"correcting a small sequence {record['seconds_per_sequence']} s",
        f"with one process {record['serial_seconds']:.0f} s",
        f"a worker killed twice {record['cluster_seconds']:.0f} s",
        f"to be done for them {record['resume_seconds']} s",
        f"of a worker, small frames {record['worker_megabytes']:.0f} MB",
        f"(22 x 201 x 201) {record['cube_seconds_per_frame']:.2f} s",
        f"of a worker, whole cubes {record['cube_megabytes']:.0f} MB",
        f"all headers with one process {first / hour:.1f} h",
        f"no file has changed {again:.0f} s",
        f"small frames, {sequences:.0f} sequences: one core {small / hour:.0f} h",
        f"small frames: 100 cores {small / 100 / 60:.0f} min",
        f"whole cubes: one core {cubes / hour:.0f} h",
        f"whole cubes: 100 cores {cubes / 100 / hour:.1f} h",
        f"100 workers, whole cubes {record['cube_megabytes'] / 10:.0f} GB",
        f"about {100 / record['cube_seconds_per_frame']:.0f} frames per second",
    ):
        assert words in text
    assert record["done"] == record["sequences"]
    assert record["failed"] == record["differing"] == record["resumed_sequences"] == 0
