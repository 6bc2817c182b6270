"""Measure the error against the weight of the ranges relative to the features: does either dominate the other?

    python -m tests.studies.weights [--num_seeds 8]

Simulated surveys with known noise: a yard that a camera looks across, with four site anchors or with one; and a rover's
lap that drifts. Biases are drawn from the prior that the stages assume. The refinement is given a stddev of all ranges
that is the true one divided by a factor from 0.1 to 10 (the root of the weight), and once, as in practice, estimates
all noise itself ("own"). Only the ratio of the two weights matters: ten times the weight for ranges is a tenth for
features.

Prints the root mean square error of all keyframes of all seeds, without alignment. Exit status 1 if with its own
weights the refinement is worse than with the best factor by more than 10 %.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np
from tests.studies.simulated_survey import (
    Case,
    drawn_biases,
    lap_survey,
    mapped,
    path_error_m,
    range_log,
    run_stages,
    unit_pixel_errors,
    yard_survey,
)

FACTORS = (0.1, 0.3, 1.0, 3.0, 10.0)
MAX_OVER_BEST = 1.1


CASES = (
    Case("yard, four site anchors", yard_survey, 0.5),
    Case("yard, one anchor", lambda: yard_survey(anchor_frame="first_camera"), 0.5),
    Case("yard, four good radios, poor features", lambda: yard_survey(range_stddev_m=0.02), 3.0),
    Case("lap, one anchor", lambda: lap_survey(num_observations=60, anchor_m=(10.0, 5.0, 8.0)), 0.5),
)


def errors_by_weight(case: Case, num_seeds: int) -> tuple[list[float], float]:
    """Root mean square error in metres with each factor, and with the refinement's own weights."""
    survey = case.survey()
    stddevs = [survey.range_stddev_m / factor for factor in FACTORS]
    errors = np.zeros((num_seeds, len(FACTORS) + 1))
    for seed in range(num_seeds):
        sfm = mapped(survey, case.pixel_stddev * unit_pixel_errors(survey, seed))
        log = range_log(survey, seed, biases_m=drawn_biases(survey, seed))
        for k, stddev in enumerate([*stddevs, None]):
            errors[seed, k] = path_error_m(survey, run_stages(survey, sfm, log, range_stddev_m=stddev).refined)
    *by_factor, own = np.sqrt(np.mean(errors**2, axis=0)).tolist()
    return by_factor, own


def main() -> int:
    parser = argparse.ArgumentParser(description="Error against the weight of the ranges.")
    parser.add_argument("--num_seeds", type=int, default=8)
    num_seeds = parser.parse_args().num_seeds
    print(f"{num_seeds} seeds; root mean square error in metres by the factor on the ranges' weight (its root)")
    print(f"{'case':38} " + " ".join(f"{factor:>7g}" for factor in FACTORS) + f" {'own':>7} {'own/best':>8}")
    is_good = True
    for case in CASES:
        by_factor, own = errors_by_weight(case, num_seeds)
        is_good &= own <= MAX_OVER_BEST * min(by_factor)
        values = " ".join(f"{error:7.4f}" for error in [*by_factor, own])
        print(f"{case.name:38} {values} {own / min(by_factor):8.3f}", flush=True)
    return 0 if is_good else 1


if __name__ == "__main__":
    sys.exit(main())
