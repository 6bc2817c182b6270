"""The range problem of a survey: which ranges and anchors take part, in which frame, and with what is known of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.known import known

from rangesfm.distances.locate_lengths import LocatedDistances
from rangesfm.errors import GeometryError, InputError
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.similarity import IDENTITY
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.options import RangeModelOptions
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.association import associate
from rangesfm.ranging.range_log import RangeLog
from rangesfm.ranging.range_observations import RangeObservations, RangeStatus
from rangesfm.scale import scale_problem as module
from rangesfm.scale.placement_prior import PlacementPrior
from rangesfm.scale.scale_problem import ScaleProblem, scale_problem

Array = npt.NDArray[np.float64]

PLACES_M = {"A": (6.0, 0.0, 2.5), "B": (-6.0, 1.0, 0.4), "C": (0.5, 6.0, 3.0), "D": (1.0, -6.0, 0.2)}
TAG_IN_CAM_M = np.array([0.1, -0.2, 0.3])
MODEL = RangeModelOptions(range_stddev_m=0.07, range_bias_stddev_m=0.02, common_bias_stddev_m=0.05)
GRAVITY = Gravity(np.array([0.0, 0.0, 1.0]), 0.05)
PLACEMENT = PlacementPrior(IDENTITY, np.zeros(3), np.eye(7))
HELP = " (two not above each other, with up_in_first_camera)"


def path(num: int = 6, times: Array | None = None) -> Trajectory:
    """Return a path of steps of 1, 2, 3, ... units from a place far from the origin, with turning cameras."""
    steps = np.cumsum(np.arange(num))[:, None] * [0.6, 0.0, 0.8]
    names = tuple(f"{k}.jpg" for k in range(num))
    turned = Rotation.from_rotvec(0.3 * np.arange(1, num + 1)[:, None] * [0.5, -1.0, 0.4]).as_matrix()
    return Trajectory(np.arange(num), names, times, steps + np.array([7.0, -3.0, 2.0]), turned)


def heard(ids: str, trajectory: Trajectory, photos: Sequence[int] | None = None) -> RangeObservations:
    """Return a range to each of the anchors (a letter each) at each of the photos."""
    photos = range(len(trajectory)) if photos is None else photos
    log = RangeLog.from_arrays(
        [id_ for _ in photos for id_ in ids],
        [4.0 + 0.1 * k + 0.01 * ord(id_) for k in photos for id_ in ids],
        image_name=[f"{k}.jpg" for k in photos for _ in ids],
    )
    return associate(log, trajectory, TAG_IN_CAM_M)


def anchor(id_: str, **of_anchor: Any) -> Anchor:
    return Anchor(id_, np.array(PLACES_M[id_]), **of_anchor)


def without(observations: RangeObservations, id_: str, num_left: int = 0) -> RangeObservations:
    """Hold out the ranges to an anchor as checks, except for some."""
    log, status = observations.log, observations.status.copy()
    rows = np.flatnonzero(log.anchor_index == log.anchor_ids.index(id_))
    status[rows[num_left:]] = RangeStatus.CHECK
    return replace(observations, status=status)


def posed(
    observations: RangeObservations | None = None,
    anchors: Sequence[Anchor] | None = None,
    frame: str = "site",
    trajectory: Trajectory | None = None,
    **options: Any,
) -> ScaleProblem:
    trajectory = path() if trajectory is None else trajectory
    observations = heard("ABC", trajectory) if observations is None else observations
    anchors = [anchor(id_) for id_ in observations.log.anchor_ids] if anchors is None else anchors
    return scale_problem(observations, trajectory, anchors, frame, MODEL, **options)


def usable(
    places_m: Sequence[Sequence[float] | None], frame: str = "site", *, with_gravity: bool = False
) -> tuple[list[bool], list[str]]:
    anchors = [Anchor(str(k), None if at is None else np.array(at)) for k, at in enumerate(places_m)]
    given = np.array([at is not None for at in places_m])
    known_, notes = module._usable_positions(anchors, given, frame, with_gravity)
    return known_.tolist(), notes


def test_the_problem_is_in_the_first_camera_unscaled_with_the_first_camera_exactly_at_the_origin() -> None:
    trajectory = path()
    problem = posed(trajectory=trajectory)
    to_first = problem.first_camera_from_sfm
    np.testing.assert_allclose(to_first.apply(trajectory.centers[0]), np.zeros(3), atol=1e-12)
    np.testing.assert_allclose(to_first.rotation @ trajectory.world_from_cam[0], np.eye(3), atol=1e-12)
    photo = np.tile(np.arange(6), 3)
    np.testing.assert_allclose(problem.ranges.centers, to_first.apply(trajectory.centers)[photo], atol=1e-12)
    np.testing.assert_array_equal(problem.ranges.centers[photo == 0], 0.0)
    turned = np.array([to_first.rotation @ each for each in trajectory.world_from_cam])
    np.testing.assert_allclose(problem.model_from_cam, turned[photo], atol=1e-12)
    np.testing.assert_allclose(problem.ranges.tag_from_center, turned[photo] @ TAG_IN_CAM_M, atol=1e-12)


def test_a_first_camera_that_is_off_its_place_by_rounding_is_put_there_and_one_that_is_off_by_more_is_not() -> None:
    trajectory = path()
    for off, is_moved in ((1e-12, False), (1e-10, True)):
        centers = module._centers_in_first_camera(trajectory.centers[:1] + off, trajectory)
        assert bool(centers.any()) == is_moved


def test_ranges_priors_and_anchors_are_those_of_the_survey_in_the_order_of_the_log() -> None:
    anchors = [
        anchor("D"),
        anchor("C", position_stddev_m=0.3, range_bias_m=0.2, range_bias_stddev_m=0.0),
        anchor("B", position_stddev_m=0.1, range_bias_m=-0.1),
        anchor("A"),
    ]
    problem = posed(anchors=anchors)
    ranges = problem.ranges
    assert ranges.anchor_index.tolist() == 6 * [0] + 6 * [1] + 6 * [2]
    expected_m = [4.0 + 0.1 * k + 0.01 * ord(id_) for id_ in "ABC" for k in range(6)]
    np.testing.assert_allclose(ranges.range_m, expected_m)
    # The radio's noise, and the common error of short ranges.
    np.testing.assert_allclose(ranges.stddev_m, np.hypot(0.07, 2.0 * np.exp(-np.array(expected_m))))
    np.testing.assert_array_equal(ranges.anchor_mean_m, [PLACES_M[id_] for id_ in "ABC"])
    assert ranges.anchor_stddev_m.tolist() == [0.0, 0.1, 0.3]
    assert ranges.bias_mean_m.tolist() == [0.0, -0.1, 0.2]
    assert ranges.bias_stddev_m.tolist() == [0.02, 0.02, 0.0]
    assert ranges.common_bias_stddev_m == 0.05
    assert ranges.frame_is_free
    assert (problem.frame, problem.anchors_are_known, problem.notes, problem.left_out) == ("site", True, (), ())
    assert problem.order_given == ("D", "C", "B", "A")
    assert (ranges.distances, ranges.gravity, ranges.placement) == (None, None, None)


def test_in_the_first_cameras_frame_one_known_anchor_is_enough_and_gravity_has_no_say() -> None:
    problem = posed(anchors=[anchor("A"), Anchor("B"), Anchor("C")], frame="first_camera", gravity=GRAVITY)
    assert (problem.frame, problem.anchors_are_known, problem.notes) == ("first_camera", True, ())
    assert problem.ranges.anchor_stddev_m.tolist() == [0.0, np.inf, np.inf]
    assert np.isnan(problem.ranges.anchor_mean_m).all(axis=1).tolist() == [False, True, True]
    assert not problem.ranges.frame_is_free
    assert problem.ranges.gravity is None


def test_positions_in_an_unknown_frame_are_not_used_at_all() -> None:
    problem = posed(frame="unknown")
    assert (problem.frame, problem.anchors_are_known) == ("first_camera", False)
    assert np.isnan(problem.ranges.anchor_mean_m).all()
    assert np.isinf(problem.ranges.anchor_stddev_m).all()
    assert problem.ranges.distances is None


def test_gravity_is_used_in_a_site_that_has_anchors() -> None:
    assert posed(gravity=GRAVITY).ranges.gravity is GRAVITY
    one = posed(anchors=[anchor("A"), Anchor("B"), Anchor("C")], gravity=GRAVITY)
    assert (one.ranges.gravity, one.frame, len(one.notes)) == (None, "first_camera", 1)


def test_with_more_than_one_place_in_the_site_only_the_lengths_between_the_surveyed_anchors_are_used() -> None:
    problem = posed(place_is_open=True)
    assert (problem.frame, problem.anchors_are_known) == ("first_camera", False)
    lengths = known(problem.ranges.distances)
    expected_m = [np.linalg.norm(np.subtract(PLACES_M[a], PLACES_M[b])) for a, b in ("AB", "AC", "BC")]
    np.testing.assert_allclose(lengths.distance_m, expected_m)
    assert lengths.anchor_pair.tolist() == [[0, 1], [0, 2], [1, 2]]
    # Two of four: the others have no position, or no ranges in use.
    observations = without(heard("ABCD", path()), "D")
    pair = posed(observations, [anchor("A"), Anchor("B"), anchor("C"), anchor("D")], place_is_open=True)
    assert known(pair.ranges.distances).anchor_pair.tolist() == [[0, 2]]


def test_lengths_of_the_user_come_before_those_between_anchors_and_checks_are_left_out() -> None:
    taped = LocatedDistances.of(
        np.array([3.0, 4.0, 5.0]),
        np.array([0.1, 0.2, 0.3]),
        model_length=np.array([1.0, 2.0, np.nan]),
        anchor_pair=np.array([[-1, -1], [-1, -1], [0, 1]]),
    )
    checked = replace(taped, is_check=np.array([False, True, False]))
    assert known(posed(distances=checked).ranges.distances).distance_m.tolist() == [3.0, 5.0]
    joined = known(posed(distances=checked, place_is_open=True).ranges.distances)
    assert joined.distance_m[:2].tolist() == [3.0, 5.0]
    assert len(joined) == 5
    # Without ranges in use, an anchor of unknown position has no place, and no lengths.
    observations = without(heard("ABC", path()), "B", num_left=3)
    left = posed(observations, [anchor("A"), Anchor("B"), anchor("C")], frame="first_camera", distances=checked)
    assert known(left.ranges.distances).distance_m.tolist() == [3.0]
    assert left.left_out == ("B",)


def test_known_positions_of_the_map_let_any_number_of_surveyed_anchors_help() -> None:
    problem = posed(anchors=[anchor("A", position_stddev_m=0.2), Anchor("B"), Anchor("C")], placement=PLACEMENT)
    assert (problem.frame, problem.notes, problem.anchors_are_known) == ("site", (), True)
    assert problem.ranges.anchor_stddev_m.tolist() == [0.2, np.inf, np.inf]
    assert problem.ranges.placement is PLACEMENT
    none = posed(anchors=[Anchor("A"), Anchor("B"), Anchor("C")], placement=PLACEMENT)
    assert (none.frame, none.anchors_are_known, none.ranges.frame_is_free) == ("site", False, True)


def test_a_surveyed_anchor_whose_ranges_are_held_out_keeps_its_position() -> None:
    problem = posed(without(heard("ABCD", path()), "D"))
    np.testing.assert_array_equal(problem.ranges.anchor_mean_m[3], PLACES_M["D"])
    assert problem.ranges.anchor_stddev_m[3] == 0.0
    assert problem.ranges.bias_stddev_m.tolist() == [0.02, 0.02, 0.02, 0.0]
    assert problem.left_out == ()
    # Where no position is used, neither is its.
    unplaced = posed(without(heard("ABCD", path()), "D"), place_is_open=True)
    assert np.isnan(unplaced.ranges.anchor_mean_m[3]).all()
    assert unplaced.left_out == ("D",)


@pytest.mark.parametrize(("num", "is_heard"), [(3, False), (4, True)])
def test_an_unknown_anchor_needs_four_ranges(num: int, is_heard: bool) -> None:
    problem = posed(without(heard("ABC", path()), "B", num), [anchor("A"), Anchor("B"), anchor("C")], "first_camera")
    assert problem.left_out == (() if is_heard else ("B",))
    assert problem.ranges.anchor_stddev_m[1] == (np.inf if is_heard else 0.0)
    assert len(problem.ranges.range_m) == 12 + (num if is_heard else 0)


def test_a_known_anchor_needs_one_range() -> None:
    assert len(posed(without(heard("ABC", path()), "B", 1)).ranges.range_m) == 13


@pytest.mark.parametrize(
    ("ids", "photos", "told"),
    [
        ("AB", [0, 1, 2, 3], None),
        ("A", [0, 1, 2, 3, 4, 5, 6], "7 of 7 ranges lie on the path, near 7 keyframes"),
        ("ABC", [0, 1, 2], "9 of 9 ranges lie on the path, near 3 keyframes"),
        ("A", [0, 1, 2, 3, 4, 5, 6, 99, 99, 99], "7 of 10 ranges lie on the path, near 7 keyframes"),
    ],
)
def test_a_scale_needs_eight_ranges_near_four_keyframes(ids: str, photos: list[int], told: str | None) -> None:
    trajectory = path(8)
    observations = heard(ids, trajectory, photos)
    if told is None:
        assert len(posed(observations, trajectory=trajectory).ranges.range_m) == 8
    else:
        with pytest.raises(GeometryError) as refused:
            posed(observations, trajectory=trajectory)
        assert str(refused.value) == (
            f"the scale is not determined: {told}; 8 near 4 are needed (do the clocks agree?)"
        )


def test_an_anchor_of_the_log_that_is_not_among_the_given_ones_is_named() -> None:
    with pytest.raises(InputError, match=r"anchor 'B' of the log is not among the anchors \(C, A\)"):
        posed(anchors=[anchor("C"), anchor("A")])


def test_positions_are_used_as_they_are_outside_a_site_or_where_none_is_given() -> None:
    assert usable([(1, 2, 3), None], "first_camera") == ([True, False], [])
    assert usable([None, None]) == ([False, False], [])


@pytest.mark.parametrize("with_gravity", [False, True])
def test_three_surveyed_anchors_that_are_not_on_a_line_are_used(with_gravity: bool) -> None:
    places_m = [(0, 0, 0), None, (4, 0, 0), (4, 3, 0)]
    assert usable(places_m, with_gravity=with_gravity) == ([True, False, True, True], [])


@pytest.mark.parametrize("with_gravity", [False, True])
def test_one_surveyed_anchor_leaves_every_turn_open(with_gravity: bool) -> None:
    known_, (note,) = usable([None, (1, 2, 3)], with_gravity=with_gravity)
    assert known_ == [False, False]
    assert note == (
        "1 surveyed anchor lets the map turn about it freely: the map gets metres, but no place in the site; "
        f"three anchors not on a line would fix it{'' if with_gravity else HELP}"
    )


@pytest.mark.parametrize(
    ("places_m", "which"),
    [
        ([(0, 0, 0), (4, 0, 1)], "2 surveyed anchors"),
        ([(0, 0, 0), (4, 0, 1), (8, 0, 2)], "surveyed anchors on one line"),
    ],
)
def test_anchors_on_a_line_leave_a_turn_open_that_gravity_fixes(places_m: list[list[float]], which: str) -> None:
    assert usable(places_m, with_gravity=True) == ([True] * len(places_m), [])
    known_, (note,) = usable(places_m)
    assert known_ == [False] * len(places_m)
    assert note == (
        f"{which} let the map turn about their line freely: the map gets metres, but no place in the site; "
        f"a third anchor off it would fix it{HELP}"
    )


@pytest.mark.parametrize("far_m", [100.0, 600.0, 60000.0])
def test_an_anchor_that_is_far_off_makes_no_line_of_the_others(far_m: float) -> None:
    places_m = [(far_m, 0, 1), (6, -5, 3), (6, 5, 1), (-6, 5, 4)]
    assert usable(places_m) == ([True] * 4, [])
    on_line = [(far_m, 0, 0), (0, 0, 0), (4, 0, 0), (8, 0, 0)]
    known_, (note,) = usable(on_line)
    assert known_ == [False] * 4
    assert note.startswith("surveyed anchors on one line")


@pytest.mark.parametrize(("off_vertical_deg", "is_used"), [(19.0, False), (21.0, True)])
def test_gravity_does_not_fix_the_turn_about_a_line_that_is_nearly_upright(
    off_vertical_deg: float, is_used: bool
) -> None:
    lean = np.tan(np.deg2rad(off_vertical_deg))
    known_, notes = usable([(0, 0, 0), (5 * lean, 0, 5)], with_gravity=True)
    assert known_ == [is_used, is_used]
    assert len(notes) == (not is_used)
    assert all(note.endswith("a third anchor off it would fix it") for note in notes)


def test_where_the_log_names_photos_times_are_those_of_walking_a_metre_a_second() -> None:
    """Photos 0, 1, 3 and 4 are 0, 1, 6 and 10 units along the path; ranges of one photo have one time."""
    problem = posed(heard("ABC", path(), [0, 1, 3, 4]))
    np.testing.assert_allclose(problem.times_s(2.0), np.tile([0.0, 2.0, 12.0, 20.0], 3))
    assert problem.velocity is None


def timed(times: Array | None, photo_times: Array | None) -> ScaleProblem:
    """Return a problem whose log has times (those of the photos, unless given)."""
    seconds = np.arange(0.0, 12.0, 2.0)
    observations = heard("AB", path(6, seconds))
    log = replace(observations.log, image_name=None, timestamp_s=np.repeat(seconds, 2) if times is None else times)
    trajectory = path(6, seconds if photo_times is None else photo_times)
    return posed(replace(observations, log=log), trajectory=trajectory)


def test_where_the_log_has_times_these_are_taken() -> None:
    assert timed(np.arange(100.0, 112.0), None).times_s(2.0).tolist() == [*range(100, 112, 2), *range(101, 112, 2)]


def test_the_velocity_is_that_of_the_path_in_the_first_camera_or_none_without_increasing_times() -> None:
    """Steps of 1, 2, ... units in 2 s each: half of the mean of the two next to a photo, and one at the ends."""
    problem = timed(None, None)
    along = path().world_from_cam[0].T @ [0.6, 0.0, 0.8]
    speeds = np.tile([0.5, 0.75, 1.25, 1.75, 2.25, 2.5], 2)
    np.testing.assert_allclose(known(problem.velocity), speeds[:, None] * along, atol=1e-12)
    back_and_forth = np.array([0.0, 2.0, 1.0, 3.0, 4.0, 5.0])
    assert timed(None, back_and_forth).velocity is None
    assert timed(None, np.array([0.0, 1.0, 1.0, 3.0, 4.0, 5.0])).velocity is None
    of_one = replace(problem, trajectory=path(1, np.zeros(1)))
    assert of_one.velocity is None
    untimed = replace(problem, trajectory=path(6))
    assert untimed.velocity is None


def test_the_velocity_at_a_range_is_that_of_the_nearer_photo() -> None:
    problem = timed(None, None)
    observations = problem.observations
    between = replace(
        observations,
        before=np.zeros(12, dtype=np.int64),
        after=np.full(12, 5),
        fraction=np.where(np.arange(12) % 2 == 0, 0.4, 0.6),
    )
    speeds = np.linalg.norm(known(replace(problem, observations=between).velocity), axis=1)
    np.testing.assert_allclose(speeds, np.repeat([0.5, 2.5], 6))


def test_two_photos_with_times_have_a_velocity() -> None:
    problem = timed(None, None)
    first = replace(problem.observations, before=np.zeros(12, dtype=np.int64), fraction=np.zeros(12))
    pair = replace(problem, observations=first, trajectory=path(2, np.array([0.0, 4.0])))
    np.testing.assert_allclose(np.linalg.norm(known(pair.velocity), axis=1), 0.25)


def test_what_is_known_of_the_single_ranges_follows_them() -> None:
    """The rows of a problem are sorted by anchor, those of the log by photo."""
    observations = heard("ABC", path())
    curved = replace(observations, log=replace(observations.log, shared_stddev_m=np.arange(18.0)))
    placed = replace(curved, center_stddev=np.full(18, 3.0), arm_stddev_m=np.full(18, 8.0))
    order = [3 * photo + k for k in range(3) for photo in range(6)]
    assert known(posed(placed).curve_stddev_m).tolist() == order
    np.testing.assert_allclose(posed(placed).placing_stddev_m(2.0), 10.0)
    assert posed(observations).curve_stddev_m is None
    arms_m = replace(placed, center_stddev=np.zeros(18), arm_stddev_m=np.arange(18.0))
    assert posed(arms_m).placing_stddev_m(2.0).tolist() == order
