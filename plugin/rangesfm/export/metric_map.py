"""The metric map with everything that exporters may need, and its transformation into the frame of the export."""

from __future__ import annotations

import errno
import math
import os
import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array
from rangesfm.colmap.transform import rescale
from rangesfm.errors import InputError
from rangesfm.options import ExportOptions
from rangesfm.util.files.folders import stays_inside
from rangesfm.util.geometry.georeference import Georeference, check_crs, georeference_of_anchor
from rangesfm.util.geometry.gravity import UP_IN_SITE
from rangesfm.util.geometry.similarity import Similarity, path_shape
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

# Largest ratio of the path's extent perpendicular to its plane to its second largest extent; above, it has no plane.
_MAX_ROUGHNESS = 0.3
# Smallest length of the mean of the photos' upward unit vectors; it is 1 where all photos agree.
_MIN_AGREEMENT = 0.3
# Horizontal part of a unit viewing direction below which the direction counts as vertical.
_NEARLY_VERTICAL = 0.1
# Distance from the origin from which on 32-bit numbers lose a twentieth of a millimetre, and soon more, metres.
_FAR_M = 500.0
# Smallest part of that mean along the normal of the path's plane. It is 0 if the photos look straight along the normal.
_MIN_LEAN = 0.01


@dataclass(frozen=True)
class MetricMap:
    """A model in metres, and what a COLMAP model cannot hold; what is not known is None or empty.

    Attributes:
        timestamps_s: time of each photo on the camera's clock, by name.
        anchors_m: position (3,) of each anchor by id, in the world of the model.
        metric_from_sfm: similarity from the world of the unscaled model to that of this model.
        relative_scale_stddev: relative stddev that the scale gives every length in the map; inf if unknown.
        is_site: whether the world of the model is the site frame of the anchors, where z is up by convention.
        upward: (3,) unit vector in another world, as measured; None where it has to be taken from the photos.
        center_covariance_m2: covariance (3, 3) of each keyframe's projection centre by photo.
        offset_m: (3,) what was subtracted from all coordinates, to have the origin near the cameras.
    """

    reconstruction: pycolmap.Reconstruction
    timestamps_s: Mapping[str, float] = field(default_factory=dict)
    anchors_m: Mapping[str, Array] = field(default_factory=dict)
    metric_from_sfm: Similarity | None = None
    relative_scale_stddev: float = math.inf
    images_path: Path | None = None
    database_path: Path | None = None
    is_site: bool = False
    upward: Array | None = None
    georeference: Georeference | None = None
    center_covariance_m2: Mapping[str, Array] = field(default_factory=dict)
    offset_m: Array = field(default_factory=lambda: np.zeros(3))

    @cached_property
    def trajectory(self) -> Trajectory:
        return trajectory_from_reconstruction(self.reconstruction, self.timestamps_s or None)

    @property
    def known_up(self) -> Array | None:
        """Return the upward unit vector (3,) in the world of the model; None if it is not known."""
        return UP_IN_SITE if self.is_site else self.upward

    def georeference_for(self, need: str) -> Georeference:
        """Return the georeference.

        Args:
            need: what needs it, for the message.

        Raises:
            InputError: the map has none; the text says how to give one.
        """
        if self.georeference is None:
            how = "anchors with [anchors] crs, or origin_anchor, origin_lat_lon_height and heading_deg"
            raise InputError(f"{need}: {how}")
        return self.georeference


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Return the images of a model that have a pose, in order of their names."""
    return sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)


def photo_files(map_: MetricMap, images_path: Path) -> dict[str, Path]:
    """Return the files of the photos of a map by their names, in order of the names.

    Raises:
        InputError: a photo is not in the folder ``images_path``, or its name leads out of a folder.
    """
    names = [image.name for image in registered_images(map_.reconstruction)]
    for name in names:
        if not stays_inside(name):
            raise InputError(f"the photo {name} would be written outside of its folder, expected a name inside it")
        if not os.path.isfile(images_path / name):
            raise InputError(f"the photo {name} of the map is not in this folder", images_path)
    return {name: images_path / name for name in names}


def require_space(folder: Path, files: Iterable[Path]) -> None:
    """Check that copies of some files fit on the disk of a folder.

    Raises:
        OSError: they do not.
    """
    if shutil.disk_usage(folder).free < sum(map(os.path.getsize, files)):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(folder))


def colored_points(model: pycolmap.Reconstruction) -> tuple[Array, npt.NDArray[np.uint8]]:
    """Return positions (n, 3) and colours (n, 3) of the 3-D points of a model, in order of their ids."""
    points = [model.point3D(point_id) for point_id in sorted(model.point3D_ids())]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    return xyz, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)


def in_frame(map_: MetricMap, options: ExportOptions) -> MetricMap:
    """Return the map in the frame of the options, with a georeference if the options or the map give one.

    Raises:
        InputError: the frame is not determined; the text says what is missing.
    """
    map_ = _georeferenced(map_, options)
    if options.frame == "result":
        return map_
    if options.frame == "level":
        vertical = up_in_world(map_.trajectory, options.up, map_.known_up)
        if map_.is_site:  # it is only tilted, not turned about z, because its heading is that of the site
            level = np.asarray(Rotation.align_vectors([[0.0, 0.0, 1.0]], [vertical])[0].as_matrix())
        else:
            level = level_axes(map_.trajectory, vertical)
        return near_origin(moved(map_, Similarity(1.0, level, np.zeros(3))))
    return moved(map_, map_.georeference_for("the frame 'enu' needs a georeference").enu_from_world)


def near_origin(map_: MetricMap) -> MetricMap:
    """Return the map with its origin among the cameras, for programs with 32-bit numbers, if it is far from them.

    The offset is in whole metres, so that adding it again restores every digit.
    """
    centers = map_.trajectory.centers
    middle = np.round(np.median(centers, axis=0)) if len(centers) else np.zeros(3)
    if np.linalg.norm(middle) <= _FAR_M:
        return map_
    return replace(moved(map_, Similarity(1.0, np.eye(3), -middle)), offset_m=map_.offset_m + middle)


def moved(map_: MetricMap, new_from_old: Similarity) -> MetricMap:
    """Return the same map in another world."""
    georeference = map_.georeference
    if georeference is not None:
        georeference = replace(georeference, enu_from_world=georeference.enu_from_world @ new_from_old.inverse())
    known, covariance_m2 = map_.metric_from_sfm, map_.center_covariance_m2
    turn = new_from_old.scale * new_from_old.rotation
    return replace(
        map_,
        reconstruction=rescale(map_.reconstruction, new_from_old),
        anchors_m={name: new_from_old.apply(at) for name, at in map_.anchors_m.items()},
        metric_from_sfm=None if known is None else new_from_old @ known,
        georeference=georeference,
        upward=None if map_.upward is None else new_from_old.rotation @ map_.upward,
        center_covariance_m2={name: turn @ of @ turn.T for name, of in covariance_m2.items()},
    )


def _georeferenced(map_: MetricMap, options: ExportOptions) -> MetricMap:
    georeference = map_.georeference
    if options.origin_anchor:
        anchor = map_.anchors_m.get(options.origin_anchor)
        if anchor is None:
            known = ", ".join(map_.anchors_m) or "none"
            raise InputError(f"origin_anchor is {options.origin_anchor!r}, expected one with a position: {known}")
        if options.origin_lat_lon_height is None or options.heading_deg is None:
            raise InputError("origin_anchor needs origin_lat_lon_height and heading_deg as well")
        georeference = georeference_of_anchor(
            anchor,
            options.origin_lat_lon_height,
            up_in_world=up_in_world(map_.trajectory, options.up, map_.known_up),
            forward_in_world=map_.trajectory.world_from_cam[0][:, 2],
            heading_deg=options.heading_deg,
        )
    if georeference is not None and options.crs:
        check_crs(options.crs)
        georeference = replace(georeference, crs=options.crs)
    return replace(map_, georeference=georeference)


def up_in_world(trajectory: Trajectory, up: str, measured: Array | None = None) -> Array:
    """Return the upward unit vector (3,) by the rule ``up`` of ExportOptions.

    Args:
        measured: it, where it is known.

    Raises:
        InputError: the photos disagree, or do not say which side of the path's plane is up; the path is not in a plane;
            or ``up`` is not valid.
    """
    if up == "auto" and measured is not None:
        return measured
    photos_up = -trajectory.world_from_cam[:, :, 1].mean(axis=0)
    if up in ("auto", "cameras"):
        if np.linalg.norm(photos_up) < _MIN_AGREEMENT:
            raise InputError("the photos do not agree on what is up: give it (--up path, or --up X,Y,Z)")
        return _unit(photos_up)
    if up == "path":
        shape = path_shape(trajectory.centers)
        if shape.stddevs[2] > _MAX_ROUGHNESS * shape.stddevs[1]:
            raise InputError("the path does not lie in a plane: give what is up (--up cameras, or --up X,Y,Z)")
        normal = shape.axes[:, 2]
        if abs(normal @ photos_up) < _MIN_LEAN:
            raise InputError("the photos do not say which side of the path's plane is up: give it (--up X,Y,Z)")
        return _unit(normal if normal @ photos_up > 0 else -normal)
    return _unit(np.array(direction(up)))


def direction(text: str) -> tuple[float, float, float]:
    """Read a direction X,Y,Z from text.

    Raises:
        InputError: it is not three numbers, or all are 0.
    """
    try:
        numbers = tuple(float(part) for part in text.replace(",", " ").split())
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not 0 < np.linalg.norm(numbers) < np.inf:
        raise InputError(f"up is {text!r}, expected auto, cameras, path or a direction X,Y,Z")
    return numbers


def _unit(vector: Array) -> Array:
    unit: Array = vector / np.linalg.norm(vector)
    return unit


def level_axes(trajectory: Trajectory, vertical: Array) -> Array:
    """Return the rotation (3, 3) of a path's world into a level frame: z up, y along the view of the first camera.

    Where the first camera looks almost straight up or down, y is along the upper edge of its image instead.

    Args:
        vertical: (3,) upward unit vector.
    """
    first = trajectory.world_from_cam[0]
    for ahead in (first[:, 2], -first[:, 1]):
        level = ahead - (ahead @ vertical) * vertical
        if np.linalg.norm(level) > _NEARLY_VERTICAL:
            break
    y = _unit(level)
    return np.stack([np.cross(y, vertical), y, vertical])
