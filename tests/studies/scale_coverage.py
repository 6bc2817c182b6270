"""Measure how often the 95 % interval of the scale covers the truth, on simulated surveys with realistic range errors.

Run: python -m tests.studies.scale_coverage --rows FILE [--num_seeds 300] [--surveys "one known"]

When started again with the same file, the study continues where it was stopped.

Each survey has a radio of its own, drawn from the population (``rangesfm.ranging.errors.components``). Its errors are
drawn as functions of time, place, distance and direction, and its map has a bend. In the calibrated cases the error
curve is known to 0.01 m; in the cases by photo, ranges name the nearest photo instead of a time. Prints for each case
of anchors the share of intervals that cover the true scale with its standard error, the median half width, the median
and the largest error, the part of the errors' mean square that the stated stddev explains (1: all), and how many
surveys were refused.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from tests.simulated.path import loop_path
from tests.simulated.surveys import METRES_PER_UNIT, measured
from tests.studies.kept_runs import Row, study
from tests.studies.planned_surveys import along
from tests.studies.real_logs import at_photos

from rangesfm.errors import GeometryError
from rangesfm.options import ScaleOptions
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.errors.components import COMPONENTS
from rangesfm.scale.initialize import initialize_scale

Array = npt.NDArray[np.float64]

ANCHORS_M = {
    "A": (6.0, 0.5, 2.5),
    "B": (-6.0, 1.0, 0.4),
    "C": (0.5, 6.0, 3.0),
    "D": (1.0, -6.0, 0.2),
    "E": (5.0, 5.0, 0.3),
    "F": (-5.0, 4.5, 2.8),
    "G": (-4.5, -5.0, 0.5),
    "H": (5.0, -4.5, 2.2),
}
TAG_IN_CAM_M = (0.05, -0.1, -0.05)
DURATION_S, RATE_HZ, KEYFRAME_RATE_HZ = 90.0, 3.0, 2.0
LEARNT_STDDEV_M = 0.01


@dataclass(frozen=True)
class Case:
    """A case: anchors with ranges, their frame, whether an error curve was learnt, and whether ranges name photos."""

    name: str
    heard: str
    frame: str
    is_calibrated: bool = False
    by_photo: bool = False


BY_TIME = (
    Case("one known", "A", "first_camera"),
    Case("one unknown", "A", "unknown"),
    Case("one known, calibrated", "A", "first_camera", is_calibrated=True),
    Case("one unknown, calibrated", "A", "unknown", is_calibrated=True),
    Case("eight surveyed", "ABCDEFGH", "site"),
    Case("eight unknown", "ABCDEFGH", "unknown"),
    Case("eight surveyed, calibrated", "ABCDEFGH", "site", is_calibrated=True),
    Case("eight unknown, calibrated", "ABCDEFGH", "unknown", is_calibrated=True),
)
CASES = (*BY_TIME, *(replace(case, name=f"photos, {case.name}", by_photo=True) for case in BY_TIME))


def main() -> None:
    asked = study(__doc__)
    print(f"{'case':36}{'covered':>14}{'half width':>12}{'median err':>12}{'worst':>8}{'explained':>11}{'refused':>9}")
    for case in CASES:
        if case.name.startswith(asked.beginning):
            rows = asked.runs_of(case.name, lambda seed, case=case: one_survey(case, seed))  # type: ignore[misc]
            found = [row for row in rows if "error" in row]
            print(f"{case.name:36}{summary(found)}{len(rows) - len(found):9}", flush=True)


def summary(rows: list[Row]) -> str:
    """Summarize the surveys that were not refused."""
    errors, low, high, stddevs = (np.array([row[name] for row in rows]) for name in ("error", "low", "high", "stddev"))
    covered, widths = float(np.mean((low <= -errors) & (-errors <= high))), (high - low) / 2
    return (
        f"{100 * covered:7.1f} +-{100 * np.sqrt(0.95 * 0.05 / len(rows)):3.1f} %{100 * np.median(widths):10.2f} %"
        f"{100 * np.median(np.abs(errors)):10.2f} %{100 * np.abs(errors).max():6.2f} %"
        f"{np.mean(stddevs**2) / np.mean(errors**2):11.2f}"
    )


def one_survey(case: Case, seed: int) -> Row:
    """Return the error of the scale's logarithm, its interval about the estimate and its stddev; nothing if refused."""
    planned = PlannedSurvey(
        along(loop_path(DURATION_S, unsteadiness_m=0.3, seed=seed), KEYFRAME_RATE_HZ),
        tuple(Anchor(name, np.array(ANCHORS_M[name])) for name in case.heard),
        case.frame,
        RATE_HZ,
        TAG_IN_CAM_M,
        curve_stddev_m=LEARNT_STDDEV_M if case.is_calibrated else None,
        component_stddevs=drawn_radio(seed, is_calibrated=case.is_calibrated),
    )
    made = measured(planned, seed)
    observations, trajectory = made.observations, made.trajectory
    if case.by_photo:
        log, trajectory, _ = at_photos(observations.log, trajectory, 0.0)
        observations = associate(log, trajectory, TAG_IN_CAM_M)
    options = ScaleOptions(max_relative_stddev=0.2)
    try:
        found = initialize_scale(
            observations, trajectory, made.anchors, anchor_frame=case.frame, options=options, seed=seed
        )
    except GeometryError:
        return {}
    low, high = found.uncertainty.interval_95
    return {
        "error": float(np.log(found.value / METRES_PER_UNIT)),
        "low": low,
        "high": high,
        "stddev": found.uncertainty.empirical,
    }


def drawn_radio(seed: int, *, is_calibrated: bool) -> dict[str, float]:
    """Draw the stddevs of the components of a radio's errors."""
    rng = np.random.default_rng((seed, 1))
    medians = [c.calibrated_median if is_calibrated and c.calibrated_median else c.median for c in COMPONENTS]
    sizes = np.exp(np.array([c.spread for c in COMPONENTS]) * rng.standard_normal(len(COMPONENTS)))
    return {c.name: float(size * median) for c, size, median in zip(COMPONENTS, sizes, medians, strict=True)}


if __name__ == "__main__":
    main()
