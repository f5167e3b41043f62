# Licensed under a 3-clause BSD style license - see LICENSE
"""Numbers of a report: sizes of causes, what they do to the data, accuracies of a model."""

import warnings
from copy import copy
from dataclasses import replace
from functools import cached_property

import astropy.units as u
import numpy as np

from astropolcal.calibration import calibrate, target_accuracies
from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.chain import leaves
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, ObservationError
from astropolcal.gap.problem import TOUCHES
from astropolcal.measurement import Measurement
from astropolcal.observations.observables import default_observable
from astropolcal.optics import Perturbation

ACCURACIES = ("s_res", "s_mean", "s_cv")
# parameters correlated more than this with what is uncertain are named
_STRONG, _MOST_TRADES = 0.5, 3
# perturbations that are angles
ANGLES = ("retardance", "rotation")
# directions below this share of the largest take nothing up
_TINY = 1e-9


# ---- sizes ---------------------------------------------------------------------------------


class Fitted:
    """What a model says of the sizes of its effects."""

    def __init__(self, model):
        self.model, self.problem = model, model.problem

    def sizes(self, name):
        """
        Return the fitted parameters of an added effect, ready for JSON.

        Each is a dictionary of ``value`` and ``std`` (a number, or one per wavelength),
        ``unit``, ``limit``, the largest size that is physical, and ``degree``, that of the
        polynomial in wavelength, None without one. The errors are those of the noise, or of
        the scatter of the residuals where it is larger.
        """
        found = {}
        for parameter in self.model.added.get(name) or ():
            slot = self.problem.free.by_name[parameter.name]
            where = self.problem.slices[parameter.name]
            unit, factor = self.unit_of(parameter.name)
            block = parameter.basis if slot.per_wavelength else None
            block = np.eye(where.stop - where.start) if block is None else block
            value = block @ self.model.fit.coefficients[where] / factor
            std = np.sqrt(np.einsum("ij,jk,ik->i", block, self.covariance[where, where], block))
            # one open coefficient leaves every value of a law open
            std = np.where(self.is_open[where].any(), np.nan, std / factor)
            size = {"value": _number(value), "std": _number(std), "unit": unit}
            size |= {"limit": float(parameter.canonical_limit / factor)}
            # the errors hold if the law has no more freedom than that
            degree = block.shape[1] - 1 if block.shape[1] < len(block) else None
            found[parameter.name] = size | {"degree": degree}
        return found

    def unit_of(self, name):
        """Return the unit of a parameter in words, and how much of it is canonical."""
        slot, optic = self.problem.free.by_name[name], name.partition(".")[0]
        carrier = next((o for c in self.model.trains for o in leaves(c) if o.name == optic), None)
        if isinstance(carrier, Perturbation) and carrier.kind.startswith(ANGLES):
            return "deg", np.deg2rad(1.0)
        return str(slot.unit or ""), slot.factor

    def double_share(self, name):
        """
        Return the share of what a cause does that is left in double differences, or None.

        To first order, and less what the rest of the model absorbs.
        """
        if not self.model.added.get(name) or self.doubles is None:
            return None
        problem, full = self.problem, self.model.fit.coefficients
        rows, without = self._rows(name), full.copy()
        without[rows] = self._absent[rows]
        others = np.setdiff1d(np.arange(problem.size), rows)
        lost = problem.residual(without) - problem.residual(full)
        slopes = problem.jacobian(full)[:, others]
        without[others] += np.linalg.lstsq(slopes, lost, rcond=_TINY)[0]
        pairs = zip(problem.differences(without), problem.differences(full), strict=True)
        single = self._in_pairs([one[0] - other[0] for one, other in pairs])
        double = np.subtract(*(self.doubles.residuals(problem.vector(q)) for q in (without, full)))
        double = double[: self.doubles.n_data]
        # of two frames of opposite signs the double difference is as large as each
        return float(np.clip(np.sum(double**2) / max(np.sum(single**2), 1e-300), 0, 1))

    @cached_property
    def doubles(self):
        """Measurement of the double differences of the model, None where frames form no pairs."""
        kind = {"observable": "normalized_double_difference", "ties": self.problem.ties}
        try:
            return Measurement(self.model.chains, self.model.observations, **kind)
        except ObservationError:
            return None

    def _in_pairs(self, singles):
        """Return the root mean square of values (W, F) over the frames of each, (n_data,)."""
        parts = zip(self.doubles.datasets, singles, strict=True)
        squares = [np.mean(one[:, d.frames] ** 2, axis=-1)[d.valid] for d, one in parts]
        return np.sqrt(np.concatenate(squares))

    @property
    def double_noise_percent(self):
        """Noise of the double differences, by that of the single differences, in percent."""
        sigma = self._in_pairs([c.sigma[0] for c in self.problem.channels])
        return 100 * float(np.sqrt(np.mean(sigma**2) / 2))

    def significance(self, name):
        """Return the size of an effect as a whole in units of its error, or None."""
        if not self.model.added.get(name):
            return None
        rows = self._rows(name)
        rows = rows[~self.is_open[rows]]
        # the centre of the prior is where the last fit began, not where the effect is absent
        moved = self.model.fit.coefficients[rows] - self._absent[rows]
        block = self.covariance[np.ix_(rows, rows)]
        error = np.sqrt(np.diag(block))
        # of unit diagonal, so that units do not matter
        left = moved / error
        inverse = np.linalg.pinv(block / np.outer(error, error), hermitian=True)
        return float(np.sqrt(max(left @ inverse @ left, 0.0)))

    @property
    def _absent(self):
        """Coefficients at which every effect is absent."""
        return self.problem.coefficients(self.problem._absent())

    def trades(self, name):
        """
        Return the other parameters that can be exchanged for a part of an effect.

        At most three names, the strongest first.
        """
        rows, error = self._rows(name), np.sqrt(np.diag(self.covariance))
        error = np.where(error > 0, error, 1.0)
        strength = np.abs(self.covariance / np.outer(error, error))[rows].max(axis=0)
        if self.is_open[rows].any():
            # what the data leave open altogether is worse than what they know badly
            null = self._directions[1]
            touching = null[np.abs(null[:, rows]).max(axis=1) > TOUCHES]
            strength = np.linalg.norm(touching, axis=0)
        own = {p.name for p in self.model.added[name]}
        others = {
            other: float(strength[where].max())
            for other, where in self.problem.slices.items()
            if other not in own and strength[where].max() > _STRONG
        }
        found = list(others)
        return [found[i] for i in ranked(list(others.values()))[:_MOST_TRADES]]

    def _rows(self, name):
        slices = [self.problem.slices[p.name] for p in self.model.added.get(name) or ()]
        return np.concatenate([np.arange(s.start, s.stop) for s in slices])

    @cached_property
    def _directions(self):
        """Root of the covariance for unit noise, and directions that data do not determine."""
        return self.problem.directions(self.model.fit.coefficients)

    @cached_property
    def covariance(self):
        """Covariance of the coefficients, without what the data do not determine."""
        half = self._directions[0]
        # residuals larger than the noise make the errors larger, smaller ones do not make them
        # smaller
        return max(1.0, self.model.mean_square) * (half.T @ half)

    @property
    def is_open(self):
        """Which coefficients the data do not determine."""
        return np.sum(self._directions[1] ** 2, axis=0) > TOUCHES**2


def _number(values):
    """Return one number, or a list of them; None for what is not finite."""
    plain = [float(v) if np.isfinite(v) else None for v in np.atleast_1d(values)]
    return plain[0] if len(plain) == 1 else plain


# ---- accuracies -----------------------------------------------------------------------------


def accuracies(model, cross_validate=True):
    """
    Return what `calibrate` says of a model, with the sizes of its causes held, ready for JSON.

    ``rms_percent`` is the root mean square of the double differences over all data: of left-out
    frames, or of the fit where there is no cross-validation. Where such a calibration is not
    possible it is None, and the lists are empty.
    """
    instrument = next((o.instrument for o in model.observations if o.instrument), None)
    found = {
        "observable": default_observable(model.observations),
        "wavelength_nm": _number(1e3 * model.problem.wavelength),
        "rms_percent": None,
        "datasets": [],
        "targets": [],
    }
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropolcalWarning)
            made = model.calibration
            calibration = (
                with_causes(model, cross_validate=False, instrument=instrument)
                if made is None
                else replace(made, fit=dict(made.fit), datasets=list(map(copy, made.datasets)))
            )
            if cross_validate:
                calibration.cross_validate()
            targets = target_accuracies(calibration)
            if not all(np.isfinite(table["s_p"]).all() for table in targets):
                targets = target_accuracies(calibration, open_directions="ignore")
    except AstropolcalError:
        return found
    tables = [record.accuracy for record in calibration.datasets]
    count = np.concatenate([table["n"] for table in tables])
    gap = np.concatenate([table["s_cv" if cross_validate else "s_res"].value for table in tables])
    return found | {
        "rms_percent": float(np.sqrt(np.nansum(count * gap**2) / count.sum())),
        "datasets": [
            {"name": record.name, "source": record.source}
            | {f"{key}_percent": _median(record.accuracy[key].value) for key in ACCURACIES}
            for record in calibration.datasets
        ],
        "targets": [
            {
                "dolp_percent": float(u.Quantity(table.meta["dolp"]).to_value(u.percent)),
                "s_p_percent": _median(table["s_p"].to_value(u.percent)),
                "s_chi_deg": _median(table["s_chi"].to_value(u.deg)),
                "words": table.meta["words"],
            }
            for table in targets
        ],
    }


def with_causes(model, **options):
    """
    Calibrate the chains of a model, the sizes of its causes held.

    Their sizes are what was found: fitting them again, to double differences, could move them, and
    so could another mirror branch.
    """
    held = {p.name for parameters in model.added.values() for p in parameters}
    ties = model.problem.ties
    held |= {name for name, tie in ties.items() if tie.source in held}
    return calibrate(
        model.chains,
        model.observations,
        fix=dict.fromkeys(sorted(held)) or None,
        search=False if held else None,
        ties={name: tie for name, tie in ties.items() if name not in held},
        **options,
    )


def _median(values):
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None
