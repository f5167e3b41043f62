# Licensed under a 3-clause BSD style license - see LICENSE
"""
What an unmodelled effect is: the declaration of a place, a kind and a dependence on the frame.

At zero parameters the edited chains are the old ones, so that derivatives at zero tell what the
effect would do to the data; fitted, the edited chains are ordinary chains again.
"""

import copy
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import astropy.units as u
import numpy as np
from astropy.modeling import models

from astropolcal import instruments, optics
from astropolcal.chain import Train, insert_optic
from astropolcal.exceptions import GapError, InstrumentError, ParameterError
from astropolcal.gap.cells import BETWEEN_BEAMS, Cell, places
from astropolcal.gap.effects.where import SEVERAL, Roles, Where
from astropolcal.gap.problem import law_basis
from astropolcal.measurement import Tie
from astropolcal.observations.pointings import TRACKING
from astropolcal.optics.laws import law_of
from astropolcal.optics.perturbations import GENERATORS, Dependence, split_run
from astropolcal.units import canonical_factor, to_unit
from astropolcal.words import check_choice, check_type, did_you_mean, is_whole

__all__ = []

#: What an effect may be.
KINDS = ("optic", "parameter", "bound", "detector", "source", "discrete")
# the dependence of what is in one of several runs, each of which is asked for
OWN_RUN = "dataset:own"
# kinds that are several generators; an error of an orientation is a rotation and one back
_SEVERAL = {
    "diattenuation": ("diattenuation_h", "diattenuation_d"),
    "retardance": ("retardance_h", "retardance_d"),
    "orientation": ("rotation",),
}
#: Degree of what is one number for all wavelengths, and no law.
NUMBER = "number"
# more frames than any run has
_LONG = 1e6
# largest change of an optic's Mueller matrix from the identity that is none
_SAME = 1e-9
_SETTINGS = (
    *("name", "title", "where", "dependence", "scale", "limit", "shows", "reference", "words"),
    *("category", "inserted", "free", "equal", "when", "near", "absorbed_by", "flux"),
    *("change", "back"),
)


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
        """Value at which the effect is absent, canonical; scalar or one per wavelength."""
        # an optic that keeps all of the polarization is none
        return float(self.is_retained) if self.neutral is None else _canonical(self.neutral)

    @property
    def is_retained(self):
        """Whether it is a share of polarization that an optic retains, 1 where it does nothing."""
        return self.name.split(".")[1].startswith("retained")


def _canonical(value):
    value = u.Quantity(value)
    return value.value * canonical_factor(value.unit)


@dataclass(frozen=True)
class Edit:
    """
    Chains with an effect in them.

    Parameters
    ----------
    chains : list
        One per dataset.
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
    def neutral(self):
        """Value of every parameter at which the effect is absent, canonical, by name."""
        return {p.name: p.canonical_neutral for p in self.parameters}

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
        Degree of the laws in wavelength, None for one value per wavelength, or
        "default" for that of each effect.
    tracking : tuple of (float, float)
        Law by which the half-wave plate of each dataset follows the sky, see ``tracking_laws``.
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
        names, tracking = tuple(o.name for o in observations), tracking_laws(observations)
        return cls(wavelength, float(np.median(fluxes)), tracking=tracking, datasets=names)

    def basis(self, degree):
        """Return the basis of the law of an effect."""
        return law_basis(self.wavelength, degree if self.degree == "default" else self.degree)


def tracking_laws(observations):
    """Return the law of the half-wave plate of every dataset, as its instrument tells it.

    Factors of parallactic angle and altitude; 0.5 and 1 for tables of no known instrument.
    """
    found = []
    for one in observations:
        law = None
        with suppress(InstrumentError):
            law = one.instrument and instruments.get(one.instrument).plate_law(one)
        found.append(law or TRACKING)
    return tuple(found)


def label_of(name):
    """Return the name of an optic that an effect adds."""
    head, sign, run = name.partition("dataset:")
    # datasets whose names differ in a space only have optics of their own
    run = re.sub(r"\W", lambda m: "_" if m.group() == "-" else f"_{ord(m.group()):x}_", run)
    return "gap_" + re.sub(r"\W", "_", head + sign) + run


class Effect:
    """
    An effect that the model of an instrument may lack, defined by its place, kind and dependence.

    Parameters
    ----------
    name : str
        Identifier.
    title : str
        What it is, for a reader.
    place : str
        ``"after:OPTIC"``, ``"before:OPTIC"``, ``"in:OPTIC"`` (the frame that turns with it),
        ``"source"``, ``"telescope"`` (upstream of the half-wave plate) or ``"detector"``; an optic
        by its name or its role.
    kind : str or tuple of str
        Kind of a `~astropolcal.optics.Perturbation`; ``"diattenuation"`` and ``"retardance"`` are
        of any axis; ``"orientation"`` is an error of the orientation of the optic inside which it
        is.
    dependence : str
        On the frame, such as ``"harmonic:derotator:1"``.
    degree : int, "number" or None
        Degree of the law in wavelength; "number" is one number for all wavelengths, and None one
        for each.
    scale, limit : float or `~astropy.units.Quantity`, or dict of them
        Size to expect, and the largest that is physical; by default those of the kind. Of an optic
        whose parameters have different units, by the name of the parameter.
    shows, reference : str
        Where in the data, and which paper.
    **settings
        Rarer ones, by the names of the attributes below.

    Attributes
    ----------
    kind : str
        One of ``KINDS``, not the kind of the perturbation, which is in ``kinds``.
    place : str
        The place in words; ``where`` is the ``Where``.
    optic : str or None
        Name of the optic that it acts on, where that is not the first of its kind.
    inserted : Optic or callable
        The optic that it inserts, or what makes it of the optic at its place.
    free : tuple of str
        Parameters of that optic that it frees, by default those that are free.
    equal : dict
        Parameters of the inserted optic that follow another one.
    when : callable
        Whether the optics of a chain, by `Roles`, have what else is needed.
    near : tuple
        ``Where``, kinds and dependence of the cell to which it is nearest, if it is none.
    absorbed_by : str or None
        The parameters of a usual nominal model that take the effect up entirely, so that data
        never show it; None where there are none.

    Raises
    ------
    GapError
        If place, kind or dependence is none.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.effects import Effect
    >>> flexure = Effect("flexure", "mirror that bends as the derotator turns",
    ...                  place="after:hwp", kind="diattenuation",
    ...                  dependence="harmonic:derotator:1", limit=0.05)
    >>> flexure.cell([instruments.get("charis").chain()]).title
    'diattenuation along the axes downstream of the half-wave plate that changes once in a turn of the derotator'
    """  # noqa: E501

    name = title = place = where = optic = inserted = near = absorbed_by = scale = limit = None
    kind, kinds, dependence, degree = "optic", (), "constant", 2
    shows, reference = "what a perturbation at its place does", "declared by its user"
    free, equal = None, {}
    #: Flux at which a coefficient counts, in units of the usual flux of a beam.
    flux = None
    #: Whether it is an error of the orientation of its optic: undone behind it.
    around = False

    def __init__(
        self, name=None, title=None, place=None, kind=None, dependence=None, degree=2, **settings
    ):
        given = {"name": name, "title": title, "where": place, "dependence": dependence}
        whole = is_whole(degree) and degree >= 0
        if not (whole or degree is None or degree == NUMBER or callable(degree)):
            raise GapError(
                f"effect {name}: degree = {degree!r}; allowed are whole numbers from 0 up, "
                f"{NUMBER!r} and None"
            )
        # None is a degree, too; a text from a file is equal to it, not the same
        if degree != 2:
            self.degree = NUMBER if degree == NUMBER else degree
        for key, value in (given | settings).items():
            if key not in _SETTINGS:
                raise GapError(f"effect {name}: no setting {key!r}{did_you_mean(key, _SETTINGS)}")
            if value is not None:
                setattr(self, {"category": "kind", "words": "place"}.get(key, key), value)
        if kind is not None:
            wanted = (kind,) if isinstance(kind, str) else tuple(kind)
            self.around = "orientation" in wanted
            self.kinds = tuple(g for one in wanted for g in _SEVERAL.get(one, (one,)))
        if place is not None and not isinstance(place, Where):
            self.where = Where.of(str(place))
            if self.where is None:
                raise GapError(
                    f"effect {name}: place = {place!r}; allowed are 'after:OPTIC', "
                    "'before:OPTIC', 'in:OPTIC', 'source', 'telescope' and 'detector'"
                )
        if self.place is None and self.where is not None:
            self.place = self.where.words
        for what in ("scale", "limit"):
            sizes = getattr(self, what)
            for size in sizes.values() if isinstance(sizes, Mapping) else (sizes,):
                self._check_size(what, size)
        if self.inserted is None:
            self._check_perturbation()

    def _check_size(self, what, size, unit=None):
        """Raise unless a size is positive, in a unit that converts to one, or in any if None."""
        if size is None:
            return
        try:
            unit = getattr(size, "unit", None) if unit is None else unit
            found = to_unit(size, unit, what)
        except ParameterError as error:
            raise GapError(f"effect {self.name}: {error}") from None
        if found.shape or not 0 < found < np.inf:
            raise GapError(f"effect {self.name}: {what} = {size}; a number above zero is needed")

    def _check_perturbation(self):
        known = (*GENERATORS, *_SEVERAL)
        for one in self.kinds:
            if one not in known:
                near = did_you_mean(one, known)
                raise GapError(f"effect {self.name}: kind {one!r}{near}; known: {', '.join(known)}")
        try:
            Dependence(self.dependence)
        except ParameterError as error:
            raise GapError(f"effect {self.name}: {error}") from None

    @classmethod
    def insert(cls, optic, after=None, before=None, inside=None, **settings):
        """
        Return the effect of an optic that a chain lacks; its free parameters are what it adds.

        Parameters
        ----------
        optic : Optic
            Any optic, at parameters at which it does nothing.
        after, before, inside : str
            Name or role of the optic next to which it stands, or with which it turns: its ``theta``
            is then relative to the axis of that.
        **settings
            Others of an `Effect`; by default name and title are those of the optic.

        Returns
        -------
        Effect

        Raises
        ------
        GapError
            If the optic does something, has no free parameter, or not one place is given.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal import optics
        >>> from astropolcal.gap.effects import Effect
        >>> film = optics.Diattenuator(theta=30 * u.deg, name="film")
        >>> Effect.insert(film, before="wollaston", limit=0.1, degree=1)
        <Effect film: Diattenuator upstream of the wollaston>
        """
        check_type("optic", optic, optics.Optic, "a single Optic is needed", GapError)
        given = {"after": after, "before": before, "in": inside}
        told = [Where(key, value) for key, value in given.items() if value is not None]
        name = settings.pop("name", optic.name)
        if len(told) != 1:
            raise GapError(f"effect {name}: give one of after=, before= and inside=")
        title = settings.pop("title", f"{type(optic).__name__} {told[0].words}")
        effect = cls(name, title, told[0], inserted=optic, **settings)
        if not effect.free_of(optic):
            raise GapError(f"effect {name}: no parameter of {type(optic).__name__} is free")
        # one position stands for all: a number for what follows one, else an angle
        matrix = optic.mueller(1.6 * u.um, 0.5 if optic.stage in optics.COORDINATES else None)
        change = np.abs(matrix - np.eye(4)).max()
        if change > _SAME:
            raise GapError(
                f"effect {name}: its optic changes the light by {change:.2g}; at the values given, "
                "from which sizes count, it must do nothing"
            )
        return effect

    # ---- which optics ------------------------------------------------------------------------

    @property
    def label(self):
        """Name of the optic in the chain."""
        return label_of(self.name)

    @property
    def acts_on(self):
        """Role of the optic that it acts on, where there may be several of a kind."""
        where = self.where
        return where.optic if where and where.is_role and where.optic in SEVERAL else None

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
        """Return the effect of one optic of its kind, with the name ``"effect:optic"``."""
        return self.changed(
            optic=optic, name=f"{self.name}:{optic}", title=f"{self.title} ({optic})"
        )

    def per_optic(self, chains):
        """Return the effect once for each optic of its kind, itself for the first."""
        if self.acts_on is None or self.optic is not None:
            return [self]
        every = [found for chain in chains if (found := Roles(chain).all(self.acts_on))]
        names = dict.fromkeys(o.name for found in every for o in found)
        first = {found[0].name for found in every}
        # one with values of its own in a dataset has another name there, on the same stage
        unlike = len({found[0].stage for found in every}) > 1
        if unlike or any(o.name in first for found in every for o in found[1:]):
            # which one is first depends on the dataset: none has the plain name
            return [self.at(name) for name in names]
        # the first of a kind keeps the plain name, in whichever dataset it is
        return [self, *(self.at(name) for name in names if name not in first)]

    def per_run(self, runs):
        """Return itself, or once for each run in which it may differ: of two zeros only one."""
        if self.dependence != OWN_RUN:
            return [self]
        return [
            self.changed(
                name=f"{self.name}/dataset:{run}",
                title=f'{self.title} in "{run}"',
                dependence=f"dataset:{run}",
            )
            for run in (runs[1:] if self.around and len(runs) == 2 else runs)
        ]

    def applies(self, chains):
        """Return whether one of the chains, one per dataset, has the place for this effect."""
        return any(self.applies_to(self.roles(chain)) for chain in chains)

    def check_for(self, chains, observations):
        """Raise GapError if no chain has its place, or no dataset what it depends on."""
        every, where = [self.roles(chain) for chain in chains], self.where
        text, run = split_run(self.dependence)
        (what, on, *_), allowed = (*text.split(":"), ""), {}
        if where is not None and all(where.find(roles, self.optic) is None for roles in every):
            optic = self.optic or where.optic
            there = [r.leaves if optic else places(Train(r.leaves)) for r in every]
            there = [one.name for part in there for one in part]
            allowed["optic of its place" if optic else "place"] = optic or where.relation, there
        if what in ("harmonic", "direction", "move") and on != "own":
            stages = [o.stage for roles in every for o in roles.leaves]
            allowed[f"stage of its dependence {text}"] = on, stages
        if run is not None:
            allowed["dataset of its dependence"] = run, [o.name for o in observations]
        for words, (value, known) in allowed.items():
            known = dict.fromkeys(name for name in known if name)
            check_choice(f"effect {self.name}: {words}", value, known, GapError)
        last = max(o.n_frames for o in observations) - 1
        if what in ("step", "frame") and int(on) > last:
            raise GapError(f"effect {self.name}: dependence = {text!r}; frames are 0 to {last}")

    def applies_to(self, roles):
        """Return whether one chain has the place, and the stage on which the effect depends."""
        place = self.where.find(roles, self.optic)
        if place is None or (self.when is not None and not self.when(roles)):
            return False
        what, stage, *_ = (*split_run(self._dependence(roles))[0].split(":"), "")
        needed = what in ("harmonic", "direction", "move")
        return not needed or any(o.stage == stage for o in roles.leaves)

    #: Function of the `Roles` of a chain that says whether it has what else is needed.
    when = None

    def _dependence(self, roles):
        """Return the dependence, with the name of the stage of the effect's own optic."""
        text = split_run(self.dependence)[0]
        if ":own" not in text:
            return self.dependence
        stage = f":{self.where.anchor(roles).stage}"
        return text.replace(":own", stage) + self.dependence.removeprefix(text)

    # ---- cells -------------------------------------------------------------------------------

    def cells(self, chains):
        """
        Return the cells of the table of places, kinds and dependences that the effect is.

        The main one comes first; where it is none, those that it is nearest to. A discrete
        alternative has none.
        """
        every = [self.roles(chain) for chain in chains]
        # what is in the chains already applies to them no more, and is still what it is
        there = [
            r
            for r in every
            if self.where.optic is None or self.where.anchor(r) is not None or self.where.otherwise
        ]
        # the first that lacks it, else the first
        roles = next((r for r in there if self.applies_to(r)), there[0] if there else None)
        if roles is None or not (self.kinds or self.near):
            return ()
        where, kinds, text, *_ = (*(self.near or (self.where, self.kinds)), None)
        text = self._dependence(roles) if text is None else text
        at = [where.cell_place(roles)]
        if self.around and not self.near:
            at.append(where.in_front_of(roles))
        texts = (text,) if isinstance(text, str) else text
        cells = [Cell(place, one, text) for text in texts for place in at for one in kinds]
        return tuple(dict.fromkeys(cells))

    def cell(self, chains):
        """Return the main one of `cells`, None where there is none."""
        return next(iter(self.cells(chains)), None)

    # ---- the edit ----------------------------------------------------------------------------

    def edit(self, chains, context):
        """Return the `Edit` of chains, which stay as they are, with the effect at zero."""
        edited, ties, keys = [], {}, {}
        name = split_run(self.dependence)[1]
        for i, chain in enumerate(chains):
            roles = self.roles(chain)
            is_in = name is None or context.datasets[i : i + 1] in ((), (name,))
            if is_in and self.applies_to(roles):
                chain, parts, more = self.put(chain, roles, context, self.label)
                ties |= more
                keys |= {
                    f"{part.name}.{key}": getattr(part, key).unit
                    for part in parts
                    for key in self.free_of(part)
                }
            edited.append(chain)
        found = self.parameters(keys, chains, context)
        for one in (one for one in found if one.name in keys):
            for what in ("limit", "scale"):
                self._check_size(what, getattr(one, what), keys[one.name] or u.one)
        return Edit(edited, found, ties)

    def parameters(self, names, chains, context):
        """Return the parameters of these names, perhaps with units, with their sizes and laws."""
        law = None if self.degree is None else self.law(context, chains)
        units = names if isinstance(names, Mapping) else dict.fromkeys(names)
        return [
            EffectParameter(name, *self._sizes(name, unit), law) for name, unit in units.items()
        ]

    def _sizes(self, name="", unit=None):
        """Return size to expect and limit, a tenth of which is expected if none is given."""
        key = name.rpartition(".")[2]
        scale, limit = (
            x.get(key) if isinstance(x, Mapping) else x for x in (self.scale, self.limit)
        )
        if limit is None:
            # those of a usual perturbation, in radian or as a share
            cell, usual = Cell("", self.kinds[0] if self.kinds else "", ""), 1
            if unit is not None and self.inserted is not None:
                if not unit.is_equivalent(u.rad):
                    raise GapError(f"effect {self.name}: give limit={{{key!r}: ...}}, in {unit}")
                usual = u.rad
            scale, limit = cell.scale * usual if scale is None else scale, cell.limit * usual
        sizes = limit / 10 if scale is None else scale, limit
        # perturbations are plain numbers, in radian where they are angles
        is_plain = self.inserted is None and type(self).put is Effect.put
        return tuple(self._plain(size) for size in sizes) if is_plain else sizes

    def _plain(self, size):
        angle = u.Quantity(size).unit.is_equivalent(u.rad)
        self._check_size("size", size, u.rad if angle else u.one)
        return to_unit(size, u.rad if angle else u.one)

    def law(self, context, chains=()):
        """Return the law of its parameters in wavelength, None for a single number."""
        # one wavelength has no law
        if self.degree is NUMBER or self.degree is None or len(context.wavelength) == 1:
            return None
        return self.degree(context) if callable(self.degree) else context.basis(self.degree)

    def is_told(self, n_wavelengths):
        """Return whether so many wavelengths distinguish its law from any other."""
        return n_wavelengths > 1 or not (self.degree is None or callable(self.degree))

    def free_of(self, optic):
        """Return the names of the parameters of its optic that the effect frees."""
        if self.free is not None:
            return self.free
        return tuple(
            k for k in optic.param_names if not getattr(optic, k).fixed and k not in self.equal
        )

    def put(self, chain, roles, context, label):
        """Return a chain with its optics, those with parameters, and their ties."""
        place = self.where.find(roles, self.optic)
        anchor = self.where.anchor(roles)
        if self.inserted is None:
            parts = added = self._perturbations(place, roles, context, label)
            if place.mount is not None and not self.around:
                # between a rotator into the frame of a stage and one back
                back = place.mount[1:] if place.mount.startswith("-") else f"-{place.mount}"
                fixed = {"theta": True}
                into = optics.Rotator(mount=place.mount, name=f"{label}_in", fixed=fixed)
                out_of = optics.Rotator(mount=back, name=f"{label}_out", fixed=fixed)
                added = [into, *parts, out_of]
        else:
            parts = added = [self._own_optic(place, anchor, context, label)]
        ties = {
            f"{part.name}.{key}": Tie(f"{part.name}.{other}")
            for part in parts
            for key, other in self.equal.items()
        }
        # turned with its optic: an effect of a plate has the axes of that plate
        follows = anchor is not None and self.where.follows and not self.around
        if follows and self.inserted is not None and not anchor.theta.fixed and _has_axes(added[0]):
            added[0].theta.bounds = (None, None)
            offset = (added[0].theta.value - anchor.theta.value) * u.deg
            ties[f"{label}.theta"] = Tie(f"{anchor.name}.theta", offset=offset)
        if self.around:
            # equal and opposite: what turns the light in front is turned back behind
            for part in parts:
                back = part.copy()
                back.name = f"{part.name}_back"
                chain = insert_optic(chain, part, before=anchor.name)
                chain = insert_optic(chain, back, after=anchor.name)
                for key in self.free_of(part):
                    ties[f"{back.name}.{key}"] = Tie(f"{part.name}.{key}", factor=-1.0)
            return chain, parts, ties
        for one in added if place.after is None else reversed(added):
            chain = place.insert(chain, one)
        return chain, parts, ties

    def _own_optic(self, place, anchor, context, label):
        """Return the optic that is inserted, at its place and with its parameters free."""
        one = self.inserted
        one = one(anchor) if callable(one) and not isinstance(one, optics.Optic) else one
        free = self.free_of(one)
        grows = self.degree is not NUMBER
        size = len(context.wavelength)
        values = {
            key: np.broadcast_to(parameter.value, size) * (parameter.unit or 1)
            for key in (*free, *self.equal)
            if grows and (parameter := getattr(one, key)).size == 1
        }
        one = one.with_parameters(**values)
        one.name, one.mount = label, one.mount or place.mount
        if self.flux is not None:
            one.reference = self.flux * context.flux
        where = self.where
        inside = where.relation == "in" and _has_axes(one)
        if anchor is not None and (inside or where.turned is not None):
            own = one.theta.value if inside else 0.0
            one.theta = (own + anchor.theta.value + (where.turned or 0.0)) * u.deg
        for key in one.param_names:
            getattr(one, key).fixed = key not in (*free, *self.equal)
        return one

    def _perturbations(self, place, roles, context, label):
        """Return one optic for each generator, at zero."""
        text = self._dependence(roles)
        keys = ("amplitude", "quadrature")[: Dependence(text).count]
        zero = 0.0 if self.degree is NUMBER else np.zeros(len(context.wavelength))
        how = dict.fromkeys(keys, zero) | {"dependence": text, "theta": place.theta * u.rad}
        how["fixed"] = {key: key not in keys for key in optics.Perturbation.param_names}
        names = [label if len(self.kinds) == 1 else f"{label}_{kind}" for kind in self.kinds]
        pairs = zip(self.kinds, names, strict=True)
        return [optics.Perturbation(kind=kind, name=name, **how) for kind, name in pairs]

    def __repr__(self):
        return f"<Effect {self.name}: {self.title}>"


def _has_axes(optic):
    """Return whether an optic turns with its mount, and has axes."""
    return not isinstance(optic, optics.FrameOptic) or optic.turns


#: What only a detector does: the optic, what of it is free, and other settings of an `Effect`.
DETECTOR = {
    # the amount is a share of the usual flux of both beams together
    "background": (optics.StrayLight(mount="total_flux"), "amount", {"flux": 2}),
    "background_of_one_beam": (optics.FluxGain(power=-1, mount="flux"), "right", {"flux": 1}),
    # one detector: the same law for both beams
    "nonlinearity": (
        *(optics.FluxGain(power=1, mount="flux"), "right"),
        {"flux": 1, "equal": {"left": "right"}},
    ),
    **{
        f"nonlinearity_of_{beam}_beam": (optics.FluxGain(power=1, mount="flux"), beam, {"flux": 1})
        for beam in ("right", "left")
    },
    # the gain of a beam grows as the flux before over the flux now
    "persistence": (
        *(optics.FluxGain(power=-1, mount="previous_flux"), "right"),
        {"equal": {"left": "right"}},
    ),
    "crosstalk": (optics.Perturbation(kind="depolarization_linear"), "amplitude", {}),
}
_IN_FRONT = ("background", "crosstalk")


def _with_course(optic, key, text):
    """Return an optic of which a parameter follows a dependence, and what of it is free."""
    what, *parts = text.split(":")
    if what == "time":
        model, free = models.Legendre1D(1, domain=(0, 1)), "c1"
    elif what == "step":
        # from half a frame before on
        middle = int(parts[0]) - 0.5 + _LONG
        model, free = models.Box1D(amplitude=0, x_0=middle, width=2 * _LONG), "amplitude"
    else:
        return optic, (key,)
    optic = optic.copy()
    law, found = law_of(key, getattr(optic, key).unit, model, Dependence(text).driver)
    optic._follow(key, law, found.values())
    return optic, (f"{key}_{free}",)


class CellEffect(Effect):
    """An effect that is one cell: a perturbation of some kind at some place."""

    kind = "cell"
    shows, reference = "what the cell does to the data", "a perturbation of no name"

    def __init__(self, cell, degree=2):
        place, dependence, settings = cell.place, cell.dependence, {"words": cell.place}
        if cell.kind in DETECTOR:
            optic, free, more = DETECTOR[cell.kind]
            sizes = {"scale": cell.scale, "limit": cell.limit}
            optic, free = _with_course(optic, free, split_run(dependence)[0])
            settings |= {"inserted": optic, "free": free} | sizes | more
            dependence = "constant" if cell.run is None else f"dataset:{cell.run}"
            if cell.kind in _IN_FRONT:
                place = Where("before", "splitter", True, otherwise=Where("detector"))
        kind = "gain" if cell.kind == "brightness" else cell.kind
        if kind.endswith(BETWEEN_BEAMS):
            kind = kind.removesuffix(BETWEEN_BEAMS)
            dependence = "beam" if cell.run is None else f"beam/dataset:{cell.run}"
        super().__init__(cell.name, cell.title, place, kind, dependence, degree, **settings)
        self._cell = cell

    def cells(self, chains):
        """Return the cell."""
        return (self._cell,)
