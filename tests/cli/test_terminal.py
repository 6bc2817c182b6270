"""Progress is one moving line on a terminal, a few plain lines elsewhere, and nothing when quiet."""

from __future__ import annotations

import contextlib
import io

import pytest
from rich.cells import cell_len
from tests.cli.screen import Clock, Terminal

from rangesfm.cli.terminal import TerminalProgress, terminal_progress


def test_plain_lines_tell_start_and_end_of_stages() -> None:
    stream, clock = io.StringIO(), Clock()
    progress = TerminalProgress(stream, clock=clock)
    progress.stage("features")
    clock.now_s += 61.2
    progress.stage("matching")
    progress.message("two models")
    clock.now_s += 2.5
    progress.end_stage()
    assert stream.getvalue().splitlines() == [
        "features ...",
        "features: 1 min 01 s",
        "matching ...",
        "two models",
        "matching: 2.5 s",
    ]


def test_plain_updates_are_sparse() -> None:
    stream, clock = io.StringIO(), Clock()
    progress = TerminalProgress(stream, clock=clock)
    progress.stage("matching")
    for num_done in range(101):
        progress.update(num_done, 400)
        clock.now_s += 1
    lines = stream.getvalue().splitlines()
    assert len(lines) == 1 + 10
    assert lines[-1] == "matching 100/400, 25 %, 5 min 00 s left"


def test_no_time_left_is_given_where_a_photo_takes_longer_than_those_before_it() -> None:
    stream, clock = io.StringIO(), Clock()
    progress = TerminalProgress(stream, clock=clock)
    progress.stage("mapping")
    for num_done in range(101):
        clock.now_s += num_done
        progress.update(num_done, 400)
    assert stream.getvalue().splitlines()[-1] == "mapping 100/400, 25 %"


def test_terminal_has_one_line_that_is_written_anew() -> None:
    stream, clock = Terminal(), Clock()
    progress = TerminalProgress(stream, clock=clock)
    progress.stage("matching")
    assert stream.lines() == ["matching"]
    clock.now_s += 2.0
    progress.update(10, 40)
    assert stream.lines() == ["matching 10/40, 25 %, 6.0 s left"]
    clock.now_s += 2.0
    progress.update(40, 40)
    assert stream.lines() == ["matching 40/40, 100 %"]
    progress.message("two models")
    clock.now_s += 1.0
    progress.update(40, 40)
    assert stream.lines() == ["two models", "matching 40/40, 100 %"]
    progress.end_stage()
    assert stream.lines() == ["two models", "matching: 5.0 s"]
    assert stream.getvalue().rfind("\033[?25h") > stream.getvalue().rfind("\033[?25l")


@pytest.mark.parametrize("columns", [0, 12, 200])
def test_names_are_shown_as_they_are_and_no_wider_than_the_terminal(
    columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    stream, name = Terminal(), "[red]\x1b[31m :smile: [/] \u6e2c\u91cf " + "x" * 300
    progress = TerminalProgress(stream)
    progress.stage(name)
    (shown,) = stream.lines()
    assert name.replace("\x1b", "?").startswith(shown)
    assert (columns or 80) - 2 < cell_len(shown) <= (columns or 80)
    progress.message(name)
    assert stream.lines()[0] == name.replace("\x1b", "?")


def test_unknown_total_shows_the_count_alone() -> None:
    stream, clock = io.StringIO(), Clock()
    progress = TerminalProgress(stream, clock=clock)
    progress.stage("refinement")
    clock.now_s += 11.0
    progress.update(7)
    assert stream.getvalue().splitlines()[-1] == "refinement 7"


def test_quiet_is_silent() -> None:
    stream = io.StringIO()
    with terminal_progress(stream, quiet=True) as progress:
        progress.stage("features")
        progress.update(1, 2)
        progress.message("note")
    assert stream.getvalue() == ""


def test_stage_that_fails_is_not_said_to_be_done() -> None:
    stream = io.StringIO()

    with contextlib.suppress(KeyboardInterrupt), terminal_progress(stream) as progress:
        progress.stage("mapping")
        raise KeyboardInterrupt
    assert stream.getvalue().splitlines()[-1].startswith("mapping: stopped after")
