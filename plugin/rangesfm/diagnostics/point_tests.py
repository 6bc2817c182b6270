"""Tests of control and check points against a map that ranges hold, too, by the covariance of all their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from scipy import special
from scipy.linalg import block_diag

from rangesfm.arrays import Array
from rangesfm.measurements.lengths.tape import CHECK, CONTROL
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.positions.control_points import ControlPoint, ControlPoints
from rangesfm.measurements.positions.known_positions import LOOK_AGAIN
from rangesfm.solver.linear_map import FALSE_ALARM_RATE, EstimatedMistake, Solved
from rangesfm.solver.mistakes import MistakeTest, MistakeTests, in_axes, row_of_mistake
from rangesfm.util.geometry.map_errors import MapErrors, MapPoint
from rangesfm.util.geometry.similarity import similarity_motions
from rangesfm.util.processes.threads import with_one_blas_thread

_ONE_FRAME = "look whether points and anchors are in one frame, and measured to the same height of the antennas"
_ALL = "frame of the points"


@dataclass(frozen=True)
class Placed:
    """Errors of a map's place in the site.

    Attributes:
        covariance: (7, 7) of the logarithm of the scale, a turn and a shift about the first camera.
        first_camera_m: (3,) its centre in the site. bent_by_m: how far a map that is not refined may be bent.
        by_antenna: whether positions of an antenna place the map, whose errors may last for long.
    """

    covariance: Array
    first_camera_m: Array
    bent_by_m: float
    by_antenna: bool = False

    def of_place(self, points: Sequence[MapPoint]) -> Array:
        """Return the (3 k, 3 k) covariance of points of a map that is right but for its place and its scale."""
        at_m = np.array([point.position_m for point in points])
        by_map = similarity_motions(at_m - self.first_camera_m).reshape(-1, 7)
        return np.asarray(by_map @ self.covariance @ by_map.T)

    def joint(self, points: Sequence[MapPoint]) -> Array:
        """Return the (3 k, 3 k) covariance of points of a map that is not refined."""
        own = [point.own_m2 + self.bent_by_m**2 / 3 * np.eye(3) for point in points]
        return np.asarray(block_diag(*own) + self.of_place(points))


@with_one_blas_thread
def diagnose_points(
    points: ControlPoints,
    model: pycolmap.Reconstruction,
    errors: MapErrors,
    scale_stddev: float,
    placed: Placed,
) -> MistakeTests:
    """Test whether each point, and all of them together, are where the map has them; empty if there are none.

    The residuals have the covariance of the coordinates as stated, of the marks in the photos, and of the map, whose
    errors all points share. For control points, which pull the map towards themselves, that is more than their
    residuals have, so that a correct one is named more rarely still.

    Args:
        points: those left out already are not tested. model: the final one, in the site.
        errors: of the refined map; where they are not known: those of ``placed``.
        scale_stddev: as for ``MapErrors.joint``.
    """
    named = NamedPoints.in_model(model, points.markers)
    tested = [of for of in points.points if named.is_shown(of.name) and of.kind in (CONTROL, CHECK)]
    if not tested:
        return MistakeTests()
    found = [named.find_mark(of.name) for of in tested]
    of_map = errors.joint(found, scale_stddev) if errors.are_known else placed.joint(found)
    if errors.are_known and placed.by_antenna:  # the errors of the refined map have none that last
        of_map = of_map + placed.of_place(found)
    own = np.repeat([of.stddev_m**2 for of in tested], 3)
    off_m = np.ravel([at.position_m - of.position_m for of, at in zip(tested, found, strict=True)])
    rows = _tested(off_m, np.diag(own) + of_map, tested)
    reasons = tuple(f"{row.words} ({np.sqrt(row.statistic):.0f} stddevs): {row.remedy}" for row in rows if row.rejected)
    return MistakeTests(tuple(rows), reasons, of_place=reasons)


def _tested(off_m: Array, covariance_m2: Array, points: Sequence[ControlPoint]) -> list[MistakeTest]:
    """Return the tests of all points and of their frame, those found first: one is taken off before the next is sought.

    A wrong point, and points that are all shifted alike, explain each other's residuals in part; the mistake with the
    largest statistic is the likeliest, as all have three numbers.

    Args:
        off_m: (3 k,) points in the map minus known ones. covariance_m2: (3 k, 3 k).
    """
    num = len(points)
    columns = [*np.eye(3 * num).reshape(3 * num, num, 3).transpose(1, 0, 2)]
    if num > 1:
        columns.append(np.tile(np.eye(3), (num, 1)))
    threshold = float(special.chdtri(3, FALSE_ALARM_RATE / len(columns)))
    found: dict[int, EstimatedMistake] = {}
    while True:
        beside = np.hstack([np.zeros((3 * num, 0)), *(columns[k] for k in found)])
        others = Solved(covariance_m2, beside, off_m)
        left = {k: others.mistake(of) for k, of in enumerate(columns) if k not in found}
        likeliest = max(left, key=lambda k: left[k].statistic)
        if left[likeliest].statistic <= threshold or len(found) == num - 1:
            break
        found[likeliest] = left[likeliest]
    order = [*found.items(), *sorted(left.items(), key=lambda item: -item[1].statistic)]
    return [_row(points[k] if k < num else None, mistake, threshold) for k, mistake in order]


def _row(point: ControlPoint | None, found: EstimatedMistake, threshold: float) -> MistakeTest:
    far = f"{np.linalg.norm(found.sizes):.2f} m from {{}} ({in_axes(found.sizes)})"
    if point is None:
        words = f"the map has all known points {far.format('their coordinates')}, alike"
        return replace(row_of_mistake(_ALL, "", found, threshold, words, _ONE_FRAME), effect_on_scale=0.0)
    words = f"the map has the {point.kind} point {point.name} {far.format('its coordinates')}"
    row = row_of_mistake(f"{point.kind} point in the map", point.name, found, threshold, words, LOOK_AGAIN)
    return replace(row, effect_on_scale=0.0 if point.kind == CHECK else np.nan)
