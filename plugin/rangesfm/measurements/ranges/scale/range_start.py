"""Ranges found beside the other kinds: solved on an unscaled path, or where a refined map has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangesfm.measurements.joint_map import KindOnMap, Located, upward_by
from rangesfm.measurements.kind import MapState
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.anchor_distances import NO_DISTANCES, AnchorDistances
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.cost import Ranges
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.placement_prior import PlacementPrior
from rangesfm.measurements.ranges.scale.range_equation import RangeState, predicted_ranges
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem, scale_problem, turns_and_velocities
from rangesfm.measurements.ranges.scale.solution import solution_from, solve_scale
from rangesfm.measurements.ranges.words import RANGES
from rangesfm.options import RangeModelOptions
from rangesfm.solver.bending import MapBending
from rangesfm.solver.posterior import ScaleByKind
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import first_camera_from, moved_similarity


@dataclass(frozen=True)
class RangesOnPath(Located):
    """The ranges of a log on an unscaled path, with all that is known of anchors and radio before.

    Where the map and its anchors are is found beside the other kinds.

    Attributes:
        observations: all ranges of the log.
        bending: of the path of the map.
        anchors: every anchor of the log, with its prior knowledge, in the order of their file.
        anchor_frame: of their positions: "site" (the map is carried there), "first_camera" (that of the first
            keyframe, metres) or "unknown" (positions are ignored; the map stays in the first camera's frame).
        range_model: what is assumed of the radio.
        distances: measured ones between the anchors of the log, in its order; those measured by radio are in the log.
        gravity: the upward direction in the first camera; None if it is not known.
        camera_side: side of the anchors' plane on which the camera was, as in the scale options; None if not known.
        site: frame of the anchors' positions here, from which texts get the coordinates in their file.
        seed: of searches by chance.
    """

    observations: RangeObservations
    bending: MapBending
    anchors: Sequence[Anchor]
    anchor_frame: str
    range_model: RangeModelOptions = field(default_factory=RangeModelOptions)
    distances: AnchorDistances = NO_DISTANCES
    gravity: Gravity | None = None
    camera_side: str | None = None
    site: Site = field(default_factory=Site)
    seed: int = 0

    kind = RANGES

    def posed(self, others: Sequence[KindOnMap], *, place_is_open: bool = False) -> ScaleProblem:
        """Return their problem beside the other kinds; argument and errors as of ``scale_problem``."""
        given = replace(self, gravity=upward_by(others, self.gravity))
        placement = placement_by(others, first_camera_from(self.bending.path))
        return scale_problem(given, placement, scales_by(others), place_is_open=place_is_open)

    def beside(self, others: Sequence[KindOnMap]) -> RangeScale:
        """Return the ranges at the best solution of their problem.

        Raises:
            InputError: an anchor of the log is not given. GeometryError: the scale is not determined.
        """
        found = solve_scale(self.posed(others))
        if not found.why_open:
            return RangeScale.begun(found)
        note = f"the map gets metres, but no place in the site: {found.why_open}"
        unplaced = self.posed(others, place_is_open=True)
        return RangeScale.begun(solution_from(unplaced, found.state.in_frame_of_model()), (note,))


@dataclass(frozen=True)
class RangesAtRest(Located):
    """Ranges on the map that the scaled one became, as a scale problem in the unit of the latter.

    Attributes:
        before: on the scaled map.
        scale: metres of the refined map per unit of the unscaled model.
        ranges: as weighted in the refined map. state: of it. bending: of its path, in the metric world.
    """

    before: RangeScale
    scale: float
    ranges: Ranges
    state: MapState
    bending: MapBending

    kind = RANGES

    def beside(self, others: Sequence[KindOnMap]) -> RangeScale:
        """Return the ranges where the map has them."""
        path, scale, ranges, posed = self.bending.path, self.scale, self.ranges, self.before.solved.posed
        # The model's frame is that of the first camera, in the unit of the unscaled model.
        model_from_path = first_camera_from(path, 1 / scale)
        placed = model_from_path.inverse()
        tags_m, centers_m = ranges.antennas_m(self.state)
        problem = replace(
            posed.ranges,
            centers=model_from_path.apply(centers_m),
            tag_from_center=(tags_m - centers_m) @ placed.rotation,
            share=np.ones(len(tags_m)),
            placement=placement_by(others, model_from_path),
            scales=scales_by(others, scale),
        )
        unscaled = path.transformed(Similarity(1 / scale, np.eye(3), np.zeros(3)))
        turns, velocity = turns_and_velocities(posed.observations, posed.rows, unscaled)
        posed = replace(
            posed,
            bending=self.bending,
            ranges=problem,
            model_from_path=model_from_path,
            model_from_cam=turns,
            velocity=velocity,
        )
        ids, blocks = posed.observations.log.anchor_ids, self.state.blocks
        anchors_m, biases_m = np.array([blocks["anchor", id_] for id_ in ids]), [blocks["bias", id_][0] for id_ in ids]
        state = RangeState(placed, anchors_m, np.array(biases_m))
        off_m = predicted_ranges(problem, state) + ranges.shared_m(self.state)[ranges.rows] - problem.range_m
        weights, noise_m = ranges.errors.robust_weights(off_m), float(np.median(ranges.errors.stddev_m))
        here = RangesOnMap(posed, state, weights, ranges.errors, noise_m)
        return RangeScale(here, self.before.told, self.before.notes)


def placement_by(others: Sequence[KindOnMap], first_camera_from_model: Similarity) -> PlacementPrior | None:
    """Return what the first other kind that places the map says of the place of the first camera's frame.

    The problem of the ranges is solved and tested with it.

    Args:
        first_camera_from_model: with the unit of the problem.
    """
    for each in others:
        if each.places_map and each.is_used:
            known = each.alone.posterior
            best = moved_similarity(each.alone.placed, known.columns.map_step(known.step), each.alone.path)
            whitening = np.linalg.inv(np.linalg.cholesky(known.place))
            return PlacementPrior(best @ first_camera_from_model.inverse(), whitening)
    return None


def scales_by(others: Sequence[KindOnMap], unit: float = 1.0) -> tuple[ScaleByKind, ...]:
    """Return the scale by each other kind that gives the map nothing else.

    The problem of the ranges is solved and tested with them.

    Args:
        unit: of the model of the problem, in units of that of the other kinds.
    """
    alone = [each.alone.scale for each in others if each.is_used and not each.places_map]
    return tuple(ScaleByKind(unit * each.value, unit * each.stddev) for each in alone)
