"""Terminal, page, result.json and Python tell the same numbers of one survey."""

from __future__ import annotations

import html
import json
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import pytest

import rangesfm

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey

    from rangesfm.result.result_folder import ResultFolder

# Half the width of a 95 % interval, in standard deviations.
HALF = 1.96


@dataclass(frozen=True)
class Told:
    """One survey, told four times: lines of the command, text of the page, result.json, and what Python returns."""

    lines: list[str]
    page: str
    result: dict[str, Any]
    python: ResultFolder

    def line(self, begin: str) -> str:
        (line,) = (line for line in self.lines if line.startswith(begin))
        return line.removeprefix(begin)


@pytest.fixture(scope="module")
def told(walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path_factory: pytest.TempPathFactory) -> Told:
    folder, walked = tmp_path_factory.mktemp("told"), walked_survey.folder
    out = ("--output_path", folder / "by_command", "--reference", "reference.csv")
    flags = [part if part != str(2.0) else "auto" for part in walked_survey.flags]
    printed = rangesfm_command("refine", *flags, "--anchors", "anchors.csv", *out, cwd=walked).stdout
    changes = {"ranges.time_offset": "auto", "report.reference": walked / "reference.csv"}
    survey = walked_survey.survey(folder / "by_python").changed(changes)
    markup = (folder / "by_command" / "report.html").read_text(encoding="utf-8")
    body = re.sub(r"<(script|style).*?</\1>", "", markup, flags=re.DOTALL)
    words = html.unescape(re.sub(r"<[^>]*>", "", re.sub(r"</(?:p|dd|dt|td|th|li|h\d)>", "\n", body)))
    page = words.replace("\u00a0", " ").replace("\u202f", "").replace("−", "-")
    result = json.loads((folder / "by_command" / "result.json").read_text())
    return Told(printed.splitlines(), page, result, rangesfm.run_survey(survey))


def test_python_returns_what_the_command_writes(told: Told) -> None:
    timed = ("seconds", "computed", "settings", "inputs")
    of_python, of_command = told.python.summary.to_json(), dict(told.result)
    for content in (of_python, of_command):
        for name in timed:
            del content[name]
        del content["refine"]["seconds"]
    assert of_python == of_command
    lines = [line for line in told.lines if "by_command" not in line]
    assert [line for line in str(told.python).splitlines() if "by_python" not in line] == lines


def test_the_scale_and_its_interval_are_the_same_everywhere(told: Told) -> None:
    scale = told.result["scale"]
    value, (low, high) = scale["value"], scale["interval_95"]
    words = told.line("accuracy: ").removesuffix(" (95 % interval)")
    least, most = re.fullmatch(r"10 m in this map are ([\d.]+) to ([\d.]+) m", words).groups()  # type: ignore[union-attr]
    decimals = len(least.partition(".")[2])
    assert [float(least), float(most)] == pytest.approx([10 * low / value, 10 * high / value], abs=0.51 * 0.1**decimals)
    assert words in told.page
    assert words in repr(told.python.summary)
    assert told.line("scale: ") == f"{value:.6g} m per SfM unit, 95 % interval {low:.6g} to {high:.6g}"
    on_page = re.search(r"The scale is ([\d.]+) metres per unit .* interval ([\d.]+) to ([\d.]+)\.", told.page)
    assert on_page is not None
    assert [float(number) for number in on_page.groups()] == pytest.approx([value, low, high], abs=6e-4)
    (check,) = re.findall(r"Scale\n\s*([\d.]+) %\n", told.page)
    assert f"the scale is known to {check} % (95 % interval)" in told.line("verdict: good: ")
    # The reference shows the same map: its error is within the interval, told alike in terminal and page.
    of_map = told.result["comparison"][-1]
    assert low / value - 1 < -of_map["scale_error_percent"] / 100 < high / value - 1
    assert f"lengths are {of_map['scale_error_percent']:+.2f} % off" in told.page
    assert any(line.endswith(f"{of_map['scale_error_percent']:+.3f} %") for line in told.lines)


def test_place_clocks_and_residuals_are_the_same_everywhere(told: Told) -> None:
    place, ranges, offset = told.result["place"], told.result["ranges"], told.result["time_offset"]
    for axis, stddev_m in zip("xyz", place["stddev_m"]):
        assert f"{axis} ± {HALF * stddev_m:.2f} m" in told.page
    worst_m = HALF * place["worst_keyframe_stddev_m"]
    assert f"the least certain photo ± {worst_m:.2f} m" in told.page
    assert f"each keyframe to {worst_m:.2g} m or better (95 %)" in told.line("place: good: ")
    assert told.line("ranges: ") == (
        f"{ranges['num_used']} of {ranges['num']} used; they differ from the map by {ranges['rms_m']:.3f} m (rms), "
        f"half of them by less than {ranges['median_abs_m']:.3f} m"
    )
    assert f"{ranges['num_used']} of {ranges['num']} ranges to 4 radio anchors" in told.page
    assert re.search(rf"Ranges and map\n\s*{ranges['rms_m']:.3f} m\n", told.page)
    assert f"half of the differences are below {ranges['median_abs_m']:.3f} m" in told.page
    within_s = HALF * offset["stddev_s"]
    assert (
        told.line("time offset: image time = range time ")
        == f"{offset['value_s']:+.3f} s, within {within_s:.3f} s (95 %)"
    )
    assert re.search(rf"Clocks\n\s*{within_s:.3f} s\n", told.page)
    assert f"{told.result['map']['num_photos']} photos along " in told.page
    assert told.line("map: ").startswith(f"{told.result['map']['num_photos']} photos, ")


def test_a_spread_is_told_as_a_95_percent_interval_and_zero_has_no_sign(told: Told) -> None:
    # A folder's name is no number: that of the first temporary folder ends in -0.
    lines = [line for line in told.lines if "by_command" not in line]
    text = "\n".join([*lines, told.page.partition("Appendix")[0]])
    assert not re.search(r"stddev|standard deviation(?!\),)", text)
    assert not re.search(r"-0\.?0*(?![\d.])", text)
