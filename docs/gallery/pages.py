# Licensed under a 3-clause BSD style license - see LICENSE
"""The pages of optics and effects: everything on them comes from the registries."""

import inspect
import io
import json
import re
import textwrap
from pathlib import Path

import astropy.units as u
import numpy as np
from jinja2 import Environment, FileSystemLoader, StrictUndefined
from numpydoc.docscrape import NumpyDocString

from astropolcal import optics
from astropolcal.chain import leaves
from astropolcal.converters.nodes import node_from_optic
from astropolcal.gap.effects import EFFECTS, Context, Effect
from astropolcal.gap.problem import law_basis
from astropolcal.optics import OPTICS
from gallery.examples import example_of
from gallery.fingerprints import scene_of
from gallery.form import form_of

_ENVIRONMENT = Environment(
    loader=FileSystemLoader(Path(__file__).parent / "templates"),
    undefined=StrictUndefined,
    keep_trailing_newline=True,
    autoescape=False,
)
KINDS = {
    "optic": "An optic that the model lacks",
    "parameter": "A parameter that is freed",
    "bound": "A bound that is lifted",
    "detector": "Detector",
    "source": "Source",
    "discrete": "Discrete alternatives",
}


def render(template, **values):
    """Return the text of a page."""
    text = _ENVIRONMENT.get_template(f"{template}.rst.jinja").render(**values)
    return re.sub(r"\n{3,}", "\n\n", text).rstrip() + "\n"


def _parts(cls):
    """Return summary, extended summary and notes of a docstring."""
    parsed = NumpyDocString(inspect.getdoc(cls))
    parts = ("Summary", "Extended Summary", "Notes")
    return [_linked("\n".join(parsed[part]).strip()) for part in parts]


def _linked(text):
    """Write names that a docstring links to its own module so that they work on any page."""

    def replace(match):
        name = match.group(1)
        return f"`~astropolcal.optics.{name}`" if name in optics.__all__ else f"``{name}``"

    return re.sub(r"(?<![`:\w])`([A-Za-z_]\w*)`(?![`_])", replace, text)


def yaml_of(**tree):
    """Return optics as they stand in a calibration file."""
    import asdf

    stream = io.BytesIO()
    asdf.AsdfFile(tree).write_to(stream, all_array_storage="inline")
    text = stream.getvalue().decode("utf-8")
    first = min(text.index(f"\n{key}:") for key in tree) + 1
    return text[first : text.rindex("\n...")]


# ---- optics --------------------------------------------------------------------------------


def _bounds(parameter):
    low, high = parameter.bounds
    if low is None and high is None:
        return "none"
    if high is None:
        return f"from {low:g}"
    return f"up to {high:g}" if low is None else f"{low:g} to {high:g}"


def _parameter_rows(optic):
    for key in optic.param_names:
        declared = inspect.getattr_static(type(optic), key)
        yield {
            "name": key,
            "unit": "" if declared.unit is None else str(declared.unit),
            "default": f"{float(np.ravel(declared.default)[0]):g}",
            "bounds": _bounds(declared),
            "fixed": declared.fixed,
            "description": declared._description,
        }


def _settings(cls):
    known = inspect.signature(cls).parameters
    names = [n for n in known if n not in (*cls.param_names, "name", "mount")]
    return ", ".join(f"``{n}`` (default ``{known[n].default!r}``)" for n in names)


def _example_code(cls):
    parsed = NumpyDocString(inspect.getdoc(cls))
    lines = [
        line[4:] for line in parsed["Examples"] if line.startswith((">>> ", "... ", ">>>", "..."))
    ]
    return "\n".join(lines)


def optic_page(name, label, place):
    """
    Return the page of an optic.

    Parameters
    ----------
    name : str
        Class in ``OPTICS``.
    label, place : str
        What the figures say that they show.
    """
    cls = OPTICS[name]
    optic = example_of(cls)
    summary, extended, notes = _parts(cls)
    # a matrix that the description states is not shown twice
    stated = "pmatrix" in f"{extended}{notes}"
    matrix, letters = ("", "") if stated else form_of(optic)
    return render(
        "optic",
        matrix=matrix,
        letters=letters,
        name=name,
        summary=summary,
        extended=extended,
        notes=notes,
        parameters=list(_parameter_rows(optic)),
        settings=_settings(cls),
        label=label,
        place=place,
        example=_example_code(cls),
        effects=[e for e in sorted(EFFECTS) if name in inserted_classes(e)],
        yaml=yaml_of(optic=optic),
    )


def _family(cls):
    return (inspect.getdoc(inspect.getmodule(cls)) or "").strip().splitlines()[0].rstrip(".")


def optics_index():
    """Return the page that lists the optics by family."""
    families = {}
    for name, cls in sorted(OPTICS.items()):
        words = _parts(cls)[0]
        families.setdefault(_family(cls), []).append({"name": name, "words": words})
    groups = [{"title": family, "members": members} for family, members in families.items()]
    words = (
        "One page for each optic in `astropolcal.optics.OPTICS`: its equation, its parameters, its "
        "Mueller matrix, what it does to a measurement, and how a calibration file holds it."
    )
    return render(
        "index", title="Optics", words=words, groups=groups, folder="optics", drawn="_elements"
    )


# ---- effects -------------------------------------------------------------------------------


def _few():
    """Return a context of three wavelengths, for text."""
    return Context(np.array([1.2, 1.6, 2.2]), 1e7)


def _few_chains(effect):
    """Return the chains of an effect's scene at three wavelengths."""
    from astropolcal.gap.alternatives import thinned

    make = scene_of(effect.name)
    if make is None:
        return None
    scene = make()
    return thinned(scene.chains, scene.data, 3)[0]


def _edited(effect):
    """Return the optics that an edit adds or changes, in the first chain that has any."""
    before = _few_chains(effect)
    if before is None:
        return []
    after = effect.edit(before, _few()).chains
    for old, new in zip(before, after, strict=True):
        known = {leaf.name: _content(leaf) for leaf in leaves(old)}
        found = [leaf for leaf in leaves(new) if known.get(leaf.name) != _content(leaf)]
        if found:
            return [(leaf, leaf.name in known) for leaf in found]
    return []


def _content(optic):
    """Return all that a calibration file says of an optic, as text."""
    node = node_from_optic(optic)
    return type(optic).__name__ + json.dumps(node, default=np.ndarray.tolist, sort_keys=True)


_CLASSES = {}


def inserted_classes(name):
    """Return the classes of the optics that an effect adds or changes."""
    if name not in _CLASSES:
        _CLASSES[name] = [type(leaf).__name__ for leaf, _ in _edited(EFFECTS[name])]
    return _CLASSES[name]


def _law(basis, per_wavelength, grid):
    if basis is None:
        return "one value per wavelength" if per_wavelength else "one number"
    n, k = basis.shape
    if k >= n:
        return "one value per wavelength"
    if np.allclose(basis, law_basis(grid, k - 1)):
        return f"polynomial of degree {k - 1} in wavelength" if k > 1 else "one number"
    return f"{k} functions of wavelength" if k > 1 else "a function of wavelength, times a number"


def _quantity(value):
    value = u.Quantity(value)
    if value.unit == u.one:
        return f"{100 * value.value:g} %"
    return f"{value.value:g} {value.unit}"


def _effect_parameters(effect):
    make = scene_of(effect.name)
    if make is None:
        return []
    scene = make()
    context = scene.context()
    edit = effect.edit(scene.chains, context)
    shapes = {
        f"{leaf.name}.{key}": getattr(leaf, key).shape
        for chain in edit.chains
        for leaf in leaves(chain)
        for key in leaf.param_names
    }
    return [
        {
            "name": p.name,
            "scale": _quantity(p.scale),
            "limit": _quantity(p.limit),
            "law": _law(p.basis, bool(shapes[p.name]), context.wavelength),
        }
        for p in edit.parameters
    ]


def _equation(effect, changed):
    """Return in words and symbols what the edit does to the chain."""
    if not changed:
        return "The chain is exchanged; nothing is added that could be fitted."
    lines = []
    shown = set()
    for leaf, was_there in changed:
        kind = f":doc:`{type(leaf).__name__} <../optics/{type(leaf).__name__}>`"
        known = type(leaf).__name__ in OPTICS
        kind = kind if known else f"``{type(leaf).__name__}``"
        mount = f", on the stage ``{leaf.mount}``" if leaf.mount else ""
        verb = "changes the optic" if was_there else "inserts an optic"
        lines.append(f"The edit {verb} ``{leaf.name}``, a {kind}{mount}.")
        math = [] if type(leaf) in shown else _math_of(type(leaf))
        shown.add(type(leaf))
        lines.extend(["", *math, ""])
    if effect.kind != "discrete":
        lines.append(_LINEAR)
    return "\n".join(lines)


_LINEAR = textwrap.dedent(
    r"""
    A diagnosis looks for the derivative of the data :math:`d` to its parameters :math:`p` where
    the effect is absent, less what the nominal parameters, with the Jacobian :math:`J`, can do:

    .. math:: r = \left(1 - J (J^\mathsf{T} J)^{-1} J^\mathsf{T}\right)
              \frac{\partial d}{\partial p}\,\delta p .
    """
)


def _math_of(cls):
    """Return the sentences of a class's description that hold an equation."""
    _, extended, _ = _parts(cls)
    paragraphs = extended.split("\n\n")
    return [f"{p}\n" for p in paragraphs if ".. math::" in p or ":math:`" in p]


def _caption(effect, words):
    what = (
        "The change that the alternative makes, before anything is refitted"
        if effect.kind == "discrete"
        else "Above, the change for the size to expect, with the coefficients 1, -0.6 and 0.4 of "
        "its law. Below, what is left of it when the free parameters of the model have absorbed "
        "what they can: what a diagnosis can see"
    )
    return f"{what}. The scene is {words}. :ref:`effect-pictures` says how to read it."


def effect_page(name, words):
    """
    Return the page of an effect.

    Parameters
    ----------
    name : str
        Effect in ``EFFECTS``.
    words : str or None
        The scene of its figure.
    """
    effect = EFFECTS[name]
    changed = _edited(effect)
    shown = changed[0][0] if changed else None
    cells = (effect.kind, effect.place, effect.shows, effect.reference, effect.absorbed_by or "")
    added = changed and not changed[0][1]
    return render(
        "effect",
        name=name,
        title=effect.title[0].upper() + effect.title[1:],
        # what is declared has its equation, what is code its words
        extended="" if type(effect) is Effect else "\n\n".join(_parts(type(effect))[:2]),
        kind=effect.kind,
        place=effect.place,
        shows=effect.shows,
        absorbed=f"``{effect.absorbed_by}``" if effect.absorbed_by else "",
        reference=effect.reference,
        width=max(len(cell) for cell in cells) + 4,
        parameters=_effect_parameters(effect),
        equation=_equation(effect, changed),
        words=words,
        caption=_caption(effect, words) if words else "",
        stored="The optic that is added, at three wavelengths and before it is fitted:"
        if added
        else "The optic as the edit leaves it, at three wavelengths and before it is fitted:",
        yaml=yaml_of(optic=shown) if shown is not None else "",
    )


def effect_row(name):
    """
    Return what the list of effects says of one, from its declaration.

    Parameters
    ----------
    name : str
        Effect in ``EFFECTS``.
    """
    effect = EFFECTS[name]
    parts = [f"Place: {effect.place}", f"Shows: {effect.shows}"]
    if effect.kind != "discrete":
        # what is added without an optic of its own is a perturbation
        keys = sorted(effect.free or ("amplitude",))
        listed = ", ".join(f"``{key}``" for key in keys)
        sizes = f"about {_quantity(effect.scale)}, at most {_quantity(effect.limit)}"
        parts.append(f"Law: {_law_of(effect)}")
        parts.append(f"Parameter{'s' if len(keys) > 1 else ''} {listed}: {sizes}")
    if effect.absorbed_by:
        parts.append(f"Absorbed by ``{effect.absorbed_by}``")
    parts.append(f"Reference: {effect.reference}")
    text = textwrap.indent(textwrap.fill(". ".join(parts) + ".", 96), "    ")
    return f":doc:`{name} </generated/models/effects/{name}>`\n    {effect.title}.\n\n{text}\n"


def _law_of(effect):
    """Return the law in wavelength in words: those of the function that makes it, if one does."""
    if isinstance(effect.degree, int):
        known = effect.degree and f"polynomial of degree {effect.degree} in wavelength"
        maker = None if type(effect).law is Effect.law else type(effect).law
    else:
        known = "one value per wavelength" if effect.degree is None else None
        maker = effect.degree if callable(effect.degree) else None
    if "edit" in vars(type(effect)) and hasattr(effect, "is_open"):
        return "as in the chain"
    if maker is not None:
        return inspect.getdoc(maker).removeprefix("Return ").rstrip(".")
    return known or "the same at all wavelengths"


def effects_index():
    """Return the page that lists the effects by kind."""
    groups = []
    for kind, title in KINDS.items():
        members = [
            {"name": n, "words": e.title} for n, e in sorted(EFFECTS.items()) if e.kind == kind
        ]
        if members:
            groups.append({"title": title, "members": members})
    words = (
        "One page for each effect in `astropolcal.gap.effects.EFFECTS`: where it acts and shows, "
        "its equation, its fingerprint in the residuals, and how a calibration file holds it. "
        ":doc:`../../effects` describes them by the place where they act."
    )
    return render("index", title="Effects", words=words, groups=groups, folder="effects", drawn="")
