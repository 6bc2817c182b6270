"""The progress of a batch, from what its workers report."""

from __future__ import annotations

import pytest
from tests.cli.screen import Clock
from tests.result_document import result_document

from rangesfm.batch.batch_state import BatchState, SurveyRow, exit_status_of, figures_of, format_rows
from rangesfm.result.summary import ResultSummary
from rangesfm.survey.settings import Survey


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def batch_state(clock: Clock) -> BatchState:
    return BatchState([(name, Survey()) for name in "abcd"], clock=clock)


def test_time_left_is_that_of_those_that_are_done(batch_state: BatchState, clock: Clock) -> None:
    for index in (0, 1):
        batch_state.tell(index, {"began_on": "here"})
    clock.now_s += 30
    assert batch_state.seconds_left() is None
    batch_state.end(0, "done", "", 0)
    batch_state.tell(2, {"began_on": "here"})
    # d waits, b should have ended by now, c has just begun
    assert batch_state.seconds_left() == pytest.approx((30 + 0 + 30) / 2)
    clock.now_s += 20
    assert batch_state.seconds_left() == pytest.approx((30 + 0 + 10) / 2)


@pytest.mark.parametrize(
    ("statuses", "expected"), [((0, 0), 0), ((0, 2), 2), ((3, 2), 3), ((2, 4, 3), 4), ((1, 2), 4), ((), 0)]
)
def test_the_batch_ends_with_the_largest_of_the_statuses(statuses: tuple[int, ...], expected: int) -> None:
    assert exit_status_of([SurveyRow("a", exit_status=status) for status in statuses]) == expected


def test_the_table_of_the_terminal_says_why_below() -> None:
    done = SurveyRow("a.toml", "done", "short", 0)
    done.figures = {**done.figures, "verdict": "doubtful", "scale": 0.5, "num_photos": 3}
    failed = SurveyRow("b.toml", "failed", "no such file", 2)
    lines = format_rows([done, failed]).split("\n")
    assert lines[1].split() == ["a.toml", "doubtful", "0.5", "3", "-", "-", "-", "-"]
    assert lines[2].split()[:2] == ["b.toml", "failed"]
    assert lines[3:] == ["", "b.toml: no such file"]


def comparison_row(rmse_m: float) -> dict[str, object]:
    after = {"rmse_se3_m": None, "rmse_sim3_m": None, "scale_error_percent": None}
    return {"name": "path", "num_keyframes": 9, "rmse_m": rmse_m, **after}


def test_figures_are_those_of_the_result() -> None:
    result = result_document(
        scale={"value": 0.7, "stddev_formal": 0.01, "stddev_empirical": 0.02},
        map={"num_photos": 14},
        ranges={"num": 10, "num_used": 8, "rms_m": 0.08},
        comparison=[comparison_row(2.0), comparison_row(0.1)],
        warnings=["one"],
    )
    figures = figures_of(ResultSummary.model_validate(result))
    assert list(figures.values()) == ["good", 0.7, 0.02, "site", 14, 10, 8, 0.08, None, 0.1, 1]
    assert list(SurveyRow("", figures=figures).cells())[-11:] == list(figures)
