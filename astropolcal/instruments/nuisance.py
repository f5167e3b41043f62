# Licensed under a 3-clause BSD style license - see LICENSE
"""
What differs from dataset to dataset and is of no interest in itself.

Background in the apertures, unequal gains of the beams and the polarization of a lamp that is
called unpolarized are optics of one dataset, with its name, and with a prior that keeps them
small where the data cannot tell them from what the datasets share.
"""

import re

import numpy as np

from astropolcal import optics
from astropolcal.chain import join, leaves
from astropolcal.exceptions import InstrumentError
from astropolcal.observations.reading import common_wavelengths

__all__ = ["NUISANCES", "add_nuisance", "without_nuisance"]

#: What may be added, and the standard deviation of its prior, a normal around zero.
NUISANCES = {"background": 0.01, "beam_gain": 0.02, "lamp": 0.002}


def add_nuisance(chains, datasets, nuisance):
    """
    Return the chains with nuisance optics, one of each kind for each dataset.

    ``"background"``, light that is added at a constant flux: the share of it in a frame of median
    flux, one value a wavelength. ``"beam_gain"``, half the relative difference of the gains
    of the two beams, one value a wavelength; normalized double differences see it in second
    order only, single differences in first. ``"lamp"``, q and u of an internal source without
    polarizer, for all wavelengths; q cannot be told from the diattenuation of a mirror that
    stands straight, except by the prior.

    Parameters
    ----------
    chains : sequence of `~astropy.modeling.CompoundModel`
        The chain of each dataset.
    datasets : sequence of Observations
        The datasets.
    nuisance : sequence of str
        Kinds, or ``"KIND:DATASET"`` for one dataset only.

    Returns
    -------
    list of `~astropy.modeling.CompoundModel`

    Raises
    ------
    InstrumentError
        If a kind or dataset is unknown, or ``"lamp"`` is asked for where there is no such source.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import instruments
    >>> from astropolcal.instruments import add_nuisance
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> frames = half_wave_plate_cycles(derotator=[45, 80] * u.deg)
    >>> lamp = simulate(charis.chain(), charis.wavelength, frames, name="night 1")
    >>> chain, = add_nuisance([charis.chain()], [lamp], ["background"])
    >>> [optic.name for optic in chain][-2:]
    ['background_night_1', 'wollaston']
    """
    chains, names = list(chains), [observations.name for observations in datasets]
    # names of optics must do as optic.parameter
    labels = [re.sub(r"\W+", "_", name) for name in names]
    # two tables may have one name
    labels = [f"{t}_{i + 1}" if labels.count(t) > 1 else t for i, t in enumerate(labels)]
    size = len(common_wavelengths(datasets))
    for text in nuisance:
        kind, _, wanted = str(text).partition(":")
        _check(kind, wanted, names)
        chosen = [i for i, name in enumerate(names) if wanted in ("", name)]
        if kind == "lamp":
            chosen = _lamps(chains, chosen, text)
        for i in chosen:
            chains[i] = _added(chains[i], datasets[i], kind, f"{kind}_{labels[i]}", size)
    return chains


def without_nuisance(chain):
    """
    Return a chain without the nuisance optics of its dataset.

    Parameters
    ----------
    chain : `~astropy.modeling.CompoundModel`
        The chain.

    Returns
    -------
    `~astropy.modeling.CompoundModel`

    Examples
    --------
    >>> from astropolcal import instruments, optics
    >>> from astropolcal.instruments import without_nuisance
    >>> chain = instruments.get("charis").chain() | optics.BeamGain(name="beam_gain_night")
    >>> without_nuisance(chain).submodel_names[-1]
    'wollaston'
    """
    prefixes = tuple(f"{kind}_" for kind in NUISANCES)
    found = leaves(chain)
    kept = [leaf for leaf in found if not str(leaf.name).startswith(prefixes)]
    return chain if len(kept) == len(found) else join(kept)


def _check(kind, wanted, names):
    if kind not in NUISANCES:
        raise InstrumentError(f"nuisance {kind!r}; allowed are {', '.join(NUISANCES)}")
    if wanted and wanted not in names:
        raise InstrumentError(f"nuisance {kind}: no dataset {wanted!r}; there are {names}")


def _lamps(chains, chosen, text):
    """Return the chains of internal sources without polarizer."""
    polarized = (optics.LinearPolarizer, optics.PolarizedSource)
    lamps = [i for i in chosen if not isinstance(leaves(chains[i])[0], polarized)]
    if not lamps:
        raise InstrumentError(f"nuisance {text}: no dataset is of an unpolarized internal source")
    return lamps


def _added(chain, observations, kind, name, size):
    found, prior, zero = leaves(chain), _normal(NUISANCES[kind]), np.zeros(size)
    split = next(i for i, leaf in enumerate(found) if leaf.splits_light)
    if kind == "lamp":
        source = optics.PolarizedSource(name=name)
        source.q.prior = source.u.prior = prior
        return join([source, *found])
    if kind == "beam_gain":
        # behind the splitter, where there are two beams
        gain = optics.BeamGain(imbalance=zero, name=name)
        gain.imbalance.prior = prior
        return join([*found[: split + 1], gain, *found[split + 1 :]])
    # the sum of both beams is 0 where it is masked
    flux = observations.position("total_flux")
    # in front of the splitter: background falls on both beams alike
    light = optics.StrayLight(
        amount=zero, reference=float(np.median(flux[flux > 0])), mount="total_flux", name=name
    )
    light.amount.prior = prior
    return join([*found[:split], light, *found[split:]])


def _normal(std):
    from scipy.stats import norm

    return norm(0.0, std)
