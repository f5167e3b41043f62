# Licensed under a 3-clause BSD style license - see LICENSE
"""
Subaru/SCExAO/VAMPIRES, visible polarimetric imager with two cameras.

A ferroelectric liquid crystal switches between two states, A and B, from frame to frame, and a
polarizing beam splitter sends the two polarizations to two cameras. Each filter, and each field
of the multiband imager, is one wavelength of a coarse grid.

Signs: as in CHARIS, which has the same half-wave plate, the retardance of the plate is negative.
All retardances with the other sign, (H, 45, R) to (-H, -45, R), give the same data; the bounds of
the half-wave plate exclude them, and those of the derotator exclude a further turn.
"""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import join
from astropolcal.exceptions import InstrumentError
from astropolcal.instruments.base import Instrument
from astropolcal.observations import is_star, mask_saturated
from astropolcal.observations.wavelengths import filter_wavelength

__all__ = ["VAMPIRES"]

_FILTERS = ("MBI 610", "625-50", "MBI 670", "675-50", "Open", "MBI 720", "725-50", "750-50",
            "MBI 760", "775-50")  # fmt: skip

# where fits start: wavelength in nm, and retardances in deg
_START_AT = (610.0, 670.0, 725.0, 775.0)
_HALF_WAVE_PLATE = (-158.0, -165.0, -171.0, -173.0)
_DEROTATOR = (281.0, 245.0, 204.0, 176.0)

_SOURCES = {"polarized": "polarized", "unpolarized": "unpolarized"}
_SOURCES |= {f"{name} internal": name for name in ("polarized", "unpolarized")}


class VAMPIRES(Instrument):
    """
    Subaru/SCExAO/VAMPIRES with its internal source.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> vampires = instruments.get("SCExAO/VAMPIRES")
    >>> [optic.name for optic in vampires.chain()][3:]
    ['relay', 'flc', 'wollaston', 'cameras']
    """

    name = "vampires"
    aliases = ("SCExAO/VAMPIRES", "Subaru/SCExAO/VAMPIRES")
    wavelength = u.Quantity([filter_wavelength("vampires", name) for name in _FILTERS])
    keywords = {
        "hwp": "RET-ANG1",
        "hwp_true": "RET-POS1",
        "derotator": "D_IMRANG",
        "flc_state": "U_FLC",
        "camera": "U_CAMERA",
        "filter": "FILTER01",
        "altitude": "ALTITUDE",
        "parallactic": "PA",
    }
    references = (
        "Norris et al. 2015, MNRAS 447, 2894 (doi:10.1093/mnras/stu2529)",
        "McIntosh et al. 2026, recalibration after the Nasmyth beam switcher, appendix on VAMPIRES",
    )
    sources = ("polarized", "unpolarized")

    def chain(
        self,
        source="polarized",
        optics_in=("flc",),
        *,
        wavelength=None,
        derotator="elliptical",
        bounds="physical",
    ):
        """
        Return the chain of the internal source, ready to be calibrated.

        Free for all wavelengths are the orientations of polarizer, half-wave plate, derotator
        and liquid crystal and its switching angle; for each wavelength the retardances of all
        optics, the diattenuation of the relay optics, the efficiency of the beam splitter and
        the unequal gains of the cameras. Where the data cannot tell them apart, normal priors
        hold the liquid crystal near half a wave and 43 deg, the cameras near equal gains, and
        the derotator near a linear retarder.

        Parameters
        ----------
        source : str
            ``"polarized"`` or ``"unpolarized"``: with or without the polarizer; without it the
            fold mirror's diattenuation is a free parameter for each wavelength.
        optics_in : sequence of str
            ``"flc"`` where the liquid crystal is in the beam.
        wavelength : `~astropy.units.Quantity`, optional
            Grid, by default all filters.
        derotator : {"elliptical", "linear"}
            Kind of retarder.
        bounds : {"physical"}
            Half-wave plate from -180 to -90 deg, derotator within the turn from 0 deg on.

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
        (10,)
        """
        _choice("derotator", derotator, ("elliptical", "linear"))
        _choice("bounds", bounds, ("physical",))
        _choice("source", source, self.sources)
        for name in optics_in:
            _choice("optics_in", name, ("flc",))
        grid = self.wavelength if wavelength is None else u.Quantity(wavelength)
        train = [_polarizer() if source == "polarized" else _fold_mirror(grid.size)]
        train += [_half_wave_plate(grid), _derotator(grid, derotator), _relay(grid.size)]
        if "flc" in optics_in:
            train.append(_liquid_crystal(grid.size))
        train.append(optics.WollastonPrism(efficiency=np.full(grid.size, 0.95), name="wollaston"))
        train.append(_cameras(grid.size))
        return join(train)

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
        source = str(observations.source).strip().lower()
        if source not in _SOURCES:
            raise InstrumentError(
                f"{observations.name}: source {observations.source!r} in the table's meta; allowed "
                f"are {', '.join(_SOURCES)}"
            )
        return _SOURCES[source], ("flc",) if _is_modulated(observations) else ()

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
    stated = observations.meta.get("flc")
    if stated is not None:
        _choice(f"{observations.name}: flc", str(stated).lower(), ("in", "out"))
        return str(stated).lower() == "in"
    # what a calibration remembers of a dataset has no columns, but the meta say how it is paired
    frames = getattr(observations, "frames", None)
    columns = () if frames is None else frames.colnames
    return "flc_state" in columns or observations.meta.get("pairing") == "flc_state"


def _choice(what, value, allowed):
    if value not in allowed:
        raise InstrumentError(f"vampires: {what} = {value!r}; allowed are {', '.join(allowed)}")


def _misaligned(about, most=5):
    return {"fixed": {"theta": False}, "bounds": {"theta": (about - most, about + most)}}


def _normal(mean, std):
    from scipy.stats import norm

    return norm(mean, std)


def _starts(grid, values):
    return np.interp(grid.to_value(u.nm), _START_AT, values) * u.deg


def _polarizer():
    return optics.LinearPolarizer(theta=90 * u.deg, name="calibration_polarizer", **_misaligned(90))


def _fold_mirror(size):
    return optics.Diattenuator(diattenuation=np.zeros(size), name="fold_mirror")


def _half_wave_plate(grid):
    settings = _misaligned(0)
    settings["bounds"] |= {"retardance": (-180, -90)}
    start = _starts(grid, _HALF_WAVE_PLATE)
    return optics.LinearRetarder(retardance=start, mount="hwp", name="hwp", **settings)


def _derotator(grid, kind):
    settings, start = _misaligned(0), _starts(grid, _DEROTATOR)
    main = "retardance" if kind == "linear" else "horizontal"
    settings["bounds"] |= {main: (0, 360)}
    settings |= {"mount": "derotator", "name": "derotator"}
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


def _relay(size):
    """Return what stands between derotator and liquid crystal, the dichroics included."""
    return optics.DiattenuatorRetarder(
        diattenuation=np.full(size, 0.01),
        retardance=np.full(size, -30.0) * u.deg,
        name="relay",
        bounds={"diattenuation": (-0.6, 0.6)},
    )


def _liquid_crystal(size):
    settings = _misaligned(0, most=20)
    settings["bounds"] |= {"retardance": (90, 270), "switching_angle": (30, 60)}
    crystal = optics.FerroelectricLiquidCrystal(
        retardance=np.full(size, 180.0) * u.deg,
        switching_angle=43 * u.deg,
        mount="flc_state",
        name="flc",
        **settings,
    )
    crystal.retardance.prior, crystal.theta.prior = _normal(180, 15), _normal(0, 2)
    crystal.switching_angle.prior = _normal(43, 2)
    return crystal


def _cameras(size):
    cameras = optics.BeamGain(imbalance=np.zeros(size), name="cameras")
    cameras.imbalance.prior = _normal(0, 0.1)
    return cameras
