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
from scipy.linalg import helmert

from astropolcal import instruments
from astropolcal.chain import insert_optic
from astropolcal.exceptions import InstrumentError
from astropolcal.gap.effects.roles import SEVERAL, Roles
from astropolcal.gap.problem import law_basis
from astropolcal.measurement import Tie
from astropolcal.observations.pointings import TRACKING
from astropolcal.units import canonical_factor

__all__ = [
    "KINDS",
    "Context",
    "Edit",
    "Effect",
    "EffectParameter",
    "Insertion",
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

    @property
    def canonical_scale(self):
        """Size to expect in canonical units."""
        return _canonical(self.scale)

    @property
    def canonical_limit(self):
        """Largest size that is physical in canonical units."""
        return _canonical(self.limit)

    @property
    def canonical_neutral(self):
        """Value at which the effect is absent, canonical; scalar or one a wavelength."""
        if self.neutral is not None:
            value = u.Quantity(self.neutral)
            return value.value * canonical_factor(value.unit)
        # an optic that keeps all of the polarization is none
        return 1.0 if self.is_retained else 0.0

    @property
    def is_retained(self):
        """Whether it is a share of polarization that an optic retains, 1 where it does nothing."""
        return self.name.split(".")[1].startswith("retained")


def _canonical(value):
    value = u.Quantity(value)
    return float(value.value * canonical_factor(value.unit))


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

    @property
    def laws(self):
        """Law in wavelength of the parameters that follow one, by name."""
        return {p.name: p.basis for p in self.parameters if p.basis is not None}

    @property
    def limits(self):
        """Largest physical size of every parameter, canonical, by name."""
        return {p.name: p.canonical_limit for p in self.parameters}

    @property
    def priors(self):
        """Standard deviation of the prior of every parameter, canonical, by name."""
        # two standard deviations reach the limit: sizes are held where the data are silent only
        return {name: limit / 2 for name, limit in self.limits.items()}


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
    datasets : tuple of str
        Names of the datasets.

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
    datasets: tuple = ()

    @classmethod
    def of(cls, wavelength, observations):
        """Return what the datasets tell, on their common grid of wavelengths."""
        fluxes = [np.nanmedian(o.flux_right + o.flux_left) / 2 for o in observations]
        return cls(
            wavelength,
            float(np.median(fluxes)),
            tracking=tracking_laws(observations),
            datasets=tuple(o.name for o in observations),
        )

    def basis(self, degree, constant=True):
        """Return the law's basis; without its constant where that is known already."""
        wanted = degree if self.degree == "default" else self.degree
        found = law_basis(self.wavelength, wanted)
        if constant:
            return found
        # a constant over the wavelengths is the orientation of the optic, which is known by itself
        if wanted is None:
            # one value a wavelength, less their mean; singular vectors would be any basis of these
            return helmert(len(found)).T
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
    # a table of no known instrument: the law of a plate that follows the sky as usual
    if observations.instrument is None:
        return TRACKING
    try:
        return instruments.get(observations.instrument).plate_law(observations)
    except InstrumentError:
        return TRACKING


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
        # the first of a kind keeps the plain name, in whichever dataset it is
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

    def cells(self, chains):
        """
        Return the cells of the table of places, kinds and dependences that the effect is.

        Parameters
        ----------
        chains : sequence
            One a dataset.

        Returns
        -------
        tuple of Cell
            The main one first; those that it is nearest to where it is none. Empty for
            discrete alternatives.
        """
        from astropolcal.gap.effects._cells import filled_in

        return filled_in(self, chains)

    def cell(self, chains):
        """Return the main one of `cells`, None where there is none."""
        return next(iter(self.cells(chains)), None)

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
        return self.anchor if self.anchor in SEVERAL else None

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
            # turned with its optic: an effect of a plate has the axes of that plate
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
        # free values need no basis, one wavelength no law
        if self.degree is None or len(context.wavelength) == 1:
            return None
        return context.basis(self.degree, self.constant)
