"""``rangesfm compare``: what scaling and refinement did, and any models of the same photos with each other."""

from __future__ import annotations

import argparse
from pathlib import Path

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.errors import InputError
from rangesfm.progress import Progress


def add_command(commands: Commands) -> None:
    parser = commands.add(
        "compare",
        execute,
        help="models with each other and with a reference",
        description=(
            "One result folder: its models with each other, and with a reference if there is one.\n"
            "Two or more models, result folders or files of camera positions: each with the first."
        ),
        example=(
            "rangesfm compare out --reference reference.csv\n"
            "  rangesfm compare out other_tool/sparse/0 --output_path comparison"
        ),
    )
    parser.add_argument("models", nargs="*", metavar="MODEL", help="result folders, COLMAP models, CSV or TUM files")
    parser.add_argument("--input_path", metavar="RESULT", help="one result folder (default: out)")
    parser.add_argument("--reference", metavar="FILE", help="true positions: CSV or TUM")
    parser.add_argument("--output_path", metavar="FOLDER", help="of two or more: write comparison.html there as well")


def execute(args: argparse.Namespace, progress: Progress) -> Outcome:
    given = [*([] if args.input_path is None else [args.input_path]), *args.models]
    paths = [Path(path) for path in given] or [Path("out")]
    reference = None if args.reference is None else Path(args.reference)
    if len(paths) == 1:
        if args.output_path is not None:
            raise InputError(f"one model is given, {paths[0]}; a page of comparison needs two (see rangesfm report)")
        from rangesfm.comparison import compare_folder

        return Outcome([str(compare_folder(paths[0], reference))])
    return _compare_many(paths, reference, None if args.output_path is None else Path(args.output_path))


def _compare_many(paths: list[Path], reference_path: Path | None, output_path: Path | None) -> Outcome:
    from rangesfm.comparison import compare, format_table
    from rangesfm.model_comparison import compare_many, read_models
    from rangesfm.reference import read_reference

    comparison = compare_many(read_models(paths))
    lines = [str(comparison)]
    if reference_path is not None:
        trajectories = {model.name: model.path for model in comparison.models}
        lines += ["", format_table(compare(trajectories, read_reference(reference_path), frame=None))]
    if output_path is not None:
        from rangesfm.comparison_page import write_comparison

        lines += ["", f"page: {write_comparison(comparison, output_path)}"]
    return Outcome(lines)
