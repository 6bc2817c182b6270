"""The files of somebody who has a phone and a radio: photos with EXIF times, and a log."""

from __future__ import annotations

from pathlib import Path

from PIL import Image
from PIL.ExifTags import IFD, Base
from tests.simulated.files import write_rows


def write_photos(folder: Path, num: int, *, num_upright: int = 0, has_times: bool = True) -> None:
    """Write photos of 96 x 64 pixels, one a second; the last ``num_upright`` of them are in portrait format."""
    folder.mkdir(parents=True, exist_ok=True)
    for k in range(num):
        size = (64, 96) if k >= num - num_upright else (96, 64)
        exif = Image.Exif()
        if has_times:
            exif.get_ifd(IFD.Exif)[Base.DateTimeOriginal] = f"2026:05:04 10:00:{k:02d}"
        Image.new("RGB", size, (9 * k, 40, 40)).save(folder / f"IMG_{k}.jpg", exif=exif)


def write_log(path: Path, start_s: float, *, anchors: tuple[str, ...] = ("A1", "A2", "A3", "A4")) -> None:
    """Write a log of ranges twice a second, to one anchor after the other."""
    rows = ((start_s + 0.5 * k, anchors[k % len(anchors)], f"{3 + 0.01 * k:.2f}") for k in range(60))
    write_rows(path, "timestamp_s,anchor_id,range_m", rows)


def write_anchors(path: Path) -> None:
    write_rows(path, "anchor_id,x_m,y_m,z_m", ((f"A{k}", 5 * (k % 2), 4 * (k // 3), 0.5 * k) for k in range(1, 5)))
