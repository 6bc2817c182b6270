"""Measured distances that hold a map in the refinement: markers as points of the map, and the residuals."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.known import known
from tests.refine.test_bundle_adjustment import a_bundle, orbit
from tests.refine.test_positions import residuals_added

from rangesfm.distances.locate_lengths import LocatedDistances, images_by_name, mark_covariance
from rangesfm.distances.tape import CONTROL, Marker, Tape, TapedDistance
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.robust_loss import RobustLoss
from rangesfm.refine.bundle_adjustment import BundleAdjustment
from rangesfm.refine.distances import (
    MeasuredDistances,
    add_distances,
    add_marker_points,
    errors_beyond_features,
    remove_marker_points,
)

Array = npt.NDArray[np.float64]
NO_PAIRS = LocatedDistances.of(np.zeros(0), np.zeros(0), anchor_pair=np.zeros((0, 2), dtype=np.int64))
LOSS_WIDTH = 3.0


def taped(start: str, end: str, distance_m: float = 1.0, stddev_m: float = 0.02) -> TapedDistance:
    return TapedDistance((start, end), distance_m, stddev_m, CONTROL, 0)


def marker_at(model: pycolmap.Reconstruction, place: Array, names: list[str]) -> Marker:
    """Return exact marks of a place in some photos, and in one that is not in the model."""
    images = images_by_name(model)
    pixels = [known(images[name].project_point(place)) for name in names]
    return Marker((*names, "elsewhere.jpg"), np.array([*pixels, [1.0, 2.0]]), (0,) * (len(names) + 1))


def some_points(model: pycolmap.Reconstruction) -> list[tuple[Array, list[str]]]:
    """Return places of points, with the names of three photos that see each."""
    points = [model.point3D(point_id) for point_id in sorted(model.points3D)]
    seen = [sorted(model.image(element.image_id).name for element in point.track.elements) for point in points]
    return [(point.xyz.copy(), names[:3]) for point, names in zip(points, seen, strict=True) if len(names) >= 3]


def test_markers_become_points_with_their_marks_as_features_and_go_again() -> None:
    model = orbit()
    num_features = {image_id: len(image.points2D) for image_id, image in model.images.items()}
    point_ids = set(model.points3D)
    (a_m, of_a), (b_m, of_b), (c_m, of_c), (d_m, of_d) = some_points(model)[:4]
    markers = {
        "A": marker_at(model, a_m, of_a), "B": marker_at(model, b_m, of_b), "unused": marker_at(model, d_m, of_d)
    }  # fmt: skip
    tape = Tape((taped("A", "B"),), markers)
    ids = add_marker_points(model, tape, {"C": marker_at(model, c_m, of_c)})
    assert list(ids) == ["A", "B", "C"]
    assert point_ids.isdisjoint(ids.values())
    for name, place, names in (("A", a_m, of_a), ("B", b_m, of_b), ("C", c_m, of_c)):
        point = model.point3D(ids[name])
        np.testing.assert_allclose(point.xyz, place, atol=1e-6)
        assert sorted(model.image(element.image_id).name for element in point.track.elements) == names
        for element in point.track.elements:
            feature = model.image(element.image_id).point2D(element.point2D_idx)
            seen_at = known(model.image(element.image_id).project_point(place))
            np.testing.assert_allclose(feature.xy, seen_at, atol=1e-9)
            assert feature.point3D_id == ids[name]
    remove_marker_points(model, ids)
    assert set(model.points3D) == point_ids
    assert {image_id: len(image.points2D) for image_id, image in model.images.items()} == num_features


def test_without_further_markers_only_the_ends_of_lengths_are_added() -> None:
    model = orbit()
    (a_m, of_a), (b_m, of_b) = some_points(model)[:2]
    markers = {"A": marker_at(model, a_m, of_a), "B": marker_at(model, b_m, of_b)}
    assert list(add_marker_points(model, Tape((taped("A", of_a[0]),), markers))) == ["A"]
    assert add_marker_points(model, Tape((), markers)) == {}


def test_a_marker_that_is_an_end_and_a_control_point_is_one_point() -> None:
    model = orbit()
    (a_m, of_a), (b_m, of_b) = some_points(model)[:2]
    markers = {"A": marker_at(model, a_m, of_a), "B": marker_at(model, b_m, of_b)}
    before = len(model.points3D)
    ids = add_marker_points(model, Tape((taped("A", "B"),), markers), {"A": markers["A"]})
    assert list(ids) == ["A", "B"]
    assert len(model.points3D) == before + 2


@pytest.mark.parametrize(("stddev_px", "beyond_px"), [(1.0, 0.8), (0.61, 0.1099), (0.6, 0.0), (0.3, 0.0)])
def test_a_mark_that_is_less_precise_than_a_feature_has_further_errors(stddev_px: float, beyond_px: float) -> None:
    bundle = replace(a_bundle(), pixel_stddev=0.6)
    model = bundle.metric
    place, names = some_points(model)[0]
    marker = replace(marker_at(model, place, names), stddev_px=stddev_px)
    point_id = min(point_id for point_id in model.points3D if np.array_equal(model.point3D(point_id).xyz, place))
    found = errors_beyond_features(bundle, {"A": marker}, {"A": point_id})
    of_one_pixel = mark_covariance(replace(marker, stddev_px=1.0), place, images_by_name(model))
    assert list(found) == ["A"]
    np.testing.assert_allclose(found["A"], beyond_px**2 * of_one_pixel, rtol=1e-2, atol=1e-15)


def errors_with(common_bias_stddev_m: float) -> Any:
    return SimpleNamespace(common_bias_stddev_m=common_bias_stddev_m, loss=RobustLoss(LOSS_WIDTH, is_bounded=True))


def an_anchor(name: str, place: Array) -> AnchorEstimate:
    return AnchorEstimate(name, place, 0.1, None, np.inf, 0.0, 0.0, 0.1)


def add_tape(
    bundle: BundleAdjustment,
    distances: list[TapedDistance],
    marker_ids: dict[str, int] | None = None,
    of_marks: dict[str, Array] | None = None,
    **anchors_m: Array,
) -> list[Array]:
    """Add taped distances, with anchors whose parameter blocks are given."""
    measured = MeasuredDistances(NO_PAIRS, Tape(tuple(distances)), marker_ids or {})
    anchors = [an_anchor(name, place) for name, place in anchors_m.items()]
    return add_distances(bundle, measured, anchors, [*anchors_m.values()], errors_with(0.1), of_marks or {})


def expected_error(length_m: float, length: TapedDistance, of_marks_m2: float = 0.0) -> float:
    return abs(length_m - length.distance_m) / float(np.sqrt(length.stddev_m**2 + of_marks_m2))


def test_a_length_between_markers_has_the_errors_of_their_marks_along_it() -> None:
    model = orbit()
    a, b = sorted(model.points3D)[:2]
    bundle = a_bundle(model, marker_ids=[a, b])
    of_marks = {"A": 1e-4 * np.diag([1.0, 2.0, 3.0]), "B": 1e-4 * np.diag([5.0, 1.0, 2.0])}
    apart = model.point3D(b).xyz - model.point3D(a).xyz
    length = taped("A", "B", 1.0, 0.02)
    assert add_tape(bundle, [length], {"A": a, "B": b}, of_marks) == []
    along = apart / np.linalg.norm(apart)
    of_marks_m2 = 1e-4 * float(along**2 @ [6.0, 3.0, 5.0])
    expected = bundle.pixel_stddev * expected_error(float(np.linalg.norm(apart)), length, of_marks_m2)
    assert np.abs(residuals_added(bundle)) == pytest.approx([expected])


def test_points_at_the_ends_of_lengths_are_kept_from_elimination() -> None:
    model = orbit()
    point_id, point = min(model.points3D.items())
    bundle = a_bundle(model, marker_ids=[point_id])
    assert not bundle.adjuster.problem.has_manifold(point.xyz)
    add_tape(bundle, [], {"A": point_id}, {"A": np.zeros((3, 3))})
    assert bundle.adjuster.problem.has_manifold(point.xyz)


def test_lengths_between_photos_markers_and_anchors_are_those_between_their_places() -> None:
    model = orbit()
    point_id, anchor_m = min(model.points3D), np.array([1.0, 2.0, 30.0])
    bundle = a_bundle(model, marker_ids=[point_id])
    other_m, lost_m = np.array([4.0, -2.0, 9.0]), np.array([np.nan, 0.0, 0.0])
    images, point_m = images_by_name(model), model.point3D(point_id).xyz
    (first, first_m), (second, second_m) = ((name, images[name].projection_center()) for name in sorted(images)[:2])
    lengths = [
        (taped(first, second, 1.0), first_m - second_m), (taped("A", first, 2.0), point_m - first_m),
        (taped("N", second, 3.0), anchor_m - second_m), (taped("N", "O", 4.0), anchor_m - other_m),
    ]  # fmt: skip
    without_place = [taped("lost", first), taped("N", "lost"), taped("N", "unheard of")]
    found = add_tape(
        bundle, [*without_place, *(length for length, _ in lengths)], {"A": point_id}, {"A": np.zeros((3, 3))},
        N=anchor_m, O=other_m, lost=lost_m,
    )  # fmt: skip
    assert found == []
    expected = [bundle.pixel_stddev * expected_error(float(np.linalg.norm(off)), length) for length, off in lengths]
    np.testing.assert_allclose(np.abs(residuals_added(bundle)), expected, rtol=1e-9)
    # The solver moves the places, and the lengths with them.
    anchor_m += 1.0
    moved_m = [np.linalg.norm(anchor_m - second_m), np.linalg.norm(anchor_m - other_m)]
    moved = [expected_error(float(moved_m[k]), lengths[2 + k][0]) for k in (0, 1)]
    np.testing.assert_allclose(np.abs(residuals_added(bundle))[2:], bundle.pixel_stddev * np.array(moved), rtol=1e-9)


def of_three_cameras() -> BundleAdjustment:
    """Return a model of a rig with three cameras, the first of which is that of the rig's frame."""
    options = pycolmap.SyntheticDatasetOptions(num_rigs=1, num_cameras_per_rig=3, num_frames_per_rig=3, num_points3D=30)
    pycolmap.set_random_seed(0)
    return a_bundle(pycolmap.synthesize_dataset(options))


@pytest.mark.parametrize(
    ("first", "second", "num_origins"), [((1, 0), (2, 0), 1), ((2, 1), (3, 1), 0), ((3, 2), (1, 2), 1)]
)
def test_a_length_within_a_rig_is_one_of_the_rig(
    first: tuple[int, int], second: tuple[int, int], num_origins: int
) -> None:
    bundle = of_three_cameras()
    images = images_by_name(bundle.metric)
    start, end = (f"camera{camera:06d}_frame{frame:06d}.png" for camera, frame in (first, second))
    apart_m = float(np.linalg.norm(images[start].projection_center() - images[end].projection_center()))
    length = taped(start, end, 0.9 * apart_m)
    origins = add_tape(bundle, [length])
    assert len(origins) == num_origins
    for origin in origins:
        np.testing.assert_array_equal(origin, np.zeros(3))
        assert bundle.adjuster.problem.is_parameter_block_constant(origin)
    expected = bundle.pixel_stddev * expected_error(apart_m, length)
    assert np.abs(residuals_added(bundle)) == pytest.approx([expected])


def test_a_length_between_cameras_of_one_rig_at_two_times_is_one_of_the_path() -> None:
    bundle = of_three_cameras()
    images = images_by_name(bundle.metric)
    start, end = "camera000002_frame000000.png", "camera000003_frame000001.png"
    apart_m = float(np.linalg.norm(images[start].projection_center() - images[end].projection_center()))
    length = taped(start, end, 0.9 * apart_m)
    assert add_tape(bundle, [length]) == []
    expected = bundle.pixel_stddev * expected_error(apart_m, length)
    assert np.abs(residuals_added(bundle)) == pytest.approx([expected])


def add_ranges_between(bundle: BundleAdjustment, blocks: list[Array], common_bias_stddev_m: float) -> list[Array]:
    pairs = np.array([[0, 1], [1, 2], [0, 2]])
    by_radio = LocatedDistances.of(np.array([9.0, 8.5, 9.5]), np.array([0.5, 0.4, 0.3]), anchor_pair=pairs)
    measured = MeasuredDistances(by_radio, Tape(), {})
    anchors = [an_anchor(f"N{k}", block) for k, block in enumerate(blocks)]
    return add_distances(bundle, measured, anchors, blocks, errors_with(common_bias_stddev_m), {})


def test_ranges_between_anchors_share_a_bias_and_are_robust() -> None:
    bundle = a_bundle()
    blocks = [np.array([0.0, 0.0, 0.0]), np.array([10.0, 0.0, 0.0]), np.array([10.0, 7.0, 0.0])]
    (bias,) = add_ranges_between(bundle, blocks, 0.1)
    bias[0] = 0.25
    errors = np.array([10.25 - 9.0, 7.25 - 8.5, np.hypot(10.0, 7.0) + 0.25 - 9.5]) / [0.5, 0.4, 0.3]
    robust = RobustLoss(LOSS_WIDTH, is_bounded=True).rho(errors**2)[0]
    found = residuals_added(bundle) / bundle.pixel_stddev
    np.testing.assert_allclose(found[:3] ** 2, robust, rtol=1e-9)
    np.testing.assert_allclose(found[3:], [2.5])


def test_the_common_bias_of_ranges_between_anchors_is_fixed_if_there_is_none() -> None:
    bundle = a_bundle()
    (bias,) = add_ranges_between(bundle, [np.array([float(k), 0.0, k * k]) for k in range(3)], 0.0)
    assert bundle.adjuster.problem.is_parameter_block_constant(bias)
    assert len(residuals_added(bundle)) == 3


@pytest.mark.parametrize(("num_lost", "num_added"), [(0, 3), (1, 1), (2, 0)])
def test_ranges_to_an_anchor_without_a_place_are_left_out(num_lost: int, num_added: int) -> None:
    bundle = a_bundle()
    blocks = [np.array([float(k), 0.0, k * k]) for k in range(3)]
    for block in blocks[:num_lost]:
        block[1] = np.nan
    assert len(add_ranges_between(bundle, blocks, 0.1)) == (1 if num_added else 0)
    assert len(residuals_added(bundle)) == num_added
