"""A simulated radio that measures only at given poses, such as those of a model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import numpy.typing as npt

from rangesfm.demo.simulated_radio import Radio, measure_ranges
from rangesfm.measurements.ranges.range_log import RangeLog

FloatArray = npt.NDArray[np.float64]


def simulate_ranges_at(
    times_s: FloatArray,
    centers_m: FloatArray,
    world_from_cam: FloatArray,
    anchors_m: Mapping[str, Sequence[float] | FloatArray],
    tag_in_cam_m: Sequence[float] | FloatArray,
    radio: Radio,
    seed: int = 0,
) -> RangeLog:
    """Simulate one range to each anchor at each of m given poses; the radio's rate is not used.

    Args:
        times_s: (m,) on the camera's clock.
        centers_m: (m, 3).
        world_from_cam: (m, 3, 3).
        anchors_m, tag_in_cam_m, radio, seed: as for ``simulate_ranges``.
    """
    pose = np.repeat(np.arange(len(times_s)), len(anchors_m))
    anchor = np.tile(np.arange(len(anchors_m)), len(times_s))
    tags = centers_m + world_from_cam @ np.asarray(tag_in_cam_m, dtype=np.float64)
    return measure_ranges(times_s[pose], tags[pose], anchor, anchors_m, radio, seed)
