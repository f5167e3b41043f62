# Licensed under a 3-clause BSD style license - see LICENSE
"""
Version of the package, as setuptools-scm wrote it at build time.

A source tree that was never built has no such file; the version is then that
of the installed distribution, or ``"0.0.0+unknown"`` if there is none.
"""

__all__ = []

try:
    from astropolcal._version import version
except ImportError:
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as _installed_version

    try:
        version = _installed_version("astropolcal")
    except PackageNotFoundError:
        version = "0.0.0+unknown"
