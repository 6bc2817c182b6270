"""What errors of the ranges would do to the scale, as plain data."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class ScaleSensitivity:
    """Change of the scale, in percent, per error of the range model; estimated biases absorb their part of it.

    Attributes:
        common_bias_per_cm: if all ranges were a centimetre longer.
        short_range_per_cm: if the shorter half of the ranges were a centimetre longer.
        anchor_bias_per_cm: by anchor id, if the ranges to that anchor were a centimetre longer.
        range_slope_per_percent: if all ranges were one percent longer.
        lever_arm_per_cm: if the tag sat a centimetre further along x, y, z of the camera.
    """

    common_bias_per_cm: float
    short_range_per_cm: float
    anchor_bias_per_cm: dict[str, float]
    range_slope_per_percent: float
    lever_arm_per_cm: tuple[float, float, float]


NOT_KNOWN = ScaleSensitivity(0.0, 0.0, {}, 0.0, (0.0, 0.0, 0.0))
