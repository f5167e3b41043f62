# Licensed under a 3-clause BSD style license - see LICENSE
"""Corrected science: images of the Stokes parameters, spectra, how well they are determined."""

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.plotting import _style as st

__all__ = ["plot_images"]

_COLORS = {"q": st.BLUE, "u": st.VERMILION, "v": st.GREEN}
_MARKERS = {"q": "o", "u": "s", "v": "^"}
# statistical and systematic error of the degree
_LINES = (("o-", st.BLACK), ("s--", st.GREEN))
_POLARIZED = ("Q", "U", "Q$_\\phi$", "U$_\\phi$")


def plot_corrected(corrected, **options):
    """Draw corrected images or spectra, with the options of `plot_images` or `plot_spectrum`."""
    draw = plot_images if corrected.stokes.ndim == 4 else plot_spectrum
    return draw(corrected, **options)


def plot_images(corrected, *, wavelength=None, figure=None):
    """
    Draw I, Q, U, Q_phi, U_phi and the error of Q of images.

    Q_phi and U_phi are made as if north were up; where that is not known, the heading states it.

    Parameters
    ----------
    corrected : Corrected
        Images.
    wavelength : int, optional
        Index of the wavelength; by default the mean over all that are determined.
    figure : `~matplotlib.figure.Figure`, optional
        Where to draw.

    Returns
    -------
    `~matplotlib.figure.Figure`

    Raises
    ------
    ParameterError
        If these are not images, or there is no such wavelength.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import optics
    >>> from astropolcal.correction import ScienceFrames, correct
    >>> from astropolcal.plotting.correction import plot_images
    >>> chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    >>> chain = chain | optics.WollastonPrism(name="wollaston")
    >>> hwp = [0, 45, 22.5, 67.5] * u.deg
    >>> image = np.ones((4, 1, 9, 9))
    >>> found = correct(chain, ScienceFrames.from_arrays(image, image, [1.6] * u.um, {"hwp": hwp}))
    >>> [axes.get_title() for axes in plot_images(found).axes][:2]
    ['I', 'Q']
    """
    if corrected.stokes.ndim != 4:
        raise ParameterError("these are spectra; plot_spectrum draws them")
    panels = _panels(corrected, _chosen(corrected, wavelength))
    # Q, U and their azimuthal components hold the same flux: one scale for all four
    limit = _top(np.abs([panels[name] for name in _POLARIZED]))
    extent = _extent(corrected)
    with st.canvas(figure, 12.5, 8.2) as figure:
        grid = figure.subplots(2, 3, sharex=True, sharey=True)
        for axes, (name, image) in zip(grid.flat, panels.items(), strict=True):
            drawn, extend = _draw_image(axes, name, image, extent, limit)
            bar = figure.colorbar(drawn, ax=axes, shrink=0.85, extend=extend)
            bar.set_label(f"flux ({corrected.unit.to_string()} per pixel)")
        for axes in grid[:, 0]:
            axes.set_ylabel(_axis_label(corrected, "north" if corrected.north_up else "y"))
        for axes in grid[1]:
            axes.set_xlabel(_axis_label(corrected, "east" if corrected.north_up else "x"))
        figure.suptitle(_heading(corrected, wavelength))
        figure.supxlabel("+ star; grey: no value", fontsize=10.5)
    return figure


def _chosen(corrected, wavelength):
    count = corrected.stokes.shape[1]
    if wavelength is None:
        return np.flatnonzero(corrected.determined[:, :3].all(axis=1))
    if not -count <= wavelength < count:
        raise ParameterError(f"wavelength = {wavelength}; there are 0 to {count - 1}")
    return np.array([wavelength % count])


def _panels(corrected, chosen):
    """Return the images by name, in the order of the panels."""
    found = corrected.azimuthal()
    images = [corrected[name][chosen] for name in "IQU"]
    images += [found[name][chosen] for name in ("q_phi", "u_phi")]
    panels = dict(zip(("I", *_POLARIZED), map(st.mean_known, images), strict=True))
    error, kind = corrected.error("Q")[chosen], "statistical"
    if not np.isfinite(error).any():
        error, kind = corrected.error("Q", "systematic")[chosen], "systematic"
    # errors of wavelengths are independent if they are statistical, and hardly if not
    power = 2 if kind == "statistical" else 1
    mean = st.mean_known(error**power) ** (1 / power) / len(chosen) ** (1 - 1 / power)
    return panels | {f"{kind} error of Q": mean}


def _draw_image(axes, name, image, extent, limit):
    """Draw an image with its own scale of brightness, or the common one of polarization.

    Return it, and at which ends of the scale values lie beyond it.
    """
    look = {"cmap": "viridis", "vmin": 0.0, "vmax": _top(image)}
    if name in _POLARIZED:
        look = {"cmap": "RdBu_r", "vmin": -limit, "vmax": limit}
    elif name == "I":
        from matplotlib.colors import LogNorm

        bright = image[image > 0]
        low = max(bright.min(), 1e-4 * bright.max()) if bright.size else 0.1
        top = max(bright.max() if bright.size else 1.0, 1.001 * low)
        look = {"cmap": "viridis", "norm": LogNorm(low, top)}
        # what is darker, or negative, gets the darkest colour, not that of missing pixels
        image = np.where(image < low, low, image)
    drawn = axes.imshow(image, origin="lower", extent=extent, **look)
    axes.grid(False)
    axes.set_facecolor("0.75")
    axes.set_title(name)
    axes.plot(0, 0, "+", color=st.BLACK if name in _POLARIZED else "white")
    low, high = drawn.get_clim()
    with np.errstate(invalid="ignore"):
        beyond = (image > high).any() + 2 * (image < low).any()
    return drawn, ("neither", "max", "min", "both")[beyond]


def _top(values):
    known = values[np.isfinite(values)]
    # of the brightest pixels, those beyond this quantile may saturate the colours
    top = np.quantile(known, 0.995) if known.size else 1.0
    return top if top > 0 else 1.0


def _extent(corrected):
    """Return the edges of the image about the star; east is positive and to the left."""
    height, width = corrected.stokes.shape[2:]
    x, y = corrected._middle()
    # milliarcseconds to arcseconds
    step = 1.0 if corrected.pixel_scale is None else corrected.pixel_scale / 1000
    # pixel centres are whole numbers: the image reaches half a pixel further
    edges = np.array([-0.5 - x, width - 0.5 - x, -0.5 - y, height - 0.5 - y]) * step
    # east is to the left on the sky
    return edges * ([-1, -1, 1, 1] if corrected.north_up else 1)


def _axis_label(corrected, direction):
    unit = "pixels" if corrected.pixel_scale is None else "arcsec"
    return f"offset to the {direction} ({unit})" if corrected.north_up else f"{direction} ({unit})"


def _heading(corrected, wavelength):
    nm = st.nanometres(corrected.wavelength)
    count = corrected.determined[:, :3].all(axis=1).sum()
    of = f"mean of {count} wavelengths, {nm.min():.0f} to {nm.max():.0f} nm"
    of = of if wavelength is None else f"{nm[wavelength]:.0f} nm"
    of += "" if corrected.north_up else "; north is not known to be up"
    return f"Corrected Stokes parameters ({_MODES[corrected.mode]})\n{of}"


_MODES = {"stokes": "full Mueller matrices", "ip": "instrumental polarization only"}


def plot_spectrum(corrected, *, figure=None):
    """Draw q and u of a point source, their errors, and how well they are determined."""
    if corrected.stokes.ndim != 2:
        raise ParameterError("these are images; take an aperture, or draw them with plot_images")
    nm = st.nanometres(corrected.wavelength)
    with st.canvas(figure, 9.0, 9.5) as figure:
        top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=(3, 2, 1.3))
        for name in corrected.components[1:].lower():
            _values(top, nm, corrected, name)
        top.axhline(0, color=st.GREY, linewidth=0.8)
        top.set_ylabel("fraction of I (%)")
        known = corrected.polarization()
        errors = [100 * known[f"s_p_{kind}"] for kind in ("statistical", "systematic")]
        for values, label, look in zip(errors, ("statistical", "systematic"), _LINES, strict=True):
            if np.isfinite(values).any():
                middle.plot(nm, values, look[0], color=look[1], label=f"$s_p$, {label}")
        middle.set_ylabel("error of the degree (%)")
        if middle.lines:
            middle.set_yscale("log")
            st.plain_numbers(middle)
        else:
            st.note(middle, "no errors are known")
        bottom.plot(nm, corrected.condition, "o-", color=st.PURPLE)
        bottom.set_ylabel("condition")
        if np.nanmax(corrected.condition) >= 1e3:
            bottom.set_yscale("log")
        else:
            # 1 is the condition of an ideal instrument, the best there is
            bottom.set_ylim(bottom=1)
        st.wavelength_label(bottom)
        figure.suptitle(f"Corrected polarization ({_MODES[corrected.mode]})")
        handles = []
        for axes in (top, middle):
            entries = st.legend_entries([axes])
            # the errors of each quantity below each other, the statistical one first
            order = sorted(entries, key=lambda label: (label.split(",")[0], "systematic" in label))
            handles += [entries[label] for label in order]
        st.legend_outside(figure, handles, columns=len(corrected.components))
        figure.align_ylabels()
    return figure


def _values(axes, nm, corrected, name):
    value, color = 100 * getattr(corrected, name), _COLORS[name]
    statistical, systematic = (
        100 * corrected.fractional_errors(kind)[name] for kind in ("statistical", "systematic")
    )
    known = np.isfinite(statistical)
    label = f"{name}, statistical error" if known.any() else name
    # a point without an error keeps its place and has no bar
    bars = np.where(known, statistical, 0.0)
    axes.errorbar(nm, value, bars, fmt=_MARKERS[name], color=color, label=label)
    if (known := np.isfinite(systematic)).any():
        band = np.where(known, systematic, np.nan)
        st.draw_band(axes, nm, value, band, color, 0.25, f"{name}, systematic error")
