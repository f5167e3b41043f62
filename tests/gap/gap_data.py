# Licensed under a 3-clause BSD style license - see LICENSE
"""Small data with a known gap, for the tests of the diagnosis."""

from functools import cache

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.gap.effects import Context, get_effect
from astropolcal.gap.model import Model
from astropolcal.gap.problem import OPEN, TOUCHES, GapProblem
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1170, 1300, 1450, 1620, 1800, 2000, 2200] * u.nm
DEROTATOR = [45, 70, 95, 120] * u.deg


def chain(wavelength=WAVELENGTH):
    return instruments.get("charis").chain(wavelength=wavelength, derotator="linear")


def frames():
    return half_wave_plate_cycles(derotator=DEROTATOR)


def observed(true=None, *, seed=1, flux=1e6, table=None, wavelength=WAVELENGTH, **options):
    true = chain(wavelength) if true is None else true
    table = frames() if table is None else table
    options = {"name": "lamp"} | options
    return simulate(true, wavelength, table, flux=flux, seed=seed, **options)


def with_effect(name, **values):
    """Return the chain with an effect of a certain size."""
    edit = get_effect(name).edit([chain()], Context(WAVELENGTH.to_value(u.um)))
    names = [parameter.name.split(".") for parameter in edit.parameters]
    assert set(values) <= {key for _, key in names}, names
    for optic, key in names:
        target = getattr(edit.chains[0][optic], key)
        target.value = np.full(np.shape(target.value), values.get(key, 0.0))
    return edit.chains[0]


def with_flux(observations, factor):
    """Return the observations with the right beam multiplied, one factor a frame."""
    table = observations.to_table()
    grown = np.repeat(factor, observations.n_bins)
    table["flux_right"] = table["flux_right"] * grown
    return Observations.from_table(table, name=observations.name)


def fitted(observations, chains=None):
    """Return the nominal model of data; the chains start at the truth, no calibration is needed."""
    observations = observations if isinstance(observations, list) else [observations]
    problem = GapProblem(chains or [chain()] * len(observations), observations)
    problem.settle_noise()
    fit = problem.fit()
    problem.settle_noise(fit.coefficients)
    return Model(problem, problem.fit(fit.coefficients))


@cache
def clean_model(seed=1):
    return fitted(observed(seed=seed))


def errors(problem, coefficients):
    """Return the standard errors of the coefficients, infinite where they are open."""
    singular, right, scale = problem.decomposed(coefficients)
    good = singular > OPEN * singular[0]
    half, null = right[good] / singular[good, None] / scale, right[~good]
    is_open = np.sum(null**2, axis=0) > TOUCHES**2
    prior = np.divide(1, problem.tight, out=np.full(problem.size, np.inf), where=problem.tight > 0)
    return np.minimum(np.where(is_open, np.inf, np.linalg.norm(half, axis=0)), prior)


def effect_basis(model, effect, nominal):
    """Return an orthonormal basis of what an effect adds to a model, where half its limit shows."""
    edit = effect.edit(model.held_chains, model.context)
    names = {p.name for p in edit.parameters}
    ties = {name: tie for name, tie in edit.ties.items() if tie.source in names}
    problem = GapProblem(
        edit.chains, model.observations, ties=ties, laws=edit.laws, like=model.problem
    )
    slopes = problem.jacobian(problem.start)
    for name, where in problem.slices.items():
        slopes[:, where] *= edit.priors[name]
    left = slopes - nominal @ (nominal.T @ slopes)
    left -= nominal @ (nominal.T @ left)
    basis, singular, _ = np.linalg.svd(left, full_matrices=False)
    return basis[:, singular > max(1.0, 1e-6 * np.linalg.norm(slopes, axis=0).max(initial=0.0))]
