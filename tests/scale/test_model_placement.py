"""The weights of several models in one world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.scale.conftest import MakeSurvey
from tests.scale.robust_scale import metric_from_sfm_by_robust_weights

from rangesfm.demo.simulated_radio import Radio
from rangesfm.scale import model_placement
from rangesfm.scale.model_placement import ScaledModel
from rangesfm.scale.range_equation import solve


def lingering_model(make_survey: MakeSurvey, seed: int = 0) -> ScaledModel:
    """A model whose ranges have errors in common, for each place and for some seconds; most are from three places."""
    survey = make_survey(num_epochs=8, radio=Radio(range_stddev_m=0.02), seed=seed)
    log, rng = survey.simulated.log, np.random.default_rng(seed)
    observations = survey.observations()
    place = len(survey.anchors_m) * observations.before + log.anchor_index
    slow = np.repeat(rng.standard_normal((10, len(survey.anchors_m))), 4, axis=0).ravel()
    errors = 0.1 * rng.standard_normal(len(slow))[place] + 0.1 * slow[place]
    taken = np.isin(observations.before, [2, 3, 9]) | (np.arange(len(log)) % 40 < 5)
    taken_log = replace(log, range_m=log.range_m + errors).subset(taken)
    estimate = survey.scale("site", "ABCDE", taken_log)
    return ScaledModel(survey.trajectory, estimate, is_in_anchor_frame=True)


def test_a_model_weighs_the_same_alone_and_in_a_join(make_survey: MakeSurvey) -> None:
    model = lingering_model(make_survey)
    estimate, errors = model.estimate, model.estimate.errors
    assert errors.inflation > 1.3
    assert np.nanmax(errors.share) > 2 * np.nanmin(errors.share)
    places = {anchor.anchor_id: anchor.position_m for anchor in estimate.anchors}
    alone = metric_from_sfm_by_robust_weights(estimate)
    joined = model_placement._Group([model], None).solve([estimate.metric_from_sfm], places)
    assert joined.state.metric_from_model.scale == pytest.approx(alone.scale, rel=1e-6)
    np.testing.assert_allclose(joined.state.metric_from_model.rotation, alone.rotation, atol=1e-6)
    alone_stddev = errors.inflation * estimate.uncertainty.formal
    assert joined.log_scale_stddev == pytest.approx(alone_stddev, rel=0.02)
    # This would not hold if all its ranges counted alike.
    part = replace(model_placement._problem(model, estimate.anchors), share=None)
    alike = solve(part, joined.state, loss=errors.loss)
    assert abs(alike.state.metric_from_model.scale / alone.scale - 1) > 1e-4
    assert alike.log_scale_stddev < 0.8 * alone_stddev
