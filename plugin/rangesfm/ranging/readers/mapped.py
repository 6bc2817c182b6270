"""Any CSV or TSV, by the names and units of its columns; some by a named preset."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from functools import partial
from pathlib import Path

from rangesfm.errors import InputError, printable
from rangesfm.files.tables import header_names, read_head
from rangesfm.ranging.log import RangeLog
from rangesfm.ranging.readers.columns import (
    QUANTITIES,
    STAMPS,
    UNITS_PER_METRE,
    Columns,
    read_columns,
)
from rangesfm.ranging.readers.reader import Reader, ReadOptions
from rangesfm.ranging.readers.roles import Sides
from rangesfm.ranging.readers.time_units import TIMESTAMP_UNITS

_PRESETS = {
    "starloc": ("STAR-loc CSV", {"timestamp": "time_s", "range": "range", "tag_id": "from_id", "anchor_id": "to_id"}),
    "miluv": ("MILUV CSV", {"timestamp": "timestamp", "range": "range", "tag_id": "from_id", "anchor_id": "to_id"}),
    "uwb_init": ("uwb_init CSV", {"timestamp": "t", "range": "range", "tag_id": "ID_Tag", "anchor_id": "ID_Anchor"}),
}


def _recognizes(preset: Mapping[str, str], head: str) -> bool:
    return set(preset.values()) <= set(header_names(head))


def _read(format: str, preset: Mapping[str, str], path: Path, options: ReadOptions) -> RangeLog:
    columns = {**preset, **options.columns}
    _check_choice("quantity in columns", columns, QUANTITIES, path)
    _check_choice("timestamp_unit", [options.timestamp_unit or "s"], TIMESTAMP_UNITS, path)
    _check_choice("range_unit", [options.range_unit or "m"], UNITS_PER_METRE, path)
    if "anchor_id" not in columns or not {"timestamp", "image_name"} & set(columns):
        raise InputError("columns must name anchor_id, range and timestamp (or image_name)", path)
    third_message = {}
    if "range" not in columns:
        names = header_names(read_head(path), options.separator)
        stamps = {stamp: columns.get(stamp, stamp) for stamp in STAMPS}
        if not {*(stamps[stamp] for stamp in STAMPS[:4])} <= set(names):
            wanted, found = ", ".join(STAMPS[:4]), printable(", ".join(names))
            raise InputError(f"columns name no column range, nor the time stamps {wanted}; found {found}", path)
        columns = {**{stamp: stamps[stamp] for stamp in STAMPS[:4]}, **columns}
        third_message = {stamp: stamps[stamp] for stamp in STAMPS[4:]}
    described = Columns(
        required=columns,
        optional=third_message,
        timestamp_unit=options.timestamp_unit or "s",
        range_unit=options.range_unit or "m",
        separator=options.separator,
        negative_is_no_measurement=True,
        stamps=options.stamps,
    )
    return read_columns(path, described, format)


def _check_choice(what: str, given: Iterable[str], choices: Collection[str], path: Path) -> None:
    for value in given:
        if value not in choices:
            raise InputError(f"{what} is '{value}', expected one of {', '.join(choices)}", path)


READERS = (
    *(
        Reader(
            name,
            description,
            partial(_recognizes, preset),
            partial(_read, name, preset),
            sides=Sides.ASKED if "from_id" in preset.values() else Sides.TOLD,
        )
        for name, (description, preset) in _PRESETS.items()
    ),
    Reader("mapped", "any CSV or TSV by a mapping of its columns", lambda head: False, partial(_read, "mapped", {})),
)
