# Licensed under a 3-clause BSD style license - see LICENSE
"""Perturbations and their dependences on the frame; their matrices are in the registry's laws."""

import astropy.units as u
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from astropolcal import optics
from astropolcal.exceptions import ParameterError
from astropolcal.mueller import is_physical, rotate
from astropolcal.observations import Observations, example_table
from astropolcal.optics import Perturbation
from astropolcal.optics.perturbations import GENERATORS, Dependence, split_run

GOOD = [
    *("constant", "time", "time2", "step:12", "frame:3", "harmonic:hwp:2", "harmonic:derotator:4"),
    *("direction:hwp", "move:derotator", "dataset:July 15", "dataset:a:b"),
]


@given(st.sampled_from(sorted(GENERATORS)), st.floats(-2, 2), st.floats(-1, 1))
def test_a_perturbation_is_the_exponential_of_its_generator(kind, size, t):
    optic = Perturbation(amplitude=size, kind=kind, dependence="time", name="one")
    found = optic.mueller(position=(t + 1) / 2)
    if kind == "gain":
        np.testing.assert_allclose(found, (1 + size * t) * np.eye(4), atol=1e-12)
    else:
        np.testing.assert_allclose(found, expm(size * t * GENERATORS[kind]), atol=1e-12)
    if kind.startswith(("retardance", "rotation", "diattenuation")):
        assert is_physical(found / found[0, 0])


def test_generators_are_the_first_order_of_known_optics():
    """Simulated challenges and the diagnosis share them: nothing else would show a wrong one."""
    h = 1e-6
    known = {
        "retardance_h": optics.LinearRetarder(retardance=h * u.rad),
        "retardance_d": optics.LinearRetarder(retardance=h * u.rad, theta=45 * u.deg),
        "rotation": optics.Rotator(theta=h * u.rad),
        "diattenuation_h": optics.Diattenuator(diattenuation=h),
        "diattenuation_d": optics.Diattenuator(diattenuation=h, theta=45 * u.deg),
        "depolarization_linear": optics.Depolarizer(retained_q=1 - h, retained_u=1 - h),
        "depolarization_circular": optics.Depolarizer(retained_v=1 - h),
    }
    slopes = {kind: (optic.mueller(1.6 * u.um) - np.eye(4)) / h for kind, optic in known.items()}
    # Q is lost and U is won, as a loss of Q alone is beside one of both
    slopes["depolarization_h"] = np.diag([0.0, -1.0, 1.0, 0.0])
    slopes["depolarization_d"] = rotate(slopes["depolarization_h"], 22.5 * u.deg)
    slopes["diattenuation_c"] = np.fliplr(np.diag([1.0, 0.0, 0.0, 1.0]))
    assert slopes.keys() | {"gain"} == GENERATORS.keys()
    for kind, slope in slopes.items():
        np.testing.assert_allclose(slope, GENERATORS[kind], atol=1e-5, err_msg=kind)


def test_dependences_have_their_functions_and_drivers():
    x = np.array([0.0, 0.25, 1.0])
    turn = Dependence("harmonic:hwp:2").waves(x)
    np.testing.assert_allclose(turn, [np.cos(2 * x), np.sin(2 * x)])
    np.testing.assert_allclose(Dependence("time").waves(x), [[-1, -0.5, 1]])
    # a bend has no drift in it
    np.testing.assert_allclose(Dependence("time2").waves(x), [[2 / 3, 1 / 4 - 1 / 3, 2 / 3]])
    frames = np.arange(5.0)
    np.testing.assert_array_equal(Dependence("step:3").waves(frames), [[0, 0, 0, 1, 1]])
    np.testing.assert_array_equal(Dependence("frame:3").waves(frames), [[0, 0, 0, 1, 0]])
    drivers = {
        "constant": None,
        "time": "sequence",
        "step:3": "frame",
        "harmonic:derotator:4": "derotator",
        "direction:hwp": "hwp_direction",
        "move:derotator": "derotator_move",
        "dataset:July": None,
    }
    for text, driver in drivers.items():
        assert Dependence(text).driver == driver
        assert Perturbation(dependence=text).mount == driver
        for other in (None, "hwp_true") if driver else ():
            with pytest.raises(ParameterError, match="follows"):
                Perturbation(dependence=text, mount=other)
            with pytest.raises(ParameterError, match="follows"):
                Perturbation(dependence=text).mount = other
    assert Perturbation(dependence="harmonic:hwp:2", mount="-hwp").stage_sign == -1


def test_a_dependence_may_be_in_one_run_only():
    for text in GOOD:
        one = Dependence(text)
        assert len(one.waves(np.zeros(3))) == one.count
        if not text.startswith("dataset"):
            run = Dependence(f"{text}/dataset:July")
            assert (one.run, run.run) == (None, "July")
            assert (run.kind, run.driver, run.count) == (one.kind, one.driver, one.count)
            assert split_run(run.text) == (text, "July")


def test_nonsense_is_refused():
    bad = ["", "always", "time3", "step", "step:", "step:-1", "step:1.5", "harmonic:hwp"]
    bad += ["harmonic:hwp:0", "harmonic:hwp:100", "direction", "move:", "dataset:", "time:hwp"]
    for text in [*bad, None, 3, ["time"]]:
        with pytest.raises(ParameterError, match="allowed are constant, time, time2, step:FRAME"):
            Dependence(text)
    with pytest.raises(ParameterError, match=r"'retardance_x'.*retardance_h"):
        Perturbation(kind="retardance_x")
    with pytest.raises(ParameterError, match="dependence = 'sometimes'"):
        Perturbation(dependence="sometimes")


def test_positions_of_moves_are_those_of_the_last_move():
    table = example_table()
    observations = Observations.from_table(table)
    n = observations.n_frames
    np.testing.assert_array_equal(observations.position("frame"), np.arange(n))
    plate = observations.position("hwp")
    moves = np.diff(plate, prepend=plate[:1])
    np.testing.assert_allclose(observations.position("hwp_move"), moves)
    # what stays was last moved as before; nothing is known before the first frame
    expected, last = [], 0.0
    for move in moves:
        last = move or last
        expected.append(float(last < 0))
    np.testing.assert_array_equal(observations.position("hwp_direction"), expected)
    # frames are in the order of their times, whatever their order in the table
    times = np.linspace(1, 0, n)
    size = observations.n_bins
    table["time"] = np.repeat(times, len(table) // n) if len(table) == n * size else times
    back = Observations.from_table(table).position("hwp_move")
    np.testing.assert_allclose(back[::-1], np.diff(plate[::-1], prepend=plate[-1:]))
