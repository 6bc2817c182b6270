"""Tables that show how the scale was found, against counting the ranges that agree with every single scale."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.geometry.similarity import Similarity
from rangesfm.scale.scale_diagnostics import scale_diagnostics

Array = npt.NDArray[np.float64]

PLACED = Similarity(2.0, Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix(), np.array([1.0, -2.0, 0.5]))
ANCHORS_M = np.array([[6.0, 0.0, 2.5], [-6.0, 1.0, 0.4], [np.nan, np.nan, np.nan]])
BIASES_M = np.array([0.3, -0.2, 0.0])
ANGLES = np.linspace(0.0, 5.0, 30)
CENTERS = np.stack([2 * np.cos(ANGLES), 1.5 * np.sin(ANGLES), 0.5 * np.sin(2.3 * ANGLES)], axis=1) + np.array(
    [9.0, 0, 4]
)
ARMS_M = np.random.default_rng(0).normal(0.0, 0.3, (30, 3))
INDEX = np.arange(30) % 3
STDDEV_M = np.where(np.arange(30) % 10 == 1, np.nan, np.where(INDEX == 0, 0.04, 0.08))
USED = np.isfinite(STDDEV_M) & (INDEX < 2)
PATH: Any = SimpleNamespace(centers=CENTERS)


def distances_m(held: Array, scale: float) -> Array:
    """Return the distances from tag to anchor on the path that is stretched about a place of the model."""
    tags = PLACED.apply(held) + (scale * (CENTERS - held) + ARMS_M) @ PLACED.rotation.T
    return np.asarray(np.linalg.norm(tags - ANCHORS_M[INDEX], axis=1))


def estimate_of(frame: str, range_m: Array, biases_m: Array = BIASES_M, stddev_m: Array = STDDEV_M) -> Any:
    return SimpleNamespace(
        observations=SimpleNamespace(
            log=SimpleNamespace(anchor_index=INDEX, range_m=range_m), centers=CENTERS, tag_from_center=ARMS_M
        ),
        metric_from_sfm=PLACED,
        anchors=[
            SimpleNamespace(position_m=at, range_bias_m=bias) for at, bias in zip(ANCHORS_M, biases_m, strict=True)
        ],
        errors=SimpleNamespace(stddev_m=stddev_m),
        frame=frame,
    )


@pytest.mark.parametrize("frame", ["site", "first_camera"])
def test_the_curve_counts_the_ranges_that_agree_on_the_path_stretched_about_its_fixed_point(frame: str) -> None:
    held = CENTERS.mean(axis=0) if frame == "site" else CENTERS[0]
    noise_m = 0.08 * np.random.default_rng(1).normal(size=30)
    range_m = np.where(USED, distances_m(held, 2.0) + BIASES_M[INDEX] + noise_m, 5.0)
    table = scale_diagnostics(estimate_of(frame, range_m), PATH)
    assert len(table.curve_scales) == 601
    assert table.curve_scales[[0, 300, 600]] == pytest.approx([2 / 3, 2.0, 6.0])
    np.testing.assert_allclose(table.curve_scales[1:] / table.curve_scales[:-1], 9 ** (1 / 600))
    # At the fixed point itself a range is the same at every scale, and says nothing.
    counted = USED & ((np.arange(30) > 0) | (frame == "site"))
    misses_m = [np.abs(distances_m(held, scale) + BIASES_M[INDEX] - range_m) for scale in table.curve_scales]
    counts = [int(np.sum(counted & (off <= 3.0 * STDDEV_M))) for off in misses_m]
    assert table.num_agreeing.tolist() == counts
    assert max(counts) > 10
    assert min(counts) < 5


@pytest.mark.parametrize("frame", ["site", "first_camera"])
def test_the_papers_candidates_are_about_the_first_camera_and_hold_the_true_scale(frame: str) -> None:
    """They know nothing of biases, so that there are none here. The first camera's own range has no candidates."""
    range_m = np.where(USED, distances_m(CENTERS[0], 2.0), 5.0)
    table = scale_diagnostics(estimate_of(frame, range_m, np.array([7.0, 7.0, 7.0])), PATH)
    assert table.candidate_rows.tolist() == np.flatnonzero(USED)[1:].tolist()
    assert USED[0]
    assert (table.candidates[:, 0] <= table.candidates[:, 1]).all()
    np.testing.assert_allclose(np.min(np.abs(table.candidates - 2.0), axis=1), 0.0, atol=1e-6)


def test_without_two_ranges_that_have_candidates_their_table_is_empty() -> None:
    only_one = np.where(np.arange(30) == 3, 0.1, np.nan)
    table = scale_diagnostics(estimate_of("site", np.full(30, 5.0), stddev_m=only_one), PATH)
    assert table.candidates.shape == (0, 2)
    assert table.candidate_rows.tolist() == []
    assert table.candidate_rows.dtype == np.int64
    assert table.num_agreeing.max() <= 1
