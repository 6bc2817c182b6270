"""The photos of a planned path limit how far its map can bend, and make its keyframes as certain as they allow."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from tests.planning.plans import FIVE_ANCHORS_M, free_bend_m, loop, planned

from rangesfm.planning.expected import Expected, expect
from rangesfm.planning.paths import path_through
from rangesfm.planning.planned_photos import PlannedPhotos
from rangesfm.solver.bending import BENDS

OPEN = PlannedPhotos(num_points=60, feature_stddev=0.001)


def seen_by(photos: PlannedPhotos, frame: str = "site") -> Expected:
    num_anchors = 5 if frame == "site" else 1
    return expect(replace(planned(FIVE_ANCHORS_M[:num_anchors], frame, loop(30.0, 60)), photos=photos))


def test_every_point_is_in_the_picture_of_the_photos_that_find_it() -> None:
    path = loop(30.0, 60)
    rays = OPEN.observations(path)
    half_width = np.tan(np.deg2rad(OPEN.field_of_view_deg / 2))
    assert np.abs(rays.ray[:, 0]).max() < half_width
    assert np.bincount(rays.point).min() >= 2
    # Nearly every photo has as many points as asked for.
    assert np.median(np.bincount(rays.frame, minlength=60)) == OPEN.num_points
    in_a_row = np.diff(rays.frame)[np.diff(rays.point) == 0]
    assert set(in_a_row.tolist()) == {1}
    assert np.bincount(rays.point).max() == OPEN.num_photos_of_point


def test_a_loop_that_is_closed_bends_less() -> None:
    blurred = OPEN.changed(feature_stddev=0.01)
    assert free_bend_m(seen_by(blurred.changed(closes_loops=True))) < 0.7 * free_bend_m(seen_by(blurred))


def test_the_bend_grows_with_the_noise_of_features_and_with_fewer_points() -> None:
    sharp, blurred = seen_by(OPEN.changed(feature_stddev=0.01)), seen_by(OPEN.changed(feature_stddev=0.02))
    assert free_bend_m(blurred) == pytest.approx(2 * free_bend_m(sharp), rel=0.05)
    assert free_bend_m(seen_by(OPEN.changed(feature_stddev=0.01, num_points=15))) > 1.5 * free_bend_m(sharp)


def test_a_walk_around_corners_is_photographed_without_a_break() -> None:
    square = [(3.0, 3.0, 1.4), (-3.0, 3.0, 1.9), (-3.0, -3.0, 1.4), (3.0, -3.0, 1.9), (3.0, 3.0, 1.4)]
    walk = path_through(square, speed_m_per_s=0.6, photo_rate_hz=2.0)
    rigid = planned(FIVE_ANCHORS_M, "site", walk)
    bending, stiff = expect(replace(rigid, photos=PlannedPhotos())), expect(rigid)
    assert bending.uncertainty.empirical < 1.2 * stiff.uncertainty.empirical
    assert bending.verdict.verdict == "good"


def test_ranges_straighten_a_map_that_bends() -> None:
    expected = seen_by(OPEN.changed(feature_stddev=0.05))
    assert 0.02 < float(np.sqrt(np.mean(expected.keyframe_stddevs_m**2))) < 0.7 * free_bend_m(expected)


def test_the_first_camera_stays_where_it_is_and_the_path_drifts_away_from_it() -> None:
    stddevs_m = seen_by(OPEN.changed(feature_stddev=0.01), "first_camera").keyframe_stddevs_m
    assert stddevs_m[0] < 1e-6
    assert stddevs_m[10] < stddevs_m[25]


def test_photos_as_sharp_as_can_be_are_a_rigid_map() -> None:
    expected = seen_by(OPEN.changed(feature_stddev=1e-5))
    not_bent = dict.fromkeys(BENDS, 0.0)
    rigid = expect(replace(expected.planned, photos=None, component_stddevs=not_bent))
    assert expected.uncertainty.empirical == pytest.approx(rigid.uncertainty.empirical, rel=1e-3)
    np.testing.assert_allclose(expected.keyframe_stddevs_m, rigid.keyframe_stddevs_m, rtol=0.1)
