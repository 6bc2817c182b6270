"""The errors of a delivered map, against the prediction of unused functions of it."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from tests.estimation.test_photo_bending import NUM, NUM_OF_FIRST, bending_of, of_two_parts, simulated
from tests.simulated.model import random_similarity

from rangesfm.colmap.transform import rescale
from rangesfm.estimation.map_posterior import _turns_bounded, bending_of_firm_parts, errors_at_estimate, sizes_of_parts
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


def measured_at_centers(size: float, num_seen: int) -> JointMap:
    """Return a map of two parts, the second of which is too large, with positions of its first photos to 1 cm."""
    bending = bending_of(of_two_parts())
    assert isinstance(bending, PhotoBending)
    path, rng = bending.path, np.random.default_rng(6)
    is_second = bending.parts[1]
    middle = path.centers[is_second].mean(axis=0)
    off_m = np.where(is_second[:, None], size * (path.centers - middle), 0.0) + 0.01 * rng.normal(size=(NUM, 3))
    by_center = np.zeros((NUM, 3, NUM, 6))
    by_center[np.arange(NUM), :, np.arange(NUM), 3:] = np.eye(3)
    nothing = np.zeros(0, dtype=np.int64)
    num = 3 * num_seen
    seen = Observations(
        Columns(0, 1, nothing, nothing, 7),
        similarity_motions(path.centers - path.centers[0]).reshape(-1, 7)[:num],
        off_m.ravel()[:num],
        kind="centers",
        by_pose=by_center.reshape(3 * NUM, -1)[:num],
        components=(Component("white", np.eye(num), 0.01, 0.5),),
        alone_m2=1e-4 * np.eye(num),
        is_used=np.ones(num, dtype=bool),
    )
    problem = joined([seen], bending).learnt()
    return JointMap((), IDENTITY, bending, False, {"centers": seen}, problem, problem.posterior())


def test_measurements_tell_the_size_of_a_part_that_no_point_ties_to_the_rest() -> None:
    on_map = measured_at_centers(0.1, NUM)
    (size,) = sizes_of_parts(on_map)
    assert size.is_determined
    assert size.off == pytest.approx(0.1, abs=3 * size.stddev)
    assert 0.0005 < size.stddev < 0.02
    # That the photos leave it open says nothing of how a map bends.
    assert 0.3 < on_map.problem.bending_factor < 5
    bending = bending_of_firm_parts(on_map)
    assert bending is not None
    assert bending.is_firm.all()


def test_a_part_that_neither_photos_nor_measurements_tie_to_the_rest_is_no_part_of_the_maps_size() -> None:
    on_map = measured_at_centers(0.1, NUM_OF_FIRST)
    (size,) = sizes_of_parts(on_map)
    assert not size.is_determined
    assert size.stddev == pytest.approx(1.0, rel=0.1)
    assert isinstance(on_map.bending, PhotoBending)
    assert np.flatnonzero(on_map.bending.is_firm).tolist() == list(range(NUM_OF_FIRST))
    assert bending_of_firm_parts(on_map) is None
    assert on_map.posterior.uncertainty.empirical < 0.02
