"""Inputs that a run reads first: log, anchors and reference. They are checked against each other."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
from scipy.spatial.distance import cdist

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.clock.offset import TimeOffset
from rangesfm.measurements.kind_as_read import KindAsRead
from rangesfm.measurements.lengths.tape import Marker, Tape
from rangesfm.measurements.lengths.tape_file import markers_of_photos, read_markers, read_tape
from rangesfm.measurements.positions.antenna_track import AntennaTrack
from rangesfm.measurements.positions.control_point_file import read_control_points
from rangesfm.measurements.positions.known_positions import LASTING_S
from rangesfm.measurements.positions.position_formats import read_positions
from rangesfm.measurements.positions.surveyed_positions import NO_POSITIONS, SurveyedPositions
from rangesfm.measurements.positions.true_positions import read_true_positions
from rangesfm.measurements.ranges.anchors.anchor import Anchor, default_anchor_frame
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchor_list
from rangesfm.measurements.ranges.anchors.anchor_ids import ids_in_log
from rangesfm.measurements.ranges.anchors.site import Site, local_site, site_of
from rangesfm.measurements.ranges.errors.error_curve import correct_ranges, read_error_curve
from rangesfm.measurements.ranges.range_log import RangeKind, RangeLog
from rangesfm.measurements.ranges.readers import read_anchors_in_log, read_ranges
from rangesfm.measurements.ranges.readers.measured import REACH_M
from rangesfm.options import RangesOptions
from rangesfm.sfm.exif_positions import read_exif_positions
from rangesfm.sfm.rigs import read_rigs
from rangesfm.survey.settings import Survey
from rangesfm.util.files.folders import natural_order
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.reference import NO_REFERENCE, Reference

# Distance between two anchors over the sum of the ranges to them. It is at most 1 where all are in metres; above each
# of these numbers, the anchors are in that unit.
_UNITS_OF_ANCHORS = (("millimetres", 100.0), ("centimetres", 10.0))
# Share of neighbouring ranges that are to two other anchors than a given one: a third if three are heard in turn.
_WITHOUT_ONE = 0.25


_Kind = TypeVar("_Kind", bound=KindAsRead)


@dataclass(frozen=True)
class RangingInputs:
    """Inputs measured in metres: those of the radio, lengths, and true positions.

    Attributes:
        log: ranges between the chosen tags and the chosen anchors, and those between two anchors or two tags, in the
            order of their times, so that the order of the log changes nothing; empty without a radio.
        tag_in_cam_m: (num_tags, 3) lever arms in the order of ``log.tag_ids``; NaN for a tag that has ranges to tags
            only.
        anchors: all anchors of the log, and those of the file that the log does not have.
        anchor_frame: "site", "first_camera" or "unknown".
        site: frame of the anchors' positions.
        tape: taped distances; empty if not given.
        reference: true positions; empty if not given.
        assumed: lines about how the files were read.
        positions: known positions of marks, in the frame of the anchors.
        others: of the kinds of measurement that share nothing with these, by their names.
    """

    log: RangeLog
    tag_in_cam_m: Array
    anchors: tuple[Anchor, ...]
    anchor_frame: str
    site: Site
    tape: Tape
    reference: Reference = NO_REFERENCE
    notes: tuple[str, ...] = ()
    assumed: tuple[str, ...] = ()
    positions: SurveyedPositions = field(default_factory=SurveyedPositions)
    others: Mapping[str, KindAsRead] = field(default_factory=dict)

    @property
    def needs_times(self) -> bool:
        """True if the photos' times are needed, for ranges by time or for another kind."""
        return isinstance(self.log.moments, ByTime) or any(each.timed is not None for each in self.beside_ranges)

    @property
    def beside_ranges(self) -> tuple[KindAsRead, ...]:
        """All that was read of each kind of measurement but ranges."""
        return (self.tape, self.positions, *self.others.values())

    def of_kind(self, kind: type[_Kind]) -> _Kind | None:
        """Return what was read of one of the other kinds; None without any."""
        return next((each for each in self.others.values() if isinstance(each, kind)), None)

    @property
    def may_be_left_out(self) -> bool:
        """True if there are measurements of which a map may leave out single ones: positions, and control lengths."""
        return self.positions.are_known or len(self.tape.control().distances) > 0

    def listed_photos(self) -> Iterator[tuple[str, tuple[str, ...]]]:
        """Yield the photos that each file names, after what it says of them."""
        points, antenna, tape = self.positions.points, self.positions.antenna, self.tape
        if markers := [*(points.markers or tape.markers).values()]:
            yield f"marks in {_name(markers[0].path)}", tuple(photo for each in markers for photo in each.image_names)
        if antenna is not None and isinstance(antenna.log.moments, ByPhoto):
            yield f"positions in {_name(antenna.log.path)}", antenna.log.moments.image_name
        if isinstance(self.log.moments, ByPhoto):
            yield f"ranges in {_name(self.log.source)}", self.log.moments.image_name

    def with_photos(self, photos: Collection[str]) -> RangingInputs:
        """Return the inputs with the photos of marks named as these are."""
        points, tape = self.positions.points, self.tape
        points = replace(points, markers=markers_of_photos(points.markers, photos))
        tape = replace(tape, markers=markers_of_photos(tape.markers, photos))
        return replace(self, tape=tape, positions=replace(self.positions, points=points))


def _name(path: Path | None) -> str:
    return "the file" if path is None else path.name


def read_ranging_inputs(survey: Survey) -> RangingInputs:
    """Read and check all inputs but the photos, and but the kinds of measurement that share nothing with ranges.

    Raises:
        InputError: a file is missing or wrong, or the log has an anchor that the file of anchors has not, or a tag
            without a lever arm.
    """
    survey.require_metres()
    _check_rigs_are_metric(survey)
    log, listed, anchor_notes = _read_radio(survey)
    tag_in_cam_m = _lever_arms_of_log(log, survey)
    anchors = listed or _anchors_of_log(log)
    _check_anchors_known(log, anchors, survey)
    frame = survey.anchors.frame or default_anchor_frame(anchors)
    site, anchors = local_site(anchors, frame, survey.anchors.crs, survey.anchors.path)
    is_marked, marks = (survey.points.path or survey.scale.distances) is not None, survey.scale.markers
    markers = read_markers(marks) if is_marked and marks is not None else {}
    site, positions = _surveyed_positions(survey, site, anchors, frame, markers)
    is_placed = any(anchor.position_m is not None for anchor in anchors)
    if frame != "unknown" and not is_placed:
        raise InputError(
            f"anchor frame {frame!r} needs anchor positions and there are none: give anchors.csv, or frame unknown",
            survey.anchors.path,
        )
    if frame != "unknown":
        _check_anchors_differ(log, anchors, survey)
        _check_unit_of_anchors(log, anchors, survey)
        _check_one_frame(log, anchors, positions)
    _check_held_out(survey, anchors, frame)
    curve_path, curve_notes = survey.ranges.error_curve, list[str]()
    if curve_path is not None:
        log, curve_notes = correct_ranges(log, read_error_curve(curve_path))
    tape = Tape() if survey.scale.distances is None else read_tape(survey.scale.distances).with_more_markers(markers)
    reference = NO_REFERENCE if survey.report.reference is None else read_true_positions(survey.report.reference)
    notes = (*_warnings(log, anchors, survey), *curve_notes)
    assumed = (
        *log.notes,
        *_kinds_of_ranges(log),
        *(["the anchor positions are those in the log"] if not listed and is_placed else ()),
        *anchor_notes,
        *positions.notes,
        *tape.notes,
        *reference.notes,
    )
    log = log.in_time_order()
    return RangingInputs(log, tag_in_cam_m, anchors, frame, site, tape, reference, notes, assumed, positions)


def _read_radio(survey: Survey) -> tuple[RangeLog, tuple[Anchor, ...], tuple[str, ...]]:
    """Return the wanted ranges of the log, and the anchors in their file with notes on how that was read."""
    file = survey.anchors
    listed, anchor_notes = tuple[Anchor, ...](), tuple[str, ...]()
    if file.path is not None:
        listed, anchor_notes = read_anchor_list(file.path, columns=file.columns, unit=file.unit)
    tag_ids = [*survey.tag.lever_arms_m, *([survey.tag.tag_id] if survey.tag.tag_id else [])]
    if survey.ranges.path is None:
        log = RangeLog.from_arrays([], [])
    else:
        ids = [anchor.anchor_id for anchor in listed]
        log = read_log(survey.ranges, ids, tag_ids)
        if (found := ids_in_log(ids, log.anchor_ids)) is not None:  # only one rule leads to these
            id_of, rule = found
            listed = tuple(replace(one, anchor_id=id_of.get(one.anchor_id, one.anchor_id)) for one in listed)
            same = ", ".join(f"{there} is {here}" for there, here in id_of.items())
            note = f"{_name(file.path)}: its anchors are named otherwise than in the log and are taken so: {same}"
            anchor_notes = (*anchor_notes, f"{note} ({rule})")
            log = read_log(survey.ranges, [anchor.anchor_id for anchor in listed], tag_ids)
        log = _of_wanted_anchors(_of_wanted_tag(log, survey.tag.tag_id), survey.anchors.use)
        _check_camera_is_heard(log)
    return log, listed, anchor_notes


def _surveyed_positions(
    survey: Survey, site: Site, anchors: Sequence[Anchor], frame: str, markers: Mapping[str, Marker]
) -> tuple[Site, SurveyedPositions]:
    """Return the known positions in the site's local frame, and that frame, which is theirs where no anchor has one.

    Raises:
        InputError: a file is wrong, or only one of anchors and points has a coordinate system.
    """
    points, asked, log = read_control_points(survey.points), survey.positions, None
    if asked.path is not None:
        log = read_exif_positions(asked.path) if asked.path.is_dir() else read_positions(asked.path, asked)
    if not points.points and log is None:
        return site, NO_POSITIONS
    if frame == "first_camera":
        table, path = ("points", survey.points.path) if points.points else ("positions", asked.path)
        raise InputError(f"[{table}] are in the site, expected [anchors] frame to be site as well", path)
    is_placed = frame == "site" and any(anchor.position_m is not None for anchor in anchors)

    def local(coordinates: Array, crs: str, path: Path | None) -> Array:
        nonlocal site, is_placed
        if is_placed:
            return site.local(coordinates, crs, path)
        is_placed, (site, moved) = True, site_of(coordinates, crs, path)
        return moved

    if points.points:
        points = points.with_more(markers)
        points = points.moved_to(local(points.positions_m, survey.points.crs or points.crs, points.path))
    if log is None:
        return site, SurveyedPositions(points)
    if asked.stddev_m is not None:
        log = replace(log, covariance_m2=np.tile(asked.stddev_m**2 * np.eye(3), (len(log), 1, 1)))
    log = replace(log, crs=asked.crs or log.crs)
    log = log.moved_to(local(log.position_m, log.crs, log.path))
    offset = None if asked.time_offset_s is None else TimeOffset.given(asked.time_offset_s)
    antenna = AntennaTrack(log, np.array(asked.antenna_in_cam_m), offset, survey.ranges)
    return site, SurveyedPositions(points, antenna, (asked.lasting_s,) if asked.lasting_s else LASTING_S)


def _check_rigs_are_metric(survey: Survey) -> None:
    """Check that a rig has lengths in metres where it is the only source of the scale.

    Raises:
        InputError: it has none.
    """
    if not survey.metric_keys and not read_rigs(survey.images.rig_config).are_metric:
        raise InputError(
            "gives no distance between cameras of a rig, and there are no ranges and no lengths: expected "
            "cam_from_rig_translation in metres, or a radio's log (--ranges LOG)",
            survey.images.rig_config,
        )


def _check_held_out(survey: Survey, anchors: Sequence[Anchor], frame: str) -> None:
    surveyed = [anchor.anchor_id for anchor in anchors if anchor.position_m is not None and frame != "unknown"]
    for anchor_id in survey.ranges.check_anchors:
        if anchor_id not in surveyed:
            raise InputError(
                f"check_anchors: the position of anchor {anchor_id!r} is not known, so its ranges cannot be checks; "
                f"expected anchors of: {', '.join(surveyed) or 'none'}",
                survey.anchors.path,
            )


def read_log(
    options: RangesOptions,
    anchor_ids: Collection[str] = (),
    tag_ids: Collection[str] = (),
    *,
    files: Sequence[str] = (),
) -> RangeLog:
    """Read the radio's log as a survey describes it; see ``read_ranges``.

    Args:
        files: to read in place of ``options.path``; empty: that path.

    Raises:
        InputError: there is no log, or it cannot be read.
    """
    if options.path is None:
        raise InputError("no ranges: give [ranges] path in a survey file, or --ranges LOG")
    return read_ranges(files or options.path, options, anchor_ids=anchor_ids, tag_ids=tag_ids)


def _check_camera_is_heard(log: RangeLog) -> None:
    if not np.any(log.kind == RangeKind.TAG_ANCHOR):
        raise InputError(
            f"none of the {len(log)} ranges is between a tag and an anchor: list the anchors in anchors.csv, or give "
            "each tag a lever arm",
            log.source,
        )


def _lever_arms_of_log(log: RangeLog, survey: Survey) -> Array:
    """Return ``RangingInputs.tag_in_cam_m``.

    Raises:
        InputError: a tag with ranges to anchors has no lever arm, or several tags share one.
    """
    given = survey.tag.lever_arms_m
    heard = np.unique(log.tag_index[log.kind == RangeKind.TAG_ANCHOR]).tolist()
    arms = np.full((len(log.tag_ids), 3), np.nan)
    if not given:
        if len(heard) > 1:
            raise InputError(
                f"the log has several tags ({', '.join(log.tag_ids[k] for k in heard)}): give each its lever arm "
                "([tag.lever_arms_m], or --tag_in_cam ID:X,Y,Z for each), or choose that of the camera (--tag_id)",
                log.source,
            )
        arms[heard] = survey.tag.tag_in_cam_m
        return arms
    for k in heard:
        if log.tag_ids[k] not in given:
            raise InputError(
                f"tag {log.tag_ids[k]!r} has no lever arm; lever arms are given for {', '.join(given)}: give "
                "it one ([tag.lever_arms_m], or --tag_in_cam ID:X,Y,Z), or choose a tag (--tag_id)",
                log.source,
                int(log.line[np.argmax(log.tag_index == k)]),
            )
        arms[k] = given[log.tag_ids[k]]
    return arms


def _check_anchors_differ(log: RangeLog, anchors: Sequence[Anchor], survey: Survey) -> None:
    """Check that the positions of a log's anchors are not all alike, as in a table that was never filled in.

    Raises:
        InputError: they are.
    """
    positions_m = [a.position_m for a in anchors if a.anchor_id in log.anchor_ids and a.position_m is not None]
    if len(positions_m) > 1 and not np.ptp(positions_m, axis=0).any():
        raise InputError(
            f"all {len(positions_m)} anchors of the log have the same coordinates, expected those that were measured, "
            "or empty cells",
            survey.anchors.path,
        )


def _check_unit_of_anchors(log: RangeLog, anchors: Sequence[Anchor], survey: Survey) -> None:
    """Check that the positions of anchors are in metres.

    The distance between two anchors is at most the sum of the ranges to them, if the camera hardly moves between these.
    A wrong unit is seen between all of them, and one wrong position not between the others.

    Raises:
        InputError: the positions seem to be in millimetres or centimetres.
    """
    known = {anchor.anchor_id: anchor.position_m for anchor in anchors if anchor.position_m is not None}
    nowhere = np.full(3, np.nan)
    position_m = np.array([known.get(anchor_id, nowhere) for anchor_id in log.anchor_ids]).reshape(-1, 3)
    of_camera = np.flatnonzero((log.anchor_index >= 0) & (log.peer_index < 0))
    if isinstance(log.moments, ByPhoto) or len(of_camera) < 2:
        return
    order = of_camera[np.argsort(log.timestamp_s[of_camera], kind="stable")]
    first, second = order[:-1], order[1:]
    apart_m = np.linalg.norm(position_m[log.anchor_index[first]] - position_m[log.anchor_index[second]], axis=1)
    close = np.flatnonzero((log.timestamp_s[second] - log.timestamp_s[first] <= 1.0) & (apart_m > 0))
    if not len(close):
        return
    share = apart_m[close] / (log.range_m[first] + log.range_m[second])[close]
    unit = next((unit for unit, least in _UNITS_OF_ANCHORS if np.quantile(share, _WITHOUT_ONE) > least), None)
    if unit is not None:
        shown = close[np.argmax(share)]
        rows = first[shown], second[shown]
        ids = " and ".join(log.anchor_ids[log.anchor_index[row]] for row in rows)
        ranges_m = " and ".join(f"{log.range_m[row]:.3g}" for row in rows)
        message = f"anchors {ids} are {apart_m[shown]:.6g} m apart here, and the ranges to them {ranges_m} m"
        asked = f"are the positions in {unit}? expected metres, or their unit (--anchor_unit)"
        raise InputError(f"{message}: {asked}", survey.anchors.path)


def _check_one_frame(log: RangeLog, anchors: Sequence[Anchor], positions: SurveyedPositions) -> None:
    """Raise InputError if known positions are all so far from the anchors that no range is measured between them."""
    heard = [one.position_m for one in anchors if one.position_m is not None and one.anchor_id in log.anchor_ids]
    known = [(positions.points.path, positions.points.positions_m)] if positions.points.points else []
    if (antenna := positions.antenna) is not None:
        known.append((antenna.log.path, antenna.log.position_m))
    for path, positions_m in known if heard else ():
        if (apart_m := float(cdist(positions_m, heard).min())) > REACH_M:
            raise InputError(
                f"the positions are {apart_m:.4g} m or more from all anchors, which no UWB radio reaches: expected "
                "both in one frame, or with their coordinate systems (crs)",
                path,
            )


def _anchors_of_log(log: RangeLog) -> tuple[Anchor, ...]:
    """Return all anchors of a log, with unknown positions unless the log has those that the radios were given."""
    in_log = read_anchors_in_log(log.source, format=log.format) if log.source is not None else ()
    by_id = {anchor.anchor_id: anchor for anchor in in_log}
    return tuple(by_id.get(anchor_id, Anchor(anchor_id)) for anchor_id in log.anchor_ids)


def of_one_tag(log: RangeLog, tag_id: str) -> RangeLog:
    """Return the ranges between one tag and anchors.

    Args:
        tag_id: of the tag; empty: the log has only one.

    Raises:
        InputError: the tag is not in the log, or the log has several tags and none is named.
    """
    log = _of_wanted_tag(log, tag_id)
    log = log.subset(log.kind == RangeKind.TAG_ANCHOR)
    if len(log.tag_ids) > 1:
        raise InputError(f"the log has several tags ({', '.join(log.tag_ids)}): say which it is (--tag_id)", log.source)
    return log


def _of_wanted_tag(log: RangeLog, tag_id: str) -> RangeLog:
    """Return the log without the ranges of other tags. Ranges between anchors are kept."""
    if not tag_id:
        return log
    if tag_id not in log.tag_ids:
        raise InputError(f"tag {tag_id!r} is not in the log, which has {', '.join(log.tag_ids)}", log.source)
    is_wanted = log.tag_index == log.tag_ids.index(tag_id)
    return log.subset(is_wanted | (log.kind == RangeKind.ANCHOR_ANCHOR))


def _of_wanted_anchors(log: RangeLog, use_anchors: Sequence[str]) -> RangeLog:
    if not use_anchors:
        return log
    if unheard := [anchor_id for anchor_id in use_anchors if anchor_id not in log.anchor_ids]:
        message = f"anchor {unheard[0]!r} to be used is not in the log ({', '.join(log.anchor_ids)})"
        raise InputError(message, log.source)
    # The last entry belongs to index -1, which means no anchor.
    wanted = np.array([*(anchor_id in use_anchors for anchor_id in log.anchor_ids), True])
    peer_is_wanted = wanted[np.where(log.kind == RangeKind.ANCHOR_ANCHOR, log.peer_index, -1)]
    return log.subset(wanted[log.anchor_index] & peer_is_wanted)


def _check_anchors_known(log: RangeLog, anchors: Sequence[Anchor], survey: Survey) -> None:
    known = {anchor.anchor_id for anchor in anchors}
    unknown = [k for k, anchor_id in enumerate(log.anchor_ids) if anchor_id not in known]
    if unknown:
        k, path = unknown[0], survey.anchors.path
        first = int(np.argmax((log.anchor_index == k) | ((log.tag_index < 0) & (log.peer_index == k))))
        listed = ", ".join(sorted(known, key=natural_order))
        raise InputError(
            f"anchor_id is {log.anchor_ids[k]!r}, expected one of {path}: {listed}; the log has "
            f"{', '.join(log.anchor_ids)} (--use_anchors leaves out others; --anchor_columns names a column "
            "with the ids of the log)",
            log.source,
            int(log.line[first]),
        )


def _kinds_of_ranges(log: RangeLog) -> Iterator[str]:
    """Yield lines about the records of a log that are no ranges between a tag and an anchor."""
    for kind, what in (
        (RangeKind.ANCHOR_ANCHOR, "anchors: they are used as distances between these"),
        (RangeKind.TAG_TAG, "tags: they are not used"),
    ):
        if num := int(np.count_nonzero(log.kind == kind)):
            yield f"{num} ranges are between two {what}"
    if log.num_no_measurement:
        yield f"{log.num_no_measurement} records of the log have no measurement"


def _warnings(log: RangeLog, anchors: Sequence[Anchor], survey: Survey) -> list[str]:
    # With use_anchors, the ranges to other anchors were left out on purpose.
    silent = [
        anchor.anchor_id for anchor in anchors if not survey.anchors.use and anchor.anchor_id not in log.anchor_ids
    ]
    notes = [*([f"no ranges to anchor {', '.join(silent)}"] if silent else [])]
    silent = [tag_id for tag_id in survey.tag.lever_arms_m if tag_id not in log.tag_ids and not survey.tag.tag_id]
    notes += [f"no ranges of tag {', '.join(silent)}"] if silent else []
    return [*notes, *log.notes_on_clock()]
