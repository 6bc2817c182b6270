"""The table of a batch: as CSV, as JSON and as a page."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from rangesfm.batch.course import Course, Status, SurveyRow
from rangesfm.batch.page import render
from rangesfm.ceres.doctor import versions
from rangesfm.files.atomic import write_text
from rangesfm.files.records import write_json
from rangesfm.files.tables import write_table

TABLE_NAME, JSON_NAME, PAGE_NAME = "batch.csv", "batch.json", "batch.html"


def write_results(course: Course, folder: Path) -> None:
    """Write ``batch.csv``, ``batch.json`` and ``batch.html``; while the batch runs the page loads itself anew."""
    rows = course.rows
    cells = [["" if value is None else str(value) for value in row.cells().values()] for row in rows]
    write_table(folder / TABLE_NAME, list(SurveyRow("").cells()), cells)
    summary = {
        **{f"num_{status.value}": course.num(status) for status in Status},
        "seconds": course.seconds,
        "versions": _versions(),
        "surveys": [row.cells() for row in rows],
    }
    write_json(summary, folder / JSON_NAME)
    write_text(render(course, folder), folder / PAGE_NAME)


@cache
def _versions() -> dict[str, str]:
    return versions()
