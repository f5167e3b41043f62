# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics of the cells that only a detector has, which follow the flux."""

import numpy as np

from astropolcal import optics
from astropolcal.measurement import Tie

__all__ = ["detector_optic"]


def detector_optic(kind, label, context):
    """
    Return the optic of a kind that belongs to a detector.

    Parameters
    ----------
    kind : str
        ``"background"``, ``"background_of_one_beam"``, ``"nonlinearity"``, ``"persistence"``
        or ``"crosstalk"``.
    label : str
        Name of the optic.
    context : Context
        Wavelengths and fluxes.

    Returns
    -------
    optic : Optic
        At zero, with its parameters free.
    side : {"before", "after"}
        On which side of the splitter.
    key : str
        The parameter that counts.
    ties : dict of str to Tie
        Parameters that follow it.
    """
    size, ties = np.zeros(len(context.wavelength)), {}
    if kind == "background":
        optic = optics.StrayLight(
            amount=size, reference=2 * context.flux, mount="total_flux", name=label
        )
        side, key = "before", "amount"
    elif kind == "crosstalk":
        optic = optics.Perturbation(amplitude=size, kind="depolarization_linear", name=label)
        side, key = "before", "amplitude"
    else:
        settings = {
            "background_of_one_beam": {"power": -1, "reference": context.flux, "mount": "flux"},
            "nonlinearity": {"power": 1, "reference": context.flux, "mount": "flux"},
            "persistence": {"power": -1, "reference": 1.0, "mount": "previous_flux"},
        }[kind]
        optic = optics.FluxGain(right=size, left=size, name=label, **settings)
        side, key = "after", "right"
        if kind != "background_of_one_beam":
            # one detector: the same law for both beams
            ties = {f"{label}.left": Tie(f"{label}.right")}
    free = {key, *(name.partition(".")[2] for name in ties)}
    for name in optic.param_names:
        getattr(optic, name).fixed = name not in free
    return optic, side, key, ties
