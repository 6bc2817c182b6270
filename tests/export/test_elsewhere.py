"""Exports to other reconstruction programs: read by their rules, they hold the same cameras and points."""

from __future__ import annotations

import errno
import itertools
import json
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from PIL import Image
from pyopf.io import load as load_opf
from pyopf.resolve import resolve
from scipy.spatial.transform import Rotation
from tests.export.models import centers_of, read_ply, synthesized, xyz

from rangesfm.errors import InputError
from rangesfm.export import COVARIANCE_FORMATS, EXPORTERS, OFFSET_NAME, MetricMap, export_map
from rangesfm.options import ExportOptions

Array = npt.NDArray[np.float64]
Centers = dict[str, Array]

NEAR = np.array([1000.0, -2000.0, 300.0])


def made(camera_model: str = "OPENCV") -> pycolmap.Reconstruction:
    params = {
        "PINHOLE": [500.0, 510.0, 310.0, 245.0],
        "SIMPLE_RADIAL": [500.0, 310.0, 245.0, 0.03],
        "OPENCV": [500.0, 510.0, 310.0, 245.0, 0.02, -0.01, 1e-3, -2e-3],
        "OPENCV_FISHEYE": [500.0, 510.0, 310.0, 245.0, 0.02, -0.01, 1e-3, -2e-3],
        "FOV": [500.0, 510.0, 310.0, 245.0, 0.1],
    }[camera_model]
    camera = {"camera_model_id": pycolmap.CameraModelId.__members__[camera_model], "camera_params": params}
    model = synthesized(6, 60, seed=3, **camera, camera_width=640, camera_height=480)
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), NEAR))
    return model


def export(model: pycolmap.Reconstruction, name: str, folder: Path, images_path: Path | None = None) -> Path:
    map_ = MetricMap(model, relative_scale_stddev=0.02, images_path=images_path)
    (path,) = export_map(map_, folder, ExportOptions(formats=(name,)))
    return path


def load(path: Path) -> Any:
    return json.loads(path.read_text(encoding="utf-8"))


def opensfm_center(shot: dict[str, Any]) -> Array:
    turn = Rotation.from_rotvec(shot["rotation"]).as_matrix()
    center: Array = -turn.T @ np.array(shot["translation"])
    return center


def nerfstudio_centers(path: Path) -> Centers:
    frames = load(path)["frames"]
    return {frame["file_path"].removeprefix("images/"): np.array(frame["transform_matrix"])[:3, 3] for frame in frames}


def kitti_centers(path: Path, names: list[str]) -> Centers:
    return dict(zip(names, np.loadtxt(path).reshape(-1, 3, 4)[:, :, 3], strict=True))


def tum_centers(path: Path, names: list[str]) -> Centers:
    return dict(zip(names, np.loadtxt(path)[:, 1:4], strict=True))


def positions_centers(path: Path) -> Centers:
    rows = [line.split() for line in path.read_text().splitlines()]
    return {name: np.array(numbers, dtype=np.float64) for name, *numbers in rows}


@pytest.mark.parametrize("shift", [np.zeros(3), np.array([2_600_000.0, 1_200_000.0, 400.0])], ids=["near", "far away"])
def test_distances_between_cameras_agree_between_all_formats(shift: Array, tmp_path: Path) -> None:
    model = made()
    model.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), shift))
    names = sorted(image.name for image in model.images.values())
    paths = {name: export(model, name, tmp_path) for name in EXPORTERS if name not in NEED_MORE}
    read: dict[str, Centers] = {
        "colmap": centers_of(pycolmap.Reconstruction(paths["colmap"])),
        "colmap_text": centers_of(pycolmap.Reconstruction(paths["colmap_text"])),
        "tum": tum_centers(paths["tum"], names),
        "ply_cameras": dict(zip(names, xyz(read_ply(paths["ply_cameras"])), strict=True)),
        "kitti": kitti_centers(paths["kitti"], names),
        "model_aligner": positions_centers(paths["model_aligner"]),
        "nerfstudio": nerfstudio_centers(paths["nerfstudio"]),
        "opensfm": {name: opensfm_center(shot) for name, shot in load(paths["opensfm"])[0]["shots"].items()},
    }
    expected = centers_of(model)
    for centers in read.values():
        for first, second in itertools.combinations(names, 2):
            found, true = (np.linalg.norm(c[first] - c[second]) for c in (centers, expected))
            assert found == pytest.approx(true, rel=1e-6)


# Formats that hold no cameras, or that need photos, their database or a place on the Earth.
NEED_MORE = {
    *COVARIANCE_FORMATS,
    "undistorted",
    "ply",
    "ply_anchors",
    "laz",
    "gpkg",
    "geojson",
    "kml",
    "transform",
    "opf",
    "pose_priors",
}


@pytest.mark.parametrize("camera_model", ["PINHOLE", "SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_nerfstudio_projects_points_where_colmap_does(camera_model: str, tmp_path: Path) -> None:
    model = made(camera_model)
    content = load(export(model, "nerfstudio", tmp_path))
    assert (tmp_path / content["ply_file_path"]).is_file()
    assert content["camera_model"] == ("OPENCV_FISHEYE" if camera_model == "OPENCV_FISHEYE" else "OPENCV")
    for frame in content["frames"]:
        image = model.find_image_with_name(frame["file_path"].removeprefix("images/"))
        assert image is not None
        world_from_gl = np.array(frame["transform_matrix"])
        world_from_gl[:3, 3] += np.loadtxt(tmp_path / OFFSET_NAME)
        for point in itertools.islice(image.points2D, 5):
            if point.has_point3D():
                xyz = model.point3D(point.point3D_id).xyz
                in_gl = np.linalg.solve(world_from_gl, [*xyz, 1.0])[:3]
                assert in_gl[2] < 0
                at = opencv_projection({**content, **frame}, in_gl * [1, -1, -1])
                expected = image.project_point(xyz)
                assert expected is not None
                np.testing.assert_allclose(at, expected, atol=1e-6)


def test_nerfstudio_gets_copies_of_the_photos_that_it_names(tmp_path: Path) -> None:
    model, photos = made(), tmp_path / "photos"
    for image in model.images.values():
        image.name = f"left/{image.name}"
        (photos / image.name).parent.mkdir(parents=True, exist_ok=True)
        (photos / image.name).write_text(image.name)
    for _ in range(2):  # the second export replaces the first
        path = export(model, "nerfstudio", tmp_path / "out", photos)
    for frame in load(path)["frames"]:
        copied = path.parent / frame["file_path"]
        assert copied.read_text() == frame["file_path"].removeprefix("images/")
        assert copied.stat().st_nlink == 1
    (path.parent / "images" / "left" / "own.jpg").touch()
    with pytest.raises(InputError, match=r"own\.jpg: is not a file that rangesfm wrote"):
        export(model, "nerfstudio", tmp_path / "out", photos)
    next((photos / "left").iterdir()).unlink()
    with pytest.raises(InputError, match="is not in this folder"):
        export(model, "nerfstudio", tmp_path / "elsewhere", photos)
    assert not list((tmp_path / "elsewhere").iterdir())


def test_nerfstudio_export_beside_the_photos_leaves_them_as_they_are(tmp_path: Path) -> None:
    model = made()
    (tmp_path / "images").mkdir()
    for image in model.images.values():
        (tmp_path / "images" / image.name).write_text(image.name)
    path = export(model, "nerfstudio", tmp_path, tmp_path / "images")
    assert all((tmp_path / frame["file_path"]).is_file() for frame in load(path)["frames"])


def of_two_cameras(first: str, second: str) -> pycolmap.Reconstruction:
    """Twelve photos, six of each camera."""
    model = synthesized(6, 60, seed=3, num_rigs=2)
    for camera, name, focal_length in zip(model.cameras.values(), (first, second), (500.0, 700.0)):
        camera.model = pycolmap.CameraModelId.__members__[name]
        camera.params = [focal_length, focal_length, 310.0, 245.0, 0.02, -0.01, 1e-3, -2e-3]
    return model


def test_nerfstudio_is_told_of_every_camera(tmp_path: Path) -> None:
    content = load(export(of_two_cameras("OPENCV_FISHEYE", "OPENCV_FISHEYE"), "nerfstudio", tmp_path))
    assert content["camera_model"] == "OPENCV_FISHEYE"
    # Intrinsics at the top level would apply to all frames.
    assert not {"fl_x", "fl_y", "cx", "cy", "w", "h", "k1", "k2", "k3", "p1", "p2"} & content.keys()
    assert sorted(frame["fl_x"] for frame in content["frames"]) == [500.0] * 6 + [700.0] * 6
    assert not any("camera_model" in frame for frame in content["frames"])


def test_nerfstudio_has_no_place_for_fisheyes_beside_others(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="one camera model for all photos"):
        export(of_two_cameras("OPENCV", "OPENCV_FISHEYE"), "nerfstudio", tmp_path)
    assert not list(tmp_path.iterdir())


def opencv_projection(frame: dict[str, Any], xyz: Array) -> Array:
    """Project a point with the formulas of OpenCV's documentation of its two camera models."""
    x, y = xyz[:2] / xyz[2]
    r2 = x * x + y * y
    k1, k2, k3, k4 = (frame.get(name, 0.0) for name in ("k1", "k2", "k3", "k4"))
    if frame["camera_model"] == "OPENCV_FISHEYE":
        radius = np.sqrt(r2)
        theta = np.arctan(radius)
        bent = theta * (1 + k1 * theta**2 + k2 * theta**4 + k3 * theta**6 + k4 * theta**8)
        x, y = bent / radius * x, bent / radius * y
    else:
        p1, p2 = frame.get("p1", 0.0), frame.get("p2", 0.0)
        radial = 1 + k1 * r2 + k2 * r2**2
        x, y = (
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        )
    return np.array([frame["fl_x"] * x + frame["cx"], frame["fl_y"] * y + frame["cy"]])


def test_opensfm_keeps_points_cameras_and_shots(tmp_path: Path) -> None:
    model = made()
    (content,) = load(export(model, "opensfm", tmp_path))
    camera = next(iter(content["cameras"].values()))
    assert camera["projection_type"] == "brown"
    assert [camera[key] * 640 for key in ("focal_x", "focal_y")] == pytest.approx([500.0, 510.0])
    assert [camera[key] * 640 for key in ("c_x", "c_y")] == pytest.approx([-10.0, 5.0])
    assert (camera["k1"], camera["k2"], camera["k3"], camera["p1"], camera["p2"]) == (0.02, -0.01, 0.0, 1e-3, -2e-3)
    assert content["shots"].keys() == {image.name for image in model.images.values()}
    for point_id, point in content["points"].items():
        np.testing.assert_array_equal(point["coordinates"], model.point3D(int(point_id)).xyz)


def test_scale_constraints_are_distances_of_the_map_between_points_that_are_marked(tmp_path: Path) -> None:
    model = made("PINHOLE")
    folder = export(model, "opf", tmp_path)
    constraints = load(folder / "constraints.json")
    control = load(folder / "input_control_points.json")
    cameras = {camera["id"]: camera["uri"] for camera in load(folder / "camera_list.json")["cameras"]}
    assert constraints["format"] == "application/opf-constraints+json"
    assert len(cameras) == model.num_images()
    marks = {point["id"]: point["marks"] for point in control["mtps"]}
    assert len(constraints["scale_constraints"]) == 10
    for constraint in constraints["scale_constraints"]:
        ends = [triangulated(model, marks[constraint[key]], cameras) for key in ("id_from", "id_to")]
        length = float(np.linalg.norm(ends[0] - ends[1]))
        assert constraint["distance"] == pytest.approx(length, rel=1e-6)
        assert constraint["sigma"] == pytest.approx(0.02 * length, rel=1e-6)


def test_the_formats_own_library_opens_the_project(tmp_path: Path) -> None:
    folder = export(made(), "opf", tmp_path)
    project = resolve(load_opf(folder / "project.opf"))
    constraints, control, cameras = project.constraints, project.input_control_points, project.camera_list
    points, photos = {point.id for point in control.mtps}, {camera.id for camera in cameras.cameras}
    assert len(cameras.cameras) == 6
    assert len(constraints.scale_constraints) == 10
    for constraint in constraints.scale_constraints:
        assert {constraint.id_from, constraint.id_to} <= points
    assert {mark.camera_id for point in control.mtps for mark in point.marks} <= photos


def triangulated(model: pycolmap.Reconstruction, marks: list[dict[str, Any]], cameras: dict[int, str]) -> Array:
    images = [model.find_image_with_name(cameras[mark["camera_id"]]) for mark in marks]
    rays = [
        model.cameras[image.camera_id].cam_from_img(np.array(mark["position_px"]))
        for image, mark in zip(images, marks, strict=True)
        if image is not None
    ]
    bearings = np.array([[*ray, 1.0] for ray in rays if ray is not None])
    poses = [image.cam_from_world().matrix() for image in images if image is not None]
    for pose in poses:  # move the origin near the cameras: the linear triangulation needs that
        pose[:, 3] += pose[:, :3] @ NEAR
    point = pycolmap.triangulate_multi_view_point(poses, bearings / np.linalg.norm(bearings, axis=1)[:, None])
    assert point is not None
    return np.ravel(point)


def test_undistorted_photos_come_with_a_metric_model_in_sparse_0(tmp_path: Path) -> None:
    model = made()
    photos = tmp_path / "photos"
    photos.mkdir()
    for image in model.images.values():
        Image.new("RGB", (640, 480), (90, 120, 30)).save(photos / image.name)
    folder = export(model, "undistorted", tmp_path / "out", photos)
    assert sorted(path.name for path in folder.iterdir()) == ["images", "sparse"]
    read = pycolmap.Reconstruction(folder / "sparse" / "0")
    assert {camera.model.name for camera in read.cameras.values()} == {"PINHOLE"}
    for name, center in centers_of(model).items():
        offset_m = np.loadtxt(folder.parent / OFFSET_NAME)
        np.testing.assert_allclose(centers_of(read)[name] + offset_m, center, rtol=1e-12)
        with Image.open(folder / "images" / name) as photo:
            camera = next(iter(read.cameras.values()))
            assert photo.size == (camera.width, camera.height)


@pytest.mark.parametrize("name", ["../up.jpg", "/abs.jpg", "a/../../up.jpg"])
def test_a_photo_is_not_written_outside_the_folder(name: str, tmp_path: Path) -> None:
    model = made()
    next(iter(model.images.values())).name = name
    with pytest.raises(InputError, match="would be written outside"):
        export(model, "undistorted", tmp_path / "out", tmp_path)


def test_photos_that_have_no_room_are_not_begun(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = made()
    for image in model.images.values():
        Image.new("RGB", (640, 480)).save(tmp_path / image.name)
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=1000))
    with pytest.raises(OSError, match=os.strerror(errno.ENOSPC)):
        export(model, "undistorted", tmp_path / "out", tmp_path)
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.parametrize(
    ("name", "camera_model", "said"),
    [
        ("nerfstudio", "FOV", "nerfstudio does not know the camera model FOV"),
        ("opensfm", "FOV", "OpenSfM does not know the camera model FOV"),
        ("undistorted", "OPENCV", "needs the photos"),
    ],
)
def test_what_a_format_cannot_hold_is_said(name: str, camera_model: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=said):
        export(made(camera_model), name, tmp_path)


def test_laz_without_what_compresses_it_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("laspy.LazBackend.detect_available", lambda: ())
    with pytest.raises(InputError, match=r"needs lazrs besides laspy: pip install '\.\[geo\]' in a clone"):
        export(made(), "laz", tmp_path)
    assert not list(tmp_path.iterdir())


def test_missing_photos_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"the photo camera.* of the map is not in this folder"):
        export(made(), "undistorted", tmp_path / "out", tmp_path)
    assert not (tmp_path / "out" / "undistorted").exists()
