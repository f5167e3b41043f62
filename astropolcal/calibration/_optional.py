# Licensed under a 3-clause BSD style license - see LICENSE
"""Packages of the extra ``mcmc``, imported when they are needed."""

from importlib import import_module

from astropolcal.exceptions import AstropolcalError


def need(module, what):
    """
    Return an optional module, or say how to install it.

    Parameters
    ----------
    module : str
        Name of the module.
    what : str
        What needs it, for the message.

    Raises
    ------
    AstropolcalError
        If it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        # as pip knows it: arviz_stats.base is in arviz-stats
        package = module.split(".")[0].replace("_", "-")
        raise AstropolcalError(
            f"{what} needs the package {package}, which is not installed: "
            'pip install "astropolcal[mcmc]", or in a clone pip install ".[mcmc]"'
        ) from error
