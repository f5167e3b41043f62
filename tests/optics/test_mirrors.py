# Licensed under a 3-clause BSD style license - see LICENSE
"""Mirrors against thin-film physics and the published numbers of CHARIS."""

from pathlib import Path

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.materials import SILVER, IsotropicMaterial, TabulatedLaw
from astropolcal.optics import (
    DiattenuatorRetarder,
    KMirror,
    LinearRetarder,
    MetalMirror,
    ParityFlip,
    PowerLawMirror,
)

WAVELENGTH = [1.2, 1.6, 2.2] * u.um
REFERENCE = Path(__file__).resolve().parents[3] / "shared" / "reference"
# Table of the M3 fit, paper Sec. 6.2
PUBLISHED_M3 = {"b1": 15.56, "m1": 3.186, "b2": 9.69, "m2": 1.040}
MIRRORS = (MetalMirror, PowerLawMirror, KMirror)


def reference(name):
    path = REFERENCE / name
    if not path.exists():
        pytest.skip(f"the published numbers {name} are not here")
    return QTable.read(path)


# --- sign and orientation -----------------------------------------------------------


def test_a_good_conductor_is_the_ideal_mirror():
    for cls in MIRRORS:
        values = (
            {"b1": 22, "b2": 0, "m1": 0, "m2": 0} if cls is PowerLawMirror else {"k_scale": 1e7}
        )
        values |= {"film_thickness": 0 * u.nm} if cls is KMirror else {}
        matrix = cls(**values).mueller(WAVELENGTH)
        expected = np.broadcast_to(np.diag([1.0, 1, -1, -1]), matrix.shape)
        np.testing.assert_allclose(matrix, expected, atol=1e-6)
        # as the parity flip turned by 45 deg, and as a half-wave retarder
        np.testing.assert_allclose(ParityFlip(theta=45 * u.deg).mueller(), expected[0], atol=1e-15)
        retarder = LinearRetarder(retardance=180 * u.deg).mueller()
        np.testing.assert_allclose(retarder, expected[0], atol=1e-15)


def test_the_field_across_the_plane_of_incidence_is_along_plus_q():
    for cls in MIRRORS:
        bare = {"film_thickness": 0 * u.nm} if cls is KMirror else {}
        mirror = cls(**bare)
        assert np.all(mirror.diattenuation(WAVELENGTH) > 0), cls
        through = mirror.mueller(WAVELENGTH) @ [1, 0, 0, 0]
        np.testing.assert_allclose(through[:, 1], mirror.diattenuation(WAVELENGTH), atol=1e-15)
        turned = cls(**bare, theta=90 * u.deg).mueller(WAVELENGTH) @ [1, 0, 0, 0]
        np.testing.assert_allclose(turned[:, 1], -through[:, 1], atol=1e-15)


def test_it_is_the_diattenuator_retarder_of_its_own_numbers():
    for cls in MIRRORS:
        mirror = cls(theta=20 * u.deg, mount="stage", name="it")
        mirror.theta.fixed = False
        free = mirror.loosened(WAVELENGTH)
        assert isinstance(free, DiattenuatorRetarder), cls
        assert (free.name, free.mount, free.theta.fixed) == ("it", "stage", False), cls
        assert free.retardance.shape == free.diattenuation.shape == (3,), cls
        np.testing.assert_allclose(free.mueller(WAVELENGTH), mirror.mueller(WAVELENGTH), atol=1e-14)
        assert np.all(
            (mirror.retardance(WAVELENGTH) >= 0) & (mirror.retardance(WAVELENGTH).value < 360)
        ), cls


# --- metals -------------------------------------------------------------------------


def test_theory_at_45_degrees():
    # pins the numbers of the documentation, Rakic et al. 1998
    silver, gold = MetalMirror(), MetalMirror(material="gold")
    np.testing.assert_allclose(
        silver.diattenuation(WAVELENGTH), [0.00667, 0.00557, 0.00492], atol=1e-5
    )
    np.testing.assert_allclose(
        gold.diattenuation(WAVELENGTH), [0.00940, 0.00820, 0.00688], atol=1e-5
    )
    np.testing.assert_allclose(
        silver.retardance(WAVELENGTH).value, [190.42, 187.76, 185.63], atol=0.01
    )
    np.testing.assert_allclose(
        gold.retardance(WAVELENGTH).value, [190.62, 187.89, 185.74], atol=0.01
    )


def test_fold_mirror_is_gold_with_one_factor():
    table = reference("charis_fold_mirror.ecsv")
    mirror = MetalMirror(material="gold", n_scale=1.19)
    residual = table["fold_mirror_diattenuation"] - mirror.diattenuation(table["wavelength"])
    # their four fits differ by 7e-4 among each other
    assert np.sqrt(np.mean(residual**2)) < 8e-4
    assert abs(np.median(residual)) < 2e-4


def test_the_default_mirror_is_bare_and_known():
    mirror = MetalMirror()
    assert mirror.film_thickness.value == 0
    assert all(getattr(mirror, key).fixed for key in mirror.param_names)
    np.testing.assert_array_equal(
        mirror.mueller(WAVELENGTH), MetalMirror(film="Al2O3").mueller(WAVELENGTH)
    )


def test_materials_survive_copies():
    mirror = MetalMirror(material="gold", film="Al2O3", film_thickness=50 * u.nm, name="m")
    for copy in (mirror.copy(), mirror.with_parameters(film_thickness=60 * u.nm)):
        assert (copy.material, copy.film) == ("gold", "Al2O3")
    assert "material='gold', film='Al2O3'" in repr(mirror)
    mirror.material = SILVER
    assert mirror.material == "silver"


def test_an_unknown_material_is_refused():
    for cls in [MetalMirror, KMirror]:
        for key in ["material", "film"]:
            law = TabulatedLaw([1.0, 2.5] * u.um, [0.3 + 6j, 1.0 + 16j])
            stranger = IsotropicMaterial("stranger", law, measured_range=[1.0, 2.5] * u.um)
            with pytest.raises(ParameterError, match="did you mean 'silver'"):
                cls(**{key: "silvr"})
            for bad in (stranger, 1.5 + 3j, None, 3):
                with pytest.raises(
                    ParameterError, match=rf"{cls.__name__}.{key} = .*register_material"
                ):
                    cls(**{key: bad})


def test_values_that_make_no_mirror_are_refused():
    for cls in [MetalMirror, KMirror]:
        with pytest.raises(WavelengthRangeError, match="fused silica"):
            cls().mueller(5 * u.um)
    for key in ["film_thickness", "n_scale", "k_scale"]:
        unit = u.nm if key == "film_thickness" else 1
        with pytest.raises(ParameterError, match=f"it.{key} = -.*not negative"):
            MetalMirror(**{key: -0.1 * unit}, name="it").mueller(WAVELENGTH)
    with pytest.raises(ParameterError, match=r"it\.incidence = 40 deg; allowed are 45 deg"):
        KMirror(incidence=40 * u.deg, name="it").mueller(WAVELENGTH)


def test_an_impossible_incidence_is_refused():
    for cls in MIRRORS:
        for degrees in [-90, 90, 120]:
            mirror = cls(incidence=[50, degrees, 50] * u.deg, name="it")
            for use in (mirror.mueller, mirror.mueller_derivatives, mirror.diattenuation):
                with pytest.raises(
                    ParameterError, match=rf"it\.incidence = {degrees} deg; allowed"
                ):
                    use(WAVELENGTH)


# --- the law of the paper -------------------------------------------------------------


def test_published_m3():
    m3 = PowerLawMirror(**PUBLISHED_M3)
    wavelength = np.linspace(1.16, 2.37, 22) * u.um
    diattenuation = m3.diattenuation(wavelength)
    assert np.all(np.diff(diattenuation) < 0)
    # 1.7 to 1.2 % over J to K
    assert diattenuation[0] == pytest.approx(0.0174, abs=2e-4)
    assert diattenuation[-1] == pytest.approx(0.0120, abs=2e-4)


def test_published_m3_is_no_metal():
    # n = k = 41 and more, where silver has 0.3 + 7.7i: the law went off to where only the
    # absorption counts, and its retardance is 9 deg from that of silver
    published = PowerLawMirror(**PUBLISHED_M3)
    index = published.index(WAVELENGTH)
    np.testing.assert_allclose(index.real, index.imag, rtol=1e-5)
    assert np.all(index.real > 40)
    difference = MetalMirror().retardance(WAVELENGTH) - published.retardance(WAVELENGTH)
    assert np.all(difference > 4 * u.deg)


def test_power_law_in_metres():
    index = PowerLawMirror(b1=14, m1=2, b2=12, m2=2).index(1 * u.um)
    assert index**2 == pytest.approx(-100 + 1j)


def test_four_numbers_are_nearly_two():
    # what unpolarized light sees of M3: its diattenuation at all wavelengths
    m3 = PowerLawMirror()
    wavelength = np.linspace(1.16, 2.37, 22) * u.um
    slopes = m3.mueller_derivatives(wavelength)
    jacobian = np.stack([slopes[key].value[:, 0, 1] for key in ("b1", "m1", "b2", "m2")], axis=-1)
    jacobian /= np.linalg.norm(jacobian, axis=0)
    singular = np.linalg.svd(jacobian, compute_uv=False)
    assert singular[2] / singular[0] < 2e-2
    assert singular[3] / singular[0] < 1e-3


# --- the K-mirror -----------------------------------------------------------------------


def test_k_mirror_of_subaru_by_its_film_alone():
    # 't Hart et al. 2021 fit 262.56 nm of silica on silver; per-wavelength values of 2026
    # are stored with the opposite sign of V
    table = reference("charis_published_fits.ecsv")
    derotator = KMirror(film_thickness=262.56 * u.nm)
    theory = 360 - derotator.retardance(table["wavelength"]).value
    difference = table["final_derotator_horizontal"].value - theory
    assert np.abs(difference).max() < 24
    assert np.median(np.abs(difference)) < 4
    # from 1.4 um on, where the published values are smooth
    assert np.abs(difference[table["wavelength"] > 1400 * u.nm]).max() < 7
