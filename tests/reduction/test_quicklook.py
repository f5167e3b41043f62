# Licensed under a 3-clause BSD style license - see LICENSE
"""Figures of a run."""

import numpy as np
import pytest
from astropy.io import fits
from reduction_lab import Small, expose, pair, star_image, write_cube

from astropolcal.exceptions import ObservationError, ParameterError
from astropolcal.plotting.reduction import plot_apertures, plot_run, save_quicklook
from astropolcal.reduction import reduce_run


@pytest.fixture(scope="module")
def star_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("star")
    paths = []
    for i in range(3):
        cube = expose(star_image(pair(Small.files, x=70.0 + i)), Small.files, seed=i)
        cube[1] = np.nan if i == 1 else cube[1]
        paths.append(write_cube(folder / f"CRSA{i:08d}_cube.fits", cube, MJD=60982.5 + i / 1440))
    return reduce_run(paths, Small(), source="star")


@pytest.fixture(scope="module")
def flat_run(tmp_path_factory):
    path = tmp_path_factory.mktemp("flat") / "CRSA00000001_cube.fits"
    cube = expose(np.full((201, 201), 300.0), Small.files)
    return reduce_run([write_cube(path, cube)], Small())


def test_apertures_lie_where_the_photometry_put_them(star_run):
    figure = plot_apertures(star_run, wavelength=0)
    assert len(figure.axes) == 3
    circles = figure.axes[2].patches
    assert circles[2].center == pytest.approx((72.0, 85.2), abs=0.1)
    assert circles[2].radius == pytest.approx(star_run.frames[2].photometry.radius[1, 0])
    assert circles[3].radius - circles[2].radius == pytest.approx(5.0)


def test_a_masked_frame_says_so(star_run):
    figure = plot_apertures(star_run, frames=[1], wavelength=1)
    assert "MASKED: empty slice" in figure.axes[0].get_title()
    assert not figure.axes[0].patches
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "no value" in labels


def test_rectangles_of_the_internal_source(flat_run):
    figure = plot_apertures(flat_run)
    right, left = figure.axes[0].patches
    assert right.get_center() == pytest.approx((131.5, 116.25))
    assert left.get_center() == pytest.approx((71.75, 86.25))


def test_run_over_time(star_run, flat_run):
    figure = plot_run(star_run, wavelength=1)
    assert [axes.get_ylabel() for axes in figure.axes][-1] == "FWHM (pixel)"
    assert figure.axes[-1].get_xlabel() == "time since the first frame (min)"
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert "masked frame" in labels
    points = figure.axes[2].lines[0].get_ydata()
    assert np.isnan(points[1])
    assert points[2] - points[0] == pytest.approx(2.0, abs=0.1)
    assert len(plot_run(flat_run).axes) == 2


@pytest.mark.slow
def test_quicklook_files(star_run, tmp_path):
    written = save_quicklook(star_run, tmp_path / "look")
    assert [path.name for path in written] == ["apertures.png", "run.png"]
    assert all(path.stat().st_size > 10_000 for path in written)
    # folders are made as those of other figures are, unless a file is in their way
    assert save_quicklook(star_run, tmp_path / "a" / "b")[0].parent == tmp_path / "a" / "b"
    with pytest.raises(ObservationError, match=r"apertures\.png: cannot be made: .*File exists"):
        save_quicklook(star_run, written[0])


def test_indices_are_checked(star_run):
    for plot in (plot_apertures, plot_run):
        with pytest.raises(ParameterError, match="wavelength = 9"):
            plot(star_run, wavelength=9)
    with pytest.raises(ParameterError, match="frames"):
        plot_apertures(star_run, frames=[3])


def test_a_cube_that_has_gone_is_an_error(star_run, tmp_path):
    frame = star_run.frames[0]
    path, frame.path = frame.path, str(tmp_path / "gone.fits")
    try:
        with pytest.raises(ObservationError, match="no such file"):
            plot_apertures(star_run)
    finally:
        frame.path = path
    assert fits.getheader(path)["INSTRUME"] == "CHARIS"
