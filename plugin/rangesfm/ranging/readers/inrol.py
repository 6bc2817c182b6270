"""The text files of the INRoL UWB data set: columns between blanks, their names in a comment."""

from __future__ import annotations

import re
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.readers.columns import Columns, read_columns
from rangesfm.ranging.readers.reader import Reader, ReadOptions

_HEADER = ("index", "timestamp", "anchor_id", "r")
_BEGIN = re.compile(r"\s{0,99}#[ \t]{0,9}index[ \t]{1,9}timestamp[ \t]{1,9}anchor_id[ \t]{1,9}r[ \t]{0,9}(?:\n|$)")
_COLUMNS = Columns(
    required={"timestamp": "timestamp", "anchor_id": "anchor_id", "range": "r"},
    optional={},
    separator=" ",
    header=_HEADER,
    negative_is_no_measurement=True,
)


def _read(path: Path, options: ReadOptions) -> RangeLog:
    if options.columns or (options.timestamp_unit, options.range_unit, options.separator) != (None, None, None):
        raise InputError("INRoL's text has fixed columns in seconds and metres; use format 'mapped'", path)
    return read_columns(path, _COLUMNS, READER.name)


READER = Reader(
    "inrol",
    "INRoL's text: # index timestamp anchor_id r",
    recognizes=lambda head: _BEGIN.match(head) is not None,
    read=_read,
)
