"""The canonical CSV: ``timestamp_s,anchor_id,range_m[,tag_id,range_stddev_m,los]``.

``image_name`` may take the place of ``timestamp_s``; where both stand, the time counts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError
from rangesfm.files.tables import header_names, read_head, write_table
from rangesfm.ranging.log import DEFAULT_TAG_ID, RangeLog
from rangesfm.ranging.readers.columns import Columns, read_columns
from rangesfm.ranging.readers.reader import Reader, ReadOptions

_BY_TIME = Columns(
    required={"timestamp": "timestamp_s", "anchor_id": "anchor_id", "range": "range_m"},
    optional={"tag_id": "tag_id", "range_stddev": "range_stddev_m", "los": "los"},
    is_strict=True,
)
_BY_IMAGE = replace(_BY_TIME, required={"image_name": "image_name", "anchor_id": "anchor_id", "range": "range_m"})


def write_ranges_csv(log: RangeLog, path: str | Path) -> None:
    """Write ``log`` as canonical CSV; optional columns only where the log says anything.

    Of a range between two of a kind, the peer stands in the column of the tag (or of the anchor).

    Raises:
        InputError: the file cannot be written.
    """
    columns: dict[str, Iterable[str]] = {}
    if log.timestamp_s is not None:
        columns["timestamp_s"] = map(repr, log.timestamp_s.tolist())
    else:
        columns["image_name"] = log.image_name or ()
    tag_id, columns["anchor_id"] = log.end_ids()
    columns["range_m"] = map(repr, log.range_m.tolist())
    if set(tag_id) != {DEFAULT_TAG_ID}:
        columns["tag_id"] = tag_id
    if not np.all(np.isnan(log.range_stddev_m)):
        columns["range_stddev_m"] = ("" if np.isnan(stddev) else repr(stddev) for stddev in log.range_stddev_m.tolist())
    if np.any(log.los >= 0):
        columns["los"] = ("" if los < 0 else str(los) for los in log.los)
    try:
        write_table(Path(path), [*columns], zip(*columns.values()))
    except OSError as error:
        raise InputError(f"cannot be written ({error.strerror})", path) from error


def _recognizes(head: str) -> bool:
    names = {*header_names(head)}
    return {"anchor_id", "range_m"} <= names and not names.isdisjoint({"timestamp_s", "image_name"})


def _read(path: Path, options: ReadOptions) -> RangeLog:
    if options.columns or options.timestamp_unit not in (None, "s") or options.range_unit not in (None, "m"):
        raise InputError("the canonical CSV has fixed columns in seconds and metres; use format 'mapped'", path)
    names = header_names(read_head(path), options.separator)
    columns = _BY_IMAGE if "image_name" in names and "timestamp_s" not in names else _BY_TIME
    return read_columns(path, columns, options.changed(timestamp_unit=None, range_unit=None), READER.name)


READER = Reader("canonical", _recognizes, _read)
