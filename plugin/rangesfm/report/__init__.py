"""A result folder as one self-contained HTML page."""

from __future__ import annotations

from pathlib import Path

from rangesfm.files import new_file
from rangesfm.report.content import gather
from rangesfm.report.page import render
from rangesfm.result_folder import read_result_folder

__all__ = ["write_report"]


def write_report(result_folder: Path) -> Path:
    """Write ``report.html`` into a run's output folder.

    The page shows what the folder holds: ``result.json`` must be there; ``ranges.csv``,
    ``images.csv``, ``reference.csv`` (in the map's frame) and the models may be.

    Returns:
        The page's path.

    Raises:
        InputError: the folder is not a result, or a file in it cannot be read.
    """
    page = render(gather(read_result_folder(result_folder)))
    path = result_folder / "report.html"
    with new_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path
