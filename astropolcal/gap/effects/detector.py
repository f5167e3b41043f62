# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects of the detector."""

import numpy as np

from astropolcal import optics
from astropolcal.gap.effects.base import Edit, Insertion
from astropolcal.measurement import Tie

__all__ = ["Background", "BeamGainError", "Nonlinearity", "Persistence"]


class BeamGainError(Insertion):
    """
    Unequal gains of the two beams.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("beam_gain").anchor
    'splitter'
    """

    name, kind, place = "beam_gain", "detector", "detector"
    title = "unequal gains of the two beams (flat field)"
    shows = "single differences of all sources, constant and harmonic 8 of the plate angle"
    reference = "Patat & Romaniello 2006, doi:10.1086/497581"
    anchor = "splitter"
    free = {"imbalance": (0.005, 0.3)}

    def build(self, size, anchor, context):
        """Return a gain of opposite sign in the two beams."""
        return optics.BeamGain(imbalance=np.zeros(size), name=self.label)


class Background(Insertion):
    """
    Background or stray light in the apertures.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("background").side
    'before'
    """

    name, kind, place = "background", "detector", "detector"
    title = "background or stray light in the apertures"
    shows = "amplitude of differences, as one over the flux"
    reference = "Patat & Romaniello 2006, doi:10.1086/497581"
    anchor, side = "splitter", "before"
    free = {"amount": (0.003, 0.2)}

    def build(self, size, anchor, context):
        """Return light that is added at a constant flux."""
        return optics.StrayLight(
            amount=np.zeros(size),
            # the amount is then a share of the usual flux of both beams together
            reference=2 * context.flux,
            mount="total_flux",
            name=self.label,
        )


class _BothBeams(Insertion):
    """A gain of both beams that depends on their own fluxes, with one coefficient."""

    anchor, degree, power, stage = "splitter", 0, 1, "flux"
    #: Whether the stage gives a ratio of fluxes, which needs no flux to refer to.
    is_ratio = False

    def build(self, size, anchor, context):
        """Return a gain that depends on the flux."""
        return optics.FluxGain(
            right=np.zeros(size),
            left=np.zeros(size),
            power=self.power,
            reference=1.0 if self.is_ratio else context.flux,
            mount=self.stage,
            name=self.label,
        )

    def edit(self, chains, context):
        """Return the chains with the gain at zero; see `Effect.edit`."""
        edit = super().edit(chains, context)
        # one detector: the same law for both beams
        ties = edit.ties | {f"{self.label}.left": Tie(f"{self.label}.right")}
        return Edit(edit.chains, edit.parameters[:1], ties)


class Nonlinearity(_BothBeams):
    """
    Detector that does not answer linearly.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("detector_nonlinearity").power
    1
    """

    name, kind, place = "detector_nonlinearity", "detector", "detector"
    title = "detector that does not answer linearly"
    shows = "harmonic 8 of the plate angle in sums, 12 in differences, as the flux"
    reference = "Didier et al. 2019, doi:10.3847/1538-4357/ab0f36; Takakura et al. 2017"
    free = {"right": (0.01, 0.3), "left": (0.01, 0.3)}


class Persistence(_BothBeams):
    """
    Light of the frame before that is still in the detector.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("persistence").stage
    'previous_flux'
    """

    name, kind, place = "persistence", "detector", "detector"
    title = "light of the frame before that is still in the detector"
    shows = "differences that follow those of the frame before"
    reference = "Smith et al. 2008, doi:10.1117/12.789372"
    # the gain of a beam grows as the flux before over the flux now
    power, stage, is_ratio = -1, "previous_flux", True
    free = {"right": (0.003, 0.1), "left": (0.003, 0.1)}
