"""Joining of models without common photos, through ranges to the same anchors, into one model, path and range set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from rangesfm.colmap.transform import joined_model, rescale
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.model_placement import ScaledModel, place_models
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.lengths.locate_lengths import distances_within
from rangesfm.measurements.lengths.markers import locatable
from rangesfm.measurements.ranges.range_observations import each_on_one_path, joined_observations
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import joined_trajectory


@dataclass(frozen=True)
class ModelVerdict:
    """Outcome for one of the models that were to be joined.

    Attributes:
        name: name for the user, such as "sparse/0".
        estimate: estimate of its scale by its own ranges; None if they do not determine it.
        joined_from_sfm: transformation from its unscaled world to that of the joined unscaled model; None if the model
            is left out.
        reason: why it is left out; empty if it is not.
    """

    name: str
    num_images: int
    estimate: ScaleEstimate | None
    joined_from_sfm: Similarity | None
    reason: str


@dataclass(frozen=True)
class JoinedModels:
    """Result of joining.

    Attributes:
        path: the joined model, in the world and unit of the first model.
    """

    path: PathOfModel
    verdicts: tuple[ModelVerdict, ...]
    notes: tuple[str, ...]


def join_models(run: SurveyRun, parts: Sequence[PathOfModel]) -> JoinedModels:
    """Scale each model on its own, then place all in one world by all their ranges, with one set of anchors.

    Args:
        run: survey of the models.
        parts: models without common photos. The others are joined to the first one.

    Raises:
        GeometryError: the scale of the first model is not determined.
    """
    exclusive = each_on_one_path([part.observations for part in parts])
    parts = [replace(part, observations=of) for part, of in zip(parts, exclusive, strict=True)]
    first = _first_in_time(parts)
    scaled: dict[int, ScaledModel] = {}
    reasons: dict[int, str] = {}  # why the own ranges of a model do not determine its scale, or why it is not placed
    for k, part in enumerate(parts):
        try:
            scaled[k] = scaled_alone(run, part, has_first_camera=k == first)
        except GeometryError as error:
            if k == 0:
                raise
            reasons[k] = str(error)
    places, why_not, notes = place_models(list(scaled.values()))
    reasons |= {k: reason for k, reason in zip(scaled, why_not, strict=True) if reason}
    if first in reasons and run.inputs.anchor_frame == "first_camera":
        why = f"the anchors are given in the frame of the first photo, and {parts[first].name}, which has that photo, "
        reasons = {k: reasons.get(k, f"{why}cannot be placed") for k in range(1, len(parts))}
    first_from_sfm = dict(zip(scaled, places, strict=True))
    placed = {k: motion for k, motion in first_from_sfm.items() if motion is not None and k not in reasons}
    verdicts = (
        ModelVerdict(
            part.name,
            part.sfm.num_reg_images(),
            scaled[k].estimate if k in scaled else None,
            placed.get(k),
            reasons.get(k, ""),
        )
        for k, part in enumerate(parts)
    )
    path = assembled([parts[k] for k in placed], list(placed.values()))
    return JoinedModels(path, tuple(verdicts), notes)


def _first_in_time(parts: Sequence[PathOfModel]) -> int:
    """Return the index of the model with the earliest photo, or without times the first photo by name."""
    starts = [
        (0.0 if path.timestamps_s is None else float(path.timestamps_s[0]), path.image_names[0])
        for path in (part.trajectory for part in parts)
    ]
    return starts.index(min(starts))


def scaled_alone(run: SurveyRun, part: PathOfModel, *, has_first_camera: bool) -> ScaledModel:
    """Scale a model by its own ranges.

    For a model without the first photo, anchors in that photo's frame are like anchors in a site frame.
    """
    frame = run.inputs.anchor_frame
    if not has_first_camera:
        frame = "site" if frame == "first_camera" else frame
        run = run.changed({"scale.up_in_first_camera": None})
    tape = distances_within(locatable(run.inputs.tape, part.sfm), part.sfm, part.observations.log.anchor_ids)
    run = replace(run, inputs=replace(run.inputs, anchor_frame=frame, tape=tape))
    estimate = run.estimate_scale(part)
    is_given = frame == "first_camera"
    return ScaledModel(
        part.trajectory, estimate, is_in_anchor_frame=is_given or estimate.frame == "site", frame_is_given=is_given
    )


def assembled(
    parts: Sequence[PathOfModel], first_from_sfm: Sequence[Similarity], *, is_of_one_database: bool = False
) -> PathOfModel:
    """Return all models and paths as one, in the world of the first; ``is_of_one_database`` as for ``joined_model``."""
    if len(parts) == 1:
        return parts[0]
    moved = [
        part.trajectory.transformed(motion.scale, motion.rotation, motion.translation)
        for part, motion in zip(parts, first_from_sfm, strict=True)
    ]
    trajectory, keyframes = joined_trajectory(moved)
    observations = joined_observations([part.observations for part in parts], first_from_sfm, keyframes)
    moved_models = [rescale(part.sfm, motion) for part, motion in zip(parts, first_from_sfm, strict=True)]
    model = joined_model(moved_models, is_of_one_database=is_of_one_database)
    frame_of = {image.name: image.frame_id for image in model.images.values()}
    frame_ids = np.array([frame_of[name] for name in trajectory.image_names], dtype=np.int64)
    path = replace(trajectory, frame_ids=frame_ids)
    return PathOfModel(parts[0].name, model, path, observations, parts[0].time_offset)
