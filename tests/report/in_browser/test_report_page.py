"""The report as its readers see it: opened from disk in a browser, light, dark, narrow and in print."""

from __future__ import annotations

import base64
import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image
from tests.report.in_browser.conftest import downloaded

from rangesfm.report import write_report

if TYPE_CHECKING:
    from tests.report.in_browser.conftest import Browser, Pixels

MakeResult = Callable[..., Path]
# Two of plan and two of elevation, local scale, four of scale and clock, two of mistakes, eight of anchors, a
# histogram, and errors.
NUM_CHARTS = 21
WIDTHS_PX = (320, 390, 768, 1280)
# Figures whose data can be downloaded: the columns of the file, and how many rows it has at least.
DOWNLOADS = {
    "scale_candidates": ("panel,series,time_s,candidate_m_per_unit", 100),
    "scale_consensus": ("panel,series,scale_m_per_unit,ranges", 100),
    "trajectory": ("panel,series,x_m,y_m", 100),
    "range_residuals": ("time_s,anchor_id,range_m,residual_scaled_m,residual_refined_m,status", 1000),
    "absolute_range_errors": (
        "time_s,anchor_id,range_m,range_by_reference_m,error_scaled_m,error_refined_m",
        1000,
    ),
    "map_points": ("x_m,y_m,z_m,red,green,blue", 1000),
}
EVIL = "</script><script>document.title = 'broken out'</script>"
HOSTILE = (
    EVIL,
    "<img src=x onerror=alert(1)>",
    "\"'><svg onload=\"document.title = 'broken out'\">",
    "{{7*7}}${7*7}",
    "\N{RIGHT-TO-LEFT OVERRIDE}gpj.1A",
    "__proto__",
    "=HYPERLINK(1)",
)

# Contrast of every text with the nearest opaque background, as WCAG 2 defines it; large text needs less.
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

# Moves the pointer over a place in the data of each figure, and counts how often values are shown.
POINT_AT_FIGURES = """
let told = 0;
for (const chart of Object.values(rangesfmFigures).flat()) {
  const {node, view, spec} = chart, box = node.getBoundingClientRect(), {left, top} = spec.padding;
  const rows = [...chart.rows()], row = rows[Math.floor(rows.length / 2)];
  const [clientX, clientY] = [box.x + left + view.scale("x")(row.x), box.y + top + view.scale("y")(row.y)];
  node.dispatchEvent(new PointerEvent("pointermove", {clientX, clientY}));
  told += !chart.tip.hidden;
}
return told;
"""


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, make_shared_result: MakeResult) -> Path:
    """A report for the tests that only look at it."""
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


def place_in(browser: Browser, chart: str, x: float, y: float) -> tuple[float, float]:
    """Return the window position of a point in a chart's data."""
    browser.run(f"{chart}.node.scrollIntoView({{block: 'center'}})")
    browser.wait_for(f"{chart}.view")
    left, top = browser.run(
        f"const {{node, view, spec}} = {chart}, box = node.getBoundingClientRect(), {{left, top}} = spec.padding;"
        "return [box.x + left + view.scale('x')(arguments[0]), box.y + top + view.scale('y')(arguments[1])]",
        x,
        y,
    )
    return float(left), float(top)


class TestOpened:
    """The page opened once, all unfolded and drawn; the last test clicks on everything."""

    @pytest.fixture(scope="class")
    @classmethod
    def opened(cls, browser: Browser, page: Path) -> Browser:
        browser.open(page)
        browser.draw_figures()
        return browser

    def test_it_opens_with_all_figures_a_silent_console_and_no_request(self, opened: Browser, page: Path) -> None:
        assert opened.console() == []
        assert {url for url in opened.requests() if not url.startswith("data:")} == {page.as_uri()}
        assert opened.run("return document.querySelectorAll('.chart svg').length") == NUM_CHARTS
        assert opened.run("return document.title").startswith("a survey & more")

    def test_every_control_has_a_name(self, opened: Browser) -> None:
        nameless = """
        return [...document.querySelectorAll("button, a, input, img, canvas, .chart")].filter(node =>
          !(node.ariaLabel || node.alt || node.textContent.trim() || (node.labels && node.labels[0].textContent.trim()))
        ).filter(node => node.checkVisibility()).map(node => node.outerHTML)
        """
        assert opened.run(nameless) == []

    def test_the_data_of_figures_are_downloads(self, opened: Browser) -> None:
        for figure, (header, min_num_rows) in DOWNLOADS.items():
            rows = downloaded(opened, figure)
            assert rows[0] == header.split(",")
            assert len(rows) > min_num_rows
            assert opened.run("return window.fileName") == f"{figure}.csv"
        assert opened.console() == []

    def test_a_figures_data_are_those_of_the_result(self, opened: Browser, page: Path) -> None:
        rows = opened.run("return [...rangesfmFigures.scale_consensus[0].rows()].map(Object.values)")
        lines = (page.parent / "scale_consensus.csv").read_text().splitlines()[1:]
        expected = [[float(cell) for cell in line.split(",")] for line in lines]
        np.testing.assert_allclose([row[1:] for row in rows], expected, rtol=1e-6)

    def test_the_pointer_tells_the_values_of_what_is_nearest(self, opened: Browser) -> None:
        chart = "rangesfmFigures.scale_consensus[0]"
        _, scale, num_agreeing = opened.run(f"return Object.values([...{chart}.rows()][50])")
        x, y = place_in(opened, chart, scale, num_agreeing)
        opened.command("Input.dispatchMouseEvent", type="mouseMoved", x=x + 2, y=y - 2)
        said = opened.run(f"return {chart}.tip.checkVisibility() && {chart}.tip.textContent")
        assert said == f"ranges that agree · scale m per unit {scale:.5g} · ranges {num_agreeing:.0f}"
        opened.command("Input.dispatchMouseEvent", type="mouseMoved", x=1, y=1)
        assert not opened.run(f"return {chart}.tip.checkVisibility()")

    def test_the_pointer_names_the_mark_that_is_drawn_under_it(self, opened: Browser) -> None:
        opened.run("document.querySelector('#trajectory').scrollIntoView({block: 'center'})")
        opened.wait_for("rangesfmFigures.trajectory[1].view")
        for i in (0, 3, 7):
            x, y = opened.run(
                "const mark = document.querySelectorAll('#trajectory .chart')[1].querySelectorAll('.mark-symbol path');"
                "const box = mark[arguments[0]].getBoundingClientRect();"
                "return [box.x + box.width / 2, box.y + box.height / 2]",
                i,
            )
            opened.command("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
            tip, shown_x, shown_y = opened.run(
                "const {tip, node} = rangesfmFigures.trajectory[1], box = node.getBoundingClientRect();"
                "return [tip.textContent, box.x + parseFloat(tip.style.left), box.y + parseFloat(tip.style.top)]"
            )
            assert tip.startswith("anchor ")
            assert (shown_x, shown_y) == pytest.approx((x, y), abs=2.0)

    def test_a_wheel_with_a_key_zooms_a_drag_moves_and_a_double_click_goes_back(self, opened: Browser) -> None:
        chart = "rangesfmFigures.scale_candidates[0]"

        def domain() -> list[float]:
            opened.draw_frame()
            low, high = opened.run(f"return {chart}.view.scale('x').domain()")
            return [low, high]

        whole = domain()
        x, y = place_in(opened, chart, 95.0, 1.0)
        wheel = {"type": "mouseWheel", "x": x, "y": y, "deltaX": 0, "deltaY": -240}
        opened.command("Input.dispatchMouseEvent", **wheel, modifiers=2)  # the Ctrl key
        near = domain()
        assert near[1] - near[0] < 0.8 * (whole[1] - whole[0])
        opened.drag((x, y), (x + 80, y))
        moved = domain()
        assert moved[0] < near[0]
        assert moved[1] - moved[0] == pytest.approx(near[1] - near[0])
        for clicks in (1, 2):
            for kind in ("mousePressed", "mouseReleased"):
                opened.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=clicks)
        assert domain() == pytest.approx(whole)
        top = opened.run("return scrollY")
        opened.command("Input.dispatchMouseEvent", **(wheel | {"deltaY": 240}))
        opened.wait_for(f"scrollY > {top}")
        assert domain() == pytest.approx(whole)

    def test_whatever_is_pointed_at_or_clicked_the_console_stays_silent(self, opened: Browser) -> None:
        assert opened.run(POINT_AT_FIGURES) == NUM_CHARTS
        num_clicked = opened.run(
            "window.files = []; HTMLAnchorElement.prototype.click = function () { files.push(this.download); };"
            "const controls = document.querySelectorAll('button, input, summary, a[href^=\"#\"]');"
            "for (const control of controls) control.dispatchEvent(new MouseEvent('click', {bubbles: true}));"
            "return controls.length"
        )
        opened.draw_frame()
        buttons = opened.run("return [...document.querySelectorAll('button.csv')].map(x => `${x.dataset.figure}.csv`)")
        assert num_clicked > len(buttons) > 10
        assert opened.run("return files") == buttons
        assert opened.console() == []


@pytest.mark.parametrize(("theme", "other"), [("light", "dark"), ("dark", "light")])
def test_it_draws_in_the_readers_theme_and_every_text_is_readable(
    browser: Browser, page: Path, theme: str, other: str
) -> None:
    colors = {
        "light": ((194, 87, 12), (29, 95, 209), (162, 28, 175)),  # the scaled path, the refined path, the anchors
        "dark": ((251, 154, 80), (121, 169, 255), (229, 138, 242)),
    }
    browser.open(page, theme=theme)
    browser.draw_figures()
    picture = browser.picture("#trajectory")
    assert all(num_pixels(picture, color) > 50 for color in colors[theme])
    assert not any(num_pixels(picture, color) > 10 for color in colors[other])
    assert (np.median(picture) > 200) == (theme == "light")
    assert browser.run(CONTRASTS) == []


def num_pixels(picture: Pixels, color: tuple[int, int, int]) -> int:
    """Count the pixels that have nearly this colour."""
    return int((np.abs(picture - color).max(axis=2) < 8).sum())


def test_unreadable_text_is_noticed(browser: Browser, tmp_path: Path) -> None:
    pale = tmp_path / "pale.html"
    pale.write_text('<body style="background: #fff"><p style="color: #999">pale</p><p style="color: #222">plain</p>')
    browser.open(pale)
    assert [text for text, _ in browser.run(CONTRASTS)] == ["pale"]


def test_it_never_scrolls_sideways(browser: Browser, page: Path) -> None:
    """The window is made narrower and narrower, as when a reader changes its size."""
    browser.open(page, width=max(WIDTHS_PX))
    browser.draw_figures()
    for width in sorted(WIDTHS_PX, reverse=True):
        browser.resize(width)
        browser.wait_for(f"innerWidth === {width} && document.documentElement.scrollWidth === {width}")


class TestFolded:
    """The page opened once, folded as it is when it is opened; each test leaves it so."""

    @pytest.fixture(scope="class")
    @classmethod
    def opened(cls, browser: Browser, page: Path) -> Browser:
        browser.open(page, is_unfolded=False)
        return browser

    def test_one_screen_answers_what_a_client_asks(self, opened: Browser) -> None:
        for shown in ("h1", "#verdict .figure", ".stage canvas", "[name=measure]", ".facts > :last-child"):
            bottom = opened.run("return document.querySelector(arguments[0]).getBoundingClientRect().bottom", shown)
            assert 0 < bottom <= 900, shown
        folded = opened.run("return [...document.querySelectorAll('details:not([open])')].map(section => section.id)")
        assert folded == [
            "view-section",
            "checks",
            "path",
            "scale",
            "ranges",
            "anchors",
            "mistakes",
            "candidates",
            "run",
        ]
        assert not opened.run("return document.querySelector('#ranges .chart').checkVisibility()")
        assert opened.run("return document.querySelector('#found table').checkVisibility()")

    def test_a_folded_section_shows_its_figures_as_wide_as_it_is(self, opened: Browser) -> None:
        opened.wait_for("Object.values(rangesfmFigures).flat().every(chart => chart.view)")  # drawn while folded
        opened.run("document.querySelector('#ranges summary').click()")
        opened.draw_frame()
        widths = opened.run(
            "return rangesfmFigures.range_residuals.map("
            "({node}) => [node, node.querySelector('svg')].map(element => element.clientWidth))"
        )
        assert all(room > 200 and drawn == pytest.approx(room, abs=1) for room, drawn in widths)
        opened.run("document.querySelector('#ranges summary').click()")

    def test_paper_has_all_but_the_appendix_unfolded(self, opened: Browser) -> None:
        unfolded = "return [...document.querySelectorAll('details[open]')].map(section => section.id)"
        opened.run("dispatchEvent(new Event('beforeprint'))")
        assert opened.run(unfolded) == ["view-section", "checks", "path", "scale", "ranges", "anchors"]
        opened.run("dispatchEvent(new Event('afterprint'))")
        assert opened.run(unfolded) == []
        a4 = {"paperWidth": 8.27, "paperHeight": 11.69, "printBackground": True}
        pdf = base64.b64decode(opened.command("Page.printToPDF", **a4)["data"])
        assert len(re.findall(rb"/Type */Page\b", pdf)) <= 9
        assert opened.console() == []


def test_names_from_files_cannot_break_out(
    browser: Browser, make_result: MakeResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = (*HOSTILE, "constructor", "1.jpg", "2.jpg")
    monkeypatch.setattr("tests.report.conftest._names", lambda num: photos[:num])
    folder = make_result(anchor_ids=HOSTILE, num_keyframes=len(photos), num_ranges_per_anchor=30, num_points=500)
    for table in ("ranges.csv", "scale_candidates.csv", "images.csv"):
        assert EVIL in (folder / table).read_text()
    path = write_report(folder)
    browser.open(path)
    browser.draw_figures()
    assert browser.console() == []
    assert "broken out" not in browser.run("return document.title")
    browser.wait_for("document.querySelector('.label.anchor')")  # with the first frame
    labels = "return [...document.querySelectorAll('.label.anchor')].map(x => x.textContent)"
    assert sorted(browser.run(labels)) == sorted(HOSTILE)
    said = [
        browser.run(f"rangesfmView.choose({k}); return document.querySelector('.photo h3').textContent")
        for k in range(len(photos))
    ]
    assert said == [*photos]
    assert browser.console() == []
    assert {url for url in browser.requests() if not url.startswith("data:")} == {path.as_uri()}
    rows = downloaded(browser, "range_residuals")[1:]
    assert {row[1] for row in rows} == {*HOSTILE[:-1], f"'{HOSTILE[-1]}"}


def test_on_paper_a_picture_stands_for_the_view(browser: Browser, page: Path) -> None:
    browser.open(page, theme="dark")
    pdf = base64.b64decode(browser.command("Page.printToPDF", printBackground=True)["data"])
    assert len(re.findall(rb"/Type */Page\b", pdf)) >= 3
    assert browser.run("return document.querySelector('.printed').naturalWidth") > 300
    # The picture has the names of the anchors, the scale bar and the grid, which stand over the view.
    data = browser.run("return document.querySelector('.printed').src").partition(",")[2]
    with Image.open(io.BytesIO(base64.b64decode(data))) as picture:
        pixels = np.asarray(picture.convert("RGB"), dtype=np.int64)
    for selector in (".label.anchor", ".scale-bar", ".grid-cell"):
        rgb = browser.run("return getComputedStyle(document.querySelector(arguments[0])).color", selector)
        color = [int(part) for part in re.findall(r"\d+", rgb)[:3]]
        assert np.count_nonzero(np.abs(pixels - color).max(axis=2) < 3) > 20, selector
    assert browser.run("return document.querySelectorAll('.chart svg').length") == NUM_CHARTS
    browser.command("Emulation.setEmulatedMedia", media="print")
    hidden: Any = browser.run("return getComputedStyle(document.querySelector('.stage canvas')).display")
    browser.command("Emulation.setEmulatedMedia", media="")
    assert hidden == "none"


def test_without_webgl_the_page_says_so_and_the_rest_works(browser_without_webgl: Browser, page: Path) -> None:
    browser_without_webgl.open(page)
    browser_without_webgl.draw_figures()
    assert browser_without_webgl.console() == []
    shown = "return document.querySelector('.without-webgl').checkVisibility()"
    assert browser_without_webgl.run(shown)
    assert not browser_without_webgl.run("return document.querySelector('.stage').checkVisibility()")
    assert browser_without_webgl.run("return document.querySelectorAll('.chart svg').length") == NUM_CHARTS
