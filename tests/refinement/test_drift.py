"""The study of drift, with one seed of its highest level and a third of the lap.

All of it: ``tests/studies/drift.py``.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import pytest

STUDY = Path(__file__).parents[1] / "studies" / "drift.py"
NUM_KEYFRAMES = 200


@pytest.fixture(scope="module")
def study() -> ModuleType:
    spec = importlib.util.spec_from_file_location("drift", STUDY)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    # Its dataclasses look their module up there.
    sys.modules["drift"] = module
    spec.loader.exec_module(module)
    return module


def test_drift_is_bent_back_in_few_iterations(study: ModuleType) -> None:
    run = study.study_run(study.LEVELS[2], 0, num_keyframes=NUM_KEYFRAMES)
    assert run.true_scale_m > 0.5
    assert run.ratio < study.MAX_RATIO
    assert run.summary.num_iterations <= study.MAX_NUM_ITERATIONS
    assert run.summary.converged
    assert run.summary.misfits == ()
    # The noise that the scale stage saw was mostly drift.
    assert run.summary.range_stddev_m[0] == pytest.approx(study.RANGE_STDDEV_M, rel=0.25)
