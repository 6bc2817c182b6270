"""Ranges that any model of the same photos can be held against."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.options import AssociationOptions
from rangesfm.ranging.association import associate
from rangesfm.ranging.clock.estimate import estimate_time_offset
from rangesfm.ranging.log import RangeLog
from rangesfm.result.folder import ResultFolder
from rangesfm.result.metric_result import USED
from rangesfm.result.tables import RangesAsUsed
from rangesfm.scale.initialize import initialize_scale
from rangesfm.survey.inputs import RangingInputs, times_of_model
from rangesfm.survey.settings import Survey


@dataclass(frozen=True)
class ModelRanges:
    """n ranges, and the metric world in which their anchors stand.

    Attributes:
        log: the ranges, at times of the camera's clock or by photo.
        tags_in_cam_m: (3,) lever arm by tag id.
        anchors_m: (3,) position by anchor id, in the metric world.
        biases_m: what its ranges read too long, by anchor id.
        image_times_s: of the photos by name; None where the log names them.
        metric_path: a path in the metric world, onto which others can be carried.
        association: how ranges are put on a path.
    """

    log: RangeLog
    tags_in_cam_m: Mapping[str, Array]
    anchors_m: Mapping[str, Array]
    biases_m: Mapping[str, float]
    image_times_s: Mapping[str, float] | None
    metric_path: Trajectory
    association: AssociationOptions

    def residuals_m(self, path: Trajectory) -> Array:
        """(k,) predicted minus measured, of the ranges that have a place on a path in the metric world."""
        timed = path if self.image_times_s is None else path.timed(self.image_times_s)
        tags = np.array([self.tags_in_cam_m[id_] for id_ in self.log.tag_ids]).reshape(-1, 3)
        anchors = np.array([self.anchors_m[id_] for id_ in self.log.anchor_ids]).reshape(-1, 3)
        biases = np.array([self.biases_m[id_] for id_ in self.log.anchor_ids])
        if len(timed) == 0 or len(self.log) == 0:
            return np.zeros(0)
        at = associate(self.log, timed, tags, options=self.association)
        index = self.log.anchor_index
        predicted = np.linalg.norm(at.centers + at.tag_from_center - anchors[index], axis=1) + biases[index]
        return np.asarray((predicted - self.log.range_m)[at.has_place])


def ranges_of_result(result: ResultFolder, metric_path: Trajectory) -> ModelRanges | None:
    """The ranges that a run used, its anchors and their biases; None where it left none.

    Args:
        metric_path: of the run's final model.
    """
    ranges, anchors = result.read(RangesAsUsed), result.anchor_positions_m
    if ranges is None:
        return None
    before, after, has_place = ranges.places_on(metric_path.image_names)
    rows = np.flatnonzero(ranges.is_used & has_place & np.isin(np.array(ranges.anchor_id, dtype=str), list(anchors)))
    # When the camera was there by its own clock; the photos' names where they have no times.
    times = names = None
    if metric_path.timestamps_s is None:
        names = [metric_path.image_names[row] for row in before[rows]]
    else:
        weight, known = ranges.weight[rows], metric_path.timestamps_s
        times = (1 - weight) * known[before[rows]] + weight * known[after[rows]]
    tag_ids = [ranges.tag_id[row] for row in rows]
    log = RangeLog.from_arrays(
        [ranges.anchor_id[row] for row in rows],
        ranges.range_m[rows],
        timestamp_s=times,
        image_name=names,
        tag_id=tag_ids,
        source=result.path / RangesAsUsed.NAME,
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


def ranges_of_survey(
    survey: Survey, inputs: RangingInputs, model: pycolmap.Reconstruction, model_path: Path
) -> ModelRanges:
    """Ranges of a log, placed by a model: those that its scale estimate believes, and the anchors as it has them.

    Args:
        survey: the log, the anchors, the tag and the photos' times.
        inputs: the same, as read.
        model: in any unit; metric or not, it is scaled by the ranges.
        model_path: where it was read from.

    Raises:
        InputError: the photos have no times, or no range has a place.
        GeometryError: the ranges do not determine the time offset or the model's scale.
    """
    times = None if inputs.log.image_name is not None else times_of_model(survey, model, model_path).by_name()
    path = trajectory_from_reconstruction(model, times)
    log = inputs.log
    if log.timestamp_s is not None:
        offset_s: float | Array | None = survey.ranges.time_offset_s
        if offset_s is None:
            found = estimate_time_offset(
                log, path, inputs.tag_in_cam_m, association=survey.ranges, seed=survey.output.seed
            )
            offset_s = found.at(log.timestamp_s)
        log = replace(log, timestamp_s=log.timestamp_s + offset_s)
    observations = associate(log, path, inputs.tag_in_cam_m, options=survey.ranges)
    if not observations.has_place.any():
        raise InputError("no range is at a photo of the model: are --images and the time offset theirs?", log.source)
    estimate = initialize_scale(
        observations,
        path,
        inputs.anchors,
        anchor_frame=inputs.anchor_frame,
        options=survey.scale,
        range_model=survey.ranges,
        seed=survey.output.seed,
    )
    metric = estimate.metric_from_sfm
    to_site = inputs.site.offset_m if estimate.frame == "site" else np.zeros(3)
    anchors = {anchor.anchor_id: anchor for anchor in estimate.anchors if np.isfinite(anchor.position_m).all()}
    return ModelRanges(
        log=estimate.observations.log.subset(np.isin(estimate.observations.status, USED)),
        tags_in_cam_m=dict(zip(log.tag_ids, inputs.tag_in_cam_m, strict=True)),
        anchors_m={id_: anchor.position_m + to_site for id_, anchor in anchors.items()},
        biases_m={id_: anchor.range_bias_m for id_, anchor in anchors.items()},
        image_times_s=times,
        metric_path=path.transformed(metric.scale, metric.rotation, metric.translation + to_site),
        association=survey.ranges,
    )
