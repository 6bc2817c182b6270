"""Measured distances as residuals of the full problem: taped ones, and ranges between anchors."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pycolmap

from rangesfm import ceres
from rangesfm.arrays import Array
from rangesfm.distances.locate_lengths import (
    LocatedDistances,
    images_by_name,
    mark_covariance,
    triangulate_marker,
    triangulate_markers,
    variance_along,
)
from rangesfm.distances.tape import Marker, Tape
from rangesfm.geometry.trajectory import pose_of
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.ranging.errors.range_errors import RangeErrors
from rangesfm.refine.bundle_adjustment import BundleAdjustment


@dataclass(frozen=True)
class MeasuredDistances:
    """Distances that are fitted together with the map.

    Attributes:
        tape: the control distances.
        marker_ids: 3-D points of the model, by the names of the markers among the ends.
        by_radio: distances between anchors; their standard deviations do not include the common bias.
    """

    by_radio: LocatedDistances
    tape: Tape
    marker_ids: Mapping[str, int]


def add_marker_points(
    model: pycolmap.Reconstruction, tape: Tape, more: Mapping[str, Marker] | None = None
) -> dict[str, int]:
    """Add markers to the model as 3-D points, with their marks as features; return the points' ids by name.

    Args:
        tape: whose ends are added. more: further markers to add, by name.

    Raises:
        InputError: as in ``locate_distances``.
    """
    places, images, markers = triangulate_markers(tape, model), images_by_name(model), {**tape.markers, **(more or {})}
    places |= {
        name: triangulate_marker(name, marker, images, tape.markers_path)
        for name, marker in (more or {}).items()
        if name not in places
    }
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


def remove_marker_points(model: pycolmap.Reconstruction, marker_ids: Mapping[str, int]) -> None:
    """Remove the points and features that ``add_marker_points`` added to the model."""
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
    images, found = images_by_name(bundle.metric), {}
    for name, point_id in marker_ids.items():
        beyond_px = float(np.sqrt(max(markers[name].stddev_px ** 2 - bundle.pixel_stddev**2, 0.0)))
        point = np.array(bundle.metric.point3D(point_id).xyz)
        found[name] = mark_covariance(replace(markers[name], stddev_px=beyond_px), point, images)
    return found


def add_distances(
    bundle: BundleAdjustment,
    distances: MeasuredDistances,
    anchors: Sequence[AnchorEstimate],
    anchor_blocks: Sequence[Array],
    errors: RangeErrors,
    of_marks: Mapping[str, Array],
) -> list[Array]:
    """Add the distances to the bundle adjustment, as residuals in pixels.

    Args:
        anchors, anchor_blocks: in the order of the log. Distances to an anchor without a position are left out.
        errors: of the ranges; their loss and common bias also apply to ranges between anchors.
        of_marks: as ``errors_beyond_features`` gives them.

    Returns:
        the parameter blocks that were added.
    """
    placed = {
        anchor.anchor_id: _End(block, None, np.array(block))
        for anchor, block in zip(anchors, anchor_blocks, strict=True)
        if np.isfinite(block).all()
    }
    origins = _add_taped(bundle, distances, placed, of_marks)
    return origins + _add_by_radio(bundle, distances.by_radio, anchor_blocks, errors)


@dataclass(frozen=True)
class _End:
    """One end of a distance.

    Attributes:
        block: parameter block of a point, or of a rig's pose.
        in_rig_m: (3,) position of the end in that rig; None if the block is the end.
        place_m: (3,) in the metric world. covariance_m2: (3, 3) of errors that no residual has.
    """

    block: Array
    in_rig_m: Array | None
    place_m: Array
    covariance_m2: Array = field(default_factory=lambda: np.zeros((3, 3)))


def _add_taped(
    bundle: BundleAdjustment,
    distances: MeasuredDistances,
    anchors: Mapping[str, _End],
    of_marks: Mapping[str, Array],
) -> list[Array]:
    ends, origins = dict(anchors), []
    for name, point_id in distances.marker_ids.items():
        block = bundle.metric.point3D(point_id).xyz
        ends[name] = _End(block, None, np.array(block), of_marks[name])
        bundle.keep_from_elimination(ends[name].block)
    images = images_by_name(bundle.metric) if distances.tape.distances else {}
    ends |= {name: _camera(bundle.metric, image) for name, image in images.items()}
    for taped in distances.tape.distances:
        if not set(taped.ends) <= ends.keys():
            continue
        a, b = (ends[name] for name in taped.ends)
        of_marks_m2 = variance_along(a.place_m, b.place_m, a.covariance_m2 + b.covariance_m2)
        if a.block is b.block or np.shares_memory(a.block, b.block):
            a, b = (_in_rig(bundle.metric, images[name]) for name in taped.ends)
            origins += [end.block for end in (a, b) if end.in_rig_m is None]
        cost = ceres.distance_cost(
            distance_m=taped.distance_m,
            stddev_m=float(np.sqrt(taped.stddev_m**2 + of_marks_m2)) / bundle.pixel_stddev,
            a_in_cam_m=a.in_rig_m,
            b_in_cam_m=b.in_rig_m,
        )
        ceres.add_residual_block(bundle.adjuster, cost, None, [a.block, b.block])
    for origin in origins:
        bundle.adjuster.problem.set_parameter_block_constant(origin)
    return origins


def _in_rig(metric: pycolmap.Reconstruction, image: pycolmap.Image) -> _End:
    """Return a camera's position in its rig, for a distance to another photo of the same rig."""
    sensor, rig = image.data_id.sensor_id, metric.rig(metric.frame(image.frame_id).rig_id)
    # The pose itself is needed as a parameter block: sensor_from_rig() returns a copy.
    pose = None if rig.is_ref_sensor(sensor) else rig.non_ref_sensors[sensor]
    center_m = image.projection_center()
    return _End(np.zeros(3), None, center_m) if pose is None else _End(pose.params, np.zeros(3), center_m)


def _camera(metric: pycolmap.Reconstruction, image: pycolmap.Image) -> _End:
    """Return a photo's projection centre as a point of its rig."""
    pose = pose_of(metric.frame(image.frame_id))
    return _End(pose.params, pose * image.projection_center(), image.projection_center())


def _add_by_radio(
    bundle: BundleAdjustment, by_radio: LocatedDistances, anchor_blocks: Sequence[Array], errors: RangeErrors
) -> list[Array]:
    bias, bias_stddev_m = np.zeros(1), errors.common_bias_stddev_m
    rows = [
        row for row, pair in enumerate(by_radio.anchor_pair) if all(np.isfinite(anchor_blocks[k]).all() for k in pair)
    ]
    if not rows:
        return []
    for row in rows:
        cost = ceres.distance_cost(
            distance_m=by_radio.distance_m[row],
            stddev_m=by_radio.stddev_m[row] / bundle.pixel_stddev,
            has_bias=True,
            loss_scale=errors.loss.width * bundle.pixel_stddev,
        )
        pair = [anchor_blocks[k] for k in by_radio.anchor_pair[row]]
        ceres.add_residual_block(bundle.adjuster, cost, None, [*pair, bias])
    bundle.add_prior(bias, np.zeros(1), bias_stddev_m)
    return [bias]
