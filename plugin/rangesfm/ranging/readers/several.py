"""A log in several files, one an anchor say: which files these are, and their ranges as one log."""

from __future__ import annotations

import glob
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError
from rangesfm.files.bags import is_bag_folder
from rangesfm.ranging.log import RangeLog

_ID_IN_NAME = re.compile(r"(?:.*[^0-9A-Za-z])?([A-Za-z]{0,2}\d{1,3}|(?=[A-F]*\d)[0-9A-F]{4})", re.ASCII)


def files_of_log(path: Path) -> list[Path]:
    """The files of a log: the path itself, all in a folder, or those of a pattern as ``uwb_*.csv``; or InputError."""
    text = str(path)
    if "\0" in text:
        raise InputError("no file has such a name", path)
    if path.is_dir() and not is_bag_folder(path):
        found = [file for file in path.iterdir() if file.is_file() and not file.name.startswith(".")]
    elif glob.has_magic(text) and not path.exists():
        found = [Path(name) for name in glob.glob(text)]
    else:
        return [path]
    if not found:
        raise InputError("no file there, expected the files of a log", path)
    return sorted(found, key=lambda file: [part.zfill(20) for part in re.split(r"(\d+)", file.name)])


def anchor_of_file(path: Path) -> str:
    """The anchor that the name of a file stands for: A5 of ``run_3_A5.csv``, else all of the name before its ending."""
    stem = path.name.split(".")[0]
    found = _ID_IN_NAME.fullmatch(stem)
    return found[1] if found else stem


def join_logs(logs: Sequence[RangeLog], source: Path) -> RangeLog:
    """All ranges in the order of their times, each between the tag and the anchor of its record."""
    by_time = {log.timestamp_s is not None for log in logs}
    if len(by_time) > 1:
        raise InputError("some of the files have times and others have names of photos, expected all alike", source)
    ends = [log.end_ids() for log in logs]
    times = (
        np.concatenate([log.timestamp_s for log in logs if log.timestamp_s is not None]) if True in by_time else None
    )
    num = sum(map(len, logs))
    joined = RangeLog.from_arrays(
        [anchor_id for _, anchor_ids in ends for anchor_id in anchor_ids],
        np.concatenate([log.range_m for log in logs]),
        timestamp_s=times,
        image_name=None if times is not None else [name for log in logs for name in log.image_name or ()],
        range_stddev_m=np.concatenate([log.range_stddev_m for log in logs]),
        tag_id=[tag_id for tag_ids, _ in ends for tag_id in tag_ids],
        los=np.concatenate([log.los for log in logs]),
        line=np.concatenate([log.line for log in logs]),
        source=source,
        format=logs[0].format,
        num_no_measurement=sum(log.num_no_measurement for log in logs),
        notes=(f"{len(logs)} files as one log", *dict.fromkeys(note for log in logs for note in log.notes)),
    )
    return joined.subset(np.argsort(times, kind="stable") if times is not None else np.arange(num))
