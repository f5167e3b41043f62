# Licensed under a 3-clause BSD style license - see LICENSE
"""
The form of an optic's Mueller matrix, read off its numbers.

The matrix is evaluated at random parameters; an element that agrees with a constant or with a
simple function of the parameters everywhere is written as that, any other gets a letter.
"""

import string

import astropy.units as u
import numpy as np

from astropolcal.optics import COORDINATES, FrameOptic
from astropolcal.units import canonical_factor

_DRAWS = 9
_WIDEST = {"deg": 170.0, "nm": 300.0, "mm": 2.0}
_CONSTANTS = {"0": 0.0, "1": 1.0, "-1": -1.0, r"\tfrac12": 0.5, r"-\tfrac12": -0.5}


def _drawn(optic, rng):
    """Return random values of the parameters but theta, in the unit of each."""
    found = {}
    for key in (*optic.own_names, *(["theta"] if optic.rotates_frame else [])):
        parameter = getattr(optic, key)
        unit = "" if parameter.unit is None else str(parameter.unit)
        widest = _WIDEST.get(unit, 1.0)
        low, high = parameter.bounds
        low = -widest if low is None else max(low, -widest)
        high = widest if high is None else min(high, widest)
        found[key] = rng.uniform(low, high) * (parameter.unit or 1)
    return found


def _evaluated(optic):
    """Return matrices (n, 4, 4) and canonical values by symbol at random parameters."""
    rng = np.random.default_rng(4)
    moves = isinstance(optic, FrameOptic) and optic.mount
    matrices, values = [], {}
    for _ in range(_DRAWS):
        drawn = _drawn(optic, rng)
        one = optic.with_parameters(**{"theta": 0 * u.deg, **drawn})
        x = rng.uniform(0.2, 0.8) * 1.5 * getattr(optic, "reference", 1.0)
        # the matrix of a state is that in the frames that have it
        in_state = moves and "=" in optic.stage
        x = 1.0 if in_state else x
        angle = optic.stage not in COORDINATES and not hasattr(optic, "reference")
        position = (x * u.rad if angle else x) if moves else None
        matrices.append(np.asarray(one.mueller(1.6 * u.um, position)).reshape(-1, 4, 4)[0])
        for key, value in drawn.items():
            number = getattr(value, "value", value) * canonical_factor(getattr(optic, key).unit)
            values.setdefault(_symbol(key), []).append(number)
        if moves and not in_state:
            values.setdefault("x", []).append(x / getattr(optic, "reference", 1.0))
    return np.array(matrices), {key: np.array(numbers) for key, numbers in values.items()}


def _symbol(key):
    if key == "theta":
        return r"\theta"
    return rf"\mathrm{{{key}}}".replace("_", r"\_")


def _simple(values):
    """Yield LaTeX and numbers of simple functions of each value."""
    for name, p in values.items():
        yield name, p
        yield rf"\cos({name})", np.cos(p)
        yield rf"\sin({name})", np.sin(p)
        yield rf"\cos(2\,{name})", np.cos(2 * p)
        yield rf"\sin(2\,{name})", np.sin(2 * p)
        yield rf"1 + {name}", 1 + p
        yield rf"1 - {name}", 1 - p
        yield rf"\tfrac12\,{name}", p / 2
        yield rf"{name}^2", p**2
        if np.all(np.abs(p) <= 1):
            yield rf"\sqrt{{1 - {name}^2}}", np.sqrt(1 - p**2)


def _functions(values):
    """Yield LaTeX and numbers of simple functions, and of products of two of them."""
    simple = list(_simple(values))
    yield from simple
    for i, (left, a) in enumerate(simple):
        for right, b in simple[i + 1 :]:
            if "+" not in left + right and "1 -" not in left.replace(r"\sqrt{1 -", ""):
                yield rf"{left}\,{right}", a * b
                yield rf"1 + {left}\,{right}", 1 + a * b
                yield rf"1 - {left}\,{right}", 1 - a * b


def _find(numbers, table):
    known = np.array([values for _, values in table]).reshape(len(table), -1)
    near = 1e-11 + 1e-9 * np.abs(known)
    same, opposite = (np.all(np.abs(numbers - s * known) <= near, axis=1) for s in (1, -1))
    for row in np.flatnonzero(same | opposite)[:1]:
        latex = table[row][0]
        if same[row]:
            return latex
        return f"-{latex}" if not latex.startswith("1 ") else f"-({latex})"
    return None


def form_of(optic):
    """
    Return the Mueller matrix of an optic, in its own frame, as LaTeX.

    Parameters
    ----------
    optic : Optic
        An example: its settings are kept, its parameters are not.

    Returns
    -------
    latex : str
        A matrix.
    words : str
        What the letters stand for, if there are any.
    """
    matrices, values = _evaluated(optic)
    table = list(_functions(values))
    letters = iter(string.ascii_lowercase)
    named, rows = [], []
    for i in range(4):
        row = []
        for j in range(4):
            numbers = matrices[:, i, j]
            latex = next((k for k, v in _CONSTANTS.items() if np.allclose(numbers, v)), None)
            latex = latex or _find(numbers, table)
            if latex is None:
                latex = next(letters)
                table.append((latex, numbers))
                named.append(latex)
            row.append(latex)
        rows.append(" & ".join(row))
    matrix = r"M = \begin{pmatrix}" + r"\\ ".join(rows) + r"\end{pmatrix}"
    words = [f"Of the {optic.beam} beam."] if optic.depends_on_beam is True else []
    words += [f":math:`x` is the position{_reference(optic)}."] if "x" in values else []
    if named:
        of = " and wavelength" if not values or _disperses(optic) else ""
        listed = ", ".join(f":math:`{n}`" for n in named)
        words.append(f"Functions of the parameters{of}, without a simple form: {listed}.")
    return matrix, " ".join(words)


def _reference(optic):
    return " in units of ``reference``" if hasattr(optic, "reference") else " of the mount"


def _disperses(optic):
    one, two = (np.asarray(optic.mueller(w * u.um)) for w in (1.4, 1.8))
    return not np.allclose(one, two)
