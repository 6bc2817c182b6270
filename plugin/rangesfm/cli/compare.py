"""``rangesfm compare``: what scaling and refinement did, and any models of the same photos with each other."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import add_flags, flags_given, overrides_from_arguments, survey_from_arguments
from rangesfm.errors import InputError
from rangesfm.progress import Progress

if TYPE_CHECKING:
    from rangesfm.comparison.models import NamedModel
    from rangesfm.comparison.ranges import ModelRanges
    from rangesfm.distances.tape import Tape
    from rangesfm.survey.settings import Survey


_KEYS = ("images.path", "ranges", "anchors", "tag", "scale")
_OF_A_RUN = ("ranges.check_share", "ranges.check_anchors", "ranges.check_times_s", "scale.method")
_WITHOUT_LOG = ("--distances", "--markers")


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "compare",
        execute,
        help="models with each other and with a reference",
        description=(
            "One result folder: its models with each other, and with a reference if there is one.\n"
            "Two or more models, result folders or files of camera positions: each with the first.\n"
            "--ranges holds them against a radio log, which the first of them places (default: the ranges that the\n"
            "first result folder used), --distances against taped distances."
        ),
        example=(
            "rangesfm compare out --reference reference.csv\n"
            "  rangesfm compare out other_tool/sparse/0 --output_path comparison\n"
            "  rangesfm compare one/sparse/0 other/sparse/0 --ranges uwb.csv --anchors anchors.csv \\\n"
            "      --images images.csv --tag_in_cam -0.0012,-0.09,-0.0663 --distances taped.csv"
        ),
    )
    parser.add_argument("models", nargs="*", metavar="MODEL", help="result folders, COLMAP models, CSV or TUM files")
    parser.add_argument("--input_path", metavar="RESULT", help="one result folder (default: out)")
    parser.add_argument("--reference", metavar="FILE", help="true positions: CSV or TUM")
    parser.add_argument("--output_path", metavar="FOLDER", help="of two or more: write comparison.html there as well")
    add_flags(parser, *_KEYS, without=_OF_A_RUN)


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    given = [*([] if args.input_path is None else [args.input_path]), *args.models]
    paths = [Path(path) for path in given] or [Path("out")]
    reference = None if args.reference is None else Path(args.reference)
    if len(paths) == 1:
        _check_more_than_one_is_not_asked_for(args, paths[0])
        from rangesfm.comparison.before_after import compare_folder

        return Outcome([str(compare_folder(paths[0], reference))])
    return _compare_many(args, paths, reference)


def _check_more_than_one_is_not_asked_for(args: argparse.Namespace, path: Path) -> None:
    if args.output_path is not None:
        raise InputError(f"one model is given, {path}; a page of comparison needs two (see rangesfm report)")
    if overrides_from_arguments(args):
        raise InputError(f"one model is given, {path}; ranges and distances to hold models against need two")


def _compare_many(args: argparse.Namespace, paths: list[Path], reference_path: Path | None) -> Outcome:
    from rangesfm.comparison.models import compare_many, read_models
    from rangesfm.comparison.with_reference import compare, format_table
    from rangesfm.geometry.reference import read_reference

    survey = _survey(args)
    models = read_models(paths)
    comparison = compare_many(models, _ranges(survey, models[0], paths[0]), _tape(survey))
    lines = [str(comparison)]
    if reference_path is not None:
        trajectories = {model.name: model.path for model in comparison.models}
        lines += ["", format_table(compare(trajectories, read_reference(reference_path), frame=None))]
    if args.output_path is not None:
        from rangesfm.comparison.page import write_comparison

        lines += ["", f"page: {write_comparison(comparison, Path(args.output_path))}"]
    return Outcome(lines)


def _survey(args: argparse.Namespace) -> Survey:
    """The ranges and distances as the flags describe them."""
    given = flags_given(args, *_KEYS)
    of_log = [name for name in given if name not in _WITHOUT_LOG]
    if of_log and "--ranges" not in given:
        raise InputError(f"{', '.join(of_log)} given without a log to use it for, expected --ranges LOG as well")
    return survey_from_arguments(args)


def _ranges(survey: Survey, first: NamedModel, path: Path) -> ModelRanges | None:
    from rangesfm.comparison.ranges import ranges_of_survey
    from rangesfm.survey.inputs import read_ranging_inputs

    if survey.ranges.path is None or first.model is None:
        return None
    return ranges_of_survey(survey, read_ranging_inputs(survey), first.model, path)


def _tape(survey: Survey) -> Tape | None:
    from rangesfm.distances.tape import read_tape

    return None if survey.scale.distances is None else read_tape(survey.scale.distances, survey.scale.markers)
