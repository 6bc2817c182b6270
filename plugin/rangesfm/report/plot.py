"""Figures as data, from which the charts of the page, their CSV files and picture files are made."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array

Pixels = npt.NDArray[np.uint8]
Range = tuple[float, float]
Limits = tuple[Range, Range, tuple[float, float]]

VIEW_SIZE = (400.0, 350.0)
"""Largest width and height of a plan or an elevation, pixels."""

WIDE_SIZE = (990.0, 250.0)
"""Width and height of a panel as wide as the page, pixels."""

_ROOM_AROUND = 0.06


class Series(NamedTuple):
    """Points of a figure that belong together.

    Attributes:
        name: in the legend and in the CSV file.
        color: name of a colour of the page's style, or "#rrggbb".
        points: (n, 2) x and y; NaN breaks a line.
        kind: "dots", "line", "dashed", or "filled" (a line with the area between it and zero).
        is_data: whether the CSV file has it and the pointer shows its values; false for the summary of another series.
    """

    name: str
    color: str
    points: Array
    kind: str = "dots"
    is_data: bool = True


class Mark(NamedTuple):
    """One marked place in a panel.

    Attributes:
        name: of its kind, for the legend.
        color: name of a colour of the page's style.
        shape: "triangle" or "disc".
        label: text beside it; "" for none.
        title: text that the pointer shows, and name in the CSV file.
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
    """One coordinate system of a figure.

    Attributes:
        title: text above it; "" for none.
        description: text for readers who cannot see it.
        labels: of the x and the y axis.
        x_range, y_range: of the axes; None: the range of the data.
        size: width and height between the axes, in pixels.
        keeps_shape: whether its height follows its width, so that both axes keep the same scale.
        zero_line: whether a line marks zero on the y axis.
        lines: name and x of vertical lines over the whole height.
        bands: name and both ends on the x axis of vertical strips over the whole height.
        rows: y, left label and right label of each row; they replace the numbers on the y axis.
        picture: (h, w, 4) red, green, blue, opacity, behind the series and over the whole panel; top row first.
    """

    title: str
    description: str
    labels: tuple[str, str]
    series: tuple[Series, ...]
    marks: tuple[Mark, ...] = ()
    x_range: Range | None = None
    y_range: Range | None = None
    size: tuple[float, float] = (400.0, 200.0)
    keeps_shape: bool = False
    zero_line: bool = False
    lines: tuple[tuple[str, float], ...] = ()
    bands: tuple[tuple[str, float, float], ...] = ()
    rows: tuple[tuple[float, str, str], ...] = ()
    picture: Pixels = field(default_factory=lambda: np.zeros((0, 0, 4), dtype=np.uint8))

    @property
    def limits(self) -> tuple[Range, Range]:
        """Return the ranges of both axes: as given, or those of the data, with some room above and below."""
        marks = np.array([[mark.x, mark.y] for mark in self.marks], dtype=np.float64).reshape(-1, 2)
        points = np.concatenate([marks, *(series.points for series in self.series)])
        x_range = self.x_range or _limits(points[:, 0])
        y_range = self.y_range or _limits(points[:, 1], _ROOM_AROUND)
        return _widened(x_range), _widened(y_range)


@dataclass(frozen=True)
class Figure:
    """Panels with one caption and one legend.

    Attributes:
        name: of its files, without ending.
        layout: "single", "views" (two side by side) or "panels" (many).
        table: name of the data on the page that the CSV file is made of, where they are too many to be stored twice;
            empty: the series themselves.
    """

    name: str
    caption: str
    panels: tuple[Panel, ...]
    layout: str = "single"
    table: str = ""

    @property
    def is_wide(self) -> bool:
        """Return whether the figure takes the whole width of the page."""
        return self.layout != "single" or self.panels[0].size[0] >= WIDE_SIZE[0]

    @property
    def entries(self) -> dict[str, tuple[str, str]]:
        """Return the legend: each text with its colour and shape.

        The shape is the kind of a Series, the shape of a Mark, "upright" for a vertical line or "strip" for a band.
        """
        given = [(one.name, one.color, one.kind) for panel in self.panels for one in panel.series if len(one.points)]
        for panel in self.panels:
            given += [(mark.name, mark.color, mark.shape) for mark in panel.marks]
            given += [(name, "ink", "upright") for name, _ in panel.lines]
            given += [(name, "interval", "strip") for name, _, _ in panel.bands]
        return {text: (color, shape) for text, color, shape in given if text}


def figure_of(
    name: str,
    caption: str,
    description: str,
    labels: tuple[str, str],
    series: Iterable[Series],
    *,
    table: str = "",
    **of_panel: Any,
) -> Figure:
    """Return a figure with one panel without a title; ``of_panel`` are further attributes of the Panel."""
    return Figure(name, caption, (Panel("", description, labels, tuple(series), **of_panel),), table=table)


@dataclass(frozen=True)
class View:
    """A view of the world along one of its axes.

    Attributes:
        name: "Plan" or "Elevation".
        axes: numbers of the world's axes that are horizontal and vertical on the page.
        sign: -1 where the vertical axis of the world points down on the page, else 1.
    """

    name: str
    axes: tuple[int, int]
    sign: float = 1.0

    def seen(self, points: Array) -> Array:
        """Return the places on the page, (n, 2), of points (n, 3)."""
        return np.asarray(points[:, self.axes] * np.array([1.0, self.sign]))

    def anchors(self, anchors_m: Mapping[str, npt.ArrayLike]) -> tuple[Array, tuple[Mark, ...]]:
        """Return the places on the page, (n, 2), of anchors whose positions (3,) are given by id, and their marks."""
        places = self.seen(np.array(list(anchors_m.values()), dtype=np.float64).reshape(-1, 3))
        marks = [
            Mark("anchor", "anchor", "triangle", x, y, anchor_id, f"anchor {anchor_id}")
            for anchor_id, (x, y) in zip(anchors_m, places.tolist(), strict=True)
        ]
        return places, tuple(marks)

    def panel(self, what: str, unit: str, series: Iterable[Series], limits: Limits, **others: Any) -> Panel:
        """Return the panel of this view.

        Args:
            what: words for what is shown, for the description.
            unit: of the axis labels, with a space before it.
            series: data, already projected by ``seen``.
            limits: from ``equal_view``.
            others: further attributes of the Panel.
        """
        x, y = (f"{'xyz'[axis]}{unit}" for axis in self.axes)
        others |= dict(zip(("x_range", "y_range", "size"), limits)) | {"keeps_shape": True}
        labels = (x, f"−{y}" if self.sign < 0 else y)
        return Panel(self.name, f"{self.name} of {what}", labels, tuple(series), **others)


def views_of(centers: Array, frame: str) -> tuple[View, View]:
    """Return plan and elevation of a path (n, 3); the elevation shows the longer horizontal direction."""
    extents = np.ptp(centers, axis=0)
    if frame == "site":
        return View("Plan", (0, 1)), View("Elevation", (0 if extents[0] >= extents[1] else 1, 2))
    # A camera looks along +z and its y axis points down.
    return View("Plan", (0, 2)), View("Elevation", (0 if extents[0] >= extents[2] else 2, 1), -1.0)


def equal_view(points: Array) -> Limits:
    """Return x range, y range and size in pixels that show points (n, 2) with a margin, at one scale in x and y."""
    width, height = VIEW_SIZE
    center, extents = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0)
    per_pixel = 1.14 * max(extents[0] / width, extents[1] / height, 1e-3 / width)
    used_height = float(np.clip(extents[1] / per_pixel * 1.25, 0.4 * height, height))
    half = per_pixel * np.array([width, used_height]) / 2
    (x_low, y_low), (x_high, y_high) = (center - half).tolist(), (center + half).tolist()
    return (x_low, x_high), (y_low, y_high), (width, used_height)


def running_median(points: Array, x_range: Range, num_bins: int) -> Array:
    """Return the middles of equal bins of x and the median of y in each, (num_bins, 2); NaN for empty bins."""
    x, y = points[np.isfinite(points).all(axis=1)].T
    edges = np.linspace(*x_range, num_bins + 1)
    index = np.clip(np.digitize(x, edges) - 1, 0, num_bins - 1)
    medians = [float(np.median(y[index == i])) if np.any(index == i) else np.nan for i in range(num_bins)]
    return np.column_stack([(edges[:-1] + edges[1:]) / 2, medians])


def histogram(values: Array, edges: Array) -> Array:
    """Return the outline of a histogram, (n, 2); values beyond the edges count in the outermost bars."""
    heights = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0].astype(float)
    return np.column_stack([np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])])


def time_axis(times_s: Array) -> tuple[Array, str]:
    """Return the values (n,) and the label of a time axis: seconds since the first, or numbers without any times."""
    if not np.isfinite(times_s).any():
        return np.arange(len(times_s), dtype=np.float64), "range number"
    return times_s - np.nanmin(times_s), "time s"


def every_nth(num: int, most: int) -> int:
    """Return the stride that keeps at most ``most`` of ``num`` items, 1 or more."""
    return max(1, -(-num // most))


def from_zero(series: Iterable[Series]) -> Range:
    """Return the range of a y axis from zero to a little above the highest point."""
    return 0.0, 1.08 * max(float(one.points[:, 1].max()) for one in series)


def _limits(values: Array, share_around: float = 0.0) -> Range:
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    return low - share_around * (high - low), high + share_around * (high - low)


def _widened(limits: Range) -> Range:
    """Return the limits, or limits with some room around where they are a single value."""
    low, high = limits
    if abs(high - low) > 1e-9 * max(1.0, abs(low), abs(high)):
        return low, high
    half = 0.5 * max(abs(low), 1.0) * 1e-2
    return low - half, high + half
