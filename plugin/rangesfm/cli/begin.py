"""The commands that come before a first run: ``init``, ``check`` and ``plan``, and ``doctor``."""

from __future__ import annotations

import argparse
import os
import shlex
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.cli.arguments import Commands, Outcome
from rangesfm.cli.survey_flags import (
    add_flags,
    add_survey_arguments,
    overrides_from_arguments,
    survey_from_arguments,
)
from rangesfm.errors import GeometryError, InputError, SolverError
from rangesfm.progress import Progress

if TYPE_CHECKING:
    from rangesfm.pipeline.check import CheckedSurvey


def add_begin_commands(commands: Commands) -> None:
    init = commands.add("init", _init, "write a survey file from folders of photos and logs", is_common=True)
    init.add_argument("folders", nargs="+", metavar="FOLDER", help="folders with photos, log, anchors, ...")
    init.add_argument("--output_path", metavar="PATH", help="survey file, or its folder (default: the first FOLDER)")
    init.add_argument("--force", action="store_true", help="write a survey file anew that is there already")
    add_flags(init, without=("output.path",))
    check = commands.add(
        "check", _check, "say in seconds what a run would read, and what is wrong with it", is_common=True
    )
    add_survey_arguments(check)
    plan = commands.add(
        "plan", _plan, "say before a survey how accurate it will be, and what to change", is_common=True
    )
    plan.add_argument("plan", nargs="?", metavar="PLAN.toml", help="file with anchors, path and radio")
    plan.add_argument("--from", dest="result", metavar="RESULT", help="plan another survey like this finished one")
    plan.add_argument("--output_path", metavar="FOLDER", help="write plan.json and plan.html into this folder")
    commands.add("doctor", _doctor, "check the installation: versions, and whether the compiled part fits them")


def _init(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Look into folders for photos, the radio's log, anchors, times, calibration and true positions, and write a
    survey file with comments that can be run. Files are recognised by their content. Prints what was understood,
    what is assumed, what is missing and which files are not used. Flags give what the folders do not hold. An existing
    file is not changed without --force.

    example:
      rangesfm init my_survey --tag_in_cam 0.03,-0.12,-0.05
    """
    from rangesfm.pipeline.check import check_survey
    from rangesfm.survey.discovery.found_files import SURVEY_NAME
    from rangesfm.survey.discovery.survey_file import survey_text
    from rangesfm.survey.discovery.understood import understand
    from rangesfm.survey.survey_reader import read_survey, survey_from_tables
    from rangesfm.util.files.atomic import write_text
    from rangesfm.util.files.output_folder import free_output

    folders = [Path(folder) for folder in args.folders]
    path = Path(args.output_path or folders[0])
    path = path if path.suffix == ".toml" else path / SURVEY_NAME
    if os.path.lexists(path) and not args.force:
        raise InputError(
            "is there already and is left as it is; --force writes it anew, --output_path PATH writes another", path
        )
    values, notes = understand(folders, overrides_from_arguments(args), args.typed)
    survey_from_tables({}, Path.cwd(), values)  # raises an error about bad values before anything is written
    folder = path.absolute().parent
    folder.mkdir(parents=True, exist_ok=True)
    kept = _make_way(path) if path.is_file() else None
    write_text(survey_text({**values, "output.path": free_output(folder)}, folder), path)
    checked = check_survey(read_survey(path))
    lines = [f"wrote {path}" + (f", and kept the earlier one as {kept.name}" if kept else "")]
    lines += [*told(checked, fault="missing"), *(f"note: {note}" for note in notes)]
    command = shlex.join(["rangesfm", "check" if checked.faults else "run", str(path)])
    missing = "write down what is missing (a flag is a key of the same name), then " if checked.faults else ""
    return Outcome([*lines, f"next: {missing}{command}"])


def _make_way(path: Path) -> Path | None:
    """Rename a survey file that somebody has changed since it was written, and return its new path; else None."""
    from rangesfm.util.files.output_folder import absolute, writer_of

    with writer_of(path) as output:
        if output.is_own(absolute(path)):
            return None
    names = (f"{path.name}.old{number}" for number in ("", *map(str, range(2, 1000))))
    kept = next(place for name in names if not os.path.lexists(place := path.with_name(name)))
    path.rename(kept)
    return kept


def _check(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Read everything that a run would read (photos or model, times, ranges, anchors, camera, reference), and print
    what it is, what is assumed and what is wrong. Takes seconds and writes nothing.

    example:
      rangesfm check survey.toml
    """
    from rangesfm.pipeline.check import check_survey

    checked = check_survey(survey_from_arguments(args, progress))
    return Outcome(told(checked, fault="error"), checked.exit_status)


def told(checked: CheckedSurvey, *, fault: str) -> list[str]:
    """Return a line for each finding. ``fault`` is the word with which lines about faults begin."""
    return [
        *checked.understood(),
        *(f"warning: {text}" for text in checked.warnings),
        *("\n  ".join([f"{fault}: {error}", *error.advice]) for error in checked.faults),
    ]


def _plan(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Compute what a run of a survey would say, before any range is measured: how accurately the scale and the place
    of the map will be known, which mistakes would be found, and which change of anchors, path or radio would help
    most. If a run would refuse the scale, the exit status is 3; all is printed and written nevertheless.

    example:
      rangesfm plan plan.toml --output_path plan
      rangesfm plan --from out
    """
    if (args.plan is None) == (args.result is None):
        raise InputError("expected either the file of a plan or --from RESULT")
    from rangesfm.planning.placement import place_anchors
    from rangesfm.planning.plan_file import read_plan
    from rangesfm.planning.survey_plan import REFUSED, plan_survey
    from rangesfm.report.plan_page import write_plan
    from rangesfm.util.files.atomic import require_apart

    if args.output_path is not None:
        require_apart([Path(args.plan or args.result)], Path(args.output_path))
    if args.plan is not None:
        planned = place_anchors(read_plan(args.plan), progress)
    else:
        from rangesfm.pipeline.plan_again import plan_of_result

        planned = plan_of_result(args.result)
    plan = plan_survey(planned)
    for warning in plan.warnings:
        progress.message(warning)
    written = [] if args.output_path is None else map(str, write_plan(plan, Path(args.output_path)))
    return Outcome([*plan.lines, *written], GeometryError.exit_status if plan.verdict == REFUSED else 0)


def _doctor(args: argparse.Namespace, progress: Progress) -> Outcome:
    """Check versions and threads, and that the compiled part shares its types with pycolmap and pyceres.

    example:
      rangesfm doctor
    """
    from rangesfm.solver.installation_checks import diagnose
    from rangesfm.util.files.text_tables import align_rows

    checks = diagnose()
    rows = []
    for check in checks:
        rows.append(("ok" if check.ok else "BAD", check.name, check.found))
        if not check.ok:
            rows.append(("", "", f"expected {check.expected}; {check.remedy}"))
    return Outcome([align_rows(rows, num_left=3)], 0 if all(check.ok for check in checks) else SolverError.exit_status)
