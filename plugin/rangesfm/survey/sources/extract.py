"""Extraction of photos from a video or a bag: the sharpest of each interval, kept until the source changes."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from itertools import groupby
from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.options import CameraOptions
from rangesfm.progress import Progress
from rangesfm.sfm.photo_files import MIN_NUM_PHOTOS
from rangesfm.survey.sources.source import Frame, PhotoSource, open_source
from rangesfm.util.files.atomic import new_folder
from rangesfm.util.files.contents import state_and_sha256
from rangesfm.util.files.records import Record
from rangesfm.util.files.text_tables import write_table

TIMES_NAME = "images.csv"
RECORD_NAME = "photos.json"
"""File in a folder of extracted photos that records their source."""
_ROUNDING = 1e-6  # tolerance, as a fraction of an interval, for times that are rounded down below its start
_Files = dict[str, tuple[tuple[int, int, int], str]]


class TakenPhotos(Record):
    """Record of the source from which the photos in a folder were extracted.

    Attributes:
        files: state (see ``state_and_sha256``) and SHA-256 of each file of the source by name.
        rate_hz, topic: the user's choice of photos.
        image_names: names of the photos in order of time.
        camera: if the source says it.
    """

    files: _Files
    rate_hz: float
    topic: str
    image_names: tuple[str, ...] = ()
    camera: CameraOptions = CameraOptions()
    notes: tuple[str, ...] = ()

    @property
    def choice(self) -> tuple[object, ...]:
        """Return what determines the photos: hashes of the source, rate and topic. Equal choices give equal photos."""
        return {name: sha256 for name, (_, sha256) in self.files.items()}, self.rate_hz, self.topic

    def are_in(self, folder: Path) -> bool:
        """Return whether all photos and the table of their times are still in a folder."""
        return all((folder / name).is_file() for name in (TIMES_NAME, *self.image_names))


def take_photos(
    path: Path, places: Sequence[Path], *, rate_hz: float, topic: str, progress: Progress, restart: bool = False
) -> tuple[Path, TakenPhotos]:
    """Write the sharpest frame of each ``1 / rate_hz`` seconds as a photo, and ``images.csv`` with their times.

    Args:
        places: folders that may have these photos already, of which one is then used as it is. Otherwise the first one
            is made or replaced when all is done.
        topic: of the images in a bag; empty: the bag has only one image topic.

    Returns:
        The folder of the photos, and their record.

    Raises:
        InputError: the source cannot be read, or has fewer than two photos.
    """
    for place in () if restart else places:
        if (earlier := _earlier_photos(path, place, rate_hz=rate_hz, topic=topic)) is not None:
            progress.message("photos: taken over from an earlier run")
            return place, earlier
    folder = places[0]
    wanted = TakenPhotos(files=_files(path, {}), rate_hz=rate_hz, topic=topic)
    progress.stage("photos")
    source = open_source(path, topic)
    with new_folder(folder) as new:
        times_s, num_bytes = _write(source, new, rate_hz, progress)
        if len(times_s) < MIN_NUM_PHOTOS:
            raise InputError(f"fewer than {MIN_NUM_PHOTOS} photos at {rate_hz:g} Hz ([images] rate_hz)", path)
        what = f"the photos are the sharpest of each {1 / rate_hz:.3g} s of {path.name}; their times are {source.clock}"
        found = {"image_names": tuple(times_s), "camera": source.camera, "notes": (what, *source.notes)}
        taken = wanted.model_copy(update=found)
        taken.write(new / RECORD_NAME)
    progress.message(f"photos: {len(times_s)} in {folder} ({num_bytes / 1e6:.3g} MB)")
    return folder, taken


def _earlier_photos(path: Path, folder: Path, *, rate_hz: float, topic: str) -> TakenPhotos | None:
    """Return the record of photos that an earlier run extracted from the same source with the same choice.

    None where there are none, or where some are missing from ``folder``.
    """
    try:
        earlier = TakenPhotos.read(folder / RECORD_NAME)
    except InputError:
        return None
    wanted = TakenPhotos(files=_files(path, earlier.files), rate_hz=rate_hz, topic=topic)
    return earlier if wanted.choice == earlier.choice and earlier.are_in(folder) else None


def sharpest(frames: Iterable[Frame], rate_hz: float) -> Iterator[Frame]:
    """Yield the sharpest frame of each interval of ``1 / rate_hz`` seconds that has frames, from the first frame on.

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


def _write(source: PhotoSource, folder: Path, rate_hz: float, progress: Progress) -> tuple[dict[str, float], int]:
    """Write the photos and the table of their times; return times (seconds) by name, and the bytes of all photos."""
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


def _files(path: Path, known: _Files) -> _Files:
    """Return state and SHA-256 by name of a file, or of all files in a folder; those known of unchanged files."""
    files = sorted(file for file in path.iterdir() if file.is_file()) if path.is_dir() else [path]
    return {file.name: state_and_sha256(file, known.get(file.name)) for file in files}
