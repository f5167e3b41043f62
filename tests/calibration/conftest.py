# Licensed under a 3-clause BSD style license - see LICENSE
"""A CHARIS-like truth, away from all bounds, and what it measures."""

from functools import cache

import astropy.units as u
import numpy as np
import pytest

from astropolcal import instruments
from astropolcal.calibration import calibrate
from astropolcal.measurement import Measurement
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
DEROTATOR = np.linspace(45, 132.5, 8) * u.deg
LAM = [1.2, 1.6, 2.2] * u.um


def charis_chain(kind="linear", *, fixed=True, wavelength=None, **options):
    """The chain where a fit starts; the two gauge angles fixed or free."""
    chain = CHARIS.chain(derotator=kind, wavelength=wavelength, **options)
    for name in ("hwp", "derotator"):
        chain[name].theta.fixed = fixed
    return chain


def charis_truth(chain):
    """A copy of the chain with values like those of the fit to Dataset 3."""
    truth = chain.copy()
    n = truth["wollaston"].efficiency.size
    truth["wollaston"].efficiency = np.linspace(0.96, 0.98, n)
    truth["hwp"].w_sio2, truth["hwp"].w_mgf2 = 1.6542 * u.mm, 1.2919 * u.mm
    if "calibration_polarizer" in truth.submodel_names:
        truth["calibration_polarizer"].theta = 90.4 * u.deg
    for name, angle in (("hwp", -0.3), ("derotator", 0.4)):
        if not truth[name].theta.fixed:
            truth[name].theta = angle * u.deg
    if "diagonal" in truth["derotator"].param_names:
        truth["derotator"].diagonal = np.linspace(-5, -2, n) * u.deg
        truth["derotator"].circular = np.linspace(3, 5, n) * u.deg
    return truth


def charis_frames(derotator=DEROTATOR):
    return half_wave_plate_cycles(derotator=derotator)


def observe(truth, frames=None, wavelength=None, **options):
    wavelength = CHARIS.wavelength if wavelength is None else wavelength
    return simulate(truth, wavelength, charis_frames() if frames is None else frames, **options)


def off_at_settings(truth, frames=None, seed=0, size=5e-3):
    """The same of a lamp whose q and u are off by as much (rms) at each derotator angle."""
    lam = CHARIS.wavelength
    table = observe(truth, frames, lam, seed=seed).to_table()
    hwp, derotator = (table[k].to_value(u.rad) for k in ("hwp", "derotator"))
    _, setting = np.unique(derotator, return_inverse=True)
    off = np.random.default_rng(seed).normal(0, size, (setting.max() + 1, 2))[setting]
    change = off[:, 0] * np.cos(4 * hwp) + off[:, 1] * np.sin(4 * hwp)
    change = 0.5 * change * (table["flux_right"] + table["flux_left"])
    table["flux_right"] += change
    table["flux_left"] -= change
    table.meta["source"] = "polarized lamp"
    return Observations.from_table(table, name=f"lamp {seed}")


@pytest.fixture(scope="session")
def make():
    """The helpers of this file, for tests."""
    from types import SimpleNamespace

    return SimpleNamespace(
        charis=CHARIS,
        chain=charis_chain,
        truth=charis_truth,
        frames=charis_frames,
        observe=observe,
        off_at_settings=off_at_settings,
        fits=fits,
        pulls_of=pulls_of,
    )


def fits(kind, fixed, seeds):
    """Truth and calibration of simulated datasets, which differ by their noise."""
    truth = charis_truth(charis_chain(kind, fixed=fixed))
    for seed in seeds:
        # the branch search has its own tests, and costs more than the fit
        cal = calibrate(
            truth, observe(truth, seed=seed), weights="errors", search=False, cross_validate=False
        )
        assert cal.converged
        assert not cal.at_bound
        assert cal.identifiability.rank == {"linear": 49 - 2 * fixed, "elliptical": 91}[kind]
        yield truth, cal


def pulls_of(truth, cal):
    """(fitted - true) / error of every free parameter."""
    free = FreeParameters([truth], 22)
    error = (cal.measurement.vector() - free.start()) / free.factors()
    return error / cal.covariance.stds


@pytest.fixture(scope="module")
def chain():
    """The truth at three wavelengths."""
    return charis_truth(charis_chain(wavelength=LAM))


@pytest.fixture(scope="module")
def measurement(chain):
    return Measurement(chain, observe(chain, wavelength=LAM, seed=1))


@pytest.fixture(scope="session")
def pulls():
    """
    Pulls of simulated calibrations, of shape (n, n_free).

    ``pulls(kind, fixed, n)``: kind of derotator, gauge angles fixed or free, how
    many. What has been fitted once is kept, as it serves several files.
    """
    known = {}

    def ensemble(kind, fixed, n):
        rows = known.setdefault((kind, fixed), [])
        rows += [pulls_of(*both) for both in fits(kind, fixed, range(len(rows), n))]
        return np.array(rows[:n])

    return ensemble


@pytest.fixture(scope="session")
def charis_data(shared_data):
    """Read a dataset of real measurements by a part of its name."""

    def read(name):
        (path,) = (shared_data / "data" / "charis").glob(f"{name}*.ecsv")
        return Observations.read(path)

    return read


@pytest.fixture(scope="session")
def charis_fit(charis_data):
    """
    Fit one of the real datasets with all its parameters, but those that are named held.

    It is made once, as it serves several files: leave it as it is.
    """

    @cache
    def fit(number, *held):
        data = charis_data(f"dataset{number}_")
        fix = dict.fromkeys(held) if held else None
        return calibrate(CHARIS.chains_for([data]), data, instrument="charis", fix=fix)

    return fit
