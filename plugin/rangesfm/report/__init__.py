"""The report: a result folder as one self-contained HTML page, and its figures as files."""

from __future__ import annotations

from pathlib import Path

from rangesfm.report.chart import write_pictures
from rangesfm.report.content import Content
from rangesfm.report.report_page import render_report, sections_of, write_page
from rangesfm.result.result_folder import REPORT_NAME, read_result_folder
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.output_folder import sole_writer

__all__ = ["write_report", "write_report_of", "write_report_pictures"]


def write_report(result_folder: AnyPath, *, images_path: AnyPath | None = None, title: str = "", by: str = "") -> Path:
    """Write ``report.html`` into the output folder of a run.

    Args:
        result_folder: must hold ``result.json``. ``ranges.csv``, ``images.csv``, ``reference.csv`` (in the frame of the
            map) and the models are shown where they are there.
        images_path: folder of the photos, for thumbnails; None: that of the run, if it is beside the result folder.
        title, by: title of the page, and who made the survey; empty: those that the run was given.

    Returns:
        Path of the page.

    Raises:
        InputError: the folder is not a result, a file in it cannot be read, or a run is writing there.
    """
    folder, images = Path(result_folder), None if images_path is None else Path(images_path)
    with sole_writer(folder):
        return write_report_of(Content(read_result_folder(folder), images_path=images, title=title, by=by), folder)


def write_report_of(content: Content, folder: Path) -> Path:
    """Write ``report.html`` into a folder and return the path of the page."""
    path = folder / REPORT_NAME
    write_page(render_report(content), path)
    return path


def write_report_pictures(result_folder: AnyPath) -> list[Path]:
    """Write the report's figures as PNG and SVG files into the subfolder ``figures`` of a result folder.

    Returns:
        Paths of the files.

    Raises:
        InputError: as in ``write_report``.
    """
    folder = Path(result_folder)
    with sole_writer(folder):
        result = read_result_folder(folder)
        figures = [figure for section in sections_of(Content(result)) for figure in section.figures]
        return write_pictures(figures, folder / "figures")
