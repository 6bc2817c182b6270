"""A real browser for the tests of pages: headless Chromium driven by Selenium, software WebGL, no network."""

from __future__ import annotations

import base64
import csv
import io
import json
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image

Pixels = npt.NDArray[np.int64]
TIMEOUT_S = 30.0
_PROGRAMS = ("chromium", "chromium-browser", "google-chrome")
_SWITCHES = ("--headless=new", "--no-sandbox", "--hide-scrollbars", "--disable-dev-shm-usage")
_SOFTWARE_WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
_NO_WEBGL = ("--disable-gpu", "--disable-3d-apis")


class Browser:
    """One browser window, and the messages and requests of its pages."""

    def __init__(self, *, has_webgl: bool = True):
        selenium = pytest.importorskip("selenium.webdriver", reason="selenium is not installed: pip install '.[test]'")
        program = next(filter(None, map(shutil.which, _PROGRAMS)), None)
        driver = shutil.which("chromedriver")
        if program is None or driver is None:
            pytest.skip("no browser to test pages in: apt-get install chromium chromium-driver")
        options = selenium.ChromeOptions()
        options.binary_location = program
        for switch in (*_SWITCHES, *(_SOFTWARE_WEBGL if has_webgl else _NO_WEBGL)):
            options.add_argument(switch)
        options.set_capability("goog:loggingPrefs", {"browser": "ALL", "performance": "ALL"})
        service = selenium.ChromeService(executable_path=driver)
        self._driver = selenium.Chrome(options=options, service=service)

    def open(self, page: Path, *, width: int = 1280, theme: str = "light", is_unfolded: bool = True) -> None:
        """Open a page from disk in a window of this size, wait for its figures and view, and forget earlier logs.

        Args:
            is_unfolded: whether to unfold all sections, as a reader can.
        """
        features = [{"name": "prefers-color-scheme", "value": theme}]
        self.command("Emulation.setEmulatedMedia", features=features)
        self.resize(width)
        for kind in ("browser", "performance"):
            self._driver.get_log(kind)
        self._driver.get(page.as_uri())
        self.wait_for("!document.querySelector('#figures') || window.rangesfmFigures")
        self.wait_for("!document.querySelector('#view') || window.rangesfmView")
        if is_unfolded:
            self.run("document.querySelectorAll('details').forEach(section => { section.open = true; })")

    def resize(self, width: int, height: int = 900) -> None:
        """Give the window another size, without opening the page again."""
        is_phone = width < 600
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": is_phone}
        self.command("Emulation.setDeviceMetricsOverride", **metrics)

    def draw_figures(self) -> None:
        """Draw all figures, not only those near the visible part."""
        self.run("for (const charts of Object.values(rangesfmFigures)) for (const chart of charts) chart.draw()")

    def run(self, script: str, *arguments: Any) -> Any:
        """Run a script in the page, and return its result."""
        return self._driver.execute_script(script, *arguments)

    def wait_for(self, condition: str) -> None:
        """Wait until an expression is true in the page."""
        deadline = time.monotonic() + TIMEOUT_S
        while not self.run(f"return Boolean({condition})"):
            assert time.monotonic() < deadline, f"never came true: {condition}"
            time.sleep(0.05)

    def click_at(self, x: float, y: float) -> None:
        """Click at a position of the window."""
        for kind in ("mousePressed", "mouseReleased"):
            self.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press the mouse at one position and release it at another."""
        steps = [("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)]
        for kind, (x, y) in steps:
            self.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def draw_frame(self) -> None:
        """Wait until everything has been drawn."""
        self._driver.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")

    def picture(self, selector: str) -> Pixels:
        """(h, w, 3) pixels of an element that fits the window, scrolled into its middle, once the next frame is drawn.

        The whole window is captured and cut here: a picture of a part of the page may leave the page scrolled by some
        hundred pixels and, as on a phone, magnified, so that later clicks miss.
        """
        self.run("document.querySelector(arguments[0]).scrollIntoView({block: 'center'})", selector)
        self.draw_frame()
        data = self.command("Page.captureScreenshot")["data"]
        window = np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), dtype=np.int64)
        left, top, right, bottom = self.run(
            "const {left, top, right, bottom} = document.querySelector(arguments[0]).getBoundingClientRect();"
            "return [left, top, right, bottom].map(Math.round)",
            selector,
        )
        assert 0 <= left < right <= window.shape[1]
        assert 0 <= top < bottom <= window.shape[0]
        return window[top:bottom, left:right]

    def console(self) -> list[str]:
        """Return the messages on the console."""
        return [entry["message"] for entry in self._driver.get_log("browser")]

    def requests(self) -> list[str]:
        """Return the addresses that the page requested, including its own and its parts'."""
        messages = [json.loads(entry["message"])["message"] for entry in self._driver.get_log("performance")]
        return [
            message["params"]["request"]["url"]
            for message in messages
            if message["method"] == "Network.requestWillBeSent"
        ]

    def command(self, name: str, **parameters: Any) -> Any:
        """Send a command of the Chrome DevTools Protocol."""
        return self._driver.execute_cdp_cmd(name, parameters)

    def quit(self) -> None:
        self._driver.quit()


def downloaded(browser: Browser, figure: str) -> list[list[str]]:
    """Return the rows of a figure's CSV file, caught where its button hands it to the browser."""
    browser.run(
        "window.made = null;"
        "URL.createObjectURL = blob => { blob.text().then(text => { window.made = text; }); return '#'; };"
        "HTMLAnchorElement.prototype.click = function () { window.fileName = this.download; };"
    )
    browser.run(f"document.querySelector('#{figure} button.csv').click()")
    browser.wait_for("window.made")
    return [*csv.reader(io.StringIO(browser.run("return window.made")))]


@pytest.fixture(scope="session")
def browser() -> Iterator[Browser]:
    """A browser that tests of pages share, because its start takes longer than most of them."""
    shared = Browser()
    yield shared
    shared.quit()


@pytest.fixture
def browser_without_webgl() -> Iterator[Browser]:
    """A browser that cannot draw in three dimensions."""
    own = Browser(has_webgl=False)
    yield own
    own.quit()
