"""A chain of keyframes with known truth, and a way to bend it as drift does, so that its photos still fit."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import along, lap_path

from rangesfm.estimation.vision_information import Rays, model_rays
from rangesfm.util.geometry.poses import Poses, model_poses
from rangesfm.util.geometry.similarity import IDENTITY
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
NUM_KEYFRAMES = 60


@pytest.fixture
def chain() -> SyntheticModel:
    """The first tenth of a lap, exact, in its own metric world."""
    path = lap_path(30.0, share=0.1)
    times = np.linspace(0.0, 30.0, NUM_KEYFRAMES)
    return synthetic_model(
        *along(path, times),
        num_observations=40,
        max_track_length=6,
        depth_range_m=(4.0, 30.0),
        metric_from_sfm=IDENTITY,
        seed=1,
    )


def poses_and_rays(model: SyntheticModel) -> tuple[Poses, Rays]:
    frame_ids = trajectory_from_reconstruction(model.reconstruction, model.timestamps_s).frame_ids
    return model_poses(model.reconstruction, frame_ids), model_rays(model.reconstruction, frame_ids)


def bent(poses: Poses, turn_deg: float, growth: float) -> tuple[Poses, Array]:
    """Return the chain with a rotation and a change of scale that build up evenly, and its local scale.

    Drift does the same to a map.
    """
    n = len(poses)
    turn = Rotation.from_rotvec(np.radians(turn_deg) * np.linspace(0, 1, n)[:, None] * [0.2, 0.3, 1.0]).as_matrix()
    scale = growth ** np.linspace(0, 1, n)
    steps = np.einsum("nij,nj->ni", scale[:-1, None, None] * turn[:-1], np.diff(poses.centers, axis=0))
    centers = poses.centers[0] + np.concatenate([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    return Poses(turn @ poses.world_from_rig, centers), scale
