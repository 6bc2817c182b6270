"""Readers of positions: tables of any layout, and the formats of POSITION_READERS.

Each is a function that returns a PositionLog, and one that recognises the beginning of a file. Pozyx and other systems
write tables with names of columns, which are recognised like those of range logs.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path

import numpy as np

from rangesfm.arrays import Array, Mask
from rangesfm.errors import InputError, nearest_known, printable
from rangesfm.measurements.positions.pose_priors import is_database, read_pose_priors
from rangesfm.measurements.positions.position_columns import (
    COVARIANCES,
    POSITIONS,
    STDDEVS,
    is_degrees,
)
from rangesfm.measurements.positions.position_log import PositionLog, crs_in_head, crs_of_line, is_no_row
from rangesfm.measurements.ranges.anchors.site import WIDEST_DEG
from rangesfm.measurements.ranges.readers import vocabulary as terms
from rangesfm.measurements.ranges.readers.layout import MISSING, find_layout
from rangesfm.measurements.ranges.readers.lists import AXES, metres, times_by_row, unclear_table
from rangesfm.measurements.ranges.readers.readings import RECORD_TIMES
from rangesfm.measurements.ranges.readers.times import DAY_S, Clock
from rangesfm.option_model import Bounds
from rangesfm.options import COORDINATE_M, STDDEV_M, PositionOptions
from rangesfm.util.files.text_tables import (
    TextTable,
    header_names,
    is_number,
    read_head,
    read_text,
    read_without_header,
)
from rangesfm.util.geometry.georeference import GEOCENTRIC, GEOGRAPHIC, geographic_of, rotation_to_enu
from rangesfm.util.geometry.moments import ByPhoto, ByTime, Moments
from rangesfm.util.geometry.reference import is_reference_file, is_tum_row, tum_table

DEGREES = Bounds(-360, 360, "degrees")
_GPS_EPOCH = datetime(1980, 1, 6, tzinfo=timezone.utc)
AUTONOMOUS_STDDEV_M = 3.0
"""Standard deviation of a coordinate by satellites without corrections, metres."""
# Standard deviations of positions by the quality that NMEA's GGA reports, metres: autonomous, differential, fixed RTK,
# float RTK. Receivers that send GST sentences say it themselves.
_NMEA_STDDEVS_M = {1: AUTONOMOUS_STDDEV_M, 2: 1.0, 4: 0.02, 5: 0.3}
_NMEA = re.compile(r"\$(?:[A-Z]{2})(GGA|RMC|GST|ZDA),([^*\r\n]*)(?:\*([0-9A-Fa-f]{2}))?\s*")

_GPX_POINT = "<trkpt"  # of a track
_DECIMALS = r"-?\d{1,6}\.\d\d"
_DWM1001 = re.compile(rf"(?:POS,|(?:POS|est)\[)({_DECIMALS}),({_DECIMALS}),({_DECIMALS}),\d{{1,3}}(?![\d.])", re.ASCII)
_DWM1001_BEGIN = re.compile(r"POS[,\[]|DIST,|AN\d|[0-9A-F]{4}\[", re.ASCII)  # the host's time is in front of it
_MANY = 20  # rows

Reader = Callable[[Path, PositionOptions], PositionLog]


def read_positions(path: Path, options: PositionOptions) -> PositionLog:
    """Read a file of positions.

    Raises:
        UnclearFileError: the columns are not known for sure; the advice says what to type.
        InputError: the file is not valid; the error gives the line.
    """
    if options.format:
        if options.format not in POSITION_READERS:
            near = nearest_known(options.format, POSITION_READERS)
            raise InputError(f"unknown format of positions '{printable(options.format)}'; the nearest is '{near}'")
        return POSITION_READERS[options.format][1](path, options)
    head = read_head(path)
    if options.columns:
        return _read_table(path, options)
    read = next((read for is_it, read in POSITION_READERS.values() if is_it(head)), _read_table)
    return read(path, options)


def is_of_positions(head: str) -> bool:
    """Return whether a file with this beginning holds measured positions in a format that nothing else looks like."""
    return _is_nmea(head) or _is_rtklib(head) or _is_odm(head) or (_is_gpx(head) and _GPX_POINT in head)


def is_of_radio(head: str) -> bool:
    """Return whether a file with this beginning has positions that a radio computed; it may have ranges, too."""
    return _is_dwm1001(head) or _is_marvelmind(head)


def _read_table(path: Path, options: PositionOptions) -> PositionLog:
    given = options.columns or options.unit or options.timestamp_unit
    unit = "s" if not given and POSITIONS.is_canonical(read_head(path)) else options.timestamp_unit
    table = POSITIONS.read(path, options.columns, options.unit, every_row=False)
    if options.unit is None:
        _require_unit(table)
    return _log_of_table(table, options, unit)


def _require_unit(table: TextTable) -> None:
    """Raise UnclearFileError if many coordinates are whole numbers without a unit: nobody measures whole metres."""
    if len(table) < _MANY or any(terms.named_length_unit(table.names[axis]) for axis in AXES):
        return
    coordinates = np.concatenate([table.numbers(axis, empty=np.nan, missing=MISSING) for axis in AXES])
    known = coordinates[np.isfinite(coordinates)]
    layout = find_layout(table.path)
    if layout is not None and len(np.unique(known)) > len(AXES) and np.all(known == np.round(known)):
        choices = [POSITIONS.choice(f"if they are in {unit}", table.names, unit=unit) for unit in ("mm", "cm", "m")]
        why = ["the coordinates are whole numbers without a unit"]
        raise unclear_table(POSITIONS.what, table.path, layout, why, choices)


def _log_of_table(
    table: TextTable, options: PositionOptions, time_unit: str | None, format: str = "table"
) -> PositionLog:
    """Return the log in a table with columns by quantity; ``time_unit`` as for ``read_timestamps``."""
    table = replace(table, missing=MISSING)
    notes, crs = [*table.notes], crs_in_head(read_head(table.path))
    if "timestamp" in table:
        times_s, _, more = times_by_row(table, POSITIONS.what, time_unit, "position_time_unit")
        moments: Moments = ByTime(times_s)
        notes += more
    else:
        moments = ByPhoto(tuple(table.text("image_name")))
    kept = _of_one_tag(table, options.tag_id)
    are_degrees = not (crs or options.crs) and options.unit is None and _are_degrees(table)
    columns = [
        table.numbers(axis, empty=np.nan, bounds=DEGREES)
        if are_degrees and axis != "z"
        else metres(table, axis, COORDINATE_M, np.nan)
        for axis in AXES
    ]
    position = np.column_stack(columns)
    is_lost = np.zeros(len(table), dtype=bool)
    if are_degrees or crs:  # receivers without a fix write zeros, which is in the Atlantic
        is_lost |= (position[:, 0] == 0) & (position[:, 1] == 0)
    if "quality" in table:
        is_lost |= table.numbers("quality", empty=0.0) == 0
    position[is_lost] = np.nan
    log = PositionLog.in_time_order(
        table.path,
        format,
        position[kept],
        moments.subset(np.flatnonzero(kept)),
        table.line[kept],
        covariance_m2=_covariances(table)[kept],
        notes=notes,
    )
    return replace(log, crs=GEOGRAPHIC if are_degrees else crs)


def _are_degrees(table: TextTable) -> bool:
    """Return whether x and y are longitude and latitude: by their names, or where these leave it open by their spread.

    They are degrees if they spread over less than a survey of metres does.
    """
    if not all(is_degrees(table.heading(axis), axis) for axis in ("x", "y")):
        return False
    if not any(axis in terms.words_of(table.heading(axis)) for axis in ("x", "y")):
        return True
    known = [values[np.isfinite(values)] for values in (table.numbers(axis, empty=np.nan) for axis in ("x", "y"))]
    return all(len(values) > 0 and float(np.ptp(values)) < WIDEST_DEG for values in known)


def _of_one_tag(table: TextTable, tag_id: str) -> Mask:
    """Return which rows (n,) are of the wanted tag."""
    if "tag_id" not in table:
        return np.ones(len(table), dtype=bool)
    ids = np.array(table.text("tag_id", empty=""), dtype=str)
    found = sorted(set(ids.tolist()))
    if not tag_id and len(found) > 1:
        raise InputError(
            f"has positions of several tags ({', '.join(found)}): say which it is (--position_tag_id)", table.path
        )
    if tag_id and tag_id not in found:
        raise InputError(f"has no position of tag {tag_id!r}, found {', '.join(found)}", table.path)
    return np.asarray(ids == (tag_id or found[0]))


def _covariances(table: TextTable) -> Array:
    """Return (n, 3, 3) covariances, NaN where the table has none: as a matrix, by axis, or of any coordinate."""
    if set(COVARIANCES) <= table.cells.keys():
        rows, columns = np.triu_indices(3)
        covariances = np.zeros((len(table), 3, 3))
        for name, i, j in zip(COVARIANCES, rows, columns, strict=True):
            covariances[:, i, j] = covariances[:, j, i] = table.numbers(name, empty=np.nan)
        is_valid = np.isnan(covariances).any(axis=(1, 2)) | (np.linalg.eigvalsh(np.nan_to_num(covariances))[:, 0] > 0)
        table.refuse(~is_valid, "cov_xx", "a positive definite covariance")
        return covariances
    return _of_stddevs([metres(table, own if own in table else "stddev", STDDEV_M, np.nan) for own in STDDEVS])


def _of_stddevs(stddevs_m: Sequence[Array]) -> Array:
    """Return (n, 3, 3) covariances given three standard deviations (n,), NaN where one of these is."""
    covariances = np.column_stack(stddevs_m)[:, :, None] ** 2 * np.eye(3)
    covariances[np.isnan(covariances).any(axis=(1, 2))] = np.nan
    return covariances


def _is_tum(head: str) -> bool:
    return is_tum_row(header_names(head)) and is_reference_file(head)  # with a quaternion of unit length


def _read_tum(path: Path, options: PositionOptions) -> PositionLog:
    columns = {"timestamp": "timestamp_s", **{axis: f"{axis}_m" for axis in AXES}}
    return _log_of_table(tum_table(path).by_quantity(columns), options, "s", "tum")


def _is_odm(head: str) -> bool:
    """Return whether the first line is a coordinate system, and the next one a photo with numbers."""
    first, second = ([line for line in head.split("\n") if line.strip() and line[0] != "#"] + ["", ""])[:2]
    name, *numbers = second.split() or [""]
    are_numbers = len(numbers) > 1 and all(map(is_number, numbers[:2]))
    return bool(crs_of_line(first)) and not is_number(name) and are_numbers


def _read_odm(path: Path, options: PositionOptions) -> PositionLog:
    """Read ODM's ``geo.txt``: the coordinate system, then image_name geo_x geo_y geo_z [yaw pitch roll [stddevs]].

    The two stddevs at the end are horizontal and vertical (docs.opendronemap.org, "Image geolocation files"); where
    they are 0, they are not known.
    """
    more = ("yaw", "pitch", "roll", "horizontal", "vertical")
    table = read_without_header(path, ("image_name", *AXES), more, has_more=True, is_no_row=is_no_row)

    def stated(name: str) -> list[str]:
        stddevs = table.numbers(name, empty=0.0, missing=MISSING).tolist()
        return [cell if stddev > 0 else "" for cell, stddev in zip(table.cells[name], stddevs, strict=True)]

    stddevs = dict(zip(STDDEVS, map(stated, ("horizontal", "horizontal", "vertical")), strict=True))
    return _log_of_table(replace(table, cells={**table.cells, **stddevs}), options, None, "odm")


def _is_marvelmind(head: str) -> bool:
    """Return whether lines are those of Marvelmind's dashboard: UNIX time in ms, two intervals, address, x, y, z."""
    rows = [line.split(",") for line in head.split("\n")[:5] if line.strip()]
    try:
        return bool(rows) and all(
            len(row) >= 9 and len(row) % 2 and 1e12 < float(row[0]) < 4e12 and float(row[3]).is_integer()
            for row in rows
        )
    except ValueError:
        return False


def _read_marvelmind(path: Path, options: PositionOptions) -> PositionLog:
    """Read the dashboard's CSV (operation manual, "CSV format")."""
    table = read_without_header(path, ("timestamp", "interval", "count", "tag_id", *AXES), has_more=True)
    return _log_of_table(table, options, "ms", "marvelmind")


def _is_dwm1001(head: str) -> bool:
    return _DWM1001.search(head) is not None


def _read_dwm1001(path: Path, options: PositionOptions) -> PositionLog:
    """Read the positions that the commands lep, lec and les of the DWM1001 print, with the host's time in front."""
    clock, times_s, rows, lines = Clock(options.timestamp_unit), list[float](), list[list[float]](), list[int]()
    for line, text in enumerate(read_text(path, errors="replace").split("\n"), 1):
        found, begin = _DWM1001.search(text), _DWM1001_BEGIN.search(text)
        if found is not None and begin is not None:
            times_s.append(clock.find_seconds(text[: begin.start()]))
            rows.append([*map(float, found.groups())])
            lines.append(line)
            if np.isnan(times_s[-1]):
                raise InputError(f"no time before the position; {RECORD_TIMES}", path, line)
    unknown = np.full((len(rows), 3, 3), np.nan)
    places = np.array(rows).reshape(-1, 3)
    return PositionLog.in_time_order(path, "dwm1001", places, ByTime(np.array(times_s)), lines, covariance_m2=unknown)


def _is_nmea(head: str) -> bool:
    return any(map(_sentence, head.split("\n")[:50]))


def _sentence(line: str) -> re.Match[str] | None:
    """Return the sentence of NMEA in a line, which may have the host's time in front; None if there is none."""
    return _NMEA.fullmatch(line[line.find("$") :].strip())


def _read_nmea(path: Path, _options: PositionOptions) -> PositionLog:
    """Read GGA sentences, with dates from RMC or ZDA and standard deviations from GST, if they are there.

    The height is above the ellipsoid: that above the sea plus the separation of the geoid. Times are UTC.
    """
    rows, lines, stddevs, num_broken = list[list[float]](), list[int](), list[Array](), 0
    day_s, last_s, errors = 0.0, -np.inf, dict[float, Array]()
    for line, text in enumerate(read_text(path, errors="replace").split("\n"), 1):
        found = _sentence(text)
        if found is None:
            continue
        kind, body, checksum = found.groups()
        cells = body.split(",")
        try:
            if checksum is not None and _checksum(found[0]) != int(checksum, 16):
                raise ValueError
            if kind in ("RMC", "ZDA"):
                day_s = _day_of_nmea(kind, cells)
            elif kind == "GST":
                errors[_seconds_of_day(cells[0])] = np.array([float(cells[6]), float(cells[5]), float(cells[7])])
            elif int(cells[5]) > 0:
                second = _seconds_of_day(cells[0])
                day_s += DAY_S if second < last_s - DAY_S / 2 else 0.0
                last_s = second
                height_m = float(cells[8]) + float(cells[10] or 0.0)
                rows.append([day_s + second, _degrees(cells[3], cells[4]), _degrees(cells[1], cells[2]), height_m])
                lines.append(line)
                usual = _NMEA_STDDEVS_M.get(int(cells[5]), 10.0) * np.array([1.0, 1.0, 2.0])
                stddevs.append(errors.get(second, usual))
        except (ValueError, IndexError):
            num_broken += 1
    notes = [f"{num_broken} broken sentences are left out"] if num_broken else []
    values = np.array(rows).reshape(-1, 4)
    covariances = _of_stddevs([*np.array(stddevs).reshape(-1, 3).T])
    log = PositionLog.in_time_order(
        path, "nmea", values[:, 1:], ByTime(values[:, 0]), lines, covariance_m2=covariances, notes=notes
    )
    return replace(log, crs=GEOGRAPHIC)


def _checksum(text: str) -> int:
    total = 0
    for character in text.strip()[1 : text.strip().index("*")]:
        total ^= ord(character)
    return total


def _seconds_of_day(cell: str) -> float:
    return 3600 * int(cell[:2]) + 60 * int(cell[2:4]) + float(cell[4:])


def _day_of_nmea(kind: str, cells: Sequence[str]) -> float:
    """Return the seconds from 1970 to the beginning of the day of an RMC or ZDA sentence."""
    if kind == "RMC":
        day, month, year = int(cells[8][:2]), int(cells[8][2:4]), 2000 + int(cells[8][4:6])
    else:
        day, month, year = int(cells[1]), int(cells[2]), int(cells[3])
    return datetime(year, month, day, tzinfo=timezone.utc).timestamp()


def _degrees(cell: str, half: str) -> float:
    minutes_at = cell.index(".") - 2
    degrees = float(cell[:minutes_at]) + float(cell[minutes_at:]) / 60
    return -degrees if half in ("S", "W") else degrees


def _is_rtklib(head: str) -> bool:
    return _rtklib_header(head.split("\n")) is not None


def _rtklib_header(lines: Sequence[str]) -> list[str] | None:
    """Return the names of the columns of an RTKLIB solution; None if it is not one."""
    for line in lines:
        names = line.lstrip("% ").split()
        if line.startswith("%") and names and names[0] in ("GPST", "UTC", "JST") and "Q" in names:
            return names
    return None


def _read_rtklib(path: Path, _options: PositionOptions) -> PositionLog:
    """Read a solution (.pos) of RTKLIB with its covariances.

    It has latitude and longitude, geocentric x, y, z (ECEF), or east, north and up from a base. Source: RTKLIB manual
    2.4.2, appendix B.1. The off-diagonal columns are signed roots of covariances.
    """
    names = _rtklib_header(read_text(path).split("\n"))
    if names is None:
        raise InputError("has no header row of an RTKLIB solution (% GPST ...)", path)
    is_geographic, is_ecef = "latitude(deg)" in names, "x-ecef(m)" in names
    if not (is_geographic or is_ecef or "e-baseline(m)" in names):
        raise InputError("an RTKLIB solution with these columns is not read, expected degrees and metres", path)
    columns = ("date", "time", *names[1:12])
    table = read_without_header(path, columns, has_more=True, is_no_row=lambda line: line.startswith("%"))
    values = np.column_stack([table.numbers(name) for name in columns[2:]])
    times_s = np.zeros(len(table))
    for row, (date, time) in enumerate(zip(table.text("date"), table.text("time"), strict=True)):
        try:
            times_s[row] = _time_of_rtklib(date, time)
        except ValueError:
            raise table.error(row, "date", "a date and a time, or a GPS week and its seconds") from None
    east_first = values[:, [1, 0, 2]] if is_geographic else values[:, :3]
    notes = ["times are GPS time, which is ahead of UTC by leap seconds"] if names[0] == "GPST" else []
    covariance_m2 = _covariance_of_rtklib(values[:, 5:11], is_geographic)
    if is_ecef:
        east_first = geographic_of(east_first, GEOCENTRIC)
        enu_from_ecef = rotation_to_enu(*east_first[:, :2].mean(axis=0).tolist())
        covariance_m2 = enu_from_ecef @ covariance_m2 @ enu_from_ecef.T
    log = PositionLog.in_time_order(
        path, "rtklib", east_first, ByTime(times_s), table.line, covariance_m2=covariance_m2, notes=notes
    )
    return replace(log, crs=GEOGRAPHIC if is_geographic or is_ecef else "")


def _time_of_rtklib(first: str, second: str) -> float:
    """Return seconds since 1970 of a date and a time, or of a GPS week and its seconds."""
    if "/" in first:
        day = datetime.strptime(first, "%Y/%m/%d").replace(tzinfo=timezone.utc)
        hours, minutes, seconds = second.split(":")
        return day.timestamp() + 3600 * int(hours) + 60 * int(minutes) + float(seconds)
    return (_GPS_EPOCH + timedelta(weeks=int(first))).timestamp() + float(second)


def _covariance_of_rtklib(roots: Array, is_geographic: bool) -> Array:
    """Return (n, 3, 3) covariances in the order of the axes from sdx, sdy, sdz, sdxy, sdyz, sdzx.

    With latitude and longitude the columns are sdn, sde, sdu, sdne, sdeu, sdun, and east is first here.
    """
    north, east, up = (0, 1, 2) if is_geographic else (1, 0, 2)
    squares = np.sign(roots) * roots**2
    covariances = np.zeros((len(roots), 3, 3))
    covariances[:, 0, 0], covariances[:, 1, 1], covariances[:, 2, 2] = (
        squares[:, east],
        squares[:, north],
        squares[:, up],
    )
    east_up, up_north = (4, 5) if is_geographic else (5, 4)
    for (i, j), column in (((0, 1), 3), ((0, 2), east_up), ((1, 2), up_north)):
        covariances[:, i, j] = covariances[:, j, i] = squares[:, column]
    # Rounded to tenths of millimetres, a matrix may lose its definiteness: then its diagonal is taken.
    is_bad = np.linalg.eigvalsh(covariances)[:, 0] <= 0
    diagonals = np.einsum("nii->ni", covariances)
    covariances[is_bad] = np.maximum(diagonals[is_bad], 1e-8)[:, :, None] * np.eye(3)
    return covariances


def _is_gpx(head: str) -> bool:
    return "<gpx" in head


def _read_gpx(path: Path, options: PositionOptions) -> PositionLog:
    """Read the points of the tracks of a GPX file (topografix.com/gpx/1/1): latitude, longitude, elevation, time.

    A file that was cut off is read as far as it goes.
    """
    before, *points = read_text(path).split(_GPX_POINT)
    if not points:
        raise InputError("holds no point of a track, expected <trkpt> with <ele> and <time>", path)
    lines = 1 + np.cumsum([part.count("\n") for part in (before, *points[:-1])])
    columns = {"timestamp": ("time", "<time>([^<]*)"), "x": ("lon", "lon *= *[\"']([^\"']*)")}
    columns |= {"y": ("lat", "lat *= *[\"']([^\"']*)"), "z": ("ele", "<ele>([^<]*)")}
    cells = {
        quantity: [found[1].strip() if (found := re.search(pattern, point)) else "" for point in points]
        for quantity, (_, pattern) in columns.items()
    }
    table = TextTable(path, lines, cells, {quantity: name for quantity, (name, _) in columns.items()})
    if not any(cells["z"]):
        raise InputError("no point of its tracks has a height, expected <ele>", path)
    notes = ("heights of GPX are above the sea, or above the ellipsoid, which moves all of them alike",)
    return _log_of_table(replace(table, notes=notes), options, "iso", "gpx")


POSITION_READERS: dict[str, tuple[Callable[[str], bool], Reader]] = {
    "colmap": (is_database, lambda path, _options: read_pose_priors(path)),
    "nmea": (_is_nmea, _read_nmea),
    "rtklib": (_is_rtklib, _read_rtklib),
    "gpx": (_is_gpx, _read_gpx),
    "odm": (_is_odm, _read_odm),
    "tum": (_is_tum, _read_tum),
    "dwm1001": (_is_dwm1001, _read_dwm1001),
    "marvelmind": (_is_marvelmind, _read_marvelmind),
    "table": (POSITIONS.is_canonical, _read_table),
}
"""Formats by name: whether a file begins like one, and its reader."""
