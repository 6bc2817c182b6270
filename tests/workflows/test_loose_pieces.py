"""A model of two pieces that hardly any point holds together is named by the commands that scale it."""

from __future__ import annotations

import json
import re

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
