"""The ranges of one log on several paths, brought together on the path that these make up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rangesfm.geometry.similarity import Similarity
from rangesfm.ranging.observations import RangeObservations, RangeStatus

Indices = npt.NDArray[np.int64]


def each_on_one_path(parts: Sequence[RangeObservations]) -> list[RangeObservations]:
    """The same, but a range that has a place on a path has none on those after it."""
    taken = np.zeros(len(parts[0].log), dtype=bool)
    exclusive = []
    for part in parts:
        status = part.status.copy()
        status[taken & part.has_place] = RangeStatus.OUTSIDE_PATH
        taken |= part.has_place
        exclusive.append(replace(part, status=status))
    return exclusive


def path_of_each(parts: Sequence[RangeObservations]) -> Indices:
    """(n,) the part in which each range has a place; -1: in none."""
    number = np.full(len(parts[0].log), -1, dtype=np.int64)
    for k, part in enumerate(parts):
        number[(number < 0) & _is_placed(part)] = k
    return number


def joined_observations(
    parts: Sequence[RangeObservations], joined_from_part: Sequence[Similarity], keyframes: Sequence[Indices]
) -> RangeObservations:
    """All ranges on the joined path.

    Args:
        parts: of one log, each range with a place on one path at most.
        joined_from_part: world of each path to that of the joined one.
        keyframes: where the keyframes of each path are in the joined one.
    """
    first = parts[0]
    joined = {
        "status": np.min([part.status for part in parts], axis=0),
        **{name: getattr(first, name).copy() for name in ("before", "after", "weight", "centers", "center_offsets")},
        "tag_from_center": first.tag_from_center.copy(),
        "center_stddev": first.center_stddev.copy(),
    }
    number = path_of_each(parts)
    for k, (part, similarity, keyframe) in enumerate(zip(parts, joined_from_part, keyframes, strict=True)):
        rows = number == k
        joined["status"][rows] = part.status[rows]
        joined["before"][rows], joined["after"][rows] = keyframe[part.before[rows]], keyframe[part.after[rows]]
        joined["weight"][rows] = part.weight[rows]
        joined["centers"][rows] = similarity.apply(part.centers[rows])
        joined["center_offsets"][rows] = similarity.scale * part.center_offsets[rows] @ similarity.rotation.T
        joined["tag_from_center"][rows] = part.tag_from_center[rows] @ similarity.rotation.T
        joined["center_stddev"][rows] = similarity.scale * part.center_stddev[rows]
    return RangeObservations(first.log, **joined)


def _is_placed(part: RangeObservations) -> npt.NDArray[np.bool_]:
    """(n,) with a place that counts, be it only as a check."""
    return np.asarray((part.before >= 0) & (part.has_place | (part.status == RangeStatus.CHECK)))
