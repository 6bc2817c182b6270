"""Marks in photos as points of a model, so that the photos hold what people marked."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pycolmap

from rangesfm.arrays import Array
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.points import NamedPoints, images_by_name
from rangesfm.solver.bundle_adjustment import BundleAdjustment


def add_marks(model: pycolmap.Reconstruction, markers: Mapping[str, Marker]) -> dict[str, int]:
    """Add markers to the model as 3-D points, with their marks as features; return the points' ids by name.

    Raises:
        InputError: as of ``NamedPoints.find_mark``.
    """
    images, points = images_by_name(model), NamedPoints.in_model(model, markers)
    places = {name: points.find_mark(name).position_m for name in markers}
    ids = {}
    for name, place in places.items():
        marker = markers[name]
        track = pycolmap.Track()
        for image_name, pixel in zip(marker.image_names, marker.pixels, strict=True):
            if image_name in images:
                image = images[image_name]
                image.points2D.append(pycolmap.Point2D(pixel))
                track.add_element(image.image_id, len(image.points2D) - 1)
        ids[name] = int(model.add_point3D(place, track, np.zeros(3, dtype=np.uint8)))
    return ids


def remove_marks(model: pycolmap.Reconstruction, marker_ids: Mapping[str, int]) -> None:
    """Remove the points and features that ``add_marks`` added to the model."""
    marked = [
        element.image_id for point_id in marker_ids.values() for element in model.point3D(point_id).track.elements
    ]
    for point_id in marker_ids.values():
        model.delete_point3D(point_id)
    for image_id in marked:
        model.image(image_id).points2D.pop()


def errors_beyond_features(
    bundle: BundleAdjustment, markers: Mapping[str, Marker], marker_ids: Mapping[str, int]
) -> dict[str, Array]:
    """Return the covariances (3, 3) of marked points, square metres, from errors that their residuals do not have.

    COLMAP's residuals weigh a mark like a feature, but one set by hand is less precise.

    Args:
        markers: by name. marker_ids: 3-D points of the model, by name.
    """
    points, found = NamedPoints.in_model(bundle.metric, markers), {}
    for name, point_id in marker_ids.items():
        beyond_px = float(np.sqrt(max(markers[name].stddev_px ** 2 - bundle.pixel_stddev**2, 0.0)))
        found[name] = points.point_of_model(point_id, beyond_px).own_m2
    return found
