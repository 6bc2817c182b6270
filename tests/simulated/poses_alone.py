"""A survey whose model has poses and no points, in the files that a user has."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from tests.simulated.files import write_anchors, write_rows
from tests.simulated.path import look_at

from rangesfm.util.geometry.similarity import align_points

Array = npt.NDArray[np.float64]
Garble = Callable[[Array, np.random.Generator], Array]

METRES_PER_UNIT = 0.42
NUM_PHOTOS = 60
ANCHORS_M = {"N": (4.6, 3.7, 0.4), "E": (-4.9, 4.1, 2.5), "S": (-4.4, -3.8, 0.5), "W": (5.1, -4.2, 2.3)}
RANGES = ("--ranges", "uwb.csv", "--ranges_time_offset", "0")
POSITIONS = ("--positions", "positions.csv")


@dataclass(frozen=True)
class PosesAlone:
    """Files in a folder: ``sparse/0``, ``images.csv``, ``uwb.csv``, ``anchors.csv`` and ``positions.csv``.

    Attributes:
        scale: of the similarity that brings the model's centres nearest to the true ones.
        flags: that read the model and the times of its photos.
    """

    folder: Path
    scale: float

    @property
    def flags(self) -> tuple[str, ...]:
        return "--input_path", "sparse/0", "--images", "images.csv", "--tag_in_cam", "0,0,0"


def write_poses_alone(
    folder: Path,
    *,
    height_amplitude_m: float = 0.5,
    drift_m: float = 0.0,
    garble: Garble = lambda range_m, rng: range_m,
    seed: int = 0,
) -> PosesAlone:
    """Write a survey along a figure of eight, one photo a second and four ranges to each anchor.

    Args:
        drift_m: root mean square of a random walk of the poses. garble: changes the ranges as measured.
    """
    rng, times = np.random.default_rng(seed), np.arange(NUM_PHOTOS, dtype=np.float64)
    true_m, found_m = _eight(times, height_amplitude_m), np.zeros((NUM_PHOTOS, 3))
    if drift_m:
        walk_m = np.cumsum(rng.standard_normal(true_m.shape), axis=0)
        found_m = drift_m * walk_m / np.sqrt(np.mean(np.sum(walk_m**2, axis=1)))
    found_m = found_m + true_m
    ahead = _eight(times + 0.1, height_amplitude_m)
    turn = Rotation.random(rng=rng).as_matrix()
    centers = found_m @ turn.T / METRES_PER_UNIT
    _write_model(folder / "sparse" / "0", centers, turn @ look_at(true_m, ahead))
    write_rows(folder / "images.csv", "image_name,timestamp_s", ((name, s) for s, name in enumerate(_names(times))))
    rows = ((name, *at_m) for name, at_m in zip(_names(times), true_m.tolist(), strict=True))
    write_rows(folder / "positions.csv", "image_name,x_m,y_m,z_m", rows)
    write_anchors(folder / "anchors.csv", ANCHORS_M)
    at_s = np.repeat(np.arange(0.0, NUM_PHOTOS - 1, 0.25), len(ANCHORS_M))
    names = np.tile(list(ANCHORS_M), len(at_s) // len(ANCHORS_M))
    from_anchor = _eight(at_s, height_amplitude_m) - [ANCHORS_M[name] for name in names]
    range_m = np.linalg.norm(from_anchor, axis=1) + 0.03 * rng.standard_normal(len(at_s))
    measured = zip(at_s.tolist(), names.tolist(), garble(range_m, rng).tolist(), strict=True)
    write_rows(folder / "uwb.csv", "timestamp_s,anchor_id,range_m", measured)
    return PosesAlone(folder, align_points(centers, true_m).scale)


def _eight(times_s: Array, height_amplitude_m: float) -> Array:
    angle = 2 * np.pi * times_s / NUM_PHOTOS
    sides = [3.0 * np.cos(angle), 2.0 * np.sin(2 * angle), 1.5 + height_amplitude_m * np.sin(3 * angle)]
    return np.column_stack(sides)


def _names(times_s: Array) -> list[str]:
    return [f"{second:04.0f}.jpg" for second in times_s]


def _write_model(folder: Path, centers: Array, world_from_cam: Array) -> None:
    folder.mkdir(parents=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 640 480 500 500 320 240\n")
    (folder / "points3D.txt").write_text("")
    lines = []
    for k, (center, turn) in enumerate(zip(centers, np.swapaxes(world_from_cam, 1, 2), strict=True)):
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        numbers = " ".join(repr(float(number)) for number in (w, x, y, z, *(-turn @ center)))
        lines.append(f"{k + 1} {numbers} 1 {k:04d}.jpg\n\n")
    (folder / "images.txt").write_text("".join(lines))
