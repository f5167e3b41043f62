# Licensed under a 3-clause BSD style license - see LICENSE
"""
What open directions and mirror branches do to the polarization measured on sky.

A standard observation is cycles of the half-wave plate at a few positions of telescope and
derotator, each solved by itself for I, Q and U from normalized double differences, as
`~astropolcal.correction.correct` does it. Without a half-wave plate it is the sequence of frames
that was calibrated, solved for I, Q and U from their fluxes. The data that were fitted may not
change, and yet the q and u that the same optics give of the sky do. Rotation and gain are the same
for all degrees of polarization; instrumental polarization that is subtracted wrongly is not, and
matters the more the fainter the polarization is.
"""

import warnings
from contextlib import suppress
from functools import cached_property

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.calibration.system import Rows, free_of, from_first_stage, inverse_rows
from astropolcal.chain import join, leaves, stages, standing
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, ChainError
from astropolcal.instruments import SkyLaw
from astropolcal.instruments.base import Instrument, without_nuisance
from astropolcal.optics import COORDINATES, LinearPolarizer
from astropolcal.optics.positions import is_move

__all__ = []

_GRID = np.meshgrid(np.deg2rad([30.0, 50.0, 70.0]), np.deg2rad([-60.0, 0.0, 60.0]))
_POINTINGS = {"altitude": _GRID[0].ravel(), "parallactic": _GRID[1].ravel()}
# frames 0 and 1, and 2 and 3, are pairs
_CYCLE = np.deg2rad([0.0, 45.0, 22.5, 67.5])
# a modulator takes both states in each of them
_MODULATOR, _STATES = "flc_state", (0.0, 1.0)
# so many settings; the angles of a stage are taken in steps of 4, which has no divisor with it
_MOST, _STRIDE = 9, 4
# frames of a sequence without a half-wave plate: kept of those calibrated, and in a setting
_KEPT, _LONGEST = 64, 16
# as for `correct`: a setting that determines q and u worse is left out
_MAX_CONDITION = 30.0

FITTED = "telescope as fitted"
PUBLISHED = "telescope of published values, taken without errors"
LEFT_OUT = "without telescope"


def known_instrument(name):
    """Return the instrument of a name, None if there is none or it is not installed here."""
    try:
        return instruments.get(name) if name else None
    except AstropolcalError:
        return None


def chain_from_sky(chains, instrument=None, wavelength=None, date=None):
    """Return the optics from the sky on, and what their telescope is in words."""
    seen = next((chain for chain in chains if "parallactic" in stages(chain)), None)
    if seen is not None:
        return from_first_stage(without_nuisance(seen), ("parallactic",)), FITTED
    if instrument is not None and instrument.has_telescope:
        return instrument._from_sky(chains[0], wavelength=wavelength, date=date), PUBLISHED
    trains = [leaves(without_nuisance(chain)) for chain in chains]
    # what is upstream of all that every dataset has belongs to the lamp, too
    shared = set.intersection(*({(type(o), o.mount) for o in train} for train in trains))
    found = [_behind_lamp(train, instrument) for train in trains]
    starts = [[(type(o), o.mount) in shared for o in train] for train in found]
    behind = [o[i.index(True) :] for o, i in zip(found, starts, strict=True) if any(i)]
    if not behind:
        raise ChainError("the chain has no optic on a stage; give the chain from the sky")
    return join(max(behind, key=len)), LEFT_OUT


def _behind_lamp(train, instrument):
    """Return the optics downstream of those of a lamp, none where it is not known which."""
    entrance = Instrument.entrance if instrument is None else instrument.entrance
    # one that says nothing of it may have other optics upstream of its plate, too
    named = [i for i, o in enumerate(train) if o.name == entrance != Instrument.entrance]
    # a polarizer upstream of what modulates belongs to the lamp
    lamp = [i for i, leaf in enumerate(train) if isinstance(leaf, LinearPolarizer) and leaf.stage]
    lamp = [i + 1 for i in lamp if any(leaf.stage for leaf in train[i + 1 :])]
    if named or lamp:
        return train[(named or lamp)[-1] :]
    with suppress(ChainError):
        return leaves(from_first_stage(join(train)))
    return []


def settings_of(measurement):
    """Return a few of the angles at which each stage but plate and telescope stood, in radian.

    Without a half-wave plate, or with devices that have states, they are those of the frames, so
    that what varies together stays together.
    """
    stood = []
    for dataset in measurement.datasets:
        states = {s: x[..., dataset.frames.T] for s, x in dataset._given.items() if "=" in s}
        stood.append({s: np.round(x, 6).ravel() for s, x in (dataset.positions | states).items()})
    wanted = dict.fromkeys(stage for one in stood for stage in one)
    if "hwp" not in wanted or any("=" in stage for stage in wanted):
        shared = sorted(set.intersection(*map(set, stood)) - {*_POINTINGS, *COORDINATES})
        if not shared:
            return {}
        frames = np.hstack([np.vstack([one[stage] for stage in shared]) for one in stood])
        frames = _spread_out(np.unique(frames, axis=1).T, _KEPT).T
        return {stage: angle.tolist() for stage, angle in zip(shared, frames, strict=True)}
    found = {}
    for stage in (stage for stage in wanted if stage not in ("hwp", *_POINTINGS)):
        angles = np.concatenate([one[stage] for one in stood if stage in one])
        found[stage] = _spread_out(np.unique(angles)).tolist()
    return found


def _spread_out(values, most=_MOST):
    return values[np.unique(np.rint(np.linspace(0, len(values) - 1, most)).astype(int))]


def view_of_measurement(measurement, vector, name=None):
    """Return the view of the sky that a measurement has at some values, None if there is none."""
    chains = measurement.put_back(vector)
    metas = [dataset.observations.meta for dataset in measurement.datasets]
    free, settings = measurement.free.of_chains(chains), settings_of(measurement)
    return _view(chains, free, measurement.wavelength, metas, name, settings)


def view_of_calibration(calibration):
    """Return the view of the sky that a calibration has, None if there is none."""
    settings = calibration.fit.get("sky_settings")
    if settings is None and calibration.measurement is not None:
        settings = settings_of(calibration.measurement)
    metas = [record.meta for record in calibration.datasets]
    chains, lam = calibration.chains, calibration.wavelength.to_value(u.um)
    return _view(chains, free_of(calibration), lam, metas, calibration.instrument, settings or {})


def _view(chains, free, lam, metas, name, settings):
    instrument = known_instrument(name)
    date = max((str(meta["date"]) for meta in metas if meta.get("date")), default=None)
    for known in ((instrument, lam * u.um, date), ()):
        with suppress(AstropolcalError), warnings.catch_warnings():
            # the published telescope of a coating that nobody states is named as such
            warnings.simplefilter("ignore", AstropolcalWarning)
            chain, telescope = chain_from_sky(chains, *known)
            break
    else:
        return None
    wanted, site = stages(chain), None
    if "hwp" not in wanted or any("=" in stage for stage in wanted):
        placed = sequence_of(wanted, settings)
    else:
        law = SkyLaw() if instrument is None or telescope == LEFT_OUT else instrument.sky_law
        stated = [meta.get("tracking") for meta in metas if meta.get("tracking") in law.modes]
        mode = stated[0] if stated else next(iter(law.modes), None)
        placed = _positions(chain, settings, law.plate_law(mode))
        site = None if instrument is None else instrument.location
    view = placed and SkyView(chain, telescope, free, lam, placed, site)
    # optics that never determine q and u say nothing of the sky
    return view if view and view.good.any() else None


def sequence_of(wanted, settings):
    """Return the positions of all stages in the frames of a sequence, None if they are not known.

    They are repeated for each pointing of the telescope.
    """
    own = [stage for stage in wanted if stage not in (*_POINTINGS, *COORDINATES)]
    own = [stage for stage in own if not is_move(stage)]
    if not own or not {*own} <= {*settings}:
        return None
    known = [settings[stage] for stage in own]
    if len({*map(len, known)}) > 1:
        return None
    frames = np.unique(np.transpose(known), axis=0)
    frames = _spread_out(frames, _LONGEST)
    count = _MOST if set(_POINTINGS) & set(wanted) else 1
    placed = dict(zip(own, np.tile(frames, (count, 1)).T, strict=True))
    placed |= {stage: np.repeat(angle, len(frames)) for stage, angle in _POINTINGS.items()}
    placed |= {stage: np.zeros(1) for stage in wanted if stage not in placed}
    return {stage: placed[stage] for stage in wanted}, count


def _positions(chain, settings, law):
    """Return the position of every stage in the frames of all settings."""
    wanted = stages(chain)
    angles = {
        # a file of before does not say where the derotator stood
        stage: np.asarray(settings.get(stage) or np.linspace(0, np.pi, _MOST, endpoint=False))
        for stage in wanted
        if stage not in ("hwp", *_POINTINGS) and stage not in COORDINATES
    }
    on_sky = bool(set(_POINTINGS) & set(wanted))
    count = _MOST if on_sky else max([len(a) for a in angles.values()], default=1)
    # in another order than the telescope's, so that the two do not go together
    order = np.arange(count) * (_STRIDE if on_sky else 1)
    each = {stage: angle[order % len(angle)] for stage, angle in angles.items()}
    plate = np.zeros(count)
    if on_sky:
        each |= _POINTINGS
        plate = law[0] * each["parallactic"] + law[1] * each["altitude"]
    n_states = len(_STATES) if _MODULATOR in wanted else 1
    cycle, n_frames = np.tile(_CYCLE, n_states), n_states * len(_CYCLE)
    placed = {stage: np.repeat(angle, n_frames) for stage, angle in each.items()}
    placed["hwp"] = np.repeat(plate, n_frames) + np.tile(cycle, count)
    # where another number of a frame is zero, an optic that depends on it does nothing
    placed |= {stage: np.full(1, x.value) for stage, x in standing(chain).items()}
    if n_states > 1:
        placed[_MODULATOR] = np.tile(np.repeat(_STATES, len(_CYCLE)), count)
    return {stage: placed[stage] for stage in wanted}, count


class SkyView:
    """What a chain from the sky measures in the standard observation, and how it changes."""

    def __init__(self, chain, telescope, free, lam, placed, site=None):
        self.chain, self.telescope, self.free, self.lam = chain, telescope, free, lam
        (self.placed, self._count), self.site = placed, site
        self._model = Rows(chain, lam, self.placed, free)
        # beams first, then wavelengths, settings, frames of a setting, and I, Q and U
        self._rows = self._by_setting(self._model)
        self.has_plate = "hwp" in self.placed and not any("=" in stage for stage in self.placed)
        self._gain, self.good = _solve(self._rows, self.has_plate)

    def _by_setting(self, model):
        rows = model.rows(n=3)
        return rows.reshape(*rows.shape[:2], self._count, -1, 3)

    @cached_property
    def changes(self):
        """How I, Q and U that are found change with each free parameter, per declared unit.

        Shape (n_wavelengths, n_settings, 3, 3, n_free), the last but one axis that of the light.
        """
        n_wavelengths, count = self.good.shape
        block = np.zeros((n_wavelengths, count, 3, 2, count, self._gain.shape[-1]))
        own = np.arange(count)
        # each setting is solved from its own frames
        block[:, own, :, :, own] = np.moveaxis(self._gain, 1, 0)
        found = self._model.changes(block.reshape(n_wavelengths, 3 * count, 2, -1))
        return found.reshape(n_wavelengths, count, 3, 3, -1)

    def against(self, chain):
        """Return what another chain finds of what this one measures, less the truth."""
        gain, good = _solve(self._by_setting(Rows(chain, self.lam, self.placed)), self.has_plate)
        both = self.good & good
        found = np.einsum("wskbf,bwsfc->wskc", gain, self._rows) - np.eye(3)
        return np.where(both[..., None, None], found, np.nan)


def _solve(rows, paired):
    """Return what turns fluxes into I, Q and U in each setting, and which are well determined."""
    n_frames = rows.shape[3]
    combine = np.eye(2 * n_frames)
    if paired:
        # beams and frames of a setting become half differences and half sums of its pairs
        minus, plus = (np.kron(np.eye(n_frames // 2), [[1, sign]]) for sign in (-1, 1))
        combine = np.concatenate([np.hstack([minus, -minus]), np.hstack([plus, plus])]) / 2
    beams = np.moveaxis(rows, 0, 2)
    channels = combine @ beams.reshape(*beams.shape[:2], -1, 3)
    gain, _, _, good = inverse_rows(channels, max_condition=_MAX_CONDITION)
    gain = gain @ combine
    return gain.reshape(*gain.shape[:3], 2, n_frames), good.all(axis=-1)


# ---- what an open direction, or a mirror branch, does to the polarization measured on sky ----


#: Degrees of linear polarization for which consequences are given, percent.
DOLPS = (30.0, 1.0, 0.1)
# angles of polarization among which least and largest are sought
_DOUBLE = 2 * np.deg2rad(np.arange(0, 180, 7.5))
# changes on sky that are not worth a number, degree and percent
_NOTHING = 0.005
# and those of a source of 1 % that are worth a warning
_MATTERS = {"aolp_deg": 0.1, "dolp_change_percent": 1.0}


def consequences_along(view, directions):
    """Return how AoLP and DoLP change for small steps along canonical directions, to first order.

    For each a dict with ``targets``, an entry for sources of 30, 1 and 0.1 % (``dolp_percent``):
    least and largest change ``aolp_deg`` and ``dolp_change_percent``; None without a view.
    """
    if view is None or not len(directions):
        return [None] * len(directions)
    steps = np.asarray(directions) / view.free.factors()
    return [_consequences((view.changes @ step)[view.good], _small) for step in steps]


def consequences_of(view, chain):
    """Return the consequences of taking another chain for the true one, however far it is."""
    change = view.against(chain)
    return _consequences(change[np.isfinite(change).all(axis=(-2, -1))], _whole)


def seen_with(view, chains):
    """Return the chain of a view, with the optics of other chains where they have them."""
    known = {leaf.name: leaf for chain in chains for leaf in leaves(chain)}
    return join(known.get(leaf.name, leaf) for leaf in leaves(view.chain))


def mean_errors(view, chain):
    """Return the mean squares of errors of q and u of taking another chain for the true one.

    In proportion to the polarization and apart from it, of all settings, (2, n_wavelengths).
    """
    change = view.against(chain)
    # of q = Q / I: what is found of I changes, too
    change = change[..., 1:, :] - np.eye(3)[1:] * change[..., :1, :1]
    known = np.isfinite(change).all(axis=(-2, -1))
    square = np.where(known[..., None, None], change, 0.0) ** 2
    found = np.stack([square[..., 1:].sum(axis=-1) / 2, square[..., 0]]).mean(axis=-1)
    return found.sum(axis=-1) / np.maximum(known.sum(axis=-1), 1)


def _consequences(matrices, changed):
    """Return least and largest change for each degree of polarization."""
    targets = []
    for dolp in DOLPS:
        turn, gain = changed(matrices, dolp / 100)
        # an angle cannot be off by more than 90 deg
        turn = np.clip(np.rad2deg(turn), -90, 90)
        spans = {"aolp_deg": _span(turn), "dolp_change_percent": _span(100 * gain)}
        targets.append({"dolp_percent": dolp} | spans)
    first = targets[0]
    both = {"aolp_deg": first["aolp_deg"], "dolp_percent": first["dolp_change_percent"]}
    return both | {"targets": targets}


def light_of(dolp, double=_DOUBLE):
    """Return I, Q and U of light of a degree of polarization at angles, (3, n_angles)."""
    return np.stack([np.ones_like(double), dolp * np.cos(double), dolp * np.sin(double)])


def weights_of(dolp, double):
    """Return how q, u, degree and angle follow from the nine changes, (4, n_angles, 9)."""
    light = light_of(dolp, double).T
    # dQ = sum of M_Qc S_c, and of q = Q / I also what is found of I changes
    change = np.eye(3)[:, None, :, None] * light[None, :, None, :]
    dq, du = (change[i] - light[:, i, None, None] * change[0] for i in (1, 2))
    cosine, sine = np.cos(double)[:, None, None], np.sin(double)[:, None, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = np.where(dolp > 0, (cosine * du - sine * dq) / np.float64(2 * dolp), np.nan)
    return np.stack([dq, du, cosine * dq + sine * du, turn]).reshape(4, len(light), 9)


# ---- in words ---------------------------------------------------------------------------


def sky_words(sky):
    """Say what a direction or a branch does on sky."""
    if not shows_on_sky(sky):
        return "on sky nothing changes"
    each = [
        (f"{target['dolp_percent']:g} %", *map(_size, _largest(target)))
        for target in targets_of(sky)
    ]
    (dolp, turn, gain), *fainter = each
    turned, gained = (f"up to {size}" if size[0].isdigit() else size for size in (turn, gain))
    words = f"on sky the AoLP changes by {turned} deg and the DoLP by {gained} % of itself"
    if all(one[1:] == (turn, gain) for one in each):
        return f"{words}, regardless of the DoLP"
    others = (f"{dolp}: {turn} deg, {gain} %" for dolp, turn, gain in fainter)
    return "; ".join([f"{words} for a source of {dolp}", *others])


def targets_of(sky):
    """Return the entries for each degree of polarization; a file of before has one."""
    first = {"dolp_percent": DOLPS[0], "aolp_deg": sky["aolp_deg"]}
    return sky.get("targets") or [first | {"dolp_change_percent": sky["dolp_percent"]}]


def shows_on_sky(sky):
    """Return whether the AoLP or the DoLP on sky changes by what is worth a word."""
    return max(max(_largest(target)) for target in targets_of(sky)) >= _NOTHING


def matters(sky):
    """Return whether a source of 1 % changes by so much that a warning is due."""
    target = next(t for t in targets_of(sky) if t["dolp_percent"] == DOLPS[1])
    return any(max(map(abs, target[key])) > limit for key, limit in _MATTERS.items())


def _largest(target):
    return [max(map(abs, target[key])) for key in ("aolp_deg", "dolp_change_percent")]


def _size(value):
    if value < _NOTHING:
        return "less than 0.01"
    return f"{value:.2g}" if value < 99.5 else f"{value:.0f}"


# ---- numbers ----------------------------------------------------------------------------


def _small(matrices, dolp):
    """Return the changes of angle and degree (of itself) to first order."""
    along = matrices.reshape(-1, 9) @ weights_of(dolp, _DOUBLE)[2:].swapaxes(1, 2)
    return along[1], along[0] / dolp


def _whole(matrices, dolp):
    """Return the changes of angle and degree (of itself), however large."""
    light = light_of(dolp)
    found = light + matrices @ light
    # q + iu, over that of the source: its modulus is the gain, half its phase the turn
    ratio = (found[..., 1, :] + 1j * found[..., 2, :]) / found[..., 0, :]
    ratio = ratio / (light[1] + 1j * light[2])
    return np.angle(ratio) / 2, np.abs(ratio) - 1


def _span(values):
    if not values.size:
        return [0.0, 0.0]
    # adding zero turns -0.0 into 0.0
    return [round(float(values.min()), 4) + 0.0, round(float(values.max()), 4) + 0.0]
