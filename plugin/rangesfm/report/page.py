"""Pages: templates, the style and the script in one file that fetches nothing."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from rangesfm.report import head, tables, text
from rangesfm.report.chart import page_charts
from rangesfm.report.checks import quality_checks
from rangesfm.report.content import Content
from rangesfm.report.figures import SECTIONS, figures_of
from rangesfm.report.scene import scene_of
from rangesfm.report.script import ASSETS, page_script, policy_source
from rangesfm.report.view import view_of

if TYPE_CHECKING:
    from jinja2 import Environment

# Nothing may be fetched, not even by mistake: the page holds all it shows. One script may run, this package's.
CONTENT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src {script}"

STYLES = ("page.css", "view.css")
_FILTERS = (text.count, text.duration, text.fixed, text.plain, text.sentence, text.signed)


def render_report(content: Content) -> str:
    """The report of a result."""
    figures = {section: figures_of(content, section) for section in SECTIONS}
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
        tables=tables,
    )


def render(template: str, *, charts: Mapping[str, Any] = MappingProxyType({}), **values: Any) -> str:
    """A whole self-contained page.

    Args:
        charts: what the page's figures are drawn from; with them comes the page's script, for its 3-D view as well.
        values: of the template; whatever is not Markup is escaped.
    """
    script = page_script() if charts else None
    policy = CONTENT_POLICY.format(script="'none'" if script is None else policy_source(script))
    styles = [(ASSETS / name).read_text(encoding="utf-8") for name in STYLES]
    page = _environment().get_template(template)
    return page.render(policy=policy, styles=styles, script=script, charts=charts, **values)


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
