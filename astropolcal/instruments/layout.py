# Licensed under a 3-clause BSD style license - see LICENSE
"""How the files of an instrument look: header keywords, detector, places of the beams."""

from dataclasses import dataclass, field
from pathlib import Path

from astropolcal.exceptions import InstrumentError, ObservationError
from astropolcal.instruments.readout import EM_EXCESS_NOISE, ReadOut

__all__ = ["FileLayout"]

_WEIGHTS = ("inverse variance", "error")


@dataclass(frozen=True)
class FileLayout:
    """
    What a reduction must know of an instrument's FITS files.

    Positions are 0-based pixels (x, y), angles radian.

    Parameters
    ----------
    keywords : dict of str to str
        Column of the observation table to FITS keyword. Besides the columns
        of angles: ``hwp_true`` (position of the half-wave plate, tracking
        included), ``exposure_time``, ``mjd``, ``date``, ``time`` (of day, both
        UTC), ``right_ascension``, ``declination``, ``object``, ``instrument``,
        ``filter`` and ``pickoff``.
    shape : tuple of int
        Of a cube: wavelengths, rows, columns.
    cube_extension : int
        Extension that holds the cube.
    alternatives : dict of str to tuple of str
        Column to further keywords, in which it is looked up in turn.
    units : dict of str to str
        Column to the unit of its keyword; degree where none is given.
    transforms : dict of str to (float, float)
        Column to (factor, offset): value = factor * header + offset, in the
        unit of the keyword.
    raw_columns : tuple of str
        Columns looked up in the header of the raw frame where the cube lacks them.
    identities : tuple of str
        Values of the ``instrument`` keyword that belong to the instrument.
    frame_pattern : str
        Regular expression of the number that cube and raw frame share.
    prefix : str
        What stands before the number in the instrument's own names.
    original_name : str
        Keyword in which a reduced copy keeps the name of the original.
    gain : float
        Electrons per adu.
    read_noise : float
        Of a pixel of the cube, electrons.
    saturation : float
        Value of a pixel, in adu, above which it is not linear.
    internal_apertures : tuple
        ((x, y) of the left rectangle, (x, y) of the right one, width, height,
        rotation).
    star_offset : tuple of float
        (x, y) from a star's image in the left beam to that in the right one.
    pixel_scale : float
        Milliarcsecond.
    edge : float
        A star whose aperture comes closer to the edge, in pixels, is flagged.
    fwhm : float
        Of a star's image, in pixels, for finding it.
    tracking : tuple of float
        (f, g) of the law hwp_true = hwp + f * parallactic + g * altitude.
    tracking_tolerance : float
        Largest deviation from it, degree.
    hwp_step : float
        The commanded angles are multiples of it, degree.
    site : tuple of float
        Longitude and latitude in degree, height in metre.
    beam_files : tuple of str
        Marks in the names of the files of the right and of the left beam, where each camera
        writes files of its own. The shape, and all places, are then those of both images side by
        side, the left one first.
    weights : {"inverse variance", "error"}
        What the extension behind the cube holds.
    states : dict of str to str
        Value of the ``flc_state`` keyword to state of the modulator, "A" or "B"; "" for none.
    read_outs : dict of str to ReadOut
        Ways to read the detector out, by the value of the ``read_mode`` keyword, or that value
        and the number of the ``camera``, such as "slow 1"; ``em`` and ``conventional`` are the
        registers of an EMCCD, which has a keyword ``em_gain``. See `read_out`.
    optics : dict of str to (str, dict of str to str)
        What headers say of optics in the beam: key of the table's meta to (column,
        {regular expression: word}). The first expression found in the column's text
        gives the word.

    Raises
    ------
    InstrumentError
        If a number that must be positive is not, or the shape is not that of a cube.

    Examples
    --------
    >>> from astropolcal import instruments
    >>> layout = instruments.get("charis").files
    >>> layout.keywords["hwp"], layout.shape
    ('RET-ANG1', (22, 201, 201))
    """

    keywords: dict
    shape: tuple
    cube_extension: int = 1
    alternatives: dict = field(default_factory=dict)
    units: dict = field(default_factory=dict)
    transforms: dict = field(default_factory=dict)
    raw_columns: tuple = ()
    identities: tuple = ()
    frame_pattern: str = r"(?<!\d)\d{8}(?!\d)"
    prefix: str = ""
    original_name: str = "ORIGNAME"
    gain: float = 1.0
    read_noise: float = 0.0
    saturation: float = float("inf")
    internal_apertures: tuple = ()
    star_offset: tuple = (0.0, 0.0)
    pixel_scale: float = 1.0
    edge: float = 1.0
    fwhm: float = 4.0
    tracking: tuple = (0.5, 1.0)
    tracking_tolerance: float = 1.0
    hwp_step: float = 11.25
    site: tuple = ()
    beam_files: tuple = ()
    weights: str = _WEIGHTS[0]
    states: dict = field(default_factory=dict)
    read_outs: dict = field(default_factory=dict)
    optics: dict = field(default_factory=dict)

    def __post_init__(self):
        for name in ("gain", "saturation", "pixel_scale", "fwhm", "hwp_step"):
            if not getattr(self, name) > 0:
                raise InstrumentError(f"{name} = {getattr(self, name)}; it must be above zero")
        for name in ("read_noise", "edge", "tracking_tolerance"):
            if not getattr(self, name) >= 0:
                raise InstrumentError(f"{name} = {getattr(self, name)}; allowed are 0 and above")
        if len(self.shape) != 3 or min(self.shape) < 1:
            raise InstrumentError(
                f"shape = {self.shape}; three positive numbers are needed (wavelength, y, x)"
            )
        if self.weights not in _WEIGHTS:
            raise InstrumentError(
                f"weights = {self.weights!r}; allowed are {', '.join(map(repr, _WEIGHTS))}"
            )
        if len(self.beam_files) not in (0, 2):
            raise InstrumentError(
                f"beam_files = {self.beam_files}; the marks of the right and left beam are needed"
            )

    @property
    def file_shape(self):
        """Shape of the cube in a file, which may be that of one beam only."""
        # with a file for each camera the shape is that of both images side by side
        slices, rows, columns = self.shape
        return (slices, rows, columns // 2) if self.beam_files else tuple(self.shape)

    def read_out(self, values):
        """
        Return how the detector was read out in a frame.

        Parameters
        ----------
        values : dict
            Of its header: ``em_gain``, ``read_mode`` and ``camera``, as far as they are known.

        Returns
        -------
        ReadOut
            With an EM gain above one, gain and read noise are those before the multiplication.

        Raises
        ------
        ObservationError
            If the mode is none of ``read_outs``, or the EM gain is impossible.

        Examples
        --------
        >>> from astropolcal.instruments.layout import FileLayout
        >>> emccd = FileLayout({"em_gain": "EMGAIN"}, (1, 512, 512), gain=4.5, read_noise=90.0)
        >>> emccd.read_out({"em_gain": 300.0})
        ReadOut(gain=0.015, read_noise=0.3, saturation=inf, excess_noise=1.4142135623730951)
        """
        own = ReadOut(self.gain, self.read_noise, self.saturation)
        em_gain, mode = values.get("em_gain"), values.get("read_mode")
        if em_gain is not None:
            if not (em_gain == 0 or em_gain >= 1):
                raise ObservationError(
                    f"{self.keywords['em_gain']} = {em_gain:g}; allowed are 0 (no multiplication) "
                    "and 1 and above"
                )
            # 0 and 1 both mean the conventional register, which has a noise of its own
            if em_gain <= 1:
                return self.read_outs.get("conventional", own)
            multiplied = ReadOut(self.gain, self.read_noise, self.saturation, EM_EXCESS_NOISE)
            return self.read_outs.get("em", multiplied).multiplied(em_gain)
        if mode is None or not self.read_outs:
            return own
        mode, camera = str(mode).strip().lower(), values.get("camera")
        # two cameras of one kind need not have the same noise
        names = [mode] if camera is None else [f"{mode} {camera:g}", mode]
        found = next((name for name in names if name in self.read_outs), None)
        if found is None:
            raise ObservationError(
                f"{self.keywords['read_mode']} = {mode!r}; allowed are {', '.join(self.read_outs)}"
            )
        return self.read_outs[found]

    def left_file(self, path):
        """
        Return the file of the left beam that belongs to one of the right beam.

        Parameters
        ----------
        path : path-like
            The file of the right beam.

        Returns
        -------
        `~pathlib.Path` or None
            In the same folder; None where one file holds both beams.

        Raises
        ------
        ObservationError
            If the name does not have the mark of the right beam.

        Examples
        --------
        >>> from astropolcal.instruments.layout import FileLayout
        >>> layout = FileLayout({}, (1, 64, 128), beam_files=("cam1", "cam2"))
        >>> layout.left_file("night_00000007_cam1.fits").name
        'night_00000007_cam2.fits'
        """
        if not self.beam_files:
            return None
        path, (right, left) = Path(path), self.beam_files
        # the last one: a folder or target may have the mark in its name too
        head, found, tail = path.name.rpartition(right)
        if not found:
            raise ObservationError(
                f"{path}: a frame needs the file of the right beam, with {right!r} in its name"
            )
        return path.with_name(f"{head}{left}{tail}")

    def frame_files(self, files):
        """
        Return one file a frame, without those of left beams that belong to another file.

        Parameters
        ----------
        files : sequence of path-like
            The files, in any order.

        Returns
        -------
        list of str

        Examples
        --------
        >>> from astropolcal.instruments.layout import FileLayout
        >>> layout = FileLayout({}, (1, 64, 128), beam_files=("cam1", "cam2"))
        >>> layout.frame_files(["a_cam1.fits", "a_cam2.fits", "b_cam2.fits"])
        ['a_cam1.fits', 'b_cam2.fits']
        """
        files = [str(path) for path in files]
        if not self.beam_files:
            return files
        # left files without a right one stay, so that the error names them
        rights = [path for path in files if self.beam_files[0] in Path(path).name]
        lefts = {str(self.left_file(path)) for path in rights}
        return [path for path in files if str(Path(path)) not in lefts]
