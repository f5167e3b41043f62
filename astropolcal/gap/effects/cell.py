# Licensed under a 3-clause BSD style license - see LICENSE
"""A cell of the table of places, kinds and dependences, as an effect that can be fitted."""

import astropy.units as u
import numpy as np

from astropolcal import optics
from astropolcal.chain import insert_optic, join, leaves
from astropolcal.gap.cells import places
from astropolcal.gap.effects._detector_cells import detector_optic
from astropolcal.gap.effects.base import Edit, Effect, EffectParameter, label_of
from astropolcal.optics import Dependence

__all__ = ["CellEffect"]

# the most that a kind may be: beyond it is no perturbation
_LIMITS = {"retardance": np.pi, "rotation": np.pi / 4, "diattenuation": 3.0, "depolarization": 3.0}
_LIMIT = 0.5


class CellEffect(Effect):
    """
    An effect that is one cell: a perturbation of some kind at some place.

    Parameters
    ----------
    cell : Cell
        Place, kind and dependence.
    degree : int or None
        Degree of its law in wavelength, None for one value a wavelength.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> from astropolcal.gap.cells import Cell
    >>> from astropolcal.gap.effects.cell import CellEffect
    >>> drift = CellEffect(Cell("in:derotator", "retardance_h", "time"))
    >>> drift.applies([instruments.get("charis").chain()])
    True
    """

    kind = "cell"
    shows = "what the cell does to the data"
    reference = "a perturbation of no name"

    def __init__(self, cell, degree=2):
        self._cell, self.degree = cell, degree
        self.name = cell.name
        self.title, self.place = cell.title, cell.place

    def cells(self, chains):
        """Return the cell."""
        return (self._cell,)

    @property
    def label(self):
        """Name of the optic in the chain."""
        return label_of(self.name)

    def applies(self, chains):
        """Return whether one of the chains has the place."""
        return any(self._place(chain) is not None for chain in chains)

    def applies_to(self, roles):
        """Return whether one chain has the place."""
        return self._place(join(roles.leaves)) is not None

    def _place(self, chain):
        if self._cell.place == "detector":
            return self._cell.place
        return next((p for p in places(chain) if p.name == self._cell.place), None)

    def edit(self, chains, context):
        """Return the chains with the perturbation at zero; see `Effect.edit`."""
        if self._cell.kind not in optics.GENERATORS:
            return self._at_detector(chains, context)
        edited, dependence = [], Dependence(self._cell.dependence)
        # chains of the same source stand for several datasets: the place of the dataset counts
        names = context.datasets or (None,) * len(chains)
        for chain, name in zip(chains, names, strict=True):
            place = self._place(chain)
            own = dependence.kind != "dataset" or dependence.text.partition(":")[2] == name
            edited.append(self._with(chain, place, context) if place and own else chain)
        scale, limit = self._cell.scale, _LIMITS.get(self._cell.kind.partition("_")[0], _LIMIT)
        basis = None if self.degree is None else context.basis(self.degree)
        keys = ("amplitude", "quadrature")[: dependence.count]
        parameters = [EffectParameter(f"{self.label}.{k}", scale, limit, basis) for k in keys]
        return Edit(edited, parameters)

    def _at_detector(self, chains, context):
        """Return the chains with what only a detector has."""
        edited = []
        for chain in chains:
            optic, side, key, ties = detector_optic(self._cell.kind, self.label, context)
            split = next(o.name for o in leaves(chain) if o.splits_light)
            edited.append(insert_optic(chain, optic, **{side: split}))
        basis = None if self.degree is None else context.basis(self.degree)
        name = f"{self.label}.{key}"
        return Edit(edited, [EffectParameter(name, self._cell.scale, _LIMIT, basis)], ties)

    def _with(self, chain, place, context):
        dependence = Dependence(self._cell.dependence)
        size = np.zeros(len(context.wavelength))
        values = {"amplitude": size}
        if dependence.count == 2:
            values["quadrature"] = size
        theta = 0.0 if place == "detector" else place.theta
        optic = optics.Perturbation(
            **values,
            kind=self._cell.kind,
            dependence=self._cell.dependence,
            theta=theta * u.rad,
            name=self.label,
        )
        for key in optic.param_names:
            getattr(optic, key).fixed = key not in values
        if place == "detector":
            split = next(o.name for o in leaves(chain) if o.splits_light)
            return insert_optic(chain, optic, after=split)
        around = [optic]
        if place.mount is not None:
            # what turns the light into the frame of the stage turns it back behind
            other = place.mount[1:] if place.mount.startswith("-") else f"-{place.mount}"
            there = optics.Rotator(mount=place.mount, name=f"{self.label}_in")
            back = optics.Rotator(mount=other, name=f"{self.label}_out")
            there.theta.fixed = back.theta.fixed = True
            around = [there, optic, back]
        for one in around if place.after is None else reversed(around):
            chain = place.insert(chain, one)
        return chain
