# Licensed under a 3-clause BSD style license - see LICENSE
"""Instruments and calibrations side by side: retardance, diattenuation and efficiency."""

import astropy.units as u
import numpy as np
from astropy.table import QTable, vstack

from astropolcal import instruments
from astropolcal.calibration.identifiability.sky import known_instrument
from astropolcal.calibration.uncertainty.derived import propagate
from astropolcal.chain import join, leaves, stages, standing, system_mueller
from astropolcal.efficiency import has_derotator, has_plate, polarimetric_efficiency, sky_path
from astropolcal.exceptions import ParameterError
from astropolcal.instruments import Instrument
from astropolcal.mueller import diattenuation_vector, retardance_vector, unit_vectors
from astropolcal.optics import COORDINATES

__all__ = ["compare"]

# an optic turned by 180 deg is the same: half a turn is all there is
_TURN = np.arange(0, 180, 5.0) * u.deg
_SKY = ("parallactic", "altitude")
# a wavelength so near to that of a filter is it
_SAME_FILTER = 0.01
# errors below this are rounding: nothing that was fitted moves the quantity
_NO_ERROR = 1e-12
# what is compared, in the order of the columns
_COMPARED = (
    "hwp_retardance",
    "hwp_diattenuation",
    "derotator_retardance",
    "derotator_diattenuation",
    "path_diattenuation",
    "least_efficiency",
    "most_efficiency",
)


def compare(members):
    """
    Return what instruments or calibrations do to polarization, at each wavelength or filter.

    Parameters
    ----------
    members : sequence or dict
        Calibrations, instruments or their names (of which the published values are taken), or pairs
        of a chain and its wavelengths. The keys of a dict are the labels; without them a
        calibration or instrument has the name of the instrument.

    Returns
    -------
    `~astropy.table.QTable`
        One row for each member and wavelength: ``label``; ``filter``, where the instrument
        names its filters; ``wavelength``; ``hwp_retardance``, ``hwp_diattenuation``,
        ``derotator_retardance`` and ``derotator_diattenuation``, of the optics on these stages
        (NaN where there is none), the retardance as an angle from 0 to 180 deg;
        ``path_diattenuation``, from the half-wave plate to the beam splitter with all stages at
        zero; ``least_efficiency`` and ``most_efficiency``, over the derotator angles, for the
        angle of polarization that is measured worst, without the telescope. Each of these also
        with ``_std`` after its name: the standard error to first order from the covariance of a
        calibration, infinite where its data do not determine the quantity, NaN where nothing that
        was fitted moves it, and for what is not a calibration.

    Raises
    ------
    ParameterError
        If there is nothing to compare, a label occurs twice, or a member is none of these.
    InstrumentError
        If an instrument is unknown, or has no published values.

    Examples
    --------
    >>> from astropolcal.calibration import compare
    >>> table = compare(["charis", "irdis"])
    >>> irdis = table[table["label"] == "irdis"]
    >>> irdis["filter"].tolist(), irdis["derotator_retardance"].round(1)
    (['Y', 'J', 'H', 'Ks'], <Quantity [126.1, 156.1,  99.3,  84.1] deg>)
    """
    if isinstance(members, dict):
        pairs = list(members.items())
    else:
        pairs = []
        for number, member in enumerate(members):
            label = member if isinstance(member, str) else getattr(member, "name", None)
            label = getattr(member, "instrument", None) or label or f"chain {number + 1}"
            pairs.append((str(label), member))
    if not pairs:
        raise ParameterError("nothing to compare: give calibrations, instruments or chains")
    labels = [label for label, _ in pairs]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise ParameterError(f"{', '.join(twice)} occurs twice; give labels, as a dict")
    table = vstack([_table(label, *_resolved(label, member)) for label, member in pairs])
    for key in table.colnames:
        if key.removesuffix("_std").endswith("_retardance"):
            table[key] = np.asarray(table[key]) * u.deg
    return table


def _resolved(label, member):
    """Return chain, wavelengths, instrument (or None) and calibration (or None) of a member."""
    if isinstance(member, str):
        member = instruments.get(member)
    if isinstance(member, Instrument):
        return member.published(), member.wavelength, member, None
    if hasattr(member, "chains") and hasattr(member, "wavelength"):
        # datasets share what is compared; the first chain has it
        return member.chains[0], member.wavelength, known_instrument(member.instrument), member
    if isinstance(member, tuple) and len(member) == 2:
        return member[0], np.atleast_1d(u.Quantity(member[1])), None, None
    raise ParameterError(
        f"{label}: {member!r} is not a calibration, instrument, name of one, or (chain, wavelength)"
    )


def _table(label, chain, wavelength, instrument, calibration):
    optics = _Optics(chain, wavelength)
    columns = {"label": [label] * wavelength.size, "filter": _filters(instrument, wavelength)}
    columns["wavelength"] = wavelength.to(u.nm)
    columns |= dict(zip(_COMPARED, optics.values(chain), strict=True))
    stds = np.full((len(_COMPARED), wavelength.size), np.nan)
    if calibration is not None:
        stds = propagate(calibration, lambda chain, *_: optics.values(chain)).std
        stds = np.where(stds > _NO_ERROR, stds, np.nan)
    return QTable(columns | {f"{key}_std": std for key, std in zip(_COMPARED, stds, strict=True)})


class _Optics:
    """What is compared of a chain, continued smoothly around its values.

    Retardances are folded to 0 to 180 deg and diattenuations are lengths: both have a kink, which a
    central difference would step over. The vectors of the chain itself say which side to follow.
    """

    def __init__(self, chain, wavelength):
        self.wavelength = wavelength
        path = self.path(chain)
        self.quaternions = [_quaternions(optic, wavelength) for optic in self.parts(path)[:2]]
        vectors = (_diattenuation_vectors(optic, wavelength) for optic in self.parts(path))
        # along Q where there is no diattenuation, whose length has no slope
        self.axes = [unit_vectors(each, [1.0, 0.0, 0.0]) for each in vectors]
        self.turns = has_derotator(path)
        efficiency = self.efficiency(path, _TURN)
        # the extreme over the angles stays at its angle, to first order (envelope theorem)
        self.extremes = [efficiency.argmin(axis=0), efficiency.argmax(axis=0)]

    @staticmethod
    def path(chain):
        """Return the path from the half-wave plate on, or the first optic on a stage."""
        found = leaves(sky_path(chain))
        # the telescope is of the site, not of the instrument
        own = [i for i, optic in enumerate(found) if _is_own(optic)]
        plate = [i for i in own if found[i].stage == "hwp"]
        return join(found[(plate or own or [0])[0] :])

    @staticmethod
    def parts(path):
        """Return plate and derotator (None where there is none) and the path."""
        own = [optic for optic in leaves(path) if _is_own(optic)]
        plate, derotator = (
            next((optic for optic in own if (optic.stage == "hwp") is is_plate), None)
            for is_plate in (True, False)
        )
        return plate, derotator, path

    def values(self, chain):
        """Return an array of shape (quantities, n_wavelengths), retardances in degree."""
        path = self.path(chain)
        parts = self.parts(path)
        retardances = []
        for optic, about in zip(parts, self.quaternions, strict=False):
            turn = _quaternions(optic, self.wavelength)
            # a quaternion and its negative are the same turn; the one nearer to that of the chain
            # continues the angle beyond 180 deg, where half a wave has neither a sign nor a kink
            turn = np.sign(np.sum(turn * about, axis=-1, keepdims=True)) * turn
            half = np.arctan2(np.linalg.norm(turn[..., 1:], axis=-1), turn[..., 0])
            retardances.append(2 * np.rad2deg(half))
        plate, derotator, whole = (
            np.sum(_diattenuation_vectors(optic, self.wavelength) * axes, axis=-1)
            for optic, axes in zip(parts, self.axes, strict=True)
        )
        used = np.unique(self.extremes)
        efficiency = self.efficiency(path, _TURN[used])
        columns = np.arange(self.wavelength.size)
        least, most = (efficiency[np.searchsorted(used, i), columns] for i in self.extremes)
        return np.stack([retardances[0], plate, retardances[1], derotator, whole, least, most])

    def efficiency(self, path, angles):
        """Return the efficiency, shape (n_angles, n_wavelengths); one angle without derotator."""
        if not has_plate(path):
            return np.full((np.size(angles), self.wavelength.size), np.nan)
        turn = angles if self.turns else None
        found = polarimetric_efficiency(path, self.wavelength, derotator=turn, aolp=None)
        return np.atleast_2d(found)


def _is_own(optic):
    """Return whether an optic is on a stage with an angle that is not one of the telescope."""
    return optic.stage not in (None, *_SKY) and optic.stage not in COORDINATES


def _matrix(optic, wavelength):
    # turning an optic by itself changes neither its retardance nor its diattenuation
    zero = {s: 0 * u.deg for s in stages(optic)} | standing(optic)
    return np.asarray(system_mueller(optic, wavelength, zero)).reshape(-1, 4, 4)


def _quaternions(optic, wavelength):
    """Return the turns of (Q, U, V) by an optic as unit quaternions, shape (n_wavelengths, 4)."""
    if optic is None:
        return np.full((wavelength.size, 4), np.nan)
    vector = retardance_vector(_matrix(optic, wavelength)).to_value(u.rad)
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    # sinc(x) is sin(pi x) / (pi x), which holds at no retardance
    parts = [np.cos(length / 2), vector * np.sinc(length / (2 * np.pi)) / 2]
    return np.broadcast_to(np.concatenate(parts, axis=-1), (wavelength.size, 4))


def _diattenuation_vectors(optic, wavelength):
    if optic is None:
        return np.full((wavelength.size, 3), np.nan)
    return np.broadcast_to(diattenuation_vector(_matrix(optic, wavelength)), (wavelength.size, 3))


def _filters(instrument, wavelength):
    names = getattr(instrument, "filters", None)
    if not names or len(names) != np.size(instrument.wavelength):
        return [""] * wavelength.size
    centres = instrument.wavelength.to_value(u.nm)
    off = np.abs(wavelength.to_value(u.nm)[:, None] / centres - 1)
    nearest = np.array(names, dtype=str)[off.argmin(axis=1)]
    return np.where(off.min(axis=1) <= _SAME_FILTER, nearest, "")
