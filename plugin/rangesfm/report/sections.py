"""The report's sections below its top; None where the run has nothing to show."""

from __future__ import annotations

from rangesfm.report import figures, tables
from rangesfm.report.checks import quality_checks
from rangesfm.report.content import Content
from rangesfm.report.markup import Markup, element
from rangesfm.report.traffic_lights import card


def checks(content: Content) -> Markup | None:
    """Traffic lights with their limits."""
    cards = [card(check) for check in quality_checks(content.summary)]
    return _section("checks", "Quality checks", element("div", cards, class_="checks"))


def path(content: Content) -> Markup | None:
    """The path in plan and elevation, and the paper's table."""
    return _section("path", "Path", figures.trajectory_views(content), tables.comparison(content))


def scale(content: Content) -> Markup | None:
    """The scale from each anchor, and the paper's two candidates."""
    return _section("scale", "Scale", _columns(figures.scale_per_anchor(content), tables.two_candidates(content)))


def ranges(content: Content) -> Markup | None:
    """Residuals over time, their distribution, and what became of the ranges of each anchor."""
    return _section(
        "ranges",
        "Ranges",
        figures.residuals_over_time(content),
        _columns(figures.residual_histogram(content), tables.range_statuses(content)),
        tables.ranges_per_anchor(content),
    )


def anchors(content: Content) -> Markup | None:
    """Where the anchors are."""
    return _section("anchors", "Anchors", tables.anchors(content))


def run(content: Content) -> Markup | None:
    """How the result came about."""
    columns = _columns(tables.stages(content), tables.refinement(content), tables.versions(content))
    return _section("run", "Run", columns, tables.settings(content))


def _columns(*parts: Markup | None) -> Markup | None:
    """Parts side by side where there is room."""
    known = [part for part in parts if part is not None]
    return element("div", known, class_="columns") if known else None


def _section(id_: str, title: str, *parts: Markup | None) -> Markup | None:
    known = [part for part in parts if part is not None]
    return element("section", element("h2", title), known, id=id_, class_="card") if known else None
