# Licensed under a 3-clause BSD style license - see LICENSE
"""
Subaru/SCExAO/VAMPIRES, visible polarimetric imager with two cameras.

A ferroelectric liquid crystal switches between two states, A and B, from frame to frame, and a
polarizing beam splitter sends the two polarizations to two cameras. Each filter, and each field
of the multiband imager, is one wavelength of a coarse grid.

On sky, telescope and half-wave plate are those of CHARIS; the tertiary mirror is silver, as
the law that is published for it was found in the infrared.

Signs: as in CHARIS, which has the same half-wave plate, the retardance of the plate is negative.
All retardances with the other sign, (H, 45, R) to (-H, -45, R), give the same data; the bounds of
the half-wave plate exclude them, and those of the derotator exclude a further turn.
"""

import astropy.units as u

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.instruments import _vampires_optics as _optics
from astropolcal.instruments._choices import check_choice
from astropolcal.instruments._subaru_optics import CHANGES, fold_mirror, polarizer
from astropolcal.instruments.base import Instrument
from astropolcal.instruments.telescope import INTERNAL, M3_MODELS, STARS, star_source, telescope
from astropolcal.instruments.vampires_headers import (
    KEYWORDS,
    LAYOUT,
    layout_of,
    mode_header,
    slices_of,
)
from astropolcal.observations.quality import is_star, mask_saturated

__all__ = ["VAMPIRES"]

# as tables may call them
_SOURCES = {name: name for name in (*INTERNAL, *STARS)}
_SOURCES |= {f"{name} internal": name for name in INTERNAL}


class VAMPIRES(Instrument):
    """
    Subaru/SCExAO/VAMPIRES, with its internal source or on sky.

    Its wavelengths are the fields of the multiband imager; files and tables of single filters
    have others, see `configured`.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> vampires = instruments.get("SCExAO/VAMPIRES")
    >>> [optic.name for optic in vampires.chain()][3:]
    ['relay', 'flc', 'wollaston', 'cameras']
    """

    name = "vampires"
    aliases = ("SCExAO/VAMPIRES", "Subaru/SCExAO/VAMPIRES")
    wavelength = slices_of({"OBS-MOD": "MBI"})
    keywords = KEYWORDS
    files = LAYOUT
    references = (
        "Norris et al. 2015, MNRAS 447, 2894 (doi:10.1093/mnras/stu2529)",
        "vampires_dpp, https://github.com/scexao-org/vampires_dpp (keywords and detectors)",
        "McIntosh et al. 2026, recalibration after the Nasmyth beam switcher, appendix on VAMPIRES",
    )
    sources = (*INTERNAL, *STARS)
    optional_optics = ("flc",)
    changes = CHANGES

    def chain(
        self,
        source="polarized",
        optics_in=("flc",),
        *,
        wavelength=None,
        derotator="elliptical",
        bounds="physical",
        m3="free",
        plate="free",
        star="star",
        target=None,
    ):
        """
        Return the chain of the internal source or a star, ready to be calibrated.

        Free for all wavelengths are the orientations of polarizer, half-wave plate, derotator
        and liquid crystal and its switching angle; for each wavelength the retardances of all
        optics, the diattenuation of the relay optics, the efficiency of the beam splitter and
        the unequal gains of the cameras. Where the data cannot tell them apart, normal priors
        hold the liquid crystal near half a wave and 43 deg, the cameras near equal gains, the
        derotator near a linear retarder, the relay optics near no retardance, and the efficiency
        near 0.95.

        Parameters
        ----------
        source : str
            ``"polarized"`` or ``"unpolarized"``: with or without the polarizer; without it the
            fold mirror's diattenuation is a free parameter for each wavelength.
            ``"unpolarized standard star"``: a star of zero polarization, behind the telescope's
            tertiary mirror. ``"polarized standard star"`` or ``"star"``: the star's q and u are
            free parameters for each wavelength, in the frame of the sky.
        optics_in : sequence of str
            ``"flc"`` where the liquid crystal is in the beam.
        wavelength : `~astropy.units.Quantity`, optional
            Grid, by default the fields of the multiband imager.
        derotator : {"elliptical", "linear", "kmirror"}
            Kind of retarder, with values of its own in each band; or three silver mirrors with
            films of silica, one law for all bands, see
            `~astropolcal.instruments.telescope.k_mirror`.
        bounds : {"physical"}
            Half-wave plate from -180 to -90 deg, derotator within the turn from 0 deg on.
        m3 : {"free", "power law", "metal"}
            Tertiary mirror of a star's chain: a diattenuation a wavelength with the retardance of
            silver, a law of the permittivity, or silver with a film.
        plate : {"free", "two-layer"}
            Half-wave plate with a retardance of its own in each band, or with the law of its two
            layers, whose thicknesses are free.
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
            If a choice is unknown.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> chain = instruments.get("vampires").chain(optics_in=(), derotator="linear")
        >>> chain["derotator"].retardance.shape
        (4,)
        """
        self.check_choices(
            source,
            optics_in,
            derotator=(derotator, ("elliptical", "linear", "kmirror")),
            plate=(plate, ("free", "two-layer")),
            bounds=(bounds, ("physical",)),
            m3=(m3, M3_MODELS),
        )
        grid = self.grid(wavelength)
        train = [polarizer() if source == "polarized" else fold_mirror(grid.size)]
        if source in STARS:
            light = star_source(source, grid, star, target)
            train = [light, *telescope(_optics.mirror(m3, grid))]
        train += [
            _optics.half_wave_plate(grid, plate),
            _optics.derotator(grid, derotator),
            _optics.relay(grid.size),
        ]
        if "flc" in optics_in:
            train.append(_optics.liquid_crystal(grid.size))
        train.append(_optics.splitter(grid.size))
        train.append(_optics.cameras(grid.size))
        return join(train)

    def telescope_optics(self, behind):
        """Return the telescope with a tertiary mirror of bare silver."""
        return telescope(_optics.silver("m3"))

    def published(self):
        """
        Return the chain of the polarized internal source with typical values, for simulations.

        No values of all optics are published; these are where fits start, rounded from a fit to
        the internal source in September 2023.

        Returns
        -------
        `~astropy.modeling.CompoundModel`

        Examples
        --------
        >>> from astropolcal import instruments
        >>> instruments.get("vampires").published()["flc"].switching_angle.quantity
        <Quantity 43. deg>
        """
        return self.chain("polarized")

    def published_meta(self):
        """Return the meta of a table taken with the chain of `published`."""
        return {
            "instrument": "SCExAO/VAMPIRES",
            "mode": "IPOL_MBI",
            "source": "polarized",
            "flc": "in",
            "pairing": "flc_state",
        }

    def configured(self, header):
        """
        Return the instrument with the wavelengths and the shape of a file.

        Parameters
        ----------
        header : `~astropy.io.fits.Header` or mapping
            Primary header, with mode, filter and size of the image.

        Returns
        -------
        VAMPIRES

        Raises
        ------
        InstrumentError
            If the filter is not known, or the image not square.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> instruments.get("vampires").configured({"FILTER01": "750-50"}).wavelength
        <Quantity [750.] nm>
        """
        # a new one: the registry hands out instances that others may hold
        one = type(self)()
        one.wavelength, one.files = slices_of(header), layout_of(header)
        return one

    def mode_header(self, wavelength):
        """Return mode and filter in the headers of cubes of these wavelengths."""
        return mode_header(wavelength)

    def optics_of(self, header):
        """Return whether the liquid crystal was in the beam, where the header tells."""
        stated = str(header.get(KEYWORDS["flc"], "")).strip().upper()
        # the header says such as "IN" or "Out of beam"
        known = {"IN": True, "OUT": False}
        found = [present for word, present in known.items() if stated.startswith(word)]
        return {"flc": found[0]} if found else {}

    def setup(self, observations):
        """
        Return the source from the table's meta, and whether the liquid crystal is in the beam.

        Parameters
        ----------
        observations : Observations
            Its meta holds ``source``, and ``flc`` (``in`` or ``out``); where it does not, the
            liquid crystal is in if there is a column ``flc_state``.

        Returns
        -------
        source : str
        optics_in : tuple of str

        Raises
        ------
        InstrumentError
            If the source is unknown, or ``flc`` is neither.
        """
        source = self.source_of(observations, _SOURCES)
        return source, ("flc",) if _is_modulated(observations) else ()

    def meta_without(self, names):
        """Return what a liquid crystal leaves behind: no states by which frames are paired."""
        return {"flc": "out", "pairing": "hwp"} if "flc" in names else {}

    def prepare(self, observations):
        """
        Return the observations with saturated frames masked.

        Where frames are paired by the state of the liquid crystal, a drift of the lamp is
        the same in both and no frame is masked for it. Elsewhere as
        `~astropolcal.instruments.Instrument.prepare`.

        Parameters
        ----------
        observations : Observations
            The dataset.

        Returns
        -------
        Observations
        """
        if observations.pairing == "flc_state" and not is_star(observations.source):
            return mask_saturated(observations)
        return super().prepare(observations)

    def published_mirrors(self):
        """Return bare gold at 45 deg, with which the paper compares the fold mirror."""
        gold = optics.MetalMirror(material="gold", incidence=45 * u.deg, name="fold_mirror")
        return {"fold_mirror": {"gold at 45°": gold}}


def _is_modulated(observations):
    # what the table says goes before what its columns suggest
    stated = observations.meta.get("flc")
    if stated is not None:
        check_choice(f"{observations.name}: flc", str(stated).lower(), ("in", "out"))
        return str(stated).lower() == "in"
    # what a calibration remembers of a dataset has no columns, but the meta say how it is paired
    frames = getattr(observations, "frames", None)
    columns = () if frames is None else frames.colnames
    return "flc_state" in columns or observations.meta.get("pairing") == "flc_state"
