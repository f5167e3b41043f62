# Licensed under a 3-clause BSD style license - see LICENSE
"""Free parameters of several chains as one flat vector."""

import astropy.units as u
import numpy as np
import pytest

from astropolcal import optics
from astropolcal.exceptions import ParameterError
from astropolcal.measurement import Normal, Tie, parameter_table
from astropolcal.measurement.parameters import FreeParameters, Slot
from astropolcal.observations import Observations, example_table
from astropolcal.observations.reading import common_wavelengths


def two_optics(**retarder):
    retarder = {"retardance": [10, 20, 30] * u.deg, "name": "plate"} | retarder
    return optics.LinearRetarder(**retarder) | optics.WollastonPrism(
        efficiency=0.9, name="wollaston"
    )


# --- the table ---------------------------------------------------------------------------


def test_table_lists_parameters_in_order_of_the_light():
    assert list(parameter_table([two_optics()])) == [
        "plate.theta", "plate.retardance", "wollaston.theta", "wollaston.efficiency",
    ]  # fmt: skip


def test_table_joins_optics_of_one_name():
    first, second = two_optics(), two_optics()
    table = parameter_table([first, second])
    assert table["plate.retardance"] == [first["plate"].retardance, second["plate"].retardance]


def test_names_that_would_be_read_as_others_are_refused():
    for name, other in (("hwp[1]", "hwp_1"), ("hwp.1", "hwp_1"), ("[", "optic")):
        with pytest.raises(ParameterError, match=f"without dot and brackets .* as '{other}'"):
            parameter_table([optics.WollastonPrism(name=name)])


def test_optics_that_cannot_be_listed_are_refused():
    with pytest.raises(ParameterError, match="WollastonPrism needs a name"):
        parameter_table([optics.WollastonPrism()])
    other = optics.Diattenuator(name="plate") | optics.WollastonPrism(name="wollaston")
    with pytest.raises(ParameterError, match="'plate' is a LinearRetarder in one dataset and a"):
        parameter_table([two_optics(), other])


# --- slots -----------------------------------------------------------------------------------


def test_slots_follow_each_other():
    free = FreeParameters([two_optics(fixed={"theta": False})], 3)
    assert [(s.name, s.start, s.size) for s in free.slots] == [
        ("plate.theta", 0, 1), ("plate.retardance", 1, 3), ("wollaston.efficiency", 4, 1),
    ]  # fmt: skip
    assert free.size == 5
    assert free.labels == [
        "plate_theta", "plate_retardance_0", "plate_retardance_1", "plate_retardance_2",
        "wollaston_efficiency",
    ]  # fmt: skip
    assert free.names[1] == "plate.retardance[0]"
    assert all(label.isidentifier() for label in free.labels)


def test_start_bounds_and_factors_are_canonical():
    free = FreeParameters([two_optics()], 3)
    np.testing.assert_allclose(free.start(), [*np.deg2rad([10, 20, 30]), 0.9])
    low, high = free.bounds()
    np.testing.assert_allclose(low, [-2 * np.pi] * 3 + [0])
    np.testing.assert_allclose(high, [2 * np.pi] * 3 + [1])
    np.testing.assert_allclose(free.factors(), [np.pi / 180] * 3 + [1])


def test_open_bounds_are_infinite():
    below, above = (Slot("plate.w", u.mm, 0, 1, b) for b in ((None, 2.0), (0.5, None)))
    assert below.canonical_bounds() == pytest.approx((-np.inf, 2000.0))
    assert above.canonical_bounds() == pytest.approx((500.0, np.inf))


def test_put_back_writes_all_chains():
    chains = [two_optics(), two_optics()]
    free = FreeParameters(chains, 3)
    free.put_back(np.array([*np.deg2rad([1, 2, 3]), 0.5]))
    for chain in chains:
        np.testing.assert_allclose(chain["plate"].retardance.value, [1, 2, 3])
        assert chain["wollaston"].efficiency.value == 0.5


def test_lookup_tells_where_a_value_comes_from():
    free = FreeParameters([two_optics()], 3, {"plate.theta": Tie("wollaston.efficiency", 2.0)})
    assert free.lookup("plate.retardance") == (free.by_name["plate.retardance"], 1.0, 0.0)
    assert free.lookup("plate.theta") == (free.by_name["wollaston.efficiency"], 2.0, 0.0)
    assert free.lookup("wollaston.theta")[0] is None
    # an offset is in the unit of the target
    ties = {"plate.theta": Tie("wollaston.efficiency", 2.0, offset=180 * u.deg)}
    free = FreeParameters([two_optics()], 3, ties)
    assert free.lookup("plate.theta")[2] == pytest.approx(np.pi)


# --- what does not fit ------------------------------------------------------------------------


def test_wrong_number_of_values():
    with pytest.raises(ParameterError, match=r"plate.retardance has 3 values; allowed are 1 or 22"):
        FreeParameters([two_optics()], 22)
    # of fixed parameters too
    chain = two_optics(fixed={"retardance": True})
    with pytest.raises(ParameterError, match=r"plate.retardance has 3 values"):
        FreeParameters([chain], 22)


def test_chains_that_differ_are_refused():
    chains = [two_optics(), two_optics(fixed={"retardance": True})]
    with pytest.raises(ParameterError, match=r"plate.retardance differs between datasets"):
        FreeParameters(chains, 3)
    with pytest.raises(ParameterError, match=r"plate.retardance differs between datasets in shape"):
        FreeParameters([two_optics(), two_optics(retardance=10 * u.deg)], 3)


def test_what_a_second_dataset_says_of_a_free_parameter_is_not_lost():
    for what, value in (("bounds", (0, 10)), ("prior", Normal(1 * u.deg, 1 * u.deg))):
        for i in (0, 1):
            chains = [two_optics(), two_optics()]
            setattr(chains[i]["plate"].retardance, what, value)
            with pytest.raises(ParameterError, match=rf"differs between datasets in its {what}"):
                FreeParameters(chains, 3)


def test_values_that_are_not_finite_are_named():
    chain = two_optics()
    chain["plate"].theta.value = np.nan
    with pytest.raises(ParameterError, match=r"plate.theta = nan must be finite"):
        chain["plate"].mueller(1.6 * u.um)


def test_impossible_tie():
    for ties, words in [
        ({"plate.teta": Tie("plate.theta")}, "no parameter 'plate.teta'"),
        ({"plate.theta": Tie("plate.nothing")}, "no parameter 'plate.nothing'"),
        ({"plate.theta": Tie("plate.theta")}, "the source is itself tied"),
        (
            {"plate.theta": Tie("wollaston.theta"), "wollaston.theta": Tie("plate.theta")},
            "the source is itself tied",
        ),
        ({"plate.theta": Tie("wollaston.theta")}, "wollaston.theta is not free"),
        ({"plate.theta": Tie("plate.retardance")}, "the shapes differ"),
        (
            {"plate.theta": Tie("wollaston.efficiency", offset=[1, 2] * u.deg)},
            r"offset = \[1. 2.\] deg; allowed are 1 or 1 finite values",
        ),
        (
            {"plate.theta": Tie("wollaston.efficiency", offset=np.nan * u.deg)},
            "offset = nan deg; allowed are 1 or 1 finite values",
        ),
    ]:
        with pytest.raises(ParameterError, match=words):
            FreeParameters([two_optics()], 3, ties)
    for factor in (np.nan, np.inf, "x", None, 0, 0.0):
        with pytest.raises(ParameterError, match=r"tie to plate.theta: factor = .*numbers but 0"):
            Tie("plate.theta", factor)
    with pytest.raises(ParameterError, match=r"offset of plate.theta"):
        FreeParameters(
            [two_optics()], 3, {"plate.theta": Tie("wollaston.efficiency", offset=1 * u.mm)}
        )
    chain = two_optics()
    chain["plate"].theta.tied = lambda model: 0.0
    with pytest.raises(ParameterError, match=r"plate.theta has a callable tie.*ties="):
        FreeParameters([chain], 3)


# --- grids --------------------------------------------------------------------------------


def test_grid_is_the_sorted_union_of_the_datasets_or_what_is_given():
    table = example_table()
    first = Observations.from_table(table)
    table["wavelength"] = table["wavelength"] * 1.000001
    table["wavelength"][table["bin"] == 2] *= 1.1
    second = Observations.from_table(table)
    np.testing.assert_allclose(
        common_wavelengths([second, first]), [1.2, 1.6, 2.2, 2.42], rtol=1e-5
    )
    observations = Observations.from_table(example_table())
    np.testing.assert_allclose(common_wavelengths([observations], [1200, 1300] * u.nm), [1.2, 1.3])
