# Licensed under a 3-clause BSD style license - see LICENSE
"""Directions in the space of the parameters, made up so that every number in the words is known."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import optics
from astropolcal.calibration.identifiability.analysis import (
    Identifiability,
    finding_of,
    telescope_words,
)
from astropolcal.calibration.identifiability.linearized import (
    LARGE,
    Whitened,
    first_of_each_kind,
    led,
    near_null_directions,
    open_directions,
)
from astropolcal.measurement import Normal
from astropolcal.measurement.parameters import FreeParameters, Uniform, declared_step, step_of

N = 3
NAMES = ["polarizer.theta", "hwp.w_sio2", *(f"retarder.retardance[{i}]" for i in range(N))]
NAMES += [f"wollaston.efficiency[{i}]" for i in range(N)]


def _free(prior=None):
    """An angle and a thickness common to all wavelengths, two parameters for each of three."""
    polarizer = optics.LinearPolarizer(name="polarizer", fixed={"theta": False})
    polarizer.theta.prior = prior
    hwp = optics.TwoLayerWaveplate(name="hwp", fixed={"w_mgf2": True})
    chain = polarizer | hwp
    chain = chain | optics.LinearRetarder(retardance=[90.0] * N * u.deg, name="retarder")
    chain = chain | optics.WollastonPrism(efficiency=np.full(N, 0.9), name="wollaston")
    return FreeParameters([chain], N)


@pytest.fixture
def free():
    free = _free()
    assert free.names == NAMES
    return free


def _unit(**parts):
    """A direction in steps; parameters per wavelength take one value for all, or three."""
    vector = np.zeros(len(NAMES))
    slots = {slot.name.replace(".", "_"): slot for slot in _free().slots}
    for key, value in parts.items():
        vector[slots[key].slice] = value
    return vector / np.linalg.norm(vector)


# --- steps -----------------------------------------------------------------------------------


def test_a_step_is_a_degree_a_micrometre_or_a_percent():
    for unit, canonical, declared in [
        (u.deg, np.deg2rad(1), 1),
        (u.rad, np.deg2rad(1), np.deg2rad(1)),
        (u.arcsec, np.deg2rad(1), 3600),
        (u.um, 1, 1),
        (u.mm, 1, 1e-3),
        (u.nm, 1, 1000),
        (None, 0.01, 0.01),
    ]:
        assert step_of(unit)[0] == pytest.approx(canonical)
        assert declared_step(unit) == pytest.approx(declared)


def test_scale_has_the_step_of_every_element(free):
    expected = [np.deg2rad(1), 1, *[np.deg2rad(1)] * N, *[0.01] * N]
    np.testing.assert_allclose(free.steps, expected)


# --- open directions ----------------------------------------------------------------------------


def test_nothing_open_nothing_said(free):
    assert open_directions(free, np.zeros((0, free.size))) == []
    assert list(led(free, np.zeros((0, free.size)))) == []


def test_a_direction_is_led_by_what_all_wavelengths_share(free):
    """By +1 of the leading parameter, whatever the length and sign of the vector."""
    vector = _unit(polarizer_theta=-2, retarder_retardance=[4, 2, -6])
    ((direction),) = open_directions(free, vector[None])
    assert direction["words"] == (
        "polarizer.theta by +1 deg cannot be distinguished from "
        "retarder.retardance by -2 to +3 deg over "
        "the wavelengths"
    )
    assert direction["parameters"]["polarizer.theta"] == pytest.approx(1)
    np.testing.assert_allclose(direction["parameters"]["retarder.retardance"], [-2, -1, 3])


def test_units_are_those_a_user_has_a_feeling_for(free):
    """A step of the efficiency is a percent, told as 0.01; one of a thickness a micrometre."""
    vector = _unit(polarizer_theta=1, hwp_w_sio2=-3, wollaston_efficiency=2)
    (direction,) = open_directions(free, vector[None])
    assert "hwp.w_sio2 by -3 um" in direction["words"]
    assert "wollaston.efficiency by +0.02 to +0.02 over the wavelengths" in direction["words"]
    assert direction["parameters"]["hwp.w_sio2"] == pytest.approx(-3)


def test_each_direction_has_a_leader_that_the_others_leave_alone(free):
    """Whatever basis of the open space is given."""
    first = _unit(polarizer_theta=1, retarder_retardance=1)
    second = _unit(hwp_w_sio2=1, wollaston_efficiency=-1)
    turn = np.array([[0.6, 0.8], [-0.8, 0.6]])
    found = list(led(free, turn @ np.array([first, second])))
    leads = [name for _, name in found]
    assert sorted(leads) == ["hwp.w_sio2", "polarizer.theta"]
    places = [NAMES.index(name) for name in leads]
    np.testing.assert_allclose([v[places] for v, _ in found], np.eye(2), atol=1e-12)
    # still the same space
    space = np.array([first, second])
    for vector, _ in found:
        np.testing.assert_allclose(space.T @ (space @ vector), vector, atol=1e-12)


def test_without_a_common_parameter_a_wavelength_leads(free):
    vector = _unit(retarder_retardance=[0, 1, 0], wollaston_efficiency=[0, 0.5, 0])
    ((_, lead),) = led(free, vector[None])
    assert lead == "retarder.retardance[1]"


def test_what_hardly_moves_is_not_named(free):
    vector = _unit(polarizer_theta=1, hwp_w_sio2=0.01, retarder_retardance=0.5)
    (direction,) = open_directions(free, vector[None])
    assert "hwp.w_sio2" not in direction["words"]
    assert set(direction["parameters"]) == {"polarizer.theta", "retarder.retardance"}


def test_a_parameter_that_changes_nothing():
    for prior, words in [
        (None, "it cannot be determined and keeps its start value"),
        (Uniform(-5 * u.deg, 5 * u.deg), "it cannot be determined and keeps its start value"),
        (Normal(0 * u.deg, 1 * u.deg), "it cannot be determined by them, only its prior tells it"),
    ]:
        (direction,) = open_directions(_free(prior), _unit(polarizer_theta=1)[None])
        assert direction["words"] == f"polarizer.theta changes no datum: {words}"


# --- badly determined directions -----------------------------------------------------------------


def _whitened(free, errors):
    """A problem in which each element has its own error, in steps, for unit noise."""
    return Whitened(np.diag(1 / np.asarray(errors, dtype=float)) / free.steps, free.steps)


def _near(free, errors, level=1.0, sky=None):
    asked = []

    def sky_of(changes):
        asked.append(np.array(changes))
        return [sky] * len(changes)

    return near_null_directions(free, _whitened(free, errors), level, sky_of), asked


def _errors(**large):
    found = dict.fromkeys(NAMES, 0.01)
    found |= large
    return [found[name] for name in NAMES]


def test_good_errors_are_not_worth_a_word(free):
    found, _ = _near(free, _errors())
    assert found == []


def test_the_limit_is_5_deg_50_um_or_5_percent(free):
    """In steps of a degree, a micrometre and a percent."""
    for name, limit, words in [
        ("polarizer.theta", LARGE[" deg"], "polarizer.theta is uncertain by {} deg"),
        ("hwp.w_sio2", LARGE[" um"], "hwp.w_sio2 is uncertain by {} um"),
        ("wollaston.efficiency[1]", 100 * LARGE[""], "wollaston.efficiency[1] is uncertain by {}"),
    ]:
        assert _near(free, _errors(**{name: 0.99 * limit}))[0] == [], (name, words)
        (direction,), _ = _near(free, _errors(**{name: 1.2 * limit}))
        shown = 1.2 * limit / (100 if "efficiency" in name else 1)
        assert direction["words"] == words.format(f"{shown:.2g}") + " at the noise of this fit", (
            name,
            words,
        )


def test_errors_grow_with_the_noise(free):
    assert _near(free, _errors(**{"polarizer.theta": 1.0}))[0] == []
    (direction,), _ = _near(free, _errors(**{"polarizer.theta": 1.0}), level=20.0)
    assert "uncertain by 20 deg" in direction["words"]


def test_the_worst_comes_first_and_goes_up(free):
    found, asked = _near(
        free,
        _errors(**{"polarizer.theta": 7.0, "hwp.w_sio2": 400.0}),
        sky={"aolp_deg": [-0.3, 0.2], "dolp_percent": [1.0, 2.0]},
    )
    assert [next(iter(d["parameters"])) for d in found] == ["hwp.w_sio2", "polarizer.theta"]
    assert found[0]["parameters"]["hwp.w_sio2"] == pytest.approx(400)
    assert (
        "; on sky the AoLP changes by up to 0.3 deg and the DoLP by up to 2 %" in found[0]["words"]
    )
    # asked in canonical units, at one standard error
    np.testing.assert_allclose(asked[0][1][0], np.deg2rad(7))


def test_which_of_two_equal_parameters_leads_does_not_hang_on_rounding(free):
    for rounding in (-1e-12, 1e-12):
        # as large a part of the limit of each, in opposite directions
        vector = _unit(polarizer_theta=-1, hwp_w_sio2=10 + rounding)
        rows = 100 * np.eye(len(NAMES)) - 99.998 * np.outer(vector, vector)
        scale = free.steps
        found = Whitened(rows / scale[:, None], scale)
        (direction,) = near_null_directions(free, found, 1.0, lambda changes: [None] * len(changes))
        assert direction["words"].startswith("polarizer.theta is uncertain by 50 deg")
        assert direction["parameters"]["hwp.w_sio2"] == pytest.approx(-498, abs=1)


def test_a_condition_beyond_ten_thousand_is_told_even_of_small_errors(free):
    errors = np.full(len(NAMES), 1e-6)
    errors[0] = 0.1
    (direction,), _ = _near(free, errors)
    assert "polarizer.theta is uncertain by 0.1 deg" in direction["words"]
    assert "(condition 1e+05)" in direction["words"]


def test_the_sky_is_asked_for_the_worst_six_only(free):
    found, asked = _near(
        free, np.full(len(NAMES), 100.0), sky={"aolp_deg": [1], "dolp_percent": [1]}
    )
    assert len(found) == len(NAMES)
    assert len(asked[0]) == 6
    assert ["sky" in d for d in found] == [True] * 6 + [False] * 2


def test_several_wavelengths_that_are_uncertain_together(free):
    """One direction along which the retardance moves at all wavelengths."""
    vector = _unit(retarder_retardance=1)
    rest = np.eye(len(NAMES)) - np.outer(vector, vector)
    rows = 100 * rest + np.outer(vector, vector) / 20
    found = Whitened(rows / free.steps, free.steps)
    (direction,) = near_null_directions(free, found, 1.0, lambda changes: [None] * len(changes))
    # 20 in all, shared by three
    expected = f"{20 / np.sqrt(3):.2g}"
    assert direction["words"] == (
        f"retarder.retardance is uncertain by {expected} to {expected} deg at 3 wavelengths "
        "together at the noise of this fit"
    )


# --- the finding -----------------------------------------------------------------------------


def test_silent_parameters_are_axes_of_the_null_space(free):
    data = np.random.default_rng(1).normal(size=(free.size, 40))
    data[3] = 0
    data[0] = data[1]
    scale = free.steps
    whitened = Whitened(data / scale[:, None], scale)
    finding, covariance = finding_of(free, whitened), whitened.covariance()
    assert finding.silent == [NAMES[3]]
    assert finding.rank == free.size - 2
    assert np.flatnonzero(~finding.identifiable).tolist() == [0, 1, 3]
    assert np.isnan(np.diag(covariance)).nonzero()[0].tolist() == [0, 1, 3]
    assert "polarizer.theta by +1 deg cannot be distinguished from hwp.w_sio2 by -1 um" in str(
        finding
    )


def test_a_finding_reads_as_a_list():
    finding = Identifiability(["a.b"], 0, np.zeros(1), np.ones((1, 1)), np.zeros(1, bool))
    finding.directions, finding.near_null = [{"words": "open"}], [{"words": "weak"}]
    finding.sampling, finding.mirrors = ["few angles"], ["other sign"]
    assert str(finding).splitlines() == [
        "The data determine 0 combinations of 1 free parameters.",
        "  - open",
        "  - badly determined: weak",
        "  - few angles",
        "  - mirror solution: other sign",
    ]


def _alike(count, name="m.d", other="w.e"):
    return [
        {
            "words": f"{name}[{i}] by +0.01 cannot be distinguished from {other}",
            "parameters": {name: 0.0},
        }
        for i in range(count)
    ]


def test_open_directions_that_differ_by_wavelength_are_counted():
    for count, more in [(3, 0), (4, 0), (5, 2), (22, 19)]:
        other = {
            "words": "hwp.theta by +1 deg cannot be distinguished from w.e",
            "parameters": {"w.e": 1.0},
        }
        alone = {"words": "m.d[9] changes no datum", "parameters": {"m.d": 1.0, "x.y": 1.0}}
        words = first_of_each_kind([other, *_alike(count), alone])
        assert words[0] == other["words"], (count, more)
        assert words[-1] == alone["words"], (count, more)
        told = [line for line in words if line.startswith("m.d[") and line != alone["words"]]
        assert len(told) + more == count, (count, more)
        says = [f"and {more} more of the same kind"] if more else []
        assert [line for line in words if "of the same kind" in line] == says, (count, more)


def test_directions_of_parameters_for_all_wavelengths_are_all_told():
    many = [{"words": f"o{i}.theta by +1 deg", "parameters": {"p.theta": 1.0}} for i in range(6)]
    assert first_of_each_kind(many) == [one["words"] for one in many]


# --- the telescope ---------------------------------------------------------------------------


def _sky_measurement(*, with_plate=True, at_bound=()):
    from types import SimpleNamespace

    optics_in = [optics.Rotator(mount="parallactic", name="parallactic")]
    optics_in += [optics.MetalMirror(name="m3"), optics.Rotator(mount="altitude", name="altitude")]
    optics_in += [optics.Diattenuator(name="window")]
    if with_plate:
        optics_in.append(optics.LinearRetarder(mount="hwp", name="hwp"))
    optics_in.append(optics.WollastonPrism(name="wollaston"))
    chain = optics_in[0]
    for optic in optics_in[1:]:
        chain = chain | optic
    names = ["m3.thickness", "window.diattenuation", "wollaston.efficiency"]
    free = SimpleNamespace(
        names=names, at_bounds=lambda vector: np.array([n in at_bound for n in names])
    )
    return SimpleNamespace(chains=[chain], datasets=[None], free=free, vector=lambda: np.zeros(3))


def _finding(*names):
    from types import SimpleNamespace

    directions = [{"parameters": dict.fromkeys(names, 1.0)}]
    return SimpleNamespace(directions=directions, near_null=[])


def test_open_mirrors_of_the_telescope_are_told_what_would_help():
    (words,) = telescope_words(_finding("m3.thickness", "hwp.theta"), _sky_measurement())
    assert words.startswith("m3.thickness: an unpolarized star shows the diattenuation of m3 and")
    # with a plate the telescope ends there, without one at the altitude axis
    assert len(telescope_words(_finding("window.diattenuation"), _sky_measurement())) == 1
    bare = _sky_measurement(with_plate=False)
    assert telescope_words(_finding("window.diattenuation"), bare) == []
    # its orientation turns with all others, which the directions say
    assert telescope_words(_finding("m3.theta", "hwp.theta"), _sky_measurement()) == []


def test_what_ran_to_its_bound_counts_as_open():
    (words,) = telescope_words(_finding(), _sky_measurement(at_bound=["m3.thickness"]))
    assert words.startswith("m3.thickness: ")
    assert telescope_words(_finding("wollaston.efficiency"), _sky_measurement()) == []
