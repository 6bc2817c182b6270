"""The refinement: bundle adjustment of photos and all measurements, from a scaled map to one at rest (section 5)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import reduce

import numpy as np
import pycolmap

from rangesfm.arrays import Array, Indices
from rangesfm.colmap.pieces import frames_of_parts
from rangesfm.errors import GeometryError
from rangesfm.estimation.drift import SAME_NOISE, close_in_graph, straighten, straighten_again
from rangesfm.estimation.free_fit import GraphSolution
from rangesfm.estimation.map_problem import MapProblem, equations_of
from rangesfm.estimation.vision_information import (
    Loop,
    Rays,
    misplaced_points,
    model_rays,
    project,
)
from rangesfm.measurements.kind import Block, MapState, Measurements
from rangesfm.measurements.marks import add_marks, errors_beyond_features, remove_marks
from rangesfm.solver.bundle_adjustment import (
    BundleAdjustment,
    SolverRun,
    pixel_stddev_of,
    solve_bundle_adjustment,
    solve_until_still,
)
from rangesfm.solver.covariance import joint_covariance
from rangesfm.solver.normal_equations import NormalEquations
from rangesfm.util.geometry.map_errors import UNKNOWN_ERRORS, MapErrors
from rangesfm.util.geometry.poses import Poses, model_poses

# Largest number of solutions of the full problem, between which the noise is estimated again.
_MAX_NUM_ROUNDS = 3
# Largest movement of a keyframe left at the end, as a share of the smallest standard deviation of a measurement.
_MAX_LAST_MOVEMENT = 0.01


@dataclass(frozen=True)
class MapAtRest:
    """A refined map that has come to rest, with its equations; everything that is said of it follows from these.

    Attributes:
        problem: with the noise of the measurements at the end.
        state: of the map. blocks: its parameter blocks, to which the equations refer.
        equations: of photos and all measurements; None if the photos are too many, or if they were not asked for.
        refined_params: which parameters of each camera are adjusted, by its id.
        parts: ids of the frames of each part, as of ``frames_of_parts``.
        run: of the solver; its ``pixel_stddev`` is the unit of the equations. pixel_stddev_at_rest: the same after it.
        bend_m, num_graph_steps: of the keyframe graph before.
    """

    problem: MapProblem
    state: MapState
    blocks: Mapping[Block, Array]
    equations: NormalEquations | None
    refined_params: dict[int, list[int]]
    parts: tuple[Indices, ...]
    run: SolverRun
    pixel_stddev_at_rest: float
    bend_m: float
    num_graph_steps: int


def refine(problem: MapProblem, *, with_equations: bool = True) -> MapAtRest:
    """Refine a model in place, and return it at rest.

    Misplaced points (see ``misplaced_points``), as wrong matches make them, do not take part.

    Args:
        with_equations: whether to set up the equations at rest.

    Raises:
        SolverError: the solver failed. InputError: an option passed through to COLMAP is unknown.
    """
    with _marks_in_map(problem) as marked:
        marked, adjustment, rays = _without_misplaced(marked)
        return _adjusted(marked, adjustment, straighten(marked, rays), with_equations=with_equations)


@contextmanager
def _marks_in_map(problem: MapProblem) -> Iterator[MapProblem]:
    """Add marks to the map as points inside the block."""
    marker_ids = add_marks(problem.metric, problem.markers)
    yield replace(problem, marker_ids=marker_ids)
    remove_marks(problem.metric, marker_ids)


def _without_misplaced(problem: MapProblem) -> tuple[MapProblem, BundleAdjustment, Rays]:
    """Return the problem without the misplaced points, its bundle adjustment, and the observations of all points."""
    frame_ids = problem.frame_ids
    rays = model_rays(problem.metric, frame_ids)
    misplaced = misplaced_points(rays, model_poses(problem.metric, frame_ids))
    problem = replace(problem, left_out_ids=frozenset(rays.point_ids[misplaced].tolist()))
    adjustment = problem.of_photos(problem.options.max_num_iterations)
    beyond_m2 = errors_beyond_features(adjustment, problem.markers, problem.marker_ids)
    problem = problem.replaced(lambda _, kind: kind.with_errors_of_marks(beyond_m2))
    rays = rays.with_pixel_stddev(adjustment.pixel_stddev)
    return replace(problem, visible_m=_just_visible_m(rays, model_poses(problem.metric, frame_ids))), adjustment, rays


def refine_with_loops(
    problem: MapProblem,
    known: Sequence[Measurements],
    loops: Sequence[Loop],
    merge_tracks: Callable[[pycolmap.Reconstruction], None],
    *,
    with_equations: bool = True,
) -> MapAtRest | None:
    """Move a refined model so that its loops close, in place, and refine it again; None where they are closed already.

    Args:
        problem: with the noise to begin with. known: its measurements with which the model was refined.
        loops: of its keyframes.
        merge_tracks: makes one point of those that two passes saw apart, in place.
        with_equations: as for ``refine``.
    """
    seen, _, rays = _without_misplaced(problem)
    if (closed := close_in_graph(seen, known, rays, loops)) is None:
        return None
    merge_tracks(problem.metric)
    # Tracks become one only where their points agree to some pixels. In a map that was bent by metres, all of them do
    # so only when those that have merged have straightened it.
    with _marks_in_map(problem) as marked:
        marked, adjustment, _ = _without_misplaced(marked)
        added = marked.add_to(adjustment, closed.blocks)
        solve_bundle_adjustment(adjustment, marked.visible_m)
        blocks = problem.state(added).blocks
    merge_tracks(problem.metric)
    return refine(problem.replaced(lambda _, kind: kind.at_blocks(blocks)), with_equations=with_equations)


def _just_visible_m(rays: Rays, poses: Poses) -> float:
    """Return the movement of a camera that moves a feature at median depth by its standard deviation."""
    _, in_cam, _ = project(rays, poses, rays.points)
    return float(np.median(np.abs(in_cam[:, 2]) / rays.root_information))


def _adjusted(
    problem: MapProblem, adjustment: BundleAdjustment, start: GraphSolution, *, with_equations: bool
) -> MapAtRest:
    """Alternate between solving the full problem and estimating the noise from its residuals."""
    problem, blocks = replace(problem, kinds=start.kinds), start.state.blocks
    runs, num_left = list[SolverRun](), problem.options.max_num_iterations
    for num_round in range(_MAX_NUM_ROUNDS):
        if num_round:
            rays = model_rays(problem.metric, problem.frame_ids).with_pixel_stddev(adjustment.pixel_stddev)
            blocks = straighten_again(problem, rays, blocks)
            adjustment = problem.of_photos(num_left)
        added = problem.add_to(adjustment, blocks)
        runs.append(solve_bundle_adjustment(adjustment, _MAX_LAST_MOVEMENT * problem.smallest_stddev))
        num_left -= runs[-1].num_iterations
        state = problem.state(added)
        blocks = state.blocks
        seen = problem.with_noise_of(state, start.num_absorbed)
        if problem.change(seen) < SAME_NOISE or not runs[-1].converged or num_left <= 0:
            break
        if num_round < _MAX_NUM_ROUNDS - 1:
            problem = seen
    tolerance_m = _MAX_LAST_MOVEMENT * problem.smallest_stddev
    run = solve_until_still(adjustment, reduce(SolverRun.then, runs), tolerance_m, num_left)
    return MapAtRest(
        problem=problem,
        state=problem.state(added),
        blocks=added,
        equations=equations_of(adjustment, added) if with_equations and adjustment.has_covariance else None,
        refined_params=adjustment.refined_params,
        parts=frames_of_parts(problem.metric),
        run=run,
        pixel_stddev_at_rest=pixel_stddev_of(adjustment.adjuster, adjustment.num_reprojections),
        bend_m=start.bend_m,
        num_graph_steps=start.num_steps,
    )


def joint_errors(rest: MapAtRest, bending_factor: float) -> MapErrors:
    """Return how the parts of a map at rest err, if each residual errs on its own; not known if it is not determined.

    Args:
        bending_factor: of the errors of all residuals.
    """
    if rest.equations is None:
        return UNKNOWN_ERRORS
    try:
        return joint_covariance(
            rest.equations,
            anchors={name: block for (what, name), block in rest.blocks.items() if what == "anchor"},
            residual_stddev=bending_factor * rest.run.pixel_stddev,
            refined_params=rest.refined_params,
            firm_frame_ids=rest.parts[0],
        )
    except GeometryError as error:
        logging.getLogger(__name__).info("%s", error)
        return UNKNOWN_ERRORS
