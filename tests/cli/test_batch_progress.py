"""The display of a running batch."""

from __future__ import annotations

import io

import pytest
from tests.cli.screen import Clock, Terminal

from rangesfm.batch.batch_state import BatchState
from rangesfm.cli.batch import BatchTerminal
from rangesfm.survey.settings import Survey


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def batch_state(clock: Clock) -> BatchState:
    return BatchState([(name, Survey()) for name in ("a.toml", "b.toml")], clock=clock)


def go_on(batch_state: BatchState, shown: BatchTerminal, clock: Clock) -> None:
    """Advance a batch in which one survey is done and the other is refused, and show each step."""
    shown.show(batch_state)
    for index in (0, 1):
        batch_state.tell(index, {"began_on": "here"})
    shown.show(batch_state)
    batch_state.tell(0, {"stage": "mapping"})
    batch_state.tell(0, {"num_done": 5, "num_total": 20})
    clock.now_s += 10.0
    shown.show(batch_state)
    batch_state.tell(1, {"began_on": "there"})
    shown.show(batch_state)
    batch_state.end(0, "done", "", 0, verdict="good")
    clock.now_s += 4.0
    shown.show(batch_state)
    batch_state.end(1, "failed", "the scale is not known", 3)
    shown.show(batch_state)


def test_plain_lines_tell_each_stage_once(batch_state: BatchState, clock: Clock) -> None:
    stream = io.StringIO()
    go_on(batch_state, BatchTerminal(stream, clock=clock), clock)
    assert stream.getvalue().splitlines() == [
        "a.toml: begins",
        "b.toml: begins",
        "a.toml: mapping",
        "b.toml: begins again, attempt 2",
        "a.toml: good after 10.0 s",
        "1 of 2 surveys over, 14.0 s, 6.0 s left",
        "b.toml: failed after 4.0 s: the scale is not known",
        "2 of 2 surveys over, 1 of them failed, 14.0 s",
    ]


def test_a_terminal_keeps_what_has_ended(batch_state: BatchState, clock: Clock) -> None:
    stream = Terminal()
    go_on(batch_state, BatchTerminal(stream, clock=clock), clock)
    assert stream.lines() == ["a.toml: good after 10.0 s", "b.toml: failed after 4.0 s: the scale is not known"]


def test_a_terminal_shows_what_is_going_on(batch_state: BatchState, clock: Clock) -> None:
    stream = Terminal()
    shown = BatchTerminal(stream, clock=clock)
    for index in (0, 1):
        batch_state.tell(index, {"began_on": "here"})
    batch_state.tell(0, {"stage": "mapping"})
    batch_state.tell(0, {"num_done": 5, "num_total": 20})
    clock.now_s += 10.0
    shown.show(batch_state)
    shown.message("a worker is gone")
    clock.now_s += 1.0
    shown.show(batch_state)
    assert stream.lines() == [
        "a worker is gone",
        "  a.toml: mapping 5/20, 25 %, 11.0 s",
        "  b.toml: begins, 11.0 s",
        "0 of 2 surveys over, 11.0 s",
    ]


def test_quiet_is_quiet(batch_state: BatchState, clock: Clock) -> None:
    stream = Terminal()
    go_on(batch_state, BatchTerminal(stream, quiet=True, clock=clock), clock)
    assert stream.getvalue() == ""
