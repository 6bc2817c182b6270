"""Loops of a mapper's model are closed by its photos alone: those that look alike, and those that the map predicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap
import pytest
from tests.listener import Listener
from tests.outputs import names_in
from tests.simulated.looped import LoopedSurvey, Matches, Pair, around_a_room, two_aisles, write_matches

from rangesfm.colmap.model_files import read_model
from rangesfm.colmap.transform import rescale
from rangesfm.pipeline.close_loops import close_loops_of_models
from rangesfm.progress import SILENT, Journal, Progress
from rangesfm.sfm.loop_database import LoopMatching
from rangesfm.sfm.loops.candidates import Views
from rangesfm.sfm.loops.loop_finder import LoopFinder
from rangesfm.sfm.steps import Workspace
from rangesfm.survey.settings import Survey
from rangesfm.util.files.output_folder import OutputFolder, sole_writer
from rangesfm.util.geometry.similarity import IDENTITY, align_points, rmse
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction


@dataclass(frozen=True)
class Reconstructed:
    """An output folder as a reconstruction by neighbours in time leaves it, in which one unit is 2.5 m."""

    looped: LoopedSurvey
    out: Path

    @classmethod
    def of(cls, looped: LoopedSurvey, out: Path) -> Reconstructed:
        with sole_writer(out) as output:
            made = output.private / "made"
            (made / "sparse" / "0").mkdir(parents=True)
            rescale(looped.chain(), replace(IDENTITY, scale=0.4)).write_binary(made / "sparse" / "0")
            write_matches(made / "database.db", looped.truth, looped.neighbours, with_descriptors=True)
            Workspace(made, SILENT).note("made", {})
            output.publish({out / path.name: path for path in made.iterdir()})
            made.rmdir()
        return cls(looped, out)

    def close(self, progress: Progress = SILENT) -> pycolmap.Reconstruction:
        values = {"mapper.matching": "sequential", "mapper.num_threads": 1, "camera.refine_intrinsics": False}
        values["output.path"] = self.out
        return close_loops_of_models(Survey().changed(values), [self.model], Journal(progress))

    @property
    def model(self) -> pycolmap.Reconstruction:
        return read_model(self.out / "sparse" / "0")

    def error_m(self, model: pycolmap.Reconstruction) -> float:
        """Return the root mean square error of the keyframes after the best similarity."""
        truth = self.looped.survey.model
        path = trajectory_from_reconstruction(model, truth.timestamps_s)
        return rmse(align_points(path.centers, truth.centers_m).apply(path.centers) - truth.centers_m)


def test_a_model_without_any_measurement_has_its_loops_closed_though_it_was_interrupted(tmp_path: Path) -> None:
    made, listener = Reconstructed.of(around_a_room(), tmp_path / "out"), Listener()
    open_m, before = made.error_m(made.model), (tmp_path / "out" / "sparse" / "0" / "points3D.bin").read_bytes()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(LoopMatching, "keep", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            made.close()
    assert (tmp_path / "out" / "sparse" / "0" / "points3D.bin").read_bytes() == before
    closed = made.close(listener)
    num_done, num_all = listener.updates["loops"][0]
    assert num_done == num_all > 0  # it has the matches of the interrupted run
    (line,) = (line for line in listener.messages if line.startswith("loops: "))
    assert "were used to close loops" in line
    assert made.error_m(closed) < 0.4 * open_m
    assert made.error_m(made.model) == pytest.approx(made.error_m(closed), rel=1e-9)
    assert set(names_in(tmp_path / "out" / ".rangesfm")) == {"manifest.json"}
    again = Listener()
    made.close(again)
    assert not again.stages


def test_one_that_was_stopped_before_its_model_took_its_place_closes_them_again(tmp_path: Path) -> None:
    made = Reconstructed.of(around_a_room(), tmp_path / "out")
    open_m = made.error_m(made.model)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OutputFolder, "publish", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        with pytest.raises(KeyboardInterrupt):
            made.close()
    assert made.error_m(made.model) == open_m
    made.close()
    assert made.error_m(made.model) < 0.4 * open_m


def test_photos_that_look_alike_close_loops_that_a_map_does_not_predict(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = Reconstructed.of(around_a_room(), tmp_path / "out")
    monkeypatch.setattr(LoopFinder, "propose", lambda *_, **__: {})
    monkeypatch.setattr(Views, "overlaps", lambda *given, **_: 0.0 * given[2])
    open_m = made.error_m(made.model)
    assert made.error_m(made.close()) < 0.6 * open_m


def test_aisles_that_look_alike_are_not_taken_for_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    survey, listener = two_aisles(), Listener()
    made = Reconstructed.of(survey.looped, tmp_path / "out")
    open_m, match = made.error_m(made.model), LoopMatching.match

    def match_all(matching: LoopMatching, pairs: list[Pair]) -> dict[Pair, Matches]:
        return {**match(matching, pairs), **survey.alike}

    monkeypatch.setattr(LoopMatching, "match", match_all)
    assert made.error_m(made.close(listener)) < 1.5 * open_m
    assert any(f"; {len(survey.alike)} contradict the model and were not used" in line for line in listener.messages)


def test_loops_stay_open_where_more_than_neighbours_was_matched(tmp_path: Path) -> None:
    made = Reconstructed.of(two_aisles().looped, tmp_path / "out")
    survey = Survey().changed({"mapper.matching": "exhaustive", "output.path": made.out})
    models: Sequence[pycolmap.Reconstruction] = [made.model]
    assert close_loops_of_models(survey, models, Journal(SILENT)) is models[0]
