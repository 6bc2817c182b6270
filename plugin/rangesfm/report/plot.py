"""A figure as data: the same for the page, its CSV file and a picture for a paper."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array

Pixels = npt.NDArray[np.uint8]
Range = tuple[float, float]
Limits = tuple[Range, Range, tuple[float, float]]

VIEW_SIZE = (400.0, 350.0)
"""Of a plan or an elevation, at most."""

WIDE_SIZE = (990.0, 250.0)
"""Of a panel as wide as the page."""

_ROOM_AROUND = 0.06


class Series(NamedTuple):
    """Points that belong together.

    Attributes:
        name: as the legend and the CSV file have it.
        color: name of a colour of the page's style, or "#rrggbb".
        points: (n, 2); NaN breaks a line.
        kind: "dots", "line", "dashed", or "filled" (a line with the area from there to zero).
        is_data: whether the CSV file and the pointer know it; not a mere summary of another series.
    """

    name: str
    color: str
    points: Array
    kind: str = "dots"
    is_data: bool = True


class Mark(NamedTuple):
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
        labels: of the x and the y axis.
        x_range, y_range: of the axes; None takes that of the data.
        size: width and height between the axes, in pixels.
        keeps_shape: whether its height goes with its width, so that both axes keep one scale.
        zero_line: whether zero is marked on the y axis.
        line: name and x of a line over the whole height.
        band: name and ends on the x axis of a strip over the whole height.
        rows: height, left and right label of each row, instead of numbers on the y axis.
        picture: (h, w, 4) red, green, blue, opacity, behind the series and all over the panel; top row first.
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
    line: tuple[str, float] | None = None
    band: tuple[str, float, float] | None = None
    rows: tuple[tuple[float, str, str], ...] = ()
    picture: Pixels | None = None

    @property
    def limits(self) -> tuple[Range, Range]:
        """Ranges of both axes, where none are given those of the data, with room above and below."""
        marks = np.array([[mark.x, mark.y] for mark in self.marks], dtype=np.float64).reshape(-1, 2)
        points = np.concatenate([marks, *(series.points for series in self.series)])
        x_range = self.x_range or _limits(points[:, 0])
        y_range = self.y_range or _limits(points[:, 1], _ROOM_AROUND)
        return _widened(x_range), _widened(y_range)


@dataclass(frozen=True)
class Figure:
    """Panels with one caption and one legend.

    Attributes:
        name: of its files.
        caption: what there is to see.
        layout: "single", "views" (two side by side) or "panels" (many).
        table: which of the page's own tables is its data, where that is too much to hold twice;
            None: the series themselves.
    """

    name: str
    caption: str
    panels: tuple[Panel, ...]
    layout: str = "single"
    table: str | None = None

    @property
    def is_wide(self) -> bool:
        """Whether it stands on its own instead of beside another."""
        return self.layout != "single" or self.panels[0].size[0] >= WIDE_SIZE[0]

    @property
    def entries(self) -> dict[str, tuple[str, str]]:
        """The legend: colour and shape (a kind of Series, a shape of Mark, "upright" or "strip") of each text."""
        given = [(one.name, one.color, one.kind) for panel in self.panels for one in panel.series if len(one.points)]
        for panel in self.panels:
            given += [(mark.name, mark.color, mark.shape) for mark in panel.marks]
            given += [(panel.line[0], "ink", "upright")] if panel.line else []
            given += [(panel.band[0], "interval", "strip")] if panel.band else []
        return {text: (color, shape) for text, color, shape in given if text}


def figure_of(
    name: str,
    caption: str,
    description: str,
    labels: tuple[str, str],
    series: Iterable[Series],
    *,
    table: str | None = None,
    **of_panel: Any,
) -> Figure:
    """A figure of one panel without a title; ``of_panel`` is what else a Panel has."""
    return Figure(name, caption, (Panel("", description, labels, tuple(series), **of_panel),), table=table)


@dataclass(frozen=True)
class View:
    """A look at the world along one of its axes.

    Attributes:
        axes: the horizontal and the vertical one on the page.
        sign: of the vertical one there.
    """

    name: str
    axes: tuple[int, int]
    sign: float = 1.0

    def seen(self, points: Array) -> Array:
        """(n, 2) places on the page of (n, 3) points."""
        return np.asarray(points[:, self.axes] * np.array([1.0, self.sign]))

    def anchors(self, anchors_m: Mapping[str, npt.ArrayLike]) -> tuple[Array, tuple[Mark, ...]]:
        """(n, 2) places of anchors, (3,) by id, and their marks."""
        places = self.seen(np.array(list(anchors_m.values()), dtype=np.float64).reshape(-1, 3))
        marks = [
            Mark("anchor", "anchor", "triangle", x, y, anchor_id, f"anchor {anchor_id}")
            for anchor_id, (x, y) in zip(anchors_m, places.tolist(), strict=True)
        ]
        return places, tuple(marks)

    def panel(self, what: str, unit: str, series: Iterable[Series], limits: Limits, **others: Any) -> Panel:
        """What ``equal_view`` says of the limits, and what else a Panel has."""
        x, y = (f"{'xyz'[axis]}{unit}" for axis in self.axes)
        others |= dict(zip(("x_range", "y_range", "size"), limits)) | {"keeps_shape": True}
        labels = (x, f"−{y}" if self.sign < 0 else y)
        return Panel(self.name, f"{self.name} of {what}", labels, tuple(series), **others)


def views_of(centers: Array, frame: str) -> tuple[View, View]:
    """Plan and elevation of a path; the latter with its longer horizontal direction."""
    extents = np.ptp(centers, axis=0)
    if frame == "site":
        return View("Plan", (0, 1)), View("Elevation", (0 if extents[0] >= extents[1] else 1, 2))
    # A camera looks along +z and its y axis points down.
    return View("Plan", (0, 2)), View("Elevation", (0 if extents[0] >= extents[2] else 2, 1), -1.0)


def equal_view(points: Array) -> Limits:
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


def histogram(values: Array, edges: Array) -> Array:
    """(n, 2): the line around the bars; what lies beyond the edges is in the outermost."""
    heights = np.histogram(np.clip(values, edges[0], edges[-1]), edges)[0].astype(float)
    return np.column_stack([np.repeat(edges, 2), np.concatenate([[0.0], np.repeat(heights, 2), [0.0]])])


def time_axis(times_s: Array) -> tuple[Array, str]:
    """(n,) seconds since the first and what the axis is called; numbers where no range has a time."""
    if not np.isfinite(times_s).any():
        return np.arange(len(times_s), dtype=np.float64), "range number"
    return times_s - np.nanmin(times_s), "time s"


def every_nth(num: int, most: int) -> int:
    """Every how many-th of so many is drawn, where no more than most are to be."""
    return max(1, -(-num // most))


def from_zero(series: Iterable[Series]) -> Range:
    """A y axis from zero to a little above the highest point."""
    return 0.0, 1.08 * max(float(one.points[:, 1].max()) for one in series)


def _limits(values: Array, share_around: float = 0.0) -> Range:
    known = values[np.isfinite(values)]
    low, high = (float(known.min()), float(known.max())) if len(known) else (0.0, 1.0)
    return low - share_around * (high - low), high + share_around * (high - low)


def _widened(limits: Range) -> Range:
    """The limits, or some room around a single value."""
    low, high = limits
    if abs(high - low) > 1e-9 * max(1.0, abs(low), abs(high)):
        return low, high
    half = 0.5 * max(abs(low), 1.0) * 1e-2
    return low - half, high + half
