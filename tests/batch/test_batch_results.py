"""The table of a batch, in its three formats."""

from __future__ import annotations

import csv
import json
from html.parser import HTMLParser
from pathlib import Path

import pytest

from rangesfm.batch.batch_state import BatchState
from rangesfm.batch.jobs import Job
from rangesfm.batch.run_batch import write_batch_results
from rangesfm.errors import Failure
from rangesfm.options import OutputOptions
from rangesfm.survey.settings import Survey

BAD_NAME = '</td><script>alert(1)</script>&".toml'


@pytest.fixture
def batch_state(tmp_path: Path) -> BatchState:
    jobs: list[Job] = [
        (f"surveys/{i}.toml", Survey(output=OutputOptions(path=tmp_path / f"out #{i}"))) for i in range(3)
    ]
    batch_state = BatchState([*jobs, (BAD_NAME, Failure(f"{BAD_NAME}: no such file", 2))])
    for i, verdict in enumerate(["good", "doubtful"]):
        batch_state.tell(i, {"began_on": "here"})
        found = (verdict, 0.5, 0.002, "site", 14, 725, 481, 0.0795, 0.51, 0.0821, 2)
        figures = dict(zip(list(batch_state.rows[i].cells())[-len(found) :], found))
        batch_state.end(i, "done", "" if verdict == "good" else "short path", 0, **figures)
    (tmp_path / "out #0").mkdir()
    (tmp_path / "out #0" / "report.html").touch()
    return batch_state


class Page(HTMLParser):
    def __init__(self, text: str):
        super().__init__()
        self.links: list[str | None] = []
        self.tags: list[str] = []
        self.texts: list[str] = []
        self.has_refresh = False
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.links += [value for name, value in attrs if name == "href"]
        self.has_refresh |= ("http-equiv", "refresh") in attrs

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def test_csv_and_json_have_a_row_for_each_survey(batch_state: BatchState, tmp_path: Path) -> None:
    write_batch_results(batch_state, tmp_path)
    with (tmp_path / "batch.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    summary = json.loads((tmp_path / "batch.json").read_text())
    assert [row["survey"] for row in rows] == [row["survey"] for row in summary["surveys"]]
    assert [row["status"] for row in rows] == ["done", "done", "waiting", "failed"]
    assert [row["exit_status"] for row in rows] == ["0", "0", "", "2"]
    assert float(rows[0]["rmse_m"]) == summary["surveys"][0]["rmse_m"] == 0.0821
    assert rows[3]["reason"] == f"{BAD_NAME}: no such file"
    assert {name: summary[name] for name in ("num_done", "num_failed", "num_waiting")} == {
        "num_done": 2,
        "num_failed": 1,
        "num_waiting": 1,
    }


def test_the_page_escapes_names_and_links_to_reports_that_are_there(batch_state: BatchState, tmp_path: Path) -> None:
    write_batch_results(batch_state, tmp_path)
    page = Page((tmp_path / "batch.html").read_text())
    assert "script" not in page.tags
    assert BAD_NAME in page.texts
    assert page.links == ["out%20%230/report.html"]
    assert any("Short path" in text or "short path" in text for text in page.texts)


def test_the_page_loads_itself_anew_until_the_batch_is_over(batch_state: BatchState, tmp_path: Path) -> None:
    write_batch_results(batch_state, tmp_path)
    assert Page((tmp_path / "batch.html").read_text()).has_refresh
    batch_state.end_all("interrupted", "interrupted")
    write_batch_results(batch_state, tmp_path)
    assert not Page((tmp_path / "batch.html").read_text()).has_refresh
