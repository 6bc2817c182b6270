"""Two models of one survey are tied by the photos of different models that match."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
import pytest
from tests.known import known
from tests.simulated.looped import Matches, Pair, two_laps
from tests.simulated.model import random_similarity

from rangesfm.colmap.transform import rescale, without_photos
from rangesfm.sfm.loops.model_ties import find_tie
from rangesfm.util.geometry.similarity import Similarity

NUM_PHOTOS, HALF = 24, 12


@dataclass(frozen=True)
class Halves:
    """A path around a small field twice, mapped in two halves, the second of which is in another world and unit.

    Attributes:
        first, second: the models.
        second_from_first: from the world of the first to that of the second.
        matches: features of the same points in photos of different halves.
    """

    first: pycolmap.Reconstruction
    second: pycolmap.Reconstruction
    second_from_first: Similarity
    matches: dict[Pair, Matches]


@pytest.fixture(scope="module")
def halves() -> Halves:
    looped = two_laps(NUM_PHOTOS, size_m=(8.0, 8.0), num_observations=100)
    names = list(looped.survey.model.timestamps_s)
    change = random_similarity(np.random.default_rng(0))
    first, second = (without_photos(looped.cut(), others) for others in (names[HALF:], names[:HALF]))
    between = {pair: of for pair, of in looped.matches.items() if pair[0] <= HALF < pair[1]}
    return Halves(first, rescale(second, change), change, between)


def test_the_tie_moves_one_model_to_where_the_other_has_it(halves: Halves) -> None:
    tie = known(find_tie(halves.first, halves.second, halves.matches, seed=0))
    assert len(tie.pairs) > 0.5 * len(halves.matches) > 10
    whole = tie.first_from_second @ halves.second_from_first
    assert whole.scale == pytest.approx(1.0, abs=0.02)
    np.testing.assert_allclose(whole.rotation, np.eye(3), atol=0.01)
    np.testing.assert_allclose(whole.translation, 0.0, atol=0.2)


def test_it_is_the_same_whichever_model_is_first(halves: Halves) -> None:
    tie = known(find_tie(halves.second, halves.first, halves.matches, seed=0))
    assert {pair[::-1] for pair in tie.pairs} <= halves.matches.keys()
    assert tie.first_from_second.scale == pytest.approx(halves.second_from_first.scale, rel=0.02)


def test_matches_that_agree_on_nothing_tie_no_models(halves: Halves) -> None:
    rng = np.random.default_rng(1)
    wrong = {pair: np.column_stack([of[:, 0], rng.permutation(of[:, 1])]) for pair, of in halves.matches.items()}
    assert find_tie(halves.first, halves.second, wrong, seed=0) is None


def test_one_pair_alone_ties_no_models(halves: Halves) -> None:
    pair = max(halves.matches, key=lambda pair: len(halves.matches[pair]))
    assert find_tie(halves.first, halves.second, {pair: halves.matches[pair]}, seed=0) is None
