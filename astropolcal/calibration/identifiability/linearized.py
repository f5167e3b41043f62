# Licensed under a 3-clause BSD style license - see LICENSE
"""The linear problem around a solution, decomposed once for all who ask, and its directions."""

from collections import defaultdict
from functools import cached_property

import numpy as np

from astropolcal.calibration.identifiability.sky import sky_words
from astropolcal.files import plain
from astropolcal.measurement.parameters import step_of

__all__ = []

# singular values below this share of the largest count as zero
RANK = 1e-9
# and so do those below this: a rounding error, as the error would be 1e12 degrees
_NOTHING = 1e-12
# products of columns tell a column of which others leave more than this share of its square
_CLEAR = 1e-5
# rows of a block of a triangular factorization
_BLOCK = 4096
# a parameter that moves by less than this share along an open direction is static
STILL = 1e-5


class Directions:
    """Singular values, right singular vectors as rows, and the rank."""

    def __init__(self, singular, right, rank):
        self.singular, self.right, self.rank = singular, right, rank
        #: Rows along which nothing changes.
        self.null = right[rank:]
        #: Whether each column is static along all open directions.
        self.determined = (np.abs(self.null) < STILL).all(axis=0)
        #: Determined rows, each as long as its standard error for unit noise.
        self.half = right[:rank] / singular[:rank, None]  # covariance = V S^-2 V^T = half^T half


def decompose(rows):
    """Decompose rows of derivatives, with all right vectors however few rows."""
    n_rows, n_columns = rows.shape
    # null directions need all right vectors; with more rows than columns they are there anyway
    wide = n_rows < n_columns
    try:
        _, singular, right = np.linalg.svd(rows, full_matrices=wide)
    except np.linalg.LinAlgError:
        # a calibration is read where there is no scipy
        from scipy.linalg import svd

        # the quick algorithm of LAPACK fails for a few matrices, the slow one does not
        _, singular, right = svd(rows, full_matrices=wide, lapack_driver="gesvd")
    singular = np.pad(singular, (0, n_columns - singular.size))
    # without data the largest singular value is zero too: nothing is determined then
    threshold = max(RANK * singular.max(initial=0.0), _NOTHING)
    return Directions(singular, right, int(np.sum(singular > threshold)))


def triangle(rows):
    """Return the triangular factor of rows, or the rows themselves where there are few."""
    if len(rows) <= rows.shape[1]:
        return rows
    # factors of blocks that fit into the cache, and their factor
    step = max(_BLOCK, 4 * rows.shape[1])
    parts = [np.linalg.qr(rows[i : i + step], mode="r") for i in range(0, len(rows), step)]
    return parts[0] if len(parts) == 1 else triangle(np.concatenate(parts))


def orthonormal(columns, keep=RANK):
    """
    Return an orthonormal basis, (n_rows, rank), of columns, (n_rows, k), compared at unit length.
    """
    # a calibration is read where there is no scipy
    from scipy.linalg import qr
    from scipy.linalg.lapack import dpstrf, dtrtri

    gram = np.asarray_chkfinite(columns.T @ columns)
    norm = np.sqrt(np.diag(gram))
    if not norm.any():
        return columns[:, :0]
    norm = np.where(norm > 0, norm, 1.0)
    # from the products of what is clearly no sum of other columns
    triangle, order, rank, _ = dpstrf(gram / np.outer(norm, norm), tol=_CLEAR)
    clear, others = np.split(order - 1, [rank])
    steps = np.zeros((norm.size, rank))
    steps[clear] = np.triu(dtrtri(triangle[:rank, :rank])[0]) / norm[clear, None]
    basis = columns @ steps
    if not others.size:
        return basis
    # what is nearly a sum the products do not tell
    rest = columns[:, others] / norm[others]
    rest -= basis @ (basis.T @ rest)
    rest, triangle, _ = qr(rest, mode="economic", pivoting=True)
    rest = rest[:, np.abs(np.diag(triangle)) > keep]
    rest = np.linalg.qr(rest - basis @ (basis.T @ rest))[0]
    return np.concatenate([basis, rest], axis=1)


def inverse_root(products, least):
    """Return what makes columns orthonormal, by their products; small directions are left out."""
    values, vectors = np.linalg.eigh(products)
    good = values > least * values.max(initial=0.0)
    return vectors[:, good] / np.sqrt(values[good])


class Whitened:
    """The linear problem around a solution, in steps of a degree, micrometre or percent.

    ``data`` (n_free, n_data) and ``priors`` (n_free, n_priors) are derivatives in units of the
    noise, ``scale`` the step of each parameter; parameters that are ``held`` count as known.
    """

    def __init__(self, data, scale, priors=None, held=None):
        self.rows, self.scale = (data * scale[:, None]).T, scale
        self.held = np.zeros(scale.size, dtype=bool) if held is None else held
        self.live = np.flatnonzero(~self.held)
        self.prior_rows = np.zeros((0, scale.size))
        if priors is not None:
            self.prior_rows = (priors * scale[:, None]).T

    @cached_property
    def _square(self):
        """The triangular factor: as good as all rows, and much shorter."""
        return triangle(self.rows)

    @cached_property
    def data(self):
        """What the data alone determine."""
        return decompose(self._square)

    @cached_property
    def together(self):
        """What data and priors determine."""
        if not len(self.prior_rows):
            return self.data
        return decompose(np.concatenate([self._square, self.prior_rows]))

    @cached_property
    def errors(self):
        """What data and priors determine of the parameters that are not held; ``live`` columns."""
        if not self.held.any():
            return self.together
        return decompose(np.concatenate([self._square, self.prior_rows])[:, self.live])

    @cached_property
    def slopes(self):
        """Derivatives of the data to the determined directions, each one error long."""
        return self.along(self.rows)

    @cached_property
    def prior_slopes(self):
        """The same of the priors."""
        return self.along(self.prior_rows)

    @cached_property
    def leverage(self):
        """Derivative of each fitted to its observed datum, shape (n_data,)."""
        # diagonal of the hat matrix J (J^T J + P)^-1 J^T
        return np.sum(self.slopes**2, axis=1)

    @cached_property
    def n_taken(self):
        """Degrees of freedom that the parameters take from the data, the sum of the leverages."""
        if not len(self.prior_rows):
            # trace of a projection
            return float(self.errors.rank)
        return float(np.sum(self.along(self._square) ** 2))

    def along(self, rows):
        """Return rows of derivatives along the determined directions, each one error long."""
        return rows[:, self.live] @ self.errors.half.T

    def given_others(self, which):
        """Return which elements are determined, and their `half`, if all but ``which`` are known.

        Both are of all elements, (n_free,) and (rank, n_free), in canonical units.
        """
        columns = np.flatnonzero(which & ~self.held)
        found = decompose(np.concatenate([self._square, self.prior_rows])[:, columns])
        known, half = np.zeros(which.size, dtype=bool), np.zeros((found.rank, which.size))
        known[columns], half[:, columns] = found.determined, found.half * self.scale[columns]
        return known, half

    def factor(self):
        """Return `errors.half` over all columns, zero for what is held, in steps."""
        return self._spread(self.errors.half)

    def null(self):
        """Return the open directions over all columns, zero for what is held, in steps."""
        return self._spread(self.errors.null)

    def _spread(self, rows):
        out = np.zeros((len(rows), self.scale.size))
        out[:, self.live] = rows
        return out

    def covariance(self):
        """Return the canonical covariance for unit noise; NaN for what is held or open."""
        out = np.full((self.scale.size, self.scale.size), np.nan)
        # a pseudo-inverse would give a small number for what is open; it gets none
        known = self.errors.determined
        columns = self.live[known]
        half = self.errors.half[:, known] * self.scale[columns]
        out[np.ix_(columns, columns)] = half.T @ half
        return out


# ---- directions in the space of the parameters, in words ----


# what is worth a word in a direction, as a share of its largest component
_WORTH_A_WORD = 0.02
# where a parameter is that uncertain, an error is no help: degree, micrometre, percent
# (how large a coefficient of a law is tells nothing)
LARGE = defaultdict(lambda: np.inf, {" deg": 5.0, " um": 50.0, "": 0.05})
# and where the data hold one direction so much better than another
_CONDITION = 1e4
# what of a near-null direction is worth a word, as a share of what moves most
_PART = 0.1
# an error that is so many times as large as slopes tell is worth a word
_TOLD = 2.0
# the sky is worked out for so many near-null directions, the worst
_ON_SKY = 6
# open directions that differ in their wavelength only and are told one by one
_MOST_ALIKE = 3
# numbers that differ by less than this share of the largest are equal but for rounding
_EQUAL = 1e-6


def ranked(values, equal=None):
    """Return the indices of values, largest first; equal ones keep their order.

    Which of two that are equal up to rounding comes out larger depends on the processor.
    """
    values = np.asarray(values, dtype=float)
    if equal is None:
        equal = _EQUAL * np.abs(values[np.isfinite(values)]).max(initial=0.0)
    order = np.argsort(-values, kind="stable")
    falling = values[order]
    # two infinities are equal, although their difference is not a number
    with np.errstate(invalid="ignore"):
        smaller = np.diff(falling, prepend=falling[:1]) < -equal
    # by groups of equal ones, and by place within a group
    return order[np.lexsort((order, np.cumsum(smaller)))]


# ---- open directions ----------------------------------------------------------------------


def open_directions(free, null):
    """Rewrite open directions so that each is led by one parameter; say them in words."""
    directions = []
    for vector, lead in led(free, null):
        moved, stem = _moved(free, vector), lead.split("[")[0]
        others = [_change(free, name, value) for name, value in moved.items() if name != stem]
        _, size, unit = step_of(free.by_name[stem].unit)
        words = f"{lead} by +{size:g}{unit} cannot be distinguished from {', '.join(others)}"
        if not others:
            with_prior = any(slot.name == stem and not prior.is_flat for slot, prior in free.priors)
            known = (
                "by them, only its prior tells it" if with_prior else "and keeps its start value"
            )
            words = f"{lead} changes no datum: it cannot be determined {known}"
        directions.append({"words": words, "parameters": plain(moved)})
    return directions


def _moved(free, vector):
    """Return what a direction changes, by parameter, in degree, micrometre or 1."""
    moved, worth = {}, _WORTH_A_WORD * min(1.0, np.abs(vector).max(initial=0.0))
    for slot in free.slots:
        # a parameter per wavelength shows if any of its values moves
        part = vector[slot.slice]
        if np.abs(part).max() > worth:
            size = step_of(slot.unit)[1]
            moved[slot.name] = part[0] * size if slot.size == 1 else part * size
    return moved


def led(free, null):
    """Yield each open direction, led by a parameter that the others do not move.

    Those common to all wavelengths come first.
    """
    several = free.spread([slot.per_wavelength for slot in free.slots])
    order, n_single = np.argsort(several, kind="stable"), int(np.sum(~several))
    columns, leads = null.copy(), []
    while len(leads) < len(null):
        size = np.linalg.norm(columns, axis=0)
        # the first that moves about as much as any: small changes of the data do not reorder
        pool = order[:n_single]
        if size[pool].max(initial=0.0) <= 1e-3:
            pool = order
        lead = next(i for i in pool if size[i] > 0.3 * size[pool].max())
        direction = columns[:, lead] / size[lead]
        # take out what this lead explains, as in a QR decomposition with pivots
        columns -= np.outer(direction, direction @ columns)
        leads.append(int(lead))
    # a basis in which each leading parameter moves by one step in its own direction only
    for vector, lead in zip(np.linalg.solve(null[:, leads], null), leads, strict=True):
        yield vector, free.names[lead]


def first_of_each_kind(directions):
    """Return the words of open directions; of one at each wavelength, of the first few."""
    kinds = {}
    for direction in directions:
        # what leads and what else moves; a lead for all wavelengths has no likes
        lead, bracket, _ = direction["words"].partition("[")
        kind = lead if bracket and " " not in lead else direction["words"]
        key = (kind, *sorted(direction.get("parameters", ())))
        kinds.setdefault(key, []).append(direction["words"])
    words = []
    for alike in kinds.values():
        # a line that counts a single one would be as long as that one
        n = len(alike) if len(alike) <= _MOST_ALIKE + 1 else _MOST_ALIKE
        words += alike[:n]
        words += [f"and {len(alike) - n} more of the same kind"] if n < len(alike) else []
    return words


def _change(free, name, value):
    unit = step_of(free.by_name[name].unit)[2]
    # adding zero turns -0.0 into 0.0
    value = np.round(value, 9) + 0.0
    if np.ndim(value) == 0:
        return f"{name} by {_signed(value, 3)}{unit}"
    low, high = np.min(value), np.max(value)
    return f"{name} by {_signed(low, 3)} to {_signed(high, 3)}{unit} over the wavelengths"


def _signed(value, digits):
    """Return a number with its sign; zero has none."""
    return f"{value:+.{digits}g}" if value else "0"


# ---- near-null directions -----------------------------------------------------------------


def near_null_directions(free, whitened, level, sky_of):
    """Say what data and priors determine so badly that it hardly counts as determined.

    Principal directions of the errors along which some parameter is uncertain by more than `LARGE`,
    or with a singular value 1e4 times smaller than the largest; ``sky_of`` gives what they do on
    sky.
    """
    found = whitened.errors
    # each row is a principal direction, as long as its standard error at the noise of the fit
    singular, errors = found.singular[: found.rank], whitened.factor() * level
    condition = found.singular[:1] / singular
    kinds = (step_of(slot.unit)[1:] for slot in free.slots)
    times_large = np.abs(errors) / free.spread([LARGE[unit] / size for size, unit in kinds])
    bad = (times_large > 1).any(axis=1) | (condition > _CONDITION)
    leads = np.array([ranked(row)[0] for row in times_large], dtype=int)
    # the sign of a singular vector is arbitrary: the worst parameter goes up
    errors = errors * np.sign(errors[np.arange(len(errors)), leads])[:, None]
    worst = [i for i in np.argsort(singular, kind="stable") if bad[i]]
    # each direction costs two evaluations of the whole chain
    changes = errors[worst] * whitened.scale
    skies = sky_of(changes[:_ON_SKY]) if worst else []
    skies += [None] * (len(worst) - len(skies))
    return [
        _near_null(free, leads[i], errors[i], times_large[i], condition[i], sky)
        for i, sky in zip(worst, skies, strict=True)
    ]


def curved_directions(free, vector, valleys, stds, sky_of):
    """Say which errors are far larger than the slopes tell, by parameter.

    ``valleys`` has elements, directions, what of these slopes do not tell, and how far elements may
    fall and rise, ``stds`` the errors from the slopes, in canonical units.
    """
    found = []
    far = [one for one in valleys if abs(one[1][one[0]]) > _TOLD * stds[one[0]]]
    for slot in free.slots:
        own = [one for one in far if slot.start <= one[0] < slot.start + slot.size]
        if not own:
            continue
        worst, *_, limits = max(own, key=lambda one: one[-1][1] - one[-1][0])
        size, unit = step_of(slot.unit)[1:]
        low, high = (vector[worst] + np.array(limits)) / free.steps[worst] * size
        others = f" (and at {len(own) - 1} more wavelengths)" if len(own) > 1 else ""
        words = (
            f"{free.names[worst]} is anywhere from {low:.3g} to {high:.3g}{unit}{others}: other "
            "parameters make up for it, farther than their slopes tell"
        )
        change = np.sum([one[1] for one in own], axis=0)
        entry = {"words": words, "parameters": plain(_moved(free, change / free.steps))}
        sky = sky_of([change])[0]
        found.append(entry if sky is None else entry | {"sky": sky})
    return found


def _near_null(free, lead, error, times_large, condition, sky):
    """Return one direction: words, what it changes at one standard error, and on sky."""
    slot = free.by_name[free.names[lead].split("[")[0]]
    _, size, unit = step_of(slot.unit)
    part = np.abs(error[slot.slice]) * size
    most = part[part > 0.5 * part.max()]
    words = f"{free.names[lead]} is uncertain by {most[0]:.2g}{unit}"
    if most.size > 1:
        words = (
            f"{slot.name} is uncertain by {most.min():.2g} to {most.max():.2g}{unit} at "
            f"{most.size} wavelengths together"
        )
    words += " at the noise of this fit"
    moved = _moved(free, np.where(times_large > _PART * times_large[lead], error, 0.0))
    others = [_change(free, name, value) for name, value in moved.items() if name != slot.name]
    if others:
        words += f", together with {', '.join(others)}"
    if condition > _CONDITION:
        words += f" (condition {condition:.1g})"
    found = {"words": words, "parameters": plain(_moved(free, error))}
    return found if sky is None else found | {"words": f"{words}; {sky_words(sky)}", "sky": sky}
