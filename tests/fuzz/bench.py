# Licensed under a 3-clause BSD style license - see LICENSE
"""What the entry point of an instrument may lead to."""

from astropolcal import optics
from astropolcal.instruments.base import Instrument


class Bench(Instrument):
    """A good one."""

    name = "bench"
    aliases = ()

    def chain(self, source="polarized", optics_in=(), *, wavelength=None, **options):
        """Return a chain."""
        return optics.LinearPolarizer(name="polarizer") | optics.WollastonPrism(name="wollaston")

    def setup(self, observations):
        """Return what is in the beam."""
        return "polarized", ()


class Unnamed(Bench):
    """One without a name."""

    name = ""


class Broken(Bench):
    """One that cannot be made."""

    name = "broken"

    def __init__(self):
        raise ValueError("cannot be made")


class Raising(Bench):
    """One that cannot say its name."""

    name = "raising"

    def answers_to(self, name):
        """Fail."""
        raise KeyError(name)


UNFIT = 3
