# Licensed under a 3-clause BSD style license - see LICENSE
"""
Speed of a diagnosis.

Not part of the normal run: ``pytest tests/benchmarks``. The goal for a pair of
a polarized and an unpolarized run, 22 wavelengths and 2 x 64 frames, the whole
library and left-out frames, is 20 s on one core; the time may grow with the
number of frames, not faster.
"""

import time

import astropy.units as u
import numpy as np
import pytest

from astropolcal import instruments
from astropolcal.gap import EFFECTS, diagnose, get_effect
from astropolcal.gap.attribution import scan
from astropolcal.gap.effects import Context
from astropolcal.gap.model import nominal_model
from astropolcal.gap.residuals import locate
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
WAVELENGTH = CHARIS.wavelength
SMOOTH = [effect for effect in EFFECTS.values() if effect.kind != "discrete"]
EFFECT, SIZE = "beam_gain", 0.01
DEROTATOR = np.linspace(45, 132.5, 8) * u.deg


def pair(cycles=1):
    """Chains and data of a polarized and an unpolarized run, each of 64 frames a cycle."""
    chains = [CHARIS.chain(source, derotator="linear") for source in ("polarized", "unpolarized")]
    context = Context(WAVELENGTH.to_value(u.um), 1e6)
    true = get_effect(EFFECT).edit([chain.copy() for chain in chains], context).chains
    for chain in true:
        chain[f"gap_{EFFECT}"].imbalance = np.full(len(WAVELENGTH), SIZE)
    # other plate angles in every cycle, so that no frame is a repetition
    steps = np.arange(8 * cycles) * 11.25 / cycles
    frames = half_wave_plate_cycles(steps * u.deg, DEROTATOR)
    data = [
        simulate(chain, WAVELENGTH, frames, flux=1e6, seed=i, name=name)
        for i, (chain, name) in enumerate(zip(true, ("polarized", "unpolarized"), strict=True))
    ]
    return chains, data


@pytest.fixture(scope="module")
def model():
    return nominal_model(*pair())


def test_whole_diagnosis(benchmark, measured):
    """Nominal fit, scan, refits, exchanges and left-out frames with the whole library."""
    chains, data = pair()
    found = benchmark.pedantic(diagnose, (chains, data), rounds=3, warmup_rounds=0, iterations=1)
    assert [cause.name for cause in found.causes] == [EFFECT]
    measured("a whole diagnosis, 2 x 64 frames", benchmark.stats.stats.min)
    assert benchmark.stats.stats.median < 20


def test_nominal_model(benchmark):
    found = benchmark.pedantic(nominal_model, pair(), rounds=3, warmup_rounds=1, iterations=1)
    assert found.fit.converged


def test_scan(benchmark, model, measured):
    """All cells and the library without refits."""
    found = benchmark.pedantic(scan, (model, SMOOTH), rounds=3, warmup_rounds=1, iterations=1)
    measured("scan of a diagnosis, 2 x 64 frames", benchmark.stats.stats.min)
    assert EFFECT in [one.name for one in found.candidates[:3]]
    assert len(found.candidates) > 1000


def test_where(benchmark, model):
    """Patterns and places of the gap."""
    where = benchmark.pedantic(locate, (model,), rounds=3, warmup_rounds=1, iterations=1)
    assert where[0]["detail"].startswith("what is constant in the half-wave-plate angle")


def seconds(function, *arguments):
    started = time.perf_counter()
    function(*arguments)
    return time.perf_counter() - started


def test_time_grows_as_the_number_of_frames(measured):
    """Scan at 64 and at 640 frames a dataset; a factor of ten may cost little more than ten."""
    times = []
    for cycles in (1, 10):
        model = nominal_model(*pair(cycles))
        times.append(min(seconds(scan, model, SMOOTH) for _ in range(3)))
    ratio = times[1] / times[0]
    measured("scan of a diagnosis, 2 x 640 frames", times[1])
    assert ratio < 15
