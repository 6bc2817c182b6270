"""Step 1: photos into COLMAP's database, and features out of them."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from pathlib import Path

import pycolmap

from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import OptionError, ReconstructionError
from rangesfm.options import MapperOptions
from rangesfm.progress import Progress
from rangesfm.vision.background import run_in_background
from rangesfm.vision.database import num_photos_with_features
from rangesfm.vision.photos import MIN_NUM_PHOTOS, Photos

_MIN_NUM_FEATURES = 50  # COLMAP starts from pairs with 100 matches and adds photos that see 30 known points
_CALL_S = 4.0


def feature_options(mapper: MapperOptions) -> pycolmap.FeatureExtractionOptions:
    """Raises InputError for keys or values that are not COLMAP's."""
    options = pycolmap.FeatureExtractionOptions(num_threads=mapper.num_threads)
    apply_options(options, mapper.features, "mapper.features")
    refuse_learned(options.type.name, "mapper.features")
    return options


def refuse_learned(name: str, table: str) -> None:
    """OptionError for learned features, or a learned way to match them, where pycolmap has no networks."""
    if not name.startswith("SIFT") or name.endswith("LIGHTGLUE"):
        known = pycolmap.FeatureExtractionOptions().todict()
        if "aliked" not in known:
            raise OptionError(
                f"[{table}] type is '{name}', expected SIFT: pycolmap {pycolmap.__version__} as installed is built"
                " without ONNX, which runs networks; features of other programs come by database_path",
                table,
                "type",
            )


def extract_features(
    database_path: Path,
    photos: Photos,
    options: pycolmap.FeatureExtractionOptions,
    progress: Progress,
    mask_path: Path | None = None,
) -> None:
    """Find features in the photos of the database that have none yet, where their masks are not black.

    Raises:
        ReconstructionError: hardly any photo has features.
    """
    reader = pycolmap.ImageReaderOptions()
    if mask_path is not None:
        reader.mask_path = mask_path
    with pycolmap.Database.open(database_path) as database:
        missing = [name for id_, name in enumerate(photos.names, 1) if not database.exists_keypoints(id_)]
        run_in_background(
            lambda token: _call_colmap(database_path, photos.folder, missing, reader, options, token),
            progress,
            lambda: num_photos_with_features(database),
            len(photos.names),
        )
        ids = enumerate(photos.names, 1)
        poor = [name for id_, name in ids if database.num_keypoints_for_image(id_) < _MIN_NUM_FEATURES]
    num_rich = len(photos.names) - len(poor)
    if num_rich < MIN_NUM_PHOTOS:
        raise ReconstructionError(
            f"{num_rich} of {len(photos.names)} photos have {_MIN_NUM_FEATURES} features or more, the first without"
            f" is {poor[0]}: are they sharp, exposed well, and not of blank walls?"
        )
    if poor:
        progress.message(
            f"{len(poor)} of {len(photos.names)} photos have fewer than {_MIN_NUM_FEATURES} features, the first is"
            f" {poor[0]}"
        )


def _call_colmap(
    database_path: Path,
    folder: Path,
    names: Sequence[str],
    reader: pycolmap.ImageReaderOptions,
    options: pycolmap.FeatureExtractionOptions,
    token: pycolmap.CancellationToken,
) -> None:
    """Some seconds' photos at a time: COLMAP finishes all photos of a call before it heeds the token."""
    num_at_a_time = num_threads = options.num_threads if options.num_threads > 0 else os.cpu_count() or 1
    start = 0
    while start < len(names):
        begin_s = time.monotonic()
        pycolmap.extract_features(
            database_path,
            folder,
            image_names=names[start : start + num_at_a_time],
            reader_options=reader,
            extraction_options=options,
            cancellation_token=token,
        )
        start += num_at_a_time
        num_in_time = num_at_a_time * _CALL_S / (time.monotonic() - begin_s)
        num_at_a_time = max(num_threads, int(num_in_time))
