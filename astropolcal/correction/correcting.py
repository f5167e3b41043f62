# Licensed under a 3-clause BSD style license - see LICENSE
"""From science frames to corrected Stokes parameters."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
from numbers import Integral

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

from astropolcal.correction.frames import DEROTATOR_LIMIT, ScienceFrames
from astropolcal.correction.result import Corrected, impossible
from astropolcal.correction.rows import RowModel, ideal_chain, sky_chain
from astropolcal.correction.solve import CHANNELS, Channels, covariance_index, estimator
from astropolcal.correction.systematic import check_choices, linear_systematic, sampled_systematic
from astropolcal.exceptions import AstropolcalError, ObservationError, ParameterError, warn
from astropolcal.files import provenance
from astropolcal.observations import OBSERVABLES
from astropolcal.pipeline.headers import check_frames, faults_of
from astropolcal.pipeline.tasks import ended_tasks
from astropolcal.progress import counting, shown
from astropolcal.words import check_choice, check_type

__all__ = ["correct"]

#: The whole Mueller matrix, or instrumental polarization only.
MODES = ("stokes", "ip")

# share of V in Q or U, of most wavelengths, that is worth a word
_LEAKS = 0.3
# by how much, and how many times its scatter, a frame is brighter at one wavelength than at others
_UNEVEN, _BEYOND = 0.05, 10.0
# times the stated errors, from which on an error that the scatter of the frames shows is told; and
# that of one alone, so many times farther off than the others, of at least so many
_BEYOND_ERRORS, _ONE_ALONE, _APART, _OTHERS = 3.0, 1.0, 6.0, 2
# times the light of one beam that the other one may have beyond what the optics let expect
_UNEQUAL = 2.0
# of I: what the sums of differences of pairs vary by in real stars, gains not being quite steady
_UNSTEADY = 0.005
# what a result keeps of the solution and of the frames
_OF_SOLUTION = ("components", "condition", "determined", "leakage", "weak")
_OF_FRAMES = ("wavelength", "unit", "north_up", "centre", "pixel_scale")
# what a caller can do about frames that do not say enough
_WAYS = {
    "date": "ScienceFrames(..., date=) states it, any_date=True takes any",
    "mode": "ScienceFrames(..., mode={})",
}
_BIASED = (
    "weights by variance: the variances follow the noisy fluxes themselves, so that low fluxes "
    "count too much and I is too small (by 5 % at 20 photons per pixel, 0.5 % at 200); equal "
    "weights are not biased"
)
_OPEN = (
    "the calibration does not determine how Q and U turn: their systematic errors are infinite. "
    "Ways out: a calibration with priors on what is open (calibrate --prior), or open_directions "
    "(--open-directions) 'ignore' or a standard deviation"
)


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
    chunk=None,
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
        ideal in everything else, as `~astropolcal.correction.ideal_chain` makes it; for comparison.
    observable : {"intensity", "single", "double"}, optional
        What is fitted: the beams, or their single or double differences and sums. Single beams are
        fitted by their intensities. The last are blind to what is the same in both frames of a
        pair, such as a gain that differs between the beams. By default what the calibration fitted:
        single differences, or double ones. Frames that have no pairs are fitted by their
        intensities, with a warning; frames that belong to no pair are left out, with a warning.
    brightness : {"measured", "given"}, optional
        How bright the frames were: as their light says, or ``frames.scale`` and else all the same.
        By default measured where there is no ``frames.scale``. It is also taken as given, with a
        warning, where there is too little light.
    components : {"IQU", "IQUV"}
        Without V it is taken as zero. With V it is solved for where the frames determine it.
    weights : array_like or "variance", optional
        Inverse variances of the fluxes, (n_frames,), (n_wavelengths, n_frames) or (2,
        n_wavelengths, n_frames); or by the variances of each pixel. Those that follow the noisy
        flux itself make I of faint light too small.
    max_condition : float
        A combination of Stokes parameters is left out if its singular value is smaller than the
        largest by more than this.
    chain : `~astropy.modeling.CompoundModel`, optional
        All optics from the sky to the detector, with optics named as the calibrated ones; by
        default that of a star that was calibrated, or the instrument's from the sky.
    interpolate : bool
        Whether parameters known at the calibrated wavelengths only are interpolated linearly
        between them; else each wavelength of the frames must be one of the calibrated.
    open_directions : {"infinite", "ignore"} or float
        Errors along directions that the calibration does not determine: infinite; zero, as if the
        choice that it made were true; or the standard deviation of the parameter that each
        direction is named after (``calibration.identifiability.directions``), in degrees of an
        angle, micrometres of a thickness, percent of anything else. All that cannot be
        distinguished from it moves along.
    max_age : `~astropy.units.Quantity`, optional
        Time between the data of the calibration and the frames from which on there is a warning;
        by default that of the instrument, see `~astropolcal.pipeline.load`.
    any_date : bool
        Take the calibration regardless of the date of the frames.
    n_samples : int
        If above zero, systematic errors are those of solving again for so many samples of the
        calibration's posterior, or covariance; else they are linearized.
    seed : int, optional
        Of the samples.
    workers : int, optional
        Threads among which the wavelengths are divided.
    cluster : str, optional
        Address of a ``dask.distributed`` scheduler, among whose workers the frames are divided.
    chunk : int, optional
        Wavelengths that are worked on at a time, more of which need more memory; by default one,
        and all on a cluster.
    progress : bool
        Whether to show how far it is; on a terminal only.
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
        If the calibration is not usable, as its verdict says; the frames have no pairs, or some
        have none, where pairs are to be fitted; their brightness cannot be measured, or differs at
        one wavelength from others; they disagree by more than all errors allow for; one beam has
        more than twice the light of the other; variances as weights follow the measured fluxes;
        combinations of Stokes parameters are poorly determined at some wavelengths; the calibration
        does not determine how they change; it is old; or a spectrum is polarized by more than
        100 %.

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
    by_variance, given = isinstance(weights, str), frames
    _check(frames, mode, weights, open_directions, n_samples, seed)
    provenance = dict(provenance or {})
    if hasattr(calibration, "datasets"):
        faults = faults_of(calibration, provenance.get("calibration", "the calibration"))
        provenance["calibration_faults"] = faults
        chain = _chain_at(calibration, frames, chain, max_age=max_age, dates=not any_date)
    model = RowModel(
        calibration, frames.positions, frames.wavelength, chain=chain, interpolate=interpolate
    )
    observable, doubts = _observable(calibration, frames, observable)
    how = {"components": components, "observable": observable, "max_condition": max_condition}
    how |= {"pairs": frames.pairs, "labels": frames.names}
    how["weights"] = None if by_variance else weights
    frames, solution, unmeasured = _estimated(model, frames, brightness, how, mode)
    systematic = _systematic(model, solution, mode, open_directions, n_samples, seed)
    unmeasured += _of_errors(systematic, by_variance, frames.source) + _unequal(solution, given)
    unmeasured += _disagreement(solution, given, systematic) if mode == "stokes" else []
    for words in doubts + unmeasured + _mirrored(calibration) + _circular(solution, frames):
        warn(words)
    division = {"chunk": chunk, "workers": workers, "cluster": cluster, "progress": progress}
    found = corrected_planes(frames.source, solution, by_variance, **division)
    n = len(components)
    known = {key: getattr(solution, key) for key in _OF_SOLUTION}
    known |= {key: getattr(frames, key) for key in _OF_FRAMES}
    result = Corrected(
        stokes=found[:n],
        covariance=found[n:] if len(found) > n else None,
        systematic=systematic,
        mode=mode,
        observable=observable,
        resampling=float(getattr(frames.source, "resampling", 1.0)) if len(found) > n else 1.0,
        provenance=_provenance(calibration, frames, systematic, provenance),
        **known,
    )
    # of images single pixels are noise
    return result if found.ndim > 2 else _with_warning(result)


def _with_warning(result):
    """Return spectra, and warn of a polarization that no light has."""
    if words := impossible(result.polarization()):
        warn(f"{words}: too little of I, as of a background that was subtracted twice, or angles")
    return result


def _of_errors(systematic, by_variance, source):
    """Say where errors are open, and what weights by variances that follow the fluxes do."""
    is_open = systematic is not None and systematic.is_open
    return [_OPEN] * is_open + [_BIASED] * (by_variance and getattr(source, "estimated", False))


def _check(frames, mode, weights, *choices):
    check_choices(*choices)
    check_choice("mode", mode, MODES, ParameterError)
    if isinstance(weights, str) and weights != "variance":
        raise ParameterError(f'weights = {weights!r}; allowed are arrays and "variance"')
    wanted = "ScienceFrames are needed, after the calibration"
    check_type("frames", frames, ScienceFrames, wanted, ParameterError)


def _systematic(model, solution, mode, open_directions, n_samples, seed):
    """Return the errors that the calibration makes, None of a chain that nobody fitted."""
    if model.calibration is None:
        return None
    how = {"mode": mode, "open_directions": open_directions}
    if n_samples:
        return sampled_systematic(model, solution, n_samples=n_samples, seed=seed, **how)
    return linear_systematic(model, solution, **how)


def _circular(solution, frames):
    """Say what V does to Q and U where it is taken as zero and they depend on it."""
    # a half-wave plate is there for linear polarization, of light that has hardly any V
    if "hwp" in frames.positions:
        return []
    leaks = np.abs(solution.leakage[:, 1:3][solution.determined[:, 1:3].all(axis=1)])
    if not np.median(leaks.max(axis=1)) > _LEAKS:
        return []
    return [
        f"V is taken as zero: 1 % of V would add up to {leaks.max():.2g} % to Q or U of these "
        'frames; components="IQUV" (--components IQUV) solves for V too'
    ]


def _mirrored(calibration):
    """Say which other solutions of the calibration, as good as it, no systematic error counts."""
    if (getattr(calibration, "fit", None) or {}).get("model_error"):
        # these count among the errors of the model
        return []
    words = "systematic errors do not count another solution: {}"
    mirrors = getattr(getattr(calibration, "identifiability", None), "mirrors", ())
    return [words.format(one) for one in mirrors if "tell the sign" in one]


def _chain_at(calibration, frames, chain, **when):
    """Check that a calibration holds for the frames; return the chain at their dates."""
    moments = frames.moments()
    check_frames(calibration, moments, "the calibration", ways=_WAYS, **when)
    if chain is not None:
        return chain
    # of a telescope that changed
    dates = [date for _, date, _ in moments if date is not None]
    return sky_chain(calibration, date=dates or None)


def _observable(calibration, frames, observable):
    """Return what is fitted, by default what the calibration has fitted, and doubts in words."""
    fitted = getattr(calibration, "settings", {}).get("observable")
    paired, apart = frames.pairs is not None and len(frames.pairs) > 0, "45 deg away"
    if "derotator" in frames.positions:
        apart += f" with the derotator within {DEROTATOR_LIMIT:g}"
    if observable is None and frames.groups is not None and not paired:
        # beams that have no partner with which they could be compared
        observable = "intensity"
    elif observable is None:
        # of a chain that nobody fitted: what cancels most
        observable = "intensity" if frames.pairs is None else "double"
        if fitted in OBSERVABLES:
            observable = "single" if OBSERVABLES[fitted].frames_per_datum == 1 else "double"
        if observable == "double" and not paired:
            return "intensity", [
                "double differences need pairs of frames, and these frames have none (half-wave "
                f"plate {apart}, hwp=): their intensities are fitted, so that unequal "
                "gains of the beams, and what the optics downstream of the half-wave plate "
                "polarize unknown to the calibration, do not cancel"
            ]
    if observable != "double" or not paired:
        return observable, []
    names, alone = frames.names, set(range(len(frames.names))) - set(np.ravel(frames.pairs))
    words = f"{len(alone)} of {len(names)} frames have no partner {apart} and are left out"
    return observable, [f"{words}; the first is {names[min(alone)]}"] if alone else []


def _estimated(model, frames, brightness, how, mode):
    """Return the frames with their brightness, their solution, and what is to be said of it."""
    rows = model.rows()
    # raises where the frames determine too little, whatever their brightness
    estimator(rows, scale=frames.scale, **how)
    frames, doubts = _with_brightness(frames, rows, brightness, how)
    if mode != "stokes":
        ideal = ideal_chain(model.chain, frames.wavelength)
        ideal = RowModel(ideal, frames.positions, frames.wavelength, chain=ideal).rows()
        # what I adds to each flux is that of the real instrument: the instrumental polarization
        rows = np.concatenate([rows[..., :1], ideal[..., 1:]], axis=-1)
    solution = estimator(rows, scale=frames.scale, **how)
    weak = [w for w, words in enumerate(solution.weak) if words]
    if weak:
        doubts += [
            f"poorly determined at {len(weak)} of {len(solution.weak)} wavelengths, left out "
            f"there: at {frames.wavelength[weak[0]]:.6g} {solution.weak[weak[0]]} (condition "
            f"{solution.condition[weak[0]]:.3g}, allowed is {how['max_condition']:g})"
        ]
    return frames, solution, doubts


def _with_brightness(frames, rows, brightness, how):
    """Return the frames with measured brightness, unless another is wanted, and doubts in words."""
    check_choice("brightness", brightness, (None, "measured", "given"), ParameterError)
    if brightness == "given" or (brightness is None and frames.scale is not None):
        return frames, []
    try:
        found = frames.with_brightness(rows, **how)
        return found, _uneven(found)
    except ObservationError as error:
        known = "all the same" if frames.scale is None else "as given"
        return frames, [
            f"the frames' brightness cannot be measured and is taken as {known}: {error}"
        ]


def _uneven(frames):
    """Say which frame has light at one wavelength that it lacks at others, as a cosmic ray is."""
    if len(frames.wavelength) < 3:
        return []
    ratio = frames.scale / np.median(frames.scale, axis=0)
    apart = ratio / np.median(ratio, axis=1, keepdims=True) - 1
    # without light it is one
    size = np.where(frames.scale == 1, 0.0, np.abs(apart))
    # the usual scatter at this wavelength, and of this frame
    usual = np.maximum(np.median(size, axis=1, keepdims=True), np.median(size, axis=0))
    size[size < np.maximum(_UNEVEN, _BEYOND * usual)] = 0.0
    if not size.any():
        return []
    w, f = np.unravel_index(np.argmax(size), size.shape)
    return [
        f"brightness: {np.count_nonzero(size)} of {size.size} frames and wavelengths differ from "
        f"the others, most {frames.names[f]} at {frames.wavelength[w]:.6g}, by "
        f"{100 * apart[w, f]:+.2g} %, which changes q and u of all pixels there; mask cosmic rays "
        "and bad pixels (NaN)"
    ]


def _unequal(solution, frames):
    """Say that one beam has far more light, in all frames together, than the solution says."""
    if frames.groups is not None:
        # of single beams
        return []
    light = np.nan_to_num(frames._light[0])
    stokes = np.nan_to_num(solution.apply(light))
    expected = np.einsum("bwfs,sw->bw", solution.rows[..., : len(stokes)], stokes)
    right, left = light.sum(axis=1) * expected[::-1]
    good = (right > 0) & (left > 0)
    ratio = np.median(right[good] / left[good]) if good.any() else 1.0
    if 1 / _UNEQUAL < ratio < _UNEQUAL:
        return []
    return [
        f"the right beam has {ratio:.2g} times the light of the left one, beyond what the optics "
        "make of it, so that q and u are too small: is BUNIT, the gain or the exposure time of one "
        "of them wrong?"
    ]


def _disagreement(solution, frames, systematic):
    """Say that the light of the frames is off the solution by more than the errors allow for.

    A solution for an ideal instrument is off for that alone.
    """
    light, noise = map(np.nan_to_num, frames._light)
    stokes, channels = np.nan_to_num(solution.apply(light)), solution.channels
    off = light - np.einsum("bwfs,sw->bfw", solution.rows[..., : len(stokes)], stokes)
    units, used = channels.units, solution.weights[0].T > 0
    # a wavelength at which a frame has no light, or no error, tells nothing
    seen = (noise > 0).all(axis=0)[units].all(axis=1)
    good = (stokes[0] > 0) & (seen | ~used).all(axis=0)
    good &= solution.determined[:, :3].all(axis=1)
    if not good.any():
        return []
    bright, used = stokes[0, good], used[:, good]
    # of q and u: what noise does, and the calibration
    own = np.einsum("wkbf,bfw->w", solution.gain[:, 1:3] ** 2, noise)[good] / bright**2 / 2
    known = np.zeros_like(own)
    if systematic is not None:
        known = [systematic.covariance(stokes[:, w], w) for w in np.flatnonzero(good)]
        known = np.diagonal(known, axis1=1, axis2=2)[:, 1:3].mean(axis=1) / bright**2
        known = np.nan_to_num(known, posinf=0.0)
    # of the difference of the beams: the brightness of a frame takes up their sum
    shares = CHANNELS["single" if channels.observable == "intensity" else channels.observable][0]
    bright = bright * solution.scale.T[:, good]
    off, noise = (off[..., good] / bright)[:, units], (noise[..., good] / bright**2)[:, units]
    noise = np.where(used, np.einsum("bk,buk...->u...", shares**2, noise), 1.0)
    apart = np.where(used, np.einsum("bk,buk...->u...", shares, off), 0.0)
    names = [" and ".join(str(frames.names[i]) for i in unit) for unit in units]
    lost = len(stokes) - 1 + (0 if frames.groups is None else len(np.unique(frames.groups)))
    what = "differences of their beams are {:.2g} % of I off the solution"
    told = _beyond(what, names, apart, noise, used.sum(axis=0) - lost, own, known)
    if told or channels.observable != "double" or frames.groups is not None:
        return told
    # what double differences do not contain, and beams or states that are exchanged turn them into:
    # regardless of the gains, it is the same in all pairs of a state
    apart = np.where(used, np.einsum("bk,buk...->u...", shares * [1, -1], off), 0.0)
    states = np.atleast_2d(frames.positions.get("flc_state", 0.0))[0]
    states = np.broadcast_to(states, channels.n_frames)[units[:, 0]]
    same = np.equal.outer(states, states)
    apart -= used * (same @ apart) / np.maximum(same @ used.astype(float), 1)
    # of each pair that of its state which is farthest from it
    product = apart @ apart.T
    far = np.where(same, np.diag(product) - 2 * product, -np.inf).argmax(axis=1)
    names = [f"{name} against those of {names[i]}" for name, i in zip(names, far, strict=True)]
    free = used.sum(axis=0) - len(np.unique(states))
    what = "sums of the differences of pairs are {:.2g} % of I apart"
    return _beyond(what, names, apart, noise, free, own, known, least=_UNSTEADY)


def _beyond(what, names, off, noise, free, own, known, least=0.0):
    """Return in words that data are off by more than the errors of q and u, and all by ``least``.

    ``off`` and the variances ``noise`` of the data have shape (n_units, n_wavelengths), ``free``
    is the degrees of freedom of each wavelength.
    """
    kept = free > 0
    off, noise, free, own, known = (x[..., kept] for x in (off, noise, free, own, known))
    if not free.size:
        return []
    n = free.size
    means = [each.mean(axis=-1, keepdims=True) for each in (off, noise / n, own / n, known)]
    for each, spread, error, systematic, number, of in (
        (off, noise, own, known, free, ""),
        (*means, free.min(keepdims=True), ", in the mean of the wavelengths"),
    ):
        square = each**2 / spread
        # what the scatter beyond chance makes of the error by noise, of all of the error squared
        share = error / (error + systematic)
        beyond = square.sum(axis=0) @ share - 4 * np.sqrt(2 * number @ share**2)
        beyond = max(beyond, 0.0) / number.sum()
        real = np.where(each, each**2 - spread, 0.0)
        told, count = np.arange(len(each)), number.sum()
        if beyond <= _BEYOND_ERRORS**2 or real.sum() <= count * least**2:
            if number.min() <= _OTHERS:
                continue
            # one that is off draws the solution to itself
            alone = (square * np.count_nonzero(each, axis=0) / number) @ share
            told, count = [np.argmax(alone)], number.size
            rest = (square.sum(axis=0) @ share - alone.max()) / ((number - 1) @ share)
            beyond = alone.max() / number.sum()
            apart = alone.max() > _APART**2 * max(rest, 1.0) * share.sum()
            if not apart or beyond <= _ONE_ALONE or real[told].sum() <= count * least**2:
                continue
        usual = 100 * np.sqrt(np.median(error + systematic))
        return [
            "the frames disagree: "
            f"{what.format(100 * np.sqrt((each[told] ** 2).sum() / count))}, "
            f"{np.sqrt(square[told].sum() / count):.2g} times their noise{of}, most those of "
            f"{names[told[np.argmax(square[told].sum(axis=1))]]}; q and u may be "
            f"wrong by {usual * np.sqrt(beyond):.2g} %, and their errors, {usual:.2g} %, are too "
            "small"
        ]
    return []


def _provenance(calibration, frames, systematic, given):
    known = {
        "instrument": getattr(calibration, "instrument", None) or "",
        "systematic": "none" if systematic is None else systematic.method,
        "held": [] if systematic is None else list(systematic.held),
        "frames": [str(name) for name in frames.names],
    }
    return provenance() | known | dict(frames.meta) | given


# ---- the sum over frames, in bounded memory ------------------------------------------------------
# A block is a range of wavelengths: its frames are read a few at a time and added to its images.
# Wavelengths do not depend on each other, and the same frames are added in the same order always,
# so the numbers do not depend on how the work is divided.

# frames, or pairs of them, whose sum is one task of a cluster
_TOGETHER = 8


def corrected_planes(
    source, solution, by_variance, *, chunk=None, workers=None, cluster=None, progress=False
):
    """Return the Stokes components of every pixel and, of fluxes with variances, their covariances.

    Their shape is (n, n_wavelengths, *image_shape), covariances in the order of
    `covariance_index`. ``by_variance`` weights each pixel by its own variances. ``workers`` threads
    divide the ranges of ``chunk`` wavelengths. With ``cluster``, the address of a scheduler, its
    processes divide the frames, and the range by default is that of all wavelengths.
    """
    for name, value in (("chunk", chunk), ("workers", workers)):
        if value is not None and not (isinstance(value, Integral) and value >= 1):
            raise ParameterError(f"{name} = {value!r}; allowed are whole numbers from 1")
    if by_variance and not source.has_variances:
        raise ParameterError("weights by variance need variances of the fluxes, and there are none")
    size, n, in_order = source.n_wavelengths, len(solution.components), map
    chunk = chunk or (1 if cluster is None else size)
    if cluster is not None:
        in_order, workers = partial(_on_cluster, cluster), 1
    n_planes = n + (len(covariance_index(n)) if source.has_variances else 0)
    out = np.empty((n_planes, size, *source.image_shape))
    with (
        shown(progress),
        counting(0 if cluster else size, "wavelengths") as add,
        ThreadPoolExecutor(workers or 1) as pool,
    ):

        def work(start):
            wavelengths = slice(start, min(start + chunk, size))
            part = out[:, wavelengths]
            part[:] = _block(source, solution, wavelengths, by_variance, in_order, part.shape)
            add(part.shape[1])

        # an error comes out here, and ends what has not begun
        list(pool.map(work, range(0, size, chunk)))
    if not np.isfinite(out[:n]).any():
        raise ObservationError(
            f"{source.names[0]} and the others: no pixel has values, and variances above zero, in "
            "frames enough to determine Q and U"
        )
    return out


def _block(source, solution, wavelengths, by_variance, in_order, shape):
    """Return components and covariances at some wavelengths, of the ``shape`` of their images.

    ``in_order`` calls a function with parts of the frames, and gives the results in the order of
    the parts.
    """
    n = len(solution.components)
    index = covariance_index(n)[: shape[0] - n]
    flat = (*shape[:2], int(np.prod(shape[2:], dtype=int)))
    out = np.full(flat, np.nan if by_variance else 0.0)
    if not by_variance:
        linear = partial(_linear, source, solution, wavelengths, flat)
        for part in in_order(linear, _together(source.batches())):
            out += part
    known = solution.determined[wavelengths]
    # a NaN in any frame makes the sum NaN; such pixels are fitted alone, from the other frames
    bad = ~np.isfinite(out).all(axis=0) & known[:, :3].all(axis=1)[:, None]
    if bad.any():
        equations = partial(_equations, source, solution, wavelengths, bad, by_variance)
        sums = sum(in_order(equations, _together(_independent(solution.channels.units))))
        for i in np.flatnonzero(bad.any(axis=1)):
            # as for all other pixels: where V is not determined it is taken as zero
            solved = 3 if n == 4 and not known[i, 3] else n
            limit = solution.settings["max_condition"]
            found = _solved(sums[..., np.nonzero(bad)[0] == i], solved, limit)
            out[:, i, bad[i]] = found[: len(out)]
    # the components, then their covariances
    for kept, column in enumerate([*((c,) for c in range(n)), *index]):
        out[kept, ~known[:, list(column)].all(axis=1)] = np.nan
    return out.reshape(shape)


def _together(parts):
    return [parts[i : i + _TOGETHER] for i in range(0, len(parts), _TOGETHER)]


def _linear(source, solution, wavelengths, shape, batches):
    """Return the weighted sum over some frames, with the same weights for all pixels."""
    # components that are not determined are made NaN in the end, so here they may be anything
    gain = np.nan_to_num(solution.gain[wavelengths])
    n = gain.shape[1]
    index = np.array(covariance_index(n)).T
    out = np.zeros(shape)
    for frames in batches:
        for beam in (0, 1):
            part = gain[:, :, beam, frames]
            _add(out[:n], part, source.fluxes(beam, frames, wavelengths))
            if source.has_variances:
                # for independent fluxes cov(S_i, S_j) = sum over frames of g_i g_j var(d)
                squares = part[:, index[0]] * part[:, index[1]]
                _add(out[n:], squares, source.variances(beam, frames, wavelengths))
    return out


def _add(out, gain, cubes):
    """Add frames times their gains, wavelength by wavelength."""
    for i in range(out.shape[1]):
        frames = cubes[:, i].reshape(len(cubes), -1)
        with np.errstate(invalid="ignore"):
            out[:, i] += gain[i] @ frames


def _independent(units):
    """Return the numbers of the units, (n, frames), in groups that have no frame in common."""
    count = units.max() + 1
    ends = csr_array((np.ones(len(units)), (units[:, 0], units[:, -1])), shape=(count, count))
    label = connected_components(ends, directed=False)[1][units[:, 0]]
    return [np.flatnonzero(label == one) for one in dict.fromkeys(label.tolist())]


def _equations(source, solution, wavelengths, pixels, by_variance, groups):
    """
    Return the normal equations of pixels that lack some fluxes, summed over some groups of units.

    Of ``pixels``, (n_wavelengths, n_pixels), those that are true: their matrices, what the scatter
    of the data adds to these, and the right sides, (n, n + n + 1, n_true).
    """
    n, of, channels = len(solution.components), np.nonzero(pixels)[0], solution.channels
    sums, shares = np.zeros((n, 2 * n + 1, of.size)), CHANNELS[channels.observable]
    size = channels.units.shape[1]
    alone = Channels(channels.observable, size, [range(size)])

    def beams_of(read, frames, power=1):
        found = [[read(beam, slice(f, f + 1), wavelengths)[0] for f in frames] for beam in (0, 1)]
        found = np.reshape(found, (2, len(frames), *pixels.shape))[..., pixels]
        return found / solution.scale[wavelengths].T[frames][:, of] ** power

    for group in groups:
        # of each beam and frame, what it adds to the right sides, and its variance
        gains, noise = {}, {}
        for unit in group:
            frames = channels.units[unit]
            data = alone.combine(beams_of(source.fluxes, frames))[:, 0]
            if source.has_variances:
                own = beams_of(source.variances, frames, 2)
                variance = alone.combine(own, 2)[:, 0]
                noise |= {(b, f): own[b, k] for b in (0, 1) for k, f in enumerate(frames)}
            for channel in (0, 1):
                row = np.take(solution.channel_rows[channel, wavelengths, unit, :n].T, of, axis=1)
                weight = solution.weights[channel, wavelengths, unit][of]
                good = np.isfinite(data[channel])
                if source.has_variances:
                    good &= np.isfinite(variance[channel]) & (variance[channel] > 0)
                    if by_variance:
                        with np.errstate(divide="ignore", invalid="ignore"):
                            # a flux that the user gave the weight zero stays out
                            weight = (weight > 0) / variance[channel]
                weighted = row * np.where(good, weight, 0.0)
                sums[:, :n] += row[:, None] * weighted
                sums[:, 2 * n] += weighted * np.where(good, data[channel], 0.0)
                for beam, k in zip(*np.nonzero(shares[channel]), strict=True):
                    key = (beam, frames[k])
                    gains[key] = gains.get(key, 0.0) + shares[channel, beam, k] * weighted
        for key, variance in noise.items():
            # A^T W V W A, right for any weights, and channels that share a flux
            scatter = gains[key] * np.nan_to_num(variance, posinf=0.0)
            sums[:, n : 2 * n] += gains[key][:, None] * scatter
    return sums


def _solved(sums, solved, max_condition):
    """Return components and covariances of pixels; NaN where they are poorly determined."""
    n = len(sums)
    sums = np.moveaxis(sums, -1, 0)[:, :solved]
    matrix, spread = sums[..., :solved], sums[..., n : n + solved]
    # eigenvalues of A^T W A are the squares of the singular values of the rows
    values = np.linalg.eigvalsh(matrix)
    good = values[:, 0] * max_condition**2 > values[:, -1]
    inverse = np.full(matrix.shape, np.nan)
    inverse[good] = np.linalg.inv(matrix[good])
    index = covariance_index(n)
    out = np.full((n + len(index), len(matrix)), np.nan)
    out[:solved] = np.einsum("pij,pj->ip", inverse, sums[..., 2 * n])
    # (A^T W A)^-1 A^T W V W A (A^T W A)^-1, right for any weights W
    covariance = inverse @ spread @ inverse
    for plane, (i, j) in enumerate(index, start=n):
        if max(i, j) < solved:
            out[plane] = covariance[:, i, j]
    return out


def _on_cluster(address, function, parts):
    """Yield the results of a function in the order of its arguments."""
    waiting, due = {}, 0
    with counting(len(parts), "groups of frames") as add:
        for ended in ended_tasks(partial(_numbered, function), enumerate(parts), cluster=address):
            if ended.reason:
                raise AstropolcalError(ended.reason)
            waiting[ended.task[0]] = ended.result
            add()
            while due in waiting:
                yield waiting.pop(due)
                due += 1


def _numbered(function, task):
    return function(task[1])
