# Licensed under a 3-clause BSD style license - see LICENSE
"""Instruments from public papers: what their chains measure of a star, and what calibrates them."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal import calibrate, instruments
from astropolcal.chain import remove_optic
from astropolcal.correction import measurement_rows
from astropolcal.exceptions import InstrumentError, ObservationError
from astropolcal.pipeline.headers import FrameAngles
from astropolcal.simulation import simulate


def differences(chain, positions, wavelength, stokes):
    """Return the normalized single differences of frames of a star, right minus left."""
    right, left = measurement_rows(chain, positions, wavelength) @ stokes
    return (right - left) / (right + left)


def on_sky(name):
    """Return an instrument, its chain from the sky, and its first wavelength."""
    instrument = instruments.get(name)
    grid = instrument.wavelength[:1]
    options = {key: grid for key in instrument.sky_options}
    return instrument, instrument.on_sky(instrument.chain(wavelength=grid), **options), grid


# --- FORS2


def test_fors2_measures_angles_from_its_position_angle():
    _, chain, grid = on_sky("fors2")
    # angles of polarization are too large by 1.54 deg in b_HIGH
    assert chain["hwp"].theta.value == pytest.approx(-1.54 / 2)
    chain["hwp"].retardance, chain["hwp"].theta = [180] * u.deg, [0] * u.deg
    aolp, pa = 50 * u.deg, 20 * u.deg
    stokes = [1, *(0.1 * f((2 * aolp).to_value(u.rad)) for f in (np.cos, np.sin)), 0]
    for plate in (0, 11, 45, 77.5) * u.deg:
        positions = {"hwp": [plate.value] * u.deg, "parallactic": [pa.value] * u.deg}
        expected = 0.1 * np.cos(4 * plate - 2 * (aolp - pa)) * 0.99
        seen = differences(chain, positions, grid, stokes)
        np.testing.assert_allclose(np.ravel(seen), expected, atol=1e-12)


def test_fors2_is_calibrated_at_arbitrary_angles_of_the_plate():
    fors2 = instruments.get("fors2")
    truth = fors2.chain("polarized")
    truth["hwp"].theta = [-3, -1, 2, 4] * u.deg
    truth["hwp"].retardance = [172, 178, 177, 174] * u.deg
    frames = QTable({"hwp": np.linspace(3, 177, 30) * u.deg})
    meta = {"instrument": "FORS2", "source": "polarized"}
    seen = simulate(truth, fors2.wavelength, frames, flux=1e8, seed=1, meta=meta)
    (start,) = fors2.chains_for([seen])
    found = calibrate(
        start, seen, observable="normalized_single_difference", cross_validate=False
    ).chains[0]
    for key in ("theta", "retardance"):
        want = getattr(truth["hwp"], key).value
        np.testing.assert_allclose(getattr(found["hwp"], key).value, want, atol=0.1)
    assert found["wollaston"].efficiency.value == pytest.approx(0.99, abs=1e-3)


# --- Roman


def test_roman_measures_q_and_u_one_after_the_other():
    roman = instruments.get("Roman/CGI")
    chain = remove_optic(roman.chain("target"), "star")
    chain["mirrors"].retardance = [0, 0] * u.deg
    positions = {"roll": [0, 0, 30, 30] * u.deg, "prism": [0, 45, 0, 45] * u.deg}
    angle = np.deg2rad(2 * 30)
    turned = [0.1 * np.cos(angle), 0.1 * np.sin(angle)]
    seen = differences(chain, positions, roman.wavelength, [1, 0.1, 0, 0])
    # the angle on the detector is that on the sky plus the roll
    for row in seen:
        np.testing.assert_allclose(row / 0.99, [0.1, 0, *turned], atol=1e-12)


def test_roman_is_calibrated_by_standard_stars_at_three_rolls():
    roman = instruments.get("roman")
    sources = {"unpolarized standard": "", "polarized standard": "HD 7927"}
    seen = []
    for source, target in sources.items():
        truth = roman.chain(source, target=target)
        truth["telescope"].horizontal = [0.012, 0.007]
        truth["telescope"].diagonal = [-0.004, 0.003]
        truth["mirrors"].retardance = [25, 12] * u.deg
        frames = QTable({"roll": np.repeat([-13, 13, 50], 2) * u.deg})
        frames["prism"] = np.tile([0, 45], 3) * u.deg
        meta = {"instrument": "roman", "source": source, "object": target}
        seen.append(simulate(truth, roman.wavelength, frames, flux=1e9, seed=1, meta=meta))
    found = calibrate(roman.chains_for(seen), seen, weights="errors", cross_validate=False)
    for key, want in {"horizontal": [0.012, 0.007], "diagonal": [-0.004, 0.003]}.items():
        value = getattr(found.chains[0]["telescope"], key).value
        np.testing.assert_allclose(value, want, atol=1e-3)
    errors = dict(zip(found.covariance.names, found.covariance.stds, strict=True))
    error = next(std for name, std in errors.items() if name.startswith("mirrors.retardance"))
    assert abs(found.chains[0]["mirrors"].retardance.value[0] - 25) < 4 * error < 20


def test_as_many_data_as_parameters_leave_the_errors_open():
    """Four frames of a target at two rolls, four parameters: only stated errors tell the noise."""
    for weights in [None, "errors"]:
        roman = instruments.get("roman")
        grid, meta = roman.wavelength[:1], {"instrument": "roman", "source": "target"}
        frames = QTable({"roll": [-13, -13, 13, 13] * u.deg, "prism": [0, 45, 0, 45] * u.deg})
        truth = roman.chain(wavelength=grid, source="target")
        truth["telescope"].horizontal = [0.01]
        seen = simulate(truth, grid, frames, flux=1e8, seed=1, meta=meta)
        (chain,) = roman.chains_for([seen])
        for optic, key in (("mirrors", "retardance"), ("wollaston", "efficiency")):
            getattr(chain[optic], key).fixed = True
        chain["wollaston"].theta.fixed = True
        found = calibrate(chain, seen, weights=weights)
        assert float(found.chains[0]["telescope"].horizontal.value) == pytest.approx(
            0.01, abs=2e-3
        ), weights
        assert np.isfinite(found.covariance.stds).all() == (weights == "errors"), weights


# --- NIRC2


def test_nirc2_turns_q_and_u_as_its_pipeline_says():
    """Q and U of ideal optics are turned by -2 PARANG + 2 EL + 2 ROTPDEST + 4 offset."""
    nirc2, chain, grid = on_sky("nirc2")
    for name in ("hwp", "derotator", "m3"):
        chain[name].retardance = [180] * u.deg
    chain["m3"].diattenuation = [0]
    cycle = np.array([0, 45, 22.5, 67.5])
    for parallactic, altitude, obrt, offset in ((0, 1, 0, 0), (13, 40, 25, 3), (-70, 66, 110, -8)):
        positions = {"hwp": cycle - offset} | {
            "parallactic": [parallactic] * 4,
            "altitude": [altitude] * 4,
            "derotator": [obrt] * 4,
        }
        positions = {stage: angles * u.deg for stage, angles in positions.items()}
        for aolp in (0, 30):
            stokes = [1, *(0.1 * f(np.deg2rad(2 * aolp)) for f in (np.cos, np.sin)), 0]
            x = np.ravel(differences(chain, positions, grid, stokes))
            measured = np.angle(complex(x[0] - x[1], x[2] - x[3]))
            turned = -2 * parallactic + 2 * altitude + 4 * obrt + 4 * offset
            expected = np.exp(1j * np.deg2rad(2 * aolp + turned))
            np.testing.assert_allclose(np.exp(1j * measured), expected, atol=1e-9)
    # with the field at rest the sky and the altitude drop out
    f, g = nirc2.sky_law.derotator_law("field")
    assert (4 * f - 2, 4 * g + 2) == (0, 0)


# --- MagAO-X


def test_magaox_sends_vertical_polarization_to_the_right_beam():
    magaox = instruments.get("MagAO-X")
    chain = remove_optic(magaox.chain("polarized"), "polarizer")
    positions = {"hwp": [0, 45] * u.deg, "derotator": [0, 0] * u.deg}
    seen = differences(chain, positions, magaox.wavelength, [1, 1, 0, 0])
    assert seen.shape == (4, 2)
    assert (seen[:, 0] < -0.98).all()
    assert (seen[:, 1] > 0.98).all()


# --- GPI


def test_gpi_measures_the_published_polarization_of_an_unpolarized_star():
    """Wiktorowicz et al. 2014; the plate that is off half a wave adds circular light."""
    gpi = instruments.get("gpi")
    chain = remove_optic(gpi.published(), "star")
    chain["hwp"].retardance = np.full(5, 180) * u.deg
    for plate, expected in (([0, 45], -0.037), ([22.5, 67.5], 0.4338)):
        for parallactic in (0, 30):
            # the plate counts from 29.14 deg
            stood = np.subtract(plate, 29.14) * u.deg
            positions = {"hwp": stood, "parallactic": [parallactic] * 2 * u.deg}
            x = differences(chain, positions, gpi.wavelength, [1, 0, 0, 0])
            seen = 50 * (x[:, 0] - x[:, 1]) / chain["wollaston"].efficiency.value
            np.testing.assert_allclose(seen, expected, atol=1e-4)
    chain["hwp"].retardance = np.full(5, 170) * u.deg
    positions = {"hwp": [0, 45] * u.deg, "parallactic": [0, 0] * u.deg}
    x = differences(chain, positions, gpi.wavelength, [1, 0, 0, 0])
    assert np.all(np.abs(x[:, 0] - x[:, 1]) > 0.01)


# --- NaCo


def test_naco_keeps_the_sky_at_its_position_angle():
    """As long as M3 is ideal the parallactic angle drops out, and the position angle counts."""
    naco, grid = instruments.get("naco"), instruments.get("naco").wavelength
    chain = remove_optic(naco.chain("star"), "star")
    chain["m3"].diattenuation, chain["m3"].retardance = np.zeros(3), np.full(3, 180) * u.deg
    chain["hwp"].retardance = np.full(3, 180) * u.deg
    seen = []
    for parallactic, position_angle, aolp in ((0, 0, 20), (50, 0, 20), (-70, 33, 53)):
        stokes = [1, *(0.1 * f(np.deg2rad(2 * aolp)) for f in (np.cos, np.sin)), 0]
        positions = {"hwp": np.array([0, 22.5])} | {
            "parallactic": [parallactic] * 2,
            "position_angle": [position_angle] * 2,
        }
        positions = {stage: angles * u.deg for stage, angles in positions.items()}
        seen.append(differences(chain, positions, grid, stokes))
    np.testing.assert_allclose(seen[1:], [seen[0]] * 2, atol=1e-12)


# --- behind Subaru's plate and derotator


def test_what_stands_behind_the_same_plate_and_derotator_is_calibrated_with_it():
    """Plate and derotator are those of CHARIS, with the same starts and free parameters."""
    charis = instruments.get("charis")
    for name in ("ircs", "hiciao", "fastpdi", "reach"):
        instrument = instruments.get(name)
        grid = instrument.wavelength
        for source in instrument.sources:
            ours, theirs = (i.chain(source, (), wavelength=grid) for i in (instrument, charis))
            for optic in theirs[:-1]:
                one = ours[optic.name]
                for key in optic.param_names:
                    mine, other = getattr(one, key), getattr(optic, key)
                    np.testing.assert_array_equal(mine.value, other.value)
                    assert (mine.fixed, mine.bounds) == (other.fixed, other.bounds)
            if "star" not in source:
                sky = [leaf.name for leaf in instrument.on_sky(ours)]
                assert sky == [leaf.name for leaf in charis.on_sky(theirs)]


def test_fast_pdi_takes_the_liquid_crystal_from_its_table():
    fast = instruments.get("fastpdi")
    chain = fast.chain("polarized", ["flc"])
    frames = QTable({"hwp": np.repeat([0, 45, 22.5, 67.5], 4) * u.deg})
    frames["derotator"] = np.tile([40, 40, 80, 80], 4) * u.deg
    frames["flc_state"] = np.tile([0, 1], 8)
    meta = {"instrument": "Fast-PDI", "source": "polarized"}
    seen = simulate(chain, fast.wavelength, frames, flux=1e8, seed=1, meta=meta)
    (built,) = fast.chains_for([seen])
    assert [leaf.name for leaf in built] == [leaf.name for leaf in chain]


# --- headers


def test_headers_give_the_angles_of_frames():
    """Without a layout of files the keywords of a frame are enough for its matrix."""
    cases = {
        "roman": ({"ROLL": 13.0, "DPAMNAME": "POL45"}, {"roll": 13, "prism": 45}),
        "fors2": ({"ESO INS RETA2 POSANG": 22.5, "ESO ADA POSANG": 5.0}, {"hwp": 22.5}),
        "magaox": ({"HWPTRACK ACTUAL ANGLE": 9.0, "STAGEK POS": 7.0}, {"hwp": 9, "derotator": 7}),
        "nirc2": ({"PCUPR": 45.0, "OBRT": 3.0}, {"hwp": 45, "derotator": 3}),
        "naco": ({"ESO INS ADC1 ENC": 1024 - 205, "ESO ADA POSANG": 8.0}, {"hwp": 90}),
        "gpi": ({"WPANGLE": 67.5}, {"hwp": 67.5}),
        "ircs": ({"RET-ANG1": 0.0, "RET-POS1": 11.0, "D_IMRANG": 4.0}, {"hwp": 11}),
    }
    pointing = {"PARANG": 30.0, "ESO TEL PARANG START": 30.0, "ESO TEL ALT": 60.0}
    pointing |= {"DATE-OBS": "2023-02-25T01:00:00", "RA": 80.0, "DEC": -30.0}
    pointing |= {"ALTITUDE": 60.0, "EL": 60.0, "UT": "01:00:00"}
    for name, (header, expected) in cases.items():
        instrument = instruments.get(name)
        chain = instrument.chain(instrument.sources[-1])
        found = instrument.positions(FrameAngles([header | pointing], instrument), chain)
        for stage, angle in expected.items():
            assert np.rad2deg(found[stage]) == pytest.approx(angle), (name, stage)
    roman = instruments.get("roman")
    with pytest.raises(ObservationError, match="DPAMNAME = 'POL9', allowed are POL0, POL45"):
        FrameAngles([{"ROLL": 13.0, "DPAMNAME": "POL9"}], roman)


def test_published_values_are_none():
    """Their values are nominal: none may be taken for a published one."""
    for name in ("fors2", "roman", "nirc2", "magaox", "naco", "ircs", "hiciao", "fastpdi", "reach"):
        with pytest.raises(InstrumentError, match="no published values"):
            instruments.get(name).published()
