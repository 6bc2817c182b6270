"""A comparison of models as one self-contained page, in the style of the report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from rangesfm.comparison.many_models import ModelsComparison, NamedModel
from rangesfm.export.metric_map import colored_points
from rangesfm.report.plot import WIDE_SIZE, Figure, Series, equal_view, figure_of, from_zero, views_of
from rangesfm.report.report_page import Section, render_page, write_page
from rangesfm.report.scene import ScenePath, view_of
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.trajectory import Trajectory

COLORS = ("after", "before", "third", "fourth")


def write_comparison(comparison: ModelsComparison, folder: Path) -> Path:
    """Write ``comparison.html`` into a folder and return its path.

    All models are drawn after the best similarity to the first model, in the unit of the first model.

    Raises:
        InputError: the folder cannot be written to, or a run is writing there.
    """
    base, path = comparison.rows[0].model, folder / "comparison.html"
    aligned = [row.aligned for row in comparison.rows]
    title = f"{len(aligned)} models of {len(base.path)} photos"
    frame = base.frame or "first_camera"
    similarity, *lengths, truth = comparison.tables
    figures = [*_moved_figure(comparison), _path_figure(comparison, aligned, frame)]
    with sole_writer(folder):
        page = render_page(
            "comparison.html",
            title=f"{title} – rangesfm comparison",
            heading=title,
            view=_view(comparison, aligned, frame),
            sections=[
                Section("models", "Models", tables=[similarity]),
                Section("truth", "Reference", tables=[truth]),
                Section("moved-section", "Differences of the cameras", figures),
                Section("distances", "Distances", tables=lengths),
            ],
        )
        write_page(page, path)
    return path


def _color(index: int) -> str:
    return COLORS[index % len(COLORS)]


def _unit(base: NamedModel) -> str:
    return "SfM units" if base.frame is None else "m"


def _view(comparison: ModelsComparison, aligned: list[Trajectory], frame: str) -> dict[str, Any]:
    """Return the data of the view of a map and all paths. The first model's is last: on that, cameras are chosen."""
    models = [row.model for row in comparison.rows]
    base, mapped = models[0], next(row for row in comparison.rows if row.model.model.num_images())
    points_m, points_rgb = colored_points(mapped.model.model)
    points_m = points_m if mapped.base_from_model is None else mapped.base_from_model.apply(points_m)
    paths = [
        ScenePath(f"model-{i}", model.name, _color(i), path, has_orientations=model.model.num_images() > 0)
        for i, (model, path) in enumerate(zip(models, aligned))
    ]
    return view_of(
        frame,
        [*paths[1:], paths[0]],
        points_m,
        points_rgb,
        np.zeros(0, dtype=np.int64),
        anchors={} if base.result is None else base.result.summary.anchors,
        unit=_unit(base),
    )


def _moved_figure(comparison: ModelsComparison) -> list[Figure]:
    """Return the figure of each camera's distance from its position in the first model; empty without any."""
    base = comparison.rows[0].model
    number = {name: i for i, name in enumerate(base.path.image_names)}
    series = []
    for i, row in enumerate(comparison.rows[1:], start=1):
        if np.isfinite(row.moved_aligned).all():
            points = np.column_stack([[number[name] + 1 for name in row.common_names], row.moved_aligned])
            series.append(Series(row.model.name, _color(i), points, "line"))
    if not series:
        return []
    moved = figure_of(
        "moved",
        "Distance of each camera from its position in the first model, after the best similarity, in the unit of the "
        "first model.",
        "Distance of each camera from its position in the first model",
        ("photo", f"moved, {_unit(base)}"),
        series,
        y_range=from_zero(series),
        size=WIDE_SIZE,
    )
    return [moved]


def _path_figure(comparison: ModelsComparison, aligned: list[Trajectory], frame: str) -> Figure:
    panels = []
    base = comparison.rows[0].model
    for view in views_of(base.path.centers, frame):
        lines = [
            Series(row.model.name, _color(i), view.seen(path.centers), "line")
            for i, (row, path) in enumerate(zip(comparison.rows, aligned))
        ]
        limits = equal_view(np.concatenate([line.points for line in lines]))
        panels.append(view.panel("all paths", f" {_unit(base)}", lines, limits))
    caption = "All paths after the best similarity to the first, in the frame and the unit of the first model."
    return Figure("paths", caption, tuple(panels), layout="views")
