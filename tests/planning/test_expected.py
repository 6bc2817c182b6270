"""A plan's expectations agree with what runs of such surveys state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.known import known
from tests.planning.plans import COPLANAR_M, FIVE_ANCHORS_M, Place, loop, planned

from rangesfm.diagnostics.place import by_similarity
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.measurements.lengths.lengths_on_map import BENDING
from rangesfm.planning.expected import expect
from rangesfm.planning.paths import path_through
from rangesfm.planning.planned_ranges import turned_out, why_place_is_open
from rangesfm.util.geometry.similarity import Similarity


@pytest.mark.parametrize(
    ("anchors_m", "frame", "rate_hz"),
    [(FIVE_ANCHORS_M, "first_camera", 5.0), (FIVE_ANCHORS_M[:1], "unknown", 20.0)],
    ids=["five known anchors", "one unknown anchor"],
)
def test_the_expected_stddev_of_the_scale_is_what_runs_state(
    anchors_m: tuple[Place, ...], frame: str, rate_hz: float
) -> None:
    plan = planned(anchors_m, frame, loop(30.0, 60), rate_hz=rate_hz)
    assert plan.num_alike == 1
    expected = expect(plan)
    path = plan.trajectory
    first = Similarity(1.0, path.world_from_cam[0], path.centers[0]).inverse()
    told = [replace(a, position_m=first.apply(at)) for a, at in zip(plan.anchors, plan.anchors_m, strict=True)]
    stated = [
        initialize_scale(turned_out(known(expected.on_map), seed), path, told, anchor_frame=frame).uncertainty.empirical
        for seed in range(5)
    ]
    assert expected.uncertainty.empirical == pytest.approx(np.median(stated), rel=0.3)


def test_the_expected_place_is_as_certain_as_runs_state() -> None:
    plan = planned(FIVE_ANCHORS_M, "site", loop(30.0, 60))
    expected = expect(plan)
    stated = []
    for seed in range(3):
        estimate = initialize_scale(
            turned_out(known(expected.on_map), seed), plan.trajectory, plan.anchors, anchor_frame="site", seed=seed
        )
        assert estimate.placement is not None
        of_keyframes = by_similarity(estimate.placement, plan.trajectory.centers)[1]
        stated.append(np.sqrt(np.trace(of_keyframes, axis1=1, axis2=2).max()))
    assert expected.worst_keyframe_m == pytest.approx(np.median(stated), rel=0.3)


def test_ranges_that_stand_for_several_say_what_all_would() -> None:
    plan = planned(FIVE_ANCHORS_M, "site", rate_hz=20.0)
    thinned = expect(plan)
    assert plan.num_alike > 1
    every = replace(plan, max_num_ranges=100_000)
    assert every.num_alike == 1
    whole = expect(every)
    num_whole, num_thinned = (len(turned_out(known(each.on_map), 0).log) for each in (whole, thinned))
    assert num_whole > 2 * num_thinned
    assert thinned.uncertainty.empirical == pytest.approx(whole.uncertainty.empirical, rel=0.05)
    assert thinned.worst_keyframe_m == pytest.approx(whole.worst_keyframe_m, rel=0.05)


def test_anchors_at_the_height_of_a_level_path_leave_the_height_open() -> None:
    path = loop(height_amplitude_m=0.0)
    level = replace(path, centers=path.centers * [1.0, 1.0, 0.0] + [0.0, 0.0, 1.6])
    of_map = expect(planned(COPLANAR_M, "site", level)).map_stddevs
    assert of_map is not None
    x_m, y_m, z_m = of_map[4:]
    assert max(x_m, y_m) < 0.1
    assert np.isinf(z_m)


def test_a_flat_path_below_anchors_of_one_height_has_a_mirror_image() -> None:
    path = loop(height_amplitude_m=0.0)
    at_the_ceiling = tuple((x, y, 3.0) for x, y, _ in COPLANAR_M)
    why, nothing = (
        why_place_is_open(known(expect(planned(anchors_m, "site", path)).on_map))
        for anchors_m in (at_the_ceiling, FIVE_ANCHORS_M)
    )
    assert "mirror image" in why
    assert nothing == ""


def test_one_unknown_anchor_beside_a_short_straight_path_is_refused_as_a_run_would() -> None:
    straight = path_through([(0.0, 0.0, 1.6), (2.0, 0.0, 1.6)], speed_m_per_s=0.25, photo_rate_hz=2.0)
    expected = expect(planned([(1.0, 8.0, 1.6)], "unknown", straight))
    with pytest.raises(GeometryError, match=r"only known to .* nearly straight"):
        _ = expected.verdict


def test_an_unknown_anchor_in_line_with_a_straight_path_leaves_the_scale_as_open_as_in_a_run() -> None:
    straight = path_through([(0.0, 0.0, 1.6), (8.0, 0.0, 1.6)], speed_m_per_s=0.5, photo_rate_hz=2.0)
    in_line = planned([(14.0, 0.0, 1.6)], "unknown", straight, rate_hz=20.0)
    expected = expect(in_line)
    stated = initialize_scale(turned_out(known(expected.on_map), 0), straight, in_line.anchors, anchor_frame="unknown")
    assert expected.uncertainty.empirical == pytest.approx(stated.uncertainty.empirical, rel=0.3)


def test_what_is_known_of_the_radio_counts() -> None:
    usual = expect(planned(FIVE_ANCHORS_M, "site"))
    better = expect(planned(FIVE_ANCHORS_M, "site", component_stddevs={"tag_antenna": 0.0025}))
    assert better.uncertainty.components["tag_antenna"] < 0.2 * usual.uncertainty.components["tag_antenna"]
    assert better.uncertainty.empirical < 0.95 * usual.uncertainty.empirical
    # A radio that is noisier than usual has larger errors of all kinds, as in a run.
    noisy = expect(planned(FIVE_ANCHORS_M, "site", component_stddevs={"white": 0.4}))
    assert noisy.uncertainty.components["curve"] > 3 * usual.uncertainty.components["curve"]


def test_a_taped_length_makes_the_scale_no_better_than_itself_and_the_bending_of_the_map() -> None:
    taped = expect(planned(FIVE_ANCHORS_M, "site", taped=((5.0, 0.005),)))
    # 5 mm in 5 m, and the bending of the map between the ends.
    assert 0.5 * BENDING < taped.uncertainty.components["tape"] < 1.5 * BENDING
    assert 0.5 * BENDING < taped.uncertainty.empirical < 1.5 * BENDING
