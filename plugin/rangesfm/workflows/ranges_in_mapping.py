"""A global bundle adjustment with ranges, for the mapper to use while the map grows."""

from __future__ import annotations

import logging
from typing import Any

import pycolmap

from rangesfm.colmap.transform import rescale, take_over
from rangesfm.errors import GeometryError, InputError, SolverError
from rangesfm.files.atomic import sha256_of
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.clock.estimate import estimate_time_offset
from rangesfm.ranging.observations import RangeObservations
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.vision.image_times import ImageTimes
from rangesfm.workflows.placed_ranges import ranges_on_path
from rangesfm.workflows.survey_stages import estimate_scale, path_of_model, refine_by_survey

# Fewer have no shape by which ranges could tell a scale.
_MIN_NUM_KEYFRAMES = 5
# By which factor the path must have grown for the clocks' offset to be looked for again.
_GROWTH = 1.5


class AdjustmentWithRanges:
    """Scale, clocks and refinement of whatever there is of a map, by the options of a survey.

    Each time all is estimated anew but the clocks' offset: a map in the making has no anchors, scale or weights that
    are worth keeping. Taped distances wait for the whole map, where their ends are.

    Attributes:
        num_with_ranges, num_without: adjustments so far, and those left to COLMAP.
    """

    def __init__(self, survey: Survey, inputs: RangingInputs, first_keyframe: str, times: ImageTimes | None):
        """
        Args:
            first_keyframe: the photo to whose frame anchors of the frame "first_camera" refer.
            times: of the photos; None: the log names them.
        """
        self._survey = survey
        self._inputs = inputs
        self._first_keyframe = first_keyframe
        self._times = times
        self._offset_s = 0.0 if inputs.log.timestamp_s is None else survey.ranges.time_offset_s
        self._num_with_offset = 0
        self.num_with_ranges = self.num_without = 0

    @property
    def inputs(self) -> list[Any]:
        """All settings that it may look at, and its files by their content."""
        survey = self._survey
        settings = survey.model_dump(
            mode="json",
            include={"camera", "ranges", "anchors", "tag", "scale", "refine"},
            exclude={"ranges": {"path", "error_curve"}, "anchors": {"path"}, "scale": {"distances", "markers"}},
        )
        files = (survey.ranges.error_curve, survey.anchors.path, survey.images.times)
        logs = [item.path for item in survey.input_paths() if item.key == "ranges.path" and item.role == "file"]
        contents = [None if path is None else sha256_of(path) for path in (*logs, *files)]
        return [settings, self._inputs.anchor_frame, self._first_keyframe, contents]

    def adjust(self, model: pycolmap.Reconstruction) -> bool:
        """Adjust a model in place; False, and it is as it was, while the ranges do not determine its scale."""
        path = path_of_model(model, self._times)
        try:
            if len(path) < _MIN_NUM_KEYFRAMES:
                raise GeometryError(f"{_MIN_NUM_KEYFRAMES} or more are needed")
            take_over(model, self._adjusted(model, path))
        except (GeometryError, InputError, SolverError) as error:
            logging.getLogger(__name__).info("%d keyframes are adjusted without ranges: %s", len(path), error)
            self.num_without += 1
            return False
        self.num_with_ranges += 1
        return True

    def note(self) -> str | None:
        """What became of the ranges, for the user; None where there was nothing to adjust."""
        num = self.num_with_ranges + self.num_without
        if not num:
            return None
        return f"ranges took part in {self.num_with_ranges} of {num} global adjustments of the map while it grew"

    def _adjusted(self, model: pycolmap.Reconstruction, path: Trajectory) -> pycolmap.Reconstruction:
        survey, inputs = self._survey, self._inputs
        observations = self._observations(path)
        estimate = estimate_scale(survey, inputs, observations, path, self._anchor_frame(path), distances=None)
        refine_intrinsics = survey.camera.mapping_refines_intrinsics
        asked = survey.changed({"camera.refine_intrinsics": refine_intrinsics, "refine.covariance": False})
        scaled = rescale(model, estimate.metric_from_sfm)
        refined, _ = refine_by_survey(asked, inputs, scaled, path, estimate, tape=None)
        return refined

    def _observations(self, path: Trajectory) -> RangeObservations:
        survey, inputs = self._survey, self._inputs
        if self._is_to_look_for_offset(path):
            found = estimate_time_offset(
                inputs.log, path, inputs.tag_in_cam_m, association=survey.ranges, seed=survey.output.seed
            )
            self._offset_s, self._num_with_offset = found.value_s, len(path)
        return ranges_on_path(survey, inputs, path, self._offset_s or 0.0)

    def _is_to_look_for_offset(self, path: Trajectory) -> bool:
        if self._inputs.log.timestamp_s is None or self._survey.ranges.time_offset_s is not None:
            return False
        return len(path) >= _GROWTH * self._num_with_offset

    def _anchor_frame(self, path: Trajectory) -> str:
        """Positions in the first camera's frame are of no use before that photo is part of the map."""
        is_there = path.image_names[0] == self._first_keyframe
        frame = self._inputs.anchor_frame
        return "unknown" if frame == "first_camera" and not is_there else frame
