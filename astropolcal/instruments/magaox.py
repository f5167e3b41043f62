# Licensed under a 3-clause BSD style license - see LICENSE
"""
Magellan/MagAO-X, visible polarimetry with two cameras and a polarizing beam splitter.

From its handbook, https://www.magao-x.org/docs/handbook/operating/polarimetry.html, a work
in progress: a half-wave plate, a cube that sends horizontal polarization to camsci1 and vertical
to camsci2, the difference camsci2 - camsci1, and the keyword ``PARANG``. So camsci2 is the
right beam here.

Not known from it, and assumed here: the plate stands upstream of the K-mirror, both count as at
Subaru, and the tertiary mirror is bare aluminium. The retardances (178 and 160 deg) and the
efficiency of the cube (0.99) are nominal. The keywords of plate and K-mirror are not known. Real
frames have not been seen.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.instruments import telescope as shared
from astropolcal.instruments.base import Instrument, SkyLaw
from astropolcal.observations.pointings import location_of

__all__ = ["MagAOX"]


class MagAOX(Instrument):
    """
    Magellan/MagAO-X with half-wave plate, K-mirror and polarizing beam splitter.

    References
    ----------
    MagAO-X handbook, https://www.magao-x.org/docs/handbook/operating/polarimetry.html.
    No paper on its polarimetry was found.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> magaox = instruments.get("MagAO-X")
    >>> [optic.name for optic in magaox.chain("star")]
    ['star', 'parallactic', 'm3', 'altitude', 'hwp', 'derotator', 'wollaston']
    """

    name = "magaox"
    aliases = ("MagAO-X", "Magellan/MagAO-X")
    # nominal centres of g', r', i' and z'
    wavelength = [527, 614, 762, 908] * u.nm
    keywords = {"parallactic": "PARANG"}
    references = (
        "MagAO-X handbook, https://www.magao-x.org/docs/handbook/operating/polarimetry.html",
    )
    sources = ("polarized", *shared.STARS)
    sky_options = ("wavelength",)
    #: The plate stays where it is put, the K-mirror follows as at any Nasmyth focus.
    sky_law = SkyLaw(plate=(0, 0))

    def chain(self, source="polarized", optics_in=(), *, wavelength=None, star="star", target=None):
        """
        Return the chain of a polarized source upstream of the plate, or of a star.

        Free are, per wavelength, the retardances of plate and K-mirror and the efficiency of the
        cube; the angles of plate and K-mirror; and of stars the diattenuation of the tertiary
        mirror. Unequal gains of the cameras are the nuisance ``"beam_gain"``.

        Parameters
        ----------
        source : str
            ``"polarized"``: a polarizer upstream of the plate. Or a kind of star.
        optics_in : sequence of str
            Nothing is optional here.
        wavelength : `~astropy.units.Quantity`, optional
            By default four filters.
        star, target : str
            Name of the source optic of a star, and of the star in the catalogue.

        Returns
        -------
        `~astropy.modeling.CompoundModel`
        """
        self.check_choices(source, optics_in)
        grid = self.grid(wavelength)
        one = np.ones(grid.size)
        train = [optics.LinearPolarizer(name="polarizer")]
        if source in shared.STARS:
            light = shared.star_source(source, grid, star, target)
            train = [light, *self.telescope_optics(wavelength=grid)]
        for stage, angle, bounds in (("hwp", 178, (150, 180)), ("derotator", 160, (0, 360))):
            held = shared.misaligned(0, 10)
            held["bounds"] |= {"retardance": bounds}
            held["retardance"] = angle * one * u.deg
            train.append(optics.LinearRetarder(mount=stage, name=stage, **held))
        # the right beam, camsci2, has the vertical polarization
        cube = {"efficiency": 0.99 * one, "theta": 90 * u.deg, "name": "wollaston"}
        return join([*train, optics.WollastonPrism(**cube)])

    def telescope_optics(self, behind=(), *, wavelength=None):
        """Return the telescope with a tertiary mirror of bare aluminium."""
        grid, metal = self.grid(wavelength), optics.MetalMirror(material="aluminium")
        return shared.telescope(
            optics.DiattenuatorRetarder(
                diattenuation=metal.diattenuation(grid),
                retardance=metal.retardance(grid),
                name="m3",
                fixed={"retardance": True},
                bounds={"diattenuation": (-0.1, 0.1)},
            )
        )

    def setup(self, observations):
        """Return the source from the table's meta, and no optional optics."""
        return self.source_of(observations), ()

    @property
    def location(self):
        """Site of the telescope, an `~astropy.coordinates.EarthLocation`."""
        return location_of((-70.6926, -29.0146, 2400.0))
