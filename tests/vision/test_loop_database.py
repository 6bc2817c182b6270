"""The copy of a database in which loops are matched."""

from __future__ import annotations

from pathlib import Path

import pytest
from tests.simulated.looped import LoopedSurvey, two_laps, write_matches

from rangesfm.colmap.transform import joined_model, without_photos
from rangesfm.files.output_folder import OutputFolder, sole_writer
from rangesfm.vision.loop_database import LoopDatabase
from rangesfm.vision.steps import DATABASE_NAME


@pytest.fixture(scope="module")
def looped() -> LoopedSurvey:
    return two_laps(12, size_m=(8.0, 8.0), num_observations=60)


def copied(output: OutputFolder) -> LoopDatabase:
    return LoopDatabase.of(output.newest(output.path / DATABASE_NAME), output)


def test_photos_whose_models_found_different_cameras_cannot_be_matched_together(
    looped: LoopedSurvey, tmp_path: Path
) -> None:
    write_matches(tmp_path / DATABASE_NAME, looped.truth, looped.matches, with_descriptors=True)
    names = list(looped.survey.model.timestamps_s)
    halves = [without_photos(looped.truth, others) for others in (names[6:], names[:6])]
    lens = halves[1].camera(1)
    lens.params = (1.01 * lens.params).tolist()
    with sole_writer(tmp_path) as output:
        database = copied(output)
        assert database.why_unfit(joined_model(halves, is_of_one_database=True)) is None
        assert "frame_00007.jpg has another camera in the model" in str(database.why_unfit(joined_model(halves)))
