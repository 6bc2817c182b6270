"""The range problem of a survey: which anchors take part."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import RangeModelOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.range_log import RangeLog
from rangesfm.ranging.range_observations import RangeObservations, RangeStatus
from rangesfm.scale.scale_problem import ScaleProblem, scale_problem

Array = npt.NDArray[np.float64]

PLACES_M = {"A": (6.0, 0.0, 2.5), "B": (-6.0, 1.0, 0.4), "C": (0.5, 6.0, 3.0), "D": (1.0, -6.0, 0.2)}
TAG_IN_CAM_M = np.array([0.1, -0.2, 0.3])
MODEL = RangeModelOptions(range_stddev_m=0.07, range_bias_stddev_m=0.02, common_bias_stddev_m=0.05)


def path(num: int = 6, times: Array | None = None) -> Trajectory:
    """Return a path of steps of 1, 2, 3, ... units from a place far from the origin, with turning cameras."""
    steps = np.cumsum(np.arange(num))[:, None] * [0.6, 0.0, 0.8]
    names = tuple(f"{k}.jpg" for k in range(num))
    turned = Rotation.from_rotvec(0.3 * np.arange(1, num + 1)[:, None] * [0.5, -1.0, 0.4]).as_matrix()
    return Trajectory(np.arange(num), names, times, steps + np.array([7.0, -3.0, 2.0]), turned)


def heard(ids: str, trajectory: Trajectory, photos: Sequence[int] | None = None) -> RangeObservations:
    """Return a range to each of the anchors (a letter each) at each of the photos."""
    photos = range(len(trajectory)) if photos is None else photos
    log = RangeLog.from_arrays(
        [id_ for _ in photos for id_ in ids],
        [4.0 + 0.1 * k + 0.01 * ord(id_) for k in photos for id_ in ids],
        image_name=[f"{k}.jpg" for k in photos for _ in ids],
    )
    return associate(log, trajectory, TAG_IN_CAM_M)


def anchor(id_: str, **of_anchor: Any) -> Anchor:
    return Anchor(id_, np.array(PLACES_M[id_]), **of_anchor)


def without(observations: RangeObservations, id_: str, num_left: int = 0) -> RangeObservations:
    """Hold out the ranges to an anchor as checks, except for some."""
    log, status = observations.log, observations.status.copy()
    rows = np.flatnonzero(log.anchor_index == log.anchor_ids.index(id_))
    status[rows[num_left:]] = RangeStatus.CHECK
    return replace(observations, status=status)


def posed(
    observations: RangeObservations | None = None,
    anchors: Sequence[Anchor] | None = None,
    frame: str = "site",
    trajectory: Trajectory | None = None,
    **options: Any,
) -> ScaleProblem:
    trajectory = path() if trajectory is None else trajectory
    observations = heard("ABC", trajectory) if observations is None else observations
    anchors = [anchor(id_) for id_ in observations.log.anchor_ids] if anchors is None else anchors
    return scale_problem(observations, trajectory, anchors, frame, MODEL, **options)


@pytest.mark.parametrize(("num", "is_heard"), [(3, False), (4, True)])
def test_an_unknown_anchor_needs_four_ranges(num: int, is_heard: bool) -> None:
    problem = posed(without(heard("ABC", path()), "B", num), [anchor("A"), Anchor("B"), anchor("C")], "first_camera")
    assert problem.left_out == (() if is_heard else ("B",))
    assert problem.ranges.anchor_stddev_m[1] == (np.inf if is_heard else 0.0)
    assert len(problem.ranges.range_m) == 12 + (num if is_heard else 0)
