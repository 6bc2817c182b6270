"""Figures as pictures for a paper, from the definitions that the page draws."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.files.atomic import make_output_folder, new_file
from rangesfm.report.chart import ASSETS, CONFIG, Spec, css, panel_spec, points_of
from rangesfm.report.plot import Figure, LegendEntry, Panel, Series

PNG_SCALE = 2.5
MAX_WIDTH_PX = 660.0
"""Of a panel: text is to have the size that papers have."""

FORMATS = ("png", "svg")
_NUM_COLUMNS = {"single": 1, "views": 2, "panels": 3}
_SYMBOLS = {"dots": "circle", "disc": "circle", "triangle": "triangle-up"}


def write_pictures(figures: list[Figure], folder: Path) -> list[Path]:
    """Write each figure as ``NAME.png`` and ``NAME.svg`` into a folder; returns their paths.

    Raises:
        InputError: the folder cannot be written to.
    """
    make_output_folder(folder)
    paths = []
    for figure in figures:
        for format in FORMATS:
            paths.append(folder / f"{figure.name}.{format}")
            write_picture(figure, paths[-1])
    return paths


def write_picture(figure: Figure, path: Path) -> None:
    """Write a figure in the format that the file's name says.

    Raises:
        InputError: the file cannot be written, or the format is none of FORMATS.
    """
    format = path.suffix[1:].lower()
    if format not in FORMATS:
        raise InputError(f"no figure format is named '{format}', expected one of {', '.join(FORMATS)}", path)
    import vl_convert  # 90 MB with a browser's script engine: only where a picture is drawn

    spec = figure_spec(figure)
    if format == "png":
        data = vl_convert.vegalite_to_png(spec, scale=PNG_SCALE)
    else:
        data = vl_convert.vegalite_to_svg(spec).encode("utf-8")
    try:
        with new_file(path) as temporary:
            temporary.write_bytes(data)
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", path) from error


def figure_spec(figure: Figure) -> Spec:
    """All panels of a figure with its legend, in the page's light colours."""

    def sheet(panel: Panel) -> Spec:
        panel = replace(panel, size=(min(panel.size[0], MAX_WIDTH_PX), panel.size[1]))
        return panel_spec(panel, lambda i: {"values": _rows(panel.series[i])}) | {"title": panel.title}

    panels = [sheet(panel) for panel in figure.panels]
    if len(figure.entries) > 1:
        panels[0]["layer"].append(_legend(figure.entries))
    columns = min(_NUM_COLUMNS[figure.layout], len(panels))
    spec = {"background": "white", "padding": 8, "config": CONFIG, "concat": panels, "columns": columns}
    colors = light_colors()
    return dict(json.loads(re.sub(r"var\(--([\w-]+)\)", lambda found: colors[found[1]], json.dumps(spec))))


def light_colors() -> dict[str, str]:
    """The page's colours by name, of its light theme."""
    light, _ = re.findall(r":root \{(.*?)\}", (ASSETS / "page.css").read_text(encoding="utf-8"), flags=re.DOTALL)
    return dict(re.findall(r"--([\w-]+): (#[0-9a-f]{6})", light))


def _rows(series: Series) -> list[dict[str, float | None]]:
    return [{"x": x, "y": y if math.isfinite(y) else None} for x, y in points_of(series).tolist()]


def _legend(entries: list[LegendEntry]) -> Spec:
    """A layer of which nothing is seen but its legend."""
    texts = [entry.text for entry in entries]
    legend = {"title": None, "orient": "top", "columns": 6, "symbolOpacity": 1}
    ranges = {
        "color": [css(entry.color) for entry in entries],
        "shape": [_SYMBOLS.get(entry.shape, "square") for entry in entries],
    }
    encoding: Spec = {
        channel: {"field": "text", "scale": {"domain": texts, "range": values}, "legend": legend}
        for channel, values in ranges.items()
    }
    data = {"values": [{"text": text} for text in texts]}
    nowhere = {"x": None, "y": None}
    return {"data": data, "mark": {"type": "point", "filled": True, "opacity": 0}, "encoding": encoding | nowhere}
