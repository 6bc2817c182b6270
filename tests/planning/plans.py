"""Plans of surveys, and simulated outcomes of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.simulated.path import loop_path

from rangesfm.geometry.trajectory import Trajectory
from rangesfm.planning.expected import Expected
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.range_observations import RangeObservations

Array = npt.NDArray[np.float64]
Place = tuple[float, float, float]

FIVE_ANCHORS_M = ((6.0, 0.0, 2.5), (-6.0, 1.0, 0.4), (0.5, 6.0, 3.0), (1.0, -6.0, 0.2), (5.0, 5.0, 1.0))
COPLANAR_M = ((6.0, 6.0, 1.6), (-6.0, 6.0, 1.6), (6.0, -6.0, 1.6), (-6.0, -6.0, 1.6))


def loop(duration_s: float = 60.0, num_keyframes: int = 120, height_amplitude_m: float = 0.35) -> Trajectory:
    """A walk around the middle, at a height of 1.6 m."""
    path = loop_path(duration_s, unsteadiness_m=0.02, height_amplitude_m=height_amplitude_m, seed=3)
    times = np.linspace(0.0, duration_s, num_keyframes)
    names = tuple(f"{number:04d}.jpg" for number in range(num_keyframes))
    return Trajectory(np.arange(num_keyframes), names, times, path.centers(times), path.world_from_cam(times))


def planned(
    anchors_m: Sequence[Place], frame: str, trajectory: Trajectory | None = None, **others: Any
) -> PlannedSurvey:
    """A plan with a radio that ranges five times a second."""
    anchors = tuple(Anchor(f"A{number}", np.array(place)) for number, place in enumerate(anchors_m))
    return PlannedSurvey(trajectory or loop(), anchors, frame, **{"rate_hz": 5.0, **others})


def turned_out(expected: Expected, seed: int) -> RangeObservations:
    """Simulate an outcome of a plan: its ranges with errors drawn from the expected ones."""
    rng = np.random.default_rng(seed)
    learned, log = expected.learned, expected.observations.log
    white = learned.names.index("white")
    together = learned.covariance_m2 - learned.covariances_m2[white]
    together += 1e-10 * np.trace(together) * np.eye(len(together))
    of_bins = np.linalg.cholesky(together) @ rng.standard_normal(len(together))
    errors = of_bins[learned.of_range] + learned.stddevs[white] * rng.standard_normal(len(learned.of_range))
    ranges = log.range_m.copy()
    ranges[expected.posed.rows] += errors
    return replace(expected.observations, log=replace(log, range_m=np.maximum(ranges, 0.05)))
