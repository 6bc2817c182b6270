"""Interruption by Ctrl-C: a real process gets the signal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pycolmap
import pytest
from tests.outputs import names_in, unfinished

import rangesfm
from rangesfm.mapper_options import MapperOptions
from rangesfm.progress import Progress
from rangesfm.sfm.database import num_photos_with_features
from rangesfm.sfm.reconstruct import reconstruct

if TYPE_CHECKING:
    from tests.listener import Listener
    from tests.sfm.conftest import Room

MAPPER = MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 400}})
NUM_PHOTOS = 12
ALL = {"features": NUM_PHOTOS, "matching": NUM_PHOTOS * (NUM_PHOTOS - 1) // 2}
PROGRAM = """
import sys
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.sfm.image_times import list_images
from rangesfm.sfm.reconstruct import reconstruct

class Printer:
    def stage(self, name): self.name = name; print(name, 0, flush=True)
    def update(self, num_done, num_total=None): print(self.name, num_done, flush=True)
    def message(self, text): pass

images, output, *params = sys.argv[1:]
mapper = MapperOptions(features={"sift": {"first_octave": 0, "max_num_features": 400}})
camera = CameraOptions(model="SIMPLE_PINHOLE", params=tuple(map(float, params)))
try:
    reconstruct(images, list_images(images), output, camera=camera, mapper=mapper, progress=Printer())
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.fixture(scope="module")
def many_photos(render_room: Callable[..., Room], tmp_path_factory: pytest.TempPathFactory) -> Room:
    return render_room(tmp_path_factory.mktemp("room"), NUM_PHOTOS)


def interrupt(room: Room, output: Path, step: str, min_num_done: int) -> None:
    """Start a reconstruction, and send Ctrl-C once the step has done so much."""
    assert room.camera.params
    arguments = [room.folder, output, *room.camera.params]
    command = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(Path(rangesfm.__path__[0]).parent)}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            name, num = line.split()
            if name == step and int(num) >= min_num_done:
                break
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate()
    assert (process.returncode, errors) == (130, "")


def num_done(output: Path) -> dict[str, int]:
    """Count the photos with features, and the pairs of photos with matches."""
    folder = unfinished(output) if unfinished(output).exists() else output
    with pycolmap.Database.open(folder / "database.db") as database:
        return {"features": num_photos_with_features(database), "matching": database.num_verified_image_pairs()}


@pytest.mark.parametrize(
    ("step", "min_num_done", "steps_left"),
    [
        ("features", 2, ["features", "matching", "mapping"]),
        ("matching", 10, ["matching", "mapping"]),
        ("mapping", 0, ["mapping"]),
    ],
)
def test_ends_soon_leaves_nothing_half_done_and_the_next_run_goes_on(
    many_photos: Room, tmp_path: Path, listener: Listener, step: str, min_num_done: int, steps_left: list[str]
) -> None:
    interrupt(many_photos, tmp_path, step, min_num_done)
    assert names_in(tmp_path) == []
    left = set(os.listdir(unfinished(tmp_path))) - {"mapping_snapshot"}  # it exists unless Ctrl-C came too soon
    assert left == {"database.db", "mapper.log", "reconstruct.json"}
    # Ctrl-C may come when the last of the few pairs has just been matched; then this step may be left or done.
    came_late = step in ALL and num_done(tmp_path)[step] == ALL[step]
    if step in ALL:
        assert min_num_done <= num_done(tmp_path)[step] <= ALL[step]
    summary = reconstruct(
        many_photos.folder,
        many_photos.names,
        tmp_path,
        camera=many_photos.camera,
        mapper=MAPPER,
        progress=listener,
    )
    assert listener.stages == steps_left or (came_late and listener.stages == steps_left[1:])
    assert summary.num_registered == NUM_PHOTOS
    if step != "mapping" and not came_late:
        assert listener.updates[step][0][0] >= min_num_done  # it continued where it was interrupted
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        assert {image.name for image in database.read_all_images()} == set(many_photos.names)
    assert num_done(tmp_path) == ALL


def test_an_error_of_the_listener_stops_colmap_and_comes_through(many_photos: Room, tmp_path: Path) -> None:
    class Broken(Progress):
        def update(self, num_done: int, num_total: int = 0) -> None:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        reconstruct(
            many_photos.folder,
            many_photos.names,
            tmp_path,
            camera=many_photos.camera,
            mapper=MAPPER,
            progress=Broken(),
        )
    # A slow listener may hear of the features when the last of them is done; the next step has not begun then.
    assert num_done(tmp_path)["matching"] == 0
    assert pycolmap.logging.alsologtostderr
