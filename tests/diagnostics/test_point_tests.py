"""Points are compared with a map by the covariance of all their residuals, so that what they share is told apart."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
import pytest
from tests.conftest import SITE_M, WalkedSurvey

from rangesfm.arrays import Array
from rangesfm.colmap.transform import rescale
from rangesfm.diagnostics.point_tests import Placed, diagnose_points
from rangesfm.measurements.lengths.tape import CLICKED_STDDEV_PX, Marker
from rangesfm.measurements.positions.control_points import ControlPoint, ControlPoints
from rangesfm.solver.mistakes import MistakeTest, MistakeTests
from rangesfm.util.geometry.map_errors import UNKNOWN_ERRORS, MapPoint

STDDEV_M, NUM_POINTS = 0.01, 6


@dataclass(frozen=True)
class Marked:
    """A map in the site without errors, and marks of points that it shows."""

    model: pycolmap.Reconstruction
    markers: Mapping[str, Marker]
    true_m: Array

    def diagnosis(
        self, seed: int, wrong_m: Array | None = None, placed_stddev: float = 0.0, kind: str = "check"
    ) -> MistakeTests:
        """Test points that were surveyed with errors, in a map whose scale, turn and shift are known so well."""
        at_m = self.true_m + STDDEV_M * np.random.default_rng(seed).standard_normal(self.true_m.shape)
        at_m = at_m if wrong_m is None else at_m + wrong_m
        points = tuple(ControlPoint(f"M{k}", at, STDDEV_M, kind, k + 2) for k, at in enumerate(at_m))
        placed = Placed(placed_stddev**2 * np.eye(7), np.array(SITE_M), 0.0)
        return diagnose_points(ControlPoints(points, self.markers), self.model, UNKNOWN_ERRORS, 0.0, placed)


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
    exact = MapPoint(np.zeros(3), {}, np.zeros((3, 3)))
    found = Placed(np.zeros((7, 7)), np.zeros(3), bent_by_m=0.3).joint([exact])
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
    found = diagnose_points(ControlPoints((alone,), marked.markers), marked.model, UNKNOWN_ERRORS, 0.0, placed)
    assert [test.rejected for test in found.tests] == [True]
    assert np.isnan(found.tests[0].effect_on_scale)
    unseen = ControlPoints((ControlPoint("elsewhere", np.zeros(3), STDDEV_M, "check", 2),))
    assert diagnose_points(unseen, marked.model, UNKNOWN_ERRORS, 0.0, placed).tests == ()


def rejected(rows: Sequence[MistakeTest]) -> list[str]:
    return [row.subject or row.name for row in rows if row.rejected]
