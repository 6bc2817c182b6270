"""Tests of control and check points against a map that ranges hold, too, by the covariance of all their residuals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from scipy import special
from scipy.linalg import block_diag, solve_triangular

from rangesfm.arrays import Array
from rangesfm.diagnostics.diagnosis import Diagnosis
from rangesfm.diagnostics.hypothesis import in_axes
from rangesfm.diagnostics.hypothesis_tests import MistakeTest
from rangesfm.diagnostics.position_tests import LOOK_AGAIN, row_of_mistake
from rangesfm.distances.map_points import MapPoint, MapPoints
from rangesfm.distances.tape import CHECK, CONTROL
from rangesfm.geometry.map_errors import MapErrors
from rangesfm.geometry.similarity import similarity_motions
from rangesfm.positions.control_points import ControlPoint, ControlPoints, marks_seen
from rangesfm.processes.threads import with_one_blas_thread
from rangesfm.scale.position_equations import MistakeInPositions
from rangesfm.scale.scale_by_positions import POINT_FALSE_ALARM_RATE

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

    def of(self, points: Sequence[MapPoint]) -> Array:
        """Return the (3 k, 3 k) covariance of points of a map that is not refined."""
        own = [point.errors.own_m2 + self.bent_by_m**2 / 3 * np.eye(3) for point in points]
        return np.asarray(block_diag(*own) + self.of_place(points))


@with_one_blas_thread
def diagnose_points(
    points: ControlPoints | None,
    model: pycolmap.Reconstruction,
    errors: MapErrors | None,
    scale_stddev: float,
    placed: Placed,
) -> Diagnosis:
    """Test whether each point, and all of them together, are where the map has them; empty if there are none.

    The residuals have the covariance of the coordinates as stated, of the marks in the photos, and of the map, whose
    errors all points share. For control points, which pull the map towards themselves, that is more than their
    residuals have, so that a correct one is named more rarely still.

    Args:
        points: those left out already are not tested. model: the final one, in the site.
        errors: of the refined map; None if it is not refined, or has none: those of ``placed``.
        scale_stddev: as for ``MapErrors.joint``.
    """
    if points is None:
        return Diagnosis((), ())
    is_seen = marks_seen(points, model)
    tested = [of for of, seen in zip(points.points, is_seen, strict=True) if seen and of.kind in (CONTROL, CHECK)]
    if not tested:
        return Diagnosis((), ())
    finder = MapPoints(model, {}, points.markers, np.nan, points.markers_path or points.path)
    found = [finder.find_marker(of.name) for of in tested]
    of_map = placed.of(found) if errors is None else errors.joint([at.errors for at in found], scale_stddev)[0]
    if errors is not None and placed.by_antenna:  # the errors of the refined map have none that last
        of_map = of_map + placed.of_place(found)
    own = np.repeat([of.stddev_m**2 for of in tested], 3)
    off_m = np.ravel([at.position_m - of.position_m for of, at in zip(tested, found, strict=True)])
    root = np.asarray(np.linalg.cholesky(np.diag(own) + of_map), dtype=np.float64)
    rows = _tested(_Residuals(off_m, root), tested)
    reasons = tuple(f"{row.words} ({np.sqrt(row.statistic):.0f} stddevs): {row.remedy}" for row in rows if row.rejected)
    return Diagnosis(tuple(rows), reasons)


@dataclass(frozen=True)
class _Residuals:
    """Residuals (3 k,) of points, in the map minus known, with the lower root (3 k, 3 k) of their covariance."""

    off_m: Array
    root: Array

    def mistake(self, columns: Array, others: Sequence[Array]) -> MistakeInPositions:
        """Estimate a mistake that changes the residuals by (3 k, 3) ``columns``, with others of any size beside it."""
        of_all = solve_triangular(self.root, np.hstack([columns, *others, self.off_m[:, None]]), lower=True)
        by, beside, off = of_all[:, :3], of_all[:, 3:-1], of_all[:, -1]
        if beside.size:
            basis = np.linalg.qr(beside)[0]
            by, off = (each - basis @ (basis.T @ each) for each in (by, off))
        values, vectors = np.linalg.eigh(by.T @ by)
        is_seen = values > _UNSEEN * np.trace(columns.T @ columns)
        root: Array = vectors[:, is_seen] / np.sqrt(values[is_seen])
        sizes = root @ (root.T @ (by.T @ off))
        statistic = float(np.sum((root.T @ (by.T @ off)) ** 2))
        return MistakeInPositions(sizes, root, statistic, np.zeros((7, 3)), bool(is_seen.all()))


# Information on a mistake of a metre, one over square metres, below which it is only rounding.
_UNSEEN = 1e-9


def _tested(residuals: _Residuals, points: Sequence[ControlPoint]) -> list[MistakeTest]:
    """Return the tests of all points and of their frame, those found first: one is taken off before the next is sought.

    A wrong point, and points that are all shifted alike, explain each other's residuals in part; the mistake with the
    largest statistic is the likeliest, as all have three numbers.
    """
    num = len(points)
    columns = [*np.eye(3 * num).reshape(3 * num, num, 3).transpose(1, 0, 2)]
    if num > 1:
        columns.append(np.tile(np.eye(3), (num, 1)))
    threshold = float(special.chdtri(3, POINT_FALSE_ALARM_RATE / len(columns)))
    found: dict[int, MistakeInPositions] = {}
    while True:
        beside = [columns[k] for k in found]
        left = {k: residuals.mistake(of, beside) for k, of in enumerate(columns) if k not in found}
        likeliest = max(left, key=lambda k: left[k].statistic)
        if left[likeliest].statistic <= threshold or len(found) == num - 1:
            break
        found[likeliest] = left[likeliest]
    order = [*found.items(), *sorted(left.items(), key=lambda item: -item[1].statistic)]
    return [_row(points[k] if k < num else None, mistake, threshold) for k, mistake in order]


def _row(point: ControlPoint | None, found: MistakeInPositions, threshold: float) -> MistakeTest:
    far = f"{np.linalg.norm(found.sizes):.2f} m from {{}} ({in_axes(found.sizes)})"
    if point is None:
        words = f"the map has all known points {far.format('their coordinates')}, alike"
        return row_of_mistake(_ALL, "", found, threshold, words, _ONE_FRAME)
    words = f"the map has the {point.kind} point {point.name} {far.format('its coordinates')}"
    row = row_of_mistake(f"{point.kind} point in the map", point.name, found, threshold, words, LOOK_AGAIN)
    return row if point.kind == CHECK else replace(row, effect_on_scale=None)
