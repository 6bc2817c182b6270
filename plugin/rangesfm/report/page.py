"""The page around the report's parts."""

from __future__ import annotations

from rangesfm.report import sections
from rangesfm.report.content import Content
from rangesfm.report.head import head
from rangesfm.report.markup import Child, Markup, element
from rangesfm.report.script import ASSETS, policy_source, view_script

# Nothing may be fetched, not even by mistake: the page holds all it shows. One script may run, this package's.
CONTENT_POLICY = "default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src {script}"

STYLES = ("page.css", "view.css")

LOGO = element(
    "svg",
    element("circle", cx="6", cy="18", r="2.4", class_="logo-dot"),
    [element("path", d=f"M6 {18 - r}a{r} {r} 0 0 1 {r} {r}", class_="logo-arc") for r in (6, 10.5, 15)],
    viewBox="0 0 24 24",
    class_="logo",
    aria_hidden="true",
)


def render(content: Content) -> str:
    """The whole page."""
    parts = [
        sections.checks(content),
        sections.view(content),
        sections.path(content),
        sections.scale(content),
        sections.ranges(content),
        sections.anchors(content),
        sections.run(content),
    ]
    return document(f"{content.title} – rangesfm report", content.title, head(content), parts)


def document(title: str, heading: str, *parts: Child, has_script: bool = True, reload: str | None = None) -> str:
    """A whole self-contained page.

    Args:
        has_script: whether it holds a view or buttons that need the page's script.
        reload: seconds after which it loads itself anew, or goes elsewhere ("0; url=..."); None: never.
    """
    script = view_script() if has_script else None
    policy = CONTENT_POLICY.format(script="'none'" if script is None else policy_source(script))
    return "<!DOCTYPE html>\n" + element(
        "html",
        element(
            "head",
            element("meta", charset="utf-8"),
            element("meta", name="viewport", content="width=device-width, initial-scale=1"),
            element("meta", name="color-scheme", content="light dark"),
            element(
                "meta",
                http_equiv="Content-Security-Policy",
                content=policy,
            ),
            None if reload is None else element("meta", http_equiv="refresh", content=reload),
            element("title", title),
            [element("style", Markup((ASSETS / name).read_text(encoding="utf-8"))) for name in STYLES],
        ),
        element(
            "body",
            element(
                "header",
                element("p", LOGO, "rangesfm report", class_="wordmark"),
                element("h1", heading),
            ),
            element("main", parts),
            None if script is None else element("script", Markup(script)),
        ),
        lang="en",
    )
