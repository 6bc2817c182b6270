"""A survey's row in the table of a batch."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from enum import Enum
from typing import Any

from rangesfm.failures import INTERNAL_ERROR
from rangesfm.files.text_table import align_rows
from rangesfm.result.summary import ResultSummary

_FAILED = 4


class Status(str, Enum):
    """What became of a survey."""

    WAITING = "waiting"
    RUNNING = "running"
    DONE = "done"
    FAILED = "failed"
    INTERRUPTED = "interrupted"

    @property
    def is_final(self) -> bool:
        return self not in (Status.WAITING, Status.RUNNING)


@dataclass(frozen=True)
class Figures:
    """What a survey found, as far as it did; see ``result.json``.

    Attributes:
        scale, scale_stddev: metres per SfM unit; the larger of the formal and the empirical stddev.
        num_photos: in the model.
        rmse_m: of the final map's keyframe centres without alignment, where there is a reference.
    """

    verdict: str | None = None
    scale: float | None = None
    scale_stddev: float | None = None
    frame: str | None = None
    num_photos: int | None = None
    num_ranges: int | None = None
    num_ranges_used: int | None = None
    range_rms_m: float | None = None
    reprojection_rms_px: float | None = None
    rmse_m: float | None = None
    num_warnings: int | None = None


@dataclass(frozen=True)
class SurveyRow:
    """One row.

    Attributes:
        survey: its file.
        reason: of a failure, or what the verdict names; one line.
        exit_status: that ``rangesfm run`` would have had; None while it is not over.
        num_attempts: how often a worker began it; more than 1 where one was killed.
        seconds: from the beginning of the last attempt to the end.
        host: where that was.
        output_path: folder of its results; empty if its file cannot be read.
    """

    survey: str
    status: Status = Status.WAITING
    reason: str = ""
    exit_status: int | None = None
    num_attempts: int = 0
    seconds: float | None = None
    host: str = ""
    output_path: str = ""
    figures: Figures = Figures()

    def cells(self) -> dict[str, Any]:
        """By column; plain values."""
        own = {item.name: getattr(self, item.name) for item in fields(self) if item.name != "figures"}
        found = {item.name: getattr(self.figures, item.name) for item in fields(self.figures)}
        return {**own, "status": self.status.value, **found}


def figures_of(summary: ResultSummary) -> Figures:
    """From ``result.json``."""
    scale, ranges = summary.scale, summary.ranges
    return Figures(
        verdict=scale.verdict,
        scale=scale.value,
        scale_stddev=scale.larger_stddev,
        frame=summary.frame,
        num_photos=summary.map.num_photos,
        num_ranges=ranges.num,
        num_ranges_used=ranges.num_used,
        range_rms_m=ranges.rms_m,
        reprojection_rms_px=None if summary.refine is None else summary.refine.reprojection_rms_px,
        rmse_m=summary.comparison[-1].rmse_m if summary.comparison else None,
        num_warnings=len(summary.warnings),
    )


def exit_status_of(rows: Iterable[SurveyRow]) -> int:
    """0 if all surveys are done, otherwise the largest of their statuses; what broke off has that of a failed run."""
    return max((_FAILED if row.exit_status == INTERNAL_ERROR else row.exit_status or 0 for row in rows), default=0)


def format_rows(rows: Sequence[SurveyRow]) -> str:
    """The rows as aligned plain text, and below them why surveys are not done."""
    header = ("survey", "result", "scale", "photos", "ranges used", "range RMS m", "RMSE m", "seconds")
    table = align_rows([header, *map(_texts, rows)])
    reasons = [_why(row) for row in rows if row.status is not Status.DONE]
    return "\n".join([table, *([""] if reasons else []), *reasons])


def _why(row: SurveyRow) -> str:
    """Errors about the file itself name it already."""
    return row.reason if row.reason.startswith(f"{row.survey}:") else f"{row.survey}: {row.reason}"


def _texts(row: SurveyRow) -> tuple[str, ...]:
    found = row.figures
    return (
        row.survey,
        found.verdict or row.status.value,
        _text(found.scale, ".6g"),
        _text(found.num_photos, "d"),
        _text(found.num_ranges_used, "d"),
        _text(found.range_rms_m, ".3f"),
        _text(found.rmse_m, ".4f"),
        _text(row.seconds, ".1f"),
    )


def _text(value: float | None, spec: str) -> str:
    return "-" if value is None else f"{value:{spec}}"
