"""Logs of inertial sensors are read from all formats; what is wrong with them is said or refused."""

from __future__ import annotations

import re
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.measurements.ranges.readers.test_readers_ros import TYPES
from tests.simulated.inertial import by_hand, imu_log
from tests.survey.sources.recorded import Message, write_bag

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.measurements.imu.formats import CANONICAL_COLUMNS, is_imu_log, read_imu
from rangesfm.measurements.imu.log import ImuLog, times_of_sampling

LOG = imu_log(by_hand(), until_s=6.0)
SINCE_1970_S = 1_790_000_000.0
G_M_S2 = 9.80665


def written(
    path: Path, header: str, columns: Sequence[Array], separator: str = ",", formats: Sequence[str] = ()
) -> Path:
    formats = formats or ["%.9f"] * len(columns)
    rows = [separator.join(form % value for form, value in zip(formats, row)) for row in np.column_stack(columns)]
    path.write_text("\n".join([*([header] if header else []), *rows]) + "\n")
    return path


def table(
    path: Path, header: str, log: ImuLog = LOG, *, per_s: float = 1.0, first_s: float = 0.0, **how: object
) -> Path:
    """Write time, gyroscope, accelerometer."""
    times = (log.timestamp_s + first_s) * per_s
    return written(path, header, [times, *log.gyro_rad_s.T, *log.accel_m_s2.T], **how)  # type: ignore[arg-type]


def canonical(folder: Path) -> Path:
    return table(folder / "imu.csv", ",".join(CANONICAL_COLUMNS))


EUROC = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
NANOSECONDS = ["%.0f", *6 * ["%.9f"]]


def euroc(folder: Path) -> Path:
    return table(folder / "data.csv", EUROC, per_s=1e9, first_s=SINCE_1970_S, formats=NANOSECONDS)


def euroc_without_header(folder: Path) -> Path:
    return table(folder / "data.csv", "", per_s=1e9, first_s=SINCE_1970_S, formats=NANOSECONDS)


def kalibr(folder: Path) -> Path:
    header = "timestamp,omega_x,omega_y,omega_z,alpha_x,alpha_y,alpha_z"
    return table(folder / "imu0.csv", header, per_s=1e9, first_s=SINCE_1970_S, formats=NANOSECONDS)


def inrol(folder: Path) -> Path:
    columns = [np.arange(len(LOG)), LOG.timestamp_s, *LOG.gyro_rad_s.T, *LOG.accel_m_s2.T]
    header = "# index timestamp wx wy wz ax ay az"
    return written(folder / "imu.txt", header, columns, " ", ["%.0f", *7 * ["%.12f"]])


def mars_since_boot(folder: Path) -> Path:
    header = "Timestamp[nanosec],gx[rad/s],gy[rad/s],gz[rad/s],ax[m/s^2],ay[m/s^2],az[m/s^2],Unix time[nanosec]"
    columns = [(LOG.timestamp_s + 40_000) * 1e9, *LOG.gyro_rad_s.T, *LOG.accel_m_s2.T]
    columns.append(np.round(LOG.timestamp_s + SINCE_1970_S) * 1e9)
    return written(folder / "gyro_accel.csv", header, columns, ",", ["%.0f", *6 * ["%.9f"], "%.0f"])


def physics_toolbox(folder: Path) -> Path:
    gravity_free = LOG.accel_m_s2 - LOG.accel_m_s2.mean(axis=0)
    columns = [LOG.timestamp_s, *LOG.accel_m_s2.T / G_M_S2, *gravity_free.T, *LOG.gyro_rad_s.T]
    return written(folder / "toolbox.csv", "time,gFx,gFy,gFz,ax,ay,az,wx,wy,wz", columns)


def androsensor(folder: Path) -> Path:
    names = [f"{sensor} {axis} ({unit})" for sensor, unit in SENSORS for axis in "XYZ"]
    gravity = np.tile([0.0, 0.0, 9.81], (len(LOG), 1))
    of_sensors = [LOG.accel_m_s2, gravity, LOG.accel_m_s2 - gravity, LOG.gyro_rad_s]
    columns = [*(axis for values in of_sensors for axis in values.T), np.round(LOG.timestamp_s * 1e3)]
    header = ";".join([*names, "Time since start in ms"])
    return written(folder / "sensors.csv", header, columns, ";")


SENSORS = (
    ("ACCELEROMETER", "m/s²"),
    ("GRAVITY", "m/s²"),
    ("LINEAR ACCELERATION", "m/s²"),
    ("GYROSCOPE", "rad/s"),
)


def rostopic(folder: Path) -> Path:
    names = [f"field.{what}.{axis}" for what in ("angular_velocity", "linear_acceleration") for axis in "xyz"]
    return table(
        folder / "imu.csv",
        ",".join(["field.header.stamp", *names]),
        per_s=1e9,
        first_s=SINCE_1970_S,
        formats=NANOSECONDS,
    )


def degrees_and_g(folder: Path) -> Path:
    names = [*(f"Gyro{axis}(deg/s)" for axis in "XYZ"), *(f"Accel{axis}(g)" for axis in "XYZ")]
    columns = [LOG.timestamp_s * 1e6, *np.degrees(LOG.gyro_rad_s).T, *LOG.accel_m_s2.T / G_M_S2]
    return written(folder / "imu.csv", ",".join(["time_us", *names]), columns)


def milli_g(folder: Path) -> Path:
    names = [*(f"acc_{axis}_mg" for axis in "xyz"), *(f"gyr_{axis}_mdps" for axis in "xyz")]
    columns = [LOG.timestamp_s * 1e3, *1e3 * LOG.accel_m_s2.T / G_M_S2, *1e3 * np.degrees(LOG.gyro_rad_s).T]
    return written(folder / "imu.csv", ",".join(["timestamp_ms", *names]), columns)


def milli_g_without_units(folder: Path) -> Path:
    columns = [LOG.timestamp_s, *1e3 * LOG.accel_m_s2.T / G_M_S2, *LOG.gyro_rad_s.T]
    return written(folder / "imu.csv", "time_s,ax,ay,az,gx,gy,gz", columns)


def german(folder: Path) -> Path:
    names = [*(f"Beschleunigung {axis} [mg]" for axis in "XYZ"), *(f"Drehrate {axis} [°/s]" for axis in "XYZ")]
    columns = [LOG.timestamp_s, *1e3 * LOG.accel_m_s2.T / G_M_S2, *np.degrees(LOG.gyro_rad_s).T]
    path = written(folder / "imu.csv", ";".join(["Zeit [s]", *names]), columns, ";")
    path.write_text(path.read_text(encoding="utf-8").replace(".", ","), encoding="cp1252")
    return path


def french(folder: Path) -> Path:
    names = [
        *(f"Accélération {axis} (m/s²)" for axis in "xyz"),
        *(f"Vitesse angulaire {axis} (rad/s)" for axis in "xyz"),
    ]
    columns = [LOG.timestamp_s, *LOG.accel_m_s2.T, *LOG.gyro_rad_s.T]
    return written(folder / "imu.csv", ",".join(["Temps (s)", *names]), columns)


def phone(folder: Path, *, platform: str, accel: dict[str, Array]) -> Path:
    """Write a recording of Sensor Logger: a file for each sensor, z before y and x, accelerations later than rates."""
    folder = folder / "2026-09-22_10-00-00"
    folder.mkdir()
    later_s = LOG.timestamp_s + 0.003
    for name, times_s, values in (
        ("Gyroscope", LOG.timestamp_s, LOG.gyro_rad_s),
        *((name, later_s, values) for name, values in accel.items()),
        ("Magnetometer", later_s, LOG.accel_m_s2),
    ):
        columns = [(times_s + SINCE_1970_S) * 1e9, times_s, *values[:, ::-1].T]
        written(folder / f"{name}.csv", "time,seconds_elapsed,z,y,x", columns, ",", ["%.0f", *4 * ["%.9f"]])
    (folder / "Metadata.csv").write_text(
        "version,device name,recording epoch time,recording time,recording timezone,platform,appVersion,device id,"
        "sensors,sampleRateMs,standardisation,platform version\n"
        f"3,A phone,1790000000000,2026-09-22_10-00-00,Europe/Zurich,{platform},1.64,an id,Gyroscope,10|10,false,36\n"
    )
    (folder / "Annotation.csv").write_text("time,seconds_elapsed,text,millisecond_press_duration\n")
    return folder


def at_gyro(values: Array) -> Array:
    """Accelerations at the times of a phone's accelerometer."""
    return np.column_stack([np.interp(LOG.timestamp_s + 0.003, LOG.timestamp_s, axis) for axis in values.T])


def android(folder: Path) -> Path:
    accel = at_gyro(LOG.accel_m_s2)
    return phone(
        folder, platform="android", accel={"TotalAcceleration": accel, "Accelerometer": accel - accel.mean(axis=0)}
    )


def ios(folder: Path) -> Path:
    accel, gravity = at_gyro(LOG.accel_m_s2), np.tile(LOG.accel_m_s2.mean(axis=0), (len(LOG), 1))
    gravity *= 9.81 / np.linalg.norm(gravity, axis=1)[:, None]
    return phone(folder, platform="ios", accel={"Accelerometer": gravity - accel, "Gravity": -gravity})


def ios_uncalibrated(folder: Path) -> Path:
    return phone(folder, platform="ios", accel={"AccelerometerUncalibrated": -at_gyro(LOG.accel_m_s2) / G_M_S2})


def zipped(folder: Path) -> Path:
    path = folder / "recording.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in android(folder).iterdir():
            archive.write(file, file.name)
    return path


def phyphox(folder: Path) -> Path:
    path = folder / "phyphox"
    path.mkdir()
    for name, what, unit, values in (
        ("Accelerometer", "Acceleration", "m/s^2", at_gyro(LOG.accel_m_s2)),
        ("Gyroscope", "Gyroscope", "rad/s", LOG.gyro_rad_s),
    ):
        header = ",".join(['"Time (s)"', *(f'"{what} {axis} ({unit})"' for axis in "xyz")])
        times_s = LOG.timestamp_s + 0.003 * (name == "Accelerometer")
        written(path / f"{name}.csv", header, [times_s, *values.T], ",", 4 * ["%.9E"])
    return path


def gopro(folder: Path) -> Path:
    """The tables that GoPro Telemetry Extractor writes."""
    path = folder / "gopro"
    path.mkdir()
    dates = np.datetime64("2026-05-04T10:00:00.000") + np.round(1e3 * LOG.timestamp_s).astype("timedelta64[ms]")
    for track, what, unit, values in (
        ("ACCL", "Accelerometer", "m/s2", LOG.accel_m_s2),
        ("GYRO", "Gyroscope", "rad/s", LOG.gyro_rad_s),
    ):
        header = ",".join(["cts,date", *(f"{what} ({axis}) [{unit}]" for axis in "zxy"), "temperature [°C]"])
        rows = zip(1e3 * LOG.timestamp_s, dates, *values[:, [2, 0, 1]].T, strict=True)
        lines = [f"{cts:.6f},{date}Z,{z:.9f},{x:.9f},{y:.9f},31.5" for cts, date, z, x, y in rows]
        (path / f"GH010042_HERO9 Black-{track}.csv").write_text("\n".join([header, *lines]) + "\n", encoding="utf-8")
    return path


def bag(folder: Path) -> Path:
    vector, quaternion = (TYPES[2].types[f"geometry_msgs/msg/{name}"] for name in ("Vector3", "Quaternion"))
    unknown = {f"{name}_covariance": np.zeros(9) for name in ("orientation", "angular_velocity", "linear_acceleration")}
    messages = list[Message]()
    for time_s, gyro, accel in zip(LOG.timestamp_s + SINCE_1970_S, LOG.gyro_rad_s.tolist(), LOG.accel_m_s2.tolist()):
        vectors = {
            "angular_velocity": vector(*gyro),
            "linear_acceleration": vector(*accel),
            "orientation": quaternion(0, 0, 0, 1),
        }
        messages.append(("/imu", "sensor_msgs/msg/Imu", float(time_s), {**unknown, **vectors}))
    return write_bag(folder / "bag", messages)


FORMATS = (
    *(canonical, euroc, euroc_without_header, kalibr, inrol, mars_since_boot, physics_toolbox, androsensor, rostopic),
    *(milli_g, milli_g_without_units, german, french),
    *(degrees_and_g, android, ios, ios_uncalibrated, zipped, phyphox, gopro, bag),
)


@pytest.mark.parametrize("write", FORMATS)
def test_each_format_is_read_in_its_units_and_axes(write: Callable[[Path], Path], tmp_path: Path) -> None:
    log = read_imu(write(tmp_path))
    assert len(log) > 0.98 * len(LOG)
    # Accelerometers that start later lose the first samples.
    rows = np.searchsorted(LOG.timestamp_s, log.timestamp_s - log.timestamp_s[-1] + LOG.timestamp_s[-1] - 0.005)
    np.testing.assert_allclose(np.diff(log.timestamp_s), np.diff(LOG.timestamp_s[rows]), atol=1.1e-3)
    np.testing.assert_allclose(log.gyro_rad_s, LOG.gyro_rad_s[rows], atol=1e-6)
    np.testing.assert_allclose(log.accel_m_s2, LOG.accel_m_s2[rows], atol=0.12)
    assert np.std(log.accel_m_s2 - LOG.accel_m_s2[rows]) < 0.03


@pytest.mark.parametrize("write", [write for write in FORMATS if write is not euroc_without_header])
def test_logs_are_recognized(write: Callable[[Path], Path], tmp_path: Path) -> None:
    assert is_imu_log(write(tmp_path))


def test_other_tables_are_not_logs(tmp_path: Path) -> None:
    (tmp_path / "uwb.csv").write_text("timestamp_s,anchor_id,range_m\n0.1,A,2.5\n")
    (tmp_path / "truth.csv").write_text("timestamp_s,x_m,y_m,z_m,qx,qy,qz,qw\n0.1,1,2,3,0,0,0,1\n")
    assert not any(map(is_imu_log, tmp_path.iterdir()))
    assert not is_imu_log(tmp_path)


def changed(path: Path, change: Callable[[list[str]], list[str]]) -> Path:
    path.write_text("\n".join(change(path.read_text().split("\n"))))
    return path


def test_gaps_repeated_times_and_lost_values_are_said(tmp_path: Path) -> None:
    def worse(lines: list[str]) -> list[str]:
        cells = lines[300].split(",")
        return [*lines[:100], *lines[200:300], ",".join([cells[0], "nan", *cells[2:]]), lines[301], *lines[301:]]

    log = read_imu(changed(canonical(tmp_path), worse))
    assert len(log) == len(LOG) - 101
    assert any(re.search(r"a gap without samples, the longest of 1(\.01)? s", doubt) for doubt in log.doubts)
    assert any("1 samples have the time of an earlier one" in note for note in log.notes)


def test_values_at_the_end_of_the_scale_are_said(tmp_path: Path) -> None:
    rates = LOG.gyro_rad_s.copy()
    rates[50:60, 1] = np.radians(250.0)
    log = ImuLog(LOG.timestamp_s, rates, LOG.accel_m_s2)
    path = table(tmp_path / "imu.csv", ",".join(CANONICAL_COLUMNS), log)
    assert any(
        f"10 of {len(LOG)} samples of the gyroscope are at the end of its scale" in doubt
        for doubt in read_imu(path).doubts
    )
    assert not any("end of its scale" in doubt for doubt in read_imu(canonical(tmp_path)).doubts)


REFUSED: dict[str, tuple[Callable[[list[str]], list[str]], str]] = {
    "empty": (lambda _: [], r"imu\.csv: the file is empty, expected a table with timestamp_s,gyro_x_rad_s"),
    "no accelerometer": (
        lambda lines: [",".join(line.split(",")[:4]) for line in lines if line],
        r"imu\.csv: there is no accelerometer in it",
    ),
    "no gyroscope": (
        lambda lines: [",".join([line.split(",")[0], *line.split(",")[4:]]) for line in lines if line],
        r"imu\.csv: there is no gyroscope in it",
    ),
    "no time": (
        lambda lines: [",".join(line.split(",")[1:]) for line in lines if line],
        r"imu\.csv: no column seems to be the time",
    ),
    "two recordings": (lambda lines: [*lines[:-1], *lines[1:]], r"imu\.csv:602: the time goes back by 5\.99 s"),
    "few samples": (lambda lines: lines[:50], r"imu\.csv: 49 samples of the gyroscope, expected 100 or more"),
    "a slow log": (lambda lines: [lines[0], *lines[1::4]], r"25 samples a second"),
    "text in a cell": (
        lambda lines: [*lines[:20], lines[20].replace(",", ",x", 1), *lines[21:]],
        r"imu\.csv:21: gyro_x_rad_s is 'x.*', expected a number",
    ),
    "something else": (lambda _: ["a,b", "1,2"], r"imu\.csv: no columns of a gyroscope and an accelerometer"),
}


@pytest.mark.parametrize("name", [name for name in REFUSED if name != "a slow log"])
def test_what_cannot_be_used_is_refused_with_its_place(name: str, tmp_path: Path) -> None:
    change, text = REFUSED[name]
    with pytest.raises(InputError, match=text):
        read_imu(changed(canonical(tmp_path), change))


def test_a_video_is_refused_with_the_way_to_its_tables(tmp_path: Path) -> None:
    (tmp_path / "GX010042.MP4").write_bytes(b"\0\0\0\x20ftypmp41" + bytes(64))
    with pytest.raises(InputError, match=r"GX010042\.MP4: is a video, .*ACCL and GYRO"):
        read_imu(tmp_path / "GX010042.MP4")


def test_few_samples_a_second_are_said(tmp_path: Path) -> None:
    change, text = REFUSED["a slow log"]
    log = read_imu(changed(canonical(tmp_path), change))
    assert any(re.search(text, doubt) for doubt in log.doubts)


def test_accelerations_without_gravity_are_refused(tmp_path: Path) -> None:
    log = ImuLog(LOG.timestamp_s, LOG.gyro_rad_s, LOG.accel_m_s2 - LOG.accel_m_s2.mean(axis=0))
    path = table(tmp_path / "imu.csv", ",".join(CANONICAL_COLUMNS), log)
    with pytest.raises(InputError, match=r"median length is .*, expected 9\.8 m/s\^2 or 1 g: record it with gravity"):
        read_imu(path)


def test_g_under_a_name_of_metres_is_converted_and_said(tmp_path: Path) -> None:
    log = ImuLog(LOG.timestamp_s, LOG.gyro_rad_s, LOG.accel_m_s2 / G_M_S2)
    read = read_imu(table(tmp_path / "imu.csv", ",".join(CANONICAL_COLUMNS), log))
    np.testing.assert_allclose(read.accel_m_s2, LOG.accel_m_s2, atol=1e-6)
    assert any("are in g by their length, whatever the name says" in note for note in read.notes)


def test_a_bag_without_a_sensor_and_an_archive_without_tables_are_refused(tmp_path: Path) -> None:
    (tmp_path / "no.zip").write_bytes(b"PK\3\4 no archive")
    with pytest.raises(InputError, match=r"no\.zip: cannot be read as a zip archive"):
        read_imu(tmp_path / "no.zip")
    with zipfile.ZipFile(tmp_path / "none.zip", "w") as archive:
        archive.writestr("photo.jpg", b"")
    with pytest.raises(InputError, match=r"none\.zip: no table in this archive"):
        read_imu(tmp_path / "none.zip")
    with pytest.raises(InputError, match="missing"):
        read_imu(tmp_path / "missing.csv")


@settings(max_examples=150)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_damaged_log_is_read_or_refused_with_one_line(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    data = bytearray(TEXT)
    for _ in range(rng.integers(1, 30)):
        kind, k = rng.integers(3), int(rng.integers(len(data)))
        if kind == 0:
            data[k] = int(rng.integers(256))
        elif kind == 1:
            del data[k : k + int(rng.integers(1, 200))]
        else:
            data[k:k] = [b"nan", b"1e300", b",", b"\n", b"-", b'"', b"\0", b"#"][int(rng.integers(8))]
    path = tmp_path / "imu.csv"
    path.write_bytes(bytes(data))
    try:
        log = read_imu(path)
    except InputError:
        return
    assert len(log) >= 100
    assert np.all(np.diff(log.timestamp_s) > 0)


def _text() -> bytes:
    rows = np.column_stack([LOG.timestamp_s, LOG.gyro_rad_s, LOG.accel_m_s2])[:200]
    return "\n".join(
        [",".join(CANONICAL_COLUMNS), *(",".join(f"{value:.4f}" for value in row) for row in rows)]
    ).encode()


TEXT = _text()


def test_samples_that_arrive_late_were_taken_evenly_unless_some_are_lost() -> None:
    taken_s = np.arange(4000) / 100.0
    delays_s = np.random.default_rng(1).exponential(0.006, len(taken_s))
    delays_s[2000:2050] += 0.3  # a transfer hangs
    arrived_s = np.maximum.accumulate(taken_s + delays_s) + 1e-9 * np.arange(len(taken_s))
    found_s = times_of_sampling(arrived_s)
    assert found_s is not None
    np.testing.assert_allclose(found_s - taken_s, (found_s - taken_s).mean(), atol=5e-4)
    assert times_of_sampling(taken_s) is None
    assert times_of_sampling(np.delete(arrived_s, range(1500, 1510))) is None
