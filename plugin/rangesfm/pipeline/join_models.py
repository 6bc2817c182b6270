"""Several models of one survey as one: tied by photos that look alike, or joined through ranges to the same anchors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pycolmap
from scipy.special import ndtri

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.colmap.transform import joined_model, rescale
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.model_placement import Piece, place_pieces
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.lengths.locate_lengths import distances_within, locatable
from rangesfm.measurements.ranges.range_observations import each_on_one_path, joined_observations
from rangesfm.pipeline.close_loops import loop_matching
from rangesfm.pipeline.metric_result import ModelVerdict
from rangesfm.pipeline.place_ranges import place_ranges
from rangesfm.sfm.incremental_mapping import adjust_whole
from rangesfm.sfm.loop_database import Pair
from rangesfm.sfm.loops.loop_finder import MAX_CHANCE
from rangesfm.sfm.loops.model_ties import Tie, find_tie
from rangesfm.sfm.loops.rounds import MAX_NUM_PAIRS
from rangesfm.sfm.mapping import mapping_options
from rangesfm.sfm.photos_alike import pairs_alike
from rangesfm.sfm.rigs import read_rigs
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.files.output_folder import sole_writer
from rangesfm.util.geometry.similarity import IDENTITY, Similarity
from rangesfm.util.geometry.trajectory import joined_trajectory

# Largest difference of two ranges beyond the distance of their places, in standard deviations of a range.
_MAX_IN_STDDEVS = -float(np.sqrt(2) * ndtri(MAX_CHANCE))


def join_models(
    run: SurveyRun, parts: Sequence[PathOfModel], *, must_join: bool = False
) -> tuple[PathOfModel, tuple[ModelVerdict, ...]]:
    """Scale each model on its own, then place all in one world by all their ranges, with one set of anchors.

    Models that cannot be joined to the first one are left out with a warning.

    Args:
        run: survey of the models.
        parts: models without common photos, with the ranges on their paths.
        must_join: whether it is an error if no other model can be joined.

    Returns:
        The joined model, in the world and unit of the first one, and the verdicts on all models (none where there is
        only one).

    Raises:
        GeometryError: the scale of the first model is not determined; or no other model can be joined, and
            ``must_join`` is true.
    """
    if len(parts) == 1:
        return parts[0], ()
    exclusive = each_on_one_path([part.observations for part in parts])
    parts = [replace(part, observations=of) for part, of in zip(parts, exclusive, strict=True)]
    first = _first_in_time(parts)
    is_given = run.inputs.anchor_frame == "first_camera"
    estimates: dict[int, ScaleEstimate] = {}
    reasons: dict[int, str] = {}  # why the own ranges of a model do not determine its scale, or why it is not placed
    for k, part in enumerate(parts):
        try:
            estimates[k] = scaled_alone(run, part, has_first_camera=k == first)
        except GeometryError as error:
            if k == 0:
                raise
            reasons[k] = str(error)
    pieces = {
        k: Piece(parts[k].trajectory, each, each.frame == "site" or (is_given and k == first), each.metric_from_sfm)
        for k, each in estimates.items()
    }
    placed, not_placed, notes = place_pieces(pieces)
    reasons |= not_placed
    if first in reasons and is_given:
        why = f"the anchors are given in the frame of the first photo, and {parts[first].name}, which has that photo, "
        reasons = {k: reasons.get(k, f"{why}cannot be placed") for k in range(1, len(parts))}
    placed = {k: placed[k] for k in sorted(placed.keys() - reasons.keys())}
    verdicts = tuple(
        ModelVerdict(part.name, part.sfm.num_reg_images(), estimates.get(k), placed.get(k), reasons.get(k, ""))
        for k, part in enumerate(parts)
    )
    left_out = [model for model in verdicts if model.joined_from_sfm is None]
    if must_join and len(left_out) == len(parts) - 1:
        why = "; ".join(f"{model.name}: {model.reason}" for model in left_out)
        raise GeometryError(f"nothing can be joined to {parts[0].name}: {why}")
    whose = (f"{model.name} ({model.num_images} photos) is left out: {model.reason}" for model in left_out)
    run.journal.warn(*notes, *whose)
    return assembled([parts[k] for k in placed], list(placed.values())), verdicts


def _first_in_time(parts: Sequence[PathOfModel]) -> int:
    """Return the index of the model with the earliest photo, or without times the first photo by name."""
    starts = [
        (0.0 if path.timestamps_s is None else float(path.timestamps_s[0]), path.image_names[0])
        for path in (part.trajectory for part in parts)
    ]
    return starts.index(min(starts))


def scaled_alone(run: SurveyRun, part: PathOfModel, *, has_first_camera: bool) -> ScaleEstimate:
    """Scale a model by all that is measured in it.

    For a model without the first photo, anchors in that photo's frame are like anchors in a site frame.
    """
    frame = run.inputs.anchor_frame
    if not has_first_camera:
        frame = "site" if frame == "first_camera" else frame
        run = run.changed({"scale.up_in_first_camera": None})
    tape = distances_within(locatable(run.inputs.tape, part.sfm), part.sfm, part.observations.log.anchor_ids)
    run = replace(run, inputs=replace(run.inputs, anchor_frame=frame, tape=tape))
    return run.estimate_scale(part, part.as_walk)


def assembled(
    parts: Sequence[PathOfModel], first_from_sfm: Sequence[Similarity], *, is_of_one_database: bool = False
) -> PathOfModel:
    """Return all models and paths as one, in the world of the first; ``is_of_one_database`` as for ``joined_model``."""
    if len(parts) == 1:
        return parts[0]
    moved = [part.trajectory.transformed(motion) for part, motion in zip(parts, first_from_sfm, strict=True)]
    trajectory, keyframes = joined_trajectory(moved)
    observations = joined_observations([part.observations for part in parts], first_from_sfm, keyframes)
    moved_models = [rescale(part.sfm, motion) for part, motion in zip(parts, first_from_sfm, strict=True)]
    model = joined_model(moved_models, is_of_one_database=is_of_one_database)
    frame_of = {image.name: image.frame_id for image in model.images.values()}
    frame_ids = np.array([frame_of[name] for name in trajectory.image_names], dtype=np.int64)
    path = replace(trajectory, frame_ids=frame_ids)
    return PathOfModel(parts[0].name, model, path, observations, parts[0].time_offset)


def tie_by_photos(run: SurveyRun, paths: Sequence[PathOfModel]) -> list[PathOfModel]:
    """Return the models with those that photos tie as one, the one with the most photos first.

    The path of no single model says which photos of different models see the same. A vocabulary of all their features
    proposes pairs, COLMAP matches them, and the ranges exclude ties that cannot be.

    Args:
        run: the survey.
        paths: its models with the ranges on their paths.
    """
    if len(paths) == 1:
        return list(paths)
    with sole_writer(run.survey.output.path) as output:
        if (matching := loop_matching(run.survey, run.journal.progress, output)) is None:
            return list(paths)
        with run.journal.stage("loops"):
            groups = [set(path.sfm.reg_image_ids()) for path in paths]
            own = {image_id: group for group in groups for image_id in group}
            seed, database = run.survey.output.seed, matching.database
            proposed = pairs_alike(database, own, matching.log, max_num=MAX_NUM_PAIRS, seed=seed)
            tied, pairs = _tied(run, paths, matching.match(proposed))
            matching.keep_ties(proposed, pairs)
            with colmap_log(matching.log):
                for path in (path for path in tied if not any(path is one for one in paths)):
                    adjust_whole(database, path.sfm, options=_options(run, database))
            output.defer(matching.places)
    if not pairs:
        return list(paths)
    models = sorted((path.sfm for path in tied), key=lambda model: -model.num_reg_images())
    return place_ranges(run, models)


def _options(run: SurveyRun, database_path: Path) -> pycolmap.IncrementalPipelineOptions:
    """Return the options by which the mapping adjusts a whole model."""
    survey = run.survey
    rigs, seed = read_rigs(survey.images.rig_config), survey.output.seed
    of_mapping = mapping_options(survey.camera, survey.mapper, rigs, seed, database_path)
    options = of_mapping.whole or of_mapping.growing
    if isinstance(options, pycolmap.IncrementalPipelineOptions):
        return options
    return pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed)


def _tied(
    run: SurveyRun, paths: Sequence[PathOfModel], verified: Mapping[Pair, Indices]
) -> tuple[list[PathOfModel], set[Pair]]:
    """Return the models, of which those that photos tie are one, and the pairs that tie them; each tie is told."""
    parts, pairs, contradicted = list(paths), set[Pair](), list[str]()
    while (found := _next_tie(run, parts, verified, contradicted)) is not None:
        first, second, tie = found
        one, other = parts[first], parts[second]
        run.journal.progress.message(
            f"{other.name} ({other.sfm.num_reg_images()} photos) becomes a part of {one.name}:"
            f" {len(tie.pairs)} pairs of photos tie them"
        )
        parts[first] = assembled([one, other], [IDENTITY, tie.first_from_second], is_of_one_database=True)
        del parts[second]
        pairs.update((min(pair), max(pair)) for pair in tie.pairs)
    run.journal.warn(*contradicted)
    return parts, pairs


def _next_tie(
    run: SurveyRun, parts: Sequence[PathOfModel], verified: Mapping[Pair, Indices], contradicted: list[str]
) -> tuple[int, int, Tie] | None:
    """Return a tie of two models that the ranges allow, with their indices; note the others in ``contradicted``."""
    for first, second in combinations(range(len(parts)), 2):
        one, other = parts[first], parts[second]
        tie = find_tie(one.sfm, other.sfm, verified, seed=run.survey.output.seed)
        if tie is None:
            continue
        if not (why := _contradiction(run, one, other, tie)):
            return first, second, tie
        if (told := f"{other.name} looks like a part of {one.name}, but is none: {why}") not in contradicted:
            contradicted.append(told)
    return None


def _contradiction(run: SurveyRun, first: PathOfModel, second: PathOfModel, tie: Tie) -> str:
    """Return why the ranges exclude a tie; empty if they do not.

    The ranges of two antennas to one anchor cannot differ by more than the distance of the antennas.
    """
    scale = _scale_alone(run, first, second, tie)
    if scale is None:
        return ""
    metres_per_unit, stddev_m = scale
    metric_from_first = replace(IDENTITY, scale=metres_per_unit)
    sides = [
        (first, _ranges_at_keyframes(first, metric_from_first)),
        (second, _ranges_at_keyframes(second, metric_from_first @ tie.first_from_second)),
    ]
    excess: dict[int, list[float]] = {}
    for pair in tie.pairs:
        one, other = (at.get(path.sfm.image(id_).frame_id, {}) for (path, at), id_ in zip(sides, pair, strict=True))
        for anchor in one.keys() & other.keys():
            (range_m, tag_m), (other_range_m, other_tag_m) = one[anchor], other[anchor]
            apart_m = float(np.linalg.norm(tag_m - other_tag_m))
            excess.setdefault(anchor, []).append(abs(range_m - other_range_m) - apart_m)
    worst = max(excess, key=lambda anchor: np.median(excess[anchor]), default=None)
    if worst is None or (excess_m := float(np.median(excess[worst]))) < _MAX_IN_STDDEVS * stddev_m:
        return ""
    anchor_id = first.observations.log.anchor_ids[worst]
    return f"ranges to {anchor_id} of photos that see the same differ by {excess_m:.2g} m more than their places"


def _scale_alone(run: SurveyRun, first: PathOfModel, second: PathOfModel, tie: Tie) -> tuple[float, float] | None:
    """Return metres per unit of the first model, and the standard deviation of a range, by one of the models alone.

    None if neither determines them. A wrong tie would hide itself in the noise that both models show together.
    """
    for path, units in ((first, 1.0), (second, tie.first_from_second.scale)):
        try:
            estimate = scaled_alone(run, path, has_first_camera=False)
        except GeometryError:
            continue
        return estimate.value / units, float(np.nanmedian(estimate.ranges.errors.stddev_m))
    return None


def _ranges_at_keyframes(path: PathOfModel, metric_from_sfm: Similarity) -> dict[int, dict[int, tuple[float, Array]]]:
    """Return, by frame and by index of the anchor, the median range near a keyframe and the antenna's median place."""
    of, log = path.observations, path.observations.log
    tags_m = metric_from_sfm.apply(of.centers) + of.tag_from_center @ metric_from_sfm.rotation.T
    rows_of: dict[tuple[int, int], list[int]] = {}
    for row in np.flatnonzero(of.has_place).tolist():
        rows_of.setdefault((int(of.nearest[row]), int(log.anchor_index[row])), []).append(row)
    found: dict[int, dict[int, tuple[float, Array]]] = {}
    for (keyframe, anchor), rows in rows_of.items():
        frame_id = int(path.trajectory.frame_ids[keyframe])
        median = float(np.median(log.range_m[rows])), np.median(tags_m[rows], axis=0)
        found.setdefault(frame_id, {})[anchor] = median
    return found
