"""Maps in other frames and on the Earth."""

from __future__ import annotations

import json
import sqlite3
import struct
import xml.etree.ElementTree as ET
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import laspy
import numpy as np
import numpy.typing as npt
import pycolmap
import pyproj
import pytest
from scipy.spatial.transform import Rotation
from tests.export.models import read_ply, xyz
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.colmap.transform import rescale
from rangesfm.errors import InputError
from rangesfm.export import OFFSET_NAME, MetricMap, export_map
from rangesfm.export.metric_map import colored_points, in_frame, moved, up_in_world
from rangesfm.options import ExportOptions
from rangesfm.util.geometry.georeference import Georeference, georeference_at
from rangesfm.util.geometry.similarity import Similarity

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey

Array = npt.NDArray[np.float64]

LAT_DEG, LON_DEG, HEIGHT_M = 47.4, 8.5, 430.0
ANCHORS = {"A1": np.array([3.0, -4.0, 2.0]), "Tür": np.array([-5.0, 1.0, 0.5])}


@pytest.fixture(scope="module")
def map_() -> MetricMap:
    """A walk in a metric world with z up, with the camera upright."""
    path = loop_path(20.0, start_s=0.0, seed=1)
    times = np.arange(20, dtype=np.float64)
    made = synthetic_model(*along(path, times), pixel_stddev=0.0, seed=2)
    model = rescale(made.reconstruction, made.metric_from_sfm)
    return MetricMap(model, made.timestamps_s, ANCHORS, made.metric_from_sfm, relative_scale_stddev=0.01)


def turned(map_: MetricMap, rotation_vector: list[float]) -> MetricMap:
    """Return the same map in a world that is tilted."""
    rotation = Rotation.from_rotvec(rotation_vector).as_matrix()
    askew = Similarity(1.0, rotation, np.array([1.0, 2.0, 3.0]))
    anchors = {name: askew.apply(at) for name, at in map_.anchors_m.items()}
    return replace(map_, reconstruction=rescale(map_.reconstruction, askew), anchors_m=anchors, metric_from_sfm=None)


def test_level_puts_up_up_and_the_first_camera_ahead(map_: MetricMap) -> None:
    askew = turned(map_, [0.7, -1.1, 0.4])
    true_up = Rotation.from_rotvec([0.7, -1.1, 0.4]).as_matrix() @ [0.0, 0.0, 1.0]
    level = in_frame(askew, ExportOptions(frame="level", up=",".join(map(str, true_up))))
    heights = np.diff(level.trajectory.centers[:, 2])
    np.testing.assert_allclose(heights, np.diff(map_.trajectory.centers[:, 2]), atol=1e-9)
    ahead = level.trajectory.world_from_cam[0][:, 2]
    assert ahead[0] == pytest.approx(0.0, abs=1e-12)
    assert ahead[1] > 0.5


def test_level_leaves_a_map_in_the_site_as_it_is_and_only_tilts_it_to_another_up(map_: MetricMap) -> None:
    in_site = replace(map_, is_site=True)
    level = in_frame(in_site, ExportOptions(frame="level"))
    np.testing.assert_allclose(level.trajectory.centers, map_.trajectory.centers, atol=1e-12)
    tilted = in_frame(in_site, ExportOptions(frame="level", up="0,0.1,1"))
    moved = tilted.trajectory.centers - map_.trajectory.centers
    np.testing.assert_allclose(moved[:, 0], 0.0, atol=1e-12)  # the shortest turn is about x
    assert np.abs(moved[:, 1]).max() > 0.01


def test_what_is_up_is_seen_by_the_cameras(map_: MetricMap) -> None:
    up = up_in_world(map_.trajectory, "cameras")
    assert np.rad2deg(np.arccos(up[2])) < 10


def test_in_a_site_frame_z_is_up(map_: MetricMap) -> None:
    tilted = turned(map_, [0.3, 0.0, 0.0])
    np.testing.assert_array_equal(up_in_world(tilted.trajectory, "auto", np.array([0.0, 0.0, 1.0])), [0, 0, 1])
    by_photos = up_in_world(tilted.trajectory, "cameras")
    np.testing.assert_array_equal(up_in_world(tilted.trajectory, "auto"), by_photos)


def test_what_is_up_is_across_a_flat_path(map_: MetricMap) -> None:
    flat = replace(map_.trajectory, centers=map_.trajectory.centers * [1.0, 1.0, 0.0])
    np.testing.assert_allclose(up_in_world(flat, "path"), [0, 0, 1], atol=1e-9)


IN_GRID_M = np.array([2_600_000.0, 1_200_000.0, 432.0])


@pytest.fixture(scope="module")
def in_grid(map_: MetricMap) -> MetricMap:
    """The same map in a site with the coordinates of a national grid."""
    return replace(moved(map_, Similarity(1.0, np.eye(3), IN_GRID_M)), is_site=True)


def nerfstudio_centers(path: Path) -> Array:
    return np.array([np.array(frame["transform_matrix"])[:3, 3] for frame in json.loads(path.read_text())["frames"]])


def test_trainers_with_32_bits_get_a_map_near_its_origin_and_its_offset(in_grid: MetricMap, tmp_path: Path) -> None:
    nerfstudio, tum = export_map(in_grid, tmp_path, ExportOptions(formats=("nerfstudio", "tum")))
    centers, true_m = nerfstudio_centers(nerfstudio), in_grid.trajectory.centers
    offset_m = np.loadtxt(tmp_path / OFFSET_NAME)
    np.testing.assert_array_equal(offset_m, np.round(offset_m))
    np.testing.assert_allclose(centers.astype(np.float32).astype(np.float64) + offset_m, true_m, rtol=0, atol=1e-5)
    assert (tmp_path / OFFSET_NAME).read_text().splitlines()[0].endswith("in transforms.json, transforms_points.ply")
    points = xyz(read_ply(tmp_path / "transforms_points.ply"))
    np.testing.assert_allclose(points + offset_m, colored_points(in_grid.reconstruction)[0], rtol=0, atol=1e-5)
    # Formats with 64 bits keep the coordinates of the site.
    np.testing.assert_allclose(np.loadtxt(tum)[:, 1:4], true_m, rtol=0, atol=1e-6)


def test_a_level_map_far_from_the_sites_zero_is_near_its_own_in_all_formats(in_grid: MetricMap, tmp_path: Path) -> None:
    formats = ("nerfstudio", "tum", "colmap", "transform")
    nerfstudio, tum, colmap, transform, _ = export_map(in_grid, tmp_path, ExportOptions(formats=formats, frame="level"))
    offset_m, true_m = np.loadtxt(tmp_path / OFFSET_NAME), in_grid.trajectory.centers
    model = pycolmap.Reconstruction(colmap)
    of_colmap = np.array(
        [model.find_image_with_name(name).projection_center() for name in in_grid.trajectory.image_names]
    )
    for centers in (nerfstudio_centers(nerfstudio), np.loadtxt(tum)[:, 1:4], of_colmap):
        np.testing.assert_allclose(centers + offset_m, true_m, rtol=0, atol=1e-6)
    assert in_grid.metric_from_sfm is not None
    found, expected = np.loadtxt(transform)[5:], in_grid.metric_from_sfm.translation
    np.testing.assert_allclose(found + offset_m, expected, rtol=0, atol=1e-6)


def test_a_map_near_its_origin_stays_where_it_is_and_corrects_the_offset_of_an_earlier_one(
    map_: MetricMap, in_grid: MetricMap, tmp_path: Path
) -> None:
    options = ExportOptions(formats=("nerfstudio",), frame="level")
    (path,) = export_map(replace(map_, is_site=True), tmp_path, options)
    np.testing.assert_allclose(nerfstudio_centers(path), map_.trajectory.centers, rtol=0, atol=1e-9)
    assert not (tmp_path / OFFSET_NAME).exists()
    export_map(in_grid, tmp_path, options)
    export_map(replace(map_, is_site=True), tmp_path, options)
    np.testing.assert_array_equal(np.loadtxt(tmp_path / OFFSET_NAME), np.zeros(3))


@pytest.mark.parametrize("up", ["sideways", "1,2", "0,0,0", "nan,0,1"])
def test_nonsense_is_not_up(up: str, map_: MetricMap) -> None:
    with pytest.raises(InputError, match="expected auto, cameras, path or a direction"):
        up_in_world(map_.trajectory, up)


def test_a_path_through_space_has_no_plane(map_: MetricMap) -> None:
    rng = np.random.default_rng(0)
    tangled = replace(map_.trajectory, centers=rng.normal(size=(len(map_.trajectory), 3)))
    with pytest.raises(InputError, match="does not lie in a plane"):
        up_in_world(tangled, "path")


def test_a_map_without_a_place_cannot_leave_for_the_earth(map_: MetricMap, tmp_path: Path) -> None:
    for options in (ExportOptions(frame="enu"), ExportOptions(formats=("gpkg",))):
        with pytest.raises(InputError, match="georeference"):
            export_map(map_, tmp_path, options)
    with pytest.raises(InputError, match="origin_anchor needs"):
        export_map(map_, tmp_path, ExportOptions(frame="enu", origin_anchor="A1"))
    with pytest.raises(InputError, match="origin_anchor is 'A9', expected one with a position: A1, Tür"):
        export_map(map_, tmp_path, ExportOptions(frame="enu", origin_anchor="A9"))


def enu_by_hand(geographic: Array) -> Array:
    """Convert longitude, latitude and height to east, north and up by the textbook: geocentric, then rotated."""
    to_cartesian = pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True)
    xyz = np.column_stack(to_cartesian.transform(*geographic.T))
    origin = np.array(to_cartesian.transform(LON_DEG, LAT_DEG, HEIGHT_M))
    lat, lon = np.deg2rad([LAT_DEG, LON_DEG])
    east = [-np.sin(lon), np.cos(lon), 0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    up = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    enu: Array = (xyz - origin) @ np.array([east, north, up]).T
    return enu


@pytest.mark.parametrize("crs", ["EPSG:2056", "EPSG:32632", "EPSG:4979", "EPSG:4326"])
def test_points_on_the_earth_are_where_geodesy_puts_them(crs: str) -> None:
    georeference = Georeference(LAT_DEG, LON_DEG, HEIGHT_M, crs)
    points = np.random.default_rng(0).uniform(-300, 300, size=(40, 3))
    np.testing.assert_allclose(enu_by_hand(georeference.geographic(points)), points, atol=1e-4)
    system = pyproj.CRS(crs).to_3d()
    to_geographic = pyproj.Transformer.from_crs(system, "EPSG:4979", always_xy=True)
    back = np.column_stack(to_geographic.transform(*georeference.projected(points).T))
    np.testing.assert_allclose(enu_by_hand(back), points, atol=1e-4)


def test_anchors_in_a_national_grid_keep_their_millimetres_and_true_lengths() -> None:
    grid = np.array([[2_683_000.0, 1_249_000.0, 430.0], [2_683_040.0, 1_249_000.0, 431.0], [np.nan] * 3])
    georeference, local = georeference_at(grid, "EPSG:2056")
    assert np.abs(local[:2]).max() < 50
    assert np.isnan(local[2]).all()
    np.testing.assert_allclose(georeference.projected(local[:2]), grid[:2], atol=1e-4)
    geod = pyproj.Geod(ellps="WGS84")
    lon, lat, _ = georeference.geographic(local[:2]).T
    # lengths grow with the height above the ellipsoid
    true_m = geod.inv(lon[0], lat[0], lon[1], lat[1])[2] * (1 + 480 / 6.38e6)
    assert np.hypot(*(local[0] - local[1])[:2]) == pytest.approx(true_m, abs=2e-3)


def test_an_unknown_system_and_swapped_coordinates_are_refused() -> None:
    with pytest.raises(InputError, match="unknown coordinate system 'EPSG:99999999'"):
        georeference_at(np.zeros((1, 3)), "EPSG:99999999")
    with pytest.raises(InputError, match="lie outside the area in which EPSG:32632 is valid"):
        georeference_at(np.array([[1e30, 5.2e6, 0.0]]), "EPSG:32632")


@pytest.mark.parametrize("heading_deg", [0.0, 90.0, 213.0])
def test_one_anchor_and_a_heading_place_the_map(heading_deg: float, map_: MetricMap) -> None:
    options = ExportOptions(
        frame="enu",
        up="0,0,1",
        origin_anchor="A1",
        origin_lat_lon_height=(LAT_DEG, LON_DEG, HEIGHT_M),
        heading_deg=heading_deg,
    )
    enu = in_frame(turned(map_, [0.0, 0.0, 1.0]), options)
    np.testing.assert_allclose(enu.anchors_m["A1"], 0, atol=1e-9)
    ahead = enu.trajectory.world_from_cam[0][:, 2]
    assert np.rad2deg(np.arctan2(ahead[0], ahead[1])) % 360 == pytest.approx(heading_deg)
    apart = np.linalg.norm(enu.anchors_m["Tür"] - enu.anchors_m["A1"])
    assert apart == pytest.approx(np.linalg.norm(ANCHORS["Tür"] - ANCHORS["A1"]))


@pytest.fixture(scope="module")
def on_earth(map_: MetricMap) -> MetricMap:
    return replace(map_, georeference=Georeference(LAT_DEG, LON_DEG, HEIGHT_M, "EPSG:2056"))


def test_laz_is_read_by_laspy_with_its_system(on_earth: MetricMap, tmp_path: Path) -> None:
    (path,) = export_map(on_earth, tmp_path, ExportOptions(formats=("laz",)))
    las = laspy.read(path)
    model = on_earth.reconstruction
    points = np.array([model.point3D(i).xyz for i in sorted(model.point3D_ids())])
    assert on_earth.georeference is not None
    np.testing.assert_allclose(las.xyz, on_earth.georeference.projected(points), atol=6e-5)
    assert las.header.parse_crs().to_epsg() == 2056
    colors = np.array([model.point3D(i).color for i in sorted(model.point3D_ids())])
    np.testing.assert_array_equal(np.column_stack([las.red, las.green, las.blue]) // 257, colors)


def test_laz_without_a_place_is_in_the_maps_own_metres(map_: MetricMap, tmp_path: Path) -> None:
    (path,) = export_map(map_, tmp_path, ExportOptions(formats=("laz",)))
    model = map_.reconstruction
    points = np.array([model.point3D(i).xyz for i in sorted(model.point3D_ids())])
    las = laspy.read(path)
    np.testing.assert_allclose(las.xyz, points, atol=6e-5)
    assert las.header.parse_crs() is None


def places_of(map_: MetricMap) -> dict[str, Array]:
    named = dict(zip(map_.trajectory.image_names, map_.trajectory.centers, strict=True))
    return {**named, **map_.anchors_m}


def test_geojson_holds_longitude_and_latitude(on_earth: MetricMap, tmp_path: Path) -> None:
    (path,) = export_map(on_earth, tmp_path, ExportOptions(formats=("geojson",)))
    features = json.loads(path.read_text(encoding="utf-8"))["features"]
    places = places_of(on_earth)
    assert [f["properties"]["name"] for f in features] == list(places)
    assert sum(f["properties"]["kind"] == "anchor" for f in features) == 2
    read = np.array([feature["geometry"]["coordinates"] for feature in features])
    np.testing.assert_allclose(enu_by_hand(read), list(places.values()), atol=2e-4)


def test_kml_is_xml_with_the_same_places(on_earth: MetricMap, tmp_path: Path) -> None:
    (path,) = export_map(on_earth, tmp_path, ExportOptions(formats=("kml",)))
    texts = [element.text for element in ET.parse(path).iter() if element.tag.endswith("coordinates")]
    read = np.array([[float(number) for number in (text or "").split(",")] for text in texts])
    np.testing.assert_allclose(enu_by_hand(read), list(places_of(on_earth).values()), atol=1e-3)


def test_geopackage_is_a_database_of_points_in_the_maps_system(on_earth: MetricMap, tmp_path: Path) -> None:
    (path,) = export_map(on_earth, tmp_path, ExportOptions(formats=("gpkg",), crs="EPSG:32632"))
    with closing(sqlite3.connect(path)) as database:
        rows = database.execute("select name, geom from survey").fetchall()
        (system,) = database.execute("select srs_id from gpkg_geometry_columns").fetchone()
    assert system == 32632
    places = places_of(on_earth)
    assert [name for name, _ in rows] == list(places)
    # A GeoPackage point ends with its well-known binary, which ends with three doubles.
    read = np.array([struct.unpack("<3d", blob[-24:]) for _, blob in rows])
    assert on_earth.georeference is not None
    expected = replace(on_earth.georeference, crs="EPSG:32632").projected(np.array(list(places.values())))
    np.testing.assert_allclose(read, expected, atol=1e-6)


def test_the_map_itself_is_not_touched(on_earth: MetricMap, tmp_path: Path) -> None:
    before = pycolmap.Reconstruction(on_earth.reconstruction)
    export_map(on_earth, tmp_path, ExportOptions(formats=("ply",), frame="enu"))
    for point_id, point in before.points3D.items():
        np.testing.assert_array_equal(on_earth.reconstruction.point3D(point_id).xyz, point.xyz)


def test_photos_that_do_not_lean_to_either_side_of_a_flat_path_do_not_say_which_is_up(map_: MetricMap) -> None:
    """Rounding would decide which side of the path is up if all photos point straight down."""
    down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    path = map_.trajectory
    headings = Rotation.from_rotvec(np.arange(len(path))[:, None] * [0.0, 0.0, 0.3]).as_matrix()
    flight = replace(path, centers=path.centers * [1.0, 1.0, 0.0], world_from_cam=headings @ down)
    with pytest.raises(InputError, match=r"do not say which side of the path's plane is up.*--up X,Y,Z"):
        up_in_world(flight, "path")


def test_a_run_levels_by_the_upward_direction_that_it_was_given_as_an_export_of_its_result_does(
    walked_survey: WalkedSurvey, rangesfm_command: Command, tmp_path: Path
) -> None:
    """The given direction is not that of the photos, which were held level."""
    flags = (*walked_survey.flags, "--anchor_frame", "unknown", "--up_in_first_camera", "0.5,-1,0", "--no_report")
    level = ("--formats", "tum", "--export_frame", "level", "--output_path", tmp_path / "out")
    rangesfm_command("scale", *flags, *level, cwd=walked_survey.folder)
    rangesfm_command("export", "out", "--formats", "tum", "--frame", "level", "--output_path", "again", cwd=tmp_path)
    of_run, of_export = (np.loadtxt(tmp_path / name / "trajectory.tum") for name in ("out", "again"))
    np.testing.assert_allclose(of_run, of_export, atol=1e-6)
