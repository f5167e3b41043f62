# Licensed under a 3-clause BSD style license - see LICENSE
"""
Subaru/SCExAO/CHARIS, near-infrared integral-field spectropolarimeter.

The chain, its starting values and the bounds follow the recalibration of
McIntosh et al. (2026), and 't Hart et al. (2021) for the half-wave plate.

Signs: with positive thicknesses the equation of the two-layer half-wave plate gives a *negative*
retardance, near -172 deg, and the derotator that belongs to it has a negative horizontal and 45 deg
retardance. The published values have both signs turned, (H, 45, R) to (-H, -45, R): an exact mirror
solution, with the same double differences.
"""

import astropy.units as u

from astropolcal import optics
from astropolcal.exceptions import InstrumentError
from astropolcal.instruments import telescope as subaru
from astropolcal.instruments.base import SubaruPolarimeter
from astropolcal.instruments.layout import COMMON, NO_LIGHT, FileLayout, frame_time
from astropolcal.observations.reading import stated_date

__all__ = ["CHARIS"]

# McIntosh et al. 2026, as `CHARIS_FIT`
_PUBLISHED_SIO2, _PUBLISHED_MGF2 = 1.653, 1.291
_PUBLISHED_MISALIGNMENT = {"calibration_polarizer": 90.03, "derotator": -0.02, "hwp": -0.04}

# the only one with polarimetry
_MODE = "broadband JHK"

# The Nasmyth beam switcher came between the two calibration runs of 2025
_NBS_ABSENT_UNTIL, _NBS_PRESENT_FROM = "2025-07-31", "2025-10-01"
# how the meta of a table say that an optional optic is out
_ABSENT = {
    "nbs": ("nasmyth_beam_switcher", "not installed"),
    "dichroic": ("yjh50_dichroic", "out"),
}


class CHARIS(SubaruPolarimeter):
    """
    Subaru/SCExAO/CHARIS in its broadband spectropolarimetric mode.

    Free are the paper's parameters: two thicknesses and the misalignments of polarizer, half-wave
    plate and derotator for all wavelengths, and the derotator's retardances and the Wollaston's
    efficiency for each. Optional optics are ``"nbs"`` (beam switcher, parity flip) and
    ``"dichroic"`` (YJH50, as a retarder of zero retardance that is fixed until you free it).

    Examples
    --------
    >>> from astropolcal import instruments
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(source="polarized", optics_in=["nbs"])
    >>> [optic.name for optic in chain]
    ['calibration_polarizer', 'hwp', 'derotator', 'nbs', 'wollaston']
    """

    name = "charis"
    aliases = ("SCExAO/CHARIS", "Subaru/SCExAO/CHARIS")
    # bins of equal resolving power, as the cubes of the extraction have them
    wavelength = subaru.CHARIS_FIT["wavelength"].copy()
    keywords = SubaruPolarimeter.keywords | {"parallactic": "PARANG"}
    files = FileLayout(
        keywords=COMMON
        | keywords
        | {
            "mjd": "MJD",
            "date": "UTC-DATE",
            "time": "UTC-TIME",
            "filter": "FILTNAME",
            "pickoff": "X_CHAPKO",
        },
        alternatives={
            "mjd": ("MJD-STR",),
            "date": ("DATE-OBS",),
            "time": ("UT",),
            "filter": ("Y_FLTNAM", "FILTER01"),
        },
        shape=(22, 201, 201),
        raw_columns=("hwp", "hwp_true", "derotator", "instrument"),
        identities=("CHARIS",),
        prefix="CRSA",
        wanted={"DATA-TYP": NO_LIGHT},
        gain=2.0,
        read_noise=10.0,
        saturation=40000.0,
        internal_apertures=((71.75, 86.25), (131.5, 116.25), 44.48, 112.38, 0.4633),
        star_offset=(63.5, 33.1),
        pixel_scale=16.2,
        site=subaru.SITE,
    )
    references = (
        "McIntosh et al. 2026, recalibration after the Nasmyth beam switcher",
        "'t Hart et al. 2021, Proc. SPIE 11833",
        "van Holstein et al. 2020, Proc. SPIE 11447",
    )
    optional_optics = ("nbs", "dichroic")

    def camera(self, optics_in, grid):
        """Return the optional optics that are in the beam, and the Wollaston prism."""
        train = []
        if "dichroic" in optics_in:
            # to be freed where several angles of the derotator tell the two apart
            train.append(optics.LinearRetarder(name="dichroic", fixed={"retardance": True}))
        if "nbs" in optics_in:
            train.append(optics.ParityFlip(name="nbs"))
        return [*train, *super().camera(optics_in, grid)]

    def published(self):
        """
        Return the chain with the values published for Dataset 3.

        The final fit of McIntosh et al. (2026), rounded, in our signs: October
        2025, polarized internal source, dichroic and beam switcher in.

        Returns
        -------
        `~astropy.modeling.CompoundModel`

        Examples
        --------
        >>> from astropolcal import instruments
        >>> instruments.get("charis").published()["hwp"].w_sio2.quantity
        <Quantity 1.653 mm>
        """
        chain = self.chain("polarized", ["dichroic", "nbs"])
        hwp, derotator = chain["hwp"], chain["derotator"]
        # (H, 45) with the other sign, see the signs at the top
        hwp.w_sio2, hwp.w_mgf2 = _PUBLISHED_SIO2 * u.mm, _PUBLISHED_MGF2 * u.mm
        derotator.horizontal = -subaru.CHARIS_FIT["horizontal"]
        derotator.diagonal = -subaru.CHARIS_FIT["diagonal"]
        derotator.circular = subaru.CHARIS_FIT["circular"]
        chain["wollaston"].efficiency = subaru.CHARIS_FIT["efficiency"]
        for name, angle in _PUBLISHED_MISALIGNMENT.items():
            chain[name].theta = angle * u.deg
        return chain

    def published_meta(self):
        """Return the meta of a table taken with the chain of `published`."""
        return {
            "instrument": "SCExAO/CHARIS",
            "mode": _MODE,
            "source": "polarized",
            "yjh50_dichroic": "in",
            "nasmyth_beam_switcher": "installed",
        }

    def published_mirrors(self):
        """Return the law of M3 that is published, see ``published_mirror``."""
        return {"m3": {"McIntosh et al. (2026)": subaru.published_mirror()}}

    def setup(self, observations):
        """
        Return source and optics in the beam, as the table's meta states them.

        Parameters
        ----------
        observations : Observations
            Its meta holds ``source``, ``nasmyth_beam_switcher`` (``installed`` or ``not
            installed``; else it is taken from ``date``) and ``yjh50_dichroic`` (``in`` or ``out``).

        Returns
        -------
        source : str
        optics_in : tuple of str

        Raises
        ------
        InstrumentError
            If the meta do not say, or name a source that is unknown.
        """
        meta, name = observations.meta, observations.name
        inside = subaru.stated(meta, name, "yjh50_dichroic", {"in": True, "out": False})
        words = {"installed": True, "not installed": False, "in": True, "out": False}
        switcher = subaru.stated(meta, name, "nasmyth_beam_switcher", words)
        if switcher is None:
            day = (stated_date(meta, name, InstrumentError) or "")[:10]
            # a month alone is not conclusive
            switcher = _switcher_by(day) if len(day) == len("2025-10-01") else None
        if switcher is None:
            raise InstrumentError(
                f"{name}: neither nasmyth_beam_switcher nor a conclusive date in the table's meta; "
                "is the beam switcher 'installed' or 'not installed'?"
            )
        present = {"dichroic": inside, "nbs": switcher}
        source = self.source_of(observations)
        return source, tuple(optic for optic, there in present.items() if there)

    def mode_header(self, wavelength):
        """Return the keyword of the mode, see the method of `Instrument`."""
        return {self.files.keywords["filter"]: _MODE}

    def meta_without(self, names):
        """Return what `setup` reads of optics that are out of the beam."""
        return {key: word for name, (key, word) in _ABSENT.items() if name in names}

    def optics_of(self, header):
        """Return whether the beam switcher was in the beam, where the date tells."""
        try:
            time = frame_time(header, self.files)
        except (TypeError, ValueError):
            return {}
        present = None if time is None else _switcher_by(time.isot[:10])
        return {} if present is None else {"nbs": present}


def _switcher_by(day):
    """Return whether the beam switcher was installed at a date, None in between."""
    # ISO dates compare as strings
    if day <= _NBS_ABSENT_UNTIL:
        return False
    # between the two runs it was installed on a day that no table tells
    return True if day >= _NBS_PRESENT_FROM else None
