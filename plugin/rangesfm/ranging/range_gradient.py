"""The distance from an anchor to the tag, and by how much it grows with whatever moves either."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rangesfm.arrays import Array

_TINY_DISTANCE_M = 1e-9


@dataclass(frozen=True)
class RangeGradient:
    """Of n distances ``|| tag - anchor ||`` in the metric world; a range's bias adds to it as it is, so with slope 1.

    Attributes:
        distance_m: (n,).
        by_tag: (n, 3) by the tag's place: the unit vector from anchor to tag; zero where one lies on the other and the
            distance has no derivative, which keeps steps finite.
    """

    distance_m: Array
    by_tag: Array

    @classmethod
    def of(cls, from_anchor_m: Array) -> RangeGradient:
        """Of vectors (n, 3) from anchor to tag."""
        distance = np.sqrt(np.einsum("ni,ni->n", from_anchor_m, from_anchor_m))
        return cls(distance, from_anchor_m / np.maximum(distance, _TINY_DISTANCE_M)[:, None])

    @property
    def by_anchor(self) -> Array:
        """(n, 3) by the anchor's place."""
        return -self.by_tag

    def by_log_scale(self, scaled_m: Array) -> Array:
        """(n,) by the logarithm of a scale, of which (n, 3) is what it has scaled of the tags' places."""
        slopes: Array = np.einsum("ni,ni->n", self.by_tag, scaled_m)
        return slopes

    def by_turn_of_world(self, arms_m: Array) -> Array:
        """(n, 3) by a rotation vector from the left, about an origin from which the tags are at (n, 3)."""
        return np.cross(arms_m, self.by_tag)

    def by_tag_in_cam(self, world_from_cam: Array) -> Array:
        """(n, 3) by the lever arm, of cameras with rotations (n, 3, 3)."""
        slopes: Array = np.einsum("nji,nj->ni", world_from_cam, self.by_tag)
        return slopes

    def by_turn_of_cam(self, tag_in_cam_m: Array, world_from_cam: Array) -> Array:
        """(n, 3) by a rotation vector of the camera in its own frame, its centre kept; lever arms (n, 3)."""
        return np.cross(tag_in_cam_m, self.by_tag_in_cam(world_from_cam))
