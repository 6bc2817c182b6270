"""A page that shows the progress of a run. It reloads itself every few seconds and leads to the report at the end."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from rangesfm.files.atomic import make_output_folder
from rangesfm.files.folders import real_path
from rangesfm.progress import Progress
from rangesfm.report.report_page import render_page, write_page
from rangesfm.report.text import duration

PAGE_NAME = "live.html"
LIVE_RELOAD_S = 2
_MIN_INTERVAL_S = 1.0


class LivePage:
    """Listener that keeps a page of the progress up to date and passes the progress on to another listener."""

    def __init__(self, listener: Progress, folder: Path, *, clock: Callable[[], float] = time.monotonic):
        make_output_folder(folder)
        self.path = folder / PAGE_NAME
        self._listener = listener
        self._clock = clock
        self._start = self._stage_start = self._last_written = clock()
        self._stage: str | None = None
        self._done: list[tuple[str, float]] = []
        self._counts: tuple[int, int | None] | None = None
        self._messages: list[str] = []
        self._write("The run has begun.", reload=f"{LIVE_RELOAD_S}")

    def stage(self, name: str) -> None:
        self._listener.stage(name)
        self._end_stage()
        self._stage, self._stage_start = name, self._clock()
        self._write_running()

    def update(self, num_done: int, num_total: int | None = None) -> None:
        self._listener.update(num_done, num_total)
        self._counts = (num_done, num_total)
        if self._clock() - self._last_written >= _MIN_INTERVAL_S:
            self._write_running()

    def message(self, text: str) -> None:
        self._listener.message(text)
        self._messages.append(text)
        self._write_running()

    def finish(self, report: Path | None) -> None:
        """Write that the run is done; the page then leads the reader to the report, if there is one."""
        self._end_stage()
        to_report = None if report is None else f"0; url={report.name}"
        self._write("The run is done.", reload=to_report)

    def fail(self) -> None:
        """Write that the run stopped before its end."""
        self._end_stage()
        self._write("The run stopped before its end; the terminal says why.", reload=None)

    def _end_stage(self) -> None:
        if self._stage is not None:
            self._done.append((self._stage, self._clock() - self._stage_start))
        self._stage = self._counts = None

    def _write_running(self) -> None:
        self._write(f"Running for {duration(self._clock() - self._start)}.", reload=f"{LIVE_RELOAD_S}")

    def _write(self, headline: str, *, reload: str | None) -> None:
        self._last_written = self._clock()
        page = render_page(
            "live.html",
            title="rangesfm run",
            heading=real_path(self.path.parent).name,
            headline=headline,
            reload=reload,
            done=self._done,
            stage=self._stage,
            counts=self._counts,
            seconds=self._clock() - self._stage_start,
            messages=self._messages,
        )
        write_page(page, self.path)


@contextmanager
def live_page(listener: Progress, folder: Path) -> Iterator[LivePage]:
    """Yield a LivePage and mark it as failed if the block raises; otherwise the block itself must finish it."""
    page = LivePage(listener, folder)
    try:
        yield page
    except BaseException:
        page.fail()
        raise
