# Licensed under a 3-clause BSD style license - see LICENSE
"""
What an open direction does to the polarization measured on sky.

The data of the internal source may not change along a direction, and yet the
q and u that the same optics give of the sky do. The part of the chain that the
sky light passes begins with the first optic on a stage.
"""

import numpy as np

from astropolcal.chain import join, leaves, stages
from astropolcal.optics import COORDINATES
from astropolcal.propagation import Propagator

__all__ = ["sky_consequences"]

_STEP = 1e-4
#: A cycle that measures Q and U (paper, Eq. for the double difference).
_CYCLE = np.deg2rad([0.0, 45.0, 22.5, 67.5])


def sky_consequences(measurement, vector, directions):
    """
    Return how recovered AoLP and DoLP change along given directions.

    Parameters
    ----------
    measurement : Measurement
        The measurement; its first dataset's chain and derotator angles count.
    vector : `~numpy.ndarray`
        The solution, canonical values, shape (n_free,).
    directions : `~numpy.ndarray`
        Canonical changes, shape (n_directions, n_free).

    Returns
    -------
    list of dict or None
        For each direction ``aolp_deg`` and ``dolp_percent``: least and largest
        change over the wavelengths of the AoLP in degree, and of the DoLP in
        percent of itself. None where the chain has no half-wave plate stage.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.calibration import sky_consequences
    >>> from astropolcal.measurement import Measurement
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[60, 85] * u.deg)
    >>> measurement = Measurement(chain, simulate(chain, charis.wavelength, frames, seed=1))
    >>> turn = np.zeros((1, measurement.free.size))
    >>> turn[0, measurement.free.by_name["hwp.theta"].start] = np.deg2rad(1)
    >>> sky = sky_consequences(measurement, measurement.vector(), turn)[0]
    >>> [round(change, 1) for change in sky["aolp_deg"]]
    [2.0, 2.0]
    """
    # a lamp's chain where there is one: the telescope's own angles are not the question
    on_sky = ["parallactic" in part.positions for part in measurement.datasets]
    index = int(np.argmin(on_sky))
    dataset = measurement.datasets[index]
    if "hwp" not in dataset.positions:
        return [None] * len(directions)
    live = measurement.copy()
    derotators = {
        stage: np.unique(np.round(angle, 6))
        for stage, angle in dataset.positions.items()
        if stage != "hwp"
    }
    low, high = measurement.free.bounds()
    rows = _rows(live, vector, derotators, index)
    inverse = np.linalg.pinv(rows)
    found = []
    for direction in directions:
        # beyond its bounds an optic may not exist
        ends = (np.clip(vector + s * _STEP * direction, low, high) for s in (1, -1))
        up, down = (_rows(live, end, derotators, index) for end in ends)
        # the recovered s obeys (A + dA) s = A s_true
        change = -inverse @ ((up - down) / (2 * _STEP))
        turn = np.rad2deg((change[:, 1, 0] - change[:, 0, 1]) / 4)
        gain = 50 * (change[:, 0, 0] + change[:, 1, 1])
        found.append({"aolp_deg": _span(turn), "dolp_percent": _span(gain)})
    return found


def _span(values):
    # adding zero turns -0.0 into 0.0
    return [round(float(values.min()), 4) + 0.0, round(float(values.max()), 4) + 0.0]


def _rows(measurement, vector, derotators, index):
    """Return what the double differences see of q and u, (n_wavelengths, n_data, 2)."""
    chain = measurement.put_back(vector)[index]
    optics = leaves(chain)
    first = next(i for i, leaf in enumerate(optics) if leaf.stage not in (None, *COORDINATES))
    sky = join(optics[first:])
    n_angles = max((len(a) for a in derotators.values()), default=1)
    positions = {"hwp": np.tile(_CYCLE, n_angles)}
    for stage, angle in derotators.items():
        positions[stage] = np.repeat(np.resize(angle, n_angles), len(_CYCLE))
    # where a frame's number is zero, an optic that depends on it does nothing
    positions |= {stage: np.zeros(1) for stage in stages(sky) if stage in COORDINATES}
    wavelength = measurement.wavelength
    columns = []
    for q, u in ((1.0, 0.0), (0.0, 1.0)):
        right, left = Propagator(sky, wavelength, positions, (1.0, q, u, 0.0)).fluxes()
        dark_right, dark_left = Propagator(sky, wavelength, positions).fluxes()
        single = (right - left) - (dark_right - dark_left)
        total = dark_right + dark_left
        plus, minus = single[:, 0::2], single[:, 1::2]
        # response of the double difference to q or u, without what the optics polarize themselves
        columns.append((plus - minus) / (total[:, 0::2] + total[:, 1::2]))
    return np.stack(columns, axis=-1)
