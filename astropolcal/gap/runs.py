# Licensed under a 3-clause BSD style license - see LICENSE
"""
What changed between several runs of the same kind of source.

A cause in one of the runs only is a change; what all have is none, and is asked for in each run by
itself.
"""

import copy
from itertools import combinations

import numpy as np

from astropolcal.chain import leaves
from astropolcal.exceptions import GapError
from astropolcal.gap._words import ONE, decimals, others
from astropolcal.gap.cells import Cell, count_runs
from astropolcal.optics.perturbations import split_run
from astropolcal.words import listed

__all__ = []

# so many changes are told in the summary
_MOST = 4
_LIKELY = 0.5


def distinct(observations, changes=False):
    """Return the datasets, those whose name is taken as copies with another name."""
    observations = list(observations)
    for one, other in combinations(observations, 2):
        if one is other or (
            one.n_frames == other.n_frames and one.content_hash == other.content_hash
        ):
            names = dict.fromkeys((one.name, other.name))
            raise GapError(f"the same data are given twice: {' and '.join(names)}")
    sources = [o.source for o in observations]
    if changes and len(set(sources)) == len(sources):
        raise GapError(
            "what changed can be determined between runs of the same kind of source only; given: "
            + ", ".join(f"{o.name} ({o.source or 'no source stated'})" for o in observations)
        )
    names, found = set(), []
    for one in observations:
        count, name = 1, one.name
        while name in names:
            count += 1
            name = f"{one.name} ({count})"
        names.add(name)
        if name != one.name:
            one = copy.copy(one)
            one.name = name
        found.append(one)
    return found


# ---- what changed ------------------------------------------------------------------------------


def changes(diagnosis, causes):
    """Return the causes that are in one of several runs only, a list of dict.

    Keys are ``cell``, ``dataset``, ``size`` (parameter to values, errors, unit and limit),
    ``probability``, ``brought_by`` (optics that only this run has, upstream of the place) and
    ``words``; the most probable first, and among these the most significant. A mistake of a table
    has no cell.
    """
    if not causes or count_runs(diagnosis.improved.problem) < 2:
        return []
    names = [o.name for o in diagnosis.improved.observations]
    chains = [leaves(chain) for chain in diagnosis.improved.chains]
    wavelength = 1e3 * diagnosis.improved.problem.wavelength
    found = []
    for cause in causes:
        cell = cause["cell"] and Cell(**cause["cell"])
        run = _run_of(cell, names, chains) if cell else split_run(cause["name"])[1]
        if run is not None:
            brought = _brought(cell, run, names, chains) if cell else []
            same = {key: cause[key] for key in ("cell", "size", "probability", "significance")}
            entry = same | {"dataset": run, "brought_by": brought}
            beside = [a for a in cause["aliases"] if cell and a["cell"] and len(names) == 2]
            # of two runs, the opposite of the other one is the same change
            twins = (a for a in beside if _in_any_run(Cell(**a["cell"])) == _in_any_run(cell))
            told = cause["share"] + sum(a["probability"] for a in twins) >= ONE
            # of what is hardly probable itself, what looks the same is of no interest
            is_asked = cause["probability"] >= _LIKELY and not told
            like = others(cause, {})[:1] if is_asked else []
            of = "" if told else " of this or what looks the same"
            of += "".join(f", such as {words}" for words in like)
            # what has a name of its own in each run
            is_named = str(cause.get("effect")).endswith(f"/dataset:{run}")
            named = cause["title"].removesuffix(f' in "{run}"') if is_named else ""
            if cell:
                entry["words"] = _sentence(cell, entry, names, wavelength, of, named)
            else:
                entry["words"] = f"What changed: {cause['title']} ({_chance(entry, of)})."
            found.append(entry)
    return sorted(found, key=lambda e: (-round(e["probability"], 2), -(e["significance"] or 0)))


def _run_of(cell, names, chains):
    """Return the name of the one dataset that has a cell, None where several have it."""
    if cell.run is not None or cell.optic is None:
        return cell.run
    there = [n for n, c in zip(names, chains, strict=True) if cell.optic in [o.name for o in c]]
    return there[0] if len(there) == 1 else None


def _in_any_run(cell):
    return Cell(cell.place, cell.kind, split_run(cell.dependence)[0])


def _brought(cell, run, names, chains):
    """Return the optics that only a run has, at or upstream of the place of a cell."""
    mine = [
        optic.name
        for optic in chains[names.index(run)]
        if not (optic.name or "").startswith("gap_")
    ]
    others = {o.name for n, c in zip(names, chains, strict=True) if n != run for o in c}
    head, _, optic = cell.place.partition(":")
    if head == "detector":
        end = len(mine)
    elif optic in mine:
        # what stands right in front of an optic is told from that by nothing
        end = mine.index(optic) + 1 + (head == "after")
    else:
        return []
    return [name for name in mine[:end] if name not in others]


# ---- in words ----------------------------------------------------------------------------------


def paragraph(content, names, asked=False):
    """Return what is to be said of the changes between runs, in a few sentences."""
    found = content["changes"]
    if not found:
        quoted = listed([f'"{name}"' for name in names])
        words = f"Nothing changed between {quoted} that the data can tell."
        if content["verdict"] == "unexplained":
            words = f"What changed between {quoted} is not known before the gap is explained."
        return [words] * asked
    words = [one["words"] for one in found[:_MOST]]
    if len(found) > _MOST:
        words.append(f"{len(found) - _MOST} smaller changes are listed below.")
    if min(one["probability"] for one in found) < _LIKELY:
        words.append(
            "These changes help to describe the runs, but what is left says that they need not be "
            "the true ones."
        )
    brought = [one for one in found if one["brought_by"]]
    if brought:
        optics = dict.fromkeys(name for one in brought for name in one["brought_by"])
        many = f"{len(brought)} of the changes are" if len(brought) > 1 else "One change is"
        words.append(
            f"{many} at or downstream of what only one run has ({listed(list(optics))}): "
            "that may have brought them."
        )
    return words


def _chance(entry, of):
    return f"probability {100 * entry['probability']:.0f} %{of}"


def _sentence(cell, entry, names, wavelength, of, named):
    """Return one change in words."""
    plain = _in_any_run(cell)
    constant = plain.dependence in ("dataset", "constant")
    title = Cell(cell.place, cell.kind, "constant").title if constant else plain.title
    title = named or title
    # the size of a gain is half the difference of the beams
    size = _size(entry["size"], wavelength, 2.0 if cell.kind == "gain" else 1.0)
    chance = _chance(entry, of)
    run = entry["dataset"]
    if named and len(entry["size"]) > 1:
        # an optic of any axis: none of its components is the change
        told = f"clearest component {_number(*size[:2])} {size[2]}, " if size else ""
        return f'In "{run}" only there is a {named} ({told}{chance}).'
    if constant and len(names) == 2 and size:
        # of the second against the first, whichever of the two has it
        sign = 1 if run == names[1] else -1
        value, error, of = size
        return (
            f'Between "{names[0]}" and "{names[1]}" the {title} changed by '
            f"{_number(sign * value, error)} {of} ({chance})."
        )
    told = f", by {_number(*size[:2])} {size[2]}" if size else ""
    if constant:
        return f'In "{run}" the {title} differs from that of the other runs{told} ({chance}).'
    return f'In "{run}" only there is {title}{told} ({chance}).'


def _number(value, error):
    digits = min(decimals(error), 6)
    return f"{value:.{digits}f} +- {error:.{digits}f}"


def _size(parameters, wavelength, times):
    """Return value, error, and unit with where, of the clearest size; nothing if all are open."""
    found = [(-1.0,)]
    for one in parameters.values():
        # what has no unit is a share
        factor, unit = (times, one["unit"]) if one["unit"] else (100.0 * times, "%")
        values = np.array(np.ravel(one["value"]), dtype=float)
        errors = np.array(np.ravel(one["std"]), dtype=float)
        clear = np.divide(np.abs(values), errors, out=np.full(errors.shape, -1.0), where=errors > 0)
        one_of = values.size == len(wavelength) > 1 and np.ptp(values) > 0
        # of one value for all wavelengths the error is the largest of theirs
        i = int(np.argmax(clear) if one_of else np.argmin(clear))
        where = f" at {wavelength[i]:.0f} nm" if one_of else ""
        found.append((clear[i], factor * values[i], factor * errors[i], f"{unit}{where}"))
    best = max(found, key=lambda size: size[0])
    return best[1:] if best[0] >= 0 else ()
