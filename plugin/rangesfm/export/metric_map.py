"""The metric map with all that exporters may need, and the frame in which it leaves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from rangesfm.arrays import Array
from rangesfm.colmap.transform import rescale
from rangesfm.errors import InputError
from rangesfm.geometry.georeference import Georeference, check_crs, georeference_of_anchor
from rangesfm.geometry.similarity import Similarity, path_shape
from rangesfm.geometry.trajectory import Trajectory, trajectory_from_reconstruction
from rangesfm.options import ExportOptions

# Extent of a path across its plane, in its second extent: above this there is no plane to speak of.
_MAX_ROUGHNESS = 0.3
# Mean of the photos' up directions: of photos that agree it has length 1.
_MIN_AGREEMENT = 0.3
_NEARLY_VERTICAL = 0.1
# Of the same mean along the normal of the path's plane: photos straight down, or of a wall, have none.
_MIN_LEAN = 0.01


@dataclass(frozen=True)
class MetricMap:
    """A metric model with what a COLMAP model does not hold.

    Attributes:
        reconstruction: in metres.
        timestamps_s: camera-clock time of each photo by name; None if unknown.
        anchors_m: (3,) position by anchor id, in the model's world.
        metric_from_sfm: from the unscaled model's world to this one's; None if unknown.
        relative_scale_stddev: of every length in the map, by the scale alone; None if unknown.
        images_path: folder of the photos; None if unknown.
        database_path: COLMAP's database of them; None if unknown.
        center_covariance_m2: (3, 3) of each keyframe's projection centre, by its photo; None if unknown.
        is_site: whether the model's world is the anchors' site frame, in which z is up by custom.
        georeference: where the model's world lies on the Earth; None if unknown.
    """

    reconstruction: pycolmap.Reconstruction
    timestamps_s: Mapping[str, float] | None = None
    anchors_m: Mapping[str, Array] | None = None
    metric_from_sfm: Similarity | None = None
    relative_scale_stddev: float | None = None
    images_path: Path | None = None
    database_path: Path | None = None
    is_site: bool = False
    georeference: Georeference | None = None
    center_covariance_m2: Mapping[str, Array] | None = None

    @cached_property
    def trajectory(self) -> Trajectory:
        return trajectory_from_reconstruction(self.reconstruction, self.timestamps_s)

    def georeference_for(self, need: str) -> Georeference:
        """The georeference, or InputError with what needs it and how the map comes by one."""
        if self.georeference is None:
            how = "anchors with [anchors] crs, or origin_anchor, origin_lat_lon_height and heading_deg"
            raise InputError(f"{need}: {how}")
        return self.georeference


def registered_images(model: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Those that have a pose, by their names."""
    return sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)


def points_of(model: pycolmap.Reconstruction) -> tuple[Array, npt.NDArray[np.uint8]]:
    """(n, 3) positions and (n, 3) colours of the 3-D points, in order of their ids."""
    points = [model.point3D(point_id) for point_id in sorted(model.point3D_ids())]
    xyz = np.array([point.xyz for point in points], dtype=np.float64).reshape(-1, 3)
    return xyz, np.array([point.color for point in points], dtype=np.uint8).reshape(-1, 3)


def in_frame(map_: MetricMap, options: ExportOptions) -> MetricMap:
    """The map in the frame that the options ask for, georeferenced as far as they and the map say.

    Raises:
        InputError: the frame is not determined, with what is missing.
    """
    map_ = _georeferenced(map_, options)
    if options.frame == "result":
        return map_
    if options.frame == "level":
        return moved(map_, Similarity(1.0, _level_from_world(map_, options.up), np.zeros(3)))
    return moved(map_, map_.georeference_for("the frame 'enu' needs a georeference").enu_from_world)


def moved(map_: MetricMap, new_from_old: Similarity) -> MetricMap:
    """The same map in another world."""
    georeference = map_.georeference
    if georeference is not None:
        georeference = replace(georeference, enu_from_world=georeference.enu_from_world @ new_from_old.inverse())
    known, covariance_m2 = map_.metric_from_sfm, map_.center_covariance_m2
    turn = new_from_old.scale * new_from_old.rotation
    return replace(
        map_,
        reconstruction=rescale(map_.reconstruction, new_from_old),
        anchors_m={name: new_from_old.apply(at) for name, at in (map_.anchors_m or {}).items()},
        metric_from_sfm=None if known is None else new_from_old @ known,
        georeference=georeference,
        center_covariance_m2=covariance_m2 and {name: turn @ of @ turn.T for name, of in covariance_m2.items()},
    )


def _georeferenced(map_: MetricMap, options: ExportOptions) -> MetricMap:
    georeference = map_.georeference
    if options.origin_anchor is not None:
        anchor = (map_.anchors_m or {}).get(options.origin_anchor)
        if anchor is None:
            known = ", ".join(map_.anchors_m or {}) or "none"
            raise InputError(f"origin_anchor is {options.origin_anchor!r}, expected one with a position: {known}")
        if options.origin_lat_lon_height is None or options.heading_deg is None:
            raise InputError("origin_anchor needs origin_lat_lon_height and heading_deg as well")
        georeference = georeference_of_anchor(
            anchor,
            options.origin_lat_lon_height,
            up_in_world=up_in_world(map_.trajectory, options.up, is_site=map_.is_site),
            forward_in_world=map_.trajectory.world_from_cam[0][:, 2],
            heading_deg=options.heading_deg,
        )
    if georeference is not None and options.crs is not None:
        check_crs(options.crs)
        georeference = replace(georeference, crs=options.crs)
    return replace(map_, georeference=georeference)


def up_in_world(trajectory: Trajectory, up: str, *, is_site: bool = False) -> Array:
    """(3,) unit vector against gravity, by the rule ``up`` of ExportOptions.

    Raises:
        InputError: the photos disagree about it or are all level with the path's plane, the path is not flat, or it is
            no direction.
    """
    if up == "auto" and is_site:
        return np.array([0.0, 0.0, 1.0])
    photos_up = -trajectory.world_from_cam[:, :, 1].mean(axis=0)
    if up in ("auto", "cameras"):
        if np.linalg.norm(photos_up) < _MIN_AGREEMENT:
            raise InputError("the photos do not agree what is up: say it (--up path, or --up X,Y,Z)")
        return _unit(photos_up)
    if up == "path":
        shape = path_shape(trajectory.centers)
        if shape.stddevs[2] > _MAX_ROUGHNESS * shape.stddevs[1]:
            raise InputError("the path does not lie in a plane: say what is up (--up cameras, or --up X,Y,Z)")
        normal = shape.axes[:, 2]
        if abs(normal @ photos_up) < _MIN_LEAN:
            raise InputError("the photos do not say which side of the path's plane is up: say it (--up X,Y,Z)")
        return _unit(normal if normal @ photos_up > 0 else -normal)
    return _unit(np.array(direction(up)))


def direction(text: str) -> tuple[float, float, float]:
    """Three numbers that are not all 0; InputError for anything else."""
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


def _level_from_world(map_: MetricMap, up: str) -> Array:
    """(3, 3) rotation: z up, y as the first camera looks (its upper edge, where it looks down)."""
    vertical = up_in_world(map_.trajectory, up, is_site=map_.is_site)
    first = map_.trajectory.world_from_cam[0]
    for ahead in (first[:, 2], -first[:, 1]):
        level = ahead - (ahead @ vertical) * vertical
        if np.linalg.norm(level) > _NEARLY_VERTICAL:
            break
    y = _unit(level)
    return np.stack([np.cross(y, vertical), y, vertical])
