"""Cut a survey with true positions into one that drifts, in which photos share points with their neighbours only.

Run: python -m tests.studies.drift_prone_cut SURVEY.toml --base_path DATA --output_path OUT [--first 0]
     [--num_photos 120] [--overlap 2] [--max_num_features 1000]
 or: python -m tests.studies.drift_prone_cut SURVEY.toml --base_path DATA --output_path OUT --input_path sparse/0
     [--max_track_length 3] [--share_of_points 0.15] [--num_seeds 3]

The first command maps a stretch of successive photos (all of them, even if the survey file skips some, so that
neighbours overlap well). Each photo is matched with the ``--overlap`` photos before it and with no other, so that no
loop is closed. Matches and models of an earlier run in OUT are used again.

In a room even such a sequence hardly drifts, because features are seen many times. The second command therefore takes
an existing model and shortens its tracks, as if from a fast camera: it keeps a random share of the points, cuts each
track into pieces of successive photos, starting at a random photo, and adjusts everything from there without ranges
until it converges. Features and their errors stay as they were; the drift is what the photos then leave undetermined.

Prints root mean square errors of the keyframes' centres, in metres, without alignment, after the best rigid motion and
after the best similarity: of the unscaled model, at the true scale, at the estimated scale and refined. The survey file
names reference, anchors and ranges.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import pycolmap
from tests.known import known

from rangesfm.comparison.with_reference import compare, format_table
from rangesfm.errors import InputError
from rangesfm.geometry.trajectory import trajectory_from_reconstruction
from rangesfm.progress import SilentProgress
from rangesfm.survey.inputs import read_ranging_inputs, times_of_model
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import read_survey
from rangesfm.vision.image_times import ImageTimes, find_image_times, list_images
from rangesfm.vision.reconstruct import reconstruct
from rangesfm.workflows.run import refine_model

# A tolerance small enough that the solver runs to convergence.
_TOLERANCE = 1e-10
_MAX_NUM_ITERATIONS = 200
_NUM_ROUNDS = 3
# As in COLMAP's mapper: points with less parallax may go behind the horizon.
_MAX_REPROJECTION_ERROR_PX = 4.0
_MIN_TRI_ANGLE_DEG = 1.5


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("survey", type=Path)
    parser.add_argument("--base_path", type=Path)
    parser.add_argument("--output_path", type=Path, required=True)
    parser.add_argument("--first", type=int, default=0, help="photo with which the stretch begins, from 0")
    parser.add_argument("--num_photos", type=int, default=120)
    parser.add_argument("--overlap", type=int, default=2)
    parser.add_argument("--max_num_features", type=int, default=1000)
    parser.add_argument("--input_path", type=Path, help="a model, instead of mapping")
    parser.add_argument("--max_track_length", type=int, default=3, help="photos in a piece of a track of that model")
    parser.add_argument("--share_of_points", type=float, default=0.15, help="of that model")
    parser.add_argument("--num_seeds", type=int, default=3, help="choices of points and pieces")
    args = parser.parse_args()
    survey = read_survey(args.survey, {"output.path": str(args.output_path.absolute())}, args.base_path)
    args.output_path.mkdir(parents=True, exist_ok=True)
    if args.input_path is None:
        times = times_of_stretch(survey, args.first, args.num_photos)
        sfm = mapped(survey, times, args.overlap, args.max_num_features)
        print_row(survey, sfm)
    else:
        whole = pycolmap.Reconstruction(args.input_path)
        for seed in range(args.num_seeds):
            print_row(survey, forgetful(whole, args.max_track_length, args.share_of_points, seed))


def times_of_stretch(survey: Survey, first: int, num_photos: int) -> ImageTimes:
    assert survey.images.path is not None
    times = find_image_times(survey.images.path, list_images(survey.images.path), survey.images.times)
    return times.of(times.image_names[first : first + num_photos])


def mapped(survey: Survey, times: ImageTimes, overlap: int, max_num_features: int) -> pycolmap.Reconstruction:
    """Return the largest model of the stretch."""
    mapper = survey.mapper.changed(
        matching="sequential",
        pairing={"overlap": overlap, "quadratic_overlap": False},
        features={"sift": {"max_num_features": max_num_features}},
    )
    assert survey.images.path is not None
    summary = reconstruct(
        survey.images.path,
        times.image_names,
        survey.output.path,
        camera=survey.camera,
        mapper=mapper,
        seed=survey.output.seed,
    )
    return summary.models[0]


def forgetful(
    whole: pycolmap.Reconstruction, max_track_length: int, share_of_points: float, seed: int
) -> pycolmap.Reconstruction:
    """Keep some of the points, cut into tracks of few successive photos, and adjust them without ranges."""
    model, rng = pycolmap.Reconstruction(whole), np.random.default_rng(seed)
    for point_id, point in sorted(whole.points3D.items()):
        model.delete_point3D(point_id)
        if rng.random() > share_of_points:
            continue
        # Names of photos are in the order of time.
        elements = sorted(point.track.elements, key=lambda element: whole.image(element.image_id).name)
        begin = -int(rng.integers(max_track_length))
        for start in range(begin, len(elements), max_track_length):
            piece = elements[max(start, 0) : start + max_track_length]
            if len({element.image_id for element in piece}) > 1:
                model.add_point3D(point.xyz, pycolmap.Track(piece))
    for _ in range(_NUM_ROUNDS):
        pycolmap.ObservationManager(model).filter_all_points3D(_MAX_REPROJECTION_ERROR_PX, _MIN_TRI_ANGLE_DEG)
        adjust_alone(model)
    return model


def adjust_alone(model: pycolmap.Reconstruction) -> None:
    """Adjust the model in place with its photos alone."""
    options = pycolmap.BundleAdjustmentOptions(
        print_summary=False, refine_focal_length=False, refine_extra_params=False
    )
    solver = options.ceres.solver_options
    solver.max_num_iterations = _MAX_NUM_ITERATIONS
    solver.function_tolerance = solver.gradient_tolerance = solver.parameter_tolerance = _TOLERANCE
    options.ceres.solver_options = solver
    pycolmap.bundle_adjustment(model, options)


def print_row(survey: Survey, sfm: pycolmap.Reconstruction) -> None:
    """Print the errors of the unscaled, scaled and refined map against the reference."""
    lengths = [point.track.length() for point in sfm.points3D.values()]
    print(f"{sfm.num_reg_images()} photos, {len(lengths)} points, seen {np.mean(lengths):.1f} times on average")
    path = survey.output.path / "cut"
    path.mkdir(exist_ok=True)
    sfm.write_binary(path)
    reference = read_ranging_inputs(survey).reference
    if reference is None:
        raise InputError("no true positions: give [report] reference in the survey file")
    times = times_of_model(survey, sfm, path)
    unscaled = compare({"unscaled": trajectory_from_reconstruction(sfm, times.by_name())}, reference, frame=None)
    cut = survey.changed({"images.model": path.absolute()}).changed(
        {"output.path": survey.output.path / "result", "refine.covariance": False, "report.enabled": False}
    )
    result = refine_model(cut, progress=SilentProgress()).summary
    print(format_table((*unscaled, *result.comparison), result.frame))
    print(f"{known(result.refine).iterations} iterations of the full problem\n", flush=True)


if __name__ == "__main__":
    main()
