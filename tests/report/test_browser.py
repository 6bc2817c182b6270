"""The report in a real browser: headless Chromium, from disk."""

from __future__ import annotations

import re
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

from rangesfm.report import write_report

MakeResult = Callable[..., Path]
Browser = Callable[..., tuple[str, list[str]]]
NUM_FIGURES = 12  # plan, elevation, scale per anchor, eight anchors, histogram
TIMEOUT_S = 60
WIDTHS_PX = (320, 390, 768, 1280)


@pytest.fixture
def browser(tmp_path: Path) -> Browser:
    """Opens a page with the given switches; returns its output and what it said on the console."""
    program = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if program is None:
        pytest.fail("these tests need Chromium: apt-get install chromium")

    def run(page: Path, *switches: str) -> tuple[str, list[str]]:
        profile = f"--user-data-dir={tmp_path / 'profile'}"
        common = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", profile]
        logging = ["--enable-logging=stderr", "--v=0"]
        command = [program, *common, *logging, *switches, page.as_uri()]
        done = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT_S, check=True)
        return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]

    return run


def screenshot(browser: Browser, page: Path, *switches: str, width: int = 1280, height: int = 1500) -> Image.Image:
    path = page.with_name("page.png")
    browser(page, f"--screenshot={path}", f"--window-size={width},{height}", *switches)
    return Image.open(path).convert("RGB")


def test_an_error_on_the_console_is_noticed(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "bad.html"
    page.write_text('<!DOCTYPE html><img src="file:///nowhere.png"><script>console.error("found")</script>')
    _, console = browser(page, "--dump-dom")
    assert any("found" in line for line in console)


def test_the_page_opens_with_all_figures_and_a_silent_console(browser: Browser, make_result: MakeResult) -> None:
    dom, console = browser(write_report(make_result("a survey & more")), "--dump-dom")
    assert console == []
    assert len(re.findall(r'<svg[^>]*class="chart"', dom)) == NUM_FIGURES
    assert "<title>a survey &amp; more" in dom


def test_it_draws_in_the_readers_theme(browser: Browser, make_result: MakeResult) -> None:
    page = write_report(make_result())
    light = np.asarray(screenshot(browser, page)).astype(int)
    dark = np.asarray(screenshot(browser, page, "--force-dark-mode")).astype(int)
    assert np.median(light) > 200
    assert np.median(dark) < 60
    for color in ((194, 87, 12), (29, 95, 209), (162, 28, 175)):  # scaled, refined, anchors
        assert num_pixels(light, color) > 100
        assert num_pixels(dark, color) < 10
    for color in ((251, 154, 80), (121, 169, 255), (229, 138, 242)):
        assert num_pixels(dark, color) > 100


def num_pixels(picture: npt.NDArray[np.int64], color: tuple[int, int, int]) -> int:
    """How many pixels have this colour, or nearly."""
    return int((np.abs(picture - color).max(axis=2) < 8).sum())


def test_it_never_scrolls_sideways(browser: Browser, make_result: MakeResult) -> None:
    page = write_report(make_result(num_keyframes=20, num_ranges_per_anchor=20))
    html = re.sub(r"<meta http-equiv[^>]*>", "", page.read_text(encoding="utf-8"))
    measure = "<script>parent.postMessage([innerWidth, document.documentElement.scrollWidth], '*')</script>"
    page.write_text(html.replace("</body>", f"{measure}</body>"), encoding="utf-8")
    # A window cannot be as narrow as a telephone, but a frame in it can.
    frames = "".join(f'<iframe src="{page.name}" width="{width}" style="border: 0"></iframe>' for width in WIDTHS_PX)
    listen = "<script>onmessage = event => { document.title += `${event.data};` }</script>"
    around = page.with_name("around.html")
    around.write_text(f"<!DOCTYPE html><title>seen:</title>{listen}{frames}", encoding="utf-8")
    dom, _ = browser(around, "--dump-dom", "--virtual-time-budget=2000")
    for width in WIDTHS_PX:
        assert f"{width},{width};" in dom
