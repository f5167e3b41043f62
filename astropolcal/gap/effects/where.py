# Licensed under a 3-clause BSD style license - see LICENSE
"""Places of effects in a chain, given by its optics and by what these are for."""

from dataclasses import dataclass

import numpy as np

from astropolcal import optics
from astropolcal.chain import Train, leaves
from astropolcal.gap.cells import Place, places
from astropolcal.optics import COORDINATES

__all__ = []

#: Roles of which a chain may have several optics.
SEVERAL = ("polarizer", "mirror", "plate", "derotator", "telescope_mirror", "turning")
# positions that are not those of a stage which carries a retarder
_NO_STAGES = (None, "parallactic", "altitude", *COORDINATES)
_RETARDERS = (
    optics.LinearRetarder,
    optics.EllipticalRetarder,
    optics.TwoLayerWaveplate,
    optics.DiattenuatorRetarder,
    optics.KMirror,
)
_BEHIND, _BEHIND_PLATE = "downstream of the derotator", "downstream of the half-wave plate"


@dataclass(frozen=True)
class Where:
    """A place in chains, given by an optic."""

    #: ``"after"``, ``"before"`` or ``"in"`` an optic, the latter in the frame that turns with it;
    #: ``"source"``, ``"telescope"`` or ``"detector"``.
    relation: str
    optic: str | None = None
    #: Whether only the role counts, see `Roles`.
    is_role: bool = False
    #: Whether what is inside an optic stands in front of it.
    in_front: bool = False
    #: Orientation to that of the optic, degree.
    turned: float | None = None
    #: The place of chains that lack the optic.
    otherwise: object = None
    #: The place in words, where they are not those of the optic.
    said: str = ""

    @classmethod
    def of(cls, place):
        """Return the place of a text such as ``"after:hwp"``, None where it is not a place."""
        relation, _, optic = place.partition(":")
        known = ("after", "before", "in") if optic else ("source", "telescope", "detector")
        return cls(relation, optic or None) if relation in known else None

    @property
    def words(self):
        """The place in words."""
        side = {"after": "downstream of the ", "before": "upstream of the "}.get(self.relation, "")
        return self.said or f"{side}{self.optic or self.relation}"

    @property
    def follows(self):
        """Whether the orientation is that of the optic, regardless of its value."""
        return self.relation == "in" and self.turned is None

    def anchor(self, roles):
        """Return the optic by which the place is given, None where there is none."""
        if self.optic is None:
            # an optic without a name is not what is meant
            return None
        own = [] if self.is_role else [o for o in roles.leaves if o.name == self.optic]
        return next(iter(own), getattr(roles, self.optic, None))

    def find(self, roles, chosen=None):
        """Return the ``Place`` in a chain, or None; no other where an optic was chosen."""
        if self.relation == "detector":
            last = _last(roles.leaves)
            return last and Place("detector", after=last.name)
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
        if self.relation == "in" or self.turned is not None:
            theta = np.deg2rad(np.mean(optic.theta.value) + (self.turned or 0.0))
            mount = optic.mount
        return Place(self.cell_place(roles, optic), mount=mount, theta=float(theta), **side)

    def cell_place(self, roles, optic=None):
        """Return the name of the place in the vocabulary of ``Cell``, the nearest that there is."""
        optic = self.anchor(roles) if optic is None else optic
        if optic is None:
            return self.relation if self.optic is None else "source"
        if self.relation == "in" and optic.stage is not None:
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
        """Return the name of the place upstream of the optic."""
        return Where("before", self.optic, self.is_role).cell_place(roles)


def _last(found):
    """Return the splitter of some optics, or the last one of a beam that is analysed."""
    analysed = any(isinstance(o, (optics.LinearPolarizer, optics.StateAnalyser)) for o in found)
    return next((o for o in found if o.splits_light), found[-1] if analysed else None)


def is_held(parameter):
    """Return whether a parameter is fixed, or as good as that: known beforehand."""
    return bool(parameter.fixed or parameter.prior is not None)


class Roles:
    """
    The optics of a chain by what they are for.

    There may be several of a kind. The plates are the retarders on the stage ``hwp``, and those
    on a stage upstream of it, or without it all but those on ``derotator``; the derotators are
    retarders on a stage downstream of the plate, regardless of its name; the telescope's mirrors
    stand between the rotation by the parallactic angle and the plate.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain.
    **chosen
        Role to the name of the optic that has it, where that is not the first of its kind.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import Roles
    >>> roles = Roles(instruments.get("charis").chain())
    >>> roles.plate.name, roles.derotator.name, roles.splitter.name
    ('hwp', 'derotator', 'wollaston')
    >>> irdis = Roles(instruments.get("irdis").chain("star"))
    >>> [mirror.name for mirror in irdis.all("telescope_mirror")]
    ['ut', 'm4']
    """

    def __init__(self, chain, **chosen):
        self.leaves = leaves(chain)
        # what an effect has added stands for nothing else
        self._own = [o for o in self.leaves if o.name and not o.name.startswith("gap_")]
        # what stands in the place of the polarizer for unpolarized light
        first = self.leaves[0]
        is_mirror = isinstance(first, (optics.Diattenuator, optics.DiattenuatorRetarder))
        self._kinds = {
            "polarizer": [o for o in self._own if isinstance(o, optics.LinearPolarizer)],
            "mirror": [first] if is_mirror and first.stage is None else [],
            **self._turning(),
        }
        front = self._in_front()
        self._kinds["telescope_mirror"] = [o for o in front if hasattr(o, "diattenuation")]
        for role, found in self._kinds.items():
            name = chosen.get(role)
            own = (o for o in found if name in (None, o.name))
            setattr(self, role, next(own, None))
        turns = [o for o in self.leaves if isinstance(o, optics.Rotator)]
        names = [o.stage for o in turns]
        # without a rotation by the parallactic angle the light is that of an internal source
        sky = turns[names.index("parallactic") :] if "parallactic" in names else []
        stars = self.leaves[: self.leaves.index(sky[0])] if sky else []
        #: Rotations by the parallactic angle and the altitude, and the star in front of them.
        self.parallactic = next(iter(sky), None)
        self.altitude = next((o for o in sky if o.stage == "altitude"), None)
        self.star = next((o for o in stars if isinstance(o, optics.PolarizedSource)), None)
        self.splitter = next((o for o in self._own if isinstance(o, optics.WollastonPrism)), None)
        #: What static optics of the relay stand behind; others stand behind the plate, too.
        plates = self._kinds["plate"]
        if plates and plates[0].stage != "hwp":
            # without a half-wave plate they come in the order of the light
            plates = plates[::-1]
        turning = [o for o in (self.derotator, *plates[:1]) if o is not None]
        self.relay = next(iter(turning), None)
        # behind a polarizer that does not turn such an optic is a property of the source
        polarizers = [o for o in self.all("polarizer") if o is not self._own[-1]]
        turning += [o for o in polarizers if o.stage is not None]
        self._kinds["turning"] = turning
        self.turning = next((o for o in turning if chosen.get("turning") in (None, o.name)), None)
        #: The plate, where the model has nothing in front of it that could polarize.
        self.entrance = self.plate if self._is_entrance() else None

    def all(self, role):
        """Return all optics of a role, in the order in which light meets them."""
        return self._kinds.get(role, [])

    def _turning(self):
        """Return plates and derotators."""
        found = [o for o in self._own if isinstance(o, _RETARDERS) and o.stage not in _NO_STAGES]
        names = [o.stage for o in found]
        plates = [o for o in found if o.stage == "hwp"]
        if plates:
            plates += found[: names.index("hwp")]
        else:
            # without a half-wave plate whatever turns is the plate, but for a derotator
            plates = [o for o in found if o.stage != "derotator"]
        behind = [o for o in found if not any(o is plate for plate in plates)]
        return {"plate": plates, "derotator": sorted(behind, key=lambda o: o.stage != "derotator")}

    def _in_front(self):
        """Return what stands between the rotation by the parallactic angle and the plate."""
        names = [o.stage for o in self._own]
        start = names.index("parallactic") + 1 if "parallactic" in names else len(names)
        plate = self._kinds["plate"]
        end = next((i for i, o in enumerate(self._own) if plate and o is plate[0]), start)
        return [o for o in self._own[start:end] if not isinstance(o, optics.Rotator)]

    def _is_entrance(self):
        if self.plate is None:
            return False
        if self._own[0] is self.plate:
            return True
        on = {o.stage for o in self._own}
        if "parallactic" not in on or "altitude" in on:
            return False
        # the sky turns, and the instrument with the telescope
        return all(is_held(getattr(o, key)) for o in self._in_front() for key in o.param_names)


def adapted(effects, chains, runs=()):
    """
    Return the effects of a library that chains have a place for, one for each optic of a kind.

    Parameters
    ----------
    effects : sequence of Effect
        The library.
    chains : sequence
        One per dataset.
    runs : sequence of str
        Names of the datasets, where several are of one kind of source.

    Returns
    -------
    list of Effect
        An effect that acts on one kind of optic comes once for each such optic: under its own name
        for the first, as ``"name:optic"`` for the others. Where there is no derotator, the words
        of what stands downstream of it name the half-wave plate; where there is no such plate,
        the words name the optic. A polarizer that turns is such an optic, too.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import EFFECTS, adapted
    >>> chain = instruments.get("irdis").chain("star")
    >>> chain["ut"].diattenuation.fixed = chain["m4"].diattenuation.fixed = True
    >>> [effect.name for effect in adapted([EFFECTS["m3_diattenuation"]], [chain])]
    ['m3_diattenuation', 'm3_diattenuation:m4']
    """
    chains = list(chains)
    found = [own for effect in effects for own in effect.per_optic(chains)]
    found = [one for effect in found for one in effect.per_run(runs)]
    found = [one for one in found if one.applies(chains)]
    every = [Roles(chain) for chain in chains]
    plates = [o for roles in every for o in roles.all("plate")]
    relays = [roles.relay.name for roles in every if roles.relay is not None]
    turning = [o.name for roles in every for o in roles.all("turning")]
    # none is on the stage of a half-wave plate
    own_name = plates and not any(o.stage == "hwp" for o in plates)
    for i, one in enumerate(found):
        words = {}
        if own_name and one.acts_on == "plate":
            words |= {"half-wave plate": one.optic or plates[0].name, f" ({one.optic})": ""}
        behind = one.optic if one.acts_on == "turning" else None
        if behind:
            words[f" ({behind})"] = ""
        elif all(roles.derotator is None for roles in every):
            behind = next(iter(relays + turning), None)
        if behind:
            is_plate = not own_name and behind in {o.name for o in plates}
            words[_BEHIND] = _BEHIND_PLATE if is_plate else f"downstream of the {behind}"
        for old, new in words.items():
            if old in one.title + one.place:
                title, place = (text.replace(old, new) for text in (one.title, one.place))
                found[i] = one = one.changed(title=title, place=place)
    return found
