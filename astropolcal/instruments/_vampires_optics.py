# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics of VAMPIRES, ready to be calibrated."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.instruments._subaru_optics import misaligned, two_layer_plate
from astropolcal.instruments.telescope import k_mirror, tertiary_mirror

# where fits start: wavelength in nm, and retardances in deg
_START_AT = (610.0, 670.0, 725.0, 775.0)
_HALF_WAVE_PLATE = (-158.0, -165.0, -171.0, -173.0)
_DEROTATOR = (281.0, 245.0, 204.0, 176.0)


def silver(name):
    return optics.MetalMirror(material="silver", incidence=45 * u.deg, name=name)


def mirror(model, grid):
    """Return the tertiary mirror, ready to be calibrated."""
    mirror = tertiary_mirror(model, grid)
    if model == "free":
        mirror.diattenuation = silver("m3").diattenuation(grid)
        mirror.retardance = silver("m3").retardance(grid)
    return mirror


def _normal(mean, std):
    from scipy.stats import norm

    return norm(mean, std)


def _starts(grid, values):
    return np.interp(grid.to_value(u.nm), _START_AT, values) * u.deg


def half_wave_plate(grid, kind):
    settings = misaligned(0)
    if kind == "two-layer":
        return two_layer_plate(**settings)
    # the branch of our sign: without it (H, 45, R) and (-H, -45, R) fit alike
    settings["bounds"] |= {"retardance": (-180, -90)}
    start = _starts(grid, _HALF_WAVE_PLATE)
    return optics.LinearRetarder(retardance=start, mount="hwp", name="hwp", **settings)


def derotator(grid, kind):
    settings, start = misaligned(0), _starts(grid, _DEROTATOR)
    main = "retardance" if kind == "linear" else "horizontal"
    settings["bounds"] |= {main: (0, 360)}
    settings |= {"mount": "derotator", "name": "derotator"}
    if kind == "kmirror":
        return k_mirror(**misaligned(0), mount="derotator", name="derotator")
    if kind == "linear":
        return optics.LinearRetarder(retardance=start, **settings)
    settings["bounds"] |= {"diagonal": (-90, 90), "circular": (-90, 90)}
    # off the point where the two small ones vanish
    small = np.full(grid.size, 1.0) * u.deg
    derotator = optics.EllipticalRetarder(
        horizontal=start, diagonal=-small, circular=small, **settings
    )
    derotator.diagonal.prior = derotator.circular.prior = _normal(0, 10)
    return derotator


def relay(size):
    """Return what stands between derotator and liquid crystal, the dichroics included."""
    relay = optics.DiattenuatorRetarder(
        diattenuation=np.full(size, 0.01),
        retardance=np.full(size, -30.0) * u.deg,
        name="relay",
        bounds={"diattenuation": (-0.6, 0.6), "retardance": (-180, 180)},
    )
    # wide: a retarder here looks like one in the derotator, unless that turns far
    relay.retardance.prior = _normal(0, 45)
    return relay


def liquid_crystal(size):
    settings = misaligned(0, most=20)
    settings["bounds"] |= {"retardance": (90, 270), "switching_angle": (30, 60)}
    crystal = optics.FerroelectricLiquidCrystal(
        retardance=np.full(size, 180.0) * u.deg,
        switching_angle=43 * u.deg,
        mount="flc_state",
        name="flc",
        **settings,
    )
    crystal.retardance.prior, crystal.theta.prior = _normal(180, 15), _normal(0, 2)
    # a smaller switching angle looks like a lower efficiency of the splitter, hence the prior
    crystal.switching_angle.prior = _normal(43, 2)
    return crystal


def cameras(size):
    cameras = optics.BeamGain(imbalance=np.zeros(size), name="cameras")
    # pairs of both states see it in second order only, hence the prior
    cameras.imbalance.prior = _normal(0, 0.1)
    return cameras


def splitter(size):
    """Return the polarizing beam splitter; an efficiency above one is none."""
    wollaston = optics.WollastonPrism(efficiency=np.full(size, 0.95), name="wollaston")
    wollaston.efficiency.prior = _normal(0.95, 0.03)
    return wollaston
