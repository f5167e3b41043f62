# Licensed under a 3-clause BSD style license - see LICENSE
"""Priors beside the chains of a file."""

import astropy.units as u
import numpy as np
import pytest
import scipy.stats

from astropolcal import optics
from astropolcal.converters.nodes import node_from_priors, restore_priors, without_priors
from astropolcal.exceptions import CalibrationFileError
from astropolcal.measurement import Normal
from astropolcal.measurement.parameters import Uniform


def chain(**priors):
    found = optics.TwoLayerWaveplate(name="hwp") | optics.WollastonPrism(name="wollaston")
    for name, prior in priors.items():
        optic, _, key = name.partition("__")
        getattr(found[optic], key).prior = prior
    return found


def again(original):
    """Return a chain with the priors of another, by way of their nodes."""
    bare = without_priors(original)
    restore_priors([bare], node_from_priors([original]))
    return bare


def test_our_own_come_back_in_their_units():
    for prior in [
        Normal(0 * u.deg, 6 * u.arcmin),
        Uniform(-1 * u.rad, 1 * u.rad),
        Normal(0.5, 0.25),
        Uniform(-1, 1),
    ]:
        found = again(chain(hwp__theta=prior))["hwp"].theta.prior
        assert type(found) is type(prior)
        for key in ("mean", "std") if isinstance(prior, Normal) else ("low", "high"):
            expected = getattr(prior, key)
            assert getattr(found, key) == expected
            assert getattr(getattr(found, key), "unit", None) == getattr(expected, "unit", None)


def test_those_of_scipy_have_the_same_density():
    for prior in [
        scipy.stats.truncnorm(-5, 0, loc=1, scale=0.03),
        scipy.stats.beta(2, 3),
        scipy.stats.norm(loc=0.98, scale=0.01),
        scipy.stats.uniform(0.9, 0.1),
    ]:
        found = again(chain(wollaston__efficiency=prior))["wollaston"].efficiency.prior
        x = np.linspace(0.9, 1.0, 11)
        np.testing.assert_array_equal(found.logpdf(x), prior.logpdf(x))


def test_parameters_without_a_prior_are_not_listed():
    assert node_from_priors([chain()]) == []
    nodes = node_from_priors([chain(hwp__theta=Normal(0 * u.deg, 1 * u.deg))])
    assert [node["parameter"] for node in nodes] == ["hwp.theta"]


def test_an_optic_of_several_chains_is_listed_once():
    first = chain(hwp__theta=Normal(0 * u.deg, 1 * u.deg))
    nodes = node_from_priors([first, first.copy()])
    assert len(nodes) == 1
    bare = [without_priors(first), without_priors(first)]
    restore_priors(bare, nodes)
    assert all(one["hwp"].theta.prior is not None for one in bare)


def test_the_copy_is_without_and_the_original_with():
    original = chain(hwp__w_sio2=Normal(1.6 * u.mm, 0.1 * u.mm))
    assert without_priors(original)["hwp"].w_sio2.prior is None
    assert original["hwp"].w_sio2.prior is not None


class Homemade:
    """A prior that no file can describe."""

    def logpdf(self, value):
        return 0.0


def test_what_files_cannot_hold():
    for prior in [Homemade(), scipy.stats.poisson(3), scipy.stats.gaussian_kde([0.1, 0.2, 0.4])]:
        with pytest.raises(
            CalibrationFileError,
            match=rf"prior of hwp.theta is a {type(prior).__name__}, which files cannot hold",
        ):
            node_from_priors([chain(hwp__theta=prior)])


NODE = {"parameter": "hwp.theta", "kind": "scipy", "distribution": "norm", "args": [], "kwds": {}}


def test_nodes_that_are_refused():
    """Nothing but a distribution of scipy can be named, so nothing else is ever called."""
    for nodes, words in [
        ([NODE, NODE], "prior of 'hwp.theta' is given twice"),
        ([NODE | {"parameter": "m3.theta"}], "prior of 'm3.theta', which no chain has"),
        ([NODE | {"distribution": "poisson"}], "no continuous distribution 'poisson'"),
        ([NODE | {"distribution": "nowhere"}], "no continuous distribution 'nowhere'"),
        ([NODE | {"distribution": "__class__"}], "no continuous distribution '__class__'"),
        ([NODE | {"distribution": "rv_continuous"}], "no continuous distribution"),
        ([NODE | {"distribution": ["norm"]}], "no continuous distribution"),
        ([NODE | {"distribution": None}], "no continuous distribution None"),
        ([NODE | {"args": [1, 2, 3, 4]}], "prior of hwp.theta: "),
        ([NODE | {"kwds": {"mean": 1}}], "prior of hwp.theta: "),
        ([NODE | {"args": [0], "kwds": {"scale": "x"}}], "prior of hwp.theta: "),
        ([NODE | {"args": [0, -1]}], r"norm of \[0, -1\] and {} is not a distribution"),
        ([NODE | {"args": [0, float("nan")]}], "is not a distribution"),
        ([NODE | {"args": [[0, 1], 1]}], "prior of hwp.theta: "),
    ]:
        with pytest.raises(CalibrationFileError, match=words):
            restore_priors([chain()], nodes)
