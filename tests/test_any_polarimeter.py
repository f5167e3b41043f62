# Licensed under a 3-clause BSD style license - see LICENSE
"""Five polarimeters without a half-wave plate in pairs: simulated, calibrated, diagnosed, used."""

import astropy.units as u
import numpy as np
import pytest
from astropy.table import QTable

from astropolcal import calibrate, optics
from astropolcal.chain import join
from astropolcal.instruments import Instrument, SkyLaw
from astropolcal.measurement import Measurement
from astropolcal.simulation import simulate

FREE = {"fixed": {"theta": False}, "bounds": {"theta": (-10, 10)}}


class Bench(Instrument):
    """A lamp behind a polarizer and a quarter-wave plate that turn, in front of an instrument."""

    wavelength = [0.6, 0.7, 0.8] * u.um
    sources = ("lamp", "star")
    references = ("this test",)
    sky_law = SkyLaw(plate=(0, 0), derotator={})
    calibrators = ("polarizer", "retarder")

    def chain(self, source="lamp", optics_in=(), *, wavelength=None):
        self.check_choices(source, optics_in)
        plate = {"retardance": 85 * u.deg, "fixed": {"retardance": True}}
        unit = {
            "polarizer": optics.LinearPolarizer(mount="calibrator", name="calibrator"),
            "retarder": optics.LinearRetarder(mount="retarder", name="retarder", **plate),
        }
        train = self.telescope_optics() if source == "star" else [unit[k] for k in self.calibrators]
        return join([*train, *self.inner(self.grid(wavelength).size)])

    def telescope_optics(self, behind=()):
        return [optics.Rotator(mount="parallactic", name="parallactic")]

    def setup(self, observations):
        return self.source_of(observations), ()


class Wheel(Bench):
    """Three polarizers in a wheel, one beam, behind a mirror, as in HST/ACS."""

    name, entrance, calibrators = "wheel", "mirror", ("polarizer",)

    def inner(self, size):
        mirror = optics.DiattenuatorRetarder(
            diattenuation=np.full(size, 0.02), retardance=np.full(size, 170) * u.deg, name="mirror"
        )
        yield mirror
        for angle in (0, 60, 120):
            yield optics.StateAnalyser(
                efficiency=0.95, theta=angle * u.deg, mount=f"filter=POL{angle}", name=f"pol{angle}"
            )

    def frames(self, turns):
        return QTable(
            {
                "calibrator": np.repeat(turns, 3) * u.deg,
                "filter": np.tile(["POL0", "POL60", "POL120"], len(turns)),
                "group": np.repeat(np.arange(len(turns)), 3),
            }
        )


class Rolls(Bench):
    """Two Wollaston prisms, at 0 and 45 deg, one at a time, as in the Roman coronagraph."""

    name, entrance, calibrators = "rolls", "mirror", ("polarizer",)

    def inner(self, size):
        yield optics.DiattenuatorRetarder(
            diattenuation=np.full(size, 0.02), retardance=np.full(size, 160) * u.deg, name="mirror"
        )
        yield optics.WollastonPrism(
            efficiency=np.full(size, 0.97), mount="prism", name="wollaston", **FREE
        )

    def frames(self, turns):
        return QTable(
            {
                "calibrator": np.repeat(turns, 2) * u.deg,
                "prism": np.tile([0, 45], len(turns)) * u.deg,
            }
        )


class QuarterWave(Bench):
    """Quarter-wave plate at arbitrary angles and a Wollaston prism, as in FORS2: full Stokes."""

    name, entrance = "quarter", "qwp"

    def inner(self, size):
        yield optics.LinearRetarder(
            retardance=np.full(size, 88) * u.deg, mount="qwp", name="qwp", **FREE
        )
        yield optics.WollastonPrism(efficiency=np.full(size, 0.98), name="wollaston")

    def frames(self, turns):
        n = 4 * len(turns)
        return QTable(
            {
                "calibrator": np.repeat(turns, 4) * u.deg,
                "retarder": np.repeat(37 * np.arange(len(turns)) % 180, 4) * u.deg,
                "qwp": (13.7 + 39.1 * np.arange(n)) % 360 * u.deg,
            }
        )


class Crystal(Bench):
    """Liquid crystal with four voltages and a polarizer, one beam: full Stokes."""

    name, entrance = "crystal", "lc1_A"
    # those of IMaX (Martinez Pillet et al. 2011), the most efficient ones
    states = {"A": (315, 305.3), "B": (315, 54.7), "C": (225, 125.3), "D": (225, 234.7)}

    def inner(self, size):
        for i, theta in enumerate((0, 45)):
            for state, values in self.states.items():
                yield optics.StateRetarder(
                    retardance=values[i] * u.deg,
                    theta=theta * u.deg,
                    mount=f"lcvr={state}",
                    name=f"lc{i + 1}_{state}",
                )
        yield optics.LinearPolarizer(name="analyser")

    def frames(self, turns):
        return QTable(
            {
                "calibrator": np.repeat(turns, 4) * u.deg,
                "retarder": np.repeat(37 * np.arange(len(turns)) % 180, 4) * u.deg,
                "lcvr": np.tile(list("ABCD"), len(turns)),
                "group": np.repeat(np.arange(len(turns)), 4),
            }
        )


class FourBeams(Bench):
    """Half-wave plate and a double Wollaston prism with four beams at once, as in ALFOSC."""

    name, entrance, calibrators = "fourbeams", "hwp", ("polarizer",)

    def inner(self, size):
        yield optics.LinearRetarder(
            retardance=np.full(size, 172) * u.deg, mount="hwp", name="hwp", **FREE
        )
        for angle in (0, 45, 90, 135):
            name = f"i{angle}"
            yield optics.StateAnalyser(
                efficiency=0.98, theta=angle * u.deg, mount=f"beam={name}", name=name
            )

    def frames(self, turns):
        return QTable(
            {
                "calibrator": turns * u.deg,
                "hwp": (11.3 * np.arange(len(turns))) % 180 * u.deg,
            }
        )


KINDS = [Wheel(), Rolls(), QuarterWave(), Crystal(), FourBeams()]
every = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
TURNS = np.linspace(3, 178, 24)


def observed(kind, chain=None, seed=0, turns=TURNS, flux=3e5, **options):
    return simulate(
        kind.chain() if chain is None else chain,
        kind.wavelength,
        kind.frames(turns),
        flux=flux,
        seed=seed,
        meta={"instrument": kind.name, "source": "lamp"},
        name=kind.name,
        **options,
    )


@pytest.mark.slow
@every
def test_pulls_are_one(kind):
    pulls, truth = [], Measurement(kind.chain(), observed(kind))
    for seed in range(40):
        found = calibrate(
            kind.chain(), observed(kind, seed=seed), weights="errors", cross_validate=False
        )
        live = found.live_measurement()
        pulls.append((live.vector() - truth.vector()) / found.covariance.std)
    assert np.std(pulls) == pytest.approx(1, abs=0.1), np.std(pulls, axis=0)
