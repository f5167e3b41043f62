# Licensed under a 3-clause BSD style license - see LICENSE
"""Whether the datasets of a fit agree on the optics that they share, and what it means for errors.

A fit has one value of an optic for all of its datasets. If the optic stood or retarded otherwise
in one of them, other parameters absorb what they can, and the errors know nothing of it. Here each
angle is moved in one dataset alone, at all wavelengths together, and all else is fitted again, to
first order: the score test of Rao (1948, Math. Proc. Camb. Phil. Soc. 44, 50,
doi:10.1017/S0305004100023987).
"""

import astropy.units as u
import numpy as np

from astropolcal.units import canonical_factor

__all__ = []

# how sure a difference is, and how well a dataset alone has to know an angle, in degree
_FAR, _TOLD = 4.0, 5.0
# what changes the data less, per degree in units of their noise, or is left of it, is nothing
_SEEN = 1e-6


def disagreements(measurement, whitened, weighting, scatter):
    """Return in which dataset an angle differs from all others, the surest first.

    Each has ``parameter``, ``dataset``, ``change_deg``, ``std_deg`` and ``sigma``. ``scatter`` is
    that of the residuals, None where they are independent; errors are those that are larger.
    """
    weight = 1.0 if weighting.weight is None else weighting.weight
    residuals, level, found = measurement.residuals() * weight, weighting.level, []
    if not level > 0:
        return found
    names = [dataset.observations.name for dataset in measurement.datasets]
    for slot, i, own in _moves(measurement, whitened):
        # less what other parameters absorb, at the expense of priors
        taken = whitened.slopes.T @ own
        left, lost = own - whitened.slopes @ taken, whitened.prior_slopes @ taken
        size = left @ left + lost @ lost
        if not size > _SEEN * (own @ own):
            continue
        variance = level**2 * size
        if scatter is not None:
            scattered = scatter.middle(left[:, None])[0, 0] + level**2 * (lost @ lost)
            variance = max(variance, scattered)
        change, std = own @ residuals / size, np.sqrt(variance) / size
        if abs(change) > _FAR * std and std < _TOLD:
            one = {"parameter": slot.name, "dataset": names[i], "change_deg": float(change)}
            found.append(one | {"std_deg": float(std), "sigma": float(abs(change) / std)})
    return sorted(found, key=lambda one: -one["sigma"])


def _moves(measurement, whitened):
    """Yield angle, dataset and derivative of the data, per degree in that dataset alone."""
    for slot in measurement.free.slots:
        if slot.unit is None or not u.Unit(slot.unit).is_equivalent(u.deg):
            continue
        turned = whitened.rows[:, slot.slice].sum(axis=1)
        parts = [np.zeros(turned.size) for _ in measurement.segments]
        for part, rows in zip(parts, measurement.segments, strict=True):
            part[rows] = turned[rows]
        seen = [i for i, part in enumerate(parts) if np.abs(part).max(initial=0.0) > _SEEN]
        # what one dataset alone has, none can contradict; of two each differs from the other
        yield from ((slot, i, parts[i]) for i in (seen if len(seen) > 2 else seen[1:]))


def between_datasets(covariance, found):
    """Return a covariance that counts differences between datasets as errors of the angles."""
    rows = np.zeros((len(found), len(covariance)))
    for row, one in zip(rows, found, strict=True):
        for i, (name, unit) in enumerate(zip(covariance.names, covariance.units, strict=True)):
            if name.partition("[")[0] == one["parameter"]:
                row[i] = np.deg2rad(one["change_deg"]) / canonical_factor(unit)
    return covariance.beside(rows) if found else covariance
