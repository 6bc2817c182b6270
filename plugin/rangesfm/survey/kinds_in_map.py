"""The table of kinds: what a survey has measured besides ranges, located in a map. No stage names a kind."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

import pycolmap

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.gravity import Upwards
from rangesfm.measurements.imu.inertial_fit import InertialProblem
from rangesfm.measurements.imu.inertial_scale import IMU, InertialScale, scale_by_sensor
from rangesfm.measurements.joint_map import JointMap, KindOnMap, find_kind
from rangesfm.measurements.kind import Block
from rangesfm.measurements.lengths.cost import TapedLengths
from rangesfm.measurements.lengths.length_scale import LengthScale, lengths_between_points
from rangesfm.measurements.lengths.lengths_on_map import LENGTHS
from rangesfm.measurements.lengths.locate_lengths import locate_distances
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.positions.cost import ARM, CLOCK
from rangesfm.measurements.positions.grouped_positions import POSITIONS
from rangesfm.measurements.positions.position_scale import PositionScale, scale_by_positions
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.source import Source
from rangesfm.solver.bending import MapBending
from rangesfm.survey.inputs import RangingInputs
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.similarity import IDENTITY
from rangesfm.util.geometry.trajectory import Trajectory


@dataclass(frozen=True)
class MapOfPhotos:
    """A map in which measurements are to be located.

    Attributes:
        model: the map. path: of its keyframes. bending: of the map.
        metres_per_unit: of the unscaled model, in the world of the path.
        blocks: parameters that a refinement of the map has estimated, by name.
        before: the kinds on the map before its refinement; empty for a map that moves as one piece.
    """

    model: pycolmap.Reconstruction
    path: Trajectory
    bending: MapBending
    metres_per_unit: float = 1.0
    blocks: Mapping[Block, Array] = field(default_factory=dict)
    before: tuple[KindOnMap, ...] = ()


def _positions(inputs: RangingInputs, at: MapOfPhotos) -> PositionScale | None:
    surveyed = _with_antenna_at(inputs.positions, at.blocks)
    known = surveyed.located(at.model, at.path)
    if known is None or known.is_check.all():
        return None
    found = scale_by_positions(
        known,
        at.path,
        at.bending,
        refined=IDENTITY if at.before else None,
        lasting_s=surveyed.lasting_s,
        metres_per_unit=at.metres_per_unit,
    )
    return replace(found, surveyed=surveyed)


def _with_antenna_at(surveyed: SurveyedPositions, blocks: Mapping[Block, Array]) -> SurveyedPositions:
    """Return all positions with the antenna's lever arm and time offset as a refinement has estimated them."""
    track = surveyed.antenna
    if track is None or ARM not in blocks:
        return surveyed
    offset_s = None if track.offset_s is None else track.offset_s + float(blocks[CLOCK][0])
    return replace(surveyed, antenna=replace(track, offset_s=offset_s, antenna_in_cam_m=blocks[ARM]))


def _lengths(inputs: RangingInputs, at: MapOfPhotos) -> LengthScale | None:
    if not inputs.tape.distances:
        return None
    found = locate_distances(inputs.tape, at.model, inputs.log.anchor_ids, at.path)
    like = find_kind(at.before, LengthScale)
    return lengths_between_points(found, at.path, at.bending, at.metres_per_unit, like, inputs.tape.distances)


def _inertial(inputs: RangingInputs, at: MapOfPhotos) -> InertialScale | None:
    if inputs.imu is None or inputs.imu.alignment is None:
        return None
    problem = InertialProblem.of_sensor(inputs.imu, inputs.imu.alignment, at.path)
    return scale_by_sensor(problem, at.bending, at.metres_per_unit)


KINDS: dict[str, Callable[[RangingInputs, MapOfPhotos], KindOnMap | None]] = {
    POSITIONS: _positions,
    LENGTHS: _lengths,
    IMU: _inertial,
}
"""How each kind is located in a map, by its name. Without ranges, the first that is used decides what is doubtful."""
_WORDS = {POSITIONS: "known positions", LENGTHS: "known lengths", IMU: "readings of the inertial sensor"}


def kinds_in_map(inputs: RangingInputs, at: MapOfPhotos) -> tuple[tuple[KindOnMap, ...], tuple[str, ...]]:
    """Return the kinds in a map, and why others are not used, in words.

    Raises:
        InputError: a measurement cannot be in the map. GeometryError: what was used before no longer can be.
    """
    found, remarks = list[KindOnMap](), list[str]()
    for kind, locate in KINDS.items():
        if at.before and all(kind != each.kind for each in at.before):
            continue
        try:
            located = locate(inputs, at)
        except GeometryError as error:
            if at.before:
                raise
            remarks.append(f"the {_WORDS[kind]} are not used: {error}")
            continue
        found += [] if located is None else [located]
    return tuple(found), tuple(remarks)


def sources_in_map(tape: Tape, on_map: JointMap | None, gravity: Gravity | None) -> tuple[Source, ...]:
    """Return the measurements besides ranges for the fit of a map that may bend.

    Args:
        tape: lengths of all kinds. on_map: what is measured in the map as one piece; None where nothing is known.
        gravity: the upward direction in the first camera; None where the map has no place in the site.
    """
    of_kinds = () if on_map is None else (source for kind in on_map.kinds for source in kind.sources(on_map))
    return (TapedLengths(tape), *of_kinds, *(() if gravity is None else (Upwards(gravity),)))
