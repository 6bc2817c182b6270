"""Joining of models without common photos, through ranges to the same anchors, into one model, path and range set."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from rangesfm.colmap.transform import joined_model, rescale
from rangesfm.distances.locate_lengths import distances_within, locatable, locate_distances
from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import Similarity
from rangesfm.geometry.trajectory import Trajectory, joined_trajectory
from rangesfm.ranging.errors.bending import MapBending
from rangesfm.ranging.range_observations import RangeObservations, each_on_one_path, joined_observations
from rangesfm.scale.initialize import initialize_scale
from rangesfm.scale.model_placement import ScaledModel, place_models
from rangesfm.scale.scale_estimate import ScaleEstimate
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey


@dataclass(frozen=True)
class ModelVerdict:
    """Outcome for one of the models that were to be joined.

    Attributes:
        name: name for the user, such as "sparse/0".
        num_images: number of its photos.
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
class PathOfModel:
    """A model with its path and the ranges on that path.

    Attributes:
        name: name for the user, such as "sparse/0".
        sfm: the unscaled model.
        trajectory: path of its photos that have a time.
        observations: ranges on that path, from the log that all models share.
    """

    name: str
    sfm: pycolmap.Reconstruction
    trajectory: Trajectory
    observations: RangeObservations


def estimate_scale(
    survey: Survey, inputs: RangingInputs, path: PathOfModel, bending: MapBending | None = None
) -> ScaleEstimate:
    """Estimate the scale of a model by ``initialize_scale``, with the options and measured lengths of a survey."""
    distances = None
    if inputs.tape is not None:
        distances = locate_distances(inputs.tape, path.sfm, path.observations.log.anchor_ids)
    return initialize_scale(
        path.observations,
        path.trajectory,
        inputs.anchors,
        anchor_frame=inputs.anchor_frame,
        options=survey.scale,
        range_model=survey.ranges,
        distances=distances,
        bending=bending,
        seed=survey.output.seed,
    )


@dataclass(frozen=True)
class JoinedModels:
    """Result of joining.

    Attributes:
        path: the joined model, in the world and unit of the first model.
        verdicts: the outcome for each model.
        notes: lines for the user.
    """

    path: PathOfModel
    verdicts: tuple[ModelVerdict, ...]
    notes: tuple[str, ...]


def join_models(parts: Sequence[PathOfModel], survey: Survey, inputs: RangingInputs) -> JoinedModels:
    """Scale each model on its own, then place all in one world by all their ranges, with one set of anchors.

    Args:
        parts: models without common photos. The others are joined to the first one.

    Raises:
        GeometryError: the scale of the first model is not determined.
    """
    exclusive = each_on_one_path([part.observations for part in parts])
    parts = [replace(part, observations=of) for part, of in zip(parts, exclusive, strict=True)]
    first = _first_in_time(parts)
    scaled, reasons = _scaled_alone(parts, survey, inputs, first)
    placements = place_models(list(scaled.values()))
    reasons |= {k: reason for k, reason in zip(scaled, placements.reasons, strict=True) if reason}
    if first in reasons and inputs.anchor_frame == "first_camera":
        why = f"the anchors are given in the frame of the first photo, and {parts[first].name}, which has that photo, "
        reasons = {k: reasons.get(k, f"{why}cannot be placed") for k in range(1, len(parts))}
    first_from_sfm = dict(zip(scaled, placements.first_from_sfm, strict=True))
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
    path = _assembled([parts[k] for k in placed], list(placed.values()))
    return JoinedModels(path, tuple(verdicts), placements.notes)


def _first_in_time(parts: Sequence[PathOfModel]) -> int:
    """Return the index of the model with the earliest photo, or without times the first photo by name."""
    starts = [
        (0.0 if path.timestamps_s is None else float(path.timestamps_s[0]), path.image_names[0])
        for path in (part.trajectory for part in parts)
    ]
    return starts.index(min(starts))


def _scaled_alone(
    parts: Sequence[PathOfModel], survey: Survey, inputs: RangingInputs, first: int
) -> tuple[dict[int, ScaledModel], dict[int, str]]:
    """Return the models whose scale their own ranges determine, and for the other models the reason.

    Both are by the models' indices in ``parts``. The first model must be among the scaled ones, else a GeometryError
    is raised.
    """
    scaled: dict[int, ScaledModel] = {}
    reasons: dict[int, str] = {}
    for k, part in enumerate(parts):
        try:
            scaled[k] = _alone(part, survey, inputs, has_first_camera=k == first)
        except GeometryError as error:
            if k == 0:
                raise
            reasons[k] = str(error)
    return scaled, reasons


def _alone(part: PathOfModel, survey: Survey, inputs: RangingInputs, *, has_first_camera: bool) -> ScaledModel:
    """Scale a model by its own ranges.

    For a model without the first photo, anchors in that photo's frame are like anchors in a site frame.
    """
    frame, tape = inputs.anchor_frame, inputs.tape
    if not has_first_camera:
        frame = "site" if frame == "first_camera" else frame
        survey = survey.changed({"scale.up_in_first_camera": None})
    if tape is not None:
        tape = distances_within(locatable(tape, part.sfm), part.sfm, part.observations.log.anchor_ids)
    estimate = estimate_scale(survey, replace(inputs, anchor_frame=frame, tape=tape), part)
    is_given = frame == "first_camera"
    return ScaledModel(
        part.trajectory, estimate, is_in_anchor_frame=is_given or estimate.frame == "site", frame_is_given=is_given
    )


def _assembled(parts: Sequence[PathOfModel], first_from_sfm: Sequence[Similarity]) -> PathOfModel:
    """Return all models and paths as one, in the world of the first."""
    if len(parts) == 1:
        return parts[0]
    moved = [
        part.trajectory.transformed(motion.scale, motion.rotation, motion.translation)
        for part, motion in zip(parts, first_from_sfm, strict=True)
    ]
    trajectory, keyframes = joined_trajectory(moved)
    observations = joined_observations([part.observations for part in parts], first_from_sfm, keyframes)
    model = joined_model([rescale(part.sfm, motion) for part, motion in zip(parts, first_from_sfm, strict=True)])
    frame_of = {image.name: image.frame_id for image in model.images.values()}
    frame_ids = np.array([frame_of[name] for name in trajectory.image_names], dtype=np.int64)
    return PathOfModel(parts[0].name, model, replace(trajectory, frame_ids=frame_ids), observations)
