# Licensed under a 3-clause BSD style license - see LICENSE
"""
Simulated image cubes: both beams of any chain, as FITS files of an instrument.

The fluxes of the beams are those of `astropolcal.simulation.simulate`. A star is an image with a
core and a halo in each beam, the internal source a flat field; both are seen through the field
stop, of which the beam splitter makes two images.
"""

import os
import re
from dataclasses import dataclass, replace
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.io import fits
from astropy.table import QTable
from astropy.time import Time
from scipy import ndimage

from astropolcal.chain import stages
from astropolcal.exceptions import (
    InstrumentError,
    ObservationError,
    ParameterError,
    warn,
)
from astropolcal.files import atomic_path, check_new, understood
from astropolcal.instruments.layout import TEXTS, unit_of
from astropolcal.observations import Observations
from astropolcal.observations.pointings import offline, tracked
from astropolcal.progress import shown, steps
from astropolcal.reduction.photometry import rectangles, turned
from astropolcal.reduction.wings import HALO_BETA
from astropolcal.simulation import check_electrons, entering_flux, expected_fluxes, simulate
from astropolcal.units import angle_to_rad, check_seed
from astropolcal.words import check_choice

__all__ = [
    "CubeFiles",
    "DetectorModel",
    "ImageModel",
    "both_states",
    "simulate_cubes",
    "true_observations",
]

_SOURCES = ("internal", "star")


@dataclass(frozen=True)
class ImageModel:
    """
    How the light of simulated cubes falls on the detector.

    Parameters
    ----------
    psf : {"moffat", "gaussian"}
        Profile of a star's core.
    fwhm : float, array_like or `~astropy.units.Quantity`
        Full width of the core at half maximum; pixels, or an angle on the sky.
    beta : float
        Exponent of a Moffat core.
    halo : float
        Share of the light in the halo, a Moffat profile with wings as of seeing.
    halo_fwhm : float or `~astropy.units.Quantity`
        Full width of the halo at half maximum.
    centre : (float, float), optional
        Place of the star in the left beam, 0-based x and y; by default the middle of the field.
    motion : float or `~astropy.units.Quantity`
        Standard deviation of the place from frame to frame, in x and in y.
    seeing : float
        Relative standard deviation of ``fwhm`` from frame to frame.
    margin : float
        How far the field stop lies outside the apertures of the layout, pixels; the only one
        of these that matters for the internal source.

    Examples
    --------
    >>> from astropolcal.reduction import ImageModel
    >>> ImageModel(fwhm=4.0, halo=0.1).psf
    'moffat'
    """

    psf: str = "moffat"
    fwhm: object = 5.0
    beta: float = 3.0
    halo: float = 0.0
    halo_fwhm: object = 30.0
    centre: tuple | None = None
    motion: object = 0.0
    seeing: float = 0.0
    margin: float = 6.0

    def _places(self, rng, scene, layout, n_frames):
        """Return the place of the star and the factor of its width, in each frame."""
        centre = np.asarray(scene.centre if self.centre is None else self.centre, dtype=float)
        if centre.shape != (2,) or not np.all(np.isfinite(centre)):
            raise ParameterError(f"centre = {centre}; two numbers are needed, x and y")
        motion = float(pixels("motion", self.motion, layout, 1, least=0.0)[0])
        centres = centre + motion * rng.standard_normal((n_frames, 2))
        # a star beside the image would leave dark cubes
        scene.check_places(centres)
        # log-normal: a width cannot become negative
        return centres, np.exp(number("seeing", self.seeing) * rng.standard_normal(n_frames))


@dataclass(frozen=True)
class DetectorModel:
    """
    What the detector of simulated cubes does to the light.

    Parameters
    ----------
    background : float or array_like
        In adu per pixel, scalar or one value per wavelength.
    gain, read_noise : float, optional
        Electrons per adu, and electrons per pixel; by default as the layout's ``read_out`` says.
    noise : bool
        Whether to draw noise; the variances are given either way.
    saturate : bool
        Whether pixels are cut off at the layout's ``saturation``.
    bad_pixels : float
        Share of the pixels without a value: NaN, with zero inverse variance.
    flat_error : float
        Relative standard deviation of the pixels' response, the same in all frames.

    Examples
    --------
    >>> from astropolcal.reduction import DetectorModel
    >>> DetectorModel(bad_pixels=1e-3).noise
    True
    """

    background: object = 0.0
    gain: float | None = None
    read_noise: float | None = None
    noise: bool = True
    saturate: bool = False
    bad_pixels: float = 0.0
    flat_error: float = 0.0

    def _read_by(self, how, n_wavelengths):
        """Return the way in which the detector is read out, and the background (W, 1, 1)."""
        gain = how.gain if self.gain is None else self.gain
        noise = how.read_noise if self.read_noise is None else self.read_noise
        how = replace(
            how,
            gain=number("gain", gain, above=0.0),
            read_noise=number("read_noise", noise),
            saturation=how.saturation if self.saturate else np.inf,
        )
        return how, per_wavelength("background", self.background, n_wavelengths)[:, None, None]

    def _pixels(self, rng, shape):
        """Return the response of the pixels of a cube, and which of them are bad."""
        spread = number("flat_error", self.flat_error, most=0.5)
        share = number("bad_pixels", self.bad_pixels, most=0.9)
        # negative responses do not exist; beyond 2 sigma at the most allowed spread
        flat = (1 + spread * rng.standard_normal(shape)).clip(0.0) if spread else 1.0
        return flat, rng.random(shape) < share


@dataclass(frozen=True)
class CubeFiles:
    """
    How the files of simulated cubes are named, and what their headers say.

    Parameters
    ----------
    exposure_time : `~astropy.units.Quantity`
        Of a frame; the frames follow each other without a gap.
    start : str or `~astropy.time.Time`
        Start of the first frame.
    headers : dict, optional
        More keywords and values for all headers.
    raw : bool
        Whether the columns that the layout looks up in raw headers are written
        there only; else they stand in the cubes, and there are no raw headers.
    first : int
        Number of the first frame.
    prefix : str, optional
        What the names of the files begin with; by default as the layout says.
    overwrite : bool
        Whether files that exist are replaced.

    Examples
    --------
    >>> from astropolcal.reduction import CubeFiles
    >>> CubeFiles(first=17).raw
    True
    """

    exposure_time: u.Quantity = 10 * u.s
    start: object = "2025-10-05T08:00:00"
    headers: dict | None = None
    raw: bool = True
    first: int = 1
    prefix: str | None = None
    overwrite: bool = False


def simulate_cubes(
    directory,
    chain,
    instrument,
    frames,
    *,
    wavelength=None,
    source="internal",
    stokes=(1.0, 0.0, 0.0, 0.0),
    flux=None,
    lamp=None,
    image=None,
    detector=None,
    files=None,
    seed=None,
    progress=False,
):
    """
    Write the cubes and raw headers that an instrument would, for a known chain.

    The true fluxes are those of `true_observations`; for stars, the half-wave
    plate stands at the angle of the tracking law.

    Parameters
    ----------
    directory : path-like
        Folder for the cubes, made if only it is absent; raw headers go to its folder ``raw``.
    chain : `~astropy.modeling.CompoundModel`
        The true chain, with a beam splitter.
    instrument : Instrument
        With a `~astropolcal.instruments.FileLayout`.
    frames : `~astropy.table.QTable`
        One row per frame: ``hwp`` as commanded, ``derotator`` and anything else the chain needs;
        for a star ``parallactic`` and ``altitude``. A column ``hwp_true`` replaces the tracking
        law, ``time`` and ``exposure_time`` those of ``files``; ``em_gain`` and ``read_mode`` tell
        how the detector is read out. All columns that the layout has a keyword for are written.
    wavelength : `~astropy.units.Quantity`, optional
        Of the slices; by default the instrument's.
    source : {"internal", "star"}
        What is seen.
    stokes : sequence of float
        Stokes vector of the light that enters the chain.
    flux : float or array_like
        Flux that enters the chain, in adu; scalar or one value per wavelength. Of the internal
        source, what enters through an area as large as an aperture of the layout. By default 1e7,
        or what lights the brightest pixel to half of the saturation where that is less.
    lamp : array_like, optional
        Relative brightness of the source in each frame.
    image : ImageModel, optional
        How the light falls on the detector; by default a Moffat core of 5 pixels.
    detector : DetectorModel, optional
        What the detector does to it; by default photon and read noise only.
    files : CubeFiles, optional
        Names of the files, times and more of their headers.
    seed : int, optional
        Seed of all that is random.
    progress : bool
        Whether to show how far it is; on a terminal only.

    Returns
    -------
    list of `~pathlib.Path`
        The cubes, in the order of the frames.

    Raises
    ------
    ParameterError
        If a number is out of range or of the wrong shape.
    InstrumentError
        If the instrument has no file layout, or one without what the source needs.
    ObservationError
        If a file exists or cannot be written, or a column is missing.

    Warns
    -----
    AstropolcalWarning
        If a pixel is above the layout's saturation and not cut off.

    Examples
    --------
    >>> import tempfile
    >>> import astropy.units as u
    >>> from astropy.io import fits
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction import simulate_cubes
    >>> from astropolcal.simulation import half_wave_plate_cycles
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(hwp=[0, 45] * u.deg)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     paths = simulate_cubes(folder, charis.published(), charis, frames, seed=1)
    ...     fits.getdata(paths[0], 1).shape
    (22, 201, 201)
    """
    image, detector = image or ImageModel(), detector or DetectorModel()
    files = files or CubeFiles()
    layout, wavelength, more = _of_mode(instrument, wavelength)
    # what is given goes before what the mode says
    more |= files.headers or {}
    check_choice("source", source, _SOURCES, ParameterError)
    frames = _with_headers(frames, layout, source, files.exposure_time, files.start)
    n_frames = len(frames)
    scene = Scene(image, layout, source, len(wavelength))
    ways = _read_outs(frames, layout)
    read = [detector._read_by(way, len(wavelength)) for way in ways]
    light = {"wavelength": wavelength, "source": source, "lamp": lamp, "stokes": stokes}
    if flux is None:
        looks = {"image": image, "background": detector.background}
        flux = _usual_flux(chain, instrument, frames, 1e7, **light, **looks)
    beams = _beam_fluxes(chain, frames, flux=flux, **light)
    # a generator for each frame, so that a frame is the same however many are simulated
    seeds = np.random.SeedSequence(check_seed(seed, generator=False)).spawn(n_frames + 2)
    *seeds, of_pixels, of_star = map(np.random.default_rng, seeds)
    # all that may be refused is, before the first file
    centres, widths = image._places(of_star, scene, layout, n_frames)
    flat, bad = detector._pixels(of_pixels, layout.shape)
    names = file_names(Path(directory), layout, files, n_frames)
    # part of the saturation, and both
    fullest = (0.0, 0.0, 0.0)
    with shown(progress):
        for i, (how, background) in enumerate(steps(read, "cubes")):
            falling = scene.light(beams[:, i], centres[i], widths[i]) + background
            brightest, saturation = float(falling.max()), ways[i].saturation
            fullest = max(fullest, (brightest / saturation, brightest, saturation))
            cube, weight = expose(falling, how, flat, seeds[i] if detector.noise else None)
            # as extraction marks pixels without a value
            cube[bad], weight[bad] = np.nan, 0.0
            header = layout.to_header(header_of(frames[i], layout) | more)
            write_cube(*names[i], cube, weight, header, layout)
    if fullest[0] > 1 and not detector.saturate:
        warn(
            f"the brightest pixel has {fullest[1]:.3g} adu, above the saturation of "
            f"{fullest[2]:g} adu: lower the flux (--flux), or cut pixels off there (--saturate)"
        )
    return [cube for cube, _ in names]


def _usual_flux(
    chain, instrument, frames, most, *, image, background, source, wavelength=None, **light
):
    """Return the flux of cubes for which none is given, at most so much."""
    layout, wavelength, _ = _of_mode(instrument, wavelength)
    frames = _with_headers(frames, layout, source, 1 * u.s, "2025-01-01")
    share = Scene(image, layout, source, len(wavelength)).peak()
    fluxes = _beam_fluxes(chain, frames, wavelength, source, **light)
    # a default may fill half of the saturation: room for better seeing, and uneven pixels
    room = 0.5 * min(way.saturation for way in _read_outs(frames, layout))
    room = room - per_wavelength("background", background, len(wavelength))
    if np.any(room <= 0):
        # no flux is low enough, which is warned of later
        return most
    brightest = np.max(fluxes.max(axis=(0, 1)) * share / room)
    if most * brightest <= 1:
        return most
    # two digits, rounded down
    digit = 10.0 ** (np.floor(-np.log10(brightest)) - 1)
    return float(np.floor(1 / (brightest * digit)) * digit)


def true_observations(
    chain,
    instrument,
    frames,
    *,
    wavelength=None,
    source="internal",
    stokes=(1.0, 0.0, 0.0, 0.0),
    noise=False,
    **options,
):
    """
    Return the table that a faultless photometry of simulated cubes would give.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        The true chain.
    instrument : Instrument
        With a file layout.
    frames : `~astropy.table.QTable`
        As for `simulate_cubes`.
    wavelength : `~astropy.units.Quantity`, optional
        By default the instrument's.
    source : {"internal", "star"}
        What is seen.
    stokes : sequence of float
        Stokes vector of the light that enters the chain.
    noise : bool
        Whether to draw the noise of the beam fluxes.
    **options
        Of `~astropolcal.simulation.simulate`: ``flux``, ``lamp``, ``meta``, ``seed``...

    Returns
    -------
    Observations
        ``hwp`` as commanded; for a star also ``hwp_true``.

    Raises
    ------
    ParameterError, ObservationError, ChainError
        If a number, column or stage is missing or wrong.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.reduction import true_observations
    >>> from astropolcal.simulation import half_wave_plate_cycles
    >>> charis = instruments.get("charis")
    >>> true_observations(charis.published(), charis, half_wave_plate_cycles()).n_frames
    8
    """
    check_choice("source", source, _SOURCES, ParameterError)
    wavelength = instrument.wavelength if wavelength is None else wavelength
    known = _with_headers(frames, _layout(instrument), source, 1 * u.s, "2025-01-01")
    kept = [c for c in QTable(frames).colnames if not isinstance(known[c], Time)]
    table = known[kept]
    if source == "star":
        # the light meets the plate where it stands; the table tells where it was sent
        table["hwp"] = known["hwp_true"]
    true = simulate(chain, wavelength, table, source=stokes, noise=noise, **options)
    if source != "star":
        return true
    rows, n = true.to_table(), true.n_bins
    rows["hwp"], rows["hwp_true"] = np.repeat(known["hwp"], n), np.repeat(known["hwp_true"], n)
    return Observations.from_table(rows, name=true.name)


# --- what is checked -------------------------------------------------------------


def _layout(instrument):
    layout = instrument.files
    if layout is None or len(layout.internal_apertures) != 5:
        raise InstrumentError(
            f"{instrument.name}: its class does not say how its files look "
            "(attribute files, with internal_apertures)"
        )
    return layout


# --- what is true ----------------------------------------------------------------


def both_states(frames):
    """
    Return each frame in both states of a modulator.

    Parameters
    ----------
    frames : `~astropy.table.QTable`
        One row per frame.

    Returns
    -------
    `~astropy.table.QTable`
        Each row twice, with 0 (state A) and 1 (B) in the column ``flc_state``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.reduction import both_states
    >>> from astropolcal.simulation import half_wave_plate_cycles
    >>> both_states(half_wave_plate_cycles(hwp=[0, 45] * u.deg))["flc_state"].tolist()
    [0.0, 1.0, 0.0, 1.0]
    """
    twice = QTable(frames)[np.repeat(np.arange(len(frames)), 2)]
    twice["flc_state"] = np.tile([0.0, 1.0], len(frames))
    return twice


def _of_mode(instrument, wavelength):
    """Return the layout of files in the mode of the wavelengths, these, and keywords of it."""
    wavelength = instrument.wavelength if wavelength is None else np.atleast_1d(wavelength)
    header = dict(instrument.mode_header(wavelength))
    layout = _layout(instrument.configured(header))
    if wavelength.shape != layout.shape[:1]:
        raise ParameterError(
            f"wavelength has shape {wavelength.shape}; the cubes have {layout.shape[0]} slices"
        )
    return layout, wavelength, header


def _read_outs(frames, layout):
    """Return how the detector is read out in each frame."""
    known = [c for c in ("em_gain", "read_mode") if c in frames.colnames]
    return [layout.read_out({c: frame[c] for c in known}) for frame in frames]


def _with_headers(frames, layout, source, exposure_time, start):
    """Return the frames with the true angle of the half-wave plate and the times."""
    frames = QTable(frames, copy=True)
    missing = {"hwp", "derotator"} - set(frames.colnames)
    if missing or not len(frames):
        raise ObservationError(f"frames: column {', '.join(sorted(missing)) or 'hwp'} is missing")
    if "hwp_true" not in frames.colnames and source == "star":
        missing = {"parallactic", "altitude"} - set(frames.colnames)
        if missing:
            raise ObservationError(
                f"frames: {' and '.join(sorted(missing))} missing, which a star needs"
            )
        sky = frames["parallactic"], frames["altitude"]
        # encoders count within one turn
        frames["hwp_true"] = tracked(frames["hwp"], *sky, layout.tracking) % (360 * u.deg)
    elif "hwp_true" not in frames.colnames:
        frames["hwp_true"] = frames["hwp"]
    if "exposure_time" not in frames.colnames:
        frames["exposure_time"] = u.Quantity(exposure_time) * np.ones(len(frames))
    number("exposure_time", frames["exposure_time"].to_value(u.s).min(), above=0.0)
    if "time" not in frames.colnames:
        # start of each frame: one follows the other
        before = np.cumsum(frames["exposure_time"]) - frames["exposure_time"]
        with offline():
            frames["time"] = Time(start) + before
    return frames


def _beam_fluxes(chain, frames, wavelength, source, flux=1.0, lamp=None, stokes=(1, 0, 0, 0)):
    """Return what reaches the detector, (beam, frame, wavelength), the right beam first."""
    table = frames[sorted({"hwp", *stages(chain)} & set(frames.colnames))]
    if source == "star":
        table["hwp"] = frames["hwp_true"]
    right_left = expected_fluxes(chain, wavelength, table, stokes)
    scale = entering_flux(flux, lamp, len(frames), len(wavelength))
    # (beam, frame, wavelength)
    return np.stack([fluxes.T * scale for fluxes in right_left])


# ---- files ---------------------------------------------------------------------------------------


def file_names(directory, layout, files, n_frames):
    """Return the paths of cube and raw header of every frame."""
    if not os.path.isdir(directory.parent):
        raise ObservationError(f"{directory}: there is no folder {directory.parent}")
    if os.path.exists(directory) and not os.path.isdir(directory):
        raise ObservationError(f"{directory}: is a file, not a folder")
    # the layout may have nothing to look up in raw headers, and then there are none
    raw = files.raw and bool(layout.raw_columns or not layout.beam_files)
    prefix = layout.prefix if files.prefix is None else files.prefix
    # eight digits, as the frame numbers of the Subaru archive have
    numbers = [f"{prefix}{files.first + i:08d}" for i in range(n_frames)]
    if files.first < 0 or re.search(layout.frame_pattern, f"{numbers[-1]}_cube.fits") is None:
        raise ParameterError(
            f"{numbers[-1]}: the number of the frame must match {layout.frame_pattern}"
        )
    # the right beam names a frame; that of the left one follows from it
    mark = layout.beam_files[0] if layout.beam_files else "cube"
    names = [
        (directory / f"{n}_{mark}.fits", directory / "raw" / f"{n}.fits" if raw else None)
        for n in numbers
    ]
    every = [(cube, layout.left_file(cube), header) for cube, header in names]
    # all names before the first file is written: a run is replaced whole or not at all
    for path in (path for group in every for path in group if path is not None):
        if os.path.exists(path):
            check_new(path, files.overwrite, ObservationError)
    folder = directory / "raw" if raw else directory
    with understood(folder, ObservationError, "cannot be made", reads=False):
        folder.mkdir(exist_ok=True, parents=True)
    return names


def write_cube(cube, raw_header, image, weight, header, layout):
    """Write a simulated cube, and leave some keywords to the header of the raw frame."""
    # as real extraction leaves it: some keywords stay behind in the raw frame
    in_raw = {layout.keywords[c] for c in layout.raw_columns if c in layout.keywords}
    in_cube = {k: v for k, v in header.items() if raw_header is None or k not in in_raw}
    left, camera = layout.left_file(cube), layout.keywords.get("camera")
    if left is None:
        _save(_hdus(in_cube, image, weight, layout), cube)
    else:
        # the left image is the first half
        parts = [np.split(array, 2, axis=-1) for array in (image, weight)]
        for number, (path, side) in enumerate([(cube, 1), (left, 0)], start=1):
            # cameras are numbered 1 (right) and 2 (left)
            own = in_cube | ({} if camera is None else {camera: number})
            _save(_hdus(own, *(part[side] for part in parts), layout), path)
    if raw_header is not None:
        _save(fits.HDUList([fits.PrimaryHDU(header=_cards(header))]), raw_header)


def _cards(header):
    # longer names are those of the convention of ESO, of which astropy otherwise warns
    return fits.Header([(k if len(k) <= 8 else f"HIERARCH {k}", v) for k, v in header.items()])


def _hdus(header, image, weight, layout):
    header, name, unit = _cards(header), "IVAR", "adu-2"
    if layout.weights == "error":
        with np.errstate(divide="ignore"):
            # where nothing is known the weight is 0, and so is this
            weight = np.where(weight > 0, 1 / np.sqrt(weight), 0.0).astype(np.float32)
        name, unit = "ERR", "adu"
    if layout.cube_extension == 0:
        # without it the unit would have to be guessed
        header["BUNIT"] = "adu"
        hdus = [fits.PrimaryHDU(image, header=header)]
    else:
        # the cube's extension need not be the first
        hdus = [fits.PrimaryHDU(header=header)]
        hdus += [fits.ImageHDU() for _ in range(layout.cube_extension - 1)]
        hdus.append(fits.ImageHDU(image, header=fits.Header({"BUNIT": "adu"}), name="IMAGE"))
    hdus.append(fits.ImageHDU(weight, header=fits.Header({"BUNIT": unit}), name=name))
    return fits.HDUList(hdus)


def _save(hdus, path):
    with atomic_path(path, ObservationError) as temporary, open(temporary, "wb") as stream:
        hdus.writeto(stream)


def header_of(frame, layout):
    """Return keyword and value of every column that the layout has a keyword for."""
    header = {}
    time = Time(frame["time"])
    date, clock = time.isot.split("T")
    # a column of the frames goes before these, so that a test may give an odd one
    known = {"date": date, "time": clock, "mjd": time.mjd * u.day}
    if layout.identities:
        known["instrument"] = layout.identities[0]
    known |= {c: frame[c] for c in frame.colnames if c != "time"}
    for column, keyword in layout.keywords.items():
        if column in known:
            header[keyword] = _value(column, known[column], layout)
    return header


def _value(column, value, layout):
    """Return what a header says: the inverse of how the layout reads it."""
    if column == "flc_state":
        return "AB"[int(value)]
    if column in TEXTS and not isinstance(value, u.Quantity):
        return str(value)
    number = u.Quantity(value).to_value(unit_of(column, layout))
    # value = factor * header + offset, turned round
    factor, offset = layout.transforms.get(column, (1.0, 0.0))
    return float((number - offset) / factor)


# ---- images of both beams: field stop, stars, detector ------------------------------------------

# what is simulated are both beams of a Wollaston prism
BEAMS = ("right", "left")

# three-point Gauss rule over a pixel
_NODES, _WEIGHTS = np.array([-1.0, 0.0, 1.0]) * np.sqrt(0.15), np.array([5.0, 8.0, 5.0]) / 18


class Scene:
    """Where the light of each beam falls: the shares of its flux in every pixel."""

    def __init__(self, image, layout, source, n_wavelengths):
        check_choice("psf", image.psf, ("moffat", "gaussian"), ParameterError)
        self.shape, self.source, self.psf = layout.shape, source, image.psf
        self.fwhm = pixels("fwhm", image.fwhm, layout, n_wavelengths)
        self.beta = number("beta", image.beta, above=1.0)
        self.halo = number("halo", image.halo, most=1.0)
        self.halo_fwhm = pixels("halo_fwhm", image.halo_fwhm, layout, n_wavelengths)
        margin = number("margin", image.margin)
        left, right, width, height, angle = layout.internal_apertures
        self.offset = np.asarray(layout.star_offset, dtype=float)
        # the field stop moves with the star from beam to beam
        # place in the left beam whose image in the right one is as far off its aperture
        self.centre = (np.add(left, right) - self.offset) / 2
        # flux of a lamp is what an aperture of the layout gets, whatever the stop
        self.area = width * height
        # margin on all sides: an aperture must not see the edge of the stop
        size = (width + 2 * margin, height + 2 * margin)
        self.boxes, self.stops = [], []
        apertures = rectangles(layout.internal_apertures, layout.shape[1:])
        places = self.centres(self.centre)
        for place, (rows, columns, weights) in zip(places, apertures, strict=True):
            stop = rectangle(layout.shape[1:], place, size, angle)
            if not stop.any():
                raise InstrumentError("internal_apertures: a beam lies outside the cube")
            if source == "internal" and np.any(stop[rows, columns][weights > 0] < 1):
                raise ParameterError(
                    f"margin = {margin:g} pixels: the field stop cuts the apertures of the layout"
                )
            # a stop fills a part of the image only; profiles are computed inside
            (box,) = ndimage.find_objects((stop > 0).astype(int))
            self.boxes.append(box)
            self.stops.append(stop[box])

    def check_places(self, centres):
        """Refuse frames whose star lies outside of the image, in either beam."""
        if self.source != "star":
            return
        rows, columns = self.shape[1:]
        for beam, places in zip(BEAMS, self.centres(centres), strict=True):
            outside = ((places < 0) | (places > (columns - 1, rows - 1))).any(axis=1)
            if outside.any():
                x, y = places[int(np.argmax(outside))]
                raise ParameterError(
                    f"the star in the {beam} beam is at ({x:.4g}, {y:.4g}), outside of the image "
                    f"of {columns} x {rows} pixels"
                )

    def centres(self, left):
        """Return the place in the right and in the left beam."""
        return np.asarray(left) + self.offset, np.asarray(left)

    def peak(self):
        """Return the largest share of a beam's light in a pixel, one per wavelength or one."""
        if self.source != "star":
            return 1 / self.area
        # in the middle of a pixel it is the largest
        box = tuple(slice(0, size) for size in self.shape[1:])
        middle = np.array(self.shape[:0:-1]) // 2
        return self._star(box, middle, self.fwhm).max(axis=(1, 2))

    def light(self, fluxes, centre, widening):
        """Return the image of both beams, in the unit of the fluxes."""
        image = np.zeros(self.shape)
        places = self.centres(centre)
        for beam, stop, box, place in zip(fluxes, self.stops, self.boxes, places, strict=True):
            if self.source == "star":
                share = stop * self._star(box, place, self.fwhm * widening)
            else:
                share = stop / self.area
            # (W, 1, 1) times (y, x) of a lamp or (W, y, x) of a star; stops may overlap
            image[(slice(None), *box)] += beam[:, None, None] * share
        return image

    def _star(self, box, place, fwhm):
        """Return the share of a star's light in the pixels of a box, (n_wavelengths, y, x)."""
        # both have the same arguments, of which a Gaussian needs fewer
        core = moffat if self.psf == "moffat" else gaussian
        share = _by_width(core, box, place, fwhm, self.beta)
        if self.halo:
            halo = _by_width(moffat, box, place, self.halo_fwhm, HALO_BETA)
            share = (1 - self.halo) * share + self.halo * halo
        return share


def rectangle(shape, centre, size, angle):
    """Return the part of each pixel within a turned rectangle, its edges a pixel wide."""
    sides = zip(turned(shape, centre, angle), size, strict=True)
    # linear over one pixel: the area stays that of the rectangle at any angle
    return np.prod([np.clip(full / 2 - np.abs(d) + 0.5, 0, 1) for d, full in sides], axis=0)


def _by_width(profile, box, place, fwhm, beta):
    """Return a profile for each wavelength; equal widths are computed once."""
    widths, which = np.unique(fwhm, return_inverse=True)
    return np.stack([profile(box, place, width, beta) for width in widths])[which]


def gaussian(box, place, fwhm, _beta):
    """Return the exact integral over every pixel of a Gaussian of unit sum."""
    from photutils.psf import CircularGaussianPRF

    rows, columns = np.ogrid[box]
    return CircularGaussianPRF(flux=1, x_0=place[0], y_0=place[1], fwhm=fwhm)(columns, rows)


def moffat(box, place, fwhm, beta):
    """Return the integral over every pixel of a Moffat profile of unit sum."""
    # alpha, by which r is divided: the profile is 1/2 at r = fwhm / 2
    core = fwhm / (2 * np.sqrt(2 ** (1 / beta) - 1))
    squares = []
    for along, middle in zip(box, (place[1], place[0]), strict=True):
        # three nodes a pixel and axis, exact for the fifth degree across a pixel
        nodes = np.arange(along.start, along.stop)[:, None] + _NODES
        squares.append((nodes.ravel() - middle) ** 2)
    profile = (1 + np.add.outer(*squares) / core**2) ** -beta
    rows, columns = (size // 3 for size in profile.shape)
    # i, j: pixels; a, b: nodes within
    pixels = np.einsum("iajb,a,b->ij", profile.reshape(rows, 3, columns, 3), _WEIGHTS, _WEIGHTS)
    # integral over the plane of (1 + r^2/alpha^2)^-beta is pi alpha^2 / (beta - 1)
    return pixels * (beta - 1) / (np.pi * core**2)


def expose(light, how, response, rng):
    """
    Return the image in adu that a detector, `ReadOut`, makes of light, and inverse variances.

    Of the light in each pixel, with that of the background; without noise where ``rng`` is None.
    """
    electrons = how.gain * response * light
    # in adu^2; of the expectation, not of what was drawn, so that weights are unbiased
    variance = (how.excess_noise**2 * electrons + how.read_noise**2) / how.gain**2
    check_electrons(electrons)
    if rng is not None:
        electrons = rng.poisson(electrons)
        # each becomes an exponentially distributed number of them; F^2 = 1 + the variance of
        # what one becomes, in units of the gain squared
        extra = how.excess_noise**2 - 1
        electrons = extra * rng.gamma(electrons / extra) if extra > 0 else electrons
        electrons = electrons + how.read_noise * rng.standard_normal(light.shape)
    # in adu, as the layout gives it
    image = np.minimum(electrons / how.gain, how.saturation)
    with np.errstate(divide="ignore"):
        weight = np.where(variance > 0, 1 / variance, 0.0)
    return image.astype(np.float32), weight.astype(np.float32)


# ---- arguments -----------------------------------------------------------------------------------


def number(name, value, *, least=0.0, above=-np.inf, most=np.inf):
    """Return a number within its bounds, of which ``above`` is itself not allowed."""
    value = float(value)
    # NaN compares as false and is refused as well
    if not (np.isfinite(value) and least <= value <= most and value > above):
        bounds = f"above {above:g}" if above > least or above == least else f"{least:g} and above"
        raise ParameterError(f"{name} = {value:g}; allowed is {bounds}, up to {most:g}")
    return value


def per_wavelength(name, value, n_wavelengths):
    """Return numbers that are not negative, one per wavelength, shape (W,)."""
    value = np.asarray(value, dtype=float)
    if value.shape not in ((), (n_wavelengths,)) or not np.all(np.isfinite(value) & (value >= 0)):
        raise ParameterError(
            f"{name} = {value}; allowed are numbers not negative, of shape () or ({n_wavelengths},)"
        )
    return np.broadcast_to(value, (n_wavelengths,))


def pixels(name, value, layout, n_wavelengths, least=0.5):
    """Return a length on the detector in pixels, one per wavelength."""
    # a plain number, and a Quantity without a unit, are pixels already
    if isinstance(value, u.Quantity) and value.unit is not u.dimensionless_unscaled:
        if value.unit.is_equivalent(u.pix):
            value = value.to_value(u.pix)
        else:
            # milliarcsecond in a degree, the unit of a layout's pixel scale
            value = np.rad2deg(angle_to_rad(value, name)) * 3.6e6 / layout.pixel_scale
    value = per_wavelength(name, value, n_wavelengths)
    if value.min() < least:
        raise ParameterError(f"{name} = {value.min():g} pixels; allowed are {least:g} and above")
    return value
