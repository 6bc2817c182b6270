"""Figures as Vega-Lite specifications, from which the page draws its charts and picture files are made."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeAlias

import numpy as np
from PIL import Image

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.report.packing import pack
from rangesfm.report.plot import Figure, Mark, Panel, Range, Series
from rangesfm.report.scene import data_uri
from rangesfm.util.files.atomic import new_file
from rangesfm.util.files.output_folder import make_output_folder
from rangesfm.util.processes.draw_pictures import draw_pictures

ASSETS = Path(__file__).with_name("assets")
Spec: TypeAlias = dict[str, Any]

MIN_LABEL_DISTANCE_PX = 12.0
ZOOM: Spec = {
    "name": "zoom",
    "bind": "scales",
    # The wheel alone scrolls the page. It zooms while a key is held, and so do two fingers. A double click resets.
    "select": {"type": "interval", "zoom": "wheel![event.ctrlKey || event.metaKey]"},
}

MAX_WIDTH_PX = 660.0  # of a panel in a picture file, with which text has the size that is usual in papers
FORMATS = ("png", "svg")
_NUM_COLUMNS = {"single": 1, "views": 2, "panels": 3}
_SYMBOLS = {"dots": "circle", "disc": "circle", "triangle": "triangle-up"}

_NUM_PICTURE_COLORS = 128
_FAR = 2.0  # data further from zero than this many times their own extent are stored relative to an origin
_MAP_DOT_PX, _DOT_PX = 1.6, 2.8
# Smallest room left and right of rows, and the width of a letter of their labels.
_LEFT_OF_ROWS_PX, _RIGHT_OF_ROWS_PX, _LETTER_PX = 64, 74, 6.8


def css(color: str) -> str:
    """Return a colour as CSS: a variable of the page's style for a name, "#rrggbb" unchanged."""
    return color if color.startswith("#") else f"var(--{color})"


_LABEL: Spec = {"fontSize": 12, "fontWeight": 600, "baseline": "middle", "color": css("ink")}
# Configuration of all figures.
CONFIG: Spec = {
    "aria": False,  # the element around a chart describes it
    "font": "sans-serif",
    "view": {"stroke": None},
    "axis": {
        "domain": False,
        "ticks": False,
        "labelPadding": 5,
        "labelFontSize": 12,
        "titleFontSize": 12,
        "titleFontWeight": "normal",
        "gridColor": css("grid"),
        "labelColor": css("muted"),
        "titleColor": css("muted"),
    },
    "axisY": {"minExtent": 42, "maxExtent": 42},
}


def page_chart(panel: Panel) -> Spec:
    """Return the data from which the script of the page, assets/view/charts.js, draws a panel."""
    spec = panel_spec(panel, lambda i: {"name": f"series{i}"})
    encodings = ["x"] if panel.rows else ["x", "y"]
    spec["layer"][0]["params"] = [ZOOM | {"select": ZOOM["select"] | {"encodings": encodings}}]
    left, right = _beside_rows(panel) if panel.rows else (64, 14)
    padding = {"top": 10, "bottom": 38, "left": left, "right": right}
    return {
        "spec": spec | {"autosize": "none", "padding": padding, "background": None, "config": CONFIG},
        "title": panel.title,
        "labels": panel.labels,
        "keeps_shape": panel.keeps_shape,
        "series": [{"name": one.name, "is_data": one.is_data, **_packed(drawn_points(one))} for one in panel.series],
        "marks": [{"name": mark.title, "x": mark.x, "y": mark.y} for mark in panel.marks],
    }


def _packed(points: Array) -> Spec:
    """Return points (n, 2) as 32-bit numbers and their origin.

    The origin is near the points where these are far from zero, as coordinates of a national grid are: 32 bits would
    round such numbers.
    """
    known = points[np.isfinite(points).all(axis=1)]
    low, high = (known.min(axis=0), known.max(axis=0)) if len(known) else np.zeros((2, 2))
    is_far = np.abs(low + high) / 2 > _FAR * (high - low)
    origin = np.where(is_far, np.round((low + high) / 2), 0.0)
    return {"origin": origin.tolist(), "points": pack(points - origin, "float32")}


def drawn_points(series: Series) -> Array:
    """Return the points to draw, (n, 2). Unknown points break a line, and are left out of dots."""
    is_known = np.isfinite(series.points).all(axis=1)
    return series.points[is_known] if series.kind == "dots" else series.points


def panel_spec(panel: Panel, data_of: Callable[[int], Spec]) -> Spec:
    """Return the Vega-Lite specification of one panel.

    Args:
        panel: to draw.
        data_of: returns the Vega-Lite data source of the i-th series, with rows of x and y; y is null or NaN where a
            line is broken.
    """
    width, height = panel.size
    x_range, y_range = panel.limits
    x_label, y_label = panel.labels
    x_axis = {"title": x_label, "tickCount": 3 if panel.rows else 4 if width < 380 else 6}
    y_axis = {} if panel.rows else {"title": y_label, "tickCount": 5}
    return {
        "width": width,
        "height": height,
        "encoding": {
            "x": _axis("x", x_range, x_axis),
            "y": _axis("y", y_range, y_axis),
            "order": {"value": None},  # a line joins points in the given order, not from left to right
        },
        "layer": [
            _layer("point", []),  # an empty layer that carries the zoom of the page
            *_background(panel, x_range, y_range),
            *(_series(one, data_of(i), y_range) for i, one in enumerate(panel.series)),
            *_labels(panel),
        ],
    }


def _axis(field: str, limits: Range, axis: Spec) -> Spec:
    scale = {"domain": list(limits), "nice": False, "zero": False}
    return {"field": field, "type": "quantitative", "scale": scale, "axis": axis or None, "stack": None}


def _layer(kind: str, rows: list[Spec], encoding: Mapping[str, Any] = MappingProxyType({}), **mark: Any) -> Spec:
    """Return a layer of a panel.

    It is clipped to the panel, because zooming moves marks out of it. The encoding of x and y is that of the panel.
    """
    return {"data": {"values": rows}, "mark": {"type": kind, "clip": True, **mark}, "encoding": {**encoding}}


def _background(panel: Panel, x_range: Range, y_range: Range) -> list[Spec]:
    layers = []
    to_x2: Spec = {"x2": {"field": "x2"}}
    if panel.picture.size:
        corners = dict(zip(("x", "x2", "y", "y2"), (*x_range, *y_range)))
        encoding = to_x2 | {"y2": {"field": "y2"}}
        colors = Image.fromarray(panel.picture).quantize(_NUM_PICTURE_COLORS, method=Image.Quantize.FASTOCTREE)
        layers.append(_layer("image", [corners], encoding, url=data_uri(colors, "PNG"), aspect=False))
    for _, low, high in panel.bands:
        layers.append(_layer("rect", [{"x": low, "x2": high}], to_x2 | {"y": None}, color=css("interval")))
    if panel.zero_line:
        layers.append(_layer("rule", [{"y": 0.0}], {"x": None}, color=css("ink")))
    for _, x in panel.lines:
        layers.append(_layer("rule", [{"x": x}], {"y": None}, color=css("ink"), size=1.5))
    return layers


def _series(series: Series, data: Spec, y_range: Range) -> Spec:
    color = css(series.color)
    if series.kind == "filled":
        outline = {"color": color, "strokeWidth": 1.5}
        return _layer("area", [], color=color, fillOpacity=0.16, line=outline) | {"data": data}
    if series.kind == "dots":
        size, opacity = (_MAP_DOT_PX, 1.0) if series.color == "map" else (_DOT_PX, 0.5)
        dots = _layer("line", [], color=color, strokeWidth=size, strokeCap="round", opacity=opacity)
        # Values beyond the axis are drawn at its edge. Dots are drawn as one line with round ends that is broken after
        # each dot, because thousands of separate marks would be slow.
        broken = f"[clamp(datum.y, {y_range[0]!r}, {y_range[1]!r}), null]"
        return dots | {"data": data, "transform": [{"calculate": broken, "as": "y"}, {"flatten": ["y"]}]}
    how: Spec = {"strokeDash": [4, 3], "strokeWidth": 1.2} if series.kind == "dashed" else {"strokeWidth": 1.8}
    return _layer("line", [], color=color, strokeJoin="round", **how) | {"data": data}


def _beside_rows(panel: Panel) -> tuple[int, int]:
    """Return the room that the labels of rows need to the left and to the right, in pixels."""
    left, right = (max(map(len, texts)) for texts in list(zip(*panel.rows))[1:])
    return (
        max(_LEFT_OF_ROWS_PX, round(_LETTER_PX * left) + 16),
        max(_RIGHT_OF_ROWS_PX, round(_LETTER_PX * right) + 16),
    )


def _labels(panel: Panel) -> list[Spec]:
    """Return layers with the labels of rows, the marks, and the labels of the marks."""
    layers = []
    if panel.rows:
        rows = [{"y": at, "left": left, "right": right} for at, left, right in panel.rows]
        of_left, of_right = _beside_rows(panel)
        # The right end is "width", because an expression has no width in a picture of several panels.
        left, right = (0, -8, "right", of_left), ("width", 8, "left", of_right)
        for side, (x, dx, align, limit) in {"left": left, "right": right}.items():
            how = _LABEL | {"clip": False, "align": align, "dx": dx, "limit": limit - 8}
            layers.append(_layer("text", rows, {"x": {"value": x}, "text": {"field": side}}, **how))
    marks = [{"x": m.x, "y": m.y, "shape": _SYMBOLS[m.shape], "color": css(m.color)} for m in panel.marks]
    if marks:
        as_it_is = {name: {"field": name, "type": "nominal", "scale": None} for name in ("shape", "color")}
        layers.append(_layer("point", marks, as_it_is, filled=True, size=75, opacity=1))
    labels = [{"x": mark.x, "y": mark.y, "label": mark.label} for mark in joined_labels(panel) if mark.label]
    if labels:
        layers.append(_layer("text", labels, {"text": {"field": "label"}}, **_LABEL, align="left", dx=8))
    return layers


def joined_labels(panel: Panel) -> list[Mark]:
    """Return marks for labelling: of marks less than 12 pixels apart only the rightmost, with all their labels."""
    scale = [(high - low) / size for (low, high), size in zip(panel.limits, panel.size)]
    groups: list[list[Mark]] = []
    for mark in panel.marks:
        for group in groups:
            if math.hypot((mark.x - group[0].x) / scale[0], (mark.y - group[0].y) / scale[1]) < MIN_LABEL_DISTANCE_PX:
                group.append(mark)
                break
        else:
            groups.append([mark])
    # The label stands to the right of its mark, where no other mark of its group is.
    rightmost = [max(group, key=lambda mark: mark.x / scale[0]) for group in groups]
    return [
        mark._replace(label=", ".join(one.label for one in group))
        for mark, group in zip(rightmost, groups, strict=True)
    ]


def write_pictures(figures: list[Figure], folder: Path) -> list[Path]:
    """Write each figure as ``NAME.png`` and ``NAME.svg`` into a folder and return the paths.

    Raises:
        InputError: the folder cannot be written to.
        SolverError: the engine that draws them failed.
    """
    drawings = {f"{figure.name}.{format}": (figure_spec(figure), format) for figure in figures for format in FORMATS}
    contents = draw_pictures([*drawings.values()])
    make_output_folder(folder)
    paths = [folder / name for name in drawings]
    for path, content in zip(paths, contents, strict=True):
        _write_picture_file(content, path)
    return paths


def write_picture(figure: Figure, path: Path) -> None:
    """Write a figure as PNG or SVG, according to the ending of the file name.

    Raises:
        InputError: the file cannot be written, or its ending is not one of ``FORMATS``.
        SolverError: the engine that draws it failed.
    """
    format = path.suffix[1:].lower()
    if format not in FORMATS:
        raise InputError(f"no figure format is named '{format}', expected one of {', '.join(FORMATS)}", path)
    (content,) = draw_pictures([(figure_spec(figure), format)])
    _write_picture_file(content, path)


def _write_picture_file(content: bytes, path: Path) -> None:
    try:
        with new_file(path) as temporary:
            temporary.write_bytes(content)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", path) from error


def figure_spec(figure: Figure) -> Spec:
    """Return the specification of a whole figure: its panels and its legend, in the light colours of the page."""

    def sheet(panel: Panel) -> Spec:
        panel = replace(panel, size=(min(panel.size[0], MAX_WIDTH_PX), panel.size[1]))
        points = [drawn_points(one).tolist() for one in panel.series]
        rows = [[{"x": x, "y": y if math.isfinite(y) else None} for x, y in of_one] for of_one in points]
        return panel_spec(panel, lambda i: {"values": rows[i]}) | {"title": panel.title}

    panels = [sheet(panel) for panel in figure.panels]
    if len(figure.entries) > 1:
        panels[0]["layer"].append(_legend(figure.entries))
    columns = min(_NUM_COLUMNS[figure.layout], len(panels))
    spec = {"background": "white", "padding": 8, "config": CONFIG, "concat": panels, "columns": columns}
    colors = light_colors()
    return dict(json.loads(re.sub(r"var\(--([\w-]+)\)", lambda found: colors[found[1]], json.dumps(spec))))


def light_colors() -> dict[str, str]:
    """Return the colours of the page's light theme, "#rrggbb" by name."""
    light, _ = re.findall(r":root \{(.*?)\}", (ASSETS / "page.css").read_text(encoding="utf-8"), flags=re.DOTALL)
    return dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", light))


def _legend(entries: dict[str, tuple[str, str]]) -> Spec:
    """Return an invisible layer that makes Vega-Lite draw the legend."""
    texts = list(entries)
    legend = {"title": None, "orient": "top", "columns": 6, "symbolOpacity": 1}
    ranges = {
        "color": [css(color) for color, _ in entries.values()],
        "shape": [_SYMBOLS.get(shape, "square") for _, shape in entries.values()],
    }
    encoding: Spec = {
        channel: {"field": "text", "scale": {"domain": texts, "range": values}, "legend": legend}
        for channel, values in ranges.items()
    }
    data = {"values": [{"text": text} for text in texts]}
    nowhere = {"x": None, "y": None}
    return {"data": data, "mark": {"type": "point", "filled": True, "opacity": 0}, "encoding": encoding | nowhere}
