"""The report's 3-D view: what it draws, and how it responds."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pycolmap
import pytest
from tests.known import known
from tests.report.conftest import ANCHORS
from tests.report.in_browser.conftest import downloaded

import rangesfm
from rangesfm.report import write_report
from rangesfm.result.joint_covariance import write_map_errors
from rangesfm.util.geometry.map_errors import MapErrors, PartErrors

if TYPE_CHECKING:
    from tests.report.in_browser.conftest import Browser, Pixels

MakeResult = Callable[..., Path]
PHONE_PX, DESKTOP_PX = 390, 1280
REFINED, SCALED = (29, 95, 209), (194, 87, 12)
NUM_KEYFRAMES = 40
CENTER = "Array.from(rangesfmView.path.centers.subarray(3 * ({0}), 3 * ({0}) + 3))"


@pytest.fixture(scope="module")
def page(tmp_path_factory: pytest.TempPathFactory, make_shared_result: MakeResult) -> Path:
    folder = tmp_path_factory.mktemp("view") / "survey"
    return write_report(
        make_shared_result(folder, num_keyframes=NUM_KEYFRAMES, num_ranges_per_anchor=120, has_photos=True)
    )


@pytest.fixture
def opened(browser: Browser, page: Path) -> Browser:
    """The page on a desktop, scrolled to the view."""
    return open_view(browser, page, DESKTOP_PX)


def open_view(browser: Browser, page: Path, width: int) -> Browser:
    browser.open(page, width=width)
    browser.run("document.querySelector('.stage').scrollIntoView({block: 'center'})")
    browser.wait_for("window.rangesfmView && rangesfmView.stage")
    return browser


def num_pixels(picture: Pixels, color: tuple[int, int, int]) -> int:
    return int((np.abs(picture - color).max(axis=2) < 12).sum())


def toggle(browser: Browser, name: str, value: str) -> None:
    browser.run(f"document.querySelector('#view [name={name}][value=\"{value}\"]').click()")


def place_of(browser: Browser, position: str) -> tuple[float, float]:
    """Return the window position of a point of the scene."""
    x, y = browser.run(
        "const box = document.querySelector('.stage canvas').getBoundingClientRect();"
        f"const [x, y] = rangesfmView.stage.pixelOf({position}); return [x + box.x, y + box.y]"
    )
    return float(x), float(y)


def text_of(browser: Browser, selector: str) -> str:
    return str(browser.run("return document.querySelector(arguments[0]).textContent", selector))


def test_layers_take_away_what_is_drawn(opened: Browser) -> None:
    at_first = opened.picture(".stage canvas")
    assert num_pixels(at_first, SCALED) < 5
    toggle(opened, "layer", "scaled")
    before = full = opened.picture(".stage canvas")
    assert np.std(full) > 5
    for color in (REFINED, SCALED):
        assert num_pixels(full, color) > 30
    for layer in ("points", "refined", "scaled"):
        toggle(opened, "layer", layer)
        after = opened.picture(".stage canvas")
        assert np.any(after != before)
        before = after
    assert num_pixels(before, SCALED) < 5
    toggle(opened, "layer", "anchors")
    opened.draw_frame()
    assert opened.run("return [...document.querySelectorAll('.label.anchor')].every(label => !label.checkVisibility())")
    assert opened.console() == []


class TestOnAPhone:
    """The page opened once; no test changes what the next one looks at."""

    @pytest.fixture(scope="class")
    @classmethod
    def phone(cls, browser: Browser, page: Path) -> Browser:
        return open_view(browser, page, PHONE_PX)

    def test_the_path_is_drawn_without_a_word_on_the_console(self, phone: Browser) -> None:
        assert num_pixels(phone.picture(".stage canvas"), REFINED) > 30
        assert phone.console() == []

    def test_the_grid_and_the_scale_bar_are_round_lengths(self, phone: Browser) -> None:
        assert re.fullmatch(r"grid [125]0* c?m", text_of(phone, ".grid-cell"))
        bar = text_of(phone, ".scale-bar")
        assert re.fullmatch(r"[125]0* c?m", bar)
        length = float(bar.split()[0]) / (100 if bar.endswith("cm") else 1)
        drawn = phone.run("return parseFloat(document.querySelector('.scale-bar').style.width)")
        assert drawn * phone.run("return rangesfmView.stage.metresPerPixel()") == pytest.approx(length, rel=0.01)

    def test_points_stand_where_the_map_has_them(self, phone: Browser) -> None:
        """The tolerance covers the resolution in which points are packed, a fraction of a millimetre."""
        low, high = phone.run(
            "const num = rangesfmView.scene.points.num;"
            "const all = Array.from({length: num}, (_, i) => rangesfmView.pointAt(i));"
            "return [Math.min, Math.max].map("
            "f => [0, 1, 2].map(axis => all.reduce((m, p) => f(m, p[axis]), all[0][axis])))"
        )
        # The made-up result is a room with walls at these places, with noise.
        origin = phone.run("return rangesfmView.scene.origin")
        assert np.add(low, origin) == pytest.approx(np.array((-2.4, -2.9, 0.0)), abs=0.1)
        assert np.add(high, origin) == pytest.approx(np.array((2.4, 2.9, 2.3)), abs=0.1)

    def test_a_click_on_a_camera_shows_its_photo_and_its_ranges(self, phone: Browser) -> None:
        assert_a_click_shows_the_photo(phone)


def test_ranges_are_filtered_by_status_and_photo(opened: Browser) -> None:
    def num_drawn() -> int:
        return int(text_of(opened, ".num-lines").split()[0])

    of_one = num_drawn()
    toggle(opened, "all-photos", "all")
    of_all = num_drawn()
    assert of_all > 5 * of_one > 0
    statuses = opened.run("return rangesfmView.scene.ranges.statuses")
    for status in ("used", "down-weighted"):
        toggle(opened, "status", str(statuses.index(status)))
    assert num_drawn() == 0
    toggle(opened, "status", str(statuses.index("outlier")))
    outliers = opened.run(
        "const {ranges} = rangesfmView.scene; const outlier = ranges.statuses.indexOf('outlier');"
        "return ranges.status.filter((status, i) => status === outlier && ranges.has_place[i]).length"
    )
    assert num_drawn() == outliers > 0


def test_a_click_on_a_camera_shows_its_photo_and_its_ranges(opened: Browser) -> None:
    assert_a_click_shows_the_photo(opened)


def assert_a_click_shows_the_photo(opened: Browser) -> None:
    wanted = 11
    opened.run("rangesfmView.look('plan')")
    opened.picture(".stage canvas")
    opened.click_at(*place_of(opened, CENTER.format(wanted)))
    chosen = opened.run("return rangesfmView.chosen")
    centers = [opened.run(f"return {CENTER.format(index)}") for index in (wanted, chosen)]
    near = np.linalg.norm(np.subtract(*centers)[:2])  # in plan one camera may hide another
    assert near < 0.3
    assert text_of(opened, ".photo h3") == f"image{chosen:05d}.jpg"
    assert opened.run("return document.querySelector('[name=photo]').value") == str(chosen)
    opened.wait_for("document.querySelector('.photo img').naturalWidth > 0")
    listed = opened.run("return document.querySelectorAll('.photo tbody tr').length")
    assert 0 < listed == int(text_of(opened, ".num-ranges").split()[0])


def test_the_slider_walks_along_the_path(opened: Browser) -> None:
    before = opened.picture(".stage canvas")
    opened.run(
        "const slider = document.querySelector('[name=photo]'); slider.value = arguments[0];"
        "slider.dispatchEvent(new Event('input'))",
        str(NUM_KEYFRAMES - 1),
    )
    assert text_of(opened, ".photo h3") == f"image{NUM_KEYFRAMES - 1:05d}.jpg"
    assert f"Photo {NUM_KEYFRAMES} of {NUM_KEYFRAMES}" in text_of(opened, ".photo .place")
    assert np.any(opened.picture(".stage canvas") != before)


def test_two_clicks_measure_a_distance_with_its_interval(opened: Browser) -> None:
    anchors = opened.run("return rangesfmView.scene.anchors.map(anchor => anchor.position)")
    toggle(opened, "layer", "points")
    toggle(opened, "measure", "on")
    opened.picture(".stage canvas")
    for i in (0, 5):
        opened.click_at(*place_of(opened, f"rangesfmView.scene.anchors[{i}].position"))
    distance = float(np.linalg.norm(np.subtract(anchors[0], anchors[5])))
    said = re.fullmatch(
        r"anchor 1 to anchor 6: ([\d.]+) m \(95 % interval, from the scale alone: ([\d.]+) to ([\d.]+) m\)",
        text_of(opened, ".measured"),
    )
    assert said is not None
    half = 1.96 * 0.00412 / 0.74213
    expected = [distance, distance * (1 - half), distance * (1 + half)]
    assert [float(value) for value in said.groups()] == pytest.approx(expected, abs=6e-4)
    opened.wait_for("document.querySelector('.label.distance')")  # with the next frame
    assert text_of(opened, ".label.distance") == f"{distance:.3f} m"


@pytest.fixture(scope="module")
def page_with_errors(tmp_path_factory: pytest.TempPathFactory, make_shared_result: MakeResult) -> Path:
    """A page of a result that holds how its parts err together: by some modes at random, and by rests."""
    folder = make_shared_result(tmp_path_factory.mktemp("errors") / "survey", num_keyframes=12, num_points=500)
    rng = np.random.default_rng(4)

    def parts(ids: tuple[Any, ...], size: int) -> PartErrors:
        rest = 1e-5 * np.eye(size)
        shape = len(ids), size
        return PartErrors(
            ids, 0.02 * rng.normal(size=(*shape, 9)), np.tile(rest, (len(ids), 1, 1)), rng.normal(size=shape)
        )

    frame_ids = tuple(range(1, 13))
    anchor_ids = tuple(str(k) for k in range(1, 9))
    write_map_errors(MapErrors({"frame": parts(frame_ids, 6), "anchor": parts(anchor_ids, 3)}, 0.004), folder)
    return write_report(folder)


def test_the_page_measures_as_the_command_does(browser: Browser, page_with_errors: Path) -> None:
    browser.open(page_with_errors)
    for first, second in ((0, 11), (3, 12), (14, 19)):
        names = browser.run(
            "const { measuring, path, scene } = rangesfmView; measuring.clear();"
            "const center = row => Array.from(path.centers.subarray(3 * row, 3 * row + 3));"
            "const ends = arguments[0].map(row => row < 12"
            " ? {kind: 'camera', name: path.names[row], position: center(row), row}"
            " : {kind: 'anchor', name: scene.anchors[row - 12].id, position: scene.anchors[row - 12].position, row});"
            "ends.forEach(end => measuring.add(end)); return ends.map(end => end.name);",
            [first, second],
        )
        (expected,) = rangesfm.measure(page_with_errors.parent, [tuple(names)]).rows
        said = re.findall(r"[+-]?\d+\.\d{3}", text_of(browser, ".measured").replace("−", "-"))
        heights = known(expected.height_difference_m), *known(expected.height_interval_m)
        wanted = [expected.distance_m, *expected.distance_interval_m, *heights]
        assert [float(number) for number in said] == pytest.approx(wanted, abs=6e-4)


def test_a_point_of_the_map_is_measured_by_the_command(browser: Browser, page_with_errors: Path) -> None:
    browser.open(page_with_errors)
    point = browser.run(
        "const { measuring, scene, path } = rangesfmView; measuring.clear();"
        "measuring.add({kind: 'point', name: scene.points.ids[5], position: rangesfmView.pointAt(5), row: null});"
        "measuring.add({kind: 'camera', name: path.names[2], position: [0, 0, 0], row: 2}); return scene.points.ids[5]"
    )
    command = f"rangesfm measure RESULT point:{point} image00002.jpg"
    assert f"(its 95 % interval: {command})" in text_of(browser, ".measured")
    model = pycolmap.Reconstruction(page_with_errors.parent / "sparse_metric" / "0")
    at = np.add(browser.run("return rangesfmView.pointAt(5)"), browser.run("return rangesfmView.scene.origin"))
    assert np.linalg.norm(model.point3D(point).xyz - at) < 1e-3


def test_a_drag_turns_the_view_and_chooses_nothing(opened: Browser) -> None:
    before, chosen = opened.picture(".stage canvas"), opened.run("return rangesfmView.chosen")
    x, y = place_of(opened, "rangesfmView.stage.center")
    opened.drag((x, y), (x + 60, y + 20))
    assert np.any(opened.picture(".stage canvas") != before)
    assert opened.run("return rangesfmView.chosen") == chosen


def test_in_the_coordinates_of_a_national_grid_all_stands_where_it_is_to_a_millimetre(
    browser: Browser, make_result: MakeResult
) -> None:
    offset_m = np.array((450000.25, 5400000.5, 312.0))
    folder = make_result(num_keyframes=12, num_ranges_per_anchor=20, num_points=300, offset_m=offset_m)
    browser.open(write_report(folder))
    browser.wait_for("window.rangesfmView && rangesfmView.stage")
    model = pycolmap.Reconstruction(folder / "sparse_metric" / "0")
    centers = np.array([model.find_image_with_name(name).projection_center() for name in _names(browser)])
    origin = np.array(browser.run("return rangesfmView.scene.origin"))
    drawn = np.reshape(browser.run("return Array.from(rangesfmView.path.centers)"), (-1, 3))
    assert np.abs(drawn).max() < 10
    assert np.abs(drawn + origin - centers).max() < 1e-4
    anchors = np.array(browser.run("return rangesfmView.scene.anchors.map(({ position }) => position)"))
    assert np.abs(anchors + origin - offset_m - ANCHORS).max() < 1e-9
    said = re.search(r"x, y, z = ([\d.]+), ([\d.]+), ([\d.]+) m", text_of(browser, ".photo .place"))
    assert said is not None
    index = int(browser.run("return rangesfmView.chosen"))
    assert np.abs(np.array(said.groups(), dtype=float) - centers[index]).max() <= 5.01e-4
    points = np.array([point.xyz for point in model.points3D.values()])
    made = np.array([row[:3] for row in downloaded(browser, "map_points")[1:]], dtype=float)
    assert len(made) == len(points)
    assert max(np.linalg.norm(points - row, axis=1).min() for row in made) < 1e-3
    rows = downloaded(browser, "trajectory")[1:]
    refined = [row[2:] for row in rows if row[:2] == [rows[0][0], "refined"]]
    assert np.abs(np.array(refined, dtype=float) - centers[:, :2]).max() < 1e-3


def _names(browser: Browser) -> list[str]:
    return list(browser.run("return rangesfmView.path.names"))
