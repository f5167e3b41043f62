# Licensed under a 3-clause BSD style license - see LICENSE
"""What a pipeline loads: the system Mueller matrix of a frame, from its header.

Loading needs numpy, astropy and asdf, nothing that fits, measures or draws.
"""

from collections.abc import Mapping
from copy import copy
from os import PathLike
from pathlib import Path

import astropy.units as u
import numpy as np

from astropolcal import instruments
from astropolcal.calibration.identifiability.sky import known_instrument
from astropolcal.calibration.result.calibration import Calibration, validity_of
from astropolcal.calibration.system import (
    MuellerMatrices,
    at_wavelengths,
    distinct,
    match_wavelengths,
    model_error,
)
from astropolcal.calibration.uncertainty.covariance import full_covariance
from astropolcal.chain import join, leaves, with_beam
from astropolcal.converters.calibration import content_hash
from astropolcal.exceptions import (
    CalibrationFileError,
    ChainError,
    InstrumentError,
    ParameterError,
    warn,
)
from astropolcal.files import one_line
from astropolcal.fitscheck import primary_header
from astropolcal.optics import COORDINATES
from astropolcal.optics.positions import PLACES, finite_position
from astropolcal.pipeline.headers import (
    FrameAngles,
    check_frames,
    describe,
    faults_of,
    inner_optics,
    telescope_optics,
    told_beam,
)
from astropolcal.pipeline.library import Entry, Library
from astropolcal.units import angle_to_rad, to_unit
from astropolcal.words import check_choice

__all__ = ["LoadedCalibration", "SystemMueller", "load"]


class SystemMueller(MuellerMatrices):
    """
    System Mueller matrices of frames and wavelengths, with what is known of their errors.

    `LoadedCalibration.system_mueller` makes it. The errors are worked out when they are asked for,
    so that an index, ``matrices[:100]``, gives those of some frames without those of the others.
    They are those of the calibrated parameters: the error of the model that the summary of a
    calibration counts (``fit["model_error"]``) is one of q and u, not of an element; ``correct``
    adds it.

    Attributes
    ----------
    value : `~numpy.ndarray`
        Shape (n_frames, n_wavelengths, 4, 4); no first axis for a single frame. The first row
        gives the flux of the beam for incident I, Q, U and V.
    wavelength : `~astropy.units.Quantity`
        Shape (n_wavelengths,).
    beam : str
        ``"right"`` or ``"left"``.
    positions : dict of str to `~astropy.units.Quantity`
        Of every stage, in degree.
    assumed : tuple of str
        Optics that are not calibrated: they have published values and add nothing to the errors.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.pipeline import load
    >>> from astropolcal.testing import example_calibration
    >>> cal = load(example_calibration())
    >>> positions = {"hwp": [0, 22.5, 45] * u.deg, "derotator": 60 * u.deg}
    >>> matrices = cal.system_mueller(positions=positions, light="internal")
    >>> matrices.value.shape, matrices[1:].covariance.shape, matrices[0].std.shape
    ((3, 22, 4, 4), (2, 22, 16, 16), (22, 4, 4))
    """

    def __init__(self, beam, positions, assumed, *problem):
        super().__init__(*problem)
        self.value, self.wavelength, self.beam = self.values(), self._lam, beam
        self.positions, self.assumed = positions, assumed

    def __getitem__(self, frames):
        """Return the matrices of some frames."""
        if not self.which.ndim:
            raise ParameterError(f"frames {frames!r}: the matrices are those of a single frame")
        some, size = copy(self), self.which.size
        some.which, some.value = np.asarray(self.which[frames]), self.value[frames]
        some.positions = {
            name: np.broadcast_to(position, (size, *position.shape[1:]), subok=True)[frames]
            for name, position in self.positions.items()
        }
        return some

    @property
    def is_open(self):
        """Elements that move along a direction that the data do not determine."""
        return self.flags()[0]

    @property
    def is_blind(self):
        """Elements that depend on parameters at a bound alone."""
        return self.flags()[1]

    @property
    def covariance(self):
        """
        Covariance of the 16 elements of each matrix, row by row, shape (..., 16, 16).

        Infinite for what the data do not determine and NaN for what they do not constrain, as
        `~astropolcal.calibration.uncertainty.covariance.Covariance.propagate` has it.
        """
        matrix = self.covariance_in_gauge
        is_open, is_blind = (each.reshape(matrix.shape[:-1]) for each in self.flags())
        unknown = is_open | is_blind
        # no covariance with what has no error, whichever of the two it is
        matrix[unknown[..., :, None] | unknown[..., None, :]] = np.nan
        matrix[is_open[..., :, None] & np.eye(16, dtype=bool)] = np.inf
        return matrix

    @property
    def covariance_in_gauge(self):
        """The covariance with open directions held where the calibration has put them.

        Finite everywhere. It is too small for what moves along them, such as the angle of
        polarization where the data know misalignments up to a common turn; a prior on one
        of the angles in the calibration gives an error that is right.
        """
        # rows: the elements of a matrix; columns: the parameters that move them
        moved = self.local_factor()
        return moved @ np.swapaxes(moved, -1, -2)


# what a caller can do about a header that does not say enough
_WAYS = {"date": "load(..., date=) states it", "mode": "load(..., mode={})"}


def load(path, header=None, *, instrument=None, mode=None, date=None, optics_in=None, max_age=None):
    """
    Load the calibration that holds for a frame.

    Parameters
    ----------
    path : path-like, Library or Calibration
        A folder of calibrations, a file, or a calibration that is in memory.
    header : `~astropy.io.fits.Header`, mapping or path-like, optional
        Primary header of the frame (or of one of several), or its file, which tells instrument,
        mode, date and, as far as the instrument knows, optics in the beam; what is given below
        comes before it.
    instrument, mode, date, optics_in
        As for `~astropolcal.pipeline.Library.find`.
    max_age : `~astropy.units.Quantity`, optional
        Time between the data of the calibration and a frame from which on there is a warning; by
        default that of the instrument (`~astropolcal.instruments.Instrument`), a year for most.
        A calibration whose end of validity was stated is never too old.

    Returns
    -------
    LoadedCalibration

    Raises
    ------
    CalibrationFileError
        If no calibration holds, several do, a file is damaged, the header lacks a date or a mode
        that the calibration needs and none is stated here, or the instrument has changed between
        the data of the calibration and the frame.
    ParameterError
        If the header is none, or ``max_age`` no time.

    Warns
    -----
    AstropolcalWarning
        If the calibration is not usable as its verdict says, those beside it in the library differ
        by more than their errors, which then count what changes between them, or it is older than
        ``max_age``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.pipeline import load
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear", optics_in=["nbs"])
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> table = simulate(chain, charis.wavelength, frames, seed=2, meta={"date": "2025-10-05"})
    >>> calibrate(chain, table, instrument="charis").write("to_load.asdf")
    >>> header = {"MJD": 60960.5, "RET-ANG1": 22.5, "D_IMRANG": 60.0, "INSTRUME": "CHARIS"}

    The three lines of a pipeline, here for a frame of the internal source:

    >>> calibration = load("to_load.asdf", header)
    >>> mueller = calibration.system_mueller(header, light="internal")
    >>> mueller.value.shape, mueller.covariance.shape
    ((22, 4, 4), (22, 16, 16))
    """
    library = path
    if isinstance(path, Calibration):
        library, held = Library([]), validity_of(path)
        library.entries = [Entry(Path("calibration in memory"), path, held, content_hash(path))]
    elif not isinstance(path, Library):
        library = Library(path)
    wanted = wanted_of(header, instrument, mode=mode, date=date, optics_in=optics_in)
    entry = library.find(**wanted)
    faults_of(entry.calibration, entry.name)
    entry = library._with_changes(entry)
    stated = {"instrument": instrument, "mode": mode, "date": date}
    stated = {key: value for key, value in stated.items() if value is not None}
    loaded = LoadedCalibration(entry, optics_in=optics_in, stated=stated, max_age=max_age)
    # whether the light comes from the sky, whose mirrors may have changed, is known later
    if header is not None:
        loaded._check([("the frame", wanted["date"], wanted["mode"])], light="internal")
    elif date is not None:
        loaded._check(loaded._frames(None), light="internal")
    return loaded


def wanted_of(header, instrument=None, *, mode=None, date=None, optics_in=None):
    """Return what `Library.find` needs for a frame; what is stated comes before its header."""
    header = primary_header(header) if isinstance(header, str | PathLike) else header
    if header is not None and not hasattr(header, "get"):
        raise ParameterError(
            f"header = {header!r} is of type {type(header).__name__}; a FITS header or a mapping "
            "is needed, such as astropy.io.fits.getheader(file)"
        )
    told = {} if header is None else describe(header, instrument)
    stated = {"instrument": instrument, "mode": mode, "date": date}
    wanted = {key: told.get(key) if value is None else value for key, value in stated.items()}
    beam = None
    if header is not None and optics_in is None:
        beam = instruments.get(wanted["instrument"]).optics_of(header)
    return wanted | {"optics_in": optics_in, "beam": beam}


def _headers(header):
    """Return headers as a list, those of files read, and whether there is one outside a list."""
    # a Header of astropy is no Mapping
    single = isinstance(header, Mapping | str | PathLike) or hasattr(header, "cards")
    headers = [header] if single else list(() if header is None else header)
    paths = (str, PathLike)
    return [primary_header(one) if isinstance(one, paths) else one for one in headers], single


class LoadedCalibration:
    """
    A calibration that gives the system Mueller matrix of frames; `load` makes it.

    Parameters
    ----------
    entry : Entry
        File and validity.
    optics_in : sequence of str, optional
        Optional optics in the beam; needed if the calibration has several sets of them, and
        the headers do not tell which.
    stated : dict of str to str
        What the user states of ``instrument``, ``mode`` and ``date``, regardless of the headers.
    max_age : `~astropy.units.Quantity`, optional
        As for `load`.

    Attributes
    ----------
    calibration : Calibration
        All that the file holds.
    path : `~pathlib.Path`
    validity : ``Validity``
    content_hash : str
        Of the file's content, for the provenance of products.

    Examples
    --------
    >>> from astropolcal.pipeline import load
    >>> from astropolcal.testing import example_calibration
    >>> example_calibration().write("lab.asdf")
    >>> load("lab.asdf")
    <LoadedCalibration lab.asdf: charis, any mode, from any date on, optics in the beam not known>
    """

    def __init__(self, entry, optics_in=None, stated=None, max_age=None):
        self.calibration = entry.calibration
        self.path, self.validity = entry.path, entry.validity
        self.content_hash = entry.content_hash
        self.optics_in = optics_in
        self._stated, self._max_age = dict(stated or {}), max_age
        self._covariance = full_covariance(self.calibration)._axes()

    def __repr__(self):
        return f"<LoadedCalibration {self.path.name}: {self.validity}>"

    @property
    def instrument(self):
        """The `~astropolcal.instruments.Instrument`, or None if it is not a known one."""
        return known_instrument(self.calibration.instrument)

    @property
    def wavelength(self):
        """Wavelengths of the calibration, a `~astropy.units.Quantity`."""
        return self.calibration.wavelength

    @property
    def chain(self):
        """The calibrated chain, an astropy model: a copy, which may be changed.

        From the sky where the telescope is calibrated, otherwise from the first optic on a stage
        of the instrument.

        Raises
        ------
        ChainError
            If the calibration has several sets of optics in the beam and none was stated.
        """
        inner = inner_optics(self.calibration, self.optics_in, label=self.path.name)
        return join([*telescope_optics(self.calibration, self.path.name), *inner]).copy()

    def system_mueller(
        self,
        header=None,
        *,
        positions=None,
        wavelength=None,
        interpolate=False,
        beam="right",
        light="sky",
    ):
        """
        Return the system Mueller matrix of frames, with its covariance.

        The covariance is that of the calibrated parameters to first order.

        Parameters
        ----------
        header : `~astropy.io.fits.Header`, mapping, path-like, or sequence of those
            Primary header of a frame, or the file that has it, or those of several.
        positions : dict of str to `~astropy.units.Quantity`
            In its place the positions of all stages (on sky with the true angle of the
            half-wave plate), scalar or shape (n_frames,).
        wavelength : `~astropy.units.Quantity`, optional
            By default the calibration's grid. Others within its range are possible where no
            parameter is given per wavelength, or with ``interpolate``.
        interpolate : bool
            Whether parameters given per wavelength are interpolated linearly.
        beam : {"right", "left"}
            The beam.
        light : {"sky", "internal"}
            Where the light enters: above the telescope, in the frame of the sky; or upstream of
            the half-wave plate, as from the internal source.

        Returns
        -------
        SystemMueller

        Raises
        ------
        CalibrationFileError
            If the calibration does not hold for the header, the header lacks a date or a mode that
            was not stated to `load` either, or the instrument has changed in between. Positions
            are taken for what they are, unless a date was stated.
        ObservationError
            If the header lacks an angle, or an altitude is not above 0 to 90 deg.
        ChainError, ParameterError
            If a position is missing, the optics in the beam are ambiguous or lacking.
        WavelengthRangeError
            If the wavelengths do not match.

        Warns
        -----
        AstropolcalWarning
            If an optic is not calibrated and has published values, or the calibration is old.
        """
        if (header is None) == (positions is None):
            raise ParameterError("give either header or positions")
        headers, single = _headers(header)
        frames = self._frames(None if header is None else headers)
        if header is not None or "date" in self._stated:
            self._check(frames, light)
        chain, assumed = self._chain(light, headers, frames)
        if header is not None:
            found = self.instrument.positions(FrameAngles(headers, self.instrument), chain)
            # the same reader as for tables of observations, so that tracking laws and offsets agree
            units = dict.fromkeys(COORDINATES, 1) | PLACES
            positions = {name: angle * units.get(name, u.rad) for name, angle in found.items()}
        lam, mix = match_wavelengths(self.wavelength, chain, wavelength, interpolate)
        chain = with_beam(at_wavelengths(chain, mix, len(self.wavelength)), beam)
        settings, which = distinct(positions)
        which = which[0] if single else which
        shown = {}
        for name, position in positions.items():
            if name in PLACES:
                angle = finite_position(position, name) * PLACES[name]
            else:
                angle = u.Quantity(position)
                angle = angle.to(u.deg) if angle.unit.is_equivalent(u.deg) else angle
            shown[name] = angle[0] if single else angle
        problem = self.calibration, self._covariance, chain, lam, settings, which, mix
        return SystemMueller(beam, shown, assumed, *problem)

    def correct(
        self, stokes, header=None, *, positions=None, hwp=None, difference="right-left", **options
    ):
        r"""
        Correct a Stokes cube that a pipeline has made of frames by differences.

        With X the ``difference`` of the beams, right minus left or the other way round, it holds
        the mean sum of the beams as I, and :math:`(X_0 - X_{45}) / 2` and :math:`(X_{22.5} -
        X_{67.5}) / 2` as Q and U, by the commanded angle of the half-wave plate; with a modulator,
        X of state B counts negative. Frames at other angles, or of several cycles, are taken by
        least squares. Neither Q nor U may have been rotated.

        Parameters
        ----------
        stokes : array_like
            Shape (n_components, n_wavelengths, ...): I, Q, U. A fourth, V, is taken for true.
        header : sequence of `~astropy.io.fits.Header`, mapping or path-like
            Primary headers of all frames that the cube was made of, or their files.
        positions : dict of str to `~astropy.units.Quantity`
            In their place the positions of all stages in each frame, as for `system_mueller`.
        hwp : `~astropy.units.Quantity`, optional
            Commanded angles of the half-wave plate; by default those of the headers, or the
            positions where the plate does not follow the sky.
        difference : {"right-left", "left-right"}
            Of the beams.
        **options
            ``wavelength``, ``interpolate`` and ``light``, as for `system_mueller`.

        Returns
        -------
        stokes, systematic : `~numpy.ndarray`
            Of the light that entered, in the frame of the sky, and what the errors of the
            calibration add to each (standard deviations; infinite where it is open), of the shape
            of ``stokes``. V is the one that was given.

        Raises
        ------
        ParameterError
            If the cube has another shape, the angles of the plate do not tell Q and U apart, or
            the commanded ones are not known.
        """
        # a copy, NaN where it is masked
        given = np.array(to_unit(stokes, getattr(stokes, "unit", None), "stokes"))
        headers, _ = _headers(header)
        options |= {"header": headers or None, "positions": positions}
        beams = [self.system_mueller(beam=b, **options) for b in ("right", "left")]
        if hwp is None and headers:
            hwp = FrameAngles(headers, self.instrument).position("hwp") * u.rad
        follows = self.instrument is None or any(map(any, self.instrument.sky_law.plate.values()))
        if hwp is None and options.get("light", "sky") == "sky" and follows:
            raise ParameterError(
                "hwp = None: the position of the half-wave plate is its true angle, which follows "
                "the sky; the commanded angles are needed, by which the cube was made"
            )
        if hwp is None and "hwp" not in beams[0].positions:
            raise ParameterError(
                "hwp = None: no half-wave plate, whose angles tell Q from U of a cube, is among "
                f"the stages; there are {', '.join(beams[0].positions) or 'none'}"
            )
        hwp = beams[0].positions["hwp"] if hwp is None else hwp
        size = len(beams[0].wavelength)
        if given.ndim < 2 or given.shape[0] not in (3, 4) or given.shape[1] != size:
            raise ParameterError(
                f"stokes of shape {given.shape}; needed are I, Q, U (and V) at {size} wavelengths"
            )
        hwp, count = np.atleast_1d(angle_to_rad(hwp, "hwp")), len(beams[0].value)
        if hwp.shape != (count,) or not np.isfinite(hwp).all():
            raise ParameterError(f"hwp = {one_line(hwp)}; {count} finite angles are needed")
        sums = _demodulation(hwp, beams[0].positions.get("flc_state", 0), difference)
        # b: beams, f: frames, w: wavelengths, k: measured, s and t: true Stokes parameters, r: rank
        matrix = np.einsum("kbf,bfws->wks", sums, [m.value[..., 0, :] for m in beams])
        slopes = np.einsum("kbf,bfwsr->wksr", sums, [m.factor[..., 0, :, :] for m in beams])
        unknown = [np.logical_or(*m.flags())[..., 0, :] for m in beams]
        unknown = np.einsum("kbf,bfws->wks", np.abs(sums), unknown) > 0
        inverse = np.linalg.inv(matrix[..., :3])
        flat = given.reshape(len(given), size, -1)
        rest = flat[:3]
        if len(flat) == 4:
            rest = rest - np.einsum("wk,wp->kwp", matrix[..., 3], flat[3])
        flat[:3] = np.einsum("wks,swp->kwp", inverse, rest)
        n = len(flat)
        moved = np.einsum("wjk,wksr->wjsr", inverse, slopes[..., :n, :])
        lacking = model_error(self.calibration.fit, beams[0].wavelength.to_value(u.um), n)
        moved = np.concatenate([moved, np.moveaxis(lacking[:, :, :3], 0, -1)], axis=-1)
        # small, and the same for all pixels (p), which only need the products of their light
        tensor = np.einsum("wjsr,wjtr->wjst", moved, moved)
        spread = np.sqrt(np.einsum("wjst,swp,twp->jwp", tensor, flat, flat, optimize=True))
        is_open = np.einsum("wjk,wks,swp->jwp", np.abs(inverse), unknown[..., :n], np.abs(flat)) > 0
        systematic = np.zeros_like(flat)
        systematic[:3] = np.where(is_open, np.inf, spread)
        return flat.reshape(given.shape), systematic.reshape(given.shape)

    def _check(self, frames, light):
        """Refuse frames for which the calibration does not hold."""
        options = {"max_age": self._max_age, "light": light, "ways": _WAYS}
        check_frames(self.calibration, frames, self.path.name, **options)

    def _frames(self, headers):
        """Return what to call each frame, its date and its mode; refuse other instruments."""
        if headers is None:
            mode = self._stated.get("mode", self.validity.mode)
            return [("the frame", self._stated.get("date"), mode)]
        instrument = self.instrument
        if instrument is None:
            raise InstrumentError(
                f"{self.path.name}: instrument {self.calibration.instrument!r} has no map of "
                "header keywords; give positions"
            )
        frames = []
        for i, header in enumerate(headers):
            told = describe(header, instrument.name, self._stated)
            if told.get("stated") is not None and not instrument.answers_to(told["stated"]):
                raise CalibrationFileError(
                    f"frame {i} is of {told['stated']}, but {self.path.name} holds for "
                    f"{self.validity}"
                )
            date, mode = (self._stated.get(key, told.get(key)) for key in ("date", "mode"))
            frames.append((f"frame {i}", date, mode))
        return frames

    # ---- the chain ---------------------------------------------------------------------

    def _chain(self, light, headers, frames):
        """Return the chain from where the light enters, and the optics that are assumed."""
        check_choice("light", light, ("sky", "internal"), ParameterError)
        beam = None
        if self.optics_in is None and self.instrument is not None:
            beam = told_beam(headers, self.instrument)
        inner = inner_optics(self.calibration, self.optics_in, beam, self.path.name)
        if light == "internal":
            return join(inner), ()
        if outer := telescope_optics(self.calibration, self.path.name):
            return join([*outer, *inner]), ()
        return self._published(inner, [date for _, date, _ in frames if date is not None])

    def _published(self, inner, dates):
        """Return a chain with the telescope as the instrument publishes it."""
        if self.instrument is None or not self.instrument.has_telescope:
            raise ChainError(
                f"{self.path.name} calibrates no telescope, and no published one is known; "
                "light='internal' leaves it out"
            )
        told = {"wavelength": self.wavelength, "date": dates or None}
        chain = self.instrument._from_sky(join(inner), **told)
        known = {leaf.name for leaf in inner}
        # axes of the telescope are optics, too, but there is nothing to calibrate in them
        assumed = tuple(o.name for o in leaves(chain) if o.name not in known and not o.stage)
        if assumed:
            warn(
                f"{self.path.name}: {', '.join(assumed)} not calibrated, published values are "
                "taken without errors",
                stacklevel=4,
            )
        return chain, assumed


def _demodulation(hwp, state, difference):
    """Return by what the beams of each frame are multiplied for I, Q and U, (3, 2, n)."""
    check_choice("difference", difference, ("right-left", "left-right"), ParameterError)
    theta = 4 * hwp
    sign = np.where(np.asarray(state) > 0, -1.0, 1.0) * (1 if difference == "right-left" else -1)
    ideal = np.stack([np.cos(theta), np.sin(theta)], axis=1)
    if np.linalg.matrix_rank(ideal, tol=1e-6) < 2:
        raise ParameterError("the angles of the half-wave plate do not tell Q and U apart")
    two = np.linalg.pinv(ideal) * sign
    mean = np.full(len(theta), 1 / len(theta))
    return np.stack([[mean, mean], *np.stack([two, -two], axis=1)])
