# Licensed under a 3-clause BSD style license - see LICENSE
"""Bases of effects that several parts of an instrument share."""

from abc import abstractmethod

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.calibration._directions import ranked
from astropolcal.chain import insert_optic
from astropolcal.gap.effects.base import Edit, Effect, EffectParameter, Insertion, label_of
from astropolcal.measurement import Tie

#: Lag of an angle in frames, written as an angle over that of one frame: 0.25, at most 2.
LAG = (0.25 * u.rad, 2 * u.rad)
# a retardance that changes by less than this (radian) from bin to bin is flat
_FLAT = 1e-3


def lagging(stage, name):
    """
    Return a rotator by the change of an angle, times a lag in frames (1 rad is one frame).

    Parameters
    ----------
    stage : str
        Stage whose angle it is, with a minus in front where it counts the other way.
    name : str
        Name of the optic.

    Returns
    -------
    DriftRotator
        Its rate is the lag.

    Examples
    --------
    >>> from astropolcal.gap.effects._shared import lagging
    >>> lagging("parallactic", "late").stage
    'parallactic_rate'
    """
    turn = optics.DriftRotator(mount=f"{stage}_rate", name=name)
    turn.rate.bounds = (-360, 360)
    return turn


class Around(Insertion):
    """An optic in front of another and its inverse behind it: an error of its orientation."""

    constant = True

    def inverse_name(self):
        """Name of the inverse."""
        return f"{self.label}_back"

    def edit(self, chains, context):
        """Return the chains with the pair at zero."""
        edit = super().edit(chains, context)
        edited, ties = [], dict(edit.ties)
        for chain in edit.chains:
            anchor = getattr(self.roles(chain), self.anchor)
            if anchor is not None:
                back = self._freed(self.build(len(context.wavelength), anchor, context))
                back.name = self.inverse_name()
                chain = insert_optic(chain, back, after=anchor.name)
                # equal and opposite: what turns the light in front is turned back behind
                for key in self.free:
                    ties[f"{back.name}.{key}"] = Tie(f"{self.label}.{key}", factor=-1.0)
            edited.append(chain)
        return Edit(edited, edit.parameters, ties)


class Depolarization(Insertion):
    """
    A depolarizer by one number, with the losses that go with it.

    One that loses Q alone is not physical: its coherency matrix has a negative eigenvalue.
    """

    free = {"retained_q": (0.01, 0.5)}
    #: Shares that are the same as that of Q.
    alike = ("retained_u", "retained_v")
    #: Orientation of its axes.
    theta = 0 * u.deg

    def build(self, size, anchor, context):
        """Return a depolarizer that keeps everything."""
        keep = dict.fromkeys((*self.free, *self.alike), np.ones(size))
        return optics.Depolarizer(**keep, theta=self.theta, name=self.label)

    def edit(self, chains, context):
        """Return the chains with the depolarizer at zero; see `Effect.edit`."""
        edit = super().edit(chains, context)
        (name,) = (parameter.name for parameter in edit.parameters)
        ties = {f"{self.label}.{key}": Tie(name) for key in self.alike}
        return Edit(edit.chains, edit.parameters, edit.ties | ties)

    def _freed(self, optic):
        for key in optic.param_names:
            getattr(optic, key).fixed = key not in (*self.free, *self.alike)
        return optic


class Discrete(Effect):
    """An alternative without parameters: it is fitted from the start, or not at all."""

    kind = "discrete"
    reference = "McIntosh et al. 2026, Sec. 4; the reflections and signs of a chain"

    @abstractmethod
    def change(self, chain, roles):
        """Return the changed chain."""

    def edit(self, chains, context):
        """Return the changed chains; nothing is added that could be fitted."""
        edited = []
        for chain in chains:
            roles = self.roles(chain)
            edited.append(self.change(chain.copy(), roles) if self.applies_to(roles) else chain)
        return Edit(edited, [])


class BandAverage(Effect):
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
        return not present and retardance_slopes(self.retarder(roles)) is not None

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
        slopes = retardance_slopes(retarder)
        # the linear retardance moves along one axis of the (H, 45) plane nearly: its main
        # direction
        axis = np.linalg.svd(slopes, full_matrices=False)[2][0]
        # a singular vector has any sign, and with it the optic would be turned by 90 deg
        axis *= np.sign(axis[ranked(np.abs(axis))[0]])
        square = (slopes @ axis) ** 2
        keep = np.ones(len(slopes))
        optic = optics.Depolarizer(
            retained_u=keep,
            retained_v=keep,
            theta=retarder.theta.value * u.deg + np.arctan2(axis[1], axis[0]) / 2 * u.rad,
            mount=retarder.mount,
            name=self.label,
        )
        # along the axis nothing is lost
        optic.retained_q.fixed, optic.theta.bounds = True, (None, None)
        return square / square.max(), insert_optic(chain, optic, after=retarder.name)


def retardance_slopes(retarder):
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
    # a retardance known modulo a turn has no jump of a turn from bin to bin
    slopes = np.gradient(np.unwrap(np.deg2rad(parts), axis=0), axis=0)
    return slopes if np.abs(slopes).max() > _FLAT else None
