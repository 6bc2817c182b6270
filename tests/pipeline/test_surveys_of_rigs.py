"""A stereo rig and a radio, each of which determines the scale."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pycolmap
import pytest
from tests.known import known

from rangesfm.colmap.transform import rescale
from rangesfm.pipeline import map_photos
from rangesfm.pipeline.map_photos import find_keyframes, map_keyframes
from rangesfm.pipeline.run import refine_model
from rangesfm.progress import Journal, Progress
from rangesfm.result.summary import ResultSummary
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import survey_from_tables
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

LEFT, RIGHT = "camera000001_", "camera000002_"
NUM_FRAMES, RANGES_PER_FRAME = 20, 8
BASELINE_STDDEV_M, RANGE_STDDEV_M = 0.001, 0.05
TAG_IN_CAM_M = np.array([0.05, -0.2, 0.1])
ANCHORS_M = {"A1": (-8.0, -7.0, 1.0), "A2": (8.0, -6.0, 4.0), "A3": (7.0, 8.0, -1.0), "A4": (-6.0, 7.0, -4.0)}


@dataclass(frozen=True)
class StereoSurvey:
    """A model of a stereo rig, whose unit comes from the configured baseline, and ranges to surveyed anchors.

    Attributes:
        true_scale: metres per unit of the model.
    """

    folder: Path
    true_scale: float

    def refined(self, *, with_radio: bool = True) -> ResultSummary:
        tables: dict[str, dict[str, Any]] = {
            "images": {"rig_config": "rig_config.json", "baseline_stddev_m": BASELINE_STDDEV_M},
            "ranges": {"path": "ranges.csv", "range_stddev_m": RANGE_STDDEV_M},
            "anchors": {"path": "anchors.csv"},
            "tag": {"tag_in_cam_m": TAG_IN_CAM_M.tolist()},
            "output": {"path": "out"},
        }
        if not with_radio:
            del tables["ranges"], tables["anchors"], tables["tag"]
        survey: Survey = survey_from_tables(tables, self.folder)
        survey = survey.changed({"images.model": self.folder / "sparse"})
        return refine_model(survey, progress=Progress()).summary


def stereo_survey(folder: Path, *, baseline_error: float = 0.0) -> StereoSurvey:
    """Simulate a stereo survey.

    Args:
        baseline_error: relative error of the configured baseline, positive if it is too long.
    """
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=NUM_FRAMES, num_points3D=200
    )
    options.sensor_from_rig_translation_stddev, options.sensor_from_rig_rotation_stddev = 0.3, 0.05
    truth = pycolmap.synthesize_dataset(options)
    write_ranges(folder, truth, np.random.default_rng(0))
    pycolmap.synthesize_noise(pycolmap.SyntheticNoiseOptions(point2D_stddev=0.5), truth)
    model = rescale(truth, Similarity(1 + baseline_error, np.eye(3), np.zeros(3)))
    (folder / "sparse").mkdir()
    model.write(folder / "sparse")
    (rig,) = model.rigs.values()
    (pose,) = rig.non_ref_sensors.values()
    assert pose is not None
    x, y, z, w = pose.rotation.quat.tolist()
    relative = {"cam_from_rig_rotation": [w, x, y, z], "cam_from_rig_translation": pose.translation.tolist()}
    cameras = [{"image_prefix": LEFT, "ref_sensor": True}, {"image_prefix": RIGHT, **relative}]
    (folder / "rig_config.json").write_text(json.dumps([{"cameras": cameras}]))
    return StereoSurvey(folder, 1 / (1 + baseline_error))


def write_ranges(folder: Path, truth: pycolmap.Reconstruction, rng: np.random.Generator) -> None:
    """Write several ranges from each frame to each anchor, with independent noise, and the anchors."""
    path = trajectory_from_reconstruction(truth)
    tags = path.centers + path.world_from_cam @ TAG_IN_CAM_M
    rows = ["image_name,anchor_id,range_m"]
    for name, tag in zip(path.image_names, tags, strict=True):
        for anchor_id, position in ANCHORS_M.items():
            ranges = np.linalg.norm(tag - position) + rng.normal(0, RANGE_STDDEV_M, RANGES_PER_FRAME)
            rows += [f"{name},{anchor_id},{range_m:.4f}" for range_m in ranges]
    (folder / "ranges.csv").write_text("\n".join(rows) + "\n")
    places = [f"{anchor_id},{x},{y},{z}" for anchor_id, (x, y, z) in ANCHORS_M.items()]
    (folder / "anchors.csv").write_text("\n".join(["anchor_id,x_m,y_m,z_m", *places]) + "\n")


def test_scales_by_ranges_and_by_baseline_agree_and_together_are_surer(tmp_path: Path) -> None:
    survey = stereo_survey(tmp_path)
    found = survey.refined()
    assert found.scale.verdict == "good"
    assert abs(np.log(found.scale.value / survey.true_scale)) < 3 * known(found.scale.relative_stddev.formal)
    (length,) = found.distances
    assert (length.from_, length.to) == (f"{LEFT}frame000000.png", f"{RIGHT}frame000000.png")
    by_kind = found.scale.by_kind
    assert by_kind["lengths"].value == pytest.approx(survey.true_scale)
    assert by_kind["ranges"].value == pytest.approx(survey.true_scale, rel=0.02)
    assert not any(test.rejected for test in found.tests)
    assert found.refine is not None
    assert found.refine.relative_scale_stddev is not None
    assert found.refine.scale_value is not None
    assert abs(np.log(found.refine.scale_value / survey.true_scale)) < 3 * found.refine.relative_scale_stddev
    assert (found.scale.stddev_empirical or np.inf) < 0.5 * (by_kind["ranges"].stddev or 0.0)


def test_a_baseline_wrong_by_3_percent_is_found_by_the_ranges_and_said(tmp_path: Path) -> None:
    found = stereo_survey(tmp_path, baseline_error=0.03).refined()
    (test,) = [test for test in found.tests if test.name == "lengths against ranges"]
    assert test.rejected
    assert test.size == pytest.approx(0.03, abs=0.005)
    assert found.scale.verdict == "doubtful"
    assert any("by the measured lengths the map is" in reason for reason in found.scale.reasons)


def test_a_stereo_rig_gives_metres_without_a_radio(tmp_path: Path) -> None:
    survey = stereo_survey(tmp_path)
    found = survey.refined(with_radio=False)
    assert found.metric_from_sfm.scale == pytest.approx(survey.true_scale, rel=1e-6)
    low, high = found.scale.interval_95 or (0.0, 0.0)
    assert low < survey.true_scale < high
    assert "one length that nothing checks" in " ".join(found.scale.reasons)


def test_a_frame_is_one_keyframe_with_the_time_of_its_photos_and_all_of_them_are_mapped(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = [f"{prefix}frame{k}.png" for k in range(4) for prefix in (LEFT, RIGHT)]
    (tmp_path / "images").mkdir()
    for name in names:
        (tmp_path / "images" / name).touch()
    rows = [f"{name},{row // 2}.000" for row, name in enumerate(names)]
    (tmp_path / "images.csv").write_text("\n".join(["image_name,timestamp_s", *rows]))
    cameras = [{"image_prefix": LEFT, "ref_sensor": True}, {"image_prefix": RIGHT}]
    (tmp_path / "rig_config.json").write_text(json.dumps([{"cameras": cameras}]))
    tables = {"images": {"path": "images", "times": "images.csv", "rig_config": "rig_config.json"}}
    survey, journal = survey_from_tables(tables, tmp_path), Journal(Progress())
    keyframes, times = find_keyframes(survey, journal)
    assert keyframes == tuple(names[::2])
    assert times is not None
    assert times.by_name() == {name: float(k) for k, name in enumerate(names[::2])}
    assert journal.warnings == []
    mapped: list[str] = []
    summary = SimpleNamespace(seconds={}, earlier_seconds={}, num_registered=2, num_keyframes=2, models=())

    def reconstruct_in(_: object, folder: Path, chosen: list[str], *__: object, **___: object) -> SimpleNamespace:
        mapped.extend(chosen)
        return summary

    monkeypatch.setattr(map_photos, "reconstruct_in", reconstruct_in)
    map_keyframes(survey, keyframes[1:], journal, restart=False, deferred=False)
    assert mapped == names[2:]
