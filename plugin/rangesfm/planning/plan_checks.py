"""Checks of a plan: what cannot be is refused, what is merely odd is said, each in one line that names its key."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from itertools import combinations

import numpy as np

from rangesfm.arrays import Array
from rangesfm.diagnostics.preflight import FAR_M, SAME_PLACE_M
from rangesfm.errors import OptionError
from rangesfm.measurements.ranges.anchors.site import coordinates_text
from rangesfm.measurements.ranges.mistakes.catalogue import LARGEST_RIG_M
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.walls import are_outside, lead_through

# Difference of height between camera and anchor, metres, that only masts and drones reach.
_TALL_M = 20.0

KeyOf = Callable[[str], str]
"""Return the key of a thing by its name, such as ``places.A1`` of anchor A1."""


def require_possible(
    planned: PlannedSurvey, floors_m: Sequence[Array], path_key: str, anchor_key: KeyOf, point_key: KeyOf
) -> None:
    """Raise OptionError if a plan cannot be as it is given.

    Args:
        floors_m: corners (k, 2) of the floors that the path must not leave.
        path_key: key in [path] that gives the path. anchor_key, point_key: of an anchor or a point, by name.
    """
    _require_apart(
        {a.anchor_id: at for a, at in zip(planned.anchors, planned.anchors_m, strict=True)}, "anchors", anchor_key
    )
    _require_apart({point.name: point.position_m for point in planned.points}, "points", point_key)
    arms = [("tag", "tag_in_cam_m", planned.tag_in_cam_m)]
    if planned.antenna is not None:
        arms.append(("positions", "antenna_in_cam_m", planned.antenna.antenna_in_cam_m))
    for table, key, arm_m in arms:
        if (length_m := float(np.linalg.norm(arm_m))) > LARGEST_RIG_M:
            expected = f"expected at most {LARGEST_RIG_M:g} m: metres from the lens, right, down and forward"
            raise OptionError(f"[{table}] {key} is {length_m:.3g} m long, {expected}", table, key)
    path = planned.trajectory.centers
    is_out = are_outside(path[:-1, :2], floors_m)
    through = np.flatnonzero(is_out | lead_through(path[:-1, :2], path[1:, :2], planned.walls_m))
    if len(through):
        at = coordinates_text(path[through[0], :2])
        raise OptionError(
            f"[path] {path_key} leads the camera through a wall at {at}, expected a path inside the walls; "
            "a door is a gap between walls",
            "path",
            path_key,
        )
    for anchor, at in zip(planned.anchors, planned.anchors_m, strict=True):
        if (nearest_m := float(np.linalg.norm(path - at, axis=1).min())) > FAR_M:
            found = f"is {nearest_m:.3g} m from the path at its nearest"
            expected = f"expected at most {FAR_M:g} m, in metres: radios reach no farther"
            key = anchor_key(anchor.anchor_id)
            raise OptionError(f"[anchors] {key}: anchor {anchor.anchor_id} {found}, {expected}", "anchors", key)


def _require_apart(places: dict[str, Array], table: str, key_of: KeyOf) -> None:
    for one, other in combinations(places, 2):
        if np.linalg.norm(places[one] - places[other]) < SAME_PLACE_M:
            found = f"[{table}] {key_of(other)}: {other} is at {coordinates_text(places[other])}, where {one} is"
            raise OptionError(f"{found}, expected another place", table, key_of(other))


def oddities(
    planned: PlannedSurvey, walls_m: Sequence[Array], path_key: str, anchor_key: KeyOf
) -> Iterator[OptionError]:
    """Yield what is odd about a plan; arguments as for ``require_possible``.

    Args:
        walls_m: corners (k, 2) of the walls for anchors.
    """
    if not planned.anchors:
        return
    is_inside = not are_outside(planned.trajectory.centers[:, :2], walls_m).any()
    outside = are_outside(planned.anchors_m[:, :2], walls_m) & is_inside
    for anchor in (anchor for anchor, is_out in zip(planned.anchors, outside, strict=True) if is_out):
        key = anchor_key(anchor.anchor_id)
        found = f"[anchors] {key}: anchor {anchor.anchor_id} is outside the walls"
        yield OptionError(f"{found}, expected inside: walls lengthen or block its ranges", "anchors", key)
    low, high = planned.places_m[:, :2].min(axis=0), planned.places_m[:, :2].max(axis=0)
    wide_m = float(np.linalg.norm(high - low))
    camera_m = float(np.median(planned.trajectory.centers[:, 2]))
    apart_m = np.abs(planned.anchors_m[:, 2] - camera_m)
    is_tall = apart_m > max(_TALL_M, wide_m)
    in_site = f"in a site {wide_m:.3g} m wide, expected heights in metres"
    if is_tall.all():
        found = f"[path] {path_key}: the camera is {apart_m.min():.3g} m above or below all anchors"
        yield OptionError(f"{found}, {in_site}", "path", path_key)
        return
    for anchor, by_m, is_odd in zip(planned.anchors, apart_m.tolist(), is_tall.tolist(), strict=True):
        key = anchor_key(anchor.anchor_id)
        if is_odd:
            found = f"[anchors] {key}: anchor {anchor.anchor_id} is {by_m:.3g} m above or below the camera"
            yield OptionError(f"{found}, {in_site}", "anchors", key)
    if planned.heights_m is not None and planned.heights_m[1] - camera_m > max(_TALL_M, wide_m):
        found = f"[anchors] heights_m lets anchors be up to {planned.heights_m[1] - camera_m:.3g} m above the camera"
        yield OptionError(f"{found}, {in_site}", "anchors", "heights_m")
