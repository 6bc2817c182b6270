"""Comparison of any number of models of the same photos with the first: positions, lengths and residuals."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, rms
from rangesfm.colmap.model_files import read_model
from rangesfm.comparison.model_ranges import NO_RANGES, ModelRanges, ranges_of_result
from rangesfm.comparison.same_photos import Length, common_photos, lengths_along, reprojection_rms_px
from rangesfm.comparison.with_reference import compare, known_keyframes, similarity_onto
from rangesfm.errors import InputError
from rangesfm.measurements.lengths.locate_lengths import locate_distances
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.lengths.tape_file import markers_of_photos
from rangesfm.measurements.positions.true_positions import read_true_positions
from rangesfm.report.report_tables import ReportTable
from rangesfm.result.comparison_row import text_or_dash
from rangesfm.result.result_folder import ResultFolder, read_result_folder
from rangesfm.result.summary import ResultSummary
from rangesfm.survey.photo_times import times_of_model
from rangesfm.survey.settings import Survey
from rangesfm.util.files.text_tables import align_rows
from rangesfm.util.geometry.reference import NO_REFERENCE, Reference
from rangesfm.util.geometry.similarity import Similarity, rmse
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

_NOT_KNOWN = (math.nan, math.nan)


@dataclass(frozen=True)
class NamedModel:
    """One of the models to compare.

    Attributes:
        name: path from which it was read.
        path: keyframes in the world of the model.
        model: empty where only positions are known.
        result: result folder whose final model this is; None for other models.
        frame: world of a model in metres, as in ``compare``; None where the unit of the model is not known.
        has_orientations: whether the rotations of the path are known; otherwise they are the identity.
    """

    name: str
    path: Trajectory
    model: pycolmap.Reconstruction
    result: ResultFolder | None
    frame: str | None = None
    has_orientations: bool = True

    def heading(self, of_column: str) -> str:
        """Return the heading of a column with lengths in the unit of the model."""
        return of_column if self.frame is None else f"{of_column} m"


@dataclass(frozen=True)
class ModelRow:
    """Comparison of one model with the first model.

    Attributes:
        base_from_model: best similarity from this model to the first; None with fewer than three common photos.
        common_names: names of the photos in both, in the order of the first model.
        moved, moved_aligned: (n,) distance of each common camera from its position in the first model, before and after
            that similarity, in the unit of the first model; ``moved_aligned`` is NaN without a similarity.
        reprojection_rms_px: NaN for a file of positions and for a model without points.
        range_rms_m: RMS of range residuals. First with the cameras as they are; if the model is a result and no log is
            given, of the ranges and anchors of its own run, so that it does not depend on the other models. Then of the
            ranges that all models share, with the cameras moved by the similarity that brings them closest to
            ``ModelRanges.metric_path``. NaN without ranges.
    """

    model: NamedModel
    base_from_model: Similarity | None
    common_names: tuple[str, ...]
    moved: Array
    moved_aligned: Array
    reprojection_rms_px: float
    range_rms_m: tuple[float, float]

    @property
    def aligned(self) -> Trajectory:
        """Return the path after that similarity, or as it is without one."""
        path = self.model.path
        return path if self.base_from_model is None else path.transformed(self.base_from_model)

    @property
    def scale_ratio(self) -> float:
        """Return the lengths in the model divided by those in the first model; NaN without a similarity."""
        return math.nan if self.base_from_model is None else 1.0 / self.base_from_model.scale

    @property
    def rotation_deg(self) -> float:
        """Return the rotation angle of the similarity in degrees; NaN without a similarity."""
        if self.base_from_model is None:
            return math.nan
        return float(np.rad2deg(Rotation.from_matrix(self.base_from_model.rotation).magnitude()))


@dataclass(frozen=True)
class ModelsComparison:
    """Comparison of models of the same photos with the first of them.

    Attributes:
        rows: one for each model, as given; all are compared with the first.
        distances: between a few pairs of photos that all models have.
        taped: for the ends of each taped distance, its length by tape; its length in each model, in the unit of that
            model; and with ranges, the latter with the scale that brings the model onto ``ModelRanges.metric_path``.
            NaN for a model that is only a path.
        truth: rows of the table against a reference; empty without one.
    """

    rows: tuple[ModelRow, ...]
    distances: tuple[Length, ...]
    taped: Mapping[tuple[str, str], Sequence[float]]
    truth: Sequence[Sequence[str]]

    @property
    def tables(self) -> tuple[ReportTable, ...]:
        """Return the tables of the comparison. A table without data has no rows."""
        models = [row.model for row in self.rows]
        cells = [_cells(row, models[0]) for row in self.rows]
        names = [model.heading(model.name) for model in models]
        of_row = [f"{model.name} after Sim(3) m" for model in models]
        of_row = of_row if any(len(lengths) > 1 + len(names) for lengths in self.taped.values()) else []
        taped = [
            [f"{a} to {b}", *(text_or_dash(length, ".4f") for length in lengths)]
            for (a, b), lengths in self.taped.items()
        ]
        distances = [[f"{a} to {b}", *(f"{length:.4f}" for length in lengths)] for a, b, lengths in self.distances]
        return (
            ReportTable(
                "Each model against the first",
                [name for name, _ in cells[0]],
                [[text for _, text in row] for row in cells],
                _NOTE,
            ),
            ReportTable("Distances between photos", ["distance", *names], distances, _UNIT_NOTE),
            ReportTable(
                "Taped distances",
                ["taped distance", "tape m", *names, *of_row],
                taped,
                _TAPED_NOTE,
            ),
            ReportTable("Each model against the reference", _TRUTH_HEADER, self.truth, _TRUTH_NOTE),
        )

    def __str__(self) -> str:
        return "\n\n".join(align_rows([table.header, *table.rows]) for table in self.tables if table.rows)


def read_named_models(paths: Sequence[Path], survey: Survey = Survey()) -> tuple[NamedModel, ...]:
    """Read COLMAP models, final models of result folders, and files of camera positions (CSV or TUM), in any order.

    Args:
        paths: of models and files.
        survey: settings that may say when the photos were taken. Where they do not, the times are those of the result
            folders that the models come from, or those in the photos' names.

    Raises:
        InputError: one of the paths is none of these, or none of them is a model.
    """
    folders = [path for path in paths if not path.is_file()]
    if not folders:
        raise InputError("only files of positions are given, expected a model or a result folder too", paths[0])
    models = {path: _read_model(path) for path in folders}
    times_s = _photo_times(models, survey)
    timed = {}
    for path, model in models.items():
        has_no_times = model.path.timestamps_s is None and all(name in times_s for name in model.path.image_names)
        timed[path] = replace(model, path=model.path.timed(times_s)) if has_no_times else model
    return tuple(timed[path] if path in timed else _read_positions(path, timed[folders[0]].path) for path in paths)


def _photo_times(models: Mapping[Path, NamedModel], survey: Survey) -> dict[str, float]:
    """Return the times of the models' photos by name; empty where they are not known."""
    path, first = next(iter(models.items()))
    times_s: dict[str, float] = {}
    if survey.images.times is not None:
        return dict(times_of_model(survey, first.model, path).by_name())
    with suppress(InputError):  # the names of the photos are no times
        times_s.update(times_of_model(survey, first.model, path).by_name())
    for result in filter(None, map(_result_around, models)):
        times_s.update(result.timestamps_s)
    return times_s


def _result_around(path: Path) -> ResultFolder | None:
    """Return the result that is in this folder, or that has this model as its sparse/0, sparse_scaled/0, ..."""
    folders = (path, path.absolute().parent.parent)
    return next((read_result_folder(folder) for folder in folders if (folder / ResultSummary.NAME).is_file()), None)


def compare_many(
    models: Sequence[NamedModel],
    ranges: ModelRanges = NO_RANGES,
    tape: Tape = Tape(),
    reference: Reference = NO_REFERENCE,
) -> ModelsComparison:
    """Compare models with the first of them.

    Args:
        models: to compare.
        ranges: with which to compare the models; without any, those of the first result folder among the models.
        tape: taped distances to measure in each model.
        reference: true positions.

    Raises:
        InputError: a model has no photo in common with the first, or lacks an end of a taped distance; or the reference
            has no keyframe of a model, or is by time and the times of its photos are not known.
    """
    own = [ranges or (ranges_of_result(one.result, one.path) if one.result else NO_RANGES) for one in models]
    ranges = next(filter(None, own), NO_RANGES)
    common = (common_photos(ranges.metric_path, model.path) for model in models)
    onto_ranges = [similarity_onto(source, target) for _, target, source in common]
    rows = []
    for model, own_ranges, onto in zip(models, own, onto_ranges, strict=True):
        range_rms_m = _NOT_KNOWN
        if onto is not None and model.has_orientations:
            as_it_is = rms((own_ranges or ranges).residuals_m(model.path))
            carried = rms(ranges.residuals_m(model.path.transformed(onto)))
            range_rms_m = _NOT_KNOWN if np.isnan(as_it_is) else (as_it_is, carried)
        rows.append(_row(models[0], model, range_rms_m))
    taped = _taped(models, ranges, onto_ranges, tape)
    truth = [_truth_cells(model, reference) for model in models] if len(reference) else []
    return ModelsComparison(tuple(rows), lengths_along([model.path for model in models]), taped, truth)


def _read_model(path: Path) -> NamedModel:
    result = _result_around(path)
    if result is not None and (path / ResultSummary.NAME).is_file():
        metric = result.read_metric_model()
        if metric is None:
            raise InputError("the result holds no metric model", path)
        return NamedModel(str(path), result.path_in(metric), metric, result, result.summary.frame)
    model, kind = read_model(path), path.absolute().parent.name
    frame = result.summary.frame if result is not None and kind in ("sparse_scaled", "sparse_metric") else None
    return NamedModel(str(path), trajectory_from_reconstruction(model), model, None, frame)


def _read_positions(path: Path, base: Trajectory) -> NamedModel:
    reference = read_true_positions(path)
    known, positions, rotations = known_keyframes(base, reference)
    if len(known) == 0:
        raise InputError(reference.why_nothing_is_known("keyframes", reference.moments_of(base)), path)
    trajectory = Trajectory(
        frame_ids=base.frame_ids[known],
        image_names=tuple(base.image_names[i] for i in known),
        timestamps_s=None if base.timestamps_s is None else base.timestamps_s[known],
        centers=positions,
        world_from_cam=np.tile(np.eye(3), (len(known), 1, 1)) if rotations is None else rotations,
    )
    has_orientations, no_model = rotations is not None, pycolmap.Reconstruction()
    return NamedModel(str(path), trajectory, no_model, None, "site", has_orientations=has_orientations)


def _row(base: NamedModel, other: NamedModel, range_rms_m: tuple[float, float]) -> ModelRow:
    names, ours, theirs = common_photos(base.path, other.path)
    if not names:
        raise InputError(f"it has no photo in common with {base.name}", other.name)
    similarity = similarity_onto(theirs, ours)
    aligned = np.full(ours.shape, np.nan) if similarity is None else similarity.apply(theirs)
    return ModelRow(
        model=other,
        base_from_model=similarity,
        common_names=names,
        moved=np.linalg.norm(theirs - ours, axis=1),
        moved_aligned=np.linalg.norm(aligned - ours, axis=1),
        reprojection_rms_px=reprojection_rms_px(other.model),
        range_rms_m=range_rms_m,
    )


def _taped(
    models: Sequence[NamedModel], ranges: ModelRanges, onto_ranges: Sequence[Similarity | None], tape: Tape
) -> dict[tuple[str, str], list[float]]:
    """Return ``ModelsComparison.taped``.

    Raises:
        InputError: an end of a distance is not in a model.
    """
    anchors_m = ranges.anchors_m
    places = np.array(list(anchors_m.values())).reshape(-1, 3)
    lengths, lengths_m = (np.full((len(models), len(tape.distances)), np.nan) for _ in range(2))
    for k, (model, onto) in enumerate(zip(models, onto_ranges, strict=True)):
        if not model.model.num_images():
            continue
        try:
            markers = markers_of_photos(tape.markers, [image.name for image in model.model.images.values()])
            located = locate_distances(replace(tape, markers=markers), model.model, list(anchors_m))
        except InputError as error:
            raise InputError(f"{error} (model {model.name})") from None
        lengths[k] = located.lengths_m(1.0, places)
        if onto is not None:
            lengths_m[k] = located.lengths_m(onto.scale, places)
    both = np.vstack([lengths, lengths_m]) if ranges else lengths
    return {taped.ends: [taped.distance_m, *both[:, k].tolist()] for k, taped in enumerate(tape.distances)}


_TRUTH_HEADER = ("model", "keyframes", "RMSE m", "aligned by", "after SE(3) m", "after Sim(3) m", "scale / truth")
_ALIGNED_BY = {"site": "nothing", "first_camera": "first pose", None: "-"}
_TRUTH_NOTE = (
    "Root mean square distances of the cameras from the reference: of a model in the site's frame without any "
    "alignment, and of one in the first camera's frame after alignment by the pose of its first known keyframe; after "
    "the best rotation and shift; and after the best similarity. Of a model that is not known to be in metres, only "
    "the last is compared."
)
_UNIT_NOTE = "Lengths of a model whose unit is not known to be the metre are in its own units."
_NOTE = (
    "Scale / first: lengths in the model divided by those in the first model. Turn: rotation of the best similarity "
    "from the model to the first model. Moved: RMS distance of the cameras from their positions in the first model, "
    "before and after that similarity, where both are in metres or neither is known to be. Range RMS: of the residuals "
    "of ranges with the cameras as they are, for models in metres. A result has its own ranges and anchors, unless a "
    "log is given; the other models have those of the first result. After Sim(3): of these for all models, after the "
    "best similarity onto the path that they were placed on."
)
_TAPED_NOTE = (
    f"{_UNIT_NOTE} After Sim(3): with the scale that brings the cameras of the model onto the path that the ranges "
    "were placed on."
)


def _truth_cells(model: NamedModel, reference: Reference) -> Sequence[str]:
    """Return the cells of a model's row against a reference, under ``_TRUTH_HEADER``."""
    (row,) = compare({model.name: model.path}, reference, frame=model.frame)
    ratio = None if row.scale_error_percent is None else 1.0 + row.scale_error_percent / 100.0
    rmse_se3_m = None if model.frame is None else row.rmse_se3_m
    first, *aligned = (text_or_dash(length_m, ".4f") for length_m in (row.rmse_m, rmse_se3_m, row.rmse_sim3_m))
    by = _ALIGNED_BY[None if row.rmse_m is None else model.frame]
    return (model.name, str(row.num_keyframes), first, by, *aligned, text_or_dash(ratio, ".6g"))


def _cells(row: ModelRow, first: NamedModel) -> list[tuple[str, str]]:
    """Return name and text of each cell of a row about a model and the first; the name is that of the column."""
    aligned, is_metric = row.moved_aligned, row.model.frame is not None
    moved = rmse(row.moved[:, None]) if is_metric == (first.frame is not None) else None
    return [
        ("model", row.model.name),
        ("photos in common", f"{len(row.common_names)} of {len(row.model.path)}"),
        ("scale / first", text_or_dash(row.scale_ratio, ".6g")),
        ("turn deg", text_or_dash(row.rotation_deg, ".3f")),
        (first.heading("moved"), text_or_dash(moved, ".4f")),
        (first.heading("after Sim(3)"), text_or_dash(rmse(aligned[:, None]), ".4f")),
        (first.heading("most"), text_or_dash(float(aligned.max()), ".4f")),
        ("reproj. px", text_or_dash(row.reprojection_rms_px, ".4f")),
        ("range RMS m", text_or_dash(row.range_rms_m[0] if is_metric else None, ".4f")),
        ("after Sim(3) m", text_or_dash(row.range_rms_m[1], ".4f")),
    ]
