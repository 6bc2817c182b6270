"""How often the 95 % interval of the scale covers the truth, on simulated surveys with errors as real radios have them.

Run: python -m tests.studies.scale_coverage [--num_seeds 100] [--seed 0] [--cases one]

Errors: white noise; errors of each anchor that last for seconds (first-order autoregressive); a bias that depends on
the direction from which the antenna sees the anchor; an error curve over distance of either sign, common to all
anchors; bursts without line of sight. In the calibrated cases the curve is known to 0.01 m. No two cases share their
errors. Prints for each case of anchors the share of intervals that cover the true scale with its standard error, the
median half width, the median and the largest error, the part of the errors' mean square that the stated stddev
explains (1: all), and how many surveys were refused.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from tests.simulated.path import loop_path

from rangesfm.demo.ranges import CameraPath, Radio, SimulatedRanges, simulate_ranges
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import ScaleOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.log import RangeLog
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
MEMORY_S, DRIFTING_STDDEV_M, DIRECTION_STDDEV_M, CURVE_STDDEV_M, LEARNT_STDDEV_M = 3.0, 0.06, 0.05, 0.07, 0.01
BURST_SHARE, BURST_S, BURST_MEAN_M = 0.08, 2.0, 0.5


@dataclass(frozen=True)
class Case:
    """Which anchors are heard, the frame in which they are given, and whether the radio's error curve was learnt."""

    name: str
    heard: str
    frame: str
    is_calibrated: bool = False

    @property
    def curve_stddev_m(self) -> float:
        return LEARNT_STDDEV_M if self.is_calibrated else CURVE_STDDEV_M


CASES = (
    Case("one known", "A", "first_camera"),
    Case("one unknown", "A", "unknown"),
    Case("one known, calibrated", "A", "first_camera", is_calibrated=True),
    Case("one unknown, calibrated", "A", "unknown", is_calibrated=True),
    Case("eight surveyed", "ABCDEFGH", "site"),
    Case("eight unknown", "ABCDEFGH", "unknown"),
    Case("eight surveyed, calibrated", "ABCDEFGH", "site", is_calibrated=True),
    Case("eight unknown, calibrated", "ABCDEFGH", "unknown", is_calibrated=True),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_seeds", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0, help="of the first survey")
    parser.add_argument("--cases", default="", help="only those whose name begins so")
    args = parser.parse_args()
    print(f"{'case':28}{'covered':>14}{'half width':>12}{'median err':>12}{'worst':>8}{'explained':>11}{'refused':>9}")
    for number, case in enumerate(CASES):
        if case.name.startswith(args.cases):
            rows = [one_survey(case, (seed, number)) for seed in range(args.seed, args.seed + args.num_seeds)]
            print(f"{case.name:28}{summary([row for row in rows if row])}{sum(not row for row in rows):9}", flush=True)


def summary(rows: list[tuple[float, float, float]]) -> str:
    """Of half widths of intervals, absolute errors and stddevs, all relative."""
    widths, errors, stddevs = np.array(rows).T
    covered = float(np.mean(errors <= widths))
    return (
        f"{100 * covered:7.1f} +-{100 * np.sqrt(0.95 * 0.05 / len(rows)):3.1f} %{100 * np.median(widths):10.2f} %"
        f"{100 * np.median(errors):10.2f} %{100 * errors.max():6.2f} %{np.mean(stddevs**2) / np.mean(errors**2):11.2f}"
    )


def one_survey(case: Case, seed: tuple[int, int]) -> tuple[float, float, float] | None:
    """Half width of the interval, absolute error and stated stddev of the scale's logarithm; None if refused."""
    path = loop_path(DURATION_S, unsteadiness_m=0.3, seed=seed[0])
    anchors_m = {name: np.array(ANCHORS_M[name]) for name in case.heard}
    rng = np.random.default_rng(seed)
    radio = Radio(rate_hz=RATE_HZ, range_stddev_m=0.05)
    simulated = simulate_ranges(path, anchors_m, TAG_IN_CAM_M, radio, int(rng.integers(2**31)))
    times = np.arange(0.0, DURATION_S, 1 / KEYFRAME_RATE_HZ)
    true = Trajectory(
        np.arange(1, len(times) + 1),
        tuple(f"{k:04d}.jpg" for k in range(len(times))),
        times,
        path.centers(times),
        path.world_from_cam(times),
    )
    scale = 2.0
    trajectory = true.transformed(1 / scale, np.eye(3), np.zeros(3))
    observations = associate(erring_log(case, simulated, path, anchors_m, rng), trajectory, TAG_IN_CAM_M)
    options = ScaleOptions(max_relative_stddev=0.2)
    anchors = given_anchors(case, anchors_m, true)
    try:
        found = initialize_scale(
            observations, trajectory, anchors, anchor_frame=case.frame, options=options, seed=seed[0]
        )
    except GeometryError:
        return None
    return found.uncertainty.half_width_95, abs(float(np.log(found.value / scale))), found.uncertainty.empirical


def given_anchors(case: Case, anchors_m: dict[str, Array], true: Trajectory) -> list[Anchor]:
    if case.frame == "unknown":
        return [Anchor(name, None) for name in anchors_m]
    if case.frame == "site":
        return [Anchor(name, position) for name, position in anchors_m.items()]
    first_camera_from_site = Similarity(1.0, true.world_from_cam[0].T, -true.world_from_cam[0].T @ true.centers[0])
    return [Anchor(name, first_camera_from_site.apply(position)) for name, position in anchors_m.items()]


def erring_log(
    case: Case, simulated: SimulatedRanges, path: CameraPath, anchors_m: dict[str, Array], rng: np.random.Generator
) -> RangeLog:
    times = simulated.image_time_s
    tags = path.centers(times) + path.world_from_cam(times) @ np.array(TAG_IN_CAM_M)
    errors = radio_errors(simulated, tags, np.array(list(anchors_m.values())), case.curve_stddev_m, rng)
    ranges = np.maximum(simulated.log.range_m + errors, 0.05)
    shared = np.full(len(ranges), LEARNT_STDDEV_M) if case.is_calibrated else None
    return replace(simulated.log, range_m=ranges, shared_stddev_m=shared)


def radio_errors(
    simulated: SimulatedRanges, tags: Array, anchors: Array, curve_stddev_m: float, rng: np.random.Generator
) -> Array:
    """(n,) all but the white noise, metres."""
    index, times, distance = simulated.log.anchor_index, simulated.image_time_s, simulated.distance_m
    direction = (anchors[index] - tags) / distance[:, None]
    errors: Array = curve_stddev_m * error_curve(distance, rng)
    for k in range(len(anchors)):
        rows = np.flatnonzero(index == k)
        errors[rows] += drifting(times[rows], rng)
        # A smooth function of the direction: a random quadratic form, as antennas have lobes.
        form = rng.normal(0, DIRECTION_STDDEV_M, (3, 3))
        errors[rows] += np.einsum("ni,ij,nj->n", direction[rows], form, direction[rows])
        block = np.floor(times[rows] / BURST_S).astype(np.int64)
        is_blocked = rng.random(block.max() + 1) < BURST_SHARE
        errors[rows] += is_blocked[block] * rng.exponential(BURST_MEAN_M, len(rows))
    return errors


def error_curve(distance: Array, rng: np.random.Generator) -> Array:
    """A draw of a Gaussian process in the logarithm of distance, of stddev 1 and one e-fold's length."""
    knots = np.linspace(np.log(0.3), np.log(30.0), 40)
    covariance = np.exp(-0.5 * (knots[:, None] - knots) ** 2) + 1e-9 * np.eye(len(knots))
    curve = np.linalg.cholesky(covariance) @ rng.standard_normal(len(knots))
    return np.interp(np.log(distance), knots, curve)


def drifting(times: Array, rng: np.random.Generator) -> Array:
    """First-order autoregressive errors at ascending times."""
    kept = np.exp(-np.diff(times) / MEMORY_S)
    errors = np.empty(len(times))
    errors[0] = rng.standard_normal()
    for i, share in enumerate(kept, start=1):
        errors[i] = share * errors[i - 1] + np.sqrt(1 - share**2) * rng.standard_normal()
    return DRIFTING_STDDEV_M * errors


if __name__ == "__main__":
    main()
