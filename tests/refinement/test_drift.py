"""The study of drift, with a third of the lap.

All of it: ``python -m tests.studies.drift``.
"""

from __future__ import annotations

import importlib
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

ROOT = Path(__file__).parents[2]
NUM_KEYFRAMES = 200
DRIFT_M = 1.0


@pytest.fixture(scope="module")
def study() -> Iterator[ModuleType]:
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(ROOT)
        yield importlib.import_module("tests.studies.drift")


@pytest.fixture(scope="module")
def lap(study: ModuleType) -> object:
    level = study.Level(DRIFT_M, 40, 0.2)
    survey = study.lap_survey(
        num_observations=level.num_observations, anchor_m=study.ANCHORS_M["inside"], num_keyframes=NUM_KEYFRAMES
    )
    return study.Lap.of(survey, level)


def test_drift_is_bent_back_in_few_iterations(study: ModuleType, lap: object) -> None:
    run = study.study_run(lap, 0)
    assert run.true_scale_m == pytest.approx(DRIFT_M, rel=0.05)
    assert run.is_good
    assert run.summary.converged
    assert run.summary.misfits == ()
    # The noise that the scale stage saw was mostly drift.
    assert run.summary.range_stddev_m[0] == pytest.approx(0.1, rel=0.25)


def test_a_mixture_of_draws_drifts_as_asked_and_is_noise_of_the_same_stddev(study: ModuleType, lap: object) -> None:
    errors, sfm = study.mixed_to_level(lap, 1)
    assert study.rmse(study.drift_of(lap.survey, sfm)) == pytest.approx(DRIFT_M, rel=0.03)  # type: ignore[attr-defined]
    assert np.std(errors) == pytest.approx(lap.pixel_stddev, rel=0.02)  # type: ignore[attr-defined]
