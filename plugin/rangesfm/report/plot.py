"""A figure as data: the same for the page, its CSV file and a picture for a paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

WIDE_SIZE = (1060.0, 300.0)
"""Of a panel as wide as the page."""

_ROOM_AROUND = 0.06


@dataclass(frozen=True)
class Series:
    """Points that belong together.

    Attributes:
        name: as the legend and the CSV file have it.
        style: name of its colour: "before", "after", "reference", ...
        points: (n, 2); NaN breaks a line.
        kind: "dots", "line", or "filled" (a line with the area from there to zero).
        is_data: whether the CSV file holds it; not a mere summary of another series.
    """

    name: str
    style: str
    points: Array
    kind: str = "dots"
    is_data: bool = True


@dataclass(frozen=True)
class Mark:
    """One labelled place: a triangle ("anchor") or a disc ("disc").

    Attributes:
        name: of its kind, for the legend.
        label: beside it; "" for none.
        title: what it says when pointed at, and what the CSV file calls it.
    """

    name: str
    x: float
    y: float
    shape: str
    label: str
    title: str


@dataclass(frozen=True)
class Picture:
    """Pixels behind the series, over the ranges of both axes.

    Attributes:
        pixels: (h, w, 4) red, green, blue, opacity; the first row is the top.
    """

    pixels: npt.NDArray[np.uint8]
    x_range: tuple[float, float]
    y_range: tuple[float, float]


@dataclass(frozen=True)
class Panel:
    """One coordinate system.

    Attributes:
        title: above it; "" for none.
        description: for those who cannot see it.
        x_range, y_range: of the axes; None takes that of the data.
        is_equal: whether both axes have one scale.
        size: width and height on the page.
        zero_line: whether zero is marked on the y axis.
        verticals: (x, style) lines over the whole height.
        bands: (low, high, style) strips over the whole height.
        rows: labels left and right of heights, instead of numbers on the y axis.
    """

    title: str
    description: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    marks: tuple[Mark, ...] = ()
    x_range: tuple[float, float] | None = None
    y_range: tuple[float, float] | None = None
    is_equal: bool = False
    size: tuple[float, float] = (460, 250)
    zero_line: bool = False
    verticals: tuple[tuple[float, str], ...] = ()
    bands: tuple[tuple[float, float, str], ...] = ()
    rows: tuple[tuple[float, str, str], ...] = ()
    picture: Picture | None = None

    @property
    def limits(self) -> tuple[tuple[float, float], tuple[float, float]]:
        """Ranges of both axes, where none are given those of the data, with room above and below."""
        points = self.all_points
        x_range = self.x_range or _limits(points[:, 0])
        return x_range, self.y_range or _with_room(_limits(points[:, 1]))

    @property
    def all_points(self) -> Array:
        """(n, 2) of all series and marks."""
        marks = np.array([[mark.x, mark.y] for mark in self.marks], dtype=np.float64).reshape(-1, 2)
        return np.concatenate([marks, *(series.points for series in self.series)])


@dataclass(frozen=True)
class Figure:
    """Panels with one caption and one legend.

    Attributes:
        name: of its files.
        caption: what there is to see.
        layout: "single", "views" (two side by side) or "panels" (many).
        legend: (style, text) beyond those of the series and marks.
        table: which of the page's own tables is its data, where that is too much to hold twice;
            None: the series themselves.
    """

    name: str
    caption: str
    panels: tuple[Panel, ...]
    layout: str = "single"
    legend: tuple[tuple[str, str], ...] = ()
    table: str | None = None

    @property
    def entries(self) -> list[tuple[str, str]]:
        """(style, text) of the legend, each once."""
        found = dict.fromkeys(
            (series.style, series.name) for panel in self.panels for series in panel.series if len(series.points)
        )
        found |= dict.fromkeys(
            ("anchor" if mark.shape == "anchor" else "after-disc", mark.name)
            for panel in self.panels
            for mark in panel.marks
        )
        return [*found, *self.legend]


def csv_text(figure: Figure) -> str:
    """The figure's data, one row for each point."""
    x_name, y_name = (
        "_".join(label.replace("−", "minus ").split())
        for label in (figure.panels[0].x_label, figure.panels[0].y_label or "row")
    )
    lines = [f"panel,series,{x_name},{y_name}"]
    for panel in figure.panels:
        for series in (series for series in panel.series if series.is_data):
            head = f"{_cell(panel.title)},{_cell(series.name)}"
            known = series.points[np.isfinite(series.points).all(axis=1)]
            lines += [f"{head},{x:.7g},{y:.7g}" for x, y in known.tolist()]
        lines += [f"{_cell(panel.title)},{_cell(mark.title)},{mark.x:.7g},{mark.y:.7g}" for mark in panel.marks]
    return "\n".join(lines) + "\n"


def _cell(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if any(sign in text for sign in ',"\n\r') else text


def _limits(values: Array) -> tuple[float, float]:
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)


def _with_room(limits: tuple[float, float]) -> tuple[float, float]:
    margin = _ROOM_AROUND * (limits[1] - limits[0])
    return limits[0] - margin, limits[1] + margin
