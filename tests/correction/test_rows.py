# Licensed under a 3-clause BSD style license - see LICENSE
"""Rows of the measurement matrix: against system matrices, and their derivatives."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable
from astropy.utils.masked import Masked

from astropolcal import calibrate, load, optics
from astropolcal.calibration.system import spread_out
from astropolcal.calibration.uncertainty import derived_mueller
from astropolcal.chain import leaves, system_mueller, with_beam
from astropolcal.correction import measurement_rows
from astropolcal.correction.rows import RowModel, sky_chain
from astropolcal.exceptions import (
    AstropolcalWarning,
    ChainError,
    ObservationError,
    ParameterError,
    WavelengthRangeError,
)
from astropolcal.simulation import half_wave_plate_cycles, simulate


def test_rows_are_the_first_rows_of_the_system_matrices(sky, charis, track):
    _, positions = track()
    rows = measurement_rows(sky, positions, charis.wavelength)
    for beam, name in enumerate(("right", "left")):
        matrix = system_mueller(with_beam(sky, name), charis.wavelength, positions)
        np.testing.assert_allclose(rows[beam], np.moveaxis(matrix[..., 0, :], 0, 1), atol=1e-14)


def test_rows_of_a_calibration_are_those_of_its_chain_on_sky(calibration, charis, track):
    _, positions = track()
    rows = measurement_rows(calibration, positions, charis.wavelength)
    on_sky = charis.on_sky(calibration.chain)
    np.testing.assert_array_equal(rows, measurement_rows(on_sky, positions, charis.wavelength))
    assert next(leaf.name for leaf in sky_chain(calibration)) == "parallactic"


def test_some_of_the_calibrated_wavelengths_in_any_order(calibration, charis, track):
    _, positions = track()
    every = measurement_rows(calibration, positions, charis.wavelength)
    some = measurement_rows(calibration, positions, charis.wavelength[[7, 3]].to(u.um))
    np.testing.assert_allclose(some, every[:, [7, 3]], atol=1e-12)


def test_derivatives_are_central_differences(calibration, track):
    _, positions = track(1)
    wavelength = calibration.wavelength[[4, 11]]
    model = RowModel(calibration, positions, wavelength)
    found = {k: np.moveaxis(v, 1, 0) for k, v in model.derivatives().items()}
    shape = next(iter(found.values())).shape
    found = spread_out(model.free, found, shape, model._mix)
    start, factors = model.free.start(), model.free.factors()
    names = model.free.names
    for name in ("hwp.w_sio2", "hwp.theta", "derotator.theta", "derotator.retardance[11]"):
        i = names.index(name)
        step = np.zeros(start.size)
        step[i] = h = 1e-6 * max(1.0, abs(start[i]) / 10)
        numeric = (model.rows(start + step) - model.rows(start - step)) / (2 * h) * factors[i]
        np.testing.assert_allclose(np.moveaxis(found[..., i], 0, 1), numeric, rtol=1e-6, atol=1e-7)
    other = names.index("derotator.retardance[3]")
    assert not found[..., other].any()


def test_what_is_not_on_sky_has_no_influence(calibration, track):
    _, positions = track(1)
    model = RowModel(calibration, positions, calibration.wavelength)
    assert not any(name.startswith("calibration_polarizer") for name in model.derivatives())
    assert any(name.startswith("m3.") for name in model.held)


def test_a_wavelength_that_is_not_calibrated_is_refused(calibration, track):
    _, positions = track(1)
    with pytest.raises(WavelengthRangeError, match=r"1500\.00 nm is none of the 22"):
        measurement_rows(calibration, positions, [1.5] * u.um)
    with pytest.raises(WavelengthRangeError, match="outside the calibrated range"):
        measurement_rows(calibration, positions, [2.5] * u.um, interpolate=True)
    # of laws alone, too, which are trusted between the calibrated wavelengths only
    chain = optics.LinearPolarizer(name="polarizer")
    chain = chain | optics.TwoLayerWaveplate(mount="hwp", name="hwp", fixed={"theta": False})
    chain = chain | optics.WollastonPrism(name="wollaston", efficiency=0.9)
    lam = [1.2, 1.6, 2.0] * u.um
    data = simulate(chain, lam, half_wave_plate_cycles(), seed=1)
    laws = calibrate(chain, data, cross_validate=False)
    at = {"hwp": [0, 22.5] * u.deg}
    for call in (
        lambda lam: measurement_rows(laws, at, lam),
        lambda lam: derived_mueller(laws, at, lam),
        lambda lam: load(laws).system_mueller(positions=at, wavelength=lam, light="internal"),
    ):
        call([1.4] * u.um)
        with pytest.raises(WavelengthRangeError, match="outside the calibrated range"):
            call([1.4, 2.1] * u.um)


def test_interpolation_names_the_parameters(calibration, track):
    _, positions = track(1)
    grid = calibration.wavelength
    between = 0.5 * (grid[7] + grid[8])
    with pytest.warns(AstropolcalWarning, match=r"derotator\.retardance, wollaston\.efficiency"):
        rows = measurement_rows(
            calibration, positions, [between.value] * grid.unit, interpolate=True
        )
    chain = charis_at(calibration, 7, 8)
    expected = measurement_rows(chain, positions, [between.value] * grid.unit)
    np.testing.assert_allclose(rows, expected, atol=1e-9)


def charis_at(calibration, i, j):
    """The chain with the means of two wavelengths in place of values per wavelength."""
    chain = sky_chain(calibration)
    from astropolcal.chain import join, leaves

    found = []
    for leaf in leaves(chain):
        values = {
            key: np.mean(getattr(leaf, key).quantity[[i, j]])
            if getattr(leaf, key).unit
            else np.mean(getattr(leaf, key).value[[i, j]])
            for key in leaf.param_names
            if np.size(getattr(leaf, key).value) > 1
        }
        found.append(leaf.with_parameters(**values) if values else leaf)
    return join(found)


def test_nodes_of_an_exposure_are_averaged(sky, charis):
    points, weights = np.polynomial.legendre.leggauss(3)
    hwp = np.deg2rad(10 + 4 * points)[:, None] * np.ones(2)
    still = {"derotator": [1.0, 1.0], "parallactic": [0.2, 0.2], "altitude": [1.1, 1.1]}
    rows = measurement_rows(sky, {"hwp": hwp, **still}, charis.wavelength)
    each = [measurement_rows(sky, {"hwp": row, **still}, charis.wavelength) for row in hwp]
    mean = sum(w / 2 * one for w, one in zip(weights, each, strict=True))
    np.testing.assert_allclose(rows, mean, atol=1e-14)


def test_a_missing_position_is_named(sky, charis):
    with pytest.raises(ChainError, match=r"no position of 'parallactic'.* there is hwp"):
        measurement_rows(sky, {"hwp": [0] * u.deg}, charis.wavelength)


def test_a_position_that_is_not_finite_is_refused(sky, charis, track):
    for bad in [np.nan, np.inf]:
        _, positions = track(1)
        positions["altitude"] = [70, bad, 70, 70] * u.deg
        with pytest.raises(ParameterError, match="altitude"):
            measurement_rows(sky, positions, charis.wavelength)


def test_degrees_without_a_unit_and_masked_positions_are_refused(sky, charis, track):
    _, positions = track(1)
    plain = np.deg2rad(positions["altitude"].value)
    for bad in (positions["altitude"].value, np.ma.array(plain, mask=[0, 1, 0, 0])):
        with pytest.raises(ParameterError, match="altitude"):
            measurement_rows(sky, positions | {"altitude": bad}, charis.wavelength)
    bad = Masked(positions["altitude"], mask=[0, 1, 0, 0])
    with pytest.raises(ParameterError, match="altitude"):
        measurement_rows(sky, positions | {"altitude": bad}, charis.wavelength)


def test_a_chain_without_stages_has_no_sky():
    with pytest.raises(ChainError, match="no optic on a stage"):
        sky_chain(optics.LinearPolarizer() | optics.WollastonPrism())


# ---- which chain -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def two_beams(charis):
    """Of the internal source with and without the beam switcher."""
    frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    chains, tables = [], []
    for seed, (optics_in, word) in enumerate([((), "not installed"), (("nbs",), "installed")]):
        chains.append(charis.chain("polarized", optics_in, derotator="linear"))
        meta = charis.published_meta() | {"nasmyth_beam_switcher": word, "yjh50_dichroic": "out"}
        tables.append(
            simulate(chains[-1], charis.wavelength, frames, seed=seed, meta=meta, name=word)
        )
    return calibrate(chains, tables, instrument="charis", cross_validate=False)


def test_chain_of_the_optics_in_the_beam(two_beams):
    with pytest.raises(ChainError, match="optics_in tells its chains apart: none or nbs"):
        sky_chain(two_beams)
    for optics_in, told in (([], {"nbs": False}), (["nbs"], {"nbs": True})):
        for chain in (
            sky_chain(two_beams, optics_in=optics_in),
            sky_chain(two_beams, beam=told),
        ):
            names = [leaf.name for leaf in leaves(chain)]
            assert names[:2] == ["parallactic", "m3"]
            assert ("nbs" in names) == told["nbs"]
    with pytest.raises(ChainError, match=r"a\.asdf: no chain with dichroic; it holds for"):
        sky_chain(two_beams, optics_in=["dichroic"], label="a.asdf")
    with pytest.raises(ChainError, match="no chain with dichroic, without nbs"):
        sky_chain(two_beams, beam={"dichroic": True, "nbs": False})


@pytest.mark.slow
def test_optics_of_one_dataset_are_no_part_of_the_chain(charis):
    """Gains of the beams that a fit has beside the instrument do not come on sky."""
    frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    meta = charis.published_meta() | {"yjh50_dichroic": "out"}
    tables = [
        simulate(
            charis.chain("polarized", ["nbs"]), charis.wavelength, frames, seed=s, meta=meta, name=n
        )
        for s, n in enumerate("ab")
    ]
    chains = charis.chains_for(tables, nuisance=["beam_gain"])
    cal = calibrate(
        chains,
        tables,
        instrument="charis",
        cross_validate=False,
        observable="normalized_single_difference",
    )
    assert not any(leaf.name.startswith("beam_gain") for leaf in leaves(sky_chain(cal)))


@pytest.mark.filterwarnings("ignore:.*m3 not calibrated")
def test_no_star_is_below_the_horizon_or_beyond_the_zenith(calibration, sky, charis, track):
    _, positions = track(1)
    uses = (
        lambda at: measurement_rows(sky, at, charis.wavelength),
        lambda at: load(calibration).system_mueller(positions=at),
        lambda at: simulate(sky, charis.wavelength, QTable(at)),
    )
    for use in uses:
        for altitude in (-70, 0, 100):
            at = positions | {"altitude": [70, altitude, 70, 70] * u.deg}
            with pytest.raises(ObservationError, match="allowed is above 0 to 90 deg"):
                use(at)
