# Licensed under a 3-clause BSD style license - see LICENSE
"""Drawings for the pages on conventions and on double differences."""

import astropy.units as u
import numpy as np

BLUE, VERMILION, GREEN, GREY = "#0072B2", "#D55E00", "#009E73", "0.45"


def _arrow(axis, angle, length=1.0, both=True, **style):
    """Draw an arrow at an angle that counts counter-clockwise from the vertical."""
    x, y = -length * np.sin(np.deg2rad(angle)), length * np.cos(np.deg2rad(angle))
    start = (-x, -y) if both else (0, 0)
    kind = "<->" if both else "->"
    axis.annotate("", (x, y), start, arrowprops={"arrowstyle": kind, "lw": 2} | style)


def _frame(axis, title):
    axis.set(xlim=(-1.75, 1.75), ylim=(-1.75, 1.75), aspect="equal")
    axis.set_title(title, y=0.98)
    axis.set_axis_off()


def _angle_panel(axis):
    _frame(axis, "angles, looking into the beam")
    axis.plot([0, 0], [-1.3, 1.3], color=GREY, lw=1)
    axis.plot([-1.3, 1.3], [0, 0], color=GREY, lw=1, ls=":")
    axis.text(0, 1.38, "vertical, 0°", ha="center", va="bottom")
    axis.text(-1.35, 0.06, "90°", ha="right", va="bottom")
    _arrow(axis, 30, 1.2, both=False, color=BLUE)
    turn = np.deg2rad(np.linspace(0, 30, 40))
    axis.plot(-0.7 * np.sin(turn), 0.7 * np.cos(turn), color=BLUE, lw=1.5)
    axis.text(-0.27, 0.83, r"$\theta$", color=BLUE, ha="center")
    axis.plot(0, 0, "o", ms=14, mfc="white", mec="black")
    axis.plot(0, 0, "o", ms=4, color="black")
    axis.text(0.2, -0.3, "light comes\ntowards you", ha="left", va="top", fontsize=9)


def _stokes_panel(axis):
    _frame(axis, "linear polarization")
    for angle, name, color, line in (
        (0, "+Q", BLUE, "-"),
        (90, "\N{MINUS SIGN}Q", BLUE, "--"),
        (45, "+U", VERMILION, "-"),
        (-45, "\N{MINUS SIGN}U", VERMILION, "--"),
    ):
        _arrow(axis, angle, 1.15, color=color, linestyle=line)
        x, y = -1.42 * np.sin(np.deg2rad(angle)), 1.42 * np.cos(np.deg2rad(angle))
        axis.text(x, y, name, color=color, ha="center", va="center", fontsize=13)


def _circular_panel(axis):
    _frame(axis, "circular polarization")
    turn = np.linspace(0, 2 * np.pi, 100)
    names = ("+V, right-handed", "\N{MINUS SIGN}V, left-handed")
    for centre, line, name in zip((-0.85, 0.85), ("-", "--"), names, strict=True):
        x, y = centre + 0.6 * np.cos(turn), 0.6 * np.sin(turn)
        axis.plot(x, y, color=GREEN, lw=2, ls=line)
        axis.text(centre, -1.0, name, color=GREEN, ha="center", va="center", fontsize=11)
    axis.text(0, 1.1, "$V = I_\\mathrm{R} - I_\\mathrm{L}$", ha="center", fontsize=12)


def _box(axis, x, text, color):
    style = {"boxstyle": "round,pad=0.4", "facecolor": "white", "edgecolor": color, "linewidth": 2}
    axis.text(x, 0, text, ha="center", va="center", fontsize=9.5, bbox=style)


def _train_panel(axis):
    optics = (
        ("sky\n$T(p)$", GREY),
        ("M3", BLUE),
        ("altitude\n$T(-a)$", GREY),
        ("half-wave plate\n$\\theta_\\mathrm{HWP} + \\delta$", VERMILION),
        ("derotator\n$\\theta_\\mathrm{der} + \\delta$", VERMILION),
        ("dichroic,\nbeam switcher", BLUE),
        ("Wollaston\nprism", GREEN),
    )
    axis.set(xlim=(-0.7, len(optics) + 0.9), ylim=(-0.75, 0.9))
    axis.set_axis_off()
    axis.plot([-0.6, len(optics) - 1], [0, 0], color="black", lw=1.5, zorder=0)
    for y, name in (
        (0.5, "right beam\nordinary, $+\\eta$"),
        (-0.5, "left beam\nextraordinary, $-\\eta$"),
    ):
        tip = {"arrowstyle": "->", "lw": 1.5}
        axis.annotate("", (len(optics) - 0.15, y), (len(optics) - 1, 0), arrowprops=tip, zorder=0)
        axis.text(len(optics) - 0.1, y, name, ha="left", va="center", fontsize=9.5)
    for x, (text, color) in enumerate(optics):
        _box(axis, x, text, color)
    axis.set_title("a chain is written in the order of the light", fontsize=11)


def conventions():
    """Draw angles, Stokes parameters and the order of a chain into a new figure of pyplot."""
    import matplotlib.pyplot as plt

    figure = plt.figure(figsize=(11, 6), layout="constrained")
    above, below = figure.subfigures(2, 1, height_ratios=(3, 1.6))
    panels = above.subplots(1, 3)
    for axis, draw in zip(panels, (_angle_panel, _stokes_panel, _circular_panel), strict=True):
        draw(axis)
    _train_panel(below.subplots())
    return figure


def _faults():
    from astropolcal import optics

    plate = optics.Diattenuator(diattenuation=0.01, mount="hwp", name="fault")
    derotator = optics.Diattenuator(diattenuation=0.01, mount="derotator", name="fault")
    behind = optics.Diattenuator(diattenuation=0.01, name="fault")
    retarder = optics.LinearRetarder(retardance=3 * u.deg, theta=45 * u.deg, name="fault")
    return {
        "gains of the beams, 1 %": (optics.BeamGain(imbalance=0.01, name="fault"), {}),
        "diattenuation after\nthe derotator, 1 %": (behind, {"before": "wollaston"}),
        "diattenuation of\nthe derotator, 1 %": (derotator, {"after": "derotator"}),
        "diattenuation of\nthe plate, 1 %": (plate, {"after": "hwp"}),
        "retarder after\nthe derotator, 3 deg": (retarder, {"before": "wollaston"}),
    }


def _single_and_double(chain, wavelength, frames):
    from astropolcal.simulation import simulate

    run = simulate(chain, wavelength, frames, noise=False)
    difference, total = run.flux_right - run.flux_left, run.flux_right + run.flux_left
    plus, minus = run.pairs().T
    double = (difference[plus] - difference[minus]) / (total[plus] + total[minus])
    return difference / total, double


def hidden_by_double_differences():
    """Draw what five faults do to single and double differences into a new figure of pyplot."""
    import matplotlib.pyplot as plt

    from astropolcal import instruments
    from astropolcal.chain import insert_optic
    from astropolcal.simulation import half_wave_plate_cycles

    charis = instruments.get("charis")
    wavelength = charis.wavelength[[4, 9, 15]]
    chain = charis.chain(derotator="linear", wavelength=wavelength)
    frames = half_wave_plate_cycles(derotator=[50, 75, 100] * u.deg)
    nominal = _single_and_double(chain, wavelength, frames)
    sizes = []
    for optic, place in _faults().values():
        faulty = insert_optic(chain, optic, **place) if place else chain | optic
        changed = _single_and_double(faulty, wavelength, frames)
        pairs = zip(changed, nominal, strict=True)
        sizes.append([100 * np.sqrt(np.mean((a - b) ** 2)) for a, b in pairs])
    sizes, at = np.array(sizes), np.arange(len(sizes))
    figure, axis = plt.subplots(figsize=(9, 4.2), layout="constrained")
    axis.hlines(at, sizes.min(axis=1), sizes.max(axis=1), color="0.7", lw=2, zorder=1)
    single = {"color": VERMILION, "s": 90, "marker": "s", "label": "single differences"}
    axis.scatter(sizes[:, 0], at, **single)
    axis.scatter(sizes[:, 1], at, color=BLUE, s=60, label="double differences", zorder=3)
    axis.set_yticks(at, list(_faults()))
    axis.invert_yaxis()
    axis.set(xscale="log", xlabel="rms change (% of polarization)")
    axis.grid(True, axis="x", color="0.9")
    axis.set_axisbelow(True)
    figure.legend(loc="outside upper center", ncols=2, frameon=False)
    return figure
