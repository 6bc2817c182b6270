"""The photos tell how far a map may be bent, and for a path without points a random walk does."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tests.refine.test_bundle_adjustment import orbit
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import loop_path
from tests.simulated.pieces import leave_across

from rangesfm.errors import GeometryError, InputError, SolverError
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.ranging.errors.bending import MapBending, WalkBending, without_similarity
from rangesfm.refine import photo_bending
from rangesfm.refine.photo_bending import PhotoBending, bending_of_model

Array = npt.NDArray[np.float64]
NUM = 16


def simulated(pixel_stddev: float) -> SyntheticModel:
    path = loop_path(float(NUM))
    times = np.arange(NUM, dtype=np.float64)
    return synthetic_model(
        times,
        path.centers(times),
        path.world_from_cam(times),
        num_observations=100,
        max_track_length=4,
        pixel_stddev=pixel_stddev,
    )


def bending_of(model: pycolmap.Reconstruction, options: RefineOptions | None = None) -> MapBending:
    trajectory = trajectory_from_reconstruction(model)
    return bending_of_model(model, trajectory, CameraOptions(refine_intrinsics=False), options or RefineOptions(), 1)


def along_x(path: Trajectory) -> np.typing.NDArray[np.float64]:
    """(n, 6 n) derivatives of each centre's x by turns and shifts of all poses."""
    by_pose = np.zeros((len(path), len(path), 6))
    by_pose[np.arange(len(path)), np.arange(len(path)), 3] = 1.0
    return by_pose.reshape(len(path), -1)


def test_a_mappers_model_is_at_the_minimum_of_its_photos_and_a_refined_map_need_not_be() -> None:
    model = simulated(pixel_stddev=1.0).reconstruction
    bending = bending_of(model)
    assert isinstance(bending, PhotoBending)
    by_pose = along_x(bending.path)
    at_minimum = bending.of_functions(by_pose, frame_is_free=True)
    np.testing.assert_array_equal(at_minimum.shift_m, 0.0)
    elsewhere = replace(bending, is_at_optimum=False).of_functions(by_pose, frame_is_free=True)
    assert np.abs(elsewhere.shift_m).max() > 1e-4
    np.testing.assert_allclose(elsewhere.formal_m2, at_minimum.formal_m2)


def test_twice_the_noise_bends_twice_as_far() -> None:
    once, twice = (bending_of(simulated(pixel_stddev=stddev).reconstruction) for stddev in (0.5, 1.0))
    assert isinstance(once, PhotoBending)
    by_pose = along_x(once.path)
    stddevs = [np.sqrt(np.diag(each.of_functions(by_pose, frame_is_free=True).formal_m2)) for each in (once, twice)]
    assert np.median(stddevs[1] / stddevs[0]) == pytest.approx(2.0, rel=0.2)


def test_a_path_without_points_walks() -> None:
    model = simulated(pixel_stddev=0.0).reconstruction
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    assert isinstance(bending_of(model), WalkBending)


@pytest.mark.parametrize(("num_across", "are_held"), [(3, False), (30, True)])
def test_parts_that_share_few_points_are_not_held_together(num_across: int, are_held: bool) -> None:
    model = simulated(pixel_stddev=0.5).reconstruction
    names = sorted(image.name for image in model.images.values())
    second = set(names[NUM // 2 :])
    leave_across(model, second, num_across)
    bending = bending_of(model)
    assert isinstance(bending, PhotoBending)
    assert bending.hold_together(second) == are_held


class Photos:
    """Photos that answer with a given covariance, and remember what they were asked."""

    def __init__(self, covariance: Array, shift: Array) -> None:
        self.answer = covariance, shift
        self.asked: list[tuple[Any, Array, Array]] = []

    def of_functions(self, frame_ids: Any, by_turn: Array, by_center: Array) -> tuple[Array, Array]:
        self.asked.append((frame_ids, by_turn, by_center))
        return self.answer


TURN = Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix()
FRAME_IDS = np.array([5, 6, 7, 8, 9])


def stub_bending(photos: Any, *, is_at_optimum: bool = True) -> PhotoBending:
    rng = np.random.default_rng(8)
    turns = np.concatenate([np.eye(3)[None], Rotation.random(4, random_state=9).as_matrix()])
    centers = np.concatenate([np.zeros((1, 3)), rng.normal(size=(4, 3))])
    path = Trajectory(FRAME_IDS, ("a", "b", "c", "d", "e"), None, centers, turns)
    return PhotoBending(photos, FRAME_IDS, path, TURN, 2.5, np.ones(5, dtype=bool), is_at_optimum)


@pytest.mark.parametrize("is_at_optimum", [True, False])
def test_functions_of_a_map_in_metres_are_asked_for_in_the_unit_of_the_photos(is_at_optimum: bool) -> None:
    covariance, shift = np.diag([1.0, 3.0]), np.array([0.1, -0.2])
    photos = Photos(covariance, shift)
    bending = stub_bending(photos, is_at_optimum=is_at_optimum)
    by_pose = np.random.default_rng(1).normal(size=(2, 30))
    found = bending.of_functions(by_pose, frame_is_free=False)
    ((frame_ids, by_turn, by_center),) = photos.asked
    expected = without_similarity(by_pose, bending.path, frame_is_free=False).reshape(2, 5, 6)
    np.testing.assert_array_equal(frame_ids, FRAME_IDS)
    np.testing.assert_allclose(by_turn, expected[:, :, :3])
    # A shift by one unit of the map is 2.5 m in its world, where the model's axes are turned.
    in_axes = np.einsum("ij,ckj->cki", TURN, expected[:, :, 3:])
    np.testing.assert_allclose(by_center, in_axes / 2.5)
    np.testing.assert_array_equal(found.formal_m2, covariance)
    np.testing.assert_array_equal(found.shift_m, np.zeros(2) if is_at_optimum else shift)
    (part,) = found.parts
    # Maps are bent twice as much as their photos say, more or less.
    assert (part.name, part.spread) == ("bending", 0.8)
    np.testing.assert_allclose(part.median_m**2 * part.alike, 4.0 * covariance)
    rigid = stub_bending(Photos(np.zeros((2, 2)), np.zeros(2)))
    assert rigid.of_functions(by_pose, frame_is_free=True).parts == ()


@pytest.mark.parametrize(("stddev", "are_held"), [(0.099, True), (0.101, False)])
def test_parts_hold_together_if_the_ratio_of_their_sizes_is_known_to_a_tenth(stddev: float, are_held: bool) -> None:
    photos = Photos(np.array([[stddev**2]]), np.zeros(1))
    bending = stub_bending(photos)
    assert bending.hold_together(["d", "b"]) == are_held
    ((_, by_turn, by_center),) = photos.asked

    def ratio(centers: Array) -> float:
        """Return the logarithm of the size of the part over that of the rest."""
        part, rest = centers[[1, 3]], centers[[0, 2, 4]]
        sizes = [np.linalg.norm(some - some.mean(axis=0)) for some in (part, rest)]
        return float(np.log(sizes[0] / sizes[1]))

    steps = [1e-6 * unit.reshape(5, 3) for unit in np.eye(15)]
    centers = bending.path.centers
    slopes = np.array([ratio(centers + step) - ratio(centers - step) for step in steps]).reshape(5, 3) / 2e-6
    np.testing.assert_allclose(by_center[0], slopes @ TURN.T / 2.5, atol=1e-7)
    np.testing.assert_allclose(by_turn[0], 0.0, atol=1e-9)


@pytest.mark.parametrize("error", [SolverError("no"), GeometryError("no"), InputError("no")])
def test_a_map_whose_photos_do_not_determine_it_walks(error: Exception, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any, **__: Any) -> None:
        raise error

    monkeypatch.setattr(photo_bending, "bundle_adjustment", refuse)
    assert isinstance(bending_of(orbit()), WalkBending)


def test_a_map_of_too_many_photos_walks_in_the_frame_of_its_first_camera(monkeypatch: pytest.MonkeyPatch) -> None:
    bundle = SimpleNamespace(has_covariance=False)
    monkeypatch.setattr(photo_bending, "bundle_adjustment", lambda *_, **__: bundle)
    found = bending_of(orbit())
    assert isinstance(found, WalkBending)
    np.testing.assert_allclose(found.path.centers[0], np.zeros(3), atol=1e-12)
    np.testing.assert_allclose(found.path.world_from_cam[0], np.eye(3), atol=1e-12)


def test_misplaced_points_do_not_count_and_the_model_keeps_its_unit() -> None:
    model = orbit()
    point_id = min(model.points3D)
    image = model.image(model.point3D(point_id).track.elements[0].image_id)
    model.point3D(point_id).xyz = image.projection_center()  # in the camera
    without = orbit()
    without.delete_point3D(point_id)
    found, expected = bending_of(model), bending_of(without)
    assert isinstance(found, PhotoBending)
    assert isinstance(expected, PhotoBending)
    assert found.metres_per_unit == 1.0
    assert found.is_at_optimum
    trajectory = trajectory_from_reconstruction(model)
    np.testing.assert_allclose(found.world_from_model, trajectory.world_from_cam[0])
    np.testing.assert_allclose(
        found.path.centers[1:],
        (trajectory.centers[1:] - trajectory.centers[0]) @ (trajectory.world_from_cam[0]),
        atol=1e-12,
    )
    by_pose = along_x(found.path)
    of_both = [each.of_functions(by_pose, frame_is_free=True).formal_m2 for each in (found, expected)]
    np.testing.assert_allclose(of_both[0], of_both[1], rtol=1e-6, atol=1e-9 * of_both[1].max())
