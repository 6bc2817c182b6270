"""A plan as one self-contained page in the style of the report: expected accuracy, and what to change."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array
from rangesfm.measurements.kinds_in_words import component_words
from rangesfm.measurements.mistake_words import mistake_in_words
from rangesfm.planning.advice import Advice
from rangesfm.planning.survey_plan import SurveyPlan, size_in_words
from rangesfm.report.plot import Figure, Limits, Mark, Panel, Pixels, Series, View, equal_view, views_of
from rangesfm.report.report_page import Section, render_page, write_page
from rangesfm.report.report_tables import ReportTable
from rangesfm.report.text import count, duration, fixed, percent, rough
from rangesfm.util.files.atomic import write_text
from rangesfm.util.files.output_folder import make_output_folder
from rangesfm.util.geometry.numerics import NORMAL_95

# From the smallest to the largest stddev; each colour is as visible on a light page as on a dark one.
_COLORS = ("#2f7ebc", "#2a9d8f", "#6f9a2b", "#c98b12", "#d4512b")
_OPEN_COLOR = "#a3123a"
_WALL_COLOR = "#6b7280"
# Ends of the bands of half widths are numbers that begin with one of these. Three bands are a factor of 10.
_STEPS = np.array([1.0, 2.0, 5.0])
_AREA_OPACITY, _AREA_WIDTH_PX = 70, 160


def write_plan(plan: SurveyPlan, folder: Path) -> list[Path]:
    """Write ``plan.json`` and ``plan.html`` into a folder and return their paths."""
    make_output_folder(folder)
    numbers, page = folder / "plan.json", folder / "plan.html"
    write_text(json.dumps(plan.as_json(), indent=2) + "\n", numbers)
    write_page(render_plan(plan), page)
    return [numbers, page]


def render_plan(plan: SurveyPlan) -> str:
    """Return the HTML text of the page of a plan."""
    num, expected = len(plan.expected.planned.anchors), plan.expected
    anchors = "1 anchor" if num == 1 else f"{num} anchors"
    title = f"{anchors}, {count(len(expected.keyframe_stddevs_m))} keyframes"
    now = {"scale": percent(NORMAL_95 * expected.uncertainty.empirical), "place": _keyframe_known_least(plan)}
    of_place = f"What would gain most for the place of the least certain keyframe, now ± {now['place']}"
    advice = [
        _advice(f"What would gain most for the scale, now ± {now['scale']}", plan.advice_for_scale),
        _advice(of_place, plan.advice_for_place),
    ]
    return render_page(
        "plan.html",
        title=f"{title} – rangesfm plan",
        heading=f"Plan: {title}",
        plan=plan,
        keyframe_known_least=now["place"],
        tiles=_tiles(plan),
        sections=[
            Section("path", "Accuracy", [accuracy_views(plan)]),
            Section("advice", "What to change", tables=advice),
            Section(
                "expected",
                "What to expect",
                tables=[_by_kind(plan), _components(plan), _anchors(plan), _points(plan), _mistakes(plan)],
            ),
        ],
    )


def _tiles(plan: SurveyPlan) -> list[tuple[str, str, str]]:
    place = plan.place
    of_place = []
    if place is not None:
        axes = ", ".join(
            f"{axis} {_half_width_95(stddev_m, 'm')}" for axis, stddev_m in zip("xyz", place.stddev_m, strict=True)
        )
        of_place = [
            ("Place", _half_width_95(math.hypot(*place.stddev_m), "m"), f"of the map's middle: {axes}"),
            (
                "Heading",
                _half_width_95(place.heading_stddev_deg, "°"),
                f"tilt {_half_width_95(place.tilt_stddev_deg, '°')}",
            ),
        ]
    planned, worst = plan.expected.planned, int(np.argmax(plan.expected.keyframe_stddevs_m))
    return [
        *of_place,
        ("Least certain keyframe", _keyframe_known_least(plan), f"number {worst + 1} on the path"),
        ("Ranges", count(planned.num_ranges if planned.anchors else 0), f"in {duration(planned.duration_s)}"),
    ]


def _keyframe_known_least(plan: SurveyPlan) -> str:
    return _half_width_95(float(plan.expected.keyframe_stddevs_m.max()), "m")


def accuracy_views(plan: SurveyPlan) -> Figure:
    """Return plan and elevation of the path; path and surroundings are coloured by their expected stddev."""
    centers = plan.expected.planned.trajectory.centers
    edges = _edges(NORMAL_95 * plan.expected.keyframe_stddevs_m)
    # A plan is drawn in the site frame, z up, even where the result will be in another frame.
    views = tuple(_view(plan, view, centers, edges) for view in views_of(centers, "site"))
    whose = "in the site" if plan.place is not None else "against the first camera"
    caption = (
        f"Expected uncertainty of places {whose} (95 %, of the three coordinates together): of the keyframes along the "
        "path, and of points around it that the photos show, at the path's mean height and depth."
    )
    if plan.expected.planned.walls_m:
        caption += f" Grey: {plan.expected.planned.walls_are}."
    return Figure("accuracy", caption, views, layout="views")


def _view(plan: SurveyPlan, view: View, centers: Array, edges: Array) -> Panel:
    places, marks = view.anchors(plan.anchors_m)
    points_m = np.array([point.position_m for point in plan.expected.planned.points]).reshape(-1, 3)
    spots = view.seen(points_m)
    marks += tuple(
        Mark("control point", "reference", "disc", x, y, point.name, f"{point.kind} point {point.name}")
        for point, (x, y) in zip(plan.expected.planned.points, spots.tolist(), strict=True)
    )
    line = view.seen(centers)
    walls = [np.insert(wall, 2, centers[:, 2].mean(), axis=1) for wall in plan.expected.planned.walls_m]
    limits = equal_view(np.vstack([line, places, spots, *map(view.seen, walls)]))
    of_keyframe = np.digitize(NORMAL_95 * plan.expected.keyframe_stddevs_m, edges)
    names = _names(edges)
    shown = names if len(edges) in of_keyframe else names[:-1]
    series = []
    for band, name in enumerate(shown):
        inside = of_keyframe == band
        inside |= np.append(False, inside[:-1])  # the step that leads out of a band has its colour, too
        points = np.where(inside[:, None], line, np.nan)
        series.append(Series(name, _color(band, len(names)), points, "line"))
    if walls and view.axes == (0, 1):
        gaps = [np.vstack([view.seen(wall), [[np.nan, np.nan]]]) for wall in walls]
        series.append(Series(plan.expected.planned.walls_are, _WALL_COLOR, np.vstack(gaps), "line"))
    area = _area(plan, view, centers.mean(axis=0), edges, limits)
    return view.panel("the path and the anchors", " m", series, limits, marks=marks, picture=area)


def _area(plan: SurveyPlan, view: View, middle: Array, edges: Array, limits: Limits) -> Pixels:
    """Return an RGBA picture (h, w, 4) of the surroundings, coloured by the expected uncertainty of points there."""
    (x_low, x_high), (y_low, y_high), size = limits
    width, height = _AREA_WIDTH_PX, max(round(_AREA_WIDTH_PX * size[1] / size[0]), 1)
    across, down = np.meshgrid(np.linspace(x_low, x_high, width), np.linspace(y_high, y_low, height))
    places = np.tile(middle, (width * height, 1))
    places[:, view.axes] = np.column_stack([across.ravel(), view.sign * down.ravel()])
    bands = np.digitize(NORMAL_95 * plan.expected.stddevs_at(places), edges)
    palette = np.array(
        [tuple(bytes.fromhex(_color(band, len(edges) + 1)[1:])) for band in range(len(edges) + 1)], dtype=np.uint8
    )
    pixels: Pixels = np.insert(palette[bands], 3, _AREA_OPACITY, axis=1).reshape(height, width, 4)
    return pixels


def _edges(half_widths_m: Array) -> Array:
    """Return the upper ends of bands of half widths of 95 % intervals, metres; the last is infinite.

    The ends are 1, 2, 5, 10, ... and the median keyframe is in the band in the middle. So the colours differ where one
    place is known at least twice as well as another, and a path that is known evenly has one colour.
    """
    known = half_widths_m[np.isfinite(half_widths_m) & (half_widths_m > 0)]
    if len(known) == 0:
        return np.array([np.inf])
    exponent = math.floor(math.log10(np.median(known)))
    ladder = np.concatenate([_STEPS * 10.0 ** (exponent + by) for by in (-1, 0, 1)])
    first = int(np.searchsorted(ladder, np.median(known), side="right")) - len(_COLORS) // 2
    return np.append(ladder[first : first + len(_COLORS) - 1], np.inf)


def _half_width_95(stddev: float, unit: str) -> str:
    return rough(NORMAL_95 * stddev, unit)


def _names(edges: Array) -> list[str]:
    ends = [rough(edge, "m") for edge in edges[:-1]]
    if not ends:
        return ["known alike", "open"]
    between = [f"{low} to {high}" for low, high in itertools.pairwise(ends)]
    return [f"below {ends[0]}", *between, f"above {ends[-1]}", "open"]


def _color(band: int, num: int) -> str:
    return _OPEN_COLOR if band == num - 1 else _COLORS[round(band * (len(_COLORS) - 1) / max(num - 2, 1))]


def _advice(caption: str, ranked: Sequence[Advice]) -> ReportTable:
    rows = [
        [f"{k}. {each.words}", percent(NORMAL_95 * each.scale_stddev), _half_width_95(each.place_stddev_m, "m")]
        for k, each in enumerate(ranked, 1)
    ]
    columns = ["one change", "scale then ± (95 %)", "that keyframe then ± (95 %)"]
    if ranked and np.isnan(ranked[0].place_stddev_m):  # the first camera's frame has no place
        rows, columns = [row[:2] for row in rows], columns[:2]
    return ReportTable(caption, columns, rows, kind="worded")


def _components(plan: SurveyPlan) -> ReportTable:
    components = plan.expected.uncertainty.components
    words = component_words(components)
    largest = sorted(components.items(), key=lambda item: -item[1])
    rows = [[words[name], percent(NORMAL_95 * stddev)] for name, stddev in largest]
    return ReportTable("What makes the scale uncertain", ["", "± of the scale (95 %)"], rows, is_narrow=True)


def _anchors(plan: SurveyPlan) -> ReportTable:
    rows = [[name, *(fixed(x, 2) for x in place)] for name, place in plan.anchors_m.items()]
    return ReportTable("Anchors", ["anchor", "x m", "y m", "z m"], rows, is_narrow=True)


def _by_kind(plan: SurveyPlan) -> ReportTable:
    rows = [
        [
            f"{kind} alone",
            percent(NORMAL_95 * alone.uncertainty.empirical),
            "no place" if math.isnan(alone.worst_keyframe_m) else _half_width_95(alone.worst_keyframe_m, "m"),
        ]
        for kind, alone in plan.by_kind.items()
    ]
    if rows:
        rows.append(
            ["all together", percent(NORMAL_95 * plan.expected.uncertainty.empirical), _keyframe_known_least(plan)]
        )
    header = ["", "scale ± (95 %)", "least certain keyframe ± (95 %)"]
    return ReportTable("What each kind of measurement would give", header, rows, kind="worded")


def _points(plan: SurveyPlan) -> ReportTable:
    rows = [
        [point.name, *(fixed(x, 2) for x in point.position_m), fixed(NORMAL_95 * point.stddev_m, 3)]
        for point in plan.expected.planned.points
    ]
    header = ["point", "x m", "y m", "z m", "± m (95 %)"]
    return ReportTable("Control points", header, rows, is_narrow=True)


def _mistakes(plan: SurveyPlan) -> ReportTable:
    rows = [
        [
            mistake_in_words(each.name, each.subject),
            size_in_words(each.smallest_detectable, each.unit),
            percent(each.effect_on_scale),
            rough(each.effect_on_place_m, "m"),
        ]
        for each in plan.largest_mistakes
    ]
    header = ["mistake", "smallest size found", "changes the scale by", "changes places by"]
    note = (
        "For each kind of mistake the one with the largest effect: the smallest size that will be found, and how much "
        "a mistake of that size changes at most. A scale error of 1 % is 1 cm at 1 m and 10 cm at 10 m."
    )
    return ReportTable("Mistakes just too small to be found", header, rows, note, kind="worded")
