"""Photo files: which of them can be read, their EXIF data, and their masks."""

from __future__ import annotations

import math
import threading
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from PIL import Image

from rangesfm.errors import InputError, ReconstructionError
from rangesfm.util.files.contents import open_regular, sha256_of, stand_in, state_and_sha256

MIN_NUM_PHOTOS = 2
MAX_PIXELS = 1_000_000_000
"""Largest number of pixels of a photo; COLMAP needs three bytes for each, and a small file may claim any number."""
UNREADABLE = (OSError, ValueError, SyntaxError, Image.DecompressionBombError)
"""Errors that Pillow's readers raise."""
_pillow_limit = threading.Lock()
_HEAD_BYTES = 1 << 10
_EXIF_IFD, _GPS_IFD = 0x8769, 0x8825
_LATITUDE, _LONGITUDE, _ALTITUDE = 2, 4, 6
_LATITUDE_REF, _LONGITUDE_REF, _ALTITUDE_REF = 1, 3, 5


@dataclass(frozen=True)
class Photos:
    """Photos of one folder, of any sizes.

    Attributes:
        names: n names, relative to the folder, in the order given.
        sizes: n pairs of width and height in pixels, as stored; EXIF orientation is ignored, as in COLMAP.
        left_out: for each photo that cannot be used, by name, the reason.
    """

    folder: Path
    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    left_out: dict[str, str]

    def subset(self, names: Collection[str]) -> Photos:
        """Return the photos with these names."""
        wanted = set(names)
        kept = [(name, size) for name, size in zip(self.names, self.sizes, strict=True) if name in wanted]
        return replace(self, names=tuple(name for name, _ in kept), sizes=tuple(size for _, size in kept))

    def contents(self, known: Mapping[str, Any]) -> dict[str, tuple[tuple[int, int, int], str]]:
        """Return the state and SHA-256 of each file, by name in the order given.

        Args:
            known: the result of an earlier call, which may have been stored as JSON. A file is not read again
                while its size and its times of change are the same.
        """
        return {name: state_and_sha256(self.folder / name, known.get(name)) for name in self.names}


@contextmanager
def opened_image(path: Path) -> Iterator[Image.Image]:
    """Open an image of up to MAX_PIXELS pixels, although Pillow refuses images above 179 megapixels.

    No pixel is read yet.

    Raises:
        One of UNREADABLE: it is not an image or not a regular file (reading some others never ends), or is too large.
    """
    if not path.is_file():
        raise FileNotFoundError("there is no such file")
    with _pillow_limit:
        usual_limit, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
        try:
            image = Image.open(path)
        finally:
            Image.MAX_IMAGE_PIXELS = usual_limit
    with image:
        num_pixels = image.width * image.height
        if num_pixels > MAX_PIXELS:
            found, most = num_pixels / 1e6, MAX_PIXELS / 1e6
            raise Image.DecompressionBombError(f"has {found:.0f} megapixels, expected at most {most:.0f}")
        yield image


def usable_photos(folder: Path, names: Sequence[str]) -> Photos:
    """Return the photos that can be read.

    Raises:
        ReconstructionError: fewer than two photos can be read.
    """
    usable, left_out = dict[str, tuple[int, int]](), dict[str, str]()
    for name in names:
        try:
            with opened_image(folder / name) as image:
                usable[name] = image.size
        except UNREADABLE as error:
            is_too_large = isinstance(error, Image.DecompressionBombError)
            left_out[name] = str(error) if is_too_large else _why_unreadable(folder / name)
    if len(usable) < MIN_NUM_PHOTOS:
        why = "".join(f"; {name} {reason}" for name, reason in list(left_out.items())[:1])
        raise ReconstructionError(
            f"{folder}: {len(usable)} of {len(names)} photos can be used, expected at least {MIN_NUM_PHOTOS}"
            f" readable ones{why}"
        )
    return Photos(folder, tuple(usable), tuple(usable.values()), left_out)


def _why_unreadable(path: Path) -> str:
    try:
        with open_regular(path) as file:
            what = stand_in(path, file.read(_HEAD_BYTES))
    except OSError:
        what = ""
    return what or "cannot be read as an image"


def image_size(path: Path) -> tuple[int, int] | None:
    """Return width and height in pixels, or None if the file is not an image."""
    try:
        with opened_image(path) as image:
            return int(image.width), int(image.height)
    except UNREADABLE:
        return None


def exif_tags(path: Path) -> dict[int, Any]:
    """Return the EXIF tags of the photo and its exposure, by number; empty if the file has none or is not an image."""
    try:
        with opened_image(path) as image:
            exif = image.getexif()
            return {**exif, **exif.get_ifd(_EXIF_IFD)}
    except UNREADABLE:
        return {}


@dataclass(frozen=True)
class GpsData:
    """Position in the data of a photo.

    Attributes:
        degrees: latitude and longitude (WGS 84). altitude_m: NaN if not given.
        tags: of the GPS part of EXIF, by number. xmp: further data, as XML.
    """

    degrees: tuple[float, float]
    altitude_m: float
    tags: Mapping[int, Any]
    xmp: bytes

    def number(self, tag: int) -> float | None:
        """Return the value of a tag; None if it is not there or is no positive number."""
        try:
            value = float(self.tags[tag])
        except (LookupError, TypeError, ValueError, ZeroDivisionError):
            return None
        return value if math.isfinite(value) and value > 0 else None


def gps_data(path: Path) -> GpsData | None:
    """Return the position in the EXIF data of a photo, or None if it has no usable one."""
    try:
        with opened_image(path) as image:
            tags, xmp = image.getexif().get_ifd(_GPS_IFD), image.info.get("xmp", b"")
        latitude = _degrees(tags[_LATITUDE], tags.get(_LATITUDE_REF) == "S")
        longitude = _degrees(tags[_LONGITUDE], tags.get(_LONGITUDE_REF) == "W")
        altitude = float(tags[_ALTITUDE]) if _ALTITUDE in tags else math.nan
    except (*UNREADABLE, LookupError, TypeError, ZeroDivisionError):
        return None
    if tags.get(_ALTITUDE_REF) in (1, b"\x01"):
        altitude = -altitude
    if not all(map(math.isfinite, (latitude, longitude))) or (_ALTITUDE in tags and not math.isfinite(altitude)):
        return None
    return GpsData((latitude, longitude), altitude, tags, xmp if isinstance(xmp, bytes) else b"")


def exif_position(path: Path) -> tuple[float, float, float] | None:
    """Return the EXIF position: latitude and longitude in degrees (WGS 84), and altitude in metres, 0 if not given.

    None if the photo has no usable position.
    """
    data = gps_data(path)
    return None if data is None else (*data.degrees, 0.0 if math.isnan(data.altitude_m) else data.altitude_m)


def _degrees(parts: Any, is_negative: bool) -> float:
    degrees, minutes, seconds = map(float, parts)
    return (degrees + minutes / 60 + seconds / 3600) * (-1 if is_negative else 1)


def contents_of_masks(folder: Path, photos: Photos) -> dict[str, str]:
    """Return the SHA-256 of each photo's mask, by the photo's name.

    Raises:
        InputError: a photo has no mask, so that COLMAP would find no features in it, or has a mask of another size,
            which COLMAP would use as if it had the photo's size.
    """
    if not folder.is_dir():
        raise InputError("no such folder, expected a folder of masks ([mapper] mask_path)", folder)
    # COLMAP's rule: the mask of a.png is a.png.png, or else a.png.
    masks = {name: folder / f"{name}.png" for name in photos.names}
    masks |= {
        name: folder / name for name, mask in masks.items() if not mask.is_file() and name.lower().endswith(".png")
    }
    if missing := [name for name, mask in masks.items() if not mask.is_file()]:
        raise InputError(
            f"{len(missing)} of {len(masks)} photos have no mask in this folder, the first is {missing[0]}: expected"
            f" {missing[0]}.png",
            folder,
        )
    for name, size in zip(photos.names, photos.sizes, strict=True):
        if (found := image_size(masks[name])) != size:
            what = "cannot be read as an image" if found is None else f"has {found[0]} x {found[1]} pixels"
            raise InputError(f"{what}, expected {size[0]} x {size[1]} like the photo {name}", masks[name])
    return {name: sha256_of(mask) for name, mask in masks.items()}
