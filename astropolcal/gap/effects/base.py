# Licensed under a 3-clause BSD style license - see LICENSE
"""
What an unmodelled effect is: an edit of the chains, with parameters and their laws.

An effect adds an optic, frees a parameter, or exchanges one optic for another.
At zero parameters the edited chains are the old ones, so that derivatives at
zero tell what the effect would do to the data; fitted, the edited chains are
ordinary chains again.
"""

import copy
import re
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import astropy.units as u
import numpy as np

from astropolcal import instruments, optics
from astropolcal.chain import insert_optic, leaves
from astropolcal.exceptions import InstrumentError
from astropolcal.gap.problem import law_basis
from astropolcal.measurement import Tie
from astropolcal.observations.pointing import TRACKING
from astropolcal.optics import COORDINATES

__all__ = [
    "KINDS",
    "Context",
    "Edit",
    "Effect",
    "EffectParameter",
    "Insertion",
    "Roles",
    "adapted",
    "tracking_laws",
]

#: What an effect may be.
KINDS = ("optic", "parameter", "bound", "detector", "source", "discrete")


@dataclass(frozen=True)
class EffectParameter:
    """
    A parameter that an effect adds.

    Parameters
    ----------
    name : str
        ``"optic.parameter"``.
    scale : `~astropy.units.Quantity` or float
        Size to expect: the standard deviation of its prior.
    limit : `~astropy.units.Quantity` or float
        Largest size that is physical.
    basis : `~numpy.ndarray` or None
        Law in wavelength, shape (W, k); None for a single number.
    neutral : `~astropy.units.Quantity` or float, optional
        Value from which the size counts; by default 1 for a share that is
        retained and 0 for everything else.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.gap.effects import EffectParameter
    >>> EffectParameter("static_retarder.circular", 1 * u.deg, 30 * u.deg, None).name
    'static_retarder.circular'
    """

    name: str
    scale: object
    limit: object
    basis: np.ndarray | None = None
    neutral: object = None


@dataclass(frozen=True)
class Edit:
    """
    Chains with an effect in them.

    Parameters
    ----------
    chains : list
        One a dataset.
    parameters : list of EffectParameter
        What the effect adds.
    ties : dict of str to Tie
        Parameters that follow others.

    Examples
    --------
    >>> from astropolcal.gap.effects import Edit
    >>> Edit([], []).ties
    {}
    """

    chains: list
    parameters: list
    ties: dict = field(default_factory=dict)


@dataclass(frozen=True)
class Context:
    """
    What an effect may know of the data.

    Parameters
    ----------
    wavelength : `~numpy.ndarray`
        Common grid in micrometre, shape (W,).
    flux : float
        Median flux of a beam, in the tables' unit.
    degree : int or None
        Degree of the laws in wavelength, None for one value a wavelength, or
        "default" for that of each effect.
    tracking : tuple of (float, float)
        Law by which the half-wave plate of each dataset follows the sky, see
        `tracking_laws`.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.effects import Context
    >>> Context(np.array([1.2, 1.6])).basis(1).shape
    (2, 2)
    """

    wavelength: np.ndarray
    flux: float = 1.0
    degree: object = "default"
    tracking: tuple = ()

    def basis(self, degree, constant=True):
        """Return the law's basis; without its constant where that is known already."""
        wanted = degree if self.degree == "default" else self.degree
        found = law_basis(self.wavelength, wanted)
        if constant:
            return found
        if wanted is None:
            # one value a wavelength, less their mean
            n = len(found)
            return np.linalg.svd(found - 1 / n)[0][:, : n - 1]
        return found[:, 1:]


def tracking_laws(observations):
    """
    Return the law of the half-wave plate of every dataset, as its instrument tells it.

    Parameters
    ----------
    observations : sequence of Observations
        The datasets.

    Returns
    -------
    tuple of (float, float)
        Factors of parallactic angle and altitude; those of
        `~astropolcal.observations.tracked` for tables of no known instrument.

    Examples
    --------
    >>> from astropolcal.gap.effects.base import tracking_laws
    >>> from astropolcal.observations import Observations, example_table
    >>> tracking_laws([Observations.from_table(example_table())])
    ((0.5, 1.0),)
    """
    return tuple(_tracking_law(one) for one in observations)


def _tracking_law(observations):
    if observations.instrument is None:
        return TRACKING
    try:
        return instruments.get(observations.instrument).plate_law(observations)
    except InstrumentError:
        return TRACKING


class Roles:
    """
    The optics of a chain by what they are for.

    There may be several of a kind. The plates are the retarders on the stage ``hwp``, and those
    on a stage in front of it; the derotators are retarders on a stage behind the plate, whatever
    it is called; the telescope's mirrors stand between the rotation by the parallactic angle and
    the plate.

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
        self._kinds = {
            "polarizer": [o for o in self._own if isinstance(o, optics.LinearPolarizer)],
            "mirror": self._source_mirrors(),
            **self._turning(),
        }
        self._kinds["telescope_mirror"] = self._telescope_mirrors()
        for role, found in self._kinds.items():
            name = chosen.get(role)
            own = (o for o in found if name in (None, o.name))
            setattr(self, role, next(own, None))
        self.splitter = next((o for o in self._own if isinstance(o, optics.WollastonPrism)), None)
        #: What static optics of the relay stand behind.
        self.relay = self.derotator or self.plate
        #: The plate, where the model has nothing in front of it that could polarize.
        self.entrance = self.plate if self._is_entrance() else None

    def all(self, role):
        """Return all optics of a role, in the order in which light meets them."""
        return self._kinds.get(role, [])

    def _source_mirrors(self):
        """Return what stands in the place of the polarizer for unpolarized light."""
        first = self.leaves[0]
        kinds = (optics.Diattenuator, optics.DiattenuatorRetarder)
        return [first] if isinstance(first, kinds) and first.stage is None else []

    def _turning(self):
        """Return plates and derotators."""
        found = [o for o in self._own if _retards(o) and o.stage not in (None, *_NO_STAGES)]
        names = [o.stage for o in found]
        middle = names.index("hwp") if "hwp" in names else -1
        plates = [o for o in found if o.stage == "hwp"]
        plates += found[: max(middle, 0)]
        behind = [o for o in found if not any(o is plate for plate in plates)]
        return {"plate": plates, "derotator": sorted(behind, key=lambda o: o.stage != "derotator")}

    def _in_front(self):
        """Return what stands between the rotation by the parallactic angle and the plate."""
        names = [o.stage for o in self._own]
        start = names.index("parallactic") + 1 if "parallactic" in names else len(names)
        plate = self._kinds["plate"]
        end = next((i for i, o in enumerate(self._own) if plate and o is plate[0]), start)
        return [o for o in self._own[start:end] if not isinstance(o, optics.Rotator)]

    def _telescope_mirrors(self):
        return [o for o in self._in_front() if hasattr(o, "diattenuation")]

    def _is_entrance(self):
        if self.plate is None:
            return False
        if self._own[0] is self.plate:
            return True
        on = {o.stage for o in self._own}
        if "parallactic" not in on or "altitude" in on:
            return False
        # the sky turns, and the instrument with the telescope
        return all(getattr(o, key).fixed for o in self._in_front() for key in o.param_names)


# positions that are not those of a stage which carries a retarder
_NO_STAGES = ("parallactic", "altitude", *COORDINATES)


def _retards(optic):
    kinds = (
        optics.LinearRetarder,
        optics.EllipticalRetarder,
        optics.TwoLayerWaveplate,
        optics.DiattenuatorRetarder,
        optics.KMirror,
    )
    return isinstance(optic, kinds)


def adapted(effects, chains):
    """
    Return the effects of a library that chains have a place for, one for each optic of a kind.

    Parameters
    ----------
    effects : sequence of Effect
        The library.
    chains : sequence
        One a dataset.

    Returns
    -------
    list of Effect
        An effect that acts on one kind of optic comes once for each such optic: under its own name
        for the first, as ``"name:optic"`` for the others. Where there is no derotator, the words
        of what stands behind it name the half-wave plate.

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
    found = [one for effect in effects for one in effect.per_optic(chains)]
    found = [one for one in found if one.applies(chains)]
    if any(Roles(chain).derotator is not None for chain in chains):
        return found
    return [_reworded(one) for one in found]


def _reworded(effect):
    words = {"title": effect.title, "place": effect.place}
    new = {key: text.replace(_BEHIND, _BEHIND_PLATE) for key, text in words.items()}
    return effect if new == words else effect.changed(**new)


_BEHIND, _BEHIND_PLATE = "behind the derotator", "behind the half-wave plate"


class Effect(ABC):
    """
    An effect that the model of an instrument may lack.

    A subclass gives the attributes, `applies` and `edit`, and is registered with
    `register_effect`.

    Attributes
    ----------
    name : str
        Identifier.
    title : str
        What it is, for a reader.
    kind : str
        One of ``KINDS``.
    place : str
        Where in the instrument.
    shows : str
        Where in the data.
    reference : str
        Paper.
    absorbed_by : str or None
        The parameters of a usual nominal model that take the effect up
        entirely, so that data never show it; None where there are none.

    Examples
    --------
    >>> from astropolcal.gap.effects import get_effect
    >>> get_effect("beam_gain").kind
    'detector'
    """

    name = title = kind = place = shows = reference = absorbed_by = None
    #: Degree of the law in wavelength.
    degree = 2
    #: Role of the optic that it acts on, see `Roles`; None where that is no single one.
    acts_on = None
    #: Name of that optic, where it is not the first of its kind.
    optic = None

    def roles(self, chain):
        """Return the optics of a chain by what they are for, with the one that it acts on."""
        chosen = {} if self.optic is None else {self.acts_on: self.optic}
        return Roles(chain, **chosen)

    def changed(self, **attributes):
        """Return a copy with other attributes."""
        new = copy.copy(self)
        for key, value in attributes.items():
            setattr(new, key, value)
        return new

    def at(self, optic):
        """
        Return the effect of one optic of its kind.

        Parameters
        ----------
        optic : str
            Its name.

        Returns
        -------
        Effect
            With the name ``"effect:optic"``.
        """
        return self.changed(
            optic=optic, name=f"{self.name}:{optic}", title=f"{self.title} ({optic})"
        )

    def per_optic(self, chains):
        """
        Return the effect once for each optic of the kind that it acts on.

        Parameters
        ----------
        chains : sequence
            One a dataset.

        Returns
        -------
        list of Effect
            Itself for the optic that is the first of its kind, and one for each other.
        """
        if self.acts_on is None or self.optic is not None:
            return [self]
        every = [Roles(chain).all(self.acts_on) for chain in chains]
        first = {found[0].name for found in every if found}
        others = dict.fromkeys(o.name for found in every for o in found if o.name not in first)
        return [self, *(self.at(name) for name in others)]

    def applies(self, chains):
        """
        Return whether the chains have the place for this effect.

        Parameters
        ----------
        chains : sequence
            One a dataset.

        Returns
        -------
        bool
        """
        return any(self.applies_to(self.roles(chain)) for chain in chains)

    @abstractmethod
    def applies_to(self, roles):
        """Return whether one chain has the place."""

    @abstractmethod
    def edit(self, chains, context):
        """
        Return the chains with the effect at zero.

        Parameters
        ----------
        chains : sequence
            One a dataset; not changed.
        context : Context
            Wavelengths and fluxes.

        Returns
        -------
        Edit
        """

    def variants(self, context):
        """
        Return the effect in all the settings among which the data may choose.

        Parameters
        ----------
        context : Context
            Wavelengths and fluxes.

        Returns
        -------
        list of Effect
            Only itself, unless a setting enters the law in a way that is not
            linear, as the thickness of a window does.
        """
        return [self]

    def __repr__(self):
        return f"<Effect {self.name}: {self.title}>"


# roles of which a chain may have several optics
_SEVERAL = ("polarizer", "mirror", "plate", "derotator", "telescope_mirror")


def label_of(name):
    """Return the name of an optic that an effect adds."""
    return "gap_" + re.sub(r"\W", "_", name)


class Insertion(Effect):
    """
    An effect that is one more optic, at a place given by another.

    A subclass gives `anchor`, `build` and the parameters that it frees.

    Attributes
    ----------
    anchor : str
        The role that it stands next to, see `Roles`.
    side : {"after", "before"}
        On which side.
    free : dict of str to (scale, limit)
        The optic's parameters that the effect frees.
    follows : bool
        Whether its orientation is that of the optic it stands next to.

    Examples
    --------
    >>> from astropolcal.gap.effects import Insertion, get_effect
    >>> isinstance(get_effect("static_retarder"), Insertion)
    True
    """

    anchor = "relay"
    side = "after"
    follows = False
    constant = True
    free = ()

    @property
    def acts_on(self):
        """Role of the optic that it acts on, where there may be several of a kind."""
        return self.anchor if self.anchor in _SEVERAL else None

    @property
    def label(self):
        """Name of the optic in the chain."""
        return label_of(self.name)

    def applies_to(self, roles):
        """Return whether one chain has the optic to stand next to."""
        return getattr(roles, self.anchor) is not None

    @abstractmethod
    def build(self, size, anchor, context):
        """Return the optic with all of its parameters at zero."""

    def edit(self, chains, context):
        """Return the chains with the optic at zero; see `Effect.edit`."""
        edited, ties = [], {}
        size = len(context.wavelength)
        for chain in chains:
            anchor = getattr(self.roles(chain), self.anchor)
            if anchor is None:
                edited.append(chain)
                continue
            optic = self._freed(self.build(size, anchor, context))
            if self.follows:
                optic.theta = anchor.theta.value * u.deg
                if not anchor.theta.fixed:
                    optic.theta.bounds = (None, None)
                    ties[f"{self.label}.theta"] = Tie(f"{anchor.name}.theta")
            edited.append(insert_optic(chain, optic, **{self.side: anchor.name}))
        return Edit(edited, self.parameters(context), ties)

    def _freed(self, optic):
        for key in optic.param_names:
            parameter = getattr(optic, key)
            parameter.fixed = key not in self.free
        return optic

    def parameters(self, context):
        """Return the parameters that the effect adds."""
        return [
            EffectParameter(f"{self.label}.{key}", *sizes, self.law(key, context))
            for key, sizes in self.free.items()
        ]

    def law(self, key, context):
        """Return the law of a parameter in wavelength, None for a single number."""
        if self.degree is None or len(context.wavelength) == 1:
            return None
        return context.basis(self.degree, self.constant)
