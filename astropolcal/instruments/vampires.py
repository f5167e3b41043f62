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

from dataclasses import replace

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.exceptions import InstrumentError, ObservationError
from astropolcal.instruments import layout
from astropolcal.instruments import telescope as subaru
from astropolcal.instruments.base import SubaruPolarimeter
from astropolcal.observations.grid import is_star, mask_saturated
from astropolcal.observations.reading import SAME_WAVELENGTH, filter_wavelength
from astropolcal.optics._modelling import FrozenNormal
from astropolcal.units import wavelengths_of

__all__ = ["VAMPIRES"]

#: Fields of the multiband imager, in the order of the slices.
FIELDS = ("MBI 610", "MBI 670", "MBI 720", "MBI 760")
_BANDS = ("625-50", "Open", "675-50", "725-50", "750-50", "775-50")
_MODE, _FILTER = "OBS-MOD", "FILTER01"
# pixels of a field of 1.1 arcsec, and of the usual window of 3 arcsec
_FIELD_SIDE, _WINDOW_SIDE = 184, 536
# part of a side that the rectangles of the internal source have
_LIT = 0.8

#: Column of the observation table to keyword.
KEYWORDS = SubaruPolarimeter.keywords | {
    "flc_state": "U_FLC",
    "flc": "U_FLCST",
    "camera": "U_CAMERA",
    "em_gain": "U_EMGAIN",
    "read_mode": "U_DETMOD",
    "filter": _FILTER,
    "parallactic": "PA",
}

# two ORCA-Quest since 2023, by read mode; before that two EMCCDs iXon Ultra 897
_FULL = 65535.0
_READ_OUTS = {
    "slow 1": layout.ReadOut(0.105, 0.245, _FULL),
    "slow 2": layout.ReadOut(0.105, 0.220, _FULL),
    "fast 1": layout.ReadOut(0.103, 0.403, _FULL),
    "fast 2": layout.ReadOut(0.103, 0.399, _FULL),
    "slow": layout.ReadOut(0.105, 0.245, _FULL),
    "fast": layout.ReadOut(0.103, 0.403, _FULL),
    "em": layout.ReadOut(4.5, 89.0, _FULL, layout.EM_EXCESS_NOISE),
    "conventional": layout.ReadOut(4.5, 9.6, 40000.0),
}


#: The multiband imager; ``layout_of`` has the other modes.
LAYOUT = layout.FileLayout(
    keywords=layout.COMMON | KEYWORDS | SubaruPolarimeter.times | {"pickoff": _MODE},
    shape=(len(FIELDS), _FIELD_SIDE, 2 * _FIELD_SIDE),
    cube_extension=0,
    weights="error",
    alternatives={"flc_state": ("U_FLCSTT",), "hwp": ("U_HWPANG",), "filter": ("U_FILTER",)},
    identities=("VAMPIRES",),
    prefix="VMPA",
    gain=0.105,
    read_noise=0.25,
    saturation=_FULL,
    pixel_scale=5.9,
    fwhm=3.5,
    site=subaru.SITE,
    beam_files=("cam1", "cam2"),
    states={"1": "A", "2": "B", "NA": ""},
    read_outs=_READ_OUTS,
    wanted={"DATA-TYP": layout.NO_LIGHT},
    optics={"flc": ("flc", {r"(?i)^\s*in": "in", r"(?i)^\s*out": "out"})},
    **layout.side_by_side(_FIELD_SIDE, _FIELD_SIDE, _LIT),
)


def slices_of(header):
    """Return the wavelengths of the slices in a file, by mode and filter in its header."""
    mode = str(header.get(_MODE, "")).upper()
    if "MBI" in mode:
        # the reduced multiband imager leaves the first field out
        return _wavelengths(FIELDS[1:] if "MBIR" in mode else FIELDS)
    name = header.get(_FILTER, header.get("U_FILTER"))
    if name is None:
        raise InstrumentError(f"vampires: no keyword {_FILTER} in the header")
    try:
        return u.Quantity([filter_wavelength("vampires", str(name).strip())])
    except ObservationError as error:
        raise InstrumentError(f"{_FILTER} = {name!r}: {error}") from None


def layout_of(header):
    """
    Return how files of a mode look.

    A header without ``NAXIS1`` and ``NAXIS2`` is of images as large as usual.
    """
    multiband = "MBI" in str(header.get(_MODE, "")).upper()
    # headers that are asked before any file is read have no size
    usual = _FIELD_SIDE if multiband else _WINDOW_SIDE
    side, rows = (int(header.get(key, usual)) for key in ("NAXIS1", "NAXIS2"))
    if side != rows or side < 16:
        raise InstrumentError(
            f"vampires: images of {side} x {rows} pixels; square ones of 16 and more are needed"
        )
    keywords = LAYOUT.keywords | ({"filter": _MODE} if multiband else {})
    shape = (len(slices_of(header)), side, 2 * side)
    # raw frames of a filter: a cube of exposures in one state
    places = layout.side_by_side(side, side, _LIT) | {"stacked": not multiband}
    return replace(LAYOUT, keywords=keywords, shape=shape, **places)


def _wavelengths(names):
    return u.Quantity([filter_wavelength("vampires", name) for name in names])


# where fits start: wavelength in nm, and retardances in deg
_START_AT = (610.0, 670.0, 725.0, 775.0)
_HALF_WAVE_PLATE = (-158.0, -165.0, -171.0, -173.0)
_DEROTATOR = (281.0, 245.0, 204.0, 176.0)
_BOUNDS = {"horizontal": (0, 360), "diagonal": (-90, 90), "circular": (-90, 90)}


def _mirror(model, grid):
    """Return the tertiary mirror, ready to be calibrated."""
    mirror = subaru.tertiary_mirror(model, grid)
    if model == "free":
        silver = optics.MetalMirror(material="silver")
        mirror.diattenuation = silver.diattenuation(grid)
        mirror.retardance = silver.retardance(grid)
    return mirror


def _starts(grid, values):
    return np.interp(grid.to_value(u.nm), _START_AT, values) * u.deg


def liquid_crystal(size, switching=43):
    """Return a liquid crystal of half a wave, whose switching angle (deg) is known to 2 deg."""
    settings = subaru.misaligned(0, most=20)
    settings["bounds"] |= {"retardance": (90, 270), "switching_angle": (30, 60)}
    crystal = optics.FerroelectricLiquidCrystal(
        retardance=np.full(size, 180.0) * u.deg,
        switching_angle=switching * u.deg,
        mount="flc_state",
        name="flc",
        **settings,
    )
    crystal.retardance.prior, crystal.theta.prior = FrozenNormal(180, 15), FrozenNormal(0, 2)
    # a smaller switching angle looks like a lower efficiency of the splitter, hence the prior
    crystal.switching_angle.prior = FrozenNormal(switching, 2)
    return crystal


# as tables may call them
_SOURCES = {name: name for name in (*subaru.INTERNAL, *subaru.STARS)}
_SOURCES |= {f"{name} internal": name for name in subaru.INTERNAL}


class VAMPIRES(SubaruPolarimeter):
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
    optional_optics = ("flc",)

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

        Free for all wavelengths are the orientations of polarizer, half-wave plate, derotator and
        liquid crystal and its switching angle; for each wavelength the retardances of all optics,
        the diattenuation of the relay optics, the efficiency of the beam splitter and the unequal
        gains of the cameras. Where the data cannot tell them apart, normal priors hold the liquid
        crystal near half a wave and 43 deg, the cameras near equal gains, the derotator near a
        linear retarder, the relay optics near no retardance, and the efficiency near 0.95.

        Parameters
        ----------
        source : str
            ``"polarized"`` or ``"unpolarized"``: with or without the polarizer; without it the
            fold mirror's diattenuation is a free parameter for each wavelength.
            ``"unpolarized standard star"``: a star of zero polarization, downstream of the
            telescope's tertiary mirror. ``"polarized standard star"`` or ``"star"``: the star's q
            and u are free parameters for each wavelength, in the frame of the sky.
        optics_in : sequence of str
            ``"flc"`` where the liquid crystal is in the beam.
        wavelength : `~astropy.units.Quantity`, optional
            Grid, by default the fields of the multiband imager.
        derotator : {"elliptical", "linear", "kmirror"}
            Kind of retarder, with values of its own in each band; or three silver mirrors with
            films of silica, one law for all bands, free in their thickness.
        bounds : {"physical"}
            Half-wave plate from -180 to -90 deg, derotator within the turn from 0 deg on.
        m3 : {"free", "power law", "metal"}
            Tertiary mirror of a star's chain: a diattenuation per wavelength with the retardance of
            silver, a law of the permittivity, or silver with a film.
        plate : {"free", "two-layer"}
            Half-wave plate with a retardance of its own in each band, or with the law of its two
            layers, whose thicknesses are free.

        Others, and what is returned and raised, are as in `Instrument.chain`.

        Examples
        --------
        >>> from astropolcal import instruments
        >>> chain = instruments.get("vampires").chain(optics_in=(), derotator="linear")
        >>> chain["derotator"].retardance.shape
        (4,)
        """
        known = {"derotator": (derotator, subaru.DEROTATORS), "bounds": (bounds, ("physical",))}
        known |= {"plate": (plate, ("free", "two-layer")), "m3": (m3, subaru.M3_MODELS)}
        self.check_choices(source, optics_in, **known)
        grid = self.grid(wavelength)
        size, settings = grid.size, subaru.misaligned(0)
        if plate == "two-layer":
            hwp = subaru.two_layer_plate(**settings)
        else:
            # the branch of our sign: without it (H, 45, R) and (-H, -45, R) fit alike
            settings["bounds"] |= {"retardance": (-180, -90)}
            start = _starts(grid, _HALF_WAVE_PLATE)
            hwp = optics.LinearRetarder(retardance=start, mount="hwp", name="hwp", **settings)
        turning = subaru.derotator(derotator, _starts(grid, _DEROTATOR), _BOUNDS)
        if derotator == "elliptical":
            turning.diagonal.prior = turning.circular.prior = FrozenNormal(0, 10)
        # what stands between derotator and liquid crystal, the dichroics included
        relay = optics.DiattenuatorRetarder(
            diattenuation=np.full(size, 0.01),
            retardance=np.full(size, -30.0) * u.deg,
            name="relay",
            bounds={"diattenuation": (-0.6, 0.6), "retardance": (-180, 180)},
        )
        # wide: a retarder here looks like one in the derotator, unless that turns far
        relay.retardance.prior = FrozenNormal(0, 45)
        crystal = [liquid_crystal(size)] if "flc" in optics_in else []
        # an efficiency above one is none
        wollaston = optics.WollastonPrism(efficiency=np.full(size, 0.95), name="wollaston")
        wollaston.efficiency.prior = FrozenNormal(0.95, 0.03)
        cameras = optics.BeamGain(imbalance=np.zeros(size), name="cameras")
        # pairs of both states see it in second order only, hence the prior
        cameras.imbalance.prior = FrozenNormal(0, 0.1)
        train = subaru.entrance(source, grid, star, target, m3, _mirror)
        return join([*train, hwp, turning, relay, *crystal, wollaston, cameras])

    def telescope_optics(self, behind):
        """Return the telescope with a tertiary mirror of bare silver."""
        return subaru.telescope(optics.MetalMirror(material="silver", name="m3"))

    def published(self):
        """
        Return the chain of the polarized internal source with typical values, for simulations.

        No values of all optics are published; these are where fits start, rounded from a fit to
        the internal source in September 2023.
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
        """Return the instrument with the wavelengths and the shape of a file."""
        # a new one: the registry hands out instances that others may hold
        one = type(self)()
        one.wavelength, one.files = slices_of(header), layout_of(header)
        return one

    def mode_header(self, wavelength):
        """Return mode and filter in the headers of cubes of these wavelengths."""
        known = [("IPOL_MBI", "Open", FIELDS), ("IPOL_MBIR", "Open", FIELDS[1:])]
        known += [("IPOL", name, (name,)) for name in _BANDS]
        wavelength = np.atleast_1d(wavelengths_of(wavelength)).to_value(u.nm)
        for mode, band, names in known:
            own = _wavelengths(names).value
            if own.shape == wavelength.shape and np.allclose(own, wavelength, SAME_WAVELENGTH, 0):
                return {_MODE: mode, _FILTER: band}
        raise InstrumentError(
            f"vampires: no file has slices of {', '.join(f'{w:g}' for w in wavelength)} nm; "
            f"allowed are one of {', '.join(_BANDS)}, or the fields {', '.join(FIELDS)} with or "
            "without the first"
        )

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

        Where the meta have no ``flc`` (``in`` or ``out``), it is in if there is a column
        ``flc_state``.
        """
        source = self.source_of(observations, _SOURCES)
        # what the table says goes before what its columns suggest
        words, meta = {"in": True, "out": False}, observations.meta
        inside = subaru.stated(meta, observations.name, "flc", words)
        if inside is None:
            # what a calibration remembers of a dataset has no columns, but the meta say how it is
            # paired
            frames = getattr(observations, "frames", None)
            columns = () if frames is None else frames.colnames
            inside = "flc_state" in columns or meta.get("pairing") == "flc_state"
        return source, ("flc",) if inside else ()

    def meta_without(self, names):
        """Return what a liquid crystal leaves: no states by which frames are paired."""
        return {"flc": "out", "pairing": "hwp"} if "flc" in names else {}

    def prepare(self, observations):
        """Return the observations with saturated frames masked.

        Where frames are paired by the state of the liquid crystal, a drift of the lamp is the same
        in both and no frame is masked for it. Elsewhere as
        `~astropolcal.instruments.Instrument.prepare`.
        """
        if observations.pairing == "flc_state" and not is_star(observations.source):
            return mask_saturated(observations)
        return super().prepare(observations)

    def published_mirrors(self):
        """Return bare gold at 45 deg, with which the paper compares the fold mirror."""
        gold = optics.MetalMirror(material="gold", incidence=45 * u.deg, name="fold_mirror")
        return {"fold_mirror": {"gold at 45°": gold}}
