"""Photos out of a video or a bag: the sharpest of each interval, kept in a folder until the source changes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import groupby
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.files.atomic import new_folder
from rangesfm.files.contents import state_and_sha256
from rangesfm.files.records import Record
from rangesfm.files.tables import write_table
from rangesfm.progress import Progress
from rangesfm.sources.source import Frame, Source, open_source

TIMES_NAME = "images.csv"
RECORD_NAME = "photos.json"
"""Of a folder of such photos: what they were taken from."""
_MIN_NUM_PHOTOS = 2
_ROUNDING = 1e-6  # of an interval
_Files = dict[str, tuple[tuple[int, int, int], str]]


class TakenPhotos(Record):
    """What the photos in a folder were taken from.

    Attributes:
        files: state and SHA-256 of the source's files by name.
        rate_hz, topic: how the photos were chosen.
        image_names: of the photos, in the order of time.
        camera: COLMAP's model and parameters, where the source says them.
        notes: what the user should know, a line each.
    """

    files: _Files
    rate_hz: float
    topic: str | None
    image_names: tuple[str, ...] = ()
    camera: tuple[str, tuple[float, ...]] | None = None
    notes: tuple[str, ...] = ()

    @property
    def choice(self) -> tuple[object, ...]:
        """What is the same where the photos are, whatever the source's state."""
        return {name: sha256 for name, (_, sha256) in self.files.items()}, self.rate_hz, self.topic

    def are_in(self, folder: Path) -> bool:
        """Whether nobody took one of them away."""
        return all((folder / name).is_file() for name in (TIMES_NAME, *self.image_names))


def take_photos(
    path: Path, folder: Path, *, rate_hz: float, topic: str | None, progress: Progress, restart: bool = False
) -> TakenPhotos:
    """Write the sharpest frame of each ``1 / rate_hz`` seconds as a photo, and ``images.csv`` with their times.

    Args:
        path: a video or a bag.
        folder: is made, or changes when all is done; left as it is where it holds these photos already.
        topic: of the images in a bag that has several such.
        restart: whether to take them anew even so.

    Raises:
        InputError: the source cannot be read, or has fewer than two photos.
    """
    earlier = None if restart else earlier_photos(path, folder, rate_hz=rate_hz, topic=topic)
    if earlier is not None:
        progress.message("photos: taken over from an earlier run")
        return earlier
    wanted = TakenPhotos(files=_files(path, None), rate_hz=rate_hz, topic=topic)
    progress.stage("photos")
    source = open_source(path, topic)
    with new_folder(folder) as new:
        times_s, num_bytes = _write(source, new, rate_hz, progress)
        if len(times_s) < _MIN_NUM_PHOTOS:
            raise InputError(f"fewer than {_MIN_NUM_PHOTOS} photos at {rate_hz:g} Hz ([images] rate_hz)", path)
        what = f"the photos are the sharpest of each {1 / rate_hz:.3g} s of {path.name}; their times are {source.clock}"
        found = {"image_names": tuple(times_s), "camera": source.camera, "notes": (what, *source.notes)}
        taken = wanted.model_copy(update=found)
        taken.write(new / RECORD_NAME)
    progress.message(f"photos: {len(times_s)} in {folder} ({num_bytes / 1e6:.3g} MB)")
    return taken


def earlier_photos(path: Path, folder: Path, *, rate_hz: float, topic: str | None) -> TakenPhotos | None:
    """Return what an earlier run took from the same source in the same way, if all of it is in ``folder``."""
    try:
        earlier = TakenPhotos.read(folder / RECORD_NAME)
    except InputError:
        return None
    wanted = TakenPhotos(files=_files(path, earlier), rate_hz=rate_hz, topic=topic)
    return earlier if wanted.choice == earlier.choice and earlier.are_in(folder) else None


def sharpest(frames: Iterable[Frame], rate_hz: float) -> Iterator[Frame]:
    """The sharpest frame of each interval of ``1 / rate_hz`` seconds, counted from the first frame, that has any.

    Frames that are not later than all before them are left out.
    """
    for _, group in groupby(_with_intervals(frames, rate_hz), key=lambda item: item[0]):
        yield max((frame for _, frame in group), key=Frame.sharpness)


def _with_intervals(frames: Iterable[Frame], rate_hz: float) -> Iterator[tuple[int, Frame]]:
    first_s, last_s = math.nan, -math.inf
    for frame in frames:
        if frame.time_s > last_s:
            first_s = frame.time_s if math.isnan(first_s) else first_s
            last_s = frame.time_s
            yield math.floor((last_s - first_s) * rate_hz + _ROUNDING), frame


def _write(source: Source, folder: Path, rate_hz: float, progress: Progress) -> tuple[dict[str, float], int]:
    """Photos and their table; returns the photos' times by name, and how many bytes they take."""
    times_s: dict[str, float] = {}
    num_expected, num_bytes = source.num_photos(rate_hz), 0
    for frame in sharpest(source.frames(), rate_hz):
        name = f"frame_{frame.number:06d}{frame.suffix}"
        frame.write(folder / name)
        times_s[name] = frame.time_s
        num_bytes += (folder / name).stat().st_size
        progress.update(len(times_s), max(num_expected, len(times_s)))
    rows = [(name, f"{time_s:.6f}") for name, time_s in times_s.items()]
    write_table(folder / TIMES_NAME, ("image_name", "timestamp_s"), rows)
    return times_s, num_bytes


def _files(path: Path, earlier: TakenPhotos | None) -> _Files:
    """State and SHA-256 by name of a file, or of those in a folder."""
    files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    known = {} if earlier is None else earlier.files
    return {file.name: state_and_sha256(file, known.get(file.name)) for file in files}
