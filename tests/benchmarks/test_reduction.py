# Licensed under a 3-clause BSD style license - see LICENSE
"""
Speed of the reduction of cubes, against a plain loop with photutils.

Not part of the normal run: ``pytest tests/benchmarks``.
"""

import time

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from timing import fastest, in_new_process

from astropolcal import instruments
from astropolcal.reduction import reduce_run
from astropolcal.reduction.cubes import simulate_cubes
from astropolcal.simulation import half_wave_plate_cycles

N_CUBES = 100
GOALS = {"star": 20.0, "internal": 5.0}
NAMES = {"star": "a star", "internal": "a lamp"}
MEMORY = 500.0


@pytest.fixture(scope="module", params=["star", "internal"])
def run(request, tmp_path_factory):
    """Cubes of 22 x 201 x 201 pixels."""
    folder = tmp_path_factory.mktemp(request.param)
    charis = instruments.get("charis")
    frames = half_wave_plate_cycles(
        hwp=[0, 45, 22.5, 67.5] * u.deg, derotator=np.linspace(45, 135, N_CUBES // 4) * u.deg
    )
    frames["parallactic"] = np.linspace(20, 30, len(frames)) * u.deg
    frames["altitude"] = np.linspace(60, 61, len(frames)) * u.deg
    chain = charis.chain("unpolarized", ["nbs"])
    flux = 1e6 if request.param == "star" else 1e7
    paths = simulate_cubes(folder, chain, charis, frames, source=request.param, flux=flux, seed=3)
    return request.param, paths, folder / "raw"


def reduced(paths, source, raw):
    """Return the number of frames and the time of the processor (s)."""
    started = time.process_time()
    reduction = reduce_run(paths, "charis", source=source, raw=raw)
    return len(reduction.frames), time.process_time() - started


def test_run_of_a_hundred_cubes(run, measured):
    source, paths, raw = run
    (n, seconds), memory = in_new_process(reduced, paths, source, raw)
    measured(f"reduction of {N_CUBES} cubes, {NAMES[source]}", seconds, memory=memory)
    assert n == N_CUBES
    assert seconds < GOALS[source]
    assert memory < MEMORY


def test_against_a_plain_loop(run, measured):
    """The loop has the places of the star given; it need not find it."""
    source, paths, raw = run
    few = paths[:2]
    loop = plain_star if source == "star" else plain_internal
    layout = instruments.get("charis").files

    def ours():
        return reduce_run(few, "charis", source=source, raw=raw, workers=1)

    def theirs():
        return [loop(path, layout) for path in few]

    flux = np.array([frame.photometry.flux for frame in ours().frames])
    np.testing.assert_allclose(np.array(theirs()), flux, rtol=0.01)
    times = fastest(ours, theirs, repeats=3, clock=time.process_time)
    ours, loop = (each / len(few) for each in times)
    measured(f"photometry of a cube, {NAMES[source]}", ours, {"loop with photutils": loop})
    assert times[1] > times[0]


def test_aperture_correction(run, measured):
    """The profile of the wings costs no more than the photometry does."""
    source, paths, raw = run
    if source != "star":
        pytest.skip("an internal source has no wings")

    def reduce(**options):
        return reduce_run(paths[:4], "charis", source=source, raw=raw, workers=1, **options)

    clock = time.process_time
    plain, corrected = fastest(
        reduce, lambda: reduce(aperture_correction=True), repeats=3, clock=clock
    )
    measured("the same with an aperture correction", corrected / 4)
    assert corrected < 4 * plain


def plain_internal(path, layout):
    from photutils.aperture import RectangularAperture, aperture_photometry

    left, right, width, height, angle = layout.internal_apertures
    cube = fits.getdata(path, 1)
    apertures = [RectangularAperture(place, width, height, theta=angle) for place in (right, left)]
    return [[aperture_photometry(image, a)["aperture_sum"][0] for image in cube] for a in apertures]


def plain_star(path, layout):
    from photutils.aperture import (
        ApertureStats,
        CircularAnnulus,
        CircularAperture,
        aperture_photometry,
    )
    from photutils.psf import fit_2dgaussian

    left, right, *_ = layout.internal_apertures
    middle = (np.add(left, right) - layout.star_offset) / 2
    fluxes = []
    cube = fits.getdata(path, 1).astype(float)
    for place in (middle + layout.star_offset, middle):
        fluxes.append([])
        for image in cube:
            level = np.median(image)
            fit = fit_2dgaussian(
                image - level, xypos=tuple(place), fit_shape=21, fwhm=5.0, fix_fwhm=False
            ).results
            where, width = (fit["x_fit"][0], fit["y_fit"][0]), fit["fwhm_fit"][0]
            aperture = CircularAperture(where, 3 * width)
            ring = CircularAnnulus(where, 3 * width, 3 * width + 5)
            total = aperture_photometry(image, aperture)["aperture_sum"][0]
            fluxes[-1].append(total - ApertureStats(image, ring).median * aperture.area)
    return fluxes
