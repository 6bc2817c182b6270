"""The scale is right although most ranges are wrong, for some seeds of the study of breakdown.

For all of it, run ``tests/studies/scale_breakdown.py``.
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.studies import scale_breakdown

NUM_SEEDS = 8


@pytest.mark.parametrize(
    ("kind", "share", "max_median_percent"),
    [("long", 0.8, 2.0), ("short", 0.8, 1.5), ("clustered", 0.7, 2.5)],
)
def test_scale_is_found_though_most_ranges_are_wrong(kind: str, share: float, max_median_percent: float) -> None:
    found = [scale_breakdown.ours(scale_breakdown.make_case(kind, share, seed), seed) for seed in range(NUM_SEEDS)]
    assert 100 * np.median(np.abs(np.array(found) / scale_breakdown.SCALE - 1)) < max_median_percent
