"""Ranges at another map: where it is, how they fit there, and how much it is bent."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.errors.robust_loss import CAUCHY
from rangesfm.scale import at_map
from rangesfm.scale.at_map import MapWithRanges
from rangesfm.scale.placement_prior import PlacementPrior
from rangesfm.scale.range_equation import RangeProblem
from rangesfm.scale.scale_by_lengths import LengthScale
from rangesfm.scale.scale_problem import ScaleProblem

Array = npt.NDArray[np.float64]

NUM, SCALE = 12, 2.5
PLACEMENT = PlacementPrior.of(Similarity(SCALE, np.eye(3), np.zeros(3)), np.zeros(3), np.eye(7))


@dataclass(frozen=True)
class Ranges:
    """Ranges on a path in the metric world, some of which do not fit, with the anchors in their places."""

    path: Trajectory
    tags_m: Array
    centers_m: Array
    anchors_m: Array
    biases_m: Array
    errors: RangeErrors
    off_m: Array
    start: Any

    @property
    def true_m(self) -> Array:
        """(k,) distances with their biases."""
        index = np.arange(NUM) % 3
        between: Array = np.linalg.norm(self.tags_m - self.anchors_m[index], axis=1)
        return between + self.biases_m[index]

    def on_map(self, shared_m: Array, lengths: LengthScale | None = None) -> MapWithRanges:
        bending: Any = SimpleNamespace(path=self.path)
        return MapWithRanges.of(
            self.start,
            self.path,
            SCALE,
            self.tags_m,
            self.centers_m,
            self.anchors_m,
            self.biases_m,
            self.errors,
            shared_m,
            bending,
            placement=PLACEMENT,
            lengths=lengths,
        )


def ranges() -> Ranges:
    rng = np.random.default_rng(0)
    rotations = Rotation.from_rotvec(rng.standard_normal((NUM, 3))).as_matrix()
    centers_m = rng.standard_normal((NUM, 3)) * [4.0, 3.0, 1.0] + [20.0, 30.0, 2.0]
    path = Trajectory(np.arange(NUM), tuple(map(str, range(NUM))), np.arange(float(NUM)), centers_m, rotations)
    tags_m = centers_m + rotations @ np.array([0.3, -0.2, 0.1])
    zeros, no = np.zeros(NUM), np.zeros(NUM, dtype=np.int64)
    errors = RangeErrors(
        stddev_m=np.linspace(0.1, 0.2, NUM) ** 1.5,
        share=np.linspace(0.5, 1.0, NUM),
        inflation=2.0,
        given_m=zeros,
        shared_m=zeros,
        placing_m=zeros,
        anchor_index=np.arange(NUM) % 3,
        block=no,
        place=no,
        loss=CAUCHY,
        common_bias_stddev_m=0.05,
    )
    off_m = np.where(np.arange(NUM) < 4, 0.3, 0.0)
    taped = LocatedDistances.of(np.array([2.0, 7.0]), np.full(2, 0.1), model_length=np.array([1.0, np.nan]))
    taped = replace(taped, anchor_pair=np.array([[-1, -1], [0, 1]]))
    made = Ranges(
        path, tags_m, centers_m, path.centers[:3] + 6.0, np.array([0.1, -0.2, 0.3]), errors, off_m, SimpleNamespace()
    )
    problem = RangeProblem(
        centers=np.full((NUM, 3), np.nan),
        tag_from_center=np.full((NUM, 3), np.nan),
        anchor_index=np.arange(NUM) % 3,
        range_m=made.true_m - off_m,
        stddev_m=np.full(NUM, np.nan),
        anchor_mean_m=made.anchors_m,
        anchor_stddev_m=np.full(3, 0.1),
        bias_mean_m=np.zeros(3),
        bias_stddev_m=np.full(3, 0.1),
        common_bias_stddev_m=0.05,
        frame_is_free=True,
        distances=taped,
    )
    unused: Any = SimpleNamespace()
    posed = ScaleProblem(problem, errors, unused, np.arange(NUM), unused, "site", True, (), (), ())
    made.start.problem = posed
    return made


def test_the_other_map_is_in_the_unit_of_the_model_and_in_its_first_camera() -> None:
    made = ranges()
    found = made.on_map(np.zeros(NUM))
    problem, placed = found.posed.ranges, found.metric_from_model
    assert placed.scale == SCALE
    np.testing.assert_allclose(placed.rotation, made.path.world_from_cam[0])
    np.testing.assert_allclose(placed.apply(np.zeros(3)), made.path.centers[0])
    np.testing.assert_allclose(placed.apply(problem.centers), made.centers_m)
    np.testing.assert_allclose(problem.tag_from_center @ placed.rotation.T, made.tags_m - made.centers_m)
    np.testing.assert_allclose(problem.centers[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(found.predicted_m, made.true_m)
    path = found.posed.trajectory
    np.testing.assert_allclose(path.centers, made.path.centers / SCALE)
    np.testing.assert_allclose(path.world_from_cam, made.path.world_from_cam)
    assert problem.placement is PLACEMENT
    assert found.bending.path is made.path


def test_ranges_are_weighed_at_the_map_without_the_errors_that_they_share() -> None:
    made = ranges()
    found = made.on_map(np.zeros(NUM))
    expected = 1 / (1 + (made.off_m / made.errors.stddev_m / 2.385) ** 2)
    np.testing.assert_allclose(found.solution.fit.weights, expected)
    np.testing.assert_allclose(found.solution.fit.residuals_m, made.off_m, atol=1e-9)
    assert found.solution.noise_stddev_m == pytest.approx(np.median(made.errors.stddev_m))
    assert found.solution.errors is made.errors
    # The solution has the weights of the errors, with more weight on its priors, and the problem itself has not.
    np.testing.assert_array_equal(found.solution.problem.stddev_m, made.errors.stddev_m)
    np.testing.assert_array_equal(found.solution.problem.share, made.errors.share)
    np.testing.assert_allclose(found.solution.problem.bias_stddev_m, 0.05)
    np.testing.assert_allclose(found.posed.ranges.bias_stddev_m, 0.1)
    without = made.on_map(-made.off_m)
    np.testing.assert_allclose(without.solution.fit.weights, 1.0)
    np.testing.assert_allclose(without.solution.fit.residuals_m, made.off_m, atol=1e-9)


def test_lengths_say_the_scale_of_the_model_with_the_maps_bending() -> None:
    """Lengths at the metric map say by which factor it is too small."""
    made, one = ranges(), np.ones(1)
    components = {"tape": 0.03, "marks": 0.04, "bending": 0.12}
    kept = LengthScale(1.02, components, np.zeros(1, dtype=np.int64), one > 0, *np.ones((5, 1)))
    distances = made.on_map(np.zeros(NUM), kept).posed.ranges.distances
    assert distances is not None
    np.testing.assert_allclose(distances.distance_m, [1.02 * SCALE, 7.0])
    np.testing.assert_allclose(distances.stddev_m, [1.02 * SCALE * 0.13, 0.1])
    np.testing.assert_array_equal(distances.model_length, [1.0, np.nan])
    without = made.on_map(np.zeros(NUM)).posed.ranges.distances
    assert without is made.start.problem.ranges.distances
    made.start.problem = replace(made.start.problem, ranges=replace(made.start.problem.ranges, distances=None))
    assert made.on_map(np.zeros(NUM), kept).posed.ranges.distances is None


def test_a_moved_map_is_the_same_one_in_another_world() -> None:
    made = ranges()
    found = made.on_map(np.zeros(NUM))
    turn = Similarity(1.1, Rotation.from_rotvec([0.1, 0.2, -0.3]).as_matrix(), np.array([1.0, 2.0, 3.0]))
    state = replace(found.solution.fit.state, metric_from_model=turn @ found.metric_from_model)
    moved = replace(found, solution=replace(found.solution, fit=replace(found.solution.fit, state=state)))
    change = found.change_to(moved)
    assert change.scale == pytest.approx(1.1)
    np.testing.assert_allclose(change.rotation, turn.rotation, atol=1e-12)
    np.testing.assert_allclose(change.translation, turn.translation, atol=1e-9)


def test_the_bending_is_compared_with_what_the_photos_let_expect(monkeypatch: pytest.MonkeyPatch) -> None:
    found = ranges().on_map(np.zeros(NUM))
    learned: Any = SimpleNamespace(bins=range(3), stddev_of_component={"bending": 0.5, "white": 9.0})
    expected: list[Any] = [SimpleNamespace(formal_m2=np.diag([0.01, 0.04, 0.07]))]
    monkeypatch.setattr(at_map, "bending_of_bins", lambda *_: expected[0])
    assert found.bending_factor(learned) == pytest.approx(0.5 / 0.2)
    expected[0] = SimpleNamespace(formal_m2=np.zeros((3, 3)))
    assert found.bending_factor(learned) == 1.0
    expected[0] = None
    assert found.bending_factor(learned) == 1.0
