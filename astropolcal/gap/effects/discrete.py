# Licensed under a 3-clause BSD style license - see LICENSE
"""Discrete alternatives: parity, signs of angles, exchanged beams."""

import astropy.units as u

from astropolcal import optics
from astropolcal.chain import insert_optic, leaves, remove_optic
from astropolcal.gap.effects._shared import Discrete
from astropolcal.gap.effects.base import label_of

__all__ = [
    "DerotatorOffset",
    "DerotatorSign",
    "MirrorBeforePlate",
    "MirrorFlip",
    "PlateOffset",
    "PlateSign",
    "SwappedBeams",
]


class MirrorFlip(Discrete):
    """
    A reflection more or less between derotator and splitter.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("mirror_flip").kind
    'discrete'
    """

    name, place = "mirror_flip", "relay behind the derotator"
    title = "odd number of reflections behind the derotator that the model lacks (or has too many)"
    shows = "everywhere: U and V have the wrong sign"

    def applies_to(self, roles):
        """Return whether there are derotator, or plate, and splitter."""
        return roles.relay is not None and roles.splitter is not None

    def change(self, chain, roles):
        """Return the chain with a parity flip taken out, or put in."""
        order = [leaf.name for leaf in roles.leaves]
        behind = roles.leaves[order.index(roles.relay.name) :]
        flips = [leaf for leaf in behind if isinstance(leaf, optics.ParityFlip)]
        # a flip twice is none: one too many and one too few are the same alternative
        if flips:
            return remove_optic(chain, flips[0].name)
        flip = optics.ParityFlip(name=label_of(self.name))
        return insert_optic(chain, flip, before=roles.splitter.name)


class MirrorBeforePlate(Discrete):
    """
    A reflection more in front of the half-wave plate.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("mirror_flip_before_plate").place
    'in front of the half-wave plate'
    """

    name, place = "mirror_flip_before_plate", "in front of the half-wave plate"
    # an odd number in all: two flips with only rotators between them are a rotation
    title = "odd number of reflections in front of the half-wave plate that the model lacks"
    shows = "everywhere: the polarization turns the other way"

    def applies_to(self, roles):
        """Return whether there is a plate."""
        return roles.plate is not None

    def change(self, chain, roles):
        """Return the chain with a parity flip in front of the plate."""
        flip = optics.ParityFlip(name=label_of(self.name))
        return insert_optic(chain, flip, before=roles.plate.name)


def _in_copy(chain, optic):
    """Return the optic of that name in a copy of the chain in which a role was found."""
    return next(leaf for leaf in leaves(chain) if leaf.name == optic.name)


class PlateSign(Discrete):
    """
    Half-wave plate whose angle counts the other way.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_sign").title
    'angle of the half-wave plate with the wrong sign'
    """

    name, place = "hwp_sign", "stage of the half-wave plate"
    title = "angle of the half-wave plate with the wrong sign"
    shows = "everywhere: the polarization turns the other way"
    acts_on = "plate"

    def applies_to(self, roles):
        """Return whether there is an optic on the stage."""
        return getattr(roles, self.acts_on) is not None

    def change(self, chain, roles):
        """Return the chain with the sign of the stage turned."""
        leaf = _in_copy(chain, getattr(roles, self.acts_on))
        leaf.mount = leaf.stage if leaf.stage_sign < 0 else f"-{leaf.stage}"
        return chain


class DerotatorSign(PlateSign):
    """
    Derotator whose angle counts the other way.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_sign").acts_on
    'derotator'
    """

    name, place, acts_on = "derotator_sign", "stage of the derotator", "derotator"
    title = "angle of the derotator with the wrong sign"
    shows = "everywhere that depends on the derotator angle"


class SwappedBeams(Discrete):
    """
    Ordinary and extraordinary beam exchanged.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("beams_swapped").place
    'detector'
    """

    name, place = "beams_swapped", "detector"
    title = "right and left beam exchanged"
    shows = "everywhere: the differences have the wrong sign"

    def applies_to(self, roles):
        """Return whether there is a splitter."""
        return roles.splitter is not None

    def change(self, chain, roles):
        """Return the chain with the splitter turned by 90 deg."""
        leaf = _in_copy(chain, roles.splitter)
        # T(-90) exchanges the axes of the prism, and with them the beams
        leaf.theta = (leaf.theta.value + 90) * u.deg
        return chain


class PlateOffset(PlateSign):
    """
    Half-wave plate whose angle counts from another zero.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("hwp_offset").offset
    <Quantity 45. deg>
    """

    name = "hwp_offset"
    title = "angle of the half-wave plate from another zero or keyword, off by 45 deg"
    shows = "everywhere: the polarization is turned by 90 deg"
    # two plates 45 deg apart differ by the sign of Q and U: polarization turned by 90 deg
    offset = 45 * u.deg

    def change(self, chain, roles):
        """Return the chain with the optic turned, and the bounds of its angle with it."""
        offset = self.offset.to_value(u.deg)
        leaf = _in_copy(chain, getattr(roles, self.acts_on))
        # bounds of a misalignment are about the nominal zero, which is what moves
        bounds = [None if b is None else b + offset for b in leaf.theta.bounds]
        leaf.theta = (leaf.theta.value + offset) * u.deg
        leaf.theta.bounds = tuple(bounds)
        return chain


class DerotatorOffset(PlateOffset):
    """
    Derotator whose angle counts from another zero.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("derotator_offset").acts_on
    'derotator'
    """

    name, place, acts_on = "derotator_offset", "stage of the derotator", "derotator"
    title = "angle of the derotator from another zero or keyword, off by 45 deg"
    shows = "everywhere that depends on the derotator angle"
