"""Make a model that is only weakly connected at one place of its path."""

from __future__ import annotations

import pycolmap


def leave_few_links(model: pycolmap.Reconstruction, last_image_id: int, num_links: int) -> None:
    """Delete all but ``num_links`` of the points that are seen both up to that photo and after it.

    Image ids are in the order of time.
    """
    links = []
    for point_id, point in sorted(model.points3D.items()):
        seen = [element.image_id for element in point.track.elements]
        if min(seen) <= last_image_id < max(seen):
            links.append(point_id)
    for point_id in links[num_links:]:
        model.delete_point3D(point_id)
