# Licensed under a 3-clause BSD style license - see LICENSE
"""What an edit of the chains is: new chains, with parameters, their laws and their limits."""

import re
from dataclasses import dataclass, field

import astropy.units as u
import numpy as np
from scipy.linalg import helmert

from astropolcal import instruments
from astropolcal.exceptions import InstrumentError
from astropolcal.gap.problem import law_basis
from astropolcal.observations.pointings import TRACKING
from astropolcal.units import canonical_factor

__all__ = [
    "KINDS",
    "Context",
    "Edit",
    "EffectParameter",
    "tracking_laws",
]

#: What an effect may be.
KINDS = ("optic", "parameter", "bound", "detector", "source", "discrete")


@dataclass(frozen=True)
class EffectParameter:
    """
    A parameter that an effect adds.

    Parameters
    ----------
    name : str
        ``"optic.parameter"``.
    scale : `~astropy.units.Quantity` or float
        Size to expect: the standard deviation of its prior.
    limit : `~astropy.units.Quantity` or float
        Largest size that is physical.
    basis : `~numpy.ndarray` or None
        Law in wavelength, shape (W, k); None for a single number.
    neutral : `~astropy.units.Quantity` or float, optional
        Value from which the size counts; by default 1 for a share that is
        retained and 0 for everything else.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal.gap.effects import EffectParameter
    >>> EffectParameter("static_retarder.circular", 1 * u.deg, 30 * u.deg, None).name
    'static_retarder.circular'
    """

    name: str
    scale: object
    limit: object
    basis: np.ndarray | None = None
    neutral: object = None

    @property
    def canonical_scale(self):
        """Size to expect in canonical units."""
        return _canonical(self.scale)

    @property
    def canonical_limit(self):
        """Largest size that is physical in canonical units."""
        return _canonical(self.limit)

    @property
    def canonical_neutral(self):
        """Value at which the effect is absent, canonical; scalar or one a wavelength."""
        if self.neutral is not None:
            value = u.Quantity(self.neutral)
            return value.value * canonical_factor(value.unit)
        # an optic that keeps all of the polarization is none
        return 1.0 if self.is_retained else 0.0

    @property
    def is_retained(self):
        """Whether it is a share of polarization that an optic retains, 1 where it does nothing."""
        return self.name.split(".")[1].startswith("retained")


def _canonical(value):
    value = u.Quantity(value)
    return float(value.value * canonical_factor(value.unit))


@dataclass(frozen=True)
class Edit:
    """
    Chains with an effect in them.

    Parameters
    ----------
    chains : list
        One a dataset.
    parameters : list of EffectParameter
        What the effect adds.
    ties : dict of str to Tie
        Parameters that follow others.

    Examples
    --------
    >>> from astropolcal.gap.effects import Edit
    >>> Edit([], []).ties
    {}
    """

    chains: list
    parameters: list
    ties: dict = field(default_factory=dict)

    @property
    def laws(self):
        """Law in wavelength of the parameters that follow one, by name."""
        return {p.name: p.basis for p in self.parameters if p.basis is not None}

    @property
    def limits(self):
        """Largest physical size of every parameter, canonical, by name."""
        return {p.name: p.canonical_limit for p in self.parameters}

    @property
    def priors(self):
        """Standard deviation of the prior of every parameter, canonical, by name."""
        # two standard deviations reach the limit: sizes are held where the data are silent only
        return {name: limit / 2 for name, limit in self.limits.items()}


@dataclass(frozen=True)
class Context:
    """
    What an effect may know of the data.

    Parameters
    ----------
    wavelength : `~numpy.ndarray`
        Common grid in micrometre, shape (W,).
    flux : float
        Median flux of a beam, in the tables' unit.
    degree : int or None
        Degree of the laws in wavelength, None for one value a wavelength, or
        "default" for that of each effect.
    tracking : tuple of (float, float)
        Law by which the half-wave plate of each dataset follows the sky, see
        `tracking_laws`.
    datasets : tuple of str
        Names of the datasets.

    Examples
    --------
    >>> import numpy as np
    >>> from astropolcal.gap.effects import Context
    >>> Context(np.array([1.2, 1.6])).basis(1).shape
    (2, 2)
    """

    wavelength: np.ndarray
    flux: float = 1.0
    degree: object = "default"
    tracking: tuple = ()
    datasets: tuple = ()

    @classmethod
    def of(cls, wavelength, observations):
        """Return what the datasets tell, on their common grid of wavelengths."""
        fluxes = [np.nanmedian(o.flux_right + o.flux_left) / 2 for o in observations]
        return cls(
            wavelength,
            float(np.median(fluxes)),
            tracking=tracking_laws(observations),
            datasets=tuple(o.name for o in observations),
        )

    def basis(self, degree, constant=True):
        """Return the law's basis; without its constant where that is known already."""
        wanted = degree if self.degree == "default" else self.degree
        found = law_basis(self.wavelength, wanted)
        if constant:
            return found
        # a constant over the wavelengths is the orientation of the optic, which is known by itself
        if wanted is None:
            # one value a wavelength, less their mean; singular vectors would be any basis of these
            return helmert(len(found)).T
        return found[:, 1:]


def tracking_laws(observations):
    """
    Return the law of the half-wave plate of every dataset, as its instrument tells it.

    Parameters
    ----------
    observations : sequence of Observations
        The datasets.

    Returns
    -------
    tuple of (float, float)
        Factors of parallactic angle and altitude; 0.5 and 1 for tables of no known instrument.

    Examples
    --------
    >>> from astropolcal.gap.effects.base import tracking_laws
    >>> from astropolcal.observations import Observations, example_table
    >>> tracking_laws([Observations.from_table(example_table())])
    ((0.5, 1.0),)
    """
    return tuple(_tracking_law(one) for one in observations)


def _tracking_law(observations):
    # a table of no known instrument: the law of a plate that follows the sky as usual
    if observations.instrument is None:
        return TRACKING
    try:
        return instruments.get(observations.instrument).plate_law(observations)
    except InstrumentError:
        return TRACKING


def label_of(name):
    """Return the name of an optic that an effect adds."""
    head, sign, run = name.partition("dataset:")
    # datasets whose names differ in a space only have optics of their own
    run = re.sub(r"\W", lambda m: "_" if m.group() == "-" else f"_{ord(m.group()):x}_", run)
    return "gap_" + re.sub(r"\W", "_", head + sign) + run
