"""Ranges on the paths of models: the offset of the clocks, and where on its path each range was taken."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.colmap.merge import without_photos
from rangesfm.errors import InputError
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.join.models import PathOfModel
from rangesfm.ranging.association import associate
from rangesfm.ranging.clock.estimate import TimeOffset, estimate_time_offset
from rangesfm.ranging.log import RangeKind
from rangesfm.ranging.observations import RangeObservations, RangeStatus, hold_out
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.vision.image_times import ImageTimes
from rangesfm.workflows.journal import Journal


def path_of_model(model: pycolmap.Reconstruction, times: ImageTimes | None) -> Trajectory:
    """The path of a model's photos; without their times where the log names photos."""
    if times is None:
        return trajectory_from_reconstruction(model)
    return trajectory_from_reconstruction(model, times.by_name(), time_resolution_s=times.resolution_s)


def path_with_times(
    survey: Survey, model: pycolmap.Reconstruction, times: ImageTimes | None, journal: Journal
) -> Trajectory:
    """The path of a model's photos that have a time, if the log needs any; InputError if none has."""
    trajectory = path_of_model(model, times)
    if not len(trajectory):
        first = min(image.name for image in model.images.values())
        raise InputError(f"none of the model's photos has a time, the first is {first}", survey.images.times)
    num = model.num_reg_frames()
    if num_without_time := num - len(trajectory):
        journal.warn(f"{num_without_time} of {num} photos of the model have no time and are left out")
    return trajectory


def find_time_offset(
    survey: Survey, inputs: RangingInputs, trajectory: Trajectory, journal: Journal
) -> TimeOffset | None:
    """Search for the offset of the clocks where it is wanted and not given."""
    if inputs.log.image_name is not None or survey.ranges.time_offset_s is not None:
        return None
    with journal.stage("time offset"):
        offset = estimate_time_offset(
            inputs.log,
            trajectory,
            inputs.tag_in_cam_m,
            association=survey.ranges,
            seed=survey.output.seed,
            progress=journal.progress,
        )
    if offset.note:
        journal.warn(offset.note)
    return offset


def ranges_on_paths(
    survey: Survey,
    inputs: RangingInputs,
    models: Sequence[pycolmap.Reconstruction],
    trajectory: Trajectory,
    times: ImageTimes | None,
    offset: TimeOffset | None,
    journal: Journal,
) -> list[PathOfModel]:
    """The models with the ranges on their paths; of photos in several of them the first model keeps them.

    Args:
        trajectory: of the first model.
    """
    offset_s = offset.value_s if offset is not None else survey.ranges.time_offset_s
    radio_times_s = inputs.log.timestamp_s
    offsets_s = (offset_s or 0.0) if offset is None or radio_times_s is None else offset.at(radio_times_s)
    paths = [PathOfModel("sparse/0", models[0], trajectory, ranges_on_path(survey, inputs, trajectory, offsets_s))]
    names = set(trajectory.image_names)
    for k, model in enumerate(models[1:], start=1):
        rest = without_photos(model, names)
        path = path_of_model(rest, times)
        if not len(path):
            journal.warn(f"sparse/{k} is left out: its photos have no time, or are in other models too")
            continue
        names.update(path.image_names)
        observations = hold_out(_on_path(survey, inputs, path, offsets_s), survey.ranges, survey.output.seed)
        paths.append(PathOfModel(f"sparse/{k}", rest, path, observations))
    return paths


def ranges_on_path(
    survey: Survey, inputs: RangingInputs, trajectory: Trajectory, offset_s: float | npt.NDArray[np.float64]
) -> RangeObservations:
    """Ranges on the path; refused where the clocks cannot be right."""
    observations = _on_path(survey, inputs, trajectory, offset_s)
    if not observations.has_place.any():
        raise InputError(
            _why_no_range_has_a_place(observations, trajectory, float(np.mean(offset_s))), survey.ranges.path
        )
    return hold_out(observations, survey.ranges, survey.output.seed)


def _on_path(
    survey: Survey, inputs: RangingInputs, trajectory: Trajectory, offset_s: float | npt.NDArray[np.float64]
) -> RangeObservations:
    return associate(inputs.log, trajectory, inputs.tag_in_cam_m, time_offset_s=offset_s, options=survey.ranges)


def _why_no_range_has_a_place(observations: RangeObservations, trajectory: Trajectory, offset_s: float) -> str:
    times, photo_times = observations.log.timestamp_s, trajectory.timestamps_s
    if times is None or photo_times is None:
        return "none of the photos that the log names is in the model"
    if np.all(observations.status[observations.log.kind == RangeKind.TAG_ANCHOR] == RangeStatus.OUTSIDE_PATH):
        return (
            f"the log's times ({times.min():.3f} to {times.max():.3f} s, plus an offset of {offset_s:g} s) do not "
            f"overlap the photos' ({photo_times[0]:.3f} to {photo_times[-1]:.3f} s): give another time offset, or auto"
        )
    return "no range is near enough to a keyframe in time: use more photos, or a larger max_interpolation_gap_s"
