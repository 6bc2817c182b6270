"""Measured lengths as measurements of the map: taped ones between named points, and ranges between anchors."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import pycolmap

from rangesfm import solver
from rangesfm.arrays import Array
from rangesfm.measurements.kind import (
    LEAST_SQUARES,
    Block,
    ByBlock,
    Linearization,
    MapState,
    Measurements,
    Weights,
)
from rangesfm.measurements.lengths.tape import Marker, Tape
from rangesfm.measurements.points import NamedPoints, images_by_name, variance_along
from rangesfm.measurements.prior import Prior
from rangesfm.solver.bundle_adjustment import BundleAdjustment
from rangesfm.util.geometry.robust_statistics import RobustLoss
from rangesfm.util.geometry.trajectory import pose_of

BETWEEN_ANCHORS: Block = ("bias", "between anchors")
_TINY_M = 1e-9

if TYPE_CHECKING:
    from typing_extensions import Self


@dataclass(frozen=True)
class Lengths(Measurements):
    """k lengths between points.

    Attributes:
        ends: names of both ends of each. points: to which they belong.
        length_m, stddev_m: (k,).
        beyond_m2: covariance (3, 3) of errors of marks that no residual has, by name.
        bias_stddev_m: of the bias that all share, as ranges between anchors do; 0: there is none.
        loss: of each length.
    """

    kind: ClassVar[str] = "length"
    counts_in_metres: ClassVar[bool] = True

    ends: tuple[tuple[str, str], ...]
    points: NamedPoints
    length_m: Array
    stddev_m: Array
    beyond_m2: Mapping[str, Array]
    bias_stddev_m: float = 0.0
    loss: RobustLoss = LEAST_SQUARES

    @property
    def markers(self) -> Mapping[str, Marker]:
        return self.points.marked(name for of in self.ends for name in of)

    @property
    def blocks(self) -> Mapping[Block, Array]:
        bias = {BETWEEN_ANCHORS: np.zeros(1)} if self.bias_stddev_m > 0 else {}
        return bias | {name: np.zeros(3) for name in self.fixed}

    @property
    def fixed(self) -> frozenset[Block]:
        return frozenset(_origin(name) for names in self.ends if self._is_in_rig(names) for name in names)

    def priors(self) -> Iterator[Prior]:
        """Yield what is known of the blocks."""
        if self.bias_stddev_m > 0:
            yield Prior.of_one(BETWEEN_ANCHORS, np.zeros(1), self.bias_stddev_m)

    @property
    def weights(self) -> Weights:
        return Weights(1 / self.stddev_m[:, None, None], np.ones(len(self.ends)), self.loss)

    def linearize(self, state: MapState) -> Linearization:
        residuals, slopes = [], []
        bias_m = float(state.blocks[BETWEEN_ANCHORS][0]) if self.bias_stddev_m > 0 else 0.0
        for names, length_m in zip(self.ends, self.length_m.tolist(), strict=True):
            start, end = (self.points.at(name, state) for name in names)
            apart = end.position_m - start.position_m
            distance_m = float(np.linalg.norm(apart))
            along = apart[None] / max(distance_m, _TINY_M)
            residuals.append(np.array([distance_m + bias_m - length_m]))
            slopes.append([(-along, start), (along, end)])
        found = self.points.linearized(state, residuals, slopes)
        if not self.bias_stddev_m > 0:
            return found
        num = len(residuals)
        of_bias = ByBlock((BETWEEN_ANCHORS,), np.zeros(num, dtype=np.int64), np.ones((num, 1, 1)))
        return Linearization(found.residual, found.pose, found.by_pose, (*found.by_block, of_bias))

    def with_errors_of_marks(self, beyond_m2: Mapping[str, Array]) -> Self:
        return replace(self, beyond_m2=beyond_m2)

    def add_to(self, adjustment: BundleAdjustment, poses: list[Array], blocks: Mapping[Block, Array]) -> None:
        images = images_by_name(adjustment.metric)
        for row, names in enumerate(self.ends):
            if self._is_in_rig(names):
                start, end = (_of_rig(adjustment.metric, images[name], blocks[_origin(name)]) for name in names)
            else:
                start, end = (self._of_world(adjustment, name, images, blocks) for name in names)
            beyond_m2 = sum((self.beyond_m2.get(name, np.zeros((3, 3))) for name in names), np.zeros((3, 3)))
            variance_m2 = self.stddev_m[row] ** 2 + variance_along(start.place_m, end.place_m, beyond_m2)
            cost = solver.distance_cost(
                distance_m=self.length_m[row],
                stddev_m=float(np.sqrt(variance_m2)) / adjustment.pixel_stddev,
                a_in_cam_m=start.in_rig_m,
                b_in_cam_m=end.in_rig_m,
                has_bias=self.bias_stddev_m > 0,
                loss_scale=self.loss.width * adjustment.pixel_stddev,
            )
            bias = [blocks[BETWEEN_ANCHORS]] if self.bias_stddev_m > 0 else []
            solver.add_residual_block(adjustment.adjuster, cost, None, [start.block, end.block, *bias])

    def _is_in_rig(self, names: tuple[str, str]) -> bool:
        """Return whether both ends are cameras of one rig at one time, whose length is that of the rig."""
        frames = [self.points.views[name].keyframe for name in names if name in self.points.views]
        return len(frames) == 2 and frames[0] == frames[1]

    def _of_world(
        self,
        adjustment: BundleAdjustment,
        name: str,
        images: Mapping[str, pycolmap.Image],
        blocks: Mapping[Block, Array],
    ) -> _End:
        if name in images:
            image = images[name]
            pose = pose_of(adjustment.metric.frame(image.frame_id))
            return _End(pose.params, pose * image.projection_center(), image.projection_center())
        block = blocks.get(("mark", name), blocks.get(("anchor", name)))
        assert block is not None, "the ends were found"
        return _End(block, None, block)


@dataclass(frozen=True)
class _End:
    """One end of a length in the bundle adjustment.

    Attributes:
        block: parameter block of a point, or of a rig's pose.
        in_rig_m: (3,) position of the end in that rig; None if the block is the end.
        place_m: (3,) in the metric world.
    """

    block: Array
    in_rig_m: Array | None
    place_m: Array


def _of_rig(metric: pycolmap.Reconstruction, image: pycolmap.Image, origin: Array) -> _End:
    """Return a camera in its rig; the reference camera is the rig's origin."""
    sensor, rig = image.data_id.sensor_id, metric.rig(metric.frame(image.frame_id).rig_id)
    # The pose itself is needed as a parameter block: sensor_from_rig() returns a copy.
    pose = None if rig.is_ref_sensor(sensor) else rig.non_ref_sensors[sensor]
    center_m = image.projection_center()
    return _End(origin, None, center_m) if pose is None else _End(pose.params, np.zeros(3), center_m)


def _origin(name: str) -> Block:
    return "rig origin", name


def taped_lengths(tape: Tape, points: NamedPoints) -> Iterator[Lengths]:
    """Yield the control lengths of a tape whose ends are in a map, if there are any."""
    taped = [each for each in tape.control().distances if all(name in points for name in each.ends)]
    if taped:
        ends, lengths_m = tuple(each.ends for each in taped), np.array([each.distance_m for each in taped])
        yield Lengths(ends, points, lengths_m, np.array([each.stddev_m for each in taped]), {})
