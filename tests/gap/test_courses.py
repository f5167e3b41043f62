# Licensed under a 3-clause BSD style license - see LICENSE
"""One perturbation of any course through the run, in place of several causes."""

import astropy.units as u
import gap_data as data
import numpy as np
import pytest

from astropolcal.gap.cells import Probes
from astropolcal.gap.challenge import Setup, make_challenge, score_answer
from astropolcal.gap.courses import courses
from astropolcal.gap.diagnosis import diagnose
from astropolcal.gap.problem import law_basis
from astropolcal.gap.report import to_dict
from astropolcal.observations import Observations
from astropolcal.simulation import half_wave_plate_cycles


def answered(seed, **how):
    """Return diagnosis, JSON and score of a challenge."""
    observations, chains, case = make_challenge(seed, **how)
    diagnosis = diagnose(chains, observations)
    content = to_dict(diagnosis)
    return diagnosis, content, score_answer(case, content)


def test_a_course_is_the_least_squares_solution_of_one_size_in_every_frame():
    model = data.fitted(
        data.observed(data.with_effect("derotator_diattenuation", diattenuation=0.01))
    )
    probes = Probes(model)
    channel, rows = probes.problem.channels[0], probes.problem.segments[0]
    basis, smooth = (law_basis(probes.problem.wavelength, degree) for degree in (4, 2))
    for one in courses(model, model)[::9]:
        slope = probes.slopes[one.place, one.kind][0]
        sizes = one.law[probes.problem.datasets[0].bins][:, None]
        each = np.eye(slope.shape[2])
        if one.stage:
            # frames at one angle have one size
            each = each[one.settings[0]].T
            each = each[each.any(axis=1)]
        length = [np.linalg.norm(channel.whiten_frames(slope * sizes * one)) for one in each]
        # a column of its own for each frame that tells it, of unit length before what lamp and
        # model absorb is taken out
        frames = np.flatnonzero(np.square(length) > 1e-6 * np.max(length) ** 2)
        table = np.zeros((len(probes.residual), len(frames)))
        for i, frame in enumerate(frames):
            column = slope * sizes * each[frame] / length[frame]
            table[rows, i] = channel.whiten(column).ravel()
        table -= probes.tangent @ (probes.tangent.T @ table)
        left, strength, _ = np.linalg.svd(table, full_matrices=False)
        told = left[:, strength > 1e-3].T @ probes.residual
        rank = len(told)
        assert one.lowered == pytest.approx(told @ told, rel=1e-6), one.words
        assert one.freedom == rank + (smooth if one.stage else basis).shape[1] - 1, one.words


def test_frames_wavelengths_and_beam_of_a_course_are_found():
    clean, number = data.observed(), np.arange(data.observed().n_frames)
    middle = np.isin(np.arange(clean.n_bins), (2, 3))
    for beam, course, law, words in (
        ("right", (number > 9) & (number < 19), middle, ["in frames 10-18", "at 1450-1620 nm"]),
        ("left", (number > 12) + 2.0 * (number > 23), 1, ["with steps at frames 13 and 24"]),
        ("right", np.cos(2 * np.pi * number / 7.3), 1, ["with a period of about 7 frames"]),
        ("left", number > 19, middle, ["from frame 20 on", "at 1450-1620 nm"]),
    ):
        table = clean.to_table()
        factor = 1 + 0.04 * np.multiply.outer(course, law * np.ones(clean.n_bins))
        table[f"flux_{beam}"] *= factor.ravel()
        model = data.fitted(Observations.from_table(table, name="lamp"))
        found = courses(model, model)
        # light that is added to one beam at these wavelengths looks nearly the same
        one = next(one for one in found if one.kind == f"gain_of_{beam}_beam")
        assert found[0].gained - one.gained < 2 * np.sqrt(2 * one.freedom), words
        assert one.lowered > 0.99 * found[0].lowered, words
        one.find_shape(model)
        assert one.shape.split(", ") == words


def test_what_is_the_same_in_all_frames_is_no_course():
    seen = data.observed()
    model = data.fitted(data.with_flux(seen, np.full(seen.n_frames, 1.02)))
    found = courses(model, model)
    assert ("detector", "gain") not in [(one.place, one.kind) for one in found]
    # of one that does what a constant does all is no part of the run
    for one in found[:20]:
        one.find_shape(model)
        assert "frame 0 on" not in one.shape


@pytest.mark.slow
def test_what_follows_a_stage_in_a_way_that_no_harmonic_does_has_no_name():
    """Half of what a move leaves behind is gone at the next: nearly an error of the encoder."""
    table = half_wave_plate_cycles(derotator=np.linspace(45, 120, 12) * u.deg)
    told = table["hwp"].copy()
    moves, left = np.diff(told.to_value("rad"), prepend=told[0].to_value("rad")), [0.0]
    for move in moves[1:]:
        left.append(left[-1] / 2 + move)
    for error, size, named in ((np.cos(told + 23 * u.deg), 0.15, True), (left, 0.08, False)):
        table["hwp"] = told + size * np.asarray(error) * u.deg
        seen = data.observed(table=table)
        written = seen.to_table()
        written["hwp"] = np.repeat(told, seen.n_bins)
        diagnosis = diagnose(data.chain(), Observations.from_table(written, name="lamp"))
        sure = diagnosis.causes[0].probability
        assert (sure > 0.95, sure < 0.3, diagnosis.courses == []) == (named, not named, named)
    best = next(one for one in diagnosis.courses if one.kind == "orientation")
    assert (best.place, best.stage) == ("in:hwp", "hwp")
    assert best.shape == "one size at each angle of the half-wave plate"
    for wave in best.wave:
        assert np.ptp([wave[told == angle] for angle in np.unique(told)], axis=1).max() == 0


@pytest.mark.long
def test_what_changes_in_a_way_that_no_table_has_is_located_and_not_named():
    # as few wavelengths and angles as tell the course from the causes of the table
    for seed, small, course, place, kind in (
        (3, (7, 8), "both stages", "after:hwp", "diattenuation_d"),
        (4, (4, 6), "swings", "in:derotator", "retardance_h"),
        (4, (5, 6), "third harmonic", "after:derotator", "diattenuation_h"),
    ):
        how = {"kind": "mechanism", "snr": 20, "setup": Setup("charis", None, *small)}
        how["fault"] = {"what": "course", "course": course, "place": place, "kind": kind}
        diagnosis, content, score = answered(seed, **how)
        assert score == "right", course
        assert max((cause.probability for cause in diagnosis.causes), default=0) < 0.5, course
        where = [(one.place, one.kind) for one in diagnosis.courses]
        assert (place, kind) in where, (course, where)
        assert content["verdict"] == "unexplained"
        assert content["where"][0]["share"] > 0.9, course
        assert any("course through the run" in line for line in content["sentences"]), course
        cells = [one["cell"] for one in content["where"] if one["axis"] == "course"]
        assert {"place": place, "kind": kind, "dependence": None} in cells, course


@pytest.mark.long
def test_two_causes_are_no_course():
    diagnosis, _, score = answered(5, kind="pair", snr=40)
    assert (score, len(diagnosis.causes), diagnosis.courses) == ("right", 2, [])
    assert min(cause.probability for cause in diagnosis.causes) > 0.9
