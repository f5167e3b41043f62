# Licensed under a 3-clause BSD style license - see LICENSE
"""Spectra of a reduced target: there, back, and what cannot be one."""

import astropy.units as u
import numpy as np
import pytest
from astropy.nddata import InverseVariance, StdDevUncertainty, VarianceUncertainty
from astropy.table import MaskedColumn, QTable
from astropy.utils.masked import Masked
from hypothesis import given
from hypothesis import strategies as st

from astropolcal.exceptions import ObservationError
from astropolcal.reduction.spectrum import (
    read_spectra,
    spectra_from_table,
    table_from_spectra,
    write_spectra,
)

specutils = pytest.importorskip("specutils", reason="specutils is not installed")


def target(n=5, seed=1, **columns):
    rng = np.random.default_rng(seed)
    table = QTable({"wavelength": np.geomspace(1160, 2370, n) * u.nm})
    table["intensity"], table["intensity_err"] = (
        rng.uniform(5, 9, n) * u.mJy,
        np.full(n, 0.1) * u.mJy,
    )
    for name in ("q", "u", "v"):
        table[name], table[f"{name}_err"] = rng.normal(0, 0.01, n), rng.uniform(1e-4, 3e-4, n)
    table["covariance_qu"] = rng.normal(0, 1e-9, n)
    for name, values in columns.items():
        table[name] = values
    table.meta = {"object": "HD 1", "calibration": "abc"}
    return table


def same(one, two):
    assert set(one.colnames) - {"mask"} == set(two.colnames) - {"mask"}
    for name in set(one.colnames) - {"mask"}:
        np.testing.assert_array_equal(u.Quantity(one[name]), u.Quantity(two[name]), err_msg=name)


def test_spectra_hold_the_columns_on_one_axis():
    table = target()
    spectra = spectra_from_table(table)
    assert list(spectra) == ["I", "q", "u", "v"]
    for key, name in (("I", "intensity"), ("q", "q"), ("u", "u"), ("v", "v")):
        spectrum = spectra[key]
        assert isinstance(spectrum, specutils.Spectrum)
        np.testing.assert_array_equal(u.Quantity(spectrum.spectral_axis), table["wavelength"])
        np.testing.assert_array_equal(spectrum.flux, u.Quantity(table[name]))
        np.testing.assert_array_equal(
            spectrum.uncertainty.array, u.Quantity(table[f"{name}_err"]).value
        )
        assert spectrum.meta["object"] == "HD 1"
    assert spectra["I"].flux.unit == u.mJy
    np.testing.assert_array_equal(spectra["u"].meta["covariance_qu"], table["covariance_qu"])


@pytest.mark.slow
@given(n=st.integers(1, 12), seed=st.integers(0, 1000), some=st.booleans())
def test_there_and_back_is_the_same_table(n, seed, some):
    table = target(n, seed)
    if some:
        table.remove_columns(["v", "v_err", "covariance_qu"])
    back = table_from_spectra(spectra_from_table(table))
    same(back, table)
    assert not back["mask"].any()
    assert back.meta == table.meta


def test_units_of_errors_need_not_be_those_of_the_values():
    plain = target(q_systematic=1e-3)
    mixed = target(q_systematic=0.1 * u.percent)
    mixed["intensity_systematic"] = 20 * u.uJy
    spectra = spectra_from_table(mixed)
    np.testing.assert_allclose(spectra["q"].meta["systematic"], 1e-3)
    back = table_from_spectra(spectra)
    np.testing.assert_allclose(back["q_systematic"], plain["q_systematic"])
    np.testing.assert_allclose(back["intensity_systematic"].to_value(u.mJy), 0.02)
    # and of values in percent, whose errors are plain numbers
    mixed["q"] = mixed["q"].to(u.percent)
    spectrum = spectra_from_table(mixed)["q"]
    np.testing.assert_allclose(spectrum.uncertainty.array, 100 * plain["q_err"])
    np.testing.assert_allclose(spectrum.meta["systematic"], 0.1)


def test_velocities_are_no_axis_of_wavelengths():
    spectra = spectra_from_table(target())
    axis = np.linspace(0, 9, 5) * u.km / u.s
    for key, one in spectra.items():
        spectra[key] = specutils.Spectrum(one.flux, axis, uncertainty=one.uncertainty)
    with pytest.raises(ObservationError, match="spectrum I: its axis is in km / s"):
        table_from_spectra(spectra)


def test_table_of_a_correction_is_read(tmp_path):
    table = QTable({"wavelength": [1.2, 1.6, 2.0] * u.um, "I": [900.0, 800.0, 700.0] * u.adu})
    table["I_statistical"], table["I_systematic"] = [3, 3, 3] * u.adu, [1, 1, np.inf] * u.adu
    for name in "qu":
        table[name] = [0.010, 0.008, np.nan]
        table[f"{name}_statistical"] = [2e-4, 2e-4, np.inf]
        table[f"{name}_systematic"] = [1e-4, np.inf, np.inf]
    table["covariance_qu_statistical"] = [1e-9, 1e-9, np.nan]
    table["determined"] = [True, True, False]
    path = tmp_path / "star.ecsv"
    table.write(path, format="ascii.ecsv")
    spectra = read_spectra(path)
    assert spectra["q"].mask.tolist() == [False, False, True]
    np.testing.assert_array_equal(spectra["u"].uncertainty.array[:2], 2e-4)
    np.testing.assert_array_equal(spectra["q"].meta["systematic"], [1e-4, np.inf, np.inf])
    again = tmp_path / "again.ecsv"
    write_spectra(spectra, again)
    same(table_from_spectra(read_spectra(again)), table_from_spectra(spectra))
    table["q_systematic"][0] = -1.0
    with pytest.raises(ObservationError, match=r"q_systematic = -1\.0"):
        spectra_from_table(table)


def test_file_reads_back(tmp_path):
    table = target(mask=[False, True, False, False, False])
    table["q"][1] = np.nan
    path = tmp_path / "target.ecsv"
    write_spectra(spectra_from_table(table), path)
    back = table_from_spectra(read_spectra(path))
    same(back, table)
    assert back["mask"].tolist() == [False, True, False, False, False]
    assert back.meta == table.meta
    with pytest.raises(ObservationError, match="exists"):
        write_spectra(spectra_from_table(table), path)
    write_spectra(spectra_from_table(target(seed=4)), path, overwrite=True)
    same(table_from_spectra(read_spectra(path)), target(seed=4))


def test_rows_come_in_the_order_of_the_wavelengths_and_masks_stay_with_them():
    table = target(mask=[True, False, False, False, False])
    spectra = spectra_from_table(table[::-1])
    np.testing.assert_array_equal(spectra["q"].flux.value, table["q"])
    assert spectra["q"].mask.tolist() == [True, False, False, False, False]
    spectra["u"].mask[3] = True
    assert table_from_spectra(spectra)["mask"].tolist() == [True, False, False, True, False]


def test_percent_and_masked_columns_are_understood():
    table = target(q=np.full(5, 1.0) * u.percent, q_err=np.full(5, 0.02) * u.percent)
    table["mask"] = [False, False, True, False, False]
    table["intensity"] = Masked(table["intensity"], mask=table["mask"])
    spectra = spectra_from_table(table)
    assert spectra["q"].flux.unit == u.percent
    np.testing.assert_allclose(spectra["q"].flux.to_value(u.one), 0.01)
    assert np.isnan(spectra["I"].flux[2])


def test_flags_are_true_or_false_and_unknown_ones_mask():
    for flags in ([True, False, True], [1, 0, 1]):
        assert spectra_from_table(target(3, mask=flags))["q"].mask.tolist() == [True, False, True]
    for data in (True, False):
        for kind in (MaskedColumn, Masked):
            unknown = kind([data] * 3, mask=[False, True, False])
            found = spectra_from_table(target(3, mask=unknown))["q"].mask
            assert found.tolist() == [data, True, data], kind
    # numpy takes any text for true
    for flags in (["False", "True", "False"], [np.nan, 0.0, 0.0]):
        with pytest.raises(ObservationError, match="mask must be true or false"):
            spectra_from_table(target(3, mask=flags))


def test_any_uncertainty_with_a_standard_deviation_will_do():
    for kind in [StdDevUncertainty, VarianceUncertainty, InverseVariance]:
        spectra = spectra_from_table(target())
        for key, spectrum in spectra.items():
            spectra[key] = specutils.Spectrum(
                flux=spectrum.flux,
                spectral_axis=spectrum.spectral_axis,
                uncertainty=spectrum.uncertainty.represent_as(kind),
            )
        np.testing.assert_allclose(table_from_spectra(spectra)["q_err"], target()["q_err"])


def test_frequencies_become_wavelengths():
    spectra = spectra_from_table(target())
    for key, spectrum in spectra.items():
        axis = u.Quantity(spectrum.spectral_axis).to(u.THz, u.spectral())
        spectra[key] = specutils.Spectrum(
            flux=spectrum.flux, spectral_axis=axis, uncertainty=spectrum.uncertainty
        )
    back = table_from_spectra(spectra)
    assert back["wavelength"].unit == u.um
    np.testing.assert_allclose(back["wavelength"].to_value(u.nm), target()["wavelength"].value)
    np.testing.assert_array_equal(back["q"], u.Quantity(target()["q"]))


def _without(column):
    table = target()
    table.remove_column(column)
    return table


def test_table_that_is_no_target_is_refused():
    for table, words in [
        (_without("u"), "missing columns u$"),
        (_without("v_err"), "missing columns v_err"),
        (_without("wavelength"), "missing columns wavelength"),
        (target()[:0], "no rows"),
        (target(wavelength=[1, 2, 2, 3, 4] * u.um), "wavelength 2.0 um is given twice"),
        (target(wavelength=[-1, 2, 3, 4, 5] * u.um), "not positive"),
        (target(wavelength=[1, 2, 3, 4, 5]), "column wavelength has no unit, a unit such as um"),
        (target(q=np.ones(5) * u.mJy), "column q has unit mJy"),
        (target(q=list("abcde")), "column q has type .*, numbers are needed"),
        (target(u=[0, np.nan, 0, 0, 0]), "u = nan at 13"),
        (target(u_err=[0, 0, -1e-4, 0, 0]), "u_err = -0.0001 at 1658.* not negative"),
        (target(intensity_err=np.ones(5) * u.um), "column intensity_err has unit um"),
    ]:
        with pytest.raises(ObservationError, match=words):
            spectra_from_table(table)


def test_spectra_that_do_not_belong_together_are_refused():
    spectra = spectra_from_table(target())
    with pytest.raises(ObservationError, match="missing u, unknown none"):
        table_from_spectra({k: v for k, v in spectra.items() if k != "u"})
    with pytest.raises(ObservationError, match="missing none, unknown w"):
        table_from_spectra(spectra | {"w": spectra["q"]})
    with pytest.raises(ObservationError, match="spectrum u: is on another spectral axis"):
        table_from_spectra(spectra | {"u": spectra["u"][:-1]})
    # 5 nm beside the others, in whatever unit
    shifted = {
        key: specutils.Spectrum(
            flux=one.flux,
            spectral_axis=one.spectral_axis.to(u.m) + (key == "u") * 5 * u.nm,
            uncertainty=one.uncertainty,
        )
        for key, one in spectra.items()
    }
    with pytest.raises(ObservationError, match="spectrum u: is on another spectral axis"):
        table_from_spectra(shifted)
    bare = specutils.Spectrum(flux=spectra["q"].flux, spectral_axis=spectra["q"].spectral_axis)
    with pytest.raises(ObservationError, match="spectrum q: has no uncertainty"):
        table_from_spectra(spectra | {"q": bare})
    plane = specutils.Spectrum(
        flux=np.ones((2, 5)) * u.one, spectral_axis=spectra["q"].spectral_axis
    )
    with pytest.raises(ObservationError, match="spectrum q: 2 axes"):
        table_from_spectra(spectra | {"q": plane})
    with pytest.raises(ObservationError, match=r"covariance_qu has shape \(5,\) for 3"):
        table_from_spectra({key: spectrum[:3] for key, spectrum in spectra.items()})


def test_a_bad_file_is_named(tmp_path):
    path = tmp_path / "bad.ecsv"
    _without("q").write(path, format="ascii.ecsv")
    with pytest.raises(ObservationError, match=r"bad\.ecsv: target: missing columns q"):
        read_spectra(path)
