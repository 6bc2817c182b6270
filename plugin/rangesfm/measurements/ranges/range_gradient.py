"""Distance from an anchor to the tag, and its derivatives by everything that moves either of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array

_TINY_DISTANCE_M = 1e-9


@dataclass(frozen=True)
class RangeGradient:
    """Derivatives of n distances ``|| tag - anchor ||`` in the metric world.

    The derivative by a range bias is 1, because the bias is added to the distance.

    Attributes:
        distance_m: (n,) distances.
        by_tag: (n, 3) derivative by the tag's position, the unit vector from anchor to tag. It is zero where both
            coincide and the distance has no derivative, which keeps the steps of a solver finite.
    """

    distance_m: Array
    by_tag: Array

    @classmethod
    def of(cls, from_anchor_m: Array) -> RangeGradient:
        """Compute distances and derivatives from the vectors (n, 3) from anchor to tag, metres."""
        distance = np.sqrt(np.einsum("ni,ni->n", from_anchor_m, from_anchor_m))
        return cls(distance, from_anchor_m / np.maximum(distance, _TINY_DISTANCE_M)[:, None])

    @property
    def by_anchor(self) -> Array:
        """Derivative by the anchor's position (n, 3)."""
        return -self.by_tag

    def by_log_scale(self, scaled_m: Array) -> Array:
        """Return the derivative (n,) by a scale's logarithm, given the scaled part (n, 3) of the tags' positions."""
        slopes: Array = np.einsum("ni,ni->n", self.by_tag, scaled_m)
        return slopes

    def by_turn_of_world(self, arms_m: Array) -> Array:
        """Return the derivative (n, 3) by a rotation of the world about a point, with the tags at ``arms_m`` from it.

        The rotation vector is applied from the left.
        """
        return np.cross(arms_m, self.by_tag)

    def by_tag_in_cam(self, world_from_cam: Array) -> Array:
        """Return the derivative (n, 3) by the lever arm, given the cameras' rotations (n, 3, 3)."""
        slopes: Array = np.einsum("nji,nj->ni", world_from_cam, self.by_tag)
        return slopes
