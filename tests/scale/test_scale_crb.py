"""The study of the refined scale against its bound, with few seeds and its two quick cases.

All of it: ``tests/studies/scale_crb.py``.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from scipy.stats import chi2, t

STUDY = Path(__file__).parents[1] / "studies" / "scale_crb.py"
NUM_SEEDS = 12
# One good estimate in a thousand falls outside. A Cauchy loss spreads 3 % beyond the bound, so the upper limit gets 5.
ERROR_RATE = 1e-3


@pytest.fixture(scope="module")
def study() -> ModuleType:
    spec = importlib.util.spec_from_file_location("scale_crb", STUDY)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Its dataclasses look their module up there.
    sys.modules["scale_crb"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("index", [1, 2], ids=["first camera", "unknown"])
def test_refined_scale_is_unbiased_and_as_certain_as_the_data_allow(study: ModuleType, index: int) -> None:
    result = study.study_case(study.CASES[index], NUM_SEEDS)
    low, high = np.sqrt(chi2.ppf([ERROR_RATE / 2, 1 - ERROR_RATE / 2], NUM_SEEDS - 1) / (NUM_SEEDS - 1))
    assert low < result.spread_over_bound < 1.05 * high
    assert abs(result.mean_in_standard_errors) < t.ppf(1 - ERROR_RATE / 2, NUM_SEEDS - 1)
    # A bound of another size would make both statements empty.
    assert 1e-3 < result.bound < 5e-3
