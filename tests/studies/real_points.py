"""Check control points on real photos: the RMSE of check points beside what the photos allow.

Run: python -m tests.studies.real_points --data FOLDER --model sparse/0 [--num_points 12] [--seed 0]

FOLDER has photos' true poses and their camera (fountain-P11 of Strecha et al. 2008: groundtruth.csv, camera.json), and
the model is of its photos (``rangesfm reconstruct FOLDER/images``). Points of the model that are seen in six photos or
more, spread over the scene, are taken for marks: what the true poses make of their features are their coordinates.
Three of them are control points, the others check points. The model is refined with all defaults.

Prints the RMSE of control and check points, and that of all points of the unrefined model after the best similarity,
which is as good as the photos alone allow.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.simulated.files import features_of, write_marks, write_rows

from rangesfm.pipeline.run import refine_model
from rangesfm.survey.settings import Survey
from rangesfm.util.geometry.reference import read_reference
from rangesfm.util.geometry.similarity import align_points, rmse

Array = npt.NDArray[np.float64]
NUM_PHOTOS, NUM_CONTROL, STDDEV_M = 6, 3, 0.005
# Share of the points that are nearest to their middle; far ones are in the background.
SHARE_NEAR = 0.9


def spread_points(model: pycolmap.Reconstruction, num: int, seed: int) -> list[int]:
    """Return the ids of points, each the farthest from those before it, after a first one drawn at random."""
    ids = [i for i in sorted(model.point3D_ids()) if model.point3D(i).track.length() >= NUM_PHOTOS]
    places = np.array([model.point3D(i).xyz for i in ids])
    from_middle = np.linalg.norm(places - np.median(places, axis=0), axis=1)
    near = np.flatnonzero(from_middle < np.quantile(from_middle, SHARE_NEAR))
    chosen = [int(np.random.default_rng(seed).choice(near))]
    while len(chosen) < num:
        apart = np.linalg.norm(places[near, None] - places[chosen], axis=2).min(axis=1)
        chosen.append(int(near[np.argmax(apart)]))
    return [ids[k] for k in chosen]


def triangulated(rays: Array, centers_m: Array) -> Array:
    """Return the point (3,) with the least squared distance from rays (n, 3) of length 1."""
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    return np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centers_m))


def main() -> int:
    """Run the study."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--model", type=Path, required=True)
    parser.add_argument("--num_points", type=int, default=12)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    model, truth = pycolmap.Reconstruction(asked.model), read_reference(asked.data / "groundtruth.csv")
    assert truth.world_from_cam is not None
    given = json.loads((asked.data / "camera.json").read_text(encoding="utf-8"))
    camera = pycolmap.Camera(
        model=given["camera_model"], width=given["width"], height=given["height"], params=given["params"]
    )
    row_of = {name: row for row, name in enumerate(truth.moments.image_name)}
    marked = {f"P{number}": i for number, i in enumerate(spread_points(model, asked.num_points, asked.seed))}
    true_m = []
    for point_id in marked.values():
        seen = features_of(model, point_id)
        rows = [row_of[name] for name in seen]
        rays = np.column_stack([camera.cam_from_img(np.array([*seen.values()])), np.ones(len(rows))])
        rays = np.einsum("nij,nj->ni", truth.world_from_cam[rows], rays / np.linalg.norm(rays, axis=1)[:, None])
        true_m.append(triangulated(rays, truth.positions_m[rows]))
    places = np.array([model.point3D(i).xyz for i in marked.values()])
    by_photos_m = rmse(align_points(places, np.array(true_m)).apply(places) - np.array(true_m))
    with tempfile.TemporaryDirectory() as scratch:
        folder, kinds = Path(scratch), ["control"] * NUM_CONTROL + ["check"] * (len(marked) - NUM_CONTROL)
        points = [(name, *at.tolist(), STDDEV_M, kind) for name, at, kind in zip(marked, true_m, kinds, strict=True)]
        write_rows(folder / "points.csv", "marker,x_m,y_m,z_m,stddev_m,kind", points)
        write_marks(folder / "marks.csv", model, marked)
        values = {
            "images.model": asked.model,
            "points.path": folder / "points.csv",
            "scale.markers": folder / "marks.csv",
            "output.path": folder / "out",
            "report.enabled": False,
        }
        found = refine_model(Survey().changed(values)).summary.points
    assert found is not None
    print(
        f"control points {found.control.rmse_3d_m:.4f} m, check points {found.check.rmse_3d_m:.4f} m; all points of "
        f"the photos alone, after the best similarity, {by_photos_m:.4f} m"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
