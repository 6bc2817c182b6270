"""The surveys of a batch: read before anything starts, and refused where two would write to one folder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from rangesfm.errors import InputError, one_line
from rangesfm.failures import Failure, failure_of
from rangesfm.survey.settings import Survey, read_survey


@dataclass(frozen=True)
class Job:
    """One survey of a batch.

    Attributes:
        name: its file, as the user wrote it; on one line, without what cannot be printed.
        survey: None if the file cannot be used.
        failure: then why not.
    """

    name: str
    survey: Survey | None
    failure: Failure | None = None


def read_jobs(paths: Sequence[str | Path], overrides: Mapping[str, object], output_path: Path) -> tuple[Job, ...]:
    """Read the survey files of a batch.

    Args:
        overrides: values by dotted key in place of those of every file; see ``read_survey``.
        output_path: where the batch's own table goes.

    Returns:
        A job for each file, also for those that cannot be used.

    Raises:
        InputError: two of them write to the same folder, or one to the batch's own.
    """
    jobs = tuple(_read_job(path, overrides) for path in paths)
    writes_to = {output_path.resolve(): "the table of the batch"}
    for job in jobs:
        if job.survey is None:
            continue
        folder = job.survey.output.path.resolve()
        if folder in writes_to:
            raise InputError(
                f"writes to {folder}, and so does {writes_to[folder]}: expected an [output] path of its own", job.name
            )
        writes_to[folder] = job.name
    return jobs


def _read_job(path: str | Path, overrides: Mapping[str, object]) -> Job:
    try:
        return Job(one_line(str(path)), read_survey(path, overrides))
    except (InputError, OSError) as error:
        return Job(one_line(str(path)), None, failure_of(error))
