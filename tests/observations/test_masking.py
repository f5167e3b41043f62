# Licensed under a 3-clause BSD style license - see LICENSE
"""Which cells are masked, for what reason, and what the warning says."""

import numpy as np
import pytest
from astropy.table import MaskedColumn, QTable

from astropolcal.exceptions import AstropolcalWarning, ObservationError
from astropolcal.observations.grid import mask_missing, mask_rows


def judged(right, left, errors=None, reasons=None):
    """Return codes and reasons of rows, and the warnings."""
    right = np.asarray(right, dtype=float)
    table = QTable({"frame": np.arange(len(right))})
    if reasons is not None:
        table["mask_reason"] = reasons
    values = {"flux_right": right, "flux_left": np.asarray(left, dtype=float)}
    for name, error in zip(("flux_right_err", "flux_left_err"), errors or (), strict=False):
        values[name] = np.asarray(error, dtype=float)
    return mask_rows(table, values, "night")


def test_reason_and_first_row_of_bad_fluxes():
    for right, left, reason, shown in [
        (np.nan, 1.0, "flux not finite", "flux_right = nan, flux_left = 1"),
        (1.0, -np.inf, "flux not finite", "flux_right = 1, flux_left = -inf"),
        # squares of what is beyond 1e100 overflow
        (1e100, 1.0, "flux not finite", "flux_right = 1e\\+100"),
        (0.0, 1.0, "flux not positive", "flux_right = 0, flux_left = 1"),
        (1.0, -5.0, "flux not positive", "flux_right = 1, flux_left = -5"),
        (1.0, 1e-101, "flux not positive", "flux_left = 1e-101"),
        # both are wrong: what is not finite comes first
        (np.nan, -1.0, "flux not finite", "flux_right = nan, flux_left = -1"),
    ]:
        words = rf"night: 1 cell masked, {reason} \(first: row 2: .*{shown}"
        with pytest.warns(AstropolcalWarning, match=words):
            code, reasons = judged([2.0, right, 3.0], [2.0, left, 3.0])
        assert code.tolist() == [0, 1, 0], (right, left, reason, shown)
        assert reasons == [reason], (right, left, reason, shown)


def test_extreme_but_usable_fluxes_stay():
    for flux in [1e-99, 1e99, 1.0]:
        code, reasons = judged([flux], [flux], errors=([flux], [flux]))
        assert code.tolist() == [0], flux
        assert reasons == [], flux


def test_errors_are_judged_after_fluxes():
    with pytest.warns(AstropolcalWarning) as caught:
        code, reasons = judged(
            [1, -1, 1, 1], [1, 1, 1, 1], errors=([1, np.nan, np.nan, 0], [1, 1, 1, 1])
        )
    assert reasons == ["flux not positive", "error not finite", "error not positive"]
    assert code.tolist() == [0, 1, 2, 3]
    assert [str(w.message).split(" (")[0] for w in caught] == [
        f"night: 1 cell masked, {reason}" for reason in reasons
    ]


def test_many_cells_are_counted():
    with pytest.warns(AstropolcalWarning, match="night: 3 cells masked, flux not positive"):
        judged([0, 0, 0, 1], [1, 1, 1, 1])


def test_declared_reasons_come_first_and_need_no_warning():
    code, reasons = judged([np.nan, np.nan, 1.0], [1, 1, 1], reasons=["cloud", "cosmic ray", ""])
    assert code.tolist() == [1, 2, 0]
    assert reasons == ["cloud", "cosmic ray"]


def test_masked_text_is_no_reason():
    column = MaskedColumn(["cloud", "cloud"], mask=[True, False])
    code, reasons = judged([1.0, 1.0], [1.0, 1.0], reasons=column)
    assert code.tolist() == [0, 1]
    assert reasons == ["cloud"]


def test_reason_that_is_no_text_is_refused():
    with pytest.raises(ObservationError, match="night: column mask_reason has type int64, strings"):
        judged([1.0], [1.0], reasons=[3])


def test_found_reason_joins_the_declared_one_of_the_same_name():
    with pytest.warns(AstropolcalWarning, match="1 cell masked"):
        code, reasons = judged([1.0, 0.0], [1.0, 1.0], reasons=["flux not positive", ""])
    assert code.tolist() == [1, 1]
    assert reasons == ["flux not positive"]


def test_missing_cells_name_the_first():
    for n_missing, words in [(1, "1 cell masked"), (2, "2 cells masked")]:
        code = np.zeros((2, 2), dtype=int)
        code[1, :n_missing] = -1
        reasons = ["cloud"]
        with pytest.warns(
            AstropolcalWarning, match=rf"{words}, missing \(first: frame 7, bin 30 has"
        ):
            mask_missing(code, reasons, [5, 7], [30, 31], "night")
        assert reasons == ["cloud", "missing"], (n_missing, words)
        assert (code == 2).sum() == n_missing, (n_missing, words)
        assert (code >= 0).all(), (n_missing, words)
