# Licensed under a 3-clause BSD style license - see LICENSE
"""VAMPIRES: tables of single differences, the liquid crystal, and its real data."""

import warnings

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import instruments
from astropolcal.calibration import calibrate
from astropolcal.calibration.fit.calibrate import fitted
from astropolcal.calibration.fit.strategies import stands_out
from astropolcal.exceptions import AstropolcalWarning, InstrumentError, ObservationError
from astropolcal.measurement import Measurement
from astropolcal.observations import Observations
from astropolcal.observations.observables import pair_states
from astropolcal.observations.reading import filter_wavelength, stated_wavelength
from astropolcal.reduction import both_states
from astropolcal.simulation import half_wave_plate_cycles, simulate

VAMPIRES = instruments.get("vampires")
META = {"instrument": "SCExAO/VAMPIRES", "source": "polarized internal", "filter": "625-50"}

# rms of the normalized FLC difference of the fits that the authors of pyPolCal published, with
# whichever of their conventions for angles and gains is best on these frames
PUBLISHED = {
    "625-50": 0.0450,
    "725-50": 0.0219,
    "775-50": 0.1175,
    "MBI 610": 0.0205,
    "MBI 670": 0.0123,
    "MBI 760": 0.0194,
}


def differences(meta=META, **columns):
    """A table as VAMPIRES has it: one row a frame."""
    table = QTable(
        {
            "file": ["a", "b", "c", "d"],
            "hwp": [0, 0, 22.5, 22.5] * u.deg,
            "derotator": [45, 45, 45, 45] * u.deg,
            "flc_state": ["A", "B", "B", "A"],
            "single_difference": [-50.0, 30.0, 20.0, 10.0] * u.adu,
            "single_sum": [100.0, 110.0, 90.0, 100.0] * u.adu,
            "single_difference_err": [3.0, 3.0, 3.0, 3.0] * u.adu,
            "single_sum_err": [5.0, 5.0, 5.0, 5.0] * u.adu,
        },
        meta=dict(meta),
    )
    for name, values in columns.items():
        table[name] = values
    return table


def read(table):
    return Observations.from_table(table, name="night")


def run(seed=1, derotator=(45, 70, 95, 120), **options):
    """Simulated frames in both states, at three filters."""
    cycles = half_wave_plate_cycles(derotator=derotator * u.deg)
    frames = QTable({name: np.repeat(cycles[name], 2) for name in cycles.colnames})
    state = np.tile([0.0, 1.0], len(cycles))
    frames["flc_state"] = state
    chain = VAMPIRES.chain(wavelength=[610, 670, 725] * u.nm, derotator="linear", **options)
    meta = META | {"pairing": "flc_state"}
    return chain, simulate(chain, [610, 670, 725] * u.nm, frames, seed=seed, meta=meta)


# --- tables of single differences ----------------------------------------------------------------


def test_beams_are_half_the_sum_and_difference():
    night = read(differences())
    assert night.flux_right[:, 0].tolist() == [25, 70, 55, 55]
    assert night.flux_left[:, 0].tolist() == [75, 40, 35, 45]
    assert night.wavelength == [625] * u.nm
    assert night.frames["frame"].tolist() == [0, 1, 2, 3]
    assert not {"single_difference", "single_sum"} & set(night.frames.colnames)


def test_errors_of_sum_and_difference_are_kept():
    night = read(differences())
    total = night.variance_right + night.variance_left
    np.testing.assert_allclose(total + 2 * night.covariance, 25)
    np.testing.assert_allclose(total - 2 * night.covariance, 9)


def test_written_table_reads_the_same(tmp_path):
    night = read(differences())
    night.write(tmp_path / "night.ecsv")
    again = Observations.read(tmp_path / "night.ecsv")
    assert again.content_hash == night.content_hash
    assert again.pairs().tolist() == night.pairs().tolist() == [[0, 1], [3, 2]]


def test_table_is_not_changed():
    table = differences()
    read(table)
    assert "flux_right" not in table.colnames
    assert "pairing" not in table.meta


def test_tables_with_fluxes_stay_as_they_are():
    table = differences()
    table["flux_right"] = table["flux_left"] = table["single_sum"]
    night = read(table)
    assert {"single_difference", "single_sum"} <= set(night.frames.colnames)
    assert night.pairing == "hwp"


def test_a_difference_beyond_the_sum_is_masked():
    bad = differences(single_difference=[-150.0, 30.0, 20.0, 10.0] * u.adu)
    with pytest.warns(AstropolcalWarning, match="row 1: flux_right = -25"):
        assert read(bad).mask.sum() == 1


def test_wavelength_that_is_not_known():
    for stated, message in [
        (
            {"filter": "626-50"},
            r"night: SCExAO/VAMPIRES: no wavelength is known of filter '626-50'",
        ),
        ({"filter": "J", "instrument": "GPI"}, "known are none; give the wavelength"),
        ({"wavelength": "wide"}, "wavelength = 'wide' in the meta; allowed is one length"),
        ({"wavelength": "-1 um"}, "allowed is one length"),
        ({"wavelength": "1 s"}, "allowed is one length"),
        ({"filter": None}, "missing column wavelength"),
    ]:
        with pytest.raises(ObservationError, match=message):
            read(differences(META | stated))


def test_wavelength_of_filters():
    assert filter_wavelength("VAMPIRES", "mbi-610") == filter_wavelength("vampires", "F610")
    assert stated_wavelength({"wavelength": 0.7 * u.um, "filter": "x"}, "night") == 0.7 * u.um
    assert stated_wavelength({}, "night") is None
    assert np.all(np.diff(VAMPIRES.wavelength) > 0)


# --- states and pairs --------------------------------------------------------------------------


def test_difference_of_the_states_is_what_is_fitted():
    night = read(differences())
    measured = Measurement(VAMPIRES.chains_for([night]), [night]).observed
    np.testing.assert_allclose(measured, [(-50 - 30) / 210, (10 - 20) / 190])


def test_pairs_by_the_plate_on_request():
    angles = [0, 0, 45, 45] * u.deg
    assert read(differences(hwp=angles)).pairs().tolist() == [[0, 1], [3, 2]]
    assert read(differences(META | {"pairing": "hwp"}, hwp=angles)).pairs().tolist() == [
        [0, 3],
        [1, 2],
    ]
    with pytest.raises(ObservationError, match="pairing of the meta = 'time'; allowed are hwp"):
        read(differences(META | {"pairing": "time"})).pairs()


def test_state_of_every_frame():
    assert read(differences()).position("flc_state").tolist() == [0, 1, 1, 0]
    assert read(differences(flc_state=[0, 1, 1, 0])).position("flc_state").tolist() == [0, 1, 1, 0]
    with pytest.raises(ObservationError, match="flc_state = 'C' in frame 1; allowed are A and B"):
        read(differences(flc_state=["A", "C", "B", "A"])).position("flc_state")
    table = differences()
    del table["flc_state"]
    with pytest.raises(ObservationError, match="no column flc_state"):
        read(table).position("flc_state")


def test_a_state_that_is_missing():
    message = r"night, row 4: flc_state A at hwp = 22.5 deg and derotator = 60 deg has no partner"
    with pytest.raises(ObservationError, match=r"row 3: flc_state B at hwp = 22\.5"):
        read(differences(derotator=[45, 45, 45, 60] * u.deg)).pairs()
    with pytest.raises(ObservationError, match=message):
        read(differences(hwp=[0, 0, 0, 22.5] * u.deg, derotator=[45, 45, 45, 60] * u.deg)).pairs()


def test_one_frame_too_many():
    with pytest.warns(AstropolcalWarning, match="night: 1 of 3 frames left out"):
        pairs = pair_states([0, 1, 1], [0, 0, 0] * u.deg, [0, 0, 0] * u.deg, name="night")
    assert pairs.tolist() == [[0, 1]]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        shared = pair_states([0, 1, 1], [0, 0, 0] * u.deg, [0, 0, 0] * u.deg, share=True)
    assert shared.tolist() == [[0, 1], [0, 2]]


@given(order=st.permutations(range(8)))
def test_pairs_do_not_depend_on_the_order(order):
    hwp, state = np.repeat([0, 22.5, 45, 67.5], 2)[list(order)], np.tile([0, 1], 4)[list(order)]
    pairs = pair_states(state, hwp * u.deg, np.full(8, 180.1) * u.deg)
    assert len(pairs) == 4
    assert np.all(state[pairs] == [0, 1])
    assert np.all(hwp[pairs[:, 0]] == hwp[pairs[:, 1]])


# --- the instrument ----------------------------------------------------------------------------


def test_source_and_modulator_of_a_table():
    assert VAMPIRES.setup(read(differences())) == ("polarized", ("flc",))
    assert VAMPIRES.setup(read(differences(META | {"flc": "out"}))) == ("polarized", ())
    with pytest.raises(InstrumentError, match="flc = 'maybe'; allowed are in, out"):
        VAMPIRES.setup(read(differences(META | {"flc": "maybe"})))
    with pytest.raises(InstrumentError, match="source of the table's meta = 'moon'; allowed"):
        VAMPIRES.setup(read(differences(META | {"source": "moon"})))


def test_unknown_choice():
    for wrong in [
        {"derotator": "fibre"},
        {"bounds": "paper"},
        {"source": "moon"},
        {"optics_in": "x"},
    ]:
        with pytest.raises(
            InstrumentError, match=f"vampires: {next(iter(wrong))} = '.*'; allowed are"
        ):
            VAMPIRES.chain(**wrong)


def test_ideal_liquid_crystal_exchanges_the_cameras():
    chain = VAMPIRES.chain(wavelength=[610, 670] * u.nm)
    chain["flc"].switching_angle = 45 * u.deg
    cycles = half_wave_plate_cycles()
    frames = QTable({name: np.repeat(cycles[name], 2) for name in cycles.colnames})
    frames["flc_state"] = np.tile([0.0, 1.0], len(cycles))
    night = simulate(chain, [610, 670] * u.nm, frames, noise=False)
    np.testing.assert_allclose(night.flux_right[::2], night.flux_left[1::2], rtol=1e-9)
    assert np.ptp(night.flux_right[::2]) > 0.3 * night.flux_right.max()


def test_source_without_polarizer_starts_at_the_fold_mirror():
    chain = VAMPIRES.chain("unpolarized")
    assert chain.submodel_names[0] == "fold_mirror"
    gold = VAMPIRES.published_mirrors()["fold_mirror"]["gold at 45°"]
    found = gold.diattenuation([610, 670, 725, 775] * u.nm)
    # as the paper has it, gold polarizes less towards the red
    assert np.all(np.diff(found) < 0)
    assert np.all((found > 0.01) & (found < 0.04))


def test_lamp_need_not_be_steady_where_states_alternate():
    _, night = run()
    assert VAMPIRES.prepare(night).mask.sum() == 0


@pytest.mark.long
def test_calibration_recovers_the_retardances():
    chain, night = run()
    start = VAMPIRES.chains_for([night], derotator="linear")[0]
    start["hwp"].retardance = np.full(3, -150) * u.deg
    start["derotator"].retardance = [260, 260, 220] * u.deg
    found = calibrate(start, night, cross_validate=False)
    for name in ("hwp", "derotator"):
        np.testing.assert_allclose(
            found.chain[name].retardance.value, chain[name].retardance.value, atol=0.5
        )
    assert np.sqrt(np.mean(found.residuals**2)) < 2e-3


# a run that used to end with residuals three times as large
MIRRORED = {
    "calibration_polarizer.theta": 85.0,
    "hwp.theta": 0.1,
    "hwp.retardance": [-151.5, -158.7, -165.9, -175.1],
    "derotator.theta": 0.3,
    "derotator.horizontal": [273.33, 247.63, 200.58, 156.15],
    "derotator.diagonal": [-14.28, 3.45, -10.52, -3.23],
    "derotator.circular": [-0.31, -14.18, -4.41, 12.9],
    "relay.diattenuation": [-0.07, -0.04, -0.08, 0.01],
    "relay.retardance": [60.1, 20.6, 21.5, -12.1],
    "flc.theta": 1.7,
    "flc.retardance": [202.9, 162.6, 193.5, 181.4],
    "flc.switching_angle": 43.9,
    "wollaston.efficiency": [0.94, 0.97, 0.92, 1.0],
    "cameras.imbalance": [-0.07, 0.2, 0.0, 0.01],
}


# and one whose mirror is found only after other wavelengths have changed their signs
MIRRORED_TWICE = {
    "calibration_polarizer.theta": 91.4,
    "hwp.theta": -1.0,
    "hwp.retardance": [-169.7, -166.4, -165.5, -172.3],
    "derotator.theta": -1.6,
    "derotator.horizontal": [286.1, 255.2, 198.9, 210.9],
    "derotator.diagonal": [-8.8, 3.7, 27.4, -1.1],
    "derotator.circular": [1.1, -5.1, 3.3, -21.3],
    "relay.diattenuation": [-0.03, 0.08, 0.01, -0.01],
    "relay.retardance": [16.8, 18.7, 6.8, 26.0],
    "flc.theta": -3.3,
    "flc.retardance": [188.9, 169.9, 191.8, 179.7],
    "flc.switching_angle": 41.0,
    "wollaston.efficiency": [0.95, 0.92, 0.98, 0.95],
    "cameras.imbalance": [0.09, -0.11, 0.16, -0.03],
}


# one whose switching angle is far from the usual, and where its fit used to end: the third
# wavelength has the wrong signs, and the switching angle is near the usual
FAR_SWITCHING = {
    "calibration_polarizer.theta": 89.3,
    "hwp.theta": -0.2,
    "hwp.retardance": [-158.7, -169.1, -171.0, -179.1],
    "derotator.theta": 0.6,
    "derotator.horizontal": [280.6, 244.9, 206.5, 189.2],
    "derotator.diagonal": [0.0, -3.4, -20.3, 6.1],
    "derotator.circular": [13.5, -22.0, -3.6, -2.0],
    "relay.diattenuation": [-0.009, -0.044, 0.011, -0.043],
    "relay.retardance": [4.8, -41.3, 26.5, 10.6],
    "flc.theta": 2.8,
    "flc.retardance": [175.2, 157.8, 163.7, 186.2],
    "flc.switching_angle": 46.7,
    "wollaston.efficiency": [0.963, 0.983, 0.92, 0.94],
    "cameras.imbalance": [0.085, 0.023, 0.008, 0.066],
}
WRONG_SIGNS = {
    "calibration_polarizer.theta": 90.5,
    "hwp.theta": 0.9,
    "hwp.retardance": [-160.1, -166.1, -168.6, -177.8],
    "derotator.theta": 0.0,
    "derotator.horizontal": [280.2, 244.7, 199.9, 188.3],
    "derotator.diagonal": [11.8, 15.8, -49.9, 14.9],
    "derotator.circular": [12.9, -23.5, -16.1, -3.8],
    "relay.diattenuation": [-0.041, 0.041, 0.004, 0.168],
    "relay.retardance": [176.0, 133.5, -17.2, -158.4],
    "flc.theta": -3.1,
    "flc.retardance": [186.9, 207.7, 161.5, 170.7],
    "flc.switching_angle": 43.7,
    "wollaston.efficiency": [0.963, 0.981, 0.923, 0.94],
    "cameras.imbalance": [0.052, 0.116, 0.125, -0.035],
}


def with_values(values):
    """The chain with values of its free parameters."""
    chain = VAMPIRES.chain()
    for name, value in values.items():
        optic, key = name.split(".")
        getattr(chain[optic], key).value = value
    return chain


def run_of_plate(values, seed):
    """A simulated run that is fitted in pairs of angles of the plate in the same state."""
    frames = both_states(half_wave_plate_cycles(derotator=np.arange(45, 140, 12.5) * u.deg))
    settings = {"flux": 2.5e5, "meta": VAMPIRES.published_meta() | {"pairing": "hwp"}}
    return simulate(with_values(values), VAMPIRES.wavelength, frames, seed=seed, **settings)


def test_a_wrong_minimum_stands_out():
    night = run_of_plate(FAR_SWITCHING, 2)
    for values, expected in ((FAR_SWITCHING, False), (WRONG_SIGNS, True)):
        # the null channel that wrong signs predict is wrong, too, and no measure of the noise
        assert stands_out(Measurement(with_values(values), night)) is expected


def few_frames(seed, **values):
    """Where a fit of two fields starts, the truth, and three cycles of it."""
    chain = VAMPIRES.chain(wavelength=VAMPIRES.wavelength[[0, 3]], derotator="linear")
    truth = chain.copy()
    for name, value in values.items():
        optic, key = name.split("__")
        getattr(truth[optic], key).value = value
    cycles = both_states(half_wave_plate_cycles(derotator=[45, 70, 95] * u.deg))
    settings = {"flux": 1e6, "seed": seed, "meta": VAMPIRES.published_meta()}
    return chain, truth, simulate(truth, VAMPIRES.wavelength[[0, 3]], cycles, **settings)


@pytest.mark.slow
def test_a_fit_behind_a_mirror_creeps_to_its_minimum():
    chain, truth, night = few_frames(
        26,
        calibration_polarizer__theta=89.037,
        hwp__theta=-1.509,
        hwp__retardance=[-151.749, -167.082],
        derotator__theta=0.577,
        derotator__retardance=[276.34, 178.646],
        relay__diattenuation=[0.07, 0.002],
        relay__retardance=[9.708, 16.23],
        flc__theta=0.749,
        flc__retardance=[174.985, 163.334],
        flc__switching_angle=40.829,
        wollaston__efficiency=[0.909, 0.953],
        cameras__imbalance=[-0.052, 0.021],
    )
    at_truth = fitted(Measurement(truth, night), search=False).measurement
    found = fitted(Measurement(chain, night)).measurement
    squares = [
        np.sum((one.residuals() / 1e-3) ** 2) + np.sum(one.free.prior_residuals(one.vector()) ** 2)
        for one in (found, at_truth)
    ]
    assert squares[0] < squares[1] + 0.5, squares


@pytest.mark.slow
def test_another_minimum_that_the_data_do_not_exclude_is_named():
    """Its axis is eleven standard errors from the truth, of which only priors know."""
    chain, _, night = few_frames(
        14,
        calibration_polarizer__theta=90.348,
        hwp__theta=-0.49,
        hwp__retardance=[-169.7, -173.813],
        derotator__theta=-0.787,
        derotator__retardance=[293.641, 199.435],
        relay__diattenuation=[0.054, 0.073],
        relay__retardance=[110.584, 123.088],
        flc__theta=5.479,
        flc__retardance=[176.024, 184.488],
        flc__switching_angle=42.771,
        wollaston__efficiency=[0.907, 0.937],
        cameras__imbalance=[0.085, 0.011],
    )
    found = calibrate(chain, night, cross_validate=False)
    assert any("flc.theta: in another minimum" in one for one in found.identifiability.mirrors)
    assert "another minimum" in found.verdict().words[0]


@pytest.mark.long
def test_no_fit_ends_where_half_a_wave_mirrors_the_liquid_crystal():
    runs = (MIRRORED, 1), (MIRRORED, 2), (MIRRORED_TWICE, 14), (FAR_SWITCHING, 2)
    for values, seed in runs:
        night = run_of_plate(values, seed)
        found = calibrate(VAMPIRES.chain(), night, cross_validate=False)
        assert np.sqrt(np.mean(found.residuals**2)) < 2e-3, seed
        assert abs(found.chain["flc"].theta.value - values["flc.theta"]) < 1, seed


@pytest.mark.long
def test_one_model_for_all_filters_of_the_real_data(shared_data):
    files = sorted((shared_data / "data" / "vampires").glob("*.ecsv"))
    if not files:
        pytest.skip("no real tables of VAMPIRES")
    tables = [VAMPIRES.prepare(Observations.read(file)) for file in files]
    assert all(table.n_frames == 160 and not table.mask.any() for table in tables)
    chains = VAMPIRES.chains_for(tables)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = calibrate(chains, tables, cross_validate=False)
    measurement = Measurement(found.chains, tables)
    residuals = measurement.residuals()
    for table, where in zip(tables, measurement.segments, strict=True):
        rms = np.sqrt(np.mean(residuals[where] ** 2))
        assert rms < PUBLISHED.get(table.meta["filter"], 0.0120), table.meta["filter"]
