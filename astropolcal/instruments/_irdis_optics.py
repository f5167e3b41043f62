# Licensed under a 3-clause BSD style license - see LICENSE
"""Optics of SPHERE/IRDIS with their published values, one a filter, and the coatings."""

import warnings
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal import optics
from astropolcal.exceptions import AstropolcalWarning, ChainError, InstrumentError
from astropolcal.instruments._choices import check_choice
from astropolcal.observations.reading import stated_date
from astropolcal.units import iso_date

# van Holstein et al. 2020, as distributed with their pipeline; one row a filter
_DATA = QTable.read(Path(__file__).parents[1] / "data" / "irdis.ecsv", format="ascii.ecsv")

#: Filters with coefficients, and the wavelengths that stand for them.
FILTERS = tuple(str(name) for name in _DATA["filter"])
CENTRES = _DATA["wavelength"]
#: Day from which the telescope's mirrors have their new coating, and the names of both.
RECOATING = _DATA.meta["recoating"]
COATINGS = ("before", "after")

# a wavelength within this share of a filter's centre stands for the filter
_SAME_FILTER = 0.01


def filters_at(wavelength):
    """Return the index of the filter of every wavelength."""
    centres, lam = CENTRES.to_value(u.um), u.Quantity(wavelength).to_value(u.um)
    index = np.abs(lam[:, None] / centres - 1).argmin(axis=1)
    # written so that NaN is off, too
    off = ~(np.abs(lam / centres[index] - 1) <= _SAME_FILTER)
    if off.any():
        known = ", ".join(f"{n} ({c:g} um)" for n, c in zip(FILTERS, centres, strict=True))
        raise InstrumentError(
            f"wavelength = {lam[off][0]:.6g} um is that of no filter with coefficients; "
            f"allowed are {known}"
        )
    return index


def check_all_filters(found):
    """Raise if the optics have another number of values than there are filters."""
    sizes = {getattr(leaf, key).size for leaf in found for key in leaf.param_names}
    if max(sizes) != len(FILTERS):
        raise ChainError(
            f"irdis: the chain has {max(sizes)} values a parameter, and it is not known for which "
            f"of the filters {', '.join(FILTERS)}; give on_sky(chain, wavelength=...)"
        )


def coating_on(date):
    """Return "before" or "after", the coating on a date."""
    return "before" if iso_date(date, error=InstrumentError)[:10] < RECOATING else "after"


def stated_coating(observations):
    """Return the coating that the meta of a table tell."""
    stated = observations.meta.get("coating")
    if stated is not None:
        check_choice(f"{observations.name}: coating", stated, COATINGS)
        return stated
    date = stated_date(observations.meta, observations.name, InstrumentError)
    if date is None:
        raise InstrumentError(
            f"{observations.name}: neither date nor coating in the table's meta; were the "
            f"telescope's mirrors those 'before' or 'after' {RECOATING}?"
        )
    return coating_on(date)


def coating_of(coating, date):
    """Return the coating of a telescope that is put before a chain, by name or date."""
    if coating is not None:
        check_choice("coating", coating, COATINGS)
    if date is None:
        if coating is None:
            warnings.warn(
                "irdis: neither date nor coating of the telescope was given; it is the one from "
                f"{RECOATING} on; give the date of the frames (date, or --date of a command), or "
                "coating='before' for older ones",
                AstropolcalWarning,
                # coating_of, telescope_optics, on_sky: the line that asked for a chain from the sky
                stacklevel=4,
            )
        return coating or "after"
    several = np.ndim(date) > 0
    found = sorted({coating_on(day) for day in (date if several else [date])})
    if len(found) != 1:
        words = f"of before and of after the recoating of {RECOATING}" if found else "none"
        raise InstrumentError(f"the dates are {words}; those of one coating are needed")
    if coating not in (None, *found):
        raise InstrumentError(
            f"coating = {coating!r}, but the date {date} is {found[0]} {RECOATING}"
        )
    return found[0]


def _column(name, index):
    return _DATA[name][index]


def _near(about):
    return {"fixed": {"theta": False}, "bounds": {"theta": (about - 5, about + 5)}}


def half_wave_plate(index):
    """Return the half-wave plate."""
    return _retarder(index, "hwp")


def _retarder(index, name):
    theta = _DATA.meta[f"{name}_theta_deg"]
    held = _near(theta)
    held["bounds"] |= {"diattenuation": (-0.1, 0.1), "retardance": (0, 360)}
    return optics.DiattenuatorRetarder(
        diattenuation=_column(f"{name}_diattenuation", index),
        retardance=_column(f"{name}_retardance", index),
        theta=theta * u.deg,
        mount=name,
        name=name,
        **held,
    )


def derotator(index):
    """Return the derotator."""
    turning = _retarder(index, "derotator")
    # double differences see it in second order only
    turning.diattenuation.fixed = True
    return turning


def polarizers(index):
    """Return the pair of polarizers before the halves of the detector."""
    # the left beam passes +Q
    return optics.WollastonPrism(
        efficiency=_column("polarizer_efficiency", index), theta=90 * u.deg, name="wollaston"
    )


def calibration_polarizer():
    """Return the polarizer of the internal source."""
    return optics.LinearPolarizer(name="calibration_polarizer", **_near(0))


def telescope(index, coating):
    """Return the optics from the sky to the half-wave plate."""
    check_choice("coating", coating, COATINGS)
    return [
        optics.Rotator(mount="parallactic", name="parallactic"),
        _mirror("ut", coating, index),
        optics.Rotator(mount="altitude", name="altitude"),
        _mirror("m4", coating, index),
    ]


def _mirror(name, coating, index):
    return optics.DiattenuatorRetarder(
        diattenuation=_column(f"{name}_diattenuation_{coating}", index),
        retardance=_column("mirror_retardance", index),
        name=name,
        # an unpolarized star shows the diattenuation of a mirror, never its retardance
        fixed={"retardance": True},
        bounds={"diattenuation": (-0.1, 0.1)},
    )
