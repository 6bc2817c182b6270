"""Comparison of paths with a reference."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.result.comparison_row import ComparisonRow
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import NO_REFERENCE, Reference
from rangesfm.util.geometry.similarity import Similarity, align_points, rmse, similarity_between
from rangesfm.util.geometry.trajectory import Trajectory
from rangesfm.util.processes.threads import with_one_blas_thread

MIN_NUM_ALIGNED = 3
"""Smallest number of keyframes for an alignment: two points always fit exactly after Sim(3)."""


@with_one_blas_thread
def compare(
    paths: Mapping[str, Trajectory], reference: Reference, *, frame: str | None = "site"
) -> tuple[ComparisonRow, ...]:
    """Compare each path with a reference.

    On a straight path the best alignment is not unique, because any turn about the line fits; its scale and its error
    are unique.

    Args:
        paths: by name.
        reference: true positions, perhaps with orientations.
        frame: world of the paths. ``"site"``: the world of the reference. ``"first_camera"``: the reference is moved
            into it by its pose at the first known keyframe. This needs camera orientations in the reference (COLMAP's
            convention); without them ``rmse_m`` is None. None: an unknown world; ``rmse_m`` is None.

    Returns:
        One row for each path.

    Raises:
        InputError: the reference has no keyframe of a path.
    """
    rows = []
    for name, path in paths.items():
        known, target, world_from_cam = known_keyframes(path, reference)
        if len(known) == 0:
            raise InputError(reference.why_nothing_is_known("keyframes", reference.moments_of(path)))
        source = path.centers[known]
        in_frame = _in_frame(path, known, target, world_from_cam, frame)
        found = similarity_onto(source, target)
        aligned_m: list[float | None] = [None, None]
        if len(source) >= MIN_NUM_ALIGNED:
            alignments = [align_points(source, target, with_scale=with_scale) for with_scale in (False, True)]
            aligned_m = [rmse(each.apply(source) - target) for each in alignments]
        row = ComparisonRow(
            name=name,
            num_keyframes=len(source),
            rmse_m=None if in_frame is None else rmse(source - in_frame),
            rmse_se3_m=aligned_m[0],
            rmse_sim3_m=aligned_m[1],
            scale_error_percent=None if found is None else 100.0 * (1.0 / found.scale - 1.0),
        )
        rows.append(row)
    return tuple(rows)


def papers_table(
    paths: Mapping[str, Trajectory], reference: Reference, *, frame: str = "site"
) -> tuple[ComparisonRow, ...]:
    """Return the table of the 2018 paper: the first of some metric paths with the true scale, and each as it is.

    Args:
        paths: by name, such as "scaled" and "refined".
        reference, frame: as in ``compare``.
    """
    true_scale = with_true_scale(next(iter(paths.values())), reference, frame=frame)
    return compare({"true scale": true_scale, **paths}, reference, frame=frame)


def with_true_scale(path: Trajectory, reference: Reference, *, frame: str = "site") -> Trajectory:
    """Return the path with the scale that fits the reference best; see Trajectory.resized.

    The path is returned unchanged if the reference does not determine its scale.
    """
    known, positions, _ = known_keyframes(path, reference)
    found = similarity_onto(path.centers[known], positions)
    return path if found is None else path.resized(found.scale, frame)


def reference_in_frame(path: Trajectory, reference: Reference, *, frame: str) -> Reference:
    """Return the reference positions of a path's keyframes by photo, in the world of the path, without fitting.

    It is empty where the reference has no keyframe of the path, or its relation to the frame of the path is unknown
    (see ``compare``).
    """
    known, target, world_from_cam = known_keyframes(path, reference)
    positions = _in_frame(path, known, target, world_from_cam, frame)
    if positions is None:
        return NO_REFERENCE
    return Reference(positions, ByPhoto(tuple(path.image_names[i] for i in known)))


def known_keyframes(path: Trajectory, reference: Reference) -> tuple[npt.NDArray[np.int64], Array, Array | None]:
    """Return the k keyframes that the reference has: indices, positions (k, 3), and rotations (k, 3, 3) or None."""
    positions, world_from_cam = reference.positions_at(path)
    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    return known, positions[known], None if world_from_cam is None else world_from_cam[known]


def _in_frame(
    path: Trajectory,
    known: npt.NDArray[np.int64],
    positions: Array,
    world_from_cam: Array | None,
    frame: str | None,
) -> Array | None:
    """Return the positions (k, 3) of ``known_keyframes`` in the world of the path; None if its relation is unknown."""
    if frame == "site":
        return positions
    if frame != "first_camera" or world_from_cam is None or len(known) == 0:
        return None
    path_from_reference = path.world_from_cam[known[0]] @ world_from_cam[0].T
    return np.asarray((positions - positions[0]) @ path_from_reference.T + path.centers[known[0]])


def similarity_onto(source: Array, target: Array) -> Similarity | None:
    """Return the best similarity from source to target, (n, 3) each; None if it is not determined or n is below 3."""
    return similarity_between(source, target) if len(source) >= MIN_NUM_ALIGNED else None
