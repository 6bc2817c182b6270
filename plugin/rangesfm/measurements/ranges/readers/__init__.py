"""Readers of radio logs in many formats, all of which give a RangeLog."""

from __future__ import annotations

import glob
import os
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.errors.noise import find_quantization_m, quantization_stddev_m
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.readers import ros, trek
from rangesfm.measurements.ranges.readers.measured import without_held
from rangesfm.measurements.ranges.readers.printed import PRINTED
from rangesfm.measurements.ranges.readers.reader import Reader, tell_roles
from rangesfm.measurements.ranges.readers.table import (
    CANONICAL_CSV,
    MAPPED,
    PRESETS,
    TABLE,
    table_reader,
    write_ranges_csv,
)
from rangesfm.measurements.ranges.readers.unclear import UnclearFileError, columns_typed
from rangesfm.options import COORDINATE_M, LENGTH_M, STDDEV_M, TIME_S, RangesOptions
from rangesfm.util.files.bags import is_bag_folder
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.folders import natural_order
from rangesfm.util.files.text_tables import read_head
from rangesfm.util.geometry.moments import ByPhoto

__all__ = ["files_of_log", "find_log_reader", "read_anchors_in_log", "read_ranges", "reader_names", "write_ranges_csv"]

_READERS = (ros.READER, CANONICAL_CSV, *PRESETS, MAPPED, TABLE, *PRINTED, trek.READER)


def reader_names() -> tuple[str, ...]:
    """Return the names of all log formats; a new format is a Reader in this package that is added to _READERS."""
    return tuple(reader.name for reader in _READERS)


def read_ranges(
    path: AnyPath | Sequence[AnyPath],
    options: RangesOptions = RangesOptions(),
    *,
    anchor_ids: Collection[str] = (),
    tag_ids: Collection[str] = (),
    **said: Any,
) -> RangeLog:
    """Read a radio's log.

    Args:
        path: a file; or several files, a folder of them, or a pattern such as ``uwb_*.csv``, for example one file per
            anchor.
        anchor_ids, tag_ids: known anchors and tags. They tell anchors from tags where the log does not, and ranges
            between two anchors or two tags from those between a tag and an anchor.
        said: single options by name. ``format`` is one of ``reader_names()``. ``columns`` gives the name in the file of
            each of ``columns.QUANTITIES``; a column with the ranges of one anchor is ``range:A1``, or ``range:A1:T0``
            with the tag.

    Returns:
        All ranges in the order of the log. Those that are no measurements are counted and left out, and so are
        repetitions of a value that a logger held until the next one came. The log's notes say what was assumed. If all
        ranges are whole centimetres or decimetres, the log's standard deviations are at least that of the rounding.

    Raises:
        InputError: the file is missing, empty or damaged, is not understood for sure (the advice says what to type), or
            has no usable range. The error gives the line if there is one.
    """
    paths, options = _paths(path), options.changed(**said)
    with _asking_by_commands(paths, options):
        chosen = _choose_readers(paths, options, options.format or ("mapped" if options.columns else ""))
        logs = [reader.read(file, options) for file, reader in chosen]
    for one in logs:
        _check_numbers(one)
    source = paths[0] if len(paths) == 1 else paths[0].parent
    log = logs[0] if len(logs) == 1 else _join_logs(logs, source)
    log = tell_roles(without_held(log), chosen[0][1].roles, known_anchor_ids=anchor_ids, known_tag_ids=tag_ids)
    step_m = None if np.all(np.isnan(log.range_stddev_m)) else find_quantization_m(log.range_m)
    least_m = 0.0 if step_m is None else quantization_stddev_m(step_m)
    return replace(log, range_stddev_m=np.maximum(log.range_stddev_m, least_m))


def read_anchors_in_log(path: AnyPath | Sequence[AnyPath], *, format: str = "") -> tuple[Anchor, ...]:
    """Return the anchors whose positions a log contains, as logs of the DWM1001 do; empty if it contains none.

    The position of an anchor is the median of its positions in the log. It is unknown if several anchors have the same
    position, because then nobody has set them up.

    Args:
        path: as for ``read_ranges``.
        format: one of ``reader_names()``; empty: recognized by content.

    Raises:
        InputError: the file is missing, empty, or of no known format.
    """
    paths, options = _paths(path), RangesOptions()
    with _asking_by_commands(paths, options):
        chosen = _choose_readers(paths, options, format)
    anchors = [(file, anchor) for file, reader in chosen for anchor in reader.read_anchors(file)]
    for file, anchor in anchors:
        if anchor.position_m is not None and not COORDINATE_M.hold(anchor.position_m).all():
            raise InputError(f"the position of anchor {anchor.anchor_id} is not one, expected {COORDINATE_M}", file)
    return tuple(anchor for _, anchor in anchors)


@contextmanager
def _asking_by_commands(paths: Sequence[Path], options: RangesOptions) -> Iterator[None]:
    """Let the error about an unclear log of the block advise whole commands, with what the user has said already."""
    try:
        yield
    except UnclearFileError as error:
        said = {
            "columns": columns_typed(options.columns),
            "timestamp_unit": options.timestamp_unit or "",
            "range_unit": options.range_unit or "",
            "separator": options.separator,
        }
        command = ["rangesfm", "ranges", *map(str, paths)]
        raise error.advising([*error.about, *(choice.typed(command, said) for choice in error.choices)]) from None


def _check_numbers(log: RangeLog) -> None:
    """Raise InputError for a number with which one cannot calculate; a standard deviation may be NaN, not known."""
    numbers = {
        "range_m": (log.range_m, LENGTH_M),
        "range_stddev_m": (log.range_stddev_m, STDDEV_M),
        "timestamp_s": (log.timestamp_s, TIME_S),
    }
    for name, (values, bounds) in numbers.items():
        wrong = ~bounds.hold(values) & ~np.isnan(values)
        if wrong.any():
            row = int(np.argmax(wrong))
            message = f"{name} is {values[row]:g}, expected {bounds}: is its unit right?"
            raise InputError(message, log.source, int(log.line[row]))


def _paths(path: AnyPath | Sequence[AnyPath]) -> list[Path]:
    paths = [path] if isinstance(path, (str, os.PathLike)) else [*path]
    if "" in paths:
        raise InputError("a log's name is empty, expected a file")
    return [*map(Path, paths)]


def _choose_readers(paths: Sequence[Path], options: RangesOptions, format: str) -> list[tuple[Path, Reader]]:
    """Return every file of the log with its reader; other files in a folder are left out."""
    files = [file for path in paths for file in files_of_log(path)]
    is_folder = len(paths) == 1 and len(files) > 1 and paths[0].is_dir()
    chosen: list[tuple[Path, Reader]] = []
    refused: InputError | None = None
    for file in files:
        try:
            chosen.append((file, find_log_reader(file, options, format)))
        except InputError as error:
            if not is_folder:
                raise
            refused = error
    names = {reader.name for _, reader in chosen}
    if len(names) > 1:
        found = ", ".join(f"{file.name} ({reader.name})" for file, reader in chosen)
        raise InputError(
            f"logs of several formats: {found}; name those to be read, for example by {files[0].parent}/*.csv", paths[0]
        )
    if refused is not None and not chosen:
        raise refused
    return chosen


def _join_logs(logs: Sequence[RangeLog], source: Path) -> RangeLog:
    """Join logs into one, sorted by time if there are times; each range is between the tag and anchor of its record."""
    if len({type(log.moments) for log in logs}) > 1:
        raise InputError("some of the files have times and others names of photos, expected the same in all", source)
    ends = [log.end_ids() for log in logs]
    is_by_photo = isinstance(logs[0].moments, ByPhoto)
    columns = {
        name: np.concatenate([getattr(log, name) for log in logs])
        for name in ("range_m", "range_stddev_m", "los", "line")
    }
    joined = RangeLog.from_arrays(
        [anchor_id for _, anchor_ids in ends for anchor_id in anchor_ids],
        timestamp_s=() if is_by_photo else np.concatenate([log.timestamp_s for log in logs]),
        image_name=[name for log in logs for name in log.image_name] if is_by_photo else (),
        tag_id=[tag_id for tag_ids, _ in ends for tag_id in tag_ids],
        source=source,
        format=logs[0].format,
        num_no_measurement=sum(log.num_no_measurement for log in logs),
        notes=(f"{len(logs)} files as one log", *dict.fromkeys(note for log in logs for note in log.notes)),
        **columns,
    )
    return joined if is_by_photo else joined.subset(np.argsort(joined.timestamp_s, kind="stable"))


def files_of_log(path: Path) -> list[Path]:
    """Return the files of a log: the path itself, all files in a folder, or those that fit a pattern.

    Raises:
        InputError: there are none.
    """
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
    return sorted(found, key=lambda file: natural_order(file.name))


def find_log_reader(path: Path, options: RangesOptions = RangesOptions(), format: str = "") -> Reader:
    """Find the reader of a file.

    Args:
        format: name of the reader; empty: recognized by content.

    Raises:
        InputError: no reader recognizes the file for sure; for a table the error has advice.
    """
    if format not in ("", TABLE.name):
        named = next((reader for reader in _READERS if reader.name == format), None)
        if named is None:
            raise InputError(f"no log format is named '{format}', expected one of {', '.join(reader_names())}", path)
        return named
    if is_bag_folder(path):
        return ros.READER
    head = read_head(path)
    if not head.strip():
        raise InputError("the file is empty, expected a log of ranges", path)
    known = () if format == TABLE.name else _READERS
    if reader := next((reader for reader in known if reader.recognizes(head)), None):
        return reader
    if "\0" in head:
        raise InputError("is neither text nor a bag: unpack it, or save it as UTF-8 text", path)
    return table_reader(path, options)
