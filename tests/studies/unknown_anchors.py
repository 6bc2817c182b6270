"""Count how often the scale from anchors at unknown positions is right, refused or wrong.

    python -m tests.studies.unknown_anchors [--num_seeds 5]

Each survey has 60 keyframes and three ranges of stddev 0.05 m to each anchor at each of them; outliers are too long by
an exponential length of 2 m on average. The paths: a walk around a yard that rises and falls, the same at one height, a
straight line, a flat circle and a path on a sphere. A scale counts as right within three of its stated stddevs (the
larger of formal and empirical), as wrong beyond, and as refused with a GeometryError. Prints the three counts and the
median error of what was not refused.

On a flat circle any scale fits unknown anchors, however many (their heights make up for it), and on a sphere one anchor
leaves two scales. Refusing is right there, unless the lever arm or several anchors break the symmetry.
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np
import numpy.typing as npt
from tests.simulated.path import loop_path, orbit_path
from tests.simulated.ranges import simulate_ranges_at

from rangesfm.demo.simulated_radio import Radio
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import ScaleOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.scale.initialize import initialize_scale

Array = npt.NDArray[np.float64]

SCALE = 2.0
NUM_KEYFRAMES, NUM_EPOCHS = 60, 3
TIMES = np.linspace(0.0, 60.0, NUM_KEYFRAMES)
ANCHORS_M = {"A": (6.5, 1.0, 2.8), "B": (-6.0, 2.0, 0.4), "C": (0.5, -6.5, 3.0)}
PATHS = ("walk", "flat walk", "line", "circle", "sphere")
LEVERS_M = ((0.0, 0.0, 0.0), (0.05, -0.25, -0.1))
OUTLIER_SHARES = (0.0, 0.3, 0.5)


def centers_of(path: str, seed: int) -> Array:
    """(n, 3) centres, metres."""
    if path in ("walk", "flat walk"):
        amplitude = 0.0 if path == "flat walk" else 0.8
        centers = loop_path(60.0, height_amplitude_m=amplitude, unsteadiness_m=0.1, seed=seed).centers(TIMES)
        if path == "flat walk":
            centers[:, 2] = 1.6
        return centers
    if path == "line":
        return np.stack([np.linspace(-5.0, 5.0, NUM_KEYFRAMES), np.zeros(NUM_KEYFRAMES), np.full(60, 1.6)], axis=1)
    centers = orbit_path(60.0, radius_m=4.0, height_amplitude_m=0.0 if path == "circle" else 2.0).centers(TIMES)
    round_the_middle: Array = 4.0 * centers / np.linalg.norm(centers, axis=1, keepdims=True) + [0.0, 0.0, 1.6]
    return round_the_middle


def estimate_once(
    path: str, num_anchors: int, share: float, lever_m: tuple[float, float, float], seed: int
) -> tuple[float, float]:
    """Return the relative error and the stated stddev of the scale."""
    centers = centers_of(path, seed)
    world_from_cam = loop_path(60.0, seed=seed).world_from_cam(TIMES)
    world_from_sfm = Similarity(SCALE, world_from_cam[0], centers[0])
    inverse = world_from_sfm.inverse()
    names = tuple(f"{k:04d}.jpg" for k in range(NUM_KEYFRAMES))
    metric = Trajectory(np.arange(1, NUM_KEYFRAMES + 1), names, TIMES, centers, world_from_cam)
    trajectory = metric.transformed(inverse.scale, inverse.rotation, inverse.translation)
    anchors_m = {name: ANCHORS_M[name] for name in list(ANCHORS_M)[:num_anchors]}
    radio = Radio(range_stddev_m=0.05, obstructed_share=share, obstructed_mean_m=2.0)
    poses = np.repeat(np.arange(NUM_KEYFRAMES), NUM_EPOCHS)
    log = simulate_ranges_at(TIMES[poses], centers[poses], world_from_cam[poses], anchors_m, lever_m, radio, seed).log
    found = initialize_scale(
        associate(log, trajectory, np.array(lever_m)),
        trajectory,
        [Anchor(name) for name in anchors_m],
        anchor_frame="unknown",
        options=ScaleOptions(),
        seed=seed,
    )
    return found.value / SCALE - 1, max(found.uncertainty.formal, found.uncertainty.empirical)


def main() -> None:
    parser = argparse.ArgumentParser(description="Scale from unknown anchors over paths, outliers and lever arms.")
    parser.add_argument("--num_seeds", type=int, default=5)
    num_seeds = parser.parse_args().num_seeds
    print(f"{'path':10} anchors outliers lever   right wrong refused   median error")
    for path, num_anchors, share, lever_m in product(PATHS, (1, 3), OUTLIER_SHARES, LEVERS_M):
        errors, num_right, num_refused = [], 0, 0
        for seed in range(num_seeds):
            try:
                error, stddev = estimate_once(path, num_anchors, share, lever_m, seed)
            except GeometryError:
                num_refused += 1
                continue
            errors.append(abs(error))
            num_right += abs(error) < 3 * stddev
        median = f"{100 * np.median(errors):8.2f} %" if errors else "       -"
        counts = f"{num_right:8} {len(errors) - num_right:5} {num_refused:7}"
        print(f"{path:10} {num_anchors:7} {100 * share:6.0f} % {any(lever_m)!s:5} {counts}   {median}", flush=True)


if __name__ == "__main__":
    main()
