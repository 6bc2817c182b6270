"""Check how clean surveys of drifting maps are judged: what is kept, what is stated, and what is wrongly named.

Run: python -m tests.studies.drifting_maps [--kinds lap hall ...] [--num_seeds 2] [--seed 0] [--out FILE]

These surveys have only the errors that all surveys have: features are noisy (0.7 pixels in the hall), so that COLMAP's
bundle adjustment of them bends and drifts, and radios have errors.

- ``lap``: a rover's lap of 300 m around a field, forward camera, tracks of at most 8 photos, no loop closed, one anchor
  on a mast beside the middle, known in the first camera's frame, Gaussian ranges of 0.1 m. The number of features in a
  photo and their noise give it a drift of 0.2, 0.5, 1, 2, 5 and 15 m on average over seeds.
- ``lap_unknown``: the same with an unknown anchor. ``lap_site``: four surveyed anchors around the field.
- ``lap_radio``: like ``lap_site``, with a radio drawn from the population of real ones, one range in 25 obstructed.
- ``hall``: 120 s in a hall, tracks of at most 8 photos, six surveyed anchors, with the same kind of radio.
- ``poses``: keyframes of ``lap_site`` with such a radio and without points, scaled only.
- ``desk``: real monocular keyframes (ORB-SLAM on TUM's fr2_desk), scaled only, with four surveyed anchors around the
  desk and simulated ranges of 0.08 m. Needs --data.

Prints for each kind: how many refined maps are nearer to the truth than the scaled map, and how many of these are kept;
how many of the delivered scales lie in their 95 % interval, and its median half width; errors of scale and of keyframes
in their stated stddevs (root mean square: 1 if the stddevs are honest); and how many surveys are doubted, and have a
mistake named. With --out each run is a line of a file, and runs that are there already are not repeated.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from tests.simulated.path import lap_path
from tests.simulated.runs import run_stages
from tests.simulated.surveys import HALL, TAG_IN_CAM_M, Kind, MadeSurvey, expected_drift_m, in_turn, made, truth_of
from tests.studies.kept_runs import run_seeds, seeds_parser

from rangesfm.errors import GeometryError, SolverError
from rangesfm.util.geometry.similarity import align_points, rmse
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Line = dict[str, Any]

LEVELS_M = (0.2, 0.5, 1.0, 2.0, 5.0, 15.0)
MAST_M = {"A1": (10.0, 5.0, 8.0)}
# At heights that distinguish the map from its mirror image.
ROUND_THE_FIELD_M = {"N": (5.0, 52.0, 14.0), "E": (68.0, -4.0, 2.0), "S": (-8.0, -50.0, 18.0), "W": (-66.0, 9.0, 4.0)}


def lap(seed: int, anchor_frame: str = "first_camera", *, with_radio: bool = False) -> MadeSurvey:
    """Simulate one lap; successive seeds go through the levels of drift."""
    return lap_of_drift(LEVELS_M[seed % len(LEVELS_M)], seed, anchor_frame, with_radio=with_radio)


def lap_of_drift(
    level_m: float,
    seed: int,
    anchor_frame: str = "first_camera",
    *,
    with_radio: bool = False,
    num_keyframes: int = 600,
) -> MadeSurvey:
    """Simulate one lap with this drift on average."""
    num_observations = 150 if level_m < 3 else 60 if level_m < 10 else 40
    anchors_m = ROUND_THE_FIELD_M if anchor_frame == "site" else MAST_M
    path, times = lap_path(300.0, share=0.98), np.linspace(0.0, 300.0, num_keyframes)
    truth = truth_of(path, times, anchors_m, anchor_frame, num_observations, (6.0, 40.0))
    pixels = level_m / expected_drift_m(truth)
    return made(truth, path, np.repeat(times, len(anchors_m)), pixels, seed, with_radio=with_radio)


def hall(seed: int) -> MadeSurvey:
    kind, path = replace(HALL, num_observations=120, tag_in_cam_m=Kind.tag_in_cam_m), HALL.path(seed)
    truth = kind.truth(path)
    return made(truth, path, in_turn(kind, path, truth), kind.pixel_stddev, seed)


def poses(seed: int) -> MadeSurvey:
    return without_points(lap(seed, "site", with_radio=True))


def without_points(survey: MadeSurvey) -> MadeSurvey:
    """Return the survey with its path alone, which can only be scaled."""
    return replace(survey, sfm=None)


def desk(folder: Path, seed: int) -> MadeSurvey:
    """Read real keyframes, matched with the truth by time; those in gaps of the truth are left out."""
    keyframes, truth = (np.loadtxt(folder / name) for name in ("fr2_desk_ORB_kf_mono.txt", "fr2_desk_groundtruth.txt"))
    rng = np.random.default_rng([seed, 11])
    nearest = np.abs(truth[:, 0] - keyframes[:, :1]).argmin(axis=1)
    known = np.abs(truth[nearest, 0] - keyframes[:, 0]) < 0.02
    keyframes, truth = keyframes[known], truth[nearest[known]]
    times, centers_m = keyframes[:, 0] - keyframes[0, 0], truth[:, 1:4]
    true_cam, seen_cam = (Rotation.from_quat(rows[:, 4:8]).as_matrix() for rows in (truth, keyframes))
    middle, size = centers_m.mean(axis=0), np.ptp(centers_m, axis=0)
    corners = np.array([(-1, -1, 0.3), (1, -1, -0.6), (1, 1, 0.8), (-1, 1, -0.2)])
    anchors_m = {f"A{k}": middle + corner * (0.6 * size + 0.8) for k, corner in enumerate(corners, 1)}
    path = Trajectory(
        np.arange(1, len(times) + 1), tuple(f"{k:05d}.png" for k in range(len(times))), times, keyframes[:, 1:4],
        seen_cam,
    )  # fmt: skip
    at = np.repeat(np.arange(len(times)), len(anchors_m))
    ids = np.tile(np.arange(len(anchors_m)), len(times))
    tags_m = centers_m[at] + true_cam[at] @ TAG_IN_CAM_M
    survey = MadeSurvey(
        None, path, anchors_m, "site", TAG_IN_CAM_M, times[at], ids, np.zeros(len(at)), tags_m, true_cam[at], anchors_m,
        centers_m, align_points(path.centers, centers_m).scale,
    )  # fmt: skip
    survey.range_m = survey.distances_m + 0.08 * rng.normal(size=len(at))
    return survey


def told(survey: MadeSurvey, kind: str, seed: int) -> Line:
    """Run a survey, and return the figures that the report needs."""
    line: Line = {"kind": kind, "seed": seed}
    try:
        metric = run_stages(survey, seed)
    except (GeometryError, SolverError) as error:
        return {**line, "refused": str(error)}
    scaled_m, final_m = (metric.trajectory.as_in(model).centers for model in (metric.scaled, metric.final))
    estimate, refined = metric.estimate, metric.refined
    # The interval belongs to the delivered map, so the error is that of its scale.
    delivered = estimate.value if metric.kept is None else metric.kept.scale
    low, high = estimate.interval_95
    variances = metric.center_covariance_m2
    known = np.array([variances[name] for name in metric.trajectory.image_names]) if variances else None
    refined_m = None if refined is None else metric.trajectory.as_in(refined.model).centers
    off_m = final_m - survey.true_centers_m
    return {
        **line,
        "refused": "",
        "scaled_m": rmse(scaled_m - survey.true_centers_m),
        "final_m": rmse(off_m),
        "refined_m": None if refined_m is None else rmse(refined_m - survey.true_centers_m),
        "kept": metric.kept is not None,
        "why_not": [] if refined is None else list(refined.why_broken),
        "log_error": float(np.log(delivered / survey.metres_per_unit)),
        "half_width": estimate.uncertainty.half_width_95,
        "stddev": estimate.uncertainty.empirical,
        "covered": bool(low <= survey.metres_per_unit <= high),
        "places": None if known is None else float(np.sqrt(np.mean(np.sum(off_m**2, axis=1) / _traces(known)))),
        "places_covered": None if known is None else _covered(off_m, known),
        "verdict": estimate.verdict,
        "reasons": list(estimate.reasons),
        "causes": [f"{c.name} {c.subject}".strip() for c in metric.diagnosis.causes],
        "of_evidence": [t.name for t in metric.diagnosis.tests if t.rejected and not t.stddev],
    }


def _traces(covariances: Array) -> Array:
    return np.asarray(np.maximum(np.trace(covariances, axis1=1, axis2=2), 1e-12))


def _covered(off_m: Array, covariances: Array) -> float:
    """Return the share of coordinates within 1.96 of their stddevs, over all keyframes that are not held."""
    stddevs = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    free = stddevs.min(axis=1) > 1e-9
    return float(np.mean(np.abs(off_m[free]) <= 1.96 * stddevs[free]))


def surveys(data: Path | None) -> dict[str, Callable[[int], MadeSurvey]]:
    """Functions that simulate a survey, by kind."""
    found: dict[str, Callable[[int], MadeSurvey]] = {
        "lap": lap,
        "lap_unknown": lambda seed: lap(seed, "unknown"),
        "lap_site": lambda seed: lap(seed, "site"),
        "lap_radio": lambda seed: lap(seed, "site", with_radio=True),
        "hall": hall,
        "poses": poses,
    }
    if data is not None:
        found["desk"] = lambda seed: desk(data / "slam_keyframes", seed)
    return found


def report(lines: list[Line]) -> Iterator[str]:
    """Yield a row for each kind."""
    for kind in dict.fromkeys(line["kind"] for line in lines):
        own = [line for line in lines if line["kind"] == kind]
        judged = [line for line in own if not line["refused"]]
        if not judged:
            yield f"{kind:12}{len(own):4} runs, all refused"
            continue
        refined = [line for line in judged if line["refined_m"] is not None]
        nearer = [line for line in refined if line["refined_m"] < line["scaled_m"]]
        in_stddevs = np.array([line["log_error"] / line["stddev"] for line in judged])
        places = [line["places"] for line in judged if line["places"] is not None]
        share = [line["places_covered"] for line in judged if line["places_covered"] is not None]
        yield (
            f"{kind:12}{len(own):4} runs, {len(own) - len(judged)} refused; nearer to the truth {len(nearer)} of "
            f"{len(refined)} refined, of these kept {sum(line['kept'] for line in nearer)}; scale covered "
            f"{100 * np.mean([line['covered'] for line in judged]):.0f} %, half width "
            f"{100 * np.median([line['half_width'] for line in judged]):.2f} %, errors in stddevs "
            f"{np.sqrt(np.mean(in_stddevs**2)):.2f}, of places {np.median(places) if places else np.nan:.2f}, places "
            f"covered {100 * np.mean(share) if share else np.nan:.0f} %; doubted "
            f"{sum(line['verdict'] != 'good' for line in judged)}, mistake named "
            f"{sum(bool(line['causes']) for line in judged)}"
        )


def main() -> int:
    parser = seeds_parser(__doc__, None, 6)
    parser.add_argument("--data", type=Path)
    asked = parser.parse_args()
    makers = surveys(asked.data)
    lines = run_seeds(asked, asked.kinds or makers, lambda kind, seed: told(makers[kind](seed), kind, seed), json.dumps)
    print(*report(lines), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
