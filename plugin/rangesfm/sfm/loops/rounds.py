"""Rounds of finding and closing loops: a map whose loops are closed proposes more of them, and judges them better."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from rangesfm.arrays import Array
from rangesfm.estimation.vision_information import Loop
from rangesfm.sfm.loop_database import LoopMatching, Pair
from rangesfm.sfm.loops.loop_finder import LoopFinder
from rangesfm.sfm.photos_alike import pairs_alike
from rangesfm.util.geometry.similarity import Similarity, rmse
from rangesfm.util.geometry.trajectory import Trajectory

MAX_NUM_PAIRS = 5
"""Pairs that one photo proposes at most in a round, of which the others are tried where the first does not match.
Sequential matching pairs a photo with 10 neighbours by default."""

MAX_NUM_ROUNDS = 3


@dataclass(frozen=True)
class LoopClosure:
    """The closing of a map's loops: its pairs of photos in all rounds, as ids, smaller first.

    Attributes:
        before: keyframes of the map that would be the result with its loops open.
        proposed: by the maps. verified: those of them that match.
        closed: those of these that were used. contradicted: those that the last map with its measurements contradicts.
    """

    before: Trajectory
    proposed: frozenset[Pair] = frozenset()
    verified: frozenset[Pair] = frozenset()
    closed: frozenset[Pair] = frozenset()
    contradicted: frozenset[Pair] = frozenset()

    @property
    def promises_more(self) -> bool:
        """Return whether no fewer pairs contradicted the map than were closed: it was bent, or none was tried."""
        return len(self.contradicted) >= len(self.closed)

    def moved_m(self, after: Trajectory) -> float:
        """Return the root mean square movement of the keyframes, whose path is now ``after``."""
        return rmse(after.centers - self.before.centers)

    def moved(self, offset_m: Array) -> LoopClosure:
        """Return the same in a world whose coordinates are larger by ``offset_m`` (3,)."""
        return replace(self, before=self.before.transformed(Similarity(1.0, np.eye(3), offset_m)))


def find_loops(
    finder: LoopFinder, matching: LoopMatching, tried: LoopClosure, *, by_likeness: bool
) -> tuple[dict[Pair, Loop], LoopClosure]:
    """Return the loops that match and fit the map, and all pairs that have been tried with those of this round.

    Args:
        finder: of loops in the map.
        matching: of its photos.
        tried: pairs of the rounds before. Those that the map contradicted are tried again.
        by_likeness: for a map that nothing but its photos holds. Of the pairs between the neighbours of two photos,
            which tell the same, one is tried, and the others only where it does not match. In the first round photos
            that look alike are tried, too, unless the map predicts that they see the same; of photos that were matched
            with each other only one.
    """
    known, seed = matching.known(), matching.options.seed
    matched = {id_: set(others) for id_, others in known.items()}
    for first, second in tried.proposed:
        matched.setdefault(first, set()).add(second)
        matched.setdefault(second, set()).add(first)
    choices = finder.propose(matched, max_num=MAX_NUM_PAIRS) if tried.promises_more else {}
    near = {id_: {id_, *others} for id_, others in known.items()} if by_likeness else {}
    proposed, same = set[Pair](), set[Pair]()
    for first, second in (of_photo[0] for of_photo in choices.values() if of_photo):
        if (first, second) not in same:
            proposed.add((first, second))
            both = product(near.get(first, {first}), near.get(second, {second}))
            same.update((min(pair), max(pair)) for pair in both)
    verified = matching.match(sorted(proposed | tried.contradicted))
    tied = {neighbour for pair in verified for photo in pair for neighbour in near.get(photo, {photo})}
    more = {pair for photo, of_photo in choices.items() if photo not in tied for pair in of_photo}
    if by_likeness and not tried.proposed:
        told, predicted = set[int](), finder.predicted(matched)
        for first, second in pairs_alike(matching.database, predicted, matching.log, max_num=1, seed=seed):
            if first not in told:
                more.add((first, second))
                told.update((first, *known.get(first, ())))
    if more := more - proposed:
        verified = {**verified, **matching.match(sorted(more))}
        proposed |= more
    loops, contradicted = finder.tested(verified, seed=seed)
    return loops, replace(
        tried,
        proposed=tried.proposed.union(proposed),
        verified=tried.verified.union(verified),
        contradicted=tried.contradicted.union(contradicted).difference(loops),
    )
