"""Radio logs of many formats, read into one: the range log."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError, printable
from rangesfm.files.tables import read_head
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.errors.quantization import find_quantization_m, quantization_stddev_m
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.readers import ros
from rangesfm.ranging.readers.canonical import write_ranges_csv
from rangesfm.ranging.readers.not_ranges import reason_without_ranges
from rangesfm.ranging.readers.reader import Reader, ReadOptions
from rangesfm.ranging.readers.registry import READERS, find_reader, reader_names, recognize
from rangesfm.ranging.readers.roles import tell_roles
from rangesfm.ranging.twr import StampOptions

__all__ = ["read_anchors_in_log", "read_ranges", "reader_names", "write_ranges_csv"]


def read_ranges(
    path: str | Path,
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
        format: one of ``reader_names()``; None: "mapped" with ``columns``, else recognised by content.
        columns: name in the file of ``timestamp`` (or ``image_name``), ``anchor_id``, ``range`` and,
            where it has them, ``tag_id``, ``range_stddev``, ``los``; without ``range``, the time stamps
            ``tx1``, ``rx1``, .. of two-way ranging, where they have other names than these.
        timestamp_unit: s, ms, us, ns or iso; None: what the format says or the number of digits, else s.
        range_unit: m, cm or mm; None: what the format says, else m.
        separator: between cells (a blank: any run of blanks); None: told from the header row.
        anchor_ids, tag_ids: known anchors and tags, which tell them apart where the log does not, and ranges
            between two of a kind from those between a tag and an anchor.
        ranging_interval_s: time between two rounds, for radios that count rounds where nobody wrote times.
        stamps: how those time stamps become ranges; None: nanoseconds of a 32-bit DW1000, through air.

    Returns:
        All ranges in the order of the log, zeros (no measurement) counted and left out. Where all are whole
        centimetres or decimetres, no stddev that the log gives is less than that of the rounding.

    Raises:
        InputError: with the line where there is one, for a file that is missing, empty, of no known
            format, broken, or without any usable range.
    """
    path = Path(path)
    if ranging_interval_s is not None and not 0 < ranging_interval_s < float("inf"):
        raise InputError(f"ranging_interval_s is {ranging_interval_s}, expected a positive number of seconds", path)
    options = ReadOptions(
        columns=dict(columns or {}),
        timestamp_unit=timestamp_unit,
        range_unit=range_unit,
        separator=separator,
        ranging_interval_s=ranging_interval_s,
        stamps=stamps or StampOptions(),
    )
    reader = _choose_reader(path, format or ("mapped" if columns else None))
    log = tell_roles(reader.read(path, options), reader.sides, known_anchor_ids=anchor_ids, known_tag_ids=tag_ids)
    return _not_better_than_rounding(log)


def read_anchors_in_log(path: str | Path, *, format: str | None = None) -> tuple[Anchor, ...]:
    """The anchors whose positions a log tells beside its ranges, as those of the DWM1001 do.

    Args:
        format: one of ``reader_names()``; None: recognised by content.

    Returns:
        Each at the median of its positions, unknown where several share a place (nobody set them up);
        empty if the format tells none.

    Raises:
        InputError: for a file that is missing, empty or of no known format.
    """
    path = Path(path)
    reader = _choose_reader(path, format)
    return () if reader.read_anchors is None else reader.read_anchors(path)


def _not_better_than_rounding(log: RangeLog) -> RangeLog:
    step_m = None if np.all(np.isnan(log.range_stddev_m)) else find_quantization_m(log.range_m)
    if step_m is None:
        return log
    return replace(log, range_stddev_m=np.maximum(log.range_stddev_m, quantization_stddev_m(step_m)))


def _choose_reader(path: Path, format: str | None) -> Reader:
    if format is not None:
        reader = find_reader(format)
        if reader is None:
            raise InputError(f"no log format is named '{format}', expected one of {', '.join(reader_names())}", path)
        return reader
    if ros.is_bag_folder(path):
        return ros.READER
    head = read_head(path)
    if not head.strip():
        raise InputError("the file is empty, expected a log of ranges", path)
    reader = recognize(head)
    if reader is None:
        reason = reason_without_ranges(head)
        if reason is not None:
            raise InputError(f"the log {reason}", path)
        first_line = printable(head.strip().split("\n")[0])
        known = "; ".join(f"{reader.name} ({reader.description})" for reader in READERS)
        raise InputError(f"not a known log format, it begins with '{first_line}'; known are {known}", path)
    return reader
