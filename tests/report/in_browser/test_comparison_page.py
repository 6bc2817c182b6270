"""The page of a comparison, in a browser: all paths in one view."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rangesfm.comparison.comparison_page import write_comparison
from rangesfm.comparison.many_models import compare_many, read_named_models

if TYPE_CHECKING:
    from tests.report.in_browser.conftest import Browser

MakeResult = Callable[..., Path]


def test_lengths_are_in_metres_only_where_the_first_model_is(
    browser: Browser, make_result: MakeResult, tmp_path: Path
) -> None:
    result = make_result("result", num_keyframes=30, num_ranges_per_anchor=20, num_points=500)
    unscaled = tmp_path / "sfm" / "0"
    shutil.copytree(result / "sparse_scaled" / "0", unscaled)
    for first, others, unit in ((result, unscaled, "c?m"), (unscaled, result, "SfM units")):
        page = write_comparison(compare_many(read_named_models([first, others])), tmp_path / "page")
        browser.open(page)
        browser.wait_for("window.rangesfmView && document.querySelector('.scale-bar').textContent")
        told = browser.run(
            "return ['.scale-bar', '.grid-cell', '.photo .place'].map(at => document.querySelector(at).innerText)"
        )
        assert all(re.search(rf"\d {unit}(;|$)", text) for text in told), told


def test_all_paths_are_drawn_and_each_can_be_taken_away(
    browser: Browser, make_result: MakeResult, tmp_path: Path
) -> None:
    sizes = {"num_keyframes": 30, "num_ranges_per_anchor": 20, "num_points": 500}
    result = make_result("result", **sizes)
    models = [result, result / "sparse_scaled" / "0", result / "reference.csv"]
    page = write_comparison(compare_many(read_named_models(models)), tmp_path / "page")
    browser.open(page)
    assert browser.console() == []
    assert {url for url in browser.requests() if not url.startswith("data:")} == {page.as_uri()}
    browser.wait_for("window.rangesfmView && rangesfmView.stage")
    assert browser.run("return rangesfmView.scene.paths.map(path => path.names.length)") == [30, 30, 30]
    for layer in ("model-0", "model-1", "model-2", "anchors"):
        before = browser.picture(".stage canvas")
        browser.run(f"document.querySelector('[name=layer][value=\"{layer}\"]').click()")
        assert np.any(browser.picture(".stage canvas") != before), layer
    for width in (390, 1280):
        browser.open(page, width=width)
        assert browser.run("return document.documentElement.scrollWidth") == width
