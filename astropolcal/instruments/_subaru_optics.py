# Licensed under a 3-clause BSD style license - see LICENSE
"""What the polarimeters at the Nasmyth focus of Subaru share: site, calibration unit, changes."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.instruments.telescope import mounted

#: Longitude, latitude (deg) and height (m) of the Subaru Telescope.
SITE = (-155.4761, 19.8255, 4139.0)

# 't Hart et al. 2021, thicknesses of the half-wave plate in mm
_THART_SIO2, _THART_MGF2 = 1.63398, 1.27711

#: What has changed; both days are known to the month only (McIntosh et al. 2026, Sec. 2 and 7).
CHANGES = (
    (None, "2025-08-01", "2025-10-01", "the Nasmyth beam switcher was installed"),
    ("m3", "2025-12-01", "2026-01-01", "the tertiary mirror M3 was coated anew"),
)


def misaligned(about, most=5):
    """Return what frees an angle within some degrees of where the optic should stand."""
    return {"fixed": {"theta": False}, "bounds": {"theta": (about - most, about + most)}}


def two_layer_plate(**settings):
    """Return the half-wave plate of both instruments, its thicknesses near the published ones."""
    settings["bounds"] |= {
        "w_sio2": (0.6 * _THART_SIO2, 1.4 * _THART_SIO2),
        "w_mgf2": (0.6 * _THART_MGF2, 1.4 * _THART_MGF2),
    }
    return optics.TwoLayerWaveplate(
        w_sio2=_THART_SIO2 * u.mm, w_mgf2=_THART_MGF2 * u.mm, mount="hwp", name="hwp", **settings
    )


def polarizer():
    """Return the polarizer of the calibration unit, which passes -Q."""
    return optics.LinearPolarizer(theta=90 * u.deg, name="calibration_polarizer", **misaligned(90))


def fold_mirror(size):
    """Return the mirror that polarizes the lamp where the polarizer is out."""
    return mounted(optics.Diattenuator(diattenuation=np.zeros(size), name="fold_mirror"))
