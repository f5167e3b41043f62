# Licensed under a 3-clause BSD style license - see LICENSE
"""Places in a chain, and dependences on the frame, of which effects are declared."""

from dataclasses import dataclass

import numpy as np

from astropolcal.chain import Train
from astropolcal.gap.cells import Place, places

__all__ = [
    "Where",
    "after",
    "before",
    "detector",
    "direction",
    "harmonic",
    "inside",
    "move",
    "source",
    "step",
    "telescope",
    "time",
]


@dataclass(frozen=True)
class Where:
    """
    A place in chains, told by an optic.

    Parameters
    ----------
    relation : {"after", "before", "inside", "source", "telescope", "detector"}
        Inside is the frame that turns with the optic.
    optic : str or None
        Its name, or its role.
    is_role : bool
        Whether only the role counts, see `Roles`.
    in_front : bool
        Whether what is inside an optic stands in front of it.
    turned : float
        Orientation to that of the optic, degree.
    otherwise : Where or None
        The place of chains that lack the optic.

    See Also
    --------
    after, before, inside, source, telescope, detector : make one.

    Examples
    --------
    >>> from astropolcal.gap.effects import Where
    >>> Where("inside", "hwp").words
    'hwp'
    """

    relation: str
    optic: str | None = None
    is_role: bool = False
    in_front: bool = False
    turned: float | None = None
    otherwise: object = None

    @property
    def words(self):
        """The place in words."""
        side = {"after": "behind the ", "before": "in front of the "}.get(self.relation, "")
        return f"{side}{self.optic or self.relation}"

    @property
    def follows(self):
        """Whether the orientation is that of the optic, whatever that is."""
        return self.relation == "inside" and self.turned is None

    def anchor(self, roles):
        """Return the optic by which the place is told, None where there is none."""
        own = [] if self.is_role else [o for o in roles.leaves if o.name == self.optic]
        return next(iter(own), getattr(roles, self.optic or "", None))

    def find(self, roles, chosen=None):
        """Return the ``Place`` in a chain, or None; no other where an optic was chosen."""
        if self.relation == "detector":
            split = next((o for o in roles.leaves if o.splits_light), None)
            return split and Place("detector", after=split.name)
        if self.optic is None:
            there = {place.name: place for place in places(Train(roles.leaves))}
            return there.get(self.relation)
        optic = self.anchor(roles)
        if optic is None:
            other = self.otherwise if chosen is None else None
            return other and other.find(roles)
        in_front = self.in_front or self.relation == "before"
        side = {"before" if in_front else "after": optic.name}
        theta, mount = 0.0, None
        if self.relation == "inside" or self.turned is not None:
            theta = np.deg2rad(np.mean(optic.theta.value) + (self.turned or 0.0))
            mount = optic.mount
        return Place(self.cell_place(roles, optic), mount=mount, theta=float(theta), **side)

    def cell_place(self, roles, optic=None):
        """Return the name of the place in the vocabulary of ``Cell``, the nearest that there is."""
        optic = self.anchor(roles) if optic is None else optic
        if optic is None:
            return self.relation if self.optic is None else "source"
        if self.relation == "inside" and optic.stage is not None:
            return f"in:{optic.name}"
        index = {o.name: i for i, o in enumerate(roles.leaves)}
        mine = index[optic.name] + (not (self.in_front or self.relation == "before"))
        found = "source"
        for place in places(Train(roles.leaves)):
            its = index[place.before] if place.after is None else index[place.after] + 1
            if its <= mine and not place.name.startswith("in:"):
                found = place.name
        return found

    def in_front_of(self, roles):
        """Return the name of the place in front of the optic."""
        return Where("before", self.optic, self.is_role).cell_place(roles)


def after(optic):
    """
    Return the place behind an optic, by its name or role, in the frame that stands still.

    Examples
    --------
    >>> from astropolcal.gap.effects import after
    >>> after("hwp").words
    'behind the hwp'
    """
    return Where("after", optic)


def before(optic):
    """
    Return the place in front of an optic, in the frame that stands still.

    Examples
    --------
    >>> from astropolcal.gap.effects import before
    >>> before("wollaston").words
    'in front of the wollaston'
    """
    return Where("before", optic)


def inside(optic):
    """
    Return the place of an optic, in the frame that turns with it.

    Examples
    --------
    >>> from astropolcal.gap.effects import inside
    >>> inside("derotator").words
    'derotator'
    """
    return Where("inside", optic)


def source():
    """
    Return the place behind the source.

    Examples
    --------
    >>> from astropolcal.gap.effects import source
    >>> source().words
    'source'
    """
    return Where("source")


def telescope():
    """
    Return the place behind the telescope, in front of the half-wave plate.

    Examples
    --------
    >>> from astropolcal.gap.effects import telescope
    >>> telescope().words
    'telescope'
    """
    return Where("telescope")


def detector():
    """
    Return the place behind the beam splitter.

    Examples
    --------
    >>> from astropolcal.gap.effects import detector
    >>> detector().words
    'detector'
    """
    return Where("detector")


# ---- dependences -------------------------------------------------------------------------------


def harmonic(stage, n):
    """
    Return the dependence on cosine and sine of n times the angle of a stage.

    Parameters
    ----------
    stage : str
        Its name.
    n : int
        Periods in a turn.

    Returns
    -------
    str

    Examples
    --------
    >>> from astropolcal.gap.effects import harmonic
    >>> harmonic("derotator", 1)
    'harmonic:derotator:1'
    """
    return f"harmonic:{stage}:{n}"


def time():
    """
    Return the dependence on time, a trend through the run.

    Examples
    --------
    >>> from astropolcal.gap.effects import time
    >>> time()
    'time'
    """
    return "time"


def step(frame):
    """
    Return the dependence of what is there from a frame on.

    Examples
    --------
    >>> from astropolcal.gap.effects import step
    >>> step(24)
    'step:24'
    """
    return f"step:{frame}"


def direction(stage):
    """
    Return the dependence on whether the last move of a stage was backwards.

    Examples
    --------
    >>> from astropolcal.gap.effects import direction
    >>> direction("hwp")
    'direction:hwp'
    """
    return f"direction:{stage}"


def move(stage):
    """
    Return the dependence on how far a stage was moved last.

    Examples
    --------
    >>> from astropolcal.gap.effects import move
    >>> move("derotator")
    'move:derotator'
    """
    return f"move:{stage}"
