# Licensed under a 3-clause BSD style license - see LICENSE
"""
Subaru/SCExAO/REACH, spectrograph IRD at high resolution, fed by single-mode fibres.

Half-wave plate and derotator are those of CHARIS. The public pipeline pyird,
https://github.com/prvjapan/pyird, has the spectra of its single-mode fibres in Y, J and H.

Nothing was found in public about its polarimetry. Assumed here: two fibres with the two
polarizations of a beam splitter downstream of the derotator, of efficiency 0.985. What fibres and
bench do to polarized light is not known and left out, and what the Nasmyth beam switcher changed.
The retardance of the derotator in Y starts at its published value at 1.16 um.
"""

import astropy.units as u

from astropolcal.instruments.polarimeter import SubaruPolarimeter

__all__ = []


class REACH(SubaruPolarimeter):
    """
    Subaru/SCExAO/REACH; its wavelengths here are one for each band.

    Unequal throughputs of the two fibres are the nuisance ``"beam_gain"``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> spectrum = [1.30, 1.31, 1.32, 1.33] * u.um
    >>> instruments.get("reach").chain(wavelength=spectrum)["derotator"].horizontal.size
    4
    """

    name = "reach"
    aliases = ("SCExAO/REACH", "Subaru/SCExAO/REACH")
    wavelength = [1.05, 1.25, 1.60] * u.um
    references = (
        "pyird, https://github.com/prvjapan/pyird",
        "'t Hart et al. 2021, Proc. SPIE 11833, arXiv:2108.04833, for plate and derotator",
    )
