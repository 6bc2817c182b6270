"""Charts: the positions at which data are drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest

from rangesfm.report.chart import drawn_points, joined_labels, panel_spec
from rangesfm.report.plot import VIEW_SIZE, Figure, Mark, Panel, Series, equal_view, running_median


def panel_of(*series: Series) -> Panel:
    return Panel("", "", ("x", "y"), series, x_range=(0.0, 10.0), y_range=(0.0, 1.0))


def test_dots_beyond_an_axis_are_drawn_at_its_edge_and_each_for_itself_and_lines_are_cut_there() -> None:
    points = np.array([[5.0, 99.0]])
    panel = panel_of(Series("dots", "after", points), Series("line", "after", points, "line"))
    dots, line = panel_spec(panel, lambda i: {"name": str(i)})["layer"][-2:]
    assert dots["transform"] == [{"calculate": "[clamp(datum.y, 0.0, 1.0), null]", "as": "y"}, {"flatten": ["y"]}]
    assert "transform" not in line
    assert line["mark"]["clip"]


def test_a_missing_point_breaks_a_line_and_is_no_dot() -> None:
    points = np.array([[0.0, 0.0], [2.0, np.nan], [3.0, 0.0]])
    np.testing.assert_array_equal(drawn_points(Series("a", "after", points, "line")), points)
    np.testing.assert_array_equal(drawn_points(Series("a", "after", points)), points[[0, 2]])


@pytest.mark.parametrize("points", [np.array([[5.0, -3.0]]), np.zeros((0, 2)), np.full((3, 2), np.nan)])
def test_a_chart_of_one_value_or_none_still_has_axes(points: np.ndarray) -> None:
    panel = Panel("", "", ("x", "y"), (Series("a", "after", points),))
    for low, high in panel.limits:
        assert math.isfinite(low)
        assert low < high


@pytest.mark.parametrize(("width", "height"), [(8.0, 1.0), (1.0, 8.0), (0.0, 0.0)])
def test_equal_views_have_one_scale_and_hold_all_points(width: float, height: float) -> None:
    points = np.array([[100.0, -7.0], [100.0 + width, -7.0 + height]])
    (x_low, x_high), (y_low, y_high), size = equal_view(points)
    assert (x_high - x_low) / size[0] == pytest.approx((y_high - y_low) / size[1])
    assert size[1] <= VIEW_SIZE[1]
    assert np.all((points > (x_low, y_low)) & (points < (x_high, y_high)))


def test_marks_that_fall_on_one_another_share_a_label() -> None:
    places = {"A": (1.0, 0.5), "B": (1.01, 0.5), "C": (9.0, 0.5)}
    marks = tuple(Mark("anchor", "anchor", "triangle", x, y, id_, id_) for id_, (x, y) in places.items())
    panel = Panel("", "", ("x", "y"), (), marks, x_range=(0.0, 10.0), y_range=(0.0, 1.0))
    assert [mark.label for mark in joined_labels(panel)] == ["A, B", "C"]


def test_the_legend_names_each_thing_once() -> None:
    points = np.zeros((2, 2))
    panels = (
        panel_of(Series("a", "after", points), Series("a", "after", points, "line"), Series("b", "before", points)),
        panel_of(Series("a", "after", points), Series("empty", "third", points[:0])),
    )
    assert list(Figure("f", "", panels).entries) == ["a", "b"]


def test_the_running_median_ignores_an_outlier_and_leaves_gaps() -> None:
    points = np.array([[0.1, 1.0], [0.2, 2.0], [0.3, 99.0], [2.5, 5.0]])
    np.testing.assert_array_equal(running_median(points, (0.0, 3.0), 3), [[0.5, 2.0], [1.5, np.nan], [2.5, 5.0]])
