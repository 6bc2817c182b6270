"""Trajectories with the covariance of each centre beside the poses."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.colmap.transform import rescale
from rangesfm.errors import InputError
from rangesfm.export import COVARIANCE_FORMATS, MetricMap, export_map
from rangesfm.export.metric_map import moved
from rangesfm.options import ExportOptions
from rangesfm.util.geometry.similarity import Similarity

Array = npt.NDArray[np.float64]


@pytest.fixture(scope="module")
def map_() -> MetricMap:
    path = loop_path(20.0, start_s=0.0, seed=1)
    times = np.arange(6, dtype=np.float64)
    made = synthetic_model(*along(path, times), pixel_stddev=0.0, seed=2)
    factors = np.random.default_rng(0).normal(0, 0.1, (6, 3, 3))
    covariances = dict(zip(made.timestamps_s, factors @ np.swapaxes(factors, 1, 2), strict=True))
    model = rescale(made.reconstruction, made.metric_from_sfm)
    return MetricMap(model, made.timestamps_s, center_covariance_m2=covariances)


def upper(covariance: Array) -> list[float]:
    return [covariance[i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))]


@pytest.mark.parametrize("name", ["tum", "kitti"])
def test_beside_the_poses_stand_the_covariances_row_by_row(map_: MetricMap, tmp_path: Path, name: str) -> None:
    table, poses = export_map(map_, tmp_path / "both", ExportOptions(formats=(f"{name}_covariance",)))
    (alone,) = export_map(map_, tmp_path, ExportOptions(formats=(name,)))
    assert poses.read_bytes() == alone.read_bytes()
    header, *rows = [line.split(",") for line in table.read_text().splitlines()]
    assert header == ["image_name", *(f"cov_{axes}_m2" for axes in ("xx", "xy", "xz", "yy", "yz", "zz"))]
    assert tuple(row[0] for row in rows) == map_.trajectory.image_names
    expected = [upper(map_.center_covariance_m2[image]) for image in map_.trajectory.image_names]
    np.testing.assert_allclose([list(map(float, row[1:])) for row in rows], expected, rtol=1e-8)


def test_it_turns_and_grows_with_the_world(map_: MetricMap) -> None:
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5]).as_matrix()
    there = moved(map_, Similarity(2.0, turn, np.ones(3))).center_covariance_m2
    assert len(there) == 6
    for name, covariance in map_.center_covariance_m2.items():
        np.testing.assert_allclose(there[name], 4.0 * turn @ covariance @ turn.T, rtol=1e-12)


@pytest.mark.parametrize("name", COVARIANCE_FORMATS)
def test_without_covariances_there_is_nothing_to_write(map_: MetricMap, tmp_path: Path, name: str) -> None:
    with pytest.raises(InputError, match="pose covariance"):
        export_map(replace(map_, center_covariance_m2={}), tmp_path, ExportOptions(formats=(name,)))
    assert not list(tmp_path.iterdir())
