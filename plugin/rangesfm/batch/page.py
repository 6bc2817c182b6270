"""A batch as one self-contained page, in the report's style."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from rangesfm.batch.course import Course, Status, SurveyState
from rangesfm.report import page
from rangesfm.report.tables import Table
from rangesfm.report.text import count, decimals_for, duration, fixed, plain

RELOAD_S = 5
_REPORT_NAME = "report.html"
_HEADER = (
    "survey",
    "",
    "scale",
    "photos",
    "ranges used",
    "range RMS",
    "reprojection RMS",
    "RMSE",
    "warnings",
    "attempts",
    "time",
)
_NOTE = (
    "Scale: metres per unit of the unscaled model, with the larger of its standard deviations. RMSE: of the keyframe "
    "centres against a reference, without any alignment. Attempts: more than one where a worker was killed."
)


def render(course: Course, folder: Path) -> str:
    """The page; it loads itself anew while the batch runs.

    Args:
        folder: where the page will be, from which its links start.
    """
    heading = f"{len(course.states)} surveys"
    return page.render(
        "batch.html",
        title=f"{heading} – rangesfm batch",
        heading=heading,
        reload=None if course.is_over else RELOAD_S,
        tiles=_tiles(course),
        table=Table("What each found", _HEADER, [_row(state, folder) for state in course.states], _NOTE),
        reasons=[(_light(state), state.row) for state in course.states if state.row.reason],
    )


def _tiles(course: Course) -> list[tuple[str, str, str]]:
    seconds = sum(row.seconds or 0.0 for row in course.rows)
    num_left = len(course.states) - course.num(Status.DONE) - course.num(Status.FAILED)
    return [
        ("Done", count(course.num(Status.DONE)), f"of {count(len(course.states))}"),
        ("Failed", count(course.num(Status.FAILED)), "see below why"),
        ("Not done", count(num_left), "or not yet"),
        ("Time taken", duration(course.seconds), f"of all surveys {duration(seconds)}"),
    ]


def _row(state: SurveyState, folder: Path) -> list[str]:
    row, found = state.row, state.row.figures
    decimals = decimals_for(found.scale_stddev, default=5)
    scale = fixed(found.scale, decimals)
    return [
        _name(state, folder),
        Markup("{} {}").format(page.light(_light(state)), found.verdict or row.status.value),
        scale if found.scale_stddev is None else f"{scale} ± {fixed(found.scale_stddev, decimals)}",
        count(found.num_photos),
        f"{count(found.num_ranges_used)} of {count(found.num_ranges)}" if found.num_ranges is not None else plain(None),
        fixed(found.range_rms_m, 3, "m"),
        fixed(found.reprojection_rms_px, 2, "px"),
        fixed(found.rmse_m, 3, "m"),
        count(found.num_warnings),
        count(row.num_attempts),
        duration(row.seconds),
    ]


def _name(state: SurveyState, folder: Path) -> str:
    """With a link to the survey's report, where it has one."""
    report = Path(state.row.output_path) / _REPORT_NAME
    if state.row.status is not Status.DONE or not report.is_file():
        return state.row.survey
    address = quote(Path(os.path.relpath(report, folder)).as_posix())
    return Markup('<a href="{}">{}</a>').format(address, state.row.survey)


def _light(state: SurveyState) -> str:
    if state.row.status is Status.DONE:
        return "green" if state.row.figures.verdict == "good" else "amber"
    return "red" if state.row.status is Status.FAILED else "off"
