"""The ranges of one log on several paths, brought together on the path that these make up."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Indices
from rangesfm.geometry.similarity import Similarity
from rangesfm.ranging.observations import RangeObservations, RangeStatus


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
    number = path_of_each(parts)
    joined: dict[str, npt.NDArray[Any]] = {"status": np.min([part.status for part in parts], axis=0)}
    for k, (part, similarity, keyframe) in enumerate(zip(parts, joined_from_part, keyframes, strict=True)):
        rows = number == k
        moved: dict[str, npt.NDArray[Any]] = {
            "status": part.status,
            "before": keyframe[part.before],
            "after": keyframe[part.after],
            "weight": part.weight,
            "centers": similarity.apply(part.centers),
            "center_offsets": similarity.scale * part.center_offsets @ similarity.rotation.T,
            "tag_from_center": part.tag_from_center @ similarity.rotation.T,
            "center_stddev": similarity.scale * part.center_stddev,
        }
        for name, values in moved.items():
            joined.setdefault(name, getattr(part, name).copy())[rows] = values[rows]
    return RangeObservations(parts[0].log, **joined)


def _is_placed(part: RangeObservations) -> npt.NDArray[np.bool_]:
    """(n,) with a place that counts, be it only as a check."""
    return np.asarray((part.before >= 0) & (part.has_place | (part.status == RangeStatus.CHECK)))
