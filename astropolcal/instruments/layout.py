# Licensed under a 3-clause BSD style license - see LICENSE
"""How the files of an instrument look: header keywords, detector, places of the beams."""

from dataclasses import dataclass, field

from astropolcal.exceptions import InstrumentError

__all__ = ["FileLayout"]


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
