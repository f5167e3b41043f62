# Licensed under a 3-clause BSD style license - see LICENSE
"""Which of a calibration's chains the light of a frame went through."""

from astropolcal.calibration._system import split_chain
from astropolcal.calibration.validity import (
    beam_words,
    instrument_of,
    optics_words,
    validity_of,
)
from astropolcal.exceptions import AstropolcalError, ChainError
from astropolcal.instruments.base import without_nuisance


def inner_optics(calibration, optics_in=None, beam=None, label="the calibration"):
    """
    Return the optics from the first on a stage of the instrument on.

    Parameters
    ----------
    calibration : Calibration
        It may have chains for several sets of optional optics.
    optics_in : sequence of str, optional
        All optional optics in the beam.
    beam : dict of str to bool, optional
        Single ones that are known to be in the beam or not; not used with ``optics_in``.
    label : str
        What messages call the calibration.

    Raises
    ------
    ChainError
        If no chain has these optics, or several have.
    """
    instrument, kinds = instrument_of(calibration), {}
    known = None if optics_in is None else set(optics_in)
    for record, chain in zip(calibration.datasets, calibration.chains, strict=True):
        inner = split_chain(without_nuisance(chain))[1]
        if _matches(_optional(instrument, record), inner, known, beam or {}):
            # chains of the same optics share them by name, so any one stands for all
            kinds.setdefault(tuple(leaf.name for leaf in inner), inner)
    if not kinds:
        wanted = beam_words(beam) if known is None else optics_words([tuple(sorted(known))])
        raise ChainError(f"{label}: no chain {wanted}; it holds for {validity_of(calibration)}")
    if len(kinds) > 1:
        # only what differs helps to choose
        common = set.intersection(*map(set, kinds))
        shown = [",".join(n for n in names if n not in common) or "none" for names in kinds]
        raise ChainError(
            f"{label}: which optics are in the beam? optics_in tells its chains apart: "
            f"{' or '.join(shown)}"
        )
    return next(iter(kinds.values()))


def _optional(instrument, record):
    """Return the optional optics of a dataset, or None if no instrument knows them."""
    try:
        return set(instrument.setup(record)[1])
    except (AttributeError, AstropolcalError):
        return None


def _matches(optional, inner, wanted, beam):
    # an instrument knows which of its optics are optional; without one all of the chain's may be
    present = {leaf.name for leaf in inner} if optional is None else optional
    if wanted is None:
        return all((name in present) == is_in for name, is_in in beam.items())
    return wanted <= present if optional is None else wanted == present


def telescope_optics(calibration):
    """Return the optics of a calibrated telescope, from the sky on; None if there are none."""
    for chain in calibration.chains:
        outer, _ = split_chain(chain)
        # in front of the parallactic angle stands the star itself, which is no telescope
        start = next((i for i, leaf in enumerate(outer) if leaf.stage == "parallactic"), None)
        if start is not None:
            return outer[start:]
    return None


def told_beam(headers, instrument, labels=None):
    """
    Return what headers tell of optional optics, name to whether they are in the beam.

    Raises
    ------
    ChainError
        If the frames differ.
    """
    found = {}
    for i, header in enumerate(headers):
        label = f"frame {i}" if labels is None else labels[i]
        for name, is_in in instrument.optics_of(header).items():
            first, before = found.setdefault(name, (label, is_in))
            if before != is_in:
                words = ("in the beam", "not") if before else ("not in the beam", "in it")
                raise ChainError(f"{name} was {words[0]} in {first}, and {words[1]} in {label}")
    return {name: is_in for name, (_, is_in) in found.items()}
