# Licensed under a 3-clause BSD style license - see LICENSE
"""Refit what changed since a calibration, and hold the rest."""

from astropolcal.calibration._beam import instrument_of
from astropolcal.calibration.fit import calibrate
from astropolcal.calibration.validity import content_hash
from astropolcal.chain import join, leaves
from astropolcal.exceptions import ParameterError
from astropolcal.measurement import parameter_table
from astropolcal.observations import Observations

__all__ = ["restart"]


def restart(calibration, observations, free, *, chain=None, positions=None, **options):
    """
    Refit only what changed: everything else keeps the values of a calibration.

    Parameters
    ----------
    calibration : Calibration or LoadedCalibration
        The old one, which is not changed.
    observations : Observations or sequence of Observations
        The new data.
    free : sequence of str
        What may have changed, ``"optic.parameter"`` or ``"optic"`` (then what is free in the old
        calibration, or all if nothing is). Optics that the old one lacks, such as a new star,
        are free as the instrument has them.
    chain : sequence of chains, optional
        One a dataset, whose optics take the values of those of the same name; by default as the
        instrument makes them, or the first of the calibration.
    positions : sequence of dict, optional
        As for ``calibrate``; by default as the instrument reads them.
    **options
        Passed to ``calibrate``; by default the old observable, and no search of
        other mirror branches.

    Returns
    -------
    Calibration
        With the errors of what was refitted; those of what was held are not in it.
        ``settings["restarted"]`` holds the hash of the old one and what was free.

    Raises
    ------
    ParameterError
        If nothing of a name in ``free`` exists, or the wavelengths differ.
    FitError
        As ``calibrate``.

    Examples
    --------
    >>> import astropy.units as u
    >>> from astropolcal import calibrate, instruments
    >>> from astropolcal.calibration import restart
    >>> from astropolcal.simulation import half_wave_plate_cycles, simulate
    >>> charis = instruments.get("charis")
    >>> chain = charis.chain(derotator="linear")
    >>> frames = half_wave_plate_cycles(derotator=[50, 65, 80] * u.deg)
    >>> old = calibrate(chain, simulate(chain, charis.wavelength, frames, seed=2))
    >>> new = restart(old, simulate(chain, charis.wavelength, frames, seed=3), ["wollaston"])
    >>> {name.partition(".")[0] for name in new.covariance.names}
    {'wollaston'}
    """
    old = getattr(calibration, "calibration", calibration)
    datasets = [observations] if isinstance(observations, Observations) else list(observations)
    free = [free] if isinstance(free, str) else list(free)
    instrument = instrument_of(old)
    chains = _new_chains(old, datasets, instrument, chain)
    _hold(old, chains, free)
    if positions is None and instrument is not None:
        positions = [instrument.positions(*pair) for pair in zip(datasets, chains, strict=True)]
    # another mirror branch would look like a change of the instrument
    start = {"observable": old.settings["observable"], "search": False}
    options = start | {"wavelength": old.wavelength} | options
    fixed = {"ties": _ties(old, chains), "instrument": old.instrument}
    new = calibrate(chains, datasets, positions=positions, **(fixed | options))
    new.settings["restarted"] = {"from": content_hash(old), "free": free}
    return new


def _new_chains(old, datasets, instrument, chain):
    """Return a chain a dataset with copies of the old optics in the place of those it has."""
    if chain is not None:
        chains = list(chain) if isinstance(chain, (list, tuple)) else [chain]
    elif instrument is not None:
        chains = [_made(instrument, table, old.wavelength) for table in datasets]
    else:
        chains = [old.chains[0]] * len(datasets)
    if len(chains) != len(datasets):
        raise ParameterError(f"{len(chains)} chains for {len(datasets)} datasets")
    # reversed, so that of optics in several chains the first dataset's is taken
    known = {leaf.name: leaf for chain in reversed(old.chains) for leaf in leaves(chain)}
    return [join(known.get(leaf.name, leaf).copy() for leaf in leaves(c)) for c in chains]


def _made(instrument, table, wavelength):
    instrument.check(table)
    source, optics_in = instrument.setup(table)
    own = instrument.particulars(table)
    return instrument.chain(source, optics_in, wavelength=wavelength, **own)


def _hold(old, chains, free):
    """Fix all that the old calibration knows but what is to be free."""
    known = {leaf.name for chain in old.chains for leaf in leaves(chain)}
    found = {}
    for leaf in (leaf for chain in chains for leaf in leaves(chain)):
        for key in leaf.param_names:
            parameter, names = getattr(leaf, key), (leaf.name.lower(), f"{leaf.name}.{key}".lower())
            for text in (t for t in free if t.lower() in names):
                # as it was before it is held below
                found.setdefault(text, []).append((parameter, parameter.fixed))
            if leaf.name in known:
                parameter.fixed = True
    for text in free:
        if text not in found:
            names = sorted({leaf.name for chain in chains for leaf in leaves(chain)})
            raise ParameterError(f"free: no {text!r} in the chains; optics are {', '.join(names)}")
        were_free = [parameter for parameter, fixed in found[text] if not fixed]
        whole = "." in text or not were_free
        for parameter, _ in found[text]:
            parameter.fixed = not (whole or any(parameter is p for p in were_free))


def _ties(old, chains):
    """Return the ties of which the leading parameter is free."""
    table = parameter_table(chains)
    return {
        name: tie
        for name, tie in old.ties.items()
        if name in table and tie.source in table and not table[tie.source][0].fixed
    }
