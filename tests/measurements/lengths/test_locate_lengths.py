"""Locating the ends of taped distances in a model, and the table of them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import along, loop_path

from rangesfm.errors import InputError
from rangesfm.measurements.lengths.locate_lengths import locatable, locate_distances
from rangesfm.measurements.lengths.tape import Marker, Tape, TapedDistance
from rangesfm.measurements.points import NamedPoints
from rangesfm.pipeline.result_records import disagreements
from rangesfm.result.entries import DistanceRow


@pytest.fixture(scope="module")
def made() -> SyntheticModel:
    path = loop_path(30.0, start_s=0.0, seed=1)
    times = np.arange(30, dtype=np.float64)
    return synthetic_model(*along(path, times), pixel_stddev=0.0, seed=2)


def taped(start: str, end: str, distance_m: float = 1.0, kind: str = "check") -> TapedDistance:
    return TapedDistance((start, end), distance_m, 0.01, kind, 2)


def long_tracks(model: pycolmap.Reconstruction, num: int) -> list[pycolmap.Point3D]:
    return sorted(model.points3D.values(), key=lambda point: -point.track.length())[:num]


def marker_of(model: pycolmap.Reconstruction, point: pycolmap.Point3D) -> Marker:
    elements = point.track.elements
    pixels = [model.image(e.image_id).points2D[e.point2D_idx].xy for e in elements]
    return Marker(
        tuple(model.image(e.image_id).name for e in elements), np.array(pixels), tuple(range(2, 2 + len(elements)))
    )


def tape(*distances: TapedDistance, **markers: Marker) -> Tape:
    return Tape(
        distances, {name: replace(marker, path=Path("m.csv")) for name, marker in markers.items()}, Path("d.csv")
    )


def test_two_photos_are_as_far_apart_as_their_cameras(made: SyntheticModel) -> None:
    names, door = list(made.timestamps_s), marker_of(made.reconstruction, long_tracks(made.reconstruction, 1)[0])
    of_one_name = tape(taped(names[2], names[7]), **{names[2]: door})  # the photo is meant
    located = locate_distances(of_one_name, made.reconstruction, [])
    lengths = located.lengths_m(made.metric_from_sfm.scale, np.zeros((0, 3)))
    assert lengths == pytest.approx([np.linalg.norm(made.centers_m[2] - made.centers_m[7])], rel=1e-9)


def test_markers_are_where_their_marks_meet(made: SyntheticModel) -> None:
    model = made.reconstruction
    first, second = long_tracks(model, 2)
    marks = {"door": marker_of(model, first), "wall": marker_of(model, second)}
    located = locate_distances(tape(taped("door", "wall"), **marks), model, [])
    assert located.lengths_m(1.0, np.zeros((0, 3))) == pytest.approx([np.linalg.norm(first.xyz - second.xyz)], rel=1e-6)


def test_anchors_are_where_they_were_found(made: SyntheticModel) -> None:
    located = locate_distances(tape(taped("B", "A")), made.reconstruction, ["A", "B"])
    anchors_m = np.array([[0.0, 0, 0], [3.0, 4, 0]])
    assert located.lengths_m(17.0, anchors_m) == pytest.approx([5.0])


def test_ends_that_are_nowhere_are_refused(made: SyntheticModel) -> None:
    model, name = made.reconstruction, next(iter(made.timestamps_s))
    point = long_tracks(model, 1)[0]
    door = marker_of(model, point)
    lonely = Marker(door.image_names[:1], door.pixels[:1], (5,))
    astray = Marker(door.image_names, door.pixels + np.eye(len(door.pixels), 2) * 300, door.lines)
    still = Marker((door.image_names[0],) * 2, door.pixels[[0, 0]], (2, 3))
    cases = {
        "d.csv:2: an end is 'nobody', expected a photo": (tape(taped(name, "nobody")), []),
        "d.csv:2: from .* expected two anchors": (tape(taped(name, "A")), ["A"]),
        "m.csv:5: marker 'door' is marked in 1 photos": (tape(taped(name, "door"), door=lonely), []),
        r"m.csv:\d+: marker 'door' is \d+ px from where the other photos put it": (
            tape(taped(name, "door"), door=astray),
            [],
        ),
        "m.csv:2: marker 'door' is seen from one direction": (tape(taped(name, "door"), door=still), []),
    }
    for said, (given, anchor_ids) in cases.items():
        with pytest.raises(InputError, match=said):
            locate_distances(given, model, anchor_ids)


def test_marks_that_do_not_meet_are_left_out_of_poses_that_drift(made: SyntheticModel) -> None:
    """In a map with points, which the photos hold together, they are a mistake of the user."""
    with_points, name = made.reconstruction, next(iter(made.timestamps_s))
    poses = pycolmap.Reconstruction(with_points)
    for point_id in list(poses.point3D_ids()):
        poses.delete_point3D(point_id)
    wall, door = (marker_of(with_points, point) for point in long_tracks(with_points, 2))
    astray = replace(door, pixels=door.pixels + np.eye(len(door.pixels), 2) * 300)
    given = tape(taped(name, "wall"), taped(name, "door"), wall=wall, door=astray)
    assert locatable(given, with_points).distances == given.distances
    assert locatable(given, poses).distances == given.distances[:1]
    for model, is_door_shown in ((with_points, True), (poses, False)):
        points = NamedPoints.in_model(model, given.markers)
        assert [points.is_shown(marker) for marker in ("wall", "door")] == [True, is_door_shown]


def test_a_check_distance_off_by_more_than_tape_and_scale_explain_is_named() -> None:
    lengths = (
        *(("a", "b", "check", 10.35), ("c", "d", "check", 10.45)),
        ("e", "f", "control", 10.45),  # it is tested as an observation of the map
    )
    rows = [
        DistanceRow(from_=a, to=b, kind=kind, measured_m=10.0, stddev_m=0.01, estimated_m=at, residual_m=at - 10.0)
        for a, b, kind, at in lengths
    ]
    [note] = [doubt.reason for doubt in disagreements(rows, relative_scale_stddev=0.01)]
    assert note.startswith("check distance from c to d: 10.450 m in the map, 10.000 m by tape (+0.450 m")
