"""How often the 95 % interval of the scale covers the truth, on simulated surveys with errors as real radios have them.

Run: python tests/studies/scale_coverage.py [--num_seeds 40] [--seed 0]

Errors: white noise; errors of each anchor that last for seconds (first-order autoregressive); a bias that depends on
the direction from which the antenna sees the anchor; an error curve over distance of either sign, common to all
anchors; bursts without line of sight. Prints for each case of anchors the share of intervals that cover the true
scale, the median half width, the median and the largest error, and how many surveys were refused.
"""

from __future__ import annotations

import argparse
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from rangesfm.errors import GeometryError
from rangesfm.geometry import Similarity
from rangesfm.options import ScaleOptions
from rangesfm.ranging.anchors import Anchor
from rangesfm.ranging.association import associate
from rangesfm.scale.initialize import initialize_scale
from rangesfm.simulate.path import loop_path
from rangesfm.simulate.ranges import Radio, SimulatedRanges, simulate_ranges
from rangesfm.trajectory import Trajectory

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
# Name, anchors that are heard, and the frame in which they are given.
CASES = (
    ("eight surveyed", "ABCDEFGH", "site"),
    ("one known", "A", "first_camera"),
    ("eight unknown", "ABCDEFGH", "unknown"),
    ("one unknown", "A", "unknown"),
)
TAG_IN_CAM_M = (0.05, -0.1, -0.05)
DURATION_S, RATE_HZ, KEYFRAME_RATE_HZ = 90.0, 5.0, 2.0
MEMORY_S, DRIFTING_STDDEV_M, DIRECTION_STDDEV_M, CURVE_STDDEV_M = 3.0, 0.06, 0.05, 0.07
BURST_SHARE, BURST_S, BURST_MEAN_M = 0.08, 2.0, 0.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_seeds", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="of the first survey")
    args = parser.parse_args()
    print(f"{'case':16}{'covered':>9}{'half width':>12}{'median err':>12}{'worst err':>11}{'refused':>9}")
    for name, heard, frame in CASES:
        rows = [one_survey(heard, frame, seed) for seed in range(args.seed, args.seed + args.num_seeds)]
        found = np.array([row for row in rows if row is not None])
        covered, widths, errors = found[:, 1] <= found[:, 0], found[:, 0], found[:, 1]
        print(
            f"{name:16}{100 * covered.mean():7.1f} %{100 * np.median(widths):10.2f} %{100 * np.median(errors):10.2f} %"
            f"{100 * errors.max():9.2f} %{len(rows) - len(found):9}",
            flush=True,
        )


def one_survey(heard: str, frame: str, seed: int) -> tuple[float, float] | None:
    """Half width of the interval and absolute error of the scale, both of its logarithm; None if refused."""
    path = loop_path(DURATION_S, unsteadiness_m=0.3, seed=seed)
    anchors_m = {name: np.array(ANCHORS_M[name]) for name in heard}
    simulated = simulate_ranges(path, anchors_m, TAG_IN_CAM_M, Radio(rate_hz=RATE_HZ, range_stddev_m=0.05), seed)
    times = np.arange(0.0, DURATION_S, 1 / KEYFRAME_RATE_HZ)
    true = Trajectory(
        np.arange(1, len(times) + 1),
        tuple(f"{k:04d}.jpg" for k in range(len(times))),
        times,
        path.centers(times),
        path.world_from_cam(times),
    )
    scale = 2.0
    first_camera_from_site = Similarity(1.0, true.world_from_cam[0].T, -true.world_from_cam[0].T @ true.centers[0])
    at = first_camera_from_site.apply if frame == "first_camera" else np.array
    anchors = [Anchor(name, None if frame == "unknown" else at(position)) for name, position in anchors_m.items()]
    tags = path.centers(simulated.image_time_s) + path.world_from_cam(simulated.image_time_s) @ np.array(TAG_IN_CAM_M)
    rng = np.random.default_rng(seed + 10_000)
    ranges = simulated.log.range_m + radio_errors(simulated, tags, np.array(list(anchors_m.values())), rng)
    log = replace(simulated.log, range_m=np.maximum(ranges, 0.05))
    trajectory = true.transformed(1 / scale, np.eye(3), np.zeros(3))
    observations = associate(log, trajectory, TAG_IN_CAM_M)
    options = ScaleOptions(max_relative_stddev=0.2)
    try:
        found = initialize_scale(observations, trajectory, anchors, anchor_frame=frame, options=options, seed=seed)
    except GeometryError:
        return None
    return found.uncertainty.half_width_95, abs(float(np.log(found.value / scale)))


def radio_errors(simulated: SimulatedRanges, tags: Array, anchors: Array, rng: np.random.Generator) -> Array:
    """(n,) all but the white noise, metres."""
    index, times, distance = simulated.log.anchor_index, simulated.image_time_s, simulated.distance_m
    direction = (anchors[index] - tags) / distance[:, None]
    errors: Array = error_curve(distance, rng)
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
    """A draw of a Gaussian process in the logarithm of distance, of one e-fold's length."""
    knots = np.linspace(np.log(0.3), np.log(30.0), 40)
    covariance = np.exp(-0.5 * (knots[:, None] - knots) ** 2) + 1e-9 * np.eye(len(knots))
    curve = CURVE_STDDEV_M * np.linalg.cholesky(covariance) @ rng.standard_normal(len(knots))
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
