"""A model of pieces that hardly any point holds together is named by the commands that scale it.

What hangs loose makes nothing else uncertain.
"""

from __future__ import annotations

import json
import re
from typing import Any

import pycolmap
import pytest
from tests.conftest import Command, WalkedSurvey
from tests.simulated.pieces import leave_across


@pytest.mark.parametrize(("num_across", "is_held"), [(5, False), (8, True)])
def test_a_model_of_two_pieces_is_named_as_such_if_their_few_points_leave_the_scale_open(
    own_survey: WalkedSurvey, rangesfm_command: Command, num_across: int, is_held: bool
) -> None:
    folder = own_survey.folder / "sparse" / "0"
    model = pycolmap.Reconstruction(folder)
    names = sorted(image.name for image in model.images.values())
    second = set(names[25:])
    leave_across(model, second, num_across)
    model.write(folder)
    flags = (*own_survey.flags, "--anchors", "anchors.csv", "--no_report", "--output_path", "out")
    said = rangesfm_command("scale", *flags, cwd=own_survey.folder)
    # A photo beside the gap may belong to either piece, or to none.
    expected = re.compile(
        r"the photos do not hold the map together: 1\d of its 40 photos \(frame_0002\d.jpg to frame_00040.jpg\) share "
        r"only \d points with the others"
    )
    assert bool(expected.search(said.stderr)) != is_held
    scale = json.loads((own_survey.folder / "out" / "result.json").read_text(encoding="utf-8"))["scale"]
    assert scale["verdict"] == ("good" if is_held else "doubtful")
    assert is_held or any(expected.match(reason) for reason in scale["reasons"])


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
