# Licensed under a 3-clause BSD style license - see LICENSE
"""Nodes of calibrations: what they hold, and what is refused in them whatever the checksum says."""

import copy
import dataclasses
import io
import json
import re

import asdf
import astropy.units as u
import numpy as np
import pytest

from astropolcal import Calibration, calibrate, optics
from astropolcal.calibration.uncertainty.covariance import Covariance
from astropolcal.converters import calibration as converter
from astropolcal.converters.calibration import (
    MIGRATIONS,
    calibration_from_node,
    check_calibration,
    node_from_calibration,
)
from astropolcal.converters.extension import CALIBRATION_TAG, CALIBRATION_TAGS, CalibrationConverter
from astropolcal.converters.nodes import value_from_node
from astropolcal.exceptions import AstropolcalWarning, CalibrationFileError
from astropolcal.measurement import Normal, Tie
from astropolcal.simulation import half_wave_plate_cycles, simulate

pytestmark = pytest.mark.usefixtures("kept_schemas")

LAM = [1.2, 1.6] * u.um


@pytest.fixture(scope="module")
def original():
    """A calibration with units, bounds, a tie with an offset, fixed, open and masked things."""
    chain = (
        optics.LinearPolarizer(theta=90 * u.deg, name="polarizer", fixed={"theta": True})
        | optics.LinearRetarder(retardance=[171, 174] * u.deg, mount="hwp", name="hwp")
        | optics.LinearRetarder(retardance=-100 * u.deg, mount="derotator", name="derotator")
        | optics.WollastonPrism(
            efficiency=0.98, name="wollaston", bounds={"efficiency": (0.9, None)}
        )
    )
    chain["hwp"].theta.fixed = False
    chain["derotator"].retardance.prior = Normal(-100 * u.deg, 60 * u.arcmin)
    frames = half_wave_plate_cycles(derotator=[45, 60, 80, 100] * u.deg)
    data = simulate(chain, LAM, frames, seed=1, meta={"instrument": "bench", "date": "2025-05-01"})
    table = data.to_table()
    table["flux_right"][3] = np.nan
    with pytest.warns(AstropolcalWarning, match="1 cell masked"):
        data = type(data).from_table(table, name="night")
    ties = {"derotator.theta": Tie("hwp.theta", -0.5, 3 * u.arcmin)}
    return calibrate(chain, data, ties=ties, instrument="bench", strategy="two-step")


@pytest.fixture
def cal(original):
    """A copy that a test may spoil."""
    return dataclasses.replace(
        original,
        chains=[chain.copy() for chain in original.chains],
        at_bound=list(original.at_bound),
        datasets=[dataclasses.replace(r, meta=dict(r.meta)) for r in original.datasets],
        fit=copy.deepcopy(original.fit),
    )


@pytest.fixture
def node(original):
    return node_from_calibration(original)


def sealed(node):
    """Return a node with the checksum of its content, as somebody who forges it would."""
    return node | {"checksum": converter._checksum(node)}


def refused(node, words):
    with pytest.raises(CalibrationFileError, match=words) as caught:
        calibration_from_node(sealed(node))
    assert "\n" not in str(caught.value)


# ---- round trips -----------------------------------------------------------------------


def test_all_of_it_comes_back(original, node):
    again = calibration_from_node(copy.deepcopy(node))
    assert again.to_dict() == original.to_dict()
    assert again.summary() == original.summary()
    hwp, derotator, wollaston = (again.chain[n] for n in ("hwp", "derotator", "wollaston"))
    assert hwp.retardance.unit == u.deg
    assert hwp.retardance.shape == (2,)
    assert hwp.theta.fixed is False
    assert again.chain["polarizer"].theta.fixed is True
    assert wollaston.efficiency.bounds == (0.9, None)
    assert derotator.retardance.prior.std == 60 * u.arcmin
    assert derotator.retardance.prior.std.unit == u.arcmin
    tie = again.ties["derotator.theta"]
    assert (tie.source, tie.factor, tie.offset.unit) == ("hwp.theta", -0.5, u.arcmin)
    assert again.datasets[0].n_masked == original.datasets[0].n_masked == 1
    assert again.measurement is None
    assert node_from_calibration(again)["checksum"] == node["checksum"]


@pytest.mark.slow
def test_through_a_file_of_asdf(original):
    """As a part of any tree, beside other things and twice."""
    buffer = io.BytesIO()
    tree = {"night": original, "others": [original], "note": "x"}
    asdf.AsdfFile(tree).write_to(buffer)
    buffer.seek(0)
    with asdf.open(buffer, lazy_load=False, memmap=False) as file:
        assert isinstance(file["night"], Calibration)
        assert file["others"][0] is file["night"]
        assert file["night"].to_dict() == original.to_dict()


def test_offset_of_a_tie_without_a_unit(original):
    """A number of its own type, as it was given."""
    ties = {"derotator.theta": dataclasses.replace(original.ties["derotator.theta"], offset=0.25)}
    one = converter._tie_node("derotator.theta", ties["derotator.theta"])
    assert one["offset"] == {"value": 0.25}
    again = value_from_node(one["offset"])
    assert type(again) is float
    assert again == 0.25


def test_what_is_for_readers_only_is_not_in_the_checksum(node):
    for key in ["validity", "written_with"]:
        calibration_from_node(copy.deepcopy(node) | {key: {"anything": 1}})


def test_everything_else_is(node):
    """Another value of a part is noticed, also where it would be possible."""
    for key in ["chains", "wavelength", "covariance", "fit", "ties", "priors"]:
        other = copy.deepcopy(node)
        part = other[key]
        if key == "wavelength":
            part["value"] = part["value"] * (1 + 1e-15)
        elif key == "chains":
            part[0]["optics"][1].retardance.value = [171.0, 175.0]
        elif key == "covariance":
            part["matrix"][0, 0] *= 1 + 4e-16
        elif key == "fit":
            part["n_data"] = 7
        else:
            del part[0]
        with pytest.raises(
            CalibrationFileError, match="does not match its checksum: it was changed"
        ):
            calibration_from_node(other)


# ---- what is refused in spite of a right checksum ------------------------------------------


def test_entries_of_one_name(node):
    for key, place, words in [
        ("accuracy", None, "column .* is given twice"),
        ("ties", 0, "'derotator.theta' is given twice"),
        ("stages", None, "is given twice"),
        ("directions", None, "is given twice"),
        ("priors", 0, "prior of 'derotator.retardance' is given twice"),
    ]:
        spoiled = copy.deepcopy(node)
        if key == "accuracy":
            table = spoiled["datasets"][0]["accuracy"]
            table.append(table[0])
        elif key == "directions":
            entry = {"words": "x", "parameters": [{"name": "a", "value": 1.0}] * 2}
            spoiled["identifiability"]["directions"].append(entry)
        elif key == "stages":
            spoiled["stages"][0]["parameters"].append(spoiled["stages"][0]["parameters"][0])
        else:
            spoiled[key].append(spoiled[key][place])
        refused(spoiled, words)


def test_a_value_with_something_else(node):
    node = copy.deepcopy(node)
    node["wavelength"]["factor"] = 1000.0
    refused(node, "a value with 'factor', which means nothing here")


def test_units_with_a_factor(node):
    """They would be read as something else than is written next time."""
    for unit in ["1e-3 um", "-1e308", "2", "0.5 deg"]:
        spoiled = copy.deepcopy(node)
        spoiled["stages"][0]["parameters"][0]["unit"] = unit
        refused(spoiled, "a unit without a factor is needed")


def test_wavelengths_that_are_none(node):
    for wavelength, words in [
        ({"value": 1.6, "unit": "um"}, "must be a list of positive lengths"),
        ({"value": [1.2, -1.6], "unit": "um"}, "must be a list of positive lengths"),
        ({"value": [1.2, np.nan], "unit": "um"}, "must be a list of positive lengths"),
        ({"value": [[1.2, 1.6]], "unit": "um"}, "must be a list of positive lengths"),
    ]:
        refused(node | {"wavelength": wavelength}, words)


def test_a_factor_of_another_shape(node):
    """Of as many numbers: it must not be laid out as it fits."""
    factor = node["covariance"]["factor"][:2]
    for other in (factor.T, factor.ravel(), factor[..., None]):
        spoiled = copy.deepcopy(node)
        spoiled["covariance"]["factor"] = other
        refused(spoiled, r"factor of the covariance has shape \(.*\); \(rank, \d+\) is needed")


# ---- values -----------------------------------------------------------------------------


def test_values_outside_of_their_bounds_are_refused(cal):
    for optic, key, value, words in [
        # bounds 0.9 and up
        ("wollaston", "efficiency", -0.99, "wollaston.efficiency = -0.99 is outside of its bounds"),
        ("wollaston", "efficiency", 0.9 - 1e-6, "outside of its bounds, 0.9 to 1e"),
        ("wollaston", "efficiency", 1e16, "outside of its bounds"),
        ("wollaston", "efficiency", np.nan, "wollaston.efficiency = nan is outside"),
        ("derotator", "retardance", 360.001, "outside of its bounds, -360 to 360"),
        ("hwp", "retardance", [171.0, -361.0], r"hwp.retardance = \[ +171. -361.\]"),
        # held: the bounds are those of the optic
        ("polarizer", "theta", 181.0, "polarizer.theta = 181.0"),
    ]:
        getattr(cal.chains[0][optic], key).value = value
        with pytest.raises(CalibrationFileError, match=words):
            check_calibration(cal)
        with pytest.raises(CalibrationFileError, match=words):
            node_from_calibration(cal)


def test_values_at_their_bounds_are_kept(cal):
    """As exactly as rounding allows; and what is held is not bound by the range of a fit."""
    chain = cal.chains[0]
    chain["polarizer"].theta.bounds = (-5, 5)
    for optic, key, value in (
        ("wollaston", "efficiency", 0.9 * (1 - 1e-12)),
        ("derotator", "retardance", -360.0 * (1 + 1e-12)),
        ("polarizer", "theta", 90.0),
    ):
        getattr(chain[optic], key).value = value
        check_calibration(cal)


# ---- parts that do not belong together ---------------------------------------------------


def change(**settings):
    def spoil(cal):
        for key, value in settings.items():
            setattr(cal, key, value)

    return spoil


def spoiled_accuracy(name, values):
    def spoil(cal):
        table = cal.datasets[0].accuracy.copy()
        table[name] = values
        cal.datasets[0].accuracy = table

    return spoil


def errors_of_the_model(absolute):
    known = {"wavelength_nm": [1200.0, 1600.0], "relative_percent": [1.0, 1.0]}
    return known | {"absolute_percent": absolute}


def test_accounts_of_a_fit_that_no_schema_allows(cal, tmp_path):
    outlier = {"frames": "1 2", "dataset": "a", "residual_percent": 1, "brightness": 1}
    bound = {"times": 1.0, "slack": 1.0, "by": []}
    for key, value in [
        ("masked", {"a": 1}),
        ("masked", ["x"]),
        ("outliers", {"a": 1}),
        ("outliers", [outlier]),
        ("outliers", [outlier | {"sigma": "x"}]),
        ("bounds", []),
        ("bounds", {"inward": {"hwp.theta": "x"}}),
        ("bounds", {"released": {"hwp.theta": bound}}),
        ("sky_settings", {"derotator": []}),
        ("sky_settings", {"derotator": ["x"]}),
        ("model_error", errors_of_the_model([-1.0, 1.0])),
        ("model_error", {"wavelength_nm": [1200.0]}),
        ("sky_accuracy", [{"wavelength_nm": [1200.0]}]),
    ]:
        spoiled = copy.deepcopy(cal)
        spoiled.fit[key] = value
        with pytest.raises(CalibrationFileError, match=f"invalid at .*fit.{key}"):
            spoiled.write(tmp_path / "spoiled.asdf")


def test_parts_that_do_not_belong_together(cal):
    for spoil, words in [
        (lambda c: c.chains.append(c.chains[0]), "2 chains but 1 datasets"),
        (change(at_bound=["hwp.thickness"]), "at_bound names 'hwp.thickness', which is not a free"),
        (lambda c: c.fit.update(sky_settings={"derotator": [np.nan]}), "must be finite"),
        (lambda c: c.fit.update(model_error=errors_of_the_model([1.0])), "of equal length"),
        (spoiled_accuracy("s_res", [["x"], ["y"]]), "s_res is not a list of numbers"),
        (spoiled_accuracy("s_cv", [[1.0], [2.0]]), "s_cv is not a list of numbers"),
        (spoiled_accuracy("s_mean", [1, 2] * u.deg), "s_mean is in deg, which is not a fraction"),
        (spoiled_accuracy("wavelength", [1, 2] * u.deg), "must be positive lengths"),
        (spoiled_accuracy("wavelength", [1, -2] * u.um), "must be positive lengths"),
    ]:
        spoiled = copy.deepcopy(cal)
        spoil(spoiled)
        with pytest.raises(CalibrationFileError, match=words):
            check_calibration(spoiled)


def test_parameters_in_another_order(cal):
    c, finding = cal.covariance, cal.identifiability
    names = [c.names[1], c.names[0], *c.names[2:]]
    units = [c.units[1], c.units[0], *c.units[2:]]
    assert finding.names == c.names
    for part, other in (
        ("covariance", Covariance(names, units, c.matrix)),
        ("identifiability", dataclasses.replace(finding, names=names)),
    ):
        words = re.escape(f"{part} of '{names[0]}', where '{names[1]}' is free in the chains")
        with pytest.raises(CalibrationFileError, match=words):
            check_calibration(dataclasses.replace(cal, **{part: other}))


def test_a_covariance_in_other_units(cal):
    c = cal.covariance
    cal.covariance = Covariance(c.names, [u.arcmin, *c.units[1:]], c.matrix)
    with pytest.raises(CalibrationFileError, match="is in arcmin, allowed is deg"):
        check_calibration(cal)


def test_one_optic_of_two_chains_has_one_value(cal):
    other = cal.chains[0].copy()
    other["hwp"].theta.value += 1e-9
    cal.chains, cal.datasets = [cal.chains[0], other], cal.datasets * 2
    with pytest.raises(CalibrationFileError, match=r"hwp.theta has different values in different"):
        check_calibration(cal)


def test_numbers_of_the_identifiability_are_finite(cal, node):
    """And what else is infinite in a file does not keep its JSON from being written."""
    finding = cal.identifiability
    n = len(finding.names)
    for change in (
        {"singular_values": np.array([np.inf, *finding.singular_values[1:]])},
        {"rank": n - 1, "null_vectors": np.full((1, n), np.nan)},
        {"directions": [{"words": "open", "parameters": {finding.names[0]: [0.1, -np.inf]}}]},
        {"near_null": [{"words": "near", "parameters": {}, "sky": {"dolp_percent": [np.nan]}}]},
    ):
        cal.identifiability = dataclasses.replace(finding, **change)
        with pytest.raises(CalibrationFileError, match=r"identifiability: .* must be finite"):
            check_calibration(cal)
    again = calibration_from_node(sealed(node | {"fit": node["fit"] | {"seconds": np.inf}}))
    assert json.loads(json.dumps(again.to_dict(), allow_nan=False))["seconds"] is None


# ---- versions ----------------------------------------------------------------------------


def test_tags():
    one = CalibrationConverter()
    assert tuple(one.tags) == CALIBRATION_TAGS
    assert one.select_tag(None, one.tags, None) == CALIBRATION_TAG == CALIBRATION_TAGS[-1]
    assert set(MIGRATIONS) == set(CALIBRATION_TAGS[:-1])


def test_a_node_of_the_first_version(original, node):
    """An entry of settings named validity meant nothing then, whatever it said."""
    old = copy.deepcopy(node)
    old["settings"] = old["settings"] | {"validity": "of somebody else"}
    again = calibration_from_node(sealed(old), CALIBRATION_TAGS[0])
    assert "validity" not in again.settings
    assert again.to_dict() == original.to_dict()
    with pytest.raises(CalibrationFileError):
        calibration_from_node(sealed(old), CALIBRATION_TAG)
    # migrations do not change what they are given
    before = dict(node["settings"])
    MIGRATIONS[CALIBRATION_TAGS[0]](node)
    assert node["settings"] == before


# ---- tags and types in the tree ------------------------------------------------------------


def text_of(original):
    buffer = io.BytesIO()
    with asdf.config_context() as config:
        config.array_inline_threshold = 10_000
        asdf.AsdfFile({"calibration": original}).write_to(buffer)
    return buffer.getvalue()


@pytest.mark.slow
def test_one_clear_error_for_what_is_out_of_place(original, tmp_path):
    for old, new in [
        (b"optics/linear_retarder-1.0.0", b"optics/linear_polarizer-1.0.0"),
        (b"optics/linear_retarder-1.0.0", b"optics/unheard_of-1.0.0"),
        (b"optics/linear_retarder-1.0.0", b"optics/linear_retarder-9.0.0"),
        (b"optics/wollaston_prism-1.0.0", b"calibration-1.1.0"),
        (b"calibration-1.1.0", b"optics/rotator-1.0.0"),
        (b"calibration-1.1.0", b"calibration-7.0.0"),
        (b"!core/ndarray-1.1.0", b"!unit/quantity-1.2.0"),
        (b"!core/ndarray-1.1.0", b"!!binary"),
        (b"!core/ndarray-1.1.0", b"!core/complex-1.0.0"),
        (b"mount: hwp", b"mount: [hwp]"),
        (b"mount: hwp", b"mount: nowhere"),
        (b"fixed: true", b"fixed: maybe"),
        (b"fixed: true", b"fixed: 1"),
        (b"unit: deg", b"unit: kg"),
        (b"unit: deg", b"unit: 3"),
        (b"n_frames: ", b"n_frames: -"),
        (b"rank: ", b"rank: 0.5 #"),
        (b"wavelength:", b"wave:"),
        (b"at_bound: ", b"at_bound: 7 #"),
    ]:
        content = text_of(original)
        assert old in content, (old, new)
        path = tmp_path / "a.asdf"
        path.write_bytes(content.replace(old, new, 1))
        with pytest.raises(CalibrationFileError) as caught:
            Calibration.read(path)
        words = str(caught.value)
        assert words.startswith(f"{path}: "), (old, new)
        assert "\n" not in words, (old, new)
        assert len(words) < 700, (old, new)
