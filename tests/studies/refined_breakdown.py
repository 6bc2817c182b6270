"""Measure how many outliers the refinement survives: its error beside that of the scaled map, from which it starts.

    python -m tests.studies.refined_breakdown [--num_seeds 10] [--anchors one] [--kind long]

A walk around a yard, 60 keyframes, 240 ranges of stddev 0.1 m: one to each of four site anchors at each keyframe, or
four to one anchor that is known in the first camera's frame. A share of 0 to 80 % of these is wrong, in the ways of
``scale_breakdown.py``: long, short, or whole stretches of one anchor's ranges long. The features fit, so the map as it
came has nothing but its similarity wrong, and whatever the refinement adds to its error is due to outliers. (For drift
and outliers together, see ``drift.py --obstructed_share``.)

Prints the root mean square error of the keyframes, without alignment, scaled and refined: the median and the worst of
the seeds, and how many were made worse by more than a fifth and a centimetre. Runs that the scale stage refuses are
left out and counted. Exit status 1 if the refined median is worse than the scaled one by more than a tenth and a
centimetre.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.studies.scale_breakdown import KINDS, SHARES, spoilt
from tests.studies.simulated_survey import (
    Survey,
    mapped,
    path_error_m,
    range_log,
    run_stages,
    unit_pixel_errors,
    yard_survey,
)

from rangesfm.errors import GeometryError
from rangesfm.ranging.range_log import RangeLog

Array = npt.NDArray[np.float64]

PIXEL_STDDEV = 0.5
MAX_RATIO, MAX_RATIO_OF_RUN, TOLERANCE_M = 1.1, 1.2, 0.01


@dataclass(frozen=True)
class Yard:
    """A survey, and how many ranges it has to an anchor at a keyframe."""

    survey: Callable[[], Survey]
    num_each: int


YARDS = {
    "four": Yard(yard_survey, 1),
    "one": Yard(lambda: yard_survey(anchor_frame="first_camera"), 4),
}


def spoilt_log(survey: Survey, num_each: int, kind: str, share: float, seed: int) -> RangeLog:
    log = range_log(survey, seed, num_each=num_each)
    rng = np.random.default_rng([seed, KINDS.index(kind), round(100 * share)])
    # Sorted by anchor, so that each stretch of wrong ranges belongs to one anchor.
    rows = np.argsort(log.anchor_index, kind="stable")
    range_m = log.range_m.copy()
    range_m[rows] = spoilt(log.range_m[rows], kind, share, rng)
    return replace(log, range_m=range_m)


def study(survey: Survey, models: list[pycolmap.Reconstruction], num_each: int, kind: str, share: float) -> Array:
    """(num, 2) errors in metres, scaled and refined, of the seeds that were not refused."""
    errors = []
    for seed, sfm in enumerate(models):
        try:
            result = run_stages(survey, sfm, spoilt_log(survey, num_each, kind, share, seed))
        except GeometryError:
            continue
        errors.append([path_error_m(survey, path) for path in (result.scaled, result.refined)])
    return np.array(errors).reshape(-1, 2)


def exceeds(refined_m: Array, scaled_m: Array, max_ratio: float) -> npt.NDArray[np.bool_]:
    beyond: npt.NDArray[np.bool_] = refined_m > max_ratio * scaled_m + TOLERANCE_M
    return beyond


def main() -> int:
    parser = argparse.ArgumentParser(description="Error of the scaled and the refined map over the share of outliers.")
    parser.add_argument("--num_seeds", type=int, default=10)
    parser.add_argument("--anchors", choices=tuple(YARDS), nargs="+", default=tuple(YARDS))
    parser.add_argument("--kind", choices=KINDS, nargs="+", default=KINDS)
    arguments = parser.parse_args()
    print(f"{arguments.num_seeds} seeds; median / worst error in metres")
    print(f"{'anchors':7} {'kind':9} {'share':>5} {'scaled':>15} {'refined':>15} {'made worse':>10} {'refused':>7}")
    is_good = True
    for name in arguments.anchors:
        survey = YARDS[name].survey()
        models = [mapped(survey, PIXEL_STDDEV * unit_pixel_errors(survey, seed)) for seed in range(arguments.num_seeds)]
        for kind in arguments.kind:
            for share in SHARES:
                errors = study(survey, models, YARDS[name].num_each, kind, share)
                is_good &= print_row(f"{name:7} {kind:9} {100 * share:4.0f}%", errors, arguments.num_seeds)
    return 0 if is_good else 1


def print_row(title: str, errors: Array, num_seeds: int) -> bool:
    """Print a row, and return whether the refinement is no worse."""
    num_refused = num_seeds - len(errors)
    if not len(errors):
        print(f"{title} {'':15} {'':15} {'':10} {num_refused:7}", flush=True)
        return True
    median, worst = np.median(errors, axis=0), np.max(errors, axis=0)
    texts = [f"{middle:7.3f} /{most:6.3f}" for middle, most in zip(median, worst, strict=True)]
    num_worse = int(np.sum(exceeds(errors[:, 1], errors[:, 0], MAX_RATIO_OF_RUN)))
    is_good = not exceeds(median[1:], median[:1], MAX_RATIO).any()
    print(f"{title} {texts[0]} {texts[1]} {num_worse:10} {num_refused:7}  {'' if is_good else 'WORSE'}", flush=True)
    return is_good


if __name__ == "__main__":
    sys.exit(main())
