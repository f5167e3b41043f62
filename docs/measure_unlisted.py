# Licensed under a 3-clause BSD style license - see LICENSE
"""
Hold the accuracy that a calibration states against the truth, where the model lacks an effect.

Each simulated run of the bench has one perturbation of any kind at the half-wave plate or
downstream of it, constant or a harmonic of the angle of a stage: it acts on sky as it does on the
lamp. The true instrument then measures targets on sky at the calibrated settings, with one cycle of
the half-wave plate each, and the calibration corrects them. ``python docs/measure_unlisted.py
FIRST LAST`` appends a row per seed to ``docs/unlisted_effects.csv``.
"""

import sys
import warnings
from pathlib import Path

import astropy.units as u
import numpy as np

from astropolcal import calibrate
from astropolcal.calibration import target_accuracies
from astropolcal.calibration.system import inverse_rows
from astropolcal.gap._bench import Bench, Fault, Setup
from astropolcal.mueller import rotate

TABLE = Path(__file__).with_name("unlisted_effects.csv")
COLUMNS = "seed,place,kind,dependence,snr,real_30,stated_30,real_1,stated_1\n"
DOLPS = (0.3, 0.01)
CYCLE = (0.0, 45.0, 22.5, 67.5)
HARMONICS = [f"harmonic:{stage}:{n}" for stage in ("hwp", "derotator") for n in (1, 2, 4)]


def main(first, last):
    """Measure the seeds from the first to the last."""
    if not TABLE.exists():
        TABLE.write_text(COLUMNS, encoding="utf-8")
    for seed in range(first, last + 1):
        with TABLE.open("a", encoding="utf-8") as file:
            file.write(",".join(measure(seed)) + "\n")


def measure(seed):
    """Return the row of a seed: the effect, and real and stated errors, rms over wavelengths."""
    bench, rng = Bench(Setup(), np.random.default_rng(seed)), np.random.default_rng(seed)
    snr = np.exp(rng.uniform(*np.log([12, 120])))
    places = [place for place in bench.places if place != "source"]
    what = {
        "place": str(rng.choice(places)),
        "dependence": str(rng.choice(["constant", *HARMONICS])),
    }
    fault = Fault(bench, {"type": "cell"} | what)
    bench.scale(fault, snr)
    data, chains = bench.record(bench.expose([fault])), bench.setup.chains()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        calibration = calibrate(chains, data, instrument="charis", cross_validate=False)
    true = rows(bench, bench.optics[0], fault.kicks(0))
    known = rows(bench, bench.split(calibration.chains[0]), [])
    told = [fault.told[key] for key in ("place", "kind", "dependence")]
    numbers = [fault.snr]
    for dolp in DOLPS:
        (table,) = target_accuracies(calibration, [(dolp * u.one, None)])
        stated, real = table["s_p"].to_value(u.percent), errors(bench, true, known, dolp)
        both = np.isfinite(stated) & np.isfinite(real)
        numbers += [np.sqrt(np.mean(each[both] ** 2)) for each in (real, stated)]
    return [str(seed), *told, *(f"{number:.4g}" for number in numbers)]


def rows(bench, optics, kicks):
    """Return what each beam measures of I, Q and U that enter the plate, (2, W, F, 3)."""
    lamp, light = bench.anchor(0, "source"), None
    for name, angle, matrices in bench._matrices(0, optics=optics):
        light = light if light is None else matrices @ light
        if name == lamp:
            light = np.eye(4)
        for place, kick in kicks if light is not None else ():
            if name == bench.anchor(0, place):
                turn = angle if place.startswith("in:") else 0.0
                light = rotate(kick, turn * u.rad) @ light
    return light[..., 0, :3].swapaxes(1, 2)


def errors(bench, true, known, dolp):
    """Return the error of the degree of polarization at the worst angle, in percent."""
    turn, plate = (np.rad2deg(bench.clean[0].position(s)).round(3) for s in ("derotator", "hwp"))
    settings = np.unique(turn)
    where = [[np.flatnonzero((turn == t) & (plate == h))[0] for h in CYCLE] for t in settings]
    true, known = (np.moveaxis(x[:, :, where], 0, 2) for x in (true, known))
    # beams and frames become half differences and half sums of pairs, as `correct` takes them
    minus, plus = (np.kron(np.eye(2), [[1, sign]]) for sign in (-1, 1))
    combine = np.concatenate([np.hstack([minus, -minus]), np.hstack([plus, plus])]) / 2
    true, known = (combine @ x.reshape(*x.shape[:2], -1, 3) for x in (true, known))
    gain, _, _, good = inverse_rows(known, max_condition=30.0)
    double = 2 * np.deg2rad(np.arange(0, 180, 7.5))
    light = np.stack([np.ones_like(double), dolp * np.cos(double), dolp * np.sin(double)])
    change = gain @ true @ light - light
    dq, du = (change[..., i, :] - light[i] * change[..., 0, :] for i in (1, 2))
    along = dq * np.cos(double) + du * np.sin(double)
    along = np.where(good.all(axis=-1)[..., None], along, np.nan)
    return 100 * np.sqrt(np.nanmean(along**2, axis=1)).max(axis=-1)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
