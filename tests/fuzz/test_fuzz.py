"""A few seconds of fuzzing with fixed seeds; README.md beside this file describes the long runs."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from tests.fuzz.targets import CORPUS, TARGETS, Target

NUM_INPUTS = 25
MAX_LENGTH = 6000
WITHOUT_RANGES = CORPUS / "any_log" / "lep.txt"


@pytest.mark.parametrize("target", TARGETS, ids=[target.name for target in TARGETS])
def test_seeds_are_read_and_damaged_ones_read_or_refused(target: Target, tmp_path: Path) -> None:
    for seed in target.seeds():
        assert target.run(seed.read_bytes(), tmp_path) == (seed != WITHOUT_RANGES), seed
    rng = random.Random(0)
    seeds = [seed.read_bytes() for seed in target.seeds()]
    for _ in range(NUM_INPUTS):
        target.run(target.mutate(rng.choice(seeds), rng, MAX_LENGTH), tmp_path)


def test_every_corpus_belongs_to_a_target() -> None:
    assert {folder.name for folder in CORPUS.iterdir()} == {target.name for target in TARGETS}
