# Licensed under a 3-clause BSD style license - see LICENSE
"""
VLT/SPHERE/IRDIS, near-infrared dual-beam imaging polarimeter.

The chain and its values are those of van Holstein et al. (2020): the mirrors M1 to M3 of the
Unit Telescope as one optic, M4, half-wave plate, derotator, and the pair of polarizers. A
wavelength stands for one of the four broadband filters. The telescope's mirrors were coated
anew on 2017-04-16; diattenuations are known before and after.

Beams have the names of the halves of the detector. The left one passes +Q, so single
differences here, right minus left, have the opposite sign of the published ones.
"""

import numpy as np

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.exceptions import InstrumentError
from astropolcal.instruments._irdis_headers import frame_table
from astropolcal.instruments._irdis_optics import (
    CENTRES,
    FILTERS,
    RECOATING,
    calibration_polarizer,
    check_all_filters,
    coating_of,
    coating_on,
    derotator,
    filters_at,
    half_wave_plate,
    polarizers,
    stated_coating,
    telescope,
)
from astropolcal.instruments.base import Instrument
from astropolcal.instruments.following import SkyLaw
from astropolcal.instruments.telescope import INTERNAL, STARS, star_source
from astropolcal.observations.pointings import location_of
from astropolcal.observations.quality import is_star

__all__ = ["IRDIS"]

# longitude, latitude (deg) and height (m) of the telescope in the headers
_SITE = (-70.4045, -24.6268, 2648.0)


class IRDIS(Instrument):
    """
    VLT/SPHERE/IRDIS in dual-beam polarimetric imaging.

    References
    ----------
    van Holstein et al. 2020, A&A 633, A64, doi:10.1051/0004-6361/201834996.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> irdis = instruments.get("irdis")
    >>> [optic.name for optic in irdis.chain("star")]
    ['star', 'parallactic', 'ut', 'altitude', 'm4', 'hwp', 'derotator', 'wollaston']
    """

    name = "irdis"
    aliases = ("SPHERE/IRDIS", "VLT/SPHERE/IRDIS")
    wavelength = CENTRES
    keywords = {
        "hwp_true": "ESO INS4 DROT3 BEGIN",
        "derotator": "ESO INS4 DROT2 BEGIN",
        "parallactic": "ESO TEL PARANG START",
        "altitude": "ESO TEL ALT",
    }
    references = (
        "van Holstein et al. 2020, A&A 633, A64, doi:10.1051/0004-6361/201834996",
        "de Boer et al. 2020, A&A 633, A63, doi:10.1051/0004-6361/201834989",
    )
    sources = (*INTERNAL, *STARS)
    sky_options = ("wavelength", "date")
    changes = (("ut", RECOATING, RECOATING, "the telescope's mirrors were coated anew"),)
    #: Names of the filters with coefficients, in the order of ``wavelength``.
    filters = FILTERS
    #: What keeps the direction of polarization that is measured fixed to the image.
    sky_law = SkyLaw(
        plate={"field": (-1.0, 1.0), "pupil": (-0.5, 1.0)},
        derotator={"field": (-0.5, 0.5), "pupil": (0.0, 0.5)},
    )
    #: Day from which the mirrors of the telescope have their new coating.
    recoating = RECOATING

    def chain(
        self,
        source="polarized",
        optics_in=(),
        *,
        wavelength=None,
        coating="after",
        star="star",
        target=None,
    ):
        """
        Return the chain of an internal source or a star, with the published values.

        Free are the retardances of half-wave plate and derotator and the diattenuations of plate
        and polarizers, one a filter, and the angles of plate and derotator; of stars also the
        diattenuations of telescope and M4, whose retardances are held. The diattenuation of the
        derotator, to which double differences are blind, is held.

        Parameters
        ----------
        source : str
            ``"polarized"``: internal source with its polarizer, whose angle is free.
            ``"unpolarized"``: without it; q and u of the light that reaches the half-wave plate
            are free, one a filter. ``"unpolarized standard star"``,
            ``"polarized standard star"`` or ``"star"``: behind telescope and M4.
        optics_in : sequence of str
            Nothing is optional here.
        wavelength : `~astropy.units.Quantity`, optional
            Filters by their central wavelengths, by default all four.
        coating : {"before", "after"}
            Coating of the telescope's mirrors: before or after 2017-04-16.
        star : str
            Name of the source optic in a star's chain.
        target : str, optional
            Name of the star, for what the catalogue of standards knows of it.

        Returns
        -------
        `~astropy.modeling.CompoundModel`

        Raises
        ------
        InstrumentError
            If a choice is unknown, or a wavelength is that of no filter with coefficients.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal import instruments
        >>> chain = instruments.get("irdis").chain("star", wavelength=[1.625] * u.um)
        >>> chain["derotator"].retardance.quantity.round(1)
        <Quantity 99.3 deg>
        """
        self.check_choices(source, optics_in)
        grid = self.grid(wavelength)
        # published coefficients are of filters: nothing is interpolated between them
        index = filters_at(grid)
        common = [half_wave_plate(index), derotator(index), polarizers(index)]
        if source == "polarized":
            return join([calibration_polarizer(), *common])
        if source == "unpolarized":
            zero = np.zeros(index.size)
            # M4 and the lamp polarize together; only what reaches the plate can be measured
            return join([optics.PolarizedSource(q=zero, u=zero, name="lamp"), *common])
        light = star_source(source, grid, star, target)
        return join([light, *telescope(index, coating), *common])

    def published(self):
        """
        Return the chain of the polarized internal source with the published values.

        Returns
        -------
        `~astropy.modeling.CompoundModel`

        Examples
        --------
        >>> from astropolcal import instruments
        >>> instruments.get("irdis").published()["wollaston"].efficiency.value.round(3).tolist()
        [0.98, 0.989, 0.996, 0.984]
        """
        return self.chain("polarized")

    def published_meta(self):
        """Return the meta of a table taken with the chain of `published`."""
        return {"instrument": "SPHERE/IRDIS", "source": "polarized"}

    def telescope_optics(self, behind, *, wavelength=None, coating=None, date=None):
        """
        Return the telescope as published, with M4, for ``on_sky``, which takes the same options.

        Parameters
        ----------
        behind : list of Optic
            The optics from the half-wave plate on.
        wavelength : `~astropy.units.Quantity`, optional
            Filters of the chain by their central wavelengths; needed if it is not of all four.
        coating : {"before", "after"}, optional
            Of the published telescope that is put in front: before or after 2017-04-16.
        date : str, ``datetime.date``, `~astropy.time.Time` or sequence of them, optional
            Of the frames, which tells the coating.

        Returns
        -------
        list of Optic

        Raises
        ------
        ChainError
            If the optics do not tell their filters.
        InstrumentError
            If the coating is unknown, is not that of the date, or the dates are of both.

        Warns
        -----
        AstropolcalWarning
            If neither coating nor date is given: it is then that of after the recoating.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> irdis = instruments.get("irdis")
        >>> [optic.name for optic in irdis.on_sky(irdis.published(), date="2016-05-01")][:4]
        ['parallactic', 'ut', 'altitude', 'm4']
        """
        if wavelength is None:
            check_all_filters(behind)
        index = filters_at(self.grid(wavelength))
        return telescope(index, coating_of(coating, date))

    def setup(self, observations):
        """
        Return source and optics in the beam, as the table's meta states them.

        Parameters
        ----------
        observations : Observations
            Its meta holds ``source``.

        Returns
        -------
        source : str
        optics_in : tuple of str
            Empty.

        Raises
        ------
        InstrumentError
            If the source is not known.
        """
        return self.source_of(observations), ()

    def particulars(self, observations):
        """
        Return the coating, and source optic and target of a star.

        Parameters
        ----------
        observations : Observations
            Of a star: its meta holds ``date`` (ISO), or ``coating``, which is
            ``before`` or ``after``; and ``object``.

        Returns
        -------
        dict

        Raises
        ------
        InstrumentError
            If the table of a star does not tell the coating.
        """
        if not is_star(observations.source):
            return {}
        return {"coating": stated_coating(observations)} | super().particulars(observations)

    @staticmethod
    def coating_on(date):
        """
        Return which coating the telescope's mirrors had.

        Parameters
        ----------
        date : str, ``datetime.date`` or `~astropy.time.Time`
            Date of the observation, a text in ISO form.

        Returns
        -------
        {"before", "after"}

        Raises
        ------
        InstrumentError
            If it is no date.

        Examples
        --------
        >>> from astropolcal.instruments import IRDIS
        >>> coating_on("2017-04-15"), coating_on("2017-04-16T03:00")
        ('before', 'after')
        """
        return coating_on(date)

    @property
    def location(self):
        """Site of the telescope, an `~astropy.coordinates.EarthLocation`."""
        return location_of(_SITE)

    def frame_table(self, headers):
        """
        Return angles, times and filters of frames from their headers.

        Parameters
        ----------
        headers : sequence of `~astropy.io.fits.Header` or mapping
            Primary headers of raw frames, all of one filter.

        Returns
        -------
        `~astropy.table.QTable`
            One row a frame: ``frame``, ``hwp`` (commanded), ``hwp_true``, ``derotator``,
            ``wavelength``, ``exposure_time``, ``time``, and of stars ``parallactic`` and
            ``altitude``, all in the middle of the exposure. With the fluxes of both beams it is
            a table of observations. The meta have instrument, filter, date and tracking.

        Raises
        ------
        ObservationError
            If a keyword is missing or impossible; the message names the frame.
        InstrumentError
            If the filter has no coefficients.

        Warns
        -----
        AstropolcalWarning
            If plate or derotator are known at the start of an exposure only (``BEGIN`` or
            ``START`` without ``END``), with how far they turn until its middle.

        Notes
        -----
        Angles are the circular means of begin and end; ``hwp_true`` is that of ``ESO INS4
        DROT3`` less 152.15 deg, the derotator that of ``ESO INS4 DROT2``, plus half the pupil
        offset of 135.99 deg when it follows the pupil. The altitude in the header is that of
        the start; by how much it changes until the middle is computed. The duration is NDIT
        (DIT + 0.938 s) + 2.4 s.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> header = {"ESO INS1 FILT ID": "FILT_BBF_H", "ESO INS4 DROT3 BEGIN": 152.15,
        ...           "ESO INS4 DROT3 END": 152.15, "ESO INS4 DROT2 BEGIN": 359.0,
        ...           "ESO INS4 DROT2 END": 3.0, "MJD-OBS": 57900.0, "EXPTIME": 2.0,
        ...           "ESO DET NDIT": 4}
        >>> table = instruments.get("irdis").frame_table([header])
        >>> table["derotator"].round(6), table.meta["filter"]
        (<Quantity [1.] deg>, 'H')
        """
        filters = dict(zip(FILTERS, CENTRES, strict=True))
        table = frame_table(list(headers), self.location, filters, self.sky_law)
        days = {self.coating_on(time) for time in table["time"]}
        if len(days) > 1:
            raise InstrumentError(
                f"the frames are from before and from after the recoating of {RECOATING}; "
                "make one table of each"
            )
        table.meta["instrument"] = "SPHERE/IRDIS"
        return table
