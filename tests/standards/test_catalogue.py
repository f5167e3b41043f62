# Licensed under a 3-clause BSD style license - see LICENSE
"""The catalogue: complete, consistent, forgiving of how names are written."""

import re

import astropy.units as u
import numpy as np
import pytest

from astropolcal import standards
from astropolcal.exceptions import ParameterError, WavelengthRangeError
from astropolcal.standards.priors import _normal

STARS, POLARIZATION = standards.catalogue()


def test_every_measurement_belongs_to_a_star_and_every_star_has_numbers():
    known = set(STARS["name"])
    assert len(known) == len(STARS)
    assert set(POLARIZATION["name"]) <= known
    without = [n for n in known - set(POLARIZATION["name"]) if standards.get(n).law is None]
    assert without == []


def test_columns_have_units():
    assert STARS["ra"].unit == STARS["dec"].unit == POLARIZATION["theta"].unit == u.deg
    assert POLARIZATION["p"].unit == STARS["p_max"].unit == u.percent
    assert POLARIZATION["wavelength"].unit == STARS["lambda_max"].unit == u.um


def test_numbers_are_possible():
    assert np.all((STARS["ra"] >= 0 * u.deg) & (STARS["ra"] < 360 * u.deg))
    assert np.all(np.diff(STARS["ra"]) >= 0)
    assert np.all(np.abs(STARS["dec"]) <= 90 * u.deg)
    assert np.all((POLARIZATION["p"] >= 0 * u.percent) & (POLARIZATION["p"] < 15 * u.percent))
    kinds = dict(zip(STARS["name"], STARS["kind"], strict=True))
    polarized = np.array([kinds[name] == "polarized" for name in POLARIZATION["name"]])
    assert np.all(POLARIZATION["p"][polarized] > 0)
    assert np.all(np.isfinite(POLARIZATION["theta"][polarized]))
    for column in ("p_err", "theta_err"):
        error = POLARIZATION[column].value
        assert np.all(~np.isfinite(error) | (error > 0))
    theta = POLARIZATION["theta"].value
    assert np.all(np.isnan(theta) | ((theta >= 0) & (theta <= 180)))
    assert set(STARS["kind"]) == set(standards.priors.KINDS)


def test_bands_are_where_they_should_be():
    ranges = {"U": (0.35, 0.37), "B": (0.43, 0.45), "V": (0.54, 0.56), "R": (0.63, 0.66)}
    ranges |= {"I": (0.78, 0.81), "J": (1.2, 1.26), "H": (1.6, 1.67), "K": (2.0, 2.2)}
    ranges |= {"optical": (0.54, 0.56)}
    for row in POLARIZATION:
        low, high = ranges[str(row["band"])]
        assert low <= row["wavelength"].to_value(u.um) <= high, row
    # nobody is asked twice: one row a star, band and source
    rows = [(r["name"], r["band"], r["reference"]) for r in POLARIZATION]
    assert len(set(rows)) == len(rows)


def test_published_parameters_come_with_each_other():
    law = np.isfinite(STARS["p_max"])
    for column in ("lambda_max", "width"):
        np.testing.assert_array_equal(np.isfinite(STARS[column]), law)
    scatter = np.isfinite(STARS["p_scatter"])
    np.testing.assert_array_equal(np.isfinite(STARS["theta_scatter"]), scatter)
    assert np.sum(scatter) > 4
    # whoever varies says so
    assert all("var" in star["note"] for star in STARS[scatter])


def test_every_row_says_where_it_is_from():
    for row in POLARIZATION:
        assert row["reference"]
        assert row["via"]
        # a publication without DOI, or whose DOI nobody has looked up, is cited in full
        assert row["doi"].startswith("10.") or re.search(r"\d{4}, .* \d+, \d+", row["reference"])
    for row in STARS[np.isfinite(STARS["p_max"])]:
        # the list of Serkowski (1974) is in a book without DOI
        assert row["law_doi"].startswith("10.") or row["law_reference"] == "Serkowski 1974"


def test_unpolarized_stars_are_and_polarized_are():
    for name in standards.names():
        star = standards.get(name)
        degree = star.polarization["p"].to_value(u.percent)
        if star.kind == "unpolarized":
            assert np.all(degree < 0.3)
        else:
            assert star.law is not None or np.max(degree) > 0.3


def test_unpolarized_stars_of_the_charis_calibration():
    for name in ["HD 293396", "HD 35532"]:
        star = standards.get(name)
        assert star.kind == "unpolarized", name
        assert star.polarization["p"][0] == 0, name
        # published 0.0 +- 0.2 %
        assert round(star.polarization["p_err"][0].to_value(u.percent), 1) == 0.2, name


def test_hd30675_has_the_law_of_whittet_1992():
    law = standards.get("HD 30675").law
    np.testing.assert_allclose(law.parameters[:3], [0.039, 0.52, 0.99])
    # between 1 and 2 % in J and H, as the CHARIS recalibration says of it
    degree = law([1.25, 1.64] * u.um).to_value(u.percent)
    assert np.all((degree > 1) & (degree < 2))


def test_laws_reproduce_the_measurements_they_were_fitted_to():
    pulls = []
    for name in standards.names("polarized"):
        star = standards.get(name)
        if star.law_errors:
            table = star.polarization[star.polarization["reference"] == star.law_reference]
            off = (star.law(table["wavelength"]) - table["p"]).to_value(u.percent)
            pulls.append(off / table["p_err"].to_value(u.percent))
    pulls = np.concatenate(pulls)
    assert len(pulls) > 200
    assert np.median(np.abs(pulls)) < 1
    assert np.mean(np.abs(pulls) < 3) > 0.9


def test_errors_of_a_law_come_all_or_none():
    for name in standards.names():
        star = standards.get(name)
        assert set(star.law_errors) in (set(), {"p_max", "lambda_max", "K", "theta", "rotation"})


def test_the_angle_of_a_law_is_that_of_the_bands():
    star = standards.get("HD 283812")
    assert star.law.theta.value == pytest.approx(31.3, abs=0.5)
    assert star.law_errors["theta"].to_value(u.deg) < 1
    # through north: 171 to 176 deg
    assert 170 < standards.get("HD 147283").law.theta.value < 177
    # the two whose angle turns, by the straight line through their bands
    for name, band in (("HD 29647", "J"), ("HD 283809", "H")):
        star = standards.get(name)
        row = star.polarization[star.polarization["band"] == band][0]
        assert abs(star.law.angle(row["wavelength"]) - row["theta"]) < 3 * u.deg
        assert star.law.rotation.value > 5


def test_names_are_forgiven():
    for written, name in [
        ("hd30675", "HD 30675"),
        (" HD_030675 ", "HD 30675"),
        ("HDE 283812", "HD 283812"),
        ("BD+59d389", "HD 236928"),
        ("bd +59 389", "HD 236928"),
        ("VI Cyg 12", "Cyg OB2 No. 12"),
        ("Cyg OB2 #14", "Cyg OB2 No. 14"),
        ("CygOB2_14", "Cyg OB2 No. 14"),
        ("g191b2b", "G191-B2B"),
        ("SA 93-317", "SA93-317"),
        ("Vela1 95", "Vel I No. 95"),
    ]:
        assert standards.get(written).name == name, (written, name)


def test_no_two_stars_share_a_name():
    keys = [_normal(n) for s in map(standards.get, standards.names()) for n in {s.name, *s.aliases}]
    stars = {_normal(s): s for s in standards.names()}
    assert len(stars) == len(standards.names())
    assert len(set(keys)) >= len(stars)


def test_a_star_like_no_other_gets_none():
    for name in ["HD 999", "HR 1", "Vega", "star"]:
        with pytest.raises(ParameterError, match=rf"no standard star '{name}'$"):
            standards.get(name)


def test_unknown_star_gets_a_suggestion():
    with pytest.raises(ParameterError, match=r"'HD 30676'; did you mean HD 30675"):
        standards.get("HD 30676")
    with pytest.raises(ParameterError, match=r"'@@'$"):
        standards.get("@@")


def test_stokes_of_a_polarized_star_is_its_law_with_errors():
    star = standards.get("HD 30675")
    q, stokes_u, covariance = star.stokes([1.25, 1.64] * u.um)
    np.testing.assert_allclose(np.hypot(q, stokes_u), star.law([1.25, 1.64] * u.um).value)
    assert covariance.shape == (2, 2, 2)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_stokes_of_an_unpolarized_star_is_zero_within_its_error():
    q, stokes_u, covariance = standards.get("HD 293396").stokes([1.25, 1.64] * u.um)
    np.testing.assert_array_equal([q, stokes_u], 0)
    np.testing.assert_allclose(covariance, np.broadcast_to(0.0018**2 * np.eye(2), (2, 2, 2)))


def test_stokes_needs_a_wavelength_in_range():
    with pytest.raises(WavelengthRangeError):
        standards.get("HD 30675").stokes(3 * u.um)
    with pytest.raises(ParameterError, match="unit"):
        standards.get("HD 293396").stokes(1.6)


def test_rows_from_memory_are_marked():
    assert standards.get("HD 30675").checked
    assert not standards.get("HD 212311").checked
    assert "from memory" in standards.get("HD 212311").polarization["via"][0]
    for row in POLARIZATION:
        assert row["checked"] != ("from memory" in row["via"])


def test_brightness_falls_back_to_v():
    star = standards.get("HD 30675")
    assert star.brightness("H") == (6.687, "H")
    assert star.brightness("R") == star.brightness() == (7.55, "V")
    assert np.isnan(standards.get("Hiltner 960").brightness("K")[0])


def test_kinds_are_checked():
    assert set(standards.names("polarized")) | set(standards.names("unpolarized")) == set(
        standards.names()
    )
    with pytest.raises(ParameterError, match="kind = 'both'"):
        standards.names("both")


def test_catalogue_cannot_be_changed_from_outside():
    stars, _ = standards.catalogue()
    stars["V"][:] = 0 * u.mag
    assert standards.catalogue()[0]["V"][0] != 0


def test_repr_names_the_star():
    assert repr(standards.get("HD 30675")) == (
        "<StandardStar 'HD 30675', polarized, 04h50m52s +28d18m51s>"
    )
