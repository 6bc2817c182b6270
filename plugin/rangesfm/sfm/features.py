"""Step 1: features of the photos in COLMAP's database."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pycolmap

from rangesfm.errors import ReconstructionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.sfm.background import find_features
from rangesfm.sfm.database import num_photos_with_features
from rangesfm.sfm.device import apply_options_of_device, uses_gpu
from rangesfm.sfm.photo_files import MIN_NUM_PHOTOS, Photos
from rangesfm.sfm.steps import Workspace
from rangesfm.util.processes.supervision import run_child

# A photo with fewer features is reported as poor. COLMAP starts from pairs with 100 matches and adds photos that see
# 30 known points.
_MIN_NUM_FEATURES = 50


def feature_options(mapper: MapperOptions) -> pycolmap.FeatureExtractionOptions:
    """Return COLMAP's options for feature extraction.

    Raises:
        InputError: a key or value that COLMAP does not have, or no GPU where one is asked for.
    """
    options = pycolmap.FeatureExtractionOptions(num_threads=mapper.num_threads, use_gpu=uses_gpu(mapper))
    apply_options_of_device(options, mapper.features, "mapper.features")
    return options


def extract_features(
    space: Workspace,
    photos: Photos,
    options: pycolmap.FeatureExtractionOptions,
    mask_path: Path | None = None,
) -> None:
    """Find features in the photos of the database that have none yet, except where their masks are black.

    Args:
        mask_path: folder of the masks.

    Raises:
        ReconstructionError: fewer than two photos have enough features, or COLMAP failed.
    """
    with pycolmap.Database.open(space.database) as database:

        def say_how_many(_: int) -> None:
            space.progress.update(num_photos_with_features(database), len(photos.names))

        missing = [name for id_, name in enumerate(photos.names, 1) if not database.exists_keypoints(id_)]
        if missing:
            work = partial(find_features, space.database, photos.folder, missing, mask_path, options, space.log_folder)
            run_child(work, say_how_many)
        say_how_many(0)
        ids = enumerate(photos.names, 1)
        poor = [name for id_, name in ids if database.num_keypoints_for_image(id_) < _MIN_NUM_FEATURES]
    num_rich = len(photos.names) - len(poor)
    if num_rich < MIN_NUM_PHOTOS:
        raise ReconstructionError(
            f"{num_rich} of {len(photos.names)} photos have {_MIN_NUM_FEATURES} features or more, the first with fewer"
            f" is {poor[0]}: are the photos sharp, well exposed, and not of blank walls?"
        )
    if poor:
        space.progress.message(
            f"{len(poor)} of {len(photos.names)} photos have fewer than {_MIN_NUM_FEATURES} features, the first is"
            f" {poor[0]}"
        )
