"""What a survey tells the stages: the same for the whole map and for one in the making."""

from __future__ import annotations

import pycolmap

from rangesfm.distances.ends import LocatedDistances
from rangesfm.distances.tape import Tape
from rangesfm.geometry.gravity import gravity_of
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.ranging.observations import RangeObservations
from rangesfm.refine.with_ranges import RefineSummary, refine_with_ranges
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.scale.initialize import initialize_scale
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.vision.image_times import ImageTimes


def path_of_model(model: pycolmap.Reconstruction, times: ImageTimes | None) -> Trajectory:
    """The path of a model's photos; without their times where the log names photos."""
    if times is None:
        return trajectory_from_reconstruction(model)
    return trajectory_from_reconstruction(model, times.by_name(), time_resolution_s=times.resolution_s)


def estimate_scale(
    survey: Survey,
    inputs: RangingInputs,
    observations: RangeObservations,
    trajectory: Trajectory,
    anchor_frame: str,
    distances: LocatedDistances | None,
) -> ScaleEstimate:
    """``initialize_scale`` by a survey's options; its arguments."""
    return initialize_scale(
        observations,
        trajectory,
        inputs.anchors,
        anchor_frame=anchor_frame,
        options=survey.scale,
        range_model=survey.ranges,
        distances=distances,
        seed=survey.output.seed,
    )


def refine_by_survey(
    survey: Survey,
    inputs: RangingInputs,
    scaled: pycolmap.Reconstruction,
    trajectory: Trajectory,
    estimate: ScaleEstimate,
    tape: Tape | None,
) -> tuple[pycolmap.Reconstruction, RefineSummary]:
    """``refine_with_ranges`` by a survey's options, from what the scale stage found.

    Args:
        scaled: in the metric world. trajectory: of the unscaled model, as the scale stage had it.
        tape: distances to keep to.
    """
    return refine_with_ranges(
        scaled,
        trajectory,
        estimate.observations,
        estimate.metric_from_sfm,
        estimate.anchors,
        estimate.errors,
        tag_in_cam_m=inputs.tag_in_cam_m,
        first_pose_is_fixed=estimate.frame != "site",
        gravity=gravity_of(survey.scale.up_in_first_camera),
        camera=survey.camera,
        options=survey.refine,
        tape=tape,
        num_threads=survey.mapper.num_threads,
    )
