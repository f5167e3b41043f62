# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects of what stands still between the derotator and the beam splitter."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.gap.effects._shared import BandAverage, Depolarization, retardance_slopes
from astropolcal.gap.effects.base import EffectParameter, Insertion, label_of

__all__ = [
    "AnisotropicDepolarizer",
    "BeamCrosstalk",
    "DichroicBandAverage",
    "DichroicRetarder",
    "Fringes",
    "FringesDrift",
    "SplitterOrientation",
    "StaticDiattenuator",
    "StaticRetarder",
]


class StaticRetarder(Insertion):
    """
    Retarder that stands still behind the derotator: relay optics, windows.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> sorted(get_effect("static_retarder").free)
    ['circular', 'diagonal', 'horizontal']
    """

    name, kind, place = "static_retarder", "optic", "relay behind the derotator"
    title = "retarder that stands still behind the derotator"
    shows = "pattern in derotator angle, smooth in wavelength"
    reference = "Harrington et al. 2019, doi:10.1117/1.JATIS.5.3.038001"
    # beyond half a turn a retardance comes back with the other sign
    free = {key: (2 * u.deg, 180 * u.deg) for key in ("horizontal", "diagonal", "circular")}

    def build(self, size, anchor, context):
        """Return an elliptical retarder without a mount."""
        zero = np.zeros(size) * u.deg
        return optics.EllipticalRetarder(
            horizontal=zero, diagonal=zero, circular=zero, name=self.label
        )


class DichroicRetarder(Insertion):
    """
    Dichroic: a retarder that changes steeply near its cut-off.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("dichroic_j_band").place
    'dichroic'
    """

    name, kind, place = "dichroic_j_band", "optic", "dichroic"
    title = "retardance of a dichroic that changes steeply with wavelength"
    shows = "pattern in derotator angle, sharp in wavelength"
    reference = "Harrington et al. 2019, doi:10.1117/1.JATIS.5.3.038001"
    free = {"horizontal": (5 * u.deg, 360 * u.deg), "diagonal": (5 * u.deg, 360 * u.deg)}

    def law(self, key, context):
        """Return one value a wavelength."""
        # free at each wavelength, whatever degree the context asks for
        return None if len(context.wavelength) == 1 else np.eye(len(context.wavelength))

    def build(self, size, anchor, context):
        """Return a linear retarder of any orientation."""
        zero = np.zeros(size) * u.deg
        return optics.EllipticalRetarder(horizontal=zero, diagonal=zero, name=self.label)


class Fringes(StaticRetarder):
    """
    Etalon: retardance that oscillates with the wavenumber.

    The difference of path between the two reflections decides on the period, and
    no derivative at zero tells it: `variants` gives one effect for each that the
    wavelengths can tell apart.

    Parameters
    ----------
    thickness : float
        Difference of path, twice the optical thickness, in micrometre.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.effects import Context, get_effect
    >>> context = Context(np.geomspace(1.16, 2.37, 22))
    >>> [round(fringes.thickness, 2) for fringes in get_effect("fringes").variants(context)][:3]
    [2.27, 4.54, 6.82]
    """

    place = "plane-parallel window behind the derotator"
    title = "fringes of a plane-parallel window"
    shows = "sinusoid in one over the wavelength"
    reference = "Harrington et al. 2017, doi:10.1117/1.JATIS.3.4.048001"
    free = {"horizontal": (1 * u.deg, 30 * u.deg), "diagonal": (1 * u.deg, 30 * u.deg)}

    #: Name without the thickness.
    stem = "fringes"

    def __init__(self, thickness=8.0):
        #: Difference of path between the two reflections, micrometre.
        self.thickness = float(thickness)
        self.name = self.stem if self.thickness == 8 else f"{self.stem}_{self.thickness:.3g}_um"
        self.title = f"{type(self).title}, period 1/({self.thickness:.3g} um)"

    @property
    def label(self):
        """Name of the optic in the chain."""
        return label_of(self.name)

    def law(self, key, context):
        """Return a sine and a cosine in the wavenumber."""
        # fewer wavelengths than a sine, a cosine and what they must be told from
        if len(context.wavelength) < 5:
            return None
        # two reflections interfere with the phase of their difference of path
        phase = 2 * np.pi * self.thickness / context.wavelength
        return np.stack([np.cos(phase), np.sin(phase)], axis=1)

    def variants(self, context):
        """
        Return fringes of all periods that the wavelengths resolve.

        Parameters
        ----------
        context : Context
            Its wavelengths: their range gives the step of the thickness, their
            widest spacing the largest.

        Returns
        -------
        list of Fringes
            Only itself for fewer than five wavelengths.
        """
        wavenumber = np.sort(1 / np.asarray(context.wavelength))
        if len(wavenumber) < 5:
            return [self]
        # one fringe more over the band for each step; the largest has two bins a fringe (Nyquist)
        step = 1 / np.ptp(wavenumber)
        largest = 1 / (2 * np.diff(wavenumber).max())
        return [type(self)(step * (i + 1)) for i in range(int(largest / step))]


class FringesDrift(Fringes):
    """
    Etalon whose fringes drift through the run, as the temperature does.

    The phase of a fringe that drifts linearly turns a cosine in the wavenumber into
    a sine. To first order both have amplitudes that change linearly with time.

    Parameters
    ----------
    thickness : float
        Difference of path, twice the optical thickness, in micrometre.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("fringes_drift").thickness
    8.0
    """

    title = "fringes of a plane-parallel window that drift through the run"
    shows = "sinusoid in one over the wavelength, with time"
    reference = "Harrington & Sueoka 2018, doi:10.1117/1.JATIS.4.1.018006"
    stem = "fringes_drift"
    free = {
        key: (1 * u.deg, 30 * u.deg)
        for key in ("horizontal", "diagonal", "horizontal_rate", "diagonal_rate")
    }

    def build(self, size, anchor, context):
        """Return a retarder that changes through the run."""
        zero = np.zeros(size) * u.deg
        return optics.DriftRetarder(
            **dict.fromkeys(self.free, zero), mount="sequence", name=self.label
        )


class StaticDiattenuator(Insertion):
    """
    Diattenuator that stands still behind the derotator.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("static_diattenuator").shows
    'single differences of all sources, at all plate and derotator angles'
    """

    name, kind, place = "static_diattenuator", "optic", "relay behind the derotator"
    title = "diattenuator that stands still behind the derotator"
    shows = "single differences of all sources, at all plate and derotator angles"
    reference = "de Boer et al. 2020, doi:10.1051/0004-6361/201834989"
    free = {"horizontal": (0.005, 0.3), "diagonal": (0.005, 0.3)}

    def build(self, size, anchor, context):
        """Return a diattenuator of any orientation."""
        return optics.VectorDiattenuator(
            horizontal=np.zeros(size), diagonal=np.zeros(size), name=self.label
        )


class AnisotropicDepolarizer(Depolarization):
    """
    Depolarizer that is not the same for all orientations: a steep retarder averaged over a band.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> list(get_effect("anisotropic_depolarizer").free)
    ['retained_q']
    """

    name, kind, place = "anisotropic_depolarizer", "optic", "relay behind the derotator"
    title = "depolarizer behind the derotator that is not the same for all orientations"
    shows = "Q measured where there is U, with the derotator angle"
    reference = "Harrington et al. 2019, doi:10.1117/1.JATIS.5.3.038001"
    # at 0 deg it would scale what the splitter sees: the efficiency takes that up
    theta = 22.5 * u.deg
    # a retarder averaged over a band keeps what is along its axis, and loses the rest alike
    alike = ("retained_v",)


class DichroicBandAverage(BandAverage):
    """
    Dichroic whose retardance changes within a wavelength bin.

    It acts on the steepest retarder that stands still behind the derotator: one of
    the model, or one that a diagnosis has found, such as ``dichroic_j_band``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import get_effect
    >>> chain = instruments.get("charis").chain(optics_in=["dichroic"])
    >>> get_effect("dichroic_band_average").applies([chain])
    False
    """

    name, kind, place = "dichroic_band_average", "optic", "dichroic"
    title = "retardance of a dichroic that changes within a wavelength bin"
    shows = "less modulation where the retardance is steep, with the derotator angle"

    def retarder(self, roles):
        """Return the steepest retarder behind the derotator that stands still."""
        if roles.derotator is None:
            return None
        names = [leaf.name for leaf in roles.leaves]
        behind = roles.leaves[names.index(roles.derotator.name) + 1 :]
        # a dict by slope: the steepest one is where the average over a bin matters most
        steep = {
            np.abs(slopes).max(): leaf
            for leaf in behind
            if leaf.stage is None and (slopes := retardance_slopes(leaf)) is not None
        }
        return steep[max(steep)] if steep else None


class BeamCrosstalk(Depolarization):
    """
    Light of one beam in the other: less modulation at all angles.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("beam_crosstalk").kind
    'detector'
    """

    name, kind, place = "beam_crosstalk", "detector", "detector"
    title = "light of one beam in the other, or any loss of contrast"
    shows = "amplitude of harmonic 4 of the plate angle alone: the efficiency takes it up"
    reference = "'t Hart et al. 2021, doi:10.1117/12.2594962"
    absorbed_by = "wollaston.efficiency"
    anchor, side = "splitter", "before"


class SplitterOrientation(Insertion):
    """
    Orientation of the beam splitter.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("wollaston_orientation").kind
    'parameter'
    """

    name, kind, place = "wollaston_orientation", "parameter", "Wollaston prism"
    title = "Wollaston prism that is turned"
    shows = "phase with derotator angle, the same at all wavelengths"
    reference = "van Holstein et al. 2020, doi:10.1051/0004-6361/201834996"
    anchor, side = "splitter", "before"
    free = {"circular": (1 * u.deg, 20 * u.deg)}

    def build(self, size, anchor, context):
        """Return a rotator of the polarization in front of the splitter."""
        return optics.EllipticalRetarder(name=self.label)

    def parameters(self, context):
        """Return one angle for all wavelengths."""
        return [EffectParameter(f"{self.label}.circular", *self.free["circular"])]
