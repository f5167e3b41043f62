# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects of what stands still between the derotator and the beam splitter."""

from abc import abstractmethod

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import insert_optic
from astropolcal.gap.effects.base import Edit, Effect, EffectParameter, Insertion, label_of
from astropolcal.measurement import Tie

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

# a retardance that changes by less than this (radian) from bin to bin is flat
_FLAT = 1e-3


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
        if len(context.wavelength) < 5:
            return None
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


class AnisotropicDepolarizer(Insertion):
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
    free = {"retained_q": (0.01, 0.5)}

    def build(self, size, anchor, context):
        """Return a depolarizer between the axes of the splitter, which keeps everything."""
        optic = optics.Depolarizer(retained_q=np.ones(size), theta=22.5 * u.deg, name=self.label)
        optic.retained_q.bounds = (0.0, 1.5)
        return optic


class _BandAverage(Effect):
    r"""
    Retarder whose retardance changes within a wavelength bin.

    Averaged over a bin in which it changes by s, a retarder keeps the polarization
    along its axis and loses the share :math:`1 - \mathrm{sinc}(s/2) \approx s^2/24` of
    what is at 45 deg to it, or circular: a depolarizer with the axes of the retarder
    and a law in wavelength that is tied to the square of its slope. The constant of the law
    is a loss at all wavelengths.

    A subclass gives `retarder`.
    """

    reference = "Harrington et al. 2019, doi:10.1117/1.JATIS.5.3.038001"
    #: Size to expect and limit of the loss.
    sizes = (0.005, 0.2)

    @property
    def label(self):
        """Name of the depolarizer in the chain."""
        return label_of(self.name)

    @abstractmethod
    def retarder(self, roles):
        """Return the retarder, None where there is none."""

    def applies_to(self, roles):
        """Return whether there is a retarder whose retardance depends on the wavelength."""
        present = any(leaf.name == self.label for leaf in roles.leaves)
        return not present and _slopes(self.retarder(roles)) is not None

    def edit(self, chains, context):
        """Return the chains with the depolarizer at zero; see `Effect.edit`."""
        edited, law = [], None
        for chain in chains:
            roles = self.roles(chain)
            if self.applies_to(roles):
                law, chain = self._behind(chain, self.retarder(roles))
            edited.append(chain)
        name = f"{self.label}.retained_u"
        basis = np.column_stack([np.ones(len(law)), law])
        ties = {f"{self.label}.retained_v": Tie(name)}
        return Edit(edited, [EffectParameter(name, *self.sizes, basis)], ties)

    def _behind(self, chain, retarder):
        """Return the law, and the chain with a depolarizer along the axis of the retarder."""
        slopes = _slopes(retarder)
        axis = np.linalg.svd(slopes, full_matrices=False)[2][0]
        square = (slopes @ axis) ** 2
        keep = np.ones(len(slopes))
        optic = optics.Depolarizer(
            retained_u=keep,
            retained_v=keep,
            theta=retarder.theta.value * u.deg + np.arctan2(axis[1], axis[0]) / 2 * u.rad,
            mount=retarder.mount,
            name=self.label,
        )
        optic.retained_q.fixed, optic.theta.bounds = True, (None, None)
        optic.retained_u.bounds = optic.retained_v.bounds = (0.0, 1.5)
        return square / square.max(), insert_optic(chain, optic, after=retarder.name)


def _slopes(retarder):
    """
    Return the change of both linear retardances within a bin, radian, shape (W, 2).

    None where there is no retarder, or its retardance does not depend on the wavelength.
    """
    if isinstance(retarder, optics.LinearRetarder):
        parts = retarder.retardance.value, 0.0
    elif isinstance(retarder, optics.EllipticalRetarder):
        parts = retarder.horizontal.value, retarder.diagonal.value
    else:
        return None
    parts = np.stack(np.broadcast_arrays(*parts), axis=-1)
    if parts.ndim == 1 or len(parts) < 3:
        return None
    slopes = np.gradient(np.unwrap(np.deg2rad(parts), axis=0), axis=0)
    return slopes if np.abs(slopes).max() > _FLAT else None


class DichroicBandAverage(_BandAverage):
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
        steep = {
            np.abs(slopes).max(): leaf
            for leaf in behind
            if leaf.stage is None and (slopes := _slopes(leaf)) is not None
        }
        return steep[max(steep)] if steep else None


class BeamCrosstalk(Insertion):
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
    free = {"retained_q": (0.01, 0.5)}

    def build(self, size, anchor, context):
        """Return a depolarizer that keeps everything."""
        optic = optics.Depolarizer(retained_q=np.ones(size), name=self.label)
        optic.retained_q.bounds = (0.0, 1.5)
        return optic


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
