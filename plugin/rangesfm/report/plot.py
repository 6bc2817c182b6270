"""A figure as data: the same for the page, its CSV file and a picture for a paper."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array

Pixels = npt.NDArray[np.uint8]
Range = tuple[float, float]

VIEW_SIZE = (400.0, 350.0)
"""Of a plan or an elevation, at most."""

WIDE_SIZE = (990.0, 250.0)
"""Of a panel as wide as the page."""

_ROOM_AROUND = 0.06


@dataclass(frozen=True)
class Series:
    """Points that belong together.

    Attributes:
        name: as the legend and the CSV file have it.
        color: name of a colour of the page's style.
        points: (n, 2); NaN breaks a line.
        kind: "dots", "line", "dashed", or "filled" (a line with the area from there to zero).
        is_data: whether the CSV file and the pointer know it; not a mere summary of another series.
    """

    name: str
    color: str
    points: Array
    kind: str = "dots"
    is_data: bool = True


@dataclass(frozen=True)
class Mark:
    """One labelled place: a "triangle" or a "disc".

    Attributes:
        name: of its kind, for the legend.
        color: name of a colour of the page's style.
        label: beside it; "" for none.
        title: what it says when pointed at, and what the CSV file calls it.
    """

    name: str
    color: str
    shape: str
    x: float
    y: float
    label: str
    title: str


@dataclass(frozen=True)
class Panel:
    """One coordinate system.

    Attributes:
        title: above it; "" for none.
        description: for those who cannot see it.
        x_range, y_range: of the axes; None takes that of the data.
        size: width and height between the axes, in pixels.
        keeps_shape: whether its height goes with its width, so that both axes keep one scale.
        zero_line: whether zero is marked on the y axis.
        verticals: (x, color) lines over the whole height.
        bands: (low, high, color) strips over the whole height.
        rows: labels left and right of heights, instead of numbers on the y axis.
        picture: (h, w, 4) red, green, blue, opacity, behind the series and all over the panel; top row first.
    """

    title: str
    description: str
    x_label: str
    y_label: str
    series: tuple[Series, ...]
    marks: tuple[Mark, ...] = ()
    x_range: Range | None = None
    y_range: Range | None = None
    size: tuple[float, float] = (400.0, 200.0)
    keeps_shape: bool = False
    zero_line: bool = False
    verticals: tuple[tuple[float, str], ...] = ()
    bands: tuple[tuple[float, float, str], ...] = ()
    rows: tuple[tuple[float, str, str], ...] = ()
    picture: Pixels | None = None

    @property
    def limits(self) -> tuple[Range, Range]:
        """Ranges of both axes, where none are given those of the data, with room above and below."""
        marks = np.array([[mark.x, mark.y] for mark in self.marks], dtype=np.float64).reshape(-1, 2)
        points = np.concatenate([marks, *(series.points for series in self.series)])
        x_range = self.x_range or _limits(points[:, 0])
        y_range = self.y_range or _with_room(_limits(points[:, 1]))
        return _widened(x_range), _widened(y_range)


@dataclass(frozen=True)
class LegendEntry:
    """Name, colour and shape ("dots", "line", "dashed", "filled", "triangle", "disc", "upright" or "strip")."""

    text: str
    color: str
    shape: str


@dataclass(frozen=True)
class Figure:
    """Panels with one caption and one legend.

    Attributes:
        name: of its files.
        caption: what there is to see.
        layout: "single", "views" (two side by side) or "panels" (many).
        legend: entries beyond those of the series and marks.
        table: which of the page's own tables is its data, where that is too much to hold twice;
            None: the series themselves.
    """

    name: str
    caption: str
    panels: tuple[Panel, ...]
    layout: str = "single"
    legend: tuple[LegendEntry, ...] = ()
    table: str | None = None

    @property
    def is_wide(self) -> bool:
        """Whether it stands on its own instead of beside another."""
        return self.layout != "single" or self.panels[0].size[0] >= WIDE_SIZE[0]

    @property
    def entries(self) -> list[LegendEntry]:
        """The whole legend; what goes by one name is in it once."""
        found: dict[str, LegendEntry] = {}
        for panel in self.panels:
            for series in panel.series:
                if len(series.points):
                    found[series.name] = LegendEntry(series.name, series.color, series.kind)
        for mark in (mark for panel in self.panels for mark in panel.marks):
            found[mark.name] = LegendEntry(mark.name, mark.color, mark.shape)
        return [*found.values(), *self.legend]


def equal_view(points: Array) -> tuple[Range, Range, tuple[float, float]]:
    """Ranges of both axes and a size that show all (n, 2) points, with a margin, at one scale in both directions."""
    width, height = VIEW_SIZE
    center, extents = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0)
    per_pixel = 1.14 * max(extents[0] / width, extents[1] / height, 1e-3 / width)
    used_height = float(np.clip(extents[1] / per_pixel * 1.25, 0.4 * height, height))
    half = per_pixel * np.array([width, used_height]) / 2
    (x_low, y_low), (x_high, y_high) = (center - half).tolist(), (center + half).tolist()
    return (x_low, x_high), (y_low, y_high), (width, used_height)


def running_median(points: Array, x_range: Range, num_bins: int) -> Array:
    """(num_bins, 2): middles of equal bins of x and the median of y in each; NaN in empty ones."""
    x, y = points[np.isfinite(points).all(axis=1)].T
    edges = np.linspace(*x_range, num_bins + 1)
    index = np.clip(np.digitize(x, edges) - 1, 0, num_bins - 1)
    medians = [float(np.median(y[index == i])) if np.any(index == i) else np.nan for i in range(num_bins)]
    return np.column_stack([(edges[:-1] + edges[1:]) / 2, medians])


def _limits(values: Array) -> Range:
    known = values[np.isfinite(values)]
    return (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)


def _with_room(limits: Range) -> Range:
    margin = _ROOM_AROUND * (limits[1] - limits[0])
    return limits[0] - margin, limits[1] + margin


def _widened(limits: Range) -> Range:
    """The limits, or some room around a single value."""
    low, high = limits
    if abs(high - low) > 1e-9 * max(1.0, abs(low), abs(high)):
        return low, high
    half = 0.5 * max(abs(low), 1.0) * 1e-2
    return low - half, high + half
