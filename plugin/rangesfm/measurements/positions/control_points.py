"""Marks with known coordinates: control points, which hold the map in the site, and check points, which test it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import csr_array

from rangesfm.arrays import Array
from rangesfm.measurements.kind import by_all_poses
from rangesfm.measurements.lengths.tape import CONTROL, Marker
from rangesfm.measurements.places import AntennaPlaces
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.positions.known_positions import KnownPositions
from rangesfm.util.geometry.trajectory import Trajectory


@dataclass(frozen=True)
class ControlPoint:
    """A mark whose coordinates are known.

    Attributes:
        name: of its marker.
        position_m: (3,) in the site's frame, metres.
        stddev_m: standard deviation of each coordinate.
        kind: "control" (it holds the map), "check" (it is compared with the result) or "left out".
        line: in the file.
    """

    name: str
    position_m: Array
    stddev_m: float
    kind: str
    line: int


@dataclass(frozen=True)
class ControlPoints:
    """Marks with known coordinates, and where they are seen.

    Attributes:
        points: in the order of the file.
        markers: marks in photos, by name; a point without any is in no photo.
        stddevs_are_given: whether the file gives the standard deviations.
        crs: coordinate system named in the file; empty if there is none.
        path: the file, for messages.
        notes: lines for the user about how the file was read.
    """

    points: tuple[ControlPoint, ...] = ()
    markers: Mapping[str, Marker] = field(default_factory=dict)
    stddevs_are_given: bool = True
    crs: str = ""
    path: Path | None = None
    notes: tuple[str, ...] = ()

    @property
    def positions_m(self) -> Array:
        """(k, 3) coordinates of all points."""
        return np.array([point.position_m for point in self.points]).reshape(-1, 3)

    def moved_to(self, positions_m: Array) -> ControlPoints:
        """Return the points with other coordinates (k, 3)."""
        moved = (replace(point, position_m=at) for point, at in zip(self.points, positions_m, strict=True))
        return replace(self, points=tuple(moved))

    def with_more(self, markers: Mapping[str, Marker]) -> ControlPoints:
        """Return the points with more markers; their own are kept where a new one has an equal name."""
        return replace(self, markers={**markers, **self.markers})

    def without(self, names: Sequence[str]) -> ControlPoints:
        """Return the points with those of these names marked as left out."""
        points = (replace(point, kind="left out") if point.name in names else point for point in self.points)
        return replace(self, points=tuple(points))


def locate_points(points: ControlPoints, model: pycolmap.Reconstruction, path: Trajectory) -> KnownPositions:
    """Find the marks of control and check points in a model, which must show them as of ``NamedPoints.is_shown``.

    Args:
        points: in the site; those that the model does not show are left out.
        model: in any world. path: of its keyframes, in the same world.

    Raises:
        InputError: the marks of a point are not of one point, or are seen from one direction only.
    """
    named = NamedPoints.in_model(model, points.markers, first_ids=path.frame_ids)
    k = len(seen := [point for point in points.points if named.is_shown(point.name)])
    found = [named.find_mark(point.name) for point in seen]
    at = named.linearized(named.state, [each.position_m for each in found], [[(np.eye(3), each)] for each in found])
    stddev_m = np.array([point.stddev_m for point in seen])
    return KnownPositions(
        names=tuple(point.name for point in seen),
        is_mark=np.ones(k, dtype=bool),
        is_check=np.array([point.kind != CONTROL for point in seen], dtype=bool),
        position_m=np.array([point.position_m for point in seen]).reshape(-1, 3),
        covariance_m2=stddev_m[:, None, None] ** 2 * np.eye(3),
        places=at.residual.reshape(-1, 3),
        arms_m=np.zeros((k, 3)),
        own_covariance=np.array([each.own_m2 for each in found]).reshape(-1, 3, 3),
        arm_stddev_m=np.zeros(k),
        time_s=np.full(k, np.nan),
        velocity=np.zeros((k, 3)),
        world_from_cam=np.zeros((k, 3, 3)),
        by_pose=by_all_poses(at.pose, at.by_pose, len(path)),
        arms_by_pose=csr_array((3 * k, 6 * len(path))),
        on_path=AntennaPlaces.nowhere(k),
    )
