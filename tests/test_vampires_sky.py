# Licensed under a 3-clause BSD style license - see LICENSE
"""VAMPIRES on sky: telescope, triple differences, and stars corrected in both states."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from star_data import in_radian

from astropolcal import instruments, optics
from astropolcal.calibration import calibrate
from astropolcal.chain import leaves, stages
from astropolcal.correction import ScienceFrames, correct, measurement_rows
from astropolcal.correction.frames import frame_positions
from astropolcal.exceptions import ChainError, InstrumentError, ObservationError
from astropolcal.measurement import Measurement
from astropolcal.observations.observables import get_observable
from astropolcal.reduction.cubes import both_states, true_observations
from astropolcal.simulation import half_wave_plate_cycles, simulate

VAMPIRES = instruments.get("vampires")
FIELDS = VAMPIRES.wavelength
TRIPLE = "normalized_triple_difference"
META = {"instrument": "SCExAO/VAMPIRES", "flc": "in", "pairing": "flc_state"}


def internal(**options):
    return VAMPIRES.chain(wavelength=FIELDS, derotator="linear", **options)


def lamp(derotator=(45, 60, 75, 90), seed=1, **options):
    table = both_states(half_wave_plate_cycles(derotator=derotator * u.deg))
    meta = META | {"source": "polarized"}
    return simulate(internal(), FIELDS, table, seed=seed, meta=meta, **options)


def track(cycles=4):
    """A star that crosses the meridian while the derotator keeps the pupil."""
    table = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, np.zeros(cycles) * u.deg)
    n = len(table)
    table["parallactic"] = np.linspace(-40, 30, n) * u.deg
    table["altitude"] = np.linspace(55, 70, n) * u.deg
    table["derotator"] = 0.5 * table["altitude"] + 40 * u.deg
    return both_states(table)


def star(chain, stokes=(1, 0, 0, 0), **options):
    return true_observations(
        chain, VAMPIRES, track(), wavelength=FIELDS, source="star", stokes=stokes, **options
    )


# --- triple differences -----------------------------------------------------------------------


def test_triple_difference_of_a_table_by_hand():
    night = lamp(noise=False)
    a_plus, b_plus, a_minus, b_minus = night.groups(4)[0]
    assert night.position("flc_state")[[a_plus, b_plus, a_minus, b_minus]].tolist() == [0, 1, 0, 1]
    assert np.rad2deg(night.position("hwp")[[a_plus, a_minus]]).tolist() == [0, 45]
    x = night.flux_right - night.flux_left
    total = night.flux_right + night.flux_left
    difference = x[a_plus] - x[b_plus] - x[a_minus] + x[b_minus]
    expected = difference / total[[a_plus, b_plus, a_minus, b_minus]].sum(axis=0)
    measured = Measurement(internal(), night, observable=TRIPLE)
    part = measured.datasets[0]
    first = measured.observed[part.group_of_datum == 0]
    np.testing.assert_allclose(first, expected, rtol=1e-12)


def test_triple_differences_are_blind_to_the_relay_and_to_the_cameras():
    """What stands still behind the plate shows in differences of states, not in those of both."""
    plain, changed = internal(), internal()
    for chain in (plain, changed):
        chain["flc"].retardance = np.full(4, 180) * u.deg
        chain["flc"].switching_angle = 45 * u.deg
        chain["relay"].retardance = np.zeros(4) * u.deg
        chain["relay"].diattenuation = np.zeros(4)
    changed["relay"].diattenuation = np.full(4, 0.1)
    table = both_states(half_wave_plate_cycles(derotator=[45, 60] * u.deg))
    predicted = {}
    for name in ("normalized_double_difference", TRIPLE):
        data = [simulate(c, FIELDS, table, noise=False, meta=META) for c in (plain, changed)]
        pair = [Measurement(c, d, observable=name).observed for c, d in zip(
            (plain, changed), data, strict=True)]  # fmt: skip
        predicted[name] = np.abs(pair[1] - pair[0]).max()
    assert predicted["normalized_double_difference"] > 0.05
    # to second order: the sum of both beams depends on the plate
    assert predicted[TRIPLE] < 0.02


@pytest.mark.slow
def test_errors_of_triple_differences_are_their_scatter():
    clean = Measurement(internal(), lamp(noise=False, flux=1e5), observable=TRIPLE)
    pulls = []
    for seed in range(4):
        noisy = Measurement(internal(), lamp(seed=seed, flux=1e5), observable=TRIPLE)
        pulls.append((noisy.observed - clean.observed) / noisy.sigma)
    # 256 data: a standard deviation is known to 4 per cent
    assert np.std(pulls) == pytest.approx(1, abs=0.15)


@pytest.mark.long
def test_fit_of_triple_differences_gives_back_the_truth():
    night, start = lamp(noise=False), internal()
    # triple differences do not see these
    for name, key in (("relay", "diattenuation"), ("cameras", "imbalance")):
        getattr(start[name], key).fixed = True
    start["hwp"].retardance = start["hwp"].retardance.quantity + 4 * u.deg
    start["derotator"].retardance = start["derotator"].retardance.quantity - 5 * u.deg
    found = calibrate(start, night, observable=TRIPLE, cross_validate=False)
    np.testing.assert_allclose(found.residuals, 0, atol=2e-5)
    for name in ("hwp", "derotator"):
        value, true = (c[name].retardance.value for c in (found.chain, internal()))
        np.testing.assert_allclose(value, true, atol=0.2)


def test_triple_difference_of_a_table_without_states_or_with_one_missing():
    night = lamp(noise=False)
    table = night.to_table()
    with pytest.raises(ObservationError, match=r"row 1: flc_state A at hwp = 0 deg.*state B"):
        night.select(np.arange(night.n_frames) != 1).groups(4)
    del table["flc_state"]
    with pytest.raises(ObservationError, match="no column flc_state; it is needed, with A or B"):
        type(night).from_table(table, name="night").groups(4)
    with pytest.raises(ObservationError, match="groups of 3 frames; allowed are 1, 2 and 4"):
        night.groups(3)


def test_a_masked_frame_takes_its_triple_difference_with_it():
    night = lamp(noise=False)
    whole = Measurement(internal(), night, observable=TRIPLE)
    mask = np.zeros(night.n_frames, dtype=bool)
    mask[3] = True
    part = Measurement(internal(), night.with_mask(mask, "test"), observable=TRIPLE)
    assert whole.n_data - part.n_data == 4
    assert get_observable(TRIPLE).frames_per_datum == 4


# --- the telescope ------------------------------------------------------------------------------


def test_chain_of_a_star():
    chain = VAMPIRES.chain("star")
    assert [leaf.name for leaf in leaves(chain)][:5] == ["star", "parallactic", "m3", "altitude",
                                                        "hwp"]  # fmt: skip
    assert chain["m3"].retardance.fixed
    assert not chain["m3"].diattenuation.fixed
    silver = optics.MetalMirror(material="silver", incidence=45 * u.deg)
    np.testing.assert_allclose(chain["m3"].diattenuation.value, silver.diattenuation(FIELDS))
    for model, name in (("metal", "MetalMirror"), ("power law", "PowerLawMirror")):
        assert type(VAMPIRES.chain("star", m3=model)["m3"]).__name__ == name
    with pytest.raises(InstrumentError, match="vampires: m3 = 'glass'; allowed are"):
        VAMPIRES.chain("star", m3="glass")


def test_sky_before_an_internal_chain():
    sky = VAMPIRES.on_sky(internal())
    assert tuple(stages(sky)) == ("parallactic", "altitude", "hwp", "derotator", "flc_state")
    assert VAMPIRES.on_sky(sky) is sky
    with pytest.raises(ChainError, match="no optic 'hwp' to put the telescope before"):
        VAMPIRES.on_sky(optics.LinearPolarizer(name="a") | optics.WollastonPrism(name="w"))


def test_half_wave_plate_follows_the_sky():
    night = star(VAMPIRES.on_sky(internal()), meta=META | {"source": "star"})
    positions = VAMPIRES.positions(night, VAMPIRES.on_sky(internal()))
    expected = night.position("hwp") + 0.5 * night.position("parallactic")
    turned = np.mod(positions["hwp"] - expected - night.position("altitude"), np.pi)
    np.testing.assert_allclose(np.minimum(turned, np.pi - turned), 0, atol=1e-9)
    assert VAMPIRES.location.lat.deg == pytest.approx(19.8255)


def test_names_of_the_targets():
    meta = META | {"source": "unpolarized standard star", "object": "HD 293396"}
    night = star(VAMPIRES.on_sky(internal()), meta=meta)
    assert VAMPIRES.setup(night) == ("unpolarized standard star", ("flc",))
    assert VAMPIRES.particulars(night) == {"star": "star_HD293396", "target": "HD 293396"}
    (chain,) = VAMPIRES.chains_for([night])
    assert leaves(chain)[0].name == "star_HD293396"


@pytest.mark.slow
def test_unpolarized_star_calibrates_the_tertiary_mirror():
    truth = VAMPIRES.on_sky(internal())
    meta = META | {"source": "unpolarized standard star", "object": "HD 293396"}
    night = star(truth, meta=meta, noise=True, seed=4, flux=1e8)
    (start,) = VAMPIRES.chains_for([night], derotator="linear")
    for leaf in leaves(start):
        for key in leaf.param_names:
            getattr(leaf, key).fixed = (leaf.name, key) != ("m3", "diattenuation")
    start["m3"].diattenuation = np.full(4, 0.03)
    found = calibrate(start, night, cross_validate=False)
    true = truth["m3"].diattenuation(FIELDS)
    np.testing.assert_allclose(found.chain["m3"].diattenuation.value, true, atol=3e-4)


# --- correction ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def seen():
    """A star of 2 and -1 per cent in both states, without noise."""
    sky = VAMPIRES.on_sky(internal())
    night = star(sky, stokes=(1, 0.02, -0.01, 0))
    return sky, night, VAMPIRES.positions(night, sky)


def test_star_is_corrected_with_both_states(seen):
    for observable in ["intensity", "single", "double"]:
        sky, night, positions = seen
        frames = ScienceFrames.from_arrays(
            night.flux_right, night.flux_left, FIELDS, in_radian(positions), hwp=night.frames["hwp"]
        )
        found = correct(sky, frames, observable=observable)
        np.testing.assert_allclose(found.q, 0.02, atol=1e-9)
        np.testing.assert_allclose(found.u, -0.01, atol=1e-9)


def test_double_differences_of_science_frames_are_of_one_state(seen):
    _, night, positions = seen
    frames = ScienceFrames.from_arrays(
        night.flux_right, night.flux_left, FIELDS, in_radian(positions), hwp=night.frames["hwp"]
    )
    state = np.asarray(positions["flc_state"])
    assert np.all(state[frames.pairs[:, 0]] == state[frames.pairs[:, 1]])
    assert len(frames.pairs) == night.n_frames // 2


def test_states_exchanged_would_be_seen(seen):
    """The test above must be able to fail: with A taken for B nothing is right."""
    sky, night, positions = seen
    wrong = positions | {"flc_state": 1 - positions["flc_state"]}
    frames = ScienceFrames.from_arrays(night.flux_right, night.flux_left, FIELDS, in_radian(wrong))
    assert np.abs(correct(sky, frames).q - 0.02).max() > 0.01


def headers(**columns):
    table = track(1)
    table["flc_state"] = np.tile(["A", "B"], len(table) // 2)
    for name, values in columns.items():
        table[name] = values
    return QTable(table)


def test_state_of_every_science_frame():
    sky = VAMPIRES.on_sky(internal())
    positions = frame_positions(VAMPIRES, headers(), sky)
    assert positions["flc_state"].tolist() == [0, 1] * 4
    assert measurement_rows(sky, positions, FIELDS).shape == (2, 4, 8, 4)
    names = [f"n{i}.fits" for i in range(8)]
    lost = ["A", "B", "", *"BABAB"]
    with pytest.raises(ObservationError, match=r"n2\.fits: no state of the modulator, flc_state"):
        frame_positions(VAMPIRES, headers(flc_state=lost), sky, names=names)
    bare = headers()
    del bare["flc_state"]
    with pytest.raises(ObservationError, match=r"n0\.fits: no state of the modulator"):
        frame_positions(VAMPIRES, bare, sky, names=names)
