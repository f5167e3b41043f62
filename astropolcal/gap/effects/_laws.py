# Licensed under a 3-clause BSD style license - see LICENSE
"""Effects that are laws of physics, or exchange optics, and no perturbations at a place."""

import astropy.units as u
import numpy as np
from scipy.linalg import helmert

from astropolcal import optics
from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.chain import insert_optic, leaves, remove_optic, replace_optic
from astropolcal.gap.effects.effect import NUMBER, Edit, Effect, EffectParameter
from astropolcal.gap.effects.where import Where, is_held
from astropolcal.measurement import Tie
from astropolcal.measurement.parameters import bind_prior
from astropolcal.observations.pointings import TRACKING
from astropolcal.optics.positions import counted
from astropolcal.units import to_unit

#: Lag of an angle in frames, written as an angle over that of one frame: 0.25, at most 2.
LAG = {"scale": 0.25 * u.rad, "limit": 2 * u.rad}
# a retardance that changes by less than this (radian) from bin to bin is flat
_FLAT = 1e-3
# nearer to a bound than this share of the limit is at the bound
_NEAR = 1e-4


def lagging(mount):
    """Return a rotator by the change of an angle, times a lag in frames (1 rad is one frame)."""
    turn = optics.DriftRotator(mount=f"{mount}_rate")
    turn.rate.bounds = (-360, 360)
    return turn


# ---- what else effects need --------------------------------------------------------------------


def mirror_leaves(key, polarized=False):
    """
    Return whether no parameter of the telescope's mirror is free, its angle and a key aside.

    Of light that may be polarized, where that is needed.
    """

    def when(roles):
        mirror = roles.telescope_mirror
        if polarized and not may_be_polarized(roles):
            return False
        # nothing is free in what is not there; what is free takes the effect up
        names = () if mirror is None else set(mirror.param_names) - {"theta", key}
        return all(is_held(getattr(mirror, name)) for name in names)

    return when


def may_be_polarized(roles):
    """Return whether the star is not held at zero polarization."""
    star = roles.star
    if isinstance(star, optics.StarSource):
        # nothing interstellar: unpolarized as far as the catalogue knows
        return not (star.p_max.fixed and not np.any(star.p_max.value))
    return star is None or not all(is_held(p) and not np.any(p.value) for p in (star.q, star.u))


# ---- laws in wavelength ------------------------------------------------------------------------


def every_wavelength(context):
    """Return one value per wavelength, for any degree that the context asks for."""
    return np.eye(len(context.wavelength))


def without_constant(context):
    """Return a law of degree 2 less its constant, which is an orientation."""
    basis = context.basis(2)
    # values per wavelength, less their mean; singular vectors would be any basis of these
    return helmert(len(basis)).T if context.degree is None else basis[:, 1:]


class WavelengthScale(Effect):
    """Retarder whose law is the derivative of the plate's retardance to wavelength."""

    def law(self, context, chains=()):
        """Return the slope of the plate's retardance, times a line."""
        plate = next(p for c in chains if has_law(p := self.where.anchor(self.roles(c))))
        # relative: small against the course of the indices, large against rounding
        step = 1e-4
        up, down = (
            plate.retardance(context.wavelength * (1 + s) * u.um).to_value(u.rad)
            for s in (step, -step)
        )
        # d retardance / d wavelength; a shift and a stretch are this times a line
        slope = (up - down) / (2 * step * context.wavelength)
        return slope[:, None] * context.basis(1) / np.abs(slope).max()


def has_law(plate):
    """Return whether the retardance of a plate is a law in wavelength."""
    return isinstance(plate, optics.TwoLayerWaveplate)


class OfLaw(Effect):
    """An effect that its law in wavelength alone tells from others of its place and kind."""

    def is_told(self, n_wavelengths):
        """Return whether the law can be distinguished from other laws."""
        return n_wavelengths > 4


class Fringes(OfLaw):
    """Etalon: retardance that oscillates with the wavenumber.

    The difference of path between the two reflections, in micrometre, decides on the period, and
    no derivative at zero tells it: `of` gives one effect for each.
    The phase of a fringe that drifts linearly turns a cosine in the wavenumber into a sine: to
    first order both have amplitudes that change linearly with time.
    """

    stem, thickness = None, 8.0

    def of(self, thickness):
        """Return the same for another difference of path, twice the optical thickness."""
        stem = self.stem or self.name
        title = self.title.partition(",")[0]
        return self.changed(
            stem=stem,
            thickness=float(thickness),
            name=stem if thickness == 8 else f"{stem}_{thickness:.3g}_um",
            title=f"{title}, period 1/({thickness:.3g} um)",
        )

    def law(self, context, chains=()):
        """Return a sine and a cosine in the wavenumber."""
        if not self.is_told(len(context.wavelength)):
            return None
        # two reflections interfere with the phase of their difference of path
        phase = 2 * np.pi * self.thickness / context.wavelength
        return np.stack([np.cos(phase), np.sin(phase)], axis=1)


# ---- optics that are exchanged -----------------------------------------------------------------


class Elliptical(Effect):
    """A derotator that is an elliptical retarder: exchanged in place, as two do not commute."""

    def applies_to(self, roles):
        """Return whether the derotator lacks this component."""
        derotator = self.where.anchor(roles)
        if isinstance(derotator, optics.EllipticalRetarder):
            return all(getattr(derotator, key).fixed for key in self.free)
        return derotator is not None and not any(o.name == self.label for o in roles.leaves)

    def put(self, chain, roles, context, label):
        """Return the chain with an elliptical derotator; see `Effect.put`."""
        old, is_new, ties = self.where.anchor(roles), False, {}
        # a component that the old one lacks is zero in it
        known = old if isinstance(old, optics.EllipticalRetarder) else optics.EllipticalRetarder()
        size = len(context.wavelength)
        values = {k: np.broadcast_to(getattr(known, k).value, size) * u.deg for k in self.free}
        if known is old:
            new = old.with_parameters(**values)
        else:
            # what is more than a retarder stays, and the new one turns with it
            is_new = not isinstance(old, optics.LinearRetarder)
            new = optics.EllipticalRetarder(
                theta=old.theta.value * u.deg,
                horizontal=(0.0 if is_new else old.retardance.value) * u.deg,
                mount=old.mount,
                name=label if is_new else old.name,
                **values,
            )
            for key in new.param_names:
                getattr(new, key).fixed = True
            # what was free stays free, so that the nominal parameters keep their meaning
            pairs = () if is_new else (("theta", "theta"), ("horizontal", "retardance"))
            for ours, theirs in pairs:
                was, now = getattr(old, theirs), getattr(new, ours)
                now.fixed, now.bounds = was.fixed, was.bounds
        for key in self.free:
            getattr(new, key).fixed = False
        if not is_new:
            return replace_optic(chain, old.name, new), [new], ties
        new.theta.bounds = (None, None)
        if not old.theta.fixed:
            ties[f"{label}.theta"] = Tie(f"{old.name}.theta")
        return insert_optic(chain, new, after=old.name), [new], ties


class BandAverage(Effect):
    r"""
    Retarder whose retardance changes within a wavelength bin.

    Averaged over a bin in which it changes by s, a retarder keeps the polarization along its axis
    and loses the share :math:`1 - \mathrm{sinc}(s/2) \approx s^2/24` of what is at 45 deg to it,
    or circular: a depolarizer with its axes and a law in wavelength that is tied to the square of
    its slope. The constant of the law is a loss at all wavelengths.
    """

    def retarder(self, roles):
        """Return the derotator, or the steepest retarder downstream of it that is static."""
        if self.where.relation == "in" or roles.derotator is None:
            return roles.derotator
        behind = roles.leaves[roles.leaves.index(roles.derotator) + 1 :]
        static = [leaf for leaf in behind if leaf.stage is None]
        found = [leaf for leaf in static if retardance_slopes(leaf) is not None]
        # the steepest one is where the average over a bin matters most
        return max(found, key=lambda o: np.abs(retardance_slopes(o)).max(), default=None)

    def applies_to(self, roles):
        """Return whether there is a retarder whose retardance depends on the wavelength."""
        present = any(leaf.name == self.label for leaf in roles.leaves)
        return not present and retardance_slopes(self.retarder(roles)) is not None

    def put(self, chain, roles, context, label):
        """Return the chain with a depolarizer along the axis of the retarder."""
        retarder = self.retarder(roles)
        slopes, axis = retardance_slopes(retarder), _steep_axis(retarder)
        theta = retarder.theta.value * u.deg + np.arctan2(axis[1], axis[0]) / 2 * u.rad
        how = {"theta": theta, "mount": retarder.mount, "name": label}
        keep = np.ones(len(slopes))
        optic = optics.Depolarizer(retained_u=keep, retained_v=keep, **how)
        # along the axis nothing is lost
        optic.retained_q.fixed, optic.theta.bounds = True, (None, None)
        tie = {f"{label}.retained_v": Tie(f"{label}.retained_u")}
        return insert_optic(chain, optic, after=retarder.name), [optic], tie

    def law(self, context, chains=()):
        """Return a constant, and the square of the slope of the last of the retarders."""
        found = [self.roles(chain) for chain in chains]
        retarder = [self.retarder(roles) for roles in found if self.applies_to(roles)][-1]
        square = (retardance_slopes(retarder) @ _steep_axis(retarder)) ** 2
        return np.column_stack([np.ones(len(square)), square / square.max()])


def _steep_axis(retarder):
    """Return the direction in the (H, 45) plane along which the linear retardance moves."""
    axis = np.linalg.svd(retardance_slopes(retarder), full_matrices=False)[2][0]
    # a singular vector has any sign, and with it the optic would be turned by 90 deg
    return axis * np.sign(axis[ranked(np.abs(axis))[0]])


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


class OfSky(Effect):
    """An error of the parallactic angle, from which that of a plate that follows the sky came."""

    def edit(self, chains, context):
        """Return the chains with sky and plate turned; see `Effect.edit`."""
        edit, turned = super().edit(chains, context), []
        # before the sky is known, the plate may follow it as most do
        laws = context.tracking or (TRACKING,) * len(chains)
        for i, (chain, (rate, _)) in enumerate(zip(edit.chains, laws, strict=True)):
            roles = self.roles(chain)
            sky = next((one for one in roles.leaves if one.name == self.label), None)
            if sky is not None and roles.plate is not None and rate:
                rate *= roles.parallactic.stage_sign
                for side, sign in {"before": rate, "after": -rate}.items():
                    one = sky.copy()
                    one.name = f"{self.label}_{side}_{i}"
                    chain = insert_optic(chain, one, **{side: roles.plate.name})
                    for key in self.free_of(one):
                        edit.ties[f"{one.name}.{key}"] = Tie(f"{sky.name}.{key}", factor=sign)
            turned.append(chain)
        return Edit(turned, edit.parameters, edit.ties)


class Recoating(Effect):
    """
    A mirror that changes from one dataset to the next, as when it is recoated or washed.

    The datasets of stars are taken in the order in which they are given; the first one is the
    reference, and each of the others has a change of its own.
    """

    def applies(self, chains):
        """Return whether there are two datasets of stars; see `Effect.applies`."""
        # the first night is the reference: a change needs two
        return sum(self.applies_to(self.roles(chain)) for chain in chains) > 1

    def edit(self, chains, context):
        """Return the chains with a diattenuator in all but the first; see `Effect.edit`."""
        edited, names = list(chains), []
        stars = [i for i, chain in enumerate(chains) if self.applies_to(self.roles(chain))]
        # the first dataset keeps the nominal mirror
        for number, i in enumerate(stars[1:], 1):
            label = f"{self.label}_{number}"
            edited[i], _, _ = self.put(chains[i], self.roles(chains[i]), context, label)
            names += [f"{label}.{key}" for key in self.free]
        return Edit(edited, self.parameters(names, chains, context))


# ---- parameters that the model holds, or that have run into a bound ------------------------------


class Held(Effect):
    """Parameters of one optic that become free, within their bounds or wider ones."""

    degree = NUMBER
    #: Whether the bounds of the optic itself hold.
    is_bounded = True

    def is_open(self, parameter):
        """Return whether the effect may act on a parameter: one that is fixed, or at a bound."""
        if self.kind != "bound":
            return is_held(parameter)
        # a bounded fit may end a little before its bound
        value, near = np.asarray(parameter.value), _NEAR * _in_unit(self.limit, parameter)
        low, high = parameter.bounds
        at_low = low is not None and np.any(value <= low + near)
        return bool(at_low or (high is not None and np.any(value >= high - near)))

    def held(self, roles):
        """Return the optic, and the names of its parameters on which the effect may act."""
        optic = self.where.anchor(roles)
        own = () if optic is None else (key for key in self.free if key in optic.param_names)
        return optic, [key for key in own if self.is_open(getattr(optic, key))]

    def applies_to(self, roles):
        """Return whether one of the parameters is held."""
        return bool(self.held(roles)[1])

    def edit(self, chains, context):
        """Return the chains with the parameters free; see `Effect.edit`."""
        edited, added = list(chains), {}
        held = [self.held(self.roles(chain)) for chain in chains]
        for name, keys in {optic.name: keys for optic, keys in held if keys}.items():
            for i, chain in enumerate(edited):
                # free in every dataset that has the optic, whatever it is for there
                if any(optic.name == name for optic in leaves(chain)):
                    fresh, found = self.released(chain[name], keys, context)
                    # a dict, for the same parameter in two datasets is one
                    added |= {one.name: one for one in found}
                    edited[i] = replace_optic(chain, name, fresh)
        return Edit(edited, list(added.values()))

    def released(self, optic, keys, context):
        """Return a copy of an optic with parameters free, and what the effect says of these."""
        fresh, found, law = self.copied(optic, keys, context), [], self.law(context)
        for key in keys:
            parameter = getattr(fresh, key)
            # where it was held is where the effect is absent
            known, name = parameter.prior, f"{optic.name}.{key}"
            value = parameter.value
            if known is not None:
                value = bind_prior(known, name, parameter.unit, parameter.bounds).mode
            value = u.Quantity(value, parameter.unit or u.one)
            possible = getattr(type(optic), key).bounds if self.is_bounded else (None, None)
            parameter.bounds = around(parameter, self.limit, possible)
            parameter.fixed, parameter.prior = False, None
            found.append(EffectParameter(name, self.scale, self.limit, law, value))
        return fresh, found

    def copied(self, optic, keys, context):
        """Return a copy of an optic, of which parameters will be free."""
        return optic.copy()


def _in_unit(quantity, parameter):
    return to_unit(quantity, parameter.unit, f"limit of {parameter.name}")


def around(parameter, limit, possible):
    """
    Return bounds that leave room on both sides of the value, and are no tighter than before.

    The room ends where the optic itself has its bounds.
    """
    room, (low, high) = _in_unit(limit, parameter), parameter.bounds
    least = -np.inf if possible[0] is None else possible[0]
    most = np.inf if possible[1] is None else possible[1]
    value = np.asarray(parameter.value)
    return (
        None if low is None else min(low, max(least, float(value.min()) - room)),
        None if high is None else max(high, min(most, float(value.max()) + room)),
    )


class StandardPolarization(Held):
    """Polarization of a star itself, which the model holds at zero or at a catalogue's value."""

    # the law is of the error of the catalogue's values; a lamp that is known to be nearly fully
    # polarized is outside the bounds of one that is fitted
    degree, is_bounded = 2, False

    def held(self, roles):
        """Return the first star whose polarization is held, and the names of its parameters."""
        star = held_star(roles.leaves)
        return star, () if star is None else self.free

    def copied(self, optic, keys, context):
        """Return a copy of a star with q and u at each wavelength."""
        size = len(context.wavelength)
        held = {key: np.broadcast_to(getattr(optic, key).value, size) for key in keys}
        return optic.with_parameters(**held)


def held_star(optics_of_chain):
    """Return the first star whose polarization is fixed."""
    stars = (o for o in optics_of_chain if isinstance(o, optics.PolarizedSource))
    return next((star for star in stars if is_held(star.q) and is_held(star.u)), None)


# ---- discrete alternatives -----------------------------------------------------------------------


class Alternative(Effect):
    """An alternative without parameters: it is fitted from the start, or not at all."""

    kind = "discrete"
    reference = "McIntosh et al. 2026, Sec. 4; the reflections and signs of a chain"
    #: Function of chain, roles, the optic and the law of its tracking that changes the chain.
    change = None
    #: The function that changes it the other way, where there are two that have one name.
    back = None
    #: Name of the only dataset of several in which it is so, None for all; whether it may be so in
    #: one of them, or in a part of it.
    run, may_be_in_part = None, False
    #: Share of the excess of the double differences that is left with it.
    left = 0.0

    def __init__(self, name, title, words, role, change=None, shows=None, **settings):
        where = Where("in", role, True) if isinstance(role, str) else role
        super().__init__(name, title, where, words=words, change=change, shows=shows, **settings)

    def cells(self, chains):
        """Return none: an alternative is not a perturbation."""
        return ()

    def ways(self):
        """Return the alternative, and that which changes the chain the other way."""
        return [self] if self.back is None else [self, self.changed(change=self.back)]

    @property
    def is_of_table(self):
        """Whether it is a mistake of a table, and no property of the instrument."""
        return self.run is not None

    def in_run(self, name):
        """Return the same for the table of one of several datasets."""
        where = "of" if self.title.endswith("table") else "in"
        title = f'{self.title} {where} "{name}" only'
        return self.changed(run=name, name=f"{self.name}/dataset:{name}", title=title)

    def edge(self, observations):
        """Return the frames, (F,) of bool, of which the alternative knows no angle: none."""
        return np.zeros(observations.n_frames, dtype=bool)

    def edit(self, chains, context):
        """Return the changed chains; nothing is added that could be fitted."""
        names = (None,) * len(chains) if self.run is None else context.datasets
        # tables hold true angles; the law tells which part of them came from the sky
        laws = () if context is None else context.tracking
        laws = laws if len(laws) == len(chains) else [TRACKING] * len(chains)
        edited = []
        for chain, law, name in zip(chains, laws, names, strict=True):
            roles = self.roles(chain)
            if name == self.run and self.applies_to(roles):
                index = roles.leaves.index(self.where.anchor(roles))
                chain = chain.copy()
                own = leaves(chain)[index]
                chain = self.change(chain, own, roles=roles, law=law, label=self.label)
            edited.append(chain)
        return Edit(edited, [])


# a table is ahead or behind by up to so many frames: half of a cycle of eight, beyond which a plate
# that is ahead is less far behind
_MOST_ROWS = 4


class Misread(Alternative):
    """Angles of stages that are not those of the table; asked for where no other alternative is."""

    reference = "the writing of tables; no paper is known"
    may_be_in_part = is_of_table = True

    def __init__(self, name, title, words, role, shows, stages, what, rate):
        super().__init__(name, title, words, role, shows=shows)
        #: The stages, what of them their optics are turned by (nothing is their angle, else its
        #: last or next move), and by how much of it.
        self.stages, self.what, self.rate = stages, what, rate

    def applies_to(self, roles):
        """Return whether there are optics on all of the stages."""
        stages = {leaf.stage for leaf in roles.leaves}
        return super().applies_to(roles) and stages.issuperset(self.stages)

    def farther(self):
        """Return the same of a table that is early or late by more frames."""
        counts = range(2, 1 + _MOST_ROWS * (self.what in ("_move", "_next")))
        titles = {n: self.title.replace("one frame", f"{n} frames") for n in counts}
        return [self.changed(what=self.what + str(n), title=titles[n]) for n in counts]

    def edge(self, observations):
        """Return the frames, (F,) of bool, whose angle is in no row of their table."""
        word, count = counted(self.what)
        if self.run not in (None, observations.name) or word not in ("_move", "_next"):
            return super().edge(observations)
        # exposures in their order: frames of several beams are taken at once
        number = np.unique(observations.position("sequence"), return_inverse=True)[1]
        return number < count if word == "_move" else number > number.max() - count

    def change(self, chain, optic, *, roles, label, **_):
        """Return a chain with all optics on the stages turned."""
        for leaf in roles.leaves:
            if leaf.stage in self.stages:
                rate = self.rate * leaf.stage_sign
                chain = geared(chain, leaf, leaf.stage + self.what, rate, label)
        return chain


def flipped_before(chain, optic, *, label, **_):
    """Return a chain with a reflection upstream of an optic."""
    return insert_optic(chain, optics.ParityFlip(name=label), before=optic.name)


def flipped_behind(chain, optic, *, roles, label, **_):
    """Return a chain with a reflection downstream of an optic taken out, or put in."""
    order = [leaf.name for leaf in roles.leaves]
    behind = roles.leaves[order.index(optic.name) :]
    flips = [leaf for leaf in behind if isinstance(leaf, optics.ParityFlip)]
    # a flip twice is none: one too many and one too few are the same alternative
    if flips:
        return remove_optic(chain, flips[0].name)
    return insert_optic(chain, optics.ParityFlip(name=label), before=roles.splitter.name)


def other_sign(chain, optic, **_):
    """Return a chain with the sign of the stage of an optic turned."""
    optic.mount = optic.stage if optic.stage_sign < 0 else f"-{optic.stage}"
    return chain


def other_sign_in_table(*factors):
    """Return what turns the sign of an angle on sky, from which that of the plate came, too."""

    def change(chain, optic, *, roles, **how):
        chain = other_sign(chain, optic)
        return chain if roles.plate is None else following(*factors)(chain, roles.plate, **how)

    return change


def exchanged(chain, optic, *, label, **_):
    """Return a chain in which the two beams of a splitter are exchanged."""
    # half a turn of its axes, by which it stays as it is itself
    turn = optics.Rotator(theta=90 * u.deg, name=label, fixed={"theta": True})
    return insert_optic(chain, turn, before=optic.name)


def turned_by(degrees):
    """Return what turns an optic, and the bounds of its angle with it."""

    def change(chain, optic, **_):
        # bounds of a misalignment are about the nominal zero, which is what moves
        bounds = [None if b is None else b + degrees for b in optic.theta.bounds]
        optic.theta = (optic.theta.value + degrees) * u.deg
        optic.theta.bounds = tuple(bounds)
        return chain

    return change


def geared(chain, optic, stage, rate, label):
    """Return a chain in which an optic is turned by a rate times the position of a stage more."""
    # rotators before and behind turn the optic without turning the light
    for side, sign in {"before": 1, "after": -1}.items():
        turn = optics.DriftRotator(mount=stage, name=f"{label}_{optic.name}_{stage}_{side}")
        # a whole number of turns included
        turn.rate.bounds = (None, None)
        turn.rate = sign * rate * u.rad
        turn.rate.fixed = True
        chain = insert_optic(chain, turn, **{side: optic.name})
    return chain


def following(*factors):
    """Return what multiplies the factors of parallactic angle and altitude in a plate's law."""

    def change(chain, plate, *, law, label, **_):
        for stage, factor, old in zip(("parallactic", "altitude"), factors, law, strict=True):
            # a law without this angle cannot have its sign wrong
            if factor * old != old:
                chain = geared(chain, plate, stage, (factor - 1) * old, label)
        return chain

    return change
