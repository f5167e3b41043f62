# Licensed under a 3-clause BSD style license - see LICENSE
"""
What the data determine: rank, null directions in words, honest errors.

A parameter is *identifiable* if no combination of parameters that leaves all data unchanged moves
it. An error is given for identifiable parameters only: a pseudo-inverse would return a small and
wrong number for the others.
"""

import re
from dataclasses import dataclass, field

import numpy as np

from astropolcal.calibration.identifiability.ambiguities import (
    harmonic_words,
    mirror_branches,
    star_words,
)
from astropolcal.calibration.identifiability.linearized import (
    Whitened,
    first_of_each_kind,
    led,
    near_null_directions,
    open_directions,
    step_of,
)
from astropolcal.calibration.identifiability.sky import (
    LEFT_OUT,
    consequences_along,
    sky_words,
    view_of_measurement,
)
from astropolcal.chain import leaves
from astropolcal.optics import Rotator

__all__ = ["Identifiability", "examine"]

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
        which bounds may exclude but no datum does, where it matters on sky.
    near_null : list of dict
        Directions that are determined so badly that it hardly counts: at the
        noise of the fit some parameter is uncertain by more than 5 deg, 0.05 mm
        or 5 %, or the singular value is more than 1e4 times below the largest.
        ``words``, the ``parameters`` with their change at one standard error,
        and what that is on ``sky`` for the worst six. Priors count as data here.
    branches : list of dict
        Of each of ``mirrors`` the ``words``, and what it does on ``sky``, or None.

    Examples
    --------
    >>> from astropolcal.calibration.identifiability import Identifiability
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
    Identifiability
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
    whitened = Whitened(data, physical_scale(free), free.prior_jacobian(vector))
    level = np.nan if weights is None else 1.0
    finding = finding_of(free, whitened)
    name = measurement.datasets[0].observations.instrument
    view = view_of_measurement(measurement, vector, name)
    return complete(finding, measurement, vector, whitened, level, view=view)


def complete(finding, measurement, vector, whitened=None, level=1.0, *, view=None):
    """Add to a finding what it means on sky, the sampling and the mirror solutions.

    With the problem ``whitened`` around the solution also the directions that are badly determined
    for the noise ``level`` of a datum of weight one.
    """
    free = measurement.free
    scaled = [direction for direction, _ in led(free, finding.null_vectors)]
    # one degree, micrometre or percent of the leading parameter
    canonical = np.array(scaled).reshape(-1, free.size) * physical_scale(free)
    view = view_of_measurement(measurement, vector) if view is None else view
    for direction, sky in zip(finding.directions, consequences_along(view, canonical), strict=True):
        if sky is not None:
            direction["sky"] = sky
            direction["words"] += f"; {sky_words(sky)}"
    if whitened is not None and np.isfinite(level):
        finding.near_null = near_null_directions(
            free, whitened, level, lambda changes: consequences_along(view, changes)
        )
    angles = {
        # commanded angles repeat in many frames; a microradian is none
        round(float(angle), 6)
        for dataset in measurement.datasets
        if "hwp" in dataset.observations.frames.colnames
        for angle in dataset.observations.position("hwp")
    }
    finding.sampling = harmonic_words(np.array(sorted(angles))) if angles else []
    finding.sampling += telescope_words(finding, measurement) + _settled_by_a_star(finding, view)
    finding.branches = mirror_branches(measurement, vector, view)
    finding.mirrors = [branch["words"] for branch in finding.branches]
    return finding


def _settled_by_a_star(finding, view):
    """Say which open directions a star of known polarization would close, and which star."""
    if view is None or view.telescope == LEFT_OUT:
        return []
    leads = [
        re.split(" by | changes ", direction["words"])[0]
        for direction in finding.directions
        if "sky" in direction and max(map(abs, direction["sky"]["aolp_deg"])) > _TURNS
    ]
    if not leads:
        return []
    return [f"{', '.join(leads)}: {star_words(view.site)} determines the angle on sky"]


def physical_scale(free):
    """Return one degree, micrometre or percent of each free parameter, in canonical units."""
    kinds = [step_of(slot.unit)[0] for slot in free.slots]
    return np.repeat(kinds, [slot.size for slot in free.slots])


# ---- what stars leave open of the telescope's mirrors, and what would determine it ----


def telescope_words(finding, measurement):
    """Say which parameters of mirrors upstream of the half-wave plate stars do not determine."""
    open_names = {
        name
        for direction in (*finding.directions, *finding.near_null)
        for name in direction["parameters"]
    }
    # what ran to a bound is as open as what drifts
    at_bound = []
    if measurement.datasets:
        held = measurement.free.at_bounds(measurement.vector())
        at_bound = [measurement.free.names[i] for i in np.flatnonzero(held)]
    words = []
    for mirror in sorted(_mirrors(measurement)):
        own = sorted(n for n in {*open_names, *at_bound} if n.startswith(f"{mirror}."))
        if own:
            words.append(
                f"{', '.join(own)}: an unpolarized star shows the diattenuation of {mirror} and "
                "nothing else, at any altitude, so the numbers of its law trade off; a star of "
                "known polarization over a wide range of parallactic angle adds the retardance, "
                "a measured film or index (a prior) does the rest"
            )
    return words


def _mirrors(measurement):
    """Return the names of what stands between the parallactic angle and the half-wave plate."""
    found = set()
    for chain, _ in zip(getattr(measurement, "chains", ()), measurement.datasets, strict=False):
        train = leaves(chain)
        stages = [leaf.stage for leaf in train]
        # the plate ends the telescope, or where there is none its last axis
        last = next((s for s in ("hwp", "altitude") if s in stages), None)
        if "parallactic" in stages and last is not None:
            inner = train[stages.index("parallactic") + 1 : stages.index(last)]
            found |= {leaf.name for leaf in inner if not isinstance(leaf, Rotator)}
    return found
