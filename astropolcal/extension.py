# Licensed under a 3-clause BSD style license - see LICENSE
"""
What ASDF asks astropolcal for: schemas, tags and converters.

ASDF finds the two functions through the entry points ``asdf.extensions`` and
``asdf.resource_mappings``. They are called whenever any ASDF file is opened,
so nothing of the physics is imported here.
"""

__all__ = ["MANIFEST_URI", "get_extensions", "get_resource_mappings"]

# of schemas, which are named by URI; tags begin with tag:astropolcal.org instead
_BASE = "asdf://astropolcal.org/astropolcal"
#: The list of all tags and the schemas they obey.
MANIFEST_URI = f"{_BASE}/manifests/astropolcal-1.0.0"


def get_resource_mappings():
    """
    Return the schemas and the manifest, by their URI.

    Returns
    -------
    list of `~asdf.resource.DirectoryResourceMapping`

    Examples
    --------
    >>> from astropolcal.extension import MANIFEST_URI, get_resource_mappings
    >>> any(MANIFEST_URI in mapping for mapping in get_resource_mappings())
    True
    """
    from importlib.resources import files

    from asdf.resource import DirectoryResourceMapping

    # wherever the package is, in a zip file too
    resources = files("astropolcal") / "resources"
    return [
        DirectoryResourceMapping(resources / kind, f"{_BASE}/{kind}/", recursive=True)
        for kind in ("schemas", "manifests")
    ]


def get_extensions():
    """
    Return the extension that converts optics and calibrations.

    Returns
    -------
    list of `~asdf.extension.ManifestExtension`

    Examples
    --------
    >>> from astropolcal.extension import get_extensions
    >>> len(get_extensions()[0].tags)
    30
    """
    from asdf.extension import ManifestExtension

    from astropolcal.converters import get_converters

    return [ManifestExtension.from_uri(MANIFEST_URI, converters=get_converters())]
