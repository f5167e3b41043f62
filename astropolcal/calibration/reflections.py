# Licensed under a 3-clause BSD style license - see LICENSE
"""
Diattenuation and retardance of calibrated mirrors, beside those of bare metals.
"""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.derived import propagate
from astropolcal.chain import leaves
from astropolcal.exceptions import ChainError
from astropolcal.optics import Diattenuator, DiattenuatorRetarder, MetalMirror, PowerLawMirror

__all__ = ["METALS", "mirror_names", "mirror_values"]

#: Metals that mirrors are compared with.
METALS = ("silver", "gold", "aluminium")

_MIRRORS = (Diattenuator, DiattenuatorRetarder, MetalMirror, PowerLawMirror)


def mirror_names(calibration):
    """
    Return the names of the mirrors, and of other diattenuators, of a calibration.

    Parameters
    ----------
    calibration : Calibration
        The calibration.

    Returns
    -------
    list of str
        In the order the light travels; without those that are fixed and do nothing.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, optics
    >>> from astropolcal.calibration import mirror_names
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> chain = (optics.Diattenuator(diattenuation=[0.01] * 3, name="fold_mirror")
    ...          | optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    ...          | optics.WollastonPrism(fixed={"efficiency": True}, name="wollaston"))
    >>> chain["hwp"].retardance.fixed = True
    >>> data = simulate(chain, [1.2, 1.6, 2.2] * u.um, half_wave_plate_cycles(), seed=2)
    >>> cal = calibrate(chain, data)
    >>> mirror_names(cal)
    ['fold_mirror']
    """
    found = {leaf.name: leaf for chain in calibration.chains for leaf in leaves(chain)}
    return [name for name, leaf in found.items() if isinstance(leaf, _MIRRORS)]


def mirror_values(calibration, name, incidence=45 * u.deg):
    """
    Return diattenuation and retardance of a mirror, with errors, beside those of metals.

    Parameters
    ----------
    calibration : Calibration
        The calibration; one read from a file will do.
    name : str
        The mirror, see `mirror_names`.
    incidence : `~astropy.units.Quantity`
        Angle of incidence for the metals.

    Returns
    -------
    `~astropy.table.QTable`
        One row a wavelength: ``wavelength``; ``diattenuation`` and its error; ``retardance`` and
        its error, where the optic has one (0 to 360 deg, 180 of an ideal mirror); and of each
        metal, bare, with the indices of Rakić et al. (1998), ``diattenuation_silver``,
        ``retardance_silver`` and so on. Errors are NaN where the data do not determine a
        value alone, and where it is held. Meta ``name``, and ``held``: whether the retardance is.

    Raises
    ------
    ChainError
        If there is no such mirror.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, optics
    >>> from astropolcal.calibration import mirror_values
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> chain = (optics.Diattenuator(diattenuation=[0.01] * 3, name="fold_mirror")
    ...          | optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    ...          | optics.WollastonPrism(fixed={"efficiency": True}, name="wollaston"))
    >>> chain["hwp"].retardance.fixed = True
    >>> data = simulate(chain, [1.2, 1.6, 2.2] * u.um, half_wave_plate_cycles(), seed=2)
    >>> cal = calibrate(chain, data)
    >>> table = mirror_values(cal, "fold_mirror")
    >>> table["diattenuation"][0].round(2), table["diattenuation_gold"][0].round(2)
    (<Quantity 1. %>, <Quantity 0.94 %>)
    """
    known = mirror_names(calibration)
    if name not in known:
        raise ChainError(f"no mirror {name!r}; the calibration has {', '.join(known) or 'none'}")
    wavelength = calibration.wavelength
    table = QTable({"wavelength": wavelength})
    leaf = _leaf(calibration.chains, name)
    percent = 100 * u.percent
    for key, unit in (("diattenuation", percent), ("retardance", u.deg)):
        if hasattr(leaf, key):
            value, std = _with_error(calibration, name, key)
            table[key], table[f"{key}_err"] = value * unit, std * unit
    table.meta |= {"name": name, "held": _is_held(leaf)}
    for metal in METALS:
        mirror = MetalMirror(material=metal, incidence=incidence)
        table[f"diattenuation_{metal}"] = mirror.diattenuation(wavelength) * percent
        table[f"retardance_{metal}"] = mirror.retardance(wavelength)
    return table


def _leaf(chains, name):
    return next(leaf for chain in chains for leaf in leaves(chain) if leaf.name == name)


def _is_held(leaf):
    """Return whether the retardance is not fitted."""
    if not isinstance(leaf, DiattenuatorRetarder):
        return all(getattr(leaf, key).fixed for key in leaf.own_names)
    return bool(leaf.retardance.fixed)


def _with_error(calibration, name, key):
    """Return a value and its error, plain (degree), shape (n_wavelengths,)."""
    size, own = len(calibration.wavelength), calibration.parameter_values().get(f"{name}.{key}")
    if own is not None:
        return (np.broadcast_to(own[part], size).astype(float) for part in ("value", "std"))

    def law(*chains):
        value = getattr(_leaf(chains, name), key)(calibration.wavelength)
        return value.to_value(u.deg) if isinstance(value, u.Quantity) else value

    def slopes(*chains):
        leaf = _leaf(chains, name)
        found = leaf.law_slopes(calibration.wavelength)[key]
        # the thickness of a film cannot be stepped below zero, so no differences are taken
        return {f"{name}.{own}": found[own] for own in found if not getattr(leaf, own).fixed}

    derived = propagate(calibration, law, slopes)
    return np.asarray(derived.value), np.asarray(derived.std)
