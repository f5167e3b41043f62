# Licensed under a 3-clause BSD style license - see LICENSE
"""Corrected science: images of the Stokes parameters."""

import numpy as np

from astropolcal.exceptions import ParameterError
from astropolcal.plotting import _style as st

__all__ = ["plot_images"]

_POLARIZED = ("Q", "U", "Q$_\\phi$", "U$_\\phi$")


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
        raise ParameterError("these are spectra; plot_images draws images")
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
