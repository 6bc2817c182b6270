"""Charts: where data lands on the page."""

from __future__ import annotations

import re

import numpy as np
import pytest

from rangesfm.report.markup import Markup, element, join
from rangesfm.report.svg import DOT_GRID_PX, Chart, equal_chart, running_median, ticks


def moves(markup: Markup, pen: str) -> list[tuple[float, float]]:
    return [(float(x), float(y)) for x, y in re.findall(rf"{pen}([\d.-]+) ([\d.-]+)", markup)]


def make_chart() -> Chart:
    """100 by 100 pixels of drawing for x in 0..10 and y in 0..1."""
    return Chart(120, 130, (0.0, 10.0), (0.0, 1.0), left=10, right=10, top=10, bottom=20)


def test_y_grows_upwards() -> None:
    chart = make_chart()
    assert (float(chart.x(0)), float(chart.y(0))) == (10.0, 110.0)
    assert (float(chart.x(10)), float(chart.y(1))) == (110.0, 10.0)


def test_dots_outside_lie_on_the_edge_and_those_that_coincide_are_drawn_once() -> None:
    chart = make_chart()
    chart.dots(np.array([[5.0, 0.5], [5.001, 0.5], [5.0, 99.0], [np.nan, 0.5]]), "after")
    svg = chart.render("dots")
    steps = np.cumsum([(float(x), float(y)) for x, y in re.findall(r"m(-?\d+) (-?\d+)h0", svg)], axis=0)
    np.testing.assert_allclose(DOT_GRID_PX * steps, [(60.0, 10.0), (60.0, 60.0)])
    assert f'transform="scale({DOT_GRID_PX:g})"' in svg


def test_a_line_is_broken_where_a_point_is_missing() -> None:
    chart = make_chart()
    chart.line(np.array([[0.0, 0.0], [1.0, 0.0], [2.0, np.nan], [3.0, 0.0], [4.0, 0.0]]), "after")
    assert [x for x, _ in moves(chart.render("line"), "M")] == [10.0, 40.0]
    assert [x for x, _ in moves(chart.render("line"), "L")] == [20.0, 50.0]


def test_nothing_to_draw_draws_nothing() -> None:
    chart = make_chart()
    chart.dots(np.zeros((0, 2)), "after")
    chart.line(np.full((3, 2), np.nan), "after")
    assert "<path" not in chart.render("empty")


def test_a_chart_of_one_value_still_has_an_axis() -> None:
    chart = Chart(120, 130, (5.0, 5.0), (-3.0, -3.0))
    chart.axes("x", "y")
    assert np.isfinite(chart.x(5.0))
    assert "<line" in chart.render("one value")


@pytest.mark.parametrize(("width", "height"), [(8.0, 1.0), (1.0, 8.0), (0.0, 0.0)])
def test_equal_charts_have_one_scale_and_hold_all_points(width: float, height: float) -> None:
    points = np.array([[100.0, -7.0], [100.0 + width, -7.0 + height]])
    chart = equal_chart(points, 460, max_height=400)
    per_metre = float(chart.x(1) - chart.x(0)), float(chart.y(0) - chart.y(1))
    assert per_metre[0] == pytest.approx(per_metre[1])
    assert chart.height <= 400
    assert np.all((chart.x(points[:, 0]) > chart.left) & (chart.x(points[:, 0]) < chart.right))
    assert np.all((chart.y(points[:, 1]) > chart.top) & (chart.y(points[:, 1]) < chart.bottom))


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.0, 10.0, ["0", "2", "4", "6", "8", "10"]),
        (-0.26, 0.27, ["−0.2", "−0.1", "0.0", "0.1", "0.2"]),
        (1e6, 1e6 + 1, ["1000000.0", "1000000.2", "1000000.4", "1000000.6", "1000000.8", "1000001.0"]),
        (0.0, 0.0031, ["0.000", "0.001", "0.002", "0.003"]),
    ],
)
def test_ticks_are_round_numbers(low: float, high: float, expected: list[str]) -> None:
    assert [text for _, text in ticks(low, high, 6)] == expected


def test_the_running_median_ignores_an_outlier_and_leaves_gaps() -> None:
    points = np.array([[0.1, 1.0], [0.2, 2.0], [0.3, 99.0], [2.5, 5.0]])
    np.testing.assert_array_equal(running_median(points, (0.0, 3.0), 3), [[0.5, 2.0], [1.5, np.nan], [2.5, 5.0]])


def test_text_is_escaped_and_markup_is_not() -> None:
    html = element("p", "<b>", element("i", "&"), None, ["x", Markup("<br>")], class_='"', data_id=2.0)
    assert html == '<p class="&quot;" data-id="2">&lt;b&gt;<i>&amp;</i>x<br></p>'
    assert join(["<", Markup("<")]) == "&lt;<"
