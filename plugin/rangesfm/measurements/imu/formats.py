"""Readers of the logs of inertial sensors.

They may be tables of any layout (the canonical one, EuRoC, TUM-VI, kalibr, Physics Toolbox, phyphox, AndroSensor,
MARS, ``rostopic echo``), a folder or a zip archive with a table for each of gyroscope and accelerometer (Sensor Logger,
phyphox, GoPro Telemetry Extractor), or ROS bags with ``sensor_msgs/Imu``.
"""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from tempfile import TemporaryDirectory

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.errors import InputError
from rangesfm.measurements.imu.log import STANDARD_GRAVITY_M_S2, ImuLog, clipped_samples, times_of_sampling
from rangesfm.measurements.imu.signals import (
    ACCEL,
    GRAVITY,
    GYRO,
    Triple,
    find_triples,
    kind_of_file,
    rank_of_file,
)
from rangesfm.measurements.ranges.readers import vocabulary as terms
from rangesfm.measurements.ranges.readers.columns import read_timestamps
from rangesfm.measurements.ranges.readers.guess import Guess, find_time, is_rising
from rangesfm.measurements.ranges.readers.layout import Layout, find_layout
from rangesfm.util.files.bags import connections_of, is_bag, messages_of, open_bag, stamp_s, types_in
from rangesfm.util.files.text_tables import TextTable, header_names, read_head, read_text

CANONICAL_COLUMNS = (
    "timestamp_s",
    *(f"gyro_{axis}_rad_s" for axis in "xyz"),
    *(f"accel_{axis}_m_s2" for axis in "xyz"),
)
_EXPECTED = f"expected a table with {','.join(CANONICAL_COLUMNS)}, or the log of a phone"
# Median length of the acceleration of what is carried, with gravity: within a third of it.
_WITH_GRAVITY = (0.67, 1.5)
# Share by which the lengths of most accelerations differ, at most, where gravity is in them.
_STEADY = 0.4
_MIN_NUM = 100
_SLOWEST_STEP_S = 0.2
_FASTEST_RAD_S = np.radians(4000.0)  # no gyroscope in phones, cameras and drones measures faster turns
_TABLES = (".csv", ".txt", ".tsv", ".dat", ".log")
_VIDEOS = (".mp4", ".mov", ".360", ".lrv", ".insv")
_MESSAGES = ("Imu",)  # of sensor_msgs
_LARGEST_BYTES = 1 << 31  # of a table in an archive


@dataclass(frozen=True)
class _Signal:
    """One signal of three axes: k samples, and what is known of them.

    Attributes:
        times_s: (k,). values: (k, 3) in ``unit`` (of ``Triple``).
        lines: (k,) of the file.
        rank: smaller for the better one of two. name: of its columns or its file, for messages.
    """

    kind: str
    times_s: Array
    values: Array
    lines: Indices
    unit: str
    rank: int
    path: Path
    name: str


def read_imu(path: Path) -> ImuLog:
    """Read the log of an inertial sensor.

    Args:
        path: a table, a folder or a zip archive of tables, or a ROS bag.

    Raises:
        InputError: there is no gyroscope or no accelerometer with gravity in it, times go back, or too few samples are
            left. The error gives the line if there is one.
    """
    if path.suffix.lower() in _VIDEOS and path.is_file():
        expected = (
            "export it as CSV (GoPro: goprotelemetryextractor.com, ACCL and GYRO), and give the folder of the tables"
        )
        raise InputError(f"is a video, and the track of the sensor in it is not read: {expected}", path)
    notes = list[str]()
    if is_bag(path):
        signals = _signals_of_bag(path)
    elif path.is_dir() or _is_zip(path):
        with _tables_of(path) as tables:
            signals = [signal for table in tables for signal in _signals_of_table(table, notes, may_be_none=True)]
            signals = _with_sign_of_platform(signals, tables, notes)
            signals = [replace(signal, path=path / signal.path.name) for signal in signals]
    else:
        signals = _signals_of_table(path, notes, may_be_none=False)
    gyro = _chosen_gyro(signals, path, notes)
    accel = _chosen_accel(signals, path, notes)
    return _joined(gyro, accel, path, notes)


def is_imu_log(path: Path) -> bool:
    """Return whether a table, folder, archive or bag is the log of an inertial sensor, by the names in it."""
    try:
        if is_bag(path):
            with open_bag(path) as bag:
                return bool(connections_of(bag, _MESSAGES))
        if path.is_dir():
            # A file with both is a log of its own.
            parts = [
                {triple.kind or kind_of_file(file.stem) for triple in find_triples(_names(file))}
                for file in path.glob("*.csv")
            ]
            return {GYRO, ACCEL} <= {kind for part in parts if not {GYRO, ACCEL} <= part for kind in part}
        if _is_zip(path):
            with zipfile.ZipFile(path) as archive:
                names = map(PurePosixPath, archive.namelist())
                return {GYRO, ACCEL} <= {kind_of_file(name.stem) for name in names if name.suffix.lower() in _TABLES}
        return {GYRO, ACCEL} <= {triple.kind for triple in find_triples(_names(path))}
    except (InputError, OSError, ValueError, zipfile.BadZipFile):
        return False


def _names(path: Path) -> list[str]:
    head = read_head(path)
    comments = [line.lstrip("#% ") for line in head.split("\n")[:10] if line.startswith(("#", "%"))]
    return [name for text in (*comments, head) for name in header_names(text)] if "\0" not in head else []


def _is_zip(path: Path) -> bool:
    return path.suffix.lower() == ".zip" and path.is_file()


@contextmanager
def _tables_of(path: Path) -> Iterator[list[Path]]:
    """Give the tables in a folder or an archive, which is unpacked for the duration of the block.

    Raises:
        InputError: the archive is broken, or there are none.
    """
    if path.is_dir():
        tables = sorted(file for file in path.iterdir() if file.suffix.lower() in _TABLES and file.is_file())
        if not tables:
            raise InputError(f"no table in this folder, {_EXPECTED}", path)
        yield tables
        return
    with TemporaryDirectory() as folder:
        try:
            with zipfile.ZipFile(path) as archive:
                for member in archive.infolist():
                    name = PurePosixPath(member.filename)
                    if (
                        name.suffix.lower() in _TABLES
                        and not name.name.startswith(".")
                        and "__MACOSX" not in name.parts
                    ):
                        if member.file_size > _LARGEST_BYTES:
                            raise InputError(f"{name.name} is larger than {_LARGEST_BYTES >> 30} GB: unpack it", path)
                        Path(folder, name.name).write_bytes(archive.read(member))
        except (zipfile.BadZipFile, NotImplementedError, RuntimeError, OSError, ValueError, EOFError) as error:
            raise InputError(f"cannot be read as a zip archive ({error})", path) from None
        tables = sorted(Path(folder).iterdir())
        if not tables:
            raise InputError(f"no table in this archive, {_EXPECTED}", path)
        yield tables


def _signals_of_table(path: Path, notes: list[str], *, may_be_none: bool) -> list[_Signal]:
    """Return the signals of a table; none where it has none and may."""
    head = read_head(path)
    if not head.strip() or "\0" in head:
        if may_be_none:
            return []
        raise InputError(f"{'is not text' if head.strip() else 'the file is empty'}, {_EXPECTED}", path)
    layout = find_layout(path)
    triples = [] if layout is None else _triples(layout, path)
    if layout is None or not triples:
        if may_be_none:
            return []
        raise InputError(f"no columns of a gyroscope and an accelerometer, {_EXPECTED}", path)
    table = layout.read()
    notes += table.told
    times_s = _times(layout, table, notes)
    signals = []
    for triple in triples:
        columns = [table.numbers(name, empty=np.nan) for name in triple.columns]
        kind, rank = triple.kind, triple.rank
        if not kind:
            kind, rank = kind_of_file(path.stem) or "", rank_of_file(path.stem)
        name = ", ".join(triple.columns)
        signals.append(_Signal(kind, times_s, np.column_stack(columns), table.line, triple.unit, rank, path, name))
    return _of_values(signals, path) if not layout.has_names else signals


def _triples(layout: Layout, path: Path) -> list[Triple]:
    """Return the signals by the names of the columns, by that of the file, or by the place of columns without names."""
    if not layout.has_names:
        names = [column.name for column in layout.columns]
        return [Triple(GYRO, tuple(names[k : k + 3]), "", 0) for k in (1, 4)] if len(names) == 7 else []  # type: ignore[arg-type]
    triples = [*find_triples([column.name for column in layout.columns])]
    by_file = kind_of_file(path.stem)
    return [triple for triple in triples if triple.kind or (by_file and len("".join(triple.columns)) < _LONG_NAMES)]


_LONG_NAMES = 24  # of three axes that only the file's name tells: x, y, z, x-axis, "X (m/s^2)"


def _of_values(signals: Sequence[_Signal], path: Path) -> list[_Signal]:
    """Tell the accelerometer from the gyroscope in a table without names: by the length of gravity."""
    lengths = [_length(signal) for signal in signals]
    if len(signals) != 2 or not lengths[0] or max(lengths) < 3 * min(lengths):
        raise InputError(
            f"a table without names, in which nothing tells gyroscope and accelerometer, {_EXPECTED}", path
        )
    accel = int(np.argmax(lengths))
    return [replace(signal, kind=ACCEL if k == accel else GYRO) for k, signal in enumerate(signals)]


def _times(layout: Layout, table: TextTable, notes: list[str]) -> Array:
    """Return the times (k,) of a table in seconds."""
    guess = Guess()
    if layout.has_names:
        find_time([*layout.columns], guess)
    columns = {key: name for key, name in guess.columns.items() if key in ("timestamp", "date", "nanoseconds")}
    if "timestamp" not in columns:
        # "since start in ms" and "Timestamp[nanosec]" are times, though in range logs such names are something else's.
        named = [column for column in layout.columns if {*column.words} & terms.TIME or not layout.has_names]
        rising = [column for column in named if is_rising(column)]
        if not rising:
            raise InputError(f"no column seems to be the time, {_EXPECTED}", table.path)
        columns = {"timestamp": rising[0].name}
    told = list[str]()

    def ask(units: Sequence[str], why: str) -> InputError:
        return InputError(
            f"the times in {columns['timestamp']} may be in {' or '.join(units)} ({why}): name the column timestamp_s, "
            "timestamp_ms, timestamp_us or timestamp_ns",
            table.path,
        )

    times_s, _ = read_timestamps(table.by_quantity(columns), None, told, ask, slowest_s=_SLOWEST_STEP_S)
    notes += [f"{table.path.name}: {note}" for note in told]
    return times_s


def _with_sign_of_platform(signals: list[_Signal], tables: Sequence[Path], notes: list[str]) -> list[_Signal]:
    """Turn the accelerations of Sensor Logger on iOS, which points them against those of Android.

    Source: its pages COORDINATES.md and CROSSPLATFORM.md (github.com/tszheichoi/awesome-sensor-logger).
    """
    about = next((table for table in tables if table.name.lower() == "metadata.csv"), None)
    layout = None if about is None else read_text(about).split("\n")
    if layout is None or len(layout) < 2:
        return signals
    said = dict(zip(header_names(layout[0], ","), header_names(layout[1], ",")))
    if said.get("platform", "").lower() != "ios" or said.get("standardisation", "").lower() == "true":
        return signals
    notes.append("Sensor Logger on iOS points accelerations downward: their signs are changed")
    return [signal if signal.kind == GYRO else replace(signal, values=-signal.values) for signal in signals]


def _signals_of_bag(path: Path) -> list[_Signal]:
    """Return the signals of the only topic of ``sensor_msgs/Imu`` in a bag, or of two with one sensor each."""
    found = list[_Signal]()
    with open_bag(path) as bag:
        connections = connections_of(bag, _MESSAGES)
        if not connections:
            has = f"it has {types_in(bag)}, expected sensor_msgs/Imu"
            raise InputError(f"no log of an inertial sensor in this bag; {has}", path)
        for topic in sorted({one.topic for one in connections}):
            rows = list[tuple[float, ...]]()
            for _, message, received_s in messages_of(bag, [one for one in connections if one.topic == topic]):
                turn, force = message.angular_velocity, message.linear_acceleration
                time_s = stamp_s(message) or received_s
                rows.append((time_s, turn.x, turn.y, turn.z, force.x, force.y, force.z))
            values = np.array(rows, np.float64).reshape(-1, 7)
            for kind, k, unit in ((GYRO, 1, "rad"), (ACCEL, 4, "")):
                if values[
                    :, k : k + 3
                ].any():  # cameras of RealSense write each sensor to a topic, with zeros beside it
                    of_axes, numbers = values[:, k : k + 3], np.arange(1, len(values) + 1)
                    found.append(_Signal(kind, values[:, 0], of_axes, numbers, unit, 0, path, topic))
    for kind in (GYRO, ACCEL):
        topics = [signal.name for signal in found if signal.kind == kind]
        if len(topics) > 1:
            raise InputError(f"several topics have a {kind} ({', '.join(topics)}): keep one in the bag", path)
    return found


def _finite(signal: _Signal) -> _Signal:
    rows = np.isfinite(signal.values).all(axis=1) & np.isfinite(signal.times_s)
    return replace(signal, times_s=signal.times_s[rows], values=signal.values[rows], lines=signal.lines[rows])


def _length(signal: _Signal) -> float:
    """Return the median length of the values; 0 without any."""
    lengths = np.linalg.norm(_finite(signal).values, axis=1)
    return float(np.median(lengths)) if len(lengths) else 0.0


def _chosen_gyro(signals: Sequence[_Signal], path: Path, notes: list[str]) -> _Signal:
    """Return the gyroscope in rad/s.

    Raises:
        InputError: there is none.
    """
    candidates = sorted((one for one in signals if one.kind == GYRO), key=lambda one: one.rank)
    if not candidates:
        raise InputError(f"there is no gyroscope in it, {_EXPECTED}", path)
    gyro = _rising(candidates[0], notes)
    gyro = replace(gyro, values=gyro.values * _RAD_S[gyro.unit])
    # Faster turns than sensors measure are degrees, whatever the name of the column says.
    too_fast = gyro.unit in ("", "rad") and bool(np.abs(gyro.values).max(initial=0.0) > _FASTEST_RAD_S)
    if too_fast:
        notes.append(f"{gyro.path.name}: {gyro.name} are taken as degrees a second, by their size")
    elif not gyro.unit:
        notes.append(
            f"{gyro.path.name}: {gyro.name} have no unit and are taken as rad/s; the photos' turns will show it"
        )
    return replace(gyro, values=np.radians(gyro.values)) if too_fast else gyro


def _chosen_accel(signals: Sequence[_Signal], path: Path, notes: list[str]) -> _Signal:
    """Return the accelerometer with gravity in it, in m/s^2.

    Raises:
        InputError: there is none.
    """
    candidates = sorted((one for one in signals if one.kind == ACCEL), key=lambda one: one.rank)
    if not candidates:
        raise InputError(f"there is no accelerometer in it, {_EXPECTED}", path)
    for one in candidates:
        if (unit := _unit_of_accel(one)) is not None:
            if one.unit and one.unit != unit:
                notes.append(
                    f"{one.path.name}: {one.name} are in {_UNIT[unit]} by their length, whatever the name says"
                )
            elif not one.unit and unit != "m":
                notes.append(f"{one.path.name}: {one.name} are taken as {_UNIT[unit]}, by their length")
            return _in_metres(_rising(one, notes), unit)
    if (gravity := next((one for one in signals if one.kind == GRAVITY), None)) is not None:
        unit_of_gravity = _unit_of_accel(gravity)
        if unit_of_gravity is not None:
            # On a phone both have the same unit, that of its operating system.
            rest = _rising((replace(candidates[0], unit=candidates[0].unit or unit_of_gravity)), notes)
            rest = _in_metres(rest, rest.unit)
            gravity = _in_metres(_rising(gravity, notes), unit_of_gravity)
            notes.append(f"{rest.path.name}: acceleration without gravity, to which gravity is added")
            return replace(rest, values=rest.values + _at(gravity, rest.times_s))
    length = _length(candidates[0])
    raise InputError(
        f"the accelerometer's median length is {length:.3g}, expected {STANDARD_GRAVITY_M_S2:.1f} m/s^2 or 1 g: record "
        "it with gravity (Sensor Logger: TotalAcceleration, or Gravity beside Accelerometer)",
        candidates[0].path,
    )


# By unit of ``Triple``: rates of turn in rad/s; its name, and the length of gravity in it.
_RAD_S = {"": 1.0, "rad": 1.0, "mrad": 1e-3, "deg": np.radians(1.0), "mdeg": np.radians(1e-3)}
_UNIT = {"m": "m/s^2", "g": "g", "mg": "mg (thousandths of g)"}
_GRAVITY = {"m": STANDARD_GRAVITY_M_S2, "g": 1.0, "mg": 1000.0}


def _unit_of_accel(signal: _Signal) -> str | None:
    """Return the unit in which a signal has the length of gravity; None if it has not."""
    lengths = np.linalg.norm(_finite(signal).values, axis=1)
    if not len(lengths):
        return None
    low, middle, high = np.percentile(lengths, [25, 50, 75])
    for unit, gravity in _GRAVITY.items():
        # Without gravity, walking has accelerations of 1 m/s^2 as well, but of all lengths.
        is_such = signal.unit == unit or high - low < _STEADY * middle
        if _WITH_GRAVITY[0] < middle / gravity < _WITH_GRAVITY[1] and is_such:
            return unit
    return None


def _in_metres(signal: _Signal, unit: str) -> _Signal:
    return replace(signal, values=signal.values * (STANDARD_GRAVITY_M_S2 / _GRAVITY[unit]))


def _rising(signal: _Signal, notes: list[str]) -> _Signal:
    """Return a signal without missing values, with times that rise.

    A few samples that are late or repeated are put in order or left out.

    Raises:
        InputError: the times go back.
    """
    signal = _finite(signal)
    steps = np.diff(signal.times_s)
    usual_s = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    back = np.flatnonzero(steps < -10 * usual_s)
    if len(back):
        k = int(back[0]) + 1
        raise InputError(
            f"the time goes back by {-steps[k - 1]:.3g} s, expected the samples of one recording in the order of time",
            signal.path,
            int(signal.lines[k]),
        )
    order = np.argsort(signal.times_s, kind="stable")
    order = order[np.append(True, np.diff(signal.times_s[order]) > 0)] if len(order) else order
    if lost := len(signal.times_s) - len(order):
        notes.append(f"{signal.path.name}: {lost} samples have the time of an earlier one and are left out")
    if np.any(steps < 0):
        notes.append(f"{signal.path.name}: {np.count_nonzero(steps < 0)} samples are late and are put in order")
    return replace(signal, times_s=signal.times_s[order], values=signal.values[order], lines=signal.lines[order])


def _at(signal: _Signal, times_s: Array) -> Array:
    """Return the values (n, 3) of a signal, interpolated."""
    return np.column_stack([np.interp(times_s, signal.times_s, values) for values in signal.values.T])


def _joined(gyro: _Signal, accel: _Signal, path: Path, notes: list[str]) -> ImuLog:
    """Return the log at the times of the gyroscope at which the accelerometer is known, too.

    Raises:
        InputError: too few samples are left, or they are too far apart.
    """
    for signal in (gyro, accel):
        if (num := len(signal.times_s)) < _MIN_NUM:
            raise InputError(f"{num} samples of the {signal.kind}, expected {_MIN_NUM} or more", path)
    gyro, accel = (_as_sampled(signal, notes) for signal in (gyro, accel))
    longest_s = max(0.1, 3 * float(np.median(np.diff(accel.times_s))))
    after = np.clip(np.searchsorted(accel.times_s, gyro.times_s), 1, len(accel.times_s) - 1)
    inside = (gyro.times_s >= accel.times_s[0]) & (gyro.times_s <= accel.times_s[-1])
    is_near = accel.times_s[after] - accel.times_s[after - 1] <= longest_s
    known = inside & (is_near | (accel.times_s[after] == gyro.times_s))
    if np.count_nonzero(known) < _MIN_NUM:
        raise InputError("gyroscope and accelerometer were not recorded at the same time", path)
    times_s = gyro.times_s[known]
    log = ImuLog(times_s, gyro.values[known], _at(accel, times_s), str(path))
    log = replace(log, clipped=clipped_samples(log.gyro_rad_s, log.accel_m_s2))
    if (fastest := float(np.abs(log.gyro_rad_s).max())) > _FASTEST_RAD_S:
        most = f"at most {np.degrees(_FASTEST_RAD_S):.0f} in any axis"
        raise InputError(f"a rate is {np.degrees(fastest):.3g} deg/s, expected {most}", gyro.path)
    if log.step_s > _SLOWEST_STEP_S:
        raise InputError(f"has a sample each {log.step_s:.2g} s, expected 50 a second or more", path)
    doubts = (f"{path.name}: {doubt}" for doubt in _doubts(log))
    return replace(log, notes=tuple(notes), doubts=tuple(doubts))


def _as_sampled(signal: _Signal, notes: list[str]) -> _Signal:
    """Return a signal with the times at which it was sampled, with a note where the file has those of arrival."""
    taken_s = times_of_sampling(signal.times_s)
    if taken_s is None:
        return signal
    note = (
        f"{signal.path.name}: the samples arrived up to {(signal.times_s - taken_s).max():.2g} s late; they were taken "
        f"evenly, {1 / np.mean(np.diff(taken_s)):.2f} a second"
    )
    notes += [] if note in notes else [note]
    return replace(signal, times_s=taken_s)


def _doubts(log: ImuLog) -> Iterator[str]:
    """Yield what is not as it should be: gaps, uneven times, few samples, values at the end of the scale."""
    steps_s = np.diff(log.timestamp_s)
    gaps_s = steps_s[steps_s > log.longest_gap_s]
    if len(gaps_s):
        num = f"{len(gaps_s)} gaps" if len(gaps_s) > 1 else "a gap"
        yield f"{num} without samples, the longest of {gaps_s.max():.2g} s; the motion across them is not used"
    if log.step_s > 0.02:
        yield f"{1 / log.step_s:.0f} samples a second; 100 or more follow the motion of hands better"
    uneven = float(np.mean(np.abs(steps_s - log.step_s) > 0.5 * log.step_s))
    if uneven > 0.2:
        yield f"times are uneven: {uneven:.0%} of the steps differ by half from their median, {1e3 * log.step_s:.1f} ms"
    for sensor, num_clipped in zip(("gyroscope", "accelerometer"), np.count_nonzero(log.clipped, axis=0), strict=True):
        if num_clipped:
            yield (
                f"{num_clipped} of {len(log)} samples of the {sensor} are at the end of its scale; the motion between "
                "the photos before and after them is not used: record with a larger scale"
            )
