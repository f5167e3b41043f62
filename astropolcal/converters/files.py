# Licensed under a 3-clause BSD style license - see LICENSE
"""Calibration files: ASDF, with schemas of our own, validated on reading.

By default ASDF neither validates what it reads nor stops at what it cannot
convert, and it follows links out of the file. Here all of that is refused: a
file gives back exactly what was written, or one line that says why not.
"""

import io
import math
import re
import struct
import warnings
from contextlib import contextmanager
from functools import cache
from importlib.metadata import distribution
from pathlib import Path

import asdf
import asdf.util
from asdf.config import AsdfConfig
from asdf.constants import YAML_END_MARKER_REGEX
from asdf.exceptions import AsdfConversionWarning, AsdfWarning, ValidationError
from asdf.extension import ExtensionProxy
from asdf.resource import ResourceMappingProxy

from astropolcal.converters import CALIBRATION_TAG, CALIBRATION_TAGS
from astropolcal.converters.extension import get_extensions, get_resource_mappings
from astropolcal.exceptions import CalibrationFileError
from astropolcal.files import atomic_path, check_new, check_yaml, one_line, understood
from astropolcal.version import version as our_version

__all__ = []

_KEY = "calibration"
_ALLOWED_TAGS = re.compile(
    r"tag:stsci\.edu:asdf/(core/(asdf|software|extension_metadata|history_entry|ndarray)"
    r"|unit/(quantity|unit)|transform/[a-z0-9_]+)-[0-9.]+"
    r"|tag:astropy\.org:astropy/units/unit-[0-9.]+"
    rf"|{'|'.join(map(re.escape, CALIBRATION_TAGS))}"
    r"|tag:astropolcal\.org:astropolcal/optics/[a-z_0-9]+-1\.0\.0"
    r"|tag:yaml\.org,2002:[a-z]+"
)
# packages that plug the converters and schemas of these tags into ASDF; those of units only where a
# file has some, as they take a second to import
_PLAIN = ("asdf-standard", "asdf")
_UNITS = ("asdf-astropy", "asdf-coordinates-schemas", "asdf-transform-schemas")
# arrays of more numbers go into binary blocks, the others are readable
_INLINE = 64
_BEGIN, _END = b"#ASDF", b"\n...\n"
_NUMBERS = re.compile(r"bool8|u?int(8|16|32|64)|float(16|32|64)")
# bytes that a compressed block may always have
_MOST_UNPACKED = 2**26
_BLOCK, _BLOCK_HEAD = b"\xd3BLK", struct.Struct(">4sHI4sQQQ")


def write_calibration(calibration, path, overwrite=False):
    """Write a calibration to an ASDF file, which appears complete or not at all."""
    path = check_new(path, overwrite, CalibrationFileError, suffix=".asdf")
    with _speaking_of(path, "cannot be written", "cannot be written: ", reads=False):
        buffer = io.BytesIO()
        with _strict_asdf(), asdf.AsdfFile({_KEY: calibration}) as file:
            file.write_to(buffer)
        content = buffer.getvalue()
    with atomic_path(path, error=CalibrationFileError) as temporary:
        temporary.write_bytes(content)


def read_calibration(path):
    """Read a calibration, validated, equal to the last bit; nothing in the file is executed."""
    path = Path(path)
    with _speaking_of(path, "damaged"):
        content = path.read_bytes()
        # cheap checks first: most broken files are truncated or something else
        if not content.startswith(_BEGIN):
            raise CalibrationFileError("not an ASDF file")
        if not content.endswith(_END):
            raise CalibrationFileError("truncated: the end of the file is missing")
        end = re.search(YAML_END_MARKER_REGEX, content).end()
        with _speaking_of("damaged", "its YAML", reads=False):
            check_yaml(content[:end], CalibrationFileError)
        _check_blocks(content, end)
        tree = asdf.util.load_yaml(io.BytesIO(content), tagged=True)
        if not isinstance(tree, dict) or _KEY not in tree:
            raise CalibrationFileError(f"not an astropolcal calibration: it has no {_KEY!r}")
        _check_version(getattr(tree[_KEY], "_tag", None) or "no tag")
        _check_nodes(tree, len(content))
        has_units = re.search(rb"[/!](units?|transform)/", content[:end])
        with (
            _strict_asdf(_ConfigWithUnits if has_units else _Config),
            asdf.open(
                io.BytesIO(content), lazy_load=False, memmap=False, validate_checksums=True
            ) as file,
        ):
            return file[_KEY]


# ---- to and from bytes -------------------------------------------------------------


class _Config(AsdfConfig):
    """ASDF with the plug-ins of what a calibration holds; those of all packages take seconds."""

    packages = _PLAIN

    @property
    def extensions(self):
        return _plugged_in("asdf.extensions", ExtensionProxy, get_extensions, self.packages)

    @property
    def resource_mappings(self):
        group, get = "asdf.resource_mappings", get_resource_mappings
        return _plugged_in(group, ResourceMappingProxy, get, self.packages)


class _ConfigWithUnits(_Config):
    packages = _UNITS + _PLAIN


@cache
def _plugged_in(group, proxy, get_ours, packages):
    """Return what our package and others plug into ASDF."""
    asked = [("astropolcal", our_version, get_ours)]
    for name in packages:
        package = distribution(name)
        points = package.entry_points.select(group=group)
        # as ASDF itself names it, who compares the names of files with what is installed
        told = package.metadata["Name"], package.version
        asked += [(*told, point.load()) for point in points]
    return [
        proxy(one, package_name=name, package_version=version)
        for name, version, get in asked
        for one in get()
    ]


@contextmanager
def _strict_asdf(kind=_ConfigWithUnits):
    """Switch on what ASDF leaves off: validation, and errors for what cannot be converted."""
    with asdf.config_context() as config, warnings.catch_warnings():
        # other versions of asdf and its plugins do not matter, what is in the file does
        warnings.simplefilter("ignore", AsdfWarning)
        warnings.simplefilter("error", AsdfConversionWarning)
        # without its schema a node would pass unseen
        warnings.filterwarnings("error", "Unable to locate schema", AsdfWarning)
        config.__class__ = kind
        config.reset_resources()
        config.validate_on_read = True
        config.warn_on_failed_conversion = False
        config.lazy_tree = False
        config.array_inline_threshold = _INLINE
        config.all_array_storage = None
        config.all_array_compression = "input"
        yield


# ---- what is refused before ASDF opens the file ------------------------------------


def _check_blocks(content, start):
    """Refuse blocks that are not all there, or claim to hold much more than the file."""
    while content[start : start + 4] == _BLOCK:
        head = content[start : start + 6 + 48]
        if len(head) < 6 + 48:
            raise CalibrationFileError("truncated: a binary block has no end")
        _, size, _, packing, room, used, data = _BLOCK_HEAD.unpack_from(head)
        start += 6 + size
        if data > (used if packing == b"\0\0\0\0" else max(_MOST_UNPACKED, 20 * used)):
            raise CalibrationFileError(f"a binary block claims to hold {data} bytes")
        if not used <= room <= len(content) - start:
            raise CalibrationFileError("a binary block claims more than the file holds")
        start += room


def _check_version(tag):
    if tag in CALIBRATION_TAGS:
        return
    kind, _, version = tag.rpartition("-")
    if kind != CALIBRATION_TAG.rpartition("-")[0]:
        raise CalibrationFileError(f"not an astropolcal calibration: {_KEY!r} has {tag}")
    known = [tag.rpartition("-")[2] for tag in CALIBRATION_TAGS]
    found, newest = (list(map(int, re.findall(r"\d+", text))) for text in (version, known[-1]))
    advice = f": update {our_version}, the file is newer" if found > newest else ""
    raise CalibrationFileError(
        f"calibration of version {version}; this astropolcal reads version "
        f"{', '.join(known)}{advice}"
    )


def _check_nodes(tree, size):
    """Refuse unknown tags, links out of the file, and arrays that cannot be in it."""
    waiting, seen = [tree], set()
    while waiting:
        node = waiting.pop()
        if id(node) in seen:
            continue
        seen.add(id(node))
        tag = getattr(node, "_tag", None)
        if tag is not None and not _ALLOWED_TAGS.fullmatch(tag):
            raise CalibrationFileError(f"holds an object of unknown kind or version, {tag}")
        if isinstance(node, dict):
            is_array = "ndarray" in (tag or "")
            if "$ref" in node or (is_array and isinstance(node.get("source"), str)):
                # a file stands for itself, and reading it must not open others
                raise CalibrationFileError("refers to another file")
            if is_array:
                _check_array(node, size)
            waiting.extend(node.values())
        elif isinstance(node, list):
            waiting.extend(node)


def _check_array(node, size):
    """Refuse arrays that are not plain numbers, or more than the bytes of the file."""
    kind, shape = node.get("datatype"), node.get("shape", [])
    if not (isinstance(kind, str) and _NUMBERS.fullmatch(kind)):
        raise CalibrationFileError(f"an array of {one_line(kind)}, plain numbers are allowed")
    plain = isinstance(shape, list) and all(type(n) is int and n >= 0 for n in shape)
    if not plain or math.prod(shape) > size:
        raise CalibrationFileError(f"an array of shape {one_line(shape)}, which cannot be in it")
    for key in ("strides", "mask"):
        if key in node:
            raise CalibrationFileError(f"an array with {key}, plain ones are allowed")


# ---- errors ------------------------------------------------------------------------


@contextmanager
def _speaking_of(path, words, prefix="", reads=True):
    """Turn anything that goes wrong into one line that names the file."""
    with understood(path, CalibrationFileError, words, reads=reads):
        try:
            yield
        except CalibrationFileError as error:
            raise CalibrationFileError(f"{path}: {prefix}{one_line(error, 500)}") from error
        except ValidationError as error:
            # what a schema objects to, and at which place of the file
            place = one_line(".".join(map(str, error.absolute_path)))
            words = f"invalid at {place}: {one_line(error.message)}"
            raise CalibrationFileError(f"{path}: {prefix}{words}") from error
