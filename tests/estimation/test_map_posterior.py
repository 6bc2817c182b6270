"""The errors of a delivered map, against the prediction of unused functions of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.estimation.test_photo_bending import NUM, bending_of, simulated
from tests.simulated.model import random_similarity

from rangesfm.colmap.transform import rescale
from rangesfm.estimation.map_posterior import _turns_bounded, errors_at_estimate
from rangesfm.estimation.photo_bending import PhotoBending
from rangesfm.measurements.joint_map import JointMap
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import Component
from rangesfm.solver.posterior import Observations, joined
from rangesfm.util.geometry.similarity import IDENTITY, similarity_motions
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

NUM_OBSERVED, ANCHOR = 25, 7


@pytest.mark.parametrize("frame_is_free", [True, False])
def test_parts_of_a_map_err_as_functions_of_it_that_were_not_observed(frame_is_free: bool) -> None:
    """Each centre is predicted as an unused observation of the joint problem, and an anchor as its unknown."""
    rng = np.random.default_rng(5)
    model = rescale(simulated(pixel_stddev=1.0).reconstruction, random_similarity(rng))
    path, bending = trajectory_from_reconstruction(model), bending_of(model)
    assert isinstance(bending, PhotoBending)
    nothing = np.zeros(0, dtype=np.int64)
    if frame_is_free:
        columns = Columns(0, 1, np.array([ANCHOR]), nothing, ANCHOR + 3)
    else:
        columns = Columns(0, -1, np.array([1]), nothing, 4)
    of_map = len(columns.of_map)

    def observations(kind: str, by_pose: np.ndarray, design: np.ndarray, *, is_used: bool) -> Observations:
        num = len(design)
        own = (Component("white", np.eye(num), 0.01, 0.5),) if is_used else ()
        unused = np.full(num, is_used)
        return Observations(
            columns,
            design,
            np.zeros(num),
            kind=kind,
            by_pose=by_pose,
            components=own,
            alone_m2=1e-4 * np.eye(num),
            is_used=unused,
        )

    by_center = np.zeros((NUM, 3, NUM, 6))
    by_center[np.arange(NUM), :, np.arange(NUM), 3:] = np.eye(3)
    motions = np.zeros((NUM, 3, columns.num))
    motions[:, :, :of_map] = similarity_motions(path.centers - path.centers[0])[:, :, :of_map]
    centers = observations("centers", by_center.reshape(3 * NUM, -1), motions.reshape(3 * NUM, -1), is_used=False)
    seen = observations(
        "seen", rng.normal(size=(NUM_OBSERVED, 6 * NUM)), rng.normal(size=(NUM_OBSERVED, columns.num)), is_used=True
    )
    problem = joined([seen, centers], bending)
    known = problem.posterior()
    at_rest = JointMap((), IDENTITY, bending, True, {"seen": seen, "centers": centers}, problem, known)
    rest: Any = SimpleNamespace(refined_params={}, blocks={("anchor", "A1"): np.zeros(3)})
    errors = errors_at_estimate(at_rest, rest, ["A1", "unheard"])
    covariance = _turns_bounded(known.covariance, columns)
    expected = problem.predicted_m2("centers", covariance)
    frames = errors.parts["frame"]
    modes = frames.modes[[frames.row_of[frame_id] for frame_id in path.frame_ids.tolist()], 3:].reshape(3 * NUM, -1)
    scale_m2 = np.trace(expected) / len(expected)
    np.testing.assert_allclose(modes @ modes.T, expected, atol=1e-5 * scale_m2)
    np.testing.assert_allclose(
        errors.centers_m2(path.frame_ids),
        [expected[k : k + 3, k : k + 3] for k in range(0, 3 * NUM, 3)],
        atol=1e-5 * scale_m2,
    )
    of_anchor = covariance[-3:, -3:]
    np.testing.assert_allclose(errors.covariances("anchor")[0], of_anchor, rtol=1e-4)
    assert errors.scale_stddev == pytest.approx(covariance[0, 0] ** 0.5, rel=1e-4)
