"""Ranges that the refinement predicts."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.refine.test_bundle_adjustment import orbit

from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.refine.radio import (
    Antennas,
    RadioEstimate,
    RadioRanges,
)

Array = npt.NDArray[np.float64]
TAGS_M = np.array([[0.1, -0.2, 0.3], [-0.3, 0.1, 0.05]])


def anchor(name: str, place: list[float], **given: Any) -> AnchorEstimate:
    position = np.array(place)
    found = AnchorEstimate(name, position, 0.1, position.copy(), 0.1, 0.0, 0.0, 0.1)
    return replace(found, **given)


ANCHORS = (
    anchor("N0", [1.0, 2.0, 3.0], range_bias_m=0.2),
    anchor("N1", [-2.0, 1.0, 0.0], range_bias_m=-0.1, prior_bias_stddev_m=0.3),
    anchor("unheard", [0.0, 0.0, 9.0]),
)


def times_of(model: pycolmap.Reconstruction) -> dict[str, float]:
    return {name: 2.0 * k for k, name in enumerate(sorted(image.name for image in model.images.values()))}


def four_ranges(model: pycolmap.Reconstruction) -> RadioRanges:
    """Return two ranges between keyframes, one at a keyframe, and one without a place, which is the third."""
    rng = np.random.default_rng(4)
    before, after = np.array([0, 2, -1, 4]), np.array([1, 3, -1, 4])
    tag_index = np.array([0, 1, 0, 1])
    log: Any = SimpleNamespace(
        anchor_index=np.array([0, 1, 0, 0]), tag_index=tag_index, range_m=np.array([3.0, 4.0, 5.0, 4.5])
    )
    observations: Any = SimpleNamespace(log=log, before=before, placed_rows=np.array([3, 0, 1]))
    offsets_m = rng.normal(0, 0.1, (4, 3))
    offsets_m[3] = 0.0
    placed = Antennas(before, after, np.array([0.25, 0.5, 0.0, 0.0]), TAGS_M[tag_index], offsets_m)
    trajectory = trajectory_from_reconstruction(model, times_of(model))
    return RadioRanges(observations, trajectory, placed, rng.normal(0, 0.1, (4, 2)))


def estimate(**given: Any) -> RadioEstimate:
    return replace(RadioEstimate(ANCHORS, TAGS_M, 0.0, 0.0, np.array([0.5, -1.0])), **given)


def places_by_hand(path: Trajectory, ranges: RadioRanges, tags_m: Array, shift_s: float = 0.0) -> tuple[Array, Array]:
    """Return the (4, 3) places of antennas and of the camera; keyframes are 2 s apart."""
    fraction = np.array([0.25 + shift_s / 2, 0.5 + shift_s / 2, 0.0, 0.0])[:, None]
    arms_m = tags_m[[0, 1, 0, 1]]
    before, after = (
        path.centers[ends] + np.einsum("nij,nj->ni", path.world_from_cam[ends], arms_m)
        for ends in ([0, 2, 0, 4], [1, 3, 0, 4])
    )
    at = (1 - fraction) * before + fraction * after + ranges.antennas.offset_in_world_m
    return at, (1 - fraction) * path.centers[[0, 2, 0, 4]] + fraction * path.centers[[1, 3, 0, 4]]


def test_predicted_ranges_have_biases_and_the_excess_of_short_ones() -> None:
    model = orbit()
    ranges = four_ranges(model)
    path = ranges.trajectory.as_in(model)
    at, _ = places_by_hand(path, ranges, TAGS_M)
    distance = np.linalg.norm(at - np.array([ANCHORS[k].position_m for k in (0, 1, 0, 0)]), axis=1)
    expected = distance + [0.2, -0.1, 0.2, 0.2] + 0.7 * np.exp(-distance / 1.0)
    found = ranges.predicted_m(model, estimate(short_range_error_m=0.7))
    np.testing.assert_allclose(found[[0, 1, 3]], expected[[0, 1, 3]], rtol=1e-12)
    assert np.isnan(found[2])
    np.testing.assert_allclose(ranges.shared_m(estimate()), ranges.shared_errors_m @ [0.5, -1.0])
