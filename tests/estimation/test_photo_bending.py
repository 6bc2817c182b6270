"""The photos tell how far a map may be bent, and for a path without points a random walk does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import SyntheticModel, random_similarity, synthetic_model
from tests.simulated.path import along, loop_path
from tests.simulated.pieces import leave_across

from rangesfm.colmap.transform import rescale
from rangesfm.estimation.photo_bending import PhotoBending, bending_of_model
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.solver.bending import MapBending, WalkBending
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

NUM, NUM_OF_FIRST = 16, 9


def simulated(pixel_stddev: float) -> SyntheticModel:
    path = loop_path(float(NUM))
    times = np.arange(NUM, dtype=np.float64)
    return synthetic_model(
        *along(path, times),
        num_observations=100,
        max_track_length=4,
        pixel_stddev=pixel_stddev,
    )


def bending_of(model: pycolmap.Reconstruction) -> MapBending:
    trajectory = trajectory_from_reconstruction(model)
    return bending_of_model(model, trajectory, CameraOptions(refine_intrinsics=False), RefineOptions(), 1)


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


@pytest.mark.parametrize("frame_is_free", [True, False])
def test_likely_steps_are_to_the_photos_minimum_and_then_as_far_as_the_covariance_lets_a_pull(
    frame_is_free: bool,
) -> None:
    turn = random_similarity(np.random.default_rng(3))
    model = rescale(simulated(pixel_stddev=1.0).reconstruction, turn)
    bending = bending_of(model)
    assert isinstance(bending, PhotoBending)
    bending = replace(bending, is_at_optimum=False)
    by_pose, pull = along_x(bending.path), np.random.default_rng(4).normal(size=NUM)

    def moved(pulls: np.typing.NDArray[np.float64]) -> np.typing.NDArray[np.float64]:
        turns, shifts_m = bending.likely_steps(pulls, 3.0, frame_is_free=frame_is_free).at(bending.path.frame_ids)
        return np.asarray(by_pose @ np.hstack([turns, shifts_m]).ravel())

    expected = bending.of_functions(by_pose, frame_is_free=frame_is_free)
    unmoved = moved(np.zeros(6 * NUM))
    np.testing.assert_allclose(unmoved, expected.shift_m, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(moved(pull @ by_pose) - unmoved, 9.0 * expected.formal_m2 @ pull, rtol=1e-6, atol=1e-9)


def test_twice_the_noise_bends_twice_as_far() -> None:
    once, twice = (bending_of(simulated(pixel_stddev=stddev).reconstruction) for stddev in (0.5, 1.0))
    assert isinstance(once, PhotoBending)
    by_pose = along_x(once.path)
    stddevs = [np.sqrt(np.diag(each.of_functions(by_pose, frame_is_free=True).formal_m2)) for each in (once, twice)]
    assert np.median(stddevs[1] / stddevs[0]) == pytest.approx(2.0, rel=0.2)


def of_two_parts() -> pycolmap.Reconstruction:
    """Return a map whose last photos see nothing of what the first ones see."""
    model = simulated(1.0).reconstruction
    leave_across(model, {image.name for image in model.images.values() if image.image_id > NUM_OF_FIRST}, 0)
    return model


def test_what_a_part_may_do_that_no_point_ties_to_the_rest_is_known_and_is_no_bending() -> None:
    whole, cut = bending_of(simulated(1.0).reconstruction), bending_of(of_two_parts())
    assert isinstance(whole, PhotoBending)
    assert isinstance(cut, PhotoBending)
    assert whole.loose.steps.shape[1] == 0
    assert cut.loose.steps.shape[1] == 7
    (bends, loose), by_pose = cut.of_functions(along_x(cut.path), frame_is_free=True).parts, along_x(cut.path)
    assert (bends.name, loose.name, loose.spread) == ("bending", "loose_parts", 0.0)
    of_first, of_second = np.split(np.sqrt(np.diag(loose.usual**2 * loose.alike)), [NUM_OF_FIRST])
    extent = np.linalg.norm(np.ptp(cut.path.centers, axis=0))
    assert of_first.max() < 0.01 * extent
    assert 0.5 * extent < of_second.min()
    formal = [np.sqrt(np.diag(each.of_functions(by_pose, frame_is_free=True).formal_m2)) for each in (whole, cut)]
    assert formal[1].max() < 5 * formal[0].max()


def test_a_photo_that_one_point_ties_to_the_rest_may_be_anywhere() -> None:
    model = simulated(1.0).reconstruction
    leave_across(model, {max(image.name for image in model.images.values())}, 1)
    bending = bending_of(model)
    assert isinstance(bending, PhotoBending)
    assert 3 <= bending.loose.steps.shape[1] <= 6  # it has no size
    loose = bending.of_functions(along_x(bending.path), frame_is_free=True).parts[1]
    stddev = np.sqrt(np.diag(loose.alike))
    assert loose.name == "loose_parts"
    assert stddev[:-1].max() < 0.01 * stddev[-1]


def test_a_path_without_points_walks() -> None:
    model = simulated(pixel_stddev=0.0).reconstruction
    for point_id in list(model.points3D):
        model.delete_point3D(point_id)
    assert isinstance(bending_of(model), WalkBending)
