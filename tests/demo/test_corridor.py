"""The corridor's photos show its walls where they are, and its path comes back after a long way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy import ndimage
from scipy.spatial.distance import cdist
from tests.known import known
from tests.outputs import names_in

from rangesfm.demo.corridor import FOCAL_PX, NUM_PHOTOS, SIZE_PX, _walk, make_corridor_survey, render
from rangesfm.demo.survey import TAG_IN_CAM_M, TIME_OFFSET_S, DemoSurvey
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.sfm.image_times import read_image_times_csv
from rangesfm.survey.survey_reader import read_survey
from rangesfm.util.geometry.reference import read_reference

NUM_MADE = 3


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> DemoSurvey:
    return make_corridor_survey(tmp_path_factory.mktemp("demo") / "corridor", num_photos=NUM_MADE)


def test_it_is_a_whole_survey_of_photos_that_are_matched_with_neighbours_alone(made: DemoSurvey) -> None:
    assert set(names_in(made.folder / "images")) == set(made.image_names)
    survey = read_survey(made.survey_path, {})
    assert (survey.mapper.matching, survey.mapper.close_loops) == ("sequential", True)
    times = read_image_times_csv(made.folder / "images.csv")
    assert (times.image_names, times.timestamps_s.tolist()) == (made.image_names, made.timestamps_s.tolist())
    size = known(pycolmap.Bitmap.read(made.folder / "images" / made.image_names[0], as_rgb=False))
    assert (size.width, size.height) == SIZE_PX
    reference = read_reference(made.folder / "reference.csv")
    np.testing.assert_allclose(reference.positions_m, made.centers_m, atol=1e-6)


def test_ranges_are_those_to_the_anchor_as_it_is_seen_from_the_first_photo(made: DemoSurvey) -> None:
    (anchor,) = read_anchors(made.folder / "anchors.csv")
    anchor_m = made.centers_m[0] + made.world_from_cam[0] @ np.asarray(anchor.position_m)
    tags_m = made.centers_m + made.world_from_cam @ np.array(TAG_IN_CAM_M)
    image_time_s = known(made.ranges.timestamp_s) + TIME_OFFSET_S
    near = [np.argsort(np.abs(image_time_s - time_s))[:5] for time_s in made.timestamps_s]  # one in ten is obstructed
    distance_m = np.linalg.norm(tags_m - anchor_m, axis=1)
    np.testing.assert_allclose(np.median(made.ranges.range_m[near], axis=1), distance_m, atol=0.1)


def test_a_spot_of_a_wall_looks_alike_in_two_photos() -> None:
    centers, world_from_cam = _walk(6)
    first, second = 3, 4
    photos = [render(centers[k], world_from_cam[k]) for k in (first, second)]
    row, column = (grid.ravel() for grid in np.mgrid[30:210:9, 40:320:9])
    in_cam = np.column_stack([column + 0.5 - SIZE_PX[0] / 2, row + 0.5 - SIZE_PX[1] / 2, np.full(row.shape, FOCAL_PX)])
    rays = in_cam @ world_from_cam[first].T
    # Of the right-hand wall, y = 0: the camera walks along it.
    multiple = -centers[first, 1] / rays[:, 1]
    spots = centers[first] + multiple[:, None] * rays
    is_seen = (multiple > 0) & (spots[:, 0] > 0) & (spots[:, 0] < 10) & (spots[:, 2] > 0.1) & (spots[:, 2] < 2.5)
    from_second = (spots[is_seen] - centers[second]) @ world_from_cam[second]
    pixel = FOCAL_PX * from_second[:, :2] / from_second[:, 2:] + np.array(SIZE_PX) / 2
    is_inside = np.all((pixel > 1) & (pixel < np.array(SIZE_PX) - 1), axis=1) & (from_second[:, 2] > 0.3)
    assert np.count_nonzero(is_inside) > 40
    there = ndimage.map_coordinates(photos[1], (pixel[is_inside] - 0.5)[:, ::-1].T, order=1)
    here = photos[0][row[is_seen][is_inside], column[is_seen][is_inside]]
    assert np.corrcoef(here, there)[0, 1] > 0.9
    assert np.std(here) > 0.05


def test_the_path_comes_back_to_its_start_and_to_no_other_place() -> None:
    centers, world_from_cam = _walk(NUM_PHOTOS)
    apart_m = cdist(centers, centers)
    assert apart_m[0, 70:].min() < 0.5
    last = 70 + int(apart_m[0, 70:].argmin())
    assert world_from_cam[0, :, 2] @ world_from_cam[last, :, 2] > 0.9
    number = np.arange(NUM_PHOTOS)
    is_between = (np.abs(number[:, None] - number) > 10) & (np.abs(number[:, None] - number) < 60)
    assert apart_m[is_between].min() > 3.0


def test_the_same_survey_is_not_made_again(made: DemoSurvey, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rangesfm.demo.corridor.render", lambda *_: pytest.fail("a photo is taken"))
    again = make_corridor_survey(Path(made.folder), num_photos=NUM_MADE)
    np.testing.assert_array_equal(again.centers_m, made.centers_m)
