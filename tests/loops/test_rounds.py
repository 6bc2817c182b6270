"""Loops that contradict a map are tried again when others have straightened it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np

from rangesfm.loops.loop_finder import LoopFinder
from rangesfm.loops.resection import Loop
from rangesfm.loops.rounds import TriedPairs, close_in_rounds, find_in

Pair = tuple[int, int]
NEIGHBOUR, NEAR, FAR, WRONG, NEW, UNLIKE = (1, 2), (1, 9), (1, 10), (2, 9), (2, 10), (3, 9)
MATCHES = np.zeros((20, 2), dtype=np.int64)


@dataclass(frozen=True)
class BentMap:
    """A map that proposes pairs, some of which match, and tells true ones from wrong ones as far as it is straight.

    Attributes:
        fits: in each map, the pairs that it takes for loops. num_closed: number of this map.
        matched: all pairs that were to be matched, for the test.
    """

    fits: tuple[set[Pair], ...]
    matched: list[list[Pair]]
    num_closed: int = 0

    def propose(self, known: Mapping[int, Set[int]], *, max_num: int) -> list[Pair]:
        proposed = [NEIGHBOUR, NEAR, FAR, WRONG, UNLIKE] if self.num_closed == 0 else [NEAR, WRONG, NEW, UNLIKE]
        return [pair for pair in proposed if pair[1] not in known.get(pair[0], set())][:max_num]

    def tested(self, verified: Mapping[Pair, Any]) -> tuple[list[Loop], list[Pair]]:
        right = [pair for pair in verified if pair in self.fits[self.num_closed]]
        loops = [cast(Loop, SimpleNamespace(image_ids=pair)) for pair in right]
        return loops, [pair for pair in verified if pair not in right]

    def match(self, pairs: list[Pair]) -> dict[Pair, Any]:
        self.matched.append(pairs)
        return {pair: MATCHES for pair in pairs if pair != UNLIKE}

    def find(self, tried: TriedPairs) -> tuple[list[Loop], TriedPairs]:
        return find_in(cast(LoopFinder, self), self.match, {1: {2}, 2: {1}}, tried)

    def with_closed(self, loops: Sequence[Loop], tried: TriedPairs) -> BentMap:
        return replace(self, num_closed=self.num_closed + 1)


def test_pairs_that_contradict_a_bent_map_are_tried_again_in_the_closed_one() -> None:
    bent = BentMap(({NEAR}, {FAR, NEW}, set()), [])
    last, tried = close_in_rounds(bent)
    assert last.num_closed == 2
    assert bent.matched == [[NEAR, FAR, WRONG, UNLIKE], [FAR, WRONG, NEW], [WRONG]]
    assert tried.closed == {NEAR, FAR, NEW}
    assert tried.contradicted == {WRONG}
    assert tried.verified == {NEAR, FAR, WRONG, NEW}
    assert tried.proposed == tried.verified | {UNLIKE}


def test_a_map_that_nothing_contradicts_is_closed_once() -> None:
    bent = BentMap(({NEAR, FAR, WRONG},), [])
    last, tried = close_in_rounds(bent)
    assert last.num_closed == len(bent.matched) == 1
    assert not tried.contradicted


def test_a_map_without_right_loops_stays_as_it_is() -> None:
    bent = BentMap((set(),), [])
    last, tried = close_in_rounds(bent)
    assert last is bent
    assert not tried.closed
    assert tried.contradicted == {NEAR, FAR, WRONG}
