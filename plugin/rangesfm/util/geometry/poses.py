"""Poses of the keyframes of a map, and of one keyframe relative to another."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices
from rangesfm.util.geometry.trajectory import pose_of


@dataclass(frozen=True)
class Poses:
    """Rig poses of n keyframes in a metric world.

    Attributes:
        world_from_rig: (n, 3, 3) rotations.
        centers: (n, 3) origins of the rig frames (for a single camera, its projection centre).
    """

    world_from_rig: Array
    centers: Array

    def __len__(self) -> int:
        return len(self.centers)


def relative_poses(poses: Poses, reference: Indices, frame: Indices) -> tuple[Array, Array]:
    """Return turns and shifts of keyframes relative to others, in the frames of these."""
    to_reference = np.swapaxes(poses.world_from_rig[reference], 1, 2)
    shift = np.einsum("uij,uj->ui", to_reference, poses.centers[frame] - poses.centers[reference])
    return to_reference @ poses.world_from_rig[frame], shift


def frames_in_order(metric: pycolmap.Reconstruction, first_ids: Indices) -> Indices:
    """Return the ids of all frames of a model with a pose: given ones, then the others."""
    return np.concatenate([first_ids, np.setdiff1d(np.array(metric.reg_frame_ids(), dtype=np.int64), first_ids)])


def model_poses(metric: pycolmap.Reconstruction, frame_ids: Iterable[int]) -> Poses:
    """Return the poses of the given frames."""
    rigid = [pose_of(metric.frame(int(frame_id))) for frame_id in frame_ids]
    world_from_rig = np.array([pose.rotation.matrix().T for pose in rigid])
    return Poses(world_from_rig, np.array([pose.tgt_origin_in_src() for pose in rigid]))
