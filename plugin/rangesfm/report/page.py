"""Pages: templates, the style and the script in one file that fetches nothing."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from rangesfm.report import figures_path, figures_ranges, figures_scale, head, text
from rangesfm.report.chart import ASSETS, page_charts
from rangesfm.report.checks import quality_checks
from rangesfm.report.content import Content
from rangesfm.report.plot import Figure
from rangesfm.report.scene import scene_of, view_of
from rangesfm.report.tables import tables_of

if TYPE_CHECKING:
    from jinja2 import Environment

# Nothing may be fetched, not even by mistake: the page holds all it shows. One script may run, this package's.
CONTENT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src {script}"

TITLES = {"path": "Path", "scale": "Scale", "ranges": "Ranges", "anchors": "Anchors"}
"""Of the sections that show figures (FIGURES) and tables (``tables_of``), in their order."""

FIGURES: dict[str, tuple[Callable[[Content], Figure | None], ...]] = {
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
    "anchors": (),
}

STYLES = ("page.css", "view.css")
_SCRIPTS = (
    *("data", "stage", "points", "cameras", "anchors", "ranges", "grid", "picking", "measuring", "photo_panel"),
    *("charts", "csv", "main"),
)
_FILTERS = (text.count, text.duration, text.fixed, text.plain, text.sentence, text.signed)


def figures_of(content: Content) -> dict[str, list[Figure]]:
    """All that there are of this result, by the section that shows them."""
    made = {section: [make(content) for make in all_of_it] for section, all_of_it in FIGURES.items()}
    return {section: [figure for figure in figures if figure is not None] for section, figures in made.items()}


def render_report(content: Content) -> str:
    """The report of a result."""
    figures = figures_of(content)
    scene = scene_of(content)
    return render(
        "report.html",
        title=f"{content.title} – rangesfm report",
        heading=content.title,
        content=content,
        summary=content.summary,
        checks=quality_checks(content.summary),
        stddevs=head.stddevs(content.summary.scale),
        tiles=head.tiles(content),
        view=None if scene is None else view_of(scene),
        figures=figures,
        charts=page_charts([figure for of_section in figures.values() for figure in of_section]),
        sections=TITLES,
        tables=tables_of(content),
    )


def render(template: str, *, charts: Mapping[str, Any] = MappingProxyType({}), **values: Any) -> str:
    """A whole self-contained page.

    Args:
        charts: what the page's figures are drawn from; with them comes the page's script, for its 3-D view as well.
        values: of the template; whatever is not Markup is escaped.
    """
    script = _script() if charts else None
    policy = CONTENT_POLICY.format(script="'none'" if script is None else _policy_source(script))
    styles = [_asset(name) for name in STYLES]
    page = _environment().get_template(template)
    return page.render(policy=policy, styles=styles, script=script, charts=charts, **values)


def _asset(name: str) -> str:
    return (ASSETS / name).read_text(encoding="utf-8")


def _script() -> str:
    """three.js and Vega, then the page's own files in one scope of their own."""
    libraries = [_asset(f"vendor/{name}.min.js") for name in ("three", "vega")]
    files = [_asset(f"view/{name}.js") for name in _SCRIPTS]
    return f'{"".join(libraries)}\n(() => {{\n"use strict";\n{"".join(files)}}})();\n'


def _policy_source(script: str) -> str:
    """What Content-Security-Policy calls an inline script by."""
    digest = hashlib.sha256(script.encode("utf-8")).digest()
    return f"'sha256-{base64.b64encode(digest).decode('ascii')}'"


def light(color: str) -> Markup:
    """A traffic light, for a table's cell."""
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
    environment.globals |= {"keyed": text.keyed, "decimals_for": text.decimals_for}
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    return environment
