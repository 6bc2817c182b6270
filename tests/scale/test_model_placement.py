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
from tests.known import known
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
COVARIANCE_M2 = np.diag([0.01, 0.04, 0.09])


def estimated(
    anchor_id: str, position_m: Array, *, is_given: bool = False, covariance_m2: Array | None = None
) -> AnchorEstimate:
    prior_m = position_m if is_given else None
    found = AnchorEstimate(anchor_id, position_m, 0.1, prior_m, 0.1 if is_given else np.inf, 0.0, 0.0, 0.1)
    return replace(found, position_covariance_m2=covariance_m2)


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


def test_an_anchors_place_is_as_certain_as_its_covariance_its_antenna_and_the_scale_say() -> None:
    """A given place does not depend on the scale; another one is off with it, as far as it is from the path."""
    place = Similarity(2.0, TURN, np.array([5.0, 6.0, 7.0]))
    middle = place.apply(PATH).mean(axis=0)
    far = middle + np.array([3.0, 0.0, 4.0])
    anchors = [
        estimated("given", far, is_given=True),
        estimated("found", far, covariance_m2=COVARIANCE_M2),
        estimated("lost", np.array([1.0, np.nan, 2.0])),
        replace(estimated("both", far, is_given=True, covariance_m2=COVARIANCE_M2), mirror_position_m=-far),
    ]
    found = model_placement._placed_anchors(model_of(place, anchors))
    assert [*found] == ["given", "found", "both"]
    np.testing.assert_allclose(found["given"].covariance_m2, 0.0004 * np.eye(3))
    by_scale_m = np.array([0.3, 0.0, 0.4])
    expected = COVARIANCE_M2 + 0.0004 * np.eye(3) + np.outer(by_scale_m, by_scale_m)
    np.testing.assert_allclose(found["found"].covariance_m2, expected)
    np.testing.assert_allclose(found["both"].covariance_m2, COVARIANCE_M2 + 0.0004 * np.eye(3))
    np.testing.assert_allclose(found["given"].places_m, [far])
    np.testing.assert_allclose(found["both"].places_m, [far, -far])


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


def test_the_uncertainty_of_a_path_is_that_of_its_places_by_scale_turn_and_shift() -> None:
    rng = np.random.default_rng(4)
    first, last = IDENTITY, Similarity(2.0, TURN, np.array([5.0, 6.0, 7.0]))
    root = 0.1 * rng.standard_normal((8, 8))
    fit = fit_of([first, last])
    fit.covariance = root @ root.T

    def places(step: Array) -> Array:
        turned = Rotation.from_rotvec(step[1:4]).as_matrix() @ last.rotation
        return Similarity(2.0 * np.exp(step[0]), turned, last.translation + step[4:]).apply(PATH).ravel()

    slopes = np.stack([(places(step) - places(-step)) / 2e-6 for step in 1e-6 * np.eye(7)], axis=1)
    covariance = slopes @ fit.covariance[1:, 1:] @ slopes.T
    expected = np.sqrt(np.trace(covariance) / len(PATH))
    assert model_placement._path_stddev_m(fit, PATH) == pytest.approx(expected, rel=1e-6)


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


def test_the_ranges_of_all_choose_the_place_that_fits_best(monkeypatch: pytest.MonkeyPatch) -> None:
    fits = [fit_of(shifted(0.0), 20.0), fit_of(shifted(50.0), 10.0), fit_of(shifted(90.0), 30.0)]
    world, asked = world_of(monkeypatch, fits)
    starts: Any = [(shifted(float(k))[1], {"A": np.full(3, k)}) for k in range(3)]
    assert world._best(2, starts) is fits[1]
    models, num_per_anchor = asked[0]
    assert [id(each) for each in models] == [id(world._models[0]), id(world._models[2])]
    assert num_per_anchor == 300
    for (similarities, anchors_m), (start, at) in zip(asked[1:], starts, strict=True):
        assert [*similarities] == [IDENTITY, start]
        assert anchors_m is at


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


ANCHORS_M = {
    "A": np.array([9.0, 0.0, 1.0]),
    "B": np.array([-8.0, 2.0, 3.0]),
    "C": np.array([1.0, 9.0, 0.0]),
    "D": np.array([0.0, -9.0, 4.0]),
}
MOTION = Similarity(1.0, TURN, np.array([3.0, -2.0, 1.0]))  # to the world of the first from that of the second
OWN = Similarity(2.0, np.eye(3), np.zeros(3))


def added(
    monkeypatch: pytest.MonkeyPatch, first: ScaledModel, second: ScaledModel, placed: Similarity | None = None
) -> tuple[model_placement._World, list[Any]]:
    """The world of two models after the second was added in its first possible place, and all of these."""
    world = model_placement._World([first, second])
    asked: list[Any] = []

    def best(k: int, starts: Sequence[Any]) -> Any:
        assert k == 1
        asked.extend(starts)
        return fit_of([Similarity(5.0, np.eye(3), np.ones(3)), placed or starts[0][0]])

    monkeypatch.setattr(world, "_best", best)
    world.add(1)
    return world, asked


def test_a_model_is_carried_over_by_the_anchors_that_it_shares(monkeypatch: pytest.MonkeyPatch) -> None:
    """A new anchor and a better placed one come with it; one that stands elsewhere is noted."""
    own_m = {id_: MOTION.inverse().apply(at) for id_, at in {**ANCHORS_M, "E": np.array([4.0, 4.0, 4.0])}.items()}
    own_m["D"] = own_m["D"] + np.array([0.0, 0.0, 9.0])
    first = model_of(
        IDENTITY, [estimated(i, at, is_given=True, covariance_m2=COVARIANCE_M2) for i, at in ANCHORS_M.items()]
    )
    better = {"B": COVARIANCE_M2 / 100, "A": COVARIANCE_M2 * 2}
    second = model_of(
        OWN, [estimated(i, at, is_given=True, covariance_m2=better.get(i, COVARIANCE_M2)) for i, at in own_m.items()]
    )
    world, [(start, anchors_m)] = added(monkeypatch, first, second)
    by_motion = start @ OWN.inverse()
    np.testing.assert_allclose(by_motion.rotation, TURN, atol=0.05)
    np.testing.assert_allclose(by_motion.translation, MOTION.translation, atol=0.3)
    # The start has the anchors where the world has them, and the others moved there.
    assert anchors_m.keys() == {"A", "B", "C", "D", "E"}
    for id_, at in ANCHORS_M.items():
        np.testing.assert_array_equal(anchors_m[id_], at)
    np.testing.assert_allclose(anchors_m["E"], by_motion.apply(own_m["E"]))
    [note] = world.notes
    off_m = float(np.linalg.norm(by_motion.apply(own_m["D"]) - ANCHORS_M["D"]))
    assert note == f"anchor D is {off_m:.2g} m elsewhere by another model"
    assert world.metric_from_sfm[0].scale == 5.0
    assert world.metric_from_sfm[1] is start
    assert [*world.metric_from_sfm] == [0, 1]
    for id_ in "BE":
        np.testing.assert_allclose(world.anchors[id_].places_m, [by_motion.apply(own_m[id_])])
        np.testing.assert_allclose(
            world.anchors[id_].covariance_m2,
            by_motion.rotation @ (better.get(id_, COVARIANCE_M2) + 0.0004 * np.eye(3)) @ by_motion.rotation.T,
        )
    for id_ in "ACD":
        np.testing.assert_array_equal(world.anchors[id_].places_m, [ANCHORS_M[id_]])


def test_of_an_anchor_and_its_mirror_image_the_start_has_the_one_that_fits(monkeypatch: pytest.MonkeyPatch) -> None:
    mirror_m = np.array([1.0, 9.0, 7.0])
    firsts = [estimated(i, at, is_given=True, covariance_m2=COVARIANCE_M2) for i, at in ANCHORS_M.items()]
    seconds = [replace(each, position_m=MOTION.inverse().apply(each.position_m)) for each in firsts]
    firsts[2] = replace(firsts[2], position_m=mirror_m, mirror_position_m=ANCHORS_M["C"])
    seconds[0] = replace(seconds[0], mirror_position_m=np.zeros(3))
    world, [(_, anchors_m), *_] = added(monkeypatch, model_of(IDENTITY, firsts), model_of(OWN, seconds))
    np.testing.assert_array_equal(anchors_m["C"], ANCHORS_M["C"])
    np.testing.assert_array_equal(anchors_m["A"], ANCHORS_M["A"])
    # The second has no doubt about C, and the first none about A, which are kept so.
    np.testing.assert_allclose(world.anchors["C"].places_m, [ANCHORS_M["C"]], atol=1e-3)
    np.testing.assert_array_equal(world.anchors["A"].places_m, [ANCHORS_M["A"]])


@pytest.mark.parametrize("are_in_frame", [(True, True), (True, False), (False, True)])
def test_models_in_the_frame_of_the_anchors_need_no_shared_ones(
    monkeypatch: pytest.MonkeyPatch, are_in_frame: tuple[bool, bool]
) -> None:
    firsts = [estimated("A", ANCHORS_M["A"], is_given=True), estimated("B", ANCHORS_M["B"], is_given=True)]
    seconds = [replace(firsts[1], position_m=np.ones(3)), estimated("C", ANCHORS_M["C"], is_given=True)]
    first = model_of(IDENTITY, firsts, is_in_anchor_frame=are_in_frame[0])
    second = model_of(OWN, seconds, is_in_anchor_frame=are_in_frame[1])
    if are_in_frame != (True, True):
        with pytest.raises(GeometryError, match="of its anchors only B also belong to others"):
            added(monkeypatch, first, second)
        return
    # The scale changes in the fit of all, but anchors are only carried along, not scaled.
    placed = Similarity(2.2, TURN, np.array([1.0, 2.0, 3.0]))
    world, [(start, anchors_m)] = added(monkeypatch, first, second, placed)
    assert start is OWN
    assert {id_: at.tolist() for id_, at in anchors_m.items()} == {
        id_: ANCHORS_M[id_].tolist() for id_ in ("B", "C", "A")
    }
    assert world.notes == []
    np.testing.assert_allclose(world.anchors["C"].places_m, [TURN @ ANCHORS_M["C"] + [1.0, 2.0, 3.0]])
    np.testing.assert_array_equal(world.anchors["B"].places_m, [ANCHORS_M["B"]])


def test_what_is_known_of_an_anchor_is_from_models_in_its_frame_and_its_bias_from_one_that_hears_it() -> None:
    quiet = replace(estimated("A", np.ones(3), is_given=True), prior_bias_stddev_m=0.0)
    heard = replace(estimated("A", np.zeros(3), is_given=True), prior_bias_stddev_m=0.2, prior_position_stddev_m=0.3)
    free = replace(estimated("A", np.full(3, 7.0)), prior_bias_stddev_m=0.1)
    in_frame, also, out = (
        model_of(IDENTITY, [anchor], is_in_anchor_frame=is_in)
        for anchor, is_in in ((quiet, True), (heard, True), (free, False))
    )
    [both] = model_placement._common_anchors([in_frame, also, out])
    assert (both.prior_bias_stddev_m, both.prior_position_stddev_m) == (0.2, 0.3)
    np.testing.assert_array_equal(known(both.prior_position_m), np.ones(3))
    [later] = model_placement._common_anchors([model_of(IDENTITY, [free], is_in_anchor_frame=True), also])
    np.testing.assert_array_equal(known(later.prior_position_m), np.zeros(3))
    # Without a frame of the anchors in the first, their places are unknown.
    [without] = model_placement._common_anchors([out, also])
    assert without.prior_position_m is None
    assert without.prior_position_stddev_m == np.inf


def test_the_placed_models_are_solved_together_from_all_ranges_and_a_single_one_stays(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    both = [Similarity(3.0, TURN, np.ones(3)), OWN]
    world, asked = world_of(monkeypatch, [fit_of(both)])
    assert world.solved() == {0: IDENTITY}
    assert asked == []
    world.metric_from_sfm[2] = MOTION
    found = world.solved()
    assert [*found] == [0, 2]
    assert [*found.values()] == both
    models, num_per_anchor = asked[0]
    assert [id(each) for each in models] == [id(world._models[0]), id(world._models[2])]
    assert num_per_anchor is None
    assert asked[1][0] == [IDENTITY, MOTION]
