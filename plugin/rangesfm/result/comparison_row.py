"""Entry of ``result.json`` for one path that is compared with a reference, which needs nothing of the other entries."""

from __future__ import annotations

import math

from rangesfm.errors import number_text
from rangesfm.util.files.records import Count, NumberOrNull, Record, Text
from rangesfm.util.files.text_tables import align_rows


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


def format_table(rows: tuple[ComparisonRow, ...], frame: str) -> str:
    """Return the rows as a table in plain text, lengths in metres; ``frame`` is that of the paths."""
    header = ("trajectory", "keyframes", rmse_heading(frame), "after SE(3)", "after Sim(3)", "scale error")
    cells = [
        (
            row.name,
            str(row.num_keyframes),
            *(text_or_dash(length_m, ".4f") for length_m in (row.rmse_m, row.rmse_se3_m, row.rmse_sim3_m)),
            text_or_dash(row.scale_error_percent, "+.3f", " %"),
        )
        for row in rows
    ]
    return align_rows([header, *cells])


def text_or_dash(value: float | None, spec: str, unit: str = "") -> str:
    """Return a number as text with its unit, or "-" where it is unknown, for a table in plain text."""
    return "-" if value is None or math.isnan(value) else f"{number_text(value, spec)}{unit}"
