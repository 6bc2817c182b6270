"""Page of a batch: one self-contained HTML file in the report's style."""

from __future__ import annotations

import os
from pathlib import Path
from urllib.parse import quote

from markupsafe import Markup

from rangesfm.batch.batch_state import BatchState, SurveyRow
from rangesfm.report import report_page
from rangesfm.report.report_tables import ReportTable
from rangesfm.report.text import count, decimals_for, duration, fixed, plain
from rangesfm.result.result_folder import REPORT_NAME
from rangesfm.util.geometry.numerics import NORMAL_95

BATCH_RELOAD_S = 5
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
    "Scale: metres per unit of the unscaled model, ± half of its 95 % interval. RMSE: error of the keyframe centres "
    "against a reference, without any alignment in a site, and aligned by the first pose elsewhere. "
    "Attempts: more than one where a worker was killed."
)


def render_batch(batch_state: BatchState, folder: Path) -> str:
    """Return the page as HTML; while the batch runs the page reloads itself.

    Args:
        folder: folder of the page, to which its links are relative.
    """
    heading = f"{len(batch_state.rows)} surveys"
    return report_page.render_page(
        "batch.html",
        title=f"{heading} – rangesfm batch",
        heading=heading,
        reload=None if batch_state.is_over else BATCH_RELOAD_S,
        tiles=_tiles(batch_state),
        table=ReportTable("Results", _HEADER, [_row(row, folder) for row in batch_state.rows], _NOTE),
        reasons=[(_light(row), row) for row in batch_state.rows if row.reason],
    )


def _tiles(batch_state: BatchState) -> list[tuple[str, str, str]]:
    seconds = sum(row.seconds or 0.0 for row in batch_state.rows)
    num_left = len(batch_state.rows) - batch_state.num("done") - batch_state.num("failed")
    return [
        ("Done", count(batch_state.num("done")), f"of {count(len(batch_state.rows))}"),
        ("Failed", count(batch_state.num("failed")), "reasons below"),
        ("Not done", count(num_left), "waiting, running or interrupted"),
        ("Time taken", duration(batch_state.seconds), f"sum of all surveys {duration(seconds)}"),
    ]


def _row(row: SurveyRow, folder: Path) -> list[str]:
    figures = row.figures
    within = None if figures["scale_stddev"] is None else NORMAL_95 * figures["scale_stddev"]
    decimals = decimals_for(within, default=5)
    scale = fixed(figures["scale"], decimals)
    return [
        _name(row, folder),
        Markup("{} {}").format(report_page.light(_light(row)), figures["verdict"] or row.status),
        scale if within is None else f"{scale} ± {fixed(within, decimals)}",
        count(figures["num_photos"]),
        f"{count(figures['num_ranges_used'])} of {count(figures['num_ranges'])}"
        if figures["num_ranges"] is not None
        else plain(None),
        fixed(figures["range_rms_m"], 3, "m"),
        fixed(figures["reprojection_rms_px"], 2, "px"),
        fixed(figures["rmse_m"], 3, "m"),
        count(figures["num_warnings"]),
        count(row.num_attempts),
        duration(row.seconds),
    ]


def _name(row: SurveyRow, folder: Path) -> str:
    """Return the survey's name, with a link to its report if there is one."""
    report = Path(row.output_path) / REPORT_NAME
    if row.status != "done" or not report.is_file():
        return row.survey
    address = quote(Path(os.path.relpath(report, folder)).as_posix())
    return Markup('<a href="{}">{}</a>').format(address, row.survey)


def _light(row: SurveyRow) -> str:
    if row.status == "done":
        return "green" if row.figures["verdict"] == "good" else "amber"
    return "red" if row.status == "failed" else "off"
