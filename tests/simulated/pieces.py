"""Models of two parts that few points tie together."""

from __future__ import annotations

from collections.abc import Collection

import pycolmap


def points_across(model: pycolmap.Reconstruction, second: Collection[str]) -> list[int]:
    """Return the ids, ascending, of the points that are seen by photos of both parts.

    Args:
        second: names of the photos of the second part.
    """
    return [
        point_id
        for point_id, point in sorted(model.points3D.items())
        if len({model.image(element.image_id).name in second for element in point.track.elements}) == 2
    ]


def leave_across(model: pycolmap.Reconstruction, second: Collection[str], num_points: int) -> None:
    """Delete all but the first of the points that are seen by photos of both parts."""
    for point_id in points_across(model, second)[num_points:]:
        model.delete_point3D(point_id)
