"""A real browser for the tests of pages: headless Chromium, driven by Selenium, software WebGL, no network."""

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
    """One window, and what pages in it said and asked for."""

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

    def open(self, page: Path, *, width: int = 1280, height: int = 900, theme: str = "light") -> None:
        """Open a page from disk as wide as asked for, its view too; what was logged before is forgotten."""
        features = [{"name": "prefers-color-scheme", "value": theme}]
        self.command("Emulation.setEmulatedMedia", features=features)
        is_phone = width < 600
        metrics = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": is_phone}
        self.command("Emulation.setDeviceMetricsOverride", **metrics)
        for kind in ("browser", "performance"):
            self._driver.get_log(kind)
        self._driver.get(page.as_uri())
        self.wait_for("!document.querySelector('#figures') || window.rangesfmFigures")
        self.wait_for("!document.querySelector('#view') || window.rangesfmView")

    def draw_figures(self) -> None:
        """All of them, not only those near the window."""
        self.run("for (const charts of Object.values(rangesfmFigures)) for (const chart of charts) chart.draw()")

    def run(self, script: str, *arguments: Any) -> Any:
        """What a script in the page returns."""
        return self._driver.execute_script(script, *arguments)

    def wait_for(self, condition: str) -> None:
        """Until an expression is true in the page."""
        deadline = time.monotonic() + TIMEOUT_S
        while not self.run(f"return Boolean({condition})"):
            assert time.monotonic() < deadline, f"never came true: {condition}"
            time.sleep(0.05)

    def click_at(self, x: float, y: float) -> None:
        """A click of the mouse at a place of the window."""
        for kind in ("mousePressed", "mouseReleased"):
            self.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def drag(self, start: tuple[float, float], end: tuple[float, float]) -> None:
        """Press at one place, release at another."""
        steps = [("mousePressed", start), ("mouseMoved", end), ("mouseReleased", end)]
        for kind, (x, y) in steps:
            self.command("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=1, clickCount=1)

    def draw_frame(self) -> None:
        """Wait until what was done has been drawn."""
        self._driver.execute_async_script("requestAnimationFrame(() => requestAnimationFrame(arguments[0]))")

    def picture(self, selector: str) -> Pixels:
        """(h, w, 3) pixels of an element, once the next frame is drawn."""
        self.draw_frame()
        box = self.run(
            "const box = document.querySelector(arguments[0]).getBoundingClientRect();"
            "return {x: box.x + scrollX, y: box.y + scrollY, width: box.width, height: box.height, scale: 1}",
            selector,
        )
        data = self.command("Page.captureScreenshot", clip=box, captureBeyondViewport=True)["data"]
        return np.asarray(Image.open(io.BytesIO(base64.b64decode(data))).convert("RGB"), dtype=np.int64)

    def console(self) -> list[str]:
        """What the page said, but for remarks of the graphics driver on its own speed."""
        return [
            entry["message"] for entry in self._driver.get_log("browser") if "GL Driver Message" not in entry["message"]
        ]

    def requests(self) -> list[str]:
        """Addresses that the page asked for, itself and what it holds included."""
        messages = [json.loads(entry["message"])["message"] for entry in self._driver.get_log("performance")]
        return [
            message["params"]["request"]["url"]
            for message in messages
            if message["method"] == "Network.requestWillBeSent"
        ]

    def command(self, name: str, **parameters: Any) -> Any:
        """A command of the Chrome DevTools Protocol."""
        return self._driver.execute_cdp_cmd(name, parameters)

    def quit(self) -> None:
        self._driver.quit()


def downloaded(browser: Browser, figure: str) -> list[list[str]]:
    """The rows of a figure's CSV file, caught where its button hands it to the browser."""
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
    """The browser that tests of pages share: its start takes longer than most of them."""
    shared = Browser()
    yield shared
    shared.quit()


@pytest.fixture
def browser_without_webgl() -> Iterator[Browser]:
    """One that cannot draw in three dimensions."""
    own = Browser(has_webgl=False)
    yield own
    own.quit()
