# Licensed under a 3-clause BSD style license - see LICENSE
"""
The figure of the first page and of the README: ``python docs/draw_landing.py`` writes it anew.

The packaged example is calibrated, and diagnosed with a derotator that is too simple for it.
"""

import json
from importlib.resources import files
from pathlib import Path

import astropy.units as u
import numpy as np

from astropolcal import Observations, calibrate, instruments
from astropolcal.gap import diagnose
from astropolcal.plotting import plot_gap_spectrum
from astropolcal.plotting._style import BLUE, COLORS, GREY, MARKERS, VERMILION, canvas
from astropolcal.plotting.residuals import DataGrid

FIGURE = Path(__file__).resolve().parent / "images" / "landing.png"
_OPTICS = "polarized\nlamp|half-wave\nplate|derotator|dichroic|beam\nswitcher|Wollaston\nprism"


def _draw_chain(axes):
    axes.set(xlim=(-0.5, 5.6), ylim=(-0.5, 0.5), title="1. Describe the chain of optics")
    axes.axis("off")
    axes.annotate("", (5.6, 0), (-0.4, 0), arrowprops={"arrowstyle": "->", "color": GREY})
    for x, words in enumerate(_OPTICS.split("|")):
        colors = ("#fbe7c2", "turns") if x in (1, 2) else ("#e4eef8", "")
        box = {"boxstyle": "round,pad=0.4", "facecolor": colors[0], "edgecolor": GREY}
        axes.text(x, 0, words, ha="center", va="center", fontsize=9.5, bbox=box)
        axes.text(x, -0.44, colors[1], ha="center", va="center", fontsize=9.5)


def _draw_data(top, bottom, cal):
    drawn = DataGrid(cal, 0)
    (row,) = drawn.nearest_bins([1575] * u.nm)
    angle, fine = drawn.abscissa, np.linspace(42, 136, 200)
    for one, color, marker in zip(drawn.series(), COLORS, MARKERS, strict=False):
        look = {"color": color, "marker": marker, "linestyle": "none", "label": one.label}
        top.plot(angle[one.data], drawn.observed[row, one.data], **look)
        top.plot(fine, drawn.curve(one, [row], fine)[0], color=color)
        bottom.plot(angle[one.data], 100 * drawn.residual[row, one.data], **look)
    nm = drawn.wavelength[row]
    top.set(title=f"2. Calibrate: data and fit at {nm:.0f} nm", ylabel="double\ndifference")
    top.tick_params(labelbottom=False)
    top.legend(title="half-wave plate at", loc="center left", bbox_to_anchor=(1, 0.5))
    bottom.set(xlabel="derotator angle (°)", ylabel="residual\n(%)", ylim=(-0.2, 0.2))


def _draw_gap(axes, diagnosis):
    floor, after, before = (
        line.get_xydata().T for line in plot_gap_spectrum(diagnosis).axes[0].lines
    )
    axes.fill_between(*floor, color="0.85", label="noise")
    axes.semilogy(*before, "s--", color=VERMILION, markerfacecolor="none", label="derotator linear")
    axes.semilogy(*after, "o-", color=BLUE, label="with this cause")
    axes.set(title="3. Diagnose: what a model lacks", ylabel="gap (%)", xlabel="wavelength (nm)")
    axes.set_ylim(bottom=0.02)
    axes.set_yticks([0.1, 1], ["0.1", "1"])
    (cause,) = diagnosis.causes
    named = {"derotator_elliptical_retardance": "45° and circular\nretardance"}[cause.name]
    axes.legend(
        title=f"derotator lacks\n{named}: {100 * cause.probability:.0f} %\n",
        loc="center left",
        bbox_to_anchor=(1, 0.5),
        title_fontproperties={"weight": "bold", "size": 10},
    )


def draw():
    """Return the figure."""
    charis = instruments.get("charis")
    observations = Observations.read(files("astropolcal") / "data" / "charis_example.ecsv")
    cal = calibrate(charis.chains_for([observations]), observations, cross_validate=False)
    diagnosis = diagnose(charis.chains_for([observations], derotator="linear"), observations)
    with canvas(None, 7.4, 7.4) as figure:
        above, below = figure.subfigures(2, height_ratios=(1, 6.2))
        chain = above.subplots()
        top, bottom, gap = below.subplots(3, height_ratios=(2.2, 0.9, 1.9))
        bottom.sharex(top)
        _draw_chain(chain)
        _draw_data(top, bottom, cal)
        _draw_gap(gap, diagnosis)
        for axes in (chain, top, gap):
            axes.set_title(axes.get_title(), loc="left", fontweight="bold")
            axes.set_title("")
    return figure


def content(figure):
    """Return the words of a figure and the numbers of its lines: what makes an older one stale."""
    lines = [line.get_xydata() for axes in figure.axes for line in axes.lines]
    words = [axes.get_title(loc="left") for axes in figure.axes]
    for axes in figure.axes:
        legend = axes.get_legend()
        words += [axes.get_xlabel(), axes.get_ylabel(), *(text.get_text() for text in axes.texts)]
        words += [legend.get_title().get_text()] if legend else []
        words += [text.get_text() for text in legend.get_texts()] if legend else []
    return {"words": words, "lines": [np.round(line, 6).tolist() for line in lines]}


if __name__ == "__main__":
    drawn = draw()
    drawn.savefig(FIGURE, dpi=160, metadata={"Comment": json.dumps(content(drawn))})
