"""Exports opened by the programs they are for: they show as many photos and points, and the same distances.

COLMAP 3.8 comes from Debian (``apt-get install colmap``); evo is GPL and no dependency. The tests of a program that is
not installed are skipped. pyopf opens its format in test_elsewhere, laspy and pyogrio theirs in test_frames. nerfstudio
and OpenSfM cannot be installed beside other packages, so test_elsewhere reads their formats by the rules of their
loaders.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
import trimesh
from PIL import Image
from scipy.spatial.distance import pdist
from scipy.spatial.transform import Rotation
from tests.export.models import synthesized

from rangesfm.colmap.transform import rescale
from rangesfm.export import MetricMap, export_map
from rangesfm.export.metric_map import colored_points
from rangesfm.options import ExportOptions
from rangesfm.util.geometry.similarity import Similarity

Array = npt.NDArray[np.float64]

NUM_PHOTOS, NUM_POINTS = 7, 80
METRIC_FROM_SFM = Similarity(3.28, Rotation.from_rotvec([0.1, -0.7, 2.5]).as_matrix(), np.array([1 / 3, -20.0, 5.0]))
# A program that rejects its project has said so within this time.
OPENS_WITHIN_S = 5.0

needs_colmap = pytest.mark.skipif(shutil.which("colmap") is None, reason="COLMAP's program is not installed")
needs_evo = pytest.mark.skipif(shutil.which("evo_traj") is None, reason="evo is not installed")


@pytest.fixture(scope="module")
def sfm() -> pycolmap.Reconstruction:
    camera = {"camera_width": 64, "camera_height": 48, "camera_params": [50.0, 32.0, 24.0, 0.0]}
    return synthesized(NUM_PHOTOS, NUM_POINTS, seed=1, **camera)


@pytest.fixture(scope="module")
def map_(sfm: pycolmap.Reconstruction, tmp_path_factory: pytest.TempPathFactory) -> MetricMap:
    photos = tmp_path_factory.mktemp("photos with blanks")
    for image in sfm.images.values():
        Image.new("RGB", (64, 48), (90, 120, 30)).save(photos / image.name)
    return MetricMap(
        rescale(sfm, METRIC_FROM_SFM),
        timestamps_s={image.name: 1.7e9 + i for i, image in sfm.images.items()},
        anchors_m={"A1": np.array([1.0, 2.0, 3.0]), "A2": np.array([-4.0, 2.0, 3.0])},
        metric_from_sfm=METRIC_FROM_SFM,
        center_covariance_m2={image.name: np.diag([1e-4, 2e-4, 3e-4]) for image in sfm.images.values()},
        images_path=photos,
    )


def export(map_: MetricMap, folder: Path, *formats: str) -> tuple[Path, ...]:
    return export_map(map_, folder, ExportOptions(formats=formats))


def run(program: str, *arguments: str | Path, home: Path | None = None) -> str:
    environment = {**os.environ, "HOME": str(home)} if home else None
    command = [program, *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def centers_of(model: pycolmap.Reconstruction) -> Array:
    """Return the (n, 3) centres in the order of the names."""
    images = sorted(model.images.values(), key=lambda image: image.name)
    return np.array([image.projection_center() for image in images])


@needs_colmap
@pytest.mark.parametrize("name", ["colmap", "colmap_text", "undistorted"])
def test_colmap_counts_photos_and_points(map_: MetricMap, name: str, tmp_path: Path) -> None:
    (path,) = export(map_, tmp_path, name)
    said = run("colmap", "model_analyzer", "--path", path / "sparse" / "0" if name == "undistorted" else path)
    counted = {key: int(num) for key, num in re.findall(r"(Registered images|Points): (\d+)", said)}
    assert counted == {"Registered images": NUM_PHOTOS, "Points": NUM_POINTS}


def version_of_colmap() -> str:
    """Return the version as in the name of the transform's file; the line of eight numbers came with COLMAP 3.9."""
    found = re.search(r"COLMAP (\d+)\.(\d+)", run("colmap", "help"))
    assert found is not None
    return "3.8" if (int(found[1]), int(found[2])) < (3, 9) else "4"


@needs_colmap
def test_colmap_moves_the_unscaled_model_to_the_metric_one_by_the_transform_of_its_version(
    sfm: pycolmap.Reconstruction, map_: MetricMap, tmp_path: Path
) -> None:
    export(map_, tmp_path, "transform")
    (tmp_path / "sfm").mkdir()
    (tmp_path / "moved").mkdir()
    sfm.write_binary(tmp_path / "sfm")
    transform = tmp_path / f"transform_colmap_{version_of_colmap()}.txt"
    paths = ("--input_path", tmp_path / "sfm", "--output_path", tmp_path / "moved", "--transform_path", transform)
    run("colmap", "model_transformer", *paths)
    moved = pycolmap.Reconstruction(tmp_path / "moved")
    np.testing.assert_allclose(centers_of(moved), centers_of(map_.reconstruction), atol=1e-9)
    np.testing.assert_allclose(colored_points(moved)[0], colored_points(map_.reconstruction)[0], atol=1e-9)


@needs_colmap
def test_colmap_aligns_the_unscaled_model_to_the_positions(
    sfm: pycolmap.Reconstruction, map_: MetricMap, tmp_path: Path
) -> None:
    (positions,) = export(map_, tmp_path, "model_aligner")
    (tmp_path / "sfm").mkdir()
    (tmp_path / "aligned").mkdir()
    sfm.write_binary(tmp_path / "sfm")
    paths = ("--input_path", tmp_path / "sfm", "--output_path", tmp_path / "aligned", "--ref_images_path", positions)
    options = ("--ref_is_gps", "0", "--alignment_type", "custom")
    version = version_of_colmap()
    error = "--robust_alignment_max_error" if version == "3.8" else "--alignment_max_error"
    run("colmap", "model_aligner", *paths, *options, error, "0.01")
    aligned = pycolmap.Reconstruction(tmp_path / "aligned")
    np.testing.assert_allclose(centers_of(aligned), centers_of(map_.reconstruction), atol=1e-6)


@needs_colmap
@pytest.mark.parametrize("is_known", [True, False], ids=["as written", "with another folder"])
def test_colmaps_window_opens_the_folder_with_its_photos(map_: MetricMap, is_known: bool, tmp_path: Path) -> None:
    (path,) = export(map_, tmp_path, "colmap")
    project = path / "project.ini"
    if not is_known:
        project.write_text(project.read_text().replace(str(map_.images_path), str(tmp_path / "none")))
    command = ["colmap", "gui", "--project_path", str(project), "--import_path", str(path)]
    surroundings = {**os.environ, "QT_QPA_PLATFORM": "offscreen"}
    window = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, env=surroundings)
    try:
        said = window.communicate(timeout=OPENS_WITHIN_S)[0].decode()
        assert not is_known, said
        assert window.returncode == 1
        assert "image_path" in said
    except subprocess.TimeoutExpired:
        assert is_known
    finally:
        window.kill()
        window.communicate()


@needs_evo
@pytest.mark.parametrize("name", ["tum", "kitti"])
@pytest.mark.parametrize("ending", ["", "_covariance"])
def test_evo_counts_poses_and_measures_the_path(map_: MetricMap, name: str, ending: str, tmp_path: Path) -> None:
    *_, path = export(map_, tmp_path, name + ending)
    said = run("evo_traj", name, path, "--full_check", home=tmp_path)
    num, length = (re.search(rf"{key}\t([\d.]+)", said) for key in ("nr. of poses", r"path length \(m\)"))
    assert num is not None, said
    assert length is not None, said
    assert int(num[1]) == NUM_PHOTOS
    expected = np.linalg.norm(np.diff(map_.trajectory.centers, axis=0), axis=1).sum()
    assert float(length[1]) == pytest.approx(expected, rel=1e-8)


def vertices_of(path: Path) -> Array:
    cloud = trimesh.load(path)
    assert isinstance(cloud, trimesh.PointCloud)
    return np.array(cloud.vertices)


def test_trimesh_reads_points_cameras_and_anchors(map_: MetricMap, tmp_path: Path) -> None:
    points, cameras, anchors = map(vertices_of, export(map_, tmp_path, "ply", "ply_cameras", "ply_anchors"))
    assert [len(points), len(cameras), len(anchors)] == [NUM_POINTS, NUM_PHOTOS, 2]
    np.testing.assert_allclose(pdist(points), pdist(colored_points(map_.reconstruction)[0]), rtol=1e-9)
    np.testing.assert_allclose(pdist(cameras), pdist(map_.trajectory.centers), rtol=1e-9)
    np.testing.assert_allclose(pdist(anchors), [5.0], rtol=1e-9)
