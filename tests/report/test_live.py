"""The page that follows a run."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.cli.screen import Clock

from rangesfm.progress import SilentProgress
from rangesfm.report.live import LIVE_RELOAD_S, LivePage, live_page

RELOAD = f'http-equiv="refresh" content="{LIVE_RELOAD_S}"'


class Listener(SilentProgress):
    def __init__(self) -> None:
        self.heard: list[object] = []

    def stage(self, name: str) -> None:
        self.heard.append(name)

    def update(self, num_done: int, num_total: int | None = None) -> None:
        self.heard.append((num_done, num_total))

    def message(self, text: str) -> None:
        self.heard.append(text)


def page_of(live: LivePage) -> str:
    return live.path.read_text(encoding="utf-8").replace("\u00a0", " ")


def test_it_shows_stages_done_and_the_one_at_work_with_the_time_left(tmp_path: Path) -> None:
    clock, listener = Clock(), Listener()
    live = LivePage(listener, tmp_path / "out", clock=clock)
    live.stage("features")
    clock.now_s += 12
    live.stage("mapping")
    clock.now_s += 20
    live.update(10, 30)
    live.message("a warning with <b>")
    page = page_of(live)
    assert RELOAD in page
    assert '<th scope="row">features</th><td>12.0 s</td>' in page
    assert '<th scope="row">mapping</th><td>10 of 30, 40.0 s left' in page
    assert "a warning with &lt;b&gt;" in page
    assert "Running for 32.0 s" in page
    assert listener.heard == ["features", "mapping", (10, 30), "a warning with <b>"]


def test_it_is_not_written_more_than_once_a_second_for_counts(tmp_path: Path) -> None:
    clock = Clock()
    live = LivePage(SilentProgress(), tmp_path, clock=clock)
    live.stage("matching")
    live.update(1, 10)
    assert "1 of 10" not in page_of(live)
    clock.now_s += 1.5
    live.update(2, 10)
    assert "2 of 10" in page_of(live)


def test_it_ends_as_the_report(tmp_path: Path) -> None:
    live = LivePage(SilentProgress(), tmp_path)
    live.finish(tmp_path / "report.html")
    assert 'http-equiv="refresh" content="0; url=report.html"' in page_of(live)
    live.finish(None)
    assert "refresh" not in page_of(live)


def test_a_run_that_stops_says_so_and_is_not_waited_for(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="stop"), live_page(SilentProgress(), tmp_path) as live:
        raise ValueError("stop")
    assert "stopped before its end" in page_of(live)
    assert "refresh" not in page_of(live)


def test_it_holds_no_script(tmp_path: Path) -> None:
    page = page_of(LivePage(SilentProgress(), tmp_path))
    assert "<script" not in page
    assert "script-src &#39;none&#39;" in page
