# Licensed under a 3-clause BSD style license - see LICENSE
"""Correlations between calibrated parameters."""

from itertools import pairwise

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.plotting._style import canvas, element_places, heading, legend_outside, style

__all__ = ["plot_correlations"]

# a parameter common to all wavelengths is drawn this much wider than one of a wavelength
_WIDE = 4.0
_SIZE, _MARGIN = 8.5, 2.6
# numbers are written into the cells of a matrix that is not larger than this
_FEW = 12
_PALE = 0.6


def plot_correlations(calibration, *, figure=None):
    """
    Draw the correlation matrix of the free parameters.

    Parameters given per wavelength form a block, short wavelengths first;
    those common to all wavelengths are drawn wider. Rows and columns of
    parameters without an error, because the data leave them open or because
    they sit at a bound, are hatched: there is no correlation to show.

    Parameters
    ----------
    calibration : Calibration, Resampled or Covariance
        What has the covariance; a calibration read from a file will do.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If there is no free parameter.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.plotting import plot_correlations
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> len(plot_correlations(cal).axes)
    2
    """
    covariance = getattr(calibration, "covariance", calibration)
    if not len(covariance):
        raise ParameterError("no free parameter, so no correlation to draw")
    groups = [(stem, len(at)) for stem, at in element_places(covariance.names).items()]
    with np.errstate(invalid="ignore"):
        matrix = covariance.correlation
    with style():
        figure = canvas(figure, _SIZE + _MARGIN, _SIZE + 1.4)
        axes = figure.add_subplot()
        edges = _edges(groups)
        image = _draw(axes, edges, matrix)
        _label(axes, edges, groups)
        if len(matrix) <= _FEW:
            _write(axes, edges, matrix)
        figure.colorbar(image, ax=axes, shrink=0.7, pad=0.02, label="correlation")
        _explain(figure, matrix)
        heading(figure, calibration, "Correlations of the parameters")
    return figure


def _edges(groups):
    """Return the borders of all cells; a parameter that stands alone is wider."""
    several = any(count > 1 for _, count in groups)
    widths = [
        np.full(count, _WIDE if count == 1 and several else 1.0) for _, count in groups
    ]  # fmt: skip
    return np.concatenate([[0.0], np.cumsum(np.concatenate(widths))])


def _draw(axes, edges, matrix):
    # what is not drawn lets the hatched background through
    axes.patch.set(facecolor="0.88", edgecolor="0.62", hatch="////")
    axes.grid(False)
    image = axes.pcolormesh(
        edges, edges, np.ma.masked_invalid(matrix), cmap="RdBu_r", vmin=-1, vmax=1, rasterized=True
    )
    axes.set(xlim=(0, edges[-1]), ylim=(edges[-1], 0), aspect="equal")
    return image


def _label(axes, edges, groups):
    """Name every group in its middle, and part it from the next."""
    ends = np.cumsum([0] + [count for _, count in groups])
    middles = [(edges[a] + edges[b]) / 2 for a, b in pairwise(ends)]
    labels = [f"{stem} ({count})" if count > 1 else stem for stem, count in groups]
    axes.set_xticks(middles, labels, rotation=45, ha="right", rotation_mode="anchor")
    axes.set_yticks(middles, labels)
    axes.tick_params(length=0)
    for border in edges[ends[1:-1]]:
        axes.axhline(border, color="0.25", linewidth=0.6)
        axes.axvline(border, color="0.25", linewidth=0.6)


def _write(axes, edges, matrix):
    middles = (edges[1:] + edges[:-1]) / 2
    for i, row in enumerate(matrix):
        for j, value in enumerate(row):
            if np.isfinite(value):
                color = "white" if abs(value) > _PALE else "black"
                text = f"{value:.2f}".replace("-", "\N{MINUS SIGN}")
                axes.text(middles[j], middles[i], text, color=color, ha="center", va="center")


def _explain(figure, matrix):
    """Say in a legend what the hatched rows are."""
    from matplotlib.patches import Patch

    without = int((~np.isfinite(np.diag(matrix))).sum())
    if without:
        label = f"{without} of {len(matrix)} parameters: left open by the data, or at a bound"
        hatched = Patch(facecolor="0.88", edgecolor="0.62", hatch="////", label=label)
        legend_outside(figure, [hatched])
