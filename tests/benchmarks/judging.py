"""Measure what the tests of mistakes cost beside the refinement, in a hall with six surveyed anchors.

    python -m tests.benchmarks.judging [--num_keyframes 600] [--num_ranges 60000]

Prints the processor time of both for three surveys: a clean one, one with an anchor's coordinate typed wrong by a
metre, and one whose ranges to an anchor are half a metre too long in the second half of the time. There is no limit on
the times.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
from tests.simulated.model import synthetic_model
from tests.simulated.path import loop_path
from tests.studies.erring_surveys import SITES

from rangesfm.demo.simulated_radio import Radio, simulate_ranges
from rangesfm.diagnostics.diagnosis import diagnose_ranges
from rangesfm.progress import SilentProgress
from rangesfm.ranging.range_log import RangeLog
from rangesfm.ranging.readers import write_ranges_csv
from rangesfm.refine.with_ranges import refine_with_ranges
from rangesfm.survey.settings import Survey
from rangesfm.workflows.run import refine_model

TAG_IN_CAM_M = (0.03, -0.12, -0.05)
PHOTO_INTERVAL_S = 0.5
HALL = SITES[0]


def timed(work: Callable[..., Any], seconds: list[float]) -> Callable[..., Any]:
    """Wrap a function so that its processor time is appended to ``seconds``."""

    def run(*arguments: Any, **others: Any) -> Any:
        begin = time.process_time()
        try:
            return work(*arguments, **others)
        finally:
            seconds.append(time.process_time() - begin)

    return run


def write_survey(folder: Path, num_keyframes: int, num_ranges: int) -> tuple[Survey, RangeLog]:
    """Write the model, the photos' times and the anchors; return the survey, and the log that is yet to be written."""
    end_s = PHOTO_INTERVAL_S * num_keyframes
    path = loop_path(end_s, center_m=(10, 7, 1.7), semi_axes_m=(7, 4.5), height_amplitude_m=0.4, num_turns=5)
    times = np.linspace(0.0, end_s - PHOTO_INTERVAL_S, num_keyframes)
    made = synthetic_model(
        times,
        path.centers(times),
        path.world_from_cam(times),
        num_observations=200,
        max_track_length=8,
        pixel_stddev=0.5,
    )
    (folder / "sparse").mkdir()
    made.reconstruction.write(folder / "sparse")
    lines = [f"{name},{at!r}\n" for name, at in made.timestamps_s.items()]
    (folder / "images.csv").write_text("image_name,timestamp_s\n" + "".join(lines))
    radio = Radio(rate_hz=num_ranges / len(HALL.anchors_m) / end_s, range_stddev_m=0.05)
    log = simulate_ranges(path, HALL.anchors_m, TAG_IN_CAM_M, radio).log
    survey = Survey().changed(
        {
            "images.model": folder / "sparse",
            "images.times": folder / "images.csv",
            "ranges.path": folder / "uwb.csv",
            "ranges.time_offset": 0.0,
            "anchors.path": folder / "anchors.csv",
            "tag.tag_in_cam_m": TAG_IN_CAM_M,
            "report.enabled": False,
            "output.path": folder / "out",
        }
    )
    return survey, log


def write_anchors(path: Path, typed_wrong_m: float) -> None:
    rows = [
        (name, x + (typed_wrong_m if k == 0 else 0), y, z) for k, (name, (x, y, z)) in enumerate(HALL.anchors_m.items())
    ]
    path.write_text("anchor_id,x_m,y_m,z_m\n" + "".join(f"{name},{x},{y},{z}\n" for name, x, y, z in rows))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_keyframes", type=int, default=600)
    parser.add_argument("--num_ranges", type=int, default=60000)
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        survey, log = write_survey(folder, asked.num_keyframes, asked.num_ranges)
        assert log.timestamp_s is not None, "the simulated log has times"
        late = (log.anchor_index == 1) & (log.timestamp_s > np.median(log.timestamp_s))
        print(f"{asked.num_keyframes} keyframes, {len(log)} ranges")
        print(f"{'survey':26}{'tests s':>9}{'refinement s':>14}{'ratio':>8}  found")
        for what, typed_wrong_m, longer_m in (
            ("clean", 0, 0),
            ("a coordinate off by 1 m", 1, 0),
            ("a step of 0.5 m", 0, 0.5),
        ):
            write_anchors(folder / "anchors.csv", typed_wrong_m)
            write_ranges_csv(replace(log, range_m=log.range_m + longer_m * late), folder / "uwb.csv")
            tests, refinement = list[float](), list[float]()
            with (
                mock.patch("rangesfm.workflows.make_metric_map.diagnose_ranges", timed(diagnose_ranges, tests)),
                mock.patch(
                    "rangesfm.workflows.make_metric_map.refine_with_ranges", timed(refine_with_ranges, refinement)
                ),
            ):
                summary = refine_model(survey, progress=SilentProgress()).summary
            found = ", ".join(f"{test.name} {test.subject}".strip() for test in summary.tests if test.rejected)
            ratio = sum(tests) / sum(refinement)
            print(f"{what:26}{sum(tests):9.2f}{sum(refinement):14.2f}{ratio:8.3f}  {found}", flush=True)


if __name__ == "__main__":
    main()
