"""Measured lengths in a model: the ends of taped lengths, and lengths between anchors."""

from __future__ import annotations

import itertools
import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import pycolmap
from scipy.sparse import csr_array

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import InputError
from rangesfm.measurements.kind import by_all_poses
from rangesfm.measurements.lengths.tape import CONTROL, Tape, TapedDistance
from rangesfm.measurements.points import NamedPoints, images_by_name, variance_along
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.anchor_distances import AnchorDistances
from rangesfm.util.geometry.map_errors import MapPoint

# Smallest standard deviation of a length between anchors, because lengths are weighted by its inverse.
_MIN_STDDEV_M = 1e-3
# Names of printed tags' corners, as ``find_tags`` gives them.
_TAG = re.compile(r"tag\d+\.[0-3]")
_NO_FRAMES: Indices = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True)
class LocatedDistances:
    """k measured lengths whose ends were found in one model: two of its points, or two anchors.

    Attributes:
        model_length: (k,) length between two points in the model's unit; NaN between anchors.
        anchor_pair: (k, 2) int, indices of the two anchors; -1 between points.
        distance_m, stddev_m: (k,) measured length and its standard deviation.
        is_check: (k,) bool, lengths that do not take part in the estimate.
        mark_stddev: (k,) standard deviation of the model's length due to errors of marks in photos, in its unit.
        is_printed: (k,) bool, sides of printed tags, which share one error of their size.
        by_pose: (k, 6 n) sparse derivatives of the model's length by the n poses of a path, as of ``KnownPositions``;
            zero where they are not known, and for lengths that occur all along the map, whose bending does not matter.
    """

    model_length: Array
    anchor_pair: Indices
    distance_m: Array
    stddev_m: Array
    is_check: Mask
    mark_stddev: Array
    is_printed: Mask
    by_pose: csr_array

    @classmethod
    def between_points(cls, distance_m: Array, stddev_m: Array, model_length: Array) -> LocatedDistances:
        """Make control lengths between points whose positions are unknown."""
        k = len(distance_m)
        no, pair = np.zeros(k, dtype=bool), np.full((k, 2), -1, dtype=np.int64)
        return cls(model_length, pair, distance_m, stddev_m, no, np.zeros(k), no, csr_array((k, 0)))

    @property
    def is_between_points(self) -> Mask:
        """Lengths between points of the model, not anchors, (k,)."""
        return np.asarray(self.anchor_pair[:, 0] < 0)

    @property
    def between_anchors(self) -> AnchorDistances:
        """Those between anchors that take part in the estimate."""
        rows = ~self.is_between_points & ~self.is_check
        return AnchorDistances(self.anchor_pair[rows], self.distance_m[rows], self.stddev_m[rows])

    def __len__(self) -> int:
        return len(self.distance_m)

    def subset(self, rows: Mask) -> LocatedDistances:
        """Return the lengths that are true in ``rows`` (k,)."""
        return LocatedDistances(**{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def lengths_m(self, scale: float, anchors_m: Array) -> Array:
        """Return the lengths in a map (k,), in metres; NaN where an anchor has no position.

        Args:
            scale: scale of the model.
            anchors_m: (m, 3) positions of the anchors.
        """
        lengths = scale * self.model_length
        between_anchors = ~self.is_between_points
        first, second = anchors_m[self.anchor_pair[between_anchors].T]
        lengths[between_anchors] = np.linalg.norm(first - second, axis=1)
        return lengths


def locate_distances(
    tape: Tape, model: pycolmap.Reconstruction, anchor_ids: Sequence[str], frame_ids: Indices = _NO_FRAMES
) -> LocatedDistances:
    """Find the ends of measured lengths in a model.

    An end is the photo of that name (its projection centre), else the marker, else the anchor.

    Args:
        frame_ids: (n,) of a path, by whose poses the derivatives are.

    Raises:
        InputError: an end is none of these, a photo is not in the model, only one of the two ends is an anchor, or the
            marks of a marker are too few, seen from one direction only, or not of one point. The error gives the line.
    """
    points, num = NamedPoints.in_model(model, tape.markers, first_ids=frame_ids), len(tape.distances)
    length, mark_stddev = np.full(num, np.nan), np.zeros(num)
    slopes: list[list[tuple[Array, MapPoint]]] = [[] for _ in tape.distances]
    pairs = np.full((num, 2), -1, dtype=np.int64)
    for row, taped in enumerate(tape.distances):
        if all(name in points for name in taped.ends):
            start, end = (points.find(name) for name in taped.ends)
            away = end.position_m - start.position_m
            length[row] = np.linalg.norm(away)
            mark_stddev[row] = np.sqrt(variance_along(start.position_m, end.position_m, start.own_m2 + end.own_m2))
            if not taped.is_everywhere:
                along = away[None] / max(length[row], 1e-12)
                slopes[row] = [(-along, start), (along, end)]
        elif set(anchor_ids).issuperset(taped.ends):
            pairs[row] = [anchor_ids.index(name) for name in taped.ends]
        else:
            known = [*points.views, *points.markers]
            raise InputError(_what_is_wrong(taped, known, anchor_ids), tape.distances_path, taped.line)
    by = points.linearized(points.state, [*length[:, None]], slopes)
    return LocatedDistances(
        length,
        pairs,
        np.array([taped.distance_m for taped in tape.distances], dtype=np.float64),
        np.array([taped.stddev_m for taped in tape.distances], dtype=np.float64),
        np.array([taped.kind != CONTROL for taped in tape.distances], dtype=bool),
        mark_stddev,
        np.array([taped.is_printed for taped in tape.distances], dtype=bool),
        by_all_poses(by.pose, by.by_pose, len(frame_ids)),
    )


def check_ends(tape: Tape, photos: Collection[str], anchor_ids: Collection[str], *, may_be_tags: bool) -> None:
    """Check that the ends of measured lengths exist, before there is a model.

    Args:
        photos: names of those that may be in the model. anchor_ids: of the log.
        may_be_tags: whether printed tags will be looked for, so that an end such as ``tag7.0`` may be found.

    Raises:
        InputError: an end does not, or a marker is in fewer than two photos. The error gives the line.
    """
    points = {*photos, *tape.markers}
    for taped in tape.distances:
        known = points | {end for end in taped.ends if may_be_tags and _TAG.fullmatch(end)}
        if not any(ends >= {*taped.ends} for ends in (known, {*anchor_ids})):
            raise InputError(_what_is_wrong(taped, known, anchor_ids), tape.distances_path, taped.line)
        for end in {*taped.ends} & tape.markers.keys() - {*photos}:
            marker = tape.markers[end]
            if (num := len({*marker.image_names} & {*photos})) < 2:
                message = f"marker {end!r} is marked in {num} photos of the survey, expected two or more"
                raise InputError(message, marker.path, marker.lines[0])


def locatable(tape: Tape, model: pycolmap.Reconstruction) -> Tape:
    """Return the tape without lengths to corners of printed tags which cannot be triangulated.

    Markers set by hand are kept, so that the user is told what is wrong with them, unless the map is one of poses, in
    which drift may be wrong.
    """
    points = NamedPoints.in_model(model, tape.end_markers if not model.num_points3D() else tape.found_markers)
    lost = {name for name in points.markers if name not in points.views and not points.is_determined(name)}
    return replace(tape, distances=tuple(taped for taped in tape.distances if lost.isdisjoint(taped.ends)))


def distances_within(tape: Tape, model: pycolmap.Reconstruction, anchor_ids: Sequence[str]) -> Tape:
    """Return the tape with only the lengths whose two ends are both in this model, or are both anchors."""
    images = images_by_name(model)
    marked = {
        name for name, marker in tape.markers.items() if sum(photo in images for photo in marker.image_names) >= 2
    }
    ends = (images.keys() | marked, set(anchor_ids))
    within = (taped for taped in tape.distances if any(known.issuperset(taped.ends) for known in ends))
    return replace(tape, distances=tuple(within))


def _what_is_wrong(taped: TapedDistance, points: Collection[str], anchor_ids: Collection[str]) -> str:
    for name in taped.ends:
        if name not in points and name not in anchor_ids:
            return f"an end is {name!r}, expected a photo that is in the model, a marker or an anchor of the log"
    return f"from {taped.ends[0]!r} to {taped.ends[1]!r}: expected two anchors, or two ends that are not anchors"


def surveyed_distances(anchors: Sequence[Anchor]) -> tuple[TapedDistance, ...]:
    """Return the length between each pair of anchors with given positions, like a taped length."""
    return tuple(
        TapedDistance(
            (first.anchor_id, second.anchor_id),
            float(np.linalg.norm(first.position_m - second.position_m)),
            max(float(np.hypot(first.position_stddev_m, second.position_stddev_m)), _MIN_STDDEV_M),
            CONTROL,
            line=0,
        )
        for first, second in itertools.combinations(anchors, 2)
        if first.position_m is not None and second.position_m is not None
    )
