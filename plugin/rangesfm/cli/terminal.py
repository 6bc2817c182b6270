"""Progress for users: lines that are drawn again on a terminal, and a few plain lines elsewhere."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, TextIO

from rangesfm.errors import one_line
from rangesfm.progress import Progress, format_duration

if TYPE_CHECKING:
    from rich.live import Live

_TERMINAL_INTERVAL_S = 0.1
_PLAIN_INTERVAL_S = 10.0
# In these stages an item takes the longer the more are done: a photo of a large map takes longer than one of a small
# map. Their time left is not known, and an estimate by the items done would be several times too short.
_GROWING_STAGES = ("rigs", "mapping")


def discard_output(stream: TextIO) -> None:
    """Discard what is written to a stream from now on, and what it has not been able to write.

    Otherwise Python would try to write that again when it exits, and complain.
    """
    with suppress(OSError, ValueError):  # there is no file behind the stream
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


class Screen:
    """Output of lines that stay and, on a terminal, of lines below them that are drawn over."""

    def __init__(self, stream: TextIO, *, quiet: bool):
        self._stream = stream
        self._quiet = quiet
        self._live: Live | None = None
        self.is_terminal = stream.isatty()

    def say(self, lines: Sequence[str]) -> None:
        """Print lines that stay; they replace the lines drawn below."""
        with self._going_on_without():
            if self._live is not None:
                self._live.stop()
                self._live = None
            if lines and not self._quiet:
                self._stream.write("".join(f"{one_line(line)}\n" for line in lines))
                self._stream.flush()

    def draw(self, lines: Sequence[str]) -> None:
        """Draw lines that stay until the next call, on a terminal only. Long lines are cut at its width."""
        if self._quiet or not self.is_terminal:
            return
        from rich.text import Text

        with self._going_on_without():
            if self._live is None:
                self._live = _live(self._stream)
            self._live.update(Text("\n".join(map(one_line, lines)), no_wrap=True, overflow="crop"), refresh=True)

    @contextmanager
    def _going_on_without(self) -> Iterator[None]:
        """Say nothing more where the stream cannot be written to, as on a full disk: that must not end the work."""
        try:
            yield
        except BrokenPipeError:
            raise
        except OSError:
            self._quiet, self._live = True, None
            discard_output(self._stream)


def _live(stream: TextIO) -> Live:
    from rich.console import Console
    from rich.live import Live

    size = shutil.get_terminal_size()
    console = Console(file=stream, width=size.columns, height=size.lines)
    live = Live(
        console=console,
        auto_refresh=False,
        transient=True,
        redirect_stdout=False,
        redirect_stderr=False,
        vertical_overflow="crop",
    )
    live.start()
    console.show_cursor(True)  # rich hides the cursor, and nothing would show it again if the process is killed
    return live


class TerminalProgress(Progress):
    """Listener that writes the progress of a run to ``stream``."""

    def __init__(self, stream: TextIO, *, quiet: bool = False, clock: Callable[[], float] = time.monotonic):
        self._screen = Screen(stream, quiet=quiet)
        self._clock = clock
        self._stage = ""  # none yet, or it has ended
        self._stage_start = self._last_update = clock()

    def stage(self, name: str) -> None:
        self.end_stage()
        self._stage = name
        self._stage_start = self._last_update = self._clock()
        self._show(name if self._screen.is_terminal else f"{name} ...")

    def update(self, num_done: int, num_total: int = 0) -> None:
        now = self._clock()
        if now - self._last_update >= (_TERMINAL_INTERVAL_S if self._screen.is_terminal else _PLAIN_INTERVAL_S):
            self._last_update = now
            taken_s = 0.0 if self._stage in _GROWING_STAGES else now - self._stage_start
            self._show(f"{self._stage} {counts(num_done, num_total, taken_s)}".strip())

    def message(self, text: str) -> None:
        self._screen.say([text])

    def end_stage(self, *, failed: bool = False) -> None:
        """Print that the current stage, if there is one, has ended."""
        ending = "stopped after " if failed else ""
        line = f"{self._stage}: {ending}{format_duration(self._clock() - self._stage_start)}"
        self._screen.say([line] if self._stage else [])
        self._stage = ""

    def _show(self, line: str) -> None:
        (self._screen.draw if self._screen.is_terminal else self._screen.say)([line])


@contextmanager
def terminal_progress(stream: TextIO, *, quiet: bool = False) -> Iterator[TerminalProgress]:
    """Yield a listener to the progress of a run. Its last stage ends with the block."""
    progress = TerminalProgress(stream, quiet=quiet)
    try:
        yield progress
    except BaseException:
        progress.end_stage(failed=True)
        raise
    progress.end_stage()


def counts(num_done: int, num_total: int, seconds: float = 0.0) -> str:
    """Return "done/total, percentage" as text, with the time left if ``seconds`` is the time taken so far."""
    if num_total <= 0:
        return str(num_done)
    text = f"{num_done}/{num_total}, {100 * num_done // num_total} %"
    if seconds > 0 and 0 < num_done < num_total:
        text += f", {format_duration(seconds * (num_total - num_done) / num_done)} left"
    return text
