# Licensed under a 3-clause BSD style license - see LICENSE
"""What the rules ask of single values: bounds, keywords, and parameters after a file."""

import io

import astropy.units as u
import numpy as np

from astropolcal.chain import leaves

# standard deviation by which the true values of free parameters are moved: in radian or 1,
# and of other dimensions the share of them
_MOVED, _MOVED_SHARE = 0.005, 0.0005


class Broken(Exception):
    """A rule does not hold."""


class Absent(Exception):
    """A rule has nothing to be applied to."""


def require(condition, words):
    if not condition:
        raise Broken(words)


def optic_names(chain):
    return [leaf.name for leaf in leaves(chain)]


def check_values(label, chain, size):
    for leaf in leaves(chain):
        for key in leaf.param_names:
            parameter, name = getattr(leaf, key), f"{label}: {leaf.name}.{key}"
            value = np.asarray(parameter.value)
            low, high = (
                np.inf * sign if bound is None else bound
                for bound, sign in zip(parameter.bounds, (-1, 1), strict=True)
            )
            good = np.isfinite(value) & (value >= low) & (value <= high)
            require(
                good.all(), f"{name} = {value[~good]} is outside of its bounds, {low} to {high}"
            )
            require(
                value.size in (1, size), f"{name} has {value.size} values; allowed are 1 or {size}"
            )


def check_keyword(column, keyword):
    require(isinstance(keyword, str) and keyword.strip(), f"{column}: keyword {keyword!r}")
    plain = keyword.replace("-", "").replace("_", "")
    short = len(keyword) <= 8 and plain.isalnum()
    # a keyword of several words is a hierarchical one
    words = keyword.split(" ")
    long = len(words) > 1 and all(w.replace("-", "").replace("_", "").isalnum() for w in words)
    require(
        keyword == keyword.upper() and (short or long), f"{column}: {keyword!r} is no FITS keyword"
    )


def check_same(source, optic, old, new):
    name = f"{source}: {optic.name}.{old.name} after a file"
    require(np.array_equal(old.value, new.value), f"{name} is {new.value}, not {old.value}")
    for what in ("unit", "bounds", "fixed"):
        before, after = getattr(old, what), getattr(new, what)
        require(before == after, f"{name}: {what} {after}, not {before}")
    require((old.prior is None) == (new.prior is None), f"{name}: its prior is {new.prior}")


def read_back(chain):
    import asdf

    from astropolcal.converters.nodes import node_from_priors, restore_priors, without_priors

    buffer = io.BytesIO()
    # a calibration file has priors beside the chains
    content = {"chain": without_priors(chain), "priors": node_from_priors([chain])}
    asdf.AsdfFile(content).write_to(buffer)
    buffer.seek(0)
    with asdf.config_context() as config:
        config.warn_on_failed_conversion = False
        with asdf.open(buffer, lazy_load=False, memmap=False) as file:
            read = file["chain"]
            restore_priors([read], file["priors"])
    return read


def moved_value(parameter, rng):
    low, high = (
        np.inf * sign if bound is None else bound
        for bound, sign in zip(parameter.bounds, (-1, 1), strict=True)
    )
    value = np.asarray(parameter.value, dtype=float)
    angle = parameter.unit is not None and parameter.unit.is_equivalent(u.rad)
    step = rng.normal(size=value.shape)
    if angle:
        step = (_MOVED * step * u.rad).to_value(parameter.unit)
    else:
        step = step * (_MOVED if parameter.unit is None else _MOVED_SHARE * np.abs(value))
    # at a bound the other way, so that every free parameter moves
    moved = np.where((value + step < low) | (value + step > high), value - step, value + step)
    moved = np.clip(moved, low, high)
    return moved if parameter.unit is None else moved * parameter.unit
