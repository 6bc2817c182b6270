"""The report page shows what the result says, loads nothing from elsewhere, and copes with missing parts."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from PIL import Image
from tests.outputs import names_in

from rangesfm.cli import main
from rangesfm.errors import InputError
from rangesfm.report import write_report
from rangesfm.report.content import Content
from rangesfm.report.scene import thumbnails, view_of_result
from rangesfm.result.result_folder import read_result_folder

if TYPE_CHECKING:
    from tests.conftest import Command

MakeResult = Callable[..., Path]
SECTIONS = [
    *("verdict", "found", "view-section", "checks", "path", "scale", "ranges", "anchors"),
    *("mistakes", "candidates", "run"),
]
FIGURES = {
    "path": ["trajectory", "map_points", "local_scale"],
    "scale": ["scale_per_anchor", "scale_consensus", "time_offset_curve"],
    "ranges": ["range_residuals", "range_residual_histogram", "absolute_range_errors"],
    "mistakes": ["mistake_tests"],
    "candidates": ["scale_candidates"],
}


class Page(HTMLParser):
    """Text, elements and ids of a page, in their order."""

    def __init__(self, html: str):
        super().__init__()
        self.tags: list[str] = []
        self.ids: list[str] = []
        self.attributes: list[tuple[str, str | None]] = []
        self.texts: list[str] = []
        self.numbers: list[tuple[str, str, float, str]] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "data":
            given = dict(attrs)
            times = float(given.get("data-times") or 1.0)
            self.numbers.append((str(given["data-key"]), str(given["value"]), times, ""))
        self.tags.append(tag)
        self.attributes += attrs
        self.ids += [value for name, value in attrs if name == "id" and value]

    def handle_data(self, data: str) -> None:
        if self.tags[-1:] == ["data"] and self.numbers[-1][3] == "":
            self.numbers[-1] = (*self.numbers[-1][:3], data)
        if self.tags[-1:] not in (["style"], ["script"]) and data.strip():
            self.texts.append(data.strip().replace("\u00a0", " ").replace("\u202f", " "))


def figures_in(folder: Path) -> dict[str, Any]:
    """Return the data of the figures on a folder's page."""
    html = write_report(folder).read_text(encoding="utf-8")
    (data,) = re.findall(r'<script type="application/json" id="figures">(.*?)</script>', html, flags=re.DOTALL)
    figures: dict[str, Any] = json.loads(data)
    return figures


def page_of(folder: Path) -> Page:
    return Page(write_report(folder).read_text(encoding="utf-8"))


def sections_of(page: Page) -> list[str]:
    return [id_ for id_ in page.ids if id_ in SECTIONS]


def figures_of(page: Page) -> list[str]:
    return [id_ for id_ in page.ids if any(id_ in names for names in FIGURES.values())]


def test_the_report_stands_beside_the_result_with_all_its_sections(make_result: MakeResult) -> None:
    folder = make_result("my survey")
    assert write_report(folder) == folder / "report.html"
    page = page_of(folder)
    assert sections_of(page) == SECTIONS
    assert figures_of(page) == [name for names in FIGURES.values() for name in names]
    assert "my survey" in page.texts
    assert not [name for name in names_in(folder) if name.startswith(".")]


def test_the_numbers_are_those_of_the_result(make_result: MakeResult) -> None:
    folder = make_result()
    summary = json.loads((folder / "result.json").read_text())
    texts = page_of(folder).texts
    expected = [
        "0.7421",
        "0.7341",
        "0.7502",
        "10 m in this map are 9.89 to 10.11 m.",
        "Scale: good",
        "Eight anchors agree within 1.5 %.",
        "12 ranges were taken before the first photo.",
        f"{summary['ranges']['rms_m']:.3f} m",
        f"{summary['ranges']['median_abs_m']:.3f} m",
        f"{summary['check_ranges']['rms_m']:.3f} m",
        str(summary["check_ranges"]["num"]),
        "0.83 px",
        "+0.0123 s",
        "rangesfm 0.1.0 in 2 min 10 s (all stages)",
        "1.9132",
        "+1.094",
        "−0.051",
        "0.0214",
        "[refine] range_loss_scale",
        "Residual, in standard deviations, from which a range is down-weighted (Geman-McClure loss) (default: 3.46)",
        "4.2.1",
    ]
    assert [text for text in expected if text not in texts] == []


def value_at(summary: Any, key: str) -> Any:
    """Return the value at a key with dots."""
    for part in key.split("."):
        summary = summary[int(part) if isinstance(summary, list) else part]
    return summary


def numbers_in(value: Any, key: str) -> list[str]:
    """List the keys of all numbers below a value."""
    if isinstance(value, (dict, list)):
        items = value.items() if isinstance(value, dict) else enumerate(value)
        return [found for name, item in items for found in numbers_in(item, f"{key}.{name}")]
    return [key] if isinstance(value, (int, float)) and not isinstance(value, bool) else []


def test_every_number_of_the_result_stands_on_the_page_as_it_is(make_result: MakeResult) -> None:
    folder = make_result()
    summary = json.loads((folder / "result.json").read_text())
    shown = page_of(folder).numbers
    for key, value, times, text in shown:
        assert float(value) == value_at(summary, key)
        shown_as = float(value) * times
        digits = text.replace("−", "-").replace("\u202f", "").removeprefix("+").split("\u00a0")[0]
        decimals = len(digits.partition(".")[2].partition("e")[0])
        assert float(digits) == pytest.approx(shown_as, abs=0.5001 * 10.0**-decimals, rel=1e-12), key
    wanted = [
        found
        for key in ("ranges", "check_ranges", "time_offset", "refine", "comparison", "anchors", "distances")
        for found in numbers_in(summary[key], key)
    ]
    wanted += ["scale.value", "scale.interval_95.0", "scale.interval_95.1"]
    wanted += numbers_in(summary["scale"]["two_candidate"], "scale.two_candidate")
    # Some numbers are shown otherwise: ranges in the table of statuses, surveyed positions as differences, lever arms
    # in one cell.
    counts = ("num_rejected", "num_anchor_anchor", "num_tag_tag", "num_keyframes", "num_without_root")
    others = [key for key in wanted if key.endswith(counts) or "surveyed" in key or "tag_in_cam_m" in key]
    # A reader shall see one figure of the scale's uncertainty, its 95 % interval, and the scale once.
    of_scale = {"refine.relative_scale_stddev", "refine.scale_value"}
    assert not of_scale & {key for key, *_ in shown}
    others += of_scale
    assert set(wanted) - set(others) <= {key for key, *_ in shown}


def doubtful_place(reason: str, stddev_m: list[float]) -> dict[str, Any]:
    others = {"heading_stddev_deg": 0.4, "worst_keyframe_stddev_m": 0.21}
    return {"verdict": "doubtful", "reasons": [reason], "stddev_m": stddev_m, **others}


def test_the_place_has_its_verdict_beside_that_of_the_scale(make_result: MakeResult) -> None:
    place = doubtful_place("why not", [0.03, 0.04, 0.12])
    texts = page_of(make_result(changes={"place": place})).texts
    begin = texts.index("Place: doubtful")
    assert begin > texts.index("Scale: good")
    assert [text for text in texts[begin:] if text in ("0.06 m", "0.08 m", "0.24 m", "Why not.")] == [
        *("0.06 m", "0.08 m", "0.24 m", "Why not.")
    ]
    texts = page_of(make_result("elsewhere", changes={"place": None})).texts
    assert not any(text.startswith("Place") for text in texts)


def facts_on(page: Page) -> dict[str, str]:
    names = ("What was done", "When", "By", "Coordinates", "Computed")
    return {name: page.texts[page.texts.index(name) + 1] for name in names if name in page.texts}


def test_what_was_done_when_by_whom_and_in_which_coordinates(make_result: MakeResult) -> None:
    told = {"report": {"title": "Hall 7, north", "by": "E. Muster"}, "anchors": {"crs": "EPSG:25832"}}
    changes = {"settings": told, "computed": "2026-05-15T08:03:00+00:00", "map": {"num_photos": 20}}
    folder = make_result(num_keyframes=20, num_ranges_per_anchor=10, changes=changes)
    at_s = [1_778_768_430 + 7 * i for i in range(20)]
    rows = "".join(f"image{i:05d}.jpg,{at_s[i]}\n" for i in range(20))
    (folder / "images.csv").write_text(f"image_name,timestamp_s\n{rows}")
    page, summary = page_of(folder), json.loads((folder / "result.json").read_text())
    assert "Hall 7, north" in page.texts
    facts, used = facts_on(page), summary["ranges"]["num_used"]
    assert facts["What was done"].startswith("20 photos along ")
    assert f" {used} of 80 ranges to 8 radio anchors at known positions" in facts["What was done"]
    assert facts["What was done"].endswith("Photos and measurements were adjusted together.")
    assert facts["When"] == "14 May 2026, 14:20 to 14:22 by the photos' clock"
    assert facts["By"] == "E. Muster"
    assert "anchors.csv (EPSG:25832)" in facts["Coordinates"]
    assert facts["Computed"].startswith("15 May 2026, rangesfm 0.1.0 in ")


def test_a_fact_that_is_not_known_is_left_out(make_result: MakeResult) -> None:
    folder = make_result(num_keyframes=5, num_ranges_per_anchor=5, is_refined=False, changes={"frame": "first_camera"})
    facts = facts_on(page_of(folder))  # the photos' clock does not tell the date
    assert facts.keys() == {"What was done", "Coordinates", "Computed"}
    assert facts["What was done"].endswith("The map was scaled as a whole.")
    assert facts["Coordinates"].startswith(
        "x, y, z in metres in the frame of the first photo, image00000.jpg (x right, y down, z forward)."
    )


def test_only_mistakes_that_were_found_stand_above_the_appendix(make_result: MakeResult) -> None:
    page = page_of(make_result(num_keyframes=5, num_ranges_per_anchor=5))
    texts = page.texts
    appendix = texts.index("Appendix")
    assert texts.index("anchor coordinate 1 y", 0, appendix)
    assert "lever arm" not in texts[:appendix]
    assert "lever arm" in texts[appendix:]
    clean = make_result("clean", num_keyframes=5, num_ranges_per_anchor=5, changes={"tests": []})
    assert "found" not in page_of(clean).ids


def test_appendix_says_what_checks_what_was_given_and_bounds_the_scale(make_result: MakeResult) -> None:
    test = {
        "name": "anchor place",
        "statistic": 0.2,
        "threshold": 16.4,
        "size": 0.1,
        "stddev": 0.1,
        "unit": "m",
        "smallest_detectable": 0.41,
        "effect_on_scale": 0.0042,
        "effect_on_place_m": 0.1,
        "rejected": False,
        "words": "w",
        "remedy": "r",
    }
    tests = [
        {**test, "subject": "A10", "redundancy": 0.35, "is_checked": True},
        {**test, "subject": "A9", "redundancy": 0.001, "is_checked": False},
        {**test, "subject": "A8"},  # its redundancy is not known
    ]
    bound = {"scale_within": 0.034, "risk": 1e-4, "limited_by": "lever arm", "unchecked": ["anchor place A9"]}
    changes = {"tests": tests, "reliability": bound}
    texts = page_of(make_result(num_keyframes=5, num_ranges_per_anchor=5, changes=changes)).texts
    first = texts.index("How well given values are checked")
    told = " ".join(texts[first:]).replace("\u00a0", " ")
    given = "position of anchor A9 untested 0.41 m 0.42 % position of anchor A10 35 % 0.41 m 0.42 % Checked"
    assert given in told
    assert "(worst case: lever arm), the scale is off by 3.4 % at most (risk of more: 0.0001)." in told


def test_no_stddev_stands_above_the_appendix(make_result: MakeResult) -> None:
    """A reader compares spreads, so all of them are half of a 95 % interval."""
    texts = page_of(make_result(num_keyframes=5, num_ranges_per_anchor=5)).texts
    assert [text for text in texts[: texts.index("Appendix")] if "stddev" in text] == []


def test_what_would_help_and_what_speaks_against_both_is_said_once(make_result: MakeResult) -> None:
    reason = "probably A3 stands elsewhere: measure it again"
    scale = {
        "reasons": [reason],
        "advice": [
            "calibrate the radio (rangesfm ranges calibrate), or tape",
            "measure it again",
            "calibrate the radio: 2 %",
        ],
    }
    place = doubtful_place(reason, [0.0, 0.0, 0.0])
    texts = page_of(make_result(changes={"scale": scale, "place": place})).texts
    assert [text for text in texts if "measure it again" in text or "calibrate" in text.lower()] == [
        "Probably A3 stands elsewhere: measure it again.",
        "Calibrate the radio (rangesfm ranges calibrate), or tape.",
    ]


def test_what_was_assumed_is_told_in_words(make_result: MakeResult) -> None:
    folder = make_result()
    texts = page_of(folder).texts
    given = json.loads((folder / "result.json").read_text())["scale"]["sensitivity"]
    assert "1 cm, all ranges" in texts
    assert f"{given['common_bias_per_cm']:+.3f}".replace("-", "−") == texts[texts.index("1 cm, all ranges") + 1]
    assert not any("per_cm" in text for text in texts)


def test_every_anchor_has_its_panel_and_its_row(make_result: MakeResult) -> None:
    texts = page_of(make_result()).texts
    assert [text for text in texts if text.startswith("Anchor ") and text[7:].isdigit()] == [
        f"Anchor {i}" for i in range(1, 9)
    ]
    assert texts.count("−2.600") >= 4


def test_the_page_asks_for_nothing_from_elsewhere(make_result: MakeResult) -> None:
    page = page_of(make_result())
    assert {"link", "iframe", "object", "embed"}.isdisjoint(page.tags)
    addresses = [value or "" for name, value in page.attributes if name in ("src", "href", "xlink:href")]
    assert addresses == []
    (policy,) = (value for name, value in page.attributes if name == "content" and value and "default-src" in value)
    assert policy.startswith("default-src 'none'; style-src 'unsafe-inline'; img-src data:; script-src 'sha256-")


def test_the_policy_allows_the_pages_own_script_and_no_other(make_result: MakeResult) -> None:
    html = write_report(make_result(num_keyframes=5, num_ranges_per_anchor=5)).read_text(encoding="utf-8")
    (script,) = re.findall(r"<script>(.*?)</script>", html, flags=re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode("utf-8")).digest()).decode("ascii")
    assert f"script-src &#39;sha256-{digest}&#39;" in html
    assert html.count("<script") == 3  # the other scripts hold data


def test_notes_on_how_the_inputs_were_read_are_no_warnings(make_result: MakeResult) -> None:
    note, warning = "uwb.csv: columns taken: range = d", "no ranges to anchor A9"
    texts = page_of(make_result(changes={"notes": [note], "warnings": [warning]})).texts
    first_screen, appendix = texts[: texts.index("Appendix")], texts[texts.index("Appendix") :]
    assert f"{warning[0].upper()}{warning[1:]}." in first_screen
    assert not any("columns taken" in text for text in first_screen)
    assert f"U{note[1:]}." in appendix


def test_the_page_may_have_another_title_and_author_than_the_run_was_given(make_result: MakeResult) -> None:
    folder = make_result(changes={"settings": {"report": {"title": "Hall", "by": "A. Other"}}})
    assert "Hall" in page_of(folder).texts
    assert main(["report", str(folder), "--report_title", "North wing", "--report_by", "E. Muster"]) == 0
    texts = Page((folder / "report.html").read_text(encoding="utf-8")).texts
    before_appendix = set(texts[: texts.index("Appendix")])  # which has the settings of the run
    assert {"North wing", "E. Muster"} <= before_appendix
    assert not {"Hall", "A. Other"} & before_appendix


def test_names_cannot_inject_markup(make_result: MakeResult) -> None:
    evil = '<script>alert("1")</script>'
    folder = make_result(
        anchor_ids=(evil, "a&b", "'\"><svg onload=alert(1)>"),
        changes={
            "warnings": [f"{evil}!"],
            "settings": {evil: evil},
            "versions": {evil: evil},
            "scale": {"value": 1.0, "reasons": [evil], "advice": [evil], "per_anchor": {evil: 1.0, "a&b": 1.1}},
            "comparison": [
                {
                    "name": evil,
                    "num_keyframes": 2,
                    "rmse_m": None,
                    "rmse_se3_m": None,
                    "rmse_sim3_m": None,
                    "scale_error_percent": None,
                }
            ],
            "seconds": {evil: 1.0},
        },
    )
    page = page_of(folder)
    assert page.tags.count("script") == 3  # the view's data, the figures' data, and the code
    assert not any(name.startswith("on") for name, _ in page.attributes)
    assert page.texts.count(evil) >= 5
    (panel,) = figures_in(folder)["scale_per_anchor"]
    assert sum(mark["name"].startswith(f"anchor {evil}") for mark in panel["marks"]) == 1
    assert f"Anchor {evil}" in page.texts


def test_a_picture_tells_found_mistakes_from_those_not_found_and_those_that_nothing_finds(
    make_result: MakeResult,
) -> None:
    evidence, could_hide = figures_in(make_result())["mistake_tests"]
    assert [one["name"] for one in evidence["series"]] == [
        "found",
        "would not be found, however large",
        "not found",
    ]
    beyond = [mark["x"] > 1.0 for mark in evidence["marks"]]
    assert beyond == [True, False, False]
    assert [mark["x"] for mark in could_hide["marks"]] == [0.42, 20.0, 0.42]


def test_the_same_result_gives_the_same_page(make_result: MakeResult) -> None:
    folder = make_result()
    assert write_report(folder).read_bytes() == write_report(folder).read_bytes()


def test_a_scale_only_result_shows_what_it_has(make_result: MakeResult) -> None:
    page = page_of(make_result(is_refined=False, has_reference=False))
    assert sections_of(page) == SECTIONS
    assert "refined" not in page.texts
    assert "reference" not in page.texts
    assert "not measured" in page.texts
    assert "Keyframe centres against the reference" not in page.texts


def test_a_result_without_ranges_or_models_has_a_page(make_result: MakeResult) -> None:
    folder = make_result(num_keyframes=10, num_ranges_per_anchor=10)
    (folder / "ranges.csv").unlink()
    for stage in ("sparse_scaled", "sparse_metric"):
        for file in (folder / stage / "0").iterdir():
            file.unlink()
        (folder / stage / "0").rmdir()
    assert sections_of(page_of(folder)) == [
        "verdict",
        "found",
        "checks",
        "path",
        "scale",
        "anchors",
        "mistakes",
        "candidates",
        "run",
    ]


def test_a_log_by_photo_without_times_is_drawn_in_its_order(make_result: MakeResult) -> None:
    folder = make_result(num_keyframes=20, num_ranges_per_anchor=20)
    lines = (folder / "ranges.csv").read_text().splitlines()
    by_photo = [lines[0], *(f",image00001.jpg,{line.split(',', 2)[2]}" for line in lines[1:])]
    (folder / "ranges.csv").write_text("\n".join(by_photo))
    (folder / "images.csv").unlink()
    (folder / "reference.csv").unlink()
    panels = figures_in(folder)["range_residuals"]
    assert [panel["labels"][0] for panel in panels] == ["range number"] * 8


def test_a_long_log_makes_no_long_page(make_result: MakeResult) -> None:
    short = write_report(make_result("short", anchor_ids=("A",), num_ranges_per_anchor=500)).stat().st_size
    folder = make_result("long", num_ranges_per_anchor=4000, has_photos=True, num_points=9000)
    long = write_report(folder).stat().st_size
    assert long < 3 * short
    assert long < 3.5e6 + 20 * 9000
    panels = figures_in(folder)["range_residuals"]
    drawn = sum(len(series["points"]["data"]) * 3 // 4 // 8 for panel in panels for series in panel["series"])
    assert drawn < 6_000 + 8 + 16 * 48  # dots and running medians
    assert any("One range in 6 is drawn" in text for text in page_of(folder).texts)


def test_a_broken_table_is_named_with_its_line(make_result: MakeResult) -> None:
    folder = make_result(num_keyframes=5, num_ranges_per_anchor=5)
    lines = (folder / "ranges.csv").read_text().splitlines()
    cells = lines[3].split(",")
    cells[4] = "far"
    (folder / "ranges.csv").write_text("\n".join([*lines[:3], ",".join(cells), *lines[4:]]))
    with pytest.raises(InputError, match=r"ranges\.csv:4: range_m is 'far'"):
        write_report(folder)
    assert not (folder / "report.html").exists()


def test_each_range_begins_at_its_own_tag(make_result: MakeResult) -> None:
    arms = {"tag": [0.0, -0.1, 0.0], "other": [0.4, 0.0, 0.2]}
    folder = make_result(num_keyframes=20, num_ranges_per_anchor=10)
    summary = json.loads((folder / "result.json").read_text())
    summary["settings"]["tag"]["lever_arms_m"] = arms
    (folder / "result.json").write_text(json.dumps(summary))
    lines = (folder / "ranges.csv").read_text().splitlines()
    changed = [line.replace(",tag,", ",other,") if number % 2 else line for number, line in enumerate(lines)]
    (folder / "ranges.csv").write_text("\n".join(changed))
    content = Content(read_result_folder(folder))
    assert content.ranges is not None
    expected = np.array([arms[tag_id] for tag_id in content.ranges.tag_id])
    assert set(content.ranges.tag_id) == {"tag", "other"}
    np.testing.assert_array_equal(content.tags_in_cam_m, expected)
    # With the tag elsewhere on the camera, the distance to the anchor changes by at most the lever arm.
    assert content.final is not None
    in_camera = Content(content.result)
    in_camera.tags_in_cam_m = np.zeros((len(expected), 3))
    known = np.isfinite(content.true_ranges_m)
    assert known.any()
    differences = np.abs(content.true_ranges_m - in_camera.true_ranges_m)[known]
    assert np.all(differences <= np.linalg.norm(expected[known], axis=1) + 1e-9)
    assert differences.max() > 0.2
    assert sorted(view_of_result(content)["ranges"]["tags_in_cam_m"]) == sorted(arms.values())


def test_a_name_from_a_file_fetches_nothing_from_outside_the_folder(tmp_path: Path) -> None:
    folder = tmp_path / "photos"
    (folder / "cam0").mkdir(parents=True)
    for path in (tmp_path / "private.png", folder / "cam0" / "in.png"):
        Image.new("L", (64, 48)).save(path)
    names = ["cam0/in.png", "../private.png", str(tmp_path / "private.png"), "cam0/../../private.png"]
    assert list(thumbnails(folder, names)) == ["cam0/in.png"]


def test_what_is_no_photo_is_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(b"\xff\xd8\xff\xe0 no photo")
    assert thumbnails(tmp_path, ["a.jpg", "missing.jpg"]) == {}


def test_a_thumbnail_is_made_of_no_photo_that_a_link_leads_to_elsewhere(tmp_path: Path) -> None:
    inside, outside = tmp_path / "photos", tmp_path / "private"
    for folder in (inside, outside):
        folder.mkdir()
        Image.new("RGB", (8, 8)).save(folder / "a.png")
    (inside / "b.png").symlink_to(outside / "a.png")
    (inside / "c.png").symlink_to(inside / "a.png")
    (inside / "more").symlink_to(outside)
    (tmp_path / "linked").symlink_to(inside)
    names = ["a.png", "b.png", "c.png", "more/a.png", "../private/a.png"]
    assert list(thumbnails(inside, names)) == ["a.png", "c.png"]
    # the user's own folder, which has such a name
    assert list(thumbnails(tmp_path / "linked", names)) == ["a.png", "c.png"]


def test_photos_of_another_folder_are_on_the_page_only_if_the_reader_says_so(
    make_result: MakeResult, tmp_path: Path, rangesfm_command: Command
) -> None:
    folder = make_result("around/result", num_keyframes=12, num_ranges_per_anchor=5, num_points=10, has_photos=True)
    mine = (folder / "photos").rename(tmp_path / "mine")
    summary = json.loads((folder / "result.json").read_text())
    summary["settings"]["images"]["path"] = str(mine)
    (folder / "result.json").write_text(json.dumps(summary))
    said = rangesfm_command("report", folder, cwd=tmp_path).stdout
    assert said.splitlines()[1].startswith(f"without photos: those of the run are in {mine}, not in the folder around")
    page = folder / "report.html"
    assert "data:image/jpeg" not in page.read_text()
    said = rangesfm_command("report", folder, "--images", mine, cwd=tmp_path).stdout
    assert said.splitlines() == [str(page)]
    assert page.read_text().count("data:image/jpeg") == 12
