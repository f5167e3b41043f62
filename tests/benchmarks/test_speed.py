# Licensed under a 3-clause BSD style license - see LICENSE
"""
Speed, by comparison with something that does the same on the same machine.

Not part of the normal run: ``pytest tests/benchmarks``. How times are compared, `timing` says.
"""

import json
import os
import statistics
import subprocess
import sys
import time
from functools import reduce

import astropy.units as u
import numpy as np
import pytest
from astropy.modeling.fitting import TRFLSQFitter
from scipy.linalg import svd
from scipy.optimize import least_squares
from timing import fastest, in_new_process, interleaved

from astropolcal import Calibration, calibrate, instruments
from astropolcal.calibration.fit.branches import BinProblem, search_branches
from astropolcal.calibration.noise.weighting import first_weighting
from astropolcal.chain import leaves, system_mueller
from astropolcal.measurement import Measurement
from astropolcal.pipeline import Library, library, load
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")


def truth():
    """The chain of the paper with 93 free parameters, away from bounds."""
    chain = CHARIS.chain()
    chain["wollaston"].efficiency = np.full(22, 0.97)
    chain["derotator"].diagonal = np.linspace(-5, -2, 22) * u.deg
    chain["derotator"].circular = np.linspace(3, 5, 22) * u.deg
    chain["hwp"].w_sio2, chain["hwp"].w_mgf2 = 1.6542 * u.mm, 1.2919 * u.mm
    return chain


@pytest.fixture(scope="module")
def observations():
    """The 64 frames and 22 wavelengths of a calibration run."""
    chain = truth()
    chain["calibration_polarizer"].theta = 90.5 * u.deg
    frames = half_wave_plate_cycles(derotator=np.linspace(45, 132.5, 8) * u.deg)
    return simulate(chain, CHARIS.wavelength, frames, flux=1e5, seed=1)


@pytest.fixture(scope="module")
def measurement(observations):
    return Measurement(CHARIS.chain(), observations)


def forget(measurement):
    """Undo the memory of the last sweep, so that each call does its work."""
    measurement._last = (None, None, {})


# --- absolute, with pytest-benchmark ------------------------------------------------------


def test_evaluation(benchmark, measurement, measured):
    """22 wavelengths x 64 frames; the goal is 0.6 ms."""
    vector = measurement.vector()

    def evaluate():
        forget(measurement)
        return measurement.predict(vector)

    assert evaluate().size == 704
    benchmark(evaluate)
    measured("prediction of 704 double differences", benchmark.stats.stats.min)
    assert benchmark.stats.stats.median < 0.6e-3


def test_calibration(benchmark, observations, measured):
    """All of `calibrate`: branches, fit, identifiability, eight-fold cross-validation."""
    cal = benchmark.pedantic(
        calibrate, (CHARIS.chain(), observations), rounds=7, warmup_rounds=1, iterations=1
    )
    assert cal.converged
    measured("calibration, 64 frames, all of it", benchmark.stats.stats.min)
    assert benchmark.stats.stats.median < 2.0


def long_calibration(n):
    """Return the processor's time (s) of a calibration of so many frames."""
    chain, steps = truth(), np.linspace(45, 132.5, n // 8) * u.deg
    frames = half_wave_plate_cycles(derotator=steps)
    data = simulate(chain, CHARIS.wavelength, frames, flux=1e5, seed=1)
    begin = time.process_time()
    cal = calibrate(CHARIS.chain(), data)
    return cal.converged, time.process_time() - begin


def test_calibration_of_a_long_table(measured):
    found = [in_new_process(long_calibration, 5120) for _ in range(3)]
    seconds, memory = min(one[0][1] for one in found), max(one[1] for one in found)
    measured("calibration, 5,120 frames", seconds, memory=memory)
    assert all(one[0][0] for one in found)
    assert seconds < 4
    assert memory < 500


@pytest.fixture(scope="module")
def calibration(observations):
    return calibrate(CHARIS.chain(), observations, cross_validate=False, instrument="charis")


def test_calibration_file(benchmark, calibration, tmp_path, measured):
    """Written and read again, with all checks; the goal is 0.4 s."""
    path = tmp_path / "cal.asdf"

    def there_and_back():
        calibration.write(path, overwrite=True)
        return Calibration.read(path)

    assert benchmark(there_and_back).chains[0].submodel_names == calibration.chain.submodel_names
    measured("a calibration file, written and read", benchmark.stats.stats.min)
    assert benchmark.stats.stats.min < 0.4


def test_library_of_ten_thousand_calibrations(calibration, tmp_path, monkeypatch, measured):
    """Opened with an index, and a look-up whose file was read before."""
    monkeypatch.setattr(library, "_SETTLED", 0)
    calibration.write(tmp_path / "00000.asdf")
    (true,) = Library(tmp_path).entries
    files = {}
    # to write ten thousand different ones takes twenty minutes; only the first is read
    for i in range(10_000):
        path = tmp_path / f"{i:05}.asdf"
        if i:
            path.write_bytes(b"#")
        begin = {"valid_from": f"{2030 + i // 28}-01-{1 + i % 28:02}"} if i else {}
        held = true.validity.to_dict() | begin
        digest = f"{i:064}" if i else true.content_hash
        record = {"state": list(library._state(path)), "validity": held, "content_hash": digest}
        files[path.name] = record | {"supersedes": [], "quality": true._quality}
    library._write_index(tmp_path, files)
    opened, when = Library(tmp_path), "2026-03-04T05:06:07"
    assert opened.find("charis", date=when).name == "00000.asdf"
    open_and_look = (lambda: Library(tmp_path), lambda: opened.find("charis", date=when))
    times = interleaved(*open_and_look, repeats=7)
    assert json.loads((tmp_path / library._INDEX).read_text())["files"] == files
    measured("a library of 10,000 calibrations, opened", times[0])
    measured("look-up in it", times[1])
    assert times[0] < 1.0
    assert times[1] < 0.05


# --- ratios ----------------------------------------------------------------------------------


def test_fitter_against_bare_scipy(measurement, measured):
    """
    The stock fitter of astropy against `least_squares` with the same functions.

    The goal is 1.2 for the same work; `TRFLSQFitter` also decomposes the last
    Jacobian for its covariance, a fixed cost of a tenth of the fit that the
    bare call is given here too.
    """
    start = search_branches(
        BinProblem(measurement, first_weighting(measurement, None)), measurement.vector()
    )[0]
    low, high = measurement.free.bounds()

    def stock():
        forget(measurement)
        measurement.stand_at(start)
        fitter = TRFLSQFitter()
        fitter(measurement, measurement.index, measurement.observed, maxiter=500, inplace=True)
        return fitter.fit_info

    def bare():
        forget(measurement)
        return least_squares(
            lambda v: measurement.predict(v) - measurement.observed,
            start,
            jac=lambda v: measurement.jacobian(v).T,
            bounds=(low, high),
            xtol=1e-7,
            max_nfev=500,
        )

    def bare_with_covariance():
        result = bare()
        _, s, right = svd(result.jac, full_matrices=False)
        return right.T / np.maximum(s, 1e-12) ** 2 @ right

    first, second = stock(), bare()
    assert first.nfev == second.nfev
    assert first.cost == pytest.approx(second.cost, rel=1e-6)
    times = interleaved(stock, bare, bare_with_covariance)
    plain, fair = times[0] / times[1], times[0] / times[2]
    others = {"bare scipy": times[1], "bare scipy with a covariance": times[2]}
    measured("fit, 93 parameters", times[0], others)
    assert fair <= 1.2
    assert plain <= 1.4


def test_analytic_against_finite_differences(measurement, measured):
    """
    Two-point differences, as astropy would use.

    They take 94 predictions, so what speeds a prediction up makes this ratio smaller: it was
    above 20 when one took twice as long.
    """
    vector = measurement.vector()

    def analytic():
        forget(measurement)
        return measurement.jacobian(vector)

    def differences(step=1e-7):
        base = measurement.predict(vector)
        out = np.empty((vector.size, base.size))
        for i in range(vector.size):
            moved = vector.copy()
            moved[i] += step
            out[i] = (measurement.predict(moved) - base) / step
        return out

    np.testing.assert_allclose(analytic(), differences(), atol=1e-5)
    times = interleaved(analytic, differences)
    measured("Jacobian, 93 parameters", times[0], {"finite differences": times[1]})
    assert times[1] / times[0] >= 10


def test_system_mueller_against_a_plain_loop(measured):
    """Matrices of 22 wavelengths x 16 frames at once, and one by one."""
    chain = truth()
    frames = half_wave_plate_cycles(derotator=[45, 80] * u.deg)
    positions = {"hwp": frames["hwp"], "derotator": frames["derotator"]}
    wavelength = CHARIS.wavelength

    def vectorized():
        return system_mueller(chain, wavelength, positions)

    def loop():
        out = []
        for i in range(len(frames)):
            for leaf in leaves(chain):
                if leaf.stage:
                    leaf.position = positions[leaf.stage][i]
            matrices = [
                np.broadcast_to(leaf.mueller(wavelength), (22, 4, 4)) for leaf in leaves(chain)
            ]
            out.append([reduce(lambda a, b: b @ a, [m[j] for m in matrices]) for j in range(22)])
        return np.array(out)

    np.testing.assert_allclose(vectorized(), loop(), atol=1e-12)
    times = interleaved(vectorized, loop, repeats=7)
    measured("matrices of a chain, 22 x 16", times[0], {"one by one": times[1]})
    assert times[1] / times[0] >= 5


def many_matrices(path, n):
    """Return the processor's times (s) of matrices of so many settings, and of their errors."""
    loaded, rng = load(path), np.random.default_rng(1)
    positions = {name: rng.uniform(0, 180, n) * u.deg for name in ("hwp", "derotator")}
    times = [time.process_time()]
    matrices = loaded.system_mueller(positions=positions, light="internal")
    times.append(time.process_time())
    assert matrices.std.shape == (n, 22, 4, 4)
    times.append(time.process_time())
    return np.diff(times)


def test_system_mueller_of_an_archive(calibration, measured, tmp_path):
    """All settings differ, which is the most work."""
    calibration.write(tmp_path / "a.asdf")
    (first, errors), _ = in_new_process(many_matrices, tmp_path / "a.asdf", 1000)
    (_, all_errors), memory = in_new_process(many_matrices, tmp_path / "a.asdf", 100_000)
    measured("matrices of 1,000 frames", first)
    measured("their errors", errors)
    measured("errors of 100,000 frames", all_errors, memory=memory)
    assert first < 0.3
    assert memory < 2000


# --- processes ------------------------------------------------------------------------------


def _compiling(cache):
    """Return an environment in which modules are compiled once, as installed ones are."""
    environment = {**os.environ, "PYTHONPYCACHEPREFIX": str(cache)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    return environment


def _seconds(code, cache, repeats=7):
    """Return the median of what a program prints."""
    times = []
    for _ in range(repeats + 1):
        result = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True,
            env=_compiling(cache),
        )  # fmt: skip
        times.append(float(result.stdout))
    # the first one compiles
    return statistics.median(times[1:])


def test_import_over_astropy_modeling(measured, tmp_path):
    """What the package adds where astropy.modeling is imported, lazy names resolved."""
    extra = _seconds(
        "import time, astropy.modeling.fitting; t = time.process_time(); "
        "from astropolcal import Observations, calibrate, instruments, optics; "
        "print(time.process_time() - t)",
        tmp_path,
    )
    measured("import, beyond that of astropy.modeling", extra)
    assert extra <= 0.15


def test_command_on_dataset_3(shared_data, measured, tmp_path):
    """``astropolcal calibrate FILE`` from start to end; the goal is 4 s."""
    (path,) = (shared_data / "data" / "charis").glob("dataset3_*.ecsv")
    code = "import sys; from astropolcal.scripts.main import main; sys.exit(main())"
    command = [sys.executable, "-c", code, "calibrate", str(path)]

    def run():
        subprocess.run(
            command, capture_output=True, check=True, cwd=tmp_path, env=_compiling(tmp_path)
        )

    (seconds,) = fastest(run, repeats=3, clock=time.perf_counter)
    measured("the command astropolcal calibrate, 64 frames", seconds)
    assert seconds < 4.0


_HUNDRED = """
import resource, sys, time
import astropy.units as u, numpy as np
from astropolcal import instruments
from astropolcal.calibration import calibrate_runs
from astropolcal.simulation import half_wave_plate_cycles, simulate
charis = instruments.get("charis")
chain = charis.chain()
for name in ("calibration_polarizer", "derotator"):
    chain[name].theta.fixed = True
frames = half_wave_plate_cycles(derotator=np.linspace(45, 132.5, 8) * u.deg)
runs = []
for i in range(100):
    truth = chain.copy()
    truth["hwp"].theta = 0.4 * (i > 33) * u.deg
    meta = {"date": f"{2001 + i // 12}-{i % 12 + 1:02d}-01"}
    runs.append(simulate(truth, charis.wavelength, frames, seed=i, flux=1e6, meta=meta))
begin = time.process_time()
found = calibrate_runs(chain, runs)
varying = [str(r["what"]) for r in found.courses if r["course"] != "constant"]
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
print(time.process_time() - begin, peak, *varying)
"""


def test_a_hundred_runs_have_one_likelihood(measured):
    """100 runs of 64 frames and 22 wavelengths: processor time and memory of a new process."""
    done = subprocess.run([sys.executable, "-c", _HUNDRED], capture_output=True, text=True)
    seconds, peak, *varying = done.stdout.split()
    measured("a hundred runs in one likelihood", float(seconds), memory=1e3 * float(peak))
    assert varying == ["hwp.theta"]
    assert float(seconds) < 60
    assert float(peak) < 1
