"""Rounds of finding and closing loops: a map whose loops are closed proposes more of them, and judges them better."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import product
from types import MappingProxyType
from typing import Protocol, TypeVar

from rangesfm.arrays import Indices
from rangesfm.sfm.loop_database import Pair
from rangesfm.sfm.loops.loop_finder import LoopFinder
from rangesfm.sfm.loops.resection import Loop

MAX_NUM_PAIRS = 5
"""Pairs that one photo proposes at most in a round, of which the others are tried where the first does not match.
Sequential matching pairs a photo with 10 neighbours by default."""

MAX_NUM_ROUNDS = 3


@dataclass(frozen=True)
class TriedPairs:
    """Pairs of photos in all rounds.

    Attributes:
        proposed: by the maps. verified: those of them that match.
        closed: those of these that were used. contradicted: those that the last map with its measurements contradicts.
    """

    proposed: frozenset[Pair] = frozenset()
    verified: frozenset[Pair] = frozenset()
    closed: frozenset[Pair] = frozenset()
    contradicted: frozenset[Pair] = frozenset()

    @property
    def promise_more(self) -> bool:
        """Return whether no fewer pairs contradicted the map than were closed: it was bent, or none was tried."""
        return len(self.contradicted) >= len(self.closed)


_Map = TypeVar("_Map", bound="MapWithLoops")


class MapWithLoops(Protocol):
    """A refined map whose loops can be closed."""

    def find(self, tried: TriedPairs) -> tuple[list[Loop], TriedPairs]:
        """Return the loops that are found in this map beside those closed before, as ``find_in``."""

    def with_closed(self: _Map, loops: Sequence[Loop], tried: TriedPairs) -> _Map | None:
        """Return the map refined with loops; None if they are closed in it, or if it broke.

        Args:
            loops: that were found last. tried: all pairs, these loops among the closed ones.
        """


def close_in_rounds(refined: _Map) -> tuple[_Map, TriedPairs]:
    """Close the loops of a map, and return the last map with the pairs of all rounds.

    The test of a loop takes the errors of the map for small. A map that is bent by metres contradicts true loops until
    others have straightened it. So where loops contradict the map, another round tests them again in the next map. If
    they are few, this only tells which of them still do; otherwise more are proposed and closed. It ends where nothing
    new is found.
    """
    tried = TriedPairs()
    for _ in range(MAX_NUM_ROUNDS):
        may_close = tried.promise_more
        loops, tried = refined.find(tried)
        closed = replace(tried, closed=tried.closed.union(loop.image_ids for loop in loops))
        if not (loops and may_close) or (after := refined.with_closed(loops, closed)) is None:
            break
        refined, tried = after, closed
        if not tried.contradicted:
            break
    return refined, tried


def find_in(
    finder: LoopFinder,
    match: Callable[[list[Pair]], Mapping[Pair, Indices]],
    known: Mapping[int, Set[int]],
    tried: TriedPairs,
    alike: Callable[[Mapping[int, Set[int]]], list[Pair]] = lambda _: [],
    neighbours: Mapping[int, Set[int]] = MappingProxyType({}),
) -> tuple[list[Loop], TriedPairs]:
    """Return the loops that match and fit the map, and all pairs that have been tried with those of this round.

    Args:
        finder: of loops in the map.
        match: returns the matches (m, 2) of those of some pairs that are verified.
        known: ids of the photos that each photo was matched with by the mapping, by its id.
        tried: pairs of the rounds before. Those that the map contradicted are tried again.
        alike: returns pairs of photos that look alike, given for each photo, by its id, those that it is not to be
            paired with: they were matched with it, or the map predicts that they see the same. It is asked once, and of
            photos that were matched with each other only one is tried.
        neighbours: ids of the photos that tell the same as each photo, by its id. Of the pairs between two
            neighbourhoods one is tried, and the others only where it does not match.
    """
    matched = {id_: set(others) for id_, others in known.items()}
    for first, second in tried.proposed:
        matched.setdefault(first, set()).add(second)
        matched.setdefault(second, set()).add(first)
    choices = finder.propose(matched, max_num=MAX_NUM_PAIRS) if tried.promise_more else {}
    near = {id_: {id_, *others} for id_, others in neighbours.items()}
    proposed, same = set[Pair](), set[Pair]()
    for first, second in (of_photo[0] for of_photo in choices.values() if of_photo):
        if (first, second) not in same:
            proposed.add((first, second))
            both = product(near.get(first, {first}), near.get(second, {second}))
            same.update((min(pair), max(pair)) for pair in both)
    verified = dict(match(sorted(proposed | tried.contradicted)))
    tied = {neighbour for pair in verified for photo in pair for neighbour in near.get(photo, {photo})}
    more = {pair for photo, of_photo in choices.items() if photo not in tied for pair in of_photo}
    if not tried.proposed:
        told = set[int]()  # photos whose neighbours tell the same
        for first, second in alike(finder.predicted(matched)):
            if first not in told:
                more.add((first, second))
                told.update((first, *known.get(first, ())))
    if more := more - proposed:
        verified.update(match(sorted(more)))
        proposed |= more
    loops, contradicted = finder.tested(verified)
    return loops, TriedPairs(
        tried.proposed.union(proposed),
        tried.verified.union(verified),
        tried.closed,
        tried.contradicted.union(contradicted).difference(loop.image_ids for loop in loops),
    )
