# Licensed under a 3-clause BSD style license - see LICENSE
"""Science frames: the fluxes of both beams, where the stages stood, how the field was turned."""

import warnings
from dataclasses import dataclass, field, replace
from functools import cached_property

import astropy.units as u
import numpy as np
from astropy.table import QTable

from astropolcal.chain import check_states, leaves, stages
from astropolcal.correction.solve import frame_brightness
from astropolcal.correction.sources import ArraySource, CubeFiles, TurnedSource
from astropolcal.exceptions import ObservationError, ParameterError, warn
from astropolcal.fitscheck import primary_header
from astropolcal.observations import Observations
from astropolcal.observations.observables import pair_frames
from astropolcal.optics import COORDINATES
from astropolcal.optics.positions import FLUXES
from astropolcal.pipeline.headers import describe
from astropolcal.units import angle_to_rad, to_unit, wavelengths_of

__all__ = ["ScienceFrames"]

#: Frames of a pair are closer; on sky it follows the field, so it turns more than inside.
DEROTATOR_LIMIT = 2 * u.deg


@dataclass(eq=False)
class ScienceFrames:
    """
    What is to be corrected.

    Attributes
    ----------
    source : object
        The fluxes of both beams, in memory or in files.
    wavelength : `~astropy.units.Quantity`
        Shape (n_wavelengths,).
    positions : dict
        Position of every stage of the chain, (n_frames,), or (nodes, n_frames) at the
        Gauss-Legendre nodes of the exposures; without a unit in radian. Of a device with states
        the state in each frame, under the name of its column.
    pairs : `~numpy.ndarray` or None
        Frames of the pairs of double differences, (n_pairs, 2); None if none were looked for.
    scale : `~numpy.ndarray` or None
        Relative brightness of the frames.
    groups : `~numpy.ndarray` or None
        Group of each frame, (n_frames,), where those of a group share their brightness: of single
        beams, by default all of them, and the beams of an exposure.
    unit : `~astropy.units.UnitBase`
        Of the fluxes.
    north_up : bool
        Whether images have north up and east left.
    centre : tuple or None
        Of the star in the images, 0-based x and y.
    pixel_scale : float or None
        Milliarcsecond.
    date : str, `~astropy.time.Time`, sequence of those, or None
        When the frames were taken (UTC), one moment for all or one for each.
    mode : str, sequence of str, or None
        Mode of the instrument, as the calibration calls it.
    meta : dict
        More that goes into a product's header.

    Examples
    --------
    >>> import astropy.units as u
    >>> import numpy as np
    >>> from astropolcal.correction import ScienceFrames
    >>> hwp = [0, 45, 22.5, 67.5] * u.deg
    >>> frames = ScienceFrames.from_arrays(np.ones((4, 22)), np.ones((4, 22)),
    ...                                    np.linspace(1.2, 2.4, 22) * u.um, {"hwp": hwp}, hwp=hwp)
    >>> frames.pairs.tolist()
    [[0, 1], [2, 3]]
    """

    source: object
    wavelength: u.Quantity
    positions: dict
    pairs: np.ndarray | None = None
    scale: np.ndarray | None = None
    groups: np.ndarray | None = None
    unit: u.UnitBase = u.adu
    north_up: bool = False
    centre: tuple | None = None
    pixel_scale: float | None = None
    date: object = None
    mode: str | None = None
    meta: dict = field(default_factory=dict)

    def __post_init__(self):
        self.wavelength = np.atleast_1d(wavelengths_of(self.wavelength))
        if self.wavelength.shape != (self.source.n_wavelengths,):
            raise ObservationError(
                f"wavelength has shape {self.wavelength.shape}; the frames have "
                f"{self.source.n_wavelengths} wavelengths"
            )
        count = self.source.n_frames
        for name, position in self.positions.items():
            if np.shape(position)[-1:] not in ((), (count,), (1,)):
                raise ObservationError(
                    f"{name} has {np.shape(position)[-1]} positions; there are {count} frames"
                )
        if self.pairs is not None:
            pairs = to_unit(self.pairs, None, "pairs")
            if pairs.size and (pairs.shape[1:] != (2,) or (pairs % 1 != 0).any()):
                raise ObservationError(
                    f"pairs has shape {pairs.shape}; whole numbers, (n_pairs, 2), are needed"
                )
            self.pairs = pairs.astype(int).reshape(-1, 2)
        if self.groups is not None and np.shape(self.groups) != (count,):
            raise ObservationError(
                f"groups has shape {np.shape(self.groups)}; one of each of the {count} frames is "
                "needed"
            )

    @property
    def names(self):
        """What the frames are called."""
        return self.source.names

    def moments(self):
        """Return name, date and mode of each frame; None where they are not known.

        Raises
        ------
        ParameterError
            If there is not one date or mode for all, or one for each frame.
        """
        parts = [list(map(str, self.names))]
        for key in ("date", "mode"):
            value = getattr(self, key)
            scalar = isinstance(value, str) or not hasattr(value, "__len__") or np.ndim(value) == 0
            parts.append([value] * len(parts[0]) if scalar else list(value))
            if len(parts[-1]) != len(parts[0]):
                raise ParameterError(
                    f"{len(parts[-1])} values of {key}; allowed are one for all, or one for each "
                    f"of the {len(parts[0])} frames"
                )
        return list(zip(*parts, strict=True))

    def with_brightness(self, rows, **settings):
        """
        Return the frames with the relative brightness that their own light shows.

        Parameters
        ----------
        rows : `~numpy.ndarray`
            As `~astropolcal.correction.measurement_rows` gives them.
        **settings
            ``components``, ``observable``, ``pairs`` and ``weights``, as for
            `~astropolcal.correction.correct`.

        Returns
        -------
        ScienceFrames
        """
        fluxes = self._light[0]
        return replace(self, scale=frame_brightness(rows, fluxes, self.groups, **settings))

    @cached_property
    def _light(self):
        """The light of both beams in the whole image and its variance, (2, n_frames, n_waves)."""
        shape = (2, self.source.n_frames, self.source.n_wavelengths)
        (light, noise), inside = np.empty((2, *shape)), _circle(self.source.image_shape)
        for w in range(shape[2]):
            light[:, :, w], noise[:, :, w], missing = self._totals(w, inside)
            if missing is None:
                continue
            # what one frame lacks is left out of all, or they would seem to differ
            if missing.any(axis=0).sum() != missing.all(axis=0).sum():
                common = inside.copy()
                common[inside] = ~missing.any(axis=0)
                if common.any():
                    light[:, :, w], noise[:, :, w], _ = self._totals(w, common)
        # of turned images the variances are those without what neighbours have in common
        return light, noise / getattr(self.source, "resampling", 1.0)

    def _totals(self, w, pixels):
        """Return the light of both beams in some pixels, NaN for none, its variance, which lack."""
        totals, weights = np.empty((2, self.source.n_frames)), pixels.astype(float)
        noise, missing = np.full(totals.shape, np.nan), None
        for frames in self.source.batches():
            for beam in (0, 1):
                found = self.source.fluxes(beam, frames, slice(w, w + 1))
                if self.source.has_variances:
                    # a bad pixel that says so must not count as light
                    known = self.source.variances(beam, frames, slice(w, w + 1))
                    found = np.where(np.isfinite(known), found, np.nan)
                    known = np.where(np.isfinite(found), known, 0.0)
                    noise[beam, frames] = known.reshape(len(found), -1) @ weights
                found = found.reshape(len(found), -1)
                with np.errstate(invalid="ignore"):
                    sums = found @ weights
                if not np.isfinite(sums).all():
                    found = found[:, pixels]
                    if missing is None:
                        missing = np.zeros((2, len(totals[0]), found.shape[1]), dtype=bool)
                    lacks = missing[beam, frames] = ~np.isfinite(found)
                    sums = np.where(lacks, 0.0, found).sum(axis=1)
                    sums[lacks.all(axis=1)] = np.nan
                totals[beam, frames] = sums
        return totals, noise, None if missing is None else missing.reshape(-1, missing.shape[2])

    @classmethod
    def from_arrays(
        cls,
        right,
        left=None,
        wavelength=None,
        positions=None,
        *,
        variance_right=None,
        variance_left=None,
        names=None,
        hwp=None,
        position_angle=None,
        centre=None,
        mirrored=False,
        order=3,
        **settings,
    ):
        """
        Make it from arrays of both beams.

        Parameters
        ----------
        right, left, variance_right, variance_left : array_like
            Images or spectra in memory, mapped from disk, or of dask, and their variances, shape
            (n_frames, n_wavelengths, ...); NaN where there is none. Of a single beam ``left`` is
            None; of several others ``right``, and ``variance_right``, are a dict of the name of
            each beam to its fluxes: ``positions`` are still those of the exposures.
        names : sequence of str, optional
            What to call the frames.
        wavelength, positions
            As the attributes, but angles with their unit.
        hwp : `~astropy.units.Quantity`, optional
            Commanded angles of the half-wave plate, by which frames are paired.
        position_angle : `~astropy.units.Quantity`, optional
            Of the +y axis of every frame; the images are then turned north up.
        centre : (float, float), optional
            0-based x and y of the star; by default the middle.
        mirrored : bool
            Whether east is to the right of north.
        order : int
            Of the spline, 0 to 5.
        **settings
            More attributes: ``pairs``, ``scale``, ``unit``, ``pixel_scale``, ``date``, ``mode``,
            ``meta``.

        Returns
        -------
        ScienceFrames
        """
        positions = {} if positions is None else dict(positions)
        for name, value in positions.items():
            if name not in COORDINATES and np.asarray(value).dtype.kind in "iuf":
                angle_to_rad(value, name)
        if left is None:
            given = right, variance_right, positions, settings, names
            right, variance_right, positions, settings, names = _single(*given)
            # no light falls where there is no beam, and nothing is learnt from it
            left = np.broadcast_to(0.0, np.shape(right))
            variance_left = None if variance_right is None else np.broadcast_to(1.0, left.shape)
        # what the fluxes say of their unit, none else is known of plain numbers
        own = getattr(right, "unit", None)
        settings["unit"] = u.Unit(settings.get("unit") or own or u.adu)
        given = variance_right, variance_left, names, settings["unit"]
        source = ArraySource(right, left, *given)
        if position_angle is not None:
            options = {"centre": centre, "mirrored": mirrored, "order": order}
            source = TurnedSource(source, position_angle, **options)
            settings["north_up"] = True
        if hwp is not None and settings.get("pairs") is None:
            settings["pairs"] = _pairs(hwp, positions, source.names)
        return cls(source, wavelength, positions, centre=centre, **settings)

    @classmethod
    def from_differences(cls, difference, total, *arguments, variance=None, **settings):
        """
        Make it from single differences and sums, right minus and plus left.

        Parameters
        ----------
        difference, total : array_like
            Shape (n_frames, n_wavelengths, ...).
        *arguments
            ``wavelength`` and ``positions``, as for `from_arrays`.
        variance : array_like, optional
            Of the difference, which is taken as that of the sum.
        **settings
            As for `from_arrays`.

        Returns
        -------
        ScienceFrames
        """
        # as floats: the sum of two integers may be beyond their type
        difference, total = (1.0 * np.asanyarray(x) for x in (difference, total))
        # var(r - l) = var(r) + var(l), shared evenly as nothing else is known
        half = None if variance is None else np.asanyarray(variance) / 2
        settings |= {"variance_right": half, "variance_left": half}
        beams = (total + difference) / 2, (total - difference) / 2
        return cls.from_arrays(*beams, *arguments, **settings)

    @classmethod
    def from_files(
        cls,
        files,
        instrument,
        table,
        chain,
        *,
        wavelength=None,
        centres=None,
        size=51,
        position_angle=None,
        mirrored=False,
        left_scale=1.0,
        detectors=None,
        **settings,
    ):
        """
        Make it from extracted cubes with both beams side by side.

        Parameters
        ----------
        files : sequence of path-like
            The cubes.
        instrument : Instrument
            With a file layout.
        table : `~astropy.table.QTable`
            One row a file, the angles that its headers give: ``hwp`` and ``derotator``, for a
            star ``parallactic`` and ``altitude``, and ``hwp_true`` if it is known; ``flc_state`` if
            the chain has a modulator.
        chain : `~astropy.modeling.CompoundModel`
            From the sky to the detector.
        wavelength : `~astropy.units.Quantity`, optional
            Of the slices; by default the instrument's.
        centres : array_like, optional
            Place of the star in the right and the left beam, 0-based x and y, side by side also
            where each beam has files of its own, shape (2, 2) or (n_frames, 2, 2); or of the left
            beam only, shape (2,) or (n_frames, 2), with the right beam where the layout says; by
            default in the middle of the field. Shape (2, 2) are always both beams; a distance of
            theirs that is not about that of the layout is refused.
        size : int
            Rows and columns that are cut out about it.
        position_angle, mirrored
            As for `from_arrays`.
        left_scale : array_like
            By what the left beam is multiplied, one number or one per frame.
        detectors : sequence of (object, object), optional
            Of the right and left beam in each frame, whose ``variance(pixels)`` gives the variances
            where the files hold no errors; pixels of images that their ``spoilt(pixels)``, if they
            have it, calls so count as without a value.
        **settings
            More attributes. Without ``date`` and ``mode`` the headers of the files tell.

        Returns
        -------
        ScienceFrames

        Raises
        ------
        ObservationError
            If a file cannot be read, or the table lacks an angle.
        ParameterError
            If ``centres`` are none, or not those of both beams.
        """
        layout = instrument.files
        positions = frame_positions(instrument, table, chain, names=files)
        left = [layout.left_file(path) for path in files] if layout.beam_files else None
        source = CubeFiles(
            files,
            _centres(centres, layout),
            size,
            position_angle=position_angle,
            extension=layout.cube_extension,
            mirrored=mirrored,
            left_files=left,
            left_scale=left_scale,
            weights=layout.weights,
            stacked=layout.stacked,
            detectors=detectors,
        )
        if settings.get("pairs") is None and "hwp" in table.colnames:
            settings["pairs"] = _pairs(table["hwp"], positions, source.names)
        settings.setdefault("pixel_scale", layout.pixel_scale)
        if not {"date", "mode"} <= set(settings):
            told = [describe(primary_header(path), instrument) for path in files]
            for key in ("date", "mode"):
                settings.setdefault(key, [each[key] for each in told])
        middle = ((size - 1) / 2, (size - 1) / 2)
        return cls(
            source,
            instrument.wavelength if wavelength is None else wavelength,
            positions,
            north_up=position_angle is not None,
            centre=middle,
            **settings,
        )


def _single(fluxes, variances, positions, settings, names):
    """Return single beams frame by frame, an exposure of several beams as several frames."""
    if not isinstance(fluxes, dict):
        n = len(fluxes)
        return fluxes, variances, positions, {"groups": np.zeros(n, dtype=int)} | settings, names
    beams, count = list(fluxes), len(fluxes)
    stacked = [
        None if each is None else np.stack([each[name] for name in beams], axis=1)
        for each in (fluxes, variances)
    ]
    n = len(stacked[0])
    flat = [None if a is None else a.reshape(n * count, *a.shape[2:]) for a in stacked]
    placed = {
        name: np.repeat(value, count, axis=-1) if np.ndim(value) else value
        for name, value in positions.items()
    }
    placed["beam"] = np.tile(beams, n)
    names = [f"frame {i}" for i in range(n)] if names is None else names
    names = [f"{name}, beam {beam}" for name in names for beam in beams]
    return *flat, placed, {"groups": np.repeat(np.arange(n), count)} | settings, names


def _circle(shape):
    """Return the pixels, in one row, that images show however they are turned."""
    if len(shape) != 2:
        return np.ones(int(np.prod(shape, dtype=int)), dtype=bool)
    half = [(n - 1) / 2 for n in shape]
    rows, columns = np.indices(shape)
    return (np.hypot(rows - half[0], columns - half[1]) <= min(shape) / 2).ravel()


def _pairs(hwp, positions, names):
    """Return the pairs of frames, of which there may be none."""
    if np.shape(hwp) != (len(names),):
        raise ObservationError(
            f"hwp has shape {np.shape(hwp)}; one angle for each of the {len(names)} frames is "
            "needed"
        )
    derotator = positions.get("derotator")
    if derotator is not None:
        derotator = np.atleast_2d(u.Quantity(derotator, getattr(derotator, "unit", u.rad)))
        # the middle of an exposure, of which there may be several nodes
        derotator = np.broadcast_to(derotator.mean(axis=0), hwp.shape, subok=True)
    options = {"derotator_tolerance": DEROTATOR_LIMIT, "labels": names, "lonely": True}
    with warnings.catch_warnings():
        # that frames are left over matters only where pairs are used
        warnings.simplefilter("ignore")
        return pair_frames(hwp, derotator, positions.get("flc_state"), **options)


def _centres(centres, layout):
    """Return the place of the same point in the right and the left beam, in the image of each."""
    if centres is None:
        left, right = layout.internal_apertures[:2]
        # the place of the left beam such that both are equally far from their rectangles
        centres = (np.add(left, right) - layout.star_offset) / 2
    centres = np.array(centres, dtype=float)
    if centres.shape[-1:] != (2,) or not np.all(np.isfinite(centres)):
        raise ParameterError(f"centres of shape {centres.shape}; x and y of each are needed")
    if centres.shape == (2,) or (centres.ndim == 2 and centres.shape != (2, 2)):
        centres = np.stack([centres + layout.star_offset, centres], axis=-2)
    apart = np.subtract(centres[..., 0, :] - centres[..., 1, :], layout.star_offset)
    # two frames of one beam have the same shape, and so has the left beam before the right one
    if (far := np.hypot(*layout.star_offset) / 2) and (np.hypot(*apart.T) > far).any():
        raise ParameterError(
            f"centres = {centres.tolist()}: the right beam comes first, about (x, y) = "
            f"{layout.star_offset} from the left one; of 2 frames give both beams"
        )
    if far:
        left, right = (np.asarray(xy) - centres[..., 1, :] for xy in layout.internal_apertures[:2])
        # beyond the image it is refused as such
        inside = (centres[..., 1, :] < layout.shape[:0:-1]).all(axis=-1)
        if (inside & (np.hypot(*right.T) < np.hypot(*left.T))).any():
            raise ParameterError(
                f"centres = {centres[..., 1, :].tolist()} of the left beam are in the right one; "
                f"the middle of the left one is at {layout.internal_apertures[0]}"
            )
    if layout.beam_files:
        # their files are apart; side by side the left image comes first
        centres[..., 0, 0] -= layout.file_shape[2]
    return centres


def frame_positions(instrument, table, chain, names=None):
    """Return the position of every stage of a chain in each frame, radian, (n_frames,), by name.

    ``table`` has one row per frame with the angles of the headers, and ``flc_state``, A or B, if
    the chain has a modulator; ``names`` are those of the frames in messages.
    """
    table = QTable(table, copy=True)
    names = [f"frame {i}" for i in range(len(table))] if names is None else list(map(str, names))
    for leaf in leaves(chain):
        if leaf.stage in FLUXES:
            raise ObservationError(
                f"{names[0]}: {leaf.name} of the calibrated chain follows the fluxes of a table, "
                "which images do not have; correct both for it, and calibrate without it"
            )
        if leaf.stage in ("sequence", "frame"):
            warn(
                f"{leaf.name} of the calibrated chain changes in the course of the calibrated run; "
                "the frames are taken to change so too, in their order",
                stacklevel=3,
            )
    modulated = "flc_state" in stages(chain)
    needed = [stage for stage in stages(chain) if stage not in COORDINATES]
    if {"time", "right_ascension"} & set(table.colnames):
        # these are worked out
        needed = [stage for stage in needed if stage not in ("parallactic", "altitude")]
    for stage in needed:
        if stage not in table.colnames:
            raise ObservationError(
                f"{names[0]}: no angle {stage!r}, which the calibrated chain needs; there is "
                f"{', '.join(table.colnames) or 'nothing'}"
            )
        values = table[stage]
        # numpy drops the mask of both kinds of masked columns without a word
        values = values.filled(np.nan) if hasattr(values, "filled") else values
        unknown = ~np.isfinite(np.asarray(values.value, dtype=float))
        if unknown.any():
            raise ObservationError(f"{names[int(np.argmax(unknown))]}: no angle {stage!r}")
    states = table["flc_state"] if "flc_state" in table.colnames else [""] * len(table)
    states = np.ma.filled(np.ma.asarray(states).astype(str), "")
    for name, state in zip(names, states, strict=True):
        if modulated and not state.strip():
            raise ObservationError(
                f"{name}: no state of the modulator, flc_state, which the calibrated chain needs; "
                "allowed are A and B"
            )
    table["frame"], table["bin"] = np.arange(len(table)), np.zeros(len(table), dtype=int)
    # a table of observations needs a wavelength; no position depends on it
    table["wavelength"] = 1 * u.um
    # positions are read as those of observations are; the fluxes do not matter
    table["flux_right"] = table["flux_left"] = np.ones(len(table)) * u.adu
    # how the plate tracked the sky is all of the meta that positions depend on
    table.meta = {key: table.meta[key] for key in ("tracking",) if key in table.meta}
    check_states(chain, table.columns, names[0])
    observations = Observations.from_table(table, name=names[0])
    return dict(instrument.positions(observations, chain))
