"""Entry of ``result.json`` for one path that is compared with a reference, which needs nothing of the other entries."""

from __future__ import annotations

from rangesfm.util.files.records import Count, NumberOrNull, Record, Text


class ComparisonRow(Record):
    """Comparison of one path with the reference: a row of the table in the 2018 paper.

    Attributes:
        name: of the path.
        num_keyframes: number of keyframes with a known reference position; all errors are over these.
        rmse_m: of keyframe centres. In the frame "site" without any alignment; in the frame "first_camera" the
            reference is aligned to the path by the pose of its first known keyframe, and this is null if the reference
            has no orientations.
        rmse_se3_m: after the best rigid motion; null below three keyframes.
        rmse_sim3_m: after the best similarity; null below three keyframes.
        scale_error_percent: scale of the path relative to the reference, minus one: positive where the map is too
            large; null below three keyframes or without motion.
    """

    name: Text
    num_keyframes: Count
    rmse_m: NumberOrNull
    rmse_se3_m: NumberOrNull
    rmse_sim3_m: NumberOrNull
    scale_error_percent: NumberOrNull


def rmse_heading(frame: str) -> str:
    """Return the heading of a column of ``ComparisonRow.rmse_m``, given the frame of the compared paths."""
    return "RMSE m by first pose" if frame == "first_camera" else "RMSE m"
