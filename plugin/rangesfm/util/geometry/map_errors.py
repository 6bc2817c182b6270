"""Joint errors of the parts of a map: what is needed for the precision of one point relative to another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.linalg import block_diag

from rangesfm.arrays import Array, Indices

Kind = Literal["frame", "camera", "sensor", "anchor", "mark"]
Part = tuple[Kind, int | str]
"""A part of a map: its kind, and its COLMAP id or the name of the anchor or mark. A sensor has the id of its camera.

Marks are parts only in a fit of which they are parameters."""


@dataclass(frozen=True)
class PartErrors:
    """Errors of k parts of one kind, each in d numbers.

    The numbers of a frame are a turn of its rig about the axes of the world (rotation vector, radians) and a shift of
    the rig's origin (metres). Those of a sensor are a turn (left rotation vector) and a shift of sensor_from_rig, those
    of a camera its parameters, those of an anchor a shift (metres).

    Attributes:
        ids: (k,) COLMAP ids, or ids of anchors.
        modes: (k, d, r) change by one standard deviation of each of r independent causes, which all parts share.
        rests: (k, d, d) covariance of what no cause explains; it is independent from part to part.
        by_scale: (k, d) expected change where the logarithm of the map's scale changes by 1.
    """

    ids: tuple[int, ...] | tuple[str, ...]
    modes: Array
    rests: Array
    by_scale: Array

    @cached_property
    def row_of(self) -> dict[int | str, int]:
        """Return the row of each part by its id."""
        ids: tuple[int | str, ...] = self.ids
        return {id_: row for row, id_ in enumerate(ids)}


@dataclass(frozen=True)
class MapPoint:
    """A point of a map, and how it errs.

    Attributes:
        position_m: (3,) in the world of the map.
        by_part: (3, d) change of the point, in metres, by each part that it depends on.
        own_m2: (3, 3) covariance of the error that only this point has.
    """

    position_m: Array
    by_part: Mapping[Part, Array]
    own_m2: Array


@dataclass(frozen=True)
class MapErrors:
    """Joint errors of all parts of a map.

    The covariance of all numbers of all parts is ``modes @ modes.T``, with the modes of all parts as rows, plus the
    rests on its diagonal.

    Attributes:
        parts: by kind; empty where it is not known how they err.
        scale_stddev: standard deviation of the logarithm of the map's scale in this covariance.
    """

    parts: Mapping[Kind, PartErrors]
    scale_stddev: float

    @property
    def are_known(self) -> bool:
        """Return whether it is known how the parts err."""
        return len(self.parts) > 0

    def covariances(self, kind: Kind) -> Array:
        """Return the (k, d, d) covariance of each part of a kind; (0, 0, 0) without any."""
        if (parts := self.parts.get(kind)) is None:
            return np.zeros((0, 0, 0))
        return np.asarray(parts.modes @ np.swapaxes(parts.modes, 1, 2) + parts.rests)

    def centers_m2(self, frame_ids: Indices) -> Array:
        """Return the (n, 3, 3) covariances of the origins of some frames."""
        rows = [self.parts["frame"].row_of[frame_id] for frame_id in frame_ids.tolist()]
        return np.asarray(self.covariances("frame")[rows, 3:, 3:])

    def relative(self, first: MapPoint, second: MapPoint, scale_stddev: float) -> Array:
        """Return how a point errs relative to another one.

        Args:
            scale_stddev: standard deviation of the logarithm of the map's scale as it is stated. It replaces the one
                that this covariance implies; how the map errs at a given scale stays as it is.

        Returns:
            (3, 3) covariance of second minus first in square metres.
        """
        apart = np.hstack([-np.eye(3), np.eye(3)])
        return np.asarray(apart @ self.joint([first, second], scale_stddev) @ apart.T)

    def joint(self, points: Sequence[MapPoint], scale_stddev: float) -> Array:
        """Return how k points err together in the world; arguments and values as for ``relative``.

        Returns:
            (3 k, 3 k) covariance of their coordinates.
        """
        by_part: dict[Part, Array] = {}
        for part in dict.fromkeys(part for point in points for part in point.by_part):
            num = next(point.by_part[part].shape[1] for point in points if part in point.by_part)
            nothing = np.zeros((3, num))  # cameras of other models have more parameters
            by_part[part] = np.vstack([point.by_part.get(part, nothing) for point in points])
        by_scale = np.zeros(3 * len(points))
        for (kind, id_), slope in by_part.items():
            errors = self.parts[kind]
            by_scale += slope @ errors.by_scale[errors.row_of[id_], : slope.shape[1]]
        covariance = block_diag(*(point.own_m2 for point in points)) + self.propagated(by_part)
        return np.asarray(covariance + (scale_stddev**2 - self.scale_stddev**2) * np.outer(by_scale, by_scale))

    def propagated(self, by_part: Mapping[Part, Array]) -> Array:
        """Return the (m, m) covariance of m numbers, given their (m, d) derivatives by each part on which they depend.

        A part may have more than d numbers, of which the first are meant.
        """
        by_mode, of_rests = [], []
        for (kind, id_), slope in by_part.items():
            errors, num = self.parts[kind], slope.shape[1]
            row = errors.row_of[id_]
            by_mode.append(slope @ errors.modes[row, :num])
            of_rests.append(slope @ errors.rests[row, :num, :num] @ slope.T)
        modes = np.sum(by_mode, axis=0)
        return np.asarray(modes @ modes.T + np.sum(of_rests, axis=0))


UNKNOWN_ERRORS = MapErrors({}, np.nan)
