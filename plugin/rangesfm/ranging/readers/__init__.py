"""Radio logs of many formats, read into one: the range log."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError
from rangesfm.files.bags import is_bag_folder
from rangesfm.files.tables import read_head
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.errors.quantization import find_quantization_m, quantization_stddev_m
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.readers import ros
from rangesfm.ranging.readers.canonical import write_ranges_csv
from rangesfm.ranging.readers.reader import Reader, ReadOptions
from rangesfm.ranging.readers.registry import find_reader, reader_names, recognize
from rangesfm.ranging.readers.roles import tell_roles
from rangesfm.ranging.readers.several import files_of_log, join_logs
from rangesfm.ranging.readers.table import TABLE, table_reader
from rangesfm.ranging.twr import StampOptions

__all__ = ["find_log_reader", "read_anchors_in_log", "read_ranges", "reader_names", "write_ranges_csv"]


def read_ranges(
    path: str | Path | Sequence[str | Path],
    *,
    format: str | None = None,
    columns: Mapping[str, str] | None = None,
    timestamp_unit: str | None = None,
    range_unit: str | None = None,
    separator: str | None = None,
    anchor_ids: Collection[str] = (),
    tag_ids: Collection[str] = (),
    ranging_interval_s: float | None = None,
    stamps: StampOptions | None = None,
) -> RangeLog:
    """Read a radio's log.

    Args:
        path: a file; or several, a folder of them, or a pattern as ``uwb_*.csv``, one an anchor say.
        format: one of ``reader_names()``; None: "mapped" with ``columns``, else recognised by content.
        columns: name in the file (or number, in one without names) of ``timestamp`` (or ``image_name``),
            ``anchor_id``, ``range`` and, where it has them, ``tag_id``, ``range_stddev``, ``los`` and others of
            ``columns.QUANTITIES``; a column an anchor: ``range:A1``, or ``range:A1:T0`` with the tag; without
            ``range``, the time stamps ``tx1``, ``rx1``, .. of two-way ranging, where they have other names than these.
        timestamp_unit: s, ms, us, ns or iso; None: what the format, the column's name or its values say.
        range_unit: m, cm or mm; None: what the format, the column's name or its values say.
        separator: between cells (a blank: any run of blanks); None: told from the rows.
        anchor_ids, tag_ids: known anchors and tags, which tell them apart where the log does not, and ranges
            between two of a kind from those between a tag and an anchor.
        ranging_interval_s: time between two rounds, for radios that count rounds where nobody wrote times.
        stamps: how those time stamps become ranges; None: nanoseconds of a 32-bit DW1000, through air.

    Returns:
        All ranges in the order of the log, those that are not positive (no measurement) counted and left out; its
        notes say what was assumed. Where all are whole centimetres or decimetres, no stddev that the log gives is
        less than that of the rounding.

    Raises:
        InputError: with the line where there is one, for a file that is missing, empty, not understood for sure
            (its advice says what to type), broken, or without any usable range.
    """
    if ranging_interval_s is not None and not 0 < ranging_interval_s < float("inf"):
        message = f"ranging_interval_s is {ranging_interval_s}, expected a positive number of seconds"
        raise InputError(message, path if isinstance(path, (str, Path)) else None)
    paths = [Path(one) for one in ([path] if isinstance(path, (str, Path)) else path)]
    options = ReadOptions(
        columns=dict(columns or {}),
        timestamp_unit=timestamp_unit,
        range_unit=range_unit,
        separator=separator,
        ranging_interval_s=ranging_interval_s,
        stamps=stamps or StampOptions(),
        given=[str(one) for one in paths],
    )
    chosen = _choose_readers(paths, options, format or ("mapped" if columns else None))
    logs = [reader.read(file, options) for file, reader in chosen]
    source = paths[0] if len(paths) == 1 else paths[0].parent
    log = logs[0] if len(logs) == 1 else join_logs(logs, source)
    log = tell_roles(log, chosen[0][1].sides, known_anchor_ids=anchor_ids, known_tag_ids=tag_ids)
    return _not_better_than_rounding(log)


def read_anchors_in_log(path: str | Path | Sequence[str | Path], *, format: str | None = None) -> tuple[Anchor, ...]:
    """The anchors whose positions a log tells beside its ranges, as those of the DWM1001 do.

    Args:
        format: one of ``reader_names()``; None: recognised by content.

    Returns:
        Each at the median of its positions, unknown where several share a place (nobody set them up);
        empty if the format tells none.

    Raises:
        InputError: for a file that is missing, empty or of no known format.
    """
    paths = [Path(one) for one in ([path] if isinstance(path, (str, Path)) else path)]
    chosen = _choose_readers(paths, ReadOptions(), format)
    return tuple(
        anchor for file, reader in chosen if reader.read_anchors is not None for anchor in reader.read_anchors(file)
    )


def _not_better_than_rounding(log: RangeLog) -> RangeLog:
    step_m = None if np.all(np.isnan(log.range_stddev_m)) else find_quantization_m(log.range_m)
    if step_m is None:
        return log
    return replace(log, range_stddev_m=np.maximum(log.range_stddev_m, quantization_stddev_m(step_m)))


def _choose_readers(paths: Sequence[Path], options: ReadOptions, format: str | None) -> list[tuple[Path, Reader]]:
    """Every file of the log with its reader; what else is in a folder is left out."""
    files = [file for path in paths for file in files_of_log(path)]
    is_folder = len(paths) == 1 and len(files) > 1 and paths[0].is_dir()
    chosen: list[tuple[Path, Reader]] = []
    refused: InputError | None = None
    for file in files:
        try:
            chosen.append((file, _choose_reader(file, options, format)))
        except InputError as error:
            if not is_folder:
                raise
            refused = error
    names = {reader.name for _, reader in chosen}
    if len(names) > 1:
        found = ", ".join(f"{file.name} ({reader.name})" for file, reader in chosen)
        raise InputError(
            f"logs of several formats: {found}; name those to be read, as by {files[0].parent}/*.csv", paths[0]
        )
    if refused is not None and not chosen:
        raise refused
    return chosen


def _choose_reader(path: Path, options: ReadOptions, format: str | None) -> Reader:
    if format is not None and format != TABLE.name:
        reader = find_reader(format)
        if reader is None:
            raise InputError(f"no log format is named '{format}', expected one of {', '.join(reader_names())}", path)
        return reader
    if is_bag_folder(path):
        return ros.READER
    head = read_head(path)
    if not head.strip():
        raise InputError("the file is empty, expected a log of ranges", path)
    reader = None if format == TABLE.name else recognize(head)
    return table_reader(path, options) if reader is None else reader


def find_log_reader(path: Path) -> Reader:
    """The reader of a file of which nothing is said.

    Raises:
        InputError: it is no radio's log, or not for sure; a table that may be one has advice.
    """
    return _choose_reader(path, ReadOptions(), None)
