"""Covariances of the joint problem, against the inverse of all normal equations and against simulated surveys."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, look_at, orbit_path
from tests.simulated.surveys import photos_adjuster

from rangesfm.errors import GeometryError
from rangesfm.solver import (
    add_residual_block,
    distance_cost,
    joint_prior_cost,
    keep_from_elimination,
    range_cost,
    tangent_jacobian,
)
from rangesfm.solver.covariance import PhotosAlone, joint_covariance
from rangesfm.solver.normal_equations import NormalEquations
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.similarity import IDENTITY, similarity_motions
from rangesfm.util.geometry.trajectory import pose_of

Array = npt.NDArray[np.float64]

NUM_FRAMES = 8
ANCHORS_M = np.array([[2.0, 1.0, 3.0], [-3.0, 2.0, -2.0], [1.0, -4.0, 2.0], [-1.0, 0.5, -3.0]])
TAG_IN_CAM_M = np.array([0.05, -0.1, 0.02])
RANGE_STDDEV_M = 0.02
BIAS_STDDEV_M = 0.01


@dataclass(frozen=True)
class Joint:
    """A bundle adjustment with ranges from every frame to every anchor."""

    reconstruction: pycolmap.Reconstruction
    adjuster: pycolmap.CeresBundleAdjuster
    anchors: list[Array]
    biases: list[Array]
    num_reprojections: int

    @property
    def problem(self) -> Any:
        return self.adjuster.problem

    @property
    def poses(self) -> list[Array]:
        frames = sorted(self.reconstruction.reg_frame_ids())
        return [pose_of(self.reconstruction.frame(i)).params for i in frames]

    def covariance(self, residual_stddev: float = 1.0, **given: Any) -> Found:
        """Return the covariance of all, with its own anchors and biases where no others are given."""
        blocks = {"anchors": self.anchors, "others": self.biases, **given}
        equations = NormalEquations.of(
            self.problem, self.reconstruction, self.num_reprojections, blocks["anchors"], blocks["others"]
        )
        anchors = {f"A{k}": anchor for k, anchor in enumerate(blocks["anchors"])}
        firm_ids = equations.columns.frames
        errors = joint_covariance(equations, anchors=anchors, residual_stddev=residual_stddev, firm_frame_ids=firm_ids)
        return Found(errors, self.poses, equations.free.shape[1])


@dataclass(frozen=True)
class Found:
    """A covariance, with the poses of its frames in their order, and the number of motions that nothing holds."""

    errors: MapErrors
    poses: list[Array]
    num_free_directions: int

    @property
    def centers(self) -> Array:
        return self.errors.covariances("frame")[:, 3:, 3:]

    @property
    def anchors(self) -> Array:
        return self.errors.covariances("anchor")

    @property
    def rig_from_world(self) -> Array:
        """(n, 6, 6) of a rotation from the left and the translation, by turns in the world and shifts of centres."""
        slopes = []
        for pose in self.poses:
            rotation = Rotation.from_quat(pose[:4]).as_matrix()
            x, y, z = -rotation.T @ pose[4:]
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            slopes.append(np.block([[-rotation, np.zeros((3, 3))], [-rotation @ cross, -rotation]]))
        by_part = np.array(slopes)
        return np.asarray(by_part @ self.errors.covariances("frame") @ np.swapaxes(by_part, 1, 2))


def model(seed: int = 0, num_frames: int = NUM_FRAMES) -> pycolmap.Reconstruction:
    times = np.arange(num_frames, dtype=np.float64)
    path = orbit_path(1.4 * num_frames)
    return synthetic_model(
        *along(path, times),
        num_observations=30,
        pixel_stddev=1.0,
        metric_from_sfm=IDENTITY,
        seed=seed,
    ).reconstruction


def joint(
    reconstruction: pycolmap.Reconstruction,
    *,
    hold_first: bool = False,
    num_anchors: int = len(ANCHORS_M),
    hold_anchors: bool = False,
    range_errors_m: Array | None = None,
) -> Joint:
    adjuster = photos_adjuster(reconstruction, hold_first=hold_first)
    anchors, biases = list(ANCHORS_M[:num_anchors].copy()), [np.zeros(1) for _ in ANCHORS_M]
    survey = Joint(reconstruction, adjuster, anchors, biases, adjuster.problem.num_residuals())
    path = orbit_path(1.4 * len(survey.poses))
    times = np.arange(len(survey.poses), dtype=np.float64)
    tags = path.centers(times) + path.world_from_cam(times) @ TAG_IN_CAM_M
    range_m = np.linalg.norm(tags - ANCHORS_M[:num_anchors, None], axis=2)
    add_ranges(survey, range_m + (0.0 if range_errors_m is None else range_errors_m))
    for position, bias in zip(survey.anchors, survey.biases, strict=False):
        prior = joint_prior_cost(mean=[[0.0]], whitening=[[1 / BIAS_STDDEV_M]])
        add_residual_block(adjuster, prior, None, [bias])
        if hold_anchors:
            survey.problem.set_parameter_block_constant(position)
    return survey


def add_ranges(survey: Joint, range_m: Array) -> None:
    """Add (num_anchors, num_frames) ranges from the frames to the anchors."""
    for anchor, bias, to_anchor_m in zip(survey.anchors, survey.biases, range_m.tolist(), strict=False):
        for pose, of_frame_m in zip(survey.poses, to_anchor_m, strict=True):
            cost = range_cost(range_m=of_frame_m, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=RANGE_STDDEV_M)
            add_residual_block(survey.adjuster, cost, None, [pose, anchor, bias])


def covariance_of_all(problem: Any, blocks: Sequence[Array]) -> Array:
    """Return the inverse of the whole normal equations."""
    jacobian = tangent_jacobian(problem, blocks).toarray()
    covariance: Array = np.linalg.pinv(jacobian.T @ jacobian, rcond=1e-14, hermitian=True)
    return covariance


def variable(survey: Joint) -> list[Array]:
    blocks = [*survey.poses, *survey.anchors, *survey.biases, *(p.xyz for p in survey.reconstruction.points3D.values())]
    problem = survey.problem
    return [b for b in blocks if problem.has_parameter_block(b) and not problem.is_parameter_block_constant(b)]


def test_it_is_the_same_of_blocks_that_are_kept_from_elimination() -> None:
    free, kept = joint(model(), hold_first=True), joint(model(), hold_first=True)
    for block in (*kept.anchors, *kept.biases):
        keep_from_elimination(kept.adjuster, block, next(iter(kept.reconstruction.points3D.values())).xyz)
    expected, found = (one.covariance() for one in (free, kept))
    np.testing.assert_allclose(found.anchors, expected.anchors, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.centers, expected.centers, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("hold_anchors", [False, True], ids=["anchors free", "anchors held"])
def test_it_is_the_inverse_of_all_normal_equations(hold_anchors: bool) -> None:
    survey = joint(model(), hold_first=not hold_anchors, hold_anchors=hold_anchors)
    found = survey.covariance(residual_stddev=2.0)
    expected = 4.0 * covariance_of_all(survey.problem, variable(survey))
    assert found.num_free_directions == 0
    first = 0 if hold_anchors else 1
    turn = np.diag([2.0, 2, 2, 1, 1, 1])
    for i in range(first, NUM_FRAMES):
        rows = slice(6 * (i - first), 6 * (i - first) + 6)
        assert found.rig_from_world[i] == pytest.approx(turn @ expected[rows, rows] @ turn, rel=1e-5, abs=1e-12)
    start = 6 * (NUM_FRAMES - first)
    centers = np.array([-Rotation.from_quat(pose[:4]).inv().apply(pose[4:]) for pose in survey.poses])
    by_center = np.linalg.pinv(similarity_motions(centers - centers.mean(axis=0)).reshape(-1, 7))[0].reshape(-1, 3)
    by_step = np.zeros(len(expected))
    for k in range(first, NUM_FRAMES):
        rotation = Rotation.from_quat(survey.poses[k][:4]).as_matrix()
        x, y, z = 2 * survey.poses[k][4:]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        by_step[6 * (k - first) : 6 * (k - first) + 6] = by_center[k] @ -rotation.T @ np.hstack([cross, np.eye(3)])
    assert found.errors.scale_stddev == pytest.approx(np.sqrt(by_step @ expected @ by_step), rel=1e-5)
    if hold_anchors:
        assert np.all(found.anchors == 0)
    else:
        assert np.all(found.rig_from_world[0] == 0)
        for k in range(len(ANCHORS_M)):
            rows = slice(start + 3 * k, start + 3 * k + 3)
            assert found.anchors[k] == pytest.approx(expected[rows, rows], rel=1e-5)


@pytest.mark.parametrize(("num_anchors", "num_free"), [(0, 7), (1, 3), (2, 1), (3, 0)])
def test_motions_of_the_map_that_nothing_holds_are_counted(num_anchors: int, num_free: int) -> None:
    survey = joint(model(), num_anchors=num_anchors, hold_anchors=True)
    biases = survey.biases[:num_anchors]
    found = survey.covariance(others=biases)
    assert found.num_free_directions == num_free
    assert np.all(np.linalg.eigvalsh(found.centers) > -1e-12)


def test_a_free_map_errs_least_under_inner_constraints() -> None:
    """The covariance is the pseudo-inverse of the normal equations reduced by the points."""
    survey = joint(model(), num_anchors=1)
    found = survey.covariance(others=survey.biases[:1])
    jacobian = tangent_jacobian(survey.problem, variable(survey)).toarray()
    normal, kept = jacobian.T @ jacobian, 6 * NUM_FRAMES + 4
    coupling = normal[:kept, kept:]
    reduced = normal[:kept, :kept] - coupling @ np.linalg.solve(normal[kept:, kept:], coupling.T)
    values, vectors = np.linalg.eigh(reduced)
    assert found.num_free_directions == 6  # all but the scale
    assert values[6] > 1e3 * abs(values[5])
    expected = vectors[:, 6:] / values[6:] @ vectors[:, 6:].T
    assert found.anchors[0] == pytest.approx(expected[-4:-1, -4:-1], rel=1e-3, abs=1e-9)


def test_two_points_with_a_taped_distance_are_eliminated_together() -> None:
    survey = joint(model(), hold_anchors=True)
    first, second = (point.xyz for point in list(survey.reconstruction.points3D.values())[:2])
    distance = float(np.linalg.norm(first - second))
    tape = distance_cost(distance_m=distance, stddev_m=1e-4)
    add_residual_block(survey.adjuster, tape, None, [first, second])
    found = survey.covariance()
    expected = covariance_of_all(survey.problem, variable(survey))
    turn = np.diag([2.0, 2, 2, 1, 1, 1])
    assert found.rig_from_world[2] == pytest.approx(turn @ expected[12:18, 12:18] @ turn, rel=1e-5, abs=1e-12)


def test_large_problems_are_solved_sparsely_with_the_same_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    survey = joint(model(num_frames=20), hold_anchors=True)
    answers = []
    for dense_from in (0.0, 1.0):
        monkeypatch.setattr("rangesfm.solver.linear_solver._DENSE_FROM", dense_from)
        monkeypatch.setattr("rangesfm.solver.nested_dissection._MAX_LEAF", 3)
        answers.append(survey.covariance())
    assert answers[0].rig_from_world == pytest.approx(answers[1].rig_from_world, rel=1e-6, abs=1e-12)
    assert answers[0].errors.scale_stddev == pytest.approx(answers[1].errors.scale_stddev, rel=1e-6)


def test_an_anchor_that_its_ranges_do_not_determine_is_named() -> None:
    survey = joint(model(), hold_anchors=True)
    lonely = np.array([1.0, 2.0, 3.0])
    cost = range_cost(range_m=3.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
    add_residual_block(survey.adjuster, cost, None, [survey.poses[0], lonely, survey.biases[0]])
    with pytest.raises(GeometryError, match="do not determine the problem's anchor number 0"):
        survey.covariance(anchors=[*survey.anchors, lonely])


def test_a_motion_that_only_rounding_keeps_from_moving_nothing_is_none() -> None:
    """A turn about the origin does not move an anchor there, even if rounding puts it 1e-17 m away."""
    counts = []
    for at in (np.zeros(3), np.array([1e-17, 2e-17, -1e-17])):
        survey = joint(model(), num_anchors=0)
        for block in (*survey.poses, *(point.xyz for point in survey.reconstruction.points3D.values())):
            survey.problem.set_parameter_block_constant(block)
        cost = range_cost(range_m=3.0, tag_in_cam_m=TAG_IN_CAM_M, stddev_m=0.1)
        add_residual_block(survey.adjuster, cost, None, [survey.poses[0], at, survey.biases[0]])
        survey.problem.set_parameter_block_constant(survey.biases[0])
        found = survey.covariance(anchors=[at], others=survey.biases[:1])
        counts.append(found.num_free_directions)
    assert counts[0] == counts[1]


def test_a_turn_about_a_straight_path_leaves_the_variances_of_places_right() -> None:
    """Ranges of an antenna at the lens do not determine this turn, beside whose variance rounding left no digit."""
    times = np.arange(30, dtype=np.float64)
    centers = np.column_stack([0.3 * times - 4.5, 0.0 * times, 0.0 * times]) + np.array([60.0, 40.0, 20.0])
    sway = np.column_stack([0.2 * np.sin(times), np.ones(30), 0.1 * np.cos(times)])
    anchors = list(ANCHORS_M + np.array([60.0, 40.0, 20.0]))
    found = []
    for height_m in (1e-3, 0.3):  # a path that is bent by 0.3 m determines the turn
        bent = centers + np.column_stack([np.zeros((30, 2)), height_m * np.sin(0.2 * times)])
        made = synthetic_model(times, bent, look_at(bent, bent + sway), num_observations=40, metric_from_sfm=IDENTITY)
        adjuster = photos_adjuster(made.reconstruction, hold_first=False)
        survey = Joint(made.reconstruction, adjuster, anchors, [np.zeros(1)], adjuster.problem.num_residuals())
        for pose, center in zip(survey.poses, bent, strict=True):
            for anchor in anchors:
                range_m = float(np.linalg.norm(center - anchor))
                cost = range_cost(range_m=range_m, tag_in_cam_m=np.zeros(3), stddev_m=RANGE_STDDEV_M)
                add_residual_block(adjuster, cost, None, [pose, anchor, survey.biases[0]])
        for block in (*anchors, *survey.biases):
            survey.problem.set_parameter_block_constant(block)
        found.append(survey.covariance())
    stddevs_m = [np.sqrt(np.trace(each.centers, axis1=1, axis2=2)) for each in found]
    np.testing.assert_allclose(stddevs_m[0], stddevs_m[1], rtol=0.25)
    assert np.linalg.eigvalsh(found[0].centers).min() > 0
    turns = [np.sqrt(np.linalg.eigvalsh(each.rig_from_world[:, :3, :3])[:, 2]) for each in found]
    assert np.all(turns[0] < np.pi)
    assert np.all(turns[1] < 0.1)


def photos_alone(*, hold_first: bool = False) -> tuple[pycolmap.Reconstruction, pycolmap.CeresBundleAdjuster]:
    """Return the model adjusted to its photos alone, without ranges, and its adjuster."""
    reconstruction = model()
    adjuster = photos_adjuster(reconstruction, hold_first=hold_first)
    adjuster.solve()
    return reconstruction, adjuster


def ratios(reconstruction: pycolmap.Reconstruction) -> tuple[Array, Array]:
    """Return two logarithms of ratios of distances, and their derivative by the centres.

    The distances are those of the second and of the last frame from the middle one, over that of the first frame. They
    do not depend on the map's position, orientation or scale.
    """
    frames = sorted(reconstruction.reg_frame_ids())
    centers = np.array([pose_of(reconstruction.frame(i)).inverse().translation for i in frames])
    apart = centers - centers[4]
    squares = np.sum(apart**2, axis=1)
    found, slopes = [], np.zeros((2, len(centers), 3))
    for row, k in enumerate((1, -1)):
        found.append(0.5 * np.log(squares[k] / squares[0]))
        slopes[row, k], slopes[row, 0] = apart[k] / squares[k], -apart[0] / squares[0]
        slopes[row, 4] = apart[0] / squares[0] - apart[k] / squares[k]
    return np.array(found), slopes


def of_functions(photos: PhotosAlone, frame_ids: Any, by_turn: Array, by_center: Array) -> tuple[Array, Array]:
    """Return the covariance of functions of poses, and their change where the map moves to the photos' minimum."""
    gradients = photos.by_steps(frame_ids, by_turn, by_center)
    return gradients.T @ photos.solve(gradients), gradients.T @ photos.at_minimum


@pytest.mark.parametrize("hold_first", [False, True])
def test_what_photos_leave_open_is_the_inverse_of_all_their_normal_equations(hold_first: bool) -> None:
    reconstruction, adjuster = photos_alone(hold_first=hold_first)
    frames = np.array(sorted(reconstruction.reg_frame_ids()))
    _, slopes = ratios(reconstruction)
    poses = [pose_of(reconstruction.frame(i)).params for i in frames.tolist()]
    # Also of how far two rigs are turned from each other; each turn is in the rig's own frame.
    turns, axes = np.zeros_like(slopes), np.random.default_rng(3).normal(size=(2, 3))
    for k, sign in ((1, 1), (5, -1)):
        turns[:, k] = sign * axes @ Rotation.from_quat(poses[k][:4]).inv().as_matrix()
    equations = NormalEquations.of(adjuster.problem, reconstruction, adjuster.problem.num_residuals())
    found, shift = of_functions(PhotosAlone(equations, 0.7), frames, turns, slopes)
    blocks = [*poses, *(point.xyz for point in reconstruction.points3D.values())]
    is_free = [adjuster.problem.has_parameter_block(block) for block in blocks]
    covariance = covariance_of_all(adjuster.problem, [b for b, free in zip(blocks, is_free, strict=True) if free])
    gradient = np.zeros((len(covariance), 2))
    for k, pose in enumerate(poses):
        if is_free[k]:
            rotation = Rotation.from_quat(pose[:4]).as_matrix()
            x, y, z = 2 * pose[4:]
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            by_step = -rotation.T @ np.hstack([cross, np.eye(3)])
            column = 6 * (k - hold_first)
            gradient[column : column + 6] = (slopes[:, k] @ by_step).T
            gradient[column : column + 3] -= 2 * turns[:, k].T  # by Ceres' step, which is half as long
    np.testing.assert_allclose(found, 0.49 * gradient.T @ covariance @ gradient, rtol=1e-6)
    assert np.abs(shift).max() < 1e-3 * np.sqrt(found.diagonal().min())


def test_what_photos_leave_open_does_not_depend_on_the_world_of_the_map() -> None:
    """Another world has other coordinates held to fix the free motions, and only rounding may show it."""
    reconstruction, adjuster = photos_alone()
    frames = np.array(sorted(reconstruction.reg_frame_ids()))
    found = []
    for seed in range(4):
        _, slopes = ratios(reconstruction)
        equations = NormalEquations.of(adjuster.problem, reconstruction, adjuster.problem.num_residuals())
        found.append(of_functions(PhotosAlone(equations, 1.0), frames, np.zeros_like(slopes), slopes)[0])
        rotation = pycolmap.Rotation3d(Rotation.random(rng=seed).as_quat())
        reconstruction.transform(pycolmap.Sim3d(1.5, rotation, np.array([20.0, -5.0, 3.0])))
    np.testing.assert_allclose(found, np.broadcast_to(found[0], np.shape(found)), rtol=1e-10)


def test_photos_say_how_far_a_map_was_moved_from_where_they_have_it() -> None:
    reconstruction, adjuster = photos_alone()
    before, _ = ratios(reconstruction)
    rng, frames = np.random.default_rng(1), np.array(sorted(reconstruction.reg_frame_ids()))
    for frame in frames.tolist():
        pose_of(reconstruction.frame(frame)).params[4:] += 1e-3 * rng.standard_normal(3)
    after, slopes = ratios(reconstruction)
    equations = NormalEquations.of(adjuster.problem, reconstruction, adjuster.problem.num_residuals())
    _, shift = of_functions(PhotosAlone(equations, 1.0), frames, np.zeros_like(slopes), slopes)
    np.testing.assert_allclose(shift, before - after, rtol=0.05)
