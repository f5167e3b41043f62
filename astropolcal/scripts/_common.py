# Licensed under a 3-clause BSD style license - see LICENSE
"""What the subcommands share: outputs, datasets, edits of the chains."""

import json
import re
import sys
import textwrap
from pathlib import Path

import astropy.units as u
import numpy as np

from astropolcal.chain import find_optic, leaves, remove_optic
from astropolcal.exceptions import AstropolcalError, ParameterError
from astropolcal.files import atomic_path

_COLUMNS = 80


def check_outputs(*paths):
    """Raise before any work is done if an output's folder is missing or is a file."""
    for path in paths:
        if path is None or str(path) == "-":
            continue
        path = Path(path)
        if not path.parent.is_dir():
            raise AstropolcalError(f"{path}: there is no folder {path.parent}")
        if path.is_dir():
            raise AstropolcalError(f"{path}: is a folder, not a file")


def wrapped(line, indent=0):
    """Break a line at 80 columns, the further ones indented; words stay whole."""
    return textwrap.fill(
        line,
        _COLUMNS,
        subsequent_indent=" " * indent,
        break_long_words=False,
        break_on_hyphens=False,
    )


def write_json(content, path):
    """Write a dictionary as JSON, atomically; ``-`` is the standard output."""
    text = json.dumps(content, indent=1, allow_nan=False) + "\n"
    if str(path) == "-":
        sys.stdout.write(text)
        return
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def read_datasets(paths):
    """Read observation tables; refuse one that is given twice."""
    from astropolcal.observations import Observations

    datasets = []
    for path in paths:
        dataset = Observations.read(path)
        for other, known in zip(paths, datasets, strict=False):
            if known.content_hash == dataset.content_hash:
                raise AstropolcalError(f"{path}: holds the same frames as {other}")
        datasets.append(dataset)
    return datasets


def edit_chains(chains, *, without=(), free=(), fix=(), prior=()):
    """
    Return the chains with optics taken out and parameters freed or fixed.

    Parameters
    ----------
    chains : list
        The chains of all datasets.
    without : sequence of str
        Names of optics to take out.
    free : sequence of str
        ``optic.parameter``, or ``optic`` for all of its parameters.
    fix : sequence of str
        The same, with ``=VALUE`` to set it; a number without unit is in the
        parameter's own.
    prior : sequence of str
        ``optic.parameter=MEAN+-STD``, units as for ``fix``; frees the parameter.

    Returns
    -------
    list

    Raises
    ------
    ChainError, ParameterError
        If a name or a value does not fit.
    """
    for name in without:
        present = [name in {leaf.name for leaf in leaves(chain)} for chain in chains]
        if not any(present):
            find_optic(chains[0], name)
        chains = [
            remove_optic(chain, name) if here else chain
            for chain, here in zip(chains, present, strict=True)
        ]
    for name in free:
        for parameter in _parameters(chains, name):
            parameter.fixed = False
    for text in fix:
        name, _, value = text.partition("=")
        for parameter in _parameters(chains, name):
            if value:
                _set(name, parameter, value)
            parameter.fixed = True
    for text in prior:
        name, _, value = text.partition("=")
        for parameter in _parameters(chains, name):
            parameter.prior = _normal(name, parameter, value)
            parameter.fixed = False
    return chains


def _parameters(chains, name):
    """Return the parameters that ``optic.parameter`` or ``optic`` names, in all chains."""
    optic, _, key = name.partition(".")
    carriers = [leaf for chain in chains for leaf in leaves(chain) if leaf.name == optic]
    if not carriers:
        find_optic(chains[0], optic)
    found = []
    for leaf in carriers:
        if key and key not in leaf.param_names:
            raise ParameterError(f"{optic} has no parameter {key!r}; it has {leaf.param_names}")
        found += [getattr(leaf, each) for each in ([key] if key else leaf.param_names)]
    return found


def _normal(name, parameter, text):
    """Return the normal prior that MEAN+-STD describes, in the parameter's unit."""
    from astropolcal.measurement import Normal

    mean, separator, std = text.partition("+-")
    if not separator:
        raise ParameterError(f"prior {name}={text}: write it as MEAN+-STD, such as 0+-0.1deg")
    unit = 1 if parameter.unit is None else parameter.unit
    # "0+-0.1deg" gives its unit once
    bare = re.fullmatch(r"\s*[-+.\deE]+\s*", mean)
    own = re.sub(r"^\s*[-+.\d]+(?:[eE][-+]?\d+)?\s*", "", std)
    values = (_value(name, parameter, t) for t in ((mean + own if bare else mean), std))
    return Normal(*(value * unit for value in values))


def _value(name, parameter, text):
    """Return the number that a text with or without unit means, in the parameter's unit."""
    match = re.fullmatch(r"\s*([-+.\d]+(?:[eE][-+]?\d+)?)\s*([A-Za-z%].*)?", text)
    number, unit = match.groups() if match else ("", None)
    try:
        value = float(number)
    except ValueError:
        raise ParameterError(f"{name}={text}: not a number") from None
    if unit:
        try:
            value = (value * u.Unit(unit)).to_value(parameter.unit or u.dimensionless_unscaled)
        except (ValueError, TypeError, u.UnitConversionError):
            raise ParameterError(
                f"{name}={text}: the unit must be convertible to {parameter.unit or 'a number'}"
            ) from None
    return value


def _set(name, parameter, text):
    value = _value(name, parameter, text)
    low, high = (
        -np.inf if parameter.bounds[0] is None else parameter.bounds[0],
        np.inf if parameter.bounds[1] is None else parameter.bounds[1],
    )
    if not (np.isfinite(value) and low <= value <= high):
        raise ParameterError(
            f"{name}={text}: allowed is {low} to {high} {parameter.unit or ''}".rstrip()
        )
    parameter.value = np.full(np.shape(parameter.value), value)
