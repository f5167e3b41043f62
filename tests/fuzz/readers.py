# Licensed under a 3-clause BSD style license - see LICENSE
"""
Everything that reads a file: good files, ways to spoil them, and what is right.

A reader gives an object or raises a subclass of `AstropolcalError`. What it gives
is looked at by ``check``, which fails where the object is not what the file says.
"""

import dataclasses
import io
import json
import re
import tempfile
import warnings
from contextlib import suppress
from functools import lru_cache
from pathlib import Path

import astropy.units as u
import numpy as np

from astropolcal import Calibration, calibrate, instruments, optics
from astropolcal.exceptions import AstropolcalError
from astropolcal.simulation import half_wave_plate_cycles, simulate
from tests.fuzz import binary, mutate

__all__ = ["READERS", "Reader", "keep_schemas"]

WAVELENGTH = [1.2, 1.6, 2.2] * u.um


class Reader:
    """
    A way into the package.

    ``seeds`` are good files by name, ``mutate`` spoils one, ``read`` reads it back,
    and ``check`` raises an `AssertionError` if what it gave is not valid.
    """

    suffix = ".dat"

    def seeds(self):
        """Return good files by name."""
        raise NotImplementedError

    def mutate(self, rng, content):
        """Return a spoiled file."""
        kinds = (mutate.mutate_bytes, mutate.mutate_words)
        return mutate.some(rng, kinds)(rng, content)

    def read(self, path):
        """Return what the package makes of a file."""
        raise NotImplementedError

    def check(self, found, path):
        """Raise if what was read is not valid."""


def _written(write, suffix):
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"good{suffix}"
        write(path)
        return path.read_bytes()


@lru_cache(maxsize=1)
def lab():
    """Return a small chain and observations of it."""
    chain = (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer")
        | optics.TwoLayerWaveplate(
            w_sio2=1.65 * u.mm, w_mgf2=1.29 * u.mm, mount="hwp", name="hwp", fixed={"theta": False}
        )
        | optics.LinearRetarder(
            retardance=[-220, -110, -57] * u.deg, mount="derotator", name="derotator"
        )
        | optics.WollastonPrism(efficiency=[0.97, 0.98, 0.99], name="wollaston")
    )
    frames = half_wave_plate_cycles(derotator=[45, 60, 80, 100] * u.deg)
    meta = {"date": "2025-05-01", "instrument": "bench"}
    return chain, simulate(chain, WAVELENGTH, frames, seed=1, meta=meta, name="night")


@lru_cache(maxsize=1)
def calibration():
    """Return a calibration with ties, priors and stages."""
    from astropolcal.measurement import Normal, Tie

    chain, data = lab()
    chain = chain.copy()
    chain["hwp"].w_sio2.prior = Normal(1.65 * u.mm, 0.1 * u.mm)
    ties = {"derotator.theta": Tie("hwp.theta", 0.5, 0.1 * u.deg)}
    return calibrate(chain, data, strategy="two-step", ties=ties, instrument="bench")


@lru_cache(maxsize=1)
def sampled():
    """Return a calibration with samples."""
    from astropolcal.calibration.posterior import Posterior

    cal = calibration()
    names = ["hwp.w_sio2", "derotator.retardance[1]"]
    places = [cal.covariance.names.index(name) for name in names]
    chain = np.random.default_rng(3).normal(size=(300, 8, 2)) * cal.covariance.stds[places]
    posterior = Posterior(
        names,
        [cal.covariance.units[i] for i in places],
        chain,
        -0.5 * np.sum(chain**2, axis=2),
        acceptance=np.linspace(0.2, 0.3, 8),
        fitted=np.zeros(2),
        thin=2,
        seed=5,
        settings={"noise": {"from": "given", "least": 1e-5}, "moves": [["DEMove", 0.8]]},
    )
    return dataclasses.replace(cal, posterior=posterior)


# ---- calibrations ------------------------------------------------------------------


def keep_schemas():
    """Let ASDF parse its schemas once in this process, which is most of the time of reading."""
    import asdf.schema

    real, known = asdf.schema._make_schema_loader, {}

    def make():
        load = real()

        def kept(url):
            if url not in known:
                known[url] = load(url)
            return known[url]

        return kept

    asdf.schema._make_schema_loader = make


class CalibrationFile(Reader):
    """Calibration files."""

    suffix = ".asdf"
    _handle = {"!": "tag:stsci.edu:asdf/"}
    _strange = (
        *("tag:stsci.edu:asdf/core/ndarray-1.1.0", "tag:stsci.edu:asdf/core/external_data-1.0.0"),
        *("tag:stsci.edu:asdf/core/complex-1.0.0", "tag:stsci.edu:asdf/unit/quantity-1.2.0"),
        *("tag:stsci.edu:asdf/core/integer-1.1.0", "tag:stsci.edu:asdf/core/asdf-1.1.0"),
        "tag:astropolcal.org:astropolcal/calibration-1.0.0",
        *(f"tag:astropolcal.org:astropolcal/optics/{n}-1.0.0" for n in ("rotator", "kmirror", "x")),
        *("tag:yaml.org,2002:binary", "tag:yaml.org,2002:set", "tag:yaml.org,2002:timestamp"),
        "tag:yaml.org,2002:python/object/new:subprocess.Popen",
    )

    def seeds(self):
        return {
            "calibration": _written(calibration().write, self.suffix),
            "posterior": _written(sampled().write, self.suffix),
        }

    def mutate(self, rng, content):
        kinds = (mutate.mutate_bytes, mutate.mutate_words, self._tree, self._tree, self._block)
        return mutate.some(rng, kinds)(rng, content)

    def _parts(self, content):
        start, end = content.index(b"--- "), content.index(b"\n...\n")
        return content[:start], content[start:end], content[end:]

    def _tree(self, rng, content):
        head, tree, rest = self._parts(content)
        tree = b"%TAG ! tag:stsci.edu:asdf/\n" + tree
        new = mutate.mutate_yaml(rng, tree, self._handle, self._strange)
        # the emitter writes the handles itself, or none
        mark = new.find(b"--- ")
        new = new[mark:] if mark >= 0 else b"--- " + new
        return head + new.removesuffix(b"...\n").rstrip(b"\n") + rest

    def _block(self, rng, content):
        """Change the heads of the binary blocks."""
        place = content.find(b"\xd3BLK")
        if place < 0:
            return self._tree(rng, content)
        rest = content[place : place + 60]
        new = mutate.mutate_bytes(rng, rest)
        return content[:place] + new + content[place + 60 :]

    def read(self, path):
        return Calibration.read(path)

    def check(self, found, path):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            expected = calibration() if found.posterior is None else sampled()
            assert found.to_dict() == expected.to_dict(), "numbers differ from those written"
            assert _digest(found) == _digest(expected), "content differs from that written"
            assert found.summary() == expected.summary()


def _digest(cal):
    from astropolcal.converters.calibration import node_from_calibration

    return node_from_calibration(cal)["checksum"]


def _content(node):
    """Return what the node of a calibration says, whatever type its numbers have."""
    from astropolcal.converters.calibration import _DERIVED
    from astropolcal.converters.nodes import _spelled

    def plain(value):
        if isinstance(value, dict) and set(value) == {"float"}:
            return float.fromhex(value["float"])
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        if type(value) is int:
            return float(value) if abs(value) < 2**1000 and float(value) == value else value
        return [plain(item) for item in value] if isinstance(value, list) else value

    found = plain(_spelled({k: v for k, v in node.items() if k not in _DERIVED}))
    # nothing in a list is as good as no list
    found = {k: v for k, v in found.items() if k != "priors" or v}
    for key in ("near_null", "branches"):
        if not found.get("identifiability", {}).get(key, True):
            del found["identifiability"][key]
    factor = found.get("covariance", {}).get("factor")
    if factor is not None and 0 in factor.get("shape", []):
        del found["covariance"]["factor"]
    # worked out again from the samples
    for key in ("words", "converged", "kept"):
        found.get("posterior", {}).pop(key, None)
    return json.dumps(found, sort_keys=True)


class ForgedCalibration(CalibrationFile):
    """
    Calibration files whose checksum was made anew after they were changed.

    What is read must be what the file says, to the last bit.
    """

    def mutate(self, rng, content):
        kinds = (mutate.mutate_words, self._tree, self._tree, self._tree)
        return mutate.some(rng, kinds)(rng, content)

    def read(self, path):
        from astropolcal.converters import calibration as converter

        stated, real = [], converter._checksum

        def forged(node):
            stated.append(_content(node))
            return node["checksum"]

        converter._checksum = forged
        try:
            found = Calibration.read(path)
        finally:
            converter._checksum = real
        return found, stated[0]

    def check(self, found, path):
        from astropolcal.converters.calibration import node_from_calibration

        cal, stated = found
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            try:
                again = _content(node_from_calibration(cal))
            except AstropolcalError as error:
                raise AssertionError(f"was read, but cannot be written: {error}") from error
            if cal.settings.get("validity") is None or "1.0.0" not in path.read_text("latin-1"):
                assert again == stated, "what was read is not what the file says"
            _use(cal)


def _use(cal):
    """Ask a calibration for all that it tells; only errors of ours may come."""
    from astropolcal.chain import system_mueller

    for ask in (repr, lambda c: c.summary(), lambda c: c.to_dict(), lambda c: c.accuracy):
        ask(cal)
    try:
        matrix = system_mueller(
            cal.chain, cal.wavelength, {m: [10.0, 20.0] * u.deg for m in ("hwp", "derotator")}
        )
    except AstropolcalError:
        return
    assert np.isfinite(matrix).all(), "the system Mueller matrix is not finite"


class Loaded(ForgedCalibration):
    """Forged calibrations in a library, from which a pipeline loads."""

    def read(self, path):
        from astropolcal.pipeline import load

        real = super().read(path)
        positions = {name: [10.0, 20.0] * u.deg for name in ("hwp", "derotator")}
        return (*real, load(real[0]).system_mueller(positions=positions, light="internal"))

    def check(self, found, path):
        found = found[2]
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert np.isfinite(found.value).all()
            assert np.abs(found.value).max() < 1e6
            assert not (found.std < 0).any()
            assert found.covariance.shape[-2:] == (16, 16)


class Index(Reader):
    """Indexes of libraries, half of them with a checksum that was made anew."""

    suffix = ".json"
    _state = (100, 1, 2, 3, True)

    def seeds(self):
        from astropolcal.pipeline import library

        quality = {"datasets": "night", "s_res": 0.1, "s_cv": None, "converged": True}
        files = {}
        for i, optics_in in enumerate((None, [["nbs"], []], [["nbs"]])):
            held = {"instrument": "bench", "mode": "J", "valid_from": f"202{i}-01-01"}
            held |= {"valid_until": f"202{i + 2}-05-01T10:00:00.000", "optics_in": optics_in}
            record = {"state": list(self._state), "validity": held, "content_hash": f"{i}" * 64}
            files[f"{i}.asdf"] = record | {"quality": quality, "supersedes": ["0" * 64] * (i == 2)}
        return {"index": json.dumps(library._index(files)).encode()}

    def mutate(self, rng, content):
        kinds = (mutate.mutate_bytes, mutate.mutate_words, mutate.mutate_json, mutate.mutate_json)
        return self._signed(rng, mutate.some(rng, kinds)(rng, content))

    def _signed(self, rng, content):
        from astropolcal.pipeline import library

        try:
            files = json.loads(content)["files"]
            return json.dumps(library._index(files)).encode() if rng.random() < 0.7 else content
        except (ValueError, LookupError, TypeError, RecursionError):
            return content

    def read(self, path):
        from astropolcal.pipeline import library

        real, library._INDEX = library._INDEX, path.name
        try:
            told = library._read_index(path.parent, 3)
        finally:
            library._INDEX = real
        found = [library._entry(Path(name), one, self._state) for name, one in told.items()]
        if None in found or not found:
            raise AstropolcalError("not relied on")
        return found

    def check(self, found, path):
        from astropolcal.pipeline import Library

        for wanted in ({}, {"date": "2022-02-03"}, {"mode": "J", "optics_in": ["nbs"]}):
            library = Library([])
            library.entries = list(found)
            assert len(library.table()) == len(found)
            library.overlaps()
            # the files are not there
            with suppress(AstropolcalError):
                raise AssertionError(f"found {library.find('bench', **wanted)}")


# ---- tables ------------------------------------------------------------------------


class Table(Reader):
    """Observation tables."""

    suffix = ".ecsv"

    def seeds(self):
        from astropolcal.observations import example_table

        _, data = lab()
        stars = simulate(
            instruments.get("charis").chain(derotator="linear", wavelength=WAVELENGTH),
            WAVELENGTH,
            half_wave_plate_cycles(derotator=[45, 60] * u.deg),
            seed=2,
            meta={"instrument": "charis"},
        )
        single = io.StringIO()
        example_table().write(single, format="ascii.ecsv")
        return {
            "lab": _written(data.write, self.suffix),
            "charis": _written(stars.write, self.suffix),
            "example": single.getvalue().encode(),
            "single": _SINGLE.encode(),
        }

    def mutate(self, rng, content):
        kinds = (mutate.mutate_bytes, mutate.mutate_words, self._header, self._cells)
        return mutate.some(rng, kinds)(rng, content)

    def _header(self, rng, content):
        lines = content.split(b"\n")
        n = next((i for i, line in enumerate(lines) if not line.startswith(b"#")), len(lines))
        n = max(n, 3)
        text = b"\n".join(line[2:] for line in lines[2:n])
        new = mutate.mutate_yaml(rng, text, strange=("!astropy.table.SerializedColumn", "!!omap"))
        marked = [b"# " + line for line in new.split(b"\n")]
        return b"\n".join([*lines[:2], *marked, *lines[n:]])

    def _cells(self, rng, content):
        lines = content.split(b"\n")
        n = next((i for i, line in enumerate(lines) if not line.startswith(b"#")), 0)
        rest = mutate.mutate_cells(rng, b"\n".join(lines[n:]), b" ")
        return b"\n".join([*lines[:n], rest])

    def read(self, path):
        from astropolcal import Observations

        return Observations.read(path)

    def check(self, found, path):
        from astropolcal import Observations

        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _check_observations(found)
            copy = path.with_name("copy.ecsv")
            found.write(copy, overwrite=True)
            again = Observations.read(copy)
            copy.unlink()
        assert again.content_hash == found.content_hash, "another table when it is written again"


def _check_observations(found):
    good = ~found.mask
    assert good.any()
    for beam in (found.flux_right, found.flux_left):
        assert np.isfinite(beam[good]).all()
        assert (beam[good] > 0).all()
        assert np.isnan(beam[found.mask]).all()
    for variance in (found.variance_right, found.variance_left):
        assert not (variance < 0).any()
    assert (found.wavelength.to_value(u.um) > 0).all()
    for column in ("hwp", "derotator"):
        assert np.isfinite(found.position(column)).all()
    repr(found), found.summary(), found.frames
    try:
        found.pairs()
    except AstropolcalError:
        pass


_SINGLE = """# %ECSV 1.0
# ---
# datatype:
# - {name: hwp, unit: deg, datatype: float64}
# - {name: derotator, unit: deg, datatype: float64}
# - {name: flc_state, datatype: string}
# - {name: single_difference, unit: adu, datatype: float64}
# - {name: single_sum, unit: adu, datatype: float64}
# meta: {instrument: VAMPIRES, filter: 625-50}
# schema: astropy-2.0
hwp derotator flc_state single_difference single_sum
0.0 90.0 A 10.0 100.0
0.0 90.0 B -9.0 101.0
45.0 90.0 A 8.0 100.0
45.0 90.0 B -11.0 99.0
"""


class Exported(Table):
    """Exported tables of Mueller matrices, and any other ECSV table."""

    def seeds(self):
        from astropolcal.pipeline import load, mueller_table, write_mueller

        positions = {name: [10.0, 20.0] * u.deg for name in ("hwp", "derotator")}
        table = mueller_table(load(calibration()), positions=positions, light="internal")
        return {"mueller": _written(lambda path: write_mueller(table, path), self.suffix)}

    def read(self, path):
        from astropolcal.observations.reading import read_ecsv

        return read_ecsv(path)

    def check(self, found, path):
        assert len(found.colnames) > 0


class Spectra(Table):
    """Spectra of a target."""

    def seeds(self):
        from astropy.table import QTable

        from astropolcal.reduction.spectrum import spectra_from_table, write_spectra

        n = np.arange(1, 6)
        table = QTable({"wavelength": n * u.um, "intensity": n * u.adu, "intensity_err": n * u.adu})
        for name in ("q", "u"):
            table[name], table[f"{name}_err"] = n / 100, n / 1000
        spectra = spectra_from_table(table)
        return {"spectra": _written(lambda path: write_spectra(spectra, path), self.suffix)}

    def read(self, path):
        from astropolcal.reduction.spectrum import read_spectra

        return read_spectra(path)

    def check(self, found, path):
        assert {"I", "q", "u"} <= set(found)
        for name, spectrum in found.items():
            error = spectrum.uncertainty.array[~np.asarray(spectrum.mask)]
            assert not (error < 0).any(), f"negative errors of {name}"
            assert (np.diff(spectrum.spectral_axis.value) > 0).all()


class Csv(Reader):
    """Tables of another program."""

    suffix = ".csv"

    def seeds(self):
        head = "filepath,D_IMRANG,RET-ANG1,p,a,LCOUNTS,RCOUNTS,sum_std,diff_std,wavelength_bin"
        rows = [
            f"/a/CRSA{i:08d}_cube.fits,45.0,{45 * (i % 2)},1,60,5e5,1e6,1225,1225,{lam}"
            for i in range(4)
            for lam in (1159.56, 1300.0)
        ]
        return {"csv": "\n".join([head, *rows]).encode()}

    def mutate(self, rng, content):
        kinds = (mutate.mutate_bytes, mutate.mutate_words, mutate.mutate_cells, mutate.mutate_cells)
        return mutate.some(rng, kinds)(rng, content)

    def read(self, path):
        from astropolcal.reduction import read_pypolcal

        return read_pypolcal(path)

    def check(self, found, path):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            _check_observations(found)


# ---- FITS --------------------------------------------------------------------------


@lru_cache(maxsize=2)
def small_layout(**changes):
    """Return the files of CHARIS with two wavelengths and few pixels."""
    return dataclasses.replace(
        instruments.get("charis").files,
        shape=(2, 33, 40),
        internal_apertures=((10.0, 16.0), (28.0, 16.0), 9.0, 20.0, 0.1),
        star_offset=(18.0, 1.5),
        fwhm=2.5,
        **changes,
    )


def two_stars(width=40):
    """Return an image of the same star in both beams, or in that of one camera."""
    y, x = np.indices((33, width))
    places = ((10.0, 15.0), (28.0, 16.5)) if width == 40 else ((10.0, 15.0),)
    star = sum(np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 2.3) for cx, cy in places)
    return np.random.default_rng(1).normal(500, 20, (2, 33, width)) + 2e4 * star


CARDS = {
    "RET-ANG1": 0.0,
    "RET-POS1": 80.0,
    "D_IMRANG": 97.0,
    "PARANG": 20.0,
    "ALTITUDE": 70.0,
    "EXPTIME": 10.0,
    "UTC-DATE": "2025-11-03",
    "UTC-TIME": "12:00:00",
    "MJD": 60982.5,
    "RA": "05:05:05",
    "DEC": "+10:00:00",
    "OBJECT": "HD 293396",
    "INSTRUME": "CHARIS",
    "FILTNAME": "Broadband",
}


class Cube(Reader):
    """Cubes to be reduced."""

    suffix = ".fits"

    def seeds(self):
        from astropy.io import fits

        noise = np.random.default_rng(1).normal(500, 20, (2, 33, 40))
        cube, weight = (fits.ImageHDU(x.astype("f4")) for x in (noise, np.ones_like(noise)))
        hdus = fits.HDUList([fits.PrimaryHDU(header=fits.Header(CARDS)), cube, weight])
        return {
            "plain": _written(fits.HDUList(hdus[:2]).writeto, self.suffix),
            "weights": _written(hdus.writeto, self.suffix),
        }

    def mutate(self, rng, content):
        return binary.mutate_fits(rng, content)

    def read(self, path):
        from astropolcal.reduction.frames import reduce_frame

        return reduce_frame(str(path), small_layout(), source="internal")

    def check(self, found, path):
        for text in (*found.errors, *found.doubts):
            assert "\n" not in text
            assert len(text) < 1000
        json.dumps(found.to_dict())
        if not found.usable:
            assert found.errors
            return
        result = found.photometry
        good = ~result.failed
        assert np.isfinite(result.flux[:, good]).all() or np.isfinite(result.flux[good]).all()
        assert not (np.asarray(result.variance) < 0).any()
        for angle in ("hwp", "derotator"):
            assert np.isfinite(found.values[angle])


class Star(Cube):
    """Cubes of a star, whose images are found."""

    def seeds(self):
        from astropy.io import fits

        header = fits.Header(CARDS | {"RET-POS1": 80.0})
        hdus = [fits.PrimaryHDU(header=header), fits.ImageHDU(two_stars().astype("f4"))]
        return {"star": _written(fits.HDUList(hdus).writeto, self.suffix)}

    def read(self, path):
        from astropolcal.reduction.frames import check_stars, reduce_frame

        frame = reduce_frame(str(path), small_layout(), source="star")
        check_stars([frame], small_layout())
        return frame


class Cameras(Cube):
    """Frames whose beams have a file each; the left one is spoiled."""

    def seeds(self):
        from astropy.io import fits

        hdus = [fits.PrimaryHDU(header=fits.Header(CARDS))]
        hdus.append(fits.ImageHDU(two_stars(20).astype("f4")))
        return {"camera": _written(fits.HDUList(hdus).writeto, self.suffix)}

    def read(self, path):
        from astropolcal.reduction.frames import reduce_frame

        layout = small_layout(beam_files=("cam1", "cam2"))
        right, left = (path.with_name(f"n00000001_cam{n}.fits") for n in (1, 2))
        right.write_bytes(_good(Cameras, "camera"))
        left.write_bytes(path.read_bytes())
        try:
            return reduce_frame(str(right), layout)
        finally:
            right.unlink()
            left.unlink()


@lru_cache(maxsize=2)
def _good(kind, name):
    return kind().seeds()[name]


class Header(Reader):
    """Headers of frames: angles, dates, mode, and what the frames are."""

    suffix = ".fits"

    def seeds(self):
        from astropy.io import fits

        hdu = fits.PrimaryHDU(header=fits.Header(CARDS))
        return {"header": _written(hdu.writeto, self.suffix)}

    def mutate(self, rng, content):
        content = binary.mutate_fits(rng, content)
        return content if rng.random() < 0.5 else binary.mutate_fits(rng, content)

    def read(self, path):
        from astropolcal.fitscheck import primary_header
        from astropolcal.pipeline.headers import FrameAngles, describe
        from astropolcal.reduction.headers import (
            Frame,
            add_pointing,
            observation_time,
            read_header,
        )

        header, charis = primary_header(path), instruments.get("charis")
        # the header of a raw frame, on which that of its cube falls back, is read alike
        raw = read_header("CRSA00000001_cube.fits", small_layout(), header={}, raw={1: [path]})
        frame = read_header(path, small_layout(), header=header)
        assert set(raw.values) <= set(frame.values)
        for ask in (
            observation_time,
            lambda v: add_pointing([Frame("x", values=dict(v))], small_layout()),
        ):
            try:
                ask(frame.values)
            except AstropolcalError:
                pass
        told = describe(header, "charis")
        angles = FrameAngles([header, header], charis)
        found = charis.positions(angles, charis.published())
        return frame, told, found

    def check(self, found, path):
        frame, told, positions = found
        for angle in positions.values():
            assert np.isfinite(angle).all(), positions
        assert all(np.isfinite(v) for v in frame.values.values() if isinstance(v, float))
        assert told["instrument"] == "charis"
        for text in frame.errors:
            assert "\n" not in text


class Product(Reader):
    """Stokes products that are read back."""

    suffix = ".fits"

    def seeds(self):
        from astropolcal.correction import Corrected, Systematic

        rng, lam = np.random.default_rng(1), [1.2, 1.6] * u.um
        provenance = {"calibration": "a.asdf", "frames": ["one.fits", "two.fits"]}

        def make(shape, centre):
            stokes = rng.uniform(1, 2, (3, 2, *shape))
            systematic = Systematic(
                rng.normal(size=(4, 2, 3, 3)) * 1e-3, np.zeros((2, 3, 3), bool), "first order", []
            )
            ones, weak = np.ones(2), ["", "u"]
            return Corrected(
                "IQU",
                lam,
                stokes,
                np.ones((6, 2, *shape)),
                systematic,
                ones,
                np.ones((2, 3), bool),
                ones,
                weak,
                "stokes",
                "normalized_double_difference",
                u.adu,
                True,
                centre,
                16.2 if centre else None,
                provenance=provenance,
            )

        return {
            name: _written(make(shape, centre).write, self.suffix)
            for name, shape, centre in (("spectrum", (), None), ("image", (5, 5), (2.0, 2.0)))
        }

    def mutate(self, rng, content):
        if rng.random() < 0.8:
            content = binary.forge_checksums(content)
        return binary.mutate_fits(rng, content)

    def read(self, path):
        from astropolcal.correction import Corrected

        return Corrected.read(path)

    def check(self, found, path):
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            _check_product(found)
            copy = path.with_name("copy.fits")
            found.write(copy, overwrite=True)
            again = self.read(copy)
            copy.unlink()
        np.testing.assert_array_equal(again.stokes, found.stokes)
        assert again.components == found.components


def _check_product(found):
    n, w = len(found.components), len(found.wavelength)
    assert found.stokes.shape[:2] == (n, w), "Stokes parameters and wavelengths do not fit"
    assert set(found.components) <= set("IQUV")
    assert len(set(found.components)) == n
    assert (found.wavelength.to_value(u.um) > 0).all()
    repr(found)
    for kind in ("statistical", "systematic"):
        values = found.covariances(kind)
        assert values.shape == (n, n, *found.stokes.shape[1:])
        assert not (values[range(n), range(n)] < 0).any(), "negative variances"
    found.polarization()
    if found.stokes.ndim == 4:
        found.azimuthal()


class Science(Reader):
    """Cubes to be corrected, cut out of files."""

    suffix = ".fits"

    def seeds(self):
        return Cube().seeds()

    def mutate(self, rng, content):
        return binary.mutate_fits(rng, content)

    def read(self, path):
        from astropolcal.correction.sources import CubeFiles

        source = CubeFiles([path], [(28.0, 16.5), (10.0, 15.0)], 11)
        beam = source.fluxes(0, slice(0, 1), slice(0, 1))
        return (
            source,
            beam,
            source.variances(0, slice(0, 1), slice(0, 1)) if (source.has_variances) else None,
        )

    def check(self, found, path):
        _, beam, variance = found
        assert beam.shape == (1, 1, 11, 11)
        assert variance is None or not (variance < 0).any()


class Described(Reader):
    """Any FITS file, which ``astropolcal info`` describes."""

    suffix = ".fits"

    def seeds(self):
        return Product().seeds() | Header().seeds() | {"cube": Cube().seeds()["weights"]}

    def mutate(self, rng, content):
        return binary.mutate_fits(rng, binary.forge_checksums(content))

    def read(self, path):
        from astropolcal.scripts._info import describe_fits

        return describe_fits(path)

    def check(self, found, path):
        from astropolcal.files import plain

        lines, content = found
        assert content["file"] == str(path)
        assert lines[0].startswith(f"{path}: ")
        json.dumps(plain(content), allow_nan=False)


# ---- journals and checkpoints ------------------------------------------------------


class Checkpoint(Reader):
    """Checkpoints of a sampler."""

    suffix = ".h5"
    shape, every = (8, 4, 2), 2
    description = {"parameters": [["hwp.theta", "deg"]], "seed": 1, "moves": ["DEMove"]}
    arrays = {"noise": np.ones(5), "bounds": np.zeros((2, 2))}

    def _run(self, path, n, resume=True):
        from astropolcal.calibration.posterior.checkpoint import Chain

        chain = Chain(self.shape, self.every)
        state = np.random.RandomState(1).get_state()
        with chain.open(path, self.description, self.arrays, resume):
            for k in range(chain.count, n):
                steps = np.full(self.shape[1:], k + 1.0)
                chain.append(steps, steps[:, 0], state, np.full(4, k + 1))
        return chain

    def seeds(self):
        return {
            f"steps{n}": _written(lambda path, n=n: self._run(path, n), self.suffix) for n in (4, 7)
        }

    def mutate(self, rng, content):
        if rng.random() < 0.5:
            return mutate.mutate_bytes(rng, content)
        kind, start, stated, steps = content.split(b"\n", 3)
        return b"\n".join([kind, start, mutate.mutate_json(rng, stated), steps])

    def read(self, path):
        return self._run(path, 8)

    def check(self, found, path):
        from astropolcal.calibration.posterior.checkpoint import Chain

        assert found.count == 8
        expected = np.broadcast_to(np.arange(1.0, 9)[:, None, None], self.shape)
        assert np.array_equal(found.coords, expected), "steps of the chain were changed"
        assert np.array_equal(found.log_prob, expected[..., 0]), "log_prob was changed"
        again = Chain(self.shape, self.every)
        with again.open(path, self.description, self.arrays, True):
            assert np.array_equal(again.coords[: again.count], expected[: again.count])
            assert again.count == 8


class Challenges(Reader):
    """Checkpoints of challenges."""

    suffix = ".jsonl"
    settings = {"seed": 1, "snr": [8.0, 300.0], "kinds": ["none"], "setup": {"n_wavelengths": 5}}

    def seeds(self):
        from astropolcal.gap.challenge import Setup, run_challenge

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "run.jsonl"
            setup = Setup(n_wavelengths=5, n_derotator=3)
            result = run_challenge(
                2, seed=2, kinds=["none"], snr=(60, 60), setup=setup, checkpoint=path
            )
            type(self).settings = result.settings
            return {"two": path.read_bytes()}

    def mutate(self, rng, content):
        kinds = (mutate.mutate_bytes, mutate.mutate_words, mutate.mutate_json, mutate.mutate_json)
        return mutate.some(rng, kinds)(rng, content)

    def read(self, path):
        from astropolcal.gap.challenge import ChallengeResult, _journal

        records = _journal(path, self.settings)
        return records, ChallengeResult([records[i] for i in range(2) if i in records], {})

    def check(self, found, path):
        records, result = found
        assert all(isinstance(index, int) for index in records)
        repr(result)
        if records:
            result.to_dict()
            result.words()


class Journal(Reader):
    """Journals of a reduction."""

    suffix = ".jsonl"

    def seeds(self):
        from astropolcal.reduction.frames import reduce_frame
        from astropolcal.reduction.run import Journal as Ours

        with tempfile.TemporaryDirectory() as folder:
            cube, path = Path(folder) / "CRSA00000001_cube.fits", Path(folder) / "journal"
            cube.write_bytes(Cube().seeds()["plain"])
            journal = Ours(path, {"a": 1})
            journal.add(reduce_frame(str(cube), small_layout()))
            return {"one": path.read_bytes()}

    def mutate(self, rng, content):
        kinds = (mutate.mutate_bytes, mutate.mutate_words, mutate.mutate_json, mutate.mutate_json)
        return mutate.some(rng, kinds)(rng, content)

    def read(self, path):
        from astropolcal.reduction.run import Journal as Ours

        return Ours(path, {"a": 1})

    def check(self, found, path):
        for frame in found._known.values():
            assert isinstance(frame.path, str)
            assert isinstance(frame.values, dict)
            repr(frame), frame.usable, frame.name
            json.dumps(frame.to_dict())


class EntryPoints(Reader):
    """Entry points of instruments: a file of them, as a distribution brings it."""

    suffix = ".txt"

    def seeds(self):
        text = "[astropolcal.instruments]\nbench = tests.fuzz.bench:Bench\nother = json:dumps\n"
        return {"entry": text.encode()}

    def mutate(self, rng, content):
        targets = ("os:getcwd", "json", "nowhere:X", "json:nothing", "tests.fuzz.bench:Broken", "")
        names = ("Bench", "UNFIT", "Unnamed", "Raising")
        targets += tuple(f"tests.fuzz.bench:{name}" for name in names)
        new = mutate.some(rng, tuple(targets)).encode()
        if rng.random() < 0.5:
            content = re.sub(rb"tests.fuzz.bench:Bench|json:dumps", new, content)
        return mutate.mutate_words(rng, content) if rng.random() < 0.6 else content

    def read(self, path):
        from importlib.metadata import EntryPoints as Points

        registry, real = dict(instruments._REGISTRY), instruments.entry_points
        try:
            points = Points(Points._from_text(path.read_text("utf-8", "replace")))
        except (TypeError, ValueError, AttributeError) as error:
            # such a distribution cannot be installed
            raise AstropolcalError("no entry points") from error
        instruments.entry_points = lambda group: points.select(group=group)
        try:
            found = [instruments.get(name) for name in ("charis", "bench")]
            return instruments.names(), found
        finally:
            instruments.entry_points = real
            instruments._REGISTRY.clear()
            instruments._REGISTRY.update(registry)

    def check(self, found, path):
        names, (charis, bench) = found
        assert charis.name == "charis"
        assert "bench" in names
        assert bench.answers_to("bench")


READERS = {
    "calibration": CalibrationFile,
    "forged": ForgedCalibration,
    "loaded": Loaded,
    "index": Index,
    "observations": Table,
    "exported": Exported,
    "spectra": Spectra,
    "csv": Csv,
    "cube": Cube,
    "star": Star,
    "cameras": Cameras,
    "header": Header,
    "product": Product,
    "science": Science,
    "info": Described,
    "checkpoint": Checkpoint,
    "challenge": Challenges,
    "journal": Journal,
    "instruments": EntryPoints,
}
