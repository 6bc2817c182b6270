"""Which way is up: a user's word on the first camera, as a prior on how the map stands in the site frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rangesfm.ranging.anchors import Anchor, AnchorEstimate

Array = npt.NDArray[np.float64]

UP_IN_SITE = np.array([0.0, 0.0, 1.0])
# A camera that somebody held level, or a phone's accelerometer.
_STDDEV_DEG = 3.0


@dataclass(frozen=True)
class Gravity:
    """The upward direction in the model's world, which is +z in the site frame.

    Attributes:
        up_in_model: (3,) unit vector.
        stddev: of its direction, radians.
    """

    up_in_model: Array
    stddev: float

    def residuals(self, rotation: Array) -> Array:
        """(3,) in stddevs, for metric_from_model's rotation."""
        off: Array = (rotation @ self.up_in_model - UP_IN_SITE) / self.stddev
        return off

    def jacobian(self, rotation: Array, left: Array) -> Array:
        """(3, 3) by the rotation vector; ``left`` is its left Jacobian."""
        x, y, z = rotation @ self.up_in_model
        cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
        slope: Array = -cross @ left / self.stddev
        return slope

    def level_rotations(self, num: int) -> Rotation:
        """All headings, evenly, of a map that stands upright."""
        upright, _ = Rotation.align_vectors(UP_IN_SITE[None], self.up_in_model[None])
        headings = Rotation.from_euler("z", np.linspace(0.0, 2 * np.pi, num, endpoint=False)[:, None])
        return headings * upright


def levelled_places(gravity: Gravity, surveyed: Sequence[Anchor], found: Sequence[AnchorEstimate]) -> tuple[str, ...]:
    """In words, what gravity adds where the site's anchors do not fix the map's heading.

    Args:
        surveyed: in the site frame. found: in the first camera's frame.
    """
    height_of = {anchor.anchor_id: anchor.position_m[2] for anchor in surveyed if anchor.position_m is not None}
    texts = []
    for anchor in found:
        if anchor.anchor_id not in height_of or not np.isfinite(anchor.position_m).all():
            continue
        wheres = []
        for place in (anchor.position_m, anchor.mirror_position_m):
            if place is not None:
                rise = float(place @ gravity.up_in_model)
                away = float(np.linalg.norm(place - rise * gravity.up_in_model))
                wheres.append(f"at site height {height_of[anchor.anchor_id] - rise:.2f} m, {away:.2f} m horizontally")
        # On the path's plane an anchor is its own mirror image.
        where = " or ".join(dict.fromkeys(wheres))
        texts.append(
            f"the first camera was {where} from anchor {anchor.anchor_id}; in which direction is not determined"
        )
    return tuple(texts)


def gravity_of(up_in_first_camera: tuple[float, float, float] | None) -> Gravity | None:
    """The prior of a survey whose model's world is the first camera's frame."""
    if up_in_first_camera is None:
        return None
    up = np.array(up_in_first_camera, dtype=np.float64)
    return Gravity(up / np.linalg.norm(up), np.deg2rad(_STDDEV_DEG))
