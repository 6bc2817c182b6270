from __future__ import annotations

import os
import re
import shutil
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from PIL import Image
from tests.outputs import names_in, paths_below, unfinished
from tests.sfm.matches import content_of

from rangesfm.errors import InputError, ReconstructionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.sfm.reconstruct import ReconstructionSummary, reconstruct

if TYPE_CHECKING:
    from tests.listener import Listener
    from tests.sfm.conftest import Room

FEATURES = {"sift": {"first_octave": 0, "max_num_features": 250}}  # enough for these photos, and quick
MAPPER = MapperOptions(features=FEATURES, reproducible=True)


@pytest.fixture(scope="module")
def done(room: Room, tmp_path_factory: pytest.TempPathFactory) -> ReconstructionSummary:
    """The room, reconstructed once for all tests that only look at the result."""
    output = tmp_path_factory.mktemp("done") / "new" / "out"
    return reconstruct(room.folder, room.names, output, camera=room.camera, mapper=MAPPER)


@pytest.fixture
def output(done: ReconstructionSummary, tmp_path: Path) -> Path:
    """A copy of the output folder of ``done``."""
    return shutil.copytree(done.log_path.parent, tmp_path / "out")


def centers_by_name(model: pycolmap.Reconstruction) -> dict[str, npt.NDArray[np.float64]]:
    return {image.name: image.projection_center() for image in model.images.values() if image.has_pose}


class TestOneModel:
    def test_holds_every_photo_at_its_place_up_to_a_similarity(self, room: Room, done: ReconstructionSummary) -> None:
        assert (len(done.models), done.num_registered) == (1, 6)
        centers = centers_by_name(done.models[0])
        sfm = np.array([centers[name] for name in room.names])
        world_from_sfm = pycolmap.estimate_sim3d(sfm, room.centers)
        assert world_from_sfm is not None
        errors = np.linalg.norm([world_from_sfm * center for center in sfm] - room.centers, axis=1)
        assert errors.max() < 0.02 * np.linalg.norm(np.ptp(room.centers, axis=0))

    def test_is_on_disk_beside_the_database_and_the_log_and_nothing_else(self, done: ReconstructionSummary) -> None:
        folder = done.log_path.parent
        assert names_in(folder) == ["database.db", "mapper.log", "reconstruct.json", "sparse"]
        assert os.listdir(folder / "sparse") == ["0"]
        assert pycolmap.Reconstruction(folder / "sparse" / "0").num_reg_images() == 6
        log = done.log_path.read_text()
        assert "Feature extraction" in log
        assert "Registering image" in log
        assert set(done.seconds) == {"features", "matching", "mapping"}

    @pytest.mark.parametrize("stddev_px", [0.0, None])
    def test_keeps_known_intrinsics_to_the_last_digit_only_on_demand(
        self, room: Room, output: Path, stddev_px: float | None
    ) -> None:
        true = room.camera.params
        assert true is not None
        given = 1.02 * true[0], *true[1:]
        camera = room.camera.changed(params=given, focal_length_stddev_px=stddev_px)
        (model,) = reconstruct(room.folder, room.names, output, camera=camera, mapper=MAPPER).models
        found = [tuple(camera.params) for camera in model.cameras.values()]
        assert found == ([given] if stddev_px == 0 else [pytest.approx(true, rel=0.005)])

    def test_has_a_database_with_options_as_given(self, output: Path) -> None:
        with pycolmap.Database.open(output / "database.db") as database:
            assert all(50 < database.num_keypoints_for_image(image_id) < 1000 for image_id in range(1, 7))

    def test_comes_again_with_the_same_seed_progress_to_the_end_and_a_clean_terminal(
        self,
        room: Room,
        done: ReconstructionSummary,
        tmp_path: Path,
        listener: Listener,
        capfd: pytest.CaptureFixture[str],
    ) -> None:
        again = reconstruct(room.folder, room.names, tmp_path, camera=room.camera, mapper=MAPPER, progress=listener)
        centers, others = centers_by_name(done.models[0]), centers_by_name(again.models[0])
        assert max(np.abs(centers[name] - others[name]).max() for name in room.names) < 1e-9
        assert listener.stages == ["features", "matching", "mapping"]
        assert {step: updates[-1] for step, updates in listener.updates.items()} == {
            "features": (6, 6),
            "matching": (15, 15),
            "mapping": (6, 6),
        }
        assert listener.messages == []
        assert capfd.readouterr() == ("", "")


class TestCamera:
    def test_is_refined_from_colmaps_guess_when_only_its_model_is_known(self, room: Room, tmp_path: Path) -> None:
        camera = CameraOptions(model="SIMPLE_PINHOLE")
        summary = reconstruct(room.folder, room.names, tmp_path, camera=camera, mapper=MAPPER)
        (refined,) = summary.models[0].cameras.values()
        assert summary.num_registered == 6
        assert refined.model == pycolmap.CameraModelId.SIMPLE_PINHOLE
        assert refined.focal_length == pytest.approx(240, rel=0.03)  # the guess is 307

    def test_is_refined_from_its_parameters_on_demand(self, room: Room, tmp_path: Path) -> None:
        camera = CameraOptions(model="SIMPLE_PINHOLE", params=(250.0, 128.0, 96.0), refine_intrinsics=True)
        summary = reconstruct(room.folder, room.names, tmp_path, camera=camera, mapper=MAPPER)
        assert next(iter(summary.models[0].cameras.values())).focal_length == pytest.approx(240, rel=0.03)

    @pytest.mark.parametrize(
        ("camera", "message"),
        [
            (
                CameraOptions(model="PINHOL", params=(1.0,)),
                "model is 'PINHOL', expected a COLMAP camera model; the nearest is 'PINHOLE'",
            ),
            (
                CameraOptions(model="PINHOLE", params=(300.0, 160.0, 120.0)),
                "3 numbers, expected 4 for PINHOLE .fx, fy, cx, cy.",
            ),
            (CameraOptions(params=(300.0, 160.0, 120.0)), "has params but no model"),
            (CameraOptions(model="SIMPLE_PINHOLE", params=(-3.0, 128.0, 96.0)), "expected f, cx, cy with f above 0"),
            (
                CameraOptions(model="SIMPLE_PINHOLE", params=(1500.0, 800.0, 600.0)),
                "inside the photos of 256 x 192 pixels",
            ),
        ],
    )
    def test_that_cannot_be_is_refused_before_anything_is_written(
        self, room: Room, tmp_path: Path, camera: CameraOptions, message: str
    ) -> None:
        with pytest.raises(InputError, match=message):
            reconstruct(room.folder, room.names, tmp_path / "out", camera=camera, mapper=MAPPER)
        assert not (tmp_path / "out").exists()


def test_sequential_matching_pairs_neighbours_in_time_whatever_their_names(
    room: Room, tmp_path: Path, listener: Listener
) -> None:
    names = tuple(f"left {9 - index}/my photo.png" for index in range(len(room.names)))
    for old, new in zip(room.names, names, strict=True):
        (tmp_path / new).parent.mkdir()
        shutil.copy(room.folder / old, tmp_path / new)
    mapper = MapperOptions(matching="sequential", features=FEATURES, pairing={"overlap": 2, "quadratic_overlap": False})
    summary = reconstruct(tmp_path, names, tmp_path / "out", camera=room.camera, mapper=mapper, progress=listener)
    assert set(centers_by_name(summary.models[0])) == set(names)
    with pycolmap.Database.open(tmp_path / "out" / "database.db") as database:
        place = {image.image_id: names.index(image.name) for image in database.read_all_images()}
        pairs = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in database.read_num_matches()[0]]
    assert Counter(abs(place[a] - place[b]) for a, b in pairs) == {1: 5, 2: 4}
    assert listener.updates["matching"][-1] == (9, 9)


def test_two_rooms_give_two_models_the_larger_first(
    render_room: Callable[..., Room], tmp_path: Path, listener: Listener
) -> None:
    small = render_room(tmp_path, 4, seed=1, prefix="a")
    large = render_room(tmp_path, 5, seed=2, prefix="b")
    mapper = MapperOptions(features=FEATURES, pipeline={"min_model_size": 3})
    names = small.names + large.names
    summary = reconstruct(tmp_path, names, tmp_path / "out", camera=small.camera, mapper=mapper, progress=listener)
    assert [set(centers_by_name(model)) for model in summary.models] == [set(large.names), set(small.names)]
    assert sorted(os.listdir(tmp_path / "out" / "sparse")) == ["0", "1"]
    assert pycolmap.Reconstruction(tmp_path / "out" / "sparse" / "1").num_reg_images() == 4
    assert summary.num_registered == 5
    assert listener.messages == ["2 separate models of 5, 4 photos"]


class TestEarlierRun:
    def test_is_taken_over_whatever_the_number_of_threads(self, room: Room, output: Path, listener: Listener) -> None:
        mapper = MapperOptions(features=FEATURES, num_threads=1, reproducible=True)
        summary = reconstruct(room.folder, room.names, output, camera=room.camera, mapper=mapper, progress=listener)
        assert (summary.num_registered, summary.seconds, listener.stages) == (6, {}, [])
        assert listener.messages == [
            f"{step}: taken over from an earlier run" for step in ("features", "matching", "mapping")
        ]

    @pytest.mark.parametrize(
        ("change", "steps"),
        [
            ({"mapper": MapperOptions(features=FEATURES, pipeline={"extract_colors": False})}, ["mapping"]),
            ({"seed": 1}, ["matching", "mapping"]),
        ],
        ids=["mapper option", "seed"],
    )
    def test_is_taken_over_up_to_the_first_change(
        self, room: Room, output: Path, change: dict[str, Any], steps: list[str]
    ) -> None:
        arguments = {"camera": room.camera, "mapper": MAPPER, **change}
        summary = reconstruct(room.folder, room.names, output, **arguments)
        assert list(summary.seconds) == steps
        assert summary.num_registered == 6

    def test_is_taken_over_while_the_photos_are_the_same_whatever_the_times_of_their_files(
        self, room: Room, output: Path, tmp_path: Path, listener: Listener
    ) -> None:
        copies = tmp_path / "copies"
        shutil.copytree(room.folder, copies, copy_function=shutil.copyfile)
        reconstruct(copies, room.names, output, camera=room.camera, mapper=MAPPER, progress=listener)
        assert listener.stages == []

    def test_is_not_taken_over_when_a_photo_changes_behind_its_size_and_time(
        self, room: Room, tmp_path: Path, listener: Listener
    ) -> None:
        photos, output = tmp_path / "photos", tmp_path / "out"
        photos.mkdir()
        for name in room.names:  # without compression, so that all files have the same size
            with Image.open(room.folder / name) as photo:
                photo.save((photos / name).with_suffix(".bmp"))
        names = [Path(name).with_suffix(".bmp").name for name in room.names]
        reconstruct(photos, names, output, camera=room.camera, mapper=MAPPER)
        before = (photos / names[0]).stat()
        changed = Image.eval(Image.open(photos / names[0]), lambda value: 255 - value)
        changed.save(photos / names[0])
        os.utime(photos / names[0], ns=(before.st_atime_ns, before.st_mtime_ns))
        assert (photos / names[0]).stat().st_size == before.st_size
        reconstruct(photos, names, output, camera=room.camera, mapper=MAPPER, progress=listener)
        assert listener.stages == ["features", "matching", "mapping"]

    def test_killed_while_it_paired_photos_in_time_order_can_be_matched_otherwise(
        self, room: Room, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def die(*_: Any, **__: Any) -> None:
            shutil.copytree(tmp_path / "out", tmp_path / "killed")
            raise KeyboardInterrupt

        with monkeypatch.context() as patched:
            patched.setattr(pycolmap, "SequentialPairGenerator", die)
            mapper = MapperOptions(features=FEATURES, matching="sequential")
            with pytest.raises(KeyboardInterrupt):
                reconstruct(room.folder, room.names, tmp_path / "out", camera=room.camera, mapper=mapper)
        mapper = MapperOptions(features=FEATURES, matching="exhaustive")
        summary = reconstruct(room.folder, room.names, tmp_path / "killed", camera=room.camera, mapper=mapper)
        assert list(summary.seconds) == ["matching", "mapping"]
        assert set(centers_by_name(summary.models[0])) == set(room.names)

    def test_is_left_as_it_was_when_other_photos_do_not_reconstruct(self, room: Room, output: Path) -> None:
        before = {path: path.read_bytes() for path in paths_below(output) if path.is_file()}
        with pytest.raises(ReconstructionError, match="no model from 2 photos"):
            reconstruct(room.folder, [room.names[0], room.names[-1]], output, camera=room.camera, mapper=MAPPER)
        assert {path: path.read_bytes() for path in paths_below(output) if path.is_file()} == before

    def test_is_left_as_it_was_through_a_hard_link(self, room: Room, output: Path, tmp_path: Path) -> None:
        linked = tmp_path / "backup.db"
        os.link(output / "database.db", linked)
        before = linked.read_bytes()
        reconstruct(room.folder, room.names, output, camera=room.camera, mapper=MAPPER, seed=1)
        assert linked.read_bytes() == before
        assert (output / "database.db").read_bytes() != before


class TestOtherPhotos:
    """Reconstruction after an earlier run on partly the same photos takes over what is known of those."""

    @pytest.fixture
    def changed(self, room: Room, tmp_path: Path) -> Room:
        """The room with its third photo changed."""
        folder = shutil.copytree(room.folder, tmp_path / "changed")
        with Image.open(folder / room.names[2]) as photo:
            darker = Image.eval(photo, lambda value: value // 2)
        darker.save(folder / room.names[2])
        return replace(room, folder=folder)

    def test_one_more_is_extracted_alone_and_only_its_pairs_are_matched(
        self, room: Room, done: ReconstructionSummary, tmp_path: Path, listener: Listener
    ) -> None:
        fewer = room.names[:2] + room.names[3:]
        reconstruct(room.folder, fewer, tmp_path, camera=room.camera, mapper=MAPPER)
        summary = reconstruct(room.folder, room.names, tmp_path, camera=room.camera, mapper=MAPPER, progress=listener)
        assert listener.messages == ["features: those of 5 photos are taken over from an earlier run"]
        assert min(listener.updates["features"]) >= (5, 6)
        assert min(listener.updates["matching"]) >= (10, 15)
        assert content_of(tmp_path / "database.db") == content_of(done.log_path.parent / "database.db")
        assert summary.num_registered == 6

    def test_one_changed_gives_what_a_run_on_these_photos_alone_gives(
        self, room: Room, changed: Room, tmp_path: Path
    ) -> None:
        for photos, output in ((room, "out"), (changed, "out"), (changed, "alone")):
            reconstruct(photos.folder, photos.names, tmp_path / output, camera=room.camera, mapper=MAPPER)
        renewed, alone = (content_of(tmp_path / output / "database.db") for output in ("out", "alone"))
        assert renewed == alone

    def test_fewer_or_in_another_order_leave_no_pairs_that_would_not_be_matched(
        self, room: Room, tmp_path: Path, listener: Listener
    ) -> None:
        mapper = MapperOptions(
            matching="sequential", features=FEATURES, pairing={"overlap": 2, "quadratic_overlap": False}
        )
        shorter = (room.names[1], room.names[0], *room.names[3:])
        for names, output in ((room.names, "out"), (shorter, "out"), (shorter, "alone")):
            reconstruct(room.folder, names, tmp_path / output, camera=room.camera, mapper=mapper, progress=listener)
        assert "features: those of 5 photos are taken over from an earlier run" in listener.messages
        renewed, alone = (content_of(tmp_path / output / "database.db") for output in ("out", "alone"))
        assert renewed == alone

    def test_with_another_camera_are_matched_again_and_not_extracted(
        self, room: Room, output: Path, tmp_path: Path, listener: Listener
    ) -> None:
        camera = CameraOptions(model="SIMPLE_PINHOLE", params=(241.0, 128.0, 96.0))
        for folder in (output, tmp_path / "alone"):
            reconstruct(room.folder, room.names, folder, camera=camera, mapper=MAPPER, progress=listener)
        assert listener.messages == ["features: those of 6 photos are taken over from an earlier run"]
        assert listener.updates["features"][0] == (6, 6)
        assert content_of(output / "database.db") == content_of(tmp_path / "alone" / "database.db")

    def test_with_other_options_start_from_nothing(
        self, room: Room, output: Path, tmp_path: Path, listener: Listener
    ) -> None:
        mapper = MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 200}})
        reconstruct(room.folder, room.names[:4], output, camera=room.camera, mapper=mapper, progress=listener)
        assert not listener.messages
        assert listener.stages == ["features", "matching", "mapping"]

    @pytest.mark.parametrize(
        ("name", "change"),
        [
            ("database.db", lambda path: path.write_bytes(path.read_bytes()[:4096] + bytes(4096))),
            ("database.db", lambda path: path.write_bytes(path.read_bytes()[:5000])),
            ("database.db/mine.txt", lambda path: (path.parent.unlink(), path.parent.mkdir(), path.write_text("mine"))),
            ("database.db-wal", lambda path: path.write_bytes(b"of a program that writes to the database")),
        ],
        ids=["overwritten", "cut", "a folder", "open elsewhere"],
    )
    def test_are_refused_where_somebody_changed_the_database(
        self, room: Room, output: Path, name: str, change: Callable[[Path], object]
    ) -> None:
        change(output / name)
        changed = (output / name).read_bytes()
        said = rf"{re.escape(name)}: is not a file that rangesfm wrote, or has changed since"
        with pytest.raises(InputError, match=said):
            reconstruct(room.folder, room.names[:4], output, camera=room.camera, mapper=MAPPER)
        # All photos need no database, because their models are there.
        assert reconstruct(room.folder, room.names, output, camera=room.camera, mapper=MAPPER).num_registered == 6
        assert (output / name).read_bytes() == changed

    def test_are_reconstructed_though_colmap_has_looked_at_the_database(self, room: Room, output: Path) -> None:
        with pycolmap.Database.open(output / "database.db") as database:  # this updates a counter in the file's header
            assert database.num_images() == 6
        summary = reconstruct(room.folder, room.names[:4], output, camera=room.camera, mapper=MAPPER)
        assert summary.num_registered == 4

    def test_start_from_nothing_where_the_unfinished_database_is_damaged(
        self, room: Room, tmp_path: Path, listener: Listener, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def die(*_: Any) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as patched:
            patched.setattr("rangesfm.sfm.photo_matching.PhotoMatching._match", die)
            with pytest.raises(KeyboardInterrupt):
                reconstruct(room.folder, room.names, tmp_path, camera=room.camera, mapper=MAPPER)
        database = unfinished(tmp_path) / "database.db"
        data = database.read_bytes()
        database.write_bytes(data[:4096] + bytes(len(data) - 4096))
        reconstruct(room.folder, room.names[:4], tmp_path, camera=room.camera, mapper=MAPPER, progress=listener)
        assert listener.messages == []
        assert listener.stages == ["features", "matching", "mapping"]

    def test_that_were_given_up_leave_the_reconstruction_of_before_to_be_taken_over(
        self, room: Room, changed: Room, output: Path, monkeypatch: pytest.MonkeyPatch, listener: Listener
    ) -> None:
        def die(*_: Any) -> None:
            raise KeyboardInterrupt

        with monkeypatch.context() as patched:
            patched.setattr("rangesfm.sfm.photo_matching.PhotoMatching._write_note", die)
            with pytest.raises(KeyboardInterrupt):
                reconstruct(changed.folder, room.names, output, camera=room.camera, mapper=MAPPER)
        reconstruct(room.folder, room.names, output, camera=room.camera, mapper=MAPPER, progress=listener)
        assert listener.stages == []
        assert not unfinished(output).exists()


class TestBadPhotos:
    def test_among_good_ones_are_left_out_and_said_so(self, room: Room, tmp_path: Path, listener: Listener) -> None:
        shutil.copytree(room.folder, tmp_path, dirs_exist_ok=True)
        (tmp_path / "broken.png").write_bytes(b"not a photo")
        Image.new("L", (256, 192), 128).save(tmp_path / "blank.png")
        names = ("broken.png", "blank.png", *room.names)
        summary = reconstruct(tmp_path, names, tmp_path / "out", camera=room.camera, mapper=MAPPER, progress=listener)
        assert set(centers_by_name(summary.models[0])) == set(room.names)
        assert listener.messages == [
            "1 of 8 photos are left out; the first, broken.png, cannot be read as an image",
            "1 of 7 photos have fewer than 50 features, the first is blank.png",
        ]

    @pytest.mark.parametrize(
        ("draw", "message"),
        [
            (lambda index: None, "0 of 3 photos can be used, expected at least 2 .*; 0.png cannot be read as an image"),
            (lambda index: Image.new("L", (256, 192), 128), "0 of 3 photos have 50 features or more.*0.png"),
            (lambda index: rug(index), "no two of 3 photos match: .*COLMAP's log: .*mapper.log"),
            (lambda index: rug(0), "no model from 3 photos, of which 3 pairs match: .*sideways"),
        ],
        ids=["unreadable", "blank", "unrelated", "from one place"],
    )
    def test_that_give_no_model_are_told_apart(
        self, tmp_path: Path, draw: Callable[[int], Image.Image | None], message: str
    ) -> None:
        names = [f"{index}.png" for index in range(3)]
        for index, name in enumerate(names):
            photo = draw(index)
            if photo is not None:
                photo.save(tmp_path / name)
        with pytest.raises(ReconstructionError, match=message):
            reconstruct(tmp_path, names, tmp_path / "out", camera=CameraOptions(model="SIMPLE_PINHOLE"), mapper=MAPPER)
        assert not (tmp_path / "out" / "sparse").exists()


def rug(seed: int) -> Image.Image:
    """A photo rich in features, different for each seed."""
    cells = np.random.default_rng(seed).integers(0, 255, (30 + 7 * seed, 41 + 9 * seed), dtype=np.uint8)
    return Image.fromarray(cells).resize((256, 192), Image.Resampling.BICUBIC)
