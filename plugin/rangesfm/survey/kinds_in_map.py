"""The table of kinds: what a survey has measured, located in a map. No stage names a kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import pycolmap

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.estimation.refinement import MapAtRest
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.gravity import UpwardDirection
from rangesfm.measurements.imu.inertial_fit import InertialProblem
from rangesfm.measurements.imu.inertial_scale import InertialScale, scale_by_sensor
from rangesfm.measurements.imu.planned_sensor import PlannedSensor
from rangesfm.measurements.imu.sensor import InertialSensor, read_sensor
from rangesfm.measurements.imu.words import IMU_WORDS
from rangesfm.measurements.joint_map import KindOnMap, Located, find_kind, upward_by
from rangesfm.measurements.kind import Block, Measurements
from rangesfm.measurements.kind_as_read import KindAsRead
from rangesfm.measurements.kind_words import KindWords
from rangesfm.measurements.lengths.cost import taped_lengths
from rangesfm.measurements.lengths.length_scale import LengthScale, lengths_between_points
from rangesfm.measurements.lengths.locate_lengths import locate_distances, surveyed_distances
from rangesfm.measurements.lengths.words import LENGTH_WORDS
from rangesfm.measurements.planned_kind import PlannedKind
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.positions.cost import ARM, CLOCK
from rangesfm.measurements.positions.position_scale import PositionScale, scale_by_positions
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.positions.words import POSITION_WORDS
from rangesfm.measurements.ranges.anchors.anchor_distances import NO_DISTANCES
from rangesfm.measurements.ranges.radio import measured_by_radio, ranges_of, ranges_of_map
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.measurements.ranges.scale.range_start import RangesAtRest, RangesOnPath
from rangesfm.measurements.ranges.words import RANGE_WORDS
from rangesfm.solver.bending import MapBending
from rangesfm.survey.inputs import RangingInputs, read_ranging_inputs
from rangesfm.survey.settings import Survey
from rangesfm.util.geometry.gravity import gravity_of
from rangesfm.util.geometry.trajectory import Trajectory

_NO_POSITION_ON_PATH = (
    "no position is near enough to a keyframe in time: use more photos, or a larger max_interpolation_gap_s"
)


@dataclass(frozen=True)
class MapOfPhotos:
    """A map in which measurements are to be located.

    Attributes:
        model: the map. bending: of the path of its keyframes.
        survey: options. observations: ranges of the log on the path of the unscaled model.
        metres_per_unit: of the unscaled model, in the world of the map.
        before: the kinds on the map before its refinement; empty for a map that moves as one piece.
        rest: the map at rest; None for a map that moves as one piece.
    """

    model: pycolmap.Reconstruction
    bending: MapBending
    survey: Survey
    observations: RangeObservations
    metres_per_unit: float = 1.0
    before: tuple[KindOnMap, ...] = ()
    rest: MapAtRest | None = None

    @property
    def path(self) -> Trajectory:
        """Of the keyframes."""
        return self.bending.path


def _ranges(inputs: RangingInputs, at: MapOfPhotos) -> Located | None:
    survey, before, distances = at.survey, find_kind(at.before, RangeScale), NO_DISTANCES
    if not len(inputs.log):
        return None
    if at.rest is not None and before is not None:
        ranges = ranges_of(at.rest.problem.kinds)
        return RangesAtRest(before, at.metres_per_unit, ranges, at.rest.state, at.bending)
    if inputs.tape.distances:
        distances = locate_distances(inputs.tape, at.model, inputs.log.anchor_ids).between_anchors
    return RangesOnPath(
        *(at.observations, at.bending, inputs.anchors, inputs.anchor_frame, survey.ranges, distances),
        gravity=gravity_of(survey.scale.up_in_first_camera),
        camera_side=survey.scale.camera_side,
        site=inputs.site,
        seed=survey.output.seed,
    )


def _positions(inputs: RangingInputs, at: MapOfPhotos) -> PositionScale | None:
    surveyed = _with_antenna_at(inputs.positions, {} if at.rest is None else at.rest.state.blocks)
    known, before = surveyed.located(at.model, at.path), find_kind(at.before, PositionScale)
    if not len(known):
        if surveyed.antenna is not None and surveyed.antenna.other_offset_s is None:
            raise GeometryError(_NO_POSITION_ON_PATH)
        return None
    begun = PositionScale.begun(known, at.bending, surveyed, is_at_rest=bool(at.before))
    if known.is_check.all() or (before is not None and not before.is_used):
        return begun
    try:
        return scale_by_positions(begun)
    except GeometryError as error:
        if at.before:
            raise
        return replace(begun, notes=(POSITION_WORDS.not_used(error),))


def _with_antenna_at(surveyed: SurveyedPositions, blocks: Mapping[Block, Array]) -> SurveyedPositions:
    """Return all positions with the antenna's lever arm and time offset as a refinement has estimated them."""
    track = surveyed.antenna
    if track is None or ARM not in blocks:
        return surveyed
    offset = track.offset and replace(track.offset, value_s=track.offset_s + float(blocks[CLOCK][0]))
    return replace(surveyed, antenna=replace(track, offset=offset, antenna_in_cam_m=blocks[ARM]))


def _lengths(inputs: RangingInputs, at: MapOfPhotos) -> LengthScale | None:
    if not inputs.tape.distances:
        return None
    found = locate_distances(inputs.tape, at.model, inputs.log.anchor_ids, at.path.frame_ids)
    if (before := find_kind(at.before, LengthScale)) is not None:
        return before.on_refined_map(found, at.bending)
    return lengths_between_points(found, at.bending, inputs.tape.distances)


def _inertial(inputs: RangingInputs, at: MapOfPhotos) -> InertialScale | None:
    sensor = inputs.of_kind(InertialSensor)
    if sensor is None or sensor.alignment is None:
        return None
    return scale_by_sensor(InertialProblem.of_sensor(sensor, sensor.alignment, at.bending))


@dataclass(frozen=True)
class Kind:
    """A row of the table of kinds.

    Attributes:
        words: how people are told of it. locate: returns it in a map; None where it is not in it.
        read: returns what a survey has of it; None without any, or where ``read_ranging_inputs`` has read it already:
            ranges, positions and lengths share files and their frame.
        planned: its table of a plan file; None without one, or where ``plan_file`` has it: a plan may change the number
            and the places of anchors, control points and lengths.
    """

    words: KindWords
    locate: Callable[[RangingInputs, MapOfPhotos], Located | None]
    read: Callable[[Survey], KindAsRead | None] = lambda survey: None
    planned: type[PlannedKind] | None = None


KINDS = (
    Kind(RANGE_WORDS, _ranges),
    Kind(POSITION_WORDS, _positions),
    Kind(LENGTH_WORDS, _lengths),
    Kind(IMU_WORDS, _inertial, lambda survey: read_sensor(survey.imu), PlannedSensor),
)
"""All kinds of measurement. The first that is used decides what is doubtful."""


def read_all_kinds(survey: Survey) -> RangingInputs:
    """Read and check all inputs but the photos; errors are those of ``read_ranging_inputs`` and of each kind."""
    inputs = read_ranging_inputs(survey)
    others = {kind.words.kind: found for kind in KINDS if (found := kind.read(survey)) is not None}
    warnings = [line for each in others.values() for line in each.warnings]
    notes = [line for each in others.values() for line in each.notes]
    return replace(inputs, others=others, notes=(*inputs.notes, *warnings), assumed=(*inputs.assumed, *notes))


def kinds_in_map(inputs: RangingInputs, at: MapOfPhotos) -> tuple[tuple[Located, ...], tuple[str, ...]]:
    """Return the kinds in a map, and why others are not used, in words.

    Raises:
        InputError: a measurement cannot be in the map. GeometryError: what was used before no longer can be.
    """
    found, remarks = list[Located](), list[str]()
    for kind in KINDS:
        if at.before and all(kind.words.kind != each.kind for each in at.before):
            continue
        try:
            located = kind.locate(inputs, at)
        except GeometryError as error:
            if at.before:
                raise
            remarks.append(kind.words.not_used(error))
            continue
        found += [] if located is None else [located]
    return tuple(found), tuple(remarks)


def without_contradicted(inputs: RangingInputs, kinds: Sequence[KindOnMap]) -> RangingInputs:
    """Return the inputs without those that contradict all else on a map."""
    lengths, positions = find_kind(kinds, LengthScale), find_kind(kinds, PositionScale)
    tape = inputs.tape.without([*(() if lengths is None else lengths.left_out)])
    known = inputs.positions.without(() if positions is None else positions.names_left_out)
    return replace(inputs, tape=tape, positions=known)


def measured_in_map(
    inputs: RangingInputs, survey: Survey, estimate: ScaleEstimate, path: Trajectory, model: pycolmap.Reconstruction
) -> tuple[Measurements, ...]:
    """Return all that was measured of a scaled map, for the fit of a map that may bend.

    Args:
        inputs: without those that contradict all else. estimate: of the scale. path: of the unscaled model.
        model: the map, metres.
    """
    tape, gravity, on_map = inputs.tape.control(), gravity_of(survey.scale.up_in_first_camera), estimate.on_map
    if inputs.anchor_frame == "site" and estimate.frame != "site":
        # Too few anchors are surveyed to place the map in the site, but the distances between them are known.
        tape = tape.with_more(surveyed_distances(inputs.anchors))
    placed, arms_m, of_log = estimate.metric_from_sfm, inputs.tag_in_cam_m, estimate.ranges
    found = ranges_of_map(path, of_log.observations, placed, arms_m, of_log.anchors, of_log.errors, survey.refine)
    ranges = replace(found, shared_errors_m=of_log.shared_errors_m)
    markers = tape.end_markers | {name: of for kind in on_map.kinds for name, of in kind.markers.items()}
    points = NamedPoints.in_model(model, markers, ranges.placed_anchors, path.frame_ids)
    of_kinds = (each for kind in on_map.kinds for each in kind.measurements(on_map, points, survey.refine))
    upward = upward_by(estimate.on_map.kinds, gravity) if estimate.frame == "site" else None
    levelled = () if upward is None else (UpwardDirection(upward),)
    return (*measured_by_radio(ranges, points), *taped_lengths(tape, points), *of_kinds, *levelled)
