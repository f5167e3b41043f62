# Licensed under a 3-clause BSD style license - see LICENSE
"""
What an archive costs: many small sequences, corrected in turn and by a cluster that loses workers.

``python tests/benchmarks/archive.py FILE.json [N]`` makes N (2,000) sequences of a star, corrects
them with one process and through a local cluster of dask one worker of which is killed twice,
compares all products bit by bit, and writes what was measured. docs/archives.rst has its numbers.
With ``--part`` the others of its numbers are kept.
"""

import argparse
import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
import threading
import time
from contextlib import closing
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits

from astropolcal import calibrate, instruments
from astropolcal.correction import measurement_rows
from astropolcal.reduction.archive import Index
from astropolcal.reduction.cubes import CubeFiles, simulate_cubes
from astropolcal.simulation import half_wave_plate_cycles, simulate

CHARIS = instruments.get("charis")
N_FRAMES, SIZE = 4, 7
#: Of the cubes, which are cut out so that both beams are just inside; and where the left one is.
SHAPE, CENTRE = (44, 76), (5.0, 5.0)
#: A sequence begins so many days after the one before.
_APART = 0.03


def write_calibration(path):
    """A calibration of the instrument, from its lamp."""
    chain = CHARIS.chain(derotator="linear", optics_in=["nbs"])
    frames = half_wave_plate_cycles(derotator=[45, 55, 65, 75, 85] * u.deg)
    meta = {"instrument": "charis", "source": "polarized", "date": "2025-10-05"}
    meta |= {"nasmyth_beam_switcher": "installed"}
    table = simulate(chain, CHARIS.wavelength, frames, flux=1e8, seed=2, meta=meta)
    calibration = calibrate(chain, table, instrument="charis", cross_validate=False)
    calibration.write(path)
    return calibration


def write_sequences(folder, calibration, numbers):
    """A star of its own polarization in each sequence, a folder per sequence."""
    chain = CHARIS.on_sky(calibration.chain)
    y, x = np.indices(SHAPE)
    places = np.add(CENTRE, CHARIS.files.star_offset), CENTRE
    images = [np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 8) for at in places]
    hwp = np.resize([0, 45, 22.5, 67.5], N_FRAMES)
    for number in numbers:
        rng = np.random.default_rng(number)
        parallactic = np.linspace(20, 22, N_FRAMES) + number % 40
        altitude = np.linspace(60, 61, N_FRAMES) + number % 15
        angles = {"hwp": hwp + 0.5 * parallactic + altitude, "derotator": np.full(N_FRAMES, 60.0)}
        angles |= {"parallactic": parallactic, "altitude": altitude}
        positions = {name: angle * u.deg for name, angle in angles.items()}
        rows = measurement_rows(chain, positions, CHARIS.wavelength)
        # below the saturation of a pixel
        flux = rows @ [5e4, *(5e4 * rng.uniform(-0.03, 0.03, 2)), 0]
        inside = Path(folder) / f"{number:05d}"
        inside.mkdir(parents=True, exist_ok=True)
        for i in range(N_FRAMES):
            cube = sum(flux[b, :, i, None, None] * images[b] for b in (0, 1))
            cube = cube + rng.normal(0, 0.5, cube.shape)
            header = fits.Header(
                {"INSTRUME": "CHARIS", "OBJECT": f"HD {number}", "FILTNAME": "Broadband",
                 "RET-ANG1": hwp[i], "D_IMRANG": 60.0, "PARANG": parallactic[i],
                 "ALTITUDE": altitude[i], "EXPTIME": 30.0,
                 "MJD": 60988.0 + number * _APART + i * 4e-4}
            )  # fmt: skip
            hdus = [fits.PrimaryHDU(header=header), fits.ImageHDU(cube.astype("f4"))]
            name = f"CRSA{number * N_FRAMES + i:08d}.fits"
            fits.HDUList(hdus).writeto(inside / name)


def correct(tree, calibration, out, *options, cut=True):
    """Run the command in a process of its own; return its summary and the seconds."""
    started = time.perf_counter()
    words = ["correct", tree, "--archive", out, "--calibration", calibration, "--any-date"]
    words += ["--json", f"{out}.json", "-q"]
    words += ["--centre", ",".join(map(str, CENTRE)), "--size", SIZE] if cut else []
    command = [sys.executable, "-m", "astropolcal.scripts.main", *map(str, (*words, *options))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode not in (0, 1):
        raise RuntimeError(done.stderr)
    summary = json.loads(Path(f"{out}.json").read_text())
    return summary | {"status": done.returncode}, time.perf_counter() - started


def differing(one, other):
    """Return the products that one of two folders lacks, or whose data differ in a bit."""
    names = {path.name for folder in (one, other) for path in Path(folder).glob("*.fits")}
    return sorted(name for name in names if _content(one, name) != _content(other, name))


def _content(folder, name):
    """Return the bytes of all data of a product, and its keywords but for the time it was made."""
    path = Path(folder) / name
    if not path.is_file():
        return None
    with fits.open(path) as hdus:
        data = [b"" if hdu.data is None else hdu.data.tobytes() for hdu in hdus]
        cards = [card for hdu in hdus for card in map(str, hdu.header.cards)]
    made = ("DATE ", "DATASUM", "CHECKSUM", "CREATED")
    return data, [c for c in cards if not c.startswith(made) and "created" not in c.lower()]


class LossyCluster:
    """A local cluster of dask whose first worker is killed when so many products are there."""

    def __init__(self, out, kill_at, workers=2):
        from distributed import LocalCluster

        self.out, self.kill_at, self.killed = Path(out), list(kill_at), []
        self._cluster = LocalCluster(
            n_workers=workers, threads_per_worker=1, processes=True, dashboard_address=None
        )
        self.address = self._cluster.scheduler_address
        self._watch = threading.Thread(target=self._kill, daemon=True)

    def __enter__(self):
        self._watch.start()
        return self

    def __exit__(self, *_):
        self.kill_at = []
        self._watch.join()
        self._cluster.close()

    def _kill(self):
        while self.kill_at:
            time.sleep(0.05)
            manifest = self.out / "manifest.jsonl"
            done = manifest.read_text().count("\n") if manifest.is_file() else 0
            if done < self.kill_at[0]:
                continue
            # the nanny starts another process in its place
            process = self._cluster.workers[0].process
            if process is None or process.pid is None:
                continue
            os.kill(process.pid, signal.SIGKILL)
            self.killed.append(process.pid)
            self.kill_at = self.kill_at[1:]


def measured(n, folder):
    """Return what was measured of so many sequences in a folder."""
    folder = Path(folder)
    tree, calibration = folder / "tree", folder / "calibration.asdf"
    write_sequences(tree, write_calibration(calibration), range(n))
    serial, serial_seconds = correct(tree, calibration, folder / "serial", "--workers", 1)
    with LossyCluster(folder / "cluster", (n // 4, n // 2)) as cluster:
        options = ("--cluster", cluster.address)
        parallel, cluster_seconds = correct(tree, calibration, folder / "cluster", *options)
    again, again_seconds = correct(tree, calibration, folder / "serial", "--workers", 1)
    size = sum(path.stat().st_size for path in tree.rglob("*.fits"))
    return {
        "sequences": n,
        "frames": n * N_FRAMES,
        "frames_per_sequence": N_FRAMES,
        "megabytes_per_frame": round(size / (n * N_FRAMES) / 1e6, 3),
        "seconds_per_sequence": round(serial["median_seconds"], 3),
        "serial_seconds": round(serial_seconds, 1),
        "cluster_workers": 2,
        "cluster_seconds": round(cluster_seconds, 1),
        "resume_seconds": round(again_seconds, 1),
        "resumed_sequences": again["n_worked_on"],
        "worker_megabytes": max(serial["most_megabytes"], parallel["most_megabytes"]),
        "workers_killed": len(set(cluster.killed)),
        "done": parallel["n_done"],
        "failed": serial["n_failed"] + parallel["n_failed"],
        "differing": len(differing(folder / "serial", folder / "cluster")),
        "load": round(os.getloadavg()[1], 1),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        "date": time.strftime("%Y-%m"),
    }


def measured_headers(n, folder):
    """Return what the index of so many sequences costs, by one process, and again unchanged."""
    folder = Path(folder)
    for number in range(n):
        inside = folder / "tree" / f"{number:05d}"
        inside.mkdir(parents=True)
        for i in range(N_FRAMES):
            header = fits.Header(
                {"INSTRUME": "CHARIS", "OBJECT": f"HD {number}", "FILTNAME": "Broadband",
                 "RET-ANG1": 22.5 * i, "D_IMRANG": 60.0, "EXPTIME": 30.0,
                 "MJD": 60988.0 + number * _APART + i * 4e-4}
            )  # fmt: skip
            name = f"CRSA{number * N_FRAMES + i:08d}.fits"
            fits.PrimaryHDU(header=header).writeto(inside / name)
    times = []
    for _ in range(2):
        started = time.perf_counter()
        with closing(Index(folder / "index.sqlite")) as index:
            index.update(folder / "tree", workers=1)
            assert sum(1 for _ in index.sequences(gap=1800)) == n
        times.append(1e3 * (time.perf_counter() - started) / (n * N_FRAMES))
    return {
        "header_milliseconds": round(times[0], 2),
        "unchanged_header_milliseconds": round(times[1], 3),
    }


def measured_cubes(n, folder):
    """Return what a frame of whole cubes costs: the star is found, the images are turned."""
    folder, n_frames = Path(folder), 16
    calibration = write_calibration(folder / "calibration.asdf")
    frames = half_wave_plate_cycles([0, 45, 22.5, 67.5] * u.deg, np.linspace(60, 62, 4) * u.deg)
    frames["parallactic"] = np.linspace(20, 26, n_frames) * u.deg
    frames["altitude"] = np.linspace(70, 72, n_frames) * u.deg
    simulate_cubes(
        folder / "tree", CHARIS.on_sky(calibration.chain), CHARIS, frames,
        source="star", stokes=(1, 0.03, -0.02, 0), flux=2e6,
        files=CubeFiles(headers={"OBJECT": "HD 1"}, raw=False),
    )  # fmt: skip
    options = ("--workers", 1, "--rotation", "pupil", "--size", 151)
    found, _ = correct(
        folder / "tree", folder / "calibration.asdf", folder / "out", *options, cut=False
    )
    if found["failed"]:
        raise RuntimeError(found["failed"])
    return {
        "cube_seconds_per_frame": round(found["median_seconds"] / n_frames, 3),
        "cube_megabytes": found["most_megabytes"],
    }


_PARTS = {"sequences": measured, "headers": measured_headers, "cubes": measured_cubes}


def main():
    parser = argparse.ArgumentParser(description=__doc__.strip().splitlines()[0])
    parser.add_argument("file", type=Path)
    parser.add_argument("number", type=int, nargs="?", default=2000)
    parser.add_argument("--part", action="append", choices=_PARTS, help="measure this part only")
    arguments = parser.parse_args()
    found = json.loads(arguments.file.read_text()) if arguments.part else {}
    for part in arguments.part or _PARTS:
        with tempfile.TemporaryDirectory() as folder:
            found |= _PARTS[part](arguments.number, folder)
    text = json.dumps(found, indent=1) + "\n"
    arguments.file.write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
