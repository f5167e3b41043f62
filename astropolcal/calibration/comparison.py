# Licensed under a 3-clause BSD style license - see LICENSE
"""Instruments and calibrations side by side: retardance, diattenuation and efficiency."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal import instruments
from astropolcal.calibration.efficiency import has_derotator, polarimetric_efficiency, sky_path
from astropolcal.chain import join, leaves, stages, system_mueller
from astropolcal.exceptions import InstrumentError, ParameterError
from astropolcal.instruments import Instrument
from astropolcal.mueller import diattenuation, retardance_vector
from astropolcal.optics import COORDINATES

__all__ = ["compare"]

_TURN = np.arange(0, 180, 5.0) * u.deg
_SKY = ("parallactic", "altitude")
# a wavelength so near to that of a filter is it
_SAME_FILTER = 0.01


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
        angle of polarization that is measured worst, without the telescope.

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
    pairs = list(members.items()) if isinstance(members, dict) else _labelled(members)
    if not pairs:
        raise ParameterError("nothing to compare: give calibrations, instruments or chains")
    labels = [label for label, _ in pairs]
    twice = sorted({label for label in labels if labels.count(label) > 1})
    if twice:
        raise ParameterError(f"{', '.join(twice)} occurs twice; give labels, as a dict")
    rows = [row for label, member in pairs for row in _rows(label, *_resolved(label, member))]
    table = QTable({key: [row[key] for row in rows] for key in rows[0]})
    for key in table.colnames:
        if key.endswith("_retardance"):
            table[key] = np.asarray(table[key]) * u.deg
    table["wavelength"] = np.asarray(table["wavelength"]) * u.nm
    return table


def _labelled(members):
    found = []
    for number, member in enumerate(members):
        label = member if isinstance(member, str) else getattr(member, "name", None)
        label = getattr(member, "instrument", None) or label or f"chain {number + 1}"
        found.append((str(label), member))
    return found


def _resolved(label, member):
    """Return chain, wavelengths and instrument (or None) of a member."""
    if isinstance(member, str):
        member = instruments.get(member)
    if isinstance(member, Instrument):
        return member.published(), member.wavelength, member
    if hasattr(member, "chains") and hasattr(member, "wavelength"):
        known = member.instrument and _known(member.instrument)
        return member.chains[0], member.wavelength, known
    if isinstance(member, tuple) and len(member) == 2:
        return member[0], np.atleast_1d(u.Quantity(member[1])), None
    raise ParameterError(
        f"{label}: {member!r} is no calibration, instrument, name of one, or (chain, wavelength)"
    )


def _known(name):
    try:
        return instruments.get(name)
    except InstrumentError:
        return None


def _rows(label, chain, wavelength, instrument):
    path = _behind_telescope(sky_path(chain))
    columns = {"label": [label] * wavelength.size, "filter": _filters(instrument, wavelength)}
    columns["wavelength"] = wavelength.to_value(u.nm)
    columns |= _optics(path, wavelength)
    columns["path_diattenuation"] = _diattenuation(path, wavelength)
    turn = _TURN if has_derotator(path) else None
    efficiency = np.atleast_2d(polarimetric_efficiency(path, wavelength, derotator=turn, aolp=None))
    columns["least_efficiency"] = efficiency.min(axis=0)
    columns["most_efficiency"] = efficiency.max(axis=0)
    return [dict(zip(columns, row, strict=True)) for row in zip(*columns.values(), strict=True)]


def _behind_telescope(path):
    """Return the path from the half-wave plate on, or the first optic on a stage."""
    found = leaves(path)
    own = [i for i, o in enumerate(found) if o.stage not in (None, *_SKY, *COORDINATES)]
    plate = [i for i in own if found[i].stage == "hwp"]
    return join(found[(plate or own or [0])[0] :])


def _optics(path, wavelength):
    """Return retardance and diattenuation of plate and derotator, NaN where there is none."""
    found = leaves(path)
    plate = next((o for o in found if o.stage == "hwp"), None)
    turning = (o for o in found if o.stage not in (None, "hwp", *_SKY, *COORDINATES))
    optics = {"hwp": plate, "derotator": next(turning, None)}
    columns = {}
    for name, optic in optics.items():
        columns[f"{name}_retardance"] = _retardance(optic, wavelength)
        columns[f"{name}_diattenuation"] = _diattenuation(optic, wavelength)
    return columns


def _matrix(optic, wavelength):
    zero = {s: 0.0 if s in COORDINATES else 0 * u.deg for s in stages(optic)}
    return np.asarray(system_mueller(optic, wavelength, zero)).reshape(-1, 4, 4)


def _retardance(optic, wavelength):
    if optic is None:
        return np.full(wavelength.size, np.nan)
    vector = retardance_vector(_matrix(optic, wavelength))
    length = np.linalg.norm(getattr(vector, "value", vector), axis=-1)
    unit = getattr(vector, "unit", u.rad)
    return np.broadcast_to((length * unit).to_value(u.deg), wavelength.size)


def _diattenuation(optic, wavelength):
    if optic is None:
        return np.full(wavelength.size, np.nan)
    return np.broadcast_to(diattenuation(_matrix(optic, wavelength)), wavelength.size)


def _filters(instrument, wavelength):
    names = getattr(instrument, "filters", None)
    if not names or len(names) != np.size(instrument.wavelength):
        return [""] * wavelength.size
    centres = instrument.wavelength.to_value(u.nm)
    lam = wavelength.to_value(u.nm)[:, None]
    nearest = np.abs(lam / centres - 1)
    return [
        str(names[i]) if off[i] <= _SAME_FILTER else ""
        for off, i in zip(nearest, nearest.argmin(axis=1), strict=True)
    ]
