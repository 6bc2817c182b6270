"""Small charts as inline SVG. Colours come from the page's style by class, so that they follow its theme."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from rangesfm.report.markup import Child, Markup, element
from rangesfm.report.text import fixed

Array = npt.NDArray[np.float64]

DOT_GRID_PX = 0.5
"""Dots are put on this grid and drawn once, so that a figure's size does not grow with the log."""


class Chart:
    """One coordinate system to draw into, in pixels of its own view box."""

    def __init__(
        self,
        width: float,
        height: float,
        x_range: tuple[float, float],
        y_range: tuple[float, float],
        *,
        left: float = 44,
        right: float = 10,
        top: float = 10,
        bottom: float = 36,
    ):
        self.width, self.height = width, height
        self.left, self.right, self.top, self.bottom = left, width - right, top, height - bottom
        self.x_range, self.y_range = _widened(x_range), _widened(y_range)
        self._parts: list[Child] = []

    def x(self, values: npt.ArrayLike) -> Array:
        """Pixels of data values."""
        low, high = self.x_range
        return self.left + (np.asarray(values, dtype=np.float64) - low) / (high - low) * (self.right - self.left)

    def y(self, values: npt.ArrayLike) -> Array:
        low, high = self.y_range
        return self.bottom - (np.asarray(values, dtype=np.float64) - low) / (high - low) * (self.bottom - self.top)

    def pixels_between(self, first: tuple[float, float], second: tuple[float, float]) -> float:
        """Distance of two data points on the page."""
        return math.dist((self.x(first[0]), self.y(first[1])), (self.x(second[0]), self.y(second[1])))

    def add(self, *parts: Child) -> None:
        self._parts.extend(parts)

    def axes(self, x_label: str, y_label: str, *, num_x_ticks: int = 6, num_y_ticks: int = 5) -> None:
        """Grid lines with numbers, and the name of each axis."""
        for tick, text in ticks(*self.x_range, num_x_ticks):
            at = float(self.x(tick))
            self.add(_line(at, self.top, at, self.bottom, "grid"), self._text(at, self.bottom + 14, text, "middle"))
        for tick, text in ticks(*self.y_range, num_y_ticks):
            at = float(self.y(tick))
            self.add(_line(self.left, at, self.right, at, "grid"), self._text(self.left - 5, at + 3.5, text, "end"))
        middle = (self.left + self.right) / 2
        self.add(self._text(middle, self.height - 5, x_label, "middle", "axis-name"))
        turned = f"translate(11 {(self.top + self.bottom) / 2:.1f}) rotate(-90)"
        self.add(element("text", y_label, class_="axis-name", text_anchor="middle", transform=turned))

    def dots(self, points: Array, class_: str) -> None:
        """One dot for each finite point of (n, 2); those outside are drawn at the edge."""
        pixels = self._pixels(points)
        pixels = np.clip(pixels[np.isfinite(pixels).all(axis=1)], (self.left, self.top), (self.right, self.bottom))
        steps = np.unique(np.round(pixels / DOT_GRID_PX).astype(np.int64), axis=0)
        if len(steps):
            # From dot to dot, in whole steps: a third of the text that places in pixels would take.
            moves = np.diff(steps, axis=0, prepend=0).tolist()
            data = "".join(f"m{x} {y}h0" for x, y in moves)
            self.add(element("path", d=data, class_=f"dots {class_}", transform=f"scale({DOT_GRID_PX:g})"))

    def line(self, points: Array, class_: str) -> None:
        """A line through (n, 2) points in turn, broken where one is not finite."""
        data, pen = [], "M"
        for x, y in self._pixels(points).tolist():
            if math.isfinite(x) and math.isfinite(y):
                data.append(f"{pen}{x:.1f} {y:.1f}")
                pen = "L"
            else:
                pen = "M"
        if data:
            self.add(element("path", d="".join(data), class_=f"line {class_}"))

    def vertical(self, x: float, class_: str) -> None:
        at = float(self.x(x))
        self.add(_line(at, self.top, at, self.bottom, class_))

    def horizontal(self, y: float, class_: str) -> None:
        at = float(self.y(y))
        self.add(_line(self.left, at, self.right, at, class_))

    def band(self, x_low: float, x_high: float, class_: str) -> None:
        """A filled strip between two x values, as far as it is inside."""
        low, high = np.clip(self.x([x_low, x_high]), self.left, self.right)
        self.add(
            element("rect", x=low, y=self.top, width=high - low, height=self.bottom - self.top, class_=class_),
        )

    def label(self, x: float, y: float, text: str, *, dx: float = 0, dy: float = 0, anchor: str = "start") -> None:
        """Text at a data point, moved by (dx, dy) pixels."""
        self.add(self._text(float(self.x(x)) + dx, float(self.y(y)) + dy, text, anchor, "label"))

    def marker(self, x: float, y: float, class_: str, title: str) -> None:
        """A triangle on a data point; the title shows on hovering."""
        a, b = float(self.x(x)), float(self.y(y))
        shape = f"M{a:.1f} {b - 6:.1f}l5.5 9.5h-11z"
        self.add(element("path", element("title", title), d=shape, class_=class_))

    def disc(self, x: float, y: float, class_: str, title: str) -> None:
        """A disc on a data point; the title shows on hovering."""
        shape = {"cx": float(self.x(x)), "cy": float(self.y(y)), "r": 4.5}
        self.add(element("circle", element("title", title), class_=class_, **shape))

    def render(self, description: str) -> Markup:
        """The finished picture; ``description`` is for those who cannot see it."""
        return element(
            "svg",
            element("title", description),
            self._parts,
            viewBox=f"0 0 {self.width:g} {self.height:g}",
            role="img",
            class_="chart",
        )

    def _pixels(self, points: Array) -> Array:
        return np.column_stack([self.x(points[:, 0]), self.y(points[:, 1])])

    def _text(self, x: float, y: float, text: str, anchor: str, class_: str = "tick") -> Markup:
        return element("text", text, x=x, y=y, text_anchor=anchor, class_=class_)


def equal_chart(points: Array, width: float, *, max_height: float) -> Chart:
    """A chart that shows all (n, 2) points, with a margin, at one scale in both directions."""
    frame = Chart(width, max_height, (0, 1), (0, 1))
    free_width, free_height = frame.right - frame.left, frame.bottom - frame.top
    center, extents = (points.min(axis=0) + points.max(axis=0)) / 2, np.ptp(points, axis=0)
    per_pixel = 1.14 * max(extents[0] / free_width, extents[1] / free_height, 1e-3 / free_width)
    used_height = float(np.clip(extents[1] / per_pixel * 1.25, 0.4 * free_height, free_height))
    half = per_pixel * np.array([free_width, used_height]) / 2
    (x_low, y_low), (x_high, y_high) = center - half, center + half
    return Chart(width, max_height - free_height + used_height, (x_low, x_high), (y_low, y_high))


def ticks(low: float, high: float, max_num: int) -> list[tuple[float, str]]:
    """At most about ``max_num`` round numbers from low to high, with their texts."""
    if max_num == 0:
        return []
    rough = (high - low) / max_num
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(factor * power for factor in (1, 2, 5, 10) if factor * power >= rough * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    decimals = max(0, -math.floor(math.log10(step) + 1e-9))
    return [(i * step, fixed(i * step, decimals)) for i in range(first, last + 1)]


def running_median(points: Array, x_range: tuple[float, float], num_bins: int) -> Array:
    """(num_bins, 2): middles of equal bins of x and the median of y in each; NaN in empty ones."""
    x, y = points[np.isfinite(points).all(axis=1)].T
    edges = np.linspace(*x_range, num_bins + 1)
    index = np.clip(np.digitize(x, edges) - 1, 0, num_bins - 1)
    medians = [float(np.median(y[index == i])) if np.any(index == i) else np.nan for i in range(num_bins)]
    return np.column_stack([(edges[:-1] + edges[1:]) / 2, medians])


def _widened(limits: tuple[float, float]) -> tuple[float, float]:
    """The limits, or some room around a single value."""
    low, high = limits
    if high - low > 1e-9 * max(1.0, abs(low), abs(high)):
        return low, high
    half = 0.5 * max(abs(low), 1.0) * 1e-2
    return low - half, high + half


def _line(x1: float, y1: float, x2: float, y2: float, class_: str) -> Markup:
    return element("line", x1=x1, y1=y1, x2=x2, y2=y2, class_=class_)


def legend(entries: Sequence[tuple[str, str]]) -> Markup:
    """Swatches with names: pairs of class and text."""
    items = [element("span", element("i", class_=f"swatch {class_}"), text) for class_, text in entries]
    return element("p", items, class_="legend")
