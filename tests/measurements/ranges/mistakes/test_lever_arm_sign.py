"""A lever arm of 22 cm with the wrong sign, on a walk around a yard that looks at its middle, is found and named."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tests.known import known
from tests.simulated.model import synthetic_model

from rangesfm.demo import survey as demo
from rangesfm.measurements.ranges.readers import write_ranges_csv
from rangesfm.pipeline.run import scale_model
from rangesfm.survey.settings import Survey

ARM_M, ARM_DOWN_M = (0.05, -0.2, -0.08), (0.0, 0.22, 0.0)


@pytest.mark.parametrize(("sign", "arm_m", "seed"), [(1, ARM_M, 0), (-1, ARM_M, 0), (-1, ARM_DOWN_M, 2)])
def test_the_sign_of_a_short_lever_arm_is_found_though_no_other_test_sees_it(
    sign: int, arm_m: tuple[float, ...], seed: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(demo, "TAG_IN_CAM_M", arm_m)
    walk = demo._plan(tmp_path, 40, seed)
    times = walk.timestamps_s
    made = synthetic_model(
        times, walk.centers_m, walk.world_from_cam, num_observations=60, max_track_length=8, pixel_stddev=0.5, seed=1
    )
    (tmp_path / "sparse").mkdir()
    made.reconstruction.write(tmp_path / "sparse")
    write_ranges_csv(walk.ranges, tmp_path / "uwb.csv")
    (tmp_path / "anchors.csv").write_text(demo._anchor_file(seed))
    rows = "".join(f"{name},{time!r}\n" for name, time in made.timestamps_s.items())
    (tmp_path / "images.csv").write_text(f"image_name,timestamp_s\n{rows}")
    survey = Survey().changed(
        {
            "images.model": tmp_path / "sparse",
            "images.times": tmp_path / "images.csv",
            "ranges.path": tmp_path / "uwb.csv",
            "ranges.time_offset": demo.TIME_OFFSET_S,
            "anchors.path": tmp_path / "anchors.csv",
            "tag.tag_in_cam_m": tuple(sign * x for x in arm_m),
            "output.path": tmp_path / "out",
            "report.enabled": False,
        }
    )
    summary = scale_model(survey).summary
    low, high = np.divide(known(summary.scale.interval_95), made.metric_from_sfm.scale)
    if sign == 1:
        assert summary.scale.verdict == "good"
        assert low < 1 < high
    else:
        assert "wrong sign" in summary.scale.reasons[0]
        assert not any(test.rejected for test in summary.tests if test.name == "lever arm")
