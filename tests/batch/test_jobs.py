"""The surveys of a batch: those that are refused before anything starts, and the others' shares of the machine."""

from __future__ import annotations

from pathlib import Path

import pytest

from rangesfm.batch.jobs import BatchOptions, read_jobs, share_this_machine
from rangesfm.errors import Failure, InputError
from rangesfm.survey.settings import Survey

GB = 10**9


def write_survey(path: Path, output: str | None) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("" if output is None else f'[output]\npath = "{output}"\n')
    return path


def test_each_survey_has_its_own_folder_and_the_overrides_of_all(tmp_path: Path) -> None:
    paths = [write_survey(tmp_path / name / "survey.toml", None) for name in ("a", "b")]
    jobs = read_jobs(paths, {"output.seed": 7}, tmp_path / "batch")
    surveys = [survey for _, survey in jobs if isinstance(survey, Survey)]
    assert [survey.output.path for survey in surveys] == [tmp_path / "a" / "out", tmp_path / "b" / "out"]
    assert [survey.output.seed for survey in surveys] == [7, 7]


@pytest.mark.parametrize("output", ["out_of_a", "../surveys/out_of_a", "./x/../out_of_a"])
def test_two_surveys_that_write_to_one_folder_are_refused(output: str, tmp_path: Path) -> None:
    first = write_survey(tmp_path / "surveys" / "a.toml", "out_of_a")
    second = write_survey(tmp_path / "surveys" / "b.toml", output)
    (tmp_path / "surveys" / "x").mkdir()
    with pytest.raises(InputError) as caught:
        read_jobs([first, second], {}, tmp_path / "batch")
    folder = tmp_path / "surveys" / "out_of_a"
    assert str(caught.value) == (f"{second}: writes to {folder}, as {first} does: expected another [output] path")


def test_one_survey_named_twice_is_refused(tmp_path: Path) -> None:
    path = write_survey(tmp_path / "a.toml", None)
    with pytest.raises(InputError, match=r"as .* does: expected another"):
        read_jobs([path, tmp_path / "." / "a.toml"], {}, tmp_path / "batch")


def test_a_survey_must_not_write_where_the_table_goes(tmp_path: Path) -> None:
    path = write_survey(tmp_path / "a.toml", "batch")
    with pytest.raises(InputError, match="as the table of the batch does"):
        read_jobs([path], {}, tmp_path / "batch")


def test_a_file_that_cannot_be_used_is_a_job_that_has_failed(tmp_path: Path) -> None:
    wrong = write_survey(tmp_path / "wrong.toml", None)
    wrong.write_text("[images]\nfolder = 3\n")
    good = write_survey(tmp_path / "good.toml", None)
    jobs = read_jobs([wrong, tmp_path / "none.toml", good], {}, tmp_path / "batch")
    failures = [failure for _, failure in jobs[:2] if isinstance(failure, Failure)]
    assert [failure.exit_status for failure in failures] == [2, 2]
    assert failures[0].message.startswith(f"{wrong}:2: unknown key 'folder'")
    assert failures[1].message == f"{tmp_path / 'none.toml'}: no such file"


def test_names_of_files_may_hold_what_no_table_could(tmp_path: Path) -> None:
    ((name, _),) = read_jobs([tmp_path / "a\n\udcff.toml"], {}, tmp_path / "batch")
    assert name == str(tmp_path / "a ?.toml")


@pytest.mark.parametrize(
    ("options", "num_surveys", "num_cores", "memory_gb", "expected"),
    [
        (BatchOptions(), 16, 8, 64, (8, 1, 8)),
        (BatchOptions(), 3, 8, 64, (3, 2, 21)),  # never more workers than surveys: the cores go to those
        (BatchOptions(), 16, 8, 8, (4, 2, 2)),  # there is memory for four workers
        (BatchOptions(), 16, 8, 1, (1, 8, 1)),
        (BatchOptions(num_workers=2), 16, 8, 64, (2, 4, 32)),
        (BatchOptions(num_threads=4), 16, 8, 64, (2, 4, 32)),
        (BatchOptions(memory_limit_bytes=30 * GB), 16, 8, 64, (2, 4, 30)),
        (BatchOptions(num_workers=2, num_threads=3, memory_limit_bytes=5 * GB), 16, 8, 64, (2, 3, 5)),
    ],
)
def test_workers_times_threads_is_at_most_the_cores(
    options: BatchOptions, num_surveys: int, num_cores: int, memory_gb: int, expected: tuple[int, int, int]
) -> None:
    num_workers, num_threads, memory, note = share_this_machine(options, num_surveys, num_cores, memory_gb * GB)
    assert (num_workers, num_threads, memory // GB, note) == (*expected, "")
    assert num_workers * num_threads <= num_cores


def test_more_threads_than_cores_are_refused() -> None:
    options = BatchOptions(num_workers=3, num_threads=2)
    with pytest.raises(InputError, match="3 workers with 2 threads each, and this machine has 4 cores: expected no"):
        share_this_machine(options, 16, 4, 64 * GB)


def test_more_workers_than_cores_are_told_of() -> None:
    num_workers, num_threads, _, note = share_this_machine(BatchOptions(num_workers=2), 16, 1, 64 * GB)
    assert (num_workers, num_threads) == (2, 1)
    assert note == "2 workers with 1 threads each, and this machine has 1 cores: each survey takes longer"
