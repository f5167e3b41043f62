# Licensed under a 3-clause BSD style license - see LICENSE
"""What corrected Stokes parameters say of themselves."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal.correction import Corrected, Systematic
from astropolcal.correction.correcting import covariance_index
from astropolcal.correction.geometry import azimuthal
from astropolcal.exceptions import AstropolcalWarning, ParameterError

LAM = [1.2, 1.6] * u.um


def make(shape=(), components="IQU", systematic=True, **changes):
    """Return numbers of which each has a place of its own."""
    rng, n = np.random.default_rng(4), len(components)
    level = np.array([1000.0, 30.0, -20.0, 10.0])[:n].reshape(n, *[1] * (1 + len(shape)))
    stokes = level * rng.uniform(0.8, 1.2, (n, 2, *shape))
    root = rng.normal(size=(n, n, 2, *shape))
    covariance = np.einsum("ik...,jk...->ij...", root, root)
    planes = np.stack([covariance[i, j] for i, j in covariance_index(n)])
    known = Systematic(rng.normal(size=(5, 2, n, n)) * 1e-3, np.zeros((2, n, n), bool), "linear")
    settings = {
        "condition": np.array([1.5, 2.5]),
        "determined": np.ones((2, n), dtype=bool),
        "leakage": rng.normal(size=(2, n)),
        "weak": ["", ""],
        "unit": u.electron,
    } | changes
    return Corrected(components, LAM, stokes, planes, known if systematic else None, **settings)


@pytest.fixture
def spectrum():
    return make()


@pytest.fixture
def images():
    return make((7, 9), north_up=True)


# ---- Stokes parameters ---------------------------------------------------------------------


def test_components_by_name(spectrum, images):
    for i, name in enumerate("IQU"):
        np.testing.assert_array_equal(spectrum[name], spectrum.stokes[i])
    assert spectrum.stokes_axis.symbol.tolist() == ["I", "Q", "U"]
    for name in ("V", "IQ", "", "q"):
        with pytest.raises(ParameterError, match=rf"component = '{name}'; allowed are I, Q, U"):
            spectrum[name]
    # the repr tells the shape
    assert repr(spectrum) == "<Corrected IQU of 2, mode stokes>"
    assert repr(images) == "<Corrected IQU of 2 x 7 x 9, mode stokes>"


def test_fractions_are_of_the_light():
    found = make(components="IQUV")
    for i, name in enumerate("quv", start=1):
        np.testing.assert_allclose(getattr(found, name), found.stokes[i] / found.stokes[0])
    dark = make()
    dark.stokes[0, 1] = 0.0
    assert np.isnan(dark.q).tolist() == [False, True]
    dark.stokes[0, 1] = -5.0
    assert np.isnan(dark.u).tolist() == [False, True]


# ---- errors --------------------------------------------------------------------------------


def test_covariances_are_symmetric_and_in_their_places():
    for components in ["IQU", "IQUV"]:
        found = make(components=components)
        matrix = found.covariances()
        for plane, (i, j) in zip(found.covariance, covariance_index(len(components)), strict=True):
            np.testing.assert_array_equal(matrix[i, j], plane)
            np.testing.assert_array_equal(matrix[j, i], plane)


def test_systematic_covariances_are_those_of_each_wavelength(images):
    found = images.covariances("systematic")
    for w in (0, 1):
        expected = images.systematic.covariance(images.stokes[:, w], w)
        np.testing.assert_allclose(found[:, :, w], expected, rtol=1e-12)
    np.testing.assert_allclose(images.error("Q", "systematic"), np.sqrt(found[1, 1]))


def test_errors_that_nobody_knows_are_nan():
    found = make(systematic=False)
    found.covariance = None
    for kind in ("statistical", "systematic"):
        assert np.isnan(found.covariances(kind)).all()
        assert np.isnan(found.error("I", kind)).all()


def test_where_nothing_was_measured_there_is_no_systematic_error(images):
    images.stokes[:, 1, 3, 4] = np.nan
    found = images.covariances("systematic")
    assert np.isnan(found[:, :, 1, 3, 4]).all()
    assert np.isfinite(found[:, :, 0]).all()
    with pytest.raises(ParameterError, match=r"'random'; allowed are statistical, systematic"):
        images.covariances("random")


# ---- images --------------------------------------------------------------------------------


def test_q_phi_is_about_the_star():
    for centre in [None, (4.0, 2.0)]:
        found = make((7, 9), centre=centre)
        told = found.azimuthal()
        expected = azimuthal(found["Q"], found["U"], (4.0, 3.0) if centre is None else centre)
        np.testing.assert_allclose([told["q_phi"], told["u_phi"]], expected)
        # the sum of both variances does not depend on the axes
        for kind in ("statistical", "systematic"):
            c = found.covariances(kind)
            both = told[f"q_phi_{kind}"] ** 2 + told[f"u_phi_{kind}"] ** 2
            np.testing.assert_allclose(both, c[1, 1] + c[2, 2], rtol=1e-9)


def test_an_aperture_is_a_sum_over_pixels(images):
    found = make((7, 9), centre=(5.0, 3.0))
    one = found.aperture(0.5)
    np.testing.assert_array_equal(one.stokes, found.stokes[:, :, 3, 5])
    cross = found.aperture(1.0)
    pixels = [(3, 5), (2, 5), (4, 5), (3, 4), (3, 6)]
    expected = sum(found.stokes[:, :, y, x] for y, x in pixels)
    np.testing.assert_allclose(cross.stokes, expected)
    expected = sum(found.covariance[:, :, y, x] for y, x in pixels)
    np.testing.assert_allclose(cross.covariance, expected)
    elsewhere = found.aperture(0.5, centre=(0, 6))
    np.testing.assert_array_equal(elsewhere.stokes, found.stokes[:, :, 6, 0])
    assert cross.systematic is found.systematic
    assert cross.unit == u.electron
    # an aperture without a centre is in the middle
    np.testing.assert_array_equal(images.aperture(0.5).stokes, images.stokes[:, :, 3, 4])
    # pixels that lack one component are left out of all, wavelength by wavelength
    holes = make((7, 9), centre=(5.0, 3.0))
    holes.stokes[1, 0, 3, 4] = np.nan
    words = "up to 1 of 5 pixels of the aperture have no value, at 1 of 2 wavelengths"
    with pytest.warns(AstropolcalWarning, match=words):
        part = holes.aperture(1.0)
    np.testing.assert_allclose(part.stokes[:, 1], cross.stokes[:, 1])
    for one, all_ in ((part.stokes, found.stokes), (part.covariance, found.covariance)):
        np.testing.assert_allclose(
            one[:, 0], sum(all_[:, 0, y, x] for y, x in pixels[:3] + pixels[4:])
        )
    # a component that is nowhere determined, or a wavelength, leaves the others
    holes.stokes[:, 0], holes.stokes[1, 1] = np.nan, np.nan
    part = holes.aperture(1.0)
    assert np.isnan(part.stokes).tolist() == [[True, False], [True, True], [True, False]]
    np.testing.assert_allclose(part["I"][1], cross["I"][1])
    # they can be compared like any object
    assert found == found
    assert found != holes
    # an aperture without errors
    images.covariance = None
    assert images.aperture(2).covariance is None


def test_apertures_of_no_size(images):
    for radius in [0, -1, np.nan]:
        with pytest.raises(ParameterError, match="no pixel is inside"):
            images.aperture(radius)
        with pytest.raises(ParameterError, match="no pixel is inside"):
            images.aperture(0.1, centre=(2.5, 2.5))
    # an aperture does not leave the images
    found = make((7, 9), centre=(5.0, 3.0))
    found.aperture(3.5)
    words = r"radius = 3.6 leaves the images of 9 x 7 pixels; allowed around \(5, 3\) are up to 3.5"
    with pytest.raises(ParameterError, match=words):
        found.aperture(3.6)


def test_what_is_asked_of_the_wrong_kind(spectrum, images):
    for ask, words in [
        (lambda s, i: s.azimuthal(), "Q_phi and U_phi are of images; these are not"),
        (lambda s, i: s.aperture(3), "an aperture needs images; these are spectra"),
        (lambda s, i: i.table(), "a table is of a point source; take an aperture of the images"),
    ]:
        with pytest.raises(ParameterError, match=words):
            ask(spectrum, images)


# ---- tables and spectra --------------------------------------------------------------------


def test_columns_of_the_table():
    for components in ["IQU", "IQUV"]:
        found = make(components=components, mode="ip", provenance={"calibration": "a.asdf"})
        table = found.table()
        np.testing.assert_array_equal(table["I"].value, found["I"])
        assert table["I"].unit == table["I_statistical"].unit == u.electron, components
        np.testing.assert_allclose(table["I_systematic"].value, found.error("I", "systematic"))
        for kind in ("statistical", "systematic"):
            errors = found.fractional_errors(kind)
            for name in components[1:].lower():
                np.testing.assert_array_equal(table[name], getattr(found, name))
                np.testing.assert_array_equal(table[f"{name}_{kind}"], errors[name])
            np.testing.assert_array_equal(table[f"covariance_qu_{kind}"], errors["covariance_qu"])
        for name in ("aolp", "s_chi_statistical", "s_chi_systematic"):
            assert table[name].unit == u.deg, components
        np.testing.assert_array_equal(table["leakage_q"], found.leakage[:, 1])
        np.testing.assert_array_equal(table["leakage_u"], found.leakage[:, 2])
        assert ("v" in table.colnames) is (components == "IQUV"), components
        assert table.meta["mode"] == "ip", components
        assert table.meta["calibration"] == "a.asdf", components


def test_a_wavelength_that_lacks_one_component_is_not_determined():
    determined = np.array([[True, True, True], [True, True, False]])
    assert make(determined=determined).table()["determined"].tolist() == [True, False]


def test_spectra_have_both_errors(spectrum):
    pytest.importorskip("specutils")
    table, found = spectrum.table(), spectrum.spectra()
    assert set(found) == {"I", "q", "u"}
    for name, one in found.items():
        np.testing.assert_array_equal(one.flux.value, u.Quantity(table[name]).value)
        expected = u.Quantity(table[f"{name}_statistical"]).value
        np.testing.assert_array_equal(one.uncertainty.array, expected)
        expected = u.Quantity(table[f"{name}_systematic"]).value
        np.testing.assert_array_equal(one.meta["systematic"], expected)
        np.testing.assert_array_equal(one.spectral_axis.value, LAM.value)
        assert not one.mask.any()
    # what is not known is masked
    spectrum.stokes[1, 0] = np.nan
    found = spectrum.spectra()
    assert found["q"].mask.tolist() == [True, False]
    assert not found["u"].mask.any()
