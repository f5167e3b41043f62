# Licensed under a 3-clause BSD style license - see LICENSE
"""
VLT/FORS2, linear imaging and spectropolarimetry in the visible.

FORS2 stands at the Cassegrain focus. Its adapter turns with the sky, so that the sky turns
upstream of the instrument by the position angle of the instrument; the stage ``parallactic`` of
the chain has this angle, and there is no derotator. Downstream of the collimator are a half-wave
plate and a Wollaston prism.

Sources: Patat & Romaniello 2006 (the lenses of the collimator polarize; up to 1.5 % at the edges
of the field), Cikota et al. 2017 (on the axis at most 0.1 %, a function of the wavelength),
Gonzalez-Gaitan et al. 2020 (imaging in four filters).

Not known from these, and nominal here: the plate has 178 deg, the prism an efficiency of 0.99,
and what is polarized on the axis starts at 0. The zero of the plate depends on the wavelength;
the table of it by ESO is not included: it is free, 0 deg at the start. The sign of
``ESO ADA POSANG`` is taken as that of a position angle from north to east.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.instruments.base import Instrument, SkyLaw
from astropolcal.instruments.telescope import STARS, misaligned, star_source
from astropolcal.observations.pointings import location_of

__all__ = ["FORS2"]


class FORS2(Instrument):
    """
    VLT/FORS2 with its half-wave plate at any angles, and its Wollaston prism.

    References
    ----------
    Patat & Romaniello 2006, PASP 118, 146, doi:10.1086/497581.
    Cikota et al. 2017, MNRAS 464, 4146, doi:10.1093/mnras/stw2545.
    Gonzalez-Gaitan et al. 2020, A&A 634, A70, doi:10.1051/0004-6361/201936379.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> fors2 = instruments.get("fors2")
    >>> [optic.name for optic in fors2.chain("star")]
    ['star', 'parallactic', 'collimator', 'hwp', 'wollaston']
    """

    name = "fors2"
    aliases = ("VLT/FORS2",)
    # nominal centres of b_HIGH, v_HIGH, R_SPECIAL and I_BESS
    wavelength = [440, 557, 655, 768] * u.nm
    keywords = {
        "hwp": "ESO INS RETA2 POSANG",
        "parallactic": "ESO ADA POSANG",
        "altitude": "ESO TEL ALT",
    }
    references = (
        "Patat & Romaniello 2006, PASP 118, 146, doi:10.1086/497581",
        "Cikota et al. 2017, MNRAS 464, 4146, doi:10.1093/mnras/stw2545",
        "Gonzalez-Gaitan et al. 2020, A&A 634, A70, doi:10.1051/0004-6361/201936379",
    )
    sources = ("polarized", *STARS)
    entrance = "collimator"
    #: The plate stays where it is put: it turns with the instrument.
    sky_law = SkyLaw(plate=(0, 0), derotator={})

    def chain(self, source="polarized", optics_in=(), *, wavelength=None, star="star", target=None):
        """
        Return the chain of a polarizer upstream of the instrument, or of a star.

        Free are, per wavelength, retardance and zero of the plate and the efficiency of the
        prism, and of stars what the collimator polarizes, which a polarizer hides.

        Parameters
        ----------
        source : str
            ``"polarized"``: light of a polarizer upstream of the instrument, such as the prism
            with which ESO measured the zero of the plate. Or a kind of star.
        optics_in : sequence of str
            Nothing is optional here.
        wavelength : `~astropy.units.Quantity`, optional
            By default four filters; in spectropolarimetry the bins of the spectrum.
        star, target : str
            Name of the source optic of a star, and of the star in the catalogue.

        Returns
        -------
        `~astropy.modeling.CompoundModel`
        """
        self.check_choices(source, optics_in)
        grid = self.grid(wavelength)
        zero = np.zeros(grid.size)
        collimator = optics.VectorDiattenuator(horizontal=zero, diagonal=zero, name="collimator")
        if source == "polarized":
            train = [optics.LinearPolarizer(name="polarizer")]
            collimator.horizontal.fixed = collimator.diagonal.fixed = True
        else:
            train = [star_source(source, grid, star, target), *self.telescope_optics()]
        plate = {"theta": zero * u.deg, "retardance": np.full(grid.size, 178) * u.deg}
        held = misaligned(0, 15)
        # linear polarization cannot tell 180 + x from 180 - x
        held["bounds"] |= {"retardance": (150, 180)}
        train += [
            collimator,
            optics.LinearRetarder(mount="hwp", name="hwp", **plate, **held),
            optics.WollastonPrism(efficiency=zero + 0.99, name="wollaston"),
        ]
        return join(train)

    def telescope_optics(self, behind=()):
        """Return the turning of the sky; M1 and M2 do not polarize on the axis."""
        return [optics.Rotator(mount="parallactic", name="parallactic")]

    def setup(self, observations):
        """Return the source from the table's meta, and no optional optics."""
        return self.source_of(observations), ()

    @property
    def location(self):
        """Site of the telescope, an `~astropy.coordinates.EarthLocation`."""
        return location_of((-70.4045, -24.6268, 2648.0))
