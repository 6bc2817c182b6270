"""Anchors with large coordinates are computed with near their middle."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from rangesfm.errors import InputError
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.site import Site, local_site, site_of

FAR = np.array([2_600_000.25, 1_200_000.5, 400.0])


def anchors_at(*positions: list[float] | None) -> tuple[Anchor, ...]:
    return tuple(
        Anchor(str(k), None if position is None else np.array(position)) for k, position in enumerate(positions)
    )


def test_far_anchors_are_moved_by_whole_metres_and_unknown_ones_stay_unknown() -> None:
    site, anchors = local_site(anchors_at([*FAR], None, [*(FAR + np.array([10.0, 0, 2]))]), "site", "")
    np.testing.assert_array_equal(site.offset_m, [2_600_005, 1_200_000, 401])
    assert anchors[1].position_m is None
    assert anchors[2].position_m is not None
    np.testing.assert_array_equal(anchors[2].position_m + site.offset_m, FAR + np.array([10.0, 0, 2]))


@pytest.mark.parametrize("frame", ["site", "first_camera"])
def test_near_anchors_and_those_of_other_frames_stay(frame: str) -> None:
    places = [[10.0, 20.0, 3.0], [-10.0, 0.0, 1.0]] if frame == "site" else [[*FAR]]
    site, anchors = local_site(anchors_at(*places), frame, "")
    assert not site.offset_m.any()
    np.testing.assert_array_equal([anchor.position_m for anchor in anchors], places)


@pytest.mark.parametrize(
    ("frame", "position", "said"),
    [
        ("first_camera", [1.0, 2.0, 3.0], "the frame is 'first_camera'"),
        ("site", None, "no anchor has a position"),
        ("site", [1.2e6, 2.6e6, 0.0], "lie outside the area in which EPSG:2056 is valid"),
    ],
)
def test_a_coordinate_system_needs_positions_on_the_earth(frame: str, position: list[float] | None, said: str) -> None:
    with pytest.raises(InputError, match=said):
        local_site(anchors_at(position), frame, "EPSG:2056")


@pytest.mark.parametrize(
    ("of_site", "of_points", "said"),
    [
        (
            "",
            "EPSG:2056",
            "these coordinates have a coordinate system and those of the anchors or control points have none",
        ),
        (
            "EPSG:2056",
            "",
            "those of the anchors or control points have a coordinate system and these coordinates have none",
        ),
    ],
)
def test_points_without_the_coordinate_system_of_the_anchors_are_refused(
    of_site: str, of_points: str, said: str
) -> None:
    site, _ = local_site(anchors_at([*FAR], [*(FAR + 10.0)]), "site", of_site)
    with pytest.raises(InputError, match=said):
        site.local(FAR[None], of_points)


@pytest.mark.parametrize(("distance_m", "offset_m"), [(7.0, 0.0), (9.0, 9.0)])
def test_a_site_is_moved_if_it_is_farther_away_than_it_is_large(distance_m: float, offset_m: float) -> None:
    across = np.array([0.0, 4.0, 0.0])
    coordinates = np.array([distance_m, 0.0, 0.0]) + np.stack([across, np.full(3, np.nan), -across])
    site, local = site_of(coordinates, "")
    np.testing.assert_array_equal(site.offset_m, [offset_m, 0.0, 0.0])
    np.testing.assert_array_equal(local, coordinates - np.array([offset_m, 0.0, 0.0]))


def test_further_points_are_moved_with_the_anchors() -> None:
    points = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    np.testing.assert_array_equal(Site(np.array([1.0, 1.0, 2.0])).local(points, ""), [[0, 1, 1], [3, 4, 4]])


def test_further_points_of_a_coordinate_system_are_where_anchors_there_are() -> None:
    places = np.array([[2_600_000.0, 1_200_000.0, 500.0], [2_600_050.0, 1_200_020.0, 510.0]])
    site, anchors = local_site(anchors_at(*places.tolist(), None), "site", "EPSG:2056")
    assert not site.offset_m.any()
    assert anchors[2].position_m is None
    local = site.local(places, "EPSG:2056")
    np.testing.assert_allclose(local, np.array([anchor.position_m for anchor in anchors[:2]], dtype=float), atol=1e-6)
    # Lengths are those of the map, but for its scale and the height above the sea.
    assert np.linalg.norm(local[1] - local[0]) == pytest.approx(np.linalg.norm(places[1] - places[0]), rel=1e-3)


@pytest.mark.parametrize(
    ("given", "crs", "texts", "place"),
    [
        ((1012.0, 5003.9791, 413.0), "", ("1012.000", "5003.979", "413.000"), "1012, 5003.98, 413"),
        ((0.0, -0.0001, 3.0), "", ("0.000", "0.000", "3.000"), "0, 0, 3"),
        (
            (2_600_000.1234, 1_200_000.0, 450.0),
            "EPSG:2056",
            ("2600000.123", "1200000.000", "450.000"),
            "2600000.12, 1200000, 450",
        ),
        (
            (7.43863242, 46.95108277, 500.25),
            "EPSG:4326",
            ("7.43863242", "46.95108277", "500.250"),
            "7.4386324, 46.9510828, 500.25",
        ),
    ],
)
def test_texts_have_the_coordinates_that_were_given(
    given: tuple[float, float, float], crs: str, texts: tuple[str, str, str], place: str
) -> None:
    site, (anchor, _) = local_site(anchors_at([*given], [given[0] + 1e-4, given[1], given[2] + 7.0]), "site", crs)
    assert anchor.position_m is not None
    assert tuple(site.coordinate_text(anchor.position_m, axis, 3) for axis in range(3)) == texts
    assert site.height_text(anchor.position_m) == f"{given[2]:g}"
    assert site.place_text(anchor.position_m) == place


def test_no_anchors_have_no_coordinate_system_and_the_file_is_named() -> None:
    with pytest.raises(InputError) as caught:
        local_site((), "site", "EPSG:2056", Path("anchors.csv"))
    assert str(caught.value) == (
        "anchors.csv: [anchors] crs is EPSG:2056, which is for anchors surveyed in a site frame, but no anchor has a "
        "position"
    )
    site, anchors = local_site((), "site", "")
    assert (anchors, site.georeference) == ((), None)
    with pytest.raises(InputError, match=r"^anchors\.csv: .*EPSG:2056"):
        site_of(np.zeros((1, 3)), "EPSG:2056", Path("anchors.csv"))


def test_degrees_of_no_known_system_are_refused_and_small_things_in_metres_are_not() -> None:
    at = np.array([[8.541694, 47.376887, 408.0], [8.541831, 47.376954, 409.5], [8.541755, 47.376801, 407.0]])
    with pytest.raises(InputError, match=r"points\.csv: coordinates look like degrees \(x from 8\.541694 to 8\.541831"):
        site_of(at, "", Path("points.csv"))
    on_a_table = np.array([[0.0121234, 0.0331234, 0.1], [0.0221234, 0.0111234, 0.2], [0.0321234, 0.0251234, 0.3]])
    for metres in (on_a_table, np.round(on_a_table + np.array([8.5, 47.3, 0.0]), 4), 1e3 * at):
        site_of(metres, "")
