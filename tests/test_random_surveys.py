"""Small surveys drawn at random end as every command must, however their measurements, clocks and logs are."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.studies.drawn_surveys import draw
from tests.studies.random_surveys import Line, failures, report, told

# Of all paths and measurements, alone and together; those that end within a second.
SEEDS = (2, 5, 8, 10, 17, 23, 31, 44, 45, 46, 60, 87, 94, 125, 130, 1033, 2059, 3005, 3050, 3055)


@pytest.mark.parametrize("seed", SEEDS)
def test_a_survey_ends_as_the_contract_says(seed: int) -> None:
    line = told(seed)
    assert line["wrong"] == []
    assert line["mistake"] != "none" or line["status"] != 2, line["said"]


def test_a_seed_draws_the_same_survey_again(tmp_path: Path) -> None:
    first, second = tmp_path / "first", tmp_path / "second"
    for folder in (first, second):
        folder.mkdir()
    assert draw(7, first).command == draw(7, second).command
    names = {path.relative_to(first) for path in first.rglob("*") if path.is_file()}
    assert {Path("images.csv"), Path("sparse/0/images.bin")} < names
    for name in names:
        assert (first / name).read_bytes() == (second / name).read_bytes()


def test_the_summary_counts_each_kind_of_failure_with_its_seeds() -> None:
    good: Line = {"status": 0, "mistake": "none", "wrong": [], "off": 0.01, "half": 0.02, "covered": True, "good": True}
    good |= {"seconds": 1.0, "said": [], "words": ""}
    lines = [{**good, "seed": seed} for seed in range(98)]
    assert report(lines)[1]
    false = {**good, "seed": 98, "covered": False}
    doubtful = {**false, "seed": 99, "good": False}
    assert (failures(false), failures(doubtful)) == (["scale outside, good"], ["scale outside, doubtful"])
    texts, is_well = report([*lines, false, doubtful])
    assert is_well
    assert "scale outside, good: 1: 98" in texts
    refused: Line = {"seed": 7, "status": 2, "mistake": "none", "wrong": [], "seconds": 1.0, "said": [], "words": ""}
    assert not report([*lines, refused])[1]
    assert not report([*lines, {**refused, "status": 1, "wrong": ["status 1"]}])[1]
    assert not report([*lines, *({**false, "seed": 100 + k} for k in range(4))])[1]
