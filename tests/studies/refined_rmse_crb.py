"""Compare the error of refined positions over many noisy surveys with the Cramer-Rao bound.

    python -m tests.studies.refined_rmse_crb [--num_seeds 40]

Simulated surveys with Gaussian noise: a yard with four site anchors, the same with one anchor known in the first
camera's frame, and a rover's lap that drifts. Each seed draws noise of features and ranges anew, and draws the anchors'
biases from the prior that the stages assume, so that the prior's information counts like that of a measurement (van
Trees' Bayesian form of the bound). COLMAP adjusts the model, as a mapper would, then scale and refinement run with
their defaults; they estimate the noise of features and ranges themselves.

The error is the root mean square distance of all keyframes of all seeds from the truth, without alignment. The bound is
that of ``simulated_survey.rmse_bound_m``. The errors are those of a few slow modes of the whole map, so 40 seeds
determine their size to some 10 %. Therefore the same seeds are also solved with all noise known and from the truth
("likeliest"). The difference of that from the bound is chance, and the difference of the refinement from that is its
own.

Exit status 1 if the error exceeds 1.15 times the bound or the likeliest map's error, or is so far below the bound that
the bound itself must be wrong.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
import numpy.typing as npt
from tests.studies.simulated_survey import (
    Case,
    Survey,
    drawn_biases,
    lap_survey,
    likeliest_path,
    mapped,
    path_error_m,
    range_log,
    rmse_bound_m,
    run_stages,
    unit_pixel_errors,
    yard_survey,
)

Array = npt.NDArray[np.float64]

MAX_RATIO = 1.15
MIN_RATIO = 0.75

CASES = (
    Case("yard, four site anchors", yard_survey, 0.5),
    Case("yard, one anchor in the first camera's frame", lambda: yard_survey(anchor_frame="first_camera"), 0.5),
    Case("lap, one anchor inside", lambda: lap_survey(num_observations=60, anchor_m=(10.0, 5.0, 8.0)), 0.5),
    Case("lap, one anchor beside", lambda: lap_survey(num_observations=60, anchor_m=(0.0, -44.0, 8.0)), 0.5),
)


def path_errors(case: Case, survey: Survey, num_seeds: int) -> Array:
    """(num_seeds, 2) root mean square error of each run, metres: refined, and likeliest."""
    errors = []
    for seed in range(num_seeds):
        pixel_errors = case.pixel_stddev * unit_pixel_errors(survey, seed)
        log = range_log(survey, seed, biases_m=drawn_biases(survey, seed))
        refined = run_stages(survey, mapped(survey, pixel_errors), log).refined
        likeliest = likeliest_path(survey, pixel_errors, log, pixel_stddev=case.pixel_stddev)
        errors.append([path_error_m(survey, refined), path_error_m(survey, likeliest)])
    return np.array(errors)


def main() -> int:
    parser = argparse.ArgumentParser(description="Refined positions against the Cramer-Rao bound.")
    parser.add_argument("--num_seeds", type=int, default=40)
    num_seeds = parser.parse_args().num_seeds
    print(f"{num_seeds} seeds; errors in metres")
    print(f"{'case':46} {'bound':>7} {'RMSE':>7} {'ratio':>6} {'worst':>7} {'likeliest':>9} {'ratio':>6}")
    is_good = True
    for case in CASES:
        survey = case.survey()
        errors = path_errors(case, survey, num_seeds)
        bound = rmse_bound_m(survey, case.pixel_stddev)
        refined, likeliest = np.sqrt(np.mean(errors**2, axis=0))
        is_inside = MIN_RATIO <= refined / bound <= MAX_RATIO and refined / likeliest <= MAX_RATIO
        is_good &= is_inside
        print(
            f"{case.name:46} {bound:7.4f} {refined:7.4f} {refined / bound:6.3f} {errors[:, 0].max():7.4f}"
            f" {likeliest:9.4f} {refined / likeliest:6.3f}  {'' if is_inside else 'OUTSIDE'}",
            flush=True,
        )
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main())
