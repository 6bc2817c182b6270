"""Supervision of a child process from its start to its end: its messages, its memory, and why it ended.

The process reads one pickled function, calls it, and writes JSON objects, one a line: ``{"stage": name}``,
``{"num_done": n, "num_total": m}``, and last either ``{"done": ...}`` or ``{"failed": ...}``.
"""

from __future__ import annotations

import ctypes
import json
import math
import os
import pickle
import pkgutil
import queue
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import closing, suppress
from dataclasses import asdict, dataclass
from functools import partial
from typing import IO, Any, TextIO

from rangesfm.errors import ReconstructionError, failure_of
from rangesfm.progress import Progress

POLL_INTERVAL_S = 0.2
"""Time between two looks at work that is done elsewhere."""
_PR_SET_PDEATHSIG = 1
_UPDATE_INTERVAL_S = 0.5
_MAX_STOP_S = 20.0  # an interrupted process that has not ended by then is killed
_MAX_LINE = 200
# Python puts the working folder first on the path, as "". A survey from somebody else may hold a numpy.py, which would
# be imported and so run. `python -P` would leave the folder out, but exists only since Python 3.11.
_CHILD = (
    "import sys; sys.path[:1] == [''] and sys.path.pop(0); "
    "from rangesfm.util.processes.supervision import work_for_parent; work_for_parent()"
)
# A line of a stack trace by glog or V8, after leading marks.
_STACK_TRACE = re.compile(r"\*\*\*|@|PC:|=+ |.*\[0x[0-9a-f]+\]$")


class MessagesToParent(Progress):
    """Progress of the work as messages, one a line; only some of the many updates are sent.

    Warnings are part of the results, and are not sent.
    """

    def __init__(self, stream: TextIO):
        self._stream = stream
        self._last_update = 0.0

    def stage(self, name: str) -> None:
        self._last_update = time.monotonic()
        self.send({"stage": name})

    def update(self, num_done: int, num_total: int = 0) -> None:
        now = time.monotonic()
        if now - self._last_update >= _UPDATE_INTERVAL_S:
            self._last_update = now
            self.send({"num_done": num_done, "num_total": num_total})

    def send(self, message: dict[str, Any]) -> None:
        self._stream.write(json.dumps(message) + "\n")
        self._stream.flush()


def work_for_parent() -> None:
    """Do the work of a child process: call the function that the parent sends with a listener to its progress.

    The last message is the result of the function (plain values), or the error that it raised.
    """
    # The parent may ignore Ctrl-C or block SIGTERM, and a child process inherits both.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if sys.platform != "win32":
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    # The stream to the parent is the process's own; whatever else is printed goes to stderr.
    parent = MessagesToParent(os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8"))
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        work = pickle.load(sys.stdin.buffer)
        _end_with(int(sys.argv[1]))
        parent.send({"done": work(parent)})
    except (Exception, KeyboardInterrupt) as error:
        parent.send({"failed": asdict(failure_of(error))})


def _end_with(parent: int) -> None:
    """Have this process killed when its parent ends in any way, so that the output folder is free for the next run."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os.kill(os.getpid(), signal.SIGKILL)
    else:  # stdin closes when the parent ends
        threading.Thread(target=lambda: (sys.stdin.buffer.read(), os._exit(1)), daemon=True).start()


def end_group_with_parent() -> None:
    """Have this child process, and all processes that it starts, killed when it is interrupted or its parent ends.

    Only on Linux are they killed too if the parent is.
    """
    if sys.platform == "win32":
        return
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: os.killpg(0, signal.SIGKILL))
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


@dataclass(frozen=True)
class Ended:
    """End of a child process.

    Attributes:
        last: the last message it sent; empty if it sent none.
        signal: the signal that killed it, if one did.
        needed_bytes: the memory it took, if it was killed for exceeding its limit, else 0.
        stopped: whether it was interrupted on request.
        errors: the last line it wrote to stderr.
    """

    last: dict[str, Any]
    signal: signal.Signals | None
    needed_bytes: int
    stopped: bool
    errors: str

    @property
    def how(self) -> str:
        """Why there is no result: the error that ended the work, or else how the process ended."""
        if "failed" in self.last:
            return str(self.last["failed"]["message"])
        how = "its process ended too soon" if self.signal is None else f"its process was ended ({self.signal.name})"
        return f"{how}: {self.errors}" if self.errors else how


def call_by_name(name: str, *arguments: Any) -> Any:
    """Call the function named ``module:function``; only the process that calls it loads the module."""
    return pkgutil.resolve_name(name)(*arguments)


def supervise(
    work: Callable[[Progress], Any],
    listen: Callable[[dict[str, Any]], object] = lambda _: None,
    *,
    environment: Mapping[str, str] = os.environ,
    memory_limit_bytes: int = 0,
    is_stopped: Callable[[], bool] = lambda: False,
) -> Ended:
    """Have a process call a function, and return how it ended.

    Args:
        work: function of a module, which returns plain values.
        listen: called with each message.
        memory_limit_bytes: the process is killed if it takes more; 0: there is no limit.
        is_stopped: called several times a second; once it returns True, the process is interrupted.
    """
    lines: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()
    last: dict[str, Any] = {}
    needed_bytes, stopped_at = 0, math.inf
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-c", _CHILD, str(os.getpid())],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            env=environment,
            start_new_session=True,  # so that a Ctrl-C in the terminal does not reach it
        )
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            threading.Thread(target=_read_lines, args=(process.stdout, lines), daemon=True).start()
            with suppress(BrokenPipeError):  # the process died; its messages so far still count
                process.stdin.write(pickle.dumps(work))
                process.stdin.flush()
            while True:
                if memory_limit_bytes and not needed_bytes and (used := _used_bytes(process)) > memory_limit_bytes:
                    needed_bytes = used
                    process.kill()
                if stopped_at == math.inf and is_stopped():
                    stopped_at = time.monotonic()
                    process.send_signal(signal.SIGINT)
                if time.monotonic() - stopped_at > _MAX_STOP_S:
                    process.kill()
                with suppress(queue.Empty):
                    if (line := lines.get(timeout=POLL_INTERVAL_S)) is None:
                        break
                    last = json.loads(line)
                    listen(last)
            process.wait()
        finally:
            with suppress(BrokenPipeError):
                process.stdin.close()  # only now, because an open stdin tells the process that its parent is alive
            process.kill()  # has no effect if it has ended
            process.wait()
        died_of = signal.Signals(-process.returncode) if process.returncode < 0 else None
        return Ended(last, died_of, needed_bytes, stopped_at < math.inf, _last_line(errors))


def _used_bytes(process: subprocess.Popen[bytes]) -> int:
    import psutil  # here, because the child processes import this module and should start fast

    try:
        return int(psutil.Process(process.pid).memory_info().rss)
    except psutil.Error:  # the process has ended
        return 0


def _read_lines(stream: IO[bytes], lines: queue.SimpleQueue[bytes | None]) -> None:
    with stream:
        for line in stream:
            if line.endswith(b"\n"):  # a line without it is incomplete, because the process was killed
                lines.put(line)
    lines.put(None)


def _last_line(errors: IO[bytes]) -> str:
    errors.seek(0)
    lines = [line.strip().lstrip("# ") for line in errors.read().decode(errors="replace").split("\n")]
    return next((line[:_MAX_LINE] for line in reversed(lines) if line and not _STACK_TRACE.match(line)), "")


def run_child(work: Callable[[Progress], int], update: Callable[[int], object] = lambda _: None) -> int:
    """Do one piece of work as ``run_children`` does, and return its result."""
    num_done = [0]

    def listen(num: int) -> None:
        num_done[0] = num
        update(num)

    with closing(run_children([work], 1, listen)) as ended:
        list(ended)
    return num_done[0]


def run_children(
    works: Iterable[Callable[[Progress], int]], num_at_once: int, update: Callable[[int], object]
) -> Generator[None, None, None]:
    """Have each piece of work done by a process; yield once for each finished piece, in their order.

    Leaving the iteration (``contextlib.closing``) interrupts the processes, and waits for their end.

    Args:
        works: functions of a module that return the number of finished items; Ctrl-C may end them at any moment. They
            are taken one at a time, when they are needed; at most one waits for a process.
        update: called several times a second with the number of items that all processes have finished.

    Raises:
        ReconstructionError: a process failed; the others were interrupted.
    """
    stop, num_done = threading.Event(), list[int]()
    pending: deque[Future[None]] = deque()

    def run(place: int, work: Callable[[Progress], int]) -> None:
        def listen(message: dict[str, Any]) -> None:
            num_done[place] = message.get("num_done", num_done[place])

        if stop.is_set():
            return
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
        ended = supervise(partial(_end_at_once, work), listen, environment=environment, is_stopped=stop.is_set)
        if "done" in ended.last:
            num_done[place] = ended.last["done"]
        elif not ended.stopped:
            raise ReconstructionError(ended.how)

    def wait_for_first() -> None:
        while not wait([pending[0]], timeout=POLL_INTERVAL_S).done:
            update(sum(num_done))
            for future in pending:
                if future.done():
                    future.result()
        pending.popleft().result()
        update(sum(num_done))

    with ThreadPoolExecutor(num_at_once, thread_name_prefix="child") as executor:
        try:
            for place, work in enumerate(works):
                num_done.append(0)
                pending.append(executor.submit(run, place, work))
                if len(pending) > num_at_once:
                    wait_for_first()
                    yield
            while pending:
                wait_for_first()
                yield
        except BaseException:
            stop.set()
            raise


def _end_at_once(work: Callable[[Progress], int], progress: Progress) -> int:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # files that COLMAP has written are intact at any moment
    return work(progress)
