"""Measure how many outliers each method for the scale survives, with one anchor known in the first camera's frame.

    python -m tests.studies.scale_breakdown [--num_seeds 20] [--plot FILE.png]

A walk around a yard with 300 ranges of stddev 0.1 m, of which a share of 0 to 80 % is wrong:

    long       each by a length of its own (exponential, mean 2 m), as without line of sight
    short      each shortened to between a tenth and nine tenths
    clustered  whole stretches of 15 ranges, each stretch by one length (exponential, mean 2 m)

The methods: the scale stage (consensus, then robust least squares); the paper's mean of the steadier branch of
candidates; the median of that branch; random sampling (RANSAC: one range gives two scales, and the best of 300 trials
is refined on its inliers); and graduated non-convexity (GNC: truncated least squares of the range equation over the
scale, Yang, Antonante, Tzoumas and Carlone, "Graduated Non-Convexity for Robust Spatial Perception", 2020). RANSAC and
GNC are given the noise and know that the radio has no bias; the scale stage estimates both. Runs that it refuses are
left out of its errors and counted.

Prints the median and the ninth decile of the absolute scale error in percent, for each method, kind and share.
``--plot`` draws the medians over the share (package matplotlib).
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from tests.simulated.path import loop_path
from tests.simulated.ranges import simulate_ranges_at

from rangesfm.demo.simulated_radio import Radio
from rangesfm.errors import GeometryError
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import ScaleOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.range_log import RangeLog
from rangesfm.scale.initialize import initialize_scale
from rangesfm.scale.two_candidate import two_candidate

Array = npt.NDArray[np.float64]

SCALE = 2.0
ANCHOR_M = (7.0, 4.0, 3.0)
TAG_IN_CAM_M = (0.05, -0.12, -0.03)
NUM_RANGES = 300
RANGE_STDDEV_M = 0.1
MEAN_EXCESS_M = 2.0
STRETCH = 15
INLIER_M = 2.5 * RANGE_STDDEV_M
SHARES = tuple(0.1 * k for k in range(9))
KINDS = ("long", "short", "clustered")


@dataclass(frozen=True)
class Case:
    """A walk with its ranges, in the first camera's frame.

    Attributes:
        trajectory: unscaled.
        centers, tag_from_center: (n, 3) at the ranges; model units, metres.
        anchor_m: (3,).
        range_m: (n,).
        times: (n,).
    """

    trajectory: Trajectory
    centers: Array
    tag_from_center: Array
    anchor_m: Array
    range_m: Array
    times: Array


def make_case(kind: str, share: float, seed: int) -> Case:
    rng = np.random.default_rng([seed, KINDS.index(kind), round(100 * share)])
    times = np.linspace(0.0, 60.0, NUM_RANGES)
    path = loop_path(60.0, height_amplitude_m=0.6, unsteadiness_m=0.1, start_deg=360 * rng.random(), seed=seed)
    centers_m, world_from_cam = path.centers(times), path.world_from_cam(times)
    radio = Radio(range_stddev_m=RANGE_STDDEV_M)
    ranges = simulate_ranges_at(
        times, centers_m, world_from_cam, {"A": ANCHOR_M}, TAG_IN_CAM_M, radio, seed
    ).log.range_m
    cam_from_world = world_from_cam[0].T
    centers = (centers_m - centers_m[0]) @ cam_from_world.T / SCALE
    rotations = cam_from_world @ world_from_cam
    names = tuple(f"{k:04d}.jpg" for k in range(NUM_RANGES))
    return Case(
        Trajectory(np.arange(1, NUM_RANGES + 1), names, times, centers, rotations),
        centers,
        rotations @ np.array(TAG_IN_CAM_M),
        cam_from_world @ (np.array(ANCHOR_M) - centers_m[0]),
        spoilt(ranges, kind, share, rng),
        times,
    )


def spoilt(ranges: Array, kind: str, share: float, rng: np.random.Generator) -> Array:
    """Make exactly this share of the ranges wrong (of the stretches, if the kind has stretches)."""
    num = len(ranges)
    if kind == "clustered":
        num_stretches = -(-num // STRETCH)
        excess = rng.exponential(MEAN_EXCESS_M, num_stretches) * chosen(num_stretches, share, rng)
        return ranges + np.repeat(excess, STRETCH)[:num]
    wrong = chosen(num, share, rng)
    if kind == "long":
        return ranges + wrong * rng.exponential(MEAN_EXCESS_M, num)
    return np.where(wrong, ranges * rng.uniform(0.1, 0.9, num), ranges)


def chosen(num: int, share: float, rng: np.random.Generator) -> npt.NDArray[np.bool_]:
    return rng.permutation(num) < round(share * num)


def ours(case: Case, seed: int) -> float:
    log = RangeLog.from_arrays(["A"] * NUM_RANGES, case.range_m, timestamp_s=case.times)
    estimate = initialize_scale(
        associate(log, case.trajectory, np.array(TAG_IN_CAM_M)),
        case.trajectory,
        [Anchor("A", case.anchor_m)],
        anchor_frame="first_camera",
        options=ScaleOptions(),
        seed=seed,
    )
    return estimate.value


def paper(case: Case, seed: int) -> float:
    table = two_candidate(case.centers, case.tag_from_center, case.anchor_m, case.range_m)
    return float("nan") if table is None else table.scale


def median_of_duplets(case: Case, seed: int) -> float:
    """Do the same with medians, for the branch that strays less from its own median."""
    table = two_candidate(case.centers, case.tag_from_center, case.anchor_m, case.range_m)
    if table is None:
        return float("nan")
    medians = np.median(table.duplets, axis=0)
    spreads = np.median(np.abs(table.duplets - medians), axis=0)
    return float(medians[np.argmin(spreads)])


def ransac(case: Case, seed: int) -> float:
    table = two_candidate(case.centers, case.tag_from_center, case.anchor_m, case.range_m)
    if table is None:
        return float("nan")
    candidates = table.duplets.ravel()
    candidates = candidates[candidates > 0]
    trials = np.random.default_rng(seed).choice(candidates, min(300, len(candidates)), replace=False)
    num_inliers = [np.sum(np.abs(residuals(case, scale)) < INLIER_M) for scale in trials]
    scale = float(trials[np.argmax(num_inliers)])
    for _ in range(5):
        scale = least_squares(case, scale, (np.abs(residuals(case, scale)) < INLIER_M).astype(np.float64))
    return scale


def gnc(case: Case, seed: int) -> float:
    """Minimize truncated least squares at INLIER_M, from plain least squares and an almost convex surrogate."""
    scale = least_squares(case, 1.0, np.ones(NUM_RANGES))
    squared = residuals(case, scale) ** 2
    mu = INLIER_M**2 / max(2 * float(squared.max()) - INLIER_M**2, 1e-9)
    for _ in range(200):
        weights = truncated_weights(squared, mu)
        scale = least_squares(case, scale, weights)
        squared = residuals(case, scale) ** 2
        mu *= 1.4
        if np.all((weights < 1e-3) | (weights > 1 - 1e-3)):
            break
    return scale


def truncated_weights(squared: Array, mu: float) -> Array:
    """Return the weights of Yang et al., equation 14."""
    inside, outside = mu / (mu + 1) * INLIER_M**2, (mu + 1) / mu * INLIER_M**2
    between = INLIER_M * np.sqrt(mu * (mu + 1) / np.maximum(squared, 1e-12)) - mu
    weights: Array = np.where(squared <= inside, 1.0, np.where(squared >= outside, 0.0, between))
    return weights


def residuals(case: Case, scale: float) -> Array:
    tags = scale * case.centers + case.tag_from_center
    off: Array = np.linalg.norm(tags - case.anchor_m, axis=1) - case.range_m
    return off


def least_squares(case: Case, scale: float, weights: Array) -> float:
    """Minimize over the scale alone by Gauss-Newton, with steps bounded to a factor of two."""
    if not weights.any():
        return scale
    for _ in range(30):
        from_anchor = scale * case.centers + case.tag_from_center - case.anchor_m
        slope = np.sum(from_anchor * case.centers, axis=1) / np.linalg.norm(from_anchor, axis=1)
        step = -float((weights * slope) @ residuals(case, scale)) / float((weights * slope) @ slope)
        scale = float(np.clip(scale + step, 0.5 * scale, 2 * scale))
        if abs(step) < 1e-9 * scale:
            break
    return scale


METHODS: dict[str, Callable[[Case, int], float]] = {
    "scale stage": ours,
    "two-candidate": paper,
    "median of duplets": median_of_duplets,
    "RANSAC": ransac,
    "GNC": gnc,
}


@dataclass(frozen=True)
class Cell:
    """Results of one method at one share of outliers: absolute relative errors, and seeds without an answer."""

    errors: Array
    num_refused: int

    def percent(self, quantile: float) -> float:
        return 100 * float(np.quantile(self.errors, quantile)) if len(self.errors) else float("nan")


def study(kind: str, share: float, num_seeds: int) -> dict[str, Cell]:
    errors: dict[str, list[float]] = {name: [] for name in METHODS}
    for seed in range(num_seeds):
        case = make_case(kind, share, seed)
        for name, method in METHODS.items():
            try:
                errors[name].append(abs(method(case, seed) / SCALE - 1))
            except GeometryError:
                continue
    return {name: Cell(np.array(found), num_seeds - len(found)) for name, found in errors.items()}


def plot(results: dict[str, dict[float, dict[str, Cell]]], path: Path) -> None:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(15, 5), layout="constrained")
    panels = figure.subplots(1, len(KINDS), sharey=True)
    for panel, kind in zip(panels, KINDS, strict=True):
        for name in METHODS:
            medians = [results[kind][share][name].percent(0.5) for share in SHARES]
            width = 3.0 if name == "scale stage" else 1.2
            panel.plot([100 * share for share in SHARES], medians, "o-", linewidth=width, markersize=4, label=name)
        panel.set(title=f"{kind} outliers", xlabel="share of outliers, %", yscale="log", ylim=(0.03, 1e4))
        panel.grid(alpha=0.3)
    panels[0].set_ylabel("median scale error, %")
    panels[0].legend()
    figure.savefig(path, dpi=100)


def main() -> None:
    parser = argparse.ArgumentParser(description="Scale error of five methods over the share of outliers.")
    parser.add_argument("--num_seeds", type=int, default=20)
    parser.add_argument("--plot", type=Path, metavar="FILE.png")
    args = parser.parse_args()
    print(
        f"{args.num_seeds} seeds, {NUM_RANGES} ranges, {RANGE_STDDEV_M} m; median / ninth decile of the error, percent"
    )
    print(f"{'kind':10} {'share':>6}" + "".join(f" {name:>18}" for name in METHODS) + "   refused")
    results: dict[str, dict[float, dict[str, Cell]]] = {kind: {} for kind in KINDS}
    for kind in KINDS:
        for share in SHARES:
            cells = results[kind][share] = study(kind, share, args.num_seeds)
            text = "".join(f" {cell.percent(0.5):9.2f} /{cell.percent(0.9):7.1f}" for cell in cells.values())
            print(f"{kind:10} {100 * share:5.0f}%{text}   {cells['scale stage'].num_refused}", flush=True)
    if args.plot is not None:
        plot(results, args.plot)


if __name__ == "__main__":
    main()
