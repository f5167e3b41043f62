# Licensed under a 3-clause BSD style license - see LICENSE
"""How science frames are put together: pairs, places of the beams, brightness."""

import dataclasses
from types import SimpleNamespace

import astropy.units as u
import numpy as np
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, QTable
from astropy.utils.masked import Masked

from astropolcal import instruments, optics
from astropolcal.correction import ScienceFrames, correct, measurement_rows
from astropolcal.correction.frames import frame_positions
from astropolcal.exceptions import AstropolcalWarning, ObservationError, ParameterError

LAM = [1.2, 1.6] * u.um
HWP = [0, 45, 22.5, 67.5] * u.deg
CHAIN = optics.LinearRetarder(
    retardance=180 * u.deg, mount="hwp", name="hwp"
) | optics.WollastonPrism(name="wollaston")


def arrays(n=4, **settings):
    flux = np.arange(2.0 * n).reshape(n, 2) + 1
    positions = settings.pop("positions", {"hwp": HWP[:n]})
    return ScienceFrames.from_arrays(flux, 2 * flux, LAM, positions, **settings)


# ---- arrays ----------------------------------------------------------------------------


def test_attributes_are_taken_over():
    frames = arrays(unit=u.electron, pixel_scale=16.2, centre=(3.0, 4.0), meta={"object": "x"})
    assert (frames.unit, frames.pixel_scale, frames.centre) == (u.electron, 16.2, (3.0, 4.0))
    assert frames.meta == {"object": "x"}
    assert frames.north_up is False
    assert frames.pairs is None
    assert frames.names == ["frame 0", "frame 1", "frame 2", "frame 3"]
    assert arrays(names=list("abcd")).names == list("abcd")


def test_pairs_by_the_angles_of_the_plate():
    for hwp, pairs in [
        ([0, 45, 22.5, 67.5], [[0, 1], [2, 3]]),
        ([0, 22.5, 45, 67.5], [[0, 2], [1, 3]]),
        ([0, 22.5, 0, 22.5], []),
        # one angle without any partner leaves the other pairs
        ([0, 45, 22.5, 0], [[0, 1]]),
        ([10, 45, 22.5, 0], [[3, 1]]),
        ([np.nan, 45, 22.5, 0], [[3, 1]]),
        ([0, 45, 0, 45.1], [[0, 1], [2, 3]]),
        ([0, 45, 0, 0], [[0, 1]]),
    ]:
        assert arrays(hwp=hwp * u.deg).pairs.tolist() == pairs, (hwp, pairs)
    for wrong in (3 * u.deg, HWP[:3], np.tile(HWP, 2)):
        with pytest.raises(ObservationError, match=r"hwp has shape .* each of the 4 frames is"):
            arrays(hwp=wrong)
    # positions of another kind than a dict
    for positions in (None, QTable({"hwp": HWP})):
        assert arrays(positions=positions, hwp=HWP).pairs.tolist() == [[0, 1], [2, 3]]


def test_frames_of_two_derotator_angles_are_no_pair():
    """Up to 2 deg apart they are; angles without a unit are refused."""
    near = {"hwp": HWP, "derotator": [60, 61.9, 80, 81]}
    with pytest.raises(ParameterError, match=r"derotator = .* needs a unit such as rad"):
        arrays(positions=near, hwp=HWP)
    near["derotator"] *= u.deg
    assert arrays(positions=near, hwp=HWP).pairs.tolist() == [[0, 1], [2, 3]]
    far = {"hwp": HWP, "derotator": [60, 62.1, 80, 81] * u.deg}
    assert arrays(positions=far, hwp=HWP).pairs.tolist() == [[2, 3]]


def test_pairs_of_exposures_during_which_the_derotator_turns():
    """At three nodes of each exposure; what counts is the middle."""
    turning = np.array([-3.0, 0.0, 3.0])[:, None] + [60.0, 60.5, 90.0, 95.0]
    positions = {"hwp": np.tile(HWP, (3, 1)), "derotator": turning * u.deg}
    assert arrays(positions=positions, hwp=HWP).pairs.tolist() == [[0, 1]]


def test_pairs_that_are_given_are_not_looked_for():
    frames = arrays(hwp=HWP, pairs=[[1, 0]])
    assert np.asarray(frames.pairs).tolist() == [[1, 0]]


def test_images_that_are_turned_have_north_up():
    image = np.ones((4, 2, 5, 5))
    frames = ScienceFrames.from_arrays(
        image, image, LAM, {"hwp": HWP}, position_angle=[0, 90, 180, 270] * u.deg
    )
    assert frames.north_up
    assert not ScienceFrames.from_arrays(image, image, LAM, {"hwp": HWP}).north_up


def test_differences_and_sums_are_beams():
    difference, total = np.array([[2.0, 4.0]] * 4), np.array([[10.0, 20.0]] * 4)
    frames = ScienceFrames.from_differences(
        difference, total, LAM, {"hwp": HWP}, variance=np.full((4, 2), 6.0), unit=u.electron
    )
    every = slice(None)
    assert frames.source.fluxes(0, every, every)[0].tolist() == [6.0, 12.0]
    assert frames.source.fluxes(1, every, every)[0].tolist() == [4.0, 8.0]
    # var(r - l) = var(r) + var(l)
    both = frames.source.variances(0, every, every) + frames.source.variances(1, every, every)
    assert np.all(both == 6.0)
    assert frames.unit == u.electron
    without = ScienceFrames.from_differences(difference, total, LAM, {"hwp": HWP})
    assert not without.source.has_variances


def test_what_does_not_fit():
    for changes, words in [
        ({"wavelength": [1.2] * u.um}, r"wavelength has shape \(1,\); the frames have 2 wave"),
        ({"positions": {"hwp": HWP[:3]}}, r"hwp has 3 positions; there are 4 frames"),
        ({"positions": {"hwp": np.zeros((5, 3)) * u.deg}}, r"hwp has 3 positions; there are 4"),
        ({"pairs": [[0, 1, 2]]}, r"pairs has shape \(1, 3\); whole numbers, \(n_pairs, 2\)"),
        ({"pairs": [[0, 1.5]]}, r"pairs has shape \(1, 2\); whole numbers"),
        ({"groups": [0, 0, 0]}, r"groups has shape \(3,\); one of each of the 4 frames"),
    ]:
        good = arrays()
        with pytest.raises(ObservationError, match=words):
            dataclasses.replace(good, **changes)
    with pytest.raises(ObservationError, match="1 names for 4 frames"):
        arrays(names=["a"])


def test_positions_of_all_frames_alike():
    for position in [7 * u.deg, [7] * u.deg, np.zeros((5, 4)) * u.deg]:
        assert arrays(positions={"hwp": position}).positions["hwp"] is position, position


def test_brightness_counts_all_light_of_a_frame(tmp_path):
    """Images are summed, without what lacks a value."""
    clouds = np.array([0.5, 1.0, 1.5, 1.0])
    rows = measurement_rows(CHAIN, {"hwp": HWP}, LAM)
    spectrum = np.einsum("bwfs,s->bfw", rows, [100.0, 3.0, -2.0, 0]) * clouds[:, None]
    shape = np.zeros((5, 5))
    shape[1:4, 1:4] = 1 / 9
    right, left = spectrum[..., None, None] * shape
    right[:, :, 0, 0] = left[:, :, 0, 0] = np.nan
    np.save(tmp_path / "right.npy", right)
    for beam in (right, np.load(tmp_path / "right.npy", mmap_mode="r")):
        frames = ScienceFrames.from_arrays(beam, left, LAM, {"hwp": HWP})
        found = frames.with_brightness(rows)
        np.testing.assert_allclose(found.scale, np.tile(clouds, (2, 1)), rtol=1e-9)
        assert frames.scale is None


# ---- files -----------------------------------------------------------------------------


def layout(**changes):
    """Return an instrument with small files."""
    files = dataclasses.replace(
        instruments.get("charis").files,
        shape=(2, 20, 40),
        internal_apertures=((10.0, 8.0), (28.0, 12.0), 9.0, 12.0, 0.1),
        star_offset=(17.0, 3.0),
        **changes,
    )
    charis = instruments.get("charis")
    lab = SimpleNamespace(name="lab", files=files, wavelength=LAM, positions=charis.positions)
    lab.configured = lambda header: lab
    return lab


TABLE = QTable({"hwp": HWP, "derotator": [60] * 4 * u.deg})
TABLE_CHAIN = optics.LinearRetarder(
    retardance=180 * u.deg, mount="hwp", name="hwp"
) | optics.WollastonPrism(name="wollaston")


@pytest.fixture
def cubes(tmp_path):
    """Cubes whose pixels tell their number: frame, slice, row and column."""
    frame, slice_, row, column = np.indices((4, 2, 20, 40))
    values = 1e5 * frame + 1e4 * slice_ + 100.0 * row + column
    paths = [tmp_path / f"CRSA0000000{i}_cube.fits" for i in range(4)]
    for path, cube in zip(paths, values, strict=True):
        fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(cube)]).writeto(path)
    return values, paths


def middle(frames, beam):
    return frames.source.fluxes(beam, slice(0, 1), slice(0, 1))[0, 0, 1, 1] % 1e4


def from_files(paths, instrument=None, **settings):
    instrument = layout() if instrument is None else instrument
    return ScienceFrames.from_files(paths, instrument, TABLE, TABLE_CHAIN, size=3, **settings)


def test_what_files_give(cubes):
    values, paths = cubes
    frames = from_files(paths, centres=[(27, 11), (10, 8)])
    assert frames.names == [str(path) for path in paths]
    assert frames.pairs.tolist() == [[0, 1], [2, 3]]
    assert frames.centre == (1.0, 1.0)
    assert frames.pixel_scale == 16.2
    assert frames.north_up is False
    np.testing.assert_array_equal(frames.wavelength, LAM)
    np.testing.assert_allclose(frames.positions["hwp"], HWP.to_value(u.rad))
    np.testing.assert_array_equal(
        frames.source.fluxes(1, slice(0, 4), slice(0, 2)), values[:, :, 7:10, 9:12]
    )
    turned = from_files(paths, position_angle=[0, 1, 2, 3] * u.deg, pixel_scale=7.0)
    assert turned.north_up
    assert turned.pixel_scale == 7.0


def test_files_without_errors_have_those_of_the_detectors(cubes):
    values, paths = cubes
    assert not from_files(paths, centres=[(27, 11), (10, 8)]).source.has_variances
    # twice the pixels on the right, thrice on the left, which counts half
    pair = [SimpleNamespace(variance=lambda x, k=k: k * x) for k in (2.0, 3.0)]
    frames = from_files(
        paths, centres=[(27, 11), (10, 8)], detectors=[pair] * len(paths), left_scale=0.5
    )
    found = frames.source.variances(1, slice(0, 4), slice(0, 2))
    np.testing.assert_allclose(found, 0.25 * 3.0 * values[:, :, 7:10, 9:12])
    # as weights they would follow the noise
    with (
        # they are no fluxes of any light
        pytest.warns(AstropolcalWarning, match="the frames disagree"),
        pytest.warns(AstropolcalWarning, match="variances follow the noisy fluxes themselves"),
    ):
        correct(CHAIN, frames, weights="variance", observable="intensity")


def test_places_of_the_beams(cubes):
    """Of both, or of the left one, from which the right one is 17 and 3 pixels away."""
    for centres, right, left in [
        # row and column of the middle, as 100 row + column
        ([(27, 11), (10, 8)], 1127, 810),
        ((10, 8), 1127, 810),
        (np.tile([(10.0, 8.0)], (4, 1)), 1127, 810),
        (np.tile([[(26.0, 10.0), (9.0, 7.0)]], (4, 1, 1)), 1026, 709),
    ]:
        frames = from_files(cubes[1], centres=centres)
        assert (middle(frames, 0), middle(frames, 1)) == (right, left), (centres, right, left)


def test_by_default_the_middle_of_the_field(cubes):
    """Half-way between both rectangles, (19, 10), less and plus half of the offset."""
    frames = from_files(cubes[1])
    found = frames.source._centres[0]
    np.testing.assert_allclose(found[0] - found[1], (17, 3))
    np.testing.assert_allclose(found.mean(axis=0), (19, 10))


def test_centres_that_are_none(cubes):
    for centres in [[1.0, 2.0, 3.0], [(1.0, np.nan), (2.0, 3.0)], 5.0]:
        with pytest.raises(
            ParameterError, match=r"centres of shape .*; x and y of each are needed"
        ):
            from_files(cubes[1], centres=centres)
    # the left beam first; the left beam in two frames
    for centres in [[(10, 8), (27, 11)], [(10, 8), (9, 7)], np.zeros((4, 2, 2))]:
        with pytest.raises(ParameterError, match=r"the right beam comes first, about \(x, y\) = "):
            from_files(cubes[1], centres=centres)
    # the star in the right beam, given as that in the left one
    for centres in [(27, 11), [(44, 14), (27, 11)]]:
        with pytest.raises(ParameterError, match="of the left beam are in the right one"):
            from_files(cubes[1], centres=centres)


def test_files_of_two_cameras(tmp_path):
    """Places are those in both images side by side, the left one first."""
    instrument = layout(beam_files=("cam1", "cam2"))
    rights = [tmp_path / f"n0000000{i}_cam1.fits" for i in range(4)]
    row, column = np.indices((20, 20))
    for path in rights:
        for name, offset in (("cam1", 20.0), ("cam2", 0.0)):
            image = np.stack([100.0 * row + column + offset] * 2)
            hdus = fits.HDUList([fits.PrimaryHDU(), fits.ImageHDU(image)])
            hdus.writeto(path.with_name(path.name.replace("cam1", name)))
    frames = from_files(rights, instrument, centres=[(27, 11), (10, 8)], left_scale=2.0)
    assert middle(frames, 0) == 1127
    assert middle(frames, 1) == 2 * 810


# ---- positions -------------------------------------------------------------------------


def test_a_modulator_needs_its_state():
    for states in [None, ["A", ""], ["A", " "], np.ma.array(["A", "B"], mask=[0, 1])]:
        modulator = optics.FerroelectricLiquidCrystal(mount="flc_state", name="flc")
        chain = modulator | CHAIN
        table = QTable({"hwp": [0, 45] * u.deg, "derotator": [60, 60] * u.deg})
        if states is not None:
            table["flc_state"] = states
        name = "a.fits" if states is None else "b.fits"
        with pytest.raises(ObservationError, match=f"{name}: no state of the modulator, flc_state"):
            frame_positions(instruments.get("vampires"), table, chain, names=["a.fits", "b.fits"])


def test_an_angle_that_is_masked_is_none():
    for hwp in [
        [0, np.nan] * u.deg,
        [0, np.inf] * u.deg,
        Masked([0.0, 45.0] * u.deg, mask=[False, True]),
        MaskedColumn([0.0, 45.0], mask=[False, True]),
        MaskedColumn([0.0, 45.0], mask=[False, True], unit="deg"),
    ]:
        table = QTable({"hwp": hwp, "derotator": [60, 60] * u.deg})
        with pytest.raises(ObservationError, match="b: no angle 'hwp'"):
            frame_positions(instruments.get("charis"), table, TABLE_CHAIN, names=["a", "b"])


def test_the_table_of_the_user_is_not_changed():
    table = TABLE.copy()
    frame_positions(instruments.get("charis"), table, TABLE_CHAIN)
    assert table.colnames == TABLE.colnames


def test_light_in_pixels_that_are_known_bad_is_none():
    """A cosmic ray that has no variance does not make its frame brighter."""
    image = np.add.outer(np.arange(9.0), np.arange(9.0)) + 1
    right, left = (share * np.ones((4, 2, 1, 1)) * image for share in (1.0, 2.0))
    variances = [right.copy(), left.copy()]
    right[2, 1, 4, 4], variances[0][2, 1, 4, 4] = 1e6, np.nan
    given = dict(zip(("variance_right", "variance_left"), variances, strict=True))
    frames = ScienceFrames.from_arrays(right, left, LAM, {"hwp": HWP}, **given)
    rows = measurement_rows(CHAIN, {"hwp": HWP}, LAM)
    np.testing.assert_allclose(frames.with_brightness(rows).scale, 1.0, atol=1e-9)


def test_what_fluxes_and_wavelengths_say_counts():
    flux = np.ones((4, 2))
    assert ScienceFrames.from_arrays(flux * u.electron, flux, LAM, {"hwp": HWP}).unit == u.electron
    # the sum of both is beyond the type
    whole = np.full((4, 2), 30000, dtype=np.int16)
    frames = ScienceFrames.from_differences(whole // 2, whole, LAM, {"hwp": HWP})
    assert frames.source.fluxes(0, slice(None), slice(None)).tolist() == [[22500.0] * 2] * 4
    for wrong in (None, [1.2, np.nan] * u.um, [0, 1.2] * u.um, [1.2, 1.6], [1.2, 1.6] * u.s):
        with pytest.raises(ParameterError, match="wavelength"):
            ScienceFrames.from_arrays(flux, flux, wrong, {"hwp": HWP})


def test_fluxes_without_any_variance_are_no_measurement():
    flux = np.ones((4, 2)) + 0.01 * np.arange(8).reshape(4, 2)
    given = dict.fromkeys(("variance_right", "variance_left"), np.zeros((4, 2)))
    frames = ScienceFrames.from_arrays(flux, flux, LAM, {"hwp": HWP}, **given)
    with pytest.raises(ObservationError, match="no pixel has values"):
        correct(CHAIN, frames, brightness="given")


def test_what_follows_fluxes_or_the_run_has_no_place_in_images_without_a_word():
    table = QTable({"hwp": [0, 22.5] * u.deg, "derotator": [60, 60] * u.deg})
    charis = instruments.get("charis")
    for follows in ("flux", "total_flux", "previous_flux"):
        optic = optics.StrayLight(amount=0.01, reference=1e6, mount=follows, name="gap_x")
        with pytest.raises(ObservationError, match=r"gap_x .* follows the fluxes of a table"):
            frame_positions(charis, table, optic | optics.WollastonPrism(name="wollaston"))
    for follows in ("sequence", "frame"):
        optic = optics.DriftRotator(rate=1 * u.deg, mount=follows, name="gap_x")
        with pytest.warns(AstropolcalWarning, match=r"gap_x .* the course of the calibrated run"):
            frame_positions(charis, table, optic | optics.WollastonPrism(name="wollaston"))
