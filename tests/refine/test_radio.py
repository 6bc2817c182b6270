"""Ranges in the refinement: the places of their antennas, what they should be, and their residuals and priors."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tests.known import known
from tests.refine.test_bundle_adjustment import a_bundle, orbit
from tests.refine.test_keyframe_graph import errors_of
from tests.refine.test_positions import residuals_added

from rangesfm import ceres
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory, pose_of, trajectory_from_reconstruction
from rangesfm.options import RefineOptions
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.errors.robust_loss import RobustLoss
from rangesfm.refine.bundle_adjustment import BundleAdjustment
from rangesfm.refine.radio import (
    AddedRadio,
    Antennas,
    RadioEstimate,
    RadioRanges,
    add_radio_priors,
    add_range_residuals,
    antennas,
    moved_anchors,
    radio_blocks,
)

Array = npt.NDArray[np.float64]
TAGS_M = np.array([[0.1, -0.2, 0.3], [-0.3, 0.1, 0.05]])
LOSS = RobustLoss(3.0, is_bounded=True)


def anchor(name: str, place: list[float], **given: Any) -> AnchorEstimate:
    position = np.array(place)
    found = AnchorEstimate(name, position, 0.1, position.copy(), 0.1, 0.0, 0.0, 0.1)
    return replace(found, **given)


ANCHORS = (
    anchor("N0", [1.0, 2.0, 3.0], range_bias_m=0.2),
    anchor("N1", [-2.0, 1.0, 0.0], range_bias_m=-0.1, prior_bias_stddev_m=0.3),
    anchor("unheard", [0.0, 0.0, 9.0]),
)


def times_of(model: pycolmap.Reconstruction) -> dict[str, float]:
    return {name: 2.0 * k for k, name in enumerate(sorted(image.name for image in model.images.values()))}


def four_ranges(model: pycolmap.Reconstruction) -> RadioRanges:
    """Return two ranges between keyframes, one at a keyframe, and one without a place, which is the third."""
    rng = np.random.default_rng(4)
    before, after = np.array([0, 2, -1, 4]), np.array([1, 3, -1, 4])
    tag_index = np.array([0, 1, 0, 1])
    log: Any = SimpleNamespace(
        anchor_index=np.array([0, 1, 0, 0]), tag_index=tag_index, range_m=np.array([3.0, 4.0, 5.0, 4.5])
    )
    observations: Any = SimpleNamespace(log=log, before=before, placed_rows=np.array([3, 0, 1]))
    offsets_m = rng.normal(0, 0.1, (4, 3))
    offsets_m[3] = 0.0
    placed = Antennas(before, after, np.array([0.25, 0.5, 0.0, 0.0]), TAGS_M[tag_index], offsets_m)
    trajectory = trajectory_from_reconstruction(model, times_of(model))
    return RadioRanges(observations, trajectory, placed, rng.normal(0, 0.1, (4, 2)))


def estimate(**given: Any) -> RadioEstimate:
    return replace(RadioEstimate(ANCHORS, TAGS_M, 0.0, 0.0, np.array([0.5, -1.0])), **given)


def errors(common_bias_stddev_m: float = 0.1) -> RangeErrors:
    """Return the errors of the three ranges with a place."""
    found = errors_of(np.array([0, 0, 1]), 0.3)
    return replace(
        found, stddev_m=np.array([0.2, 0.3, 0.4]), share=np.array([1.0, 0.5, 0.25]), inflation=1.5, loss=LOSS,
        common_bias_stddev_m=common_bias_stddev_m,
    )  # fmt: skip


def places_by_hand(path: Trajectory, ranges: RadioRanges, tags_m: Array, shift_s: float = 0.0) -> tuple[Array, Array]:
    """Return the (4, 3) places of antennas and of the camera; keyframes are 2 s apart."""
    fraction = np.array([0.25 + shift_s / 2, 0.5 + shift_s / 2, 0.0, 0.0])[:, None]
    arms_m = tags_m[[0, 1, 0, 1]]
    before, after = (
        path.centers[ends] + np.einsum("nij,nj->ni", path.world_from_cam[ends], arms_m)
        for ends in ([0, 2, 0, 4], [1, 3, 0, 4])
    )
    at = (1 - fraction) * before + fraction * after + ranges.antennas.offset_in_world_m
    return at, (1 - fraction) * path.centers[[0, 2, 0, 4]] + fraction * path.centers[[1, 3, 0, 4]]


def test_an_antenna_is_between_those_of_its_two_keyframes() -> None:
    turned = Rotation.from_rotvec([0.0, 0.0, np.pi / 2]).as_matrix()
    both = Antennas(
        np.array([0, 1]), np.array([1, 1]), np.array([0.25, 0.0]), np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]]),
        np.array([[0.0, 0.0, 0.5], [0.0] * 3]),
    )  # fmt: skip
    found = both.positions(np.array([[0.0, 0.0, 0.0], [4.0, 0.0, 0.0]]), np.array([np.eye(3), turned]))
    # (1, 0, 0) and (4, 1, 0), a quarter of the way; the second lever arm points to -x.
    np.testing.assert_allclose(found, [[1.75, 0.25, 0.5], [2.0, 0.0, 0.0]], atol=1e-12)
    second = both.subset(np.array([1]))
    assert (second.before.tolist(), second.after.tolist(), second.fraction.tolist()) == ([1], [1], [0.0])
    np.testing.assert_array_equal(second.tag_in_cam_m, [[0.0, 2.0, 0.0]])
    np.testing.assert_array_equal(second.offset_in_world_m, [[0.0] * 3])


def test_antennas_of_a_metric_map_are_where_the_scale_stage_put_them() -> None:
    rng = np.random.default_rng(6)
    sfm = trajectory_from_reconstruction(orbit())
    placed = Similarity(2.0, Rotation.from_rotvec([0.2, 0.7, -0.4]).as_matrix(), np.array([5.0, 6.0, 7.0]))
    offsets, arms_m = rng.normal(0, 0.1, (2, 3)), rng.normal(0, 0.3, (2, 3))
    observed: Any = SimpleNamespace(
        log=SimpleNamespace(tag_index=np.array([1, 0])), before=np.array([0, 3]), after=np.array([1, 3]),
        fraction=np.array([0.25, 0.0]), center_offsets=offsets, tag_from_center=arms_m,
    )  # fmt: skip
    found = antennas(sfm, observed, placed, TAGS_M)
    metric = sfm.transformed(placed.scale, placed.rotation, placed.translation)
    centers = np.array([0.75 * sfm.centers[0] + 0.25 * sfm.centers[1], sfm.centers[3]]) + offsets
    expected = placed.apply(centers) + arms_m @ placed.rotation.T
    np.testing.assert_allclose(found.positions(metric.centers, metric.world_from_cam), expected, atol=1e-12)
    np.testing.assert_array_equal(found.tag_in_cam_m, TAGS_M[[1, 0]])


def test_intervals_between_keyframes_are_those_of_their_times() -> None:
    ranges = four_ranges(orbit())
    np.testing.assert_array_equal(ranges.interval_s, [2.0, 2.0, 0.0, 0.0])
    untimed = replace(ranges, trajectory=replace(ranges.trajectory, timestamps_s=None))
    np.testing.assert_array_equal(untimed.interval_s, np.zeros(4))
    np.testing.assert_array_equal(ranges.rows, [3, 0, 1])


@pytest.mark.parametrize("shift_s", [0.0, 0.3])
def test_a_shift_in_time_moves_only_ranges_between_keyframes(shift_s: float) -> None:
    model = orbit()
    ranges = four_ranges(model)
    path, tags_m = ranges.trajectory.as_in(model), TAGS_M + 0.1
    found = ranges.places(path, estimate(tags_in_cam_m=tags_m, time_shift_s=shift_s))
    expected = places_by_hand(path, ranges, tags_m, shift_s)
    for seen, by_hand in zip(found, expected, strict=True):
        np.testing.assert_allclose(seen[[0, 1, 3]], by_hand[[0, 1, 3]], atol=1e-12)
    # What is assumed of the ranges themselves stays as it is.
    np.testing.assert_array_equal(ranges.antennas.fraction, [0.25, 0.5, 0.0, 0.0])


def test_predicted_ranges_have_biases_and_the_excess_of_short_ones() -> None:
    model = orbit()
    ranges = four_ranges(model)
    path = ranges.trajectory.as_in(model)
    at, _ = places_by_hand(path, ranges, TAGS_M)
    distance = np.linalg.norm(at - np.array([ANCHORS[k].position_m for k in (0, 1, 0, 0)]), axis=1)
    expected = distance + [0.2, -0.1, 0.2, 0.2] + 0.7 * np.exp(-distance / 1.0)
    found = ranges.predicted_m(model, estimate(short_range_error_m=0.7))
    np.testing.assert_allclose(found[[0, 1, 3]], expected[[0, 1, 3]], rtol=1e-12)
    assert np.isnan(found[2])
    np.testing.assert_allclose(ranges.shared_m(estimate()), ranges.shared_errors_m @ [0.5, -1.0])


FREE = RefineOptions(lever_arm_stddev_m=0.02, time_offset_stddev_s=0.05, short_range_stddev_m=0.1)
FIXED = RefineOptions()


def added(
    bundle: BundleAdjustment, ranges: RadioRanges, radio: RadioEstimate, options: RefineOptions
) -> tuple[ceres.RangeBlocks, npt.NDArray[np.int64]]:
    blocks = radio_blocks(radio, bundle.metric, ranges.trajectory, options)
    return blocks, add_range_residuals(bundle, ranges, errors(), blocks)


def test_only_what_has_an_uncertainty_gets_a_parameter() -> None:
    model = orbit()
    trajectory, radio = four_ranges(model).trajectory, estimate(time_shift_s=0.25, short_range_error_m=0.5)
    free, fixed = (radio_blocks(radio, model, trajectory, options) for options in (FREE, FIXED))
    assert free.lever_arms_are_free
    assert not fixed.lever_arms_are_free
    np.testing.assert_array_equal(known(free.time_shift), [0.25])
    np.testing.assert_array_equal(known(free.amplitude), [0.5])
    assert fixed.time_shift is None
    assert fixed.amplitude is None
    np.testing.assert_array_equal(free.tags_in_cam, TAGS_M)
    np.testing.assert_array_equal(free.anchors, [each.position_m for each in ANCHORS])
    np.testing.assert_array_equal(free.biases, [[0.2], [-0.1], [0.0]])
    np.testing.assert_array_equal(np.concatenate(free.shared), [0.5, -1.0])
    for frame_id, block in zip(trajectory.frame_ids.tolist(), free.poses, strict=True):
        assert block.ctypes.data == pose_of(model.frame(frame_id)).params.ctypes.data
    # The solver changes the blocks, not the estimate that it starts from.
    assert not any(np.shares_memory(block, TAGS_M) for block in free.tags_in_cam)
    assert not any(np.shares_memory(b, a.position_m) for a, b in zip(ANCHORS, free.anchors, strict=True))


@pytest.mark.parametrize("options", [FREE, FIXED])
def test_an_estimate_has_the_values_that_the_solver_left(options: RefineOptions) -> None:
    model = orbit()
    before = estimate(time_shift_s=0.25, short_range_error_m=0.5)
    blocks = radio_blocks(before, model, four_ranges(model).trajectory, options)
    for block in (*blocks.anchors, *blocks.biases, *blocks.tags_in_cam, *blocks.shared):
        block += 1.0
    for wanted in (blocks.time_shift, blocks.amplitude):
        if wanted is not None:
            wanted += 1.0
    other = np.zeros(3)
    radio = AddedRadio(blocks, [other], np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))
    found = radio.estimate(before)
    for each, given in zip(found.anchors, ANCHORS, strict=True):
        np.testing.assert_array_equal(each.position_m, given.position_m + 1.0)
        assert each.range_bias_m == given.range_bias_m + 1.0
        assert (each.anchor_id, each.prior_bias_stddev_m) == (given.anchor_id, given.prior_bias_stddev_m)
    np.testing.assert_array_equal(found.tags_in_cam_m, TAGS_M + 1.0)
    is_free = options is FREE
    assert (found.time_shift_s, found.short_range_error_m) == ((1.25, 1.5) if is_free else (0.25, 0.5))
    np.testing.assert_array_equal(found.shared, [1.5, 0.0])
    wanted_ids = [id(block) for block in (blocks.time_shift, blocks.amplitude) if block is not None]
    expected = [id(block) for block in (*blocks.biases, *blocks.tags_in_cam)]
    expected += [*wanted_ids, *(id(block) for block in blocks.shared), id(other)]
    assert [id(block) for block in radio.all_but_anchors] == expected


def test_an_estimate_without_tags_and_shared_errors_is_empty() -> None:
    blocks = ceres.RangeBlocks((), (), (), ())
    none = np.zeros(0, dtype=np.int64)
    found = AddedRadio(blocks, [], none, none).estimate(RadioEstimate((), np.zeros((0, 3))))
    assert found.tags_in_cam_m.shape == (0, 3)
    assert found.shared.shape == (0,)


@pytest.mark.parametrize("options", [FREE, FIXED])
def test_residuals_of_ranges_are_robust_and_in_pixels(options: RefineOptions) -> None:
    bundle = a_bundle()
    ranges = four_ranges(bundle.metric)
    blocks, rows = added(bundle, ranges, estimate(), options)
    if options is FREE:  # the values of the blocks count, not those at the start
        blocks.tags_in_cam[0][:] += 0.1
        known(blocks.time_shift)[:] = 0.2
        known(blocks.amplitude)[:] = 0.4
    blocks.biases[1][:] += 0.3
    none = np.zeros(0, dtype=np.int64)
    now = AddedRadio(blocks, [], rows, none).estimate(estimate())
    off_m = ranges.predicted_m(bundle.metric, now) + ranges.shared_m(now) - ranges.observations.log.range_m
    scaled = off_m[ranges.rows] / errors().stddev_m
    worth = np.array([1.0, 0.5, 0.25]) / 1.5**2
    expected = np.sign(scaled) * np.sqrt(worth * LOSS.rho(scaled**2)[0])
    residuals = np.asarray(bundle.adjuster.problem.evaluate_residuals())
    np.testing.assert_allclose(residuals[rows], bundle.pixel_stddev * expected, rtol=1e-9)
    assert len(residuals) == bundle.num_reprojections + 3


def test_each_parameter_of_the_radio_has_its_prior_in_pixels() -> None:
    bundle = a_bundle()
    ranges, radio = four_ranges(bundle.metric), estimate()
    blocks, _ = added(bundle, ranges, radio, FREE)
    before = bundle.adjuster.problem.num_residuals()
    rows = add_radio_priors(bundle, radio, TAGS_M, 0.5, blocks, FREE)
    assert isinstance(rows, np.ndarray)
    blocks.anchors[0] += [0.1, 0.2, -0.3]
    blocks.anchors[1] += [-0.1, 0.3, 0.2]
    blocks.tags_in_cam[0] += [0.01, 0.02, 0.03]
    blocks.tags_in_cam[1] += [0.04, -0.02, 0.01]
    known(blocks.time_shift)[:] = 0.1
    known(blocks.amplitude)[:] = 0.3
    residuals = np.asarray(bundle.adjuster.problem.evaluate_residuals())
    found = residuals[before:][residuals[before:] != 0] / bundle.pixel_stddev
    np.testing.assert_allclose(found[:6], [1.0, 2.0, -3.0, -1.0, 3.0, 2.0])
    # Both biases, 0.2 and -0.1, have own errors of 0.1 and 0.3, and one of 0.5 in common.
    covariance = np.diag([0.1**2, 0.3**2]) + 0.5**2
    off_m = np.array([0.2, -0.1])
    assert found[6:8] @ found[6:8] == pytest.approx(off_m @ np.linalg.solve(covariance, off_m))
    np.testing.assert_allclose(found[8:14], [0.5, 1.0, 1.5, 2.0, -1.0, 0.5])
    np.testing.assert_allclose(found[14:16], [2.0, 3.0])
    np.testing.assert_allclose(found[16:], [0.5, -1.0])
    np.testing.assert_allclose(residuals[rows], bundle.pixel_stddev * np.array([0.5, -1.0]))
    assert not bundle.adjuster.problem.has_parameter_block(blocks.anchors[2])


def bias_residuals(common_bias_stddev_m: float, *stddevs_m: float) -> tuple[BundleAdjustment, list[Array], Array]:
    """Return the biases of two anchors with these priors, and the residuals of the priors, in standard deviations."""
    bundle = a_bundle()
    ranges = four_ranges(bundle.metric)
    anchors = [replace(each, prior_position_stddev_m=np.inf, prior_position_m=None) for each in ANCHORS]
    both = (replace(each, prior_bias_stddev_m=stddev) for each, stddev in zip(anchors[:2], stddevs_m, strict=True))
    radio = replace(estimate(), anchors=(*both, anchors[2]), shared=np.zeros(0))
    blocks, _ = added(bundle, replace(ranges, shared_errors_m=np.zeros((4, 0))), radio, FIXED)
    before = bundle.num_reprojections + 3
    rows = add_radio_priors(bundle, radio, TAGS_M, common_bias_stddev_m, blocks, FIXED)
    assert len(rows) == 0
    found = np.asarray(bundle.adjuster.problem.evaluate_residuals())[before:]
    return bundle, list(blocks.biases[:2]), found[found != 0] / bundle.pixel_stddev


def test_a_bias_without_an_uncertainty_is_fixed_and_an_unknown_one_has_no_prior() -> None:
    bundle, biases, found = bias_residuals(0.0, 0.0, np.inf)
    assert [bundle.adjuster.problem.is_parameter_block_constant(bias) for bias in biases] == [True, False]
    assert len(found) == 0
    assert len(residuals_added(bundle)) == 3  # those of the ranges


def test_a_single_bias_with_a_prior_has_the_common_error_too() -> None:
    _, _, found = bias_residuals(0.4, 0.0, 0.3)
    assert np.abs(found) == pytest.approx([0.1 / 0.5])


def test_biases_without_a_common_error_are_independent() -> None:
    _, _, found = bias_residuals(0.0, 0.1, 0.3)
    assert np.abs(found) == pytest.approx([2.0, 1 / 3])


def test_moved_anchors_keep_all_but_their_places_and_biases() -> None:
    places = np.arange(9.0).reshape(3, 3)
    found = moved_anchors(ANCHORS, places, [1.0, 2.0, 3.0])
    assert [each.anchor_id for each in found] == ["N0", "N1", "unheard"]
    np.testing.assert_array_equal([each.position_m for each in found], places)
    assert [each.range_bias_m for each in found] == [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match="zip"):
        moved_anchors(ANCHORS, places[:2], [1.0, 2.0, 3.0])
