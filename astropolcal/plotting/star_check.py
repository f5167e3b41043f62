# Licensed under a 3-clause BSD style license - see LICENSE
"""Polarization of a standard star as calibrated, against the catalogue."""

import numpy as np

from astropolcal.plotting._style import (
    BLUE,
    GREY,
    MINUS,
    SIGMA,
    VERMILION,
    canvas,
    heading,
    legend_entries,
    legend_outside,
    style,
    wavelength_label,
)

__all__ = ["plot_star_check"]

_QUANTITIES = (("dolp", "percent", "DoLP (%)", "%"), ("aolp", "deg", "AoLP (°)", "°"))


def plot_star_check(calibration, entry=None, *, figure=None):
    """
    Draw degree and angle of polarization of a standard star against wavelength.

    Parameters
    ----------
    calibration : Calibration
        A calibration that was checked with a star; one read from a file will do.
    entry : dict, optional
        One of ``calibration.fit["stars"]``, by default the last.
    figure : `~matplotlib.figure.Figure`, optional
        An empty figure to draw into.

    Returns
    -------
    `~matplotlib.figure.Figure`
        Left the degree, right the angle: above observed and catalogue, below their
        difference. Bars are standard errors of the mean over the cycles; the dashes
        are the rms error of single cycles.

    Raises
    ------
    ObservationError
        If the calibration was checked with no star.

    Notes
    -----
    The figure of the polarized standard of McIntosh et al. (2026, appendix).

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments, optics
    >>> from astropolcal.calibration.validation.stars import add_star_check
    >>> from astropolcal.plotting import plot_star_check
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> lam = [1.2, 1.6, 2.2] * u.um
    >>> chain = charis.chain(derotator="linear", wavelength=lam)
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, lam, frames, seed=2))
    >>> sky = optics.PolarizedSource(u=0.01, name="star") | chain["hwp"] | chain["derotator"]
    >>> sky = sky | chain["wollaston"]
    >>> night = simulate(sky, lam, frames, seed=3, meta={"object": "HD 30675"})
    >>> table = add_star_check(cal, sky, night)
    >>> len(plot_star_check(cal).axes)
    4
    """
    entry = _last(calibration) if entry is None else entry
    values = {key: np.asarray(value) for key, value in entry.items() if isinstance(value, list)}
    with style():
        figure = canvas(figure, 12, 6.4)
        panels = figure.subplots(2, 2, sharex=True, height_ratios=(2, 1))
        for (top, bottom), quantity in zip(panels.T, _QUANTITIES, strict=True):
            _draw(top, bottom, values, *quantity)
            wavelength_label(bottom)
        what = f"{entry['star']}, which no fit saw"
        heading(figure, calibration, what, [entry["name"]])
        legend_outside(figure, list(legend_entries(panels.ravel()).values()), columns=2)
    return figure


def _last(calibration):
    from astropolcal.exceptions import ObservationError

    if not calibration.fit.get("stars"):
        raise ObservationError("the calibration was checked with no star: nothing to draw")
    return calibration.fit["stars"][-1]


def _draw(top, bottom, values, key, unit, label, short):
    # lines are drawn through the points as they come
    order = np.argsort(values["wavelength_nm"])
    lam = values["wavelength_nm"][order]
    seen, error, known, spread, off = (
        values[f"{key}{part}_{unit}"][order]
        for part in ("", "_err", "_known", "_known_err", "_error")
    )
    points = {"color": BLUE, "marker": "o", "linestyle": "none"}
    observed = f"observed, with 1{SIGMA} errors of the mean"
    top.errorbar(lam, seen, yerr=np.nan_to_num(error), label=observed, **points)
    # a star whose polarization no catalogue has is drawn alone
    if np.isfinite(known).any():
        top.plot(lam, known, color=VERMILION, label="catalogue, with the published errors")
        top.fill_between(lam, known - spread, known + spread, color=VERMILION, alpha=0.2, lw=0)
    bottom.axhline(0, color=GREY, linewidth=1)
    bottom.errorbar(lam, off, yerr=np.nan_to_num(error), **points)
    # of the angle no such error is known
    if key == "dolp":
        single = values["s_dolp_percent"][order]
        for sign in (1, -1):
            label_of = "± rms error of a single cycle" if sign > 0 else None
            bottom.plot(lam, sign * single, color=GREY, linestyle="--", label=label_of)
    top.set_ylabel(label)
    bottom.set_ylabel(f"obs. {MINUS} catalogue\n({short})")
