"""Wrong points, antennas and frames among known positions are found with their sizes, and each is said in words."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.sparse import eye_array
from scipy.spatial.transform import Rotation
from tests.scale.test_position_equations import known_positions

from rangesfm.arrays import Array
from rangesfm.diagnostics import position_tests
from rangesfm.diagnostics.hypothesis_tests import MistakeTest
from rangesfm.geometry.similarity import Similarity, similarity_motions
from rangesfm.ranging.errors.bending import ErrorPart
from rangesfm.scale.linear_map import LinearMap
from rangesfm.scale.position_equations import PositionEquations, errors_of_sizes
from rangesfm.scale.range_equation import Columns

SITE_FROM_MODEL = Similarity(2.0, Rotation.from_rotvec([0.3, -0.4, 1.2]).as_matrix(), np.array([5.0, -3.0, 1.0]))
STDDEV_M = 0.05
NUM_MARKS, NUM_ANTENNA = 6, 9
LASTING_S = 24.0
ARM, CLOCK, DATUM = "antenna's lever arm", "antenna's clock", "datum shift"
NOTHING = np.zeros(0, dtype=np.int64)


def positions_of(
    *,
    off_m: Mapping[int, Sequence[float]] = MappingProxyType({}),
    arm_m: Array | None = None,
    late_s: float = 0.0,
    num_marks: int = NUM_MARKS,
    num_antenna: int = NUM_ANTENNA,
    is_moving: bool = True,
    clock_stddev_s: float = 0.0,
    checks: Collection[int] = (),
    left_out: Collection[int] = (),
) -> Any:
    """Positions without noise on a map that is true, as ``PositionScale`` has them; marks come first.

    Args:
        off_m: (3,) additions to some of the known positions. arm_m: (3,) in the camera, to the true lever arm.
        late_s: how late the times of the antenna's positions are.
    """
    rng, num = np.random.default_rng(0), num_marks + num_antenna
    known = known_positions([True] * num_marks + [False] * num_antenna)
    is_antenna = ~known.is_mark[:, None]
    turns = Rotation.random(num, rng=1).as_matrix()
    known = replace(
        known,
        places=rng.uniform(-5, 5, (num, 3)),
        is_check=np.isin(np.arange(num), [*checks]),
        time_s=known.time_s * LASTING_S / (NUM_ANTENNA - 1),
        velocity=np.where(is_antenna & is_moving, rng.uniform(-1, 1, (num, 3)), 0.0),
        world_from_cam=np.where(is_antenna[:, None], turns, 0.0),
        clock_stddev_s=np.full(num, clock_stddev_s),
    )
    true_m = known.predicted_m(SITE_FROM_MODEL)
    given_m = true_m.copy()
    for row, addition_m in off_m.items():
        given_m[row] += addition_m
    if arm_m is not None:
        given_m = given_m + known.world_from_cam @ arm_m @ SITE_FROM_MODEL.rotation.T
    # If the times are late, the antenna was there before them.
    given_m = given_m - late_s * SITE_FROM_MODEL.scale * known.velocity @ SITE_FROM_MODEL.rotation.T
    known = replace(known, position_m=given_m)
    is_used = ~known.is_check & ~np.isin(np.arange(num), [*left_out])
    motions = similarity_motions(true_m - true_m[0]).reshape(-1, 7)
    residual_m = known.misclosures_m(SITE_FROM_MODEL).ravel()
    linear = LinearMap(residual_m, motions, np.zeros(0), np.zeros((0, 7)), Columns(0, 1, NOTHING, NOTHING, 7))
    parts = (ErrorPart("points", STDDEV_M**2 * np.eye(3 * num)),)
    equations = PositionEquations(
        linear, parts, errors_of_sizes(parts, {"points": 1.0}), np.repeat(is_used, 3), eye_array(3 * num, format="csr")
    )
    return SimpleNamespace(
        known=known, site_from_model=SITE_FROM_MODEL, is_used=is_used, equations=equations, threshold=20.0
    )


def of_antenna(positions: Any) -> dict[str, MistakeTest]:
    return {row.name: row for row in position_tests._of_antenna(positions)}


@pytest.mark.parametrize(("share", "is_possible"), [(0.98, True), (1.02, False)])
def test_no_antenna_is_farther_than_twenty_metres_and_no_clock_off_by_more_than_the_survey_lasts(
    share: float, is_possible: bool
) -> None:
    arm = of_antenna(positions_of(arm_m=20 * share * np.array([0.0, 0.6, -0.8])))[ARM]
    clock = of_antenna(positions_of(late_s=LASTING_S * share))[CLOCK]
    assert [arm.rejected, clock.rejected] == [is_possible] * 2
    assert [arm.statistic > 0.0, clock.statistic > 0.0] == [is_possible] * 2
