# Licensed under a 3-clause BSD style license - see LICENSE
"""The functions that ASDF finds by the entry points of this package."""

from astropolcal.converters.extension import get_extensions, get_resource_mappings

__all__ = ["get_extensions", "get_resource_mappings"]
