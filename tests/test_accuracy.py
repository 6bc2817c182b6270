"""Tests of the comparison in the table of accuracy."""

from __future__ import annotations

import numpy as np
from tests.accuracy.figures import Figure

RMSE = Figure("RMSE", "rmse", "median", "m", "higher")
STORED = {f"{kind} {seed}": {"rmse": 0.05 + 0.002 * seed} for kind in ("hall", "yard", "room") for seed in range(4)}


def worse(changes_m: dict[str, float]) -> list[str]:
    """Return the figures that are worse after changes of some cases."""
    now = {case: {"rmse": values["rmse"] + changes_m.get(case, 0.0)} for case, values in STORED.items()}
    return [loss.words for loss in RMSE.losses(now, STORED) if loss.is_real]


def test_a_worse_mean_is_named_and_scatter_is_not() -> None:
    scatter_m = dict(zip(STORED, np.random.default_rng(0).normal(0.0, 0.004, len(STORED)), strict=True))
    assert worse({}) == []
    assert worse(scatter_m) == []
    assert "RMSE" in worse({case: 0.01 + off_m for case, off_m in scatter_m.items()})
    assert worse({case: -0.01 + off_m for case, off_m in scatter_m.items()}) == []


def test_a_kind_of_case_that_is_worse_is_named_among_those_that_are_not() -> None:
    assert worse({f"yard {seed}": 0.01 + 0.0005 * seed for seed in range(4)}) == ["RMSE, yard"]


def test_cases_of_any_size_that_are_worse_are_named_beside_large_ones_that_are_not() -> None:
    stored = {"a map that drifts far": {"rmse": 12.0}}
    stored |= {f"{letter} map": {"rmse": 0.02 * 1.5**k} for k, letter in enumerate("abcdefgh")}
    now = {case: {"rmse": rmse["rmse"] * (1.3 if rmse["rmse"] < 1 else 1.001)} for case, rmse in stored.items()}
    assert [loss.words for loss in RMSE.losses(now, stored) if loss.is_real] == ["RMSE"]
    assert not [loss for loss in RMSE.losses(stored, now) if loss.is_real]
