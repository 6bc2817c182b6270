"""How far paths are from a reference, and what the refinement changed."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.errors import InputError
from rangesfm.geometry.reference import Reference, read_reference
from rangesfm.geometry.similarity import align_points, rmse, similarity_between
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.result.entries import ComparisonRow
from rangesfm.result.folder import ResultFolder, read_result_folder
from rangesfm.result.ranges_as_used import RangesAsUsed
from rangesfm.text_table import align_rows

MIN_NUM_ALIGNED = 3
"""Poses from which an alignment says something: two points always fit after Sim(3)."""


def compare(
    paths: Mapping[str, Trajectory],
    reference: Reference,
    *,
    frame: str | None = "site",
    max_gap_s: float = 0.05,
) -> tuple[ComparisonRow, ...]:
    """One row for each path, by its name.

    On a straight path the best alignment is not unique (any turn about the line fits),
    but its scale and its error are.

    Args:
        frame: what world the paths are in. ``"site"``: the reference's own, compared as
            it is. ``"first_camera"``: the reference is carried into it by its pose at the
            first keyframe, which needs its orientations (the camera's, as COLMAP has
            them); without them ``rmse_m`` is None. None: any world; ``rmse_m`` is None.
        max_gap_s: see Reference.positions_at.

    Raises:
        InputError: the reference knows no keyframe of a path.
    """
    return tuple(_compare_path(name, path, reference, frame, max_gap_s) for name, path in paths.items())


def papers_table(
    scaled: Trajectory,
    refined: Trajectory | None,
    reference: Reference,
    *,
    frame: str = "site",
    max_gap_s: float = 0.05,
) -> tuple[ComparisonRow, ...]:
    """The paper's table: the true scale, the estimated scale, and the refined path if there is one.

    Args: as in ``compare``; the paths are metric and in ``frame``.
    """
    paths = {
        "true scale": with_true_scale(scaled, reference, frame=frame, max_gap_s=max_gap_s),
        "estimated scale": scaled,
    }
    if refined is not None:
        paths["refined"] = refined
    return compare(paths, reference, frame=frame, max_gap_s=max_gap_s)


def with_true_scale(
    path: Trajectory, reference: Reference, *, frame: str = "site", max_gap_s: float = 0.05
) -> Trajectory:
    """The path with the scale that fits the reference best, otherwise placed as it is (see Trajectory.resized).

    A path whose scale the reference does not tell comes back unchanged.
    """
    positions, _ = reference.positions_at(path, max_gap_s)
    known = np.isfinite(positions).all(axis=1)
    scale = _scale_to(path.centers[known], positions[known])
    return path if scale is None else path.resized(scale, frame)


def reference_in_frame(
    path: Trajectory, reference: Reference, *, frame: str | None = "site", max_gap_s: float = 0.05
) -> Reference | None:
    """The reference at the path's keyframes, by photo, in the path's own world and without fitting it.

    Returns:
        None where it knows none of them, or the frames cannot be tied (see ``compare``).
    """
    positions = _positions_in_frame(path, reference, frame, max_gap_s)
    if positions is None or not np.isfinite(positions).any():
        return None
    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    return Reference(positions[known], image_names=tuple(path.image_names[i] for i in known))


def _positions_in_frame(path: Trajectory, reference: Reference, frame: str | None, max_gap_s: float) -> Array | None:
    positions, world_from_cam = reference.positions_at(path, max_gap_s)
    if frame == "site":
        return positions
    known = np.flatnonzero(np.isfinite(positions).all(axis=1))
    if frame != "first_camera" or world_from_cam is None or len(known) == 0:
        return None
    first = known[0]
    path_from_reference = path.world_from_cam[first] @ world_from_cam[first].T
    in_path: Array = (positions - positions[first]) @ path_from_reference.T + path.centers[first]
    return in_path


def _compare_path(
    name: str, path: Trajectory, reference: Reference, frame: str | None, max_gap_s: float
) -> ComparisonRow:
    positions, _ = reference.positions_at(path, max_gap_s)
    known = np.isfinite(positions).all(axis=1)
    if not known.any():
        raise InputError(reference.why_nothing_is_known(path, max_gap_s))
    source, target = path.centers[known], positions[known]
    in_frame = _positions_in_frame(path, reference, frame, max_gap_s)
    is_aligned = len(source) >= MIN_NUM_ALIGNED
    scale = _scale_to(source, target)
    return ComparisonRow(
        name=name,
        num_keyframes=len(source),
        rmse_m=None if in_frame is None else rmse(source - in_frame[known]),
        rmse_se3_m=_aligned_rmse(source, target, with_scale=False) if is_aligned else None,
        rmse_sim3_m=_aligned_rmse(source, target, with_scale=True) if is_aligned else None,
        scale_error_percent=None if scale is None else 100.0 * (1.0 / scale - 1.0),
    )


def _aligned_rmse(source: Array, target: Array, *, with_scale: bool) -> float:
    return rmse(align_points(source, target, with_scale=with_scale).apply(source) - target)


def _scale_to(source: Array, target: Array) -> float | None:
    """Scale of the best similarity from source to target; None where there is none."""
    found = similarity_between(source, target) if len(source) >= MIN_NUM_ALIGNED else None
    return None if found is None else found.scale


def format_table(rows: tuple[ComparisonRow, ...]) -> str:
    """The rows as aligned plain text, lengths in metres."""
    header = ("trajectory", "keyframes", "RMSE m", "after SE(3)", "after Sim(3)", "scale error")
    cells = [
        (
            row.name,
            str(row.num_keyframes),
            _text(row.rmse_m, ".4f"),
            _text(row.rmse_se3_m, ".4f"),
            _text(row.rmse_sim3_m, ".4f"),
            _text(row.scale_error_percent, "+.3f", " %"),
        )
        for row in rows
    ]
    return align_rows([header, *cells])


@dataclass(frozen=True)
class CameraDistance:
    """Distance between the centres of two keyframes, in the models' unit."""

    image_names: tuple[str, str]
    before: float
    after: float


@dataclass(frozen=True)
class ModelComparison:
    """Two models of the same photos in the same world; pairs are (before, after).

    Attributes:
        num_keyframes: in both.
        reprojection_rms_px: None where one of the two is only a path.
        range_rms_m, range_median_abs_m: of the given range residuals; None without.
        mean_displacement_m, max_displacement_m: of the camera centres.
        distances: between a few keyframes spread over the path.
    """

    num_keyframes: int
    reprojection_rms_px: tuple[float, float] | None
    range_rms_m: tuple[float, float] | None
    range_median_abs_m: tuple[float, float] | None
    mean_displacement_m: float
    max_displacement_m: float
    distances: tuple[CameraDistance, ...]


def compare_models(
    before: pycolmap.Reconstruction | Trajectory,
    after: pycolmap.Reconstruction | Trajectory,
    *,
    range_residuals_m: tuple[Array, Array] | None = None,
) -> ModelComparison:
    """What changed from one model to another of the same photos, both metric and in one world.

    Args:
        range_residuals_m: predicted minus measured, of the ranges used, before and after.

    Raises:
        InputError: they have no photo in common.
    """
    path_before, path_after = _as_path(before), _as_path(after)
    index_after = {name: i for i, name in enumerate(path_after.image_names)}
    names = [name for name in path_before.image_names if name in index_after]
    if not names:
        raise InputError("the two models have no photo in common")
    index_before = {name: i for i, name in enumerate(path_before.image_names)}
    centers_before = path_before.centers[[index_before[name] for name in names]]
    centers_after = path_after.centers[[index_after[name] for name in names]]
    displacements = np.linalg.norm(centers_after - centers_before, axis=1)
    reprojection = None
    if not isinstance(before, Trajectory) and not isinstance(after, Trajectory):
        reprojection = (reprojection_rms_px(before), reprojection_rms_px(after))
    return ModelComparison(
        num_keyframes=len(names),
        reprojection_rms_px=reprojection,
        range_rms_m=_of_both(range_residuals_m, lambda r: float(np.sqrt(np.mean(r**2)))),
        range_median_abs_m=_of_both(range_residuals_m, lambda r: float(np.median(np.abs(r)))),
        mean_displacement_m=float(displacements.mean()),
        max_displacement_m=float(displacements.max()),
        distances=_distances(names, centers_before, centers_after),
    )


def reprojection_rms_px(reconstruction: pycolmap.Reconstruction) -> float:
    """Root of the mean squared distance between observed and projected points; NaN for none."""
    squared: list[Array] = [np.zeros(0)]
    for image in reconstruction.images.values():
        if not image.has_pose:
            continue
        observed = list(image.get_observation_points2D())
        if not observed:
            continue
        xyz = np.array([reconstruction.point3D(point.point3D_id).xyz for point in observed])
        in_cam = image.cam_from_world() * xyz
        projected = image.camera.img_from_cam(in_cam, check_cheirality=False)
        squared.append(np.sum((projected - np.array([point.xy for point in observed])) ** 2, axis=1))
    errors = np.concatenate(squared)
    return float(np.sqrt(errors.mean())) if len(errors) else float("nan")


def format_models(comparison: ModelComparison) -> str:
    """The comparison of two models as aligned plain text."""
    rows: list[tuple[str, ...]] = [("", "before", "after")]
    for label, pair in (
        ("reprojection RMS px", comparison.reprojection_rms_px),
        ("range residual RMS m", comparison.range_rms_m),
        ("range residual median abs m", comparison.range_median_abs_m),
    ):
        if pair is not None:
            rows.append((label, f"{pair[0]:.4f}", f"{pair[1]:.4f}"))
    for distance in comparison.distances:
        label = "{} to {} m".format(*distance.image_names)
        rows.append((label, f"{distance.before:.4f}", f"{distance.after:.4f}"))
    moved = (
        f"{comparison.num_keyframes} keyframes moved by {comparison.mean_displacement_m:.4f} m on average, "
        f"at most {comparison.max_displacement_m:.4f} m"
    )
    return f"{align_rows(rows)}\n{moved}"


@dataclass(frozen=True)
class FolderComparison:
    """What a finished run can be compared with.

    Attributes:
        rows: the paper's table; empty without a reference.
        models: scaled against refined; None where the run did not refine.
    """

    rows: tuple[ComparisonRow, ...]
    models: ModelComparison | None

    def __str__(self) -> str:
        parts = []
        if self.rows:
            parts.append(format_table(self.rows))
        if self.models is not None:
            parts.append(format_models(self.models))
        return "\n\n".join(parts)


def compare_folder(
    output_path: Path, reference_path: Path | None = None, *, max_gap_s: float = 0.05
) -> FolderComparison:
    """Compare the models in a run's output folder, with a reference file if there is one.

    Raises:
        InputError: the folder is not a result, it holds nothing to compare, or the
            reference cannot be read or knows none of its photos.
    """
    result = read_result_folder(output_path)
    scaled, refined = result.read_model("sparse_scaled"), result.read_model("sparse_metric")
    if scaled is None:
        raise InputError("there is no scaled model (sparse_scaled/0) to compare", output_path)
    if refined is None and reference_path is None:
        raise InputError("the run did not refine (no sparse_metric/0): a reference is needed to compare", output_path)
    rows: tuple[ComparisonRow, ...] = ()
    if reference_path is not None:
        path_of_refined = None if refined is None else trajectory_from_reconstruction(refined, result.timestamps_s)
        rows = papers_table(
            trajectory_from_reconstruction(scaled, result.timestamps_s),
            path_of_refined,
            read_reference(reference_path),
            frame=result.summary.frame,
            max_gap_s=max_gap_s,
        )
    models = None
    if refined is not None:
        models = compare_models(scaled, refined, range_residuals_m=_used_residuals(result))
    return FolderComparison(rows, models)


def _used_residuals(result: ResultFolder) -> tuple[Array, Array] | None:
    ranges = result.read(RangesAsUsed)
    if ranges is None:
        return None
    before, after = ranges.residual_scaled_m[ranges.is_used], ranges.residual_refined_m[ranges.is_used]
    known = np.isfinite(before) & np.isfinite(after)
    return (before[known], after[known]) if known.any() else None


def _as_path(model: pycolmap.Reconstruction | Trajectory) -> Trajectory:
    return model if isinstance(model, Trajectory) else trajectory_from_reconstruction(model)


def _distances(names: list[str], before: Array, after: Array) -> tuple[CameraDistance, ...]:
    """Over the whole path, each half of it, and its middle."""
    last = len(names) - 1
    pairs = ((0, last), (0, last // 2), (last // 2, last), (last // 4, 3 * last // 4))
    distinct = dict.fromkeys((a, b) for a, b in pairs if a != b)
    return tuple(
        CameraDistance(
            (names[a], names[b]),
            float(np.linalg.norm(before[a] - before[b])),
            float(np.linalg.norm(after[a] - after[b])),
        )
        for a, b in distinct
    )


def _of_both(pair: tuple[Array, Array] | None, measure: Callable[[Array], float]) -> tuple[float, float] | None:
    return None if pair is None else (measure(pair[0]), measure(pair[1]))


def _text(value: float | None, spec: str, unit: str = "") -> str:
    return "-" if value is None else f"{value:{spec}}{unit}"
