"""The incremental mapping gives COLMAP's models, the same in every run, and can be ended and continued."""

from __future__ import annotations

import copy
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.few_links import leave_few_links
from tests.simulated.model import synthetic_model
from tests.simulated.path import loop_path
from tests.studies.simulated_database import write_database

from rangesfm.geometry.similarity import align_points, rmse
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.vision.incremental_mapping import adjust_whole, incremental_mapping
from rangesfm.vision.mapping import pipeline_options


def walk(num_photos: int, max_track_length: int) -> pycolmap.Reconstruction:
    """Half a walk around a yard."""
    times = np.linspace(0.0, 20.0, num_photos)
    path = loop_path(20.0, num_turns=0.4, seed=1)
    centers, world_from_cam = path.centers(times), path.world_from_cam(times)
    return synthetic_model(
        times, centers, world_from_cam, num_observations=150, max_track_length=max_track_length
    ).reconstruction


def write_matches(path: Path, model: pycolmap.Reconstruction) -> Path:
    num = sum(len(image.points2D) for image in model.images.values())
    write_database(path, model, 0.3 * np.random.default_rng(0).standard_normal((num, 2)))
    return path


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Matches of half a walk around a yard, with a gap that no match bridges."""
    model = walk(16, max_track_length=6)
    leave_few_links(model, 10, num_links=0)
    return write_matches(tmp_path_factory.mktemp("database") / "database.db", model)


@pytest.fixture
def options() -> pycolmap.IncrementalPipelineOptions:
    pipeline = {
        "min_model_size": 3,
        "extract_colors": False,
        "mapper": {"init_min_num_inliers": 20, "abs_pose_min_num_inliers": 15},
    }
    camera = CameraOptions(model="PINHOLE", params=(750.0, 750.0, 480.0, 320.0))
    options = pipeline_options(camera, MapperOptions(num_threads=1, pipeline=pipeline), seed=0)
    assert isinstance(options, pycolmap.IncrementalPipelineOptions)
    return options


def mapped(
    database: Path, options: pycolmap.IncrementalPipelineOptions, **arguments: Any
) -> list[pycolmap.Reconstruction]:
    return incremental_mapping(database, database.parent, options=options, **arguments)


def centers(model: pycolmap.Reconstruction) -> npt.NDArray[np.float64]:
    return np.array([model.image(image_id).projection_center() for image_id in sorted(model.reg_image_ids())])


def off_by(model: pycolmap.Reconstruction, true: pycolmap.Reconstruction) -> float:
    """Return the RMSE of the photos' centres after the best similarity."""
    return rmse(align_points(centers(model), centers(true)).apply(centers(model)) - centers(true))


def test_it_gives_colmaps_models(database: Path, options: pycolmap.IncrementalPipelineOptions) -> None:
    found, output = mapped(database, options), database.with_name("expected")
    expected = pycolmap.incremental_mapping(database, database.parent, output, options=options)
    assert [model.num_reg_images() for model in expected.values()] == [10, 6]
    for theirs, ours in zip(expected.values(), found, strict=True):
        assert set(ours.reg_image_ids()) == set(theirs.reg_image_ids())
        assert ours.num_points3D() == theirs.num_points3D()
        assert np.abs(centers(ours) - centers(theirs)).max() < 1e-8


def test_threads_do_not_change_the_map(tmp_path: Path, options: pycolmap.IncrementalPipelineOptions) -> None:
    """The mapping of pycolmap itself, with several threads, begins with one of seven pairs of photos."""
    database = write_matches(tmp_path / "database.db", walk(28, max_track_length=7))
    (expected,) = mapped(database, options)
    assert expected.num_reg_images() == 28
    options.num_threads = 8
    for _ in range(4):
        (found,) = mapped(database, options)
        assert np.abs(centers(found) - centers(expected)).max() < 1e-9


def test_a_whole_map_finds_out_a_calibration_that_it_grew_with(
    tmp_path: Path, options: pycolmap.IncrementalPipelineOptions
) -> None:
    true = walk(16, max_track_length=6)
    database = write_matches(tmp_path / "database.db", true)
    with pycolmap.Database.open(database) as opened:
        (camera,) = opened.read_all_cameras()
        focal_length_px, camera.params = camera.params[0], [*(1.03 * camera.params[:2]), *camera.params[2:]]
        opened.update_camera(camera)
    whole, options.constant_cameras = copy.deepcopy(options), {camera.camera_id}
    (model,) = mapped(database, options)
    errors_m = [off_by(model, true)]
    assert model.camera(camera.camera_id).params[0] == pytest.approx(1.03 * focal_length_px, rel=1e-12)
    adjust_whole(database, model, options=whole)
    errors_m.append(off_by(model, true))
    assert model.camera(camera.camera_id).params[0] == pytest.approx(focal_length_px, rel=0.002)
    assert errors_m[1] < 0.5 * errors_m[0]


def test_cancelled_mapping_ends_with_the_photo_at_hand(
    database: Path, options: pycolmap.IncrementalPipelineOptions
) -> None:
    token, registered = pycolmap.CancellationToken(), list[str]()

    def cancel_the_second_time(model: pycolmap.Reconstruction) -> None:
        registered.append("")
        if len(registered) == 2:
            token.cancel()

    (model,) = mapped(database, options, next_image_callback=cancel_the_second_time, cancellation_token=token)
    assert model.num_reg_images() == 4


def test_a_mapping_ends_when_its_time_is_over(database: Path, options: pycolmap.IncrementalPipelineOptions) -> None:
    options.max_runtime_seconds = 1
    (model,) = mapped(database, options, next_image_callback=lambda model: time.sleep(0.6))
    assert 2 <= model.num_reg_images() <= 4
    assert all(point.error >= 0 for point in model.points3D.values())


def test_a_mapping_goes_on_from_a_snapshot(
    database: Path, options: pycolmap.IncrementalPipelineOptions, tmp_path: Path
) -> None:
    options.snapshot_path, options.snapshot_frames_freq, options.multiple_models = tmp_path, 2, False
    (whole,) = mapped(database, options)
    snapshots = [pycolmap.Reconstruction(folder) for folder in sorted(tmp_path.iterdir())]
    assert [model.num_reg_images() for model in snapshots] == [4, 6, 8, 10]
    options.snapshot_frames_freq, registered = 0, list[str]()
    (continued,) = mapped(
        database,
        options,
        input_path=sorted(tmp_path.iterdir())[1],
        next_image_callback=lambda model: registered.append(""),
    )
    assert len(registered) == 4
    assert set(continued.reg_image_ids()) == set(whole.reg_image_ids())
