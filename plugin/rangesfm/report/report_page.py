"""HTML pages: templates, style and script in one file that loads nothing from elsewhere."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Iterable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from markupsafe import Markup

from rangesfm.report import figures_mistakes, figures_path, figures_ranges, figures_scale, report_tables, text
from rangesfm.report.chart import ASSETS, css, page_chart
from rangesfm.report.checks import quality_checks
from rangesfm.report.content import Content
from rangesfm.report.facts import facts_of
from rangesfm.report.figures_loops import loops_figure
from rangesfm.report.plot import Figure
from rangesfm.report.scene import view_of_result
from rangesfm.util.files.atomic import new_file

if TYPE_CHECKING:
    from jinja2 import Environment

# The browser must load nothing, not even by mistake, because the page holds all that it shows. Only one script may run:
# that of this package, named by its hash.
CONTENT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src {script}"


class Section(NamedTuple):
    """A card of a page. The page leaves it out where it has neither a figure nor a table with rows.

    Attributes:
        is_open: whether it is unfolded at first.
        is_appendix: whether it stays folded on paper unless the reader unfolds it.
    """

    id: str
    title: str
    figures: Sequence[Figure] = ()
    tables: Sequence[report_tables.ReportTable] = ()
    is_open: bool = True
    is_appendix: bool = False


# Sections of the report: id and title, and the functions that make its figures and tables.
_Parts = tuple[
    Sequence[Callable[[Content], Iterable[Figure]]], Sequence[Callable[[Content], report_tables.ReportTable]]
]
_FOUND = ("found", "Mistakes that the ranges show")
_SECTIONS: dict[tuple[str, str], _Parts] = {
    _FOUND: ((), (partial(report_tables.mistakes, are_found=True),)),
    ("path", "Path"): (
        (figures_path.trajectory_views, figures_path.map_views, loops_figure, figures_path.local_scale),
        (report_tables.comparison,),
    ),
    ("scale", "Scale and clocks"): (
        (figures_scale.scale_per_anchor_figure, figures_scale.consensus, figures_scale.clock_curve),
        (report_tables.scale_by_kind, report_tables.error_budget, report_tables.sensitivity),
    ),
    ("ranges", "Ranges"): (
        (figures_ranges.residuals_over_time, figures_ranges.residual_histogram, figures_ranges.absolute_errors),
        (report_tables.range_statuses, report_tables.ranges_per_anchor),
    ),
    ("anchors", "Anchors and measured lengths"): ((), (report_tables.anchors, report_tables.distances)),
    ("points", "Known points and positions"): ((), (report_tables.control_points,)),
    ("others", "Other measurements"): ((), ()),
}
_APPENDIX: dict[tuple[str, str], _Parts] = {
    ("mistakes", "Mistakes that were tested for and not found"): (
        (figures_mistakes.mistakes_figure,),
        (partial(report_tables.mistakes, are_found=False), report_tables.reliability),
    ),
    ("candidates", "The method of the 2018 paper, for comparison"): (
        (figures_scale.candidates,),
        (report_tables.two_candidates,),
    ),
    ("run", "How it was computed"): (
        (),
        (
            *(report_tables.stages, report_tables.refinement, report_tables.versions, report_tables.notes),
            *(report_tables.intrinsics, report_tables.inputs, report_tables.settings),
        ),
    ),
}
STYLES = ("page.css", "view.css")
_SCRIPTS = (
    *("data", "stage", "points", "cameras", "anchors", "ranges", "grid", "picking", "measuring", "photo_panel"),
    *("charts", "csv", "main"),
)
_FILTERS = (text.count, text.duration, text.fixed, text.percent, text.sentence, text.signed)


def sections_of(content: Content) -> list[Section]:
    """Return all sections of the report, with their figures and tables."""
    sections = []
    for (id_, title), (drawn, listed) in (_SECTIONS | _APPENDIX).items():
        figures = [figure for make in drawn for figure in make(content)]
        tables = [*(make(content) for make in listed), *report_tables.of_kinds(content, id_)]
        is_open, is_appendix = (id_, title) == _FOUND, (id_, title) in _APPENDIX
        sections.append(Section(id_, title, figures, tables, is_open, is_appendix))
    return sections


def render_report(content: Content) -> str:
    """Return the HTML text of the report of a result."""
    return render_page(
        "report.html",
        title=f"{content.title} – rangesfm report",
        heading=content.title,
        summary=content.summary,
        checks=quality_checks(content.summary),
        facts=facts_of(content),
        view=view_of_result(content),
        sections=sections_of(content),
    )


def render_page(template: str, *, sections: Sequence[Section] = (), **values: Any) -> str:
    """Return the HTML text of a whole self-contained page.

    Args:
        template: file name of the Jinja template.
        sections: of the page. The page holds its script, which also draws the 3-D view, only where they have figures.
        values: of the template's variables; text that is not Markup is escaped.
    """
    figures = [figure for section in sections for figure in section.figures]
    charts = {figure.name: [page_chart(panel) for panel in figure.panels] for figure in figures}
    script, source = None, "'none'"
    if charts:  # three.js and Vega, then this package's own files in one scope
        libraries = "".join(_asset(f"vendor/{name}.min.js") for name in ("three", "vega"))
        files = "".join(_asset(f"view/{name}.js") for name in _SCRIPTS)
        script = f'{libraries}\n(() => {{\n"use strict";\n{files}}})();\n'
        digest = hashlib.sha256(script.encode("utf-8")).digest()
        source = f"'sha256-{base64.b64encode(digest).decode('ascii')}'"
    policy, styles = CONTENT_POLICY.format(script=source), [_asset(name) for name in STYLES]
    page = _environment().get_template(template)
    return page.render(policy=policy, styles=styles, script=script, charts=charts, sections=sections, **values)


def write_page(page: str, path: Path) -> None:
    """Write a page as a file. If that fails, no part of the file is left."""
    with new_file(path) as temporary:
        temporary.write_text(page, encoding="utf-8", errors="xmlcharrefreplace")


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def light(color: str) -> Markup:
    """Return a traffic light as HTML, for a cell of a table."""
    macros: Any = _environment().get_template("macros.html").module
    return Markup(macros.light(color))


@cache
def _environment() -> Environment:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader(Path(__file__).with_name("templates")),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {function.__name__: function for function in _FILTERS}
    globals_ = (text.keyed, text.within_95, text.decimals_for, text.said_once, css)
    environment.globals |= {function.__name__: function for function in globals_}
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment
