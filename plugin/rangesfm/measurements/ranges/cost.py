"""Ranges between an antenna on the camera and anchors, as measurements of the map."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt

from rangesfm import solver
from rangesfm.arrays import Array, Indices, rows_by_key
from rangesfm.measurements.kind import Block, ByBlock, Doubt, Linearization, MapState, Measurements, Weights
from rangesfm.measurements.places import AntennaPlaces
from rangesfm.measurements.prior import Prior
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.errors.noise import SHORT_RANGE_LENGTH_M, bias_whitening
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors, misfits
from rangesfm.measurements.ranges.range_gradient import RangeGradient
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.options import RefineOptions
from rangesfm.solver.bundle_adjustment import BundleAdjustment
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.robust_statistics import RobustLoss

CLOCK: Block = ("clock", "ranges")
SHORT: Block = ("short range error", "ranges")
# Largest size of a block of numbers that all ranges share: as many as a pose has columns, for Ceres' fastest kernels.
_MAX_NUM_SHARED = 6


@dataclass(frozen=True)
class Ranges(Measurements):
    """The ranges of a log on the path of a map. Those that take part are k of n.

    Attributes:
        observations: all of the log, on the unscaled model.
        places: of the antennas at all n ranges.
        tags_in_cam_m: (num_tags, 3) lever arms as given.
        anchors: with their priors, in the order of the log, in the metric world.
        errors: of the k ranges.
        shared_errors_m: (n, s) errors that the ranges share, for s independent standard deviations.
        options: which parameters of the radio are estimated besides.
        metres_per_unit: of the unscaled model, on which the ranges were placed.
    """

    kind: ClassVar[str] = "range"
    counts_in_metres: ClassVar[bool] = True

    observations: RangeObservations
    places: AntennaPlaces
    tags_in_cam_m: Array
    anchors: tuple[AnchorEstimate, ...]
    errors: RangeErrors
    shared_errors_m: Array
    options: RefineOptions
    metres_per_unit: float

    @property
    def rows(self) -> Indices:
        """(k,) rows of the ranges that take part: all that have a place."""
        return self.observations.placed_rows

    @property
    def takes_part(self) -> bool:
        return len(self.rows) > 0

    @property
    def places_map(self) -> bool:
        return any(np.isfinite(each.prior_position_stddev_m) for each in self.anchors)

    @property
    def placed_anchors(self) -> Mapping[str, Array]:
        """(3,) positions of the anchors that have one, by name."""
        return {each.anchor_id: each.position_m for each in self.anchors if np.isfinite(each.position_m).all()}

    @property
    def is_heard(self) -> npt.NDArray[np.bool_]:
        """(m,) anchors to which ranges take part."""
        return np.isin(np.arange(len(self.anchors)), self.observations.log.anchor_index[self.rows])

    @property
    def blocks(self) -> Mapping[Block, Array]:
        found = {("anchor", each.anchor_id): each.position_m for each in self.anchors}
        found |= {("bias", each.anchor_id): np.array([each.range_bias_m]) for each in self.anchors}
        if self.options.lever_arm_stddev_m > 0:
            found |= dict(zip(self._arm_names, self.tags_in_cam_m, strict=True))
        if self.options.time_offset_stddev_s:
            found[CLOCK] = np.zeros(1)
        if self.options.short_range_stddev_m:
            found[SHORT] = np.zeros(1)
        return found | {name: np.zeros(stop - start) for name, start, stop in self._shared}

    @property
    def fixed(self) -> frozenset[Block]:
        heard = zip(self.anchors, self.is_heard, strict=True)
        return frozenset(
            name
            for each, is_heard in heard
            for name, stddev in (
                (("anchor", each.anchor_id), each.prior_position_stddev_m),
                (("bias", each.anchor_id), each.prior_bias_stddev_m),
            )
            if not (is_heard and stddev > 0)
        )

    @property
    def _arm_names(self) -> list[Block]:
        return [("lever_arm", tag_id) for tag_id in self.observations.log.tag_ids]

    @property
    def _shared(self) -> list[tuple[Block, int, int]]:
        """Names of the blocks of shared errors, and the first and the last of the numbers of each."""
        num = self.shared_errors_m.shape[1]
        starts = range(0, num, _MAX_NUM_SHARED)
        return [(("shared", f"ranges {k}"), k, min(k + _MAX_NUM_SHARED, num)) for k in starts]

    def priors(self) -> Iterator[Prior]:
        """Yield what is known of the blocks."""
        heard = [each for each, is_heard in zip(self.anchors, self.is_heard, strict=True) if is_heard]
        for each in heard:
            mean_m, stddev_m = each.prior_position_m, each.prior_position_stddev_m
            if mean_m is not None and 0 < stddev_m < np.inf:
                yield Prior.of_one(("anchor", each.anchor_id), mean_m, stddev_m)
        if drawn := [each for each in heard if 0 < each.prior_bias_stddev_m < np.inf]:
            # One joint prior, because the biases share that of the tag.
            own_m = np.array([each.prior_bias_stddev_m for each in drawn])
            yield Prior(
                (tuple(("bias", each.anchor_id) for each in drawn),),
                np.array([[[each.prior_bias_m] for each in drawn]]),
                bias_whitening(own_m, self.errors.common_bias_stddev_m)[None],
            )
        if self.options.lever_arm_stddev_m > 0:
            for name, arm_m in zip(self._arm_names, self.tags_in_cam_m, strict=True):
                yield Prior.of_one(name, arm_m, self.options.lever_arm_stddev_m)
        if self.options.time_offset_stddev_s:
            yield Prior.of_one(CLOCK, np.zeros(1), self.options.time_offset_stddev_s)
        if self.options.short_range_stddev_m:
            yield Prior.of_one(SHORT, np.zeros(1), self.options.short_range_stddev_m)
        for name, start, stop in self._shared:
            yield Prior.of_one(name, np.zeros(stop - start), 1.0)

    def begun(self, state: MapState) -> Ranges:
        """Return the ranges with the errors to begin with on a map as it is given, which may bend."""
        placing_m = self.observations.placing_stddev_m(self.metres_per_unit)[self.rows]
        errors = self.errors.at(self.antennas_m(state)[0], placing_m)
        if self.options.short_range_stddev_m > 0:
            errors = errors.without_shared()
        return replace(self, errors=errors.for_bending_map(RobustLoss(self.options.range_loss_scale, is_bounded=True)))

    @property
    def weights(self) -> Weights:
        return Weights(1 / self.errors.stddev_m[:, None, None], self.errors.worth, self.errors.loss)

    def linearize(self, state: MapState) -> Linearization:
        places, log = self.places.subset(self.rows), self.observations.log
        anchor, tag = log.anchor_index[self.rows], log.tag_index[self.rows]
        arms_m, later_s = self.arms_m(state)[tag], self._later_s(state)
        gradient = self._gradient(state, self.rows)
        shortness = np.exp(-gradient.distance_m / SHORT_RANGE_LENGTH_M)
        excess_m = float(state.blocks[SHORT][0]) if SHORT in state.blocks else 0.0
        towards = (1 - excess_m / SHORT_RANGE_LENGTH_M * shortness)[:, None, None] * gradient.by_tag[:, None]
        ones = np.ones((len(anchor), 1, 1))
        by_block = [
            ByBlock(tuple(("anchor", each.anchor_id) for each in self.anchors), anchor, -towards),
            ByBlock(tuple(("bias", each.anchor_id) for each in self.anchors), anchor, ones),
        ]
        all_of_one = np.zeros(len(anchor), dtype=np.int64)
        if self.options.lever_arm_stddev_m > 0:
            by_arm = places.by_arm(state.poses, towards, later_s)
            by_block.append(ByBlock(tuple(self._arm_names), tag, by_arm))
        if CLOCK in state.blocks:
            by_block.append(ByBlock((CLOCK,), all_of_one, places.by_time(state.poses, arms_m, towards)))
        if SHORT in state.blocks:
            by_block.append(ByBlock((SHORT,), all_of_one, shortness[:, None, None]))
        for name, start, stop in self._shared:
            by_block.append(ByBlock((name,), all_of_one, self.shared_errors_m[self.rows, None, start:stop]))
        residual_m = (self.predicted_m(state) - log.range_m)[self.rows]
        slopes = places.by_pose(state.poses, arms_m, towards, later_s)
        return Linearization(residual_m[:, None], places.keyframes, slopes, tuple(by_block))

    def predicted_m(self, state: MapState) -> Array:
        """Return the (n,) ranges that a state predicts, with shared errors; NaN without a place."""
        distance_m = self._gradient(state, np.arange(len(self.observations.log))).distance_m
        biases_m = np.array([state.blocks["bias", each.anchor_id][0] for each in self.anchors])
        predicted_m = distance_m + biases_m[self.observations.log.anchor_index] + self.shared_m(state)
        if SHORT in state.blocks:
            predicted_m += state.blocks[SHORT][0] * np.exp(-distance_m / SHORT_RANGE_LENGTH_M)
        return np.where(self.observations.before >= 0, predicted_m, np.nan)

    def shared_m(self, state: MapState) -> Array:
        """Return by how much each range (n,) is too long because of the shared errors."""
        sizes = np.concatenate([np.zeros(0), *(state.blocks[name] for name, _, _ in self._shared)])
        return np.asarray(self.shared_errors_m @ sizes)

    def estimated(self, state: MapState, block: Block) -> float | None:
        """Return a number of the radio, ``CLOCK`` or ``SHORT``; None if it is not estimated."""
        return float(state.blocks[block][0]) if block in state.blocks else None

    def misfits(self, state: MapState) -> tuple[Doubt, ...]:
        """Return the reasons why the ranges fit a state worse than their noise suggests."""
        if not self.takes_part:
            return ()
        rows, log, seen = self.rows, self.observations.log, self.observations
        times = seen.before + seen.fraction if isinstance(log.moments, ByPhoto) else log.timestamp_s
        return misfits(self.errors, (self.predicted_m(state) - log.range_m)[rows], times[rows])

    def antennas_m(self, state: MapState) -> tuple[Array, Array]:
        """Return the (k, 3) places of tag and camera at the ranges that take part."""
        places, later_s = self.places.subset(self.rows), self._later_s(state)
        arms_m = self.arms_m(state)[self.observations.log.tag_index[self.rows]]
        return places.at(state.poses, arms_m, later_s), places.centers(state.poses, later_s)

    def _gradient(self, state: MapState, rows: Indices) -> RangeGradient:
        log = self.observations.log
        anchors_m = np.array([state.blocks["anchor", each.anchor_id] for each in self.anchors]).reshape(-1, 3)
        arms_m = self.arms_m(state)[log.tag_index[rows]]
        tags_m = self.places.subset(rows).at(state.poses, arms_m, self._later_s(state))
        return RangeGradient.of(tags_m - anchors_m[log.anchor_index[rows]])

    def arms_m(self, state: MapState) -> Array:
        """Return the (num_tags, 3) lever arms."""
        if self.options.lever_arm_stddev_m > 0:
            return np.array([state.blocks[name] for name in self._arm_names])
        return self.tags_in_cam_m

    def _later_s(self, state: MapState) -> float:
        return float(state.blocks[CLOCK][0]) if CLOCK in state.blocks else 0.0

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        """Add the costs: one residual block for the ranges of one place, anchor and tag, each of which is robust alone.

        The solver's work grows with the number of blocks and of pairs of blocks that share a residual, and much less
        with the number of residuals in a block.
        """
        log, rows, at = self.observations.log, self.rows, self.places.subset(self.rows)
        anchor_index, tag_index = log.anchor_index[rows], log.tag_index[rows]
        arm_is_free, share = self.options.lever_arm_stddev_m > 0, adjustment.pixel_stddev**2 * self.errors.worth
        for group in rows_by_key(at.before, at.after, anchor_index, tag_index):
            before, after, anchor, tag = (
                int(index[group[0]]) for index in (at.before, at.after, anchor_index, tag_index)
            )
            measured: dict[str, Any] = {
                "range_m": log.range_m[rows[group]],
                "stddev_m": self.errors.stddev_m[group],
                "share": share[group],
                "loadings_m": self.shared_errors_m[rows[group]],
                "tag_in_cam_m": None if arm_is_free else self.tags_in_cam_m[tag],
                "short_range_length_m": SHORT_RANGE_LENGTH_M if SHORT in blocks else None,
                "loss_scale": self.errors.loss.width,
                "loss_is_bounded": self.errors.loss.is_bounded,
            }
            anchor_id = self.anchors[anchor].anchor_id
            names = [("anchor", anchor_id), ("bias", anchor_id), *([self._arm_names[tag]] if arm_is_free else ())]
            if before == after:
                cost, ends = solver.range_cost(**measured), [poses[before]]
            else:
                interval_s = at.interval_s[group[0]] if CLOCK in blocks else None
                cost = solver.interpolated_range_cost(
                    **measured, weight=at.fraction[group], offset_in_world_m=at.offset_m[group], interval_s=interval_s
                )
                ends, names = [poses[before], poses[after]], [*names, *([CLOCK] if CLOCK in blocks else ())]
            names += [*([SHORT] if SHORT in blocks else ()), *(name for name, _, _ in self._shared)]
            solver.add_residual_block(adjustment.adjuster, cost, None, [*ends, *(blocks[name] for name in names)])

    def at_blocks(self, blocks: Mapping[Block, Array]) -> Ranges:
        return replace(self, anchors=anchors_at(self.anchors, blocks))

    def like(self, other: Ranges) -> Ranges:
        return replace(self, errors=other.errors)

    def under(self, loss: RobustLoss) -> Ranges:
        return replace(self, errors=replace(self.errors, loss=loss))

    def with_noise_of(self, residual: Array, num_absorbed: float) -> Ranges:
        return replace(self, errors=self.errors.seen_by_bending_map(residual[:, 0], num_absorbed))

    def change(self, other: Ranges) -> float:
        return self.errors.change(other.errors)

    def log_likelihood(self, residual: Array) -> float:
        return self.errors.noise_of_estimated(residual[:, 0]).log_likelihood


def anchors_at(anchors: Sequence[AnchorEstimate], blocks: Mapping[Block, Array]) -> tuple[AnchorEstimate, ...]:
    """Return the anchors with the positions and biases in blocks."""
    return tuple(
        replace(
            each,
            position_m=blocks["anchor", each.anchor_id],
            range_bias_m=float(blocks["bias", each.anchor_id][0]),
        )
        for each in anchors
    )
