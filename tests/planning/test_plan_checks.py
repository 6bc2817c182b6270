"""A plan that cannot be is refused in one line, and what is merely odd is said, with the line of the file."""

from __future__ import annotations

from pathlib import Path

import pytest

from rangesfm.errors import InputError
from rangesfm.planning.plan_file import read_plan

ROOM = "walls_m = [[[0, 0], [12, 0], [12, 8], [0, 8], [0, 0]]]\nheights_m = [0.3, 3.0]\n"
PLACES = "A1 = [0, 0, 2.5]\nA2 = [12, 0, 0.5]\nA3 = [12, 8, 2.5]\n"
WALK = "[path]\nwaypoints = [[2, 2, 1.6], [10, 2, 1.6], [10, 6, 1.6]]\n"
# The middle of its corners is outside, and so is the loop.
LOOP_IN_AN_L = "[path]\nloop_inside_m = [[0, 0], [20, 0], [20, 1], [1, 1], [1, 20], [0, 20]]\n"


def plan_of(folder: Path, *, walls: str = ROOM, places: str = PLACES, path: str = WALK, more: str = "") -> Path:
    file = folder / "plan.toml"
    file.write_text(f"[anchors]\n{walls}[anchors.places]\n{places}{path}{more}")
    return file


@pytest.mark.parametrize(
    ("parts", "line", "found"),
    [
        (
            {"path": WALK.replace("[10, 6", "[10, 9")},
            9,
            r"\[path\] waypoints leads the camera through a wall at 10, .*, expected a path inside the walls",
        ),
        ({"walls": "", "path": LOOP_IN_AN_L}, 7, r"\[path\] loop_inside_m leads the camera through a wall at"),
        (
            {"places": PLACES + "A4 = [0, 0, 2.5]\n"},
            8,
            r"\[anchors\] places.A4: A4 is at 0, 0, 2.5, where A1 is, expected another place",
        ),
        (
            {"more": "[points.places]\nP = [1, 1, 1]\nQ = [1, 1, 1]\n"},
            12,
            r"\[points\] places.Q: Q is at 1, 1, 1, where P is",
        ),
        (
            {"more": "[tag]\ntag_in_cam_m = [3, -12, -5]\n"},
            11,
            r"\[tag\] tag_in_cam_m is 13.3 m long, expected at most 3 m: metres from the lens",
        ),
        (
            {"more": "[positions]\nantenna_in_cam_m = [0, -31, 0]\n"},
            11,
            r"\[positions\] antenna_in_cam_m is 31 m long, expected at most 3 m",
        ),
        (
            {"walls": "", "places": PLACES.replace("[12, 8, 2.5]", "[1200, 800, 250]")},
            5,
            r"\[anchors\] places.A3: anchor A3 is .* m from the path at its nearest, expected at most 300 m",
        ),
    ],
    ids=[
        "waypoints",
        "loop",
        "anchors in one place",
        "points in one place",
        "tag in cm",
        "antenna in cm",
        "site in cm",
    ],
)
def test_what_cannot_be_is_refused_with_its_line(parts: dict[str, str], line: int, found: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=rf"plan.toml:{line}: {found}") as refused:
        read_plan(plan_of(tmp_path, **parts))
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("parts", "line", "found"),
    [
        (
            {"places": PLACES + "A4 = [0, 10, 2.5]\n"},
            8,
            "[anchors] places.A4: anchor A4 is outside the walls, expected",
        ),
        (
            {"path": WALK.replace("1.6", "160")},
            9,
            "[path] waypoints: the camera is 158 m above or below all anchors, in a site 14.4 m wide, expected heights",
        ),
        (
            {"places": PLACES.replace("0.5", "50")},
            6,
            "[anchors] places.A2: anchor A2 is 48.4 m above or below the camera, in a site 14.4 m wide, expected",
        ),
        (
            {"walls": ROOM.replace("0.3, 3.0", "30, 300")},
            3,
            "[anchors] heights_m lets anchors be up to 298 m above the camera",
        ),
    ],
    ids=["outside", "path in cm", "anchor in cm", "heights in cm"],
)
def test_what_is_odd_is_said_with_its_line(parts: dict[str, str], line: int, found: str, tmp_path: Path) -> None:
    (warning,) = read_plan(plan_of(tmp_path, **parts)).warnings
    assert f"plan.toml:{line}: {found}" in warning
    assert "\n" not in warning


def test_a_sound_plan_has_no_warning(tmp_path: Path) -> None:
    assert read_plan(plan_of(tmp_path)).warnings == ()
    on_a_hill = PLACES.replace("2.5", "412.5").replace("0.5", "410.5")
    hill = read_plan(plan_of(tmp_path, places=on_a_hill, path=WALK.replace("1.6", "411.6")))
    assert hill.warnings == ()
