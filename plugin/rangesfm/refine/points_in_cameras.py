"""3-D points that lie in a camera: what a mapper makes, now and then, of wrong matches of photos from one place.

A feature goes by its point's place over the depth. At next to no depth, what such a point says about one photo is so
much more than all else that rounding it makes a solver's matrix indefinite in all but timid steps; one of 50 000 does.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from rangesfm.refine.vision_information import Observations, Poses, project

# Of the median depth. What a point says goes by the square.
_MIN_DEPTH = 1e-4


def points_in_cameras(observations: Observations, poses: Poses) -> npt.NDArray[np.bool_]:
    """(p,) whether a point of the model lies in a camera that sees it."""
    depth = project(observations, poses, observations.points)[1][:, 2]
    in_camera: npt.NDArray[np.bool_] = np.zeros(len(observations.points), dtype=np.bool_)
    in_camera[observations.point[np.abs(depth) < _MIN_DEPTH * np.median(np.abs(depth))]] = True
    return in_camera
