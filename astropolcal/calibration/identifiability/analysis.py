# Licensed under a 3-clause BSD style license - see LICENSE
"""
What the data determine: rank, null directions in words, honest errors.

A parameter is *identifiable* if no combination of parameters that leaves all data unchanged moves
it. An error is given for identifiable parameters only: a pseudo-inverse would return a small and
wrong number for the others.

Discrete mirror solutions: each candidate is tried on the measurement and counts only if it predicts
the same data and stays within the bounds. What the bounds, or the model of an optic, exclude may be
the truth all the same: it is reported where it matters on sky.

Harmonics of the half-wave plate: a perfect plate puts the polarization into harmonic 4 of its
angle, an imperfect one also into 2, and a wedge or dust into 1. Angles from 0 to 78.75 deg cover
one period of harmonic 4 only: there the others look alike.
"""

import re
from dataclasses import dataclass, field
from functools import lru_cache

import astropy.units as u
import numpy as np

from astropolcal import standards
from astropolcal.calibration.identifiability.linearized import (
    Whitened,
    first_of_each_kind,
    led,
    near_null_directions,
    open_directions,
)
from astropolcal.calibration.identifiability.sky import (
    LEFT_OUT,
    consequences_along,
    consequences_of,
    matters,
    seen_with,
    sky_words,
    view_of_measurement,
)
from astropolcal.calibration.system import split_chain
from astropolcal.chain import join, leaves, stages, standing, system_mueller
from astropolcal.instruments.base import without_nuisance
from astropolcal.optics import (
    DiattenuatorRetarder,
    EllipticalRetarder,
    LinearRetarder,
    MuellerElement,
    Rotator,
)

__all__ = ["examine"]

# a direction that is a parameter of its own is that parameter by all but this
_OWN = 1e-9
# a direction whose step turns the AoLP by more, in degree, is one for a polarized star
_TURNS = 0.1


@dataclass
class Identifiability:
    """
    Rank of a calibration and what it leaves undetermined.

    Parameters
    ----------
    names : list of str
        Names of the free parameters, one an element of the flat vector.
    rank : int
        Rank of the Jacobian.
    singular_values : `~numpy.ndarray`
        With columns scaled to a degree, a micrometre or a percent.
    null_vectors : `~numpy.ndarray`
        Shape (n_free - rank, n_free), in degree, micrometre or percent.
    identifiable : `~numpy.ndarray`
        Whether each parameter is determined, shape (n_free,).
    directions : list of dict
        For each null direction its ``words``, the ``parameters`` that move, and
        what it does to the ``sky``: changes of AoLP and DoLP of ``targets``.
    sampling : list of str
        Harmonics that the half-wave-plate angles cannot separate, and what stars do not determine
        of the telescope.
    mirrors : list of str
        Discrete mirror solutions within the bounds; and the other hand of the whole instrument,
        which bounds may exclude but no datum does, where it matters on sky. Of a calibration also
        signs of retardances that the data hardly tell.
    near_null : list of dict
        Directions that are determined so badly that it hardly counts: at the noise of the fit some
        parameter is uncertain by more than 5 deg, 0.05 mm or 5 %, or the singular value is more
        than 1e4 times below the largest. ``words``, the ``parameters`` with their change at one
        standard error, and what that is on ``sky`` for the worst six. Priors count as data here.
        Of a calibration also parameters whose errors are far larger than slopes tell.
    branches : list of dict
        Of each of ``mirrors`` the ``words``, and what it does on ``sky``, or None.

    Examples
    --------
    >>> from astropolcal.calibration.identifiability.analysis import Identifiability
    >>> import numpy as np
    >>> Identifiability(["a.theta"], 1, np.ones(1), np.zeros((0, 1)), np.ones(1, bool)).n_free
    1
    """

    names: list
    rank: int
    singular_values: np.ndarray
    null_vectors: np.ndarray
    identifiable: np.ndarray
    directions: list = field(default_factory=list)
    sampling: list = field(default_factory=list)
    mirrors: list = field(default_factory=list)
    near_null: list = field(default_factory=list)
    branches: list = field(default_factory=list)

    @property
    def n_free(self):
        """Number of free parameters."""
        return len(self.names)

    @property
    def silent(self):
        """Names of the parameters that change no datum; a fit leaves them where they start."""
        # length of each axis within the null space: 1 if the axis lies in it
        own = np.sum(np.reshape(self.null_vectors, (-1, self.n_free)) ** 2, axis=0)
        return [self.names[i] for i in np.flatnonzero(own > 1 - _OWN)]

    def __str__(self):
        lines = [f"The data determine {self.rank} combinations of {self.n_free} free parameters."]
        lines += [f"  - {words}" for words in first_of_each_kind(self.directions)]
        lines += [f"  - badly determined: {direction['words']}" for direction in self.near_null]
        lines += [f"  - {words}" for words in self.sampling]
        lines += [f"  - mirror solution: {words}" for words in self.mirrors]
        return "\n".join(lines)


def finding_of(free, whitened):
    """Return what the data alone determine, of a problem that is decomposed once."""
    found = whitened.data
    return Identifiability(
        names=free.names,
        rank=found.rank,
        singular_values=found.singular,
        null_vectors=found.null,
        # at a bound there is no error either, though the data may well push against it
        identifiable=found.determined & ~whitened.held,
        directions=open_directions(free, found.null),
    )


def examine(measurement, weights=None):
    """
    Say what a measurement can determine, before anything is fitted.

    Parameters
    ----------
    measurement : Measurement
        Chains and observations; the current values count, so give plausible ones.
    weights : `~numpy.ndarray`, optional
        One over the noise of each datum, shape (n_data,). With it the finding
        tells also what will be determined badly.

    Returns
    -------
    ``Identifiability``
        As in the result of a fit.

    Examples
    --------
    Before a run is taken, on simulated frames:

    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import examine
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.published()
    >>> frames = half_wave_plate_cycles(derotator=[45, 60, 80] * u.deg)
    >>> planned = simulate(chain, charis.wavelength, frames, noise=False)
    >>> finding = examine(Measurement(chain, planned))
    >>> finding.rank, finding.n_free
    (91, 93)
    """
    vector, free = measurement.vector(), measurement.free
    data = measurement.jacobian(vector) * (1.0 if weights is None else weights)
    whitened = Whitened(data, free.steps, free.prior_jacobian(vector, for_errors=True))
    level = np.nan if weights is None else 1.0
    name = measurement.datasets[0].observations.instrument
    view = view_of_measurement(measurement, vector, name)
    return complete(measurement, whitened, level, view)


def complete(measurement, whitened, level, view):
    """Return the finding with what it means on sky, the sampling and the mirror solutions.

    The problem ``whitened`` around the present values gives the directions that are badly
    determined for the noise ``level`` of a datum of weight one, if that is known.
    """
    free, vector = measurement.free, measurement.vector()
    finding = finding_of(free, whitened)
    scaled = [direction for direction, _ in led(free, finding.null_vectors)]
    # one degree, micrometre or percent of the leading parameter
    canonical = np.array(scaled).reshape(-1, free.size) * free.steps
    for direction, sky in zip(finding.directions, consequences_along(view, canonical), strict=True):
        if sky is not None:
            direction["sky"] = sky
            direction["words"] += f"; {sky_words(sky)}"
    if np.isfinite(level):
        finding.near_null = near_null_directions(
            free, whitened, level, lambda changes: consequences_along(view, changes)
        )
    tables = [dataset.observations for dataset in measurement.datasets]
    angles = [table.position("hwp") for table in tables if "hwp" in table.frame_columns]
    finding.sampling = harmonic_words(np.concatenate(angles)) if angles else []
    finding.sampling += telescope_words(finding, measurement)
    # open directions that a star of known polarization would close
    leads = [
        re.split(" by | changes ", direction["words"])[0]
        for direction in finding.directions
        if "sky" in direction and max(map(abs, direction["sky"]["aolp_deg"])) > _TURNS
    ]
    if leads and view.telescope != LEFT_OUT:
        star = star_words(view.site)
        finding.sampling.append(f"{', '.join(leads)}: {star} determines the angle on sky")
    finding.branches = mirror_branches(measurement, vector, view)
    finding.mirrors = [branch["words"] for branch in finding.branches]
    return finding


# ---- what stars leave open of the telescope's mirrors, and what would determine it ----


def telescope_words(finding, measurement):
    """Say which parameters of mirrors upstream of the half-wave plate stars do not determine."""
    free = measurement.free
    found = (*finding.directions, *finding.near_null)
    moving = {name for direction in found for name in direction["parameters"]}
    # what ran to a bound is as open as what drifts
    moving |= {free.names[i] for i in np.flatnonzero(free.at_bounds(measurement.vector()))}
    words, mirrors = [], set()
    for train in map(leaves, measurement.chains):
        places = [leaf.stage for leaf in train]
        # the plate ends the telescope, or where there is none its last axis
        last = next((s for s in ("hwp", "altitude") if s in places), None)
        if "parallactic" in places and last is not None:
            inner = train[places.index("parallactic") + 1 : places.index(last)]
            mirrors |= {leaf.name for leaf in inner if not isinstance(leaf, Rotator)}
    for mirror in sorted(mirrors):
        # what its orientation turns with is said of the directions
        own = sorted(n for n in moving if n.startswith(f"{mirror}.") and n != f"{mirror}.theta")
        if own:
            words.append(
                f"{', '.join(own)}: an unpolarized star shows the diattenuation of {mirror} and "
                "nothing else, at any altitude; a star of known polarization over a wide range of "
                "parallactic angle adds the retardance, a measured film or index (a prior) the rest"
            )
    return words


# ---- ambiguities ---------------------------------------------------------------------------


# a star that culminates lower has little range of parallactic angle, and much air in front
_LOW = 45.0
_EQUATOR = 60.0


def star_words(site):
    """Return a polarized standard star in words, with the name of the best one for a site."""
    name, high = _best_star(None if site is None else site.to_geodetic().lat.deg)
    reach = "" if high is None else f", which reaches {high:.0f} deg here"
    return f"a polarized standard star over a range of parallactic angle (such as {name}{reach})"


@lru_cache
def _best_star(latitude):
    """Return name and greatest altitude of the star whose angle frames tell best."""
    stars, _ = standards.catalogue()
    numbers = {key: np.array(stars[key].value, dtype=float) for key in ("p_max", "p_max_err", "V")}
    high = 90 - np.abs(stars["dec"].to_value("deg") - (latitude or 0.0))
    # photon noise of the angle; a law without errors does not tell what is known of the star
    score = numbers["p_max"] * 10 ** (-0.2 * numbers["V"])
    known = np.isfinite(score) & np.isfinite(numbers["p_max_err"])
    # without a site one that most of them see, as it stands high over the equator
    seen = known & (high >= (_LOW if latitude is not None else _EQUATOR))
    best = int(np.argmax(np.where(seen if seen.any() else known, score, -np.inf)))
    return str(stars["name"][best]), None if latitude is None else float(high[best])


# ---- what a set of half-wave-plate angles can separate ----


#: Sets of harmonics that a model may need to tell apart, with what brings the last one in.
SETS = (
    ((0, 4), "the polarization"),
    ((0, 2, 4), "a half-wave plate that is not perfect"),
    ((0, 1, 2, 4), "a wedge, dust or beam wander"),
)
# beyond this condition number errors grow too much to call the harmonics separate
_POOR = 10.0


def harmonic_conditions(angles):
    """Return the condition number of each set of harmonics for plate angles in radian."""
    found, angles = {}, np.asarray(angles, float)
    for harmonics, _ in SETS:
        # the frames' brightness or polarization as a Fourier series of the plate angle
        waves = [wave(k * angles) for k in harmonics for wave in (np.cos, np.sin)]
        # harmonic 0 has no sine
        columns = np.column_stack(waves[:1] + waves[2:])
        singular = np.linalg.svd(columns, compute_uv=False)
        poor = len(angles) < columns.shape[1] or singular[-1] < 1e-12 * singular[0]
        found[harmonics] = np.inf if poor else float(singular[0] / singular[-1])
    return found


def harmonic_words(angles):
    """Say which harmonics plate angles in radian cannot separate, and which angles to add."""
    degrees = np.unique(np.round(np.rad2deg(angles), 3))
    words, conditions = [], harmonic_conditions(np.deg2rad(degrees))
    for harmonics, origin in SETS:
        condition = conditions[harmonics]
        if condition > _POOR:
            span = f"{degrees[0]:g} to {degrees[-1]:g} deg"
            new = ", ".join(str(k) for k in harmonics if k not in (0, 4)) or "4"
            rest = ", ".join(str(k) for k in harmonics if str(k) not in new.split(", "))
            size = f"{condition:.2g}" if np.isfinite(condition) else "infinite"
            words.append(
                f"half-wave-plate angles {span} separate harmonic {new} badly from {rest} "
                f"(condition {size}, from {origin}): add {_missing(degrees, harmonics)}"
            )
    return words


def _missing(degrees, harmonics):
    """Return the angles, in even steps, that complete a period of the lowest harmonic."""
    lowest = min(k for k in harmonics if k)
    period = 360.0 / lowest
    steps = np.diff(degrees)
    step = float(np.median(steps)) if steps.size else 22.5
    # a step that does not divide the period, or that is too coarse for harmonic 4
    # Nyquist: two angles a period of the highest harmonic, and one more
    count = max(round(period / step), 2 * max(harmonics) // lowest + 1, 4)
    wanted = np.arange(count) * period / count + degrees[0]
    new = [angle for angle in wanted if np.abs(degrees - angle).min() > 0.1]
    if len(new) > 3 and np.allclose(np.diff(new), new[1] - new[0]):
        return f"{new[0]:g} to {new[-1]:g} deg"
    return ", ".join(f"{angle:g}" for angle in new) + " deg"


# ---- discrete mirror solutions: other values that give exactly the same data ----


# far below any noise, far above rounding: a mirror solution is exact or it is none
_SAME = 1e-9
# frames of a long table in which the light is looked at
_FEW = 64
_SAME_DATA = "all retardances with the other sign (circular ones keep theirs) give the same data"


def mirror_branches(measurement, vector, view):
    """Return the mirror solutions as dicts: ``words``, and ``sky`` as in `consequences_along`.

    With them the other hand of the whole instrument, if only bounds or models exclude it and it
    matters on sky.
    """
    # the free retarders by name, with the slots of their retardances
    retarders, branches = {}, []
    for leaf in (leaf for chain in measurement.chains for leaf in leaves(chain)):
        if isinstance(leaf, (LinearRetarder, EllipticalRetarder, DiattenuatorRetarder)):
            # with one component held the others cannot go to the mirror solution
            keys = [key for key in leaf.own_names if key != "diattenuation"]
            slots = [measurement.free.by_name.get(f"{leaf.name}.{key}") for key in keys]
            if None not in slots:
                retarders[leaf.name] = slots
    turns = "a retardance d (length |d|) and d (1 - 360 deg / |d|) are the same optic"
    candidates = [(f"{name}: {turns}", [name], other_turn) for name in retarders]
    candidates.append((f"{', '.join(retarders)}: {_SAME_DATA}", retarders, _other_hand))
    low, high = measurement.free.bounds()
    for words, names, edit in candidates:
        other = np.array(vector, dtype=float)
        for slots in (retarders[name] for name in names):
            parts = np.broadcast_arrays(*(vector[slot.slice] for slot in slots))
            for slot, values in zip(slots, edit(np.array(parts)), strict=True):
                # one value for all wavelengths where these want several is no mirror: see below
                other[slot.slice] = values[: slot.size]
        inside = np.all((other >= low) & (other <= high))
        change = np.abs(measurement.predict(other) - measurement.predict(vector)).max()
        if inside and change < _SAME and not np.allclose(other, vector):
            sky = None
            if view is not None:
                sky = consequences_of(view, seen_with(view, measurement.put_back(other)))
            branches.append({"words": words, "sky": sky})
    if not any(_SAME_DATA in branch["words"] for branch in branches):
        branches += _other_instrument(measurement, vector, view)
    for branch in branches:
        if branch["sky"] is not None and matters(branch["sky"]):
            branch["words"] += (
                f"; WARNING: if the other one is true, {sky_words(branch['sky'])}; "
                f"{star_words(view.site)} tells them apart"
            )
    return branches


def _other_instrument(measurement, vector, view):
    """Return the other handedness downstream of the telescope, if it matters and no datum tells."""
    if view is None or view.telescope == LEFT_OUT:
        return []
    lam = measurement.wavelength * u.um
    for chain, dataset in zip(measurement.put_back(vector), measurement.datasets, strict=True):
        front, _ = split_chain(without_nuisance(chain))
        if not front:
            continue
        source = join(front)
        step = max(1, dataset.frames.shape[0] // _FEW)
        moving = {
            stage: angle[:, ::step].ravel() * u.rad for stage, angle in dataset.positions.items()
        }
        places = standing(source)
        positions = places | {s: moving[s] for s in stages(source) if s not in places}
        light = system_mueller(source, lam, positions)[..., :, 0]
        # circularly polarized light that enters the instrument tells its hand
        if np.abs(light[..., 3]).max() > _SAME * np.abs(light[..., 0]).max():
            return []
    telescope, instrument = split_chain(view.chain)
    # V -> -V in front of everything behind it: the fluxes are of I alone, and have no hand
    turned = MuellerElement.from_matrix(np.diag([1.0, 1.0, 1.0, -1.0]), name="other_hand")
    sky = consequences_of(view, join([*telescope, turned, *instrument]))
    words = f"downstream of the telescope: {_SAME_DATA}, only bounds or models exclude them"
    return [{"words": words, "sky": sky}] if matters(sky) else []


def other_turn(retardance):
    """Turn the other way round the same axis; shape (1 or 3, n)."""
    length = np.linalg.norm(retardance, axis=0)
    # turning by d about an axis is turning by d - 360 deg about it
    return retardance * (1 - 2 * np.pi / np.where(length > 0, length, np.inf))


def _other_hand(retardance):
    """Change the sign of V before and after it."""
    # V -> -V is a reflection of the Poincare sphere: it turns round rotations about axes in the
    # equator (linear retardance), and leaves those about the axis of V
    return retardance * np.array([-1.0, -1.0, 1.0])[: len(retardance), None]
