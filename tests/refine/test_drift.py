"""The study of drift, with a third of the lap.

For all of it, run ``python -m tests.studies.drift``.
"""

from __future__ import annotations

import numpy as np
import pytest
from tests.studies import drift
from tests.studies.simulated_survey import lap_survey

from rangesfm.geometry.similarity import rmse

NUM_KEYFRAMES = 200
DRIFT_M = 1.0


@pytest.fixture(scope="module")
def lap() -> drift.Lap:
    level = drift.Level(DRIFT_M, 40, 0.2)
    survey = lap_survey(
        num_observations=level.num_observations, anchor_m=drift.ANCHORS_M["inside"], num_keyframes=NUM_KEYFRAMES
    )
    return drift.Lap.of(survey, level)


def test_drift_is_bent_back_in_few_iterations(lap: drift.Lap) -> None:
    run = drift.study_run(lap, 0)
    assert run.true_scale_m == pytest.approx(DRIFT_M, rel=0.05)
    assert run.is_good
    assert run.summary.converged
    assert run.summary.misfits == ()
    # Most of the noise that the scale stage saw was drift.
    assert run.summary.errors.stddev_m[0] == pytest.approx(0.1, rel=0.25)


def test_a_mixture_of_draws_drifts_as_asked_and_is_noise_of_the_same_stddev(lap: drift.Lap) -> None:
    errors, sfm = drift.mixed_to_level(lap, 1)
    assert rmse(drift.drift_of(lap.survey, sfm)) == pytest.approx(DRIFT_M, rel=0.03)
    assert np.std(errors) == pytest.approx(lap.pixel_stddev, rel=0.02)
