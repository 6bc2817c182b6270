"""COLMAP models are read unchanged, and damaged ones are refused before they do harm."""

from __future__ import annotations

import itertools
import math
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from tests.fuzz.model_bytes import ModelFile, parse

from rangesfm.colmap.model_files import read_model
from rangesfm.errors import InputError

if TYPE_CHECKING:
    from tests.conftest import WalkedSurvey


@pytest.fixture(scope="module")
def rigs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A model of two rigs of three cameras each, with points."""
    options = pycolmap.SyntheticDatasetOptions(
        num_rigs=2,
        num_cameras_per_rig=3,
        num_frames_per_rig=4,
        num_points3D=30,
        camera_model_id=pycolmap.CameraModelId.OPENCV,
        camera_params=[1280.0, 1280.0, 512.0, 384.0, 0.05, 0.0, 0.0, 0.0],
    )
    folder = tmp_path_factory.mktemp("rigs")
    pycolmap.synthesize_dataset(options).write_binary(folder)
    return folder


def test_binary_and_text_models_are_read_whole(rigs: Path, tmp_path: Path) -> None:
    model = read_model(rigs)
    assert (model.num_rigs(), model.num_cameras(), model.num_reg_images(), model.num_points3D()) == (2, 6, 24, 30)
    model.write_text(tmp_path)
    text = read_model(tmp_path)
    for image_id, image in model.images.items():
        np.testing.assert_allclose(text.image(image_id).projection_center(), image.projection_center(), atol=1e-9)


@pytest.mark.parametrize("name", ["cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin"])
def test_file_cut_off_anywhere_is_refused(name: str, rigs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(rigs, tmp_path / "model")
    data = (folder / name).read_bytes()
    for length in np.linspace(0, len(data) - 1, 40).astype(int):
        (folder / name).write_bytes(data[:length])
        with pytest.raises(InputError, match="is damaged or cut off") as caught:
            read_model(folder)
        assert caught.value.path == folder / name


def test_folder_above_the_model_is_told_from_the_model(rigs: Path, tmp_path: Path) -> None:
    shutil.copytree(rigs, tmp_path / "sparse" / "0")
    with pytest.raises(InputError, match=r"not a COLMAP model, .*; is it .*sparse/0\?"):
        read_model(tmp_path / "sparse")
    with pytest.raises(InputError, match=r"files that COLMAP wrote$"):
        read_model(tmp_path)


@pytest.mark.parametrize("ending", [".bin", ".txt"])
@pytest.mark.parametrize("name", ["cameras", "images", "points3D"])
def test_missing_file_is_named(name: str, ending: str, rigs: Path, tmp_path: Path) -> None:
    model = read_model(rigs)
    (model.write_binary if ending == ".bin" else model.write_text)(tmp_path)
    (tmp_path / (name + ending)).unlink()
    with pytest.raises(InputError, match=f"not a whole COLMAP model, there is no {name}{ending};"):
        read_model(tmp_path)


@pytest.mark.parametrize("write", [pycolmap.Reconstruction.write_binary, pycolmap.Reconstruction.write_text])
def test_names_may_hold_blanks(
    write: Callable[[pycolmap.Reconstruction, Path], None], rigs: Path, tmp_path: Path
) -> None:
    model = read_model(rigs)
    for image in model.images.values():
        image.name = f"my  own {image.name}"
    write(model, tmp_path)
    read = read_model(tmp_path)
    assert {id: image.name for id, image in read.images.items()} == {
        id: image.name for id, image in model.images.items()
    }
    assert read.num_points3D() == model.num_points3D()


@pytest.mark.parametrize("damage", ["cut", "nan", "commas"])
def test_damaged_line_of_a_text_model_is_named(damage: str, rigs: Path, tmp_path: Path) -> None:
    read_model(rigs).write_text(tmp_path)
    lines = (tmp_path / "images.txt").read_text().split("\n")
    number = 6 if damage == "cut" else 5
    line = lines[number - 1]
    words = line.split()
    damaged = {"cut": " ".join(words[:-1]), "nan": " ".join([words[0], "nan", *words[2:]])}
    lines[number - 1] = damaged.get(damage, line.replace(" ", ","))
    end = number if damage == "cut" else len(lines)
    (tmp_path / "images.txt").write_text("\n".join(lines[:end]))
    with pytest.raises(InputError, match=r"cut off or damaged|no line of a photo") as caught:
        read_model(tmp_path)
    assert (caught.value.path, caught.value.line) == (tmp_path / "images.txt", number)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("which", ["all", "last", "every other", "end of file"])
def test_photos_of_a_text_model_may_lack_the_line_of_their_features(which: str, rigs: Path, tmp_path: Path) -> None:
    model = read_model(rigs)
    model.write_text(tmp_path)
    (tmp_path / "points3D.txt").write_text("")
    lines = [line for line in (tmp_path / "images.txt").read_text().split("\n") if line[:1] != "#"]
    poses = lines[: 2 * len(model.images) : 2]
    text = {"all": "\n", "last": "\n\n", "end of file": "\n\n"}.get(which, "").join(poses)
    if which == "every other":
        text = "".join(line + "\n" * (1 + k % 2) for k, line in enumerate(poses))
    (tmp_path / "images.txt").write_text(f"# poses\n{text}" + "\n" * (which != "end of file"))
    read = read_model(tmp_path)
    assert read.num_reg_images() == len(poses) == 24
    for image_id, image in model.images.items():
        assert read.image(image_id).name == image.name
        np.testing.assert_allclose(read.image(image_id).projection_center(), image.projection_center(), atol=1e-9)


def test_missing_line_of_features_leaves_those_of_other_photos_alone(rigs: Path, tmp_path: Path) -> None:
    model = read_model(rigs)
    bare = min(model.images)
    for feature, point in enumerate(model.image(bare).points2D):
        if point.has_point3D():
            model.delete_observation(bare, feature)
    model.write_text(tmp_path)
    lines = (tmp_path / "images.txt").read_text().split("\n")
    at = next(k for k, line in enumerate(lines) if line.split()[:1] == [str(bare)])
    (tmp_path / "images.txt").write_text("\n".join([*lines[: at + 1], *lines[at + 2 :]]))
    read = read_model(tmp_path)
    assert read.num_points3D() == model.num_points3D()
    seen = [{id: image.num_points3D for id, image in each.images.items()} for each in (read, model)]
    assert seen[0] == seen[1]
    assert (read.image(bare).num_points2D(), max(seen[0].values()) > 0) == (0, True)


def test_pose_that_is_not_finite_is_named(walked_survey: WalkedSurvey, tmp_path: Path) -> None:
    model = read_model(walked_survey.folder / "sparse" / "0")
    model.frame(3).rig_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.full(3, np.nan))
    model.write(tmp_path)
    with pytest.raises(InputError, match=r"the pose of frame_00003\.jpg is not finite"):
        read_model(tmp_path)


class TestContent:
    """Contents that COLMAP would accept and fail on later; each test spoils one thing."""

    @pytest.fixture
    def refused(self, rigs: Path, tmp_path: Path) -> Callable[..., str]:
        """Return a function that changes a file and returns the message of the refusal."""

        def read(name: str, change: Callable[[ModelFile], object]) -> str:
            folder = shutil.copytree(rigs, tmp_path / "model")
            file = parse(name, (folder / name).read_bytes())
            change(file)
            (folder / name).write_bytes(file.pack())
            with pytest.raises(InputError) as caught:
                read_model(folder)
            assert str(caught.value).isprintable()
            assert caught.value.path in (folder, folder / name)
            return str(caught.value)

        return read

    @pytest.mark.parametrize(
        ("name", "field", "value", "said"),
        [
            ("cameras.bin", "param", math.nan, "camera 1 has impossible parameters"),
            ("cameras.bin", "param", 1e308, "camera 1 has impossible parameters"),
            ("cameras.bin", "param", 0.0, "camera 1 has impossible parameters"),
            ("cameras.bin", "width", 2**63, f"camera 1 has photos of {2**63} x 768 pixels"),
            ("cameras.bin", "height", 0, "camera 1 has photos of 1024 x 0 pixels"),
            ("frames.bin", "tx", 1e300, r"the pose of \S+\.png is not finite"),
            ("frames.bin", "qw", 3.0, r"the pose of \S+\.png has a quaternion of length 3\.\d+, expected 1"),
            ("images.bin", "name", b"", "the name of image 1 is not printable text"),
            ("images.bin", "name", b"\xff.jpg", "the name of image 1 is not printable text"),
            ("images.bin", "name", b"two\nlines.jpg", "the name of image 1 is not printable text"),
            ("images.bin", "y", 1e308, "a feature has no finite pixel coordinates"),
            ("points3D.bin", "x", math.inf, r"points3D.bin: point \d+ is at \(inf, .*\), expected finite coordinates"),
        ],
    )
    def test_that_is_no_number_or_name_is_named(
        self, name: str, field: str, value: float | bytes, said: str, refused: Callable[..., str]
    ) -> None:
        def change(file: ModelFile) -> None:
            fields = itertools.chain(file.records[0], *file.groups[0])
            next(item for item in fields if item.name == field).value = value

        assert re.search(f"{said}$", refused(name, change))

    def test_that_has_a_name_twice_is_named(self, refused: Callable[..., str]) -> None:
        def change(file: ModelFile) -> None:
            names = [item for record in file.records for item in record if item.name == "name"]
            names[1].value = names[0].value

        assert re.search(r"2 images are called \S+\.png, expected each name once", refused("images.bin", change))

    @pytest.mark.parametrize("num_left", [0, 1, -1])
    def test_whose_tracks_are_shorter_than_the_features_say_is_refused(
        self, num_left: int, refused: Callable[..., str]
    ) -> None:
        def change(file: ModelFile) -> None:
            del file.groups[0][num_left:]
            file.records[0][-1].value = len(file.groups[0])

        assert "the tracks of the points do not agree with the features of the images" in refused(
            "points3D.bin", change
        )

    def test_whose_points_are_gone_is_refused(self, refused: Callable[..., str]) -> None:
        def change(file: ModelFile) -> None:
            del file.records[3], file.groups[3]
            file.count -= 1

        assert "the tracks of the points do not agree with the features of the images" in refused(
            "points3D.bin", change
        )

    def test_that_sees_a_point_twice_at_one_feature_is_refused(self, refused: Callable[..., str]) -> None:
        def change(file: ModelFile) -> None:
            file.groups[0][1] = file.groups[0][0]

        assert "the tracks of the points do not agree with the features of the images" in refused(
            "points3D.bin", change
        )

    def test_whose_image_is_gone_is_refused(self, rigs: Path, tmp_path: Path) -> None:
        model = read_model(rigs)
        model.delete_all_points2D_and_points3D()
        model.write_binary(tmp_path)
        images = parse("images.bin", (tmp_path / "images.bin").read_bytes())
        del images.records[3], images.groups[3]
        images.count -= 1
        (tmp_path / "images.bin").write_bytes(images.pack())
        with pytest.raises(
            InputError, match=r"frame \d+ has a pose but no image, or names an image that does not exist"
        ):
            read_model(tmp_path)

    def test_without_tracks_and_features_is_read(self, rigs: Path, tmp_path: Path) -> None:
        model = read_model(rigs)
        model.delete_all_points2D_and_points3D()
        model.add_point3D_with_id(5, pycolmap.Point3D())
        for write in (model.write_binary, model.write_text):
            folder = tmp_path / write.__name__
            folder.mkdir()
            write(folder)
            assert read_model(folder).num_points3D() == 1

    def test_of_a_text_model_is_looked_at_too(self, rigs: Path, tmp_path: Path) -> None:
        read_model(rigs).write_text(tmp_path)
        text = (tmp_path / "points3D.txt").read_text().splitlines(keepends=True)
        (tmp_path / "points3D.txt").write_text("".join(text[:-1]))
        with pytest.raises(InputError, match="the tracks of the points do not agree with the features"):
            read_model(tmp_path)

    def test_with_quaternions_of_few_digits_has_rotations_all_the_same(self, rigs: Path, tmp_path: Path) -> None:
        read_model(rigs).write_binary(tmp_path)
        frames = parse("frames.bin", (tmp_path / "frames.bin").read_bytes())
        for record in frames.records:
            for item in record[2:6]:
                item.value = round(float(item.value), 3)
        (tmp_path / "frames.bin").write_bytes(frames.pack())
        for frame in read_model(tmp_path).frames.values():
            assert frame.rig_from_world is not None
            assert np.linalg.norm(frame.rig_from_world.params[:4]) == pytest.approx(1, abs=1e-15)


@pytest.mark.parametrize(
    ("name", "pattern", "new", "said"),
    [
        ("cameras.txt", r"^2 OPENCV", "2 OPENCW", "cameras.txt:5: is '2 OPENCW 1024 768 "),
        ("cameras.txt", r"^(2 OPENCV .*) \S+$", r"\1", "cameras.txt:5: is '2 OPENCV 1024 768 "),
        ("cameras.txt", r"^2 .*\n", "", "rigs.txt:4: rig 1 names camera 2, which is not in cameras.txt"),
        ("cameras.txt", r"\A", "\ufeff", "cameras.txt:1: begins with a byte order mark"),
        ("points3D.txt", r"^(3 \S+) .*$", r"\1", "points3D.txt:6: is '3 "),
        ("points3D.txt", r"^3 \S+", "3 nan", "points3D.txt:6: is '3 nan "),
        ("points3D.txt", r"^(3(?: \S+){7}) \d+", r"\1 99", "points3D.txt:6: point 3 names image 99, which is not in "),
        ("points3D.txt", r"^(3 .*) \d+\s*$", r"\1 9999\n", "points3D.txt:6: point 3 names feature 9999 of image "),
        ("points3D.txt", r"^(3 .*)$", r"\1\n\1", "points3D.txt:7: point 3 is in line 6 already"),
        ("images.txt", r"^2((?: \S+){7}) \d+", r"2\1 77", "images.txt:7: image 2 names camera 77, which is not in "),
        ("images.txt", r"^2((?: \S+){7} \d+ )", r"1\1", "images.txt:7: image 1 is in line 5 already"),
        ("frames.txt", r"^2 \d+", "2 9", "frames.txt:5: frame 2 names rig 9, which is not in rigs.txt"),
        ("frames.txt", r"^2 .*\n", "", "is in no frame of frames.txt"),
        ("rigs.txt", r"^1 .*$", "1 2 X", "rigs.txt:4: is '1 2 X', expected RIG_ID NUM_SENSORS and the sensors"),
    ],
)
def test_a_fault_in_a_text_model_is_said_with_its_file_and_line(
    name: str, pattern: str, new: str, said: str, rigs: Path, tmp_path: Path
) -> None:
    read_model(rigs).write_text(tmp_path)
    text = (tmp_path / name).read_text(encoding="utf-8")
    changed = re.sub(pattern, new, text, count=1, flags=re.MULTILINE)
    assert changed != text
    (tmp_path / name).write_text(changed, encoding="utf-8")
    with pytest.raises(InputError) as caught:
        read_model(tmp_path)
    assert said in str(caught.value)


@pytest.mark.parametrize(
    ("name", "at", "said"),
    [
        ("cameras.bin", 12, "cameras.bin: record 1: camera {} has the model 77, which COLMAP does not know"),
        ("images.bin", 8 + 60, "images.bin: record 1: image {} names camera 77, which is not in cameras.bin"),
        ("frames.bin", 8 + 4, "frames.bin: record 1: frame {} names rig 77, which is not in rigs.bin"),
    ],
)
def test_a_fault_in_a_binary_model_is_said_with_its_file_and_record(
    name: str, at: int, said: str, rigs: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(rigs, tmp_path / "model")
    data = bytearray((folder / name).read_bytes())
    data[at : at + 4] = (77).to_bytes(4, "little")
    (folder / name).write_bytes(data)
    with pytest.raises(InputError) as caught:
        read_model(folder)
    assert said.format(int.from_bytes(data[8:12], "little")) in str(caught.value)


def test_rigs_without_frames_are_named(rigs: Path, tmp_path: Path) -> None:
    folder = shutil.copytree(rigs, tmp_path / "model")
    (folder / "frames.bin").unlink()
    with pytest.raises(InputError, match=r"there is rigs\.bin without frames\.bin"):
        read_model(folder)
