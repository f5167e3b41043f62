# Licensed under a 3-clause BSD style license - see LICENSE
"""
Coronagraph of the Nancy Grace Roman Space Telescope, linear polarimetry in bands 1 and 4.

One of two Wollaston prisms is in the beam, clocked by 45 deg, so that q and u are measured one
after the other (Groff et al.); nothing modulates. Rolls of the spacecraft turn the sky. The
centres of the bands, the keywords ``ROLL`` and ``DPAMNAME``, and the sign of the roll (the angle of
polarization on the detector is that on the sky plus the roll) are those of the public pipeline
corgidrp, https://github.com/roman-corgi/corgidrp.

Not known, and nominal here: what telescope and coronagraph do to polarized light, the efficiency
of the prisms (0.99), and by how much their clocking departs from 0 and 45 deg. There is no
polarizer on board: standard stars calibrate it.
"""

import re

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.instruments.polarimeter import Polarimeter, wollaston
from astropolcal.instruments.telescope import misaligned, star_source

__all__ = []


class RomanCoronagraph(Polarimeter):
    """
    Coronagraph of the Roman Space Telescope with its two Wollaston prisms.

    A table has the columns ``roll``, and ``prism``: 0 deg where ``DPAMNAME`` is POL0, 45 deg where
    it is POL45. Its sources are not called stars, as there is no site of the telescope whose sky
    turns: "unpolarized standard", "polarized standard" and "target".

    Free are, per band, the diattenuation of all that is upstream of the prisms, its retardance,
    which lowers the signal of one prism, and the efficiency of the prisms; and their common
    orientation.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> roman = instruments.get("roman")
    >>> [optic.name for optic in roman.chain("target")]
    ['star', 'roll', 'telescope', 'mirrors', 'wollaston']
    """

    name = "roman"
    aliases = ("Roman/CGI", "CGI")
    wavelength = [573.8, 825.5] * u.nm
    keywords = {"roll": "ROLL", "prism": "DPAMNAME"}
    transforms = {"prism": {"POL0": 0.0, "POL45": 45.0}}
    references = (
        "Groff et al., Proc. SPIE, Roman Space Telescope CGI: prism and polarizer "
        "characterization modes",
        "corgidrp, https://github.com/roman-corgi/corgidrp",
    )
    sources = ("unpolarized standard", "polarized standard", "target")
    sky_options = ()
    entrance = "roll"
    # a chain is of a source in the sky; there is no other that a telescope could be put before
    has_telescope = False

    def light(self, source, grid, star, target):
        """Return a standard star or a target."""
        kind = "star" if source == "target" else f"{source} star"
        light = star_source(kind, grid, star, target)
        if source == "polarized standard" and not target:
            # a start: of a star without polarization nothing tells the efficiencies
            light.q = np.full(grid.size, 0.03)
        return [light]

    def inner(self, source, optics_in, grid):
        """Return the turning of the sky, what is upstream of the prisms, and the prisms."""
        zero = np.zeros(grid.size)
        return [
            optics.Rotator(mount="-roll", name="roll"),
            optics.VectorDiattenuator(horizontal=zero, diagonal=zero, name="telescope"),
            optics.LinearRetarder(
                retardance=(zero + 10) * u.deg, bounds={"retardance": (0, 90)}, name="mirrors"
            ),
            wollaston(grid, mount="prism", **misaligned(0)),
        ]

    def particulars(self, observations):
        """Return the names of a star, ``object`` in the meta: of its source, in the catalogue."""
        target = str(observations.meta.get("object") or "")
        words = re.sub(r"\W+", "", target)
        return {"star": f"star_{words}", "target": target} if words else {}
