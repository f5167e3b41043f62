# Licensed under a 3-clause BSD style license - see LICENSE
"""
A standard observation of the sky, and how the Stokes parameters that it finds change.

Cycles of the half-wave plate at a few positions of telescope and derotator, each solved by itself
for I, Q and U from normalized double differences, as `~astropolcal.correction.correct` does it.
"""

import warnings
from functools import cached_property

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.calibration._rows import Rows
from astropolcal.chain import join, leaves, stages
from astropolcal.exceptions import AstropolcalError, AstropolcalWarning, ChainError
from astropolcal.instruments import SkyLaw
from astropolcal.instruments.base import without_nuisance
from astropolcal.measurement.parameters import FreeParameters
from astropolcal.optics import COORDINATES

_ALTITUDES, _PARALLACTIC = np.deg2rad([30.0, 50.0, 70.0]), np.deg2rad([-60.0, 0.0, 60.0])
_TELESCOPE = ("parallactic", "altitude")
# frames 0 and 1, and 2 and 3, are pairs
_CYCLE = np.deg2rad([0.0, 45.0, 22.5, 67.5])
# a modulator takes both states in each of them
_MODULATOR, _STATES = "flc_state", (0.0, 1.0)
# so many settings; the angles of a stage are taken in steps of 4, which has no divisor with it
_MOST, _STRIDE = 9, 4
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
        return _from_stage(without_nuisance(seen), ("parallactic",)), FITTED
    if instrument is not None and instrument.has_telescope:
        known = {"wavelength": wavelength, "date": date}
        options = {key: known[key] for key in instrument.sky_options}
        return instrument.on_sky(chains[0], **options), PUBLISHED
    chain = without_nuisance(chains[0])
    return _from_stage(chain, [s for s in stages(chain) if s not in COORDINATES]), LEFT_OUT


def _from_stage(chain, wanted):
    found = leaves(chain)
    first = next((i for i, leaf in enumerate(found) if leaf.stage in wanted), None)
    if first is None:
        raise ChainError("the chain has no optic on a stage; give the chain from the sky")
    return join(found[first:])


def settings_of(measurement):
    """Return a few of the angles at which each stage but plate and telescope stood, in radian."""
    angles = {}
    for dataset in measurement.datasets:
        for stage, angle in dataset.positions.items():
            if stage not in ("hwp", *_TELESCOPE):
                angles.setdefault(stage, []).append(np.round(angle, 6).ravel())
    return {
        stage: _spread_out(np.unique(np.concatenate(several))).tolist()
        for stage, several in angles.items()
    }


def _spread_out(values):
    return values[np.unique(np.rint(np.linspace(0, len(values) - 1, _MOST)).astype(int))]


def view_of_measurement(measurement, vector, name=None):
    """Return the view of the sky that a measurement has at some values, None without a plate."""
    chains = measurement.put_back(vector)
    metas = [dataset.observations.meta for dataset in measurement.datasets]
    free, settings = measurement.free.of_chains(chains), settings_of(measurement)
    return _view(chains, free, measurement.wavelength, metas, name, settings)


def view_of_calibration(calibration):
    """Return the view of the sky that a calibration has, None without a half-wave plate."""
    grid = calibration.wavelength
    free = FreeParameters(calibration.chains, len(grid), calibration.ties)
    settings = calibration.fit.get("sky_settings")
    if settings is None and calibration.measurement is not None:
        settings = settings_of(calibration.measurement)
    metas = [record.meta for record in calibration.datasets]
    chains, lam = calibration.chains, grid.to_value(u.um)
    return _view(chains, free, lam, metas, calibration.instrument, settings or {})


def _view(chains, free, lam, metas, name, settings):
    instrument = known_instrument(name)
    date = max((str(meta["date"]) for meta in metas if meta.get("date")), default=None)
    try:
        with warnings.catch_warnings():
            # the published telescope of a coating that nobody states is named as such
            warnings.simplefilter("ignore", AstropolcalWarning)
            chain, telescope = chain_from_sky(chains, instrument, lam * u.um, date)
    except AstropolcalError:
        try:
            chain, telescope = chain_from_sky(chains)
        except ChainError:
            return None
    if "hwp" not in stages(chain):
        return None
    law = SkyLaw() if instrument is None or telescope == LEFT_OUT else instrument.sky_law
    stated = [meta.get("tracking") for meta in metas if meta.get("tracking") in law.modes]
    mode = stated[0] if stated else next(iter(law.modes), None)
    placed = _positions(stages(chain), settings, law.plate_law(mode))
    site = None if instrument is None else instrument.location
    view = SkyView(chain, telescope, free, lam, placed, site)
    # optics that never determine q and u say nothing of the sky
    return view if view.good.any() else None


def _positions(wanted, settings, law):
    """Return the position of every stage in the frames of all settings."""
    angles = {
        # a file of before does not say where the derotator stood
        stage: np.asarray(settings.get(stage) or np.linspace(0, np.pi, _MOST, endpoint=False))
        for stage in wanted
        if stage not in ("hwp", *_TELESCOPE, *COORDINATES)
    }
    altitude, parallactic = (grid.ravel() for grid in np.meshgrid(_ALTITUDES, _PARALLACTIC))
    on_sky = bool(set(_TELESCOPE) & set(wanted))
    count = _MOST if on_sky else max([len(a) for a in angles.values()], default=1)
    # in another order than the telescope's, so that the two do not go together
    order = np.arange(count) * (_STRIDE if on_sky else 1)
    each = {stage: angle[order % len(angle)] for stage, angle in angles.items()}
    plate = np.zeros(count)
    if on_sky:
        each |= {"altitude": altitude, "parallactic": parallactic}
        plate = law[0] * parallactic + law[1] * altitude
    n_states = len(_STATES) if _MODULATOR in wanted else 1
    cycle, n_frames = np.tile(_CYCLE, n_states), n_states * len(_CYCLE)
    placed = {stage: np.repeat(angle, n_frames) for stage, angle in each.items()}
    placed["hwp"] = np.repeat(plate, n_frames) + np.tile(cycle, count)
    # where another number of a frame is zero, an optic that depends on it does nothing
    placed |= {stage: np.zeros(1) for stage in wanted if stage in COORDINATES}
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
        self._gain, self.good = _solve(self._rows)

    def _by_setting(self, model):
        rows = model.rows(n=3)
        return rows.reshape(*rows.shape[:2], self._count, -1, 3)

    @cached_property
    def changes(self):
        """
        How I, Q and U that are found change with each free parameter, per declared unit.

        Shape (n_wavelengths, n_settings, 3, 3, n_free), the last but one axis that of the light.
        """
        n_wavelengths, count = self.good.shape
        block = np.zeros((n_wavelengths, count, 3, 2, count, self._gain.shape[-1]))
        own = np.arange(count)
        # each setting is solved from its own frames
        block[:, own, :, :, own] = np.moveaxis(self._gain, 1, 0)
        found = self._model.changes(block.reshape(n_wavelengths, 3 * count, 2, -1))
        return found.reshape(n_wavelengths, count, 3, 3, -1)

    def along(self, directions):
        """Return the changes for steps along directions in canonical units, (..., w, s, 3, 3)."""
        steps = np.asarray(directions) / self.free.factors()
        return np.moveaxis(self.changes @ steps.T, -1, 0)

    def with_optics_of(self, chains):
        """Return the chain from the sky with those optics that other chains have from them."""
        known = {leaf.name: leaf for chain in chains for leaf in leaves(chain)}
        return join(known.get(leaf.name, leaf) for leaf in leaves(self.chain))

    def against(self, chain):
        """Return what another chain finds of what this one measures, less the truth."""
        gain, good = _solve(self._by_setting(Rows(chain, self.lam, self.placed)))
        both = self.good & good
        found = np.einsum("wskbf,bwsfc->wskc", gain, self._rows) - np.eye(3)
        return np.where(both[..., None, None], found, np.nan)


def _solve(rows):
    """Return what turns fluxes into I, Q and U in each setting, and which are well determined."""
    n_frames = rows.shape[3]
    # beams and frames of a setting become half differences and half sums of its pairs
    minus, plus = (np.kron(np.eye(n_frames // 2), [[1, sign]]) for sign in (-1, 1))
    combine = np.concatenate([np.hstack([minus, -minus]), np.hstack([plus, plus])]) / 2
    beams = np.moveaxis(rows, 0, 2)
    channels = combine @ beams.reshape(*beams.shape[:2], -1, 3)
    singular = np.linalg.svd(channels, compute_uv=False)
    good = singular[..., -1] * _MAX_CONDITION > singular[..., 0]
    gain = np.linalg.pinv(channels) @ combine
    return gain.reshape(*gain.shape[:3], 2, n_frames), good
