"""RangeObservations: every range of a log with its position on the path, or the reason why it has none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import InputError
from rangesfm.measurements.places import PlacesOnPath
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.options import RangesOptions
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.similarity import Similarity


class RangeStatus(IntEnum):
    """Status of a range; only ranges with the first two take part in a result."""

    USED = 0
    DOWN_WEIGHTED = 1
    OUTLIER = 2
    NO_KEYFRAME_NEAR = 3
    OUTSIDE_PATH = 4
    UNKNOWN_IMAGE = 5
    UNKNOWN_ANCHOR = 6
    CHECK = 7
    ANCHOR_ANCHOR = 8
    TAG_TAG = 9

    @property
    def label(self) -> str:
        return self.name.lower().replace("_", "-")


USED = (RangeStatus.USED, RangeStatus.DOWN_WEIGHTED)
"""Statuses of ranges that are used in the final model, with full or reduced weight."""


@dataclass(frozen=True)
class RangeObservations(PlacesOnPath):
    """n ranges (all of the log, in its order) on the path of one model.

    Attributes:
        log: the ranges.
        status: (n,) RangeStatus.
        time_offset_stddev_s: standard deviation of the clocks' offset that was used.
    """

    log: RangeLog
    status: npt.NDArray[np.int8]
    time_offset_stddev_s: float = 0.0

    @property
    def has_place(self) -> Mask:
        """Ranges that estimates may use (n,): on the path, to a wanted anchor, not held out."""
        return np.asarray(self.status <= RangeStatus.OUTLIER)

    def placing_stddev_m(self, metres_per_unit: float) -> Array:
        """Return the standard deviation (n,) of the antenna's coordinates in a map of this scale, metres."""
        return np.hypot(metres_per_unit * self.center_stddev, self.arm_stddev_m)

    def predicted_m(self, metric_from_model: Similarity, anchors_m: Array, biases_m: Array) -> Array:
        """Return the (n,) ranges where a similarity places the path, metres; NaN without a position on it.

        Args:
            anchors_m, biases_m: (m, 3) and (m,) of the log's anchors, in the metric world.
        """
        index = self.log.anchor_index
        antennas_m = metric_from_model.apply(self.centers) + self.tag_from_center @ metric_from_model.rotation.T
        return np.asarray(np.linalg.norm(antennas_m - anchors_m[index], axis=1) + biases_m[index])

    @property
    def placed_rows(self) -> Indices:
        """Rows (k,) of the ranges that estimates may use, in ``log.own_order``."""
        order = self.log.own_order
        return np.asarray(order[self.has_place[order]])


def hold_out(observations: RangeObservations, checks: RangesOptions, seed: int) -> RangeObservations:
    """Hold out ranges as checks: those of some anchors, those of an interval of time, and a random share of the rest.

    Raises:
        InputError: an anchor is not in the log, or no range is in the interval.
    """
    log, status = observations.log, observations.status.copy()
    chosen = np.zeros(len(log), dtype=bool)
    for anchor_id in checks.check_anchors:
        if anchor_id not in log.anchor_ids:
            raise InputError(f"the check anchor {anchor_id!r} is not in the log ({', '.join(log.anchor_ids)})")
        chosen |= log.anchor_index == log.anchor_ids.index(anchor_id)
    if checks.check_times_s:
        chosen |= _in_time(log, checks.check_times_s)
    status[chosen & observations.has_place] = RangeStatus.CHECK
    # Checks are drawn from the whole log, so that the same ranges are checks whichever part of the path is known.
    drawn = np.zeros(len(log), dtype=bool)
    drawn[log.own_order] = np.random.default_rng(seed).permutation(len(log)) < round(checks.check_share * len(log))
    status[drawn & (status <= RangeStatus.OUTLIER)] = RangeStatus.CHECK
    return replace(observations, status=status)


def _in_time(log: RangeLog, times_s: tuple[float, ...]) -> Mask:
    if isinstance(log.moments, ByPhoto):
        raise InputError("check_times_s needs a log with times, this one names photos", log.source)
    first, last = times_s
    inside: Mask = (log.timestamp_s >= first) & (log.timestamp_s <= last)
    if not inside.any():
        start, end = log.timestamp_s.min(), log.timestamp_s.max()
        # Twelve digits are printed, because times may be seconds since 1970.
        found, expected = f"{first:.12g} to {last:.12g} s", f"{start:.12g} to {end:.12g} s"
        raise InputError(f"no range from {found}, expected within {expected}", log.source)
    return inside


# Robust weights below which a range counts as down-weighted, or as an outlier.
DOWN_WEIGHTED_BELOW = 0.5
OUTLIER_BELOW = 0.1


def status_by_weight(weights: Array) -> npt.NDArray[np.int8]:
    """Return the status (n,) of ranges that took part in an estimate, by their final robust weights in [0, 1]."""
    status = np.full(len(weights), RangeStatus.USED, dtype=np.int8)
    status[weights < DOWN_WEIGHTED_BELOW] = RangeStatus.DOWN_WEIGHTED
    status[weights < OUTLIER_BELOW] = RangeStatus.OUTLIER
    return status


def each_on_one_path(parts: Sequence[RangeObservations]) -> list[RangeObservations]:
    """Return the observations of several paths, with each range on the first path only that it has a position on."""
    taken = np.zeros(len(parts[0].log), dtype=bool)
    exclusive = []
    for part in parts:
        status = part.status.copy()
        status[taken & part.has_place] = RangeStatus.OUTSIDE_PATH
        taken |= part.has_place
        exclusive.append(replace(part, status=status))
    return exclusive


def joined_observations(
    parts: Sequence[RangeObservations], joined_from_part: Sequence[Similarity], keyframes: Sequence[Indices]
) -> RangeObservations:
    """Join observations on several paths into observations on the joined path.

    Args:
        parts: observations of one log; each range has a position on one path at most.
        joined_from_part: transformation from the world of each path to that of the joined one.
        keyframes: for each path, the indices of its keyframes in the joined path.
    """
    is_free = np.ones(len(parts[0].log), dtype=bool)
    joined: dict[str, Any] = {"status": np.min([part.status for part in parts], axis=0)}
    for part, similarity, keyframe in zip(parts, joined_from_part, keyframes, strict=True):
        # Ranges with a position that is used by an estimate or a check.
        rows = is_free & (part.before >= 0) & (part.has_place | (part.status == RangeStatus.CHECK))
        is_free &= ~rows
        moved: dict[str, npt.NDArray[Any]] = {
            "status": part.status,
            "before": keyframe[part.before],
            "after": keyframe[part.after],
            "fraction": part.fraction,
            "centers": similarity.apply(part.centers),
            "center_offsets": similarity.scale * part.center_offsets @ similarity.rotation.T,
            "tag_from_center": part.tag_from_center @ similarity.rotation.T,
            "center_stddev": similarity.scale * part.center_stddev,
            "arm_stddev_m": part.arm_stddev_m,
        }
        for name, values in moved.items():
            joined.setdefault(name, getattr(part, name).copy())[rows] = values[rows]
    return RangeObservations(log=parts[0].log, **joined)
