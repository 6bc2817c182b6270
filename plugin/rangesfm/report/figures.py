"""All figures of a result, by the section that shows them."""

from __future__ import annotations

from rangesfm.report import figures_path, figures_ranges, figures_scale
from rangesfm.report.content import Content
from rangesfm.report.plot import Figure

SECTIONS = {
    "path": (figures_path.trajectory_views, figures_path.map_views, figures_path.local_scale),
    "scale": (
        figures_scale.scale_per_anchor,
        figures_scale.bootstrap,
        figures_scale.consensus,
        figures_scale.clock_curve,
        figures_scale.candidates,
    ),
    "ranges": (
        figures_ranges.residuals_over_time,
        figures_ranges.residual_histogram,
        figures_ranges.absolute_errors,
    ),
}


def figures_of(content: Content, section: str) -> list[Figure]:
    """What a section has to show of this result."""
    made = (make(content) for make in SECTIONS[section])
    return [figure for figure in made if figure is not None]


def all_figures(content: Content) -> list[Figure]:
    """Every figure of the result, in the page's order."""
    return [figure for section in SECTIONS for figure in figures_of(content, section)]
