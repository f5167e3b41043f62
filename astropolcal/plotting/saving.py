# Licensed under a 3-clause BSD style license - see LICENSE
"""All figures of a calibration as files."""

from contextlib import suppress
from functools import partial
from pathlib import Path

import numpy as np

from astropolcal.exceptions import (
    AstropolcalError,
    CalibrationFileError,
    ChainError,
    ObservationError,
    warn,
)
from astropolcal.files import understood
from astropolcal.plotting._style import save
from astropolcal.plotting.accuracy import plot_accuracy, plot_star_check, plot_target_accuracy
from astropolcal.plotting.identifiability import plot_correlations, plot_identifiability
from astropolcal.plotting.parameters import (
    other_parameters,
    plot_efficiency,
    plot_mirrors,
    plot_parameters,
    plot_retardances,
)
from astropolcal.plotting.posterior import MAX_CORNER, plot_corner
from astropolcal.plotting.residuals import plot_double_differences, plot_residuals
from astropolcal.progress import stage, steps

__all__ = ["save_all"]


def save_all(calibration, folder):
    """
    Write every figure that a calibration allows as PNG files.

    Figures for which the chain has no such optic, or the calibration no data (when it was read from
    a file), are left out. Each file appears complete or not at all; existing ones are replaced.

    Where the calibration has a posterior, ``corner.png`` shows the parameters common to all
    wavelengths, or else those of the longest autocorrelation times.

    Parameters
    ----------
    calibration : Calibration
        The calibration.
    folder : path-like
        Where to write; it is created if it does not exist.

    Returns
    -------
    list of `~pathlib.Path`
        The files: of ``double_differences.png`` (``double_differences_2.png`` for the second
        dataset, and so on), ``residuals.png``, ``accuracy.png``, ``targets.png``, ``mirrors.png``,
        ``star.png`` (one per star that was checked), ``retardances.png``, ``efficiency.png``,
        ``correlations.png``, ``identifiability.png``, ``other_parameters.png`` and
        ``corner.png`` those that could be drawn.

    Warns
    -----
    AstropolcalWarning
        If the figure of the posterior cannot be drawn, for instance as corner is not installed.

    Raises
    ------
    AstropolcalError
        If the folder or a file cannot be written.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, optics
    >>> from astropolcal.plotting import save_all
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> chain = (optics.LinearPolarizer(name="polarizer")
    ...          | optics.LinearRetarder(retardance=170 * u.deg, mount="hwp", name="hwp")
    ...          | optics.WollastonPrism(efficiency=0.98, name="wollaston"))
    >>> frames = half_wave_plate_cycles(derotator=[45, 90] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, [1.2, 1.6] * u.um, frames, seed=1))
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     [path.name for path in save_all(cal, folder)][:3]
    ['double_differences.png', 'residuals.png', 'identifiability.png']
    """
    folder = Path(folder)
    with understood(folder, AstropolcalError, "cannot be created", reads=False):
        folder.mkdir(parents=True, exist_ok=True)
    paths = []
    stage("drawing")
    for name, draw in steps(list(_figures(calibration)), "figures"):
        # no such optic, no data in a file, or no datum left: the figure has nothing to show
        with suppress(ChainError, CalibrationFileError, ObservationError):
            paths.append(save(draw(), folder / f"{name}.png"))
    if (posterior := calibration.posterior) is not None:
        path = folder / "corner.png"
        # a package that is not installed, or a parameter that did not move
        try:
            paths.append(save(plot_corner(posterior, _drawn(posterior)), path))
        except AstropolcalError as error:
            warn(f"{path} is not drawn: {error}")
    return paths


def _drawn(posterior):
    """Return what is common to all wavelengths, or else the slowest, as many as a figure holds."""
    names = posterior.names
    if len(names) <= MAX_CORNER:
        return names
    # one per wavelength ends in its index: hwp.retardance[3]
    common = [name for name in names if not name.endswith("]")]
    times = posterior.autocorrelation_times
    # what does not move comes first
    order = np.argsort(-np.where(np.isnan(times), np.inf, times), kind="stable")
    return (common or [names[i] for i in order])[:MAX_CORNER]


def _figures(calibration):
    """Yield the name of each figure and what draws it."""
    for i in range(len(calibration.datasets)):
        name = "double_differences" + (f"_{i + 1}" if i else "")
        yield name, partial(plot_double_differences, calibration, dataset=i)
    plots = {"residuals": plot_residuals, "identifiability": plot_identifiability}
    plots |= {"accuracy": plot_accuracy, "retardances": plot_retardances}
    plots |= {"targets": plot_target_accuracy, "mirrors": plot_mirrors}
    for i, entry in enumerate(calibration.fit.get("stars", [])):
        plots["star" + (f"_{i + 1}" if i else "")] = partial(plot_star_check, entry=entry)
    plots |= {"efficiency": plot_efficiency, "correlations": plot_correlations}
    for name, plot in plots.items():
        yield name, partial(plot, calibration)
    yield "other_parameters", lambda: plot_parameters(calibration, other_parameters(calibration))
