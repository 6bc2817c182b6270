"""Positions known in the site, found in a model: of marks that its photos show, and of an antenna on its path."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.sparse import csr_array, vstack

from rangesfm.arrays import Array, Mask
from rangesfm.measurements.places import AntennaPlaces
from rangesfm.util.geometry.similarity import Similarity

LASTING_S = (3.0, 30.0, 300.0)
"""Times for which errors of an antenna's positions last, seconds: those of filters and reflections for seconds, those
of the troposphere, of satellites and of echoes in a hall for minutes. A mixture follows any time between."""

MIN_NUM_POSITIONS = 3
"""Fewest positions, not on one line, that determine a similarity."""

LOOK_AGAIN = "look whether its coordinates were mistyped, or its marks are of another point"
"""What to do about a control point that contradicts the others."""


@dataclass(frozen=True)
class KnownPositions:
    """k positions in the site, each with the place of the same thing in a model.

    In the site the place is ``scale * R c + R a + t``, with c the place in the model, a the lever arm and
    (scale, R, t) the similarity from the model's world to the site.

    Attributes:
        names: of marks; the photo or the time of an antenna's positions.
        is_mark: (k,) whether it is a mark; otherwise it is the antenna.
        is_check: (k,) positions that do not take part in the estimate.
        position_m: (k, 3) in the site. covariance_m2: (k, 3, 3) of these; NaN where it is unknown.
        places: (k, 3) in the model's world and unit. arms_m: (k, 3) lever arms in the axes of the model's world.
        own_covariance: (k, 3, 3) of the places, in the model's world and unit, without errors of the poses.
        arm_stddev_m: (k,) of each coordinate of the arms.
        time_s: (k,) on the photos' clock, or the number of the photo where these have no times; NaN for marks.
        velocity: (k, 3) of the antenna, model units per second; 0 for marks.
        world_from_cam: (k, 3, 3) rotations of the camera; 0 for marks.
        by_pose, arms_by_pose: (3 k, 6 n) sparse derivatives of places and arms by the n poses of a path: for each, a
            turn in its own frame and a shift, in the model's world and unit.
        on_path: places of the camera on its path; none for marks.
    """

    names: tuple[str, ...]
    is_mark: Mask
    is_check: Mask
    position_m: Array
    covariance_m2: Array
    places: Array
    arms_m: Array
    own_covariance: Array
    arm_stddev_m: Array
    time_s: Array
    velocity: Array
    world_from_cam: Array
    by_pose: csr_array
    arms_by_pose: csr_array
    on_path: AntennaPlaces

    def __len__(self) -> int:
        return len(self.names)

    def joined(self, others: KnownPositions) -> KnownPositions:
        """Return these positions followed by others in the same model."""
        both: dict[str, Any] = {name: np.concatenate([getattr(self, name), getattr(others, name)]) for name in _ARRAYS}
        both |= {name: vstack([getattr(self, name), getattr(others, name)], format="csr") for name in _SPARSE}
        return KnownPositions(self.names + others.names, **both, on_path=self.on_path.joined(others.on_path))

    def predicted_m(self, site_from_model: Similarity) -> Array:
        """Return the (k, 3) positions in the site."""
        return np.asarray(site_from_model.apply(self.places) + self.arms_m @ site_from_model.rotation.T)

    def misclosures_m(self, site_from_model: Similarity) -> Array:
        """Return the (k, 3) differences: in the map minus known."""
        return self.predicted_m(site_from_model) - self.position_m


_SPARSE = ("by_pose", "arms_by_pose")
_ARRAYS = tuple(field.name for field in fields(KnownPositions) if field.name not in ("names", "on_path", *_SPARSE))
