"""The plane that coplanar anchors lie in, and the side of it on which the camera moved."""

from __future__ import annotations

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.ranges.scale.range_equation import RangeProblem, RangeState
from rangesfm.util.geometry.gravity import UP_IN_SITE
from rangesfm.util.geometry.similarity import PathShape, Similarity, path_shape

# Anchors are coplanar if their extent across the plane is below this share of their second largest extent.
_COPLANAR = 0.1
# Angle from the vertical, degrees, below which a line or a plane stands upright. Gravity does not fix the turn about
# such a line, and nothing is above or below such a plane.
_UPRIGHT_DEG = 20.0
# Share of the path's places that must lie on one side for the path to count as on that side.
_ON_ONE_SIDE = 0.9
# Share of the path's length. Places nearer to the plane than this count as in it: ranges cannot tell their side.
_IN_PLANE = 1e-3


def anchor_plane(problem: RangeProblem) -> tuple[Array, Array] | None:
    """Return a point (3,) and the upward unit normal (3,) of the anchors' plane; None if they have no common plane.

    Anchors on a line have one where gravity is known and the line is not steep: the plane that holds the line and is
    level across it.
    """
    known = problem.anchor_mean_m[np.isfinite(problem.anchor_mean_m).all(axis=1)]
    if len(known) < 2:
        return None
    shape = path_shape(known)
    if are_on_line(known):
        if problem.gravity is None or is_steep(shape):
            return None
        along = shape.axes[:, 0]
        normal = UP_IN_SITE - (UP_IN_SITE @ along) * along
    elif shape.stddevs[2] < _COPLANAR * shape.stddevs[1]:
        normal = shape.axes[:, 2] * np.copysign(1.0, shape.axes[:, 2] @ UP_IN_SITE)
    else:
        return None
    return shape.centroid, normal / np.linalg.norm(normal)


def are_on_line(places_m: Array) -> bool:
    """Return True if places (n, 3) leave a turn about their line open, also without any one of them.

    One that is wrong by hundreds of metres makes a line of all.
    """
    without_one = (np.delete(places_m, k, axis=0) for k in range(len(places_m)))
    return path_shape(places_m).is_line and all(path_shape(some).is_line for some in without_one)


def is_steep(anchors: PathShape) -> bool:
    """Return True if the positions' line is so near the vertical that gravity does not fix the turn about it."""
    return bool(abs(anchors.axes[:, 0] @ UP_IN_SITE) > np.cos(np.deg2rad(_UPRIGHT_DEG)))


def mirrored_map(problem: RangeProblem, state: RangeState) -> RangeState | None:
    """Return the map on the other side of the anchors' plane, or None if they have no plane.

    The mirror image of a map is left-handed, so it is no map. It is therefore also reflected in the plane of its own
    path, which leaves a flat path unchanged: such a path fits the ranges on both sides equally well.
    """
    plane = anchor_plane(problem)
    if plane is None:
        return None
    point, normal = plane
    placed, path = state.metric_from_model, path_shape(problem.centers)
    across = _reflection(normal)
    rotation = across @ placed.rotation @ _reflection(path.axes[:, 2])
    middle = point + across @ (placed.apply(path.centroid) - point)
    translation = middle - placed.scale * rotation @ path.centroid
    return RangeState(Similarity(placed.scale, rotation, translation), state.anchors_m.copy(), state.bias_m.copy())


def camera_side_of(problem: RangeProblem, state: RangeState) -> str | None:
    """Return "above", "below" or "on both sides of" the anchors' plane; None if there is no plane or the path is in it.

    Raises:
        GeometryError: the plane stands upright.
    """
    plane = anchor_plane(problem)
    if plane is None:
        return None
    point, normal = plane
    if normal @ UP_IN_SITE < np.sin(np.deg2rad(_UPRIGHT_DEG)):
        raise GeometryError("the anchors stand in an upright plane, so that nothing is above or below it: camera_side")
    heights = (state.metric_from_model.apply(problem.centers) - point) @ normal
    length = state.metric_from_model.scale * path_shape(problem.centers).stddevs[0]
    off_plane = np.abs(heights) > _IN_PLANE * length
    if not off_plane.any():
        return None
    share_above = float(np.mean(heights[off_plane] > 0))
    if share_above >= _ON_ONE_SIDE:
        return "above"
    return "below" if share_above <= 1 - _ON_ONE_SIDE else "on both sides of"


def is_on_side(problem: RangeProblem, state: RangeState, camera_side: str | None) -> bool:
    """Return whether the path is on the given side of the anchors' plane or in it; true if no side is given.

    Raises:
        GeometryError: the plane stands upright.
    """
    return camera_side is None or camera_side_of(problem, state) in (camera_side, None)


def on_side(problem: RangeProblem, states: list[RangeState], camera_side: str | None) -> list[RangeState]:
    """Return the states whose path is on the given side of the anchors' plane or in it; all if there is no plane.

    Raises:
        GeometryError: the plane is upright, or no state is on that side.
    """
    kept = [state for state in states if is_on_side(problem, state, camera_side)]
    if states and not kept:
        raise GeometryError(
            f"the ranges put the camera {camera_side_of(problem, states[0])} the anchors' plane, not "
            f"{camera_side} as said: check camera_side and the anchors' heights"
        )
    return kept


def _reflection(normal: Array) -> Array:
    return np.eye(3) - 2 * np.outer(normal, normal)
