"""The weights of several models in one world."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.scale.conftest import MakeSurvey
from tests.scale.robust_scale import metric_from_sfm_by_robust_weights

from rangesfm.demo.simulated_radio import Radio
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import IDENTITY, Similarity
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.robust_loss import CAUCHY
from rangesfm.scale import model_placement
from rangesfm.scale.model_placement import ScaledModel
from rangesfm.scale.range_equation import solve

Array = npt.NDArray[np.float64]


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


TURN = Rotation.from_rotvec([0.1, -0.2, 0.7]).as_matrix()
PATH = np.random.default_rng(0).standard_normal((30, 3)) * [4.0, 3.0, 1.0]
EXTENT = 2.0 * float(np.linalg.norm(PATH.std(axis=0)))  # of the path, scaled by 2


def model_of(
    metric_from_sfm: Similarity, anchors: Sequence[AnchorEstimate], *, is_in_anchor_frame: bool = False
) -> ScaledModel:
    """A model whose scale is known to a tenth."""
    estimate: Any = SimpleNamespace(
        metric_from_sfm=metric_from_sfm,
        anchors=anchors,
        uncertainty=SimpleNamespace(empirical=0.1),
        errors=SimpleNamespace(loss=CAUCHY),
    )
    trajectory: Any = SimpleNamespace(centers=PATH)
    return ScaledModel(trajectory, estimate, is_in_anchor_frame)


def fit_of(similarities: Sequence[Similarity], cost: float = 0.0, stddev_m: float = 0.0) -> Any:
    """A fit of models, the last of which is only uncertain by a shift of ``stddev_m`` in all."""
    num = 7 * len(similarities) - 6
    covariance = np.zeros((num, num))
    covariance[-3:, -3:] = stddev_m**2 / 3 * np.eye(3)
    return SimpleNamespace(
        state=SimpleNamespace(similarities=tuple(similarities)),
        cost=cost,
        covariance=covariance,
        columns=(SimpleNamespace(scale=0), SimpleNamespace(scale=num - 7)),
    )


def world_of(monkeypatch: pytest.MonkeyPatch, fits: Sequence[Any]) -> tuple[model_placement._World, list[Any]]:
    """A world of two models in which the possible places of the second have these fits; also what they were asked."""
    asked: list[Any] = []

    class Group:
        def __init__(self, models: Sequence[ScaledModel], num_per_anchor: int | None):
            asked.append((models, num_per_anchor))

        def solve(self, metric_from_sfm: Sequence[Similarity], anchors_m: Mapping[str, Array]) -> Any:
            asked.append((metric_from_sfm, anchors_m))
            return fits[len(asked) - 2]

    monkeypatch.setattr(model_placement, "_Group", Group)
    models = [model_of(IDENTITY, []), model_of(IDENTITY, []), model_of(IDENTITY, [])]
    return model_placement._World(models), asked


def shifted(shift_m: float) -> list[Similarity]:
    return [IDENTITY, Similarity(2.0, TURN, np.array([0.0, shift_m, 0.0]))]


@pytest.mark.parametrize(
    ("share", "gap", "stddev_share", "refused"),
    [
        (0.11, 4.4, 0.0, "two places of it, {apart:.2g} m apart, fit all ranges equally well"),
        (0.11, 4.6, 0.0, None),
        (0.09, 1.0, 0.24, None),
        (0.09, 1.0, 0.26, "the anchors place it only to {stddev:.2g} m, of an extent of {extent:.2g} m"),
    ],
)
def test_a_place_is_refused_if_another_one_fits_alike_or_it_is_open(
    monkeypatch: pytest.MonkeyPatch, share: float, gap: float, stddev_share: float, refused: str | None
) -> None:
    best = fit_of(shifted(0.0), 10.0, stddev_share * EXTENT)
    world, _ = world_of(monkeypatch, [fit_of(shifted(share * EXTENT), 10.0 + gap), best])
    starts: Any = [(IDENTITY, {}), (IDENTITY, {})]
    if refused is None:
        assert world._best(1, starts) is best
        return
    expected = refused.format(apart=share * EXTENT, stddev=stddev_share * EXTENT, extent=EXTENT)
    with pytest.raises(GeometryError, match=expected):
        world._best(1, starts)
