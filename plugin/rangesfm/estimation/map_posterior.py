"""The delivered map: its bend from the map at rest, and how its parts err (sections 6 and 7 of ``model.md``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.linalg import cho_solve, solve_triangular

from rangesfm.arrays import Array, Mask
from rangesfm.estimation.photo_bending import HELD, LARGEST_FACTOR, PhotoBending
from rangesfm.estimation.refinement import MapAtRest
from rangesfm.measurements.joint_map import JointMap
from rangesfm.solver.bending import NO_STEPS, FrameSteps
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.normal_equations import HALF_A_REVOLUTION
from rangesfm.solver.part_errors import PartSteps, map_errors, rows_of, steps_of
from rangesfm.solver.posterior import JointProblem
from rangesfm.util.geometry.map_errors import UNKNOWN_ERRORS, MapErrors
from rangesfm.util.geometry.numerics import NORMAL_95
from rangesfm.util.geometry.similarity import align_points, similarity_motions
from rangesfm.util.geometry.trajectory import Trajectory


def likely_bend(at_rest: JointMap, unscaled: Trajectory) -> FrameSteps:
    """Return where photos and all that is measured have the frames of a map at rest, before it moves as a whole.

    It is their expected bending after all that is observed: Rasmussen and Williams, "Gaussian processes for machine
    learning", 2006, eq. 2.42. A map whose photos say nothing of it stays as it is.

    Args:
        unscaled: the path of the unscaled model. The scale of the similarity to it stays as it is.
    """
    problem, known, bending = at_rest.problem, at_rest.posterior, at_rest.bending
    if not isinstance(bending, PhotoBending):
        return NO_STEPS
    steps = bending.likely_steps(
        known.pulls @ at_rest.by_pose, _factor(problem), frame_is_free=known.columns.frame >= 0
    )
    firm_m = (at_rest.path.centers + steps.at(bending.path.frame_ids)[1])[bending.is_firm]
    size = at_rest.metres_per_unit / align_points(unscaled.centers[bending.is_firm], firm_m).scale
    from_first_m = bending.from_first_m
    return steps._replace(shifts_m=size * (from_first_m + steps.shifts_m) - from_first_m)


@dataclass(frozen=True)
class SizeOfPart:
    """The size of a part of a map beside its largest part, by photos and all that is measured.

    Attributes:
        part: (k,) mask of its poses among those of the path.
        off: logarithm of its size in the map over that which it has. stddev: of that.
    """

    part: Mask
    off: float
    stddev: float

    @property
    def is_determined(self) -> bool:
        return self.stddev < HELD

    @property
    def half_width_95(self) -> float:
        """By how much the part may be too large or too small beside the others, with 95 % probability."""
        return abs(self.off) + NORMAL_95 * self.stddev


def sizes_of_parts(on_map: JointMap) -> tuple[SizeOfPart, ...]:
    """Return the sizes of the parts of a map that share few points with the others (section 7 of ``model.md``).

    None of a map whose photos do not say how it is bent.
    """
    bending, problem, known = on_map.bending, on_map.problem, on_map.posterior
    if not isinstance(bending, PhotoBending):
        return ()
    parts = [part for part in bending.parts[1:] if np.count_nonzero(part) > 1]
    if not parts:
        return ()
    by_pose = np.vstack([*map(bending.size_beside, parts), on_map.by_pose])
    gradients = bending.shape_by_steps(by_pose, frame_is_free=known.columns.frame >= 0)
    factor = _factor(problem)
    own, observed = gradients[:, : len(parts)], gradients[:, len(parts) :]
    moved = factor**2 * bending.photos_at(factor).solve(own)
    across = moved.T @ observed
    whitened = cho_solve((problem.solution.lower, True), np.hstack([across.T, problem.design[problem.is_used]]))
    left = across @ whitened[:, len(parts) :]
    covariance = moved.T @ own - across @ whitened[:, : len(parts)] + left @ known.covariance @ left.T
    # A refined map is where all that is measured has it; a scaled one is as the photos alone have it.
    off = np.zeros(len(parts)) if on_map.is_at_rest else -across @ known.pulls
    stddevs = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return tuple(map(SizeOfPart, parts, off.tolist(), stddevs.tolist()))


def bending_of_firm_parts(on_map: JointMap) -> PhotoBending | None:
    """Return the bending of a map whose size and place are those of all parts whose sizes photos and measurements tell.

    None if the map was measured with it already, or if photos do not say how it is bent.
    """
    bending = on_map.bending
    if not isinstance(bending, PhotoBending):
        return None
    told = (each.part for each in sizes_of_parts(on_map) if each.is_determined)
    is_firm = np.any([bending.parts[0], *told], axis=0)
    return None if np.array_equal(is_firm, bending.is_firm) else replace(bending, is_firm=is_firm)


def errors_at_estimate(at_rest: JointMap, rest: MapAtRest, anchor_ids: Sequence[str]) -> MapErrors:
    """Return how the parts of a map err that was bent and moved to its best estimate (section 7 of ``model.md``).

    Its photos bend it by a covariance P before anything is observed. With H the derivatives of the observations by
    bending, A those by the map as a whole and by anchors, Q the covariance of their errors with those by bending, and
    C that of the estimate, a function of the map with derivatives f and b by both errs by
    f P f' - f P H' Q^-1 H P f' + (b - f P H' Q^-1 A) C (b - f P H' Q^-1 A)' (universal kriging: Rasmussen and Williams,
    "Gaussian processes for machine learning", 2006, eq. 2.42).

    Args:
        rest: the same map, with its equations. anchor_ids: in the order of the ranges' log.

    Returns:
        errors that are not known where the photos do not say how the map is bent.
    """
    problem, known, bending = at_rest.problem, at_rest.posterior, at_rest.bending
    if not isinstance(bending, PhotoBending):
        return UNKNOWN_ERRORS
    columns, photos, variance = known.columns, bending.photos_at(_factor(problem)), _factor(problem) ** 2
    column_of = dict(zip(anchor_ids, columns.anchor.tolist(), strict=False))
    heard = [name for what, name in rest.blocks if what == "anchor" and name in column_of]
    parts = [
        *photos.parts(rest.refined_params),
        *(PartSteps("anchor", id_, None, np.eye(3), np.ones(3)) for id_ in heard),
    ]
    rows, steps = rows_of(parts), steps_of(parts, len(photos.gradient))
    motions, by_unknown = np.zeros((steps.shape[1], 7)), np.zeros((steps.shape[1], columns.num))
    shifts = dict(zip(photos.poses[0].tolist(), similarity_motions(bending.from_first_m), strict=True))
    for part, own in zip(parts, rows, strict=True):
        if part.kind == "frame":  # a turn about the axes of the world, and a shift of the origin
            motions[own][:3, 1:4] = np.eye(3)
            motions[own][3:] = shifts[int(part.id_)]
        elif part.kind == "anchor" and (at := column_of[str(part.id_)]) >= 0:
            by_unknown[own, at : at + 3] = np.eye(3)
    by_unknown[:, columns.of_map] = motions[:, : len(columns.of_map)]

    # Before anything is observed, with the part that is a similarity taken out of what the photos leave open.
    is_free = columns.frame >= 0
    of_whole, of_blocks = bending.similarity_by_steps(frame_is_free=is_free), photos.blocks()
    by_whole = photos.solve(of_whole)
    whole_m2, across_m2 = of_whole.T @ by_whole, steps.T @ by_whole

    def bent(gradients: Array) -> Array:
        """Return the covariance of the parts with functions of the map's shape, by their derivatives."""
        found = photos.solve(gradients)
        return np.asarray(variance * (steps.T @ found - motions @ (of_whole.T @ found)))

    def bent_block(part: PartSteps, own: slice) -> Array:
        mixed = across_m2[own] @ motions[own].T
        block = part.covariance(of_blocks) - mixed - mixed.T + motions[own] @ whole_m2 @ motions[own].T
        return np.asarray(variance * block)

    def product(right: Array) -> Array:
        own = bent(steps @ right - of_whole @ (motions.T @ right))
        return np.asarray(own - observed.T @ (observed @ right) + left @ (covariance @ (left.T @ right)))

    across = bent(bending.shape_by_steps(at_rest.by_pose, frame_is_free=is_free))
    lower = problem.solution.lower
    observed = solve_triangular(lower, across.T, lower=True)
    left = by_unknown - observed.T @ solve_triangular(lower, problem.design[problem.is_used], lower=True)
    covariance = _turns_bounded(known.covariance, columns)
    scale = columns.scale
    return map_errors(
        parts,
        product,
        (
            bent_block(part, own) - observed[:, own].T @ observed[:, own] + left[own] @ covariance @ left[own].T
            for part, own in zip(parts, rows, strict=True)
        ),
        left @ covariance[scale] / covariance[scale, scale],
        float(np.sqrt(covariance[scale, scale])),
    )


def _factor(problem: JointProblem) -> float:
    """Return the learnt bending over that expected from the photos, of which no map has more than the largest.

    What a map would have to bend by more than maps do is an error of the measurements that they alone do not show.
    """
    return min(problem.bending_factor, LARGEST_FACTOR)


def _turns_bounded(covariance: Array, columns: Columns) -> Array:
    """Return the covariance (p, p) of a map with the knowledge that its turn is anything up to half a revolution.

    What determines a turn hardly, as that about a straight path, would otherwise leave it any number of revolutions.
    """
    turn = columns.of_map[1:4]
    of_turn = covariance[:, turn]
    known = of_turn[turn] + HALF_A_REVOLUTION**2 * np.eye(len(turn))
    return np.asarray(covariance - of_turn @ np.linalg.solve(known, of_turn.T))
