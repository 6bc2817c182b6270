"""Anchor: a static radio node with what is known of it, and the estimate of one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from rangesfm.arrays import Array
from rangesfm.util.geometry.similarity import Similarity


@dataclass(frozen=True)
class Anchor:
    """A static UWB node.

    Attributes:
        anchor_id: id in the log.
        position_m: (3,) antenna in the anchors' frame, metres; None if unknown.
        position_stddev_m: standard deviation of each coordinate; 0 means exact.
        range_bias_m: prior mean of the bias of its ranges, positive if they are too long (antenna delay).
        range_bias_stddev_m: prior standard deviation of that bias; None means the option's default.
    """

    anchor_id: str
    position_m: Array | None = None
    position_stddev_m: float = 0.0
    range_bias_m: float = 0.0
    range_bias_stddev_m: float | None = None


@dataclass(frozen=True)
class AnchorEstimate:
    """Estimate of an anchor in the metric frame of a result, with its prior.

    Attributes:
        anchor_id: id in the log.
        position_m: (3,) position; NaN for an unknown anchor with too few ranges.
        position_stddev_m: root of the mean variance of the three coordinates; 0 for an anchor that was held fixed.
        prior_position_m, prior_position_stddev_m: surveyed position in the same frame and the standard deviation of
            each coordinate; None and inf if unknown.
        range_bias_m: bias of its ranges, positive if they are too long.
        prior_bias_m, prior_bias_stddev_m: prior of the bias, without the part that all anchors share; a standard
            deviation of 0 fixes it.
        mirror_position_m: mirror image that fits as well; None if there is none.
        position_covariance_m2: (3, 3) covariance by the ranges alone, before any refinement; 0 for an anchor that was
            held fixed.
    """

    anchor_id: str
    position_m: Array
    position_stddev_m: float
    prior_position_m: Array | None
    prior_position_stddev_m: float
    range_bias_m: float
    prior_bias_m: float
    prior_bias_stddev_m: float
    mirror_position_m: Array | None = None
    position_covariance_m2: Array = field(default_factory=lambda: np.zeros((3, 3)))

    def moved(self, motion: Similarity) -> AnchorEstimate:
        """Return it carried into another frame by a rigid motion."""
        prior_m, mirror_m, turn = self.prior_position_m, self.mirror_position_m, motion.rotation
        return replace(
            self,
            position_m=motion.apply(self.position_m),
            prior_position_m=None if prior_m is None else motion.apply(prior_m),
            mirror_position_m=None if mirror_m is None else motion.apply(mirror_m),
            position_covariance_m2=turn @ self.position_covariance_m2 @ turn.T,
        )

    def mirror_moved(self, change: Similarity) -> AnchorEstimate:
        """Return it with its mirror image, if there is one, where a similarity moves that."""
        mirror_m = self.mirror_position_m
        return self if mirror_m is None else replace(self, mirror_position_m=change.apply(mirror_m))


def default_anchor_frame(anchors: Sequence[Anchor]) -> str:
    """Return the frame of anchors for which the user gave none: "site" if any position is known, else "unknown"."""
    return "site" if any(anchor.position_m is not None for anchor in anchors) else "unknown"
