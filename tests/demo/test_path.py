"""A camera's path goes through the poses that it is given."""

from __future__ import annotations

import numpy as np
from tests.simulated.path import loop_path

from rangesfm.demo.ranges import CameraPath


def test_path_goes_through_the_given_poses() -> None:
    whole = loop_path(20.0, seed=4)
    times = np.linspace(0.0, 20.0, 9)
    path = CameraPath.through(times, whole.centers(times), whole.world_from_cam(times))
    np.testing.assert_allclose(path.centers(times), whole.centers(times), atol=1e-12)
    np.testing.assert_allclose(path.world_from_cam(times), whole.world_from_cam(times), atol=1e-9)
