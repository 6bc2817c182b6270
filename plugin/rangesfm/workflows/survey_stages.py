"""What a survey tells the stages: the same for the whole map and for one in the making."""

from __future__ import annotations

import numpy as np
import pycolmap

from rangesfm.distances.tape import Tape
from rangesfm.geometry.gravity import gravity_of
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.refine.with_ranges import RefineSummary, refine_with_ranges
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.vision.image_times import ImageTimes


def path_of_model(model: pycolmap.Reconstruction, times: ImageTimes | None) -> Trajectory:
    """The path of a model's photos; without their times where the log names photos."""
    if times is None:
        return trajectory_from_reconstruction(model)
    return trajectory_from_reconstruction(model, times.by_name(), time_resolution_s=times.resolution_s)


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
    ranges = survey.ranges
    # Those of which neither the log nor the survey says how noisy they are.
    stddev_is_estimated = np.isnan(estimate.observations.log.range_stddev_m) & (ranges.range_stddev_m is None)
    return refine_with_ranges(
        scaled,
        trajectory,
        estimate.observations,
        estimate.metric_from_sfm,
        estimate.anchors,
        tag_in_cam_m=inputs.tag_in_cam_m,
        range_stddev_m=estimate.range_stddev_m,
        range_share=estimate.range_share,
        stddev_is_estimated=stddev_is_estimated,
        correlation_inflation=estimate.correlation_inflation,
        common_bias_stddev_m=ranges.common_bias_stddev_m,
        first_pose_is_fixed=estimate.frame != "site",
        gravity=gravity_of(survey.scale.up_in_first_camera),
        camera=survey.camera,
        options=survey.refine,
        tape=tape,
        num_threads=survey.mapper.num_threads,
    )
