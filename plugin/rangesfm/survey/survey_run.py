"""A survey at work: its options, inputs and journal in one, which place its ranges on paths and scale its models."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Any

import pycolmap

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError, InputError
from rangesfm.estimation.scale.initialize import estimate_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.clock.offset import NO_OFFSET, TimeOffset
from rangesfm.measurements.kind import Doubt
from rangesfm.measurements.kind_as_read import TimedLog
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.range_log import RangeKind
from rangesfm.measurements.ranges.range_observations import RangeObservations, hold_out
from rangesfm.measurements.ranges.scale.range_estimate import RangeEstimate
from rangesfm.measurements.ranges.time_offset import estimate_time_offset
from rangesfm.progress import Journal
from rangesfm.sfm.image_times import ImageTimes
from rangesfm.solver.bending import MapBending, WalkBending
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.kinds_in_map import MapOfPhotos, kinds_in_map
from rangesfm.survey.settings import Survey
from rangesfm.util.files.photo_names import told_none, told_unknown
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.trajectory import Trajectory


@dataclass(frozen=True)
class PathOfModel:
    """A model with its path and the ranges on that path.

    Attributes:
        name: name for the user, such as "sparse/0".
        trajectory: path of its photos that have a time.
        observations: ranges on that path, from the log that all models share.
        time_offset: with which the ranges were placed; 0 where the log names photos.
    """

    name: str
    sfm: pycolmap.Reconstruction
    trajectory: Trajectory
    observations: RangeObservations
    time_offset: TimeOffset = NO_OFFSET

    @property
    def offset_s(self) -> Array:
        """Image time minus time of the log: (n,) for its ranges, NaN where it names photos."""
        return self.time_offset.at(self.observations.log.timestamp_s)

    @property
    def as_walk(self) -> WalkBending:
        """How the model is bent if it drifts as a map of poses does."""
        return WalkBending(self.trajectory)


@dataclass(frozen=True)
class SurveyRun:
    """A survey at work.

    Attributes:
        inputs: what was read from its files, measured in metres.
        journal: is told of stages and warnings.
        times: of the photos; None where they are not needed, or not yet known.
        doubts: of any map of the survey, known before one is made.
    """

    survey: Survey
    inputs: RangingInputs
    journal: Journal
    times: ImageTimes | None = None
    doubts: tuple[Doubt, ...] = ()

    @property
    def timed_logs(self) -> tuple[TimedLog, ...]:
        """All logs with clocks of their own, that of the radio first."""
        log, inputs = self.inputs.log, self.inputs
        others = filter(None, (each.timed for each in inputs.beside_ranges))
        if not isinstance(log.moments, ByTime):
            return tuple(others)
        radio_s = log.timestamp_s[log.kind == RangeKind.TAG_ANCHOR]
        options = self.survey.ranges
        return (TimedLog("ranges", options.path, radio_s, options.time_offset_s), *others)

    def changed(self, values: Mapping[str, Any]) -> SurveyRun:
        """Return the same with other options by dotted key, as ``Survey.changed``."""
        return replace(self, survey=self.survey.changed(values))

    def with_photos(self, photos: Collection[str], where: str) -> SurveyRun:
        """Return the same with the photos of marks named as these are, after warnings about names of no photo.

        Args:
            photos: names of all photos. where: what has these, for the warnings.
        """
        for what, listed in self.inputs.listed_photos():
            self.journal.warn(*told_unknown(what, listed, photos, where))
        return replace(self, inputs=self.inputs.with_photos(photos))

    def find_time_offset(self, trajectory: Trajectory) -> TimeOffset:
        """Return the time offset between the clocks, which is searched for if it is not given.

        It is 0 where the log names photos.

        Raises:
            GeometryError: the ranges do not determine it.
        """
        inputs, survey = self.inputs, self.survey
        if isinstance(inputs.log.moments, ByPhoto):
            return NO_OFFSET
        if survey.ranges.time_offset_s is not None:
            return TimeOffset.given(survey.ranges.time_offset_s)
        with self.journal.stage("time offset"):
            offset = estimate_time_offset(
                inputs.log,
                trajectory,
                inputs.tag_in_cam_m,
                association=survey.ranges,
                seed=survey.output.seed,
                progress=self.journal.progress,
            )
        self.journal.warn(*([offset.note] if offset.note else []))
        return offset

    def ranges_on(
        self, trajectory: Trajectory, offset_s: float | Array, *, may_be_none: bool = False
    ) -> RangeObservations:
        """Place the ranges on a path and hold out the check ranges.

        Args:
            offset_s: image time minus range time, one for all ranges or (n,).
            may_be_none: whether it is fine if no range has a place on the path.

        Raises:
            InputError: no range has a place on the path; the text says why.
        """
        log, options = self.inputs.log, self.survey.ranges
        placed = associate(log, trajectory, self.inputs.tag_in_cam_m, time_offset_s=offset_s, options=options)
        if len(log) and not may_be_none and not placed.has_place.any():
            why = _why_no_range_has_a_place(placed, trajectory)
            raise InputError(why, options.path)
        return hold_out(placed, options, self.survey.output.seed)

    def estimate_scale(self, path: PathOfModel, bending: MapBending) -> ScaleEstimate:
        """Estimate the scale of a model by all that the survey has measured in it.

        Args:
            bending: how the map is bent.

        Raises:
            GeometryError: the scale is not determined.
        """
        log = path.observations
        at = MapOfPhotos(path.sfm, bending, self.survey, log)
        located, remarks = kinds_in_map(self.inputs, at)
        if not located and remarks:
            raise GeometryError(f"the scale is not determined: {'; '.join(remarks)}")
        begun = RangeEstimate.begun(log, self.survey.ranges)
        return estimate_scale(located, bending, self.survey.scale, begun).remarked(remarks)


def _why_no_range_has_a_place(placed: RangeObservations, trajectory: Trajectory) -> str:
    if isinstance(placed.log.moments, ByPhoto) or trajectory.timestamps_s is None:
        return told_none("the log", placed.log.moments.image_name, trajectory.image_names)
    return "no range is near enough to a keyframe in time: use more photos, or a larger max_interpolation_gap_s"
