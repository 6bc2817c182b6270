"""Ranges with which any model of the same photos can be compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.options import RangesOptions
from rangesfm.result.result_folder import ResultFolder
from rangesfm.result.result_tables import RangesAsUsed
from rangesfm.util.geometry.similarity import IDENTITY
from rangesfm.util.geometry.trajectory import Trajectory


@dataclass(frozen=True)
class ModelRanges:
    """Ranges, and the metric world of their anchors.

    Attributes:
        log: ranges with times of the camera's clock, or with names of photos.
        tags_in_cam_m: lever arm (3,) of each tag by id.
        anchors_m: position (3,) of each anchor by id, in the metric world.
        biases_m: range bias of each anchor by id, positive where its ranges are too long.
        image_times_s: times of the photos by name; empty where the log names photos.
        metric_path: a path in the metric world, to which other paths can be aligned.
        association: options for placing ranges on a path.
    """

    log: RangeLog
    tags_in_cam_m: Mapping[str, Array]
    anchors_m: Mapping[str, Array]
    biases_m: Mapping[str, float]
    image_times_s: Mapping[str, float]
    metric_path: Trajectory
    association: RangesOptions

    def __len__(self) -> int:
        return len(self.log)

    def residuals_m(self, path: Trajectory) -> Array:
        """Return predicted minus measured ranges, (k,) metres, of the k ranges with a place on a metric path."""
        timed = path.timed(self.image_times_s) if self.image_times_s else path
        tags = np.array([self.tags_in_cam_m[id_] for id_ in self.log.tag_ids]).reshape(-1, 3)
        anchors = np.array([self.anchors_m[id_] for id_ in self.log.anchor_ids]).reshape(-1, 3)
        biases = np.array([self.biases_m[id_] for id_ in self.log.anchor_ids])
        if len(timed) == 0 or len(self.log) == 0:
            return np.zeros(0)
        at = associate(self.log, timed, tags, options=self.association)
        return np.asarray((at.predicted_m(IDENTITY, anchors, biases) - self.log.range_m)[at.has_place])


_NOWHERE = Trajectory(np.zeros(0, dtype=np.int64), (), None, np.zeros((0, 3)), np.zeros((0, 3, 3)))
NO_RANGES = ModelRanges(RangeLog.from_arrays([], []), {}, {}, {}, {}, _NOWHERE, RangesOptions())


def ranges_of_result(result: ResultFolder, metric_path: Trajectory) -> ModelRanges:
    """Return the ranges that a run used, its anchors and their biases; none for a result without ranges.

    Args:
        result: of the run.
        metric_path: path of the final model of the run.
    """
    ranges, anchors = result.read(RangesAsUsed), result.anchor_positions_m
    if not ranges:
        return NO_RANGES
    _, _, has_place = ranges.places_on(metric_path.image_names)
    rows = np.flatnonzero(ranges.is_used & has_place & np.isin(np.array(ranges.anchor_id, dtype=str), list(anchors)))
    has_times = metric_path.timestamps_s is not None
    tag_ids = [ranges.tag_id[row] for row in rows]
    log = RangeLog.from_arrays(
        [ranges.anchor_id[row] for row in rows],
        ranges.range_m[rows],
        timestamp_s=ranges.camera_times_s(result.timestamps_s)[rows] if has_times else (),
        image_name=() if has_times else [ranges.keyframe_before[row] for row in rows],
        tag_id=tag_ids,
        source=result.output_path / RangesAsUsed.NAME,
    )
    return ModelRanges(
        log=log,
        tags_in_cam_m=dict(zip(tag_ids, result.lever_arms_m(tag_ids), strict=True)),
        anchors_m=anchors,
        biases_m={id_: result.summary.anchors[id_].range_bias_m or 0.0 for id_ in anchors},
        image_times_s=result.timestamps_s,
        metric_path=metric_path,
        association=result.summary.settings.ranges.association,
    )
