"""The study of the refined scale against its bound, with few seeds and its two quick cases.

All of it: ``tests/studies/scale_crb.py``.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, t
from tests.studies import scale_crb

NUM_SEEDS = 12
# One good estimate in a thousand falls outside. A Cauchy loss spreads 3 % beyond the bound, so the upper limit gets 5.
ERROR_RATE = 1e-3


@pytest.mark.parametrize("index", [1, 2], ids=["first camera", "unknown"])
def test_refined_scale_is_unbiased_and_as_certain_as_the_data_allow(index: int) -> None:
    result = scale_crb.study_case(scale_crb.CASES[index], NUM_SEEDS)
    low, high = np.sqrt(chi2.ppf([ERROR_RATE / 2, 1 - ERROR_RATE / 2], NUM_SEEDS - 1) / (NUM_SEEDS - 1))
    assert low < result.spread_over_bound < 1.05 * high
    assert abs(result.mean_in_standard_errors) < t.ppf(1 - ERROR_RATE / 2, NUM_SEEDS - 1)
    # A bound of another size would make both statements empty.
    assert 1e-3 < result.bound < 5e-3
