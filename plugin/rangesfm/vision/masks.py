"""Masks of photos, by COLMAP's convention: where a mask is black, no feature is taken."""

from __future__ import annotations

from pathlib import Path

from rangesfm.errors import InputError
from rangesfm.files.atomic import sha256_of
from rangesfm.vision.photos import Photos, image_size


def contents_of_masks(folder: Path | None, photos: Photos) -> dict[str, str]:
    """SHA-256 of each photo's mask; none without a folder of them.

    Raises:
        InputError: a photo has none, which COLMAP would leave without features, or one of another size, which COLMAP
            would take for one of the photo's size.
    """
    if folder is None:
        return {}
    if not folder.is_dir():
        raise InputError("no such folder, expected one of masks ([mapper] mask_path)", folder)
    masks = {name: _mask(folder, name) for name in photos.names}
    if missing := [name for name, mask in masks.items() if not mask.is_file()]:
        raise InputError(
            f"{len(missing)} of {len(masks)} photos have no mask there, the first is {missing[0]}: expected"
            f" {missing[0]}.png",
            folder,
        )
    for name, size in zip(photos.names, photos.sizes, strict=True):
        if (found := image_size(masks[name])) != size:
            what = "cannot be read as an image" if found is None else f"is of {found[0]} x {found[1]} pixels"
            raise InputError(f"{what}, expected {size[0]} x {size[1]} as the photo {name}", masks[name])
    return {name: sha256_of(mask) for name, mask in masks.items()}


def _mask(folder: Path, name: str) -> Path:
    """As COLMAP looks for it: that of a.png may also be called a.png."""
    mask = folder / f"{name}.png"
    return folder / name if not mask.is_file() and name.lower().endswith(".png") else mask
