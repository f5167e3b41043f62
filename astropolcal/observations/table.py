# Licensed under a 3-clause BSD style license - see LICENSE
"""`Observations`, the table of beam fluxes from which everything is calibrated."""

import dataclasses
import hashlib
from pathlib import Path

import astropy.units as u
import numpy as np
from astropy.table import QTable, Table
from astropy.time import Time

from astropolcal.exceptions import ObservationError, ParameterError, warn
from astropolcal.files import one_line
from astropolcal.observations import reading
from astropolcal.observations.grid import beam_variances, build_grid, warn_of_copies
from astropolcal.observations.observables import PAIRINGS, frame_groups, warn_of_exposures
from astropolcal.observations.pointings import frame_coordinate
from astropolcal.optics import COORDINATES
from astropolcal.units import angle_to_rad, canonical_unit
from astropolcal.words import check_choice, counted, html, listed

__all__ = ["Observations", "example_table"]


class Observations:
    """
    Beam fluxes of a series of frames, validated.

    Make one with `read` or `from_table`; an instance does not change, and `with_mask` and `select`
    return new ones. The table has one row per frame and wavelength, in any order:

    ============================== ========= =========================================
    column                         unit      meaning
    ============================== ========= =========================================
    frame, bin                               whole numbers
    wavelength                     length    one value per bin
    hwp, derotator, ...            angle     positions of the stages that the chain has
    parallactic, altitude          angle     optional, on sky
    flux_right, flux_left          any, one  ordinary and extraordinary beam; or
    flux, or flux_NAME             any, one  a single beam, or several others
    flux_right_err, flux_left_err  of flux   optional errors of the beams, and
    single_difference_err,         of flux   of R - L and R + L: what the beams share;
    single_sum_err                           alone, in proportion to the fluxes
    mask_reason                              optional, not empty where unusable
    any other                      any       belongs to the frame (file, time,
                                             flc_state), the same in all its rows
    ============================== ========= =========================================

    A cell whose flux or error is not a positive number, or that has no row, is masked with a reason
    and a warning. Everything worse is an `~astropolcal.exceptions.ObservationError`.

    Attributes
    ----------
    name : str
        For messages, reports and plots.
    path : `~pathlib.Path` or None
        The file it was read from.
    meta : dict
        As in the table; a ``date`` in it as ``YYYY-MM-DD``, perhaps with the time of day, or
        ``YYYY-MM``.

    Examples
    --------
    >>> from astropolcal.observations import Observations, example_table
    >>> obs = Observations.from_table(example_table(), name="night1")
    >>> obs
    <Observations 'night1': example polarimeter, polarized, 4 frames x 3 bins, 0 cells masked>
    >>> obs.pairs().tolist()
    [[0, 2], [1, 3]]
    """

    def __init__(self, grid, meta, name, path):
        self._grid = grid
        self.meta = dict(meta)
        self.name = str(name)
        self.path = None if path is None else Path(path)
        # in one form, as dates are compared as text
        date = reading.stated_date(self.meta, self._label)
        self.meta |= {} if date is None else {"date": date}
        # from the grid and not from the file: a mask set later holds for them as well
        self._variances = beam_variances(grid.flux_right, grid.flux_left, grid.errors)
        # found when they are first asked for, and kept
        self._groups, self._hashes = {}, {}
        self._mask = grid.reason > 0
        arrays = (grid.bin, grid.rows, grid.reason, self._mask)
        # groups and hash are kept, so that what they were made of must not change
        for array in (*arrays, *self._variances, *self._measured().values()):
            array.flags.writeable = False

    @classmethod
    def read(cls, path, *, name=None):
        """
        Read an ECSV file.

        Parameters
        ----------
        path : str or `~pathlib.Path`
            The file.
        name : str, optional
            By default the name of the file without its extension.

        Returns
        -------
        Observations

        Raises
        ------
        ObservationError
            If the file is absent, unreadable or inconsistent; the message is one
            line that names the file and the row or column.

        Warns
        -----
        AstropolcalWarning
            If cells are masked, or frames are copies of others.

        Examples
        --------
        >>> from astropolcal.observations import Observations
        >>> Observations.read("nowhere.ecsv")
        Traceback (most recent call last):
        ...
        astropolcal.exceptions.ObservationError: nowhere.ecsv: no such file
        """
        table = reading.read_ecsv(path)
        # it goes to terminals, pages and figures
        name = one_line(Path(path).stem, None) if name is None else name
        found = cls.from_table(table, name=name, path=path)
        warn_of_copies(found._grid, found._label)
        return found

    @classmethod
    def from_table(cls, table, *, name="table", path=None):
        """
        Validate a table that is in memory.

        Parameters
        ----------
        table : `~astropy.table.Table`
            Columns as described in the class; it is not changed.
        name : str
            For messages and reports.
        path : str or `~pathlib.Path`, optional
            The file it came from.

        Returns
        -------
        Observations

        Raises
        ------
        ObservationError
            If the table is inconsistent.

        Examples
        --------
        >>> from astropy.table import QTable
        >>> from astropolcal.observations import Observations
        >>> Observations.from_table(QTable({"frame": [0], "bin": [0], "hwp": [0]}), name="x")
        Traceback (most recent call last):
        ...
        astropolcal.exceptions.ObservationError: x: missing columns wavelength, flux_right, flux_left; it has frame, bin, hwp
        """  # noqa: E501
        label = str(name if path is None else path)
        table = reading.complete_table(table, label)
        found = cls(build_grid(table, label), getattr(table, "meta", {}), name, path)
        dark = found.mask.all(axis=0)
        if not dark.any():
            return found
        # a fit can constrain nothing there
        words = listed([f"{w:.4g}" for w in found.wavelength[dark].to_value(u.nm)])
        warn(f"{label}: no usable cell at {words} nm; left out", stacklevel=3)
        return found.select_bins(~dark)

    @property
    def instrument(self):
        """Name of the instrument (str), or None if the table does not say."""
        return self._text("instrument")

    @property
    def source(self):
        """What was observed (str), or None if the table does not say."""
        return self._text("source")

    def _text(self, key):
        value = self.meta.get(key)
        return value if isinstance(value, str) else None

    @property
    def frames(self):
        """One row per frame with every column that belongs to frames (a copy)."""
        return self._grid.frames.copy()

    @property
    def frame_columns(self):
        """Names of the columns of `frames`."""
        return self._grid.frames.colnames

    @property
    def n_frames(self):
        """Number of frames, F."""
        return len(self._grid.frames)

    @property
    def n_bins(self):
        """Number of wavelength bins, W."""
        return len(self._grid.bin)

    @property
    def bin(self):
        """Numbers of the wavelength bins, shape (W,)."""
        return self._grid.bin

    @property
    def wavelength(self):
        """Wavelength of every bin (`~astropy.units.Quantity`), shape (W,)."""
        return self._grid.wavelength.copy()

    @property
    def flux_unit(self):
        """Unit of the fluxes and the square root of that of the variances."""
        return self._grid.flux_unit

    @property
    def flux_right(self):
        """Flux of the ordinary beam, shape (F, W), NaN where masked."""
        return self._grid.flux_right

    @property
    def flux_left(self):
        """Flux of the extraordinary beam, shape (F, W), NaN where masked."""
        return self._grid.flux_left

    @property
    def single_beam(self):
        """Whether each frame has one beam only: `flux_right`; `flux_left` is then zero."""
        return self._grid.single

    @property
    def brightness_groups(self):
        """Number of the group of frames that share the brightness of the source, shape (F,)."""
        frames = self._grid.frames
        if "group" not in frames.colnames:
            return np.zeros(self.n_frames, dtype=int)
        return np.unique(np.asarray(frames["group"]), return_inverse=True)[1]

    @property
    def variance_right(self):
        """Variance of `flux_right`, shape (F, W), NaN where masked or unknown."""
        return self._variances[0]

    @property
    def variance_left(self):
        """Variance of `flux_left`, shape (F, W), NaN where masked or unknown."""
        return self._variances[1]

    @property
    def covariance(self):
        """Covariance of the two beams, shape (F, W), NaN where masked or unknown."""
        return self._variances[2]

    @property
    def mask(self):
        """True where a cell is unusable, shape (F, W)."""
        return self._mask

    @property
    def mask_reasons(self):
        """Number of masked cells by reason (dict)."""
        counts = np.bincount(self._grid.reason.ravel(), minlength=len(self._grid.reasons) + 1)
        pairs = zip(self._grid.reasons, counts[1:].tolist(), strict=True)
        return {reason: count for reason, count in pairs if count}

    @property
    def content_hash(self):
        """
        SHA-256 of the content (str), the same for any order of rows and format of numbers.

        Numbers count to 12 significant digits in canonical units; of ``meta``, only
        the instrument and the source belong to the content.
        """
        grid, header = self._grid, f"{self.instrument}|{self.source}"
        # meta may change, the columns may not
        if header not in self._hashes:
            columns = {name: grid.frames[name] for name in grid.frames.colnames}
            columns |= {"bin": grid.bin, "wavelength": grid.wavelength, "mask": self.mask}
            columns |= {name: array * grid.flux_unit for name, array in self._measured().items()}
            self._hashes[header] = hash_columns(columns, header)
        return self._hashes[header]

    def _measured(self):
        grid = self._grid
        fluxes = {"flux_right": grid.flux_right, "flux_left": grid.flux_left}
        return ({"flux": grid.flux_right} if grid.single else fluxes) | grid.errors

    def __len__(self):
        return self.n_frames

    def __repr__(self):
        return f"<Observations {self.name!r}: {self._headline()}>"

    def _repr_html_(self):
        return html(repr(self), self.frames)

    def _headline(self):
        counts = [f"{counted(self.n_frames, 'frame')} x {counted(self.n_bins, 'bin')}"]
        counts.append(f"{counted(int(self.mask.sum()), 'cell')} masked")
        return ", ".join([text for text in (self.instrument, self.source) if text] + counts)

    def summary(self):
        """
        Return what the table holds, in a few lines of text.

        Returns
        -------
        str

        Examples
        --------
        >>> from astropolcal.observations import Observations, example_table
        >>> print(Observations.from_table(example_table(), name="x").summary())
        x: example polarimeter, polarized, 4 frames x 3 bins, 0 cells masked
        wavelength: 1.2 to 2.2 um
        hwp: 0, 22.5, 45, 67.5 deg
        derotator: 90 deg
        errors: flux_right_err and flux_left_err
        """
        low, high = self.wavelength.min(), self.wavelength.max()
        lines = [f"{self.name}: {self._headline()}"]
        lines.append(f"wavelength: {low.value:g} to {high.value:g} {high.unit}")
        angles = (name for name, column in self._grid.frames.columns.items() if _is_angle(column))
        lines += [f"{name}: {_span(np.rad2deg(self.position(name)))} deg" for name in angles]
        lines.append(f"errors: {' and '.join(self._grid.errors) or 'none'}")
        lines += [f"masked, {why}: {counted(n, 'cell')}" for why, n in self.mask_reasons.items()]
        return "\n".join(lines)

    def position(self, column):
        """
        Return an angle of every frame, or another quantity that an optic may depend on.

        Parameters
        ----------
        column : str
            A column with the unit of an angle, such as ``"hwp"``; or one of
            `~astropolcal.optics.COORDINATES`: ``"sequence"``, how far the run has come, from 0 in
            the first frame to 1 in the last (by the column ``time`` if it gives the time of every
            frame, else by the order); ``"frame"``, its number from 0; ``"hwp_direction"`` and
            ``"derotator_direction"``, 1 where the last move of that stage was backwards,
            ``"hwp_move"`` and ``"derotator_move"``, how far it went, in radian, and ``"hwp_next"``
            and ``"derotator_next"``, how far it goes next, so also of any other stage, and
            ``"hwp_move2"``, how far it went in the last two moves; ``"hwp_reversed"`` and
            ``"derotator_reversed"``, how far it is from where it would be if each cycle came in
            reverse order; ``"flc_state"``, 0 or 1 for the states A and B of a modulator;
            ``"parallactic_rate"``,
            ``"hwp_rate"`` and ``"derotator_rate"``, by how much that angle changes from one frame
            to the next, in radian, so also of any other stage; ``"brightness"``, by what share the
            frame is brighter than the mean of the table; ``"flux"``, the fluxes of the beams in the
            unit of the table, 0 where masked; ``"total_flux"``, the sum of both, once for each;
            ``"previous_flux"``, the fluxes over those of the frame taken before, 1 for the first
            and where one of the two is masked. For laws of parameters also ``"time"``, a Modified
            Julian Date (UTC), and ``"x"`` and ``"y"``, the place in the field in arcsec.

        Returns
        -------
        `~numpy.ndarray`
            Radian, shape (F,); a number for the sequence and the state; for the fluxes shape
            (2, B, F), the right beam first.

        Raises
        ------
        ObservationError
            If there is no such column, or it is not an angle.

        Examples
        --------
        >>> from astropolcal.observations import Observations, example_table
        >>> obs = Observations.from_table(example_table())
        >>> obs.position("hwp")[:3].round(4).tolist()
        [0.0, 0.3927, 0.7854]
        """
        frames = self._grid.frames
        if column in COORDINATES:
            return frame_coordinate(self, column)
        if column not in frames.colnames:
            angles = [name for name in frames.colnames if _is_angle(frames[name])]
            known = ", ".join(angles) or "none"
            raise ObservationError(f"{self._label}: no column {column!r}; its angles are {known}")
        if not _is_angle(frames[column]):
            raise ObservationError(
                f"{self._label}: column {column} is not an angle; a unit such as deg is needed"
            )
        return reading.numeric_column(frames, column, self._label, u.rad)

    @property
    def _label(self):
        return self.name if self.path is None else str(self.path)

    @property
    def pairing(self):
        """
        What differs between the frames of a pair, from the meta (str).

        ``"hwp"``, the default: the half-wave plate, by 45 deg. ``"flc_state"``, the default
        in a table of single differences with that column: the state of a modulator.
        """
        value = self.meta.get("pairing", PAIRINGS[0])
        check_choice(f"{self._label}: pairing of the meta", value, PAIRINGS, ObservationError)
        return value

    def pairs(self, tolerance=0.3 * u.deg, *, derotator_tolerance=0.5 * u.deg, share=False):
        """
        Pair the frames 45 degrees of (commanded) half-wave-plate angle apart, or see `pairing`.

        Parameters
        ----------
        tolerance, derotator_tolerance : `~astropy.units.Quantity`
            Largest differences that still count as the same angle.
        share : bool
            Whether a frame left over may be paired with one that is already used.

        Returns
        -------
        `~numpy.ndarray` of int
            Frame indices (plus, minus), shape (P, 2); read only, found once and kept. The plus
            frame is the one whose angle modulo 90 deg lies in [0, 45). The frames agree in the
            derotator angle and in the state of a modulator; among several partners the nearest
            in time is taken.

        Raises
        ------
        ObservationError
            If an angle of the table has no partner in it, or nothing can be paired.

        Warns
        -----
        AstropolcalWarning
            If frames are left over.

        Examples
        --------
        >>> from astropolcal.observations import Observations, example_table
        >>> obs = Observations.from_table(example_table())
        >>> obs.pairs().tolist()
        [[0, 2], [1, 3]]
        """
        return self._grouped(self.pairing, tolerance, derotator_tolerance, share)

    def _grouped(self, kind, tolerance=0.3 * u.deg, derotator_tolerance=0.5 * u.deg, share=False):
        limits = {"tolerance": tolerance, "derotator_tolerance": derotator_tolerance}
        # in radian, so that 30 arcmin and 0.5 deg are one entry
        limits = {name: float(angle_to_rad(angle, name)) for name, angle in limits.items()}
        key = (kind, *limits.values(), bool(share))
        if key not in self._groups:
            limits = {name: angle * u.rad for name, angle in limits.items()}
            rows = self._grid.rows.tolist()
            self._groups[key] = frame_groups(self, kind, rows, self._label, share=share, **limits)
        return self._groups[key]

    def groups(self, size):
        """
        Return the frames of each datum of an observable.

        Parameters
        ----------
        size : {1, 2, 4}
            Frames per datum: single frames, `pairs`, or pairs in both states of a modulator.

        Returns
        -------
        `~numpy.ndarray` of int
            Frame indices, shape (G, size). Four frames are state A and B at the plus angle of the
            half-wave plate, then at the minus angle, which is 45 deg further.

        Raises
        ------
        ObservationError
            If a frame has no partner in the other state at its angles; the message names the
            file, the row and the state. Or if nothing can be paired.

        Warns
        -----
        AstropolcalWarning
            If frames are left over, or the exposures of those whose light is taken to be the same
            differ.

        Examples
        --------
        >>> from astropolcal.observations import Observations, example_table
        >>> table = example_table(hwp=(0, 0, 45, 45), wavelength=(0.625,))
        >>> table["flc_state"] = ["A", "B", "B", "A"]
        >>> Observations.from_table(table).groups(4).tolist()
        [[0, 1, 3, 2]]
        """
        if size == 4:
            return self._grouped("both")
        if size == 2:
            return self.pairs()
        if size != 1:
            raise ObservationError(f"groups of {size!r} frames; allowed are 1, 2 and 4")
        if self.single_beam:
            number = self.brightness_groups
            shared = [np.flatnonzero(number == one) for one in range(number.max() + 1)]
            warn_of_exposures(self, shared, self._label)
        return np.arange(self.n_frames)[:, None]

    def with_mask(self, mask, reason):
        """
        Return observations with more cells masked.

        Parameters
        ----------
        mask : array_like of bool
            True where a cell is to be masked: shape (F, W), or (F,) for whole frames.
        reason : str
            Why; it appears in `mask_reasons`. Cells masked before keep their reason.

        Returns
        -------
        Observations

        Raises
        ------
        ObservationError
            If the shape, type or reason is wrong, or no usable cell would remain.

        Examples
        --------
        >>> from astropolcal.observations import Observations, example_table
        >>> obs = Observations.from_table(example_table())
        >>> obs.with_mask(obs.flux_right < 400, "faint").mask_reasons
        {'faint': 3}
        """
        grid, label = self._grid, self._label
        mask, known = np.asarray(mask), self.mask
        shapes = (known.shape, known.shape[:1])
        if mask.dtype != bool or mask.shape not in shapes:
            raise ObservationError(
                f"{label}: mask of type {mask.dtype} and shape {mask.shape}; allowed are "
                f"booleans of shape {shapes[0]} or {shapes[1]}"
            )
        if not isinstance(reason, str) or not reason.strip():
            raise ObservationError(f"{label}: reason = {reason!r}, some words are needed")
        reason = reason.strip()
        new = (mask if mask.ndim == 2 else mask[:, None]) & ~known
        if (new | known).all():
            raise ObservationError(
                f"{label}: masking {reason!r} would leave no usable cell of {new.size}"
            )
        reasons = grid.reasons if reason in grid.reasons else (*grid.reasons, reason)
        # a masked flux is NaN as well, so that what forgets the mask cannot use it
        return self._with(
            flux_right=np.where(new, np.nan, grid.flux_right),
            flux_left=np.where(new, np.nan, grid.flux_left),
            errors={name: np.where(new, np.nan, error) for name, error in grid.errors.items()},
            reason=np.where(new, reasons.index(reason) + 1, grid.reason),
            reasons=reasons,
        )

    def select(self, frames):
        """
        Return the observations of some frames, in the order of the table.

        Parameters
        ----------
        frames : array_like of bool or int
            One boolean per frame, or indices of frames, each at most once.

        Returns
        -------
        Observations

        Raises
        ------
        ObservationError
            If an index is out of range or given twice, or no usable cell remains.

        Examples
        --------
        >>> from astropolcal.observations import Observations, example_table
        >>> obs = Observations.from_table(example_table())
        >>> obs.select(obs.pairs()[0]).frames["hwp"].value.tolist()
        [0.0, 45.0]
        """
        frames, n_frames, label = np.asarray(frames), self.n_frames, self._label
        if frames.dtype == bool and frames.shape == (n_frames,):
            frames = np.flatnonzero(frames)
        # an empty list has type float, and selects nothing that could be used
        if frames.dtype.kind not in "iu" or frames.ndim != 1:
            raise ObservationError(
                f"{label}: frames of type {frames.dtype} and shape {frames.shape}; allowed "
                f"are {n_frames} booleans or a list of indices"
            )
        outside = frames[(frames < -n_frames) | (frames >= n_frames)]
        if outside.size:
            raise ObservationError(
                f"{label}: frame index {outside[0]}, allowed are 0 to {n_frames - 1}"
            )
        # -1 and the last index are the same frame
        index, counts = np.unique(frames % n_frames, return_counts=True)
        if (counts > 1).any():
            raise ObservationError(
                f"{label}: frame index {index[counts > 1][0]} is given twice, "
                "each frame is allowed once"
            )
        own = {"frames": self._grid.frames[index], "rows": self._grid.rows[index]}
        return self._part((index,), f"the {counted(len(index), 'frame')} selected have", **own)

    def select_bins(self, bins):
        """
        Return the observations at some wavelengths.

        Parameters
        ----------
        bins : array_like of bool
            One boolean per bin, shape (B,).

        Returns
        -------
        Observations

        Raises
        ------
        ObservationError
            If the shape or type is wrong, or no usable cell remains.

        Examples
        --------
        >>> import astropy.units as u
        >>> from astropolcal.observations import Observations, example_table
        >>> obs = Observations.from_table(example_table())
        >>> obs.select_bins(obs.wavelength < 1.5 * u.um).n_bins
        1
        """
        chosen = np.asarray(bins)
        if chosen.dtype != bool or chosen.shape != (self.n_bins,):
            raise ObservationError(
                f"{self._label}: bins of type {chosen.dtype} and shape {chosen.shape}; allowed "
                f"are {self.n_bins} booleans"
            )
        own = {"bin": self.bin[chosen], "wavelength": self._grid.wavelength[chosen]}
        return self._part((slice(None), chosen), "the bins selected have", **own)

    def _part(self, place, words, **own):
        """Return some of the cells, which have columns of their own."""
        if self.mask[place].all():
            raise ObservationError(f"{self._label}: {words} no usable cell")
        for name in ("flux_right", "flux_left", "reason"):
            own[name] = getattr(self._grid, name)[place]
        errors = {name: error[place] for name, error in self._grid.errors.items()}
        return self._with(errors=errors, **own)

    def _with(self, **changes):
        """Return observations of a changed grid, with the same meta, name and file."""
        grid = dataclasses.replace(self._grid, **changes)
        return Observations(grid, self.meta, self.name, self.path)

    def to_table(self):
        """
        Return a table from which `from_table` makes the same observations.

        Returns
        -------
        `~astropy.table.QTable`
            One row per frame and bin, masked cells with NaN and a ``mask_reason``.

        Examples
        --------
        >>> from astropolcal.observations import Observations, example_table
        >>> obs = Observations.from_table(example_table())
        >>> len(obs.to_table())
        12
        """
        grid = self._grid
        # wavelengths run fastest, (F * W,) rows
        table = grid.frames[np.repeat(np.arange(self.n_frames), self.n_bins)]
        table["bin"] = np.tile(grid.bin, self.n_frames)
        table["wavelength"] = np.tile(grid.wavelength, self.n_frames)
        for name, array in self._measured().items():
            table[name] = array.ravel() * grid.flux_unit
        if self.mask.any():
            table["mask_reason"] = np.array(["", *grid.reasons])[grid.reason.ravel()]
        table.meta.update(self.meta)
        return table

    def write(self, path, overwrite=False):
        """
        Write an ECSV file that `read` turns into the same observations.

        The file appears complete or not at all.

        Parameters
        ----------
        path : str or `~pathlib.Path`
            The file.
        overwrite : bool
            Whether an existing file may be replaced.

        Raises
        ------
        ObservationError
            If the file exists, or cannot be written.

        Examples
        --------
        >>> import tempfile
        >>> from pathlib import Path
        >>> from astropolcal.observations import Observations, example_table
        >>> obs = Observations.from_table(example_table())
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     obs.write(Path(folder) / "copy.ecsv")
        ...     again = Observations.read(Path(folder) / "copy.ecsv")
        >>> again.content_hash == obs.content_hash
        True
        """
        # a plain Table gives a header that people can read, unlike a QTable
        reading.write_table(Table(self.to_table()), path, overwrite)


def _span(angles):
    """Return few distinct angles one by one, many as a range."""
    distinct = np.unique(angles.round(4))
    if len(distinct) <= 8:
        return ", ".join(f"{angle:g}" for angle in distinct)
    return f"{distinct[0]:g} to {distinct[-1]:g}"


def _is_angle(column):
    return isinstance(column, u.Quantity) and column.unit.is_equivalent(u.rad)


# ---- fingerprint ---------------------------------------------------------------------------------


def hash_columns(columns, header=""):
    """
    Return the SHA-256 of named columns in any order, and of a header.

    Numbers count to 12 digits, angles and lengths in canonical units, so that the way they are
    written does not matter.
    """
    digest = hashlib.sha256(header.encode())
    # the order of columns in a file says nothing
    for name in sorted(columns):
        # the name separates columns, or moving a value to the next one would go unnoticed
        unit, text = _canonical(columns[name])
        digest.update(f"\n{name}|{unit}|{text}".encode())
    return digest.hexdigest()


def _canonical(column):
    """Return the unit and the values of a column as text that formats cannot change."""
    unit = getattr(column, "unit", None)
    if isinstance(column, Time):
        # one moment is the same in all scales, of which a local one tells no other
        column = (column if column.scale == "local" else column.utc).mjd
    elif isinstance(column, u.Quantity):
        try:
            unit = canonical_unit(unit)
            column = column.to_value(unit)
        # units that are neither angles nor lengths, such as adu, stay as they are
        except ParameterError:
            column = column.value
    if not isinstance(column, np.ndarray):
        return unit, "\x1f".join(str(value) for value in column)  # coordinates and the like
    mask = np.asarray(getattr(column, "mask", False))
    values = np.ma.getdata(getattr(column, "unmasked", column))
    if values.dtype.kind in "iuf":
        # adding zero turns -0 into 0
        # 12 digits: what conversions between units leave of a double
        numbers = (np.asarray(values, dtype=float) + 0.0).ravel().tolist()
        text = ("%.11e\x1f" * len(numbers) % tuple(numbers))[:-1]
        if not mask.any():
            return unit, text
        values = np.reshape(text.split("\x1f"), values.shape)
    elif values.dtype.kind in "US":
        # a file of text has no blanks about a word, and a word that is empty is masked in it
        values = np.char.strip(values.astype(str))
        mask = mask | (values == "")
    # what lies below a mask is not content
    values = np.where(mask, "masked", np.asarray(values).astype(str))
    return unit, "\x1f".join(values.ravel().tolist())


# ---- example -------------------------------------------------------------------------------------


def example_table(
    hwp=(0.0, 22.5, 45.0, 67.5), derotator=(90.0,), wavelength=(1.2, 1.6, 2.2), polarization=0.5
):
    """
    Return what an ideal dual-beam polarimeter measures of light with positive Q.

    Fluxes follow R, L = I (1 +- p cos 4 (hwp - derotator)) / 2: half-wave plate,
    derotator (half a wave as well) and Wollaston prism are all ideal.

    Parameters
    ----------
    hwp, derotator : sequence of float
        Angles in degree; there is a frame for every combination.
    wavelength : sequence of float
        Micrometre.
    polarization : float
        Degree of polarization, p.

    Returns
    -------
    `~astropy.table.QTable`
        As `~astropolcal.observations.Observations.from_table` takes it, with the
        errors of photon noise.

    Examples
    --------
    >>> from astropolcal.observations import example_table
    >>> example_table().colnames[:5]
    ['frame', 'bin', 'wavelength', 'hwp', 'derotator']
    """
    # "ij": the wavelength runs fastest, then the plate, then the derotator
    stages, plates, bins = np.meshgrid(derotator, hwp, np.arange(len(wavelength)), indexing="ij")
    frame = np.repeat(np.arange(len(hwp) * len(derotator)), len(wavelength))
    # each half-wave plate turns polarization by twice its angle, and both act in turn
    signal = polarization * np.cos(4 * np.deg2rad(plates - stages)).ravel()
    # photons, so that the errors of a few percent can be seen in a plot
    intensity = 1000.0
    right, left = intensity * (1 + signal) / 2, intensity * (1 - signal) / 2
    return QTable(
        {
            "frame": frame,
            "bin": bins.ravel(),
            "wavelength": np.asarray(wavelength, dtype=float)[bins.ravel()] * u.um,
            "hwp": plates.ravel() * u.deg,
            "derotator": stages.ravel() * u.deg,
            "flux_right": right * u.adu,
            "flux_left": left * u.adu,
            "flux_right_err": np.sqrt(right) * u.adu,
            "flux_left_err": np.sqrt(left) * u.adu,
        },
        meta={"instrument": "example polarimeter", "source": "polarized"},
    )
