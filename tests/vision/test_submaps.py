"""A survey mapped in overlapping stretches: what they share makes one model of them, and what is done stays done."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import loop_path
from tests.simulated_database import camera_options, matched_photos, write_database

from rangesfm.errors import InputError, ReconstructionError
from rangesfm.files.atomic import LOCK_NAME
from rangesfm.geometry.similarity import align_points, rmse
from rangesfm.options import MapperOptions
from rangesfm.progress import SilentProgress
from rangesfm.vision.mapping import pipeline_options
from rangesfm.vision.matched_photos import MatchedPhotos
from rangesfm.vision.reconstruct import reconstruct
from rangesfm.vision.submap_joining import join_submaps
from rangesfm.vision.submap_processes import map_submaps
from rangesfm.vision.submap_refinement import refine_joined
from rangesfm.vision.submaps import Submap, check_submap_options, plan_submaps, submap_places

if TYPE_CHECKING:
    from tests.vision.conftest import Listener, Room

NUM_PHOTOS = 24
MAPPER = MapperOptions(
    pipeline={"extract_colors": False}, num_threads=1, submap_size=10, submap_overlap=5, num_submaps_at_once=2
)


class Walk:
    """A simulated survey with matches in ``folder``, and its truth."""

    def __init__(self, folder: Path, truth: SyntheticModel):
        self.folder = folder
        self.database = folder / "database.db"
        self.truth = truth
        self.matched = matched_photos(self.database)

    def plan(self, matched: MatchedPhotos | None = None, mapper: MapperOptions = MAPPER) -> tuple[Submap, ...]:
        camera = camera_options(self.database)
        return plan_submaps(matched or self.matched, self.database, self.folder / "submaps", camera, mapper, seed=0)

    def rmse_m(self, model: pycolmap.Reconstruction) -> float:
        """Of the centres, after the best similarity."""
        found = np.array([model.image(image_id).projection_center() for image_id in sorted(model.reg_image_ids())])
        truth = self.truth.centers_m[np.array(sorted(model.reg_image_ids())) - 1]
        return rmse(align_points(found, truth).apply(found) - truth)


@pytest.fixture(scope="module")
def mapped_walk(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    """All of its submaps are mapped. Not to be written to."""
    path = loop_path(NUM_PHOTOS + 2.0, start_s=-1.0, semi_axes_m=(6.0, 4.5), seed=3)
    times = np.arange(NUM_PHOTOS, dtype=np.float64)
    truth = synthetic_model(
        times,
        path.centers(times),
        path.world_from_cam(times),
        num_observations=80,
        pixel_stddev=0.5,
        seed=1,
    )
    folder = tmp_path_factory.mktemp("walk")
    write_database(folder / "database.db", truth.reconstruction)
    walk = Walk(folder, truth)
    for submap in walk.plan():
        submap.map(SilentProgress())
    return walk


@pytest.fixture
def walk(mapped_walk: Walk, tmp_path: Path) -> Walk:
    """A copy that may be spoilt."""
    return Walk(shutil.copytree(mapped_walk.folder, tmp_path / "walk"), mapped_walk.truth)


def parts_of(submaps: Sequence[Submap]) -> list[pycolmap.Reconstruction]:
    return [model for submap in submaps for model in submap.models()]


@pytest.mark.parametrize(
    ("num_photos", "expected"),
    [
        (10, [(0, 10)]),
        (11, [(0, 10), (1, 11)]),
        (15, [(0, 10), (5, 15)]),
        (24, [(0, 10), (5, 15), (10, 20), (14, 24)]),
        (7, [(0, 7)]),
    ],
)
def test_stretches_cover_all_photos_and_none_is_shorter(num_photos: int, expected: list[tuple[int, int]]) -> None:
    assert [(places.start, places.stop) for places in submap_places(num_photos, 10, 5)] == expected


def test_a_submap_stands_alone_and_keeps_the_ids_of_the_whole(mapped_walk: Walk) -> None:
    submaps = mapped_walk.plan()
    assert [submap.is_mapped for submap in submaps] == [True] * 4
    (model,) = submaps[1].models()
    assert {model.image(i).name for i in model.reg_image_ids()} == set(submaps[1].photos.names)
    assert sorted(model.reg_image_ids()) == list(range(6, 16))
    assert mapped_walk.rmse_m(model) < 0.05
    left = sorted(path.name for path in submaps[1].folder.iterdir())
    assert left == ["mapper.log", "sparse", "submap.json"]


def test_joined_they_are_one_model_with_tracks_over_all_borders(mapped_walk: Walk) -> None:
    parts = parts_of(mapped_walk.plan())
    (joined,) = join_submaps(parts, seed=0)
    assert joined.num_reg_images() == NUM_PHOTOS
    before_m = mapped_walk.rmse_m(joined)
    options = pipeline_options(camera_options(mapped_walk.database), MAPPER, seed=0)
    refine_joined(mapped_walk.database, mapped_walk.folder, [joined], options, SilentProgress())
    assert mapped_walk.rmse_m(joined) < min(before_m, 0.05)
    tracks = [{element.image_id for element in point.track.elements} for point in joined.points3D.values()]
    assert any(min(track) <= 5 and max(track) >= 11 for track in tracks)  # photos that no submap has together
    features = [(e.image_id, e.point2D_idx) for point in joined.points3D.values() for e in point.track.elements]
    assert len(features) == len(set(features))
    truth = mapped_walk.truth.reconstruction
    assert len(features) > 0.9 * sum(point.track.length() for point in truth.points3D.values())


def test_without_common_photos_they_stay_apart(mapped_walk: Walk) -> None:
    parts = parts_of(mapped_walk.plan())
    models = join_submaps([parts[3], parts[0], parts[1]], seed=0)
    assert [sorted(model.reg_image_ids()) for model in models] == [list(range(15, 25)), list(range(1, 16))]


def test_a_part_that_comes_late_brings_two_groups_together(mapped_walk: Walk) -> None:
    parts = parts_of(mapped_walk.plan())
    (joined,) = join_submaps([parts[0], parts[3], parts[2], parts[1]], seed=0)
    assert sorted(joined.reg_image_ids()) == list(range(1, NUM_PHOTOS + 1))
    assert mapped_walk.rmse_m(joined) < 0.2


def test_a_part_in_another_place_than_its_photos_is_not_laid_on(mapped_walk: Walk) -> None:
    parts = parts_of(mapped_walk.plan())[:2]
    rng = np.random.default_rng(0)
    for frame in parts[1].frames.values():
        frame.rig_from_world.translation += rng.normal(size=3)
    assert len(join_submaps(parts, seed=0)) == 2


def test_only_submaps_with_another_photo_are_to_be_mapped_again(walk: Walk) -> None:
    name = walk.matched.photos.names[3]
    changed = replace(walk.matched, contents={**walk.matched.contents, name: "another"})
    killed = walk.folder / "submaps" / "000000" / "database.db-wal"
    killed.write_bytes(b"of a process that was killed")
    assert [submap.is_mapped for submap in walk.plan(changed)] == [False, True, True, True]
    assert [submap.database.exists() for submap in walk.plan(changed)] == [True, False, False, False]
    assert not killed.exists()
    # The matches of a pair may depend on all photos, where their looks decide.
    assert not any(submap.is_mapped for submap in walk.plan(replace(walk.matched, only_by_place=False)))


def test_only_submaps_with_the_same_photos_under_the_same_ids_are_taken_over(walk: Walk) -> None:
    photos = walk.matched.photos
    shorter = replace(walk.matched, photos=replace(photos, names=photos.names[:18]))
    assert [submap.is_mapped for submap in walk.plan(shorter)] == [True, True, False]
    assert sorted(path.name for path in (walk.folder / "submaps").iterdir()) == ["000000", "000001", "000002"]
    later = replace(walk.matched, photos=replace(photos, names=photos.names[1:]))
    assert not any(submap.is_mapped for submap in walk.plan(later))
    assert not any(submap.is_mapped for submap in walk.plan(mapper=MAPPER.changed(pipeline={"min_num_matches": 9})))


def test_a_stretch_where_nothing_is_seen_has_no_model_and_is_done(walk: Walk, tmp_path: Path) -> None:
    submap = replace(walk.plan()[0], folder=tmp_path / "blank", inputs="none")
    submap.folder.mkdir()
    with pycolmap.Database.open(walk.database) as database:
        database.clear_two_view_geometries()
    walk.plan(mapper=MAPPER.changed(pipeline={}))
    shutil.copy(walk.folder / "submaps" / "000000" / "database.db", submap.database)
    submap.map(SilentProgress())
    assert (submap.is_mapped, submap.models()) == (True, ())


def test_a_process_that_fails_is_named_with_what_it_said(walk: Walk) -> None:
    submaps = walk.plan(mapper=MAPPER.changed(pipeline={"min_num_matches": 16}))
    submaps[1].database.write_bytes(b"no database")
    with pytest.raises(ReconstructionError, match="submap 000001: COLMAP stopped: "):
        map_submaps(submaps[1:2], 1, SilentProgress())


def test_whoever_stops_listening_stops_the_processes(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    # At once: so small a submap is mapped before one would otherwise hear of it.
    monkeypatch.setattr("rangesfm.vision.submap_processes._POLL_INTERVAL_S", 0.0)
    monkeypatch.setattr("rangesfm.processes.supervision._POLL_INTERVAL_S", 0.01)

    class Deaf(SilentProgress):
        def update(self, num_done: int, num_total: int | None = None) -> None:
            raise KeyboardInterrupt

    submap = walk.plan(mapper=MAPPER.changed(pipeline={"min_num_matches": 17}))[0]
    with pytest.raises(KeyboardInterrupt):
        map_submaps([submap], 1, Deaf())
    assert not submap.is_mapped
    assert not (submap.folder / LOCK_NAME).exists()


def test_photos_are_mapped_by_processes_joined_and_taken_over(room: Room, tmp_path: Path, listener: Listener) -> None:
    few = {"features": {"sift": {"max_num_features": 250}}, "submap_size": 5, "submap_overlap": 4}
    mapper = MAPPER.model_copy(update=few)  # smaller than they may be, for few photos
    made = reconstruct(room.folder, room.names, tmp_path, camera=room.camera, mapper=mapper, progress=listener)
    assert (len(made.models), made.num_registered) == (1, 6)
    assert listener.messages == ["mapping: 2 submaps of 5 photos"]
    assert listener.updates["mapping"][-1] == (6, 6)
    centers = {image.name: image.projection_center() for image in made.models[0].images.values()}
    found = np.array([centers[name] for name in room.names])
    errors = align_points(found, room.centers).apply(found) - room.centers
    assert rmse(errors) < 0.01 * float(np.linalg.norm(np.ptp(room.centers, axis=0)))
    listener.messages.clear()
    shutil.rmtree(tmp_path / "sparse")
    reconstruct(room.folder, room.names, tmp_path, camera=room.camera, mapper=mapper, progress=listener)
    assert listener.messages == [
        "features: taken over from an earlier run",
        "matching: taken over from an earlier run",
        "mapping: 2 submaps of 5 photos",
        "mapping: 2 of 2 submaps are taken over from an earlier run",
    ]
    listener.messages.clear()
    reconstruct(room.folder, room.names, tmp_path, camera=room.camera, mapper=mapper, progress=listener)
    assert listener.messages[-1] == "mapping: taken over from an earlier run"


@pytest.mark.parametrize(
    ("mapper", "said"),
    [
        (MAPPER.changed(submap_overlap=10), "submap_overlap is 10, expected 3 to 9 of a submap_size of 10"),
        (MAPPER.changed(pipeline={"init_image_id1": 3}), "init_image_id1 is of one mapping, expected none beside"),
        (MAPPER.changed(ranges_in_mapping=True), "ranges_in_mapping is of one mapping, expected none beside"),
    ],
)
def test_options_that_fit_no_submap_are_refused(mapper: MapperOptions, said: str) -> None:
    with pytest.raises(InputError, match=said):
        check_submap_options(mapper)
    check_submap_options(mapper.changed(submap_size=None))
