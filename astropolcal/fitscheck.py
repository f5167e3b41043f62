# Licensed under a 3-clause BSD style license - see LICENSE
"""
What a FITS file claims to hold, looked at before astropy opens it.

A header without an end, or one that claims a billion axes, keeps astropy busy for minutes, and
what is packed may be immense. ``check_fits`` goes from header to header as Sec. 4.4.1 of the FITS
standard 4.0 describes, and adds up what has a checksum on its way; what else is wrong is left for
astropy to say.
"""

import bz2
import gzip
import io
import lzma
import math
import os
import re

import numpy as np

from astropolcal.exceptions import AstropolcalError, ObservationError
from astropolcal.files import understood

__all__ = []

# bytes; all parts of a file are filled up to whole blocks (Sec. 3.1 of the standard)
_BLOCK, _CARD = 2880, 80
_END = b"END".ljust(_CARD)
#: Blocks of a header, 36 cards each: headers of observatories have some thousand cards.
MOST_BLOCKS = 1000
#: Headers of a file.
MOST_HDUS = 1000
# of axes and of columns, by the standard; astropy loops over as many as are claimed
_MOST_CLAIMED = 999
# zeros are packed a thousand times smaller, cubes that are masked in part ten times
_MOST_UNPACKED, _UNPACKED_SHARE = 2**28, 100
_CHUNK = 2**20
_CLAIM = re.compile(rb"(BITPIX|GROUPS|NAXIS\d{0,3}|PCOUNT|GCOUNT|TFIELDS) *= *([+-]?\d{1,70}|T)\b")
# DATASUM and CHECKSUM (Sec. 4.4.2.7); a blank value stands for none
_SUM = re.compile(rb"(DATASUM|CHECKSUM) *= *'? *([^' /]*)")
# ones' complement sums of words of 32 bits are equal modulo this number
_ONES = 2**32 - 1
_PACKINGS = {b"\x1f\x8b": gzip.open, b"BZh": bz2.open, b"\xfd7zXZ": lzma.open}
_NEEDS_MEMORY = (b"\xfd7zXZ",)


def readable_fits(path, error=ObservationError):
    """Turn any failure with a FITS file into one line that names it, see ``understood``."""
    return understood(path, error, "not a readable FITS file")


def open_fits(path, error=ObservationError, *, count=MOST_HDUS, whole=False):
    """Open a FITS file for astropy, at its beginning, after ``check_fits`` with the same arguments.

    Astropy does not close a file that it cannot read, and loses its way in a packed one whose
    headers are damaged: so it is given a file that is open, and unpacked.
    """
    check_fits(path, error, count=count, whole=whole)
    with readable_fits(path, error):
        file = open(path, "rb")
        packing = _packing(file)
        if packing is None:
            return file
        # bounded by the check, if it has been through all of the file
        most = MOST_BLOCKS * _BLOCK if count == 1 else -1
        with file, _PACKINGS[packing](file) as unpacked:
            return io.BytesIO(unpacked.read(most))


def primary_header(path, error=ObservationError):
    """Return the primary header of a FITS file."""
    from astropy.io import fits

    with readable_fits(path, error), open_fits(path, error, count=1) as stream:
        return fits.Header.fromfile(stream)


def check_fits(path, error=AstropolcalError, *, count=MOST_HDUS, whole=False):
    """Refuse a FITS file whose headers would take astropy minutes or all of the memory.

    The file may be packed by gzip, bzip2 or xz; ``count`` HDUs are going to be read, and ``whole``
    refuses data that are claimed and not there. ``error`` is raised if a header has no end, claims
    negative sizes or more axes or columns than the standard allows, what is packed is immense, or
    a ``DATASUM`` or ``CHECKSUM`` does not match.
    """
    with understood(path, error, "not a readable FITS file"), open(path, "rb") as file:
        size, packing = os.path.getsize(path), _packing(file)
        limits = {"most": max(_MOST_UNPACKED, _UNPACKED_SHARE * size)} if packing else {"end": size}
        if packing in _NEEDS_MEMORY:
            # how much its unpacking takes is the choice of who packed it
            lzma.LZMADecompressor(memlimit=_MOST_UNPACKED).decompress(file.read(_CHUNK), 1)
            file.seek(0)
        with _PACKINGS[packing](file) if packing else file as stream:
            # of a file of another kind astropy would have its user try options
            start = stream.read(6)
            if not start:
                raise ValueError("Empty or corrupt FITS file")
            if start != b"SIMPLE":
                raise error(f"{path}: is not a FITS file")
            stream.seek(0)
            _walk(stream, path, error, count, whole, **limits)


def _packing(file):
    """Return by what mark a file begins that is packed, None if it is not."""
    start = file.read(6)
    file.seek(0)
    if start.startswith(b"PK\3\4"):
        # astropy would unpack it to the disk, whatever its size
        raise ValueError("a zip archive: unpack it first")
    return next((mark for mark in _PACKINGS if start.startswith(mark)), None)


def _walk(stream, path, error, count, whole, **limits):
    """Go from header to header, as far as they can be understood."""
    # headers come one by one: where the next begins is known from the sizes in the one before
    for number in range(count):
        claims = _header(stream, number)
        if claims is None:
            return
        size, last = _data_size(claims), number + 1 == count < MOST_HDUS
        if last:
            # of data that are not read the sum is what the header says
            wrong = _wrong_sum(claims, None if size else 0)
        else:
            there, data = _skip(stream, size, bool(claims["sums"]), **limits)
            if not there and whole:
                raise ValueError(f"truncated: the data of HDU {number} are not whole")
            if not there:
                return
            wrong = _wrong_sum(claims, data)
        if wrong:
            raise error(
                f"{path}: {wrong} in HDU {number}: it was changed after it was written, is "
                "damaged, or has the header of another file"
            )
        if last:
            return
    if stream.read(1):
        raise ValueError(f"more than {MOST_HDUS} HDUs")


def _wrong_sum(claims, data):
    """Return which checksum does not match header and data, of which the sum may not be known."""
    stated, checksum = (claims["sums"].get(key, "") for key in ("DATASUM", "CHECKSUM"))
    good = stated.isdecimal()
    if stated and not (good and data in (None, int(stated) % _ONES)):
        return f"DATASUM = {stated!r} does not match the data"
    data = int(stated) % _ONES if good else data
    if checksum and data is not None and (claims["own"] + data) % _ONES:
        return f"CHECKSUM = {checksum!r} does not match"
    return ""


def _sum(content):
    """Return the ones' complement sum of big-endian words of 32 bits."""
    return int(np.frombuffer(content, ">u4").sum(dtype=np.uint64)) % _ONES


def _header(stream, number):
    """Return what a header claims of sizes and sums, and its own sum; None if there is none."""
    claims, sums, own = {}, {}, 0
    for _ in range(MOST_BLOCKS):
        block = stream.read(_BLOCK)
        if len(block) < _BLOCK:
            return None
        own += _sum(block)
        for place in range(0, _BLOCK, _CARD):
            # to astropy a card such as "END = 0" is none
            if block[place : place + _CARD] == _END:
                return claims | {"sums": sums, "own": own}
            found = _CLAIM.match(block, place, place + _CARD)
            if found:
                _add(claims, found[1].decode(), found[2], number)
            found = _SUM.match(block, place, place + _CARD)
            if found and found[2]:
                sums.setdefault(found[1].decode(), found[2].decode("latin-1"))
    raise ValueError(f"header {number} has no end within {MOST_BLOCKS * _BLOCK // _CARD} cards")


def _add(claims, key, text, number):
    value = 1 if text == b"T" else int(text)
    # data of a negative size lead astropy back to the same header, for ever
    if value < 0 and key != "BITPIX":
        raise ValueError(f"{key} = {value} in header {number}, which must not be negative")
    if key in ("NAXIS", "TFIELDS") and value > _MOST_CLAIMED:
        raise ValueError(f"{key} = {value} in header {number}, up to {_MOST_CLAIMED} are allowed")
    # of two cards of one keyword the first counts, for astropy too
    claims.setdefault(key, value)


def _data_size(claims):
    """Return the bytes of the data, Eqs. (1) and (2) of the standard, filled up to blocks."""
    axes = [claims.get(f"NAXIS{i + 1}", 0) for i in range(claims.get("NAXIS", 0))]
    if not axes:
        # without axes there are no data, whatever else is claimed
        return 0
    # the first axis of random groups is written as zero, and does not count
    numbers = claims.get("PCOUNT", 0) + math.prod(axes[1:] if "GROUPS" in claims else axes)
    bits = abs(claims.get("BITPIX", 8)) * claims.get("GCOUNT", 1) * numbers
    return -(-bits // (8 * _BLOCK)) * _BLOCK


def _skip(stream, size, summed, end=None, most=None):
    """Pass over data; return whether they are there, and their sum if it is wanted."""
    target = stream.tell() + size
    if most is not None and target > most:
        # before it is done: unpacking a gigabyte of zeros takes seconds
        raise ValueError(f"it would unpack to {target} bytes, up to {most} are allowed")
    if end is not None and not summed:
        stream.seek(min(target, end))
        return target <= end, None
    total = 0
    while (left := target - stream.tell()) > 0:
        chunk = stream.read(min(_CHUNK, left))
        if not chunk or len(chunk) % 4:
            return False, None
        total += _sum(chunk) if summed else 0
    return True, total % _ONES
