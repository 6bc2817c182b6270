"""COLMAP models are read as they are, and damaged ones refused before they do harm."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest

from rangesfm.errors import InputError
from rangesfm.model_files import read_model

if TYPE_CHECKING:
    from tests.conftest import WalkedSurvey


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of two rigs of three cameras each, with points."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2,
        num_cameras_per_rig=3,
        num_frames_per_rig=4,
        num_points3D=30,
        camera_model_id=pycolmap.CameraModelId.OPENCV,
        camera_params=[1280.0, 1280.0, 512.0, 384.0, 0.05, 0.0, 0.0, 0.0],
    )
    folder = tmp_path_factory.mktemp("rigs")
    pycolmap.synthesize_dataset(options).write_binary(folder)
    return folder


def test_binary_and_text_models_are_read_whole(rigs: Path, tmp_path: Path) -> None:
    model = read_model(rigs)
    assert (model.num_rigs(), model.num_cameras(), model.num_reg_images(), model.num_points3D()) == (2, 6, 24, 30)
    model.write_text(tmp_path)
    text = read_model(tmp_path)
    for image_id, image in model.images.items():
        np.testing.assert_allclose(text.image(image_id).projection_center(), image.projection_center(), atol=1e-9)


@pytest.mark.parametrize("name", ["cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin"])
def test_file_cut_off_anywhere_is_refused(name: str, rigs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(rigs, tmp_path / "model")
    data = (folder / name).read_bytes()
    for length in np.linspace(0, len(data) - 1, 40).astype(int):
        (folder / name).write_bytes(data[:length])
        with pytest.raises(InputError, match="is damaged or cut off") as caught:
            read_model(folder)
        assert caught.value.path == folder / name


def test_folder_above_the_model_is_told_from_the_model(rigs: Path, tmp_path: Path) -> None:
    shutil.copytree(rigs, tmp_path / "sparse" / "0")
    with pytest.raises(InputError, match=r"not a COLMAP model, .*; is it .*sparse/0\?"):
        read_model(tmp_path / "sparse")
    with pytest.raises(InputError, match=r"files that COLMAP wrote$"):
        read_model(tmp_path)


def test_pose_that_is_not_finite_is_named(walked_survey: WalkedSurvey, tmp_path: Path) -> None:
    model = read_model(walked_survey.folder / "sparse" / "0")
    model.frame(3).rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.full(3, np.nan))
    model.write(tmp_path)
    with pytest.raises(InputError, match=r"the pose of frame_00003\.jpg is not finite"):
        read_model(tmp_path)
