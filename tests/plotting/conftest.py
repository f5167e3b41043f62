# Licensed under a 3-clause BSD style license - see LICENSE
"""Small calibrations to draw, each made once."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import calibrate, optics
from astropolcal.simulation import half_wave_plate_cycles, simulate

WAVELENGTH = [1200, 1400, 1600, 1900, 2200] * u.nm
ANGLES = [45, 57.5, 82.5, 107.5, 132.5] * u.deg


def make_chain(derotator="elliptical", efficiency=0.98, first=None):
    """A chain of no instrument in particular, with a law and parameters per wavelength."""
    n = len(WAVELENGTH)
    first = optics.LinearPolarizer(theta=90 * u.deg, name="polarizer") if first is None else first
    start = np.linspace(-160, -60, n) * u.deg
    if derotator == "elliptical":
        turned = optics.EllipticalRetarder(
            horizontal=start,
            diagonal=np.full(n, -2.0) * u.deg,
            circular=np.full(n, 3.0) * u.deg,
            mount="derotator",
            name="derotator",
        )
    else:
        turned = optics.LinearRetarder(retardance=start, mount="derotator", name="derotator")
    return (
        first
        | optics.TwoLayerWaveplate(mount="hwp", name="hwp")
        | turned
        | optics.WollastonPrism(efficiency=np.full(n, efficiency), name="wollaston")
    )


def make_observations(chain, angles=ANGLES, mask=None, **options):
    frames = half_wave_plate_cycles(derotator=angles)
    observations = simulate(chain, WAVELENGTH, frames, **({"flux": 1e5, "seed": 5} | options))
    return observations if mask is None else observations.with_mask(mask, "cosmic ray")


@pytest.fixture(scope="session")
def elliptical():
    """A calibration in which every parameter is determined."""
    chain = make_chain()
    return calibrate(chain, make_observations(chain), instrument="bench", errors="white")


@pytest.fixture(scope="session")
def masked():
    """Derotator linear, with masked cells: one whole wavelength of a frame, one frame wholly."""
    chain = make_chain("linear")
    mask = np.zeros((len(ANGLES) * 8, len(WAVELENGTH)), dtype=bool)
    mask[3, 2] = True
    mask[8, :] = True
    return calibrate(chain, make_observations(chain, mask=mask))


@pytest.fixture(scope="session")
def at_bound():
    """The true efficiency is 1, so that some of the fitted ones stop at that bound."""
    chain = make_chain("linear", efficiency=1.0)
    return calibrate(chain, make_observations(chain))


@pytest.fixture(scope="session")
def undetermined():
    """Misalignments of everything are free: only sums of them act on the data."""
    chain = make_chain()
    observations = make_observations(chain)
    for name in ("polarizer", "hwp", "derotator"):
        theta = chain[name].theta
        theta.fixed = False
        theta.bounds = (float(theta.value) - 5, float(theta.value) + 5)
    return calibrate(chain, observations, errors="white")


@pytest.fixture(scope="session")
def two_step():
    chain = make_chain("linear")
    return calibrate(chain, make_observations(chain), strategy="two-step")


@pytest.fixture(scope="session")
def several():
    """A polarized and an unpolarized dataset, the latter with a diattenuating mirror."""
    mirror = optics.Diattenuator(diattenuation=np.full(len(WAVELENGTH), 0.01), name="fold_mirror")
    chains = [make_chain("linear"), make_chain("linear", first=mirror)]
    observations = [
        make_observations(chains[0], name="polarized"),
        make_observations(chains[1], ANGLES[:3], name="unpolarized", seed=6),
    ]
    return calibrate(chains, observations)


@pytest.fixture(scope="session")
def single_angle():
    """One derotator angle, and one frame a datum; only the half-wave plate is fitted."""
    chain = make_chain("linear")
    chain["derotator"].retardance.fixed = True
    observations = make_observations(chain, [70] * u.deg)
    return calibrate(chain, observations, observable="normalized_single_difference")


@pytest.fixture(scope="session")
def with_mirror():
    """Calibrates a mirror in front of the half-wave plate; what stands behind that is known."""

    def calibrated(mirror):
        chain = make_chain("linear", first=mirror)
        chain["derotator"].retardance.fixed = True
        # a little polarization less cannot be told from a little less of its modulation
        chain["wollaston"].efficiency.fixed = True
        observations = make_observations(chain, ANGLES[:3], name="unpolarized")
        return calibrate(chain, observations, search=False, cross_validate=False)

    return calibrated
