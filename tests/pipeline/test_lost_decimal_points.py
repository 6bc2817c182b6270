"""An anchor that is given hundreds of metres from where it stands is named, and the others find the scale."""

from __future__ import annotations

import json

import pytest
from tests.conftest import SITE_M, Command, WalkedSurvey


@pytest.mark.parametrize("anchor_id", ["A1", "A2", "A3", "A4"])
def test_a_lost_decimal_point_is_named_and_does_not_change_the_scale(
    own_survey: WalkedSurvey, rangesfm_command: Command, anchor_id: str
) -> None:
    anchors = own_survey.folder / "anchors.csv"
    header, *lines = anchors.read_text(encoding="utf-8").splitlines()
    rows = [line.split(",") for line in lines]
    for row in rows:
        if row[0] == anchor_id:
            row[1] = str(SITE_M[0] + 100 * (float(row[1]) - SITE_M[0]))
    anchors.write_text("\n".join([header, *map(",".join, rows)]) + "\n", encoding="utf-8")
    flags = (*own_survey.flags, "--anchors", "anchors.csv", "--no_report", "--output_path", "out")
    rangesfm_command("scale", *flags, cwd=own_survey.folder)
    scale = json.loads((own_survey.folder / "out" / "result.json").read_text(encoding="utf-8"))["scale"]
    low, high = scale["interval_95"]
    assert low < own_survey.site_from_sfm.scale < high < 1.06 * low
    assert scale["verdict"] == "doubtful"
    assert scale["reasons"][0].startswith(f"probably anchor {anchor_id} is about ")
