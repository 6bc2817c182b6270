"""The report's sections below its top; None where the run has nothing to show."""

from __future__ import annotations

from rangesfm.report import figures, tables
from rangesfm.report.checks import quality_checks
from rangesfm.report.content import Content
from rangesfm.report.drawing import draw
from rangesfm.report.markup import Child, Markup, element
from rangesfm.report.result_scene import scene_of
from rangesfm.report.traffic_lights import card
from rangesfm.report.view import view as scene_view

WIDE = 600
"""Figures at least so wide stand on their own."""


def checks(content: Content) -> Markup | None:
    """Traffic lights with their limits."""
    cards = [card(check) for check in quality_checks(content.summary)]
    return section("checks", "Quality checks", element("div", cards, class_="checks"))


def view(content: Content) -> Markup | None:
    """The map in 3-D."""
    scene = scene_of(content)
    return None if scene is None else section("view-section", "Map in 3-D", scene_view(scene))


def path(content: Content) -> Markup | None:
    """The path in plan and elevation, and the paper's table."""
    return section("path", "Path", _figures(content, "path"), tables.comparison(content))


def scale(content: Content) -> Markup | None:
    """The scale from each anchor, how it was found, and the paper's two candidates."""
    return section(
        "scale", "Scale", _figures(content, "scale"), tables.two_candidates(content), tables.sensitivity(content)
    )


def ranges(content: Content) -> Markup | None:
    """Residuals over time, their distribution, and what became of the ranges of each anchor."""
    return section(
        "ranges",
        "Ranges",
        _figures(content, "ranges"),
        tables.range_statuses(content),
        tables.ranges_per_anchor(content),
    )


def anchors(content: Content) -> Markup | None:
    """Where the anchors are, and what a tape says."""
    return section("anchors", "Anchors", tables.anchors(content), tables.distances(content))


def run(content: Content) -> Markup | None:
    """How the result came about."""
    columns = _columns(tables.stages(content), tables.refinement(content), tables.versions(content))
    parts = (tables.intrinsics(content), tables.inputs(content), tables.settings(content))
    return section("run", "Run", columns, *parts)


def _figures(content: Content, section: str) -> list[Markup]:
    """Small figures side by side, wide ones and those of many panels on their own."""
    parts: list[Markup] = []
    small: list[Markup] = []
    for figure in figures.figures_of(content, section):
        if figure.layout == "single" and figure.panels[0].size[0] < WIDE:
            small.append(draw(figure))
        else:
            parts += [columns] if (columns := _columns(*small)) else []
            parts.append(draw(figure))
            small = []
    return parts + ([columns] if (columns := _columns(*small)) else [])


def _columns(*parts: Markup | None) -> Markup | None:
    """Parts side by side where there is room."""
    known = [part for part in parts if part is not None]
    return element("div", known, class_="columns") if known else None


def section(id_: str, title: str, *parts: Child) -> Markup | None:
    """A card with a heading; None without anything in it."""
    known = [part for part in parts if part]
    return element("section", element("h2", title), known, id=id_, class_="card") if known else None
