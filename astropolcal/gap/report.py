# Licensed under a 3-clause BSD style license - see LICENSE
"""
A diagnosis in words, in numbers for machines, as a table and as a page to send.

All of them say the same: `to_dict` works it out, and the others show it.
"""

import base64
import io
import warnings
from contextlib import contextmanager, suppress
from copy import deepcopy
from dataclasses import replace
from functools import cached_property
from textwrap import wrap

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal import instruments, progress
from astropolcal.calibration import target_accuracies
from astropolcal.calibration.fit.calibrate import fitted as fit_measurement
from astropolcal.calibration.fit.calibrate import standing_at
from astropolcal.calibration.identifiability.linearized import ranked
from astropolcal.calibration.result.verdict import faults, what_differs
from astropolcal.calibration.uncertainty.covariance import covariance_along
from astropolcal.chain import leaves
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, GapError, ObservationError
from astropolcal.files import plain
from astropolcal.gap import _words, runs
from astropolcal.gap.planning import plan
from astropolcal.gap.problem import OPEN, TOUCHES, GapProblem, law_basis
from astropolcal.gap.residuals import locate
from astropolcal.gap.selection import REMAINDER
from astropolcal.measurement import Measurement, Normal, parameter_table
from astropolcal.observations.observables import default_observable
from astropolcal.optics import Perturbation

__all__ = ["causes_table", "summary", "to_dict", "write_html"]

#: Caption of the figure that stands with the causes, see `~astropolcal.plotting.plot_cause_map`.
MAP = "Where in the chain the causes are, and of which kind"
_DPI = 130
# a figure on a telephone: inches, dots per inch, characters of its title
_NARROW, _FINE, _TITLE = 4.2, 180, 42
# pixels of a page to an inch
_CSS = 96
_MOST_SCORES = 8
# a wavelength that has this share of the gap has it alone
_ALONE = 0.8
# what the JSON of a diagnosis, of its causes and of their effects has as it is
_OWN = ("verdict", "seconds", "noise_floor_percent", "gap_p_value", "remainder_p_value")
_OWN += ("gap_before_percent", "gap_after_percent")
_OF_CAUSE = ("probability", "share", "p_value", "explained", "evidence", "stability")
_OF_EFFECT = ("place", "kind", "shows", "reference")
# the accuracies of a dataset
ACCURACIES = ("s_res", "s_mean", "s_cv")
# parameters correlated more than this with what is uncertain are named
_STRONG, _MOST_TRADES = 0.5, 3
# perturbations that are angles
ANGLES = ("retardance", "rotation")
# coefficients by which a law bends more than it was asked for, as shares of its size
_BENDS = (0.001, 0.01, 0.03, 0.1)
# directions below this share of the largest take nothing up
_TINY = 1e-9


# ---- for machines ------------------------------------------------------------------------


@progress.in_one_thread
def to_dict(diagnosis):
    """
    Return a diagnosis as plain numbers, lists and strings, ready for JSON.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.

    Returns
    -------
    dict
        Keys ``verdict``, ``sentences``, ``nominal``, ``n_free``, ``seconds``,
        ``noise_floor_percent``, ``gap_before_percent``, ``gap_after_percent``,
        ``shrinkage_percent``, ``where``, ``causes``, ``accuracy_before``, ``accuracy_after``,
        ``next_observations`` and others; what is not a number is None.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.gap.report import to_dict
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> wavelength = [1.2, 1.3, 1.45, 1.6, 1.9, 2.2] * u.um
    >>> chain = instruments.get("charis").chain(derotator="linear", wavelength=wavelength)
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, wavelength, frames, seed=1)
    >>> content = to_dict(diagnose(chain, data))
    >>> content["verdict"], content["n_free"], content["causes"]
    ('none', 17, [])
    """
    if diagnosis.content is None:
        diagnosis.content = _worked_out(diagnosis)
    return deepcopy(diagnosis.content)


def _worked_out(diagnosis):
    crossed, nominal, improved = bool(diagnosis.held_out), diagnosis.nominal, diagnosis.improved
    # a model with the wrong parity is not worth a fit, and so has no prediction
    exchanged = any(cause.effect.kind == "discrete" for cause in diagnosis.causes)
    misread = any(getattr(cause.effect, "is_of_table", False) for cause in diagnosis.causes)
    same = improved is nominal
    fitted = Fitted(improved)
    before = accuracies(fitted if same else Fitted(nominal), crossed and not exchanged)
    after = before if same else accuracies(fitted, crossed)
    causes = [_cause(diagnosis, i, fitted) for i in range(len(diagnosis.causes))]
    ranks = {cause["name"]: cause["rank"] for cause in causes}
    for cause in causes:
        cause["details"] = _words.details(cause, ranks)
        cause["words"] = _words.cause(cause)
    noisy = diagnosis.remainder_p_value > REMAINDER
    old = nominal.excess
    left = float(np.clip(improved.excess / old, 0, 1)) if old > 0 else 1.0
    scores = ("statistic", "rank", "evidence")
    # as they were given: a part of a run has a name of its own, and is no run
    names = diagnosis.settings.get("names", [o.name for o in improved.observations])
    content = {key: getattr(diagnosis, key) for key in _OWN} | {
        "nominal": _nominal(nominal),
        "n_free": int(nominal.problem.size),
        "n_data": int(nominal.problem.n_data),
        "exchanged": exchanged,
        # the model that an alternative has beaten is not fitted
        "converged": bool(exchanged or nominal.fit.converged),
        "cross_validated": crossed,
        "shrinkage_percent": _shrinkage(diagnosis, exchanged),
        # frames that a misread table pairs are no double difference
        "double_difference": None if misread else _double(fitted, before, after),
        "misread": misread,
        "nested_percent": diagnosis.nested.percent if diagnosis.nested else None,
        "unlisted_probability": diagnosis.settings.get("unlisted"),
        **_frames(diagnosis),
        "where": _where(diagnosis),
        "where_left": [] if same or noisy else [o for part in _located(improved) for o in part],
        "left_share": 0.0 if noisy else left,
        "left_share_limit": improved.hidden_share(nominal),
        "hidden_percent": diagnosis.hidden_percent,
        "causes": causes,
        "changes": runs.changes(diagnosis, causes) if len(names) > 1 else [],
        "scores": [
            _named(one) | {key: getattr(one, key) for key in scores}
            for one in diagnosis.scan.candidates[:_MOST_SCORES]
        ],
        "n_effects": len(diagnosis.scan.candidates),
        "accuracy_before": before,
        "accuracy_after": after,
        "next_observations": plan(diagnosis),
    }
    asked = diagnosis.settings.get("changes", False)
    words = [*_words.sentences(content, len(names) > 1), *runs.paragraph(content, names, asked)]
    words += _scattered(diagnosis) if asked else []
    if misread and causes[0]["probability"] >= 0.5:
        # before all optics, and before what else is not known
        words.insert(0, _words.correct(causes[0]))
    if diagnosis.settings.get("fails") and diagnosis.verdict == "unexplained":
        words.insert(0, _words.fails(diagnosis.settings["fails"]))
    return plain(content | {"sentences": words})


def _scattered(diagnosis):
    """Say what differs between runs where causes do not explain the gap.

    Of errors that all data at a setting share no cause is sure; how residuals scatter is.
    """
    made = diagnosis.nominal.calibration
    told = what_differs(made.calibration()) if diagnosis.verdict == "unexplained" and made else []
    return [f"Measured by how the residuals of all runs scatter, {one}." for one in told]


def _frames(diagnosis):
    """Return the frames that are not what their table says, and what is left out as noise."""
    told = [fault.to_dict() for fault in diagnosis.frames]
    in_tails = [fault for fault in told if fault["what"] == "noise"]
    return {"frames": [fault for fault in told if fault not in in_tails], "in_tails": in_tails}


def _nominal(model):
    """Return the nominal model in words: the optics of each dataset, and what is free."""
    chains = dict.fromkeys(" | ".join(leaf.name for leaf in leaves(c)) for c in model.chains)
    free = ", ".join(slot.name for slot in model.problem.free.slots)
    return f"{'; '.join(chains)}. Free: {free}"


def _where(diagnosis):
    """Return where the gap lies, after what may be it unless one wavelength has nearly all."""
    model = diagnosis.nominal
    alone, rest = _located(model)
    # what is at one wavelength is no perturbation with a law in wavelength
    is_there = alone and diagnosis.verdict == "unexplained"
    excess = max(model.excess, 1e-300)
    # what may be in place of all causes
    courses = [
        {
            "axis": "course",
            "detail": f"{one.words}: {one.shape}" if one.shape else one.words,
            "share": min(one.lowered / excess, 1.0),
            "p_value": one.p_value,
            "kind": "place",
            "cell": {"place": one.place, "kind": one.kind, "dependence": None},
        }
        for one in ([] if is_there else diagnosis.courses)
    ]
    return [*courses, *alone, *rest]


def _located(model):
    """Return where the gap lies: a single wavelength that has nearly all of it, and the rest."""
    nm = [f"{nm:.0f} nm" for nm in 1000 * model.problem.wavelength]
    found = locate(model)
    alone = [one for one in found if one["detail"] in nm and one["share"] > _ALONE]
    return alone, [one for one in found if one not in alone]


def _double(fitted, before, after):
    """Return gap and noise of the double differences, None where there are none."""
    gaps = {"before_percent": before["rms_percent"], "after_percent": after["rms_percent"]}
    if fitted.doubles is None or None in gaps.values():
        return None
    return gaps | {"noise_percent": fitted.double_noise_percent}


def _shrinkage(diagnosis, exchanged):
    """Return by how much the mean square of the gap is lower, with its 68 % interval."""
    value = 100 * (1 - (diagnosis.gap_after_percent / diagnosis.gap_before_percent) ** 2)
    low = high = None
    if len(diagnosis.held_out) > 1 and not exchanged:
        _, low, high = diagnosis.held_out[0].shrinkage(diagnosis.held_out[-1])
    return {"value": value, "low": low, "high": high}


def _cause(diagnosis, i, fitted):
    cause = diagnosis.causes[i]
    before, after = cause.before, cause.after
    if cause.effect.kind == "discrete" and diagnosis.held_out:
        # what an exchanged optic leaves is what the next step begins with
        after = diagnosis.held_out[0]
    entry = {"rank": i + 1, **_named(cause), "cell": _of_cell(cause)}
    entry |= {key: getattr(cause.effect, key) for key in _OF_EFFECT}
    entry |= {key: getattr(cause, key) for key in _OF_CAUSE} | {
        "aliases": [
            _named(one) | {"cell": _of_cell(one), "probability": chance}
            for one, chance in cause.aliases
        ],
        "double_difference_share": fitted.double_share(cause.name),
        "left_out_before_percent": before.percent if before else None,
        "left_out_after_percent": after.percent if after else None,
        "evidence_by_dataset": cause.by_dataset,
        "size": fitted.sizes(cause.name),
        "significance": fitted.significance(cause.name),
        "physical": bool(cause.physical),
        "at_bound": diagnosis.improved.at_bound(cause.name),
    }
    # what can be exchanged for it is asked only where the size is not told: it costs a
    # decomposition
    open_size = not all(_words.has_sizes(entry))
    return entry | {"trades_with": fitted.trades(cause.name) if open_size else []}


def _of_cell(one):
    return one.cell.to_dict() if one.cell else None


def _named(one):
    """Return what a cause or a candidate is called."""
    effect = one.name if one.is_named else None
    return {"name": one.name, "effect": effect, "title": one.effect.title}


# ---- sizes of the causes, and what they do to the data ---------------------------------------


class Fitted:
    """What a model says of the sizes of its effects."""

    def __init__(self, model):
        self.model, self.problem = model, model.problem

    def sizes(self, name):
        """Return the fitted parameters of an added effect, ready for JSON.

        Each is a dictionary of ``value`` and ``std`` (a number, or one per wavelength),
        ``unit``, ``limit``, the largest size that is physical, and ``degree``, that of the
        polynomial in wavelength, None without one. The errors are those of the noise, or of
        the scatter of the residuals where it is larger.
        """
        found = {}
        for parameter in self.model.added.get(name) or ():
            unit, factor = self.unit_of(parameter.name)
            value, std, block = self.values(parameter)
            size = {"value": _number(value / factor), "std": _number(std / factor), "unit": unit}
            size |= {"limit": float(parameter.canonical_limit / factor)}
            degree = block.shape[1] - 1 if self._is_smooth(block) else None
            found[parameter.name] = size | {"degree": degree}
        return found

    def values(self, parameter):
        """Return values and errors of an added parameter, canonical, and the basis of its law."""
        slot, where = self.problem.free.by_name[parameter.name], self.problem.slices[parameter.name]
        block = parameter.basis if slot.per_wavelength else None
        block = np.eye(where.stop - where.start) if block is None else block
        value = self.problem.vector(self.model.fit.coefficients)[slot.slice]
        square = np.einsum("ij,jk,ik->i", block, self.covariance[where, where], block)
        std = np.sqrt(square + np.sum(self.bends[:, slot.slice] ** 2, axis=0))
        # one open coefficient leaves every value of a law open
        return value, np.where(self.is_open[where].any(), np.nan, std), block

    def _is_smooth(self, block):
        """Return whether a law is a polynomial in wavelength that could bend more."""
        law = law_basis(self.problem.wavelength, block.shape[1] - 1)
        is_short = block.shape[1] < len(block) and law.shape == block.shape
        return is_short and np.allclose(law, block)

    @cached_property
    def bends(self):
        """How far free values may be off as laws of causes bend more, root of squares, (n, n_free).

        A bend that the data show too little of to be asked for is more than the errors of a law.
        """
        mine, parts = self.problem, [np.empty((0, self.problem.free.size))]
        added = (p.name for own in self.model.added.values() for p in own)
        known = {key: getattr(mine, key) for key in ("ties", "neutral", "limits")}
        smooth = [n for n in added if n in mine.laws and self._is_smooth(mine.laws[n])]
        # a parameter that has one value for all wavelengths follows no law
        smooth = [n for n in smooth if n in mine.slices and mine.free.by_name[n].per_wavelength]
        if smooth:
            known["laws"] = {n: law for n, law in mine.laws.items() if n not in smooth}
            free = GapProblem(self.model.trains, self.model.observations, like=mine, **known)
            slopes = free.jacobian(free.start)
            parts += [self._bend(n, mine.laws[n], slopes[:, free.slices[n]]) for n in smooth]
        return np.concatenate(parts)

    def _bend(self, name, block, slopes):
        """Return the part of one parameter, of derivatives (n_rows, W) to its values.

        Coefficients of up to two degrees more are some share of the size of its law.
        """
        mine, linear, where = self.problem, self.model.linear, self.problem.free.by_name[name].slice
        value = mine.vector(self.model.fit.coefficients)[where] - mine.neutral.get(name, 0.0)
        size = max(np.mean(value**2), np.finfo(float).tiny / _BENDS[0] ** 2)
        more = law_basis(mine.wavelength, min(block.shape[1] + 1, len(block) - 2))
        more = more[:, block.shape[1] :]
        raw, temper = slopes @ more, max(1.0, self.model.mean_square)
        left = raw - linear.tangent @ (linear.tangent.T @ raw)
        gram, target = left.T @ left / temper, left.T @ linear.residual / temper
        odds, squares = [], []
        for share in _BENDS:
            held = np.eye(len(gram)) / (share**2 * size)
            spread = np.linalg.inv(gram + held)
            middle = spread @ target
            odds.append((target @ middle + np.linalg.slogdet(spread @ held)[1]) / 2)
            squares.append(spread + np.outer(middle, middle))
        square = np.average(squares, axis=0, weights=np.exp(odds - np.max(odds)))
        # the other coefficients give way
        half = self._directions[0]
        off = -mine.spread(raw.T @ self.model.jacobian @ half.T @ half)
        off[:, where] += more.T
        return np.linalg.cholesky(square).T @ off

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
        without[rows] = problem.absent[rows]
        others = np.setdiff1d(np.arange(problem.size), rows)
        lost = problem.residual(without) - problem.residual(full)
        slopes = self.model.jacobian[:, others]
        without[others] += np.linalg.lstsq(slopes, lost, rcond=_TINY)[0]
        without = np.clip(without, problem.low, problem.high)
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
        moved = (self.model.fit.coefficients - self.problem.absent)[rows]
        block = self.covariance[np.ix_(rows, rows)]
        error = np.sqrt(np.diag(block))
        # of unit diagonal, so that units do not matter
        left = moved / error
        inverse = np.linalg.pinv(block / np.outer(error, error), hermitian=True)
        return float(np.sqrt(max(left @ inverse @ left, 0.0)))

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
        return self.problem.numbers(p.name for p in self.model.added[name])

    @cached_property
    def _directions(self):
        """Root of the covariance for unit noise, and directions that data do not determine."""
        singular, right, scale = self.model.decomposed
        good = singular > OPEN * singular[0]
        # covariance = (J^T J)^-1 = V S^-2 V^T, without the open directions
        return right[good] / singular[good, None] / scale, right[~good]

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


def accuracies(fitted, cross_validate=True):
    """
    Return what `calibrate` says of a fitted model, with its causes as found, ready for JSON.

    ``rms_percent`` is the root mean square of the double differences over all data: of left-out
    frames that others foresee, or of the fit where there is no cross-validation. Where such a
    calibration is not possible it is None, and the lists are empty.
    """
    model = fitted.model
    instrument = next((o.instrument for o in model.observations if o.instrument), None)
    found = {
        "observable": default_observable(model.observations),
        "wavelength_nm": _number(1e3 * model.problem.wavelength),
        "rms_percent": None,
        "datasets": [],
        "targets": [],
        "against_prior": None,
        "unusable": [],
    }
    try:
        with warnings.catch_warnings(action="ignore", category=AstropolcalWarning):
            made = model.calibration or _with_causes_held(model, instrument)
            tables = made.accuracies(cross_validate=cross_validate)
            # what is not known of the causes is not known on sky
            seen = with_causes(fitted, instrument) if model.added else made.calibration()
            targets = target_accuracies(seen)
            if not all(np.isfinite(table["s_p"]).all() for table in targets):
                targets = target_accuracies(seen, open_directions="ignore")
    except AstropolcalError:
        return found
    count = np.concatenate([table["n"] for table in tables])
    gap = np.concatenate([table["s_cv" if cross_validate else "s_res"].value for table in tables])
    # what is left out may be all that determines a wavelength
    known = np.isfinite(gap)
    rms = np.sqrt(np.average(gap[known] ** 2, weights=count[known])) if known.any() else None
    return found | {
        "rms_percent": rms,
        "against_prior": seen.fit["against_prior"],
        # what calibrate would say, of which residuals as small as noise tell nothing
        "unusable": faults(seen),
        "datasets": [
            {"name": one.name, "source": one.source}
            | {f"{key}_percent": _median(table[key].value) for key in ACCURACIES}
            for one, table in zip(model.observations, tables, strict=True)
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


def _with_causes_held(model, instrument):
    """Fit the chains of a model with its causes as found, for what the model leaves of the data."""
    added = {p.name for parameters in model.added.values() for p in parameters}
    # and what follows them
    ties = model.problem.ties
    held = sorted(added.union(name for name, tie in ties.items() if tie.source in added))
    ties = {name: tie for name, tie in ties.items() if name not in held}
    chains = [chain.copy() for chain in model.chains]
    table = parameter_table(chains)
    for parameter in (one for name in held for one in table[name]):
        parameter.fixed = True
    measurement, options = Measurement(chains, model.observations, ties=ties), {"observable": None}
    how = {"search": not added, "instrument": instrument, "held": held, "options": options}
    return fit_measurement(measurement, **how)


def with_causes(fitted, instrument=None):
    """Return a fitted model as a calibration, with the errors of its fit of single differences.

    Where these do not tell all of a cause, its components are no larger than is usual, or than the
    largest of them. What is not known of the causes is not known of the other parameters, and on
    sky, either.
    """
    model = fitted.model
    if not model.added:
        made = model.calibration or _with_causes_held(model, instrument)
        told = {"instrument": instrument or made.settings["instrument"]}
        return replace(made, settings=made.settings | told).calibration()
    chains = [chain.copy() for chain in model.chains]
    causes = {p.name: p for own in model.added.values() for p in own}
    for name, parameter in causes.items():
        slot = model.problem.free.by_name[name]
        optic, key = name.split(".")
        value, std, _ = (one / slot.factor for one in fitted.values(parameter))
        # errors of all wavelengths may be one and the same, which priors of each do not know
        std = np.where(std > 0, std * np.sqrt(std.size), parameter.canonical_limit / slot.factor)
        for leaf in (leaf for chain in chains for leaf in leaves(chain) if leaf.name == optic):
            size, own = np.shape(getattr(leaf, key).value), getattr(leaf, key)
            mean, error = (np.reshape(one, size) if size else one.item() for one in (value, std))
            own.prior = Normal(*((one * own.unit if own.unit else one) for one in (mean, error)))
    measurement = Measurement(chains, model.observations, ties=model.problem.ties)
    settings = {"strategy": "diagnosis", "fitter": "diagnose", "gauge": "none"}
    told = {"converged": model.fit.converged, "message": "single differences of all frames"}
    standing = standing_at(measurement, told, tuple(causes), instrument=instrument, **settings)
    return standing.calibration(covariance=_covariance(fitted, measurement.free))


def _covariance(fitted, free):
    """Return the covariance of the parameters of a model with causes."""
    model, problem = fitted.model, fitted.problem
    singular, right, scale = model.decomposed
    known, each = singular > OPEN * singular[0], problem.spread(right / scale)
    sizes = np.sqrt(max(1.0, model.mean_square)) / singular[known, None]
    half = np.concatenate([sizes * each[known], fitted.bends])
    return covariance_along(free, half / free.steps, each[~known] / free.steps)


def _median(values):
    known = values[np.isfinite(values)]
    return float(np.median(known)) if known.size else None


# ---- tables --------------------------------------------------------------------------------


def causes_table(diagnosis):
    """
    Return the causes as a table, one row each.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.

    Returns
    -------
    `~astropy.table.QTable`
        Columns ``rank``, ``effect``, ``place``, ``cannot_be_told_from``, ``probability``,
        ``explained``, ``physical``, ``gap_before`` and ``gap_after`` (percent of
        polarization on left-out frames, NaN where there was no cross-validation).

    Examples
    --------
    >>> from types import SimpleNamespace
    >>> from astropolcal.gap.report import causes_table
    >>> len(causes_table(SimpleNamespace(causes=[])))
    0
    """
    rows = []
    for i, c in enumerate(diagnosis.causes, 1):
        aliases = ", ".join(one.name for one, _ in c.aliases)
        gaps = [np.nan if h is None else h.percent for h in (c.before, c.after)]
        told = (c.effect.place, aliases, c.probability, c.explained, c.physical)
        rows.append((i, c.name, *told, *gaps))
    columns = {"rank": int, "effect": str, "place": str, "cannot_be_told_from": str}
    columns |= {"probability": float, "explained": float, "physical": bool}
    columns |= {"gap_before": float, "gap_after": float}
    how = {"dtype": list(columns.values()), "units": {"gap_before": "%", "gap_after": "%"}}
    return QTable(rows=rows or None, names=list(columns), **how)


# ---- for the terminal ------------------------------------------------------------------------


def summary(diagnosis, written=()):
    """
    Return a diagnosis as text of at most 80 columns.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    written : sequence of path-like
        Files that were written.

    Returns
    -------
    str
        The summary, of at most 24 lines: a few sentences, a table of the causes, what to observe
        next, and what was written. Below it each cause with its sizes, and where the gap lies.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.gap.report import summary
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> wavelength = [1.2, 1.3, 1.45, 1.6, 1.9, 2.2] * u.um
    >>> chain = instruments.get("charis").chain(derotator="linear", wavelength=wavelength)
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, wavelength, frames, seed=1)
    >>> print(summary(diagnose(chain, data)).splitlines()[0])
    The model agrees with the measurements: it lacks nothing that these data show.
    """
    return _words.text(to_dict(diagnosis), _about_frames(diagnosis), written)


# ---- a page ------------------------------------------------------------------------------------


def write_html(diagnosis, path, *, figures=None, size_figures=None):
    """
    Write a diagnosis as one self-contained page.

    Parameters
    ----------
    diagnosis : Diagnosis
        The diagnosis.
    path : path-like
        The file; an existing one is replaced.
    figures : dict of str to `~matplotlib.figure.Figure`, optional
        Figures by caption, such as those of `astropolcal.plotting`. They become part of the page.
    size_figures : dict of str to `~matplotlib.figure.Figure`, optional
        Figures by the name of an effect, shown with that cause.

    Raises
    ------
    GapError
        If the file cannot be written.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.gap import diagnose
    >>> from astropolcal.gap.report import write_html
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> wavelength = [1.2, 1.3, 1.45, 1.6, 1.9, 2.2] * u.um
    >>> chain = instruments.get("charis").chain(derotator="linear", wavelength=wavelength)
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 90] * u.deg)
    >>> data = simulate(chain, wavelength, frames, seed=1)
    >>> write_html(diagnose(chain, data), "gap.html")
    """
    from astropolcal.pipeline.monitoring import write_page

    known = {
        "content": to_dict(diagnosis),
        "datasets": diagnosis.nominal.observations,
        "frames": _about_frames(diagnosis),
        "figures": _images(figures),
        "map_caption": MAP,
        "size_figures": _images(size_figures),
        "words": _words,
        "accuracies": ACCURACIES,
    }
    names = ("number", "percent", "p", "short_share", "in_title")
    filters = {name: getattr(_words, name) for name in names}
    filters |= {"title_of": _words.title, "zip": zip}
    write_page(path, GapError, "astropolcal.gap", "report.html", known, filters)


def _about_frames(diagnosis):
    """Return a line on the frames that are left out, and one on those that calibrate would."""
    masked, used = [], []
    for o in diagnosis.nominal.observations:
        prepared, known = _prepared(o), o.mask_reasons
        new = [why for why, n in prepared.mask_reasons.items() if n > known.get(why, 0)]
        for lines, mask, reasons in ((masked, o.mask, known), (used, prepared.mask & ~o.mask, new)):
            count = int(mask.any(axis=1).sum())
            why = f" ({', '.join(reasons)})" if reasons else ""
            lines += [f"{count} of {len(mask)} frames of {o.name}{why}"] if count else []
    lines = [f"Left out in whole or in part: {_words.listed(masked)}."] if masked else []
    if used:
        lines.append(f"Used here, though calibrate masks them: {_words.listed(used)}.")
    return lines


def _prepared(observations):
    """Return a dataset with the masks with which calibrate would take it."""
    # of no or an unknown instrument, or if nothing would be left: calibrate refuses such a table
    with warnings.catch_warnings(), suppress(AstropolcalError):
        # what is masked is said in our own words
        warnings.simplefilter("ignore", AstropolcalWarning)
        return instruments.get(observations.instrument).prepare(observations)
    return observations


def _images(figures):
    """Return figures as data URIs, wide and narrow, with their width and height in CSS pixels."""
    found = {}
    for name, figure in progress.steps(list((figures or {}).items()), "figures"):
        width, height = (round(_CSS * inches) for inches in figure.get_size_inches())
        source = figure_source(figure, _DPI)
        found[name] = {"width": width, "height": height, "source": source}
        with _narrow(figure):
            found[name]["narrow"] = figure_source(figure, _FINE)
    return found


def figure_source(figure, dpi):
    """Return a figure as part of a page, which has to be one file that can be sent."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi)
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")


@contextmanager
def _narrow(figure):
    """Have the panels of a figure below one another, as wide as a telephone."""
    panels = [axes for axes in figure.axes if axes.get_subplotspec() is not None]
    places = [axes.get_subplotspec() for axes in panels]
    size, title = tuple(figure.get_size_inches()), figure.get_suptitle()
    ticks = [axis.get_tick_params() for axes in panels for axis in (axes.xaxis, axes.yaxis)]
    # names of groups of frames, which stand side by side; those of columns are turned already
    named = [axes for axes in panels if axes.xaxis.get_tick_params().get("length") == 0]
    named = [axes for axes in named if not any(x.get_rotation() for x in axes.get_xticklabels())]
    own = list(dict.fromkeys(places))
    rows = max((place.get_gridspec().nrows for place in own), default=1)
    if len(own) > rows:
        grid = figure.add_gridspec(len(own), 1)
        for axes, place in zip(panels, places, strict=True):
            axes.set_subplotspec(grid[own.index(place)])
            # those that panels side by side share
            axes.tick_params(labelbottom=True, labelleft=True)
    figure.set_size_inches(min(_NARROW, size[0]), size[1] * max(len(own), 1) / rows)
    _title(figure, "\n".join(part for line in title.split("\n") for part in wrap(line, _TITLE)))
    for axes in named:
        axes.tick_params(axis="x", rotation=90)
    try:
        yield
    finally:
        for axes in named:
            axes.tick_params(axis="x", rotation=0)
        for axes, place, x, y in zip(panels, places, ticks[::2], ticks[1::2], strict=True):
            axes.set_subplotspec(place)
            axes.tick_params(labelbottom=x["labelbottom"], labelleft=y["labelleft"])
        figure.set_size_inches(size)
        _title(figure, title)


def _title(figure, text):
    # without one there is no room to be kept for it
    if text:
        figure.suptitle(text)
