"""Close the loops of simulated surveys, and compare with what all true matches give.

    python -m tests.studies.loops laps [--num_seeds 5] [--num_keyframes 300] [--size_m 60 40] [--pixel_stddev 0.7]
    python -m tests.studies.loops aisles [--num_seeds 20]
    python -m tests.studies.loops pairs

``laps``: two laps of a rover that looks ahead, tracks of at most 8 keyframes, one anchor known in the first camera's
frame, one range of stddev 0.1 m at each keyframe. Root mean square errors of the keyframes without alignment: scaled,
refined, with closed loops, and refined with all true matches from the start. Of the loops that are closed, those are
counted that the map would propose without ranges, at the true scale. Exit status 1 if a map with closed loops errs by
more than twice the error with all true matches.

``aisles``: two aisles with exactly the same shelves, 3 m apart, and four surveyed anchors. All pairs that look alike
are tested, and the loops that the map proposes are closed, with such pairs among those that match.

``pairs``: number of pairs that the map of two laps proposes for 200 to 2000 keyframes at the same distances, with the
covariance of the true map.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap
from tests.simulated.looped import Closed, LoopedSurvey, ScaledMap, adjusted, close, two_aisles, two_laps
from tests.studies.simulated_survey import covariance_at_truth, range_log

from rangesfm.colmap.transform import rescale
from rangesfm.geometry.similarity import Similarity, align_points
from rangesfm.geometry.trajectory import trajectory_from_reconstruction
from rangesfm.loops.candidates import MIN_OVERLAP, Views
from rangesfm.loops.loop_finder import LoopFinder
from rangesfm.loops.rounds import MAX_NUM_PAIRS


def study_laps(
    num_seeds: int, num_keyframes: int, size_m: tuple[float, float], num_observations: int, pixel_stddev: float
) -> bool:
    """Return whether all maps with closed loops err by at most twice the error with all true matches."""
    print(
        "seed  scaled  refined  closed  all true matches  closed / all   (m)   proposed  closed  contradicted", end=""
    )
    print("  of the closed proposed without ranges")
    is_good = True
    for seed in range(num_seeds):
        looped = two_laps(
            num_keyframes, size_m=size_m, num_observations=num_observations, pixel_stddev=pixel_stddev, seed=seed
        )
        log = range_log(looped.survey, seed)
        with TemporaryDirectory() as folder:
            found = close(looped, looped.chain(), log, Path(folder))
        best = ScaledMap.of(looped.survey, adjusted(pycolmap.Reconstruction(looped.truth)), log)
        maps = (found.before.scaled.scaled, found.before.model, found.after.model, best.refined()[0])
        errors_m = [best.error_m(model) for model in maps]
        tried = found.tried
        counts = len(tried.proposed), len(tried.closed), len(tried.contradicted), _num_without_ranges(found)
        print(seed, *(f"{error:.3f}" for error in errors_m), f"{errors_m[2] / errors_m[3]:.2f}", *counts, flush=True)
        is_good &= errors_m[2] < 2 * errors_m[3]
    return is_good


def _num_without_ranges(found: Closed) -> int:
    """Return how many of the loops overlap in the map of photos alone, which has the true scale."""
    scaled = found.before.scaled
    path = scaled.trajectory.as_in(scaled.scaled)
    scale = align_points(path.centers, scaled.survey.model.centers_m).scale
    model = rescale(scaled.scaled, Similarity(scale, np.eye(3), np.zeros(3)))
    views = Views.of(model, path.frame_ids)
    rows = [[views.row_of[image_id] for image_id in pair] for pair in found.tried.closed]
    return sum(views.overlaps(one, np.array([other]), np.zeros(1))[0] >= MIN_OVERLAP for one, other in rows)


def study_aisles(num_seeds: int) -> None:
    print("seed  alike  taken for loops  contradicted   refined  closed (m)")
    num_without = 0
    for seed in range(num_seeds):
        survey = two_aisles(num_keyframes=15, length_m=6.0, seed=seed)
        log = range_log(survey.looped.survey, seed)
        with TemporaryDirectory() as folder:
            found = close(survey.looped, survey.looped.chain(), log, Path(folder), alike=survey.alike)
        loops, contradicted = found.before.finder.tested(survey.alike)
        num_wrong = len(loops) + len(found.tried.closed & survey.alike.keys())
        num_without += num_wrong == 0
        errors_m = [found.before.scaled.error_m(of.model) for of in (found.before, found.after)]
        print(seed, len(survey.alike), len(loops), len(contradicted), *(f"{e:.3f}" for e in errors_m), flush=True)
    print(f"no wrong loop in {num_without} of {num_seeds}")


def study_pairs() -> None:
    print("keyframes  proposed pairs  per keyframe  seconds")
    for num_keyframes in (200, 500, 1000, 2000):
        size = num_keyframes / 200
        looped = two_laps(num_keyframes, size_m=(40.0 * size, 26.0 * size), num_observations=60)
        num, seconds = _num_proposed(looped)
        print(num_keyframes, num, f"{num / num_keyframes:.2f}", f"{seconds:.1f}", flush=True)


def _num_proposed(looped: LoopedSurvey) -> tuple[int, float]:
    truth, times = looped.survey.model.reconstruction, looped.survey.model.timestamps_s
    chain = looped.cut()
    covariance = covariance_at_truth(looped.survey, chain, 0.5)
    finder = LoopFinder.of(chain, trajectory_from_reconstruction(truth, times), covariance.errors, 0.5, seed=0)
    start = time.perf_counter()
    return len(finder.propose({}, max_num=MAX_NUM_PAIRS)), time.perf_counter() - start


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("laps", "aisles", "pairs"))
    parser.add_argument("--num_seeds", type=int, default=5)
    parser.add_argument("--num_keyframes", type=int, default=300)
    parser.add_argument("--size_m", type=float, nargs=2, default=(60.0, 40.0))
    parser.add_argument("--num_observations", type=int, default=60)
    parser.add_argument("--pixel_stddev", type=float, default=0.7)
    args = parser.parse_args()
    if args.what == "laps":
        size_m = args.size_m[0], args.size_m[1]
        is_good = study_laps(args.num_seeds, args.num_keyframes, size_m, args.num_observations, args.pixel_stddev)
        return 0 if is_good else 1
    if args.what == "aisles":
        study_aisles(args.num_seeds)
    else:
        study_pairs()
    return 0


if __name__ == "__main__":
    sys.exit(main())
