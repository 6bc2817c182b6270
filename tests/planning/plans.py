"""Plans of surveys, and simulated outcomes of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.simulated.path import along, loop_path

from rangesfm.estimation.free_fit import GraphBending
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.planning.expected import Expected
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Place = tuple[float, float, float]

FIVE_ANCHORS_M = ((6.0, 0.0, 2.5), (-6.0, 1.0, 0.4), (0.5, 6.0, 3.0), (1.0, -6.0, 0.2), (5.0, 5.0, 1.0))
COPLANAR_M = ((6.0, 6.0, 1.6), (-6.0, 6.0, 1.6), (6.0, -6.0, 1.6), (-6.0, -6.0, 1.6))


def loop(duration_s: float = 60.0, num_keyframes: int = 120, height_amplitude_m: float = 0.35) -> Trajectory:
    """A walk around the middle, at a height of 1.6 m."""
    path = loop_path(duration_s, unsteadiness_m=0.02, height_amplitude_m=height_amplitude_m, seed=3)
    times = np.linspace(0.0, duration_s, num_keyframes)
    names = tuple(f"{number:04d}.jpg" for number in range(num_keyframes))
    return Trajectory(np.arange(num_keyframes), names, *along(path, times))


def free_bend_m(expected: Expected) -> float:
    """Root mean square bend of the keyframes by the photos alone, metres."""
    path = expected.planned.trajectory
    assert expected.vision is not None
    centers = np.zeros((len(path), 3, len(path), 6))
    centers[np.arange(len(path)), :, np.arange(len(path)), 3:] = np.eye(3)
    bending = GraphBending(expected.vision, path)
    covariance = bending.of_functions(centers.reshape(3 * len(path), -1), frame_is_free=True).formal_m2
    return float(np.sqrt(np.trace(covariance) / len(path)))


def planned(
    anchors_m: Sequence[Place], frame: str, trajectory: Trajectory | None = None, **others: Any
) -> PlannedSurvey:
    """A plan with a radio that ranges five times a second."""
    anchors = tuple(Anchor(f"A{number}", np.array(place)) for number, place in enumerate(anchors_m))
    return PlannedSurvey(trajectory or loop(), anchors, frame, **{"rate_hz": 5.0, **others})
