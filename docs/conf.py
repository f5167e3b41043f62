# Licensed under a 3-clause BSD style license - see LICENSE
"""
Sphinx configuration, on the shared settings of Astropy.

Neither the build nor the pages need a network. Links to the documentation of other
packages are resolved only where ``READTHEDOCS`` or ``ASTROPOLCAL_DOCS_ONLINE`` is set.
"""

import os
import sys
import tomllib
from datetime import UTC, datetime
from importlib.metadata import distribution
from pathlib import Path

from sphinx_astropy.conf.v3 import *  # noqa: F403
from sphinx_astropy.conf.v3 import (
    exclude_patterns,
    extensions,
    intersphinx_mapping,
    numpydoc_xref_ignore,
)

from astropolcal.version import version as release

# the gallery of models is a package beside this file
sys.path.insert(0, str(Path(__file__).parent))

# -- Project --------------------------------------------------------------------

project = "astropolcal"
author = "astropolcal developers"
copyright = f"{datetime.now(tz=UTC).year}, {author}"
version = release.split("+")[0]

# -- Sources --------------------------------------------------------------------

exclude_patterns += ["changes/*", "_templates", "gallery", "tutorials", "**/conftest.py"]
numpydoc_xref_ignore |= {"shape", "array"}

# -- Pages that are written by a build ----------------------------------------------

# pages of optics and effects from the registries, and tutorials from scripts; what has not
# changed is not drawn or run again
extensions += ["gallery.build", "sphinx_gallery.gen_gallery"]

sphinx_gallery_conf = {
    "examples_dirs": "tutorials",
    "gallery_dirs": "generated/tutorials",
    "filename_pattern": r"/plot_",
    "within_subsection_order": "FileNameSortKey",
    "abort_on_example_error": True,
    "download_all_examples": False,
    "capture_repr": (),
    "remove_config_comments": True,
    "show_signature": False,
    "write_computation_times": False,
    "inspect_global_variables": False,
}


def _unreleased():
    """Return the fragments of the next version, as towncrier will put them together."""
    folder = Path(__file__).parent / "changes"
    settings = tomllib.loads((folder.parents[1] / "pyproject.toml").read_text(encoding="utf-8"))
    lines = ["In development", "--------------", ""]
    for kind in settings["tool"]["towncrier"]["type"]:
        files = sorted(folder.glob(f"*.{kind['directory']}.rst"))
        lines += [kind["name"], "^" * len(kind["name"]), ""] if files else []
        for path in files:
            text = path.read_text(encoding="utf-8").strip().replace("\n", "\n  ")
            lines += [f"- {text}", ""]
    return "\n".join(lines) if len(lines) > 3 else ""


_generated = Path(__file__).parent / "generated"
_generated.mkdir(exist_ok=True)
(_generated / "unreleased.txt").write_text(_unreleased(), encoding="utf-8")

# -- Links to other packages ------------------------------------------------------

ONLINE = bool(os.environ.get("READTHEDOCS") or os.environ.get("ASTROPOLCAL_DOCS_ONLINE"))

EXTERNAL = (
    "asdf",
    "asdf_astropy",
    "astropy",
    "dask",
    "emcee",
    "matplotlib",
    "numpy",
    "photutils",
    "scipy",
    "specutils",
)

if ONLINE:
    for unused in ("astropy.org", "h5py", "pythonloc"):
        intersphinx_mapping.pop(unused, None)
    intersphinx_mapping["asdf"] = ("https://www.asdf-format.org/projects/asdf/en/stable/", None)
    intersphinx_mapping["photutils"] = ("https://photutils.readthedocs.io/en/stable/", None)
    intersphinx_mapping["specutils"] = ("https://specutils.readthedocs.io/en/stable/", None)
else:
    intersphinx_mapping = {}
    # it looks for its inventories on the network
    extensions = [name for name in extensions if not name.endswith("intersphinx_toggle")]

nitpicky = True
nitpick_ignore_regex = [
    # private bases, and packages whose inventory lists too little
    (r"py:.*", r"astropolcal\.(.*\.)?_.*"),
    # what only a module has is private; tests/test_docs_links.py knows whether it is there
    (r"py:.*", r"astropolcal\.\w+\.[a-z]\w*\..*"),
    (r"py:.*", r"(astropy\.modeling|numpy\.typing)\..*"),
]
# there is nothing to link these to, and without network there is nothing at all
unlinked = [name for name in EXTERNAL if name not in intersphinx_mapping]
nitpick_ignore_regex.append((r"py:.*", rf"({'|'.join(unlinked)})(\..*)?"))
if not ONLINE:
    builtin = (
        r"(bool|bytes|dict|float|int|list|object|str|tuple|type|property|None|True|False"
        r"|[A-Z]\w*(Error|Warning|Exception)|Exception"
        r"|(abc|argparse|collections|concurrent|contextlib|dataclasses|enum|functools|io|pathlib"
        r"|typing)\..*)"
    )
    nitpick_ignore_regex.append((r"py:.*", builtin))

# -- Pages ------------------------------------------------------------------------

html_title = f"astropolcal {version}"
# MathJax comes with the pages, so that equations show without network, too. This one file of it
# draws in SVG and needs no fonts; the package's own extension would copy all 24 MB.
mathjax_path = "tex-svg.js"
html_static_path = [
    str(
        distribution("sphinx-mathjax-offline").locate_file(
            f"sphinx-mathjax-offline/static/mathjax/{mathjax_path}"
        )
    ),
    "_static",
]
html_css_files = ["pages.css"]
html_logo = html_favicon = "_static/logo.svg"
# the header has the logo
# pages of source are wide, and their navigation would be most of the time of a build
html_sidebars = {"[!_]**": ["components/sst-sidebar-nav.html"], "_modules/**": []}
html_theme_options = {
    # pages with the navigation of all other pages are twice as large
    "collapse_navigation": True,
    "logo": {"text": "astropolcal", "alt_text": "Logo of astropolcal"},
    "navbar_start": "components/navbar-logo.html",
    "navbar_links": [
        ["First calibration", "first_calibration"],
        ["Tutorials", "generated/tutorials/index"],
        ["Optics", "generated/models/optics"],
        ["Questions", "faq"],
        ["Reference", "api"],
    ],
    "footer_links": [],
    # the theme would search other packages, and load a counter of visitors from the network
    "rtd_search": False,
    "goatcounter_analytics_url": "",
}
# one picture of each plot; the default makes three
plot_formats = [("png", 110)]
plot_html_show_formats = False

modindex_common_prefix = ["astropolcal."]

# the class page lists attributes and methods already
numpydoc_show_class_members = False
autoclass_content = "class"
