# Licensed under a 3-clause BSD style license - see LICENSE
"""What open directions and mirror branches do to bright and faint polarization on sky."""

from dataclasses import replace
from itertools import permutations

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from star_data import CHARIS, META, WAVELENGTH, observe_star, star_chain

from astropolcal import Calibration, calibrate, instruments, optics
from astropolcal.calibration import examine, target_accuracies
from astropolcal.calibration.identifiability.analysis import (
    _best_star,
    mirror_branches,
    star_words,
)
from astropolcal.calibration.identifiability.sky import (
    FITTED,
    LEFT_OUT,
    PUBLISHED,
    consequences_along,
    consequences_of,
    matters,
    shows_on_sky,
    sky_words,
    view_of_calibration,
    view_of_measurement,
)
from astropolcal.chain import join, leaves
from astropolcal.correction.rows import sky_chain
from astropolcal.exceptions import ParameterError
from astropolcal.instruments import Instrument
from astropolcal.measurement import Measurement
from astropolcal.simulation import half_wave_plate_cycles, simulate
from astropolcal.stokes import angle_error

LAMP = META | {"source": "polarized"}


def lamp(seed=1, **options):
    """A chain of the lamp and what it measures."""
    chain = CHARIS.chain("polarized", ["dichroic", "nbs"], wavelength=WAVELENGTH)
    frames = half_wave_plate_cycles(derotator=[45, 57.5, 70, 82.5, 95] * u.deg)
    return chain, simulate(chain, WAVELENGTH, frames, seed=seed, meta=LAMP, **options)


def star(q=0.0, u_=0.0, **options):
    """A chain of a star whose polarization is known exactly, and what it measures."""
    known = optics.PolarizedSource(q=q, u=u_, name="star", fixed={"q": True, "u": True})
    chain = join([known, *leaves(star_chain("star", **options))[1:]])
    return chain, observe_star(chain, source="star", seed=3)


def fitted(*parts, **options):
    chains, data = zip(*parts, strict=True)
    return calibrate(
        list(chains), list(data), instrument="charis", cross_validate=False, search=False, **options
    )


@pytest.fixture(scope="module")
def alone():
    return fitted(lamp())


# ---- steps along directions -----------------------------------------------------------------


def test_polarization_of_the_telescope_is_subtracted_at_a_wrong_angle():
    """A plate that is off by e turns the AoLP by 2 e, and leaves 4 e of D behind."""
    free = {"theta": False, "retardance": True}
    bare = (
        optics.Diattenuator(diattenuation=0.5, name="polarizer", fixed={"diattenuation": True})
        | optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp", fixed=free)
        | optics.WollastonPrism(name="wollaston")
    )
    data = simulate(bare, WAVELENGTH, half_wave_plate_cycles(), noise=False)
    small, diattenuation = 1e-3, 0.01
    held = {"q": True, "u": True}
    sky = join(
        [
            optics.PolarizedSource(name="star", fixed=held),
            optics.Rotator(mount="parallactic", name="parallactic"),
            optics.Diattenuator(diattenuation=diattenuation, name="m3"),
            optics.Rotator(mount="-altitude", name="altitude"),
            *leaves(bare)[1:],
        ]
    )
    seen = observe_star(sky, source="star", noise=False)
    for chain, observed, share in ((bare, data, 0.0), (sky, seen, diattenuation)):
        live = Measurement(chain, observed)
        step = np.zeros((1, live.free.size))
        step[0, live.free.by_name["hwp.theta"].start] = small
        (found,) = consequences_along(view_of_measurement(live, live.vector()), step)
        for target in found["targets"]:
            relative = share / (target["dolp_percent"] / 100)
            assert np.abs(target["dolp_change_percent"]).max() == pytest.approx(
                100 * 4 * small * relative, rel=0.02, abs=2e-3
            )
            # both ways about the turn
            high = np.rad2deg(2 * small * (1 + relative))
            assert np.abs(target["aolp_deg"]).max() == pytest.approx(high, rel=0.02)
        assert found["aolp_deg"] == found["targets"][0]["aolp_deg"]
        assert found["dolp_percent"] == found["targets"][0]["dolp_change_percent"]


@pytest.mark.slow
@pytest.mark.parametrize("real", [False, True])
def test_equal_fits_a_degree_apart_differ_as_predicted(alone, real, request):
    """
    Two calibrations with equal residuals, one used for what the other measures.

    For a target of 1 % in CHARIS it is 6 % of the DoLP: the tertiary mirror polarizes by so much.
    """
    cal, chain = alone, alone.chain
    if real:
        # skips, with the reason, where there are no data
        data = CHARIS.prepare(request.getfixturevalue("charis_data")("dataset3_"))
        (chain,) = CHARIS.chains_for([data])
        cal = calibrate(chain, data, instrument="charis", cross_validate=False)
        chain = cal.chain
    data = cal.measurement.datasets[0].observations
    angle, other = chain["calibration_polarizer"].theta.quantity, chain["derotator"].theta.quantity
    fix = {"calibration_polarizer.theta": angle + 1 * u.deg, "derotator.theta": other}
    moved = calibrate(chain, data, instrument="charis", cross_validate=False, search=False, fix=fix)
    rms = [np.sqrt(np.mean(one.residuals**2)) for one in (cal, moved)]
    assert rms[1] == pytest.approx(rms[0], rel=1e-5)
    found = consequences_of(view_of_calibration(cal), view_of_calibration(moved).chain)
    (said,) = (
        one["sky"]["targets"]
        for one in cal.identifiability.directions
        if one["words"].startswith("calibration_polarizer.theta by +1 deg")
    )
    for one, two in zip(found["targets"][:2], said[:2], strict=True):
        np.testing.assert_allclose(one["aolp_deg"], two["aolp_deg"], atol=0.02)
        np.testing.assert_allclose(
            one["dolp_change_percent"], two["dolp_change_percent"], atol=0.05, rtol=0.01
        )
    np.testing.assert_allclose(
        found["targets"][2]["dolp_change_percent"], said[2]["dolp_change_percent"], rtol=0.02
    )
    assert 4 < max(said[1]["dolp_change_percent"]) < 8
    assert max(map(abs, said[1]["aolp_deg"])) > 2 > 1.2 > max(map(abs, said[0]["aolp_deg"]))


def test_what_is_said_grows_as_the_polarization_becomes_faint(alone):
    (words,) = (
        one["words"]
        for one in alone.identifiability.directions
        if one["words"].startswith("calibration_polarizer.theta")
    )
    said = words.partition("; on sky")[2]
    assert said.startswith(" the AoLP changes by up to 1.1 deg and the DoLP by up to 0.")
    assert " for a source of 30 %; 1 %: 2." in said
    assert "; 0.1 %: " in said
    # the other direction, of the derotator alone, is no matter
    assert any(
        one["words"].endswith("on sky nothing changes") for one in alone.identifiability.directions
    )
    assert any(HD in words for words in alone.identifiability.sampling)


def test_a_file_of_before_knows_one_degree_of_polarization():
    for turn, gain, words in [
        ((0, 0), (0, 0), "on sky nothing changes"),
        ((-5.26, 0), (0, 3), "by up to 5.3 deg and the DoLP by up to 3 % of itself, regardless"),
        ((99.8, 0), (0, 0), "up to 100 deg"),
        ((0.004, -0.004), (-300, 1), "less than 0.01 deg and the DoLP by up to 300 % of"),
    ]:
        sky = {"aolp_deg": list(turn), "dolp_percent": list(gain)}
        assert words in sky_words(sky)
        assert shows_on_sky(sky) == bool(max(map(abs, (*turn, *gain))) > 0)


# ---- the star that settles it -----------------------------------------------------------------

HD = "HD 30675"


def test_star_is_known_and_gets_high():
    for latitude, name in [(19.8, HD), (-24.6, None), (None, HD)]:
        from astropolcal import standards

        found, high = _best_star(latitude)
        known = standards.get(found)
        assert known.kind == "polarized"
        assert known.law_errors
        assert name in (None, found)
        if latitude is None:
            assert high is None
            assert "reaches" not in star_words(None)
        else:
            assert high == pytest.approx(90 - abs(latitude - known.coord.dec.deg))
            assert high > 45


def test_a_polarized_star_closes_the_direction_that_it_is_said_to():
    """With its q and u known, every error on sky is finite, and nothing turns the AoLP."""
    cal = fitted(lamp(), star(0.02, -0.01))
    for direction in cal.identifiability.directions:
        assert max(map(abs, direction["sky"]["aolp_deg"])) < 0.01
    assert not any(HD in words for words in cal.identifiability.sampling)
    assert all(np.isfinite(table["s_chi"]).all() for table in target_accuracies(cal))
    assert view_of_calibration(cal).telescope == FITTED


# ---- mirror branches --------------------------------------------------------------------------


def branches_of(*parts, name="charis"):
    chains, data = zip(*parts, strict=True)
    live = Measurement(list(chains), list(data))
    view = view_of_measurement(live, live.vector(), name)
    return view, mirror_branches(live, live.vector(), view)


def test_hand_of_the_instrument_matters_behind_a_mirror_that_retards():
    view, branches = branches_of(lamp(), star(m3="metal"))
    same, other = branches
    # one optic in two disguises
    assert not shows_on_sky(same["sky"])
    assert "WARNING" not in same["words"]
    assert other["words"].startswith(
        "downstream of the telescope: all retardances with the other sign"
    )
    assert (
        "only bounds or models exclude them; WARNING: if the other one is true, on sky"
        in other["words"]
    )
    assert f"(such as {HD}, which reaches 8" in other["words"]
    assert matters(other["sky"])
    one_percent = other["sky"]["targets"][1]
    assert max(one_percent["dolp_change_percent"]) > 5
    # the same as a mirror whose retardance has the other sign
    m3 = view.chain["m3"]
    lam = WAVELENGTH
    turned = optics.DiattenuatorRetarder(
        diattenuation=m3.diattenuation(lam), retardance=-m3.retardance(lam), name="m3"
    )
    mirrored = join(turned if leaf.name == "m3" else leaf for leaf in leaves(view.chain))
    expected = consequences_of(view, mirrored)["targets"]
    for one, two in zip(other["sky"]["targets"], expected, strict=True):
        for key in ("aolp_deg", "dolp_change_percent"):
            np.testing.assert_allclose(one[key], two[key], atol=2e-3)


def test_hand_is_no_matter_where_something_tells_it_or_nothing_depends_on_it():
    # a polarized star sends circularly polarized light into the instrument
    assert len(branches_of(lamp(), star(0.02, m3="metal"))[1]) == 1
    assert len(branches_of(lamp(), name=None)[1]) == 1
    chain, data = star()
    chain["m3"].retardance = np.full(len(WAVELENGTH), 180.0) * u.deg
    assert len(branches_of(lamp(), (chain, data))[1]) == 1


def test_vampires_is_warned_of_the_other_hand():
    vampires = instruments.get("vampires")
    chain, frames = vampires.published(), half_wave_plate_cycles(derotator=[20, 60, 100] * u.deg)
    frames = frames[np.repeat(np.arange(len(frames)), 2)]
    frames["flc_state"] = np.tile([0.0, 1.0], len(frames) // 2)
    data = simulate(chain, vampires.wavelength, frames, noise=False, meta=vampires.published_meta())
    finding = examine(Measurement(chain, data))
    (branch,) = (b for b in finding.branches if "WARNING" in b["words"])
    assert finding.mirrors == [b["words"] for b in finding.branches]
    assert max(branch["sky"]["targets"][1]["dolp_change_percent"]) > 15


def test_a_branch_within_the_bounds_is_followed_on_sky():
    """A linear plate and derotator, whose bounds leave room for the other hand."""
    _, data = lamp()
    plate = optics.LinearRetarder(retardance=np.full(3, 170.0) * u.deg, mount="hwp", name="hwp")
    chain = CHARIS.chain("polarized", wavelength=WAVELENGTH, derotator="linear")
    chain = join(plate if leaf.name == "hwp" else leaf for leaf in leaves(chain))
    chain["derotator"].retardance.bounds = (None, None)
    branches = branches_of((chain, data))[1]
    (both,) = (b for b in branches if b["words"].startswith("hwp, derotator: all retardances"))
    assert "downstream of the telescope" not in " ".join(b["words"] for b in branches)
    assert shows_on_sky(both["sky"])


# ---- the chain from the sky, and what is stated --------------------------------------------------


def test_where_the_telescope_comes_from(alone):
    assert view_of_calibration(alone).telescope == PUBLISHED
    bare = replace(alone, settings=alone.settings | {"instrument": None})
    assert view_of_calibration(bare).telescope == LEFT_OUT
    for cal, words in ((alone, PUBLISHED), (bare, LEFT_OUT)):
        (table,) = target_accuracies(cal, [(0.01, None)])
        assert words in table.meta["words"]
    # coefficients of four filters, and a date that nobody states
    irdis = instruments.get("irdis")
    chain, frames = irdis.published(), half_wave_plate_cycles(derotator=[20, 60] * u.deg)
    plates = {}
    for mode in (None, "field", "pupil"):
        meta = {} if mode is None else {"tracking": mode}
        live = Measurement(chain, simulate(chain, irdis.wavelength, frames, meta=meta))
        view = view_of_measurement(live, live.vector(), "irdis")
        assert view.telescope == PUBLISHED
        plates[mode] = view.placed["hwp"]
    # the plate follows the sky as the tables state it; else as the first mode does
    np.testing.assert_array_equal(plates[None], plates["field"])
    assert np.abs(plates["pupil"] - plates["field"]).max() > 0.1


def test_accuracy_on_sky_does_not_depend_on_the_order_of_the_datasets(monkeypatch):
    """What not all datasets have upstream belongs to the lamp, and what an instrument says."""
    polarizer = optics.LinearPolarizer(mount="first", name="polarizer")
    retarder = optics.LinearRetarder(retardance=80 * u.deg, mount="unit", name="retarder")
    inner = [
        optics.DiattenuatorRetarder(diattenuation=0.03, retardance=170 * u.deg, name="mirror"),
        optics.LinearRetarder(retardance=125 * u.deg, mount="turning", name="modulator"),
        optics.WollastonPrism(efficiency=0.98, name="prism"),
    ]
    frames = QTable({"turning": np.tile(np.arange(0, 180, 22.5), 6) * u.deg})
    frames["first"] = frames["unit"] = np.repeat(np.arange(0, 180, 30), 8) * u.deg
    parts = []
    for unit in ([polarizer], [polarizer, retarder], []):
        chain = join([*unit, *inner])
        parts.append((chain, simulate(chain, [0.5, 0.6] * u.um, frames, name=f"{len(unit)}")))
    found = []
    for some in permutations(parts):
        cal = calibrate(*map(list, zip(*some, strict=True)), weights="errors", cross_validate=False)
        found.append([table["s_p"].value for table in target_accuracies(cal)])
    assert np.isfinite(found).all()
    np.testing.assert_allclose(found, [found[0]] * len(found), rtol=1e-3)
    # of a single dataset the instrument tells what a star's light meets first
    known = type("Known", (Instrument,), {"name": "known", "entrance": "mirror", "chain": None})
    monkeypatch.setattr(instruments, "_REGISTRY", instruments._REGISTRY | {"known": known})
    cal = calibrate(*parts[1], instrument="known", cross_validate=False)
    assert [leaf.name for leaf in leaves(sky_chain(cal))] == ["mirror", "modulator", "prism"]
    assert next(iter(leaves(view_of_calibration(cal).chain))).name == "mirror"


def test_what_is_open_is_infinite_and_what_it_leaves_alone_is_not(alone):
    """Without telescope the open directions turn the AoLP and do nothing else."""
    bare = replace(alone, settings=alone.settings | {"instrument": None})
    for table in target_accuracies(bare):
        assert np.isinf(table["s_Q"]).all()
        assert np.isinf(table["s_chi"]).all()
        assert np.isfinite(table["s_p"]).all()
    # the polarization of the telescope turns with them
    assert np.isinf(target_accuracies(alone)[0]["s_p"]).all()
    held = calibrate(
        alone.chain, alone.measurement.datasets[0].observations, instrument="charis",
        search=False, cross_validate=False, fix={"hwp.theta": None, "derotator.theta": None},
    )  # fmt: skip
    (faint,) = target_accuracies(held, [(0.0, None)])
    assert np.isfinite(faint["s_p"]).all()
    # an unpolarized target has no angle
    assert np.isinf(faint["s_chi"]).all()


def test_rounding_is_no_open_direction():
    """The retardance of a plate turns no angle; what is computed of that is rounding."""
    frames = half_wave_plate_cycles(derotator=[0, 30, 60, 90] * u.deg)
    frames["lamp"] = frames.columns.pop("derotator")
    grid = [0.5, 0.6, 0.7] * u.um
    for retardance in ([172, 175, 178] * u.deg, 172 * u.deg):
        train = (
            optics.LinearPolarizer(mount="lamp", name="lamp", fixed={"theta": False})
            | optics.LinearRetarder(retardance=retardance, mount="hwp", theta=0.3 * u.deg, name="p")
            | optics.WollastonPrism(efficiency=0.97, name="prism")
        )
        for seed in (1, 2, 3):
            data = simulate(train, grid, frames, flux=1e5, seed=seed)
            cal = calibrate(train, data, weights="errors", cross_validate=False)
            for table in target_accuracies(cal):
                assert np.isfinite(table["s_chi"]).all()
            assert cal.verdict().usable, cal.summary()


def test_error_of_the_model_alone():
    """With a perfect fit it is all that there is: shares of q, of u and of the intensity."""
    cal = fitted(lamp(noise=False), fix={"hwp.theta": None, "derotator.theta": None})
    known = {"wavelength_nm": [1000.0, 2400.0], "relative_percent": [1.0, 1.0],
             "absolute_percent": [0.05, 0.05]}  # fmt: skip
    cal = replace(cal, fit=cal.fit | {"model_error": known})
    for dolp in (0.3, 0.01, 0.001):
        size = np.hypot(0.01 * dolp, 0.0005)
        (table,) = target_accuracies(cal, [(dolp, None)])
        np.testing.assert_allclose(table["s_Q"].to_value(u.one), size, rtol=1e-3)
        np.testing.assert_allclose(table["s_p"].to_value(u.one), size, rtol=1e-3)
        # of a faint target that is no longer size / (2 p)
        np.testing.assert_allclose(table["s_chi"].value, angle_error(dolp, size), rtol=1e-3)
        assert "and an error of the model" in table.meta["words"]


def test_settings_that_tell_no_error_of_the_model_do_not_make_it_smaller(make):
    """Of two angles of the derotator the parameters take all that they share: nothing is known."""
    chain = make.truth(make.chain())
    many, two = make.frames(), make.frames([60, 100] * u.deg)
    tables = [make.off_at_settings(chain, frames, i) for i, frames in enumerate([many, two])]
    known = []
    for chosen in (tables, tables[:1], tables[1:]):
        cal = calibrate([chain] * len(chosen), chosen, search=False, cross_validate=False)
        known.append(np.median(cal.fit["model_error"]["relative_percent"]))
        told = "relative" not in cal.fit["model_error"]["missing"]
        (table,) = target_accuracies(cal, [(0.3, None)])
        assert told == ("and an error of the model" in table.meta["words"])
        assert told == (len(chosen) > 1 or chosen[0].n_frames > 16)
    assert known[0] == pytest.approx(known[1], rel=0.15)


def test_file_holds_and_gives_the_same_numbers(tmp_path):
    cal = fitted(lamp(), star(0.02, -0.01))
    cal.write(tmp_path / "cal.asdf")
    again = Calibration.read(tmp_path / "cal.asdf")
    chosen = [(0.3, None), (0.01, None), (0.001, None), (0.05, 30 * u.deg)]
    tables, others = target_accuracies(cal, chosen), target_accuracies(again, chosen)
    for one, two in zip(tables, others, strict=True):
        for key in one.colnames:
            np.testing.assert_allclose(two[key].value, one[key].value, rtol=1e-9)
        assert one.meta == two.meta
    for entry, table in zip(again.fit["sky_accuracy"], tables[:3], strict=True):
        assert entry["words"] == table.meta["words"]
        np.testing.assert_allclose(entry["s_q_percent"], table["s_Q"].value, rtol=1e-9)
        np.testing.assert_allclose(entry["s_chi_deg"], table["s_chi"].value, rtol=1e-9)
        np.testing.assert_allclose(entry["wavelength_nm"], WAVELENGTH.to_value(u.nm))
    assert again.identifiability.branches == cal.identifiability.branches
    # a file of before does not say where the derotator stood
    del again.fit["sky_settings"]
    assert np.isfinite(target_accuracies(again)[0]["s_p"]).all()


def test_impossible_targets_are_refused_and_no_angles_say_nothing(alone):
    for target in ((2.0, None), (np.nan, None), (0.5, 1 * u.um), ([0.1, 0.2], None)):
        with pytest.raises(ParameterError):
            target_accuracies(alone, [target])
    fixed = optics.LinearRetarder(retardance=80 * u.deg, name="bench")
    train = join([optics.LinearPolarizer(name="polarizer"), fixed, optics.WollastonPrism(name="w")])
    other = replace(alone, chains=[train], settings=alone.settings | {"instrument": None})
    assert target_accuracies(other) == []
