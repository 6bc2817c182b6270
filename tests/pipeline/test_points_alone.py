"""A map in the site by control points alone: held by them, tested by check points, and beside ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from tests.conftest import WalkedSurvey
from tests.known import assert_scale, known
from tests.simulated.files import write_marks
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.errors import GeometryError, InputError
from rangesfm.pipeline.run import refine_model, scale_model
from rangesfm.progress import Progress
from rangesfm.result.summary import ResultSummary
from rangesfm.survey.settings import Survey

Array = npt.NDArray[np.float64]
QUIET = Progress()
POINT_STDDEV_M, NUM_POINTS = 0.005, 8
FAR_M = np.array([2_600_000.0, 1_200_000.0, 400.0])


@dataclass(frozen=True)
class Yard:
    """A model with points, marks of some of them in photos, and their true coordinates."""

    folder: Path
    made: SyntheticModel
    marks_m: Mapping[str, Array]

    def survey(self, where: Path, points: str, **values: object) -> Survey:
        """Return a survey with these rows of coordinates."""
        path = where / "points.csv"
        path.write_text(f"marker,x_m,y_m,z_m,stddev_m,kind\n{points}")
        given = {key.replace("__", "."): value for key, value in values.items()}
        base = {"images.model": self.folder / "sparse", "output.path": where / "out", "points.path": path}
        return Survey().changed({**base, "scale.markers": self.folder / "markers.csv", **given})

    def rows(self, kinds: Sequence[str], offset_m: Array | None = None, **wrong_m: float) -> str:
        """Return rows of coordinates, accurate to 5 mm; ``wrong_m`` is added to the heights of points by name."""
        rng, lines = np.random.default_rng(3), ""
        for kind, (name, true_m) in zip(kinds, self.marks_m.items(), strict=False):
            at = true_m + POINT_STDDEV_M * rng.standard_normal(3) + [0, 0, wrong_m.get(name, 0.0)]
            at = at if offset_m is None else at + offset_m
            lines += f"{name},{at[0]:.4f},{at[1]:.4f},{at[2]:.4f},{POINT_STDDEV_M},{kind}\n"
        return lines


@pytest.fixture(scope="module")
def yard(tmp_path_factory: pytest.TempPathFactory) -> Yard:
    """Simulate fourteen photos on a loop, with marks clicked to half a pixel."""
    path, rng = loop_path(20.0, height_amplitude_m=0.5, seed=1), np.random.default_rng(5)
    photos = along(path, np.arange(0.0, 20.0, 1.5))
    made = synthetic_model(*photos, num_observations=120, pixel_stddev=0.5, seed=2)
    folder = tmp_path_factory.mktemp("yard")
    model = made.reconstruction
    (folder / "sparse").mkdir()
    model.write(folder / "sparse")
    seen = [i for i in sorted(model.point3D_ids()) if model.point3D(i).track.length() >= 4]
    true_m = _true_points(made, seen)
    near = [i for i in seen if np.linalg.norm(true_m[i] - made.centers_m.mean(axis=0)) < 10]
    marked = {f"M{k}": i for k, i in enumerate(rng.choice(near, NUM_POINTS, replace=False).tolist())}
    write_marks(folder / "markers.csv", model, marked)
    return Yard(folder, made, {name: true_m[point_id] for name, point_id in marked.items()})


def _true_points(made: SyntheticModel, ids: Sequence[int]) -> dict[int, Array]:
    """Return the true positions of points, which the model has exactly, in metres."""
    model = made.reconstruction
    return {i: made.metric_from_sfm.apply(model.point3D(i).xyz[None])[0] for i in ids}


def test_control_points_place_the_map_in_the_site_and_check_points_test_it(yard: Yard, tmp_path: Path) -> None:
    survey = yard.survey(tmp_path, yard.rows(["control"] * 5 + ["check"] * 3, FAR_M))
    result = refine_model(survey, progress=QUIET)
    summary, points = result.summary, known(result.summary.points)
    assert_scale(summary, yard.made.metric_from_sfm.scale, 0.01)
    assert (summary.scale.verdict, summary.frame, summary.scale.method) == ("good", "site", "positions")
    assert known(summary.place).verdict == "good"
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse_metric" / "0")
    found = np.array([image.projection_center() for _, image in sorted((i.name, i) for i in model.images.values())])
    assert np.linalg.norm(found - yard.made.centers_m - FAR_M, axis=1).max() < 0.03
    assert [row.kind for row in points.points] == ["control"] * 5 + ["check"] * 3
    assert (points.control.num, points.check.num) == (5, 3)
    assert known(points.control.rmse_3d_m) < 0.03  # 9 mm of the survey, and the marks in the depth of the photos
    off = np.array([row.residual_m for row in points.points if row.kind == "check"])
    assert known(points.check.rmse_m) == pytest.approx(np.sqrt(np.mean(off**2, axis=0)))
    assert known(points.check.rmse_3d_m) < 0.05
    assert sorted(test.name for test in summary.tests) == ["check point"] * 3 + ["control point"] * 5
    assert not any(test.rejected for test in summary.tests)
    assert any(line.startswith("check points: 3, RMSE ") for line in result.lines)
    page = (survey.output.path / "report.html").read_text()
    assert "Control and check points" in page
    assert ResultSummary.read(survey.output.path / "result.json") == summary


def test_marks_whose_photos_are_spelt_otherwise_count_as_well(yard: Yard, tmp_path: Path) -> None:
    rows = yard.rows(["control"] * 8)
    (tmp_path / "markers.csv").write_text((yard.folder / "markers.csv").read_text().replace(".jpg", ".TIF"))
    values = []
    for markers in (yard.folder / "markers.csv", tmp_path / "markers.csv"):
        survey = yard.survey(tmp_path, rows, scale__markers=markers, report__enabled=False)
        values.append(scale_model(survey, progress=QUIET).summary.scale.value)
    assert values[0] == values[1]


def test_marks_in_photos_that_the_map_lacks_are_counted_and_named(yard: Yard, tmp_path: Path) -> None:
    text = (yard.folder / "markers.csv").read_text()
    first = sorted(image.name for image in yard.made.reconstruction.images.values())[0]
    (tmp_path / "markers.csv").write_text(text.replace(first, "other_7.jpg"))
    survey = yard.survey(
        tmp_path, yard.rows(["control"] * 8), scale__markers=tmp_path / "markers.csv", report__enabled=False
    )
    num = text.count(first)
    assert num
    summary = scale_model(survey, progress=QUIET).summary
    assert (
        f"{num} of {text.count('.jpg')} marks in markers.csv are of photos that are not in the map, such as "
        f"other_7.jpg; the map has {first}" in summary.warnings
    )


@pytest.mark.parametrize("run", [refine_model, scale_model])
def test_a_control_point_half_a_metre_off_is_named_and_left_out(yard: Yard, tmp_path: Path, run: object) -> None:
    assert callable(run)
    survey = yard.survey(tmp_path, yard.rows(["control"] * 6 + ["check"], M2=0.5), report__enabled=False)
    summary = run(survey, progress=QUIET).summary
    assert_scale(summary, yard.made.metric_from_sfm.scale, 0.01)
    assert (summary.tests[0].name, summary.tests[0].subject) == ("control point", "M2")
    assert known(summary.tests[0].size) == pytest.approx(0.5, abs=0.1)
    assert "probably the control point M2 is 0." in summary.scale.reasons[0]
    assert [row.kind for row in known(summary.points).points] == [
        *("control", "control", "left out", "control", "control", "control", "check")
    ]
    assert not any(test.rejected for test in summary.tests[1:])
    assert known(summary.place).verdict == "doubtful"
    assert known(summary.place).reasons == summary.scale.reasons


def test_a_check_point_that_is_not_where_the_map_has_it_makes_the_verdicts_doubtful(yard: Yard, tmp_path: Path) -> None:
    survey = yard.survey(tmp_path, yard.rows(["control"] * 5 + ["check"] * 2, M6=0.2), report__enabled=False)
    summary = scale_model(survey, progress=QUIET).summary
    assert_scale(summary, yard.made.metric_from_sfm.scale, 0.01)
    assert [(test.name, test.subject) for test in summary.tests if test.rejected] == [("check point", "M6")]
    assert (summary.scale.verdict, known(summary.place).verdict) == ("doubtful", "doubtful")
    assert "the check point M6 is 0.2" in known(summary.place).reasons[0]


def test_beside_ranges_a_check_point_is_compared_with_the_map_that_they_hold(
    walked_survey: WalkedSurvey, tmp_path: Path
) -> None:
    model = pycolmap.Reconstruction(walked_survey.folder / "sparse" / "0")
    chosen = [i for i in sorted(model.point3D_ids()) if model.point3D(i).track.length() >= 5][:100:20]
    points = "marker,x_m,y_m,z_m,stddev_m,kind\n"
    for k, point_id in enumerate(chosen):
        x_m, y_m, z_m = walked_survey.site_from_sfm.apply(model.point3D(point_id).xyz)
        points += f"M{k},{x_m},{y_m},{z_m + (k == 2)},0.01,check\n"
    write_marks(tmp_path / "marks.csv", model, {f"M{k}": point_id for k, point_id in enumerate(chosen)})
    (tmp_path / "points.csv").write_text(points)
    files = {"points.path": tmp_path / "points.csv", "scale.markers": tmp_path / "marks.csv"}
    survey = walked_survey.survey(tmp_path / "out").changed({**files, "report.enabled": False})
    summary = scale_model(survey, progress=QUIET).summary
    assert [(test.name, test.subject) for test in summary.tests if test.rejected] == [("check point", "M2")]
    assert known(summary.place).verdict == "doubtful"
    assert "the check point M2 is 1." in known(summary.place).reasons[0]
    assert not any("not used" in reason for reason in summary.scale.reasons)


@pytest.mark.parametrize("num", [1, 2])
def test_a_mistyped_length_beside_control_points_is_told_apart(yard: Yard, tmp_path: Path, num: int) -> None:
    """A single one contradicts the points, and either may be wrong; with a second one it is left out."""
    pairs, text = [("M6", "M7"), ("M5", "M7")][:num], "from,to,distance_m\n"
    for factor, (start, end) in zip((1.3, 1.0), pairs, strict=False):
        text += f"{start},{end},{factor * np.linalg.norm(yard.marks_m[end] - yard.marks_m[start]):.3f}\n"
    (tmp_path / "tape.csv").write_text(text)
    rows = yard.rows(["control"] * 5)
    survey = yard.survey(tmp_path, rows, scale__distances=tmp_path / "tape.csv", report__enabled=False)
    summary = scale_model(survey, progress=QUIET).summary
    assert summary.scale.verdict == "doubtful"
    if num == 1:
        assert "by the measured lengths the map is 30.0 % larger than by the known" in summary.scale.reasons[0]
    else:
        assert any("probably the length from M6 to M7 is given as" in reason for reason in summary.scale.reasons)
        assert_scale(summary, yard.made.metric_from_sfm.scale, 0.01)


def test_three_points_alone_leave_a_doubt_that_a_check_point_removes(yard: Yard, tmp_path: Path) -> None:
    survey = yard.survey(tmp_path, yard.rows(["control"] * 3), report__enabled=False)
    summary = scale_model(survey, progress=QUIET).summary
    assert_scale(summary, yard.made.metric_from_sfm.scale, 0.05)
    assert "rests on 3 known positions, so that nothing tells which of them is wrong" in summary.scale.reasons[0]
    checked = yard.survey(tmp_path, yard.rows(["control"] * 3 + ["check"]), report__enabled=False)
    summary = scale_model(checked, progress=QUIET).summary
    assert not any("nothing tells" in reason for reason in summary.scale.reasons)


def test_points_that_are_too_few_are_refused_with_their_number(yard: Yard, tmp_path: Path) -> None:
    survey = yard.survey(tmp_path, yard.rows(["control"] * 2 + ["check"] * 2))
    with pytest.raises(
        GeometryError, match="2 known positions are in the map, expected 3 or more that are not on one line"
    ):
        scale_model(survey, progress=QUIET)


def test_check_points_and_lengths_alone_are_no_measurements_of_a_map(yard: Yard, tmp_path: Path) -> None:
    (tmp_path / "tape.csv").write_text("from,to,distance_m,kind\nM0,M1,2.5,check\n")
    tape = {"scale__distances": tmp_path / "tape.csv"}
    for more in ({}, tape):
        with pytest.raises(GeometryError, match="nothing in the map is measured but for comparison, as check points"):
            scale_model(yard.survey(tmp_path, yard.rows(["check"] * 4), **more), progress=QUIET)


def test_a_point_without_marks_is_named_and_left_out(yard: Yard, tmp_path: Path) -> None:
    survey = yard.survey(tmp_path, yard.rows(["control"] * 4) + "unseen,1,2,3,0.01,control\n", report__enabled=False)
    summary = scale_model(survey, progress=QUIET).summary
    assert any("1 of 5 known points are left out" in warning and "unseen" in warning for warning in summary.warnings)
    assert known(summary.points).points[-1].estimated_m is None


def test_points_and_anchors_in_the_first_camera_are_refused(yard: Yard, tmp_path: Path) -> None:
    anchors = tmp_path / "anchors.csv"
    anchors.write_text("anchor_id,x_m,y_m,z_m\nA1,1,2,3\n")
    survey = yard.survey(tmp_path, yard.rows(["control"] * 4), anchors__path=anchors, anchors__frame="first_camera")
    with pytest.raises(InputError, match=r"\[points\] are in the site, expected \[anchors\] frame to be site as well"):
        scale_model(survey, progress=QUIET)
