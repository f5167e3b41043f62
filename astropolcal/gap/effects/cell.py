# Licensed under a 3-clause BSD style license - see LICENSE
"""A cell of the table of places, kinds and dependences, as an effect that can be fitted."""

from astropolcal.gap.effects.effect import Effect
from astropolcal.gap.effects.library import LIBRARY
from astropolcal.gap.effects.where import Where

__all__ = ["CellEffect"]

_AS_LISTED = ("inserted", "free", "equal", "flux", "scale", "limit")


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
        where = Where({"in": "inside"}.get(relation, relation), optic or None)
        told = {"kind": cell.kind, "dependence": cell.dependence}
        # what a detector does with the flux is no perturbation but an optic of the library
        at = (Where("detector"), (cell.kind,))
        row = next((effect for effect in LIBRARY if (effect.near or ())[:2] == at), None)
        if row is not None:
            where, told = row.where, {key: getattr(row, key) for key in _AS_LISTED}
        super().__init__(
            f"{cell.place}/{cell.kind}/{cell.dependence}",
            cell.title,
            where,
            degree=degree,
            **told,
            category="cell",
            words=cell.place,
            shows="what the cell does to the data",
            reference="a perturbation of no name",
        )
        self._cell = cell

    def cells(self, chains):
        """Return the cell."""
        return (self._cell,)
