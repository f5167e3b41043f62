# Licensed under a 3-clause BSD style license - see LICENSE
"""
How times grow with frames, wavelengths and walkers: a table and a figure.

``python tests/benchmarks/scaling.py DIR`` writes ``speed_scaling.ecsv`` and ``speed_scaling.png``.
The table also keeps what the machine is; docs/speed.rst draws it.
"""

import argparse
import os
import platform
import sys
import time
from pathlib import Path

import astropy
import astropy.units as u
import numpy as np
import scipy
from astropy.table import Table

sys.path.insert(0, str(Path(__file__).parent))

from timing import fastest

from astropolcal import instruments
from astropolcal.calibration.posterior import LogPosterior
from astropolcal.measurement import Measurement
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
FRAMES, WAVELENGTHS, WALKERS = (16, 64, 256, 1024), (1, 5, 22, 88, 352), (6, 24, 96, 384)
"""What is varied; the other two stay at 64 frames, 22 wavelengths and one walker."""
_TURNS = 5


def measurement(n_frames=64, n_wavelengths=22):
    """A calibration run of CHARIS with a derotator that is free at each wavelength."""
    wavelength = np.linspace(1160, 2390, n_wavelengths) * u.nm
    chain = CHARIS.chain("polarized", wavelength=wavelength)
    angles = np.linspace(45, 132.5, n_frames // 8) * u.deg
    frames = half_wave_plate_cycles(derotator=angles)
    return Measurement(chain, simulate(chain, wavelength, frames, flux=1e5, seed=1))


def seconds(model, repeats=15):
    """Return the times of a prediction and of a Jacobian."""
    vector = model.vector()

    def predict():
        model._last = (None, None, {})
        return model.predict(vector)

    def jacobian():
        model._last = (None, None, {})
        return model.jacobian(vector)

    return fastest(predict, jacobian, repeats=repeats)


def curves():
    """Give axis, number, function and seconds of all points."""
    for axis, numbers in (("frames", FRAMES), ("wavelengths", WAVELENGTHS)):
        for n in numbers:
            model = measurement(**{f"n_{axis}": n})
            for name, time_ in zip(("prediction", "Jacobian"), seconds(model), strict=True):
                yield axis, n, name, time_
    model = measurement()
    posterior = LogPosterior(model, noise=1e-3)
    for n in WALKERS:
        walkers = np.tile(posterior.centre, (n, 1))
        (time_,) = fastest(lambda walkers=walkers: posterior(walkers), repeats=7)
        yield "walkers", n, "log-posterior", time_


def processor():
    """Return the name of the processor and the number of cores."""
    name = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = [line for line in info.read_text().splitlines() if line.startswith("model name")]
        name = lines[0].split(":", 1)[1].strip() if lines else name
    return f"{name}, {os.cpu_count()} cores"


def table():
    # a machine that is shared may be slow for a while
    turns = [list(curves()) for _ in range(_TURNS)]
    rows = Table(rows=turns[0], names=("axis", "number", "function", "seconds"))
    least = np.min([[row[3] for row in turn] for turn in turns], axis=0)
    rows["seconds"] = np.array([float(f"{s:.3g}") for s in least])
    rows.meta.update(
        machine=processor(), date=time.strftime("%Y-%m"), python=platform.python_version(),
        numpy=np.__version__, scipy=scipy.__version__, astropy=astropy.__version__,
    )  # fmt: skip
    return rows


def draw(rows, figure=None):
    """Return a figure with a panel for each of what was varied."""
    from astropolcal.plotting._style import COLORS, MARKERS, canvas

    with canvas(figure, 10, 3.6) as figure:
        axes = figure.subplots(1, 3, sharey=True)
        looks = {"prediction": 0, "Jacobian": 1, "log-posterior": 2}
        for panel, axis in zip(axes, ("frames", "wavelengths", "walkers"), strict=True):
            for name, i in looks.items():
                part = rows[(rows["axis"] == axis) & (rows["function"] == name)]
                if len(part):
                    panel.loglog(part["number"], part["seconds"] * 1e3, color=COLORS[i],
                                 marker=MARKERS[i], label=name)  # fmt: skip
            numbers, times = _proportional(rows[rows["axis"] == axis])
            panel.loglog(numbers, times * 1e3, color="0.45", ls=":", label="proportional")
            panel.set_xlabel(f"number of {axis}")
            panel.legend(loc="upper left")
        axes[0].set_ylabel("time (ms)")
    return figure


def _proportional(part):
    """Return a line of slope one through the last point of the slowest curve."""
    numbers = np.unique(part["number"])
    last = part["seconds"][part["number"] == numbers[-1]].max()
    return numbers, 0.5 * last * numbers / numbers[-1]


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("folder", type=Path)
    folder = parser.parse_args().folder
    rows = table()
    rows.write(folder / "speed_scaling.ecsv", overwrite=True)
    draw(rows).savefig(folder / "speed_scaling.png", dpi=130)
    rows.pprint(max_lines=-1)


if __name__ == "__main__":
    main()
