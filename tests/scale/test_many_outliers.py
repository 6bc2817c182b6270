"""Most ranges are wrong, and the scale is right: some seeds of the study of breakdown.

All of it: ``tests/studies/scale_breakdown.py``.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

STUDY = Path(__file__).parents[1] / "studies" / "scale_breakdown.py"
NUM_SEEDS = 8


@pytest.fixture(scope="module")
def study() -> ModuleType:
    spec = importlib.util.spec_from_file_location("scale_breakdown", STUDY)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Its dataclasses look their module up there.
    sys.modules["scale_breakdown"] = module
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize(
    ("kind", "share", "max_median_percent"),
    [("long", 0.8, 2.0), ("short", 0.8, 1.5), ("clustered", 0.7, 2.5)],
)
def test_scale_is_found_though_most_ranges_are_wrong(
    study: ModuleType, kind: str, share: float, max_median_percent: float
) -> None:
    found = [study.ours(study.make_case(kind, share, seed), seed) for seed in range(NUM_SEEDS)]
    assert 100 * np.median(np.abs(np.array(found) / study.SCALE - 1)) < max_median_percent
