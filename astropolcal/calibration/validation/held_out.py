# Licensed under a 3-clause BSD style license - see LICENSE
"""Prediction of standards: datasets that the fit of a calibration did not use."""

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.calibration.identifiability.analysis import physical_scale
from astropolcal.chain import join, leaves
from astropolcal.exceptions import ChainError, FitError
from astropolcal.files import columns
from astropolcal.measurement import Measurement, parameter_table
from astropolcal.observations.reading import SAME_WAVELENGTH, bins_on_grid
from astropolcal.optics import PolarizedSource

__all__ = ["add_standard"]

# what a step of a degree may add to the errors of a prediction before it is worth a word
_WORTH_A_WORD = 0.1


def refuse_fitted(calibration, observations):
    """Refuse observations with the content of a fitted dataset."""
    seen = {record.content_hash: record.name for record in calibration.datasets}
    if observations.content_hash in seen:
        raise FitError(
            f"{observations.name} is not an independent standard: the calibration was fitted "
            f"to it as {seen[observations.content_hash]}"
        )


def standard_accuracy(calibration, chain, observations, positions=None):
    """Return how well a calibration predicts a dataset that its fit did not use.

    The table of `add_standard`, which keeps it with the calibration.
    """
    refuse_fitted(calibration, observations)
    rows = bins_on_grid(observations, calibration.wavelength.to_value(u.um))
    predicted = _calibrated_chain(calibration, chain, rows, observations.name)
    known = parameter_table([predicted])
    fitted = {leaf.name for item in calibration.chains for leaf in leaves(item)}
    measurement = Measurement(
        predicted,
        observations,
        observable=calibration.settings["observable"],
        positions=None if positions is None else [positions],
        ties={k: t for k, t in calibration.ties.items() if k in known and t.source in known},
    )
    table = _errors(measurement)
    table["s_cv"] = _own_s_cv(calibration, observations.source, rows)
    with np.errstate(divide="ignore", invalid="ignore"):
        table["chi"] = (table["s_standard"] / table["s_cv"]).to_value(u.one)
    table.meta |= {
        "name": observations.name,
        "source": observations.source,
        "content_hash": observations.content_hash,
        "n_frames": int(observations.n_frames),
        "open_percent": _moved_by_open(calibration, measurement, rows),
        "not_calibrated": [leaf.name for leaf in leaves(chain) if leaf.name not in fitted],
    }
    table.meta["words"] = _words(table, bool(_of_source(calibration, observations.source)))
    return table


def predicted_chain(calibration, chain, observations):
    """Return the chain with the calibration's values at the wavelengths of the observations."""
    rows = bins_on_grid(observations, calibration.wavelength.to_value(u.um))
    return _calibrated_chain(calibration, chain, rows, observations.name, sources=True)


def _calibrated_chain(calibration, chain, rows, name, sources=False):
    """Return the chain with the calibration's values, bounds and flags where it has the optic."""
    # reversed, so that of optics in several chains the first dataset's counts
    fitted = {leaf.name: leaf for item in calibration.chains[::-1] for leaf in leaves(item)}
    train, unknown = [], []
    for leaf in leaves(chain):
        is_source = sources and isinstance(leaf, PolarizedSource)
        own = None if is_source else fitted.get(leaf.name)
        if is_source:
            pass
        elif own is None:
            parameters = ((key, getattr(leaf, key)) for key in leaf.param_names)
            # free, and nothing is known of it
            is_open = (k for k, p in parameters if not p.fixed and p.prior is None)
            unknown += [f"{leaf.name}.{key}" for key in is_open]
        elif type(own) is not type(leaf):
            raise ChainError(
                f"{name}: {leaf.name} is of class {type(leaf).__name__}, but that of the "
                f"calibration is of class {type(own).__name__}"
            )
        origin = leaf if own is None else own
        train.append(_at_rows(leaf, origin, rows, calibration.wavelength, free=is_source))
    if unknown:
        raise FitError(
            f"{name}: nothing determines {', '.join(unknown)}: the calibration has no such "
            "optics; hold them at known values"
        )
    return join(train)


def _at_rows(leaf, source, rows, grid, free=False):
    """Return the optic with the source's values at some wavelengths of the grid."""
    values = {}
    for key in leaf.param_names:
        parameter = getattr(source, key)
        value = np.array(parameter.value)
        on_grid = value.size > 1 and value.size == len(grid)
        value = value[rows] if on_grid else value
        values[key] = value if parameter.unit is None else value * parameter.unit
    new = leaf.with_parameters(**values)
    for key in leaf.param_names:
        # with the calibration's flags its open directions can be followed; what only a
        # catalogue knows stays as it is
        getattr(new, key).fixed = getattr(source, key).fixed or (source is leaf and not free)
        getattr(new, key).bounds = getattr(source, key).bounds
        getattr(new, key).prior = None
    return new


def _errors(measurement):
    """Return number, rms, mean and scatter of the residuals at each wavelength."""
    residuals, (part,) = measurement.residuals(), measurement.datasets
    groups = [residuals[part.bin_of_datum == b] for b in part.bins]
    nan = np.nan
    columns = {
        "s_standard": [np.sqrt(np.mean(r**2)) if r.size else nan for r in groups],
        "bias": [r.mean() if r.size else nan for r in groups],
        "scatter": [r.std(ddof=1) if r.size > 1 else nan for r in groups],
    }
    table = QTable({"wavelength": part.observations.wavelength, "n": [r.size for r in groups]})
    for key, values in columns.items():
        table[key] = 100 * np.array(values) * u.percent
    return table


def _of_source(calibration, source):
    return [record for record in calibration.datasets if record.source == source]


def _own_s_cv(calibration, source, rows):
    """Return s_cv over the data of the same source, or over all, at each wavelength."""
    same = _of_source(calibration, source) or calibration.datasets
    grid = calibration.wavelength.to_value(u.nm)
    squares, n = np.zeros(grid.size), np.zeros(grid.size)
    for table in (r.accuracy for r in same if r.accuracy is not None):
        at = np.abs(table["wavelength"].to_value(u.nm)[:, None] - grid).argmin(axis=1)
        s_cv, count = table["s_cv"].to_value(u.percent), np.asarray(table["n"])
        known = np.isfinite(s_cv)
        # mean square over datasets, weighted by their number of data
        np.add.at(squares, at[known], (count * s_cv**2)[known])
        np.add.at(n, at[known], count[known])
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(squares / n)[rows] * u.percent


def _moved_by_open(calibration, measurement, rows):
    """Return by how many percent a step along the open directions moves the prediction."""
    finding, free = calibration.identifiability, measurement.free
    place = {name: i for i, name in enumerate(finding.names)}
    # columns of the finding that belong to the standard's free parameters, at its wavelengths
    columns = []
    for slot in free.slots:
        single = slot.name in place
        names = [slot.name] if single else [f"{slot.name}[{row}]" for row in rows]
        columns += [place[name] for name in names]
    # open directions of the calibration, as far as the standard's chain has the parameters
    null = np.asarray(finding.null_vectors).reshape(-1, len(place))[:, columns]
    moved = (null * physical_scale(free)) @ measurement.jacobian(measurement.vector())
    return float(100 * np.linalg.norm(moved, axis=0).max(initial=0.0))


def _words(table, same_source):
    chi = table["chi"][np.isfinite(table["chi"])]
    words = "no s_cv to compare with"
    if chi.size:
        words = f"errors {np.median(chi):.2g} times s_cv (median over the wavelengths)"
        words += "" if same_source else ", which is that of other sources"
    moved = table.meta["open_percent"]
    if moved > _WORTH_A_WORD * np.nanmedian(table["s_standard"].value):
        words += (
            f"; along what the calibration does not determine the prediction moves by "
            f"up to {moved:.2g} % "
            "a degree, so its gauge counts"
        )
    return words


def add_standard(calibration, chain, observations, positions=None):
    """
    Predict a standard and keep the result with the calibration.

    It goes into ``calibration.fit["standards"]``, and so into summary, JSON and
    file, and into the column ``s_standard`` of the accuracies of datasets with the same
    source. A standard that was there already is replaced.

    Parameters
    ----------
    calibration : Calibration
        The calibration, which is changed; one read from a file will do.
    chain : Optic or `~astropy.modeling.CompoundModel`
        Chain of the standard. Nothing is fitted: optics that the calibration has, by name, take
        its values; the others keep theirs.
    observations : Observations
        The standard: a source, a night or settings that did not take part in the fit.
    positions : dict of str to `~numpy.ndarray`, optional
        Position of every stage in radian, shape (n_frames,).

    Returns
    -------
    `~astropy.table.QTable`
        Columns ``wavelength``; ``n``, the number of data; ``s_standard``, rms of the errors of
        prediction; ``bias``, their mean; ``scatter``, their standard deviation about it; ``s_cv``,
        that of the calibration's data of the same source, or of all; and ``chi``, the ratio
        ``s_standard / s_cv``: 1 where the standard is predicted as well as settings left out of
        the fit. Meta ``name``, ``source``, ``content_hash``, ``n_frames``, ``words``;
        ``open_percent``: by how much the prediction moves, at most, for one degree, micrometre or
        percent along what the calibration does not determine; and ``not_calibrated``: optics whose
        values are those of the chain.

    Raises
    ------
    FitError
        If the observations took part in the fit, or the chain has free parameters of optics that
        were not calibrated.
    ChainError
        If an optic is of another kind than that of the same name.
    ObservationError
        If a wavelength is none of the calibration's.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.calibration import add_standard
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> cal = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> table = add_standard(cal, chain, simulate(chain, charis.wavelength, frames, seed=3))
    >>> u.allclose(cal.accuracy["s_standard"], table["s_standard"])
    True
    """
    table = standard_accuracy(calibration, chain, observations, positions)
    entry = {key: table.meta[key] for key in ("name", "source", "content_hash", "n_frames")}
    entry |= columns(table, "wavelength", "n", "s_standard", "bias", "scatter", "s_cv", "chi")
    entry |= {key: table.meta[key] for key in ("open_percent", "not_calibrated", "words")}
    others = [
        other
        for other in calibration.fit.get("standards", [])
        if other["content_hash"] != entry["content_hash"]
    ]
    calibration.fit["standards"] = [*others, entry]
    for record in (r for r in calibration.datasets if r.accuracy is not None):
        _fill(record, calibration.fit["standards"])
    return table


def _fill(record, standards):
    """Write the rms over all standards of the dataset's source into its accuracies."""
    lam = record.accuracy["wavelength"].to_value(u.nm)
    squares, n = np.zeros(lam.size), np.zeros(lam.size)
    for entry in (s for s in standards if s["source"] == record.source):
        own = np.array(entry["wavelength_nm"])
        pairs = np.abs(lam[:, None] - own) < SAME_WAVELENGTH * own
        count = np.array(entry["n"])
        squares += pairs @ np.where(
            count > 0, count * np.array(entry["s_standard_percent"]) ** 2, 0
        )
        n += pairs @ count
    with np.errstate(divide="ignore", invalid="ignore"):
        record.accuracy["s_standard"] = np.sqrt(squares / n) * u.percent
