"""The report as a reader has it: opened from disk in a browser, light, dark, narrow and on paper."""

from __future__ import annotations

import base64
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from rangesfm.report import write_report

if TYPE_CHECKING:
    from tests.report.in_browser.conftest import Browser, Pixels

MakeResult = Callable[..., Path]
NUM_CHARTS = 20  # plan and elevation twice, local scale, five of scale and clock, eight anchors, histogram, true errors
WIDTHS_PX = (320, 390, 768, 1280)
EVIL = "</script><script>document.title = 'broken out'</script>"

# Of every text: its own colour on the nearest opaque background, as WCAG 2 has it; large text needs less.
CONTRASTS = """
const channel = c => (c /= 255) <= 0.04045 ? c / 12.92 : ((c + 0.055) / 1.055) ** 2.4;
const luminance = rgb => [0.2126, 0.7152, 0.0722].reduce((sum, w, i) => sum + w * channel(rgb[i]), 0);
const parse = text => text.match(/[\\d.]+/g).map(Number);
const isOpaque = rgba => rgba.length === 3 || rgba[3] === 1;
const poor = [];
const walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT);
while (walker.nextNode()) {
  const node = walker.currentNode.parentElement;
  const isSeen = node.checkVisibility() && !node.closest("script, style, title");
  if (!isSeen || !walker.currentNode.textContent.trim()) continue;
  const style = getComputedStyle(node);
  const color = parse(node.namespaceURI.endsWith("svg") ? style.fill : style.color);
  let behind = node;
  while (behind && !isOpaque(parse(getComputedStyle(behind).backgroundColor))) behind = behind.parentElement;
  const ground = parse(getComputedStyle(behind).backgroundColor);
  const [darker, lighter] = [luminance(color), luminance(ground)].sort((a, b) => a - b);
  const ratio = (lighter + 0.05) / (darker + 0.05);
  const size = parseFloat(style.fontSize);
  const isLarge = size >= 24 || (size >= 18.66 && style.fontWeight >= 700);
  if (ratio < (isLarge ? 3 : 4.5)) poor.push([walker.currentNode.textContent.trim(), ratio]);
}
return poor;
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, make_shared_result: MakeResult) -> Path:
    """One report for the tests that only look."""
    folder = tmp_path_factory.mktemp("page") / "a survey & more"
    return write_report(
        make_shared_result(folder, num_keyframes=60, num_ranges_per_anchor=200, num_points=4000, has_photos=True)
    )


def test_an_error_on_the_console_and_a_request_are_noticed(browser: Browser, tmp_path: Path) -> None:
    bad = tmp_path / "bad.html"
    bad.write_text('<!DOCTYPE html><img src="file:///nowhere.png"><script>console.error("found")</script>')
    browser.open(bad)
    assert any("found" in line for line in browser.console())
    assert "file:///nowhere.png" in browser.requests()


def test_it_opens_with_all_figures_a_silent_console_and_no_request(browser: Browser, page: Path) -> None:
    browser.open(page)
    assert browser.console() == []
    assert {url for url in browser.requests() if not url.startswith("data:")} == {page.as_uri()}
    assert browser.run("return document.querySelectorAll('svg.chart').length") == NUM_CHARTS
    assert browser.run("return document.title").startswith("a survey & more")


def test_it_draws_in_the_readers_theme(browser: Browser, page: Path) -> None:
    colors = {
        "light": ((194, 87, 12), (29, 95, 209), (162, 28, 175)),  # scaled, refined, anchors
        "dark": ((251, 154, 80), (121, 169, 255), (229, 138, 242)),
    }
    for theme, other in (("light", "dark"), ("dark", "light")):
        browser.open(page, theme=theme)
        picture = browser.picture("#trajectory")
        assert all(num_pixels(picture, color) > 50 for color in colors[theme])
        assert not any(num_pixels(picture, color) > 10 for color in colors[other])
        assert (np.median(picture) > 200) == (theme == "light")


def num_pixels(picture: Pixels, color: tuple[int, int, int]) -> int:
    """How many pixels have this colour, or nearly."""
    return int((np.abs(picture - color).max(axis=2) < 8).sum())


@pytest.mark.parametrize("theme", ["light", "dark"])
def test_every_text_is_readable(browser: Browser, page: Path, theme: str) -> None:
    browser.open(page, theme=theme)
    assert browser.run(CONTRASTS) == []


def test_unreadable_text_is_noticed(browser: Browser, tmp_path: Path) -> None:
    pale = tmp_path / "pale.html"
    pale.write_text('<body style="background: #fff"><p style="color: #999">pale</p><p style="color: #222">plain</p>')
    browser.open(pale)
    assert [text for text, _ in browser.run(CONTRASTS)] == ["pale"]


@pytest.mark.parametrize("width", WIDTHS_PX)
def test_it_never_scrolls_sideways(browser: Browser, page: Path, width: int) -> None:
    browser.open(page, width=width)
    assert browser.run("return [innerWidth, document.documentElement.scrollWidth]") == [width, width]


def test_every_control_has_a_name(browser: Browser, page: Path) -> None:
    browser.open(page)
    nameless = """
    return [...document.querySelectorAll("button, a, input, img, canvas, svg.chart")].filter(node =>
      !(node.ariaLabel || node.alt || node.textContent.trim() || (node.labels && node.labels[0].textContent.trim()))
    ).filter(node => node.checkVisibility()).map(node => node.outerHTML)
    """
    assert browser.run(nameless) == []


def test_names_from_files_cannot_break_out(browser: Browser, make_result: MakeResult) -> None:
    folder = make_result(anchor_ids=(EVIL, "<img src=x onerror=alert(1)>"), num_keyframes=12, num_ranges_per_anchor=30)
    for table in ("ranges.csv", "scale_candidates.csv"):
        assert EVIL in (folder / table).read_text()
    browser.open(write_report(folder))
    assert browser.console() == []
    assert "broken out" not in browser.run("return document.title")
    assert browser.run("return [...document.querySelectorAll('.label.anchor')].map(x => x.textContent)")[0] == EVIL


def test_the_data_of_figures_are_downloads(browser: Browser, page: Path) -> None:
    browser.open(page)
    for figure, header in (
        ("scale_candidates", "panel,series,time_s,candidate_m_per_unit"),
        ("scale_consensus", "panel,series,scale_m_per_unit,ranges"),
        ("trajectory", "panel,series,x_m,y_m"),
    ):
        link = f"document.querySelector('#{figure} a.csv')"
        text = browser.run(f"return decodeURIComponent({link}.href.slice({link}.href.indexOf(',') + 1))")
        assert text.splitlines()[0] == header
        assert len(text.splitlines()) > 100
        assert browser.run(f"return {link}.download") == f"{figure}.csv"


@pytest.mark.parametrize(
    ("figure", "header"),
    [
        ("range_residuals", "time_s,anchor_id,range_m,residual_scaled_m,residual_refined_m,status"),
        ("absolute_range_errors", "time_s,anchor_id,range_m,range_by_reference_m,error_scaled_m,error_refined_m"),
        ("map_points", "x_m,y_m,z_m,red,green,blue"),
    ],
)
def test_large_data_are_made_when_asked_for(browser: Browser, page: Path, figure: str, header: str) -> None:
    browser.open(page)
    # What the button makes is caught where it is handed to the browser.
    browser.run("URL.createObjectURL = blob => { blob.text().then(text => { window.made = text; }); return '#'; }")
    browser.run(f"document.querySelector('#{figure} button.csv').click()")
    browser.wait_for("window.made")
    lines = browser.run("return window.made").splitlines()
    assert lines[0] == header
    assert len(lines) > 1000
    assert browser.console() == []


def test_on_paper_a_picture_stands_for_the_view(browser: Browser, page: Path) -> None:
    browser.open(page, theme="dark")
    pdf = base64.b64decode(browser.command("Page.printToPDF", printBackground=True)["data"])
    assert len(re.findall(rb"/Type */Page\b", pdf)) >= 3
    assert browser.run("return document.querySelector('.printed').naturalWidth") > 300
    browser.command("Emulation.setEmulatedMedia", media="print")
    hidden: Any = browser.run("return getComputedStyle(document.querySelector('.stage canvas')).display")
    browser.command("Emulation.setEmulatedMedia", media="")
    assert hidden == "none"


def test_without_webgl_the_page_says_so_and_the_rest_works(browser_without_webgl: Browser, page: Path) -> None:
    browser_without_webgl.open(page)
    assert browser_without_webgl.console() == []
    shown = "return document.querySelector('.without-webgl').checkVisibility()"
    assert browser_without_webgl.run(shown)
    assert not browser_without_webgl.run("return document.querySelector('.stage').checkVisibility()")
    assert browser_without_webgl.run("return document.querySelectorAll('svg.chart').length") == NUM_CHARTS
