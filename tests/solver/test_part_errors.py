"""Shared modes of the errors of a map's parts, against the whole covariance."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.solver.test_covariance import Joint, covariance_of_all, joint, model, variable

from rangesfm.util.geometry.map_errors import MapErrors, MapPoint

Array = npt.NDArray[np.float64]


def found_in(survey: Joint) -> MapErrors:
    return survey.covariance().errors


def center_of(frame_id: int) -> MapPoint:
    return MapPoint(np.zeros(3), {("frame", frame_id): np.hstack([np.zeros((3, 3)), np.eye(3)])}, np.zeros((3, 3)))


def anchor(anchor_id: str) -> MapPoint:
    return MapPoint(np.zeros(3), {("anchor", anchor_id): np.eye(3)}, np.zeros((3, 3)))


def relative(errors: MapErrors, first: MapPoint, second: MapPoint) -> Array:
    """Return the relative covariance as the problem has it, with its own uncertainty of the scale."""
    return errors.relative(first, second, errors.scale_stddev)


def centers_by_steps(survey: Joint, frames: range, num_columns: int) -> Array:
    """(frames, 3, num_columns) derivatives of centres by the steps of Ceres; the first frame is held."""
    slopes = np.zeros((len(frames), 3, num_columns))
    for row, k in enumerate(frames):
        pose = survey.poses[k]
        rotation = Rotation.from_quat(pose[:4]).as_matrix()
        x, y, z = 2 * pose[4:]
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        slopes[row, :, 6 * (k - 1) : 6 * k] = -rotation.T @ np.hstack([cross, np.eye(3)])
    return slopes


def test_two_points_err_relative_to_each_other_as_in_the_inverse_of_all_normal_equations() -> None:
    survey = joint(model(), hold_first=True)
    errors = found_in(survey)
    whole = covariance_of_all(survey.problem, variable(survey))
    frames = sorted(survey.reconstruction.reg_frame_ids())
    slopes = centers_by_steps(survey, range(1, len(frames)), len(whole))
    apart = slopes[4] - slopes[1]
    expected = apart @ whole @ apart.T
    found = relative(errors, center_of(frames[2]), center_of(frames[5]))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * expected.max())
    to_anchor = -slopes[1]
    first = 6 * (len(frames) - 1) + 3
    to_anchor[:, first : first + 3] += np.eye(3)
    expected = to_anchor @ whole @ to_anchor.T
    found = relative(errors, center_of(frames[2]), anchor("A1"))
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-6 * expected.max())


def test_few_modes_leave_keyframes_about_as_certain_relative_to_each_other_as_they_are(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    survey = joint(model(num_frames=40), hold_anchors=True)
    frames = sorted(survey.reconstruction.reg_frame_ids())
    whole, few = found_in(survey), _with_few_modes(survey, monkeypatch)
    assert few.parts["frame"].modes.shape[2] == 40 < whole.parts["frame"].modes.shape[2]
    pairs = [(a, b) for a in frames for b in frames if a < b]
    stddevs = [np.sqrt([np.diag(relative(of, center_of(a), center_of(b))) for a, b in pairs]) for of in (whole, few)]
    ratios = stddevs[1] / stddevs[0]
    assert 0.85 < ratios.min() <= ratios.max() < 1.2
    assert np.median(np.abs(np.log(ratios))) < 0.03


def _with_few_modes(survey: Joint, monkeypatch: pytest.MonkeyPatch) -> MapErrors:
    monkeypatch.setattr("rangesfm.solver.part_errors.MAX_NUM_MODES", 40)
    return found_in(survey)


def test_a_stated_uncertainty_of_the_scale_replaces_that_of_the_problem() -> None:
    """A scale known exactly leaves what the map errs at that scale; one known worse widens long distances."""
    survey = joint(model(), hold_first=True)
    errors = found_in(survey)
    frames = sorted(survey.reconstruction.reg_frame_ids())
    first, last = center_of(frames[0]), center_of(frames[4])
    own = errors.relative(first, last, errors.scale_stddev)
    exact, wide = (errors.relative(first, last, stddev) for stddev in (0.0, 0.1))
    assert np.linalg.eigvalsh(exact).min() > -1e-12
    assert np.trace(exact) < np.trace(own) < np.trace(wide)
    at = {frame: survey.poses[k] for k, frame in enumerate(frames)}
    centers = [-Rotation.from_quat(at[f][:4]).inv().apply(at[f][4:]) for f in (frames[0], frames[4])]
    along = (centers[1] - centers[0]) / np.linalg.norm(centers[1] - centers[0])
    by_scale = np.sqrt(along @ (wide - exact) @ along) / 0.1
    assert by_scale == pytest.approx(float(np.linalg.norm(centers[1] - centers[0])), rel=0.1)
    assert np.sqrt(along @ wide @ along) == pytest.approx(0.1 * np.linalg.norm(centers[1] - centers[0]), rel=0.15)
