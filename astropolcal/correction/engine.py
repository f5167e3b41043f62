# Licensed under a 3-clause BSD style license - see LICENSE
"""
The sum over frames, in bounded memory, with or without dask.

A block is a range of wavelengths: its frames are read a few at a time and added to its images.
Wavelengths do not depend on each other and frames are added in the same order always, so the
numbers do not depend on how the work is divided.
"""

from functools import partial
from itertools import combinations_with_replacement
from uuid import uuid4

import numpy as np

from astropolcal.exceptions import AstropolcalError, ParameterError

__all__ = ["correct_block", "covariance_index", "run_blocks"]

# seconds in which a cluster must answer
_TIMEOUT = 10


def covariance_index(n_components):
    """
    Return the pairs of components whose covariances are kept, in order.

    Parameters
    ----------
    n_components : int
        3 or 4.

    Returns
    -------
    list of (int, int)

    Examples
    --------
    >>> from astropolcal.correction.engine import covariance_index
    >>> covariance_index(3)
    [(0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)]
    """
    return list(combinations_with_replacement(range(n_components), 2))


def correct_block(source, solution, start, stop, by_variance=False):
    """
    Return the Stokes parameters of a range of wavelengths, and their covariances.

    Parameters
    ----------
    source : ArraySource, TurnedSource or CubeFiles
        The fluxes.
    solution : Estimator
        What turns them into Stokes parameters.
    start, stop : int
        The wavelengths.
    by_variance : bool
        Whether each pixel is weighted by its own variances.

    Returns
    -------
    `~numpy.ndarray`
        Shape (n, stop - start, ...): the components, then, if the fluxes have variances, their
        covariances in the order of `covariance_index`.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal import optics
    >>> from astropolcal.correction import estimator, measurement_rows
    >>> from astropolcal.correction.engine import correct_block
    >>> from astropolcal.correction.sources import ArraySource
    >>> chain = optics.LinearRetarder(retardance=180 * u.deg, mount="hwp", name="hwp")
    >>> chain = chain | optics.WollastonPrism(name="wollaston")
    >>> rows = measurement_rows(chain, {"hwp": [0, 22.5] * u.deg}, [1.6] * u.um)
    >>> source = ArraySource(np.array([[1.0], [0.5]]), np.array([[0.0], [0.5]]))
    >>> correct_block(source, estimator(rows), 0, 1).round(12).tolist()
    [[1.0], [1.0], [0.0]]
    """
    if by_variance and not source.has_variances:
        raise ParameterError("weights by variance need variances of the fluxes, and there are none")
    n = len(solution.components)
    wavelengths = slice(start, stop)
    n_pixels = int(np.prod(source.image_shape, dtype=int))
    n_out = n + (len(covariance_index(n)) if source.has_variances else 0)
    if by_variance:
        out = np.full((n_out, stop - start, n_pixels), np.nan)
    else:
        out = _linear(source, solution, wavelengths, n_out, n_pixels)
    known = solution.determined[wavelengths]
    for i, w in enumerate(range(start, stop)):
        bad = ~np.isfinite(out[:, i]).all(axis=0)
        # a NaN in any frame makes the sum NaN; such pixels are fitted alone, from the other frames
        if bad.any() and known[i, :3].all():
            out[:, i, bad] = _pixel_by_pixel(source, solution, w, bad, n_out, by_variance)
        for kept, column in _columns(n, n_out):
            out[kept, i] = out[kept, i] if known[i, list(column)].all() else np.nan
    return out.reshape(n_out, stop - start, *source.image_shape)


def _columns(n, n_out):
    """Yield what the planes of the result are about."""
    yield from enumerate([(i,) for i in range(n)] + covariance_index(n)[: n_out - n])


def _linear(source, solution, wavelengths, n_out, n_pixels):
    """Return the weighted sum over frames, with the same weights for all pixels."""
    # components that are not determined are made NaN in the end, so here they may be anything
    gain = np.nan_to_num(solution.gain[wavelengths])
    n, count = gain.shape[1], len(gain)
    index = np.array(covariance_index(n)).T
    out = np.zeros((n_out, count, n_pixels))
    for frames in source.batches():
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


def _pixel_by_pixel(source, solution, w, pixels, n_out, by_variance):
    """Return what a least-squares fit gives of pixels that lack some fluxes."""
    n = len(solution.components)
    # as for all other pixels: where V is not determined it is taken as zero
    solved = 3 if n == 4 and not solution.determined[w, 3] else n
    index = covariance_index(solved)
    size = int(pixels.sum())
    normal, spread = np.zeros((2, len(index), size))
    right = np.zeros((solved, size))
    for unit, frames in enumerate(solution.channels.units):
        data, variance = _unit(source, solution.channels, frames, w, pixels)
        for channel in (0, 1):
            row = solution.channel_rows[channel, w, unit, :solved]
            weight = solution.weights[channel, w, unit]
            good = np.isfinite(data[channel])
            if variance is not None:
                good &= np.isfinite(variance[channel]) & (variance[channel] > 0)
                if by_variance:
                    with np.errstate(divide="ignore", invalid="ignore"):
                        # a flux that the user gave the weight zero stays out
                        weight = (weight > 0) / variance[channel]
            weight = np.where(good, weight, 0.0)
            right += row[:, None] * (weight * np.where(good, data[channel], 0.0))
            products = np.array([row[i] * row[j] for i, j in index])[:, None]
            normal += products * weight
            if variance is not None:
                # A^T W V W A: with W = 1 / V it is the normal matrix itself
                spread += products * (weight**2 * np.where(good, variance[channel], 0.0))
    return _solved(normal, right, spread, n, n_out, solution.max_condition)


def _unit(source, channels, frames, w, pixels):
    """Return the channels of one unit and their variances, of some pixels at a wavelength."""

    def read(method):
        return [
            [method(beam, slice(f, f + 1), slice(w, w + 1)).reshape(-1)[pixels] for beam in (0, 1)]
            for f in frames
        ]

    data = channels.of_unit(read(source.fluxes))
    variance = None
    if source.has_variances:
        variance = channels.variance_of_unit(read(source.variances))
    return data, variance


def _solved(normal, right, spread, n, n_out, max_condition):
    """Solve the normal equations of all pixels; NaN where they are poorly determined."""
    solved, size = right.shape
    matrix = _full(normal, solved)
    # eigenvalues of A^T W A are the squares of the singular values of the rows
    values = np.linalg.eigvalsh(matrix)
    good = values[:, 0] * max_condition**2 > values[:, -1]
    inverse = np.full((size, solved, solved), np.nan)
    inverse[good] = np.linalg.inv(matrix[good])
    out = np.full((n_out, size), np.nan)
    out[:solved] = np.einsum("pij,jp->ip", inverse, right)
    if n_out > n:
        # (A^T W A)^-1 A^T W V W A (A^T W A)^-1, right for any weights W
        covariance = inverse @ _full(spread, solved) @ inverse
        for plane, (i, j) in enumerate(covariance_index(n), start=n):
            if max(i, j) < solved:
                out[plane] = covariance[:, i, j]
    return out


def _full(planes, n):
    """Return symmetric matrices, (n_pixels, n, n), of their upper triangles."""
    matrix = np.empty((planes.shape[1], n, n))
    for plane, (i, j) in zip(planes, covariance_index(n), strict=True):
        matrix[:, i, j] = matrix[:, j, i] = plane
    return matrix


# ---- dividing the work -----------------------------------------------------------------------


def run_blocks(block, shape, *, chunk=1, workers=None, cluster=None, progress=False):
    """
    Run a function on ranges of wavelengths and put the results together.

    Parameters
    ----------
    block : callable
        Called with start and stop; returns an array of shape (n, stop - start, ...).
    shape : tuple of int
        Of the result, (n, n_wavelengths, ...).
    chunk : int
        Wavelengths of a block.
    workers : int, optional
        Threads of dask; by default dask is not used.
    cluster : str, optional
        Address of a ``dask.distributed`` scheduler.
    progress : bool
        Whether to show a progress bar; it appears on a terminal only.

    Returns
    -------
    `~numpy.ndarray`

    Raises
    ------
    ParameterError
        If a number is not positive.
    AstropolcalError
        If dask is needed and not installed, or the cluster cannot be reached.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.correction.engine import run_blocks
    >>> run_blocks(lambda start, stop: np.arange(start, stop)[None] ** 2.0, (1, 3)).tolist()
    [[0.0, 1.0, 4.0]]
    """
    from tqdm import tqdm

    for name, value in (("chunk", chunk), ("workers", workers)):
        if value is not None and not value >= 1:
            raise ParameterError(f"{name} = {value}; it must be at least 1")
    out = np.empty(shape)
    ranges = [(i, min(i + chunk, shape[1])) for i in range(0, shape[1], chunk)]
    with tqdm(
        total=shape[1], desc="correcting", unit="slice", disable=None if progress else True
    ) as bar:

        def keep(limits, result):
            out[:, limits[0] : limits[1]] = result
            bar.update(limits[1] - limits[0])

        if workers is None and cluster is None:
            for limits in ranges:
                keep(limits, block(*limits))
        elif cluster is None:
            _with_threads(partial(_planned, block, ranges, shape), ranges, workers, keep)
        else:
            _with_cluster(partial(_planned, block, ranges, shape), ranges, cluster, keep)
    return out


def _planned(block, ranges, shape):
    """Return one delayed result a range, of dask's map_blocks."""
    import dask.array as da

    # the array of dask holds the numbers of the wavelengths only; the block reads its fluxes itself
    numbers = da.arange(shape[1], chunks=(tuple(b - a for a, b in ranges),))
    new_axes = [0, *range(2, len(shape))]
    chunks = ((shape[0],), numbers.chunks[0], *((size,) for size in shape[2:]))
    planned = numbers.map_blocks(
        partial(_of_numbers, block),
        new_axis=new_axes,
        chunks=chunks,
        # without a name and a kind dask would look through all of the data, and call the block
        name=f"correct-{uuid4().hex}",
        meta=np.empty((0,) * len(shape)),
    )
    return list(planned.to_delayed().ravel())


def _of_numbers(block, numbers):
    return block(int(numbers[0]), int(numbers[-1]) + 1)


def _need_dask():
    try:
        import dask.array  # noqa: F401
    except ImportError:
        raise AstropolcalError(
            'workers and cluster need dask, which is not installed: pip install "astropolcal[dask]"'
        ) from None


def _with_threads(plan, ranges, workers, keep):
    _need_dask()
    import dask

    tasks = [dask.delayed(keep)(limits, part) for limits, part in zip(ranges, plan(), strict=True)]
    dask.compute(*tasks, scheduler="threads", num_workers=workers)


def _with_cluster(plan, ranges, cluster, keep):
    _need_dask()
    try:
        from distributed import Client, as_completed

        client = Client(cluster, timeout=_TIMEOUT)
    except (ImportError, OSError, ValueError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise AstropolcalError(f"cluster {cluster}: cannot be used: {reason}") from error
    with client:
        futures = client.compute(plan())
        places = dict(zip((future.key for future in futures), ranges, strict=True))
        for future, result in as_completed(futures, with_results=True):
            keep(places[future.key], result)
            # results of many images must not stay in the memory of the cluster
            future.release()
