"""Exports, read back by other readers, have the same content."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from tests.export.models import centers_of, read_ply, synthesized, xyz
from tests.outputs import names_in, paths_in
from tests.result_document import anchor_entry, result_document

from rangesfm.errors import InputError
from rangesfm.export import (
    COVARIANCE_FORMATS,
    EXPORTED_NAMES,
    EXPORTERS,
    OFFSET_NAME,
    export_model,
    write_camera_positions,
)
from rangesfm.export.colmap import write_model
from rangesfm.pipeline.export_result import export_result
from rangesfm.util.geometry.similarity import Similarity

FAR_AWAY = np.array([2_600_000.0, 1_200_000.0, 400.0])
METRIC_FROM_SFM = Similarity(0.37, Rotation.from_rotvec([0.1, -0.7, 2.5]).as_matrix(), np.array([1 / 3, -2e5, 1e-7]))
ANCHORS = {"A1": np.array([1.0, 2.0, 3.0]), "Tür 2": FAR_AWAY}


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    """A model far from its origin, as in a national grid."""
    reconstruction = synthesized(7, 80, seed=1)
    reconstruction.transform(pycolmap.Sim3d(3.0, pycolmap.Rotation3d(), FAR_AWAY))
    for index, point in enumerate(reconstruction.points3D.values()):
        point.color = np.array([index, 255 - index, 7], dtype=np.uint8)
    return reconstruction


def times_of(model: pycolmap.Reconstruction) -> dict[str, float]:
    """Times one second apart, in reverse order of the names."""
    names = sorted((image.name for image in model.images.values()), reverse=True)
    return {name: 1.7e9 + i for i, name in enumerate(names)}


@pytest.mark.parametrize("name", ["colmap", "colmap_text"])
def test_colmap_models_are_read_back_whole(tmp_path: Path, model: pycolmap.Reconstruction, name: str) -> None:
    write_model(model, tmp_path / name, as_text=name == "colmap")  # an older one in the other form
    (path,) = export_model(model, [name], tmp_path)
    read = pycolmap.Reconstruction(path)
    assert {file.suffix for file in paths_in(path)} == {".txt" if name == "colmap_text" else ".bin"}
    assert read.num_points3D() == model.num_points3D()
    assert read.compute_mean_reprojection_error() == pytest.approx(model.compute_mean_reprojection_error())
    for image_name, center in centers_of(model).items():
        np.testing.assert_allclose(centers_of(read)[image_name], center, rtol=1e-14)


def test_the_tum_trajectory_holds_world_from_camera_in_order_of_time(
    tmp_path: Path, model: pycolmap.Reconstruction
) -> None:
    times = times_of(model)
    (path,) = export_model(model, ["tum"], tmp_path, timestamps_s=times)
    rows = np.loadtxt(path)
    assert np.all(np.diff(rows[:, 0]) == 1.0)
    for name, time in times.items():
        (row,) = rows[rows[:, 0] == time]
        image = model.find_image_with_name(name)
        assert image is not None
        world_from_cam = image.cam_from_world().inverse()
        np.testing.assert_allclose(row[1:4], world_from_cam.translation, rtol=0, atol=1e-8)
        np.testing.assert_allclose(
            Rotation.from_quat(row[4:]).as_matrix(), world_from_cam.rotation.matrix(), atol=1e-10
        )


def test_a_tum_trajectory_without_times_counts_and_says_so(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    (path,) = export_model(model, ["tum"], tmp_path)
    np.testing.assert_array_equal(np.loadtxt(path)[:, 0], range(7))
    assert any(line.startswith("#") and "no times" in line for line in path.read_text().splitlines())


def test_ply_points_keep_their_place_and_colour(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    (path,) = export_model(model, ["ply"], tmp_path)
    vertices = read_ply(path)
    ids = sorted(model.point3D_ids())
    np.testing.assert_array_equal(xyz(vertices), [model.point3D(i).xyz for i in ids])
    colors = np.column_stack([vertices[name] for name in ("red", "green", "blue")])
    np.testing.assert_array_equal(colors, [model.point3D(i).color for i in ids])


def test_ply_points_are_read_by_colmap(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    (path,) = export_model(model, ["ply"], tmp_path)
    read = pycolmap.Reconstruction()
    read.import_PLY(path)
    assert read.num_points3D() == model.num_points3D()


def test_ply_cameras_look_where_the_cameras_look(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    (path,) = export_model(model, ["ply_cameras"], tmp_path)
    vertices = read_ply(path)
    images = sorted(model.images.values(), key=lambda image: image.name)
    np.testing.assert_allclose(xyz(vertices), [image.projection_center() for image in images], rtol=0, atol=1e-8)
    normals = np.column_stack([vertices[name] for name in ("nx", "ny", "nz")])
    np.testing.assert_allclose(normals, [image.viewing_direction() for image in images], atol=1e-6)


def test_ply_anchors_are_named_in_a_comment(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    (path,) = export_model(model, ["ply_anchors"], tmp_path, anchors_m=ANCHORS)
    np.testing.assert_array_equal(xyz(read_ply(path)), list(ANCHORS.values()))
    assert b"comment anchors A1 T\\xfcr 2\n" in path.read_bytes()


def test_an_empty_model_gives_empty_files(tmp_path: Path) -> None:
    paths = export_model(pycolmap.Reconstruction(), ["ply", "ply_cameras", "ply_anchors", "tum"], tmp_path)
    assert [len(read_ply(path)) for path in paths[:3]] == [0, 0, 0]
    assert all(line.startswith("#") for line in paths[3].read_text().splitlines())


def test_the_transform_carries_the_unscaled_model_to_the_metric_one(
    tmp_path: Path, model: pycolmap.Reconstruction
) -> None:
    with pytest.raises(InputError, match="'transform' needs metric_from_sfm"):
        export_model(model, ["transform"], tmp_path)
    line, matrix = export_model(model, ["transform"], tmp_path, metric_from_sfm=METRIC_FROM_SFM)
    assert [line.name, matrix.name] == ["transform_colmap_4.txt", "transform_colmap_3.8.txt"]
    scale, qw, qx, qy, qz, *translation = map(float, line.read_text().split())
    assert scale == METRIC_FROM_SFM.scale
    np.testing.assert_array_equal(translation, METRIC_FROM_SFM.translation)
    moved = pycolmap.Reconstruction(model)
    moved.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(np.array([qx, qy, qz, qw])), np.array(translation)))
    for name, center in centers_of(model).items():
        expected = METRIC_FROM_SFM.apply(center)
        np.testing.assert_allclose(centers_of(moved)[name], expected, rtol=1e-12)
        np.testing.assert_allclose(np.loadtxt(matrix) @ [*center, 1.0], [*expected, 1.0], rtol=1e-12)


def test_model_aligner_positions_are_those_of_the_photos(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    (path,) = export_model(model, ["model_aligner"], tmp_path)
    lines = [line.split() for line in path.read_text().splitlines()]
    assert {name: tuple(map(float, position)) for name, *position in lines} == {
        name: tuple(center) for name, center in centers_of(model).items()
    }


def test_a_name_that_colmap_would_split_is_refused(tmp_path: Path, model: pycolmap.Reconstruction) -> None:
    next(iter(model.images.values())).name = "my photo.jpg"
    with pytest.raises(InputError, match=r"'my photo\.jpg'"):
        write_camera_positions(model, tmp_path / "positions.txt")
    assert list(tmp_path.iterdir()) == []


def test_an_unknown_format_is_named_with_the_known_ones_before_anything_is_written(
    tmp_path: Path, model: pycolmap.Reconstruction
) -> None:
    with pytest.raises(InputError, match=r"'las'.*colmap.*tum.*ply.*transform") as error:
        export_model(model, ["tum", "las"], tmp_path / "out")
    assert error.value.exit_status == 2
    assert not (tmp_path / "out").exists()


def write_photos(folder: Path, model: pycolmap.Reconstruction) -> Path:
    folder.mkdir()
    for image in model.images.values():
        camera = model.cameras[image.camera_id]
        Image.new("RGB", (camera.width, camera.height), (90, 120, 30)).save(folder / image.name)
    return folder


def write_result(folder: Path, model: pycolmap.Reconstruction, *, is_refined: bool) -> None:
    for name in ("sparse_scaled", "sparse_metric") if is_refined else ("sparse_scaled",):
        shifted = pycolmap.Reconstruction(model)
        shift = np.array([1000.0 if name == "sparse_scaled" else 0.0, 0.0, 0.0])
        shifted.transform(pycolmap.Sim3d(1.0, pycolmap.Rotation3d(), shift))
        (folder / name / "0").mkdir(parents=True)
        shifted.write_binary(folder / name / "0")
    rows = [f"{name},{time}" for name, time in times_of(model).items()]
    (folder / "images.csv").write_text("\n".join(["image_name,timestamp_s", *rows]))
    if is_refined:
        axes = ("xx", "xy", "xz", "yy", "yz", "zz")
        header = ",".join(["image_name", *(f"cov_{two}_m2" for two in axes)])
        lines = [f"{name},1e-4,0,0,1e-4,0,1e-4" for name in times_of(model)]
        (folder / "pose_covariance.csv").write_text("\n".join([header, *lines]))
    document = result_document(
        frame="first_camera",
        scale={"value": 2.0, "stddev_empirical": 0.02},
        georeference={"lat_deg": 47.4, "lon_deg": 8.5, "height_m": 400.0, "crs": "EPSG:2056"},
        anchors={"A1": anchor_entry([1, 2, 3]), "A2": anchor_entry(None)},
        metric_from_sfm={"scale": 2.0, "rotation_xyzw": [0, 0, 1, 0], "translation_m": [1, 2, 3]},
    )
    (folder / "result.json").write_text(json.dumps(document))


@pytest.mark.parametrize("is_refined", [True, False])
def test_a_result_is_exported_in_its_best_form_in_every_format(
    tmp_path: Path, model: pycolmap.Reconstruction, is_refined: bool
) -> None:
    write_result(tmp_path / "out", model, is_refined=is_refined)
    photos = write_photos(tmp_path / "photos", model)
    # Pose priors go into a copy of the photos' database, which this result does not have.
    left_out = {"pose_priors", *(() if is_refined else COVARIANCE_FORMATS)}
    formats = [name for name in EXPORTERS if name not in left_out]
    exported = export_result(tmp_path / "out", formats, tmp_path / "exports", images_path=photos)
    paths = {path.name: path for path in exported}
    assert all(path.exists() and path.parent == tmp_path / "exports" for path in exported)
    expected = np.mean(list(centers_of(model).values()), axis=0) + ([0, 0, 0] if is_refined else [1000, 0, 0])
    rows = np.loadtxt(paths["trajectory.tum"])
    np.testing.assert_allclose(rows[:, 1:4].mean(axis=0), expected)
    assert rows[0, 0] == 1.7e9
    np.testing.assert_array_equal(xyz(read_ply(paths["anchors.ply"])), [[1, 2, 3]])
    assert paths["transform_colmap_4.txt"].read_text().split()[0] == "2"
    expected_names = {name for format in formats for name in EXPORTED_NAMES[format]}
    assert set(names_in(tmp_path / "exports")) == expected_names | {OFFSET_NAME}


def test_a_folder_without_a_metric_model_cannot_be_exported(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"no result\.json"):
        export_result(tmp_path, ["tum"], tmp_path / "exports")
    (tmp_path / "result.json").write_text(json.dumps(result_document()))
    with pytest.raises(InputError, match="no metric model"):
        export_result(tmp_path, ["tum"], tmp_path / "exports")
