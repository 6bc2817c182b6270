"""Figures on the page: SVG, legend, caption, and their data to download."""

from __future__ import annotations

import base64
import io
from urllib.parse import quote

import numpy as np
from PIL import Image

from rangesfm.report.markup import Markup, element
from rangesfm.report.plot import WIDE_SIZE, Figure, Mark, Panel, Picture, Series, csv_text
from rangesfm.report.svg import Chart, equal_chart, legend

MIN_LABEL_DISTANCE_PX = 12.0
_LEFT, _LEFT_OF_ROWS, _RIGHT_OF_ROWS = 58, 64, 74
_NUM_COLORS = 128
_SAFE_IN_DATA = "-._~,;:+*/()'"


def draw(figure: Figure) -> Markup:
    """The whole figure."""
    panels = [_with_title(panel) for panel in figure.panels]
    body = panels if figure.layout == "single" else [element("div", panels, class_=figure.layout)]
    caption = element("figcaption", figure.caption, " ", _download(figure))
    return element("figure", legend(figure.entries) if figure.entries else None, body, caption, id=figure.name)


def _download(figure: Figure) -> Markup:
    file = f"{figure.name}.csv"
    label = f"Data of this figure as {file}"
    if figure.table is not None:
        attributes = {"data_csv": figure.table, "data_file": file}
        return element("button", "CSV", type="button", class_="csv", aria_label=label, **attributes)
    href = "data:text/csv;charset=utf-8," + quote(csv_text(figure), safe=_SAFE_IN_DATA)
    return element("a", "CSV", href=href, download=file, class_="button csv", aria_label=label)


def _with_title(panel: Panel) -> Markup:
    picture = draw_panel(panel)
    if panel.size[0] >= WIDE_SIZE[0]:
        picture = element(
            "div", picture, class_="scroll wide", tabindex="0", role="group", aria_label=panel.description
        )
    return element("div", element("h3", panel.title), picture) if panel.title else picture


def draw_panel(panel: Panel) -> Markup:
    """One panel as SVG."""
    chart = _chart(panel)
    if panel.picture is not None:
        chart.add(_image(chart, panel.picture))
    for low, high, style in panel.bands:
        chart.band(low, high, style)
    chart.axes(panel.x_label, panel.y_label, num_x_ticks=_num_ticks(panel), num_y_ticks=0 if panel.rows else 5)
    if panel.zero_line:
        chart.horizontal(0.0, "zero")
    for x, style in panel.verticals:
        chart.vertical(x, style)
    for series in panel.series:
        _draw_series(chart, series)
    for y, left, right in panel.rows:
        chart.label(chart.x_range[0], y, left, dx=-8, dy=4, anchor="end")
        chart.label(chart.x_range[1], y, right, dx=8, dy=4)
    for mark in joined(panel.marks, chart):
        _draw_mark(chart, mark)
    return chart.render(panel.description)


def _draw_series(chart: Chart, series: Series) -> None:
    if series.kind == "dots":
        chart.dots(series.points, series.style)
    elif series.kind == "line":
        chart.line(series.points, series.style)
    else:
        ends = series.points[[0, -1]] * (1.0, 0.0)
        chart.line(np.concatenate([ends[:1], series.points, ends[1:]]), f"{series.style} filled")


def _chart(panel: Panel) -> Chart:
    width, height = panel.size
    if panel.is_equal:
        return equal_chart(panel.all_points, width, max_height=height)
    x_range, y_range = panel.limits
    if panel.rows:
        return Chart(width, height, x_range, y_range, left=_LEFT_OF_ROWS, right=_RIGHT_OF_ROWS)
    return Chart(width, height, x_range, y_range, left=_LEFT)


def _num_ticks(panel: Panel) -> int:
    return 4 if panel.rows else 5 if panel.size[0] < 400 else 6


def _draw_mark(chart: Chart, mark: Mark) -> None:
    if mark.shape == "anchor":
        chart.marker(mark.x, mark.y, "anchor-mark", mark.title)
        chart.label(mark.x, mark.y, mark.label, dx=8, dy=4)
    else:
        chart.disc(mark.x, mark.y, "after-fill", mark.title)


def joined(marks: tuple[Mark, ...], chart: Chart) -> list[Mark]:
    """Marks that fall on one another share one label."""
    groups: list[list[Mark]] = []
    for mark in marks:
        place = (mark.x, mark.y)
        near = (
            group
            for group in groups
            if mark.label and chart.pixels_between(place, (group[0].x, group[0].y)) < MIN_LABEL_DISTANCE_PX
        )
        group = next(near, None)
        if group is None:
            groups.append([mark])
        else:
            group.append(mark)
    return [
        Mark(
            group[0].name,
            group[0].x,
            group[0].y,
            group[0].shape,
            ", ".join(mark.label for mark in group),
            ", ".join(mark.title for mark in group),
        )
        for group in groups
    ]


def _image(chart: Chart, picture: Picture) -> Markup:
    file = io.BytesIO()
    Image.fromarray(picture.pixels).quantize(_NUM_COLORS, method=Image.Quantize.FASTOCTREE).save(
        file, "PNG", optimize=True
    )
    x, right = chart.x(picture.x_range).tolist()
    bottom, y = chart.y(picture.y_range).tolist()
    href = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii")
    return element("image", href=href, x=x, y=y, width=right - x, height=bottom - y, preserveAspectRatio="none")
