"""The study of the refined scale against its bound, with few seeds and its two quick cases.

For all of it, run ``tests/studies/scale_crb.py``.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2, t
from tests.studies import scale_crb

NUM_SEEDS = 12
# One good estimate in a thousand falls outside. A Cauchy loss spreads 3 % beyond the bound, so the upper limit is 5 %
# wider.
ERROR_RATE = 1e-3


@pytest.mark.parametrize("index", [1, 2], ids=["first camera", "unknown"])
def test_refined_scale_is_unbiased_and_as_certain_as_the_data_allow(index: int) -> None:
    result = scale_crb.study_case(scale_crb.CASES[index], NUM_SEEDS)
    low, high = np.sqrt(chi2.ppf([ERROR_RATE / 2, 1 - ERROR_RATE / 2], NUM_SEEDS - 1) / (NUM_SEEDS - 1))
    assert low < result.spread_over_bound < 1.05 * high
    assert abs(result.mean_in_standard_errors) < t.ppf(1 - ERROR_RATE / 2, NUM_SEEDS - 1)
    # With a bound of another size, both statements would mean nothing.
    assert 1e-3 < result.bound < 5e-3
