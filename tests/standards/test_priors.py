# Licensed under a 3-clause BSD style license - see LICENSE
"""How well a star is known: complete, calibrated, and said."""

import dataclasses

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.table import QTable

from astropolcal import standards
from astropolcal.exceptions import ParameterError
from astropolcal.standards import SerkowskiLaw, StandardStar, whittet_width
from astropolcal.standards.priors import turning

PARAMETERS = {"p_max", "lambda_max", "K", "theta", "rotation"}
POLARIZED = [standards.get(name) for name in standards.names("polarized")]
UNPOLARIZED = [standards.get(name) for name in standards.names("unpolarized")]
WHITTET = [star for star in POLARIZED if star.law_reference == "Whittet et al. 1992"]
BANDS = {"U": 0.36, "B": 0.44, "V": 0.55, "R": 0.65, "I": 0.8, "J": 1.25, "H": 1.65, "K": 2.2}


def _star(rows, kind="polarized", **options):
    """A star with rows of band, p, p_err (percent), theta, theta_err (degree)."""
    band, p, p_err, theta, theta_err = zip(*rows, strict=True) if rows else ((),) * 5
    table = QTable(
        {
            "band": np.array(band, dtype="U8"),
            "wavelength": [BANDS.get(b, 0.55) for b in band] * u.um,
            "p": np.array(p, dtype=float) * u.percent,
            "p_err": np.array(p_err, dtype=float) * u.percent,
            "theta": np.array(theta, dtype=float) * u.deg,
            "theta_err": np.array(theta_err, dtype=float) * u.deg,
            "reference": np.array(["Nobody 1900"] * len(band), dtype="U16"),
            "checked": np.ones(len(band), dtype=bool),
        }
    )
    place = SkyCoord(30 * u.deg, 10 * u.deg)
    return StandardStar("made up", kind, place, 1 * u.arcsec, {}, table, **options)


def _number(value):
    return float(getattr(value, "value", value))


def _pulls(star, table):
    """How far degrees and angles are from the star's law, in their errors together."""
    law = star.interstellar().law
    q, stokes_u, covariance = star.stokes(table["wavelength"])
    degree = np.hypot(q, stokes_u)
    along = np.stack([q, stokes_u], -1) / degree[:, None]
    across = np.stack([-along[:, 1], along[:, 0]], -1)
    radial, turned = (np.sqrt(np.einsum("ni,nij,nj->n", a, covariance, a)) for a in (along, across))
    one = u.dimensionless_unscaled
    error = np.hypot(radial, table["p_err"].to_value(one))
    off = table["theta"].to_value(u.deg) - law.angle(table["wavelength"]).to_value(u.deg)
    angle_error = np.hypot(np.rad2deg(turned / 2 / degree), table["theta_err"].to_value(u.deg))
    return (table["p"].to_value(one) - degree) / error, ((off + 90) % 180 - 90) / angle_error


# --- every star of the catalogue ---------------------------------------------------------


def test_every_polarized_star_has_five_errors_and_says_what_is_assumed():
    for star in POLARIZED:
        known = star.interstellar()
        assert set(known.errors) == PARAMETERS
        for name, error in known.errors.items():
            assert 0 < _number(error) < np.inf, (star.name, name)
        # errors are the diagonal of the covariance, in the units of the law
        scale = [0.01 if name == "p_max" else 1 for name in known.errors]
        errors = np.array([_number(error) for error in known.errors.values()]) * scale
        np.testing.assert_allclose(np.sqrt(np.diag(known.covariance)), errors, rtol=1e-9)
        assert np.all(np.linalg.eigvalsh(known.covariance / np.outer(errors, errors)) > 0)
        # a number of the assumption, or no assumption
        assert all(any(c.isdigit() for c in words) for words in known.assumed), star.name
        assert star.law is None or known.source.startswith(star.law_reference)
        if not star.law_errors:
            assert set(star.polarization["reference"]) <= set(_references(known.source)), star.name
        _, _, covariance = star.stokes([0.55, 1.25, 1.65, 2.2] * u.um)
        assert np.all(np.linalg.eigvalsh(covariance) > 0), star.name


def _references(source):
    return {part.rsplit(" (", 1)[0] for part in source.split("; ")}


def test_what_is_published_is_left_as_it_is():
    for star in WHITTET:
        known = star.interstellar()
        assert known.source == "Whittet et al. 1992"
        np.testing.assert_allclose(known.law.parameters, star.law.parameters, rtol=1e-12)
        for name in PARAMETERS:
            np.testing.assert_allclose(_number(known.errors[name]), _number(star.law_errors[name]))


def test_every_unpolarized_star_has_an_error_and_says_where_from():
    for star in UNPOLARIZED:
        value, words = star.unpolarized_error()
        assert 1e-4 <= value <= 1e-2, star.name
        assert str(star.polarization["reference"][0]) in words
        assert ("assumed" in words) == (not np.any(np.isfinite(star.polarization["p_err"])))
        q, stokes_u, covariance = star.stokes([1.25, 2.2] * u.um)
        np.testing.assert_array_equal([q, stokes_u], 0)
        np.testing.assert_allclose(covariance, [value**2 * np.eye(2)] * 2)


def test_hd30675_in_j_h_and_k():
    """Whittet et al. (1992): 1.90 +- 0.09, 1.10 +- 0.08 and 0.74 +- 0.12 %."""
    star = standards.get("HD 30675")
    rows = star.polarization[5:]
    np.testing.assert_allclose(rows["p"].value, [1.90, 1.10, 0.74])
    degree, angle = _pulls(star, rows)
    assert np.all(np.abs(degree) < 1)
    assert np.all(np.abs(angle) < 1.5)


def test_errors_are_those_of_the_measurements():
    """To these the laws were fitted: at least 68 % are within the errors of law and band."""
    together, infrared = [], []
    for star in POLARIZED:
        table = star.polarization[np.isfinite(star.polarization["theta_err"])]
        if len(table):
            together.append(_pulls(star, table))
            infrared.append(together[-1][0][table["wavelength"] > 1 * u.um])
    degree, angle = map(np.concatenate, zip(*together, strict=True))
    assert degree.size > 700
    for pulls in (degree, angle):
        assert np.mean(np.abs(pulls) < 1) > 0.68
        assert 0.8 < np.std(pulls) < 1.05
    # J, H and K are known as well as they were measured, neither better nor worse
    infrared = np.concatenate(infrared)
    assert infrared.size > 250
    assert 0.9 < np.std(infrared) < 1.15


@pytest.mark.slow
def test_errors_are_right_where_nothing_was_measured():
    """
    J, H and K held out: the law of the medium through what is optical.

    Behind ordinary dust, where a standard usually is, the pulls have a width of 1; the
    errors are too small for stars in dark clouds, whose lambda_max is up to 0.9 um.
    """
    for bands in ["V", "R", "BVRI"]:
        every, ordinary, angles = [], [], []
        for star in WHITTET:
            table = star.polarization[star.polarization["reference"] == star.law_reference]
            kept = np.isin(table["band"], list(bands))
            out = np.isin(table["band"], ["J", "H", "K"])
            if not np.any(kept):
                continue
            blind = dataclasses.replace(star, polarization=table[kept], law=None, law_errors={})
            degree, angle = _pulls(blind, table[out])
            every.append(degree)
            angles.append(angle)
            if 0.42 < star.law.lambda_max.value < 0.68:
                ordinary.append(degree)
        every, ordinary, angles = map(np.concatenate, (every, ordinary, angles))
        assert 0.9 < np.std(ordinary) < 1.15, bands
        assert 0.63 < np.mean(np.abs(ordinary) < 1) < 0.73, bands
        assert np.std(every) < 2.2, bands
        assert 0.63 < np.mean(np.abs(angles) < 1) < 0.85, bands


def test_the_table_of_the_page():
    """Median error of the degree in J, H and K, by what is measured."""
    found = {}
    for star in POLARIZED:
        many = len(set(star.polarization["band"])) > 2
        group = "published" if star.law_errors else "three" if many else "one or two"
        q, stokes_u, covariance = star.stokes([1.25, 1.65, 2.2] * u.um)
        degree = np.hypot(q, stokes_u)
        along = np.stack([q, stokes_u], -1) / degree[:, None]
        variance = np.einsum("ni,nij,nj->n", along, covariance, along)
        found.setdefault(group, []).append(100 * np.sqrt(variance) / degree)
    assert {group: len(rows) for group, rows in found.items()} == {
        "published": 94, "three": 11, "one or two": 41
    }  # fmt: skip
    expected = {"published": (3, 5, 12), "three": (5, 10, 18), "one or two": (15, 18, 24)}
    for group, rows in found.items():
        np.testing.assert_allclose(np.median(rows, axis=0), expected[group], atol=0.6)


def test_variable_stars_are_less_certain():
    for name, degree, angle in (("HD 183143", 0.3, 1), ("HD 198478", 0.3, 1), ("HD 80558", 0, 0.8)):
        star = standards.get(name)
        known = star.interstellar()
        assert known.errors["p_max"] >= degree * u.percent
        assert known.errors["theta"] >= angle * u.deg
        assert any("varies" in words for words in known.assumed)
        steady = dataclasses.replace(star, variability={}).interstellar()
        assert steady.errors["p_max"] < known.errors["p_max"]
        assert not any("varies" in words for words in steady.assumed)


# --- stars made up -----------------------------------------------------------------------


def test_zero_is_as_uncertain_as_it_was_measured():
    for rows, percent in [
        # the larger of sigma and p / sqrt 2
        ([("V", 0.0, 0.18)], 0.18),
        ([("V", 0.2, 0.2)], 0.2),
        ([("V", 0.2, 0.02)], 0.2 / np.sqrt(2)),
        # no less than 0.01 %, and 0.1 % where nobody states an error
        ([("V", 0.002, 0.001)], 0.01),
        ([("V", 0.002, np.nan)], 0.1),
        ([("V", 0.5, np.nan)], 0.5 / np.sqrt(2)),
        # who states an error counts, however small the number of another is
        ([("V", 0.0, 0.05), ("V", 0.001, np.nan)], 0.05),
        # the certain one decides over the uncertain one
        ([("B", 0.3, 0.3), ("V", 0.0, 0.02)], 0.02),
        # two of the same: nothing is gained, because systematic errors do not average
        ([("B", 0.04, 0.04), ("V", 0.04, 0.04)], 0.04),
    ]:
        star = _star([(*row, np.nan, np.nan) for row in rows], kind="unpolarized")
        assert star.unpolarized_error().value == pytest.approx(percent / 100, rel=0.02), (
            rows,
            percent,
        )


def test_zero_covers_the_true_polarization():
    """Stars of 0 to 0.1 % measured to 0.05 % in q and u: 68 % of q and u are within the error."""
    rng = np.random.default_rng(1)
    inside = []
    for true in rng.normal(0, 0.05, (300, 2)):
        measured = np.hypot(*(true + rng.normal(0, 0.05, 2)))
        star = _star([("V", measured, 0.05, np.nan, np.nan)], kind="unpolarized")
        inside.extend(np.abs(true) < 100 * star.unpolarized_error().value)
    assert 0.68 < np.mean(inside) < 0.9


def test_the_law_goes_through_the_measurements():
    law = SerkowskiLaw(p_max=0.05, lambda_max=0.6 * u.um, theta=40 * u.deg)
    degree = law(list(BANDS.values()) * u.um).to_value(u.percent)
    rows = [(b, p, 0.01, 40, 0.1) for b, p in zip(BANDS, degree, strict=True)]
    for bands in ("UBVRIJHK", "BVRI"):
        known = _star([row for row in rows if row[0] in bands]).interstellar()
        assert known.law.lambda_max.value == pytest.approx(0.6, abs=0.01)
        assert known.law.K.value == pytest.approx(law.K.value, abs=0.02)
        assert known.law.p_max.value == pytest.approx(0.05, abs=3e-4)
        assert known.law.theta.value == pytest.approx(40, abs=1e-6)
        assert known.errors["rotation"] < 1 * u.deg / u.um
        assert not any(words.startswith("rotation") for words in known.assumed)


def test_one_band_gets_the_law_of_the_medium():
    known = _star([("R", 4.0, 0.02, 30, 0.2)]).interstellar()
    assert known.law.lambda_max.value == pytest.approx(0.545, abs=0.001)
    assert known.law.K.value == pytest.approx(whittet_width(0.545 * u.um), abs=0.01)
    assert known.law(0.65 * u.um).to_value(u.percent) == pytest.approx(4.0, abs=0.01)
    assert known.errors["lambda_max"].to_value(u.um) == pytest.approx(0.08, abs=0.001)
    # that of the relation, and what the relation takes over from lambda_max: the two
    # go together, and the degree in H is known better than they are as independent errors
    assert known.errors["K"] == pytest.approx(np.hypot(0.1, 1.66 * 0.08), abs=0.003)
    assert known.covariance[1, 2] > 0.7 * np.sqrt(known.covariance[1, 1] * known.covariance[2, 2])
    together, apart = (
        np.trace(known.law.stokes(1.65 * u.um, errors).covariance)
        for errors in (known.covariance, known.errors | {"theta": 0 * u.deg})
    )
    assert together < 0.5 * apart
    assert known.errors["rotation"].value == pytest.approx(3)
    assert known.errors["theta"].to_value(u.deg) == pytest.approx(0.6, abs=0.1)
    text = " ".join(known.assumed)
    for words in ("0.545 +- 0.08 um", "0.01 + 1.66 lambda_max", "0 +- 3 deg/um", "0.5 deg"):
        assert words in text
    assert known.source == "Nobody 1900 (R)"


def test_what_a_source_does_not_say_is_assumed_and_said():
    for rows, words in (
        ([("V", 4.0, np.nan, 30, 1)], "Nobody 1900 states no error; 0.1 %"),
        ([("optical", 4.0, 0.01, 30, 1)], "+- 5 % of it where the source names no band"),
    ):
        known = _star(rows).interstellar()
        assert any(words in sentence for sentence in known.assumed)
        assert known.errors["p_max"] > 0.09 * u.percent
    law = SerkowskiLaw(p_max=0.04, lambda_max=0.5 * u.um, K=1.15, theta=30 * u.deg)
    known = _star([], law=law, law_reference="Somebody 1899").interstellar()
    assert known.source == "Somebody 1899"
    assert known.errors["p_max"].to_value(u.percent) == pytest.approx(0.1)
    assert known.errors["lambda_max"].to_value(u.um) == pytest.approx(0.02, rel=0.01)
    # a width without an error is a convention
    assert known.law.K.value == pytest.approx(whittet_width(0.5 * u.um), abs=1e-3)
    text = " ".join(known.assumed)
    for words in ("0.1 % and 0.02 um", "1 deg is assumed"):
        assert words in text


def test_sources_that_disagree_leave_their_difference():
    one = _star([("V", 4.0, 0.01, 30, 0.1)]).interstellar()
    two = _star([("V", 4.0, 0.01, 30, 0.1), ("V", 4.2, 0.01, 34, 0.1)]).interstellar()
    assert two.law.p_max.value == pytest.approx(0.041, rel=1e-3)
    assert one.errors["p_max"] < 0.03 * u.percent < 0.09 * u.percent < two.errors["p_max"]
    assert two.errors["theta"] > 2 * u.deg > 1 * u.deg > one.errors["theta"]


def test_an_angle_without_error_has_that_of_the_degree():
    for p_err in (0.05, 0.4):
        known = _star([("V", 4.0, p_err, 30, np.nan)]).interstellar()
        assert known.errors["theta"].to_value(u.deg) == pytest.approx(
            np.hypot(np.rad2deg(p_err / 4 / 2), 0.5), rel=0.01
        )


def test_what_a_star_says_cannot_be_changed_from_outside():
    star = standards.get("HD 30675")
    known = star.interstellar()
    known.law.p_max, known.errors["K"] = 0.5, 7.0
    known.covariance[:] = 0
    again = star.interstellar()
    assert again.law.p_max.value == pytest.approx(0.039)
    assert again.errors["K"] == pytest.approx(0.05)
    assert np.all(np.linalg.eigvalsh(star.stokes(1.6 * u.um).covariance) > 0)


def test_kinds_are_not_mixed_up():
    with pytest.raises(ParameterError, match=r"HD 293396 is unpolarized; ask for unpolarized_err"):
        standards.get("HD 293396").interstellar()
    with pytest.raises(ParameterError, match=r"HD 30675 is polarized; ask for interstellar\(\)"):
        standards.get("HD 30675").unpolarized_error()
    for rows in ([], [("V", 4.0, 0.1, np.nan, np.nan)]):
        with pytest.raises(ParameterError, match="made up has neither a law nor a measurement"):
            _star(rows).stokes(1 * u.um)


# --- the angle ---------------------------------------------------------------------------


def test_angles_turn_along_a_straight_line():
    x = np.array([0.44, 0.55, 0.65, 0.8, 1.25, 1.65])
    for start in (58.0, 179.0, 0.5):
        theta = np.mod(start + 8 * (x - 0.6), 180)
        (at, turn), covariance, words = turning(x, theta, np.full(6, 0.5), 0.6)
        assert abs((at - start + 90) % 180 - 90) < 1e-6
        assert turn == pytest.approx(8)
        assert words == []
        assert 0.5 < np.sqrt(covariance[0, 0]) < 0.7
        assert covariance[1, 1] < 1


def test_few_or_uncertain_bands_do_not_turn():
    x = np.array([0.44, 0.65, 0.8])
    for n, error in ((1, 0.1), (2, 0.1), (3, 3.0)):
        theta = np.array([20.0, 21.0, 22.0])[:n]
        (at, turn), covariance, words = turning(x[:n], theta, np.full(n, error), 0.55)
        assert turn == 0
        assert covariance[1, 1] == pytest.approx(9)
        assert at == pytest.approx(theta.mean(), abs=1e-6)
        assert len(words) == 1
        # where it was measured the angle is known without the rotation
        away = np.array([1, x[:n].mean() - 0.55])
        least = 0.5**2 + max(error**2 / n, np.var(theta) / max(n - 1, 1))
        assert away @ covariance @ away == pytest.approx(least, rel=0.05)
    # on both sides of north the mean is north
    (at, _), _, _ = turning(x[:2], np.array([179.0, 1.0]), np.ones(2), 0.55)
    assert min(at, 180 - at) < 1e-9


def test_errors_of_the_line_are_no_smaller_than_its_scatter():
    x, rng = np.linspace(0.4, 2, 40), np.random.default_rng(3)
    theta = 50 + rng.normal(0, 2, 40)
    _, covariance, _ = turning(x, theta, np.full(40, 0.1), 1.2)
    error = np.sqrt(np.diag(covariance))
    assert error[0] == pytest.approx(np.hypot(2 / np.sqrt(40), 0.5), rel=0.2)
    assert error[1] == pytest.approx(2 / np.sqrt(40) / x.std(), rel=0.3)
