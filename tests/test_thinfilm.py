# Licensed under a 3-clause BSD style license - see LICENSE
"""Reflection against closed forms, conservation laws and the package tmm."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from astropolcal import mueller
from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.materials import FUSED_SILICA, GOLD, get_material
from astropolcal.thinfilm import Reflection, reflect

REAL = st.floats(1.05, 4.0)
DEGREES = st.floats(0.0, 88.0)
MICRON = st.floats(0.02, 0.8)
METAL = st.tuples(st.floats(0.05, 4), st.floats(1, 20)).map(lambda nk: complex(*nk))
LIGHT = 1.6 * u.um


@st.composite
def stacks(draw, indices=REAL | METAL, substrate=REAL | METAL):
    """Incidence, films and substrate."""
    films = draw(st.lists(st.tuples(indices, MICRON), max_size=4))
    return draw(DEGREES) * u.deg, [(n, d * u.um) for n, d in films], draw(substrate)


def fresnel(index, incidence, ambient=1.0):
    bare = reflect(LIGHT, incidence, index, ambient=ambient)
    return bare.r_s, bare.r_p


# --- closed forms -----------------------------------------------------------------


@given(index=REAL | METAL, degrees=DEGREES)
def test_fresnel_by_snell(index, degrees):
    # the other textbook form, with the complex angle of refraction
    angle = np.deg2rad(degrees)
    inside = np.sqrt(1 - (np.sin(angle) / index) ** 2 + 0j)
    cosine = np.cos(angle)
    r_s, r_p = fresnel(index, degrees * u.deg)
    assert r_s == pytest.approx((cosine - index * inside) / (cosine + index * inside), abs=1e-13)
    assert r_p == pytest.approx((index * cosine - inside) / (index * cosine + inside), abs=1e-13)


@given(n=st.floats(1.2, 2.5), substrate=REAL)
def test_quarter_wave_film(n, substrate):
    film = reflect(LIGHT, 0 * u.deg, substrate, [(n, LIGHT / (4 * n))])
    expected = ((n**2 - substrate) / (n**2 + substrate)) ** 2
    assert film.reflectance == pytest.approx(expected, abs=1e-14)


@given(n=st.floats(1.2, 2.5), substrate=METAL, degrees=DEGREES)
def test_half_wave_film_is_absent(n, substrate, degrees):
    inside = np.sqrt(n**2 - np.sin(np.deg2rad(degrees)) ** 2)
    bare = reflect(LIGHT, degrees * u.deg, substrate)
    film = reflect(LIGHT, degrees * u.deg, substrate, [(n, LIGHT / (2 * inside))])
    assert film.r_s == pytest.approx(bare.r_s, abs=1e-12)
    assert film.r_p == pytest.approx(bare.r_p, abs=1e-12)


@given(setup=stacks())
def test_a_film_without_thickness_or_contrast_is_absent(setup):
    incidence, films, substrate = setup
    plain = reflect(LIGHT, incidence, substrate, films)
    for extra in ((2.0, 0 * u.nm), (substrate, 300 * u.nm)):
        more = reflect(LIGHT, incidence, substrate, [*films, extra])
        assert more.r_s == pytest.approx(plain.r_s, abs=1e-11)
        assert more.r_p == pytest.approx(plain.r_p, abs=1e-11)


@given(setup=stacks(), cut=st.floats(0, 1))
def test_a_film_in_two_parts_is_one(setup, cut):
    incidence, films, substrate = setup
    whole = reflect(LIGHT, incidence, substrate, [*films, (1.7, 400 * u.nm)])
    parts = [(1.7, cut * 400 * u.nm), (1.7, (1 - cut) * 400 * u.nm)]
    cut_ = reflect(LIGHT, incidence, substrate, [*films, *parts])
    assert cut_.r_s == pytest.approx(whole.r_s, abs=1e-11)
    assert cut_.r_p == pytest.approx(whole.r_p, abs=1e-11)


def test_a_thick_absorber_hides_what_is_behind():
    gold = GOLD.index(LIGHT).value
    bare = reflect(LIGHT, 45 * u.deg, gold)
    for thickness in (1 * u.um, 1 * u.mm, 1 * u.m):
        thick = reflect(LIGHT, 45 * u.deg, 1.5, [(gold, thickness)])
        assert thick.r_p == pytest.approx(bare.r_p, abs=1e-14)
        assert thick.transmittance_s < 1e-30


def test_metals_retard_more_than_half_a_wave_in_this_convention():
    # r_p leads: e^{-i omega t}, n + ik; grows from 180 deg at normal incidence to 360 deg
    angles = [0.1, 20, 45, 70, 89] * u.deg
    found = reflect(LIGHT, angles, "gold").retardance
    assert np.all(np.diff(found) > 0)
    assert found[0].value == pytest.approx(180, abs=0.01)
    assert 180 * u.deg < found[2] < 200 * u.deg


# --- laws -------------------------------------------------------------------------


@given(setup=stacks(REAL, REAL), ambient=st.floats(1.0, 2.0))
def test_power_is_conserved_without_absorption(setup, ambient):
    incidence, films, substrate = setup
    found = reflect(LIGHT, incidence, substrate, films, ambient=ambient)
    assert found.reflectance_s + found.transmittance_s == pytest.approx(1, abs=1e-9)
    assert found.reflectance_p + found.transmittance_p == pytest.approx(1, abs=1e-9)


@given(setup=stacks())
def test_nothing_gains(setup):
    incidence, films, substrate = setup
    found = reflect(LIGHT, incidence, substrate, films)
    assert 0 <= found.reflectance_s + found.transmittance_s <= 1 + 1e-9
    assert 0 <= found.reflectance_p + found.transmittance_p <= 1 + 1e-9


@given(setup=stacks(), factor=st.floats(0.2, 5))
def test_only_thickness_over_wavelength_counts(setup, factor):
    incidence, films, substrate = setup
    here = reflect(LIGHT, incidence, substrate, films)
    there = reflect(LIGHT * factor, incidence, substrate, [(n, d * factor) for n, d in films])
    assert there.r_p == pytest.approx(here.r_p, abs=1e-12)


@given(setup=stacks(METAL | REAL, METAL))
def test_mueller_matrix_is_physical_and_has_the_numbers(setup):
    incidence, films, substrate = setup
    found = reflect(LIGHT, incidence, substrate, films)
    matrix = found.mueller()
    assert mueller.is_physical(matrix)
    assert matrix[0, 1] == pytest.approx(found.diattenuation)
    cross = 2 * found.r_p * np.conj(found.r_s) / (2 * found.reflectance)
    assert matrix[2, 2] == pytest.approx(cross.real, abs=1e-12)
    assert matrix[2, 3] == pytest.approx(cross.imag, abs=1e-12)


def test_total_reflection():
    # the classical formula of the phase behind a prism (Born & Wolf, Sec. 1.5.4)
    angle, n = np.deg2rad(55.0), 1.5
    found = reflect(LIGHT, angle * u.rad, 1.0, ambient=n)
    assert found.reflectance == pytest.approx(1, abs=1e-15)
    half = np.cos(angle) * np.sqrt(np.sin(angle) ** 2 - n**-2) / np.sin(angle) ** 2
    # theirs is the phase of s over that of p
    expected = 2 * np.pi - 2 * np.arctan(half)
    assert found.retardance.to_value(u.rad) == pytest.approx(expected, abs=1e-12)
    # the critical angle itself
    found = reflect(LIGHT, np.arcsin(1 / 1.5) * u.rad, 1.0, ambient=1.5)
    assert found.reflectance == pytest.approx(1, abs=1e-6)


# --- against tmm ------------------------------------------------------------------


@settings(deadline=None)
@given(setup=stacks(), ambient=st.sampled_from([1.0, 1.33]))
def test_amplitudes_and_transmittance_of_tmm(setup, ambient):
    tmm = pytest.importorskip("tmm", reason="tmm is not installed")
    incidence, films, substrate = setup
    # opaque films make tmm print and change them
    films = [(n, d) for n, d in films if complex(n).imag * d.value < 2]
    found = reflect(LIGHT, incidence, substrate, films, ambient=ambient)
    indices = [ambient, *(n for n, _ in films), substrate]
    depths = [np.inf, *(d.to_value(u.um) for _, d in films), np.inf]
    for kind, r, passed in (
        ("s", found.r_s, found.transmittance_s),
        ("p", found.r_p, found.transmittance_p),
    ):
        other = tmm.coh_tmm(kind, indices, depths, incidence.to_value(u.rad), LIGHT.value)
        assert r == pytest.approx(other["r"], abs=1e-11)
        if complex(substrate).imag == 0:
            assert passed == pytest.approx(other["T"], abs=1e-11)


# --- derivatives ------------------------------------------------------------------


def difference(function, step=2e-4):
    """Five-point derivative at zero of the diattenuation and the retardance in radian."""

    def at(shift):
        found = function(shift * step)
        return np.array([found.diattenuation, found.retardance.to_value(u.rad)])

    return (8 * (at(1) - at(-1)) - (at(2) - at(-2))) / (12 * step)


@settings(max_examples=60)
@given(
    angle=st.floats(5, 75),
    first=st.floats(0.05, 0.4),
    second=st.floats(0.05, 0.4),
    index=st.floats(1.3, 2.2),
    n=st.floats(0.2, 2),
    k=st.floats(4, 15),
)
def test_derivatives_against_differences(angle, first, second, index, n, k):
    start = {
        "incidence": np.deg2rad(angle),
        "n": n,
        "k": k,
        "n_1": index,
        "k_1": 0.05,
        "thickness_1": first,
        "n_2": 1.45,
        "k_2": 0.02,
        "thickness_2": second,
    }

    def at(**moved):
        v = start | moved
        films = [(complex(v[f"n_{i}"], v[f"k_{i}"]), v[f"thickness_{i}"] * u.um) for i in (1, 2)]
        return reflect(LIGHT, v["incidence"] * u.rad, complex(v["n"], v["k"]), films)

    slopes = at().derivatives()
    assert set(slopes) == set(start)
    for key, found in slopes.items():
        expected = difference(lambda shift, key=key: at(**{key: start[key] + shift}))
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-6)


# --- many at once, materials, and what is refused ------------------------------------


def test_arrays_are_the_stack_of_the_scalars():
    wavelength, angle = [1.2, 1.6, 2.2] * u.um, [[10.0], [60.0]] * u.deg
    films = [("fused silica", 120 * u.nm), ("Al2O3", [80, 90, 100] * u.nm)]
    together = reflect(wavelength, angle, "silver", films)
    assert together.retardance.shape == (2, 3)
    assert together.mueller().shape == (2, 3, 4, 4)
    for i in range(2):
        for j in range(3):
            one = [films[0], ("Al2O3", films[1][1][j])]
            alone = reflect(wavelength[j], angle[i, 0], "silver", one)
            assert together.r_p[i, j] == pytest.approx(complex(alone.r_p), abs=1e-15)
            for key, slope in alone.derivatives().items():
                full = np.broadcast_to(together.derivatives()[key], (2, 2, 3))
                np.testing.assert_allclose(full[:, i, j], slope, rtol=1e-12)


def test_names_materials_and_numbers_are_the_same():
    index = FUSED_SILICA.index(LIGHT).value
    by_name = reflect(LIGHT, 30 * u.deg, "Ag", [("silica", 0.1 * u.um)])
    by_material = reflect(LIGHT, 30 * u.deg, get_material("silver"), [(FUSED_SILICA, 100 * u.nm)])
    by_number = reflect(LIGHT.to(u.nm), 30 * u.deg, get_material("silver"), [(index, 1e-4 * u.mm)])
    assert isinstance(by_name, Reflection)
    assert by_name.r_p == by_material.r_p
    assert by_name.r_p == pytest.approx(by_number.r_p, abs=1e-14)


def test_nonsense_is_refused():
    for degrees in [-1, 90, 100, np.nan, np.inf]:
        with pytest.raises(ParameterError, match=r"incidence = .* less than 90 deg"):
            reflect(LIGHT, degrees * u.deg, "gold")
    for index in [np.nan, -1.0, 1 - 0.1j, 0, np.inf, [1.5, np.nan]]:
        with pytest.raises(ParameterError, match=r"index = .*; allowed are"):
            reflect(LIGHT, 0 * u.deg, index)
    for ambient in [0.0, 1 + 0.1j, -1.0]:
        with pytest.raises(ParameterError, match=r"ambient = .* real, positive|index = "):
            fresnel(1.5, 0 * u.deg, ambient=ambient)
    for thickness in [-1 * u.nm, np.nan * u.nm, 3, 1 * u.s]:
        with pytest.raises(ParameterError, match="thickness"):
            reflect(LIGHT, 0 * u.deg, "gold", [(1.5, thickness)])
    with pytest.raises(ParameterError, match="material or index"):
        reflect(LIGHT, 0 * u.deg, object())
    with pytest.raises(ParameterError, match="unobtainium"):
        reflect(LIGHT, 0 * u.deg, "unobtainium")
    with pytest.raises(ParameterError, match="must be positive"):
        reflect(-LIGHT, 0 * u.deg, 1.5)
    with pytest.raises(WavelengthRangeError, match="fused silica"):
        reflect(5 * u.um, 0 * u.deg, "gold", [("fused silica", 1 * u.um)])
    with pytest.raises(ParameterError, match="must broadcast together"):
        reflect([1.2, 1.6] * u.um, [0, 10, 20] * u.deg, 1.5)


def test_an_index_keeps_unit_and_mask():
    plain = reflect(LIGHT, 45 * u.deg, 1.5, [(1.4, 200 * u.nm)], ambient=1.1)
    films = [(140 * u.percent, 200 * u.nm)]
    percent = reflect(LIGHT, 45 * u.deg, 150 * u.percent, films, ambient=110 * u.percent)
    np.testing.assert_allclose(percent.diattenuation, plain.diattenuation)
    with pytest.raises(ParameterError, match=r"index = .*; allowed are"):
        reflect(LIGHT, 0 * u.deg, np.ma.array([1.5, 1.6], mask=[False, True]))
