"""Show what has changed between two surveys of one site.

python compare_two_surveys.py RESULT_FOLDER_BEFORE RESULT_FOLDER_AFTER [CHANGES.ply]

Both results must be in the site frame of the same anchors: they are compared as they are, because an alignment could
hide a change. Prints the distances from the points of the second map to the nearest points of the first, next to the
uncertainty of the two scales. Writes the points that lie further away than that uncertainty in red, and all others in
grey.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial import KDTree

from rangesfm.export import write_points
from rangesfm.result.result_folder import ResultFolder, read_result_folder


def main() -> None:
    before, after = (read_result_folder(Path(path)) for path in sys.argv[1:3])
    for result in (before, after):
        if result.summary.frame != "site":
            sys.exit(
                f"{result.output_path}: in the frame {result.summary.frame!r}; only maps in one site frame can be "
                "compared"
            )
    old, new = metric_model(before), metric_model(after)
    points = positions(new)
    distance_m = KDTree(positions(old)).query(points)[0]
    # Both scales stretch the maps about their middle.
    stddevs = [result.summary.scale.relative_stddev_empirical or 0.0 for result in (before, after)]
    relative = np.hypot(stddevs[0], stddevs[1])
    spacing_m = float(np.median(KDTree(positions(old)).query(positions(old), k=2)[0][:, 1]))
    explained_m = 3 * (spacing_m + relative * np.linalg.norm(points - points.mean(axis=0), axis=1))
    has_changed = distance_m > explained_m
    print(
        f"points of the second map: {len(points)}, the nearest of the first at {np.median(distance_m):.3f} m (median)"
    )
    print(f"further than spacing and scale explain: {has_changed.sum()} ({100 * has_changed.mean():.1f} %)")
    if len(sys.argv) > 3:
        for point_id, changed in zip(new.points3D, has_changed, strict=True):
            new.point3D(point_id).color = np.array([220, 30, 30] if changed else [150, 150, 150], dtype=np.uint8)
        print(f"in colour: {write_points(new, Path(sys.argv[3]))}")


def metric_model(result: ResultFolder) -> pycolmap.Reconstruction:
    model = result.read_metric_model()
    if model is None:
        sys.exit(f"{result.output_path}: no metric model")
    return model


def positions(model: pycolmap.Reconstruction) -> npt.NDArray[np.float64]:
    return np.array([point.xyz for point in model.points3D.values()])


if __name__ == "__main__":
    main()
