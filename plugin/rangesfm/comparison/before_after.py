"""Comparison of a model before the refinement with the same model after it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.arrays import Array, median, rms
from rangesfm.comparison.same_photos import Length, common_photos, lengths_along, reprojection_rms_px
from rangesfm.comparison.with_reference import papers_table
from rangesfm.errors import InputError
from rangesfm.result.comparison_row import format_table
from rangesfm.result.result_folder import read_result_folder
from rangesfm.result.result_tables import RangesAsUsed
from rangesfm.util.files.text_tables import align_rows
from rangesfm.util.geometry.reference import read_reference
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.util.processes.threads import with_one_blas_thread


@dataclass(frozen=True)
class ModelComparison:
    """Comparison of two models of the same photos in the same world. All pairs are (before, after).

    Attributes:
        reprojection_rms_px: empty where one of the two is only a path.
        range_rms_m, range_median_abs_m: RMS and median size of the given range residuals; empty without any.
        displacements_m: (n,) distance between both positions of each keyframe that both models have.
        distances: between a few keyframes spread over the path.
    """

    reprojection_rms_px: tuple[float, ...]
    range_rms_m: tuple[float, ...]
    range_median_abs_m: tuple[float, ...]
    displacements_m: Array
    distances: tuple[Length, ...]

    def __str__(self) -> str:
        pairs = {
            "reprojection RMS px": self.reprojection_rms_px,
            "range residual RMS m": self.range_rms_m,
            "range residual median abs m": self.range_median_abs_m,
            **{f"{a} to {b} m": lengths for a, b, lengths in self.distances},
        }
        rows = [(label, *(f"{value:.4f}" for value in pair)) for label, pair in pairs.items() if pair]
        moved = self.displacements_m
        return (
            f"{align_rows([('', 'before', 'after'), *rows])}\n{len(moved)} keyframes moved by {moved.mean():.4f} m on "
            f"average, at most {moved.max():.4f} m"
        )


@with_one_blas_thread
def compare_models(
    before: pycolmap.Reconstruction | Trajectory,
    after: pycolmap.Reconstruction | Trajectory,
    *,
    range_residuals_m: Sequence[Array] = (),
) -> ModelComparison:
    """Compare two metric models of the same photos in the same world.

    Args:
        before: model or path before the change.
        after: model or path after it.
        range_residuals_m: predicted minus measured ranges, (k,) each, before and after; empty without ranges.

    Raises:
        InputError: they have no photo in common.
    """
    models = [one for one in (before, after) if not isinstance(one, Trajectory)]
    paths = [one if isinstance(one, Trajectory) else trajectory_from_reconstruction(one) for one in (before, after)]
    names, centers_before, centers_after = common_photos(*paths)
    if not names:
        raise InputError("the two models have no photo in common")
    return ModelComparison(
        reprojection_rms_px=tuple(map(reprojection_rms_px, models)) if len(models) == 2 else (),
        range_rms_m=tuple(map(rms, range_residuals_m)),
        range_median_abs_m=tuple(median(np.abs(one)) for one in range_residuals_m),
        displacements_m=np.linalg.norm(centers_after - centers_before, axis=1),
        distances=lengths_along(paths),
    )


def compare_folder(output_path: Path, reference_path: Path | None = None) -> str:
    """Compare the models in the output folder of a run with each other and, if there is one, with a reference file.

    Returns:
        Tables in plain text: that of the 2018 paper, if there is a reference; and the scaled against the refined model,
        if the run refined.

    Raises:
        InputError: the folder is not a result or has nothing to compare, or the reference cannot be read or has none of
            its photos.
    """
    result = read_result_folder(output_path)
    scaled, refined = result.read_model("sparse_scaled"), result.read_model("sparse_metric")
    if scaled is None:
        raise InputError("there is no scaled model (sparse_scaled/0) to compare", output_path)
    if refined is None and reference_path is None:
        raise InputError("the run did not refine (no sparse_metric/0): a reference is needed to compare", output_path)
    tables = []
    if reference_path is not None:
        path = result.path_in(scaled)
        paths = {"scaled": path} if refined is None else {"scaled": path, "refined": path.as_in(refined)}
        rows = papers_table(paths, read_reference(reference_path), frame=result.summary.frame)
        tables.append(format_table(rows, result.summary.frame))
    if refined is not None:
        ranges = result.read(RangesAsUsed)
        both = [of_all[ranges.is_used] for of_all in ranges.residuals_by_model_m.values()]
        known = np.isfinite(both).all(axis=0)
        residuals_m = [of_one[known] for of_one in both] if len(both) == 2 and known.any() else []
        tables.append(str(compare_models(scaled, refined, range_residuals_m=residuals_m)))
    return "\n\n".join(tables)
