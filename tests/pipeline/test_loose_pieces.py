"""A model of pieces that hardly any point holds together is named by the commands that scale it.

What hangs loose makes nothing else uncertain.
"""

from __future__ import annotations

import json
import re
from typing import Any

import numpy as np
import pycolmap
import pytest
from tests.conftest import Command, WalkedSurvey
from tests.simulated.pieces import leave_across

# A photo beside the gap may belong to either piece, or to none.
OF_PIECES = re.compile(
    r"the photos do not hold the map together: 1\d of its 40 photos \(frame_0002\d.jpg to frame_00040.jpg\) share "
    r"only \d points with the others, so that the two parts may differ in scale and place"
    r"(; beside the others, it is too large by (?P<percent>[-\d.]+) %)?"
)


def test_ranges_tell_that_a_piece_is_too_large_which_the_photos_do_not_hold(
    own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    found = []
    for size in (1.0, 1.1):
        of_two_pieces(own_survey, size=size, num_across=0)
        flags = (*own_survey.flags, "--anchors", "anchors.csv", "--no_report", "--output_path", f"out_{size}")
        rangesfm_command("scale", *flags, cwd=own_survey.folder)
        result = json.loads((own_survey.folder / f"out_{size}" / "result.json").read_text(encoding="utf-8"))
        found.append(result["scale"])
    assert found[0]["verdict"] == "good"
    assert found[1]["verdict"] == "doubtful"
    named = [OF_PIECES.match(reason) for reason in found[1]["reasons"]]
    (too_large,) = [float(match["percent"]) for match in named if match and match["percent"]]
    assert too_large == pytest.approx(100 * np.log(1.1), abs=2)


def test_a_piece_that_neither_photos_nor_ranges_hold_may_have_any_size(
    own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    of_two_pieces(own_survey, size=1.0, num_across=0)
    log = own_survey.folder / "uwb.csv"
    header, *rows = log.read_text(encoding="utf-8").splitlines()
    first_s = float(rows[0].split(",")[0])
    of_first = [row for row in rows if float(row.split(",")[0]) < first_s + 22]
    log.write_text("\n".join([header, *of_first]) + "\n", encoding="utf-8")
    flags = (*own_survey.flags, "--anchors", "anchors.csv", "--no_report", "--output_path", "out")
    said = rangesfm_command("scale", *flags, cwd=own_survey.folder)
    match = OF_PIECES.search(said.stderr)
    assert match
    assert match["percent"] is None


def of_two_pieces(survey: WalkedSurvey, *, size: float, num_across: int) -> None:
    """Leave few points between the first photos and the others, and make what these see larger."""
    folder = survey.folder / "sparse" / "0"
    model = pycolmap.Reconstruction(folder)
    second = set(survey.image_names[25:])
    leave_across(model, second, num_across)
    ids = sorted(image.image_id for image in model.images.values() if image.name in second)
    origin = model.image(ids[0]).projection_center()
    for image_id in ids:
        image = model.image(image_id)
        rotation = image.cam_from_world().rotation
        center = origin + size * (image.projection_center() - origin)
        pose = pycolmap.Rigid3d(rotation, -rotation.matrix() @ center)
        model.frame(image.frame_id).set_cam_from_world(image.camera_id, pose)
    for point in model.points3D.values():
        if all(element.image_id in ids for element in point.track.elements):
            point.xyz = origin + size * (point.xyz - origin)
    model.write(folder)


@pytest.mark.parametrize("anchors", [("--anchors", "anchors.csv"), ()])
@pytest.mark.parametrize("command", ["scale", "refine"])
def test_a_photo_of_one_point_may_be_anywhere_and_the_rest_of_the_map_is_as_certain_as_without_it(
    own_survey: WalkedSurvey, rangesfm_command: Command, command: str, anchors: tuple[str, ...]
) -> None:
    def entries(name: str) -> dict[str, Any]:
        output = own_survey.folder / name
        flags = (*own_survey.flags, *anchors, "--no_report", "--output_path", output.name)
        rangesfm_command(command, *flags, cwd=own_survey.folder)
        found: dict[str, Any] = json.loads((output / "result.json").read_text(encoding="utf-8"))
        return found

    before = entries("before")
    folder = own_survey.folder / "sparse" / "0"
    model = pycolmap.Reconstruction(folder)
    last = max(image.name for image in model.images.values())
    leave_across(model, {last}, 1)
    model.write(folder)
    after = entries("after")
    for name in ("value", "interval_95"):
        assert after["scale"][name] == pytest.approx(before["scale"][name], rel=0.01)
    if anchors:
        for name in ("stddev_m", "heading_stddev_deg"):
            assert after["place"][name] == pytest.approx(before["place"][name], rel=0.1)


def test_photos_that_share_no_point_are_left_out_with_a_word(
    own_survey: WalkedSurvey, rangesfm_command: Command
) -> None:
    folder = own_survey.folder / "sparse" / "0"
    model, apart = pycolmap.Reconstruction(folder), own_survey.image_names[20]
    leave_across(model, {apart}, 0)
    model.write(folder)
    flags = (*own_survey.flags, "--anchors", "anchors.csv", "--no_report", "--output_path", "out")
    said = rangesfm_command("refine", *flags, cwd=own_survey.folder)
    assert (
        f"1 of 40 photos of the model share no point with another, the first is {apart}: nothing tells" in said.stderr
    )
    written = pycolmap.Reconstruction(own_survey.folder / "out" / "sparse_metric" / "0")
    placed = {image.name for image in written.images.values() if image.has_pose}
    assert placed == {*own_survey.image_names} - {apart}
