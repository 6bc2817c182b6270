"""Readers of tables: with columns named by the user, columns of a known data set, or columns that are recognized.

The canonical CSV is ``timestamp_s,anchor_id,range_m[,tag_id,range_stddev_m,los]``. ``image_name`` may replace
``timestamp_s``; if both are present, the time is used.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import partial
from itertools import islice, permutations
from pathlib import Path

import numpy as np

from rangesfm.errors import InputError, printable
from rangesfm.measurements.ranges.range_log import DEFAULT_TAG_ID, RangeLog
from rangesfm.measurements.ranges.readers.columns import CANONICAL, QUANTITIES, STAMPS, read_columns
from rangesfm.measurements.ranges.readers.guess import Guess, described, guess_columns
from rangesfm.measurements.ranges.readers.layout import Layout, are_quaternions, find_layout, read_rows
from rangesfm.measurements.ranges.readers.lists import TableForm, columns_taken
from rangesfm.measurements.ranges.readers.reader import EndpointRoles, Reader
from rangesfm.measurements.ranges.readers.unclear import Choice, UnclearFileError, columns_typed
from rangesfm.options import RangesOptions
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.text_tables import header_names, read_head, read_table, write_user_table
from rangesfm.util.geometry.moments import ByTime

_FORM = TableForm(
    "ranges",
    {
        "timestamp": "timestamp_s",
        "image_name": "image_name",
        "anchor_id": "anchor_id",
        "range": "range_m",
        "tag_id": "tag_id",
        "range_stddev": "range_stddev_m",
        "los": "los",
    },
    ("timestamp or image_name", "anchor_id", "range"),
    lambda form, path, layout: None,
)
_PRESETS = {
    "starloc": {"timestamp": "time_s", "range": "range", "tag_id": "from_id", "anchor_id": "to_id"},
    "miluv": {"timestamp": "timestamp", "range": "range", "tag_id": "from_id", "anchor_id": "to_id"},
    "uwb_init": {"timestamp": "t", "range": "range", "tag_id": "ID_Tag", "anchor_id": "ID_Anchor"},
    "inrol": {"timestamp": "timestamp", "range": "r", "anchor_id": "anchor_id"},
}
_INROLS_COLUMNS = ("index", "timestamp", "anchor_id", "r")
_INROLS_COMMENT = re.compile(
    r"\s{0,99}#[ \t]{0,9}index[ \t]{1,9}timestamp[ \t]{1,9}anchor_id[ \t]{1,9}r[ \t]{0,9}(?:\n|$)"
)
_ID_IN_NAME = re.compile(r"(?:.*[^0-9A-Za-z])?([A-Za-z]{0,2}\d{1,3}|(?=[A-F]*\d)[0-9A-F]{4})", re.ASCII)
_MOST_COMMANDS = 4  # commands for columns of which nothing is known
_SPAN = re.compile(r"(\D*)(\d{1,4})-(\D*)(\d{1,4})", re.ASCII)
_POSITIONS_ONLY = (
    "holds positions that the radio computed and not the ranges they came from; "
    "record the ranges themselves (DWM1001: the command lec or les instead of lep)"
)
_TDOA = (
    "holds differences of arrival times (TDoA), which are no ranges between a tag and an anchor; "
    "record two-way ranging instead"
)
# Logs of radios that hold no ranges, and what they hold instead. Positions may stand beside ranges, and are the reason
# only if nothing in the log can be the ranges.
_NO_RANGES = (
    (re.compile(r'\btdoa\b|\btdoa_|"tdoa|\bidA\b.{0,99}\bidB\b', re.ASCII | re.IGNORECASE), _TDOA),
    (re.compile(r'"tagId".{0,2000}"(?:tagData|coordinates|anchorData)"', re.ASCII | re.DOTALL), _POSITIONS_ONLY),
    (re.compile(r"(?<![0-9A-Za-z])POS[,\[]-?\d", re.ASCII), _POSITIONS_ONLY),
    (re.compile(r'"(?:POS|pos|position)"\s*:\s*[{\[]|"est_pos"', re.ASCII), _POSITIONS_ONLY),
)


def _anchor_of_file(path: Path) -> str:
    """Return the anchor id in a file name: A5 in ``run_3_A5.csv``, or else the whole name without its ending."""
    stem = path.name.split(".")[0]
    found = _ID_IN_NAME.fullmatch(stem)
    return found[1] if found else stem


def table_reader(path: Path, options: RangesOptions) -> Reader:
    """Return the reader of a table whose columns are recognized by names and values.

    Raises:
        InputError: the columns are not known for sure. The advice gives what was found, the closest guess and the
            command to type.
    """
    layout = find_layout(path, options.separator)
    if layout is None:
        _refuse_other_logs(path, _NO_RANGES)
        first_line = printable(read_head(path).strip().split("\n")[0])
        raise InputError(f"neither a known log format nor a table; it begins with '{first_line}'", path)
    guess = guess_columns(layout)
    if guess.missing or guess.doubts or (not layout.has_names and _is_trajectory(layout)):
        raise _question(path, layout, guess)
    notes = tuple(_notes(path, layout, guess))

    def read(path: Path, options: RangesOptions) -> RangeLog:
        return _read(path, options, TABLE.name, guess.columns, layout, notes)

    return replace(TABLE, read=read, roles=guess.roles)


def _is_trajectory(layout: Layout) -> bool:
    """Return whether a table has the columns of a TUM trajectory: time, x, y, z, and a quaternion."""
    columns = layout.columns
    return len(columns) == 8 and all(one.kind == "numbers" for one in columns) and are_quaternions(columns[4:])


def _notes(path: Path, layout: Layout, guess: Guess) -> Iterable[str]:
    found = {quantity: name for quantity, name in guess.columns.items() if not quantity.startswith("range:")}
    yield columns_taken(found, layout.has_names)
    yield from guess.notes
    if "anchor_id" not in found and not guess.is_wide:
        yield f"no column gives the anchor: it is named '{_anchor_of_file(path)}' after the file"


def _refuse_other_logs(path: Path, known: Iterable[tuple[re.Pattern[str], str]]) -> None:
    """Raise InputError for a log that holds something else than ranges.

    Args:
        known: patterns of such logs, and what they hold.
    """
    head = read_head(path)
    if instead := next((what for pattern, what in known if pattern.search(head)), None):
        raise InputError(f"the log {instead}", path)


def _question(path: Path, layout: Layout, guess: Guess) -> InputError:
    if _is_trajectory(layout):
        return InputError("holds poses over time (a trajectory) and no ranges", path)
    _refuse_other_logs(path, _NO_RANGES if "range" in guess.missing else _NO_RANGES[:1])
    closest = ", ".join(f"{quantity} = {name}" for quantity, name in guess.told.items()) or "none"
    why = "; ".join([*(f"no column seems to be the {missing}" for missing in guess.missing), *guess.doubts])
    last = "perhaps" if guess.missing else "if that is right"
    choices = [Choice(last, {"columns": columns_typed(columns)}) for columns in _possible_columns(layout, guess)]
    nothing = f"no other column of numbers can be the {' or the '.join(guess.missing)}, which a log needs"
    about = (
        f"found: {len(layout.columns)} columns: {', '.join(described(layout.columns))}",
        f"closest guess: {closest}",
        f"not sure: {why}",
        *([] if choices else [nothing]),
    )
    return UnclearFileError(_FORM.what, path, about, choices, "a table whose columns are not known for sure")


def _possible_columns(layout: Layout, guess: Guess) -> Iterable[dict[str, str]]:
    """Yield the columns of a guess, with a few columns of numbers in the place of those that it misses."""
    taken = guess.columns.values()
    free = [
        column.name
        for column in layout.columns
        if column.kind == "numbers" and column.name not in taken and len({*column.numbers}) > 1
    ]
    for names in islice(permutations(free, len(guess.missing)), _MOST_COMMANDS):
        yield {**guess.told, **dict(zip(guess.missing, names))}


def _recognizes(format: str, head: str) -> bool:
    if format == "inrol":
        return _INROLS_COMMENT.match(head) is not None
    return set(_PRESETS[format].values()) <= set(header_names(head))


def _read_preset(format: str, path: Path, options: RangesOptions) -> RangeLog:
    return _read(path, options, format, {**_PRESETS[format], **options.columns})


def _read_mapped(path: Path, options: RangesOptions) -> RangeLog:
    return _read(path, options, MAPPED.name, options.columns, find_layout(path, options.separator))


def _read(
    path: Path,
    options: RangesOptions,
    format: str,
    told: Mapping[str, str],
    layout: Layout | None = None,
    notes: tuple[str, ...] = (),
) -> RangeLog:
    """Read a table by the columns that the user, a preset or a guess names.

    Args:
        told: name of the column of each quantity, as ``Guess.columns``.
        layout: of the table; None: it has a header row, and cells between separators.
        notes: lines for the user, before those on the rows.
    """
    for quantity in (key.partition(":")[0] for key in told):
        if quantity not in QUANTITIES:
            message = f"quantity in columns is '{quantity}', expected one of {', '.join(QUANTITIES)}"
            raise InputError(message, path)
    if not {"timestamp", "image_name"} & set(told):
        raise InputError("columns must name range, timestamp (or image_name) and anchor_id where there is one", path)
    wide = _wide(told, path)
    columns = {key: name for key, name in told.items() if not key.startswith("range:")}
    if layout is not None and not {*columns.values(), *wide} <= {*layout.names}:
        layout = None
    third_message = {}
    if "range" not in columns and not wide:
        names = layout.names if layout else header_names(read_head(path), options.separator)
        stamps = {stamp: columns.get(stamp, stamp) for stamp in STAMPS}
        if not {*(stamps[stamp] for stamp in STAMPS[:4])} <= set(names):
            wanted, found = ", ".join(STAMPS[:4]), printable(", ".join(names))
            raise InputError(f"columns name neither range nor the time stamps {wanted}; found {found}", path)
        columns = {**{stamp: stamps[stamp] for stamp in STAMPS[:4]}, **columns}
        third_message = {stamp: stamps[stamp] for stamp in STAMPS[4:]}
    columns |= {f"range:{name}": name for name in wide}
    columns |= {anchor_id: anchor_id[1:] for anchor_id, _ in wide.values() if anchor_id.startswith("@")}
    required, optional = dict.fromkeys(columns.values()), [*third_message.values()]
    columns |= third_message
    if layout is not None:
        table = layout.read().by_quantity(columns)
        if layout.are_records and "range" in table:  # records without a range are about something else
            table = table.where([cell != "" for cell in table.text("range", empty="")])
    elif format == "inrol":
        table = read_rows(path, _INROLS_COLUMNS, " ").by_quantity(columns)
    else:
        table = read_table(path, [*required], optional, separator=options.separator).by_quantity(columns)
    table = replace(table, notes=(*notes, *table.notes))
    links = {f"range:{name}": ids for name, ids in wide.items()}
    return read_columns(table, options, format, wide=links, anchor_id=_anchor_of_file(path))


def _wide(told: Mapping[str, str], path: Path) -> dict[str, tuple[str, str]]:
    """Return the columns that belong to one anchor and one tag each, with the ids of these.

    They are given one by one, as ``range:A1=d1``, or many at once, as ``range:0-7:T0-T2=2-25``. After an @ comes the
    column in which the anchor's id is.
    """
    wide: dict[str, tuple[str, str]] = {}
    for key, name in told.items():
        quantity, _, ids = key.partition(":")
        if quantity == "range" and ids.startswith("@"):
            wide[name] = (ids, "")
        elif quantity == "range" and ids:
            anchors, tags = (_spanned(part) for part in (ids.partition(":")[0], ids.partition(":")[2]))
            names = _spanned(name) if len(anchors) * len(tags) > 1 else [name]
            if len(names) != len(anchors) * len(tags):
                expected = f"{len(anchors)} x {len(tags)}"
                raise InputError(f"columns: {key} names {len(names)} columns, expected {expected}, tags in turn", path)
            wide |= dict(zip(names, ((anchor, tag) for anchor in anchors for tag in tags)))
    return wide


def _spanned(text: str) -> list[str]:
    """Return the items of a span: T0, T1, T2 for T0-T2."""
    span = _SPAN.fullmatch(text)
    if span is None or span[3] not in ("", span[1]) or int(span[4]) < int(span[2]):
        return [text]
    return [f"{span[1]}{number}" for number in range(int(span[2]), int(span[4]) + 1)]


def write_ranges_csv(log: RangeLog, path: AnyPath) -> None:
    """Write a log as canonical CSV; optional columns are written only if the log has values for them.

    For a range between two anchors or two tags, the other end is in the column of the tag or of the anchor.

    Raises:
        InputError: the file cannot be written.
    """
    columns: dict[str, Iterable[str]] = {}
    if isinstance(log.moments, ByTime):
        columns["timestamp_s"] = map(repr, log.timestamp_s.tolist())
    else:
        columns["image_name"] = log.image_name
    tag_id, columns["anchor_id"] = log.end_ids()
    columns["range_m"] = map(repr, log.range_m.tolist())
    if set(tag_id) != {DEFAULT_TAG_ID}:
        columns["tag_id"] = tag_id
    if not np.all(np.isnan(log.range_stddev_m)):
        columns["range_stddev_m"] = ("" if np.isnan(stddev) else repr(stddev) for stddev in log.range_stddev_m.tolist())
    if np.any(log.los >= 0):
        columns["los"] = ("" if los < 0 else str(los) for los in log.los)
    write_user_table(Path(path), [*columns], zip(*columns.values()))


def _read_canonical(path: Path, options: RangesOptions) -> RangeLog:
    if options.columns or options.timestamp_unit not in (None, "s"):
        raise InputError("the canonical CSV has fixed columns, with times in seconds; use format 'mapped'", path)
    return read_columns(_FORM.read_canonical(path, options.separator), options.changed(timestamp_unit=None), CANONICAL)


CANONICAL_CSV = Reader(CANONICAL, _FORM.is_canonical, _read_canonical)
PRESETS = tuple(
    Reader(
        name,
        partial(_recognizes, name),
        partial(_read_preset, name),
        roles=EndpointRoles.ASKER_AND_ASKED if "from_id" in preset.values() else EndpointRoles.TAG_AND_ANCHOR,
    )
    for name, preset in _PRESETS.items()
)
MAPPED = Reader("mapped", lambda head: False, _read_mapped)
TABLE = replace(MAPPED, name="table")
