"""Points are compared with a map by the covariance of all their residuals, so that what they share is told apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
import pytest
from scipy import stats
from scipy.spatial.transform import Rotation
from tests.conftest import SITE_M, WalkedSurvey

from rangesfm.arrays import Array
from rangesfm.colmap.transform import rescale
from rangesfm.diagnostics.diagnosis import Diagnosis
from rangesfm.diagnostics.hypothesis_tests import MistakeTest
from rangesfm.diagnostics.point_tests import Placed, _tested, diagnose_points
from rangesfm.distances.map_points import MapPoint
from rangesfm.distances.tape import CLICKED_STDDEV_PX, Marker
from rangesfm.geometry.map_errors import MapPointErrors
from rangesfm.positions.control_points import ControlPoint, ControlPoints

STDDEV_M, NUM_POINTS = 0.01, 6


@dataclass(frozen=True)
class Marked:
    """A map in the site without errors, and marks of points that it shows."""

    model: pycolmap.Reconstruction
    markers: Mapping[str, Marker]
    true_m: Array

    def diagnosis(
        self, seed: int, wrong_m: Array | None = None, placed_stddev: float = 0.0, kind: str = "check"
    ) -> Diagnosis:
        """Test points that were surveyed with errors, in a map whose scale, turn and shift are known so well."""
        at_m = self.true_m + STDDEV_M * np.random.default_rng(seed).standard_normal(self.true_m.shape)
        at_m = at_m if wrong_m is None else at_m + wrong_m
        points = tuple(ControlPoint(f"M{k}", at, STDDEV_M, kind, k + 2) for k, at in enumerate(at_m))
        placed = Placed(placed_stddev**2 * np.eye(7), np.array(SITE_M), 0.0)
        return diagnose_points(ControlPoints(points, self.markers), self.model, None, 0.0, placed)


@pytest.fixture(scope="module")
def marked(walked_survey: WalkedSurvey) -> Marked:
    model = rescale(pycolmap.Reconstruction(walked_survey.folder / "sparse" / "0"), walked_survey.site_from_sfm)
    seen = [i for i in sorted(model.point3D_ids()) if model.point3D(i).track.length() >= 5][::20]
    markers = {}
    for k, point_id in enumerate(seen[:NUM_POINTS]):
        images = [model.image(element.image_id) for element in model.point3D(point_id).track.elements]
        pixels = [image.project_point(model.point3D(point_id).xyz) for image in images]
        names = tuple(image.name for image in images)
        markers[f"M{k}"] = Marker(names, np.array(pixels), (0,) * len(names), CLICKED_STDDEV_PX)
    return Marked(model, markers, np.array([model.point3D(i).xyz for i in seen[:NUM_POINTS]]))


def test_points_of_a_map_that_is_not_refined_are_as_far_off_as_it_is_bent() -> None:
    exact = MapPoint("M", np.zeros(3), MapPointErrors({}, np.zeros((3, 3))))
    found = Placed(np.zeros((7, 7)), np.zeros(3), bent_by_m=0.3).of([exact])
    assert np.trace(found) == pytest.approx(0.3**2)


def one_off(row: int, off_m: float) -> Array:
    wrong_m = np.zeros((NUM_POINTS, 3))
    wrong_m[row] = [0, 0, off_m]
    return wrong_m


@pytest.mark.parametrize("placed_stddev", [0.0, 0.3])
def test_a_wrong_point_is_named_however_loosely_the_map_is_placed(placed_stddev: float, marked: Marked) -> None:
    found = marked.diagnosis(1, one_off(2, 1.0), placed_stddev)
    assert [(test.name, test.subject) for test in found.tests if test.rejected] == [("check point in the map", "M2")]
    assert found.tests[0].size == pytest.approx(1.0, abs=0.3)
    assert len(found.reasons) == 1
    assert "the map has the check point M2" in found.reasons[0]


def test_two_wrong_points_are_both_named(marked: Marked) -> None:
    found = marked.diagnosis(1, one_off(2, 1.0) + one_off(4, -1.5))
    assert {test.subject for test in found.tests if test.rejected} == {"M2", "M4"}


def test_points_in_another_frame_are_told_as_one_mistake(marked: Marked) -> None:
    found = marked.diagnosis(1, np.tile([0.5, -0.3, 0.2], (NUM_POINTS, 1)))
    assert [(test.name, test.subject) for test in found.tests if test.rejected] == [("frame of the points", "")]
    assert "the map has all known points 0.6" in found.reasons[0]
    assert "(-0.5" in found.reasons[0]


def test_what_the_stated_errors_explain_is_not_named(marked: Marked) -> None:
    assert not any(marked.diagnosis(seed).reasons for seed in range(4))


def test_a_single_point_is_tested_and_no_point_is_none(marked: Marked) -> None:
    alone = ControlPoint("M0", marked.true_m[0] + [0, 0, 3.0], STDDEV_M, "control", 2)
    placed = Placed(1e-6 * np.eye(7), np.array(SITE_M), 0.0)
    found = diagnose_points(ControlPoints((alone,), marked.markers), marked.model, None, 0.0, placed)
    assert [test.rejected for test in found.tests] == [True]
    assert found.tests[0].effect_on_scale is None
    unseen = ControlPoints((ControlPoint("elsewhere", np.zeros(3), STDDEV_M, "check", 2),))
    assert diagnose_points(unseen, marked.model, None, 0.0, placed).tests == ()


def points_at(*places_m: Sequence[float], own_stddev_m: float = 0.0) -> list[MapPoint]:
    own_m2 = own_stddev_m**2 * np.eye(3)
    return [MapPoint(f"P{k}", np.array(at_m), MapPointErrors({}, own_m2)) for k, at_m in enumerate(places_m)]


def test_points_of_a_map_that_is_right_but_for_its_place_err_together() -> None:
    """The map may be scaled and turned about the first camera, and shifted: its points move as these say."""
    first_m, places_m = np.array([1.0, -2.0, 3.0]), np.array([[4.0, 0, 3], [0, 5, -1]])
    root = 1e-5 * np.random.default_rng(0).standard_normal((7, 7))
    found = Placed(root @ root.T, first_m, 0.0).of_place(points_at(*places_m))
    moves = []
    for step in root.T:
        turn = Rotation.from_rotvec(step[1:4]).as_matrix()
        moved_m = first_m + np.exp(step[0]) * (places_m - first_m) @ turn.T + step[4:]
        moves.append((moved_m - places_m).ravel())
    np.testing.assert_allclose(found, np.array(moves).T @ np.array(moves), rtol=1e-3, atol=1e-13)


def test_own_errors_and_the_bending_of_points_are_independent() -> None:
    shift = np.diag([0, 0, 0, 0, 0.2, 0, 0]) ** 2
    found = Placed(shift, np.zeros(3), 0.3).of(points_at([1, 0, 0], [0, 2, 0], own_stddev_m=0.1))
    shared = np.zeros((6, 6))
    shared[np.ix_([0, 3], [0, 3])] = 0.04
    np.testing.assert_allclose(found, shared + (0.01 + 0.03) * np.eye(6))


def rows_of(off_m: Sequence[Sequence[float]], kind: str = "check") -> list[MistakeTest]:
    """Test points P0, P1, ... that the map has so far from their coordinates; each errs by 0.1 m."""
    points = [ControlPoint(f"P{k}", np.zeros(3), 0.01, kind, k) for k in range(len(off_m))]
    return _tested(np.ravel(off_m), 0.1**2 * np.eye(3 * len(off_m)), points)


def rejected(rows: Sequence[MistakeTest]) -> list[str]:
    return [row.subject or row.name for row in rows if row.rejected]


NONE_M = [0.0, 0.0, 0.0]


def test_one_point_alone_is_tested_without_its_frame() -> None:
    (row,) = rows_of([[0.3, 0.0, -0.4]])
    assert row.statistic == pytest.approx(25.0)
    assert row.threshold == pytest.approx(stats.chi2.isf(0.02, 3))
    assert row.words == "the map has the check point P0 0.50 m from its coordinates (+0.30, +0.00, -0.40 m)"
    assert (row.name, row.subject, row.unit) == ("check point in the map", "P0", "m")
    assert row.rejected


def test_points_and_their_frame_share_the_rate_of_false_alarms() -> None:
    rows = rows_of([NONE_M] * 4)
    assert len(rows) == 5
    assert all(row.threshold == pytest.approx(stats.chi2.isf(0.02 / 5, 3)) for row in rows)
    assert sorted(row.subject for row in rows) == ["", "P0", "P1", "P2", "P3"]


def test_a_point_is_named_from_the_threshold_on() -> None:
    """Its statistic is its squared error in stddevs, as points and map err independently."""
    threshold = float(stats.chi2.isf(0.02 / 4, 3))
    for factor, names in ((0.99, []), (1.01, ["P1"])):
        off_m = 0.1 * np.sqrt(factor * threshold)
        rows = rows_of([NONE_M, [0.0, off_m, 0.0], NONE_M])
        assert rejected(rows) == names
        assert rows[0].subject == "P1"  # the likeliest comes first in either case


def test_points_that_are_off_are_named_one_after_the_other_the_worst_first() -> None:
    off_m = [NONE_M, [0, 0, 2.0], NONE_M, [0, 3.0, 0], NONE_M, NONE_M]
    rows = rows_of(off_m)
    assert rejected(rows) == ["P3", "P1"]
    assert [row.size for row in rows[:2]] == [pytest.approx(3.0), pytest.approx(2.0)]
    # Those that were not found are tested beside those that were, and follow by their statistics.
    assert [row.statistic for row in rows[2:]] == sorted((row.statistic for row in rows[2:]), reverse=True)
    assert max(row.statistic for row in rows[2:]) < 1e-9


def test_a_shift_of_all_points_is_named_as_such_and_a_wrong_point_beside_it() -> None:
    shifted_m = np.tile([0.5, -0.25, 1.0], (6, 1))
    rows = rows_of(shifted_m.tolist())
    assert rejected(rows) == ["frame of the points"]
    assert rows[0].words == (
        "the map has all known points 1.15 m from their coordinates (+0.50, -0.25, +1.00 m), alike"
    )
    assert rows[0].effect_on_scale == 0.0
    assert "in one frame" in rows[0].remedy
    shifted_m[2] += [0.0, 0.8, 0.0]
    rows = rows_of(shifted_m.tolist())
    assert rejected(rows) == ["frame of the points", "P2"]
    assert rows[1].size == pytest.approx(0.8)


@pytest.mark.parametrize("off_m", [[[0, 0, 9.0], [5.0, 0, 0]], [[0, 0, 9.0], [0, -7.0, 0], [5.0, 0, 0]]])
def test_the_last_point_and_the_frame_explain_the_same_if_all_others_are_wrong(off_m: list[list[float]]) -> None:
    """So neither of them is taken off before the other is tested."""
    rows = rows_of(off_m)
    assert rejected(rows[: len(off_m) - 1]) == [f"P{k}" for k in range(len(off_m) - 1)]
    last = rows[len(off_m) - 1 :]
    assert {row.subject for row in last} == {"", f"P{len(off_m) - 1}"}
    assert [row.statistic for row in last] == [pytest.approx(50.0**2)] * 2


def test_a_check_point_moves_no_scale_and_of_a_control_point_it_is_not_known() -> None:
    assert {row.effect_on_scale for row in rows_of([NONE_M] * 3, kind="check")} == {0.0}
    of_control = rows_of([NONE_M] * 3, kind="control")
    assert {row.effect_on_scale for row in of_control if row.subject} == {None}
    assert {row.name for row in of_control} == {"control point in the map", "frame of the points"}
