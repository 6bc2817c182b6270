"""Show the size of each component of the ranges' errors on real logs, against the true distances.

Run: python -m tests.studies.shown_errors --data FOLDER

The components are learnt as in a survey, but at the true scale and from the same start for all logs. They are the
columns of the table in ``rangesfm/measurements/ranges/errors/components.py``. The logs are those of ``real_logs.json``.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from unittest.mock import patch

import numpy as np
from tests.studies.real_logs import FACTOR, SETS, RealLog

from rangesfm.measurements.ranges.errors.components import components
from rangesfm.measurements.ranges.errors.learned import learn_errors, radio_components
from rangesfm.measurements.ranges.scale.binned_ranges import binned_ranges
from rangesfm.measurements.ranges.scale.range_equation import predicted_ranges
from rangesfm.measurements.ranges.scale.range_start import RangesOnPath
from rangesfm.measurements.ranges.scale.scale_problem import scale_problem
from rangesfm.measurements.ranges.scale.solution import solve_scale
from rangesfm.solver.bending import WalkBending

# Medians that the logs' errors suggest at first sight, metres, and below them how far each log may differ.
START = {"white": 0.05, "time": 0.04, "drift": 0.01, "place": 0.03, "view": 0.035, "bias": 0.045, "common_bias": 0.2}
START |= {
    "short": 0.2,
    "tag_bias": 0.03,
    "curve": 0.04,
    "slope": 0.004,
    "antenna": 0.05,
    "off_axis": 0.05,
    "tag_antenna": 0.05,
}
SPREAD, OF_WHITE = 0.7, 1.0


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    args = parser.parse_args()
    start = components({name: (size, OF_WHITE if name == "white" else SPREAD) for name, size in START.items()})
    likeliest = patch("rangesfm.solver.noise.ComponentLikelihood.mean_stddevs", lambda self, logs: np.exp(logs))
    with patch("rangesfm.measurements.ranges.errors.learned.COMPONENTS", start), likeliest:
        for name in SETS:
            found = shown(RealLog.read(args.data, name))
            print(f"{name:17}" + "  ".join(f"{part} {stddev:.4f}" for part, stddev in found.items()), flush=True)


def shown(real: RealLog) -> dict[str, float]:
    """Return the stddevs of a log by component."""
    case = real.case("known")
    observations = real.placed(case, real.path)
    posed = scale_problem(RangesOnPath(observations, WalkBending(real.path), case.anchors, case.frame))
    solved = solve_scale(posed)
    state = solved.state
    true = replace(
        state,
        metric_from_model=replace(state.metric_from_model, scale=FACTOR),
        bias_m=posed.ranges.bias_mean_m,
    )
    bins = binned_ranges(replace(solved, state=true)).bins
    off_m = posed.ranges.range_m - predicted_ranges(posed.ranges, true)
    nothing_open = np.zeros((len(off_m), 1))
    components = radio_components(bins, posed.curve_stddev_m)
    given = (bins.mean(off_m), bins.mean(nothing_open), np.ones((1, 1)), solved.noise_stddev_m)
    learned = learn_errors(components, bins, *given)
    return dict(zip(learned.names, learned.stddevs.tolist(), strict=True))


if __name__ == "__main__":
    main()
