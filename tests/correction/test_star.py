# Licensed under a 3-clause BSD style license - see LICENSE
"""The polarization of a star, measured or stated, and images without it."""

import dataclasses
import warnings

import astropy.units as u
import numpy as np
import pytest

from astropolcal.correction import Corrected, ScienceFrames, Systematic, correct
from astropolcal.correction.star import star_words
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.stokes import polarization_angle

RING = (8, 10)


@pytest.fixture(scope="module")
def scene_with_star(scene):
    """A disk about a star that is itself polarized, in three wavelengths, and the disk alone."""
    alone = scene(3)
    stokes = alone.copy()
    q, u_ = np.array([0.02, 0.015, 0.01]), np.array([-0.01, -0.02, 0.005])
    stokes[1] += q[:, None, None] * stokes[0]
    stokes[2] += u_[:, None, None] * stokes[0]
    return alone, stokes, q, u_


def corrected(stokes, variance=1.0, systematic=None):
    n, size = len(stokes), stokes.shape[1]
    planes = np.zeros((6, *stokes.shape[1:]))
    planes[[0, 3, 5]] = variance
    return Corrected(
        "IQU",
        np.linspace(1.2, 1.6, size) * u.um,
        stokes,
        planes,
        systematic,
        np.ones(size),
        np.ones((size, n), bool),
        np.zeros((size, n)),
        [""] * size,
        north_up=True,
    )


def test_a_polarized_star_leaves_its_disk(scene_with_star):
    alone, stokes, q, u_ = scene_with_star
    rows, columns = np.indices(stokes.shape[2:]) - 10
    far = np.hypot(rows, columns) > 7.9
    # where nothing but the star shines
    stokes, alone = stokes.copy(), alone.copy()
    alone[1:, :, far] = 0
    stokes[1:, :, far] = np.stack([q, u_])[..., None] * stokes[:1, :, far]
    result = corrected(stokes).without_star(annulus=RING)
    np.testing.assert_allclose(result.stokes, alone, atol=1e-12)
    np.testing.assert_allclose(result.star["q"], q)
    np.testing.assert_allclose(result.star["u"], u_)
    # stated, it is the same light
    stated = corrected(stokes[:, :1]).without_star(
        dolp=np.hypot(q[0], u_[0]), aolp=polarization_angle(q[0], u_[0]) * u.deg
    )
    np.testing.assert_allclose(stated.stokes, alone[:, :1], atol=1e-12)
    assert (result.star.meta["star"], stated.star.meta["star"]) == (
        "annulus of 8 to 10 pixels",
        "stated",
    )


def test_errors_are_those_of_the_scatter(scene_with_star):
    _, stokes, *_ = scene_with_star
    rng, found = np.random.default_rng(3), []
    for _ in range(300):
        noisy = stokes + rng.normal(scale=2.0, size=stokes.shape)
        result = corrected(noisy, 4.0).without_star(annulus=RING)
        found.append(result.stokes[1:, :, 4, 12])
    both = result.covariances("statistical") + result.covariances("systematic")
    expected = np.sqrt(np.array([both[i, i][:, 4, 12] for i in (1, 2)]))
    np.testing.assert_allclose(np.std(found, axis=0), expected, rtol=0.15)
    # the error of the star is the same in all pixels: it does not average out
    share = result.star["q_statistical"]
    np.testing.assert_allclose(
        result.error("Q", "systematic")[:, 4, 12], share * result["I"][:, 4, 12], rtol=1e-6
    )


def test_error_of_a_stated_value_is_along_and_across_it(scene_with_star):
    _, stokes, *_ = scene_with_star
    errors = (0.001, 3 * u.deg)
    result = corrected(stokes).without_star(dolp=2 * u.percent, aolp=0 * u.deg, errors=errors)
    light = result["I"]
    np.testing.assert_allclose(result.error("Q", "systematic"), 0.001 * light)
    np.testing.assert_allclose(result.error("U", "systematic"), 0.04 * np.deg2rad(3) * light)
    known = corrected(stokes).without_star(dolp=2 * u.percent, aolp=0 * u.deg)
    assert not known.error("Q", "systematic").any()
    words = [star_words(one.star) for one in (known, result)]
    assert [one.endswith(", taken as exact") for one in words] == [True, False]
    # one star at all wavelengths
    between = result.systematic.between(light[None, :, 10, 10] * np.array([[1], [0], [0]]))
    assert between[1, 0, 1, 2] == pytest.approx(0.001**2 * light[0, 10, 10] * light[2, 10, 10])


def test_an_offset_of_the_calibration_cancels_with_a_measured_star(scene_with_star):
    _, stokes, *_ = scene_with_star
    factor = np.random.default_rng(1).normal(scale=1e-3, size=(4, 3, 3, 3))
    known = Systematic(factor, np.zeros((3, 3, 3), bool), "linear")
    known.open[1, 1, 0] = True
    one = corrected(stokes, 0.0, known)
    result = one.without_star(annulus=RING)
    # truth that errs by one direction, corrected as if it did not
    for direction in factor:
        moved = stokes + np.einsum("wab,bwyx->awyx", direction, stokes)
        shift = corrected(moved, 0.0).without_star(annulus=RING).stokes - result.stokes
        index = int(np.argmax([np.array_equal(direction, f) for f in factor]))
        expected = np.einsum("wab,bwyx->awyx", result.systematic.factor[index], result.stokes)
        # to first order
        np.testing.assert_allclose(shift[1:], expected[1:], atol=2e-2 * np.abs(shift).max())
    assert np.abs(result.systematic.factor[:4, :, 1:, 0]).max() < 1e-15
    assert np.isfinite(result.error("Q", "systematic")).all()
    # what is stated does not know of it
    stated = one.without_star(dolp=0.02, aolp=0 * u.deg)
    assert np.isinf(stated.error("Q", "systematic")[1]).all()


def test_spectra_take_a_stated_value(scene_with_star):
    _, stokes, *_ = scene_with_star
    spectrum = corrected(stokes).aperture(3.0)
    result = spectrum.without_star(dolp=0.01, aolp=45 * u.deg)
    np.testing.assert_allclose(result.u, spectrum.u - 0.01)
    with pytest.raises(ParameterError, match="needs images"):
        spectrum.without_star(annulus=RING)


def test_what_is_refused_is_one_line(scene_with_star):
    _, stokes, *_ = scene_with_star
    holes, dark, strange = stokes.copy(), stokes.copy(), stokes.copy()
    holes[:, 1, :9] = holes[:, 1, 12:] = np.nan
    dark[0] = 0.0
    strange[1] = 2 * strange[0]
    cases = [
        (stokes, {"annulus": (8, 12)}, ParameterError, "leaves the images of 21 x 21 pixels"),
        (stokes, {"annulus": (8, 8)}, ParameterError, "two radii in pixels are needed"),
        (stokes, {"annulus": "8"}, ParameterError, "two radii in pixels are needed"),
        (holes, {"annulus": RING}, ObservationError, r"of its \d+ pixels have no value at 1.4 um"),
        (dark, {"annulus": RING}, ObservationError, "no light at 1.2 um"),
        (strange, {"annulus": RING}, ObservationError, "polarized by 200 %"),
        (
            stokes,
            {"dolp": 1.2, "aolp": 0 * u.deg},
            ParameterError,
            "120 % at 0 deg; allowed are 0 to",
        ),
        (stokes, {"dolp": np.nan, "aolp": 0 * u.deg}, ParameterError, "allowed are 0 to 100 %"),
        (
            stokes,
            {"dolp": 0.1, "aolp": 0 * u.deg, "errors": (-1, 0 * u.deg)},
            ParameterError,
            "0 and above",
        ),
        (stokes, {"dolp": 0.1, "aolp": 4.0}, ParameterError, "needs a unit"),
        *(
            (stokes, {"dolp": 0.1, "aolp": 4 * u.deg} | given, ParameterError, words)
            for given, words in (
                ({"dolp": [0.1, 0.2]}, r"has shape \(2,\); .* must be single numbers"),
                ({"aolp": [4, 5, 6] * u.deg}, r"has shape \(3,\); .* must be single numbers"),
                ({"errors": ([0.1], 1 * u.deg)}, r"has shape \(1,\); .* must be single numbers"),
                ({"errors": 0.1}, "errors = 0.1; two are needed"),
            )
        ),
        (stokes, {}, ParameterError, "either annulus, or dolp"),
        (stokes, {"dolp": 0.1}, ParameterError, "either annulus, or dolp"),
        (stokes, {"dolp": 0.1, "annulus": RING}, ParameterError, "either annulus, or dolp"),
    ]
    for data, options, error, message in cases:
        with pytest.raises(error, match=message) as caught:
            corrected(data).without_star(**options)
        assert "\n" not in str(caught.value), options
    once = corrected(stokes).without_star(annulus=RING)
    with pytest.raises(ParameterError, match="subtracted already: annulus of 8 to 10"):
        once.without_star(annulus=RING)


def test_a_wavelength_without_values_stays_without(scene_with_star):
    _, stokes, *_ = scene_with_star
    stokes = stokes.copy()
    stokes[:, 1] = np.nan
    result = corrected(stokes).without_star(annulus=RING)
    assert np.isnan(result.stokes[:, 1]).all()
    assert np.isfinite(result.stokes[:, [0, 2]]).all()
    assert np.isnan(result.star["q"][1])


def test_a_v_that_is_not_determined_leaves_the_other_errors(scene_with_star):
    _, stokes, *_ = scene_with_star
    three = corrected(stokes)
    known = three.covariance
    # II, IQ, IU, IV, QQ, QU, QV, UU, UV, VV
    planes = np.full((10, *known.shape[1:]), np.nan)
    planes[[0, 1, 2, 4, 5, 7]] = known
    four = dataclasses.replace(
        three,
        components="IQUV",
        stokes=np.concatenate([stokes, np.full_like(stokes[:1], np.nan)]),
        covariance=planes,
        leakage=np.zeros((3, 4)),
        determined=np.tile([True, True, True, False], (3, 1)),
    )
    expected, found = (one.without_star(annulus=RING) for one in (three, four))
    for component in "IQU":
        np.testing.assert_allclose(found.error(component), expected.error(component))
    assert np.isnan(found.error("V")).all()


def test_the_product_says_what_was_subtracted(scene_with_star, tmp_path):
    _, stokes, *_ = scene_with_star
    result = corrected(stokes).without_star(annulus=RING)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        result.write(tmp_path / "s.fits")
        again = Corrected.read(tmp_path / "s.fits")
    assert again.star.meta == result.star.meta
    for name in result.star.colnames:
        np.testing.assert_array_equal(again.star[name], result.star[name])
    np.testing.assert_array_equal(again.covariances("systematic"), result.covariances("systematic"))


def test_it_is_measured_after_the_correction(sky, charis, track, seen, scene_with_star):
    """Before it, star and instrument polarize together, and the field turns between frames."""
    alone, stokes, q, _ = scene_with_star
    hwp, positions = track()
    lam = charis.wavelength
    both = np.repeat(stokes[:, :1], len(lam), axis=1)
    right, left = seen(sky, positions, lam, both)
    frames = ScienceFrames.from_arrays(right, left, lam, positions, hwp=hwp)
    result = correct(sky, frames).without_star(annulus=(0, 2))
    np.testing.assert_allclose(result.star["q"], q[0], atol=2e-4)
    np.testing.assert_allclose(result["Q"][0], alone[1, 0], atol=0.02)
