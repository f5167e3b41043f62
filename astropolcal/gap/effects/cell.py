# Licensed under a 3-clause BSD style license - see LICENSE
"""A cell of the table of places, kinds and dependences, as an effect that can be fitted."""

from astropolcal.chain import insert_optic, leaves
from astropolcal.gap.effects._detector_cells import detector_optic
from astropolcal.gap.effects.base import Edit, EffectParameter, label_of
from astropolcal.gap.effects.effect import Effect
from astropolcal.gap.effects.where import Where
from astropolcal.optics import GENERATORS

__all__ = ["CellEffect"]

# the largest share that a detector's error may be
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

    def __init__(self, cell, degree=2):
        relation, _, optic = cell.place.partition(":")
        everywhere = "constant" if cell.run is None else f"dataset:{cell.run}"
        super().__init__(
            cell.name,
            cell.title,
            Where({"in": "inside"}.get(relation, relation), optic or None),
            # what only a detector has is put in by itself, see `edit`
            *((cell.kind, cell.dependence) if cell.kind in GENERATORS else ("gain", everywhere)),
            degree,
            category="cell",
            words=cell.place,
            shows="what the cell does to the data",
            reference="a perturbation of no name",
        )
        self._cell = cell

    def cells(self, chains):
        """Return the cell."""
        return (self._cell,)

    def edit(self, chains, context):
        """Return the chains with the perturbation at zero; see `Effect.edit`."""
        if self._cell.kind in GENERATORS:
            return super().edit(chains, context)
        edited, ties, label = [], {}, label_of(self.name)
        for i, chain in enumerate(chains):
            if not self._in_dataset(context, i):
                edited.append(chain)
                continue
            optic, side, key, ties = detector_optic(self._cell.kind, label, context)
            split = next(o.name for o in leaves(chain) if o.splits_light)
            edited.append(insert_optic(chain, optic, **{side: split}))
        basis = None if self.degree is None else context.basis(self.degree)
        size = EffectParameter(f"{label}.{key}", self._cell.scale, _LIMIT, basis)
        return Edit(edited, [size], ties)
