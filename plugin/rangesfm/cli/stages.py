"""The commands that make a map: ``run``, ``demo``, ``reconstruct``, ``scale``, ``refine`` and ``join``."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import (
    MEASURED,
    add_flags,
    add_restart_argument,
    add_survey_arguments,
    survey_from_arguments,
)
from rangesfm.errors import InputError
from rangesfm.progress import Progress

if TYPE_CHECKING:
    from rangesfm.survey.settings import Survey


_SCALE_KEYS = (
    *("images.path", "images.model", "images.times", "images.rig_config", "images.baseline_stddev_m"),
    *(MEASURED, "anchors", "tag", "mapper.num_threads", "export", "report", "output"),
)
_DEMO_FOLDER = "rangesfm_demo"
_MIN_NUM_PHOTOS = 20  # fewer walk too short a way to tell the time offset
_JOIN_KEYS = (
    *("ranges.range_stddev_m", "ranges.range_bias_stddev_m", "ranges.common_bias_stddev_m", "anchors", "scale"),
    *("mapper.num_threads", "refine", "export", "report", "output"),
)


def add_stages_commands(commands: Commands) -> None:
    run = commands.add("run", _run, "make a metric model from photos and ranges: the whole pipeline", is_common=True)
    add_survey_arguments(run)
    add_restart_argument(run)
    demo = commands.add("demo", _demo, "make a small survey and run the pipeline on it: no data needed", is_common=True)
    demo.add_argument(
        "folder", nargs="?", default=_DEMO_FOLDER, metavar="DIR", help=f"folder to write to (default: {_DEMO_FOLDER})"
    )
    demo.add_argument(
        "--scene",
        choices=("yard", "corridor"),
        default="yard",
        help="yard: 40 photos, five surveyed anchors; corridor: 96 photos whose map drifts, one anchor, and a path "
        "that comes back to its start (default: yard)",
    )
    demo.add_argument(
        "--num_photos", type=int, metavar="N", help="use the first N of the photos, 20 or more (default: all)"
    )
    demo.add_argument("--imu", action="store_true", help="with the log of a phone's inertial sensor on the camera, too")
    demo.add_argument("--seed", type=int, default=0, metavar="N", help="seed of the sensors and the run (default: 0)")
    demo.add_argument("--num_threads", type=int, metavar="N", help="number of threads; -1: one for each core")
    add_restart_argument(demo)
    reconstruct = commands.add("reconstruct", _reconstruct, "make an unscaled COLMAP model from photos")
    add_survey_arguments(reconstruct, "images", "camera", "mapper", "output", without=("images.model",))
    add_restart_argument(reconstruct)
    scale = commands.add("scale", _scale, "estimate the scale of a COLMAP model from ranges, with a verdict")
    add_survey_arguments(scale, *_SCALE_KEYS)
    refine = commands.add("refine", _refine, "make a refined metric model from a COLMAP model and ranges")
    of_loops = ("mapper.database_path", "mapper.close_loops")
    add_survey_arguments(refine, *_SCALE_KEYS, "camera.refine_intrinsics", *of_loops, "refine")
    join = commands.add(
        "join", _join, "join several surveys of one site to one metric map, through their common anchors"
    )
    join.add_argument("results", nargs="*", metavar="RESULT", help="output folders of runs, two or more")
    add_flags(join, *_JOIN_KEYS, without=("scale.up_in_first_camera", "scale.distances", "scale.markers"))


def _run(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Make a metric model from photos and ranges. Stages that an earlier run has finished are not done again. In place
    of a survey file, a folder is enough if its files can be recognised (see rangesfm init).

    example:
      rangesfm run my_survey
      rangesfm run survey.toml --every_nth 3 --output_path out
    """
    survey = survey_from_arguments(args, progress)
    if args.survey is not None and survey.source.path is None:  # the argument is a folder without a survey file
        from rangesfm.pipeline.check import check_survey

        for fact in check_survey(survey).understood():
            progress.message(fact)
    if survey.images.model is None:
        _require_images(survey)
        survey.require_metres()
    else:
        _require_model_and_metres(survey)
    from rangesfm.pipeline.run import run_survey

    return Outcome(run_survey(survey, progress=progress, restart=args.restart).lines)


def _demo(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Make a small survey (photos, simulated UWB log, truth) and run it. The photos of the yard come with rangesfm.
    Those of the corridor are rendered; their map shows drift, which the range to one anchor and then loops take out.

    example:
      rangesfm demo my_demo
      rangesfm demo my_corridor --scene corridor
    """
    from rangesfm.demo import corridor
    from rangesfm.demo import survey as yard
    from rangesfm.pipeline.run import run_survey
    from rangesfm.survey.survey_reader import read_survey

    most = corridor.NUM_PHOTOS if args.scene == "corridor" else yard.NUM_PHOTOS
    num_photos = most if args.num_photos is None else args.num_photos
    if not _MIN_NUM_PHOTOS <= num_photos <= most:
        raise InputError(f"--num_photos is {num_photos}, expected {_MIN_NUM_PHOTOS} to {most}")
    if args.seed < 0:
        raise InputError(f"--seed is {args.seed}, expected 0 or more")
    make = corridor.make_corridor_survey if args.scene == "corridor" else yard.make_demo_survey
    folder = Path(args.folder)
    made = make(folder, num_photos=num_photos, seed=args.seed, imu=args.imu)
    overrides: dict[str, object] = {"output.seed": args.seed, "report.reference": folder / "reference.csv"}
    if args.num_threads is not None:
        overrides["mapper.num_threads"] = args.num_threads
    survey = read_survey(made.survey_path, overrides)
    return Outcome(run_survey(survey, progress=progress, restart=args.restart).lines)


def _reconstruct(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Make an unscaled COLMAP model from photos: keyframes, features, matching, mapping.

    example:
      rangesfm reconstruct --images photos --image_times images.csv
    """
    survey = survey_from_arguments(args)
    _require_images(survey)
    from rangesfm.pipeline.run import reconstruct_survey

    return Outcome(reconstruct_survey(survey, progress=progress, restart=args.restart))


def _scale(args: argparse.Namespace, progress: Progress) -> Outcome:
    r"""Estimate the scale of a COLMAP model from ranges, and write the rescaled model. The model needs no points.

    example:
      rangesfm scale --input_path sparse/0 --ranges uwb.csv --images images.csv \
        --output_path out
    """
    survey = survey_from_arguments(args)
    _require_model_and_metres(survey)
    from rangesfm.pipeline.run import scale_model

    return Outcome(scale_model(survey, progress=progress).lines)


def _refine(args: argparse.Namespace, progress: Progress) -> Outcome:
    r"""Scale a COLMAP model by ranges, then refine it by a bundle adjustment that includes the ranges. If the
    refinement breaks the map, the scaled map is the result, and the reason is printed.

    example:
      rangesfm refine --input_path sparse/0 --ranges uwb.csv --anchors anchors.csv \
        --images images.csv --tag_in_cam -0.0012,-0.09,-0.0663 --output_path out
    """
    survey = survey_from_arguments(args)
    _require_model_and_metres(survey)
    from rangesfm.pipeline.run import refine_model

    return Outcome(refine_model(survey, progress=progress).lines)


def _join(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Join the results of surveys with common anchors to one map with one set of anchors. The surveys may be of
    different days, or of different cameras with their own tags; they need no common photos. The map is in the frame of
    the first one. Anchors need not be surveyed: then each survey must have three or more in common with the others, not
    on a line.

    example:
      rangesfm join monday/out tuesday/out --output_path site
    """
    survey = survey_from_arguments(args)
    from rangesfm.pipeline.join_surveys import join_surveys

    return Outcome(join_surveys(survey, [Path(result) for result in args.results], progress=progress).lines)


def _require_images(survey: Survey) -> None:
    from rangesfm.survey.sources.source import is_source

    path = survey.photos_path
    if not (os.path.isdir(path) or (is_source(path) and path.is_file())):
        raise InputError("no such folder of photos, video or bag", path)


def _require_model_and_metres(survey: Survey) -> None:
    if not os.path.exists(survey.given_model_path):
        raise InputError("no such folder of a COLMAP model, or file of a trajectory", survey.given_model_path)
    survey.require_metres()
