# Licensed under a 3-clause BSD style license - see LICENSE
"""
The map of the architecture: ``python docs/draw_architecture.py`` writes it anew.

Layers and rooms are those of the contract in setup.cfg, arrows the imports of the source. An
import that others imply is left out: of A to B, B to C and A to C the last has no arrow.
"""

import ast
import configparser
import re
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
PACKAGE = REPOSITORY / "astropolcal"
MAP = REPOSITORY / "docs" / "images" / "architecture.svg"

_WIDTH, _ROW, _BOX, _ROOM = 900, 56, 28, 20
_CORE, _ABOVE = "#e4eef8", "#f6ecd8"


def contract():
    """Return the layers and the rooms of the calibration, highest first, and the physics core."""
    config = configparser.ConfigParser()
    config.read(REPOSITORY / "setup.cfg", encoding="utf-8")
    sections = (config[f"importlinter:contract:{name}"] for name in ("layers", "calibration"))
    layers, rooms = (
        [re.findall(r"\w+", line) for line in section["layers"].split("\n") if line.strip()]
        for section in sections
    )
    core = config["importlinter:contract:core"]["source_modules"].split()
    return layers, rooms, {name.removeprefix("astropolcal.") for name in core}


def imports(names):
    """Return what each of the packages imports, and what it looks up by name when it is called."""
    found, by_name = {name: set() for name in names}, set()
    for path in PACKAGE.rglob("*.py"):
        text, own = path.read_text(encoding="utf-8"), path.relative_to(PACKAGE).parts[0]
        own = own.removesuffix(".py")
        if own in found:
            modules = set(_imported(ast.parse(text)))
            found[own] |= {name for name in names if f"astropolcal.{name}" in modules} - {own}
            by_name |= {(own, name) for name in re.findall(r'\b_above\("(\w+)', text)}
    return found, by_name


def _imported(tree):
    """Yield each package of ours that is imported, as ``astropolcal.name``."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            full = [f"{node.module}.{alias.name}" for alias in node.names]
        else:
            full = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        yield from (".".join(name.split(".")[:2]) for name in full)


def reduced(graph):
    """Return the arrows that no way over other packages implies."""
    return sorted(
        (name, other)
        for name, others in graph.items()
        for other in others
        if not any(other in _below(graph, way) for way in others - {other})
    )


def _below(graph, name):
    found = set(graph[name])
    for other in graph[name]:
        found |= _below(graph, other)
    return found


def draw():
    """Return the map as SVG."""
    layers, rooms, core = contract()
    graph, by_name = imports([name for layer in layers for name in layer])
    boxes, height = _places(layers, rooms)
    parts = [_arrow(boxes, *pair) for pair in reduced(graph)]
    parts += [_arrow(boxes, *pair, dashed=True) for pair in sorted(by_name)]
    for name, (x, y, width, tall) in boxes.items():
        fill = _CORE if name in core else _ABOVE
        parts.append(
            f'<rect x="{x - width / 2:g}" y="{y:g}" width="{width:g}" height="{tall:g}" rx="5" '
            f'fill="{fill}" stroke="#555"/>'
        )
        parts.append(_text(name, x, y + 18, bold=True))
    x, y, *_ = boxes["calibration"]
    for i, room in enumerate(rooms):
        parts.append(_text(" | ".join(room), x, y + 18 + _ROOM * (i + 1)))
    parts += _legend(height)
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {_WIDTH} {height}" '
        'font-family="sans-serif" font-size="13">',
        "<title>Layers, packages and imports of astropolcal</title>",
        '<defs><marker id="head" viewBox="0 0 10 10" refX="9" refY="5" markerWidth="7" '
        'markerHeight="7" orient="auto"><path d="M0,1 L10,5 L0,9 z" fill="#555"/></marker></defs>',
        f'<rect width="{_WIDTH}" height="{height}" fill="white"/>',
    )
    return "\n".join([*head, *parts, "</svg>", ""])


def _places(layers, rooms):
    """Return middle, top, width and height of the box of each package, and the whole height."""
    boxes, y = {}, 16
    for layer in layers:
        tall = _BOX
        for i, name in enumerate(layer):
            width, tall = 9 * len(name) + 20, _BOX
            if name == "calibration":
                width, tall = 150, _BOX + _ROOM * len(rooms) + 4
            boxes[name] = (_WIDTH / 2 + (i - (len(layer) - 1) / 2) * 190, y, width, tall)
        y += tall + _ROW - _BOX
    return boxes, y + 30


def _text(words, x, y, *, bold=False, anchor="middle"):
    weight = ' font-weight="bold"' if bold else ""
    return f'<text x="{x:g}" y="{y:g}" text-anchor="{anchor}"{weight}>{words}</text>'


def _arrow(boxes, name, other, *, dashed=False):
    """Return an arrow; one that passes other layers goes around them."""
    (x1, y1, w1, h1), (x2, y2, w2, _) = boxes[name], boxes[other]
    dash = ' stroke-dasharray="5 4"' if dashed else ""
    if y1 == y2:
        side = 1 if x2 > x1 else -1
        path = f"M{x1 + side * w1 / 2:g},{y1 + 14:g} L{x2 - side * w2 / 2:g},{y2 + 14:g}"
    elif 0 < y2 - y1 - h1 < _ROW:
        path = f"M{x1:g},{y1 + h1:g} L{x2:g},{y2:g}"
    else:
        # around on the side where it begins, the farther the longer it is
        side = 1 if x1 + x2 > _WIDTH or dashed else -1
        start, end = x1 + side * w1 / 2, x2 + side * w2 / 2
        reach = _WIDTH / 2 + side * min(200 + 0.5 * abs(y2 - y1), 430)
        bend = f"C{reach:g},{y1 + 30:g} {reach:g},{y2 - 10:g}"
        path = f"M{start:g},{y1 + 14:g} {bend} {end:g},{y2 + 14:g}"
    return f'<path d="{path}" fill="none" stroke="#777" marker-end="url(#head)"{dash}/>'


def _legend(height):
    y = height - 28
    return [
        f'<rect x="16" y="{y}" width="18" height="14" fill="{_CORE}" stroke="#555"/>',
        _text("physics core: numpy, scipy, astropy", 40, y + 12, anchor="start"),
        f'<rect x="300" y="{y}" width="18" height="14" fill="{_ABOVE}" stroke="#555"/>',
        _text("may use more", 324, y + 12, anchor="start"),
        f'<path d="M440,{y + 7} h36" stroke="#777" stroke-dasharray="5 4" '
        'marker-end="url(#head)"/>',
        _text("looked up by name when called; all else is an import", 484, y + 12, anchor="start"),
    ]


if __name__ == "__main__":
    MAP.write_text(draw(), encoding="utf-8")
