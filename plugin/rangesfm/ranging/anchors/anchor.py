"""Anchor: a static radio node, with what is known of it."""

from __future__ import annotations

from dataclasses import dataclass

from rangesfm.arrays import Array


@dataclass(frozen=True)
class Anchor:
    """A static UWB node.

    Attributes:
        anchor_id: as in the log.
        position_m: (3,) antenna in the anchors' frame, metres; None if nobody measured it.
        position_stddev_m: of each coordinate; 0 means exact.
        range_bias_m: prior mean of what its ranges read too long (antenna delay).
        range_bias_stddev_m: prior stddev of that bias; None means the option's default.
    """

    anchor_id: str
    position_m: Array | None = None
    position_stddev_m: float = 0.0
    range_bias_m: float = 0.0
    range_bias_stddev_m: float | None = None


@dataclass(frozen=True)
class AnchorEstimate:
    """An anchor in the metric frame of a result, and what was known of it there.

    Attributes:
        position_m: (3,); NaN for an unknown one with too few ranges.
        position_stddev_m: of each coordinate, root of their mean variance; 0 for one that was held fixed.
        prior_position_m, prior_position_stddev_m: as surveyed, in the same frame; None and inf if unknown.
        range_bias_m: what its ranges read too long.
        prior_bias_m, prior_bias_stddev_m: of the bias, but for what all anchors share; stddev 0 fixes it.
        mirror_position_m: the other place that fits as well; None if there is none.
        position_covariance_m2: (3, 3) by the ranges alone, before any refinement; None if not known.
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
    position_covariance_m2: Array | None = None
