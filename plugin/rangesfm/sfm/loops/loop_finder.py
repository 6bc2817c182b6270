"""Proposal of pairs by a refined map, and the test of those that match against that map."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass
from functools import cached_property
from itertools import compress

import pycolmap

from rangesfm.arrays import Indices
from rangesfm.colmap.pieces import MIN_NUM_SHARED, overlaps_in
from rangesfm.estimation.vision_information import LoopPoses
from rangesfm.sfm.loop_database import Pair
from rangesfm.sfm.loops.candidates import Views, predicted_overlaps, propose_pairs
from rangesfm.sfm.loops.relative_errors import RelativeErrors
from rangesfm.sfm.loops.resection import MAX_CHANCE, Loop, Resection, loop_poses
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.trajectory import Trajectory


@dataclass(frozen=True)
class LoopFinder:
    """A refined map, with what is needed to find its loops.

    Attributes:
        model: the map, metres.
        path: its keyframes.
        errors: of these keyframes.
        pixel_stddev: standard deviation of a coordinate of a feature.
        seed: of random numbers.
    """

    model: pycolmap.Reconstruction
    path: Trajectory
    errors: RelativeErrors
    pixel_stddev: float
    seed: int

    @classmethod
    def in_refined_map(
        cls,
        model: pycolmap.Reconstruction,
        trajectory: Trajectory,
        errors: MapErrors,
        pixel_stddev: float,
        seed: int,
    ) -> LoopFinder:
        """Return the finder of loops in a refined map; ``trajectory`` has its keyframes, also in another world."""
        path = trajectory.as_in(model)
        return cls(model, path, RelativeErrors.of_keyframes(errors, path.frame_ids, path.centers), pixel_stddev, seed)

    @cached_property
    def views(self) -> Views:
        return Views.in_model(self.model, self.path.frame_ids)

    def propose(self, matched: Mapping[int, Set[int]], *, max_num: int) -> dict[int, list[Pair]]:
        """Return for each photo, by its id, the pairs that are worth matching, the best first.

        Args:
            matched: ids of the photos that each photo was matched with, by its id.
            max_num: largest number of pairs of one photo.
        """
        known = self._known(matched)
        return propose_pairs(self.views, self.errors, known, max_num=max_num, pixel_stddev=self.pixel_stddev)

    def predicted(self, matched: Mapping[int, Set[int]]) -> dict[int, set[int]]:
        """Return for each photo those that it was matched with, or that the map predicts to see the same, by ids.

        They may see it from where its features are not found again.
        """
        known, ids = self._known(matched), self.views.image_ids
        for first, others, _ in predicted_overlaps(self.views, self.errors, known, from_anywhere=True):
            known[int(ids[first])].update(ids[others].tolist())
        return known

    def _known(self, matched: Mapping[int, Set[int]]) -> dict[int, set[int]]:
        """Return for each photo of the map those that it was matched with or shares enough points with, by ids."""
        ids = self.model.reg_image_ids()
        known = {id_: set(matched.get(id_, ())) for id_ in ids}
        shared = overlaps_in(self.model).tocoo()
        enough = (shared.data >= MIN_NUM_SHARED) & (shared.row != shared.col)
        for first, second in zip(shared.row[enough].tolist(), shared.col[enough].tolist(), strict=True):
            known[ids[first]].add(ids[second])
        return known

    def tested(self, verified: Mapping[Pair, Indices]) -> tuple[list[Loop], list[Pair]]:
        """Return the loops that fit the map, and the pairs that it contradicts.

        Pairs whose matches have too few points say nothing and are in neither.

        Args:
            verified: matches (m, 2) of features that fit a two-view geometry, by pair.
        """
        resection = Resection(self.model, self.views, self.errors, self.pixel_stddev, self.seed)
        found = (resection.loop_of_pair(pair, matches) for pair, matches in verified.items())
        loops = [loop for loop in found if loop is not None]
        fits = [loop.chance(self.errors) >= MAX_CHANCE for loop in loops]
        return list(compress(loops, fits)), [loop.image_ids for loop, is_right in zip(loops, fits) if not is_right]

    def relative_poses(self, loops: Sequence[Loop]) -> LoopPoses:
        """Return what loops say, for the keyframe graph, by ids of frames."""
        return loop_poses(self.model, self.path.frame_ids, self.errors, loops)
