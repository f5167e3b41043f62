# Licensed under a 3-clause BSD style license - see LICENSE
"""How half-wave plate and derotator of an instrument follow the sky."""

import math
from dataclasses import dataclass, field
from types import MappingProxyType

from astropolcal.exceptions import InstrumentError
from astropolcal.instruments._choices import check_choice
from astropolcal.observations.pointings import TRACKING

__all__ = ["SkyLaw"]

# what keeps the pupil, or the image, still at a Nasmyth focus
_NASMYTH = MappingProxyType({"pupil": (0.0, 0.5), "field": (0.5, 0.5)})


@dataclass(frozen=True)
class SkyLaw:
    r"""
    How half-wave plate and derotator follow parallactic angle *p* and altitude *a*.

    .. math:: \theta = \theta_0 + f\,p + g\,a

    with the commanded angle, or an offset, :math:`\theta_0`.

    Parameters
    ----------
    plate : (float, float) or dict of str to (float, float)
        (f, g) of the half-wave plate; (0, 0) for one that stays where it is put. Where it depends
        on what the derotator keeps still, one for each mode, such as ``"field"`` and ``"pupil"``.
        Without it that of Subaru, (0.5, 1).
    derotator : dict of str to (float, float)
        (f, g) of the derotator for each mode; empty where there is none. Without it that of a
        Nasmyth focus: (0, 0.5) for ``"pupil"``, (0.5, 0.5) for ``"field"``.

    Raises
    ------
    InstrumentError
        If a law is not two finite numbers, or plate and derotator have other modes.

    Examples
    --------
    A polarimeter at a Cassegrain focus, which turns with the telescope:

    >>> from astropolcal.instruments import SkyLaw
    >>> SkyLaw(plate=(0, 0), derotator={}).plate_law()
    (0.0, 0.0)

    One whose plate has a law of its own for each mode:

    >>> law = SkyLaw(plate={"field": (-1, 1), "pupil": (-0.5, 1)})
    >>> law.plate_law("pupil"), law.derotator_law("pupil")
    ((-0.5, 1.0), (0.0, 0.5))
    """

    plate: object = TRACKING
    derotator: dict = field(default_factory=lambda: dict(_NASMYTH))

    def __post_init__(self):
        # one law for all modes has the name ""
        given = self.plate if isinstance(self.plate, dict) else {"": self.plate}
        plate = {mode: _pair(f"plate {mode}".strip(), law) for mode, law in given.items()}
        turns = {mode: _pair(f"derotator {mode}", law) for mode, law in self.derotator.items()}
        if not plate:
            raise InstrumentError("plate = {}: at least one law is needed, (0, 0) if it stands")
        # a frozen instance is set once, here
        object.__setattr__(self, "plate", plate)
        object.__setattr__(self, "derotator", turns)
        # a mode of the plate that the derotator lacks could never be asked for
        lost = sorted(set(plate) - {""} - set(turns)) if turns else []
        if lost:
            raise InstrumentError(
                f"the plate has a law for {', '.join(lost)}, the derotator for {', '.join(turns)}"
            )

    @property
    def modes(self):
        """What the derotator may keep still, or what the law of the plate depends on."""
        return tuple(self.derotator) or tuple(mode for mode in self.plate if mode)

    @property
    def plate_depends_on_mode(self):
        """Whether the law of the plate is another one in another mode."""
        # two modes with the same law need not be told apart
        return len(set(self.plate.values())) > 1

    def plate_law(self, mode=None):
        """
        Return the factors of parallactic angle and altitude in the plate's true angle.

        Parameters
        ----------
        mode : str, optional
            What the derotator keeps still; needed where the law depends on it.

        Returns
        -------
        (float, float)

        Raises
        ------
        InstrumentError
            If the mode is unknown, or not given where it is needed.
        """
        if mode is not None and self.modes:
            check_choice("mode", mode, self.modes)
        if mode in self.plate:
            return self.plate[mode]
        if self.plate_depends_on_mode:
            check_choice("mode", mode, tuple(self.plate))
        return next(iter(self.plate.values()))

    def derotator_law(self, mode):
        """
        Return the factors of parallactic angle and altitude in the derotator's angle.

        Parameters
        ----------
        mode : str
            What it keeps still.

        Returns
        -------
        (float, float)

        Raises
        ------
        InstrumentError
            If there is no derotator, or the mode is unknown.
        """
        if not self.derotator:
            raise InstrumentError("there is no derotator that follows the sky")
        check_choice("law", mode, tuple(self.derotator))
        return self.derotator[mode]


def _pair(what, law):
    try:
        f, g = (float(number) for number in law)
    except (TypeError, ValueError):
        f = g = float("nan")
    if not (math.isfinite(f) and math.isfinite(g)):
        raise InstrumentError(
            f"{what}: {law!r} must be two numbers, factors of parallactic angle and altitude"
        )
    return f, g
