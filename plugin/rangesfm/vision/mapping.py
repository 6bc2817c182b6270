"""Step 3: COLMAP's incremental mapper, and its models on disk."""

from __future__ import annotations

import shutil
from collections.abc import Iterable
from pathlib import Path

import pycolmap

from rangesfm.colmap.model_files import read_model, write_binary_model
from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import ReconstructionError
from rangesfm.files.atomic import new_folder, scratch_folder
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.progress import Progress
from rangesfm.vision.background import run_in_background
from rangesfm.vision.database import num_matching_pairs
from rangesfm.vision.mapping_loop import GlobalAdjustment, incremental_mapping
from rangesfm.vision.photos import Photos
from rangesfm.vision.snapshots import Snapshots, newest_snapshot, remove_snapshots


class NoModelError(ReconstructionError):
    """Nothing failed; the photos just do not give a model."""


def pipeline_options(camera: CameraOptions, mapper: MapperOptions, seed: int) -> pycolmap.IncrementalPipelineOptions:
    """Raises InputError for keys or values that are not COLMAP's."""
    options = pycolmap.IncrementalPipelineOptions(num_threads=mapper.num_threads, random_seed=seed)
    options.mapper.random_seed = options.triangulation.random_seed = seed
    if not camera.mapping_refines_intrinsics:
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    apply_options(options, mapper.pipeline, "mapper.pipeline")
    return options


def map_incrementally(
    database_path: Path,
    photos: Photos,
    models_path: Path,
    snapshots_path: Path,
    options: pycolmap.IncrementalPipelineOptions,
    progress: Progress,
    adjustment: GlobalAdjustment | None = None,
) -> None:
    """Write all models to ``models_path``/0, /1, ..., the one with the most photos first.

    Goes on from the newest snapshot in ``snapshots_path``, if there is one, and has its own there until it is done.

    Raises:
        NoModelError: there is not a single one.
        ReconstructionError: COLMAP failed.
    """
    begun = newest_snapshot(snapshots_path)
    counter = _Counter(begun)
    if begun is not None:
        progress.message(f"mapping: goes on from {counter.num_in_next_model} photos of an earlier run")
    # COLMAP writes models as it goes, in the order in which it began them.
    with scratch_folder(models_path.with_name("mapping")) as folder:
        snapshots = Snapshots(snapshots_path, folder / "snapshots", options, len(photos.names))

        def begin_model() -> None:
            counter.begin_model()
            snapshots.begin_model()

        def add_photo() -> None:
            counter.add_photo()
            snapshots.add_photo()

        models = run_in_background(
            lambda token: incremental_mapping(
                database_path,
                photos.folder,
                folder,
                options=options,
                adjustment=adjustment,
                input_path=begun or "",
                initial_image_pair_callback=begin_model,
                next_image_callback=add_photo,
                cancellation_token=token,
            ),
            progress,
            lambda: counter.num_registered,
            len(photos.names),
        )
    if not models:
        with pycolmap.Database.open(database_path) as database:
            num_matching = num_matching_pairs(database)
        raise NoModelError(
            f"no model from {len(photos.names)} photos, of which {num_matching} pairs match: photos from"
            " more places sideways to the view, or known camera parameters, may help"
        )
    write_models(models.values(), models_path)
    remove_snapshots(snapshots_path)


def write_models(models: Iterable[pycolmap.Reconstruction], models_path: Path) -> None:
    """As ``models_path``/0, /1, ..., the one with the most photos first."""
    with new_folder(models_path) as temporary:
        for index, model in enumerate(sorted(models, key=lambda model: -model.num_reg_images())):
            (temporary / str(index)).mkdir()
            write_binary_model(model, temporary / str(index))


def read_models(models_path: Path) -> tuple[pycolmap.Reconstruction, ...]:
    """The models that ``map_incrementally`` wrote, in their order."""
    folders = [folder for folder in models_path.iterdir() if folder.name.isdecimal()]
    return tuple(read_model(folder) for folder in sorted(folders, key=lambda folder: int(folder.name)))


def remove_models(models_path: Path) -> None:
    shutil.rmtree(models_path, ignore_errors=True)


class _Counter:
    """Photos registered so far; in more than one model they count more than once."""

    def __init__(self, begun: Path | None):
        self.num_registered = 0
        self.num_in_next_model = 2 if begun is None else pycolmap.Reconstruction(begun).num_reg_images()

    def begin_model(self) -> None:
        self.num_registered += self.num_in_next_model
        self.num_in_next_model = 2

    def add_photo(self) -> None:
        self.num_registered += 1
