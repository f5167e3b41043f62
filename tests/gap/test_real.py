# Licensed under a 3-clause BSD style license - see LICENSE
"""
Effects withheld from models of real data, each with a known answer.

Five to eight of the 22 wavelengths are enough to see them, and keep the tests short.
"""

import numpy as np
import pytest

from astropolcal import instruments
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
