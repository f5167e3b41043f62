# Licensed under a 3-clause BSD style license - see LICENSE
"""From science frames to corrected Stokes parameters."""

import warnings
from datetime import UTC, datetime
from functools import partial

import numpy as np

from astropolcal.correction.engine import correct_block, covariance_index, run_blocks
from astropolcal.correction.ideal import ideal_chain
from astropolcal.correction.result import Corrected
from astropolcal.correction.rows import RowModel
from astropolcal.correction.solve import estimator
from astropolcal.correction.systematic import linear_systematic, sampled_systematic
from astropolcal.exceptions import AstropolcalWarning, ObservationError, ParameterError
from astropolcal.observations import OBSERVABLES
from astropolcal.pipeline.headers import check_frames

__all__ = ["MODES", "correct"]

#: The whole Mueller matrix, or instrumental polarization only.
MODES = ("stokes", "ip")

# what a caller can do about frames that do not say enough
_WAYS = {
    "date": "ScienceFrames(..., date=) states it, any_date=True takes any",
    "mode": "ScienceFrames(..., mode={})",
}


def correct(
    calibration,
    frames,
    *,
    mode="stokes",
    observable=None,
    brightness=None,
    components="IQU",
    weights=None,
    max_condition=30.0,
    chain=None,
    interpolate=False,
    open_directions="infinite",
    max_age=None,
    any_date=False,
    n_samples=0,
    seed=None,
    workers=None,
    cluster=None,
    chunk=1,
    progress=False,
    provenance=None,
):
    r"""
    Correct science frames for the polarization of telescope and instrument.

    Parameters
    ----------
    calibration : Calibration or `~astropy.modeling.CompoundModel`
        The calibration; or a chain with known values, which gives no systematic errors.
    frames : ScienceFrames
        The fluxes of both beams, images or spectra.
    mode : {"stokes", "ip"}
        ``"stokes"`` inverts the Mueller matrices of the frames. ``"ip"`` removes only the
        instrumental polarization that the calibration predicts, and takes the instrument for
        ideal in everything else (see `ideal_chain`); for comparison.
    observable : {"intensity", "single", "double"}, optional
        What is fitted: the beams, or their single or double differences and sums. The
        last are blind to what is the same in both frames of a pair, such as a gain that differs
        between the beams. By default what the calibration fitted: single differences, or double
        ones. Frames that have no pairs are fitted by their intensities, with a warning; frames
        that belong to no pair are left out, with a warning.
    brightness : {"measured", "given"}, optional
        How bright the frames were: as their light says (`frame_brightness`), or ``frames.scale``
        and else all the same. By default measured where there is no ``frames.scale``. It is also
        taken as given, with a warning, where there is too little light.
    components : {"IQU", "IQUV"}
        Without V it is taken as zero. With V it is solved for where the frames determine it.
    weights : array_like or "variance", optional
        As for `estimator`; or by the variances of each pixel.
    max_condition : float
        A combination of Stokes parameters is left out if its singular value is smaller than the
        largest by more than this, see `estimator`.
    chain : `~astropy.modeling.CompoundModel`, optional
        All optics from the sky to the detector, with optics named as the calibrated ones; by
        default that of `sky_chain`.
    interpolate : bool
        Whether parameters known at the calibrated wavelengths only are interpolated linearly
        between them; else each wavelength of the frames must be one of the calibrated.
    open_directions : {"infinite", "ignore"} or float
        See `linear_systematic`.
    max_age : `~astropy.units.Quantity`, optional
        Time between the data of the calibration and the frames from which on there is a warning;
        by default that of the instrument, see `~astropolcal.pipeline.load`.
    any_date : bool
        Take the calibration whatever the date of the frames.
    n_samples : int
        If above zero, systematic errors are sampled, see `sampled_systematic`; else they are
        linearized.
    seed : int, optional
        Of the samples.
    workers : int, optional
        Threads of dask among which the wavelengths are divided; by default dask is not used.
    cluster : str, optional
        Address of a ``dask.distributed`` scheduler, which divides them among its processes.
    chunk : int
        Wavelengths that are worked on at a time, more of which need more memory.
    progress : bool
        Whether to show a progress bar; it appears on a terminal only.
    provenance : dict, optional
        What goes into the header of the product besides versions and names of the frames.

    Returns
    -------
    Corrected

    Raises
    ------
    ObservationError
        If the frames do not determine Q and U.
    CalibrationFileError
        If the calibration does not hold for the frames' date and mode, these are not known and
        the calibration does not hold for all, or the instrument has changed in between.
    ParameterError, ChainError, WavelengthRangeError
        If a choice is unknown, a position is missing, or a wavelength is not calibrated.

    Warns
    -----
    AstropolcalWarning
        If the frames have no pairs, or some have none, where the calibration fitted pairs; their
        brightness cannot be measured; combinations of Stokes parameters are poorly determined at
        some wavelengths; the calibration leaves open how they change; or it is old.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import instruments
    >>> from astropolcal.correction import ScienceFrames, correct, measurement_rows
    >>> charis = instruments.get("charis")
    >>> sky = charis.on_sky(charis.published())
    >>> positions = {"hwp": [80, 125, 102.5, 147.5] * u.deg, "derotator": [60] * 4 * u.deg,
    ...              "parallactic": [20] * 4 * u.deg, "altitude": [70] * 4 * u.deg}
    >>> rows = measurement_rows(sky, positions, charis.wavelength)
    >>> right, left = np.moveaxis(rows @ [1000, 20, -10, 0], 1, 2)
    >>> star = correct(sky, ScienceFrames.from_arrays(right, left, charis.wavelength, positions))
    >>> float(star.q[0].round(9)), float(star.u[0].round(9))
    (0.02, -0.01)
    """
    by_variance = _check_choices(mode, weights)
    if hasattr(calibration, "datasets"):
        when = {"max_age": max_age, "dates": not any_date, "ways": _WAYS}
        check_frames(calibration, frames.moments(), "the calibration", **when)
    model = RowModel(
        calibration, frames.positions, frames.wavelength, chain=chain, interpolate=interpolate
    )
    observable, doubts = _observable(calibration, frames, observable)
    how = {
        "components": components,
        "observable": observable,
        "pairs": frames.pairs,
        "weights": None if by_variance else weights,
        "max_condition": max_condition,
        "labels": frames.names,
    }
    rows = model.rows()
    # raises where the frames determine too little, whatever their brightness
    estimator(rows, scale=frames.scale, **how)
    frames, unmeasured = _with_brightness(frames, rows, brightness, how)
    solution = estimator(_rows(model, rows, frames, mode), scale=frames.scale, **how)
    for words in (*doubts, *unmeasured):
        warnings.warn(words, AstropolcalWarning, stacklevel=2)
    _warn_of_weak(solution, frames.wavelength)
    systematic = _systematic(model, solution, mode, open_directions, n_samples, seed)
    n = len(components)
    source = frames.source
    # first the components, then their covariances as the engine lays them out
    planes = n + (len(covariance_index(n)) if source.has_variances else 0)
    out = run_blocks(
        partial(correct_block, source, solution, by_variance=by_variance),
        (planes, source.n_wavelengths, *source.image_shape),
        chunk=chunk,
        workers=workers,
        cluster=cluster,
        progress=progress,
    )
    return Corrected(
        components,
        frames.wavelength,
        out[:n],
        out[n:] if planes > n else None,
        systematic,
        solution.condition,
        solution.determined,
        solution.leakage,
        solution.weak,
        mode,
        observable,
        frames.unit,
        frames.north_up,
        frames.centre,
        frames.pixel_scale,
        _provenance(calibration, frames, systematic, provenance),
    )


def _check_choices(mode, weights):
    """Return whether the variances of the fluxes weight them; refuse what is not known."""
    if mode not in MODES:
        raise ParameterError(f"mode = {mode!r}; allowed are {', '.join(MODES)}")
    by_variance = isinstance(weights, str)
    if by_variance and weights != "variance":
        raise ParameterError(f'weights = {weights!r}; allowed are arrays and "variance"')
    return by_variance


def _observable(calibration, frames, observable):
    """Return what is fitted, by default what the calibration has fitted, and doubts in words."""
    fitted = getattr(calibration, "settings", {}).get("observable")
    if observable is None and fitted in OBSERVABLES:
        observable = "single" if OBSERVABLES[fitted].frames_per_datum == 1 else "double"
        if observable == "double" and frames.pairs is None:
            return "intensity", [
                "the calibration fitted pairs of frames, and these frames have none (half-wave "
                "plate angles 45 deg apart, hwp=): their intensities are fitted, so that unequal "
                "gains of the beams, and what the optics behind the half-wave plate polarize "
                "unknown to the calibration, do not cancel"
            ]
    # of a chain that nobody fitted: what cancels most
    observable = observable or ("intensity" if frames.pairs is None else "double")
    if observable != "double" or frames.pairs is None:
        return observable, []
    names, alone = frames.names, set(range(len(frames.names))) - set(np.ravel(frames.pairs))
    words = f"{len(alone)} of {len(names)} frames have no partner 45 deg away and are left out"
    return observable, [f"{words}; the first is {names[min(alone)]}"] if alone else []


def _with_brightness(frames, rows, brightness, how):
    """Return the frames with measured brightness, unless another is wanted, and doubts in words."""
    if brightness not in (None, "measured", "given"):
        raise ParameterError(f"brightness = {brightness!r}; allowed are 'measured', 'given'")
    if brightness == "given" or (brightness is None and frames.scale is not None):
        return frames, []
    try:
        return frames.with_brightness(rows, **how), []
    except ObservationError as error:
        known = "all the same" if frames.scale is None else "as given"
        return frames, [
            f"the frames' brightness cannot be measured and is taken as {known}: {error}"
        ]


def _rows(model, rows, frames, mode):
    if mode == "stokes":
        return rows
    ideal = RowModel(
        ideal_chain(model.chain, frames.wavelength),
        frames.positions,
        frames.wavelength,
        chain=ideal_chain(model.chain, frames.wavelength),
    )
    # what I adds to each flux is that of the real instrument: the instrumental polarization
    return np.concatenate([rows[..., :1], ideal.rows()[..., 1:]], axis=-1)


def _warn_of_weak(solution, wavelength):
    flags = solution.flags()
    if flags:
        first = next(iter(flags))
        warnings.warn(
            f"poorly determined at {len(flags)} of {len(wavelength)} wavelengths, left out there: "
            f"at {wavelength[first]:.6g} {flags[first]} (condition "
            f"{solution.condition[first]:.3g}, allowed is {solution.max_condition:g})",
            AstropolcalWarning,
            stacklevel=3,
        )


def _systematic(model, solution, mode, open_directions, n_samples, seed):
    if model.calibration is None:
        return None
    if n_samples:
        return sampled_systematic(model, solution, n_samples=n_samples, seed=seed, mode=mode)
    found = linear_systematic(model, solution, mode=mode, open_directions=open_directions)
    if found.is_open:
        warnings.warn(
            "the calibration leaves open how Q and U turn: their systematic errors are infinite. "
            "Ways out: a calibration with priors on what is open (calibrate --prior), or "
            "open_directions (--open-directions) 'ignore' or a standard deviation",
            AstropolcalWarning,
            stacklevel=3,
        )
    return found


def _provenance(calibration, frames, systematic, given):
    import astropy

    from astropolcal.version import version

    known = {
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
        "astropolcal": version,
        "astropy": astropy.__version__,
        "numpy": np.__version__,
        "instrument": getattr(calibration, "instrument", None) or "",
        "systematic": "none" if systematic is None else systematic.method,
        "held": [] if systematic is None else list(systematic.held),
        "frames": [str(name) for name in frames.names],
    }
    return known | dict(frames.meta) | dict(given or {})
