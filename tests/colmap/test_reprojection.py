"""A model whose axes are not as in COLMAP is told from one that is merely wrong, with what to change."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.conftest import Command, WalkedSurvey
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.colmap.reprojection import wrong_axes

Array = npt.NDArray[np.float64]

FLIPPED_X, FLIPPED_Y, FLIPPED_Z = np.diag([-1.0, 1, 1]), np.diag([1.0, -1, 1]), np.diag([1.0, 1, -1])
SWAPPED = np.eye(3)[[0, 2, 1]]
AS_IS = np.eye(3)


@pytest.fixture
def model() -> pycolmap.Reconstruction:
    path, times = loop_path(20.0), np.arange(20.0)
    made = synthetic_model(*along(path, times), num_observations=60, seed=1)
    return made.reconstruction


def change(model: pycolmap.Reconstruction, points: Array, centers: Array, cameras: Array) -> None:
    """Write points and centres in other coordinates, with cameras along other axes."""
    for point in model.points3D.values():
        point.xyz = points @ point.xyz
    for frame in model.frames.values():
        pose = frame.rig_from_world
        assert pose is not None
        turn = pose.rotation.matrix()
        center = centers @ (-turn.T @ pose.translation)
        turn = cameras @ turn @ centers.T
        frame.rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(turn), -turn @ center)


@pytest.mark.parametrize(
    ("points", "centers", "cameras", "said"),
    [
        (FLIPPED_X, AS_IS, AS_IS, "is mirrored.*only with the other sign of the points' x,"),
        (SWAPPED, AS_IS, AS_IS, "is mirrored.*only with the points' y and z exchanged,"),
        (-AS_IS, AS_IS, AS_IS, "is mirrored.*only with "),
        (AS_IS, FLIPPED_Z, FLIPPED_Z, "is mirrored.*the other sign of the points' z and the cameras' z in the other"),
        (FLIPPED_Z, FLIPPED_Z, FLIPPED_Z, "is mirrored.*only with the cameras' z in the other direction,"),
        (SWAPPED, SWAPPED, FLIPPED_Y, "is mirrored.*only with the cameras' y in the other direction,"),
        (AS_IS, AS_IS, FLIPPED_Y @ FLIPPED_Z, "has other axes.*only with the cameras' y and z in the other direction,"),
    ],
)
def test_other_axes_are_named(
    model: pycolmap.Reconstruction, points: Array, centers: Array, cameras: Array, said: str
) -> None:
    assert wrong_axes(model) is None
    change(model, points, centers, cameras)
    found = wrong_axes(model)
    assert found is not None
    assert re.search(said, found)


def test_points_that_are_wrong_in_any_axes_are_not_named_so(model: pycolmap.Reconstruction) -> None:
    places = np.random.default_rng(0).permutation([point.xyz for point in model.points3D.values()])
    for point, place in zip(model.points3D.values(), places, strict=True):
        point.xyz = place
    assert wrong_axes(model) is None


@pytest.mark.parametrize("command", ["scale", "refine"])
def test_a_mirrored_model_is_refused_before_the_work(
    own_survey: WalkedSurvey, rangesfm_command: Command, command: str
) -> None:
    folder: Path = own_survey.folder / "sparse" / "0"
    model = pycolmap.Reconstruction(folder)
    change(model, FLIPPED_Z, AS_IS, AS_IS)
    model.write(folder)
    done = rangesfm_command(command, *own_survey.flags, "--anchors", "anchors.csv", cwd=own_survey.folder, status=2)
    assert "sparse/0: the model is mirrored" in done.stderr
    assert not (own_survey.folder / "out").exists()
