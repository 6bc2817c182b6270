"""A map at rest with the matching of its photos, whose loops are closed in rounds, whatever its metres come from."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence, Set
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, Protocol, TypeVar

import pycolmap

from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.estimation.vision_information import LoopPoses
from rangesfm.progress import Journal
from rangesfm.sfm.loop_database import LoopMatching, Pair
from rangesfm.sfm.loops.loop_finder import LoopFinder
from rangesfm.sfm.loops.merge import merge_tracks
from rangesfm.sfm.loops.resection import Loop
from rangesfm.sfm.loops.rounds import TriedPairs, find_in
from rangesfm.sfm.photos_alike import pairs_alike
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.trajectory import Trajectory

MergeTracks = Callable[[pycolmap.Reconstruction], None]
"""Makes one point of those that two passes saw apart, in place."""
_Map = TypeVar("_Map", bound="ClosableMap")


class ClosableMap(Protocol):
    """A map at rest whose loops can be closed.

    Attributes:
        model, trajectory: the map, and the path of its keyframes in any world.
        errors: of its poses; None if they are not known.
        pixel_stddev: standard deviation of a coordinate of a feature.
        why_broken: what shows that the map is broken; empty if nothing does.
    """

    @property
    def model(self) -> pycolmap.Reconstruction: ...

    @property
    def trajectory(self) -> Trajectory: ...

    @property
    def errors(self) -> MapErrors | None: ...

    @property
    def pixel_stddev(self) -> float: ...

    @property
    def why_broken(self) -> Sequence[str]: ...

    def with_loops(self: _Map, loops: LoopPoses, merge: MergeTracks) -> _Map | None:
        """Return the map refined with loops, relative poses by ids of frames; None if they are closed in it."""


@dataclass(frozen=True)
class MatchedMap(Generic[_Map]):
    """A map with the matching of its photos.

    Attributes:
        map: the map.
        matching: of its photos.
        journal: is told of stages and warnings.
        seed: of random numbers.
        asks_vocabulary: whether photos that look alike are matched, too, where the map does not predict that they see
            the same.
    """

    map: _Map
    matching: LoopMatching
    journal: Journal
    seed: int
    asks_vocabulary: bool

    def find(self, tried: TriedPairs) -> tuple[list[Loop], TriedPairs]:
        if (finder := self._finder) is None:
            return [], tried
        with self.journal.stage("loops"):
            return find_in(finder, self.matching.match, self.matching.known(), tried, self._alike)

    def with_closed(self, loops: Sequence[Loop], tried: TriedPairs) -> MatchedMap[_Map] | None:
        self.keep(tried)
        finder, matching = self._finder, self.matching
        assert finder is not None, "it has found the loops"

        def merge(model: pycolmap.Reconstruction) -> None:
            with colmap_log(matching.log):
                merge_tracks(model, matching.database, seed=self.seed)

        with self.journal.stage("refinement"):
            closed = self.map.with_loops(finder.relative_poses(loops), merge)
        if closed is not None and (why := closed.why_broken):
            self.journal.warn(f"loops are left open, because the map broke: {'; '.join(why)}")
            return None
        return None if closed is None else replace(self, map=closed)

    def keep(self, tried: TriedPairs) -> None:
        """Keep the matches of closed loops alone in the database, and what was tried in vain."""
        self.matching.keep(tried.proposed, tried.verified, tried.closed)

    def _alike(self, known: Mapping[int, Set[int]]) -> list[Pair]:
        if not self.asks_vocabulary:
            return []
        return pairs_alike(self.matching.database, known, self.matching.log, max_num=1, seed=self.seed)

    @cached_property
    def _finder(self) -> LoopFinder | None:
        if (errors := self.map.errors) is None:
            return None
        return LoopFinder.in_refined_map(self.map.model, self.map.trajectory, errors, self.map.pixel_stddev, self.seed)
