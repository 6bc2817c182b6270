"""Sources of photos: videos and bags, which yield one frame after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.options import CameraOptions
from rangesfm.util.files.bags import is_bag

if TYPE_CHECKING:
    from PIL.Image import Image

VIDEO_EXTENSIONS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts")
# Largest side of the reduced picture by which sharpness is measured. Blur below its pixels does no harm.
MAX_SIDE_PX = 1000


@dataclass(frozen=True)
class Frame:
    """A frame that may become a photo. It is decoded only on demand.

    Attributes:
        number: of the frame in its source, from 0.
        time_s: time at which it was taken, seconds on the clock of the source.
        grey: function that returns the picture in 8-bit grey, perhaps reduced in size.
    """

    number: int
    time_s: float
    suffix: str
    grey: Callable[[], Image]
    write: Callable[[Path], object]

    def sharpness(self) -> float:
        """Return the mean square difference between neighbouring pixels. Blur makes it smaller."""
        import numpy as np

        grey = self.grey()
        values = np.asarray(grey.reduce(max(1, max(grey.size) // MAX_SIDE_PX)), dtype=np.float32)
        return sum(float(np.mean(np.diff(values, axis=axis) ** 2)) for axis in (0, 1))


@dataclass(frozen=True)
class PhotoSource:
    """A video, or the images of a bag.

    Attributes:
        what: description for the user.
        duration_s: approximate duration.
        num_frames: number of frames by the header of the file; 0 where it does not say.
        clock: description of the times, for the user.
        frames: function that yields all frames in their order.
        camera: if the source says it.
    """

    what: str
    size_px: tuple[int, int]
    duration_s: float
    num_frames: int
    clock: str
    frames: Callable[[], Iterator[Frame]]
    camera: CameraOptions = CameraOptions()
    notes: tuple[str, ...] = ()

    def num_photos(self, rate_hz: float) -> int:
        """Return about how many photos there will be, with one in each interval of ``1 / rate_hz`` seconds."""
        num = math.ceil(self.duration_s * rate_hz)
        return min(num, self.num_frames) if self.num_frames else num


def is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_EXTENSIONS


def is_source(path: Path) -> bool:
    """Return whether a path is a video or a bag, by its name. A folder of photos is not a source."""
    return is_video(path) or is_bag(path)


def open_source(path: Path, topic: str) -> PhotoSource:
    """Open a video or a bag and read all that is known before its frames are decoded.

    Args:
        topic: of the images in a bag; empty: the bag has only one image topic.

    Raises:
        InputError: the source cannot be read, or has several image topics and none is chosen.
    """
    from rangesfm.survey.sources.bag import open_images
    from rangesfm.survey.sources.video import open_video

    return open_video(path) if is_video(path) else open_images(path, topic)
