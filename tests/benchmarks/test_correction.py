# Licensed under a 3-clause BSD style license - see LICENSE
"""
Speed and memory of the correction of cubes, against copying them with numpy.

Not part of the normal run: ``pytest tests/benchmarks``.
"""

import time
import tracemalloc

import astropy.units as u
import numpy as np
import pytest
from timing import fastest

from astropolcal import instruments
from astropolcal.correction import ScienceFrames, correct

N_FRAMES = 100
#: Cubes of CHARIS; the two beams of a frame are two such arrays.
SHAPE = (22, 201, 201)
#: Most time, in that of copying the images once; reading them twice is all that it takes.
GOAL = 1.3


def positions(n):
    parallactic, altitude = np.linspace(-20, 20, n) * u.deg, np.linspace(65, 70, n) * u.deg
    hwp = np.resize([0, 45, 22.5, 67.5], n) * u.deg
    return {
        "hwp": hwp + 0.5 * parallactic + altitude,
        "derotator": np.linspace(55, 80, n) * u.deg,
        "parallactic": parallactic,
        "altitude": altitude,
    }


@pytest.fixture(scope="module")
def chain():
    charis = instruments.get("charis")
    return charis.on_sky(charis.published())


@pytest.fixture(scope="module")
def beams():
    rng = np.random.default_rng(1)
    # half of the pixels each, so that both together are the array that is copied
    shape = (N_FRAMES // 2, *SHAPE)
    return [rng.uniform(1, 2, size=shape) for _ in "rl"]


def copy(arrays):
    for array in arrays:
        array.copy()


def copy_and_sum(arrays):
    for array in arrays:
        array.copy().sum(axis=0)


@pytest.mark.parametrize("workers", [None, 2])
def test_speed(beams, chain, measured, workers):
    frames = ScienceFrames.from_arrays(
        *beams, instruments.get("charis").wavelength, positions(N_FRAMES // 2)
    )
    ours, copied, summed = fastest(
        lambda: correct(chain, frames, workers=workers),
        lambda: copy(beams),
        lambda: copy_and_sum(beams),
        repeats=9,
        clock=time.perf_counter,
    )
    threads = f", {workers} threads" if workers else ""
    others = {"copy with numpy": copied, "copy and sum with numpy": summed}
    measured(f"correction of {N_FRAMES} cubes of 22 x 201 x 201{threads}", ours, others)
    # threads of a busy machine wait for each other
    assert ours < GOAL * (copied if workers is None else summed)


@pytest.mark.parametrize("n_frames", [50, 200])
def test_memory(tmp_path, chain, capsys, n_frames):
    """Frames on disk; beyond the result, less than twice the share of one frame is held."""
    shape = (n_frames, 22, 101, 101)
    beams = []
    for name in "rl":
        array = np.lib.format.open_memmap(tmp_path / name, "w+", "f4", shape)
        for i in range(n_frames):
            array[i] = 1.0 + i
        array.flush()
        beams.append(np.load(tmp_path / name, mmap_mode="r"))
    wavelength = instruments.get("charis").wavelength
    frames = ScienceFrames.from_arrays(*beams, wavelength, positions(n_frames))
    correct(chain, frames, workers=1)
    tracemalloc.start()
    result = correct(chain, frames, workers=1)
    peak = tracemalloc.get_traced_memory()[1] - result.stokes.nbytes
    tracemalloc.stop()
    share = 2 * 8 * np.prod(shape[1:])
    with capsys.disabled():
        print(f"\n  {n_frames} frames: {peak / share:.2f} of a frame's share beyond the result")
    assert peak < 2 * share
