"""Frames of a video, read by the optional package av."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from datetime import datetime, timezone
from functools import partial
from itertools import product
from pathlib import Path
from typing import TYPE_CHECKING

from PIL import Image

from rangesfm.errors import InputError
from rangesfm.installed_versions import missing_extra
from rangesfm.survey.sources.source import Frame, PhotoSource

if TYPE_CHECKING:
    from av import VideoFrame
    from av.container import InputContainer

_QUALITY = 95
_SINCE_2001_S = 978307200  # an earlier creation time (Unix seconds) comes from a clock that was never set
# The first key is written by iPhones, with the time zone; the second is that of the container, in UTC by definition.
_CREATION_KEYS = ("com.apple.quicktime.creationdate", "creation_time")
_CREATION_FORMS = ("%Y-%m-%dT%H:%M:%S%z", "%Y-%m-%dT%H:%M:%S.%f%z")


def open_video(path: Path) -> PhotoSource:
    """Open a video as a source of photos. The photos are turned as players turn the video.

    Raises:
        InputError: it cannot be read, or av is not installed.
    """
    with _reading(path) as video:
        first = next(video.decode(video=0), None)
        if first is None:
            raise InputError("there is no frame in this video", path)
        stream = video.streams.video[0]
        if stream.duration is not None and stream.time_base is not None:
            duration_s = float(stream.duration * stream.time_base)
        else:
            duration_s = (video.duration or 0) * 1e-6
        start_s = _creation_time_s(video)
        size_px, num_frames = _image(first).size, stream.frames
    clock = "seconds from its first frame, because it has no creation time"
    if start_s is not None:
        created = datetime.fromtimestamp(start_s, timezone.utc).isoformat(sep=" ", timespec="seconds")
        clock = (
            f"those of its frames, with the first one at its creation time {created}; that time is in whole seconds, "
            "and with some cameras it is local time, or the end of the video"
        )
    turned = "the photos are turned as players show the video; the lever arm refers to the turned photos"
    return PhotoSource(
        what=f"video, {size_px[0]} x {size_px[1]} pixels, {duration_s:.1f} s",
        size_px=size_px,
        duration_s=duration_s,
        num_frames=num_frames,
        clock=clock,
        frames=partial(_frames, path, start_s or 0.0),
        notes=(turned,) if first.rotation else (),
    )


def _frames(path: Path, start_s: float) -> Iterator[Frame]:
    first_s = None
    with _reading(path) as video:
        video.streams.video[0].thread_type = "AUTO"
        for number, frame in enumerate(video.decode(video=0)):
            pts = frame.dts if frame.pts is None else frame.pts
            if pts is None or frame.time_base is None:
                raise InputError(f"its frame {number} has no time", path)
            time_s = float(pts * frame.time_base)
            first_s = time_s if first_s is None else first_s
            yield Frame(number, start_s + time_s - first_s, ".jpg", partial(_grey, frame), partial(_write, frame))


@contextmanager
def _reading(path: Path) -> Iterator[InputContainer]:
    try:
        import av
    except ImportError:
        raise missing_extra("reading a video needs the package av", "video", path) from None
    try:
        with av.open(path, metadata_errors="replace") as video:
            if not video.streams.video:
                raise InputError("there are no pictures in this video", path)
            yield video
    except av.FFmpegError as error:
        raise InputError(f"cannot be read as a video ({error.strerror})", path) from error


def _creation_time_s(video: InputContainer) -> float | None:
    """Return the creation time of a video, seconds since 1970 in UTC; None where it has none."""
    for key, form in product(_CREATION_KEYS, _CREATION_FORMS):
        with suppress(KeyError, ValueError):
            time_s = datetime.strptime(video.metadata[key], form).timestamp()
            if time_s > _SINCE_2001_S:
                return time_s
    return None


def _grey(frame: VideoFrame) -> Image.Image:
    return Image.fromarray(frame.to_ndarray(format="gray"))


def _image(frame: VideoFrame) -> Image.Image:
    """Return a frame turned as players show it, counterclockwise by a multiple of 90 degrees."""
    image = Image.fromarray(frame.to_ndarray(format="rgb24"))
    return image.rotate(90 * round(frame.rotation / 90), expand=True)


def _write(frame: VideoFrame, path: Path) -> None:
    _image(frame).save(path, quality=_QUALITY, subsampling=0)
