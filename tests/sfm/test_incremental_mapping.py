"""The incremental mapping gives COLMAP's models, and can be ended and continued."""

from __future__ import annotations

import copy
import time
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.simulated.looped import matches_in, write_matches
from tests.simulated.model import synthetic_model
from tests.simulated.path import loop_path
from tests.simulated.pieces import leave_across

from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.sfm.incremental_mapping import UnfinishedMapping, adjust_whole, incremental_mapping
from rangesfm.sfm.mapping import pipeline_options
from rangesfm.util.geometry.similarity import align_points, rmse


def walk(num_photos: int, max_track_length: int) -> pycolmap.Reconstruction:
    """Half a walk around a yard."""
    times = np.linspace(0.0, 20.0, num_photos)
    path = loop_path(20.0, num_turns=0.4, seed=1)
    centers, world_from_cam = path.centers(times), path.world_from_cam(times)
    return synthetic_model(
        times, centers, world_from_cam, num_observations=150, max_track_length=max_track_length, pixel_stddev=0.3
    ).reconstruction


def matched(path: Path, model: pycolmap.Reconstruction) -> Path:
    write_matches(path, model, matches_in(model))
    return path


@pytest.fixture(scope="module")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Matches of half a walk around a yard, with a gap that no match bridges."""
    model = walk(16, max_track_length=6)
    leave_across(model, {image.name for image_id, image in model.images.items() if image_id > 10}, 0)
    return matched(tmp_path_factory.mktemp("database") / "database.db", model)


def options_of(num_threads: int, *, reproducible: bool) -> pycolmap.IncrementalPipelineOptions:
    pipeline = {
        "min_model_size": 3,
        "extract_colors": False,
        "mapper": {"init_min_num_inliers": 20, "abs_pose_min_num_inliers": 15},
    }
    camera = CameraOptions(model="PINHOLE", params=(750.0, 750.0, 480.0, 320.0))
    mapper = MapperOptions(num_threads=num_threads, reproducible=reproducible, pipeline=pipeline)
    options = pipeline_options(camera, mapper, seed=0)
    assert isinstance(options, pycolmap.IncrementalPipelineOptions)
    return options


@pytest.fixture
def options() -> pycolmap.IncrementalPipelineOptions:
    return options_of(1, reproducible=False)


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


def test_threads_do_not_change_a_reproducible_map(tmp_path: Path) -> None:
    """With several threads, the mapping begins with one of seven pairs of photos."""
    database = matched(tmp_path / "database.db", walk(28, max_track_length=7))
    (expected,) = mapped(database, options_of(1, reproducible=False))
    assert expected.num_reg_images() == 28
    for _ in range(4):
        (found,) = mapped(database, options_of(8, reproducible=True))
        assert np.array_equal(centers(found), centers(expected))


def test_threads_give_a_map_as_good(tmp_path: Path) -> None:
    true = walk(28, max_track_length=7)
    database = matched(tmp_path / "database.db", true)
    options = options_of(8, reproducible=False)
    assert options.num_threads == 8
    (found,), (alone,) = mapped(database, options), mapped(database, options_of(1, reproducible=False))
    assert off_by(found, true) < 1.5 * off_by(alone, true)


def test_a_whole_map_finds_out_a_calibration_that_it_grew_with(
    tmp_path: Path, options: pycolmap.IncrementalPipelineOptions
) -> None:
    true = walk(16, max_track_length=6)
    database = matched(tmp_path / "database.db", true)
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
    token = pycolmap.CancellationToken()

    def cancel_with_four_photos(mapping: UnfinishedMapping) -> None:
        if mapping.growing.num_reg_images() == 4:
            token.cancel()

    (model,) = mapped(database, options, callback=cancel_with_four_photos, cancellation_token=token)
    assert model.num_reg_images() == 4


def test_a_mapping_ends_when_its_time_is_over(database: Path, options: pycolmap.IncrementalPipelineOptions) -> None:
    options.max_runtime_seconds = 1
    (model,) = mapped(database, options, callback=lambda mapping: time.sleep(0.6))
    assert 2 <= model.num_reg_images() <= 4
    assert all(point.error >= 0 for point in model.points3D.values())


def moments_of(
    database: Path, options: pycolmap.IncrementalPipelineOptions
) -> tuple[list[UnfinishedMapping], list[pycolmap.Reconstruction]]:
    """Return what a mapping had after each photo, and its models."""
    moments: list[UnfinishedMapping] = []

    def keep(mapping: UnfinishedMapping) -> None:
        *finished, growing = map(pycolmap.Reconstruction, mapping.models)
        moments.append(UnfinishedMapping(tuple(finished), growing, mapping.size_at_adjustment))

    return moments, mapped(database, options, callback=keep)


def assert_goes_on(
    moment: UnfinishedMapping,
    database: Path,
    options: pycolmap.IncrementalPipelineOptions,
    whole: list[pycolmap.Reconstruction],
) -> None:
    seen: list[int] = []
    continued = mapped(
        database, options, unfinished=moment, callback=lambda mapping: seen.append(mapping.growing.num_reg_images())
    )
    assert seen[0] == moment.growing.num_reg_images()
    assert len(continued) == len(whole)
    for found, expected in zip(continued, whole, strict=True):
        assert found.num_points3D() == expected.num_points3D()
        assert set(found.reg_image_ids()) == set(expected.reg_image_ids())
        assert np.abs(centers(found) - centers(expected)).max() < 1e-9


def test_a_mapping_goes_on_after_any_photo_of_any_model(
    database: Path, options: pycolmap.IncrementalPipelineOptions
) -> None:
    moments, whole = moments_of(database, options)
    assert [model.num_reg_images() for model in whole] == [10, 6]
    assert [len(moment.finished) for moment in moments] == 9 * [0] + 5 * [1]
    for moment in moments:
        assert_goes_on(moment, database, options, whole)


def test_a_mapping_that_goes_on_adjusts_the_whole_when_it_would_have(
    tmp_path: Path, options: pycolmap.IncrementalPipelineOptions
) -> None:
    database = matched(tmp_path / "database.db", walk(28, max_track_length=7))
    options.ba_global_frames_ratio = options.ba_global_points_ratio = 1.3
    moments, whole = moments_of(database, options)
    # In smaller models, the adjustment of a photo's neighbourhood changes all photos, too.
    moments = [moment for moment in moments if moment.growing.num_reg_images() > 8]
    assert len(moments) == 20
    assert len({moment.size_at_adjustment for moment in moments}) < 7
    for moment in moments[::3]:
        assert_goes_on(moment, database, options, whole)
