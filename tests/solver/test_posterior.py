"""All kinds of measurement are one linear Gaussian problem, whose answers are those of dense algebra."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy.linalg import block_diag

from rangesfm.arrays import Array
from rangesfm.measurements.mistakes import Mistake, estimated
from rangesfm.solver.bending import Bending, bending_parts
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import Component, learnt_sizes, noise_of_sizes
from rangesfm.solver.posterior import Observations, joined
from rangesfm.util.geometry.trajectory import Trajectory

NUM_POSES = 4
PATH = Trajectory(
    np.arange(NUM_POSES),
    tuple("abcd"),
    np.arange(float(NUM_POSES)),
    np.arange(3.0 * NUM_POSES).reshape(NUM_POSES, 3),
    np.tile(np.eye(3), (NUM_POSES, 1, 1)),
)


@dataclass(frozen=True)
class Shaken:
    """A map whose poses err independently, by a known amount."""

    path: Trajectory = PATH
    size: float = 0.3

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> Bending:
        found = bending_parts("bending", by_pose @ by_pose.T, self.size, 0.0)
        nothing = np.zeros(len(by_pose))
        return Bending(found, np.diag(nothing), nothing)


def kind(name: str, num: int, seed: int, noise: float, *, is_placed: bool = True, shared: float = 0.0) -> Observations:
    """Draw observations with independent and shared errors; a kind that is not placed depends on the scale alone."""
    rng = np.random.default_rng(seed)
    columns = Columns.of_whole(7 if is_placed else 1)
    own, alike = noise**2 * np.eye(num), shared**2 * np.ones((num, num))
    return Observations(
        columns,
        rng.standard_normal((num, columns.num)),
        0.1 * rng.standard_normal(num),
        kind=name,
        by_pose=rng.standard_normal((num, 6 * NUM_POSES)),
        components=(Component(f"{name} noise", own), Component(f"{name} shared", alike)),
        alone_m2=own,
        is_used=np.ones(num, dtype=bool),
    )


def two_kinds() -> tuple[Observations, Observations]:
    return kind("positions", 12, 0, 0.2, shared=0.1), kind("lengths", 3, 1, 0.05, is_placed=False)


def dense(*kinds: Observations) -> tuple[Array, Array, Array]:
    """Return design, residuals and covariance of all observations, in which the map bends alike."""
    design = np.zeros((sum(len(each.residual_m) for each in kinds), 7))
    design[:12], design[12:, :1] = kinds[0].design, kinds[1].design
    by_pose = np.vstack([each.by_pose for each in kinds])
    own = block_diag(*(np.sum([part.alike for part in each.components], axis=0) for each in kinds))
    return design, np.concatenate([each.residual_m for each in kinds]), own + 0.3**2 * by_pose @ by_pose.T


def test_the_best_estimate_of_two_kinds_is_that_of_dense_least_squares() -> None:
    kinds = two_kinds()
    problem = joined(kinds, Shaken())
    design, residual, covariance = dense(*kinds)
    np.testing.assert_allclose(problem.noise.covariance_m2, covariance)
    found = problem.solved(problem.noise.covariance_m2)
    inverse = np.linalg.inv(covariance)
    expected = np.linalg.inv(design.T @ inverse @ design)
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-8)
    np.testing.assert_allclose(found.step, -expected @ design.T @ inverse @ residual, rtol=1e-7)


def test_another_kind_never_widens_the_interval() -> None:
    first, second = two_kinds()
    alone, both = (joined(kinds, Shaken()).posterior() for kinds in ((first,), (first, second)))
    assert both.uncertainty.half_width_95 < alone.uncertainty.half_width_95


def test_a_mistake_is_found_with_its_size_also_where_it_is_not_used() -> None:
    kinds = two_kinds()
    problem = joined(kinds, Shaken())
    design, _, _ = dense(*kinds)
    columns = np.zeros((15, 1))
    columns[3] = 1.0
    exact = replace(problem, residual_m=design @ np.arange(7.0) - 0.8 * columns[:, 0])
    for problem in (exact, replace(exact, is_used=np.arange(15) != 3)):
        [found] = estimated(problem, [Mistake("one", -columns)])
        assert found.sizes[0] == pytest.approx(0.8)
        assert found.statistic == pytest.approx((0.8 / found.stddevs[0]) ** 2)
    # The mistake does not pass for noise.
    [found] = estimated(exact.learnt(columns), [Mistake("one", -columns)])
    assert found.sizes[0] == pytest.approx(0.8)


def test_redundancy_is_what_the_unknowns_leave_of_what_a_known_map_shows() -> None:
    """A mistake in a prior, which the observations of a known map do not show at all, is checked by none of them."""
    three = replace(
        kind("lengths", 3, 0, 1.0, is_placed=False), design=np.ones((3, 1)), by_pose=np.zeros((3, 6 * NUM_POSES))
    )
    problem = joined([replace(three, prior_residual=np.zeros(1), prior_design=np.ones((1, 1)))], Shaken())
    in_length, in_prior = estimated(
        problem, [Mistake("length", np.eye(4)[:, [0]]), Mistake("prior", np.eye(4)[:, [3]])]
    )
    assert in_length.redundancy == pytest.approx(3 / 4)
    assert in_prior.is_seen
    assert in_prior.redundancy == 0.0


def test_what_nobody_observes_is_as_certain_as_its_conditional_distribution() -> None:
    kinds = two_kinds()
    unseen = replace(kind("keyframes", 2, 5, 0.0), is_used=np.zeros(2, dtype=bool))
    problem = joined([*kinds, unseen], Shaken())
    found = problem.predicted_m2("keyframes", problem.posterior().covariance)
    # With nearly nothing known of the unknowns beforehand.
    prior = 1e6 * np.eye(7)
    design, _, _ = dense(*kinds)
    design = np.vstack([design, unseen.design])
    covariance = problem.noise.covariance_m2 + design @ prior @ design.T
    seen, other = slice(0, 15), slice(15, 17)
    expected = covariance[other, other] - covariance[other, seen] @ np.linalg.solve(
        covariance[seen, seen], covariance[seen, other]
    )
    linear, noise = problem.among(problem.is_used)
    best = problem.predicted_m2("keyframes", linear.solved(noise.covariance_m2).covariance)
    np.testing.assert_allclose(best, expected, rtol=1e-3)
    assert np.all(np.diag(found) >= np.diag(best) * (1 - 1e-9))


def test_errors_that_are_tied_to_a_component_grow_with_it() -> None:
    rng = np.random.default_rng(0)
    lasting = Component("lasting", np.eye(40), 0.1, 1.0, {"frame": 0.25 * np.ones((40, 40))})
    off_m = 0.5 * rng.standard_normal(40)
    sizes = learnt_sizes([lasting], off_m, np.ones((40, 1)), np.zeros((0, 1)))
    assert sizes["lasting"] == pytest.approx(off_m.std(ddof=1), rel=0.1)
    found = noise_of_sizes([lasting], sizes, 40)
    assert found.names == ("lasting", "frame")
    assert found.stddev_of_component["frame"] == pytest.approx(0.5 * sizes["lasting"])
    np.testing.assert_allclose(found.only("frame").covariance_m2, 0.25 * sizes["lasting"] ** 2)
