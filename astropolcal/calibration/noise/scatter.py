# Licensed under a 3-clause BSD style license - see LICENSE
r"""
How residuals scatter and are correlated, and the groups that are left out together.

What a model gets wrong is not independent from datum to datum: neighbouring wavelengths of a pair
of frames depart alike, and so do the pairs at one setting of the derotator. Errors that count all
data as independent are too small then. Here the residuals of each dataset have the covariance

.. math:: V = S \left( \sum_k \tau_k\, C_k \otimes L_k \right) S .

S is the scatter at each wavelength. C is the correlation of pairs of frames: of a pair with itself,
or of the pairs at one setting, where an error of Stokes q and u goes with :math:`\cos 4\theta` and
:math:`\sin 4\theta` of the half-wave plate. L is that of wavelengths: none, over a tenth of their
logarithm, all, or that of the principal components of the errors at the settings. Beside these, a
stage may stand beside the angle of the table at each setting, which moves all pairs and wavelengths
there along the derivative to that angle: what turns q and u says little of their size. Or it does
so at each of its own angles, as a half-wave plate in each cycle. The shares
:math:`\tau` are those for which products of residuals have the values that are found, after what
the fit took away (MINQUE: Rao 1971, J. Multivariate Anal. 1, 257,
doi:10.1016/0047-259X(71)90001-7).
"""

from dataclasses import dataclass

import numpy as np

from astropolcal.chain import leaves
from astropolcal.exceptions import FitError
from astropolcal.observations.grid import clusters, cycle_numbers, is_star, runs_of_frames
from astropolcal.observations.pointings import angle_or_zero
from astropolcal.optics import LinearPolarizer
from astropolcal.words import check_choice

__all__ = []

#: What may make a group, and what groups of it are called.
GROUPS = {
    "derotator": "derotator angles",
    "cycle": "half-wave-plate cycles",
    "dataset": "datasets",
}
# runs into which the cycles of a star are divided
_RUNS = 8


def leave_out_groups(measurement, by="derotator"):
    """Return the group of each datum for cross-validation, numbered from 0: see `GROUPS`.

    By default its derotator angle, per dataset. On sky the derotator turns slowly, so there, and
    without one, a group is one of eight runs of consecutive cycles of the half-wave plate, or one
    cycle where there are fewer. A cycle is the column ``cycle`` of the frames where there is one;
    otherwise it ends where a plate angle (of one state of a modulator) comes again or the derotator
    moves. The plus frame of a datum counts. By "pair" each group of frames is its own.
    """
    groups, first = [], 0
    for dataset in measurement.datasets:
        plus, table = dataset.frames[:, 0], dataset.observations
        turns = "derotator" in table.frame_columns and "parallactic" not in dataset.positions
        if by == "dataset":
            number = np.zeros(len(plus), dtype=int)
        elif by == "pair":
            number = np.arange(len(plus))
        elif by == "derotator" and turns:
            number = clusters(table.position("derotator")[plus], turn=np.pi)
        else:
            number = np.unique(cycle_numbers(table)[plus], return_inverse=True)[1]
            if by == "derotator":
                count = int(number.max()) + 1
                number = runs_of_frames(count, min(_RUNS, count))[number]
        # groups of different datasets never share a number
        groups.append(first + number[dataset.group_of_datum])
        first += int(number.max()) + 1
    return np.concatenate(groups)


def groups_by(measurement, by="derotator"):
    """Return the same by "derotator", "cycle" or "dataset"; refuse a group of a single member."""
    check_choice("groups", by, GROUPS, FitError)
    groups, found = leave_out_groups(measurement, by), []
    for i, (part, where) in enumerate(zip(measurement.datasets, measurement.segments, strict=True)):
        angle = np.rad2deg(angle_or_zero(part.observations, "derotator"))[part.frames[:, 0]]
        for k, label in enumerate(np.unique(groups[where])):
            rows = groups[where] == label
            what = f"number {i if by == 'dataset' else k}"
            if by == "derotator":
                what = f"{angle[part.group_of_datum[rows][0]]:g} deg"
            most = int(np.bincount(measurement.bins[where][rows]).max())
            found.append((f"{by} {what} of {part.observations.name}", most))
    if len(found) < 2:
        raise FitError(f"cross-validation by {by}: all data are in one group, {found[0][0]}")
    for name, most in found:
        if most < 2:
            raise FitError(
                f"cross-validation by {by}: group {name} has a single member; at least 2 data per "
                "wavelength are needed, group by something else or leave it out"
            )
    return groups


def what_is_left_out(calibration):
    """Return what the cross-validation of a calibration has left out, in words."""
    return GROUPS.get(calibration.fit.get("groups", "derotator"), "groups")


# ---- how residuals scatter and hang together, and what this does to the errors ----


# over which misfits of neighbouring wavelengths hang together, in the logarithm of the wavelength:
# the correlation falls to 0.7 from one bin of CHARIS to the next, as it does in Datasets 1 and 3
_LENGTH = 0.1
# no wavelength counts as less noisy than this share of the median of its dataset
_FLOOR = 0.1
# fewer degrees of freedom than this tell no scatter
_LEAST_FREEDOM = 1.0
# fewer settings do not tell an error of theirs from the parameters
_FEWEST_SETTINGS = 3
# errors that rest on n settings, of the derotator for example, are by chance too small where
# runs seem to differ: their variance counts 1 + 8/n times there. Of 44 series of 7 equal runs with
# stages that stop beside the table's angle at each of 4 to 14 settings, 7 were said to change
# without it, all with 4 settings, and 4 are
_BY_CHANCE = 8.0
# shares below so many times their error under independence count as chance; those of stages, which
# have few angles, below what independent data exceed with this probability: of 180 runs without
# errors of stages 2 had a share, of 40 of IRDIS with five degrees of freedom 5 at most, and of 120
# of IRDIS with a wrong plate 79
_CHANCE, _BY_LUCK = 2.0, 0.01
# share of the scatter that is independent from datum to datum at the least
_INDEPENDENT = 0.05
# and principal components of the errors at settings below so many times what they have by chance
_MORE = 1.5
# columns of derivatives that are worked on at once
_COLUMNS = 16
# a part of which the fit leaves less than this share is not seen in the residuals
_LEFT = 0.05


@dataclass(eq=False)
class _Part:
    """Residuals of one dataset: where they are among pairs and wavelengths, and their scatter."""

    rows: slice
    pair: np.ndarray
    bin: np.ndarray
    patterns: np.ndarray
    kernels: tuple
    amplitude: np.ndarray
    #: Which pair is at which setting, (n_pairs, n_settings).
    member: np.ndarray
    #: How the angle of a stage shows in the pairs at wavelengths, of mean square one, and which
    #: pairs have the same error of it, (n_pairs, n_angles).
    stages: tuple = ()
    shares: np.ndarray = None
    #: Degrees of freedom from which each share is known.
    freedom: np.ndarray = None
    #: Which components residuals can tell at all.
    told: np.ndarray = None

    def dense(self, columns):
        """Return columns as an array of pairs, wavelengths and columns; masked data are zero."""
        out = np.zeros((len(self.patterns), len(self.kernels[0]), columns.shape[1]))
        out[self.pair, self.bin] = columns
        return out

    def components(self):
        """Yield whether pairs of a setting are correlated, and the correlation of wavelengths."""
        yield from ((False, kernel) for kernel in self.kernels)
        if self.patterns.shape[1]:
            yield from ((True, kernel) for kernel in self.kernels[1:])

    def halves(self, columns):
        """Return, for each component, columns before and after its matrix, to be multiplied."""
        dense = self.dense(columns)
        seen = np.tensordot(self.patterns, dense, axes=(0, 0))
        for together, kernel in self.components():
            before = seen if together else dense
            yield before, kernel @ before
        for stage, member in self.stages:
            off = member.T @ np.einsum("pw,pwk->pk", stage, dense)
            yield off[None], off[None]

    def applied(self, columns):
        """Return the matrix of each component times columns."""
        halves = self.halves(columns)
        for (together, _), (_, behind) in zip(self.components(), halves, strict=False):
            if together:
                behind = np.tensordot(self.patterns, behind, axes=(1, 0))
            yield behind[self.pair, self.bin]
        for (stage, member), (off, _) in zip(self.stages, halves, strict=True):
            yield stage[self.pair, self.bin, None] * (member @ off[0])[self.pair]

    def overlaps(self):
        """Return the traces of the products of two components, shape (n, n)."""
        present = self.dense(np.ones((len(self.pair), 1)))[..., 0]
        alone, diagonal = present.T @ present, np.sum(self.patterns**2, axis=1)
        mixed = present.T @ (diagonal[:, None] * present)
        # the square of the correlation of the pairs at a setting: q with q, u with u, and q with u
        q, u = self.patterns[:, 0::2], self.patterns[:, 1::2]
        crossed = np.hstack([q * q, u * u, np.sqrt(2) * q * u]).T @ present
        both, parts = crossed.T @ crossed, list(self.components())
        pairs = {(True, True): both, (False, False): alone}
        n = len(parts)
        found = np.zeros((n + len(self.stages),) * 2)
        found[:n, :n] = [
            [np.sum(k * m * pairs.get((a, b), mixed)) for b, m in parts] for a, k in parts
        ]
        for j, (stage, member) in enumerate(self.stages, n):
            # of what moves all data at a setting along one direction
            off = stage[self.pair, self.bin, None] * member[self.pair]
            found[j] = found[:, j] = [np.vdot(off, one) for one in self.applied(off)]
        return found

    def freedom_of(self, wanted, up, down):
        """Return how many degrees of freedom tell what pairs share, after a fit with such slopes.

        Of sums of squares of H z with independent z (Satterthwaite 1946, Biometrics Bull. 2, 110,
        doi:10.2307/3002019); H is what the fit leaves of a component. Infinite of all others.
        """
        found, kernels = np.full(len(wanted), np.inf), [kernel for _, kernel in self.components()]
        halves = zip(self.halves(down), self.halves(up), strict=True)
        for k, ((a, _), (b, _)) in enumerate(halves):
            if not wanted[k]:
                continue
            if k < len(kernels):
                sizes, root = np.linalg.eigh(kernels[k])
                root = root * np.sqrt(sizes.clip(0))
                left = np.kron(self.patterns.T @ self.patterns, np.diag(sizes.clip(0)))
            else:
                stage, member = self.stages[k - len(kernels)]
                left, root = np.diag(member.T @ np.sum(stage**2, axis=1)), np.eye(member.shape[1])
            a, b = (np.einsum("pwk,wl->plk", x, root).reshape(len(left), -1) for x in (a, b))
            left = left - a @ b.T
            square = left.T @ left
            found[k] = max(np.trace(square) ** 2 / max(np.sum(square**2), 1e-300), 1.0)
        return found


class Scatter:
    """Covariance of the residuals of a fit; of the weighting only its pattern counts."""

    @classmethod
    def of(cls, *problem):
        """Return it where the residuals of all datasets tell how they scatter, else None."""
        found = cls(*problem)
        told = (found._level, *(part.amplitude for part in found.parts))
        return found if all(np.isfinite(one).all() for one in told) else None

    def __init__(self, measurement, weighting, whitened, beside=None):
        """Start; ``beside`` is a direction of the data, of length one, that is fitted as well."""
        self.measurement = measurement
        weight = 1.0 if weighting.weight is None else weighting.weight
        self._level = 1.0 / weight * np.ones(measurement.n_data)
        residuals = measurement.residuals() * weight
        leverage = whitened.leverage
        #: Derivatives of the data to the determined directions, each one standard error long.
        self.slopes = whitened.slopes
        if beside is not None:
            residuals = residuals - beside * (beside @ residuals)
            leverage = leverage + beside**2
            self.slopes = np.column_stack([self.slopes, beside])
        groups = leave_out_groups(measurement)
        self.parts = [
            self._part(i, groups, residuals, leverage) for i in range(len(measurement.datasets))
        ]
        for part in self.parts:
            part.shares = self._shares(part, residuals[part.rows])

    def _part(self, i, groups, residuals, leverage):
        dataset, rows = self.measurement.datasets[i], self.measurement.segments[i]
        bins, group = self.measurement.bins[rows], groups[rows]
        log = np.log(self.measurement.wavelength)
        distance = np.abs(log[:, None] - log)
        member = _members(dataset, group - group.min())
        part = _Part(
            rows,
            dataset.group_of_datum,
            bins,
            _patterns(dataset, member),
            (np.eye(log.size), np.exp(-distance / _LENGTH), np.ones_like(distance)),
            _amplitude(bins, residuals[rows], 1 - leverage[rows]),
            member,
        )
        part.stages = tuple(self._stages(part, i))
        scaled = residuals[rows] / part.amplitude
        if part.patterns.shape[1] and np.isfinite(scaled).all():
            # q and u of the residuals at each setting, (2 n_settings, n_wavelengths)
            errors = part.patterns.T @ part.dense(scaled[:, None])[..., 0]
            seen = np.sqrt(np.sum(part.patterns**2, axis=0))[:, None]
            # of one plate angle q or u may not show at all
            errors = np.divide(errors, seen, out=np.zeros_like(errors), where=seen > 0)
            part.kernels += _correlation(errors)
            size = np.repeat(np.sum(errors**2, axis=1).reshape(-1, 2).sum(axis=1), 2)
            part.patterns = part.patterns * np.sqrt(0.5 + 0.5 * size / max(size.mean(), 1e-300))
        return part

    def _stages(self, part, i):
        """Yield how a wrong angle of each stage shows, at each setting and at each of its own."""
        dataset, measurement = self.measurement.datasets[i], self.measurement
        sweep, table = dataset.forward(measurement.vector()), dataset.observations
        for stage in dataset.positions:
            slope = dataset.along_stage(measurement.chains[i], sweep, stage)
            slope = slope / (self._level[part.rows] * part.amplitude)
            size = np.sqrt(np.mean(slope**2))
            if not (size > 0 and np.isfinite(size)):
                continue
            slope = part.dense(slope[:, None] / size)[..., 0]
            if part.member.shape[1]:
                yield slope, part.member
            if stage in table.frame_columns:
                own = clusters(table.position(stage)[dataset.frames[:, 0]], turn=2 * np.pi)
                own = own[:, None] == np.arange(own.max() + 1)
                # angles that come again at other settings
                again = (own.T @ part.member.astype(int) > 0).sum(axis=1) > 1
                if own.shape[1] >= _FEWEST_SETTINGS and np.mean(again) > 0.5:
                    yield slope, own

    def _shares(self, part, residuals):
        """Solve for the shares with which products of residuals are as large as they are."""
        # a calibration is read where there is no scipy
        from scipy.special import betaincinv

        scaled = (residuals / part.amplitude)[:, None]
        found = np.array([np.sum(a * b) for a, b in part.halves(scaled)])
        slopes = self.slopes[part.rows]
        up, down = slopes * part.amplitude[:, None], slopes / part.amplitude[:, None]
        # what a component of the scatter (columns) adds to a product of residuals (rows):
        # tr(A M B M) with M = 1 - U U^T, the residuals of a fit
        full = part.overlaps()
        n, rank = len(full), slopes.shape[1]
        seen, inner = full.copy(), np.empty((rank, 2 * n, rank))
        for i in range(0, rank, _COLUMNS):
            # a few columns at a time: all components of all of them need not be held at once
            some = slice(i, i + _COLUMNS)
            before = [matrix / part.amplitude[:, None] for matrix in part.applied(down[:, some])]
            behind = [matrix * part.amplitude[:, None] for matrix in part.applied(up[:, some])]
            seen -= 2 * np.array([[np.vdot(a, b) for b in behind] for a in before])
            product = slopes.T @ np.concatenate([*before, *behind], axis=1)
            inner[:, :, some] = product.reshape(rank, 2 * n, -1)
        seen += np.einsum("iaj,jbi->ab", inner[:, :n], inner[:, n:], optimize=True)
        size = np.diag(full)
        told = part.told = np.diag(seen) > _LEFT * size
        number = np.arange(n)
        stages = number >= n - len(part.stages)
        part.freedom = part.freedom_of(stages, up, down)
        if not np.isfinite(seen).all():
            return np.eye(n)[0]
        shares = _solved(seen, found, told)
        # a share that independent data have by chance, and that cannot be negative, would make all
        # errors too large; the variance of a product of residuals is twice its trace
        chance = np.sqrt(2 / np.maximum(np.diag(seen), 1.0)) * shares.sum()
        chance[~stages] *= _CHANCE
        # of independent data the share of few in the sum of squares has a beta distribution
        few, spare = part.freedom[stages], max(len(residuals) - np.sum(slopes**2), 1.0)
        most = spare * betaincinv(few / 2, np.maximum(spare - few, 1.0) / 2, 1 - _BY_LUCK)
        chance[stages] *= (most - few) / np.sqrt(2 * few)
        chance[0] = 0.0
        shares = _solved(seen, found, told & (shares >= chance))
        # some of it always is independent, and all of it where nothing is told
        shares[0] = max(shares[0], _INDEPENDENT if shares.any() else 1.0)
        others = (shares > 0) & (number >= len(part.kernels)) & ~stages
        part.freedom = np.minimum(part.freedom, part.freedom_of(others, up, down))
        return shares

    def middle(self, slopes):
        """Return the covariance of the pulls of the residuals on directions, (n_data, n)."""
        total = np.zeros((slopes.shape[1],) * 2)
        for part in self.parts:
            scaled = slopes[part.rows] * part.amplitude[:, None]
            for share, (before, behind) in zip(part.shares, part.halves(scaled), strict=True):
                if share:
                    total += share * np.tensordot(before, behind, axes=((0, 1), (0, 1)))
        # a product of two arrays is symmetric to rounding only
        return (total + total.T) / 2

    def freedom(self, slopes, variances):
        """Return from how many degrees of freedom the variances of pulls on directions are known.

        Satterthwaite (1946, Biometrics Bull. 2, 110, doi:10.2307/3002019).
        """
        spread = np.zeros(slopes.shape[1])
        for part in self.parts:
            scaled = slopes[part.rows] * part.amplitude[:, None]
            halves = zip(part.shares, part.freedom, part.halves(scaled), strict=True)
            for share, freedom, (before, behind) in halves:
                if share:
                    spread += (share * np.sum(before * behind, axis=(0, 1))) ** 2 / freedom
        return variances**2 / np.maximum(spread, 1e-300)

    def at_settings(self, i):
        """Return the error of q and u that all pairs at a setting share, per wavelength.

        NaN where the dataset has no data, and where its settings do not tell such an error.
        """
        part = self.parts[i]
        found = np.full(len(part.kernels[0]), np.nan)
        known = [np.diag(kernel) if together else None for together, kernel in part.components()]
        present = part.dense(np.ones((len(part.bin), 1)))[..., 0].sum(axis=0)
        known += [np.sum(stage**2, axis=0) / np.maximum(present, 1) for stage, _ in part.stages]
        known = list(zip(part.shares, part.told, known, strict=True))
        if not any(told for _, told, size in known if size is not None):
            return found
        variance = sum(share * size for share, _, size in known if size is not None)
        found[part.bin] = np.sqrt(variance)[part.bin] * part.amplitude * self._level[part.rows]
        return found


def _correlation(errors):
    """Return the correlation of wavelengths that the errors at the settings have, if there is one.

    Of principal components with more variance than independent wavelengths would have by chance
    (Marchenko & Pastur 1967).
    """
    count, size = errors.shape
    _, singular, shapes = np.linalg.svd(errors, full_matrices=False)
    share = singular**2 / max(np.sum(singular**2), 1e-300)
    chance = (np.sqrt(count) + np.sqrt(size)) ** 2 / (count * size)
    shapes = shapes[share > _MORE * chance] * singular[share > _MORE * chance, None]
    kernel = shapes.T @ shapes
    return (kernel * size / np.trace(kernel),) if len(shapes) else ()


def _solved(seen, found, taken):
    """Return the shares of the components that are taken, none negative."""
    from scipy.optimize import nnls

    shares, norm = np.zeros(len(found)), np.sqrt(np.diag(seen)[taken])
    if taken.any():
        shares[taken] = nnls(seen[np.ix_(taken, taken)] / norm[:, None], found[taken] / norm)[0]
    return shares


def _members(dataset, group):
    """Return which pair is at which setting, (n_pairs, n_groups); none where groups are few."""
    count = int(group.max()) + 1
    of_pair = np.zeros(len(dataset.frames), dtype=int)
    of_pair[dataset.group_of_datum] = group
    return of_pair[:, None] == np.arange(count if count >= _FEWEST_SETTINGS else 0)


def _patterns(dataset, member):
    """Return how an error of q and u at each setting shows in the pairs, (n_pairs, 2 n_groups)."""
    plate = dataset.positions.get("hwp")
    angle = np.zeros(len(member)) if plate is None else 4 * plate[0]
    out = np.empty((len(member), 2 * member.shape[1]))
    # q and u of each setting next to each other
    out[:, 0::2], out[:, 1::2] = member * np.cos(angle)[:, None], member * np.sin(angle)[:, None]
    return out


def _amplitude(bins, residuals, spare):
    """Return the rms of the residuals at the wavelength of each, for the freedom left there."""
    total, freedom = np.sum(residuals**2), spare.sum()
    whole = np.sqrt(total / freedom) if freedom >= _LEAST_FREEDOM else np.nan
    left = np.bincount(bins, spare)
    told = left >= _LEAST_FREEDOM
    rms = np.sqrt(np.bincount(bins, residuals**2) / np.where(told, left, 1.0))
    levels = np.where(told, rms, whole)
    least = _FLOOR * np.median(levels[np.unique(bins)])
    return np.maximum(levels, least)[bins] if total > 0 else np.full(len(bins), np.nan)


def model_error(measurement, scatter, signs):
    """Return the error of the model at a setting that it has not seen, for `Calibration.fit`.

    ``relative_percent`` multiplies the polarization, from polarized sources; ``absolute_percent``
    does not, from all others. Standard errors of q and u per wavelength; zero, and in ``missing``,
    where none tells. ``settings`` is the least number of them that tells one, if there is one.
    ``sign_relative_percent`` and ``sign_absolute_percent`` are those of signs that the data do not
    tell, whose mean squares are ``signs``, where there are such.
    """
    squares, settings = {"relative": [], "absolute": []}, []
    if scatter is None and not signs.any():
        return None
    for i, dataset in enumerate(() if scatter is None else measurement.datasets):
        polarized = kind_of_source(dataset.observations.source) == "polarized"
        square = scatter.at_settings(i) ** 2
        squares["relative" if polarized else "absolute"].append(square)
        if np.nansum(square) > 0:
            settings.append(scatter.parts[i].patterns.shape[1] // 2)
    found = {"wavelength_nm": (1e3 * measurement.wavelength).tolist(), "missing": []}
    for key, rows in squares.items():
        rows = np.reshape(rows, (-1, measurement.wavelength.size))
        count, total = np.isfinite(rows).sum(axis=0), np.nansum(rows, axis=0)
        found[f"{key}_percent"] = (100 * np.sqrt(total / np.maximum(count, 1))).tolist()
        if not count.any():
            found["missing"].append(key)
    if signs.any():
        keys = (f"sign_{key}_percent" for key in squares)
        found |= zip(keys, (100 * np.sqrt(signs)).tolist(), strict=True)
    return found | ({"settings": min(settings)} if settings else {})


def by_chance(settings):
    """Return by how much errors that rest on so many settings count as larger; on None, by none."""
    return 1.0 if settings is None else np.sqrt(1 + _BY_CHANCE / settings)


def kind_of_source(source, chain=None):
    """Return "polarized", "unpolarized" or "star", from the words of a table.

    A table that does not say it is of polarized light, unless its ``chain`` begins without a
    polarizer: then None.
    """
    if is_star(source):
        return "star"
    words = (source or "").lower()
    if "unpolarized" in words:
        return "unpolarized"
    told = "polarized" in words or chain is None or isinstance(leaves(chain)[0], LinearPolarizer)
    return "polarized" if told else None


BLOCKS = ("derotator", "pair")


def labels_of(measurement, block):
    """Return the number of the block of each datum; datasets have their own blocks."""
    check_choice("block", block, BLOCKS, FitError)
    return leave_out_groups(measurement, block)


def labels_as_given(measurement, groups):
    """Return the labels of the groups of data, of which a user gives one per datum."""
    labels = np.asarray(groups)
    if labels.shape != (measurement.n_data,):
        raise FitError(
            f"groups of shape {labels.shape}; allowed is ({measurement.n_data},), one per datum"
        )
    return labels
