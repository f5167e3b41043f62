# Licensed under a 3-clause BSD style license - see LICENSE
"""Samples of a posterior: the corner plot."""

import numpy as np

from astropolcal.calibration.posterior.samples import ENOUGH, need
from astropolcal.exceptions import ParameterError
from astropolcal.plotting._style import BLUE, MINUS, VERMILION, canvas

__all__ = ["plot_corner"]

__doctest_requires__ = {"plot_corner": ["corner"]}

# more panels than this cannot be read
MAX_CORNER = 12
# behind words that stand on data
_PAPER = {"facecolor": "white", "edgecolor": "none", "alpha": 0.8, "pad": 1.5}
_MARGIN = 1.35
# a fitted value closer than this to the range of the samples is drawn, in widths of the range
_NEAR = 0.5


def plot_corner(posterior, parameters=None, *, fitted=True, figure=None):
    """
    Draw the samples of each pair of parameters, and of each alone.

    Parameters
    ----------
    posterior : Posterior
        The samples; its burn-in is left out.
    parameters : sequence of str, optional
        Names, such as ``hwp.w_sio2``; by default all.
    fitted : bool
        Whether to mark the values of the fit, where the posterior knows them.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    AstropolcalError
        If corner is not installed.
    ParameterError
        If a parameter is unknown, has not moved, or there are more than 12.

    Notes
    -----
    Contours hold 39, 86 and 99 % of the samples, 1, 2 and 3 sigma of a normal distribution of two
    parameters; dashed lines are the quantiles 0.16, 0.5 and 0.84. Given are the autocorrelation
    time of each parameter, in steps, and the correlation coefficient r of each pair.

    Examples
    --------
    >>> import numpy as np
    >>> import astropy.units as u
    >>> from astropolcal.calibration.posterior import Posterior
    >>> from astropolcal.plotting import plot_corner
    >>> chain = np.random.default_rng(1).normal(size=(500, 8, 2))
    >>> names = ["hwp.theta", "derotator.theta"]
    >>> len(plot_corner(Posterior(names, [u.deg, u.deg], chain, chain[..., 0])).axes)
    4
    """
    corner = need("corner", "the corner plot")
    columns = _columns(posterior, parameters, MAX_CORNER)
    samples = posterior.samples()[:, columns]
    stuck = [posterior.names[i] for i in columns[np.ptp(samples, axis=0) == 0]]
    if stuck:
        raise ParameterError(f"no corner plot: {', '.join(stuck)} did not move")
    labels, shifts = _labels(posterior, columns, samples)
    marks = posterior.fitted[columns] if fitted and posterior.fitted is not None else None
    size = 1.2 + 2.1 * len(columns)
    # corner sets margins of its own, which a layout engine would undo
    with canvas(figure, size, size, layout=None) as figure:
        corner.corner(
            samples - shifts,
            fig=figure,
            labels=labels,
            label_kwargs={"fontsize": 9.5},
            labelpad=0.06,
            quantiles=(0.16, 0.5, 0.84),
            # the content of 1, 2 and 3 sigma ellipses in two dimensions: 1 - exp(-s^2 / 2)
            levels=1 - np.exp([-0.5, -2.0, -4.5]),
            fill_contours=True,
            plot_datapoints=False,
            # enough samples in each to draw contours
            bins=int(np.clip(np.sqrt(len(samples)) / 3, 12, 50)),
            color=BLUE,
            max_n_ticks=4,
            hist_kwargs={"linewidth": 1.5},
        )
        marks = None if marks is None else marks - shifts
        _finish_corner(figure, posterior, columns, samples - shifts, marks)
    return figure


def _columns(posterior, parameters, most):
    names = posterior.names if parameters is None else list(parameters)
    if not 1 <= len(names) <= most:
        raise ParameterError(
            f"{len(names)} parameters for one figure; allowed are 1 to {most}: name some with "
            "parameters="
        )
    return np.array([posterior.index(name) for name in names])


def _labels(posterior, columns, samples):
    """Return axis labels, and what is taken off each parameter's values for legible ticks.

    A width of 0.1 um about 1654 um would leave no space for ticks.
    """
    labels, shifts = [], []
    for i, column in enumerate(columns):
        middle, width = np.median(samples[:, i]), np.ptp(samples[:, i])
        # decimals that resolve a tenth of the range
        digits = 1 - int(np.floor(np.log10(width)))
        shift = round(middle, digits - 1) if abs(middle) > 20 * width else 0.0
        taken = f"{'+' if shift < 0 else MINUS} {abs(shift):.{max(digits - 1, 0)}f}"
        labels.append(_label(posterior, column, taken if shift else ""))
        shifts.append(shift)
    return labels, np.array(shifts)


def _label(posterior, column, taken=""):
    """Return name and unit on two lines, as names are longer than panels are high."""
    optic, _, key = posterior.names[column].rpartition(".")
    unit = posterior.units[column]
    words = [key, taken, f"({unit})" if unit is not None else ""]
    return f"{optic}\n".lstrip() + " ".join(word for word in words if word)


def _finish_corner(figure, posterior, columns, samples, marks):
    n = len(columns)
    panels = np.array(figure.axes).reshape(n, n)
    for axes, time in zip(panels.diagonal(), posterior.autocorrelation_times[columns], strict=True):
        axes.set_title(f"τ = {time:.0f} steps", fontsize=10)
    for axes in figure.axes:
        axes.grid(False)
        axes.tick_params(labelsize=8.5)
    correlations, widths = np.atleast_2d(np.corrcoef(samples.T)), np.ptp(samples, axis=0)
    for row, column in zip(*np.tril_indices(n), strict=True):
        axes = panels[row, column]
        lines = [(axes.axvline, axes.get_xlim(), column)]
        if row != column:
            text = f"r = {correlations[row, column]:.4f}"
            look = {"xycoords": "axes fraction", "va": "top", "bbox": _PAPER, "fontsize": 8.5}
            axes.annotate(text, (0.04, 0.96), **look)
            lines.append((axes.axhline, axes.get_ylim(), row))
        for draw, (low, high), k in lines if marks is not None else ():
            # the fitted value, where that does not change the range by much
            if low - _NEAR * widths[k] < marks[k] < high + _NEAR * widths[k]:
                draw(marks[k], color=VERMILION, linewidth=1.2)
    width, height = figure.get_size_inches()
    figure.subplots_adjust(left=_MARGIN / width, bottom=_MARGIN / height)
    figure.suptitle(_heading(posterior, marks is not None), x=0.98, ha="right", va="top", y=0.98)


def _heading(posterior, marked):
    lines = [f"Posterior: {posterior.n_steps} steps of {posterior.chain.shape[1]} walkers"]
    lines.append(f"{int(posterior.n_times)} times the longest autocorrelation time τ")
    # fewer autocorrelation times than these say nothing of convergence
    if posterior.n_times < ENOUGH:
        lines.append("(CHAIN TOO SHORT)")
    elif not posterior.converged:
        lines.append("(NOT CONVERGED)")
    if posterior.is_thinned:
        lines.append(f"drawn: {posterior.log_prob.size} of {posterior.convergence.n_draws} samples")
    if marked:
        lines.append("orange: fitted values")
    return "\n".join(lines)
