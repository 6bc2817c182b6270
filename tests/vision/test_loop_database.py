"""The copy of a database in which loops are matched: what it keeps, and what the record notes."""

from __future__ import annotations

import json
from pathlib import Path

import pycolmap
import pytest
from tests.simulated.looped import LoopedSurvey, two_laps, write_matches

from rangesfm.colmap.transform import joined_model, without_photos
from rangesfm.files.output_folder import OutputFolder, sole_writer
from rangesfm.progress import SilentProgress
from rangesfm.vision.loop_database import LoopDatabase, forget_loops
from rangesfm.vision.steps import DATABASE_NAME, RECORD_NAME, Steps


@pytest.fixture(scope="module")
def looped() -> LoopedSurvey:
    return two_laps(12, size_m=(8.0, 8.0), num_observations=60)


def copied(output: OutputFolder) -> LoopDatabase:
    return LoopDatabase.of(output.newest(output.path / DATABASE_NAME), output)


def pairs_in(path: Path) -> set[tuple[int, int]]:
    with pycolmap.Database.open(path) as database:
        return {*map(pycolmap.pair_id_to_image_pair, database.read_two_view_geometry_num_inliers()[0])}


def test_the_record_notes_loops_until_they_are_forgotten(looped: LoopedSurvey, tmp_path: Path) -> None:
    neighbours = {pair: of for pair, of in looped.matches.items() if pair[1] - pair[0] < 3}
    others = [pair for pair in looped.matches if pair not in neighbours][:3]
    write_matches(tmp_path / DATABASE_NAME, looped.truth, neighbours)
    (tmp_path / RECORD_NAME).write_text(json.dumps({"steps": {"mapping": {"done": True}}, "notes": {}}))
    with sole_writer(tmp_path) as output:
        first = copied(output)
        first._note(others, ())  # as ``match`` does before it matches
        write_matches(first.path, looped.truth, looped.matches)
        assert first.known() == {
            id_: {other for pair in looped.matches if pair not in others and id_ in pair for other in pair} - {id_}
            for id_ in {id_ for pair in looped.matches if pair not in others for id_ in pair}
        }
        first.keep(others, others, others[:1])
        first.publish(output)
        again = copied(output)
        assert again == first
        assert pairs_in(again.path) == looped.matches.keys() - set(others[1:])
        steps = Steps(again.folder / RECORD_NAME, SilentProgress())
        forget_loops(steps, again.path)
        assert pairs_in(again.path) == looped.matches.keys() - set(others)
        assert not steps.notes["loops"]


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
