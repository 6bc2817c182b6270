"""The report's figures as pictures for a paper, through the optional package matplotlib."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rangesfm.errors import InputError
from rangesfm.files.atomic import make_output_folder, new_file
from rangesfm.report.plot import Figure, Panel, Series

if TYPE_CHECKING:
    from matplotlib.axes import Axes

PIXELS_PER_INCH = 220
_PAGE_PIXELS_PER_INCH = 96
_NUM_COLUMNS = {"single": 1, "views": 2, "panels": 3}
_COLORS = {
    "before": "#c2570c",
    "after": "#1d5fd1",
    "reference": "#17202b",
    "true-scale": "#0f766e",
    "measured": "#7b8794",
    "rejected": "#7b8794",
    "map-point": "#c3ccd6",
    "anchor": "#a21caf",
    "interval": "#dce8fb",
}
_INK = "#17202b"


def write_pictures(figures: list[Figure], folder: Path) -> list[Path]:
    """Write each figure as ``NAME.png`` into a folder; returns their paths.

    Raises:
        InputError: matplotlib is not installed, or the folder cannot be written to.
    """
    if find_spec("matplotlib") is None:
        raise InputError("pictures need the package matplotlib: python -m pip install 'rangesfm[plot]'")
    make_output_folder(folder)
    from matplotlib import rc_context

    with rc_context({"text.parse_math": False}):  # names may hold dollars
        return [_write(figure, folder / f"{figure.name}.png") for figure in figures]


def _write(figure: Figure, path: Path) -> Path:
    from matplotlib.figure import Figure as Sheet

    num_columns = min(_NUM_COLUMNS[figure.layout], len(figure.panels))
    num_rows = -(-len(figure.panels) // num_columns)
    width, height = (size / _PAGE_PIXELS_PER_INCH for size in figure.panels[0].size)
    # Text of the size that papers have, whatever the width on the page.
    sheet = Sheet(figsize=(min(width, 7.2) * num_columns, height * num_rows), layout="constrained")
    grid: Any = sheet.subplots(num_rows, num_columns, squeeze=False)
    for place, axes in enumerate(grid.flat):
        if place < len(figure.panels):
            _draw(figure.panels[place], axes)
        else:
            axes.axis("off")
    labels = {label: handle for axes in grid.flat for handle, label in zip(*axes.get_legend_handles_labels())}
    if len(labels) > 1:
        sheet.legend(
            labels.values(),
            labels.keys(),
            loc="outside upper center",
            ncols=min(len(labels), 6),
            fontsize=8,
            markerscale=4,
        )
    with new_file(path) as temporary:
        sheet.savefig(temporary, format="png", dpi=PIXELS_PER_INCH, metadata={"Software": None})
    return path


def _draw(panel: Panel, axes: Axes) -> None:
    if panel.picture is not None:
        extent = (*panel.picture.x_range, *panel.picture.y_range)
        axes.imshow(panel.picture.pixels, extent=extent, interpolation="nearest", aspect="auto")
    for low, high, style in panel.bands:
        axes.axvspan(low, high, color=_COLORS.get(style, _INK), lw=0)
    if panel.zero_line:
        axes.axhline(0.0, color=_INK, lw=0.6)
    for x, _ in panel.verticals:
        axes.axvline(x, color=_INK, lw=0.8)
    for series in panel.series:
        _draw_series(series, axes)
    for mark in panel.marks:
        is_anchor = mark.shape == "anchor"
        axes.plot(mark.x, mark.y, "^" if is_anchor else "o", ms=5, color=_COLORS["anchor" if is_anchor else "after"])
        axes.annotate(mark.label, (mark.x, mark.y), xytext=(4, 3), textcoords="offset points", fontsize=7)
    if panel.rows:
        axes.set_yticks([y for y, _, _ in panel.rows], [left for _, left, _ in panel.rows])
    _frame(panel, axes)


def _draw_series(series: Series, axes: Axes) -> None:
    x, y = series.points.T
    color = _COLORS.get(series.style, _INK)
    label = series.name if series.is_data or series.style == "map-point" else None
    if series.kind == "dots":
        # Thousands of dots are faint, a dozen are not.
        axes.plot(x, y, ".", ms=1.5, alpha=0.5 if len(x) > 100 else 1.0, color=color, label=label)
    elif series.kind == "line":
        axes.plot(x, y, "--" if series.style == "reference" else "-", lw=1.0, color=color, label=label)
    else:
        axes.plot(x, y, lw=1.0, color=color, label=label)
        axes.fill_between(x, y, color=color, alpha=0.15, lw=0)


def _frame(panel: Panel, axes: Axes) -> None:
    if panel.title:
        axes.set_title(panel.title, fontsize=9)
    axes.set_xlabel(panel.x_label, fontsize=8)
    axes.set_ylabel(panel.y_label, fontsize=8)
    axes.tick_params(labelsize=7)
    axes.grid(alpha=0.3, lw=0.5)
    if panel.is_equal:
        axes.set_aspect("equal", adjustable="datalim")
        return
    if panel.picture is not None:
        axes.set_aspect("equal")
    x_range, y_range = panel.limits
    axes.set_xlim(*x_range)
    axes.set_ylim(*y_range)
