"""Everything that a report shows, gathered from a result folder."""

from __future__ import annotations

from copy import copy
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.export.metric_map import colored_points
from rangesfm.result.result_folder import MODEL_NAMES, ResultFolder
from rangesfm.result.result_tables import RangesAsUsed
from rangesfm.util.files.folders import real_path
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

DEFAULT_FOLDER = "out"
MAX_KEYFRAME_SHARE = 0.1
"""A range counts as taken at a photo if its time is within this fraction of the interval to the next photo."""


class Content:
    """Everything that a report shows of a result folder; parts that the folder lacks are empty.

    Attributes:
        title: as given, or the name of the folder; where that is the default one, of the survey folder around it.
        by: who made the survey.
        summary: content of ``result.json``; ``result`` reads the tables beside it.
        images_path: folder of the photos; None where it is not known.
        ranges: content of ``ranges.csv``, n rows.
        tags_in_cam_m: (n, 3) lever arm of each range's tag, in the camera frame.
        range_times_s: (n,) time of each range, or of its photo, in seconds since the first; NaN where unknown.
        scaled, refined: the camera's path before and after the refinement; ``final`` is the refined path, else the
            scaled one.
        reference_m: (k, 3) true positions in the frame of the map; ``reference_by_photo`` has the same by photo, each
            of shape (3,).
        points_m, points_rgb: (m, 3) positions and colours of the points of the final map.
        point_ids: (m,) their ids.
        scaled_cameras, refined_cameras: cameras of both models by id, in order of the ids.
    """

    def __init__(
        self,
        result: ResultFolder,
        *,
        images_path: Path | None = None,
        home: Path | None = None,
        title: str = "",
        by: str = "",
    ):
        """Read what the report needs.

        Args:
            result: the folder to read.
            images_path: folder of the photos, for thumbnails; None: that of the run, if it is beside the result.
            home: folder that names the result, where the result is still in a temporary folder; None: its own folder.
            title, by: empty: those that the run was given.

        Raises:
            InputError: a file of the result is there but cannot be read.
        """
        self.result, self.summary = result, result.summary
        given = self.summary.settings.report
        folder = real_path(home or result.output_path)
        own_name = folder.parent.name if folder.name == DEFAULT_FOLDER and folder.parent.name else folder.name
        self.title, self.by = title or given.title or own_name, by or given.by or ""
        self.images_path = images_path or result.images_path
        self.ranges = result.read(RangesAsUsed)
        self.tags_in_cam_m = result.lever_arms_m(self.ranges.tag_id)
        of_photos = result.timestamps_s
        times = np.array([of_photos.get(name, np.nan) for name in self.ranges.image_name], dtype=np.float64)
        times = np.where(np.isfinite(self.ranges.timestamp_s), self.ranges.timestamp_s, times)
        self.range_times_s = times - np.min(times, initial=np.inf, where=np.isfinite(times))
        scaled, refined = models = [result.read_model(stage) or pycolmap.Reconstruction() for stage in MODEL_NAMES]
        self.scaled, self.refined = (result.path_in(model) for model in models)
        self.final, final = (self.refined, refined) if self.refined else (self.scaled, scaled)
        self.points_m, self.points_rgb = colored_points(final)
        self.point_ids = np.array(sorted(final.point3D_ids()), dtype=np.int64)
        self.scaled_cameras, self.refined_cameras = (
            {camera_id: copy(camera) for camera_id, camera in sorted(model.cameras.items())} for model in models
        )
        reference = result.read_reference()
        self.reference_m = reference.positions_m
        self.reference_by_photo = dict(zip(reference.moments.image_name, self.reference_m))

    @cached_property
    def true_scale(self) -> Trajectory:
        """Return the path before the refinement, resized to the scale of the reference; empty if that is not known.

        The size follows from the scale error that the comparison found, because the reference may hold the positions of
        only a few photos.
        """
        errors = [row.scale_error_percent for row in self.summary.comparison if row.name == "scaled"]
        if not self.scaled or not errors or errors[0] is None:
            return trajectory_from_reconstruction(pycolmap.Reconstruction())
        return self.scaled.resized(1.0 / (1.0 + errors[0] / 100.0), self.summary.frame)

    @cached_property
    def true_ranges_m(self) -> Array:
        """Return the true length of each range by the reference, (n,) metres; NaN where unknown.

        They are known for ranges that are used and were taken at a photo, because the reference may not say where the
        camera was in between. Camera orientations and anchor positions are those of the final map.
        """
        ranges, path, anchors_m = self.ranges, self.final, self.result.anchor_positions_m
        index_of = {name: i for i, name in enumerate(path.image_names)}
        distances = np.full(len(ranges), np.nan)
        for row in np.flatnonzero(np.isfinite(ranges.weight) & ranges.is_used) if self.reference_by_photo else ():
            fraction = float(ranges.weight[row])
            name = (ranges.keyframe_before if fraction < 0.5 else ranges.keyframe_after)[row]
            position, anchor = self.reference_by_photo.get(name), anchors_m.get(ranges.anchor_id[row])
            is_at_photo = min(fraction, 1 - fraction) <= MAX_KEYFRAME_SHARE and name in index_of
            if is_at_photo and position is not None and anchor is not None:
                tag = position + path.world_from_cam[index_of[name]] @ self.tags_in_cam_m[row]
                distances[row] = np.linalg.norm(tag - anchor)
        return distances
