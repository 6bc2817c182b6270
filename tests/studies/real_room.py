"""The real room's survey, with its truth, for the study of mistakes."""

from __future__ import annotations

import csv
import json
from functools import cache
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial.transform import Rotation, Slerp
from tests.simulated.surveys import MadeSurvey

from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.measurements.ranges.readers import read_ranges
from rangesfm.util.geometry.reference import read_reference
from rangesfm.util.geometry.similarity import align_points
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

EVERY = 10
MAX_GAP_S = 0.05


def real_room(folder: Path, model: Path, seed: int) -> MadeSurvey:
    """Read a tenth of the ranges: every tenth, starting at another one for each seed."""
    trajectory, times, centers_m, rotations = path_and_truth(folder, model)
    log = read_ranges(folder / "uwb.csv")
    rows = np.arange(seed % EVERY, len(log), EVERY)
    time_s = log.timestamp_s[rows]
    inside = (time_s > times[0]) & (time_s < times[-1])
    rows, time_s = rows[inside], time_s[inside]
    tag_in_cam_m = np.array(json.loads((folder / "camera.json").read_text(encoding="utf-8"))["tag_in_cam_m"])
    turned = rotations(time_s).as_matrix()
    anchors_m = {
        anchor.anchor_id: np.asarray(anchor.position_m) for anchor in read_anchors(folder / "anchors_antennas.csv")
    }
    anchors_m = {name: anchors_m[name] for name in log.anchor_ids}
    at_photos = interpolated(times, centers_m, np.asarray(trajectory.timestamps_s))
    is_known = np.isfinite(at_photos).all(axis=1)
    return MadeSurvey(
        sfm=None,
        trajectory=trajectory,
        anchors_m=dict(anchors_m),
        anchor_frame="site",
        tag_in_cam_m=tag_in_cam_m,
        time_s=time_s,
        anchor=log.anchor_index[rows],
        range_m=log.range_m[rows],
        tags_m=np.column_stack([np.interp(time_s, times, c) for c in centers_m.T]) + turned @ tag_in_cam_m,
        true_anchors_m=anchors_m,
        world_from_cam=turned,
        true_centers_m=at_photos,
        metres_per_unit=align_points(trajectory.centers[is_known], at_photos[is_known]).scale,
    )


@cache
def path_and_truth(
    folder: Path, model: Path
) -> tuple[Trajectory, npt.NDArray[np.float64], npt.NDArray[np.float64], Slerp]:
    with (folder / "images.csv").open(encoding="utf-8") as file:
        times_of = {row["image_name"]: float(row["timestamp_s"]) for row in csv.DictReader(file)}
    trajectory = trajectory_from_reconstruction(pycolmap.Reconstruction(model), times_of)
    reference = read_reference(folder / "groundtruth.csv")
    assert reference.world_from_cam is not None
    rotations = Slerp(reference.moments.timestamp_s, Rotation.from_matrix(reference.world_from_cam))
    return trajectory, reference.moments.timestamp_s, reference.positions_m, rotations


def interpolated(
    times: npt.NDArray[np.float64], places: npt.NDArray[np.float64], at: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """(n, 3) positions, NaN across gaps."""
    after = np.clip(np.searchsorted(times, at), 1, len(times) - 1)
    found = np.column_stack([np.interp(at, times, axis) for axis in places.T])
    is_in_gap = (times[after] - times[after - 1] > MAX_GAP_S) | (at < times[0]) | (at > times[-1])
    return np.where(is_in_gap[:, None], np.nan, found)
