"""The range problem of a survey: ranges and anchors in the first camera's frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import GeometryError, InputError
from rangesfm.measurements.lengths.locate_lengths import surveyed_distances
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.anchor_distances import AnchorDistances
from rangesfm.measurements.ranges.errors.noise import START_STDDEV_M
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.radio import lengths_by_radio
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.anchor_plane import are_on_line, is_steep
from rangesfm.measurements.ranges.scale.placement_prior import PlacementPrior
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem
from rangesfm.solver.bending import MapBending
from rangesfm.solver.posterior import ScaleByKind
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.similarity import Similarity, path_shape, rounding_of
from rangesfm.util.geometry.trajectory import MIN_NUM_KEYFRAMES, OnPath, Trajectory, first_camera_from

if TYPE_CHECKING:
    from rangesfm.measurements.ranges.scale.range_start import RangesOnPath

MIN_NUM_RANGES = 4
"""Fewest ranges that place an anchor: three determine a position, and a fourth one checks it."""
MIN_RANGES = 8
"""Fewest ranges that determine a scale: there are seven unknowns, and one more checks the fit."""


@dataclass(frozen=True)
class ScaleProblem:
    """A RangeProblem and how it belongs to the survey.

    Attributes:
        given: the ranges on the path of the unscaled model.
        bending: of the path on which they are, that one or another which the map became.
        ranges: the problem; its model world is the first camera's frame, unscaled.
        model_from_path: from the world of the map's path to that.
        model_from_cam: (k, 3, 3) rotations of the keyframe nearest to each range.
        velocity: (k, 3) camera velocity at each range, model units per second. None without times, or if the photos'
            times do not increase along the path.
        rows: (k,) rows of the observations that its ranges are.
        notes: why the map has no place in the site frame, for the user.
        left_out: anchors with too few ranges on the path to be placed.
    """

    given: RangesOnPath
    bending: MapBending
    ranges: RangeProblem
    model_from_path: Similarity
    model_from_cam: Array
    velocity: Array | None
    rows: Indices
    notes: tuple[str, ...]
    left_out: tuple[str, ...]

    @property
    def observations(self) -> RangeObservations:
        """All ranges of the log."""
        return self.given.observations

    @property
    def prior_errors(self) -> RangeErrors:
        """Errors of its ranges before anything is estimated."""
        return RangeErrors.begin(self.observations, self.rows, self.given.range_model)

    @property
    def on_path(self) -> OnPath:
        """Places of the ranges between keyframes."""
        return self.observations.subset(self.rows)

    @property
    def curve_stddev_m(self) -> Array:
        """(k,) standard deviations of a learnt error curve that was subtracted from the ranges; NaN if none was."""
        return self.observations.log.shared_stddev_m[self.rows]

    def times_s(self, metres_per_unit: float) -> Array:
        """Return (k,) times of the ranges in seconds; where the log names photos, as of somebody who walks."""
        if isinstance(moments := self.observations.log.moments, ByTime):
            return moments.timestamp_s[self.rows]
        before = self.observations.before[self.rows]
        _, first, of_range = np.unique(before, return_index=True, return_inverse=True)
        return walking_times_s(metres_per_unit * self.ranges.centers[first])[of_range]

    def placing_stddev_m(self, metres_per_unit: float) -> Array:
        """Return the (k,) standard deviation of each coordinate of the antennas, metres, in a map of this scale."""
        return self.observations.placing_stddev_m(metres_per_unit)[self.rows]

    def carried(self, turns: Array, shifts: Array) -> ScaleProblem:
        """Return them on the path bent by turns (k, 3, 3) and shifts (k, 3) of its keyframes, in its own world."""
        to_model = self.model_from_path
        turns = to_model.rotation @ turns @ to_model.rotation.T
        shifts = to_model.scale * shifts @ to_model.rotation.T
        at, share = self.on_path, self.on_path.fraction[:, None]
        turn = turns[at.nearest]
        ranges = replace(
            self.ranges,
            centers=self.ranges.centers + (1 - share) * shifts[at.before] + share * shifts[at.after],
            tag_from_center=np.einsum("nij,nj->ni", turn, self.ranges.tag_from_center),
        )
        velocity = None if self.velocity is None else np.einsum("nij,nj->ni", turn, self.velocity)
        return replace(self, ranges=ranges, model_from_cam=turn @ self.model_from_cam, velocity=velocity)

    def weighted(self, errors: RangeErrors) -> RangeProblem:
        """Return the problem weighted by errors.

        Correlated ranges carry less information than independent ones. The ranges keep their nominal weights, and the
        priors get more weight instead, by the square of the inflation.
        """
        ranges, inflation = self.ranges, errors.inflation
        distances, gravity, placement = ranges.distances, ranges.gravity, ranges.placement
        return replace(
            ranges,
            stddev_m=errors.stddev_m,
            share=ranges.share * errors.share,
            bias_stddev_m=ranges.bias_stddev_m / inflation,
            common_bias_stddev_m=ranges.common_bias_stddev_m / inflation,
            distances=replace(distances, stddev_m=distances.stddev_m / inflation),
            gravity=None if gravity is None else replace(gravity, stddev_rad=gravity.stddev_rad / inflation),
            placement=None if placement is None else replace(placement, whitening=placement.whitening * inflation),
            scales=tuple(replace(each, stddev=each.stddev / inflation) for each in ranges.scales),
        )


def scale_problem(
    given: RangesOnPath,
    placement: PlacementPrior | None = None,
    scales: tuple[ScaleByKind, ...] = (),
    *,
    place_is_open: bool = False,
) -> ScaleProblem:
    """Set up the range problem.

    Args:
        given: the ranges.
        placement: what known positions say of the map's place, for the first camera's frame; None without any.
        scales: of the map by other kinds alone, metres per unit.
        place_is_open: whether the map has more than one possible place in the site. Then only the distances between
            surveyed anchors are used, not their positions.

    Raises:
        InputError: an anchor of the log is not among the anchors.
        GeometryError: too few ranges have a place on the path.
    """
    observations, anchor_frame, range_model = given.observations, given.anchor_frame, given.range_model
    log, path = observations.log, given.bending.path
    in_log = _anchors_of_log(log.anchor_ids, given.anchors)
    surveyed = np.array([a.position_m is not None for a in in_log], dtype=bool) & (anchor_frame != "unknown")
    rows, heard = _usable_ranges(observations, surveyed)
    known, notes = _usable_positions(in_log, surveyed & heard, anchor_frame, given.gravity is not None)
    known &= not place_is_open
    if placement is not None:  # any number of surveyed anchors helps a map that has its place
        known, notes = surveyed & heard, []
    # A surveyed anchor whose ranges are all held out keeps its position, so that they can be checked against it.
    placed = known | (surveyed & known.any())
    left_out = tuple(a.anchor_id for a, k in zip(in_log, heard | placed, strict=True) if not k)
    bias_m = np.array([a.range_bias_m for a in in_log])
    stddevs_m = (a.range_bias_stddev_m for a in in_log)
    bias_stddev_m = np.array([range_model.range_bias_stddev_m if each is None else each for each in stddevs_m])
    in_site = anchor_frame == "site" and bool(known.any())
    apart = surveyed & heard & (anchor_frame == "site" and not in_site)
    distances = _between_anchors(given, in_log, apart, bias_m, bias_stddev_m)
    has_ends = np.asarray((heard | placed)[distances.anchor_pair].all(axis=1))
    errors = RangeErrors.begin(observations, rows, range_model)
    ranges = RangeProblem(
        centers=_centers_in_first_camera(observations.centers[rows], path),
        tag_from_center=observations.tag_from_center[rows] @ path.world_from_cam[0],
        anchor_index=log.anchor_index[rows],
        range_m=log.range_m[rows],
        stddev_m=errors.stddev_m,
        anchor_mean_m=np.where(placed[:, None], np.array([_position(a) for a in in_log]), np.nan),
        anchor_stddev_m=np.where(heard, np.where(known, np.array([a.position_stddev_m for a in in_log]), np.inf), 0.0),
        bias_mean_m=bias_m,
        bias_stddev_m=np.where(heard, bias_stddev_m, 0.0),
        common_bias_stddev_m=range_model.common_bias_stddev_m,
        frame_is_free=in_site or placement is not None,
        share=errors.share,
        distances=distances.subset(has_ends),
        gravity=given.gravity if in_site else None,
        placement=placement,
        scales=scales,
    )
    moving = turns_and_velocities(observations, rows, path)
    return ScaleProblem(given, given.bending, ranges, first_camera_from(path), *moving, rows, tuple(notes), left_out)


def turns_and_velocities(
    observations: RangeObservations, rows: Indices, trajectory: Trajectory
) -> tuple[Array, Array | None]:
    """Return ``model_from_cam`` and ``velocity`` of a ScaleProblem on a path."""
    nearest, times_s, world_from_first = (
        observations.nearest[rows],
        trajectory.timestamps_s,
        trajectory.world_from_cam[0],
    )
    turns: Array = world_from_first.T @ trajectory.world_from_cam[nearest]
    # Two photos at once, or a path that goes back in time, have no velocity.
    is_by_photo = isinstance(observations.log.moments, ByPhoto)
    if is_by_photo or times_s is None or len(times_s) < 2 or (np.diff(times_s) <= 0).any():
        return turns, None
    return turns, np.asarray(np.gradient(trajectory.centers, times_s, axis=0)[nearest] @ world_from_first)


def walking_times_s(places_m: Array) -> Array:
    """Return (n,) times, seconds, at which somebody who walks a metre a second is at (n, 3) places, from 0."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(places_m, axis=0), axis=1)))


def _anchors_of_log(anchor_ids: tuple[str, ...], anchors: Sequence[Anchor]) -> list[Anchor]:
    by_id = {anchor.anchor_id: anchor for anchor in anchors}
    missing = [anchor_id for anchor_id in anchor_ids if anchor_id not in by_id]
    if missing:
        raise InputError(f"anchor {missing[0]!r} of the log is not among the anchors ({', '.join(by_id)})")
    return [by_id[anchor_id] for anchor_id in anchor_ids]


def _position(anchor: Anchor) -> Array:
    return np.full(3, np.nan) if anchor.position_m is None else anchor.position_m


def _usable_ranges(observations: RangeObservations, given: Mask) -> tuple[Indices, Mask]:
    """Return the rows of the ranges in use, and a (m,) mask of the anchors that have enough of them."""
    rows = observations.placed_rows
    index = observations.log.anchor_index
    counts = np.bincount(index[rows], minlength=len(given))
    heard = counts >= np.where(given, 1, MIN_NUM_RANGES)
    rows = rows[heard[index[rows]]]
    keyframes = np.union1d(observations.before[rows], observations.after[rows])
    if len(rows) < MIN_RANGES or len(keyframes) < MIN_NUM_KEYFRAMES:
        raise GeometryError(
            f"the scale is not determined: {len(rows)} of {len(observations.log)} ranges lie on the path, near "
            f"{len(keyframes)} keyframes; {MIN_RANGES} near {MIN_NUM_KEYFRAMES} are needed (do the clocks agree?)"
        )
    return rows, heard


def _centers_in_first_camera(centers: Array, trajectory: Trajectory) -> Array:
    """Return (k, 3) centres in the first camera's frame.

    The first camera's own centre is set to exactly 0 and not to a rounding error, so that no scale moves it.
    """
    off = centers - trajectory.centers[0]
    off[np.linalg.norm(off, axis=1) <= rounding_of(trajectory.centers)] = 0.0
    return np.asarray(off @ trajectory.world_from_cam[0])


def _usable_positions(
    anchors: Sequence[Anchor], given: Mask, anchor_frame: str, gravity_is_known: bool
) -> tuple[Mask, list[str]]:
    """Return a (m,) mask of anchors whose given positions can be used in this frame, and notes why others cannot."""
    num = int(given.sum())
    if anchor_frame != "site" or num == 0:
        return given, []
    positions_m = np.array([_position(a) for a, k in zip(anchors, given, strict=True) if k])
    levelled = gravity_is_known and not is_steep(path_shape(positions_m))
    if num >= 2 and (not are_on_line(positions_m) or levelled):
        return given, []
    if num == 1:
        why = "1 surveyed anchor lets the map turn about it freely"
    else:
        which = "2 surveyed anchors" if num == 2 else "surveyed anchors on one line"
        why = f"{which} let the map turn about their line freely"
    fix = "a third anchor off it" if num > 1 else "three anchors not on a line"
    # Gravity does not fix the turn about a vertical line, and with one anchor it does not fix the heading.
    help_of_gravity = "" if gravity_is_known else " (two not above each other, with up_in_first_camera)"
    note = f"{why}: the map gets metres, but no place in the site; {fix} would fix it{help_of_gravity}"
    return np.zeros(len(anchors), dtype=bool), [note]


def _between_anchors(
    given: RangesOnPath, anchors: Sequence[Anchor], apart: Mask, bias_m: Array, bias_stddev_m: Array
) -> AnchorDistances:
    """Return the lengths between anchors that were measured, taped ones first, which hold in any frame.

    Args:
        anchors: m of the log. apart: (m,) those of whose positions the distances are used. bias_m, bias_stddev_m: (m,).
    """
    ids, model = [anchor.anchor_id for anchor in anchors], given.range_model
    pairs = surveyed_distances([anchor for anchor, k in zip(anchors, apart, strict=True) if k])
    lengths_m, stddevs_m = np.array([[pair.distance_m, pair.stddev_m] for pair in pairs]).reshape(-1, 2).T
    ends = np.array([[ids.index(end) for end in pair.ends] for pair in pairs], dtype=np.int64).reshape(-1, 2)
    noise_m, common_stddev_m = model.range_stddev_m or START_STDDEV_M, model.common_bias_stddev_m
    by_radio = lengths_by_radio(given.observations.log, noise_m, bias_m, bias_stddev_m, common_stddev_m)
    return given.distances.joined(AnchorDistances(ends, lengths_m, stddevs_m)).joined(by_radio)
