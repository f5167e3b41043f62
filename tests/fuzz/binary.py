# Licensed under a 3-clause BSD style license - see LICENSE
"""Ways to spoil the structure of FITS files."""

import gzip
import io
from functools import lru_cache

import numpy as np
from astropy.io import fits

from astropolcal.fitscheck import MOST_HDUS, _walk
from tests.fuzz.mutate import HOSTILE, NUMBERS, mutate_bytes, some

__all__ = ["forge_checksums", "mutate_fits"]

BLOCK, CARD = 2880, 80
SIZES = ("0", "1", "-1", "2", "3", "999", "99999", "1000000000", "9223372036854775807", "4.5", "T")
_STRUCTURE = ("SIMPLE", "XTENSION", "BITPIX", "NAXIS", "PCOUNT", "GCOUNT", "TFIELDS", "THEAP")
_ADDED = (
    *("BZERO", "BSCALE", "BLANK", "ZIMAGE", "ZCMPTYPE", "ZBITPIX", "ZNAXIS", "GROUPS", "EXTEND"),
    *("TFORM1", "TDIM1", "TNULL1", "TSCAL1", "TZERO1", "TTYPE1", "TUNIT1", "END", "CONTINUE"),
)
_FORMS = ("PA(999999999)", "999999999D", "QD(1)", "0A", "X", "8X", "C", "K", "1PJ", "zz", "10A")
_TYPES = ("IMAGE", "BINTABLE", "TABLE", "A3DTABLE", "FOREIGN", "x")


# ---- FITS --------------------------------------------------------------------------


@lru_cache(maxsize=1)
def _zeros():
    """Return 50 MB of nothing, packed as a part of a file of gzip."""
    return gzip.compress(b"\0" * 50_000_000, 1)


def mutate_fits(rng, content):
    """Change cards of the headers, data, or the order of the parts of a FITS file."""
    kinds = ("bytes", "card", "card", "card", "card", "hdu", "nan", "gzip", "remade")
    kind = some(rng, kinds)
    if kind == "bytes":
        return mutate_bytes(rng, content)
    if kind == "gzip":
        packed = gzip.compress(content, 1) + some(rng, (b"", _zeros()))
        return packed if rng.random() < 0.5 else mutate_bytes(rng, packed)
    headers = _headers(content)
    if not headers:
        return mutate_bytes(rng, content)
    if kind == "hdu":
        return _parts(rng, content, headers)
    if kind == "nan":
        return _numbers(rng, content, headers)
    if kind == "remade":
        return _remade(rng, content)
    for _ in range(int(rng.integers(1, 4))):
        content = _card(rng, content, some(rng, headers))
    return content


def _headers(content):
    """Return where the headers start and end."""
    found, start = [], 0
    while start + BLOCK <= len(content):
        if content[start : start + 8] in (b"SIMPLE  ", b"XTENSION"):
            place = start
            while place + CARD <= len(content) and content[place : place + 8] != b"END     ":
                place += CARD
            end = -(-(place + CARD) // BLOCK) * BLOCK
            found.append((start, end, place))
            start = end
        else:
            start += BLOCK
    return found


def _value(rng, key):
    if key.startswith("NAXIS") or (key in _STRUCTURE and rng.random() < 0.5):
        return some(rng, SIZES)
    if key == "XTENSION":
        return f"'{some(rng, _TYPES):8}'"
    if key.startswith("TFORM"):
        return f"'{some(rng, _FORMS):8}'"
    if key == "BITPIX":
        return some(rng, ("8", "16", "32", "64", "-32", "-64", "7", "0", "-16", "x"))
    word = some(rng, (*NUMBERS, *HOSTILE, "F", "T"))
    return word if rng.random() < 0.5 else f"'{word}'"


def _card(rng, content, header):
    start, _, last = header
    n = (last - start) // CARD
    cards = [content[start + CARD * i : start + CARD * (i + 1)] for i in range(n)]
    i = int(rng.integers(n))
    key = cards[i][:8].decode("latin-1").strip()
    kind = some(rng, ("value", "value", "value", "value", "delete", "double", "key", "add", "junk"))
    if kind == "value":
        cards[i] = _spelled(key, _value(rng, key))
    elif kind == "delete":
        del cards[i]
    elif kind == "double":
        cards.insert(int(rng.integers(n + 1)), cards[i])
    elif kind == "swap":
        j = int(rng.integers(n))
        cards[i], cards[j] = cards[j], cards[i]
    elif kind == "key":
        cards[i] = (some(rng, _STRUCTURE + _ADDED).ljust(8).encode() + cards[i][8:])[:CARD]
    elif kind == "add":
        key = some(rng, _ADDED)
        cards.insert(int(rng.integers(n + 1)), _spelled(key, _value(rng, key)))
    else:
        cards[i] = rng.bytes(CARD)
    text = b"".join(cards) + b"END".ljust(CARD)
    text = text.ljust(-(-len(text) // BLOCK) * BLOCK)
    return content[:start] + text + content[header[1] :]


def _spelled(key, value):
    raw = f"{key:8}= {value:>20}".encode("utf-8", "replace")[:CARD]
    return raw.ljust(CARD).replace(b"\n", b" ")


def _parts(rng, content, headers):
    """Drop, double or move whole HDUs."""
    ends = [start for start, *_ in headers[1:]] + [len(content)]
    parts = [content[start:end] for (start, *_), end in zip(headers, ends, strict=True)]
    i, j = (int(k) for k in rng.integers(len(parts), size=2))
    kind = some(rng, ("drop", "double", "swap", "many", "none"))
    if kind == "drop":
        del parts[i]
    elif kind == "double":
        parts.insert(j, parts[i])
    elif kind == "many":
        parts += [parts[i][:BLOCK]] * 300
    elif kind == "swap":
        parts[i], parts[j] = parts[j], parts[i]
    else:
        parts[i] = parts[i][: headers[i][1] - headers[i][0]]
    return b"".join(parts)


def _numbers(rng, content, headers):
    """Put special numbers into the data behind a header."""
    content = bytearray(content)
    _, end, _ = some(rng, headers)
    if end >= len(content):
        return bytes(content)
    new = np.array(some(rng, (np.nan, np.inf, -np.inf, 1e38, -1e38, -1.0, 0.0, 1e-40)))
    raw = new.astype(some(rng, (">f4", ">f8"))).tobytes() * some(rng, (1, 1, 100, 50_000))
    place = end + 8 * int(rng.integers(max((len(content) - end) // 8, 1)))
    content[place : place + len(raw)] = raw[: len(content) - place]
    return bytes(content)


def _remade(rng, content):
    """Change the arrays as a program would: other shapes, types and compressions."""
    try:
        # what was spoiled before may keep astropy busy for ever
        _walk(io.BytesIO(content), "made up", ValueError, MOST_HDUS, False, end=len(content))
        with fits.open(io.BytesIO(content), memmap=False) as hdus:
            hdus = [hdu.copy() for hdu in hdus]
    except Exception:
        return mutate_bytes(rng, content)
    images = [i for i, hdu in enumerate(hdus) if isinstance(hdu.data, np.ndarray) and hdu.is_image]
    if not images:
        return mutate_bytes(rng, content)
    i = some(rng, images)
    data, kind = hdus[i].data, some(rng, ("type", "cut", "axis", "flat", "none", "packed", "sign"))
    changes = {
        "type": lambda: data.astype(some(rng, (">i2", ">f4", ">f8", "u1", ">i8"))),
        "cut": lambda: data[: int(rng.integers(len(data) + 1))],
        "axis": lambda: data[None],
        "flat": lambda: data.ravel(),
        "none": lambda: None,
        "packed": lambda: data,
        "sign": lambda: -data,
    }
    name, header = hdus[i].name, hdus[i].header
    with np.errstate(all="ignore"):
        new = changes[kind]()
    if i == 0:
        hdus[0] = fits.PrimaryHDU(new, header)
    elif kind == "packed":
        hdus[i] = fits.CompImageHDU(new, name=name)
    else:
        hdus[i] = fits.ImageHDU(new, header, name=name)
    buffer = io.BytesIO()
    try:
        fits.HDUList(hdus).writeto(buffer)
    except Exception:
        return mutate_bytes(rng, content)
    return buffer.getvalue()


def forge_checksums(content):
    """Take the checksums out of the headers, as somebody who edits a file would."""
    for start, end, _ in _headers(content):
        head = content[start:end]
        for key in (b"CHECKSUM=", b"DATASUM ="):
            head = head.replace(key, b"COMMENT  ")
        content = content[:start] + head + content[end:]
    return content
