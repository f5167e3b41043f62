# Licensed under a 3-clause BSD style license - see LICENSE
"""
Effects withheld from models of real data, each with a known answer.

Five to eight of the 22 wavelengths are enough to see them, and keep the tests short.
"""

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from astropolcal import calibrate, instruments
from astropolcal.calibration import robust_covariance
from astropolcal.chain import leaves, remove_optic
from astropolcal.gap import diagnose
from astropolcal.gap.alternatives import thinned
from astropolcal.gap.remainders import outlying_frames
from astropolcal.observations import Observations

pytestmark = pytest.mark.slow
CHARIS = instruments.get("charis")
PARITY = {"mirror_flip", "mirror_flip_before_plate", "beams_swapped"}
DEROTATOR = {
    "derotator_elliptical_retardance",
    "derotator_45_retardance",
    "derotator_circular_retardance",
}
# orientations of polarizer, plate and derotator take part of an elliptical retardance up
ORIENTATION = {"polarizer_misalignment", "hwp_misalignment", "derotator_misalignment"}


def observed(shared_data, *names):
    return [Observations.read(shared_data / "data" / "charis" / f"{name}.ecsv") for name in names]


def named(diagnosis, least=0.0):
    """Return the names of all causes and of what cannot be told from them."""
    causes = [cause for cause in diagnosis.causes if cause.explained > least]
    return [{cause.name, *cause.aliases} for cause in causes]


def test_beam_switcher_that_the_model_lacks_is_a_parity(shared_data):
    data = observed(shared_data, "dataset3_polarized_2025-10-05")
    chains = [remove_optic(chain, "nbs") for chain in CHARIS.chains_for(data)]
    found = diagnose(*thinned(chains, data, 5))
    assert found.verdict == "effect"
    assert named(found)[0] & PARITY == PARITY
    assert found.causes[0].effect.kind == "discrete"
    assert found.gap_after_percent < found.gap_before_percent / 5


@pytest.mark.parametrize("name", ["dataset1_polarized_2025-07-15", "dataset3_polarized_2025-10-05"])
def test_elliptical_retardance_that_the_derotator_lacks(shared_data, name):
    data = observed(shared_data, name)
    chains = CHARIS.chains_for(data, derotator="linear")
    for chain in chains:
        for leaf in leaves(chain):
            leaf.theta.fixed = True
    found = diagnose(*thinned(chains, data, 6))
    assert found.verdict == "effect"
    # the flat field is missing as well; nothing else is as large
    large = named(found, least=0.05)
    assert any(group & DEROTATOR for group in large)
    assert all(group & (DEROTATOR | ORIENTATION | {"beam_gain"}) for group in large)
    assert found.held_out[0].shrinkage(found.held_out[-1])[0] > 80


def test_fold_mirror_that_the_model_lacks(shared_data):
    data = observed(shared_data, "dataset4_unpolarized_2025-10-05")
    chains = [remove_optic(chain, "fold_mirror") for chain in CHARIS.chains_for(data)]
    found = diagnose(*thinned(chains, data, 8))
    assert {"source_linear"} & set.union(*named(found))


def test_lamp_that_is_unstable_is_not_blamed_on_the_optics(shared_data):
    data = observed(shared_data, "dataset4_unpolarized_2025-10-05")
    model = diagnose(*thinned(CHARIS.chains_for(data), data, 8)).improved
    worst = outlying_frames(model)[0]
    first, last = map(int, worst["frames"].split("-"))
    turned = np.rad2deg(data[0].position("derotator"))[first : last + 1]
    np.testing.assert_allclose(turned, 45, atol=1)
    assert len(turned) == 8
    assert worst["channel"] == "sum"
    assert worst["words"].startswith("lamp unstable at derotator 45 deg")


# ---- another processor -------------------------------------------------------------------------


def numbers(shared_data):
    """What a calibration, its errors and a diagnosis find in Dataset 3, as JSON holds it."""
    data = observed(shared_data, "dataset3_polarized_2025-10-05")
    chains = CHARIS.chains_for(data)
    fix = {"hwp.theta": None, "derotator.theta": None}
    cal = calibrate(chains, data, fix=fix, cross_validate=False)
    wrong = [remove_optic(chain, "nbs") for chain in chains]
    effects = [*sorted(PARITY), "beam_gain", "derotator_diattenuation", "dichroic_j_band"]
    found = diagnose(*thinned(wrong, data, 3), effects=[*effects, "static_retarder"])
    return {
        "values": (cal.measurement.vector() / cal.measurement.free.factors()).tolist(),
        "errors": cal.covariance.stds.tolist(),
        "robust errors": robust_covariance(cal).stds.tolist(),
        "causes": [[cause.name, *cause.aliases] for cause in found.causes],
        "explained": [cause.explained for cause in found.causes],
        "gaps": [found.gap_before_percent, found.gap_after_percent],
    }


@pytest.mark.skipif(
    platform.machine().lower() not in ("x86_64", "amd64"),
    reason="the kernels of OpenBLAS that the test compares are those of x86-64",
)
def test_numbers_and_causes_are_those_of_another_processor(shared_data):
    """Prescott's kernels, which run everywhere, against those that OpenBLAS takes here."""
    code = "import json, sys, test_real as t; print(json.dumps(t.numbers(t.Path(sys.argv[1]))))"
    paths = filter(None, [str(Path(__file__).parent), os.environ.get("PYTHONPATH")])
    environment = {"OPENBLAS_CORETYPE": "Prescott", "PYTHONPATH": os.pathsep.join(paths)}
    printed = subprocess.run(
        [sys.executable, "-c", code, str(shared_data)],
        env=os.environ | environment,
        stdout=subprocess.PIPE,
        check=True,
    ).stdout
    own, other = numbers(shared_data), json.loads(printed)
    assert len(own["causes"][0]) == 3
    assert other["causes"] == own["causes"]
    # measured: 1e-12 of the errors; what is at its bound has none
    moved = np.subtract(other["values"], own["values"]) / np.nan_to_num(own["errors"], nan=1.0)
    assert np.abs(moved).max() < 1e-6
    for key in ("errors", "robust errors", "explained", "gaps"):
        np.testing.assert_allclose(other[key], own[key], rtol=1e-6, err_msg=key)
