"""A joint adjustment and its covariance, against the same factor graph in GTSAM.

Thirty keyframes with features, ranges to four roughly known anchors, lengths between anchors and between keyframes and
anchors, and positions of an antenna with a lever arm: every residual block of a survey in metres.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.surveys import photos_adjuster
from tests.solver.test_covariance import (
    ANCHORS_M,
    RANGE_STDDEV_M,
    TAG_IN_CAM_M,
    Joint,
    add_ranges,
    model,
)

from rangesfm.solver import (
    add_residual_block,
    distance_cost,
    joint_prior_cost,
    keep_from_elimination,
    position_cost,
)
from rangesfm.solver.covariance import joint_covariance
from rangesfm.solver.normal_equations import NormalEquations
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.trajectory import pose_of

gtsam = pytest.importorskip("gtsam", reason="it has no wheel for this Python")

Array = npt.NDArray[np.float64]

NUM_FRAMES = 30
ANCHOR_STDDEV_M, LENGTH_STDDEV_M, POSITION_STDDEV_M = 0.05, 0.01, 0.03
ANTENNA_IN_CAM_M = np.array([-0.1, -0.2, 0.05])
# Pairs of anchors, and of a keyframe and an anchor, whose distance was taped.
BETWEEN_ANCHORS, TO_ANCHORS = ((0, 1), (1, 3)), ((4, 2), (20, 0))
POSITION_AT = range(0, NUM_FRAMES, 5)


@dataclass(frozen=True)
class Measured:
    """Noisy measurements of one survey, and where its adjustment begins."""

    reconstruction: pycolmap.Reconstruction
    given_anchors_m: Array
    range_m: Array
    between_anchors_m: Array
    to_anchors_m: Array
    positions_m: Array

    @classmethod
    def of(cls, seed: int) -> Measured:
        rng, begin = np.random.default_rng(seed), model(seed, NUM_FRAMES)
        centers, rotations = centers_and_rotations(begin)
        tags = centers + rotations @ TAG_IN_CAM_M
        distances = np.linalg.norm(tags[:, None] - ANCHORS_M, axis=2)
        between = [np.linalg.norm(ANCHORS_M[a] - ANCHORS_M[b]) for a, b in BETWEEN_ANCHORS]
        to = [np.linalg.norm(centers[k] - ANCHORS_M[a]) for k, a in TO_ANCHORS]
        antennas = (centers + rotations @ ANTENNA_IN_CAM_M)[list(POSITION_AT)]
        return cls(
            begin,
            ANCHORS_M + ANCHOR_STDDEV_M * rng.standard_normal(ANCHORS_M.shape),
            distances + RANGE_STDDEV_M * rng.standard_normal(distances.shape),
            np.array(between) + LENGTH_STDDEV_M * rng.standard_normal(len(between)),
            np.array(to) + LENGTH_STDDEV_M * rng.standard_normal(len(to)),
            antennas + POSITION_STDDEV_M * rng.standard_normal(antennas.shape),
        )


def centers_and_rotations(reconstruction: pycolmap.Reconstruction) -> tuple[Array, Array]:
    """(n, 3) centres and (n, 3, 3) rotations from camera to world, in the order of the frames."""
    poses = [pose_of(reconstruction.frame(i)).params for i in sorted(reconstruction.reg_frame_ids())]
    rotations = np.array([Rotation.from_quat(pose[:4]).as_matrix().T for pose in poses])
    return np.array([-rotation @ pose[4:] for rotation, pose in zip(rotations, poses)]), rotations


def by_ceres(measured: Measured) -> tuple[Array, Array, MapErrors]:
    """Return centres, anchors and their covariance; the reconstruction is adjusted."""
    reconstruction = measured.reconstruction
    adjuster = photos_adjuster(reconstruction, hold_first=False)
    problem: Any = adjuster.problem
    num_reprojections = problem.num_residuals()
    poses = [pose_of(reconstruction.frame(i)).params for i in sorted(reconstruction.reg_frame_ids())]
    anchors, no_bias = list(measured.given_anchors_m.copy()), [np.zeros(1) for _ in ANCHORS_M]
    survey = Joint(reconstruction, adjuster, anchors, no_bias, num_reprojections)
    add_ranges(survey, measured.range_m.T)
    for block, given in zip(anchors, measured.given_anchors_m, strict=True):
        prior = joint_prior_cost(mean=given[None], whitening=np.eye(3) / ANCHOR_STDDEV_M)
        add_residual_block(adjuster, prior, None, [block])
    for block in no_bias:
        problem.set_parameter_block_constant(block)
    for (a, b), length_m in zip(BETWEEN_ANCHORS, measured.between_anchors_m.tolist(), strict=True):
        cost = distance_cost(distance_m=length_m, stddev_m=LENGTH_STDDEV_M)
        add_residual_block(adjuster, cost, None, [anchors[a], anchors[b]])
    for (k, a), length_m in zip(TO_ANCHORS, measured.to_anchors_m.tolist(), strict=True):
        cost = distance_cost(distance_m=length_m, stddev_m=LENGTH_STDDEV_M, a_in_cam_m=np.zeros(3))
        add_residual_block(adjuster, cost, None, [poses[k], anchors[a]])
    for k, position_m in zip(POSITION_AT, measured.positions_m, strict=True):
        whitening = np.eye(3) / POSITION_STDDEV_M
        cost = position_cost(position_m=position_m[None], whitening=whitening[None], tag_in_cam_m=ANTENNA_IN_CAM_M)
        add_residual_block(adjuster, cost, None, [poses[k]])
    points = [reconstruction.points3D[point_id].xyz for point_id in sorted(reconstruction.point3D_ids())]
    for block, point in zip(anchors, points, strict=False):
        keep_from_elimination(adjuster, block, point)
    adjuster.solve()
    equations = NormalEquations.of(problem, reconstruction, num_reprojections, anchors, no_bias)
    named = dict(zip("ABCDEFGH", anchors, strict=False))
    covariance = joint_covariance(equations, anchors=named, firm_frame_ids=equations.columns.frames)
    return centers_and_rotations(reconstruction)[0], np.array(anchors), covariance


def by_gtsam(measured: Measured) -> tuple[Array, Array, Array, Array]:
    """Return centres, anchors and their (n, 3, 3) covariances, from the same start."""
    graph, values, reconstruction = gtsam.NonlinearFactorGraph(), gtsam.Values(), measured.reconstruction
    frame_ids = sorted(reconstruction.reg_frame_ids())
    centers, rotations = centers_and_rotations(reconstruction)
    key_of = {frame_id: key for key, frame_id in enumerate(frame_ids)}
    for key, (center, rotation) in enumerate(zip(centers, rotations, strict=True)):
        values.insert(key, gtsam.Pose3(gtsam.Rot3(rotation), center))
    first_anchor, first_point = NUM_FRAMES, NUM_FRAMES + len(ANCHORS_M)
    (camera,) = reconstruction.cameras.values()
    (fx, fy), (cx, cy) = (
        (camera.focal_length_x, camera.focal_length_y),
        (camera.principal_point_x, camera.principal_point_y),
    )
    assert camera.model in (pycolmap.CameraModelId.PINHOLE, pycolmap.CameraModelId.SIMPLE_PINHOLE)
    calibration, pixel = gtsam.Cal3_S2(fx, fy, 0.0, cx, cy), gtsam.noiseModel.Unit.Create(2)
    for number, point_id in enumerate(sorted(reconstruction.point3D_ids())):
        point = reconstruction.points3D[point_id]
        values.insert(first_point + number, point.xyz)
        for element in point.track.elements:
            image = reconstruction.image(element.image_id)
            xy = image.points2D[element.point2D_idx].xy
            pose = key_of[image.frame_id]
            graph.add(gtsam.GenericProjectionFactorCal3_S2(xy, pixel, pose, first_point + number, calibration))
    tag = gtsam.Pose3(gtsam.Rot3(), TAG_IN_CAM_M)
    of_ranges, of_lengths = (
        gtsam.noiseModel.Isotropic.Sigma(1, stddev) for stddev in (RANGE_STDDEV_M, LENGTH_STDDEV_M)
    )
    for (k, a), range_m in np.ndenumerate(measured.range_m):
        graph.add(gtsam.RangeFactorWithTransform3D(k, first_anchor + a, range_m, of_ranges, tag))
    of_anchors = gtsam.noiseModel.Isotropic.Sigma(3, ANCHOR_STDDEV_M)
    for a, given in enumerate(measured.given_anchors_m):
        values.insert(first_anchor + a, given)
        graph.add(gtsam.PriorFactorPoint3(first_anchor + a, given, of_anchors))
    for (a, b), length_m in zip(BETWEEN_ANCHORS, measured.between_anchors_m, strict=True):
        graph.add(gtsam.RangeFactor3(first_anchor + a, first_anchor + b, length_m, of_lengths))
    at_center = gtsam.Pose3()
    for (k, a), length_m in zip(TO_ANCHORS, measured.to_anchors_m, strict=True):
        graph.add(gtsam.RangeFactorWithTransform3D(k, first_anchor + a, length_m, of_lengths, at_center))
    of_positions = gtsam.noiseModel.Isotropic.Sigma(3, POSITION_STDDEV_M)
    for k, position_m in zip(POSITION_AT, measured.positions_m, strict=True):
        graph.add(gtsam.GPSFactorArm(k, position_m, ANTENNA_IN_CAM_M, of_positions))
    result, parameters = values, gtsam.GaussNewtonParams()
    parameters.setRelativeErrorTol(0.0)
    parameters.setAbsoluteErrorTol(1e-14)
    result = gtsam.GaussNewtonOptimizer(graph, result, parameters).optimize()
    marginals = gtsam.Marginals(graph, result)
    poses = [result.atPose3(k) for k in range(NUM_FRAMES)]
    # Its steps of a pose are in the camera's own axes, the turn first.
    turned = np.array([pose.rotation().matrix() for pose in poses])
    of_poses = np.array([marginals.marginalCovariance(k)[3:, 3:] for k in range(NUM_FRAMES)])
    keys = range(first_anchor, first_point)
    return (
        np.array([pose.translation() for pose in poses]),
        np.array([result.atPoint3(key) for key in keys]),
        turned @ of_poses @ np.swapaxes(turned, 1, 2),
        np.array([marginals.marginalCovariance(key) for key in keys]),
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_state_and_covariance_are_those_of_gtsam(seed: int) -> None:
    measured = Measured.of(seed)
    centers_m, anchors_m, of_centers, of_anchors = by_gtsam(measured)
    own_centers_m, own_anchors_m, covariance = by_ceres(measured)
    np.testing.assert_allclose(own_centers_m, centers_m, atol=1e-6)
    np.testing.assert_allclose(own_anchors_m, anchors_m, atol=1e-6)
    for own, theirs in (
        (covariance.covariances("frame")[:, 3:, 3:], of_centers),
        (covariance.covariances("anchor"), of_anchors),
    ):
        size = np.trace(theirs, axis1=1, axis2=2)[:, None, None]
        np.testing.assert_allclose(own / size, theirs / size, atol=1e-6)
