# Licensed under a 3-clause BSD style license - see LICENSE
"""Sphinx extension that writes the model gallery before the pages are read."""

import hashlib
from pathlib import Path

import astropolcal
from astropolcal.gap.effects import EFFECTS
from astropolcal.optics import OPTICS

_PACKAGE = Path(astropolcal.__file__).parent
_DRAWING = ("build", "examples", "fingerprints", "optic_figures")
_COMMON = ("chain.py", "propagation.py", "mueller.py", "optics")
_OF_EFFECTS = ("gap/effects", "gap/problem.py", "gap/channels.py", "instruments/charis.py")


def _digest(parts):
    """Return a hash of the parts of the package that figures depend on, and of the gallery."""
    files = [Path(__file__).parent / f"{name}.py" for name in _DRAWING]
    for part in parts:
        path = _PACKAGE / part
        files += [path] if path.is_file() else sorted(path.rglob("*.py"))
    sha = hashlib.sha256()
    for path in files:
        sha.update(path.read_bytes())
    return sha.hexdigest()


def _write(path, text):
    """Write a page only where it has changed, so that it is not read again for nothing."""
    if not path.is_file() or path.read_text(encoding="utf-8") != text:
        path.write_text(text, encoding="utf-8")


def _figure(width, height, layout="constrained"):
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout=layout)


def draw_optic(name, folder):
    """
    Draw the figures of an optic.

    Parameters
    ----------
    name : str
        Class in ``OPTICS``.
    folder : `~pathlib.Path`
        Where the PNG files go.

    Returns
    -------
    tuple of str
        What they show, in words.
    """
    from gallery.examples import example_of
    from gallery.optic_figures import draw_elements, draw_measurement

    optic = example_of(OPTICS[name])
    elements, measurement = _figure(8, 6.4, None), _figure(7.5, 4.6)
    words = draw_elements(elements, optic), draw_measurement(measurement, optic)
    elements.savefig(folder / f"{name}_elements.png", dpi=90)
    measurement.savefig(folder / f"{name}_measurement.png", dpi=90)
    return words


def draw_effect(name, folder):
    """
    Draw the fingerprint of an effect.

    Parameters
    ----------
    name : str
        Effect in ``EFFECTS``.
    folder : `~pathlib.Path`
        Where the PNG file goes.

    Returns
    -------
    str
        The scene, in words; empty where no scene has a place for the effect.
    """
    from gallery.fingerprints import draw_rows, fingerprint, scene_of

    make = scene_of(name)
    if make is None:
        return ""
    labels = ("as it\nis", "what is\nleft")
    rows = list(zip(labels, fingerprint(name, make), strict=False))
    height = 1.3 * len(rows) + 1.0
    # a layout that is found costs a second painting
    figure = _figure(9.5, height, None)
    figure.subplots_adjust(0.12, 0.55 / height, 0.99, 1 - 0.28 / height, 0.04, 0.18)
    draw_rows(figure, rows, make().columns)
    figure.savefig(folder / f"{name}.png", dpi=90)
    return make().words


def _drawn(names, draw, figures, stamp, say):
    """Return the words of every figure, drawing those that are not there yet."""
    found = {}
    for number, name in enumerate(names):
        note = figures / f"{name}.txt"
        lines = note.read_text(encoding="utf-8").splitlines() if note.is_file() else [""]
        if lines[0] != stamp:
            say(f"drawing {name} ({number + 1} of {len(names)})")
            words = draw(name, figures)
            lines = [stamp, *([words] if isinstance(words, str) else words)]
            note.write_text("\n".join(lines), encoding="utf-8")
        found[name] = lines[1:] or [""]
    return found


def write_gallery(folder, say=lambda line: None):
    """
    Write pages and figures of all registered optics and effects.

    Parameters
    ----------
    folder : `~pathlib.Path`
        Folder of the pages.
    say : callable
        Called with a line on what is done.
    """
    from gallery import pages

    figures = folder / "figures"
    for part in (figures, folder / "optics", folder / "effects"):
        part.mkdir(parents=True, exist_ok=True)
    optics = _drawn(sorted(OPTICS), draw_optic, figures, _digest(_COMMON), say)
    stamp = _digest(_COMMON + _OF_EFFECTS)
    effects = _drawn(sorted(EFFECTS), draw_effect, figures, stamp, say)
    written = {folder / "optics.rst": pages.optics_index()}
    written[folder / "effects.rst"] = pages.effects_index()
    for name, words in optics.items():
        written[folder / "optics" / f"{name}.rst"] = pages.optic_page(name, *words)
    for name, words in effects.items():
        written[folder / "effects" / f"{name}.rst"] = pages.effect_page(name, words[0])
    for path, text in written.items():
        _write(path, text)
    for path in folder.rglob("*.rst"):
        if path not in written:
            path.unlink()


def _on_start(app):
    from sphinx.util import logging

    write_gallery(Path(app.srcdir) / "generated" / "models", logging.getLogger(__name__).info)


def _rows():
    """Return the directive that lists effects by name, with the words of their declarations."""
    from sphinx.util.docutils import SphinxDirective

    from gallery import pages

    class Effects(SphinxDirective):
        has_content = True

        def run(self):
            names = " ".join(self.content).split()
            return self.parse_text_to_nodes("\n".join(pages.effect_row(name) for name in names))

    return Effects


def setup(app):
    """Connect the gallery to a build."""
    app.add_directive("effects", _rows())
    app.connect("builder-inited", _on_start, priority=100)
    return {"version": "1", "parallel_read_safe": True, "parallel_write_safe": True}
