"""Known positions in a site as measurements of the map: of an antenna on the camera, and of points that photos show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from rangesfm import solver
from rangesfm.arrays import Array, Indices, rows_by_key
from rangesfm.measurements.kind import (
    LEAST_SQUARES,
    Block,
    ByBlock,
    Linearization,
    MapState,
    Measurements,
    Weights,
)
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.places import AntennaPlaces
from rangesfm.measurements.points import NamedPoints
from rangesfm.measurements.positions.antenna_track import AntennaTrack
from rangesfm.measurements.positions.known_positions import KnownPositions
from rangesfm.measurements.prior import Prior
from rangesfm.measurements.ranges.errors.noise import STRETCH_S, correlation_inflation, stretch_labels
from rangesfm.options import RefineOptions
from rangesfm.solver.bundle_adjustment import BundleAdjustment
from rangesfm.util.geometry.robust_statistics import RobustLoss, factor_of_stddevs
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory

if TYPE_CHECKING:
    from typing_extensions import Self

ARM: Block = ("lever_arm", "positions")
CLOCK: Block = ("clock", "positions")


@dataclass(frozen=True)
class AntennaPositions(Measurements):
    """k positions of an antenna, with their errors as learnt on a rigid map.

    Attributes:
        names: of the photo or the time of each.
        places: on the path.
        position_m: (k, 3) in the metric world.
        root_information: (k, 3, 3) inverse roots of the covariances as learnt.
        stated_share: (k,) factor of the standard deviations with which they are those that the log states, which is the
            smallest one; 0 where it states none.
        group: (k,) label of each position's stretch of time, in which errors may be alike.
        arm_m: (3,) lever arm as given. arm_stddev_m: of its coordinates; 0 holds it.
        clock_stddev_s: of the time offset; 0: it was given.
        loss: of the length of an error, in standard deviations of its coordinates.
        factor: of the standard deviations, as residuals of a map that may bend show it.
        inflation: factor on the standard deviation of estimates from many positions, for their errors' correlation in
            time, as residuals of such a map show it.
    """

    kind: ClassVar[str] = "position"
    counts_in_metres: ClassVar[bool] = True

    names: tuple[str, ...]
    places: AntennaPlaces
    position_m: Array
    root_information: Array
    stated_share: Array
    group: Indices
    arm_m: Array
    arm_stddev_m: float
    clock_stddev_s: float
    loss: RobustLoss
    factor: float = 1.0
    inflation: float = 1.0

    @classmethod
    def on_map(
        cls, known: KnownPositions, rows: Indices, stddev_m: Array, path: Trajectory, site_from_model: Similarity,
        track: AntennaTrack, options: RefineOptions,
    ) -> AntennaPositions:  # fmt: skip
        """Return positions on a map that is to be fitted.

        Args:
            known: in the unscaled model. rows: (k,) of the antenna's that take part.
            stddev_m: (k,) standard deviations of a coordinate. path: of the unscaled model.
            site_from_model: the estimate. track: of the antenna. options: of the fit.
        """
        arm_m, of_camera = np.array(track.antenna_in_cam_m, np.float64), known.on_path.subset(rows)
        arms_in_cam_m = np.tile(arm_m, (len(rows), 1))
        stated_m = np.sqrt(np.trace(known.covariance_m2[rows], axis1=1, axis2=2) / 3)
        return cls(
            tuple(known.names[row] for row in rows.tolist()),
            of_camera.on_map(path, arms_in_cam_m, known.arms_m[rows], site_from_model),
            known.position_m[rows],
            _whitenings(known.covariance_m2[rows], stddev_m),
            stated_share=np.nan_to_num(stated_m) / stddev_m,
            group=stretch_labels(known.time_s[rows], STRETCH_S),
            arm_m=arm_m,
            arm_stddev_m=options.lever_arm_stddev_m,
            clock_stddev_s=track.offset_stddev_s,
            loss=RobustLoss(options.range_loss_scale, is_bounded=True),
        )

    @property
    def places_map(self) -> bool:
        return True

    @property
    def blocks(self) -> Mapping[Block, Array]:
        return {ARM: self.arm_m, CLOCK: np.zeros(1)}

    @property
    def fixed(self) -> frozenset[Block]:
        held = ((ARM, self.arm_stddev_m), (CLOCK, self.clock_stddev_s))
        return frozenset(name for name, stddev in held if not stddev > 0)

    def priors(self) -> Iterator[Prior]:
        """Yield what is known of the blocks."""
        if self.arm_stddev_m > 0:
            yield Prior.of_one(ARM, self.arm_m, self.arm_stddev_m)
        if self.clock_stddev_s > 0:
            yield Prior.of_one(CLOCK, np.zeros(1), self.clock_stddev_s)

    @property
    def _root_information(self) -> Array:
        return self.root_information / np.maximum(self.factor, self.stated_share)[:, None, None]

    @property
    def weights(self) -> Weights:
        return Weights(self._root_information, np.full(len(self.position_m), self.inflation**-2), self.loss)

    def linearize(self, state: MapState) -> Linearization:
        num, later_s = len(self.position_m), float(state.blocks[CLOCK][0])
        arms_m, axes = np.tile(state.blocks[ARM], (num, 1)), np.tile(np.eye(3), (num, 1, 1))
        all_of_one = np.zeros(num, dtype=np.int64)
        by_block = (
            ByBlock((ARM,), all_of_one, self.places.by_arm(state.poses, axes, later_s)),
            ByBlock((CLOCK,), all_of_one, self.places.by_time(state.poses, arms_m, axes)),
        )
        return Linearization(
            self.places.at(state.poses, arms_m, later_s) - self.position_m,
            self.places.keyframes,
            self.places.by_pose(state.poses, arms_m, axes, later_s),
            by_block,
        )

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        at, roots = self.places, self._root_information
        arm_is_free, clock_is_free = self.arm_stddev_m > 0, self.clock_stddev_s > 0
        for rows in rows_by_key(at.before, at.after):
            ends = list(dict.fromkeys((int(at.before[rows[0]]), int(at.after[rows[0]]))))
            is_between = len(ends) == 2
            cost = solver.position_cost(
                position_m=self.position_m[rows],
                whitening=roots[rows],
                tag_in_cam_m=None if arm_is_free else self.arm_m,
                weight=at.fraction[rows] if is_between else None,
                offset_in_world_m=at.offset_m[rows] if is_between else None,
                interval_s=at.interval_s[rows[0]] if is_between and clock_is_free else None,
                share=(adjustment.pixel_stddev / self.inflation) ** 2,
                loss_scale=self.loss.width,
            )
            further = [blocks[ARM]] if arm_is_free else []
            further += [blocks[CLOCK]] if is_between and clock_is_free else []
            solver.add_residual_block(adjustment.adjuster, cost, None, [*(poses[end] for end in ends), *further])

    def like(self, other: AntennaPositions) -> AntennaPositions:
        return replace(self, factor=other.factor, inflation=other.inflation)

    def under(self, loss: RobustLoss) -> AntennaPositions:
        return replace(self, loss=loss)

    def with_noise_of(self, residual: Array, num_absorbed: float) -> AntennaPositions:
        shown = replace(self, factor=self._shown(residual, num_absorbed))
        scaled = shown.weights.whitened(residual)
        weights = np.repeat(self.loss.weights(np.linalg.norm(scaled, axis=1)), 3)
        groups = (3 * self.group[:, None] + np.arange(3)).ravel()
        return replace(shown, inflation=correlation_inflation(scaled.ravel(), weights, groups, np.ones(scaled.size)))

    def _shown(self, residual: Array, num_absorbed: float) -> float:
        """Return the factor of the standard deviations that residuals show; arguments as for ``with_noise_of``."""
        scaled = np.einsum("gij,gj->gi", self.root_information, residual)
        return factor_of_stddevs(scaled, num_absorbed)

    def change(self, other: AntennaPositions) -> float:
        mine, others = (of.inflation * np.maximum(of.factor, of.stated_share) for of in (self, other))
        return float(np.max(np.abs(np.log(mine / others))))

    def log_likelihood(self, residual: Array) -> float:
        return -residual.size * float(np.log(max(self._shown(residual, 0.0), 1e-300)))


def _whitenings(covariances_m2: Array, stddevs_m: Array) -> Array:
    """Return (k, 3, 3) whitenings of covariances as given, but of these mean standard deviations (k,)."""
    given = np.isfinite(covariances_m2[:, :1, :1])
    shapes = np.where(given, covariances_m2, np.eye(3))
    shapes = shapes / (np.trace(shapes, axis1=1, axis2=2) / 3)[:, None, None]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(shapes * stddevs_m[:, None, None] ** 2)))


@dataclass(frozen=True)
class MarkedPositions(Measurements):
    """k marked points with known coordinates.

    Attributes:
        names: of their markers. points: to which they belong.
        position_m: (k, 3) in the metric world. stddev_m: (k,) of each coordinate.
        beyond_m2: covariance (3, 3) of errors of marks that no residual has, by name.
    """

    kind: ClassVar[str] = "control point"
    counts_in_metres: ClassVar[bool] = True

    names: tuple[str, ...]
    points: NamedPoints
    position_m: Array
    stddev_m: Array
    beyond_m2: Mapping[str, Array]

    @property
    def places_map(self) -> bool:
        return True

    @property
    def markers(self) -> Mapping[str, Marker]:
        return {name: self.points.markers[name] for name in self.names}

    @property
    def weights(self) -> Weights:
        beyond_m2 = np.array([self.beyond_m2.get(name, np.zeros((3, 3))) for name in self.names])
        roots = np.linalg.inv(np.linalg.cholesky(self.stddev_m[:, None, None] ** 2 * np.eye(3) + beyond_m2))
        return Weights(roots, np.ones(len(self.names)), LEAST_SQUARES)

    def linearize(self, state: MapState) -> Linearization:
        placed = [self.points.mark_at(name, state) for name in self.names]
        residuals = [point.position_m - at for point, at in zip(placed, self.position_m, strict=True)]
        return self.points.linearized(state, residuals, [[(np.eye(3), point)] for point in placed])

    def with_errors_of_marks(self, beyond_m2: Mapping[str, Array]) -> Self:
        return replace(self, beyond_m2=beyond_m2)

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        roots = adjustment.pixel_stddev * self.weights.root_information
        for name, position_m, whitening in zip(self.names, self.position_m, roots, strict=True):
            cost = solver.joint_prior_cost(mean=position_m[None], whitening=whitening)
            solver.add_residual_block(adjustment.adjuster, cost, None, [blocks["mark", name]])
