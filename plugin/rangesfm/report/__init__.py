"""A result folder as one self-contained HTML page."""

from __future__ import annotations

from pathlib import Path

from rangesfm.files.atomic import sole_writer
from rangesfm.report.chart import write_pictures
from rangesfm.report.content import Content
from rangesfm.report.page import render_report, sections_of, write_page
from rangesfm.result.folder import REPORT_NAME, read_result_folder

__all__ = ["write_report", "write_report_of", "write_report_pictures"]


def write_report(result_folder: Path, *, images_path: Path | None = None) -> Path:
    """Write ``report.html`` into a run's output folder.

    The page shows what the folder holds: ``result.json`` must be there; ``ranges.csv``,
    ``images.csv``, ``reference.csv`` (in the map's frame) and the models may be.

    Args:
        images_path: folder of the photos, for thumbnails; None: those of the run, if they are beside the result.

    Returns:
        The page's path.

    Raises:
        InputError: the folder is not a result, a file in it cannot be read, or a run is writing there.
    """
    with sole_writer(result_folder):
        return write_report_of(Content(read_result_folder(result_folder), images_path=images_path), result_folder)


def write_report_of(content: Content, folder: Path) -> Path:
    """Write ``report.html`` into a folder; returns the page's path."""
    path = folder / REPORT_NAME
    write_page(render_report(content), path)
    return path


def write_report_pictures(result_folder: Path) -> list[Path]:
    """Write the report's figures as PNG and SVG files into ``figures`` in a run's output folder; returns their paths.

    Raises:
        InputError: as ``write_report``.
    """
    with sole_writer(result_folder):
        result = read_result_folder(result_folder)
        figures = [figure for section in sections_of(Content(result)) for figure in section.figures]
        return write_pictures(figures, result_folder / "figures")
