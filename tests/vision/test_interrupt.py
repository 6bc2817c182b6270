"""Ctrl-C, for real: a process of its own gets the signal."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pycolmap
import pytest

import rangesfm
from rangesfm.options import MapperOptions
from rangesfm.vision.reconstruct import reconstruct

if TYPE_CHECKING:
    from tests.vision.conftest import Listener, Room

MAPPER = MapperOptions(features={"sift": {"max_num_features": 400}})
PROGRAM = """
import sys
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.vision.image_times import list_images
from rangesfm.vision.reconstruct import reconstruct

class Printer:
    def stage(self, name): self.name = name; print(name, 0, flush=True)
    def update(self, num_done, num_total=None): print(self.name, num_done, flush=True)
    def message(self, text): pass

images, output, *params = sys.argv[1:]
mapper = MapperOptions(features={"sift": {"max_num_features": 400}})
camera = CameraOptions("SIMPLE_PINHOLE", tuple(map(float, params)))
try:
    reconstruct(images, list_images(images), output, camera=camera, mapper=mapper, progress=Printer())
except KeyboardInterrupt:
    sys.exit(130)
"""


@pytest.fixture(scope="module")
def many_photos(render_room: Callable[..., Room], tmp_path_factory: pytest.TempPathFactory) -> Room:
    return render_room(tmp_path_factory.mktemp("room"), 12)


def interrupt(room: Room, output: Path, step: str, min_num_done: int) -> float:
    """Start a reconstruction, press Ctrl-C once the step is so far; the seconds until it ended."""
    assert room.camera.params is not None
    arguments = [room.folder, output, *room.camera.params]
    command = [sys.executable, "-c", PROGRAM, *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": str(Path(rangesfm.__path__[0]).parent)}
    with subprocess.Popen(
        command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            name, num_done = line.split()
            if name == step and int(num_done) >= min_num_done:
                break
        process.send_signal(signal.SIGINT)
        start = time.monotonic()
        _, errors = process.communicate(timeout=60)
    assert (process.returncode, errors) == (130, "")
    return time.monotonic() - start


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
    assert interrupt(many_photos, tmp_path, step, min_num_done) < 10
    assert sorted(os.listdir(tmp_path)) == ["database.db", "mapper.log", "reconstruct.json"]
    summary = reconstruct(
        many_photos.folder,
        many_photos.names,
        tmp_path,
        camera=many_photos.camera,
        mapper=MAPPER,
        progress=listener,
    )
    assert listener.stages == steps_left
    assert summary.num_registered == 12
    if step != "mapping":
        assert listener.updates[step][0][0] >= min_num_done  # it did not begin at nothing
    with pycolmap.Database.open(tmp_path / "database.db") as database:
        assert {image.name for image in database.read_all_images()} == set(many_photos.names)
        assert database.num_verified_image_pairs() == 66


def test_an_error_of_the_listener_stops_colmap_and_comes_through(many_photos: Room, tmp_path: Path) -> None:
    class Broken:
        def stage(self, name: str) -> None:
            pass

        def update(self, num_done: int, num_total: int | None = None) -> None:
            raise ZeroDivisionError

        def message(self, text: str) -> None:
            pass

    start = time.monotonic()
    with pytest.raises(ZeroDivisionError):
        reconstruct(
            many_photos.folder,
            many_photos.names,
            tmp_path,
            camera=many_photos.camera,
            mapper=MAPPER,
            progress=Broken(),
        )
    assert time.monotonic() - start < 10
    assert pycolmap.logging.alsologtostderr
