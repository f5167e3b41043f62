# Licensed under a 3-clause BSD style license - see LICENSE
"""Headers that are refused before astropy opens the file, and those that must not be."""

import bz2
import gzip
import io
import lzma
import re
import time
import warnings
import zipfile
import zlib

import numpy as np
import pytest
from astropy.io import fits

from astropolcal.exceptions import AstropolcalError, ObservationError
from astropolcal.fitscheck import (
    MOST_BLOCKS,
    MOST_HDUS,
    check_fits,
    open_fits,
    primary_header,
    readable_fits,
)

PACKERS = {"plain": bytes, "gzip": gzip.compress, "bzip2": bz2.compress, "xz": lzma.compress}


def block(*cards):
    """Return a header of raw cards, filled up to a whole block."""
    return b"".join(card.ljust(80).encode() for card in cards).ljust(2880)


SIMPLE = "SIMPLE  =                    T"
NOTHING = (SIMPLE, "BITPIX  =                    8", "NAXIS   =                    0")


def stored(tmp_path, content):
    path = tmp_path / "some.fits"
    path.write_bytes(content)
    return path


def refused(path, words, **options):
    with pytest.raises(ObservationError, match=words) as caught:
        check_fits(path, ObservationError, **options)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def of_astropy(*hdus):
    buffer = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(buffer)
    return buffer.getvalue()


def groups():
    """Return 100 random groups of 3 + 5 x 2 numbers; their first axis is zero and not counted."""
    axes = [f"NAXIS{i + 1}  = {n:20}" for i, n in enumerate((0, 5, 2))]
    counts = [f"{key:8}= {value:>20}" for key, value in (("PCOUNT", 3), ("GCOUNT", 100))]
    first = block(
        SIMPLE,
        "BITPIX  =                  -32",
        "NAXIS   =                    3",
        *axes,
        "GROUPS  =                    T",
        *counts,
        "END",
    )
    # 100 x 13 x 4 bytes are not quite two blocks
    return first + b"\0" * 5760 + of_astropy(fits.ImageHDU(np.ones(7)))[2880:]


def table(rows=5):
    """Return a table with a heap, whose bytes are counted by PCOUNT."""
    lists = np.array([np.arange(n, dtype=float) for n in range(rows)], dtype=object)
    columns = [
        fits.Column("a", "D", array=np.arange(rows)),
        fits.Column("b", "PD()", array=lists),
    ]
    return fits.BinTableHDU.from_columns(columns)


GOOD = {
    "nothing": of_astropy(),
    "images": of_astropy(fits.ImageHDU(np.ones((3, 70, 11), "i2")), fits.ImageHDU(np.ones(1))),
    "table with a heap": of_astropy(table(), fits.ImageHDU(np.ones(1000))),
    "table without rows": of_astropy(table(0), fits.ImageHDU(np.ones(3))),
    "compressed image": of_astropy(fits.CompImageHDU(np.arange(900, dtype="i4").reshape(30, 30))),
    "random groups": groups(),
}


# ---- checksums ---------------------------------------------------------------------------


def test_checksums_that_do_not_match_are_refused(tmp_path):
    """Each bit counts, in all kinds of HDUs; without the keywords, or a value, nothing does."""
    for packer in PACKERS:
        buffer = io.BytesIO()
        image = np.arange(2000, dtype="i2").reshape(40, 50)
        hdus = [fits.ImageHDU(image), fits.CompImageHDU(image), fits.ImageHDU(image.astype("u2"))]
        hdus = [fits.PrimaryHDU(), *hdus, fits.BinTableHDU(np.array([(1, 2.0)], dtype="i4,f8"))]
        fits.HDUList(hdus).writeto(buffer, checksum=True)
        good = buffer.getvalue()
        path = stored(tmp_path, PACKERS[packer](good))
        check_fits(path, ObservationError, whole=True)
        with fits.open(io.BytesIO(good)) as opened:
            places = [(i, h.fileinfo()) for i, h in enumerate(opened)]
        for number, info in places:
            for place, keyword, read in (
                (info["datLoc"] + 1, "DATASUM = '.*' does not match the data", None),
                (info["datLoc"] - 1, "CHECKSUM = '.*' does not match", number + 1),
            ):
                # the primary HDU has no data
                if read is None and not info["datSpan"]:
                    continue
                spoiled = bytearray(good)
                spoiled[place] ^= 2
                stored(tmp_path, PACKERS[packer](bytes(spoiled)))
                refused(path, f"{keyword} in HDU {number}: it was changed")
                if read is not None:
                    refused(path, f"{keyword} in HDU {number}", count=read)
        blank = re.sub(rb"(?<=M= ')[^']{16}|(?<=M = ')\d*", lambda m: b" " * len(m[0]), good)
        absent = good.replace(b"CHECKSUM=", b"CHECKSUN=").replace(b"DATASUM =", b"DATASUN =")
        for content in (blank, absent):
            assert content != good, packer
            check_fits(stored(tmp_path, PACKERS[packer](content)), ObservationError, whole=True)


# ---- files that are good ---------------------------------------------------------------


def test_good_files_pass(tmp_path):
    for packer in PACKERS:
        for name in GOOD:
            check_fits(stored(tmp_path, PACKERS[packer](GOOD[name])), ObservationError, whole=True)


def test_each_header_is_found(tmp_path):
    """Sizes of data are those of astropy: else what follows them would be missed."""
    for packer in PACKERS:
        for name in GOOD:
            with fits.open(io.BytesIO(GOOD[name])) as hdus:
                n = len(hdus)
            content = GOOD[name] + block("XTENSION= 'IMAGE   '", "NAXIS   = 5000", "END")
            refused(
                stored(tmp_path, PACKERS[packer](content)), f"NAXIS = 5000 in header {n}, up to 999"
            )


def test_data_that_are_cut_off(tmp_path):
    """The last block of data is missing: only who needs all of them minds."""
    for packer in PACKERS:
        for name in sorted(set(GOOD) - {"nothing"}):
            path = stored(tmp_path, PACKERS[packer](GOOD[name][:-2880]))
            check_fits(path, ObservationError)
            refused(path, r"truncated: the data of HDU \d are not whole", whole=True)


def test_which_data_are_cut_off(tmp_path):
    two = of_astropy(fits.ImageHDU(np.ones(3)), fits.ImageHDU(np.ones((40, 40))))
    refused(stored(tmp_path, two[:-100]), "the data of HDU 2 are not whole", whole=True)


def test_only_headers_that_are_wanted_are_looked_at(tmp_path):
    bad = of_astropy(fits.ImageHDU(np.ones(3))) + block("XTENSION= 'IMAGE   '", "NAXIS   = 5000")
    path = stored(tmp_path, bad)
    for count in (1, 2):
        check_fits(path, ObservationError, count=count)
    refused(path, "NAXIS = 5000 in header 2, up to 999 are allowed", count=3)


def test_files_of_another_kind(tmp_path):
    for packer in PACKERS:
        for content in [b"no FITS file", b"x" * 100_000, block("XTENSION= 'A'")]:
            refused(stored(tmp_path, PACKERS[packer](content)), r"some.fits: is not a FITS file$")


def test_remains_behind_the_last_part_do_no_harm(tmp_path):
    """Some programs fill files up; astropy ignores it."""
    path = stored(tmp_path, GOOD["images"] + b"\0" * 28800)
    check_fits(path, ObservationError, whole=True)
    with pytest.warns(match="extra padding"), fits.open(path) as file:
        assert len(file) == 3


def test_the_first_of_two_cards_of_one_keyword_counts(tmp_path):
    for first, later, blocks in [(0, 7000, 0), (3, 0, 1), (2881, 1, 2)]:
        axes = "NAXIS   = 1", f"NAXIS1  = {first}", f"NAXIS1  = {later}"
        content = block(SIMPLE, "BITPIX  = 8", *axes, "END") + b"\0" * 2880 * blocks
        content += block("XTENSION= 'IMAGE   '", "NAXIS   = 5000", "END")
        refused(stored(tmp_path, content), "NAXIS = 5000 in header 1")


def test_a_card_that_only_begins_like_the_end(tmp_path):
    content = block(SIMPLE, "BITPIX  = 8", "NAXIS   = 1", "END     = -0.0", "NAXIS1  = -1", "END")
    refused(stored(tmp_path, content), "NAXIS1 = -1 in header 0, which must not be negative")


def test_without_axes_there_are_no_data(tmp_path):
    """Whatever is claimed: astropy goes on behind the header, and so must this."""
    content = block(*NOTHING, "PCOUNT  = 8", "GCOUNT  = 5", "END")
    content += block("XTENSION= 'IMAGE   '", "NAXIS   = 5000", "END")
    refused(stored(tmp_path, content), "NAXIS = 5000 in header 1")


# ---- files that are not -----------------------------------------------------------------


def test_more_axes_or_columns_than_there_can_be(tmp_path):
    for packer in PACKERS:
        for key in ["NAXIS", "TFIELDS"]:
            for value in ["1000", "9" * 19, "9" * 70, "+5000", "1000 / of axes"]:
                content = block(SIMPLE, f"{key:8}= {value:>20}", "END")
                number = value.split()[0].lstrip("+")
                refused(
                    stored(tmp_path, PACKERS[packer](content)),
                    rf"not a readable FITS file: {key} = {number} in header 0, up to 999 are",
                )


def test_as_many_axes_as_the_standard_allows(tmp_path):
    check_fits(stored(tmp_path, block(SIMPLE, "NAXIS   = 999", "END")), ObservationError)


def test_a_header_that_never_ends(tmp_path):
    """It is refused as soon as it is too long, however long it is."""
    content = block(*NOTHING) * (MOST_BLOCKS + 1)
    refused(stored(tmp_path, content), rf"header 0 has no end within {MOST_BLOCKS * 36} cards")


def test_the_longest_header(tmp_path):
    content = block(*NOTHING) * (MOST_BLOCKS - 1) + block(*NOTHING, "END")
    check_fits(stored(tmp_path, content), ObservationError)


def test_zeros_behind_a_packed_file_take_no_time(tmp_path):
    """Fifty megabytes, which are fifty kilobytes in the file."""
    content = gzip.compress(GOOD["images"]) + gzip.compress(b"\0" * 50_000_000, 1)
    path = stored(tmp_path, content)
    start = time.process_time()
    refused(path, r"header 3 has no end within \d+ cards")
    assert time.process_time() - start < 2


def test_too_many_parts(tmp_path):
    part = block("XTENSION= 'IMAGE   '", "BITPIX  = 8", "NAXIS   = 0", "END")
    check_fits(stored(tmp_path, block(*NOTHING, "END") + part * (MOST_HDUS - 1)), ObservationError)
    path = stored(tmp_path, block(*NOTHING, "END") + part * MOST_HDUS)
    refused(path, f"more than {MOST_HDUS} HDUs")


def test_packed_data_that_would_be_immense(tmp_path):
    for packer in ["gzip", "bzip2", "xz"]:
        axes = [f"NAXIS{i}  =           1000000" for i in (1, 2)]
        content = block(SIMPLE, "BITPIX  = 64", "NAXIS   = 2", *axes, "END")
        refused(
            stored(tmp_path, PACKERS[packer](content)),
            r"it would unpack to 80000000\d+ bytes, up to 268435456 are allowed",
        )


def test_plain_data_that_would_be_immense_are_only_cut_off(tmp_path):
    """The size of a plain file bounds what is read of it."""
    axes = [f"NAXIS{i}  =  9223372036854775807" for i in (1, 2)]
    path = stored(tmp_path, block(SIMPLE, "BITPIX  = 64", "NAXIS   = 2", *axes, "END"))
    check_fits(path, ObservationError)
    refused(path, "the data of HDU 0 are not whole", whole=True)


def test_negative_sizes_would_lead_back_for_ever(tmp_path):
    for key in ["NAXIS", "NAXIS1", "NAXIS17", "PCOUNT", "GCOUNT", "TFIELDS"]:
        content = block(
            SIMPLE, "BITPIX  = -32", "NAXIS   = 1", "NAXIS1  = 3", f"{key:8}= -1", "END"
        )
        refused(stored(tmp_path, content), f"{key} = -1 in header 0, which must not be negative")


def test_strange_sizes_do_not_stop_the_walk(tmp_path):
    for value in ["T", "'3'", "4.5"]:
        content = block(SIMPLE, "BITPIX  = 8", "NAXIS   = 1", f"NAXIS1  = {value}", "END")
        check_fits(stored(tmp_path, content + b"\0" * 2880), ObservationError)


def test_a_packed_file_whose_unpacking_takes_all_memory(tmp_path):
    """Of xz it is the writer who decides how much memory the reader needs."""
    packed = bytearray(lzma.compress(GOOD["nothing"]))
    check_fits(stored(tmp_path, bytes(packed)), ObservationError)
    # the filter 0x21, LZMA2, has one byte of properties: 38 stands for a dictionary of 2 GiB
    packed[packed.index(b"\x21\x01", 12) + 2] = 38
    # the header of the block begins at byte 12 with its length, and ends with its own CRC
    start, end = 12, 12 + 4 * packed[12]
    packed[end : end + 4] = zlib.crc32(packed[start:end]).to_bytes(4, "little")
    refused(stored(tmp_path, bytes(packed)), "not a readable FITS file: .*[Mm]emory")


def test_packed_files_that_are_damaged(tmp_path):
    for packer in ["gzip", "bzip2", "xz"]:
        packed = PACKERS[packer](GOOD["images"])
        refused(stored(tmp_path, packed[:60]), "not a readable FITS file")


def test_archives_are_not_unpacked_to_the_disk(tmp_path):
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("a.fits", GOOD["images"])
    refused(stored(tmp_path, buffer.getvalue()), "a zip archive: unpack it first")


# ---- the door ---------------------------------------------------------------------------


def test_what_is_no_file_of_this_kind(tmp_path):
    for make, words in [
        (lambda path: None, "no such file"),
        (lambda path: path.mkdir(), "is a folder, not a file"),
        (lambda path: path.write_text("a text"), "is not a FITS file"),
        (lambda path: path.write_bytes(b""), "Empty or corrupt FITS file"),
    ]:
        path = tmp_path / f"{len(words)}.fits"
        make(path)
        for opened in (check_fits, open_fits, primary_header):
            with pytest.raises(ObservationError, match=words):
                opened(path, ObservationError)


def test_astropy_reads_what_is_opened(tmp_path):
    for packer in PACKERS:
        for name in GOOD:
            path = stored(tmp_path, PACKERS[packer](GOOD[name]))
            with open_fits(path) as stream:
                assert stream.read() == GOOD[name], (packer, name)
                stream.seek(0)
                with fits.open(stream) as hdus, fits.open(io.BytesIO(GOOD[name])) as expected:
                    assert len(hdus) == len(expected), (packer, name)
                    # astropy adds cards of its own to some
                    known = dict(expected[0].header)
                    assert {key: known[key] for key in primary_header(path)} == dict(
                        primary_header(path)
                    ), (packer, name)
            # a file is mapped, what was packed is in memory
            assert isinstance(stream, io.BytesIO) is (packer != "plain"), (packer, name)
            assert stream.closed, (packer, name)


def test_a_header_alone_of_an_immense_packed_file(tmp_path):
    """Of a packed raw frame not more is unpacked than a header can have."""
    header = block(*NOTHING[:2], "NAXIS   = 1", "NAXIS1  = 90000000000", "RET-ANG1= 22.5", "END")
    path = stored(tmp_path, gzip.compress(header + b"\0" * 5_000_000))
    assert primary_header(path)["RET-ANG1"] == 22.5
    with open_fits(path, count=1) as stream:
        assert len(stream.read()) == MOST_BLOCKS * 2880
    refused(path, "it would unpack to")


def test_a_damaged_card_in_a_packed_file_does_not_lead_back(tmp_path):
    """Astropy takes the size of the packed file for that of what is in it."""
    for card in ["GROUPS  = 'x", "XTENSION= IMAGE", "SIMPLE  = ="]:
        part = block("XTENSION= 'IMAGE   '", card, "BITPIX  = 8", "NAXIS   = 0", "END")
        path = stored(tmp_path, gzip.compress(block(*NOTHING, "END") + part))
        start = time.process_time()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with readable_fits(path), open_fits(path) as stream, fits.open(stream) as hdus:
                assert len(hdus) <= 3, card
        assert time.process_time() - start < 2, card


def test_other_errors_of_the_block(tmp_path):
    path = stored(tmp_path, GOOD["images"])
    with pytest.raises(ObservationError, match=r"some.fits: not a readable FITS file: IndexError"):
        with readable_fits(path):
            [][1]
    with pytest.raises(AstropolcalError, match=r"^as it is$"), readable_fits(path):
        raise AstropolcalError("as it is")
    with pytest.raises(AstropolcalError) as caught, readable_fits(path, AstropolcalError):
        raise OSError(5, "Input/output error")
    assert type(caught.value) is AstropolcalError
