"""A small bundle adjustment to which tests add residuals."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest

from rangesfm.solver import check_compatibility

AdjusterOf: TypeAlias = Callable[..., pycolmap.CeresBundleAdjuster]


@pytest.fixture
def reconstruction() -> pycolmap.Reconstruction:
    """Six frames of one camera, without noise."""
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=1, num_frames_per_rig=6, num_points3D=60, track_length=4
    )
    return pycolmap.synthesize_dataset(options)


@pytest.fixture
def adjuster_of() -> AdjusterOf:
    """Return a function that makes a bundle adjuster over all images, with fixed intrinsics and one thread."""
    return _adjuster_of


def _adjuster_of(
    reconstruction: pycolmap.Reconstruction, constant_frame_id: int | None = None, num_threads: int = 1
) -> pycolmap.CeresBundleAdjuster:
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=False, refine_extra_params=False
    )
    options.ceres.auto_select_solver_type = False
    options.ceres.solver_options.num_threads = num_threads
    options.ceres.min_num_residuals_for_cpu_multi_threading = 0
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    if constant_frame_id is not None:
        config.set_constant_rig_from_world_pose(constant_frame_id)
    return pycolmap.create_default_ceres_bundle_adjuster(options, config, reconstruction)


PoseBlock: TypeAlias = Callable[[pycolmap.Reconstruction, int], npt.NDArray[np.float64]]


@pytest.fixture
def pose_block() -> PoseBlock:
    """Return a function that gives a frame's pose in the array that the solver changes."""
    return _pose_block


def _pose_block(reconstruction: pycolmap.Reconstruction, frame_id: int) -> npt.NDArray[np.float64]:
    rig_from_world = reconstruction.frame(frame_id).rig_from_world
    assert rig_from_world is not None
    params: npt.NDArray[np.float64] = rig_from_world.params
    return params


@pytest.fixture
def unchecked() -> Iterator[None]:
    """Forget the result of the compatibility check before and after the test."""
    check_compatibility.cache_clear()
    yield
    check_compatibility.cache_clear()
