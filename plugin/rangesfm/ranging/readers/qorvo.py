"""Qorvo DWM3001CDK and QM33 shell: ``SESSION_INFO_NTF: {..}`` over several lines, and the older
``{"Block":1, "results":[..]}``.
"""

from __future__ import annotations

import re
from bisect import bisect_right
from collections.abc import Iterator
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.files.tables import read_text
from rangesfm.ranging.readers.printed import LOST
from rangesfm.ranging.readers.reader import Reading, ReadOptions, reader_of_readings
from rangesfm.ranging.readers.times import HostClock

_DEFAULT_RANGING_INTERVAL_S = 0.2
_BEGIN = re.compile(r'SESSION_INFO_NTF:?\s{0,9}\{|\{\s{0,9}"Block"\s{0,9}:', re.ASCII)
_END = re.compile(r"\]\s{0,9}\}")
_COUNTERS = tuple(
    re.compile(rf"{name}\s{{0,9}}[=:]\s{{0,9}}(\d{{1,18}})(?!\d)", re.ASCII)
    for name in ("block_index", "sequence_number", '"Block"')
)
_EACH = re.compile(r'mac_address=|"Addr"')
_MEASUREMENT = re.compile(
    r'mac_address=(?P<id>0x[0-9A-Fa-f]{1,16}), status="SUCCESS", distance\[cm\]=(?P<cm>-?\d{1,9})(?=[],])'
    r'|"Addr"\s*:\s*"(?P<json_id>(?:0x)?[0-9A-Fa-f]{1,16})"\s*,\s*"Status"\s*:\s*"(?:Ok|SUCCESS)"\s*,'
    r'\s*"D_cm"\s*:\s*(?P<json_cm>-?\d{1,9})(?=[,}])',
    re.ASCII,
)


def _readings(path: Path, options: ReadOptions) -> Iterator[Reading]:
    text, clock = read_text(path, errors="replace"), _Clock(path, options)
    begins = list(_BEGIN.finditer(text))
    line_starts = [0, *(end.end() for end in re.finditer("\n", text))]
    for begin, stop in zip(begins, [*(begin.start() for begin in begins[1:]), len(text)]):
        end = _END.search(text, begin.end(), stop)
        body = text[begin.start() : stop if end is None else end.end()]
        line = bisect_right(line_starts, begin.start())
        timestamp_s = clock.seconds(text[line_starts[line - 1] : begin.start()], body, line)
        measurements = list(_MEASUREMENT.finditer(body))
        for found in measurements:
            anchor_id, range_cm = (
                found["id"] or found["json_id"],
                found["cm"] or found["json_cm"],
            )
            yield Reading(timestamp_s, anchor_id, int(range_cm) / 100, line)
        yield from [LOST] * (len(_EACH.findall(body)) - len(measurements))


class _Clock:
    """The host's time before a record; in a log without any, the radio's count of ranging intervals."""

    def __init__(self, path: Path, options: ReadOptions):
        self._path = path
        self._host = HostClock(path, options)
        self._has_host_time: bool | None = None
        self._interval_s = options.ranging_interval_s or _DEFAULT_RANGING_INTERVAL_S
        self._last_count = -1

    def seconds(self, prefix: str, body: str, line: int) -> float:
        if self._has_host_time is None:
            self._has_host_time = self._host.find_seconds(prefix) is not None
        if self._has_host_time:
            return self._host.seconds(prefix, line)
        found = next(filter(None, (counter.search(body) for counter in _COUNTERS)), None)
        if found is None:
            raise InputError("neither a time before the record nor a block_index in it, expected one", self._path, line)
        count = int(found[1])
        if count < self._last_count:
            raise InputError(
                f"the radio's count goes back from {self._last_count} to {count}: it was restarted; split the log "
                "there, or record it with the host's time before each record",
                self._path,
                line,
            )
        self._last_count = count
        return count * self._interval_s


READER = reader_of_readings("qorvo", lambda head: _BEGIN.search(head) is not None, _readings)
