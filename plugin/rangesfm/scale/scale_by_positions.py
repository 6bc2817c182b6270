"""The similarity from a map to the site by known positions: of marks (control points) and of an antenna on the camera.

A known position p of something with the place c in the model and the lever arm a obeys p = scale * R c + R a + t. Its
error has several parts: the survey of the point, the marks in the photos, noise of the antenna's positions and errors
of these that last for some time, and the bending of the map, which the photos allow. The sizes of those that are not
given are estimated by restricted likelihood (``ComponentLikelihood``), as for ranges.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import special
from scipy.sparse import csr_array, diags_array, kron
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.errors import GeometryError
from rangesfm.geometry.numerics import MAX_NUM_ROUNDS, ROUNDING, UNDETERMINED
from rangesfm.geometry.robust_statistics import CAUCHY, MIN_STDDEV_M
from rangesfm.geometry.similarity import IDENTITY, Similarity, align_points, path_shape, similarity_motions
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.positions.known_positions import LASTING_S, KnownPositions
from rangesfm.processes.threads import with_one_blas_thread
from rangesfm.ranging.errors.bending import BendingOfBins, ErrorPart, MapBending
from rangesfm.ranging.errors.components import CLOCKS
from rangesfm.ranging.errors.learned import ErrorParts
from rangesfm.ranging.range_observations import OUTLIER_BELOW
from rangesfm.scale.anchor_plane import is_line
from rangesfm.scale.linear_map import FALSE_ALARM_RATE, NUM_SUSPECTS, LinearMap
from rangesfm.scale.placement_prior import PlacementPrior
from rangesfm.scale.position_equations import (
    LASTING,
    PositionEquations,
    at_point,
    covariance_of_groups,
    errors_by_place,
    errors_of_sizes,
    expected_sizes,
    grouped_by_time,
    learnt_sizes,
    times_of_groups,
)
from rangesfm.scale.range_equation import Columns
from rangesfm.scale.scale_by_lengths import NUM_WITHIN, LengthScale, ScaleByKind
from rangesfm.scale.scale_estimate import ScaleUncertainty
from rangesfm.scale.uncertainty import KnownMap

MIN_NUM_POSITIONS = 3
"""Fewest positions, not on one line, that determine a similarity."""
# Most triples for a start.
_MAX_NUM_TRIPLES = 300
# Standard deviation of the logarithm of what a system says of its own errors, and of what is guessed of them; and the
# share of the noise that lasts, before anything is known.
_SPREAD_GIVEN, _SPREAD_GUESSED, _LASTING_SHARE = 0.5, 1.0, 0.3
# Largest standard deviation of a turn of the map, radians, for which its effect is linear.
_MAX_TURN_STDDEV = 0.3


@dataclass(frozen=True)
class PositionScale:
    """The scale and the place of a map by k known positions.

    Attributes:
        site_from_model: the estimate.
        known: the positions. weights: (k,) robust weights.
        is_left_out: (k,) control points that contradict the others.
        threshold: squared error of a control point, in standard deviations, above which it is left out.
        uncertainty: of the scale.
        covariance: (7, 7) of the logarithm of the scale, a turn and a shift about the first camera.
        best_step: (7,) from the estimate to that with the best weights for the errors.
        equations: of the positions. bending_m2: (3 g, 3 g) covariance of their coordinates that the photos' residuals
            let expect; 0 without photos.
        stddev_m: (k,) standard deviation of a coordinate of each known position.
        inflation: standard deviation of the scale by the antenna's positions, divided by that for independent errors.
    """

    site_from_model: Similarity
    known: KnownPositions
    weights: Array
    is_left_out: Mask
    threshold: float
    uncertainty: ScaleUncertainty
    covariance: Array
    best_step: Array
    equations: PositionEquations
    bending_m2: Array
    stddev_m: Array
    inflation: float

    @property
    def value(self) -> float:
        """Metres per unit of the model."""
        return self.site_from_model.scale

    @property
    def alone(self) -> ScaleByKind:
        """The scale, with its standard deviation."""
        return self.uncertainty.about(self.value)

    @property
    def bending_factor(self) -> float:
        """Return the learnt bending over the bending expected from the photos' residuals; 1 if that is unknown."""
        expected_m = float(np.sqrt(np.trace(self.bending_m2) / len(self.bending_m2)))
        return self.equations.errors.stddev_of_component["bending"] / expected_m if expected_m > 0 else 1.0

    @property
    def names_left_out(self) -> list[str]:
        """Names of the control points that contradict the others."""
        return [self.known.names[row] for row in np.flatnonzero(self.is_left_out).tolist()]

    def prior(self, path: Trajectory, first_camera_from_model: Similarity) -> PlacementPrior:
        """Return what the positions say of the place of the first camera's frame, by the best weights for their errors.

        Args:
            path: of the model.
        """
        best = moved_similarity(self.site_from_model, self.best_step, path)
        return PlacementPrior.of(best @ first_camera_from_model.inverse(), np.zeros(3), self.covariance)

    @property
    def is_used(self) -> Mask:
        """(k,) positions that take part."""
        return np.asarray(~self.known.is_check & ~self.is_left_out & (self.weights >= OUTLIER_BELOW))

    @property
    def num_used(self) -> int:
        return int(np.count_nonzero(self.is_used))

    @property
    def has_check(self) -> bool:
        """True if some of the positions only check the others."""
        return bool(self.known.is_check.any())


def _determine(known: KnownPositions, used: Mask) -> bool:
    """Return whether positions determine a similarity: three or more that are not on one line."""
    if used.sum() < MIN_NUM_POSITIONS:
        return False
    stddevs = path_shape(known.places[used]).stddevs
    return bool(stddevs[1] > UNDETERMINED * stddevs[0])


@with_one_blas_thread
def scale_by_positions(
    known: KnownPositions,
    path: Trajectory,
    bending: MapBending,
    *,
    lengths: LengthScale | None = None,
    refined: Similarity | None = None,
    lasting_s: Sequence[float] = LASTING_S,
) -> PositionScale:
    """Estimate the similarity to the site, with contradicting control points left out.

    Args:
        known: positions in the model of ``path``. path: of the camera. bending: of the map.
        lengths: what measured lengths say of the scale, which takes part.
        refined: similarity of a map that photos and positions made together; None: the map is one piece, and its
            similarity is estimated.
        lasting_s: for how long errors of the antenna's positions last, seconds.

    Raises:
        GeometryError: the positions are too few, or on one line.
    """
    problem = _Problem(known, path, bending, lengths, refined, tuple(lasting_s))
    problem.require_enough()
    used = ~known.is_check
    num_control = int(np.count_nonzero(known.is_mark & used))
    threshold = float(special.chdtri(3, FALSE_ALARM_RATE / max(num_control, 1)))
    fit = problem.fit(used)
    while (worst := problem.worst(fit, threshold)) is not None:
        fit = worst
    found = problem.result(fit, used & ~fit.used, threshold)
    refuse_open_turn(found.covariance)
    return found


def refuse_open_turn(covariance: Array) -> None:
    """Raise GeometryError if a (7, 7) covariance of a similarity by known positions leaves its turn open."""
    turn_stddev = float(np.sqrt(np.linalg.eigvalsh(covariance[1:4, 1:4])[-1]))
    if turn_stddev > _MAX_TURN_STDDEV:
        raise GeometryError(
            "the known positions are nearly on one line, which leaves the turn of the map about it open "
            f"({np.rad2deg(turn_stddev):.0f} degrees, 1 stddev): survey a point off that line"
        )


@dataclass(frozen=True)
class _Fit:
    """A robust fit of some of the positions, with their learnt errors; arrays are of all k positions."""

    similarity: Similarity
    used: Mask
    weights: Array
    stddev_m: Array
    equations: PositionEquations
    bending: BendingOfBins
    sizes: dict[str, float]


@dataclass(frozen=True)
class _Problem:
    """The positions on a map; arguments as for ``scale_by_positions``."""

    known: KnownPositions
    path: Trajectory
    bending: MapBending
    lengths: LengthScale | None
    refined: Similarity | None
    lasting_s: tuple[float, ...]

    def require_enough(self) -> None:
        """Raise GeometryError if the positions do not determine a similarity."""
        is_control = ~self.known.is_check
        if not _determine(self.known, is_control):
            expected = f"expected {MIN_NUM_POSITIONS} or more that are not on one line"
            raise GeometryError(f"{np.count_nonzero(is_control)} known positions are in the map, {expected}")

    def fit(self, used: Mask, start: Similarity | None = None) -> _Fit:
        """Fit the similarity robustly, and learn the errors from what it leaves."""
        similarity, weights, stddev_m = self.robust(used, start)
        before, bending = self.equations(used, similarity, weights, stddev_m)
        sizes = learnt_sizes(before.parts, before.linear, before.is_used)
        equations = replace(before, errors=errors_of_sizes(before.parts, sizes))
        return _Fit(similarity, used, weights, stddev_m, equations, bending, sizes)

    def equations(
        self, used: Mask, similarity: Similarity, weights: Array, stddev_m: Array
    ) -> tuple[PositionEquations, BendingOfBins]:
        """Return the equations about a similarity with the errors to expect before any is learnt, and the bending."""
        grouping = grouped_by_time(self.known, weights)
        by_pose = groups_by_pose(self.known, similarity, self.path, grouping)
        bending = self.bending.of_functions(by_pose, frame_is_free=True)
        linear = self._linear(similarity, grouping, bending)
        parts = tuple(self._parts(similarity, grouping, stddev_m, bending))
        takes_part = (abs(grouping) @ np.repeat(used & (weights >= OUTLIER_BELOW) | used & self.known.is_mark, 3)) > 0
        errors = errors_of_sizes(parts, expected_sizes(parts, linear))
        return PositionEquations(linear, parts, errors, takes_part, grouping), bending

    def robust(self, used: Mask, start: Similarity | None) -> tuple[Similarity, Array, Array]:
        """Return the similarity, (k,) weights and (k,) standard deviations, by iteratively reweighted least squares."""
        known = self.known
        similarity = self.refined or start or _of_triples(known, np.flatnonzero(used))
        for _ in range(MAX_NUM_ROUNDS):
            off_m = known.misclosures_m(similarity)
            stddev_m = self._stddevs_m(off_m, used)
            away = np.sqrt(np.mean(off_m**2, axis=1)) / stddev_m
            weights = used * CAUCHY.weights(away)
            if self.refined is not None:  # the map has its place; only outliers are told apart
                break
            step = self._step(similarity, off_m, weights / stddev_m**2)
            similarity = moved_similarity(similarity, step, self.path)
            if np.abs(step).max() < ROUNDING:
                break
        return similarity, weights, stddev_m

    def _step(self, similarity: Similarity, off_m: Array, weights: Array) -> Array:
        root = np.repeat(np.sqrt(weights), 3)
        off, by = root * off_m.ravel(), root[:, None] * self._design(similarity)
        prior_off, prior_design = self._priors(similarity)
        step = np.linalg.lstsq(np.vstack([by, prior_design]), -np.append(off, prior_off), rcond=ROUNDING)[0]
        return np.asarray(step)

    def _priors(self, similarity: Similarity) -> tuple[Array, Array]:
        """Return what the measured lengths say of the scale: (r,) and (r, 7), in standard deviations."""
        if self.lengths is None:
            return np.zeros(0), np.zeros((0, 7))
        design = np.eye(1, 7) / self.lengths.relative_stddev
        return np.log(similarity.scale / self.lengths.value) * design[:, 0], design

    def _design(self, similarity: Similarity) -> Array:
        """Return the (3 k, 7) derivatives of the positions by scale, turn and shift about the first camera."""
        origin = similarity.apply(self.path.centers[:1])[0]
        motions = similarity_motions(self.known.predicted_m(similarity) - origin)
        motions[:, :, 0] = similarity.apply(self.known.places) - origin  # the lever arm does not scale
        return motions.reshape(-1, 7)

    def _stddevs_m(self, off_m: Array, used: Mask) -> Array:
        """Return (k,) standard deviations of a coordinate: as given, or larger if the residuals of its kind are."""
        known, stddevs = self.known, np.ones(len(self.known))
        given = _stddev_of(known.covariance_m2)
        freedom = np.sqrt(3 * used.sum() / max(3 * used.sum() - 7, 1))
        # Half of all vectors of three normally distributed numbers are shorter than this.
        median_length = np.sqrt(special.chdtri(3, 0.5))
        for of_kind in (known.is_mark, ~known.is_mark):
            if (rows := used & of_kind).any():
                is_given = bool(np.isfinite(given[of_kind]).all())
                ratio = given if is_given else np.ones(len(known))
                shown = freedom * float(np.median(np.linalg.norm(off_m[rows], axis=1) / ratio[rows])) / median_length
                stddevs[of_kind] = ratio[of_kind] * max(shown, 1.0 if is_given else MIN_STDDEV_M)
        return stddevs

    def _linear(self, similarity: Similarity, grouping: csr_array, bending: BendingOfBins) -> LinearMap:
        residual_m = grouping @ self.known.misclosures_m(similarity).ravel() + bending.shift_m
        nothing = np.zeros(0, dtype=np.int64)
        design = grouping @ self._design(similarity)
        return LinearMap(residual_m, design, *self._priors(similarity), Columns(0, 1, nothing, nothing, 7))

    def _parts(
        self, similarity: Similarity, grouping: csr_array, stddev_m: Array, bending: BendingOfBins
    ) -> Iterator[ErrorPart]:
        """Yield the components of the errors."""
        yield from bending.parts
        known, rotation = self.known, similarity.rotation
        places = similarity.scale**2 * rotation @ known.own_covariance @ rotation.T
        places += known.arm_stddev_m[:, None, None] ** 2 * np.eye(3)
        covariance = known.covariance_m2
        assumed = stddev_m[:, None, None] ** 2 * np.eye(3)
        for name, of_kind, names_of_place in (
            ("points", known.is_mark, "marks"),
            ("positions", ~known.is_mark, "places"),
        ):
            if not of_kind.any():
                continue
            yield ErrorPart(names_of_place, covariance_of_groups(grouping, places, of_kind))
            is_known = bool(np.isfinite(covariance[of_kind]).all())
            own = covariance_of_groups(grouping, covariance if is_known else assumed, of_kind)
            spread = 0.0 if known.is_stated[of_kind].all() and name == "points" else _SPREAD_GIVEN
            yield ErrorPart(name, own, spread=spread if is_known else _SPREAD_GUESSED)
        if known.clock_stddev_s.any():
            moved_m = similarity.scale * known.velocity @ rotation.T * known.clock_stddev_s[:, None]
            of_clock = grouping @ moved_m.ravel()
            yield ErrorPart(CLOCKS, np.outer(of_clock, of_clock))
        if (rows := np.flatnonzero(~known.is_mark & np.isfinite(known.time_s))).size:
            size_m = np.where(np.isfinite(_stddev_of(covariance)), _stddev_of(covariance), stddev_m)
            of_groups, times_s = times_of_groups(grouping, known, size_m, rows)
            for lasting_s in self.lasting_s:
                apart = np.exp(-np.abs(times_s.reshape(-1, 1) - times_s.ravel()) / lasting_s)
                alike = apart.reshape(len(times_s), NUM_WITHIN, -1, NUM_WITHIN).mean(axis=(1, 3))
                own = np.kron(alike * np.outer(of_groups, of_groups), np.eye(3))
                yield ErrorPart(f"{LASTING}{lasting_s:g}s", own, _LASTING_SHARE, _SPREAD_GUESSED)
            yield from errors_by_place(
                grouping,
                known.predicted_m(similarity),
                of_groups,
                _LASTING_SHARE,
                _SPREAD_GUESSED,
                is_geodetic=bool(known.is_geodetic[rows].all()),
            )

    def worst(self, fit: _Fit, threshold: float) -> _Fit | None:
        """Return the fit without the control point that contradicts the others most; None if none does.

        The errors are learnt again without each suspect, as its own error would be taken for theirs.
        """
        rows = np.flatnonzero(fit.used & self.known.is_mark)
        statistics = np.array([fit.equations.of_mistake(at_point(self.known, row)).statistic for row in rows.tolist()])
        found, largest = None, threshold
        for row in rows[np.argsort(-statistics, kind="stable")[:NUM_SUSPECTS]].tolist():
            others = fit.used & (np.arange(len(fit.used)) != row)
            if int(others.sum()) <= MIN_NUM_POSITIONS - 1 or not _determine(self.known, others):
                continue
            without = self.fit(others, fit.similarity)
            mistake = without.equations.of_mistake(at_point(self.known, row))
            if mistake.statistic > largest:
                found, largest = without, mistake.statistic
        return found

    def result(self, fit: _Fit, is_left_out: Mask, threshold: float) -> PositionScale:
        """Return the scale with its uncertainty, by the rule of ``KnownMap.between``."""
        rows = fit.equations.is_used
        linear, errors = fit.equations.of(rows)
        variances = fit.stddev_m**2 / np.maximum(fit.weights, OUTLIER_BELOW)
        weighed = (fit.equations.grouping @ diags_array(np.repeat(variances, 3)) @ fit.equations.grouping.T).toarray()
        if self.refined is not None:
            weighed = weighed + fit.bending.formal_m2
        weighed = weighed[np.ix_(rows, rows)]
        formal = float(np.sqrt(linear.solved(weighed).covariance[0, 0]))
        others, of_groups = linear.with_weights(weighed, errors.covariance_m2)
        found = KnownMap.between(linear, errors, formal, others)
        return PositionScale(
            site_from_model=moved_similarity(fit.similarity, found.half_way, self.path),
            known=self.known,
            weights=fit.weights,
            is_left_out=is_left_out,
            threshold=threshold,
            uncertainty=found.uncertainty,
            covariance=found.covariance,
            best_step=linear.solved(errors.covariance_m2).step - found.half_way,
            equations=fit.equations,
            bending_m2=fit.bending.formal_m2,
            stddev_m=self._own_stddev_m(fit),
            inflation=self._inflation(fit, errors, of_groups[0]),
        )

    def _own_stddev_m(self, fit: _Fit) -> Array:
        """Return (k,) learnt standard deviations of a coordinate of the known positions, without errors that last."""
        given = _stddev_of(self.known.covariance_m2)
        base = np.where(np.isfinite(given), given, fit.stddev_m)
        return base * np.where(self.known.is_mark, fit.sizes.get("points", 1.0), fit.sizes.get("positions", 1.0))

    def _inflation(self, fit: _Fit, errors: ErrorParts, of_groups: Array) -> float:
        """Return the inflation for the scale, given its (3 g,) change by the coordinates that take part."""
        is_antenna = abs(fit.equations.grouping) @ np.repeat(~self.known.is_mark, 3) > 0
        by = np.where(is_antenna[fit.equations.is_used], of_groups, 0.0)
        of_parts = {name: size for name, size in errors.stddev_of_bins(by).items() if name.startswith("positions")}
        alone = of_parts.get("positions", 0.0)
        return float(np.linalg.norm([*of_parts.values()])) / alone if alone > 0 else 1.0


def groups_by_pose(known: KnownPositions, similarity: Similarity, path: Trajectory, grouping: csr_array) -> Array:
    """Return (3 g, 6 n) derivatives of groups of positions by the poses of a path, with shifts as in its first camera.

    These are the axes in which ``MapBending`` has the shifts.
    """
    rotation = kron(np.eye(len(known)), similarity.rotation, format="csr")
    by_pose = grouping @ rotation @ (similarity.scale * known.by_pose + known.arms_by_pose)
    parts = by_pose.toarray().reshape(by_pose.shape[0], -1, 6)
    parts[:, :, 3:] = parts[:, :, 3:] @ path.world_from_cam[0]
    return np.asarray(parts.reshape(len(parts), -1))


def expected_positions(
    known: KnownPositions, path: Trajectory, bending: MapBending, lasting_s: Sequence[float] = LASTING_S
) -> PositionEquations:
    """Return the equations of positions that are planned: on a map that is true, with the errors to expect.

    Args:
        known: without errors, in the model of ``path``, whose world is the site.

    Raises:
        GeometryError: the positions are too few, or on one line.
    """
    problem = _Problem(known, path, bending, None, IDENTITY, tuple(lasting_s))
    problem.require_enough()
    used = ~known.is_check
    return problem.equations(used, *problem.robust(used, None))[0]


def moved_similarity(similarity: Similarity, step: Array, path: Trajectory) -> Similarity:
    """Return a similarity moved by (7,) logarithm of the scale, turn and shift about the first camera of a path."""
    origin = similarity.apply(path.centers[:1])[0]
    rotation = Rotation.from_rotvec(step[1:4]).as_matrix() @ similarity.rotation
    scale = similarity.scale * float(np.exp(np.clip(step[0], -1.0, 1.0)))
    return Similarity(scale, rotation, origin + step[4:] - scale * rotation @ path.centers[0])


def _of_triples(known: KnownPositions, rows: Indices) -> Similarity:
    """Return the similarity of three positions with the least sum of distances of all: a robust start.

    Lever arms are taken off with the rotation of a first fit.
    """
    places, targets = known.places[rows], known.position_m[rows]
    for _ in range(2):
        candidates = [align_points(places, targets)]
        for chosen in map(list, _triples(len(rows))):
            if not any(is_line(path_shape(each)) for each in (places[chosen], targets[chosen])):
                candidates.append(align_points(places[chosen], targets[chosen]))
        best = candidates[int(np.argmin([_distance_sum(each, places, targets) for each in candidates]))]
        targets = known.position_m[rows] - known.arms_m[rows] @ best.rotation.T
    return best


def _distance_sum(similarity: Similarity, places: Array, targets: Array) -> float:
    return float(np.linalg.norm(similarity.apply(places) - targets, axis=1).sum())


def _triples(num: int) -> Iterator[tuple[int, ...]]:
    """Yield triples of numbers below ``num``: all if they are few, else some that are spread over them."""
    if num * (num - 1) * (num - 2) // 6 <= _MAX_NUM_TRIPLES:
        yield from itertools.combinations(range(num), MIN_NUM_POSITIONS)
        return
    rng = np.random.default_rng(0)
    for _ in range(_MAX_NUM_TRIPLES):
        yield tuple(rng.choice(num, MIN_NUM_POSITIONS, replace=False).tolist())


def _stddev_of(covariances: Array) -> Array:
    """Return (k,) standard deviations of a coordinate: the root of the mean variance."""
    return np.asarray(np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 3))
