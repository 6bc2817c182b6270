"""A lens that is not as its camera model is named, with what to try; one that is, is not."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.diagnostics.lens import doubts_of_lens

if TYPE_CHECKING:
    from tests.conftest import Command, WalkedSurvey


def walk(seed: int) -> pycolmap.Reconstruction:
    times = np.arange(100, 140, dtype=np.float64)
    path = loop_path(42.0, start_s=99.0, seed=seed)
    return synthetic_model(
        *along(path, times),
        num_observations=100,
        max_track_length=8,
        pixel_stddev=0.5,
        seed=seed,
    ).reconstruction


def photograph_with_low_pixels(model: pycolmap.Reconstruction, camera_model: str, height: float) -> None:
    """Put the features where pixels of another height than width have them, and adjust with a camera model."""
    for camera in model.cameras.values():
        other = pycolmap.Camera.create_from_model_name(1, camera_model, 1.0, camera.width, camera.height)
        focal_length_px, center = camera.params[0], camera.params[2:4]
        camera.model, camera.params = other.model, [focal_length_px, *center, *(len(other.params) - 3) * [0.0]]
    for image in model.images.values():
        center_px = model.cameras[image.camera_id].principal_point_y
        for point in image.points2D:
            point.xy = np.array([point.xy[0], center_px + (point.xy[1] - center_px) / height])
    pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions(print_summary=False))


def test_pixels_that_are_no_squares_are_named_with_a_camera_model_that_has_them(
    own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    path = own_survey.folder / "sparse" / "0"
    model = pycolmap.Reconstruction(path)
    photograph_with_low_pixels(model, "SIMPLE_RADIAL", 0.87)
    model.write(path)
    arguments = (*own_survey.flags, "--anchors", "anchors.csv", "--output_path", "out")
    done = rangesfm_command("refine", *arguments, cwd=own_survey.folder)
    scale = json.loads(Path(own_survey.folder / "out" / "result.json").read_text())["scale"]
    assert scale["verdict"] == "doubtful"
    assert scale["reasons"][0].startswith("the lens is not as the camera model SIMPLE_RADIAL has it: with OPENCV,")
    assert "next time: map the photos again with --camera_model OPENCV, or calibrate the camera" in done.stdout


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_said_of_a_lens_that_fits(seed: int) -> None:
    assert doubts_of_lens(walk(seed), 1.0, 0.0) == ()


def test_nothing_is_said_of_a_lens_whose_misfit_changes_lengths_by_less_than_the_interval() -> None:
    model = walk(0)
    photograph_with_low_pixels(model, "SIMPLE_RADIAL", 0.95)
    assert doubts_of_lens(model, 1.0, 0.01)
    assert doubts_of_lens(model, 1.0, 0.03) == ()
