"""A panel as a Vega-Lite specification: what the page and a paper draw alike."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeAlias

from PIL import Image

from rangesfm.report.plot import Figure, Mark, Panel, Pixels, Range, Series
from rangesfm.report.scene import pack

ASSETS = Path(__file__).with_name("assets")
Spec: TypeAlias = dict[str, Any]
Color: TypeAlias = Callable[[str], str]

MIN_LABEL_DISTANCE_PX = 12.0
ZOOM: Spec = {
    "name": "zoom",
    "bind": "scales",
    # A wheel alone scrolls the page; with a key, or when two fingers pinch, it zooms. A double click goes back.
    "select": {"type": "interval", "zoom": "wheel![event.ctrlKey || event.metaKey]"},
}

_NUM_PICTURE_COLORS = 128
_MAP_DOT_PX, _DOT_PX = 1.6, 2.8
_LABEL: Spec = {"type": "text", "fontSize": 12, "fontWeight": 600, "baseline": "middle"}
_LEFT_OF_ROWS_PX, _RIGHT_OF_ROWS_PX = 64, 74


def page_chart(panel: Panel) -> Spec:
    """What the page's script, assets/view/charts.js, draws a panel from; colours are those of the page's style."""

    def color(name: str) -> str:
        return f"var(--{name})"

    spec = panel_spec(panel, color, lambda i: {"name": f"series{i}"})
    encodings = ["x"] if panel.rows else ["x", "y"]
    spec["layer"][0]["params"] = [ZOOM | {"select": ZOOM["select"] | {"encodings": encodings}}]
    margins: Spec = {"top": 10, "bottom": 38, "left": 64, "right": 14}
    if panel.rows:
        margins |= {"left": _LEFT_OF_ROWS_PX, "right": _RIGHT_OF_ROWS_PX}
    series = [
        {"name": one.name, "kind": one.kind, "is_data": one.is_data, "points": pack(one.points, "float32")}
        for one in panel.series
    ]
    return {
        "spec": spec | {"autosize": "none", "padding": margins, "background": None, "config": config(color)},
        "title": panel.title,
        "labels": [panel.x_label, panel.y_label],
        "keeps_shape": panel.keeps_shape,
        "series": series,
        "marks": [{"title": mark.title, "x": mark.x, "y": mark.y} for mark in panel.marks],
    }


def page_charts(figures: list[Figure]) -> dict[str, list[Spec]]:
    """The charts of figures, by name."""
    return {figure.name: [page_chart(panel) for panel in figure.panels] for figure in figures}


def panel_spec(panel: Panel, color: Color, data_of: Callable[[int], Spec]) -> Spec:
    """One panel.

    Args:
        color: what a name of a colour is called where the panel is drawn.
        data_of: where the rows of the i-th series are, as ``rows_of`` makes them.
    """
    width, height = panel.size
    x_range, y_range = panel.limits
    x = _axis("x", x_range, {"title": panel.x_label, "tickCount": 4 if panel.rows or width < 380 else 6})
    y = _axis("y", y_range, None if panel.rows else {"title": panel.y_label, "tickCount": 5})
    layers = [_layer("point", {"values": []}, x=x, y=y)]
    if panel.picture is not None:
        layers.append(_image(panel.picture, _at(x, *x_range, "x2") | _at(y, *y_range, "y2")))
    layers += [_layer({"type": "rect", "color": color(c)}, **_at(x, low, high, "x2")) for low, high, c in panel.bands]
    if panel.zero_line:
        layers.append(_layer({"type": "rule", "color": color("ink")}, **_at(y, 0.0)))
    layers += [_layer({"type": "rule", "color": color(c), "size": 1.5}, **_at(x, at)) for at, c in panel.verticals]
    for i, series in enumerate(panel.series):
        inside = [_clamped("x", x_range), _clamped("y", y_range)] if series.kind == "dots" else []
        # Points in turn, not from left to right, and none on top of another.
        layer = _layer(
            _mark_of(series, color(series.color)), data_of(i), x=x, y=y | {"stack": None}, order={"value": None}
        )
        layers.append(layer | {"transform": inside})
    layers += _rows(panel, y, color("ink")) + _marks(panel, x, y, color)
    return {"width": width, "height": height, "layer": layers}


def rows_of(series: Series) -> list[dict[str, float]]:
    """Rows of a series' data set; an empty one breaks the line.

    Dots are a line that is broken after each: one path with round ends, where thousands of marks would be slow.
    """
    rows = [{"x": x, "y": y} if math.isfinite(x + y) else {} for x, y in series.points.tolist()]
    return [row for point in rows for row in (point, {})] if series.kind == "dots" else rows


def config(color: Color) -> Spec:
    """What all figures have in common."""
    axis = {
        "domain": False,
        "ticks": False,
        "labelPadding": 5,
        "labelFontSize": 12,
        "titleFontSize": 12,
        "titleFontWeight": "normal",
        "gridColor": color("grid"),
        "labelColor": color("muted"),
        "titleColor": color("muted"),
    }
    return {
        "aria": False,  # the element around a chart describes it
        "font": "sans-serif",
        "view": {"stroke": None},
        "axis": axis,
        "axisY": {"minExtent": 42, "maxExtent": 42},
    }


def _axis(field: str, limits: Range, axis: Spec | None) -> Spec:
    scale = {"domain": list(limits), "nice": False, "zero": False}
    return {"field": field, "type": "quantitative", "scale": scale, "axis": axis}


def _at(axis: Spec, value: float, end: float | None = None, end_channel: str = "") -> Spec:
    """Encodings of a place on one axis, or of a stretch of it."""
    fixed = {name: part for name, part in axis.items() if name != "field"}
    encoding = {axis["field"]: fixed | {"datum": value}}
    return encoding if end is None else encoding | {end_channel: {"datum": end}}


def _layer(mark: Any, data: Spec | None = None, **encoding: Spec) -> Spec:
    """Clipped to the panel, since zooming moves marks out of it."""
    mark = {"type": mark} if isinstance(mark, str) else mark
    return {"data": data or {"values": [{}]}, "mark": {"clip": True} | mark, "encoding": encoding}


def _mark_of(series: Series, color: str) -> Spec:
    if series.kind == "filled":
        return {"type": "area", "color": color, "fillOpacity": 0.16, "line": {"color": color, "strokeWidth": 1.5}}
    if series.kind == "dots":
        is_map = series.color == "map"
        size, opacity = (_MAP_DOT_PX, 1.0) if is_map else (_DOT_PX, 0.5)
        return {"type": "line", "color": color, "strokeWidth": size, "strokeCap": "round", "opacity": opacity}
    dash = {"strokeDash": [4, 3], "strokeWidth": 1.2} if series.kind == "dashed" else {"strokeWidth": 1.8}
    return {"type": "line", "color": color, "strokeJoin": "round", **dash}


def _clamped(field: str, limits: Range) -> Spec:
    """What lies beyond an axis is drawn at its edge."""
    low, high = limits
    return {"calculate": f"isValid(datum.{field}) ? clamp(datum.{field}, {low!r}, {high!r}) : null", "as": field}


def _image(picture: Pixels, encoding: Spec) -> Spec:
    file = io.BytesIO()
    colors = Image.fromarray(picture).quantize(_NUM_PICTURE_COLORS, method=Image.Quantize.FASTOCTREE)
    colors.save(file, "PNG", optimize=True)
    url = "data:image/png;base64," + base64.b64encode(file.getvalue()).decode("ascii")
    return _layer({"type": "image", "url": url, "aspect": False}, **encoding)


def _rows(panel: Panel, y: Spec, color: str) -> list[Spec]:
    """Texts left and right of the heights that they belong to."""
    if not panel.rows:
        return []
    data = {"values": [{"y": at, "left": left, "right": right} for at, left, right in panel.rows]}
    mark = _LABEL | {"clip": False, "color": color}
    left = mark | {"align": "right", "limit": _LEFT_OF_ROWS_PX - 8}
    right = mark | {"align": "left", "limit": _RIGHT_OF_ROWS_PX - 8}
    return [
        _layer(left, data, x={"value": -8}, y=y, text={"field": "left"}),
        _layer(right, data, x={"value": {"expr": "width + 8"}}, y=y, text={"field": "right"}),
    ]


def _marks(panel: Panel, x: Spec, y: Spec, color: Color) -> list[Spec]:
    layers = []
    for shape, its_color in dict.fromkeys((mark.shape, mark.color) for mark in panel.marks):
        values = [{"x": mark.x, "y": mark.y} for mark in panel.marks if mark.shape == shape]
        symbol = {"disc": "circle", "triangle": "triangle-up"}[shape]
        mark = {"type": "point", "shape": symbol, "filled": True, "size": 75, "color": color(its_color), "opacity": 1}
        layers.append(_layer(mark, {"values": values}, x=x, y=y))
    labels = [{"x": mark.x, "y": mark.y, "label": mark.label} for mark in joined_labels(panel) if mark.label]
    if labels:
        mark = _LABEL | {"align": "left", "dx": 8, "color": color("ink")}
        layers.append(_layer(mark, {"values": labels}, x=x, y=y, text={"field": "label"}))
    return layers


def joined_labels(panel: Panel) -> list[Mark]:
    """Marks that fall on one another in a panel share one label."""
    scale = [(high - low) / size for (low, high), size in zip(panel.limits, panel.size)]
    groups: list[list[Mark]] = []
    for mark in panel.marks:
        place = (mark.x / scale[0], mark.y / scale[1])
        for group in groups:
            if math.dist(place, (group[0].x / scale[0], group[0].y / scale[1])) < MIN_LABEL_DISTANCE_PX:
                group.append(mark)
                break
        else:
            groups.append([mark])
    return [replace(group[0], label=", ".join(mark.label for mark in group)) for group in groups]
