# Licensed under a 3-clause BSD style license - see LICENSE
"""One statement: what a calibration says of a target, and what `correct` claims for that target."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest

from astropolcal.calibration import target_accuracies
from astropolcal.calibration.identifiability.sky import view_of_calibration
from astropolcal.correction import ScienceFrames, correct
from astropolcal.correction.rows import RowModel
from astropolcal.correction.solve import estimator
from astropolcal.correction.systematic import linear_systematic, sampled_systematic
from astropolcal.exceptions import ParameterError

LACKING = {"wavelength_nm": [1100.0, 2400.0], "relative_percent": [0.2, 0.4],
           "absolute_percent": [0.03, 0.01]}  # fmt: skip


def with_model_error(calibration, known):
    return replace(calibration, fit=calibration.fit | {"model_error": known})


def claims(calibration, seen, dolp, aolp, **options):
    """Errors that `correct` claims for simulated frames of each setting, (4, n_settings, 22)."""
    view, lam, found = view_of_calibration(calibration), calibration.wavelength, []
    stokes = np.array([1e5, *(1e5 * dolp * f(2 * aolp) for f in (np.cos, np.sin))])
    hwp = [0, 45, 22.5, 67.5] * u.deg
    for i in range(view.good.shape[1]):
        positions = {k: v[4 * i : 4 * i + 4] * u.rad for k, v in view.placed.items()}
        fluxes = seen(calibration, positions, lam, np.tile(stokes[:, None], 22))
        frames = ScienceFrames.from_arrays(*fluxes, lam, positions, hwp=hwp)
        result = correct(calibration, frames, any_date=True, **options)
        assert result.observable == "double"
        one, both = result.fractional_errors("systematic"), result.polarization()
        keys = "s_p_systematic", "s_chi_systematic"
        found.append([one["q"], one["u"], *(both[key] for key in keys)])
    return np.moveaxis(found, 0, 1), view.good.T


def check(calibration, seen, dolp, aolp, choice="infinite"):
    each, good = claims(calibration, seen, dolp, np.deg2rad(aolp), open_directions=choice)
    # a setting that determines nothing is left out by both
    assert good.mean() > 0.9
    rms = np.sqrt(np.sum(np.where(good, each, 0) ** 2, axis=1) / good.sum(axis=0))
    (table,) = target_accuracies(calibration, [(dolp, aolp * u.deg)], open_directions=choice)
    columns = [table[key].to_value(u.one) for key in ("s_Q", "s_U", "s_p")]
    np.testing.assert_allclose(columns, rms[:3], rtol=1e-3)
    np.testing.assert_allclose(table["s_chi"].to_value(u.deg), rms[3], rtol=1e-3)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore:poorly determined at 1 of 22 wavelengths")
def test_correct_claims_what_the_calibration_says(calibration, seen):
    for known in [None, LACKING]:
        for dolp in [0.3, 0.01, 0.001]:
            calibration = with_model_error(calibration, known)
            for aolp in (0.0, 35.0):
                check(calibration, seen, dolp, aolp)


@pytest.mark.filterwarnings("ignore:poorly determined at 1 of 22 wavelengths")
def test_what_is_open_may_be_ignored_by_both(open_calibration, seen):
    check(open_calibration, seen, 0.01, 20.0, "ignore")
    (table,) = target_accuracies(open_calibration, [(0.01, None)])
    assert np.isinf(table["s_Q"]).all()
    with pytest.raises(ParameterError, match="open_directions = 2; allowed are infinite, ignore"):
        target_accuracies(open_calibration, open_directions=2)


def test_model_error_adds_in_squares(calibration, track):
    """q and u err by a share of each and by one of the intensity, interpolated in wavelength."""
    for make in [linear_systematic, sampled_systematic]:
        options = {"n_samples": 20, "seed": 1} if make is sampled_systematic else {}
        errors = []
        for known in (None, LACKING):
            model = RowModel(
                with_model_error(calibration, known), track()[1], calibration.wavelength
            )
            solution = estimator(model.rows())
            errors.append(
                [make(model, solution, **options), make(model, solution, mode="ip", **options)]
            )
        nm = calibration.wavelength.to_value(u.nm)
        rel, absolute = (
            np.interp(nm, LACKING["wavelength_nm"], LACKING[f"{key}_percent"]) / 100
            for key in ("relative", "absolute")
        )
        q, u_ = 0.3, -0.1
        for w in (0, 10, 21):
            for k, share in enumerate(
                (rel[w] ** 2 * (q**2 + u_**2) + absolute[w] ** 2, absolute[w] ** 2)
            ):
                without, with_it = (one[k].covariance([2.0, 2 * q, 2 * u_], w) for one in errors)
                # of offsets only the intensity counts
                np.testing.assert_allclose(
                    with_it - without, np.diag([0, 4 * share, 4 * share]), atol=1e-12
                )
