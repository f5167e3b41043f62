# Licensed under a 3-clause BSD style license - see LICENSE
"""
Chains of optics: the compound model, its optics, and its system Mueller matrix.

A chain is what astropy's ``|`` makes of optics, written in the order the
light travels. Nothing here depends on which optics they are.
"""

from functools import reduce
from itertools import accumulate
from operator import or_

import astropy.units as u
import numpy as np
from astropy.modeling import CompoundModel

from astropolcal.exceptions import ChainError, ObservationError, ParameterError, warn
from astropolcal.mueller import phase_of, turned
from astropolcal.optics import COORDINATES, Optic, Perturbation
from astropolcal.optics.laws import law_of
from astropolcal.optics.positions import FLUXES, PLACES, finite_position
from astropolcal.words import did_you_mean

__all__ = [
    "at_positions",
    "follow",
    "insert_optic",
    "join",
    "leaves",
    "remove_optic",
    "replace_optic",
    "stages",
    "system_mueller",
    "with_beam",
]


def leaves(chain):
    """
    Return the optics of a chain in the order the light travels.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        One optic, or optics joined with ``|``.

    Returns
    -------
    list of Optic
        The optics themselves, not copies.

    Raises
    ------
    ChainError
        If something in the chain is not an optic or is joined by another
        operator, or if two optics share a name.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.chain import leaves
    >>> chain = optics.LinearPolarizer(name="polarizer") | optics.WollastonPrism(name="wollaston")
    >>> [optic.name for optic in leaves(chain)]
    ['polarizer', 'wollaston']
    """
    found = list(chain) if isinstance(chain, Train) else list(_walk(chain))
    names = [optic.name for optic in found if optic.name]
    twice = sorted({name for name in names if names.count(name) > 1})
    if twice:
        raise ChainError(f"optics need different names; {', '.join(twice)} occurs more than once")
    return found


class Train(tuple):
    """Optics in the order of the light that are not joined yet.

    What is tried by the hundred need not be a compound model each time: its making costs as the
    square of the number of optics.
    """

    __slots__ = ()

    def copy(self):
        """Return a train of copies of the optics."""
        return Train(optic.copy() for optic in self)

    def __getitem__(self, key):
        if isinstance(key, str):
            return find_optic(self, key)
        return super().__getitem__(key)


def _again(chain, found):
    """Return optics as what the chain was: a train, or a compound model."""
    return Train(found) if isinstance(chain, Train) else join(found)


def _walk(model):
    if isinstance(model, CompoundModel):
        if model.op != "|":
            raise ChainError(f"optics are joined with |, not with {model.op}")
        yield from _walk(model.left)
        yield from _walk(model.right)
    elif isinstance(model, Optic):
        yield model
    else:
        raise ChainError(
            f"{type(model).__name__} is not an optic; a chain is made of "
            "astropolcal.optics joined with |"
        )


def join(optics):
    """
    Join optics to a chain.

    Parameters
    ----------
    optics : sequence of Optic
        At least one, in the order the light travels.

    Returns
    -------
    Optic or `~astropy.modeling.CompoundModel`

    Raises
    ------
    ChainError
        If there is no optic, something else than an optic, or two optics share a name.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.chain import join
    >>> join([optics.LinearPolarizer(), optics.WollastonPrism()]).n_submodels
    2
    """
    optics = list(optics)
    if not optics:
        raise ChainError("a chain needs at least one optic")
    for optic in optics:
        leaves(optic)
    leaves(Train(optics))
    return reduce(or_, optics)


def find_optic(chain, name):
    """Return the optic of that name, or raise a ChainError that lists near matches."""
    found = leaves(chain)
    for optic in found:
        if optic.name == name:
            return optic
    names = [optic.name for optic in found if optic.name]
    hint = did_you_mean(name, names)
    known = ", ".join(names) or "no optic with a name"
    raise ChainError(f"no optic {name!r} in the chain; it has {known}{hint}")


def replace_optic(chain, name, optic):
    """
    Return a chain with the named optic replaced; the rest is shared.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain.
    name : str
        Name of the optic that goes.
    optic : Optic
        The optic that takes its place.

    Returns
    -------
    Optic or `~astropy.modeling.CompoundModel`

    Raises
    ------
    ChainError
        If there is no such optic.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.chain import replace_optic
    >>> chain = optics.ParityFlip(name="nbs") | optics.WollastonPrism(name="wollaston")
    >>> replace_optic(chain, "nbs", optics.Depolarizer(name="relay"))[0].name
    'relay'
    """
    old = find_optic(chain, name)
    return _again(chain, [optic if leaf is old else leaf for leaf in leaves(chain)])


def parted(optics, start):
    """Return what stands upstream of an optic, and the optic with what belongs to it and the rest.

    To it belong optics that turn with it, as an error of its retardance, and those that have a
    counterpart ``NAME_back`` downstream, as an error of its angle. A perturbation that follows its
    stage may be one of the source.
    """
    own, behind = optics[start].stage, optics[start:]
    backs = {optic.name for optic in behind}

    def belongs(optic):
        turns = own is not None and optic.stage == own and not isinstance(optic, Perturbation)
        return turns or f"{optic.name}_back" in backs

    front = optics[:start]
    return [o for o in front if not belongs(o)], [*filter(belongs, front), *behind]


def insert_optic(chain, optic, *, after=None, before=None):
    """
    Return a chain with one more optic.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain.
    optic : Optic
        The new optic.
    after, before : str
        Name of the neighbour; exactly one of the two.

    Returns
    -------
    `~astropy.modeling.CompoundModel`

    Raises
    ------
    ChainError
        If the neighbour is missing or not exactly one is named.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.chain import insert_optic, leaves
    >>> chain = insert_optic(optics.WollastonPrism(name="wollaston"),
    ...                      optics.ParityFlip(name="nbs"), before="wollaston")
    >>> [leaf.name for leaf in leaves(chain)]
    ['nbs', 'wollaston']
    """
    if (after is None) == (before is None):
        raise ChainError("name exactly one neighbour: after=... or before=...")
    found, neighbour = leaves(chain), find_optic(chain, after or before)
    found.insert(found.index(neighbour) + bool(after), optic)
    return _again(chain, found)


def remove_optic(chain, name):
    """
    Return a chain without the named optic.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain.
    name : str
        Name of the optic that goes.

    Returns
    -------
    Optic or `~astropy.modeling.CompoundModel`

    Raises
    ------
    ChainError
        If there is no such optic, or nothing would be left.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.chain import remove_optic
    >>> chain = optics.ParityFlip(name="nbs") | optics.WollastonPrism(name="wollaston")
    >>> remove_optic(chain, "nbs").name
    'wollaston'
    """
    gone = find_optic(chain, name)
    return _again(chain, [leaf for leaf in leaves(chain) if leaf is not gone])


def follow(chain, name, model, of, *, since=None):
    """
    Return a chain in which a parameter follows a model of astropy.

    What the model gives is added to the parameter, in each frame. Its coefficients become
    parameters of the optic: ``c1`` of a law of ``theta`` is ``theta_c1``. The one that does the
    same everywhere is held, as the parameter itself is that constant. Of a law of wavelength it is
    the value at zero: an angle that was bounded to a whole turn or more has no bounds there.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain; it is not changed.
    name : str
        The parameter, ``"optic.parameter"``.
    model : `~astropy.modeling.Model`
        Fittable, of one output, with bounds and fixed flags. Values without units are in the unit
        of the parameter, and per day, arcsec, micrometre or degree of the inputs.
    of : str or sequence of str
        Its inputs: ``"time"`` (days), ``"x"``, ``"y"`` (arcsec in the field), ``"wavelength"``
        (micrometre), a stage (degree), or one of `~astropolcal.optics.COORDINATES`.
    since : str, `~astropy.time.Time` or float, optional
        When time is zero (UTC); a law of time needs it.

    Returns
    -------
    Optic or `~astropy.modeling.CompoundModel`
        The law with its present coefficients is ``chain[optic].parameter.law``.

    Raises
    ------
    ChainError, ParameterError
        If there is no such parameter, or the model does not fit.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropy.modeling import models
    >>> from astropolcal import optics
    >>> from astropolcal.chain import at_positions, follow
    >>> plate = optics.LinearRetarder(retardance=170 * u.deg, name="plate")
    >>> chain = follow(plate, "plate.retardance", models.Polynomial1D(1, c1=0.1), "time",
    ...                since="2026-01-01")
    >>> chain.retardance_c1.quantity
    <Quantity 0.1 deg / d>
    >>> later = at_positions(chain, time="2026-04-11")
    >>> later.mueller()[2, 2].round(6)
    np.float64(-1.0)
    """
    optic, _, key = name.rpartition(".")
    old = find_optic(chain, optic)
    if key not in type(old).param_names:
        known = ", ".join(type(old).param_names)
        raise ParameterError(f"no parameter {key!r} of {optic!r}; it has {known}")
    new = old.copy()
    law, found = law_of(name, old._declared(key).unit, model, of, since)
    new._follow(key, law, found.values())
    constant = getattr(new, key)
    unit, bounds = constant.unit, constant.bounds
    is_angle = unit is not None and unit.is_equivalent(u.deg) and None not in bounds
    # bounds a whole turn apart leave no value out; turns may be counted from any data, not from the
    # wavelength zero
    if "wavelength" in law.of and is_angle and np.diff(bounds)[0] * unit > 359.9 * u.deg:
        constant.bounds = None, None
    return replace_optic(chain, optic, new)


def stages(chain):
    """
    Return the names of the stages whose positions the chain needs.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain.

    Returns
    -------
    tuple of str
        Each name once, without sign, in the order the light meets them; inputs of laws that
        parameters follow are among them.

    Examples
    --------
    >>> from astropolcal import optics
    >>> from astropolcal.chain import stages
    >>> stages(optics.LinearRetarder(mount="hwp") | optics.Rotator(mount="-altitude"))
    ('hwp', 'altitude')
    """
    found = {}
    for leaf in leaves(chain):
        found |= {leaf.stage: None} if leaf.stage else {}
        found |= dict.fromkeys(name for law in leaf._follows.values() for name in law.of)
    return tuple(name for name in found if name != "wavelength")


def standing(chain):
    """Return where each number of a frame stands in a view of a chain: zero, or as calibrated."""
    found = {stage: 0.0 * u.one for stage in stages(chain) if stage in COORDINATES}
    for law in (law for leaf in leaves(chain) for law in leaf._follows.values()):
        found |= {name: law.middle(name) * PLACES[name] for name in law.of if name in PLACES}
    return found


def warn_beyond(chain, positions):
    """Warn of laws that are asked for beyond the frames that they were calibrated with."""
    for leaf in leaves(chain):
        for key, law in leaf._follows.items():
            words = law.beyond(positions)
            if words:
                warn(f"the law of {leaf.name}.{key} is extrapolated: {words}", stacklevel=3)


def states_of(chain):
    """Return the states that a chain knows, lists by the column of the table, ``"beam"`` too."""
    known = {}
    for column, equals, state in (stage.partition("=") for stage in stages(chain)):
        if equals:
            known.setdefault(column, []).append(state)
    return known


def check_states(chain, columns, label, least=2):
    """Refuse columns, by name, with a state that no optic of the chain knows.

    Of devices with ``least`` known states: one that is known in one state only may be off.
    """
    for column, states in states_of(chain).items():
        # a column that is missing is named where positions are read
        found = {str(state).strip() for state in np.atleast_1d(columns.get(column, []))}
        if len(states) >= least and (strange := sorted(found - set(states))):
            words = f"{column} = {', '.join(strange)} in the table; the chain knows "
            raise ObservationError(f"{label}: {words}{', '.join(states)}")


def with_beam(chain, beam):
    """
    Return a copy of the chain that follows one beam of its beam splitter.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain.
    beam : {"right", "left"}
        The beam.

    Returns
    -------
    Optic or `~astropy.modeling.CompoundModel`

    Raises
    ------
    ChainError
        If the chain has no beam splitter.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import optics
    >>> from astropolcal.chain import with_beam
    >>> left = with_beam(optics.LinearPolarizer() | optics.WollastonPrism(), "left")
    >>> float(left(1.6 * u.um, 1, 0, 0, 0)[1])
    0.0
    """
    copy = chain.copy()
    found = leaves(copy)
    if not any(leaf.splits_light for leaf in found):
        raise ChainError("the chain has no beam splitter, so it has no beams")
    for leaf in found:
        if hasattr(leaf, "beam"):
            leaf.beam = beam
    return copy


def at_positions(chain, **positions):
    """
    Return a copy of the chain whose stages stand at the given positions.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain.
    **positions : `~astropy.units.Quantity` or array_like
        Position of each stage by name, an angle, or a number for those of
        `~astropolcal.optics.COORDINATES`; for many frames and wavelengths in one
        call, of shape (n_frames, 1), and (n_frames, n_wavelengths) for fluxes.

    Returns
    -------
    Optic or `~astropy.modeling.CompoundModel`
        Ready to be called with light.

    Raises
    ------
    ChainError
        If the chain has no such stage.
    ParameterError
        If a position is not finite, not an angle, or not a number where one is due.

    Warns
    -----
    AstropolcalWarning
        If a law is asked beyond the frames that it was calibrated with.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import optics
    >>> from astropolcal.chain import at_positions
    >>> hwp = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp")
    >>> _, I, Q, U, V = at_positions(hwp, hwp=22.5 * u.deg)(1.6 * u.um, 1, 1, 0, 0)
    >>> round(float(U), 6)
    1.0
    """
    copy = chain.copy()
    known = stages(copy)
    for name in positions:
        if name not in known:
            raise ChainError(f"no stage {name!r} in the chain; it has {', '.join(known) or 'none'}")
    for leaf in leaves(copy):
        if leaf.stage in positions:
            leaf.position = positions[leaf.stage]
        inputs = {name for law in leaf._follows.values() for name in law.of} & set(positions)
        places = {name: finite_position(positions[name], name) for name in inputs}
        leaf._places = leaf._places | places
        warn_beyond(Train([leaf]), places)
    return copy


def _oriented_leaves(chain, wavelength, positions):
    """Yield each leaf with what its matrix needs: dispersion, angle, values."""
    for leaf in leaves(chain):
        check_inputs(leaf, positions)
        dispersion, angle, values = leaf._resolve(wavelength, None, places=positions)
        shift = leaf.stage_sign * positions[leaf.stage] if leaf.stage else 0.0
        yield leaf, *leaf._moved(dispersion, angle, shift), values


def check_inputs(leaf, positions):
    """Refuse positions without the stage of an optic or what its laws depend on."""
    needed = [
        (name, f"{leaf._label}.{key} follows a law of {name!r}")
        for key, law in leaf._follows.items()
        for name in law.of
    ]
    if leaf.stage:
        needed.append((leaf.stage, f"optic {leaf._label} stands on stage {leaf.stage!r}"))
    for name, words in needed:
        if name not in positions and name != "wavelength":
            raise ChainError(f"{words}, but positions has only {sorted(positions)}")


def system_mueller(chain, wavelength=None, positions=None):
    """
    Return the Mueller matrix of the whole chain.

    Parameters
    ----------
    chain : Optic or `~astropy.modeling.CompoundModel`
        The chain; of a beam splitter, its ``beam`` (see `with_beam`).
    wavelength : `~astropy.units.Quantity`, optional
        Scalar or shape (n_wavelengths,).
    positions : dict of str to `~astropy.units.Quantity` or array_like, optional
        Position of every stage, scalar or shape (n_frames,): an angle, or a
        number for those of `~astropolcal.optics.COORDINATES`. A flux is that
        of the beam and may have shape (n_frames, n_wavelengths).

    Returns
    -------
    `~numpy.ndarray`
        Shape (n_frames, n_wavelengths, 4, 4); an axis is missing where all
        positions or the wavelength are scalar.

    Raises
    ------
    ChainError
        If the position of a stage is missing, two stages have different numbers
        of positions, or a flux has another number of wavelengths.
    ParameterError, WavelengthRangeError
        If a wavelength is missing, out of range, or does not match the
        parameters given per wavelength, or a position has the wrong unit.

    Warns
    -----
    AstropolcalWarning
        As `at_positions`.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import optics
    >>> from astropolcal.chain import system_mueller
    >>> chain = optics.TwoLayerWaveplate(mount="hwp", name="hwp") | optics.WollastonPrism()
    >>> system_mueller(chain, [1.2, 1.6] * u.um, {"hwp": [0, 22.5, 45] * u.deg}).shape
    (3, 2, 4, 4)
    """
    positions, shape = _check_axes(wavelength, positions)
    warn_beyond(chain, positions)
    # rows from the detector back, with one turn from optic to optic: what turns them is a phase
    total, frame = np.eye(4), 0.0
    nodes = list(_oriented_leaves(chain, wavelength, positions))
    for leaf, dispersion, angle, values in nodes[::-1]:
        if leaf.rotates_frame:
            frame = frame + angle
        else:
            total = _turned(total, angle - frame) @ leaf._matrix(dispersion, *values)
            frame = angle
    total, whole = _turned(total, -frame), (*shape, 4, 4)
    return total if total.shape == whole else np.broadcast_to(total, whole).copy()


def _turned(rows, angle):
    """Return rows times T(-angle), in place where they have room."""
    return turned(rows, phase_of(np.asarray(angle)[..., None]), in_place=True)


def _check_axes(wavelength, positions):
    """Return the positions with an axis for wavelengths, and the shape of both together."""
    if np.ndim(wavelength) > 1 or not np.size(wavelength):
        raise ParameterError(
            f"wavelength has shape {np.shape(wavelength)}; allowed are a scalar or one axis"
        )
    grid = () if wavelength is None else np.shape(wavelength)
    placed, shapes = {}, {}
    for name, value in (positions or {}).items():
        position = finite_position(value, name)
        one_each = position.ndim > 1
        if one_each and not (name in FLUXES and position.shape[1:] == grid):
            several = f" or (n_frames, {grid[0]})" if grid and name in FLUXES else ""
            raise ChainError(
                f"{name} has shape {position.shape}; allowed are a scalar, (n_frames,){several}"
            )
        shapes[name] = position.shape[:1] if one_each else position.shape
        placed[name] = position[..., None] if grid and not one_each else position
    try:
        frames = np.broadcast_shapes(*shapes.values())
    except ValueError:
        raise ChainError(f"the positions have different shapes: {shapes}") from None
    return placed, frames + grid


def system_mueller_derivatives(chain, wavelength=None, positions=None):
    """Return the derivatives of `system_mueller` to parameters, by ``"optic.parameter"``.

    Quantities of shape (n_frames, n_wavelengths, 4, 4) per unit of the parameter.
    """
    positions, shape = _check_axes(wavelength, positions)
    nodes = list(_oriented_leaves(chain, wavelength, positions))
    matrices = [leaf._oriented(*rest) for leaf, *rest in nodes]
    before = list(accumulate(matrices[:-1], lambda product, m: m @ product, initial=np.eye(4)))
    after = np.eye(4)
    result = {}
    for (leaf, *rest), matrix, upstream in zip(
        nodes[::-1], matrices[::-1], before[::-1], strict=True
    ):
        if not leaf.name:
            raise ChainError(f"{type(leaf).__name__} needs a name before its parameters have one")
        rates = leaf._rates_at(wavelength, positions)
        slopes = leaf._oriented_derivatives(matrix, *rest, rates)
        for key, slope in zip(leaf.param_names, slopes, strict=True):
            value = np.broadcast_to(after @ slope @ upstream, (*shape, 4, 4)).copy()
            result[f"{leaf.name}.{key}"] = leaf._per_unit(key, value)
        after = after @ matrix
    return result
