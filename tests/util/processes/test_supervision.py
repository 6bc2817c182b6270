"""Child processes that report, use too much memory, crash, or do not end when they are told to."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import psutil
import pytest
from tests.traps import set_traps

from rangesfm.batch.survey_process import run_in_batch
from rangesfm.sfm.background import find_features
from rangesfm.util.processes.draw_pictures import _draw
from rangesfm.util.processes.supervision import Ended, call_by_name, supervise


def run(
    code: str,
    listen: Callable[[dict[str, Any]], None] = lambda _: None,
    *,
    work: Callable[..., Any] = len,
    memory_limit_bytes: int = 1 << 40,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Ended:
    code = "import json, os, signal, sys, time\nsay = lambda **m: print(json.dumps(m), flush=True)\n" + code
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("rangesfm.util.processes.supervision._CHILD", code)
        return supervise(work, listen, memory_limit_bytes=memory_limit_bytes, is_stopped=is_stopped)


def test_messages_come_one_by_one_and_the_last_is_the_ending() -> None:
    heard: list[dict[str, Any]] = []
    ended = run("import pickle\nsay(given=str(pickle.load(sys.stdin.buffer)))\nsay(n=2)", heard.append)
    assert heard == [{"given": str(len)}, {"n": 2}]
    assert ended == Ended({"n": 2}, None, 0, False, "")


def test_one_that_needs_too_much_memory_is_killed() -> None:
    ended = run("say(n=1)\ndata = b'x' * 200_000_000\ntime.sleep(60)", memory_limit_bytes=100_000_000)
    assert ended.needed_bytes > 100_000_000
    assert ended.last == {"n": 1}


OF_GLOG = "why it crashed\\n*** stack trace ***\\n    @ 0x5 f()"
OF_V8 = "#\\n# why it crashed\\n#\\n==== C stack trace ====\\n\\n    lib.so(+0x3a) [0x7f0b]"


@pytest.mark.parametrize(
    ("number", "trace"), [(signal.SIGKILL, OF_GLOG), (signal.SIGABRT, OF_GLOG), (signal.SIGTRAP, OF_V8)]
)
def test_a_crash_is_named(number: signal.Signals, trace: str) -> None:
    code = f"print('{trace}', file=sys.stderr)\nos.kill(os.getpid(), {number.value})"
    ended = run(code)
    assert (ended.signal, ended.errors, ended.last) == (number, "why it crashed", {})


def test_half_a_message_counts_for_nothing() -> None:
    ended = run("say(n=1)\nprint('{\"n\": ', end='', flush=True)\nos.kill(os.getpid(), 9)")
    assert ended.last == {"n": 1}


def test_what_it_said_counts_also_if_it_died_before_it_heard() -> None:
    ended = run("say(n=1)\nos.kill(os.getpid(), 9)", work=partial(len, b"more than a pipe holds" * 100_000))
    assert (ended.last, ended.signal) == ({"n": 1}, signal.SIGKILL)


def test_one_that_is_stopped_may_tidy_up() -> None:
    code = "try:\n    say(pid=os.getpid())\n    time.sleep(60)\nexcept KeyboardInterrupt:\n    say(tidy=True)"
    heard: list[dict[str, Any]] = []
    ended = run(code, heard.append, is_stopped=lambda: bool(heard))
    assert (ended.last, ended.stopped) == ({"tidy": True}, True)


def test_nothing_is_left_running_where_the_listener_fails() -> None:
    heard: list[dict[str, Any]] = []

    def fail(message: dict[str, Any]) -> None:
        heard.append(message)
        raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run("say(pid=os.getpid())\ntime.sleep(60)", fail)
    assert not psutil.pid_exists(heard[0]["pid"])


def test_a_child_imports_nothing_from_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sprung = set_traps(tmp_path)
    monkeypatch.chdir(tmp_path)
    works: list[Any] = [find_features, run_in_batch, partial(_draw, [])]
    ended = [supervise(work) for work in works]
    assert ["failed" in of.last for of in ended] == [True, True, False]  # they got far enough to say what is wrong
    assert not sprung()


def test_a_child_imports_what_is_on_the_path_of_the_user(tmp_path: Path) -> None:
    (tmp_path / "of_the_user.py").write_text("def work(progress):\n    return 5\n")
    work = partial(call_by_name, "of_the_user:work")
    assert supervise(work, environment={**os.environ, "PYTHONPATH": str(tmp_path)}).last == {"done": 5}
