"""Content: all that a report shows, gathered from a result folder; what is missing is None."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from rangesfm.reference import read_reference
from rangesfm.result_folder import RangesAsUsed, ResultFolder
from rangesfm.trajectory import Trajectory, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]


class Summary:
    """``result.json``, read so that a missing or odd part is None instead of an error."""

    def __init__(self, values: dict[str, Any]):
        self._values = values

    def get(self, *keys: str) -> Any:
        """The value under nested keys; None if there is none."""
        value: Any = self._values
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        return value

    def number(self, *keys: str) -> float | None:
        """A finite number."""
        return as_number(self.get(*keys))

    def table(self, *keys: str) -> dict[str, Any]:
        """A nested object, empty if there is none."""
        value = self.get(*keys)
        return value if isinstance(value, dict) else {}

    def texts(self, *keys: str) -> list[str]:
        """A list as strings, empty if there is none."""
        value = self.get(*keys)
        return [str(item) for item in value] if isinstance(value, list) else []


@dataclass(frozen=True)
class Content:
    """All that a report shows.

    Attributes:
        title: name of the result.
        summary: ``result.json``.
        ranges: ``ranges.csv``.
        range_times_s: (n,) when each range was taken, seconds since the first; NaN where unknown.
        scaled, refined: the path before and after the refinement.
        reference_m: (k, 3) positions in the map's frame.
        anchors_m: (3,) by id.
        points_m: (m, 3) of the final map.
    """

    title: str
    summary: Summary
    ranges: RangesAsUsed | None
    range_times_s: Array | None
    scaled: Trajectory | None
    refined: Trajectory | None
    reference_m: Array | None
    anchors_m: dict[str, Array]
    points_m: Array | None

    @property
    def final(self) -> Trajectory | None:
        """The best path there is."""
        return self.refined if self.refined is not None else self.scaled

    @property
    def frame(self) -> str:
        return str(self.summary.get("frame") or "first_camera")


def gather(result: ResultFolder) -> Content:
    """Read what the report needs.

    Raises:
        InputError: a file of the result is there but cannot be read.
    """
    ranges = result.read_ranges()
    scaled, refined = result.read_model("sparse_scaled"), result.read_model("sparse_metric")
    final = refined or scaled
    reference_path = result.path / "reference.csv"
    return Content(
        title=result.path.resolve().name,
        summary=Summary(result.summary),
        ranges=ranges,
        range_times_s=None if ranges is None else _range_times(ranges, result.timestamps_s or {}),
        scaled=None if scaled is None else trajectory_from_reconstruction(scaled, result.timestamps_s),
        refined=None if refined is None else trajectory_from_reconstruction(refined, result.timestamps_s),
        reference_m=read_reference(reference_path).positions_m if reference_path.is_file() else None,
        anchors_m=result.anchor_positions_m,
        points_m=None
        if final is None
        else np.array([point.xyz for point in final.points3D.values()], dtype=np.float64).reshape(-1, 3),
    )


def as_number(value: Any) -> float | None:
    """A finite number, or None."""
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    return float(value) if is_number and math.isfinite(value) else None


def in_natural_order(ids: Iterable[str]) -> list[str]:
    """The distinct ids, "2" before "10"."""
    return sorted(set(ids), key=lambda id_: (not id_.isdecimal(), int(id_) if id_.isdecimal() else 0, id_))


def _range_times(ranges: RangesAsUsed, image_times_s: dict[str, float]) -> Array:
    """Time of each range (its own, or that of its photo) since the first: epochs have no room on an axis."""
    of_image = np.array([image_times_s.get(name, np.nan) for name in ranges.image_name], dtype=np.float64)
    times = np.where(np.isfinite(ranges.timestamp_s), ranges.timestamp_s, of_image)
    since_first: Array = times - np.min(times, initial=np.inf, where=np.isfinite(times))
    return since_first
