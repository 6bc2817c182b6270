"""Rigs of cameras, from their configuration to the mapped model."""

from __future__ import annotations

import json
import shutil
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
from PIL import Image
from tests.known import known as known_scale

from rangesfm.errors import InputError
from rangesfm.mapper_options import MapperOptions
from rangesfm.measurements.lengths.length_scale import lengths_between_points
from rangesfm.measurements.lengths.locate_lengths import locate_distances
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.options import CameraOptions
from rangesfm.sfm.given_database import opened
from rangesfm.sfm.image_times import read_image_times_csv
from rangesfm.sfm.photo_files import usable_photos
from rangesfm.sfm.reconstruct import reconstruct
from rangesfm.sfm.rigs import read_rigs
from rangesfm.solver.bending import WalkBending
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

NUM_CAMERAS, NUM_FRAMES = 3, 8
PREFIXES = [f"camera{k:06d}_" for k in range(1, NUM_CAMERAS + 1)]
NAMES = [f"{prefix}frame{k:06d}.png" for k in range(NUM_FRAMES) for prefix in PREFIXES]


@dataclass(frozen=True)
class Simulated:
    """Blank photos of a rig, the truth, and a database of matches without rigs."""

    folder: Path
    truth: pycolmap.Reconstruction

    @property
    def poses(self) -> list[pycolmap.Rigid3d]:
        """Return the poses of the cameras other than the reference camera."""
        return poses_of(self.truth)

    def config(self, path: Path, known: Collection[int], **others: Any) -> Path:
        """Write a configuration that gives the poses of some of the cameras."""
        cameras: list[dict[str, Any]] = [{"image_prefix": PREFIXES[0], "ref_sensor": True}]
        for k, pose in enumerate(self.poses, 1):
            cameras.append({"image_prefix": PREFIXES[k]})
            if k in known:
                x, y, z, w = pose.rotation.quat.tolist()
                cameras[-1]["cam_from_rig_rotation"] = [w, x, y, z]
                cameras[-1]["cam_from_rig_translation"] = pose.translation.tolist()
        cameras[-1] |= others
        path.write_text(json.dumps([{"cameras": cameras}]))
        return path


def poses_of(model: pycolmap.Reconstruction) -> list[pycolmap.Rigid3d]:
    (rig,) = (rig for rig in model.rigs.values() if rig.non_ref_sensors)
    poses = [rig.non_ref_sensors[sensor] for sensor in sorted(rig.non_ref_sensors, key=lambda sensor: sensor.id)]
    return [pose for pose in poses if pose is not None]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Simulated:
    folder = tmp_path_factory.mktemp("rig")
    pycolmap.set_random_seed(0)
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=1, num_cameras_per_rig=NUM_CAMERAS, num_frames_per_rig=NUM_FRAMES, num_points3D=100
    )
    options.sensor_from_rig_translation_stddev = options.sensor_from_rig_rotation_stddev = 0.2
    with pycolmap.Database.open(folder / "given.db") as database:
        truth = pycolmap.synthesize_dataset(options, database)
        pycolmap.apply_rig_config([], database)
    for name in NAMES:
        Image.new("L", (options.camera_width, options.camera_height)).save(folder / name)
    return Simulated(folder, truth)


def mapped(simulated: Simulated, config: Path, method: str = "incremental") -> pycolmap.Reconstruction:
    mapper = MapperOptions(database_path=simulated.folder / "given.db").changed(method=method)
    summary = reconstruct(
        simulated.folder, NAMES, config.with_name("out"), camera=CameraOptions(), mapper=mapper, rigs=read_rigs(config)
    )
    model = summary.models[0]
    assert model.num_reg_images() == len(NAMES)
    assert model.num_reg_frames() == NUM_FRAMES
    return model


@pytest.mark.parametrize(("method", "max_off"), [("incremental", 1e-12), ("hierarchical", 1e-12), ("global", 1e-5)])
def test_known_places_are_kept_to_the_digit_but_by_the_global_mapper_and_give_the_model_its_scale(
    simulated: Simulated, tmp_path: Path, method: str, max_off: float
) -> None:
    model = mapped(simulated, simulated.config(tmp_path / "rig_config.json", known=(1, 2)), method)
    for found, true in zip(poses_of(model), simulated.poses, strict=True):
        assert np.allclose(found.matrix(), true.matrix(), rtol=0, atol=max_off)
    compared = pycolmap.compare_reconstructions(model, simulated.truth)
    assert compared is not None
    assert compared["rec2_from_rec1"].scale == pytest.approx(1, rel=1e-3)


def test_rigs_of_a_given_database_are_told_to_have_no_say(simulated: Simulated, tmp_path: Path) -> None:
    path = Path(shutil.copy(simulated.folder / "given.db", tmp_path))
    photos = usable_photos(simulated.folder, NAMES)
    for known in ((), (1, 2)):
        if known:
            read_rigs(simulated.config(tmp_path / "rig_config.json", known)).apply(path)
        with opened(path, photos, tmp_path) as given:
            assert given is not None
            assert ("its rigs are ignored: rigs are taken from [images] rig_config" in given.note) == bool(known)


@pytest.mark.parametrize(
    ("known", "method"), [((), "incremental"), ((1,), "incremental"), ((1,), "global"), ((1,), "hierarchical")]
)
def test_unknown_places_are_found_and_go_together_with_those_that_are_known(
    simulated: Simulated, tmp_path: Path, known: tuple[int, ...], method: str
) -> None:
    model = mapped(simulated, simulated.config(tmp_path / "rig_config.json", known), method)
    compared = pycolmap.compare_reconstructions(model, simulated.truth)
    assert compared is not None
    scale = compared["rec2_from_rec1"].scale
    for found, true in zip(poses_of(model), simulated.poses, strict=True):
        assert np.allclose(found.rotation.matrix(), true.rotation.matrix(), rtol=0, atol=1e-3)
        assert np.allclose(scale * found.translation, true.translation, rtol=0, atol=1e-3)
    if known:
        assert scale == pytest.approx(1, rel=1e-3)


def test_what_is_known_of_distances_is_told_of_two_photos_in_the_model(simulated: Simulated, tmp_path: Path) -> None:
    rigs = read_rigs(simulated.config(tmp_path / "rig_config.json", known=(2,)))
    (taped,) = rigs.baselines(simulated.truth, stddev_m=0.002)
    assert taped.ends == (f"{PREFIXES[0]}frame000000.png", f"{PREFIXES[2]}frame000000.png")
    assert taped.distance_m == pytest.approx(np.linalg.norm(simulated.poses[1].translation))
    assert taped.stddev_m == 0.002


@pytest.mark.parametrize(("apart_m", "num_measured"), [(0.0, 1), (1e-4, 2)])
def test_one_baseline_at_two_visits_is_one_length_and_one_measured_anew_is_another(
    simulated: Simulated, tmp_path: Path, apart_m: float, num_measured: int
) -> None:
    model, stddev_m = pycolmap.Reconstruction(simulated.truth), 0.001
    for image in model.images.values():
        visit = "monday" if int(image.name[-8:-4]) < NUM_FRAMES // 2 else "friday"
        image.name = f"{visit}/{image.name}"
    pose, rigs = simulated.poses[1], []
    for visit, longer_m in (("monday", 0.0), ("friday", apart_m)):
        x, y, z, w = pose.rotation.quat.tolist()
        length_m = np.linalg.norm(pose.translation)
        known = {
            "cam_from_rig_rotation": [w, x, y, z],
            "cam_from_rig_translation": (pose.translation * (1 + longer_m / length_m)).tolist(),
        }
        reference = {"image_prefix": f"{visit}/{PREFIXES[0]}", "ref_sensor": True}
        rigs.append({"cameras": [reference, {"image_prefix": f"{visit}/{PREFIXES[2]}", **known}]})
    (tmp_path / "rig_config.json").write_text(json.dumps(rigs))
    taped = read_rigs(tmp_path / "rig_config.json").baselines(model, stddev_m)
    assert len(taped) == num_measured
    path = trajectory_from_reconstruction(model)
    located = locate_distances(Tape(taped), model, [])
    found = known_scale(lengths_between_points(located, WalkBending(path))).alone
    assert found.scale.value == pytest.approx(1.0, rel=1e-3)
    expected = stddev_m / np.linalg.norm(pose.translation) / np.sqrt(num_measured)
    assert found.posterior.uncertainty.empirical == pytest.approx(expected, rel=1e-3)


def test_photos_of_one_frame_share_the_time_of_the_first_of_them_that_has_one(
    simulated: Simulated, tmp_path: Path
) -> None:
    frames = read_rigs(simulated.config(tmp_path / "rig_config.json", known=())).frames(["other.png", *NAMES])
    assert len(frames) == NUM_FRAMES + 1
    assert frames[NAMES[0]] == tuple(NAMES[:NUM_CAMERAS])
    rows = [f"{name},{row // NUM_CAMERAS}" for row, name in enumerate(NAMES)]
    (tmp_path / "times.csv").write_text("\n".join(["image_name,timestamp_s", *rows[1:], "other.png,-1"]))
    times = read_image_times_csv(tmp_path / "times.csv", tuple(frames), frames)
    assert times.image_names == ("other.png", *NAMES[::NUM_CAMERAS])
    assert times.timestamps_s.tolist() == [-1, *range(NUM_FRAMES)]
    (tmp_path / "times.csv").write_text(f"image_name,timestamp_s\n{NAMES[0]},1\n{NAMES[1]},1\nother.png,1\n")
    with pytest.raises(InputError, match=rf"4: other.png has the same time as {NAMES[0]} in line 2"):
        read_image_times_csv(tmp_path / "times.csv", tuple(frames), frames)


@pytest.mark.parametrize(
    ("others", "message"),
    [
        ({"cam_from_rig_rotation": [1, 0, 0]}, "cam_from_rig_rotation of 'camera000003_' has 3 numbers, expected 4"),
        ({"cam_from_rig_rotation": [2, 0, 0, 0]}, "is .2, 0, 0, 0., expected w, x, y, z of length 1"),
        ({"ref_sensor": True}, "is not a rig configuration of COLMAP's .*only have one reference sensor"),
        ({"image_prefix": "right/"}, "no photo's name begins with image_prefix 'right/'"),
        ({"image_prefix": "camera00000"}, "belongs to 'camera000001_' and 'camera00000', expected one image_prefix"),
    ],
)
def test_what_is_no_rig_is_one_line(simulated: Simulated, tmp_path: Path, others: dict[str, Any], message: str) -> None:
    path = simulated.config(tmp_path / "rig_config.json", known=(), **others)
    with pytest.raises(InputError, match=f"rig_config.json: .*{message}"):
        read_rigs(path).frames(NAMES)
    path.write_text("[]")
    with pytest.raises(InputError, match=r"rig_config.json: holds no rig"):
        read_rigs(path)
