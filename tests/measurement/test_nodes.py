# Licensed under a 3-clause BSD style license - see LICENSE
"""Positions of stars, exposures of several nodes, and priors of several values."""

import astropy.units as u
import numpy as np
import pytest
from scipy.stats import norm
from star_data import CHARIS, observe_star, star_chain

from astropolcal import optics
from astropolcal.chain import leaves
from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.measurement import Measurement, Normal
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.observations import Observations
from astropolcal.observations.pointings import sky_positions


def truth(**options):
    chain = star_chain(**options)
    chain["m3"].diattenuation = [0.017, 0.014, 0.012]
    chain["derotator"].diagonal = [-5, -4, -3] * u.deg
    return chain


# --- default positions ----------------------------------------------------------------------------


def test_star_is_predicted_with_the_tracking_law_by_itself():
    chain = truth()
    star = observe_star(chain, noise=False)
    assert np.abs(Measurement(chain, star).residuals()).max() < 1e-12


def test_without_the_tracking_law_it_would_not_be():
    chain = truth()
    star = observe_star(chain, noise=False)
    commanded = {s: star.position(s) for s in ("hwp", "derotator", "parallactic", "altitude")}
    residuals = Measurement(chain, star, positions=[commanded]).residuals()
    assert np.abs(residuals).max() > 5e-3


def test_table_of_an_unknown_instrument_is_read_as_it_is():
    table = observe_star(truth(), noise=False).to_table()
    table.meta["instrument"] = "home-made"
    star = Observations.from_table(table)
    part = Measurement(truth(), star).datasets[0]
    np.testing.assert_allclose(part.positions["hwp"], star.position("hwp")[part.frames.T])


# --- nodes ----------------------------------------------------------------------------------------


def test_exposure_is_the_mean_of_its_moments():
    """Many short frames, averaged, against three nodes of one long exposure."""
    chain = truth(source="star")
    first = next(leaf for leaf in leaves(chain) if leaf.name == "star")
    first.q, first.u = [0.02] * 3, [-0.01] * 3
    star = observe_star(chain, 4, parallactic=(-60, 60), noise=False)
    rough = sky_positions(star, nodes=3, duty=0.9)
    fine = sky_positions(star, nodes=24, duty=0.9)
    found = [Measurement(chain, star, positions=[p]) for p in (rough, fine)]
    at = found[0].vector()
    a, b = (m.predict(at).copy() for m in found)
    point = Measurement(chain, star).predict(at)
    assert np.abs(a - b).max() < 1e-9
    assert np.abs(point - b).max() > 1e-7


def test_one_node_changes_nothing():
    chain, star = truth(), observe_star(truth(), noise=False)
    one = {s: np.atleast_2d(a) for s, a in sky_positions(star).items()}
    both = [Measurement(chain, star, positions=[p]) for p in (one, None)]
    np.testing.assert_array_equal(*(m.predict(m.vector()).copy() for m in both))


def test_derivatives_of_exposures():
    chain, star = truth(source="star"), observe_star(truth(), 5, noise=False)
    positions = CHARIS.positions(star, chain, nodes=3, duty=1.0)
    measurement = Measurement(chain, star, positions=[positions])
    vector, step = measurement.vector(), 1e-6
    jacobian = measurement.jacobian(vector).copy()
    for k in range(vector.size):
        ends = [measurement.predict(vector + s * step * (np.arange(vector.size) == k)).copy()
                for s in (1, -1)]  # fmt: skip
        np.testing.assert_allclose(jacobian[k], (ends[0] - ends[1]) / (2 * step), atol=1e-7)


def test_positions_of_an_exposure_are_its_middle():
    chain, star = truth(), observe_star(truth(), noise=False)
    positions = CHARIS.positions(star, chain, nodes=4, duty=1.0)
    smeared, sharp = (
        Measurement(chain, star, positions=[p]).datasets[0].positions for p in (positions, None)
    )
    np.testing.assert_allclose(smeared["parallactic"], sharp["parallactic"], atol=1e-12)


def test_nodes_that_differ_are_an_error():
    chain, star = truth(), observe_star(truth(), noise=False)
    positions = sky_positions(star, nodes=3, duty=1.0)
    positions["hwp"] = positions["hwp"][:2]
    with pytest.raises(ObservationError, match="star: the stages have different numbers of nodes"):
        Measurement(chain, star, positions=[positions])


# --- priors, one value a wavelength ---------------------------------------------------------------


def test_prior_of_several_values():
    for prior in [
        Normal([0.01, 0.02] * u.one, [0.001, 0.002] * u.one),
        norm([0.01, 0.02], [0.001, 0.002]),
    ]:
        star = optics.PolarizedSource(q=[0.0, 0.0], u=[0.0, 0.0], name="star")
        star.q.prior = prior
        free = FreeParameters([star], 2)
        vector = np.array([0.011, 0.016, 0.0, 0.0])
        np.testing.assert_allclose(free.prior_residuals(vector), [1.0, -2.0])
        jacobian = free.prior_jacobian(vector)
        np.testing.assert_allclose(jacobian[:2], np.diag([1000.0, 500.0]))


def test_prior_of_another_number_of_values_is_an_error():
    star = optics.PolarizedSource(q=[0.0, 0.0], u=[0.0, 0.0], name="star")
    star.q.prior = Normal([0.01, 0.02, 0.03] * u.one, 0.001)
    with pytest.raises(ParameterError, match=r"prior of star.q has 3 values; allowed are 1 or 2"):
        FreeParameters([star], 2)


def test_prior_beyond_the_bounds_names_the_value():
    star = optics.PolarizedSource(q=[0.0, 0.0], u=[0.0, 0.0], name="star")
    star.q.prior = Normal([0.01, 0.9] * u.one, 0.001)
    with pytest.raises(ParameterError, match=r"prior of star.q peaks at 0.9"):
        FreeParameters([star], 2)


def test_prior_without_width_is_an_error():
    star = optics.PolarizedSource(q=[0.0, 0.0], u=[0.0, 0.0], name="star")
    star.q.prior = Normal([0.01, 0.02] * u.one, [0.001, 0.0] * u.one)
    with pytest.raises(ParameterError, match="needs a positive std"):
        FreeParameters([star], 2)
