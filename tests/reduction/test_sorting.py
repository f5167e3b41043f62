# Licensed under a 3-clause BSD style license - see LICENSE
"""Which frames belong together, without any file."""

from types import SimpleNamespace

import numpy as np
import pytest

from astropolcal import instruments
from astropolcal.exceptions import ObservationError
from astropolcal.reduction import Reduction
from astropolcal.reduction.frames import Frame
from astropolcal.reduction.photometry import Photometry
from astropolcal.reduction.run import (
    consistent,
    replace_angles,
    set_aside,
    without_repeats,
)

LAYOUT = instruments.get("charis").files


def frame(number, hwp=0.0, derotator=45.0, *, digest=None, unit="adu", folder="", **values):
    """Return a measured frame of that number; without one it has a name of its own."""
    name = f"{folder}CRSA{number:08d}.fits" if isinstance(number, int) else f"{folder}{number}"
    return Frame(
        name,
        number if isinstance(number, int) else None,
        {"hwp": hwp, "derotator": derotator} | values,
        unit=unit,
        photometry=Photometry.empty(2),
        digest=name if digest is None else digest,
    )


def aside(*frames, source="internal"):
    """Return names kept, and why the others are not."""
    reduction = Reduction(None, source)
    kept = [one.name for one in set_aside(frames, reduction)]
    return kept, {path: "; ".join(why) for path, why in reduction.problems.items()}


# ---- copies and other kinds ----------------------------------------------------------


def test_frames_are_sorted_by_number_then_time_then_name():
    frames = [frame("b.fits", mjd=2.0), frame("a.fits", mjd=3.0), frame(7), frame(3)]
    kept, _ = aside(*frames, frame("z.fits"), frame("y.fits"))
    assert kept == [
        "CRSA00000003.fits",
        "CRSA00000007.fits",
        "b.fits",
        "a.fits",
        "y.fits",
        "z.fits",
    ]


def test_same_data_under_another_name_are_a_copy():
    kept, why = aside(frame(1, digest="x"), frame(2, digest="x"))
    assert kept == ["CRSA00000001.fits"]
    assert why == {"CRSA00000002.fits": "the same data as CRSA00000001.fits"}


def test_same_number_in_another_folder_is_named_with_its_folder():
    _, why = aside(frame(1, folder="one/"), frame(1, folder="two/"))
    assert why == {"two/CRSA00000001.fits": "the same frame as one/CRSA00000001.fits"}


def test_unusable_frame_is_no_original():
    """A copy of what could not be measured is not a copy."""
    broken = frame(1, digest="x")
    broken.errors.append("truncated")
    kept, why = aside(broken, frame(2, digest="x"))
    assert kept == ["CRSA00000002.fits"]
    assert why == {"CRSA00000001.fits": "truncated"}


def test_frame_of_another_kind_than_most_is_left_out():
    for source, name, usual, other in [
        ("internal", "filter", "Broadband", "J"),
        ("internal", "pickoff", "in", "out"),
        ("internal", "light", "even", "uneven"),
        ("star", "filter", "Broadband", "J"),
        ("star", "object", "HD 1", "HD 2"),
    ]:
        frames = [frame(i, **{name: usual}) for i in range(3)] + [frame(9, **{name: other})]
        kept, why = aside(*frames, source=source)
        assert len(kept) == 3, (source, name, usual, other)
        assert why == {
            "CRSA00000009.fits": f"{name} {other!r}, the others of the run have {usual!r}"
        }, (source, name, usual, other)


def test_what_does_not_matter_for_a_source_is_not_compared():
    for source, name in [("internal", "object"), ("star", "light")]:
        kept, why = aside(frame(1, **{name: "a"}), frame(2, **{name: "b"}), source=source)
        assert (len(kept), why) == (2, {}), (source, name)


def test_other_units_are_another_kind():
    _, why = aside(frame(1), frame(2), frame(3, unit="electron"))
    assert why == {"CRSA00000003.fits": "unit 'electron', the others of the run have 'adu'"}


def test_spelling_and_silence_do_not_tell_objects_apart():
    for other in ["hd1", "HD  1", "HD_1", "Hd.1", None]:
        kept, _ = aside(frame(1, object="HD 1"), frame(2, object=other), source="star")
        assert len(kept) == 2, other


def test_silent_frame_stays_beside_one_that_contradicts():
    named = [frame(i, object="HD 1") for i in range(3)]
    kept, why = aside(*named, frame(8), frame(9, object="HD 2"), source="star")
    assert "CRSA00000008.fits" in kept
    assert list(why) == ["CRSA00000009.fits"]


def test_signs_in_names_tell_objects_apart():
    for one, other in [("HD 1-2", "HD 12"), ("BD+12", "BD-12")]:
        kept, _ = aside(frame(1, object=one), frame(2, object=other), source="star")
        assert kept == ["CRSA00000001.fits"], (one, other)


# ---- commanded angles ----------------------------------------------------------------


def test_angles_are_replaced_in_turn_and_differences_said():
    frames = [frame(i, hwp=angle) for i, angle in enumerate([0, 45, 0, 30])]
    replace_angles(frames, [0, 45])
    assert [one.values["hwp"] for one in frames] == [0, 45, 0, 45]
    assert [one.doubts for one in frames] == [
        [], [], [], ["half-wave plate at 30 deg in the header, replaced by 45 deg"],
    ]  # fmt: skip


def test_without_a_sequence_angles_stay():
    frames = [frame(1, hwp=30.0)]
    replace_angles(frames, None)
    assert frames[0].values["hwp"] == 30.0


def test_sequence_that_does_not_divide_the_frames_is_refused():
    for sequence in [[], [0, 45], [0, 45, 22.5, 67.5]]:
        words = (
            f"3 frames cannot be cut into sequences of {len(sequence)} angles; frames are missing"
        )
        with pytest.raises(ObservationError, match=words):
            replace_angles([frame(i) for i in range(3)], sequence)


def test_angles_that_do_not_fit_are_left_out_unless_they_were_replaced():
    frames = [frame(i, hwp=angle) for i, angle in enumerate([0, 45, 0, 45, 0, 30])]
    reduction = Reduction(None, "internal")
    kept = consistent(frames, reduction, LAYOUT)
    assert [one.number for one in kept] == [0, 1, 2, 3, 4]
    (why,) = reduction.problems["CRSA00000005.fits"]
    assert why.startswith("half-wave plate at 30 deg, no multiple of 11.25 deg")
    assert consistent([], reduction, LAYOUT) == []


def test_frames_at_90_degrees_measure_the_same():
    for hwp, derotator, repeats in [
        (90.0, 45.0, True),
        (90.2, 45.4, True),
        (-90.0, 45.0, True),
        (90.4, 45.0, False),
        (90.0, 45.6, False),
        (45.0, 45.0, False),
        (180.0, 45.0, False),
    ]:
        reduction = Reduction(None, "internal")
        kept = without_repeats([frame(1), frame(2, hwp, derotator)], reduction)
        assert len(kept) == 2 - repeats, (hwp, derotator, repeats)
        words = [f"half-wave plate at {hwp:g} deg repeats that of CRSA00000001.fits"]
        assert list(reduction.problems.values()) == [words] * repeats, (hwp, derotator, repeats)


def test_a_repeat_of_a_repeat_is_an_original():
    """0, 90 and 180 deg: the second repeats the first, the third is 180 deg from what is kept."""
    frames = [frame(i, hwp) for i, hwp in enumerate([0.0, 90.0, 180.0])]
    kept = without_repeats(frames, Reduction(None, "internal"))
    assert [one.values["hwp"] for one in kept] == [0.0, 180.0]


# ---- what is said of the run ---------------------------------------------------------


def modulated(amplitude, n=8, offset=0.1):
    """Return frames whose normalized single difference follows cos 4 hwp about an offset."""
    frames = []
    for i, hwp in enumerate(np.arange(n) * 11.25):
        x = offset + amplitude * np.cos(4 * np.deg2rad(hwp))
        one = frame(i, hwp)
        one.photometry.flux[:] = [[1 + x], [1 - x]] * np.array([1e3])
        frames.append(one)
    return frames


def seen_source(frames):
    """Return what the fluxes of CHARIS say of its lamp."""
    from astropolcal.reduction.run import _seen_source

    return _seen_source(frames, instruments.get("charis"))


def test_modulation_tells_a_polarized_lamp():
    for amplitude, seen in [
        (0.9, "polarized"),
        (0.42, "polarized"),
        (0.3, None),
        (0.14, "unpolarized"),
        (0.0, "unpolarized"),
    ]:
        assert seen_source(modulated(amplitude)) == seen, (amplitude, seen)
        # an offset that no plate changes is no modulation
        assert seen_source(modulated(amplitude, offset=0.0)) == seen, (amplitude, seen)


def test_few_angles_tell_nothing():
    assert seen_source(modulated(0.9, n=3)) is None


def test_failed_slices_do_not_tell():
    frames = modulated(0.9)
    for one in frames:
        one.photometry.flux[:, 1] = [1.0, 1.0]
        one.photometry.flag([False, True], "saturated")
    assert seen_source(frames) == "polarized"


def test_headers_tell_optics_by_the_first_pattern_that_is_found():
    from astropolcal.reduction.run import _optic

    words = {"nothing": "out", "JH": "in"}
    layout = SimpleNamespace(optics={"dichroic": ("pickoff", words), "stop": ("mask", {"x": "in"})})
    for pickoff, word in (("JH nothing", "out"), ("JH", "in"), ("K", None), (None, None)):
        one = frame(1, **({"pickoff": pickoff} if pickoff else {}))
        assert (_optic(layout, "dichroic", one), _optic(layout, "stop", one)) == (word, None)
