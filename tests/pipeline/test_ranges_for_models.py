"""All entry points scale a model by a survey alike: with its lengths, without the ranges that it holds out."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest

from rangesfm.pipeline.ranges_for_models import ranges_of_survey
from rangesfm.pipeline.run import run_survey, scale_model
from rangesfm.progress import Progress
from rangesfm.survey.settings import Survey

if TYPE_CHECKING:
    from tests.conftest import WalkedSurvey


@pytest.fixture
def survey(walked_survey: WalkedSurvey, tmp_path: Path) -> Survey:
    """The walked survey with a fifth of its ranges held out, and a taped length that is a bit too long."""
    first, last = walked_survey.image_names[0], walked_survey.image_names[20]
    length_m = 1.01 * np.linalg.norm(walked_survey.centers_m[20] - walked_survey.centers_m[0])
    (tmp_path / "taped.csv").write_text(f"from,to,distance_m,stddev_m\n{first},{last},{length_m:.4f},0.01\n")
    only_scaled = {"refine.enabled": False, "report.enabled": False}
    measured = {"ranges.check_share": 0.2, "scale.distances": tmp_path / "taped.csv"}
    return walked_survey.survey(tmp_path / "out").changed({**only_scaled, **measured})


def test_a_model_has_one_scale_by_a_survey_whoever_asks(survey: Survey) -> None:
    path = survey.given_model_path
    scaled = scale_model(survey, progress=Progress()).summary
    assert run_survey(survey, progress=Progress()).summary.scale.value == scaled.scale.value
    sfm = pycolmap.Reconstruction(path)
    compared = ranges_of_survey(survey, sfm, path)
    centers = {image.name: image.projection_center() for image in sfm.images.values()}
    in_model = np.array([centers[name] for name in compared.metric_path.image_names])
    ratios = np.linalg.norm(np.diff(compared.metric_path.centers, axis=0), axis=1) / np.linalg.norm(
        np.diff(in_model, axis=0), axis=1
    )
    assert ratios == pytest.approx(np.full(len(ratios), scaled.scale.value), rel=1e-9)
    assert len(compared.log) == scaled.ranges.num_used
    assert scaled.check_ranges.num > 0
    assert scaled.distances[0].kind == "control"
