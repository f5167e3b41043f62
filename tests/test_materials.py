# Licensed under a 3-clause BSD style license - see LICENSE
"""Refractive indices against published values, and where they are refused."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.materials import (
    MGF2,
    QUARTZ,
    SellmeierLaw,
    UniaxialMaterial,
    get_material,
    material_names,
)

MATERIALS = [QUARTZ, MGF2]

# The independent law for quartz, 0.18 to 3 um: Radhakrishnan 1951, Proc.
# Indian Acad. Sci., coefficients as listed by refractiveindex.info.
RADHAKRISHNAN = UniaxialMaterial(
    "quartz after Radhakrishnan",
    SellmeierLaw(
        (
            (0.663044, 0.060**2),
            (0.517852, 0.106**2),
            (0.175912, 0.119**2),
            (0.565380, 8.844**2),
            (1.675299, 20.742**2),
        )
    ),
    SellmeierLaw(
        (
            (0.665721, 0.060**2),
            (0.503511, 0.106**2),
            (0.214792, 0.119**2),
            (0.539173, 8.792**2),
            (1.807613, 19.70**2),
        )
    ),
    measured_range=[0.18, 3.0] * u.um,
)

# Tydex, "Synthetic crystal quartz", rounded to three decimals there
QUARTZ_TABLE = [
    (0.219, 1.625, 1.637),
    (0.243, 1.605, 1.617),
    (0.291, 1.581, 1.591),
    (0.405, 1.557, 1.567),
    (0.589, 1.544, 1.553),
    (1.083, 1.534, 1.543),
    (1.800, 1.524, 1.532),
    (2.500, 1.512, 1.520),
]


@pytest.mark.parametrize(("wavelength", "ordinary", "extraordinary"), QUARTZ_TABLE)
def test_quartz_agrees_with_a_manufacturers_table(wavelength, ordinary, extraordinary):
    # half a unit of the last digit, and 5e-4 between samples and laws
    assert QUARTZ.ordinary(wavelength * u.um).value == pytest.approx(ordinary, abs=1e-3)
    assert QUARTZ.extraordinary(wavelength * u.um).value == pytest.approx(extraordinary, abs=1e-3)


def test_quartz_at_the_sodium_line():
    # n_o = 1.5442, n_e = 1.5533 of every table of minerals; the law of Ghosh
    # lies 4e-5 below the classical five-digit values 1.54424 and 1.55335
    assert QUARTZ.ordinary(589.3 * u.nm).value == pytest.approx(1.54424, abs=6e-5)
    assert QUARTZ.extraordinary(589.3 * u.nm).value == pytest.approx(1.55335, abs=6e-5)
    assert QUARTZ.birefringence(589.3 * u.nm).value == pytest.approx(0.00911, abs=2e-5)


def test_magnesium_fluoride_at_the_helium_line():
    # catalogue values n_o = 1.378 and n_e = 1.390 at 587.6 nm, three decimals
    assert MGF2.ordinary(587.6 * u.nm).value == pytest.approx(1.378, abs=6e-4)
    assert MGF2.extraordinary(587.6 * u.nm).value == pytest.approx(1.390, abs=6e-4)
    assert MGF2.birefringence(587.6 * u.nm).value == pytest.approx(0.0118, abs=5e-5)


def sellmeier(wavelength, constant, terms):
    """The textbook form, resonance wavelengths not squared."""
    square = wavelength**2
    return np.sqrt(constant + sum(b * square / (square - c**2) for b, c in terms))


def test_the_laws_are_those_of_the_papers():
    # written out once more from Ghosh 1999 and Dodge 1984, poles as wavelengths
    ghosh = [
        sellmeier(1.55, 1.28604141, [(1.07044083, 0.100292571), (1.10202242, 10.0)]),
        sellmeier(1.55, 1.28851804, [(1.09509924, 0.101045467), (1.15662475, 10.0)]),
    ]
    dodge = [
        sellmeier(
            1.55,
            1.0,
            [(0.48755108, 0.04338408), (0.39875031, 0.09461442), (2.3120353, 23.793604)],
        ),
        sellmeier(
            1.55,
            1.0,
            [(0.41344023, 0.03684262), (0.50497499, 0.09076162), (2.4904862, 23.771995)],
        ),
    ]
    for material, expected in ((QUARTZ, ghosh), (MGF2, dodge)):
        found = [material.ordinary(1.55 * u.um).value, material.extraordinary(1.55 * u.um).value]
        assert found == pytest.approx(expected, abs=1e-8)


def test_birefringence_in_the_h_band():
    # pins the numbers that every half-wave plate of the package rests on
    assert QUARTZ.birefringence(1.55 * u.um).value == pytest.approx(0.008474, abs=1e-6)
    assert MGF2.birefringence(1.55 * u.um).value == pytest.approx(0.011419, abs=1e-6)


@pytest.mark.parametrize(
    ("wavelength", "percent"), [(1.2, -0.488), (1.6, -0.755), (2.05, -1.245), (2.4, -1.848)]
)
def test_the_extension_of_quartz_costs_what_the_documentation_says(wavelength, percent):
    ratio = QUARTZ.birefringence(wavelength * u.um) / RADHAKRISHNAN.birefringence(wavelength * u.um)
    assert 100 * (ratio - 1).value == pytest.approx(percent, abs=2e-3)


def test_quartz_stays_within_half_a_percent_of_the_other_law_up_to_j_band():
    wavelength = np.linspace(0.25, 1.2, 200) * u.um
    ratio = QUARTZ.birefringence(wavelength) / RADHAKRISHNAN.birefringence(wavelength)
    assert np.abs(ratio - 1).max() < 0.005


def test_indices_of_quartz_stay_close_to_the_other_law_in_the_extension():
    wavelength = np.linspace(2.0531, 2.5, 50) * u.um
    for ours, other in (
        (QUARTZ.ordinary, RADHAKRISHNAN.ordinary),
        (QUARTZ.extraordinary, RADHAKRISHNAN.extraordinary),
    ):
        assert np.abs(ours(wavelength) - other(wavelength)).max() < 2e-4


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.name)
def test_valid_range_holds_the_measured_range_and_charis(material):
    low, high = material.valid_range
    assert low <= material.measured_range[0]
    assert high >= material.measured_range[1]
    assert low < 1.16 * u.um
    assert high > 2.369 * u.um


def test_only_quartz_goes_beyond_its_measurements():
    assert QUARTZ.valid_range[1] == 2.5 * u.um
    assert QUARTZ.measured_range[1] == 2.0531 * u.um
    assert np.all(MGF2.valid_range == MGF2.measured_range)


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.name)
def test_dispersion_is_normal_and_crystals_are_positive(material):
    wavelength = np.linspace(*material.valid_range.to_value(u.um), 400) * u.um
    assert np.all(np.diff(material.ordinary(wavelength)) < 0)
    assert np.all(np.diff(material.extraordinary(wavelength)) < 0)
    assert np.all(np.diff(material.birefringence(wavelength)) < 0)
    assert np.all(material.birefringence(wavelength) > 0)


@given(st.floats(0.2, 2.5), st.sampled_from(MATERIALS))
def test_the_unit_of_the_wavelength_does_not_matter(wavelength, material):
    expected = material._birefringence_um(wavelength)
    for unit in (u.nm, u.mm, u.AA, u.m):
        quantity = (wavelength * u.um).to(unit)
        assert material.birefringence(quantity).value == pytest.approx(expected, rel=1e-9)


@given(st.floats(0.2, 2.5), st.sampled_from(MATERIALS))
def test_birefringence_is_the_difference_of_the_indices(wavelength, material):
    quantity = wavelength * u.um
    difference = material.extraordinary(quantity) - material.ordinary(quantity)
    assert difference.value == pytest.approx(material.birefringence(quantity).value, abs=1e-15)


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.name)
@pytest.mark.parametrize("method", ["ordinary", "extraordinary", "birefringence"])
def test_shapes_are_kept_and_results_are_dimensionless(material, method):
    for shape in ((), (3,), (2, 3), (0,)):
        result = getattr(material, method)(np.full(shape, 1.5) * u.um)
        assert result.shape == shape
        assert result.unit == u.dimensionless_unscaled


@pytest.mark.parametrize("material", MATERIALS, ids=lambda m: m.name)
def test_the_ends_of_the_range_are_inside_in_every_unit(material):
    for unit in (u.nm, u.um, u.mm, u.AA, u.m):
        assert np.all(material.birefringence(material.valid_range.to(unit)) > 0)


@pytest.mark.parametrize("method", ["ordinary", "extraordinary", "birefringence"])
@pytest.mark.parametrize("wavelength", [0.15, 2.501, 10.0, -1.0, 0.0, np.nan, np.inf])
def test_outside_the_range_quartz_has_no_index(method, wavelength):
    with pytest.raises(WavelengthRangeError, match=r"quartz.*0\.198 to 2\.5 um.*not at"):
        getattr(QUARTZ, method)(wavelength * u.um)


def test_the_message_names_the_offending_one_of_many():
    with pytest.raises(WavelengthRangeError, match=r"MgF2 .* 0\.2 to 7\.04 um, not at 7\.5 um"):
        MGF2.birefringence([1000.0, 7500.0] * u.nm)


def test_the_hot_path_checks_the_range_too():
    assert QUARTZ._birefringence_um(np.array([1.2, 2.0])).shape == (2,)
    with pytest.raises(WavelengthRangeError):
        QUARTZ._birefringence_um(np.array([1.2, 2.6]))
    with pytest.raises(WavelengthRangeError):
        QUARTZ._birefringence_um(np.nan)


@pytest.mark.parametrize("wavelength", [1.5, [1.5, 1.6], 1.5 * u.s])
def test_a_wavelength_needs_a_unit_of_length(wavelength):
    with pytest.raises(ParameterError, match="wavelength"):
        QUARTZ.ordinary(wavelength)


def test_the_registry_knows_every_material_by_every_name():
    assert material_names() == ["quartz", "MgF2"]
    for material in MATERIALS:
        for name in (material.name, *material.aliases):
            assert get_material(name) is material
            assert get_material(f" {name.upper()} ") is material
        assert material.doi.startswith("10.")
        assert material.name in repr(material)


def test_a_misspelt_material_gets_a_suggestion():
    with pytest.raises(ParameterError, match=r"'quarz'; did you mean 'quartz'\? .*MgF2"):
        get_material("quarz")
    with pytest.raises(ParameterError, match=r"'unobtainium' \(available"):
        get_material("unobtainium")


@pytest.mark.parametrize("limits", [[2.0, 1.0], [1.0, 1.0], [0.0, 1.0], [np.nan, 1.0], [1.0]])
def test_a_range_must_increase(limits):
    law = SellmeierLaw(((1.0, 0.01),))
    with pytest.raises(ParameterError, match="measured_range"):
        UniaxialMaterial("toy", law, law, measured_range=limits * u.um)


def test_a_sellmeier_law_by_hand():
    # n^2 = 1.5 + 0.7 * 4 / (4 - 1) = 2.4333...
    law = SellmeierLaw(terms=((0.7, 1.0),), constant=1.5)
    assert law._index_um(2.0) == pytest.approx(np.sqrt(1.5 + 2.8 / 3), rel=1e-15)
