"""The photos that can be read."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from PIL import Image

from rangesfm.errors import ReconstructionError
from rangesfm.files.atomic import state_and_sha256

MIN_NUM_PHOTOS = 2


@dataclass(frozen=True)
class Photos:
    """Photos, of whatever size.

    Attributes:
        folder: of all of them.
        names: n names, relative to the folder, in the order given.
        sizes: n times width and height, pixels, as stored: EXIF does not turn them, as COLMAP does not.
        left_out: photos that cannot be used, and why.
    """

    folder: Path
    names: tuple[str, ...]
    sizes: tuple[tuple[int, int], ...]
    left_out: dict[str, str]

    def of(self, names: Collection[str]) -> Photos:
        """Some of them."""
        wanted = set(names)
        kept = [(name, size) for name, size in zip(self.names, self.sizes, strict=True) if name in wanted]
        return replace(self, names=tuple(name for name, _ in kept), sizes=tuple(size for _, size in kept))

    def contents(self, known: Mapping[str, Any]) -> dict[str, tuple[tuple[int, int, int], str]]:
        """State and SHA-256 of each file, by name in the order given: what tells these photos from others.

        Args:
            known: what an earlier call returned, perhaps by way of JSON; a file is not read again
                while its size and its times of change are the same.
        """
        return {name: state_and_sha256(self.folder / name, known.get(name)) for name in self.names}


def usable_photos(folder: Path, names: Sequence[str]) -> Photos:
    """Those that can be read.

    Raises:
        ReconstructionError: fewer than two of them.
    """
    sizes = {name: image_size(folder / name) for name in names}
    usable = {name: size for name, size in sizes.items() if size is not None}
    left_out = {name: "cannot be read as an image" for name in names if name not in usable}
    if len(usable) < MIN_NUM_PHOTOS:
        why = "".join(f"; {name} {reason}" for name, reason in list(left_out.items())[:1])
        raise ReconstructionError(
            f"{folder}: {len(usable)} of {len(names)} photos can be used, expected at least {MIN_NUM_PHOTOS}"
            f" readable ones{why}"
        )
    return Photos(folder, tuple(usable), tuple(usable.values()), left_out)


def image_size(path: Path) -> tuple[int, int] | None:
    """Width and height, pixels; None of what is no image."""
    try:
        with Image.open(path) as image:
            return int(image.width), int(image.height)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):  # what Pillow's readers raise
        return None
