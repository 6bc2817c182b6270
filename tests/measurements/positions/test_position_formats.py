"""Positions are read from tables, TUM trajectories, NMEA, RTKLIB and Marvelmind, and mistakes are named."""

from __future__ import annotations

from datetime import datetime, timezone
from functools import reduce
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from rangesfm.errors import InputError
from rangesfm.measurements.positions.position_formats import read_positions
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.measurements.positions.true_positions import read_true_positions
from rangesfm.measurements.ranges.readers.unclear import UnclearFileError
from rangesfm.options import PositionOptions
from rangesfm.util.geometry.georeference import GEOGRAPHIC

DAY_S = datetime(2024, 3, 1, tzinfo=timezone.utc).timestamp()


def read(folder: Path, text: str, **options: object) -> PositionLog:
    """Write a file and read it."""
    path = folder / "positions.txt"
    path.write_text(text)
    return read_positions(path, PositionOptions().changed(**options))


def nmea(*bodies: str) -> str:
    """Return sentences with their checksums."""
    sums = (f"{reduce(lambda total, letter: total ^ ord(letter), body, 0):02X}" for body in bodies)
    return "".join(f"${body}*{total}\r\n" for body, total in zip(bodies, sums, strict=True))


def test_the_canonical_table_is_read_in_the_order_of_time(tmp_path: Path) -> None:
    found = read(tmp_path, "timestamp_s,x_m,y_m,z_m,stddev_m\n2,4,5,6,0.1\n1,1,2,3,0.2\n2,9,9,9,0.1\n")
    np.testing.assert_array_equal(found.moments.timestamp_s, [1, 2])
    np.testing.assert_array_equal(found.position_m, [[1, 2, 3], [4, 5, 6]])
    np.testing.assert_allclose(found.covariance_m2, [0.04 * np.eye(3), 0.01 * np.eye(3)])
    np.testing.assert_array_equal(found.line, [3, 2])
    assert found.notes == ("positions.txt: 1 of 3 positions have the time of an earlier one and are left out",)


def test_positions_by_photo_may_have_a_covariance(tmp_path: Path) -> None:
    names = "image_name,x_m,y_m,z_m,cov_xx_m2,cov_xy_m2,cov_xz_m2,cov_yy_m2,cov_yz_m2,cov_zz_m2"
    found = read(tmp_path, f"{names}\na.jpg,1,2,3,4,1,0,5,0,6\nb.jpg,1,2,3,,,,,,\n")
    assert found.moments.image_name == ("a.jpg", "b.jpg")
    np.testing.assert_array_equal(found.covariance_m2[0], [[4, 1, 0], [1, 5, 0], [0, 0, 6]])
    assert np.isnan(found.covariance_m2[1]).all()


def test_a_table_of_a_positioning_system_is_recognised_by_its_columns(tmp_path: Path) -> None:
    rows = "".join(f"{1000 * k},T1,{100 * k},{200 * k},{5 * k}\n" for k in range(30))
    found = read(tmp_path, f"timestamp (ms),tag_id,pos_x (mm),pos_y (mm),pos_z (mm)\n{rows}")
    np.testing.assert_allclose(found.moments.timestamp_s, np.arange(30.0))
    np.testing.assert_allclose(found.position_m[2], [0.2, 0.4, 0.01])
    with pytest.raises(InputError, match=r"has positions of several tags \(T1, T2\): say which it is"):
        read(tmp_path, "timestamp_s,tag_id,x,y,z\n1,T1,1,2,3\n2,T2,1,2,3\n")
    two = "timestamp_s,tag_id,x,y,z\n1,T1,1,2,3\n2,T2,4,5,6\n"
    np.testing.assert_array_equal(read(tmp_path, two, tag_id="T2").position_m, [[4, 5, 6]])


def test_a_tum_trajectory_gives_its_positions(tmp_path: Path) -> None:
    found = read(tmp_path, "1.0 1 2 3 0 0 0 1\n2.0 4 5 6 0 0 0 1\n")
    assert (found.format, found.crs) == ("tum", "")
    np.testing.assert_array_equal(found.position_m, [[1, 2, 3], [4, 5, 6]])


def test_nmea_gives_ellipsoidal_heights_utc_and_stddevs(tmp_path: Path) -> None:
    text = nmea(
        "GPRMC,235959.00,A,4717.11399,N,00833.91590,E,0.0,0.0,290224,,,A",
        "GPGST,235959.00,1.0,,,,0.02,0.03,0.05",
        "GPGGA,235959.00,4717.11399,N,00833.91590,E,4,12,0.7,499.6,M,48.0,M,,",
        "GPGGA,000001.50,4717.11400,N,00833.91590,W,1,12,0.7,499.6,M,48.0,M,,",
        "GPGGA,000002.50,,,,,0,00,,,M,,M,,",
    )
    found = read(tmp_path, f"{text}$GPGGA,000003.00,broken*00\n")
    assert (found.format, found.crs) == ("nmea", GEOGRAPHIC)
    np.testing.assert_allclose(found.moments.timestamp_s, [DAY_S - 1, DAY_S + 1.5])
    np.testing.assert_allclose(found.position_m[0], [8 + 33.9159 / 60, 47 + 17.11399 / 60, 547.6])
    assert found.position_m[1, 0] < 0
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance_m2[0])), [0.03, 0.02, 0.05])
    assert found.covariance_m2[1, 0, 0] == pytest.approx(9.0)
    assert found.notes == ("positions.txt: 1 broken sentences are left out",)
    by_host = "".join(f"2024-02-29T23:59:59.100Z {line}\n" for line in text.splitlines())
    np.testing.assert_array_equal(read(tmp_path, by_host).position_m, found.position_m)


def test_degrees_in_the_names_of_columns_tell_longitude_from_latitude(tmp_path: Path) -> None:
    rows = "".join(f"2026/05/04 10:00:0{k}.000;{47 + k * 1e-6:.6f};9.0;430.0;1\n" for k in range(9))
    found = read(tmp_path, f"GPST;latitude(deg);longitude(deg);height(m);Q\n{rows}")
    assert found.crs == GEOGRAPHIC
    np.testing.assert_allclose(found.position_m[1], [9, 47.000001, 430], rtol=1e-12)


def test_a_solution_of_rtklib_has_covariances_east_north_up(tmp_path: Path) -> None:
    names = (
        "%  GPST latitude(deg) longitude(deg) height(m) Q ns sdn(m) sde(m) sdu(m) sdne(m) sdeu(m) sdun(m) age(s) ratio"
    )
    row = "2024/03/01 00:00:05.500 47.06 -1.35 84.8 1 9 0.02 0.01 0.05 -0.01 0.002 0.003 0.0"
    found = read(tmp_path, f"% program : RTKLIB\n{names}\n{row}\n")
    assert (found.format, found.crs) == ("rtklib", GEOGRAPHIC)
    np.testing.assert_allclose(found.moments.timestamp_s, [DAY_S + 5.5])
    np.testing.assert_allclose(found.position_m, [[-1.35, 47.06, 84.8]])
    np.testing.assert_allclose(
        found.covariance_m2[0], [[1e-4, -1e-4, 4e-6], [-1e-4, 4e-4, 9e-6], [4e-6, 9e-6, 25e-4]], atol=1e-12
    )
    assert "GPS time, which is ahead of UTC" in found.notes[0]
    with pytest.raises(InputError, match=r"positions.txt:2: has 4 cells, expected date time latitude"):
        read(tmp_path, f"{names}\n2024/03/01 00:00:05.500 47.06 -1.35\n")


def test_a_solution_of_rtklib_in_geocentric_coordinates_is_turned_to_east_north_up(tmp_path: Path) -> None:
    names = "%  GPST x-ecef(m) y-ecef(m) z-ecef(m) Q ns sdx(m) sdy(m) sdz(m) sdxy(m) sdyz(m) sdzx(m) age(s) ratio"
    row = "2024/03/01 00:00:05.500 4345879.4430 705824.3170 4599894.7760 1 9 0.01 0.01 0.05 0.0 0.0 0.0 0.0 9.9"
    found = read(tmp_path, f"{names}\n{row}\n")
    lon_deg, lat_deg, height_m = found.position_m[0]
    assert found.crs == GEOGRAPHIC
    assert lon_deg == pytest.approx(np.rad2deg(np.arctan2(705824.3170, 4345879.4430)), abs=1e-9)
    # Formulas of the ellipsoid WGS 84.
    lat, square = np.deg2rad(lat_deg), 6.69437999014e-3
    normal_m = 6378137.0 / np.sqrt(1 - square * np.sin(lat) ** 2)
    assert (normal_m + height_m) * np.cos(lat) == pytest.approx(np.hypot(4345879.4430, 705824.3170), abs=1e-3)
    assert (normal_m * (1 - square) + height_m) * np.sin(lat) == pytest.approx(4599894.7760, abs=1e-3)
    # The axis of the Earth, of which little is known, points north and up.
    axis = np.array([0.0, np.cos(lat), np.sin(lat)])
    np.testing.assert_allclose(found.covariance_m2[0], 1e-4 * np.eye(3) + 24e-4 * np.outer(axis, axis), atol=1e-9)


GPX = """<?xml version="1.0" encoding="UTF-8"?>
<gpx version="1.1" creator="phone" xmlns="http://www.topografix.com/GPX/1/1">
<metadata><time>2024-06-01T11:00:00Z</time></metadata>
<wpt lat="1" lon="2"><ele>3</ele></wpt>
<trk><trkseg>
"""
GPX_POINT = """<trkpt {}>
  <ele>43{}.25</ele>
  <time>2024-06-01T1{}Z</time>
</trkpt>
"""


def test_points_of_tracks_in_gpx_are_positions(tmp_path: Path) -> None:
    points = [
        GPX_POINT.format('lat="47.5" lon="9.25"', 0, "1:06:40"),
        GPX_POINT.format("lon='9.5' lat='47.75'", 1, "1:06:41.500"),
        GPX_POINT.format("lon='9.5' lat='47.75'", 2, "1:06:42").replace("<ele>432.25</ele>", ""),
    ]
    whole = GPX + "".join(points) + "</trkseg></trk></gpx>\n"
    for text in (whole, whole[: whole.rindex("</trkpt>")]):  # the phone's battery was empty
        found = read(tmp_path, text)
        assert (found.format, found.crs) == ("gpx", GEOGRAPHIC)
        np.testing.assert_array_equal(found.position_m, [[9.25, 47.5, 430.25], [9.5, 47.75, 431.25]])
        np.testing.assert_allclose(found.moments.timestamp_s, [1717240000.0, 1717240001.5])
    with pytest.raises(InputError, match=r"positions\.txt:10: lat is 'here', expected"):
        read(tmp_path, whole.replace("47.75", "here", 1))
    with pytest.raises(InputError, match=r"no point of its tracks has a height"):
        read(tmp_path, whole.replace("ele>", "altitude>"))
    with pytest.raises(InputError, match=r"holds no point of a track"):
        read(tmp_path, GPX + "</trkseg></trk></gpx>\n")


@pytest.mark.parametrize(
    "names",
    [
        "Label,X/Longitude,Y/Latitude,Z/Altitude,Accuracy_X/Y_(m),Accuracy_Z_(m)",
        "imagename,longitude,latitude,altitude,accuracy horizontal,accuracy vertical",
    ],
)
def test_a_standard_deviation_of_two_coordinates_is_that_of_each(names: str, tmp_path: Path) -> None:
    found = read(tmp_path, f"{names}\nIMG_1,9.0,47.0,430.0,0.02,0.05\nIMG_2,9.00001,47.0,431.0,0.03,0.06\n")
    np.testing.assert_allclose(np.sqrt(found.covariance_m2[0]), np.diag([0.02, 0.02, 0.05]))


def test_the_principal_point_in_a_list_of_cameras_is_no_place(tmp_path: Path) -> None:
    names = "#cameras 2\n#name,x,y,alt,yaw,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"
    rows = "".join(f"IMG_{k}.jpg,{k}.5,2.5,{3 + k}.5,12.1,80.2,0.5,28.1,0.01,0.02,0,0,0,0,0,0\n" for k in range(2))
    found = read(tmp_path, f"{names}\n{rows}")
    np.testing.assert_array_equal(found.position_m, [[0.5, 2.5, 3.5], [1.5, 2.5, 4.5]])


def test_latitude_before_longitude_is_offered_in_a_list_without_names(tmp_path: Path) -> None:
    with pytest.raises(UnclearFileError) as error:
        read(tmp_path, by_photo("{photo},{y},{x},{z},0.02,0.05"))
    assert "image_name=1,x=3,y=2,z=4" in [choice.flags["position_columns"] for choice in error.value.choices]


@pytest.mark.parametrize(
    "line",
    [
        "POS,{:.2f},-2.85,0.59,74",
        "DIST,1,AN0,022E,7.94,8.03,0.00,3.44,POS,{:.2f},-2.85,0.59,74",
        "022E[7.94,8.03,0.00]=3.38 le_us=3082 est[{:.2f},-2.85,0.59,74]",
    ],
)
def test_positions_that_a_dwm1001_prints_are_read_with_the_hosts_time(line: str, tmp_path: Path) -> None:
    found = read(tmp_path, "dwm> lep\n" + "".join(f"{1.7e9 + k:.3f} {line.format(k)}\n" for k in range(5)))
    assert found.format == "dwm1001"
    np.testing.assert_array_equal(found.moments.timestamp_s, 1.7e9 + np.arange(5))
    np.testing.assert_array_equal(found.position_m[3], [3.0, -2.85, 0.59])
    with pytest.raises(InputError, match=r"positions.txt:1: no time before the position"):
        read(tmp_path, line.format(1) + "\n")


def test_coordinates_in_whole_numbers_are_asked_about(tmp_path: Path) -> None:
    rows = "".join(
        f'[{{"timestamp": {1.7e9 + k}, "coordinates": {{"x": {1000 + 20 * k}, "y": {7 * k}, "z": 1300}}}}]\n'
        for k in range(30)
    )
    with pytest.raises(UnclearFileError, match="not known for sure") as error:
        read(tmp_path, rows)
    assert [choice.flags["position_unit"] for choice in error.value.choices] == ["mm", "cm", "m"]
    np.testing.assert_allclose(read(tmp_path, rows, unit="mm").position_m[1], [1.02, 0.007, 1.3])


def test_a_time_before_the_topic_of_a_message_is_its_time(tmp_path: Path) -> None:
    row = '{:.3f} dwm/node/0c96/uplink/location {{"position":{{"x":1.25,"y":{},"z":3.5,"quality":68}}}}\n'
    found = read(tmp_path, "".join(row.format(1.7e9 + k, 0.5 + k) for k in range(30)))
    np.testing.assert_array_equal(found.moments.timestamp_s, 1.7e9 + np.arange(30))


def test_a_log_of_marvelminds_dashboard_is_read(tmp_path: Path) -> None:
    rows = "".join(f"{1700000000000 + 100 * k},100,{100 * k},5,1.0{k},2.0,0.5,1,3.2,2,4.1\n" for k in range(3))
    found = read(tmp_path, rows)
    assert found.format == "marvelmind"
    np.testing.assert_allclose(np.diff(found.moments.timestamp_s), 0.1, atol=1e-6)
    np.testing.assert_allclose(found.position_m[:, 0], [1.0, 1.01, 1.02])


@pytest.mark.parametrize("system", ["CARTESIAN", "WGS84"])
def test_pose_priors_of_a_database_are_positions_of_its_photos(tmp_path: Path, system: str) -> None:
    path = tmp_path / "database.db"
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera(model="PINHOLE", width=10, height=10, params=[10, 10, 5, 5])
        camera_id = database.write_camera(camera)
        for k in range(3):
            image = pycolmap.Image(name=f"{k}.jpg", camera_id=camera_id)
            image_id = database.write_image(image)
            image.image_id = image_id
            prior = pycolmap.PosePrior(
                position=[47.0 + k, 8.0, 400.0],
                position_covariance=0.01 * np.eye(3),
                coordinate_system=pycolmap.PosePriorCoordinateSystem.__members__[system],
                corr_data_id=image.data_id,
            )
            database.write_pose_prior(prior)
    before = path.read_bytes()
    found = read_positions(path, PositionOptions())
    assert found.moments.image_name == ("0.jpg", "1.jpg", "2.jpg")
    is_geographic = system == "WGS84"
    assert found.crs == (GEOGRAPHIC if is_geographic else "")
    np.testing.assert_array_equal(found.position_m[1], [8, 48, 400] if is_geographic else [48, 8, 400])
    assert np.isnan(found.covariance_m2).all() == is_geographic
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("text", "options", "said"),
    [
        ("", {}, "the file is empty, expected a table with timestamp_s or image_name"),
        ("timestamp_s,x_m,y_m,z_m\n", {}, "holds no position (read as table)"),
        ("timestamp_s,x_m,y_m,z_m\n1,2,three,4\n", {}, "positions.txt:2: y_m is 'three', expected"),
        ("timestamp_s,x_m,y_m,z_m,stddev_m\n1,2,3,4,-1\n", {}, "positions.txt:2: stddev_m is -1, expected"),
        (
            "image_name,x_m,y_m,z_m\na.jpg,1,2,3\nb.jpg,2,2,3\na.jpg,9,2,3\n",
            {},
            "positions.txt:4: photo a.jpg is in line 2 already, expected each once",
        ),
        ("1 2 3\n", {"format": "rtk"}, "unknown format of positions 'rtk'; the nearest is 'rtklib'"),
        ("1 2 3\n", {"format": "rtklib"}, "has no header row of an RTKLIB solution"),
    ],
)
def test_a_mistake_in_positions_is_named(tmp_path: Path, text: str, options: dict[str, object], said: str) -> None:
    with pytest.raises(InputError) as error:
        read(tmp_path, text, **options)
    assert said in str(error.value)


def test_unclear_columns_are_asked_for(tmp_path: Path) -> None:
    with pytest.raises(UnclearFileError, match="a table of positions whose columns are not known for sure") as error:
        read(tmp_path, "time,a,b,c\n1,2,3,4\n2,3,4,5\n")
    told = [str(choice) for choice in error.value.choices]
    assert told == ["if a, b, c are x, y, z, add --position_columns timestamp=time,x=a,y=b,z=c"]


ROWS = [(1403636579763555584 + 100_000_000 * k, 3.0 + 0.25 * k, -1.5 * k, 1.5 + 0.125 * k) for k in range(30)]
EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1], b_w_RS_S_x [rad s^-1], b_w_RS_S_y [rad s^-1], "
    "b_w_RS_S_z [rad s^-1]"
)
# A header, a row with the time t in ns, the time s in seconds and the place x, y, z, and the cells that come after.
TRAJECTORIES = {
    "EuRoC": (EUROC, "{t},{x},{y},{z},0.6,0.0,0.8,0.0,0.1,0.2,0.3,0,0,0"),
    "VINS": ("", "{t},{x},{y},{z},0.6,0.0,0.8,0.0,0.1,0.2,0.3,"),
    "MCD": ("num t x y z qx qy qz qw", "{k} {s} {x} {y} {z} 0.0 0.8 0.0 0.6"),
    "DWM1001": ("Time,POSX,POSY,POSZ", "{s},{x},{y},{z}"),
    "ROS": (
        "time,pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,pose.orientation.y,"
        "pose.orientation.z,pose.orientation.w,twist.linear.x,twist.linear.y,twist.linear.z",
        "{s},{x},{y},{z},0,0,0,1,0.1,0.2,0.3",
    ),
    "TUM with commas": ("", "{s},{x},{y},{z},0.0,0.6,0.0,0.8"),
    "plain": ("", "{s} {x} {y} {z}"),
    "transform": ("timestamp;tx;ty;tz", "{s};{x};{y};{z}"),
}


@pytest.mark.parametrize("name", TRAJECTORIES)
def test_trajectories_of_other_programs_give_their_positions(tmp_path: Path, name: str) -> None:
    header, row = TRAJECTORIES[name]
    rows = [row.format(k=k, t=t, s=f"{t / 1e9:.6f}", x=x, y=y, z=z) for k, (t, x, y, z) in enumerate(ROWS)]
    path = tmp_path / "positions.txt"
    found = read(tmp_path, "\n".join([header] * bool(header) + rows) + "\n")
    np.testing.assert_allclose(found.moments.timestamp_s, [t / 1e9 for t, *_ in ROWS], atol=1e-6)
    np.testing.assert_array_equal(found.position_m, [place for _, *place in ROWS])
    reference = read_true_positions(path)
    np.testing.assert_array_equal(reference.positions_m, found.position_m)
    np.testing.assert_array_equal(reference.moments.timestamp_s, found.moments.timestamp_s)


PHOTOS = [f"DJI_{k:04}.JPG" for k in range(5)]
PLACES = [[9.0 + 1e-6 * k, 46.95 - 2e-6 * k, 430.5 + k] for k in range(5)]


def by_photo(row: str) -> str:
    return "".join(
        row.format(photo=photo, label=photo[:-4], x=x, y=y, z=z) + "\n"
        for photo, (x, y, z) in zip(PHOTOS, PLACES, strict=True)
    )


@pytest.mark.parametrize(
    ("text", "crs"),
    [
        ("EPSG:4326\n" + by_photo("{photo} {x} {y} {z}"), "EPSG:4326"),
        ("EPSG:4326\n" + by_photo("{photo} {x} {y} {z} 10 0 -90 0.02 0.04"), "EPSG:4326"),
        ("+proj=utm +zone=32 +datum=WGS84\n" + by_photo("{photo}\t{x}\t{y}\t{z}"), "+proj=utm +zone=32 +datum=WGS84"),
        (
            "#Label,X/Longitude,Y/Latitude,Z/Altitude,Yaw,Pitch,Roll\n" + by_photo("{label},{x},{y},{z},0,0,0"),
            GEOGRAPHIC,
        ),
        (
            '# CoordinateSystem: GEOGCS["WGS 84",DATUM["x",AUTHORITY["EPSG","6326"]],AUTHORITY["EPSG","4326"]]\n'
            "#Label,X/Longitude,Y/Latitude,Z/Altitude\n" + by_photo("{label},{x},{y},{z}"),
            "EPSG:4326",
        ),
        ("SourceFile,Longitude,Latitude,Altitude\n" + by_photo("{photo},{x},{y},{z}"), GEOGRAPHIC),
    ],
)
def test_positions_of_photos_keep_their_coordinate_system(tmp_path: Path, text: str, crs: str) -> None:
    found = read(tmp_path, text)
    assert found.crs == crs
    assert [name[:8] for name in found.moments.image_name] == [photo[:8] for photo in PHOTOS]
    np.testing.assert_array_equal(found.position_m, PLACES)
    if "0.02" in text:
        np.testing.assert_allclose(found.covariance_m2, np.tile(np.diag([4e-4, 4e-4, 16e-4]), (5, 1, 1)))


@pytest.mark.parametrize(
    ("latitude", "longitude", "height"),
    [
        ("49.0398", "8.5076", "415.2"),
        ('"49 deg 2\' 23.28"" N"', '"8 deg 30\' 27.36"" E"', "415.2 m Above Sea Level"),
        ("49°02'23.28''N", "8°30'27.36''E", "415.2 m"),
        ("N 49.0398°", "E 8.5076°", "415.2"),
    ],
)
def test_degrees_of_photos_are_read_as_programs_write_them(
    latitude: str, longitude: str, height: str, tmp_path: Path
) -> None:
    row = f"./a.jpg,{latitude},{longitude},{height}\n"
    found = read(tmp_path, "SourceFile,GPSLatitude,GPSLongitude,GPSAltitude\n" + row + row.replace("a.jpg", "b.jpg"))
    assert (found.crs, found.moments.image_name) == (GEOGRAPHIC, ("./a.jpg", "./b.jpg"))
    np.testing.assert_allclose(found.position_m, 2 * [[8.5076, 49.0398, 415.2]], atol=1e-9)


@pytest.mark.parametrize(
    "names",
    [
        "Label,X/Easting,Y/Northing,Z/Altitude,X_est,Y_est,Z_est",
        "File Name,Easting,Northing,Elevation,Longitude,Latitude,Ellipsoidal height",
        "Name,Easting,Northing,Elevation,Base easting,Base northing,Base elevation",
    ],
)
def test_of_several_coordinates_the_measured_ones_in_the_map_are_taken(names: str, tmp_path: Path) -> None:
    found = read(tmp_path, f"{names}\nIMG_1,1,2,3,8,49,6\nIMG_2,4,5,6,8,49,6\n")
    np.testing.assert_array_equal(found.position_m, [[1, 2, 3], [4, 5, 6]])
    assert not found.crs


def test_columns_by_number_do_not_drop_the_coordinate_system_of_the_first_line(tmp_path: Path) -> None:
    text = "EPSG:4326\n" + by_photo("{photo} {x} {y} {z}")
    found = read(tmp_path, text, columns={"image_name": "1", "x": "2", "y": "3", "z": "4"})
    assert found.crs == "EPSG:4326"
    np.testing.assert_array_equal(found.position_m, PLACES)


def test_local_metres_under_a_heading_for_both_are_no_degrees(tmp_path: Path) -> None:
    found = read(tmp_path, "#Label,X/Longitude,Y/Latitude,Z/Altitude\na,1.5,2.5,0.5\nb,8.5,12.5,0.5\n")
    assert not found.crs


def test_ranges_without_names_are_not_taken_for_positions(tmp_path: Path) -> None:
    with pytest.raises(UnclearFileError, match="a table of positions whose columns are not known for sure"):
        read(tmp_path, "".join(f"{0.5 * k} 2 {5 + k % 3} {4.25 + 0.1 * k}\n" for k in range(20)))


def test_photos_with_large_coordinates_are_asked_about_with_whole_commands(tmp_path: Path) -> None:
    with pytest.raises(UnclearFileError) as error:
        read(tmp_path, "".join(f"{photo} {2e6 + k} {1e6 - k} {400 + k}\n" for k, photo in enumerate(PHOTOS)))
    assert [choice.flags for choice in error.value.choices] == [
        {"position_columns": "image_name=1,x=2,y=3,z=4"},
        {"position_columns": "image_name=1,x=3,y=2,z=4"},
    ]


@pytest.mark.parametrize(
    ("header", "lost"),
    [
        ("timestamp_s,x_m,y_m,z_m", "2.0,nan,nan,nan"),
        ("timestamp_s,x_m,y_m,z_m", "2.0,,,"),
        ("Time,POSX,POSY,POSZ", "2.0,null,null,null"),
        ("timestamp_s,x_m,y_m,z_m,quality", "2.0,0,0,0,0"),
        ("t,Longitude,Latitude,Height", "2.0,0,0,0"),
    ],
)
def test_rows_without_a_fix_are_counted_and_left_out(tmp_path: Path, header: str, lost: str) -> None:
    more = ",4" * (header.count(",") - 3)
    rows = [f"{k}.0,{8 + 1e-5 * k},{47 + 1e-5 * k},3{more}" if k != 2 else lost for k in range(6)]
    found = read(tmp_path, "\n".join([header, *rows]) + "\n")
    assert found.moments.timestamp_s.tolist() == [0.0, 1.0, 3.0, 4.0, 5.0]
    assert np.isfinite(found.position_m).all()
    assert "positions.txt: 1 of 6 rows have no position (no fix) and are left out" in found.notes


def test_a_true_trajectory_may_have_gaps(tmp_path: Path) -> None:
    for name, text in (
        ("a.csv", "timestamp_s,x_m,y_m,z_m\n0,1,2,3\n1,nan,nan,nan\n2,4,5,6\n"),
        ("a.tum", "0 1 2 3 0 0 0 1\n1 nan nan nan 0 0 0 1\n2 4 5 6 0 0 0 1\n"),
    ):
        (tmp_path / name).write_text(text)
        found = read_true_positions(tmp_path / name)
        assert found.moments.timestamp_s.tolist() == [0.0, 2.0]
        assert found.notes == (f"{name}: 1 of 3 rows have no position and are left out",)


def test_true_positions_in_degrees_are_refused(tmp_path: Path) -> None:
    (tmp_path / "geo.txt").write_text("EPSG:4326\n" + by_photo("{photo} {x} {y} {z}"))
    with pytest.raises(InputError, match=r"geo\.txt: the positions are in EPSG:4326, expected metres"):
        read_true_positions(tmp_path / "geo.txt")
