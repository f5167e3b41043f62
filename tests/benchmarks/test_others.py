# Licensed under a 3-clause BSD style license - see LICENSE
"""
Evaluation of a chain against other packages and numpy; their matrices are in test_neighbours.

Not part of the normal run: ``pytest tests/benchmarks``.
"""

import numpy as np
import pytest
from comparisons import Comparison
from timing import fastest


@pytest.fixture(scope="module")
def sides():
    return Comparison()


@pytest.mark.parametrize("side", ["matrices_by_hand", "components_by_hand", "katsu", "py_pol"])
def test_all_sides_do_the_same(sides, side):
    if side in ("katsu", "py_pol"):
        pytest.importorskip(f"{side}.mueller", reason=f"{side} is not installed")
    np.testing.assert_allclose(getattr(sides, side)(), sides.ours(), atol=1e-12)


def test_against_numpy(sides, measured):
    """Mueller matrices by hand must not be faster; code for this chain alone is."""
    ours, matrices, components = fastest(
        sides.ours, sides.matrices_by_hand, sides.components_by_hand, repeats=500
    )
    others = {"matrices with numpy": matrices, "components with numpy": components}
    measured("evaluation of a chain", ours, others)
    assert ours < 1.3 * matrices
    assert ours < 1.5 * components


def test_against_katsu(sides, measured):
    """Light through one matrix after the other, and the matrices of the whole chain."""
    pytest.importorskip("katsu.mueller", reason="katsu is not installed")
    ours, light, system = fastest(sides.ours, sides.katsu, sides.katsu_system, repeats=300)
    others = {"katsu, light": light, "katsu, matrices of the chain": system}
    measured("evaluation of a chain", ours, others)
    assert light > 7 * ours
    assert system > 7 * ours


def test_matrices_against_katsu(sides, measured):
    """Both give the (22, 64, 4, 4) matrices of the chain up to the right beam."""
    pytest.importorskip("katsu.mueller", reason="katsu is not installed")
    theirs = sides.katsu_system()[0]
    np.testing.assert_allclose(sides.our_system().swapaxes(0, 1), theirs, atol=1e-12)
    ours, other = fastest(sides.our_system, lambda: sides.katsu_system(1), repeats=50)
    measured("matrices of a chain, 22 x 64", ours, {"katsu": other})
    assert other > 0.8 * ours


def test_against_py_pol(sides, measured):
    pytest.importorskip("py_pol.mueller", reason="py_pol is not installed")
    ours, light = fastest(sides.ours, sides.py_pol, repeats=7)
    measured("evaluation of a chain", ours, {"py_pol": light})
    assert light > 10 * ours


def test_system_mueller_is_what_was_compared(sides):
    right = sides.our_system()
    assert right.shape == (64, 22, 4, 4)
    np.testing.assert_allclose(right[..., 0, 0].T, sides.ours()[0], atol=1e-12)
