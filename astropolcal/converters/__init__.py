# Licensed under a 3-clause BSD style license - see LICENSE
"""
Converters between astropolcal's objects and the nodes of an ASDF tree.

Their modules import ASDF but none of the physics before a node of theirs is
read or written.
"""

__all__ = ["get_converters"]


def get_converters():
    """
    Return one converter an optic, and that of calibrations.

    Returns
    -------
    list of `~asdf.extension.Converter`

    Examples
    --------
    >>> from astropolcal.converters import get_converters
    >>> [converter.tags[0].split("/")[-1] for converter in get_converters()][:2]
    ['calibration-1.0.0', 'beam_gain-1.0.0']
    """
    from astropolcal.converters.calibration import CalibrationConverter
    from astropolcal.converters.optics import OPTIC_MODULES, OpticConverter

    return [CalibrationConverter(), *(OpticConverter(name) for name in OPTIC_MODULES)]
