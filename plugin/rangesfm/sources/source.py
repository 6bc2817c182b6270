"""What photos are taken out of: something that shows frames, one after the other."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rangesfm.files.bags import is_bag

if TYPE_CHECKING:
    from PIL.Image import Image

VIDEO_EXTENSIONS = (".mp4", ".mov", ".avi", ".mkv", ".m4v", ".webm", ".mts")
MAX_SIDE_PX = 1000  # of a picture reduced to see how sharp it is: finer blur than of its pixels does no harm


@dataclass(frozen=True)
class Frame:
    """A picture that may become a photo; it is decoded when asked for.

    Attributes:
        number: which one it is in its source, from 0.
        time_s: when it was taken.
        suffix: of the file that ``write`` writes.
        grey: as 8-bit grey values, perhaps reduced.
        write: as a photo to a new file.
    """

    number: int
    time_s: float
    suffix: str
    grey: Callable[[], Image]
    write: Callable[[Path], None]

    def sharpness(self) -> float:
        """Energy of the gradient, which blur lowers: mean square of the differences between neighbouring pixels."""
        import numpy as np

        grey = self.grey()
        values = np.asarray(grey.reduce(max(1, max(grey.size) // MAX_SIDE_PX)), dtype=np.float32)
        return sum(float(np.mean(np.diff(values, axis=axis) ** 2)) for axis in (0, 1))


@dataclass(frozen=True)
class Source:
    """A video, or the images of a bag.

    Attributes:
        what: it is, for people.
        size_px: width and height of its photos.
        duration_s: about.
        num_frames: that it says it has; 0 where it does not say.
        clock: what its times are, for people.
        camera: COLMAP's model and parameters, where it says them.
        frames: all of them, in their order.
        notes: what else the user should know, a line each.
    """

    what: str
    size_px: tuple[int, int]
    duration_s: float
    num_frames: int
    clock: str
    frames: Callable[[], Iterator[Frame]]
    camera: tuple[str, tuple[float, ...]] | None = None
    notes: tuple[str, ...] = ()

    def num_photos(self, rate_hz: float) -> int:
        """About how many photos there will be, one in each interval of ``1 / rate_hz`` seconds."""
        num = math.ceil(self.duration_s * rate_hz)
        return min(num, self.num_frames) if self.num_frames else num


def is_video(path: Path) -> bool:
    return path.suffix.lower() in VIDEO_EXTENSIONS


def is_source(path: Path) -> bool:
    """Whether photos can be taken out of it, by its name; a folder of photos is none."""
    return is_video(path) or is_bag(path)


def open_source(path: Path, topic: str | None) -> Source:
    """What is known of it before its pictures are looked at.

    ``topic`` is of the images in a bag; None: it has one such. InputError if nothing tells which are meant, or the
    source cannot be read.
    """
    from rangesfm.sources.bag import open_images
    from rangesfm.sources.video import open_video

    return open_video(path) if is_video(path) else open_images(path, topic)
