"""Draw a floor plan with dimensions from a metric map (needs matplotlib).

python floor_plan.py RESULT_FOLDER PLAN.png [LOWEST_M HIGHEST_M]

Shows, from above, the map's points between two heights, the camera's path, the anchors, and the overall length and
width in metres with the uncertainty of the scale. Without heights, the middle half of the points by height is drawn,
which leaves out most of the floor and the ceiling.
"""

from __future__ import annotations

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import numpy.typing as npt
from matplotlib.axes import Axes

from rangesfm.export import MetricMap
from rangesfm.export.metric_map import in_frame
from rangesfm.options import ExportOptions
from rangesfm.result.result_folder import read_result_folder

Array = npt.NDArray[np.float64]


def main() -> None:
    folder, plan = Path(sys.argv[1]), Path(sys.argv[2])
    result = read_result_folder(folder)
    model = result.read_metric_model()
    if model is None:
        sys.exit(f"{folder}: no metric model")
    # In a site frame z points up by convention. Any other map is levelled by the orientation of its cameras.
    options = ExportOptions(frame="result" if result.summary.frame == "site" else "level")
    map_ = in_frame(MetricMap(model, result.timestamps_s, result.anchor_positions_m), options)
    points = np.array([point.xyz for point in map_.reconstruction.points3D.values()])
    low, high = map(float, sys.argv[3:5]) if len(sys.argv) > 4 else np.quantile(points[:, 2], [0.25, 0.75])
    wall = points[(points[:, 2] >= low) & (points[:, 2] <= high)]
    half_width_95 = 1.96 * (result.summary.scale.relative_stddev_empirical or 0.0)

    figure, axes = plt.subplots(figsize=(8, 8))
    axes.plot(wall[:, 0], wall[:, 1], ".", color="0.35", markersize=1.5, label=f"points from {low:.2f} to {high:.2f} m")
    axes.plot(*map_.trajectory.centers[:, :2].T, color="tab:blue", linewidth=1, label="camera")
    for name, at in (map_.anchors_m or {}).items():
        axes.plot(at[0], at[1], "^", color="tab:purple")
        axes.annotate(name, (at[0], at[1]), xytext=(4, 4), textcoords="offset points")
    lowest, highest = np.quantile(wall[:, :2], [0.02, 0.98], axis=0)
    path = map_.trajectory.centers[:, :2]
    corner = np.minimum(lowest, path.min(axis=0))
    for axis in (0, 1):
        draw_dimension(axes, corner, (lowest[axis], highest[axis]), axis, half_width_95)
    axes.set_aspect("equal")
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.legend(loc="upper right")
    figure.savefig(plan, dpi=150, bbox_inches="tight")
    width, depth = highest - lowest
    print(f"{width:.3f} m x {depth:.3f} m, each +- {100 * half_width_95:.1f} % (95 %, by the scale): {plan}")


def draw_dimension(axes: Axes, corner: Array, interval: tuple[float, float], axis: int, half_width_95: float) -> None:
    """Draw a dimension arrow with its length below the map, or left of it."""
    start, end = corner - 0.4, corner - 0.4
    start[axis], end[axis] = interval
    axes.annotate("", (end[0], end[1]), (start[0], start[1]), arrowprops={"arrowstyle": "<->"})
    length, middle = interval[1] - interval[0], (start + end) / 2
    text = f"{length:.2f} ± {half_width_95 * length:.2f} m"
    aside = {"ha": "center", "va": "bottom"} if axis == 0 else {"ha": "right", "va": "center", "rotation": 90}
    axes.annotate(text, (middle[0], middle[1]), **aside)


if __name__ == "__main__":
    main()
