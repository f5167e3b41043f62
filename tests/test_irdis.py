# Licensed under a 3-clause BSD style license - see LICENSE
"""SPHERE/IRDIS: its chain against the published formulae, its headers, correction, diagnosis."""

import datetime
import re
import warnings
from contextlib import nullcontext
from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import QTable, Table
from astropy.time import Time
from star_data import in_radian

from astropolcal import optics
from astropolcal.calibration import calibrate
from astropolcal.chain import insert_optic, leaves, remove_optic, system_mueller, with_beam
from astropolcal.correction import ScienceFrames, correct, measurement_rows
from astropolcal.correction.frames import frame_positions
from astropolcal.exceptions import (
    AstropolcalWarning,
    ChainError,
    InstrumentError,
    ObservationError,
    ParameterError,
)
from astropolcal.gap.effects import EFFECTS, Context, Roles, adapted, get_effect
from astropolcal.instruments import IRDIS, SkyLaw
from astropolcal.observations import Observations, pointing
from astropolcal.simulation import half_wave_plate_cycles, simulate

IRDIS_ = IRDIS()
COATINGS = ("before", "after")
N_POINTINGS = 1000


@pytest.fixture(scope="module")
def published(shared_data):
    """The table of published values, apart from those in the package."""
    table = Table.read(shared_data / "reference" / "irdis_van_holstein_2020.ecsv")
    table.add_index("filter")
    return table


# --- an independent evaluation of the published formulae, in plain numpy --------------------


def turned(angle):
    """T of van Holstein et al. (2020), angle in degree."""
    c, s = np.cos(2 * np.deg2rad(angle)), np.sin(2 * np.deg2rad(angle))
    return np.array([[1, 0, 0, 0], [0, c, s, 0], [0, -s, c, 0], [0, 0, 0, 1.0]])


def component(epsilon, delta):
    """Their general diattenuator-retarder, retardance in degree."""
    root, delta = np.sqrt(1 - epsilon**2), np.deg2rad(delta)
    c, s = root * np.cos(delta), root * np.sin(delta)
    return np.array([[1, epsilon, 0, 0], [epsilon, 1, 0, 0], [0, 0, c, s], [0, 0, -s, c]])


def polarizer(d):
    return 0.5 * np.array([[1, d, 0, 0], [d, 1, 0, 0], [0, 0, 0, 0], [0, 0, 0, 0.0]])


def system(table, band, coating, pointing, side):
    """Their Mueller matrix of the whole system; side is +1 for the left beam."""
    row = table.loc[band]
    hwp = pointing["hwp"] + table.meta["offset_hwp_deg"]
    der = pointing["derotator"] + table.meta["offset_derotator_deg"]
    mirrors = (
        component(row[f"m4_diattenuation_{coating}"], row["mirror_retardance"])
        @ turned(pointing["altitude"])
        @ component(row[f"ut_diattenuation_{coating}"], row["mirror_retardance"])
        @ turned(pointing["parallactic"])
    )
    plate = component(row["hwp_diattenuation"], row["hwp_retardance"])
    derotator = component(row["derotator_diattenuation"], row["derotator_retardance"])
    return (
        polarizer(side * row["polarizer_diattenuation"])
        @ turned(-der)
        @ derotator
        @ turned(der)
        @ turned(-hwp)
        @ plate
        @ turned(hwp)
        @ mirrors
    )


def random_pointings(n, seed=20170416):
    rng = np.random.default_rng(seed)
    ranges = {
        "hwp": (0, 360),
        "derotator": (0, 360),
        "parallactic": (-180, 180),
        "altitude": (10, 90),
    }
    return {name: rng.uniform(*ends, n) for name, ends in ranges.items()}


@pytest.mark.slow
def test_mueller_matrix_is_that_of_the_published_formulae(published):
    """1,000 random pointings, four filters, both beams, to 1e-8."""
    for coating in COATINGS:
        angles = random_pointings(N_POINTINGS)
        sky = IRDIS_.on_sky(IRDIS_.published(), coating=coating)
        positions = {name: values * u.deg for name, values in angles.items()}
        for side, beam in ((1, "left"), (-1, "right")):
            ours = system_mueller(with_beam(sky, beam), IRDIS_.wavelength, positions)
            for k, band in enumerate(IRDIS_.filters):
                for i in range(N_POINTINGS):
                    pointing = {name: values[i] for name, values in angles.items()}
                    theirs = system(published, band, coating, pointing, side)
                    np.testing.assert_allclose(ours[i, k], theirs, rtol=0, atol=1e-8)


def test_coatings_differ_by_what_was_published(published):
    """The diattenuation of the telescope fell by a quarter to a third."""
    before, after = (IRDIS_.chain("star", coating=c)["ut"].diattenuation.value for c in COATINGS)
    np.testing.assert_allclose(before, published["ut_diattenuation_before"], rtol=0, atol=0)
    assert np.all(after < 0.75 * before)


# --- the chain ------------------------------------------------------------------------------


def test_star_chain_has_the_optics_in_order():
    chain = IRDIS_.chain("star")
    assert [leaf.name for leaf in leaves(chain)] == [
        "star", "parallactic", "ut", "altitude", "m4", "hwp", "derotator", "wollaston",
    ]  # fmt: skip
    assert chain["altitude"].mount == "altitude"
    assert chain["ut"].retardance.fixed
    assert not chain["ut"].diattenuation.fixed
    for source in ["polarized", "unpolarized"]:
        first = leaves(IRDIS_.chain(source))[0].name
        assert first == {"polarized": "calibration_polarizer", "unpolarized": "lamp"}[source], (
            source
        )


def test_wavelengths_choose_their_filters_in_any_order():
    chain = IRDIS_.chain("star", wavelength=[2182, 1245] * u.nm)
    whole = IRDIS_.chain("star")
    for name, key in (("derotator", "retardance"), ("m4", "diattenuation")):
        value = getattr(whole[name], key).value
        np.testing.assert_array_equal(getattr(chain[name], key).value, value[[3, 1]])


def test_wavelength_of_no_filter_is_refused():
    for lam in [1.40, 3.8, 0.6]:
        with pytest.raises(
            InstrumentError, match=r"no filter with coefficients; allowed are Y .*Ks"
        ):
            IRDIS_.chain(wavelength=[1.625, lam] * u.um)


def test_unknown_choice_is_refused():
    for options, words in [
        ({"source": "moon"}, r"source = 'moon'; allowed are polarized"),
        ({"source": "star", "coating": "new"}, r"coating = 'new'; allowed are before, after"),
        ({"optics_in": ["nbs"]}, r"irdis: optics_in = 'nbs'; allowed are none"),
    ]:
        with pytest.raises(InstrumentError, match=words):
            IRDIS_.chain(**options)


def test_on_sky_puts_the_telescope_before_the_plate():
    sky = IRDIS_.on_sky(IRDIS_.chain("unpolarized"), coating="before")
    assert sky.submodel_names[:5] == ("parallactic", "ut", "altitude", "m4", "hwp")
    expected = IRDIS_.chain("star", coating="before")["ut"].diattenuation.value
    np.testing.assert_array_equal(sky["ut"].diattenuation.value, expected)


def test_telescope_of_a_chain_of_one_filter_and_of_no_date():
    chain = IRDIS_.chain("polarized", wavelength=[1.245] * u.um)
    with pytest.raises(ChainError, match=r"which of the filters Y, J, H, Ks"):
        IRDIS_.on_sky(chain)
    sky = IRDIS_.on_sky(chain, wavelength=[1.245] * u.um, coating="after")
    assert sky["ut"].retardance.value == pytest.approx(173.414169049)
    # of no date, the newer one
    with pytest.warns(AstropolcalWarning, match=r"neither date nor coating.*from 2017-04-16 on"):
        found = IRDIS_.on_sky(IRDIS_.published())
    np.testing.assert_array_equal(_ut(found), _ut(IRDIS_.chain("star", coating="after")))


def _ut(chain):
    return chain["ut"].diattenuation.value


def test_telescope_on_sky_is_that_of_the_date():
    for date, coating in [
        ("2017-04-15", "before"),
        (Time("2017-04-16T00:10"), "after"),
        (datetime.date(2016, 1, 1), "before"),
        (["2016-01-01", "2016-01-02"], "before"),
        (Time(["2019-01-01", "2019-01-02"]), "after"),
    ]:
        found = IRDIS_.on_sky(IRDIS_.published(), date=date)
        np.testing.assert_array_equal(_ut(found), _ut(IRDIS_.chain("star", coating=coating)))


def test_telescope_that_cannot_be_is_refused():
    for options, words in [
        ({"coating": "new"}, "coating = 'new'; allowed are before, after"),
        ({"date": "last night"}, "date = 'last night' is not a date; allowed"),
        ({"date": ["2017-04-15", "2017-04-17"]}, "of before and of after the recoating"),
        ({"date": "2019-01-01", "coating": "before"}, "coating = 'before', but the date 2019"),
        ({"date": []}, "dates are none"),
    ]:
        with pytest.raises(InstrumentError, match=words):
            IRDIS_.on_sky(IRDIS_.published(), **options)


# --- setup and dates ------------------------------------------------------------------------


def star_table(mirrors="after", n=16, source="unpolarized standard star", **meta):
    """Frames of a star that is tracked before the meridian, with the plate's true angle."""
    hwp = np.tile([0, 45, 22.5, 67.5], n // 4)
    parallactic, altitude = np.linspace(-31, -25, n), np.linspace(60, 62, n)
    frames = QTable({"hwp": hwp * u.deg})
    frames["derotator"] = 0.5 * (altitude - parallactic) * u.deg
    frames["parallactic"], frames["altitude"] = parallactic * u.deg, altitude * u.deg
    frames["hwp_true"] = (hwp + altitude - parallactic) * u.deg
    meta = {"instrument": "SPHERE/IRDIS", "source": source, "date": "2016-02-20"} | meta
    chain = IRDIS_.chain(source, coating=mirrors)
    return simulate(chain, IRDIS_.wavelength, frames, noise=False, meta=meta, name="night")


def test_date_tells_the_coating():
    for meta, coating in [
        ({"date": "2016-02-20"}, "before"),
        ({"date": "2017-04-15T23:59"}, "before"),
        ({"date": "2017-04-16"}, "after"),
        ({"date": "2016-02-20", "coating": "after"}, "after"),
    ]:
        table = star_table(**meta)
        assert IRDIS_.particulars(table)["coating"] == coating, (meta, coating)
        (chain,) = IRDIS_.chains_for([table])
        expected = IRDIS_.chain("star", coating=coating)["ut"].diattenuation.value
        np.testing.assert_array_equal(chain["ut"].diattenuation.value, expected)


def test_star_without_a_coating_is_refused():
    for meta, words in [
        ({"date": None}, "neither date nor coating"),
        ({"date": "2017-04"}, "date = '2017-04' is not a date; allowed"),
        ({"coating": "fresh"}, "night: coating = 'fresh'; allowed are before, after"),
    ]:
        with pytest.raises(InstrumentError, match=words):
            IRDIS_.particulars(star_table(**meta))


def test_internal_source_needs_no_date():
    frames = half_wave_plate_cycles(derotator=[0, 30] * u.deg)
    meta = IRDIS_.published_meta()
    table = simulate(IRDIS_.published(), IRDIS_.wavelength, frames, noise=False, meta=meta)
    assert IRDIS_.setup(table) == ("polarized", ())
    assert IRDIS_.particulars(table) == {}


def test_plate_follows_the_sky_so_that_commanded_angles_mean_q_and_u():
    """With perfect optics, 0 and 45 deg measure Q, 22.5 and 67.5 deg U, wherever it points."""
    for mode in ["field", "pupil"]:
        p, a = np.deg2rad([[-50.0, -50, -50, -50, 70, 70, 70, 70], [35.0] * 4 + [80] * 4])
        hwp = np.tile([0, 45, 22.5, 67.5], 2)
        turn = (a - p) if mode == "field" else a
        frames = QTable({"hwp": hwp * u.deg, "derotator": 0.5 * np.rad2deg(turn) * u.deg})
        frames["parallactic"], frames["altitude"] = np.rad2deg(p) * u.deg, np.rad2deg(a) * u.deg
        table = frames.copy()
        table["frame"], table["bin"] = np.arange(8), np.zeros(8, int)
        table["wavelength"] = 1.625 * u.um
        table["flux_right"] = table["flux_left"] = np.ones(8) * u.adu
        table.meta = {"tracking": mode}
        chain = _ideal_sky()
        positions = IRDIS_.positions(Observations.from_table(table), chain)
        right, left = measurement_rows(chain, positions, [1.625] * u.um)
        single = (left - right)[0][:, 1:3]
        expected = np.tile([[1, 0], [-1, 0], [0, 1], [0, -1]], (2, 1))
        if mode == "field":
            np.testing.assert_allclose(single, expected, atol=1e-12)
        else:
            # the pupil stands still: what is measured is turned with the sky on the detector
            angle = np.arctan2(single[:, 1], single[:, 0])
            steps = np.angle(np.exp(1j * (angle - angle[::4].repeat(4))))
            np.testing.assert_allclose(np.cos(steps), np.tile([1, -1, 0, 0], 2), atol=1e-12)


def _ideal_sky():
    chain = IRDIS_.chain("star", wavelength=[1.625] * u.um)
    for name in ("ut", "m4", "hwp", "derotator"):
        chain[name].diattenuation, chain[name].retardance = [0.0], [180] * u.deg
        chain[name].theta = 0 * u.deg
    chain["wollaston"].efficiency = [1.0]
    return remove_optic(chain, "star")


def test_star_with_neither_true_angle_nor_tracking_is_refused():
    table = star_table()
    frames = table.frames
    bare = QTable({n: frames[n] for n in ("hwp", "derotator", "parallactic", "altitude")})
    with pytest.raises(InstrumentError, match=r"tracking is None.*one of field, pupil"):
        frame_positions(IRDIS_, bare, IRDIS_.chain("star"))


# --- headers ----------------------------------------------------------------------------------


def header(stokes="Qplus", **changes):
    """A primary header as ESO writes it, with the keywords that count."""
    cards = {
        "MJD-OBS": 57438.3, "EXPTIME": 16.0, "RA": 83.8, "DEC": -24.0, "ESO DET NDIT": 4,
        "ESO INS1 FILT ID": "FILT_BBF_J", "ESO INS4 COMB ROT": "FIELD",
        "ESO INS4 DROT3 BEGIN": 160.0, "ESO INS4 DROT3 END": 160.4,
        "ESO INS4 DROT2 BEGIN": 359.8, "ESO INS4 DROT2 END": 0.4,
        "ESO TEL PARANG START": 179.9, "ESO TEL PARANG END": -179.5, "ESO TEL ALT": 62.0,
        "ESO OCS DPI H2RT STOKES": stokes,
    } | changes  # fmt: skip
    made = fits.Header()
    for key, value in cards.items():
        if value is not None:
            made[f"HIERARCH {key}" if key.startswith("ESO") else key] = value
    # through the text of a file, as a header arrives
    return fits.Header.fromstring(made.tostring())


def test_headers_give_the_angles_in_the_middle_of_the_exposure():
    table = IRDIS_.frame_table([header(s) for s in ("Qplus", "Qminus", "Uplus", "Uminus")])
    assert table["hwp"].to_value(u.deg).tolist() == [0, 45, 22.5, 67.5]
    np.testing.assert_allclose(table["hwp_true"].to_value(u.deg), 160.2 - 152.15)
    np.testing.assert_allclose(table["derotator"].to_value(u.deg), 0.1, atol=1e-9)
    parallactic = table["parallactic"].to_value(u.deg)
    np.testing.assert_allclose((parallactic + 360) % 360, 180.2, atol=1e-9)
    np.testing.assert_array_equal(table["wavelength"].to_value(u.um), 1.245)
    assert table.meta["tracking"] == "field"
    assert table.meta["date"] == "2016-02-20"
    assert table["time"][0].startswith("2016-02-20T07:12:35")  # 70.2 s after 7:12, halved


def test_altitude_moves_on_to_the_middle():
    """Far from the meridian a star moves by at most 15 deg an hour."""
    short, long = (
        IRDIS_.frame_table([header(**{"ESO DET NDIT": n})])["altitude"][0].to_value(u.deg) - 62
        for n in (1, 100)
    )
    assert 0 < abs(short) < abs(long) < 15 * (100 * 17 + 3) / 2 / 3600


def test_pupil_tracking_adds_half_the_offset_of_the_pupil():
    field, pupil = (
        IRDIS_.frame_table([header(**{"ESO INS4 COMB ROT": mode})]) for mode in ("FIELD", "PUPIL")
    )
    difference = pupil["derotator"] - field["derotator"]
    assert difference.to_value(u.deg) == pytest.approx(135.99 / 2)


def test_site_and_laws_are_those_of_the_subclass():
    """At another site the altitude moves otherwise, and a plate that stands does not turn."""

    class Elsewhere(IRDIS):
        sky_law = SkyLaw(plate=(0.0, 0.0), derotator={"field": (0, 0), "pupil": (0, 0.5)})
        files = replace(IRDIS.files, site=(-155.5, 19.8, 4139.0))

    cards = header(**{"ESO DET NDIT": 100, "ESO INS4 DROT3 END": None})
    tables = []
    for one in (IRDIS_, Elsewhere()):
        with pytest.warns(AstropolcalWarning, match="until the middle") as caught:
            tables.append(one.frame_table([cards]))
        assert ("by up to 0 deg" in str(caught[0].message)) == (one is not IRDIS_)
        layout = one.configured(cards).files
        assert layout.tracking == one.sky_law.plate_law("field")
        with pytest.warns(AstropolcalWarning, match="until the middle"):
            found = layout.from_header(cards)["ESO TEL ALT"]
        assert found == pytest.approx(tables[-1]["altitude"][0].value, abs=1e-9)
    assert abs(tables[0]["altitude"] - tables[1]["altitude"])[0] > 0.01 * u.deg
    Elsewhere.files = replace(IRDIS.files, site=())
    with pytest.raises(ParameterError, match="the site of the telescope is needed"):
        Elsewhere().frame_table([cards])


def test_angles_of_the_start_alone_are_taken_and_told():
    """What is lost is how far the stages turn until the middle, which the other laws tell."""
    for mode in ["FIELD", "PUPIL"]:
        start = {"ESO INS4 DROT2 BEGIN": None, "ESO INS4 DROT2 START": 10.0} | {
            f"ESO INS4 DROT{i} END": None for i in (2, 3)
        }
        cards = {"ESO INS4 COMB ROT": mode, "ESO DET NDIT": 100}
        with pytest.warns(AstropolcalWarning) as caught:
            table = IRDIS_.frame_table([header(**cards), header(**cards, **start)])
        np.testing.assert_allclose(table["hwp_true"][1].to_value(u.deg), 160.0 - 152.15)
        offset = {"FIELD": 0.0, "PUPIL": 135.99 / 2}[mode]
        np.testing.assert_allclose(table["derotator"].to_value(u.deg), [0.1 + offset, 10 + offset])
        target = SkyCoord(83.8 * u.deg, -24 * u.deg)
        times = Time(57438.3, format="mjd") + [0, 0.5 * (100 * 16.938 + 2.4)] * u.s
        change = {
            key: np.diff(np.unwrap(angle.to_value(u.deg), period=360))[0]
            for key, angle in zip(
                ("altitude", "parallactic"), pointing(target, times, IRDIS_.location), strict=True
            )
        }
        laws = {
            "hwp_true": IRDIS_.sky_law.plate_law(mode.lower()),
            "derotator": IRDIS_.sky_law.derotator_law(mode.lower()),
        }
        assert len(caught) == 2, mode
        for warning, (column, keyword) in zip(
            caught, {"hwp_true": "DROT3", "derotator": "DROT2"}.items(), strict=True
        ):
            words = str(warning.message)
            assert words.startswith(
                f"no keyword ESO INS4 {keyword} END in 1 frame of 2, the first"
            ), mode
            lost = abs(laws[column] @ np.array([change["parallactic"], change["altitude"]]))
            assert lost > 0.1, mode
            assert words.endswith(f"it turns by up to {lost:.2g} deg"), mode
            assert warning.filename == __file__, mode


def test_stage_that_moves_within_a_frame_is_told():
    absent = dict.fromkeys(("ESO TEL PARANG START", "ESO OCS DPI H2RT STOKES", "RA"))
    for number, column in ((2, "derotator"), (3, "hwp_true")):
        first, last = (f"ESO INS4 DROT{number} {word}" for word in ("BEGIN", "END"))
        # a lamp stands still; with a star near the zenith the stages turn in half an hour
        for off_sky, cards, turn, told in (
            (absent, {}, 0.9, ""),
            (absent, {}, -12.0, "12"),
            ({}, {}, 1.1, ""),
            ({}, {"ESO DET NDIT": 100}, 1.9, ""),
            ({}, {}, 40.0, "40"),
        ):
            angles = {first: 359.0, last: (359.0 + turn) % 360}
            frames = [header(**off_sky), header(**off_sky, **cards, **angles)]
            with warnings.catch_warnings(record=True) as caught:
                warnings.simplefilter("always")
                IRDIS_.frame_table(frames)
            words = " ".join(str(warning.message) for warning in caught)
            assert bool(caught) == bool(told), (column, turn, words)
            assert re.search(rf"^$|by up to {told}.* frame 1: {column} moved", words), words


def test_internal_frames_have_no_sky():
    absent = dict.fromkeys(("ESO TEL PARANG START", "ESO OCS DPI H2RT STOKES", "RA"))
    table = IRDIS_.frame_table([header(**absent)])
    assert "parallactic" not in table.colnames
    assert table["hwp"].to_value(u.deg) == pytest.approx(160.2 - 152.15)


def test_header_that_cannot_be_used_is_refused():
    for changes, error, words in [
        (
            {"ESO INS4 DROT3 BEGIN": None, "ESO INS4 DROT3 END": None},
            ObservationError,
            "frame 1: no keyword ESO INS4 DROT3 BEGIN",
        ),
        ({"ESO TEL ALT": "high"}, ObservationError, "frame 1: ESO TEL ALT = 'high'; a number"),
        ({"ESO TEL ALT": "6_2"}, ObservationError, "frame 1: ESO TEL ALT = '6_2'; a number"),
        ({"EXPTIME": -1.0}, ObservationError, "frame 1: EXPTIME = '-1.0'; .* at least 0"),
        # what stands for no value would have a mean, too
        ({"ESO TEL PARANG START": 9999.0}, ObservationError, "START = '9999.0'; .* -720 to 720"),
        ({"ESO INS4 DROT2 END": 180.3}, ObservationError, "BEGIN = 359.8, but .* = 180.3; within"),
        ({"ESO TEL ALT": 96.0}, ObservationError, "ESO TEL ALT = '96.0'; a number from 0 to 90"),
        ({"RA": 400.0}, ObservationError, "RA = '400.0'; a number from 0 to 360 is needed"),
        ({"ESO INS4 COMB ROT": "NONE"}, ObservationError, "allowed are FIELD, PUPIL"),
        ({"ESO TEL PARANG START": None}, ObservationError, "frame 1: no keyword ESO TEL PARANG"),
        ({"ESO OCS DPI H2RT STOKES": "V"}, ObservationError, "'V'; allowed are Qplus"),
        ({"ESO INS1 FILT ID": "FILT_NBF_CntK1"}, InstrumentError, "'FILT_NBF_CntK1' has no coef"),
        ({"ESO INS1 FILT ID": "FILT_BBF_H"}, ObservationError, "frames of several filters: H, J"),
        ({"MJD-OBS": 57900.0}, InstrumentError, "before and from after the recoating"),
    ]:
        with pytest.raises(error, match=words):
            IRDIS_.frame_table([header(), header(**changes)])
    with pytest.raises(ObservationError, match="no headers"):
        IRDIS_.frame_table([])


def test_headers_with_fluxes_are_a_table_that_calibrates():
    headers = [header(s) for s in ("Qplus", "Qminus", "Uplus", "Uminus")]
    table = IRDIS_.frame_table(headers)
    table["bin"] = np.zeros(4, dtype=int)
    table["flux_right"], table["flux_left"] = [5, 6, 5, 4] * u.adu, [5, 4, 5, 6] * u.adu
    table.meta["source"] = "star"
    observations = Observations.from_table(table)
    (chain,) = IRDIS_.chains_for([observations])
    positions = IRDIS_.positions(observations, chain)
    np.testing.assert_allclose(np.rad2deg(positions["hwp"]), 8.05)


# --- correction ---------------------------------------------------------------------------------


def test_q_and_u_are_corrected():
    """What the published chain measures of a disk is turned back into its Q and U."""
    for coating in COATINGS:
        for observable in ["intensity", "double"]:
            table = star_table(coating, n=16).frames
            sky = IRDIS_.on_sky(IRDIS_.published(), coating=coating)
            positions = frame_positions(IRDIS_, table, sky)
            rng = np.random.default_rng(5)
            light = np.stack(
                [np.full((4, 5), 1000.0), *rng.normal(0, 20, (2, 4, 5)), np.zeros((4, 5))]
            )
            rows = measurement_rows(sky, positions, IRDIS_.wavelength)
            right, left = np.einsum("bwfs,swx->bfwx", rows, light)
            frames = ScienceFrames.from_arrays(
                right, left, IRDIS_.wavelength, in_radian(positions), hwp=table["hwp"]
            )
            done = correct(sky, frames, observable=observable)
            np.testing.assert_allclose(done.q, light[1] / 1000, atol=1e-9)
            np.testing.assert_allclose(done.u, light[2] / 1000, atol=1e-9)


def test_correction_with_the_other_coating_leaves_their_difference():
    """Correcting with the wrong coating leaves up to the change of the diattenuation."""
    table = star_table("before", n=16).frames
    true, wrong = (IRDIS_.on_sky(IRDIS_.published(), coating=c) for c in COATINGS)
    positions = frame_positions(IRDIS_, table, true)
    right, left = np.moveaxis(measurement_rows(true, positions, IRDIS_.wavelength)[..., 0], 1, 2)
    frames = ScienceFrames.from_arrays(right, left, IRDIS_.wavelength, in_radian(positions))
    left_over = np.hypot(*(getattr(correct(wrong, frames), key) for key in "qu"))
    change = true["ut"].diattenuation.value - wrong["ut"].diattenuation.value
    assert np.all(left_over > 0.2 * change)
    assert np.all(left_over < 1.2 * change + 1e-3)


def test_calibrated_internal_source_corrects_a_star():
    """Simulated calibration data, then the star: the whole way."""
    frames = half_wave_plate_cycles(derotator=[0, 20, 45, 70, 110] * u.deg)
    truth = IRDIS_.published()
    truth["derotator"].retardance = truth["derotator"].retardance.value * u.deg + 1.5 * u.deg
    table = simulate(
        truth, IRDIS_.wavelength, frames, flux=1e8, seed=3, meta=IRDIS_.published_meta()
    )
    calibration = calibrate(
        IRDIS_.chains_for([table]), [table], instrument="irdis", search=False, cross_validate=False
    )
    # the telescope is that of the frames' date
    for coating, date in (("after", None), ("after", "2018-05-01"), ("before", "2016-05-01")):
        sky = IRDIS_.on_sky(truth, coating=coating)
        star = star_table(coating, n=16).frames
        positions = frame_positions(IRDIS_, star, sky)
        rows = measurement_rows(sky, positions, IRDIS_.wavelength)
        right, left = np.moveaxis(rows @ [1000, 30, -20, 0], 1, 2)
        science = ScienceFrames.from_arrays(
            right, left, IRDIS_.wavelength, in_radian(positions), hwp=star["hwp"], date=date
        )
        no_date = pytest.warns(AstropolcalWarning, match="neither date nor coating")
        with nullcontext() if date else no_date:
            done = correct(calibration, science, observable="double", open_directions="ignore")
        np.testing.assert_allclose(done.q, 0.03, atol=3e-4)
        np.testing.assert_allclose(done.u, -0.02, atol=3e-4)


# --- what a diagnosis asks of it ------------------------------------------------------------------


def applicable(chain):
    return {name for name, effect in EFFECTS.items() if effect.applies([chain])}


def minimal(plate=True):
    """A polarimeter with a plate and a splitter only: no derotator, no telescope."""
    chain = optics.LinearPolarizer(name="polarizer") | optics.WollastonPrism(name="wollaston")
    if plate:
        hwp = optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="plate")
        chain = insert_optic(chain, hwp, after="polarizer")
    return chain


def test_no_effect_of_an_optic_that_is_absent():
    for place in ["derotator", "telescope", "tertiary", "sky"]:
        found = {effect.name for effect in adapted(EFFECTS.values(), [minimal()])}
        words = {effect.name: effect.place for effect in adapted(EFFECTS.values(), [minimal()])}
        assert found <= applicable(minimal()), place
        assert not {name for name, where in words.items() if place in where}, place
        assert any(place in effect.place for effect in EFFECTS.values()), place


def test_relay_stands_behind_the_plate_where_there_is_no_derotator():
    named = {effect.name: effect for effect in adapted(EFFECTS.values(), [minimal()])}
    assert named["static_retarder"].place == "relay downstream of the half-wave plate"
    assert "derotator" not in named["mirror_flip"].title
    with_one = adapted([EFFECTS["static_retarder"]], [IRDIS_.chain("polarized")])
    assert with_one[0] == EFFECTS["static_retarder"]
    assert [effect.name for effect in with_one[1:]] == ["static_retarder:hwp"]


def test_an_effect_of_irdis_needs_its_place():
    assert len([n for n in applicable(minimal()) if n.startswith("hwp_")]) > 5
    assert not {n for n in applicable(minimal(plate=False)) if n.startswith("hwp_")}
    # those of the telescope, on the sky only
    star, internal = IRDIS_.chain("star"), IRDIS_.chain("polarized")
    for name in ("parallactic_sign", "altitude_sign", "sky_background"):
        assert name in applicable(star)
        assert name not in applicable(internal)
    # the diattenuation of the telescope is a free parameter of the chain already
    assert "m3_diattenuation" not in applicable(IRDIS_.chain("unpolarized standard star"))


def test_an_effect_edits_one_optic_of_a_kind():
    """Four diattenuating retarders, but one half-wave plate and one derotator."""
    chain, context = IRDIS_.chain("star"), Context(IRDIS_.wavelength.to_value(u.um))
    roles = Roles(chain)
    assert (roles.plate.name, roles.derotator.name) == ("hwp", "derotator")
    for name in ("hwp_tilt", "derotator_diattenuation"):
        (edited,) = get_effect(name).edit([chain], context).chains
        added = set(edited.submodel_names) - set(chain.submodel_names)
        assert added == {f"gap_{name}"}
