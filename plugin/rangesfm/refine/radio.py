"""Ranges as residuals of the full problem, with the antennas' positions and the radio's own parameters."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm import ceres
from rangesfm.arrays import Array, Indices
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory, pose_of
from rangesfm.options import RefineOptions
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.association import lever_arms
from rangesfm.ranging.errors.noise import SHORT_RANGE_LENGTH_M, bias_whitening
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.ranging.range_observations import RangeObservations
from rangesfm.refine.bundle_adjustment import BundleAdjustment


@dataclass(frozen=True)
class Antennas:
    """Positions of n antennas.

    They are ``(1 - fraction) * p_before + fraction * p_after + offset`` with ``p = c + R tag_in_cam``.

    Attributes:
        before, after: (n,) indices of keyframes of the trajectory; -1 for a range without a place.
        fraction: (n,) interpolation fraction in [0, 1].
        tag_in_cam_m: (n, 3) lever arms in the camera's frame.
        offset_in_world_m: (n, 3) difference of the curved path from the straight line; constant while the map bends.
    """

    before: Indices
    after: Indices
    fraction: Array
    tag_in_cam_m: Array
    offset_in_world_m: Array

    def positions(self, centers: Array, world_from_cam: Array) -> Array:
        """Return the (n, 3) antenna positions in the world of (k, 3) centres and (k, 3, 3) rotations."""
        before, after = (
            centers[ends] + np.einsum("nij,nj->ni", world_from_cam[ends], self.tag_in_cam_m)
            for ends in (self.before, self.after)
        )
        fraction = self.fraction[:, None]
        return np.asarray((1 - fraction) * before + fraction * after + self.offset_in_world_m)

    def subset(self, rows: Indices) -> Antennas:
        """Return the antennas of some of the ranges."""
        return Antennas(*(getattr(self, field.name)[rows] for field in fields(self)))


def antennas(
    trajectory: Trajectory, observations: RangeObservations, metric_from_sfm: Similarity, tags_in_cam_m: Array
) -> Antennas:
    """Return the antennas of all ranges.

    Args:
        trajectory, observations: of the unscaled model.
        metric_from_sfm: similarity to the world of the poses for which positions will be computed.
        tags_in_cam_m: (num_tags, 3) lever arms, in the order of the log's tags.
    """
    tags_in_cam = tags_in_cam_m[observations.log.tag_index]
    on_line = Antennas(
        observations.before, observations.after, observations.fraction, tags_in_cam, np.zeros_like(tags_in_cam)
    )
    from_center = on_line.positions(np.zeros_like(trajectory.centers), trajectory.world_from_cam)
    beyond = metric_from_sfm.scale * observations.center_offsets + observations.tag_from_center - from_center
    return replace(on_line, offset_in_world_m=beyond @ metric_from_sfm.rotation.T)


@dataclass(frozen=True)
class RadioEstimate:
    """All parameters of the ranges besides the poses.

    Attributes:
        anchors: in the order of the log.
        tags_in_cam_m: (num_tags, 3) antennas in the rig frame.
        time_shift_s: how much later than assumed the ranges were taken.
        short_range_error_m: amplitude of ``exp(-distance / SHORT_RANGE_LENGTH_M)``, by which short ranges are too long.
        shared: (k,) size of each of ``RadioRanges.shared_errors_m``.
    """

    anchors: tuple[AnchorEstimate, ...]
    tags_in_cam_m: Array
    time_shift_s: float = 0.0
    short_range_error_m: float = 0.0
    shared: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class RadioRanges:
    """The ranges of a refinement.

    Attributes:
        observations, trajectory: of the unscaled model.
        antennas: of all ranges, with the lever arms as given.
        shared_errors_m: (n, k) errors that all ranges share, for k independent standard deviations.
    """

    observations: RangeObservations
    trajectory: Trajectory
    antennas: Antennas
    shared_errors_m: Array

    def shared_m(self, radio: RadioEstimate) -> Array:
        """Return by how much each range (n,) is too long because of the shared errors."""
        return np.asarray(self.shared_errors_m @ radio.shared)

    @property
    def rows(self) -> Indices:
        """(k,) rows of the ranges that take part: all that have a place."""
        return self.observations.placed_rows

    @property
    def interval_s(self) -> Array:
        """(n,) times between the keyframes around each range, seconds; 0 at a keyframe."""
        times = self.trajectory.timestamps_s
        if times is None:
            return np.zeros(len(self.antennas.before))
        return times[self.antennas.after] - times[self.antennas.before]

    def places(self, path: Trajectory, radio: RadioEstimate) -> tuple[Array, Array]:
        """Return the (n, 3) positions of the tag and of the camera's centre at each range, on a metric path.

        The camera's are on straight lines between keyframes; only the tag's include the curve of the path.
        """
        fraction, between = self.antennas.fraction.copy(), self.antennas.before != self.antennas.after
        if radio.time_shift_s:
            fraction[between] += radio.time_shift_s / self.interval_s[between]
        tags_in_cam_m = radio.tags_in_cam_m[self.observations.log.tag_index]
        at = replace(self.antennas, tag_in_cam_m=tags_in_cam_m, fraction=fraction)
        ends = path.centers[at.before], path.centers[at.after]
        centers_m = (1 - fraction)[:, None] * ends[0] + fraction[:, None] * ends[1]
        return at.positions(path.centers, path.world_from_cam), centers_m

    def predicted_m(self, metric: pycolmap.Reconstruction, radio: RadioEstimate) -> Array:
        """Return the (n,) ranges predicted by a metric model, interpolated like the residuals; NaN without a place."""
        index = self.observations.log.anchor_index
        at, _ = self.places(self.trajectory.as_in(metric), radio)
        from_anchor = at - np.array([a.position_m for a in radio.anchors]).reshape(-1, 3)[index]
        distance = np.linalg.norm(from_anchor, axis=1)
        predicted = distance + np.array([a.range_bias_m for a in radio.anchors])[index]
        predicted += radio.short_range_error_m * np.exp(-distance / SHORT_RANGE_LENGTH_M)
        return np.where(self.observations.before >= 0, predicted, np.nan)


def ranges_predicted_by_model(
    metric: pycolmap.Reconstruction,
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    tag_in_cam_m: npt.ArrayLike,
    anchors: Sequence[AnchorEstimate],
) -> Array:
    """Return the (n,) ranges predicted by a metric model, interpolated like the residuals; NaN without a place.

    Arguments as for ``refine_with_ranges``.
    """
    ranges, radio = radio_as_given(trajectory, observations, metric_from_sfm, tag_in_cam_m, anchors)
    return ranges.predicted_m(metric, radio)


def radio_as_given(
    trajectory: Trajectory,
    observations: RangeObservations,
    metric_from_sfm: Similarity,
    tag_in_cam_m: npt.ArrayLike,
    anchors: Sequence[AnchorEstimate],
) -> tuple[RadioRanges, RadioEstimate]:
    """Return ranges and radio parameters as given; arguments as for ``refine_with_ranges``."""
    tags_in_cam_m = lever_arms(observations.log, tag_in_cam_m)
    placed = antennas(trajectory, observations, metric_from_sfm, tags_in_cam_m)
    none_shared = np.zeros((len(observations.log), 0))
    return RadioRanges(observations, trajectory, placed, none_shared), RadioEstimate(tuple(anchors), tags_in_cam_m)


def radio_blocks(
    radio: RadioEstimate, metric: pycolmap.Reconstruction, trajectory: Trajectory, options: RefineOptions
) -> ceres.RangeBlocks:
    """Return parameter blocks with the values of an estimate, and the blocks of a model's poses."""
    return ceres.RangeBlocks(
        poses=[pose_of(metric.frame(int(frame_id))).params for frame_id in trajectory.frame_ids],
        anchors=[anchor.position_m.copy() for anchor in radio.anchors],
        biases=[np.array([anchor.range_bias_m]) for anchor in radio.anchors],
        tags_in_cam=list(radio.tags_in_cam_m.copy()),
        lever_arms_are_free=options.lever_arm_stddev_m > 0,
        time_shift=np.array([radio.time_shift_s]) if options.time_offset_stddev_s else None,
        amplitude=np.array([radio.short_range_error_m]) if options.short_range_stddev_m else None,
        shared=ceres.shared_blocks(radio.shared),
    )


@dataclass(frozen=True)
class AddedRadio:
    """Parameters and residuals of the ranges and distances in the full problem.

    Attributes:
        blocks: of the ranges; the solver changes them in place. others: of other residuals.
        residual_rows: (k,) indices of the ranges' residuals among those of the problem.
        shared_prior_rows: indices of the residuals of the shared errors' prior.
    """

    blocks: ceres.RangeBlocks
    others: list[Array]
    residual_rows: Indices
    shared_prior_rows: Indices

    @property
    def all_but_anchors(self) -> list[Array]:
        """Every parameter block that is not a point of the world."""
        wanted = [block for block in (self.blocks.time_shift, self.blocks.amplitude) if block is not None]
        return [*self.blocks.biases, *self.blocks.tags_in_cam, *wanted, *self.blocks.shared, *self.others]

    def estimate(self, before: RadioEstimate) -> RadioEstimate:
        """Return the parameters with the solver's values."""
        blocks = self.blocks
        return RadioEstimate(
            moved_anchors(before.anchors, blocks.anchors, [bias[0] for bias in blocks.biases]),
            np.array(blocks.tags_in_cam).reshape(-1, 3),
            before.time_shift_s if blocks.time_shift is None else float(blocks.time_shift[0]),
            before.short_range_error_m if blocks.amplitude is None else float(blocks.amplitude[0]),
            np.concatenate([np.zeros(0), *blocks.shared]),
        )


def add_range_residuals(
    bundle: BundleAdjustment,
    ranges: RadioRanges,
    errors: RangeErrors,
    blocks: ceres.RangeBlocks,
) -> Indices:
    """Add ranges as residuals, scaled so that one standard deviation of a range weighs as much as one of a pixel.

    Args:
        errors: of the ranges that take part.

    Returns:
        (k,) index of each range's residual among those of the problem.
    """
    log, rows, at = ranges.observations.log, ranges.rows, ranges.antennas.subset(ranges.rows)
    placed = ceres.PlacedRanges(
        range_m=log.range_m[rows],
        stddev_m=errors.stddev_m,
        before=at.before,
        after=at.after,
        weight=at.fraction,
        offset_in_world_m=at.offset_in_world_m,
        anchor_index=log.anchor_index[rows],
        tag_index=log.tag_index[rows],
        interval_s=ranges.interval_s[rows],
        share=bundle.pixel_stddev**2 * errors.worth,
        loadings_m=ranges.shared_errors_m[rows],
    )
    return ceres.add_ranges(
        bundle.adjuster,
        placed,
        blocks,
        short_range_length_m=None if blocks.amplitude is None else SHORT_RANGE_LENGTH_M,
        loss_scale=errors.loss.width,
        loss_is_bounded=errors.loss.is_bounded,
    )


def add_radio_priors(
    bundle: BundleAdjustment,
    radio: RadioEstimate,
    tags_in_cam_m: Array,
    common_bias_stddev_m: float,
    blocks: ceres.RangeBlocks,
    options: RefineOptions,
) -> Indices:
    """Fix each radio parameter, add its prior, or leave it free; standard deviations are scaled to pixels.

    Args:
        tags_in_cam_m: (num_tags, 3) lever arms as given, the means of their priors.
        common_bias_stddev_m: of the bias that all ranges share.

    Returns:
        indices of the residuals of the shared errors' prior.
    """
    for anchor, position in zip(radio.anchors, blocks.anchors, strict=True):
        bundle.add_prior(position, anchor.prior_position_m, anchor.prior_position_stddev_m)
    _add_bias_priors(bundle, radio.anchors, blocks.biases, common_bias_stddev_m)
    for block, given in zip(blocks.tags_in_cam, tags_in_cam_m, strict=True):
        bundle.add_prior(block, given, options.lever_arm_stddev_m)
    bundle.add_prior(blocks.time_shift, np.zeros(1), options.time_offset_stddev_s)
    bundle.add_prior(blocks.amplitude, np.zeros(1), options.short_range_stddev_m)
    rows = [np.zeros(0, dtype=np.int64)]
    for numbers in blocks.shared:
        rows.append(bundle.adjuster.problem.num_residuals() + np.arange(len(numbers)))
        bundle.add_prior(numbers, np.zeros(len(numbers)), 1.0)
    return np.concatenate(rows)


def _add_bias_priors(
    bundle: BundleAdjustment, anchors: tuple[AnchorEstimate, ...], biases: Sequence[Array], common_stddev_m: float
) -> None:
    """Add one joint prior for all estimated biases, because they share the tag's bias."""
    drawn = []
    for anchor, bias in zip(anchors, biases, strict=True):
        bundle.add_prior(bias, None, anchor.prior_bias_stddev_m)
        if bundle.adjuster.problem.has_parameter_block(bias) and 0 < anchor.prior_bias_stddev_m < np.inf:
            drawn.append((anchor, bias))
    if drawn:
        own_stddev_m = np.array([anchor.prior_bias_stddev_m for anchor, _ in drawn])
        cost = ceres.joint_prior_cost(
            mean=np.array([anchor.prior_bias_m for anchor, _ in drawn]),
            whitening=bundle.pixel_stddev * bias_whitening(own_stddev_m, common_stddev_m),
        )
        ceres.add_residual_block(bundle.adjuster, cost, None, [bias for _, bias in drawn])


def moved_anchors(
    anchors: Sequence[AnchorEstimate], positions_m: Iterable[Array], biases_m: Iterable[float]
) -> tuple[AnchorEstimate, ...]:
    """Return the anchors with new positions and biases."""
    return tuple(
        replace(anchor, position_m=position, range_bias_m=float(bias))
        for anchor, position, bias in zip(anchors, positions_m, biases_m, strict=True)
    )
