"""Step 3: mapping by COLMAP's mappers or another one, and their models on disk."""

from __future__ import annotations

import copy
import os
import shlex
import shutil
import signal
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TypeAlias

import pycolmap

from rangesfm.colmap.calibrated_cameras import cameras_as_given
from rangesfm.colmap.model_files import read_model, write_binary_model
from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import InputError, ReconstructionError, shown
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.sfm.background import WholePipelineOptions, map_at_once, run_in_background, run_program
from rangesfm.sfm.database import num_matching_pairs
from rangesfm.sfm.device import uses_gpu
from rangesfm.sfm.incremental_mapping import (
    UnfinishedMapping,
    adjust_whole,
    incremental_mapping,
    newest_snapshot,
    snapshots,
)
from rangesfm.sfm.photo_files import Photos
from rangesfm.sfm.rigs import Rigs
from rangesfm.sfm.steps import DATABASE_NAME, MODELS_NAME, Workspace
from rangesfm.util.files.atomic import new_folder, scratch_folder
from rangesfm.util.processes.supervision import run_child

_MAX_LINE = 200
WHILE_GROWING: dict[str, float] = {
    "ba_global_frames_ratio": 2.0,
    "ba_global_points_ratio": 2.0,
    "ba_global_max_refinements": 1,
    "ba_global_function_tolerance": 1e-4,
    "ba_local_max_refinements": 1,
}
"""How a model grows.

COLMAP adjusts all of it each time that it has grown by a tenth, to the last digit and up to five times in a row, which
takes most of the mapping's time. Its neighbours place a new photo well enough: all of it is adjusted to the end when it
is whole.
"""


ExternalMapper: TypeAlias = tuple[str, ...]
"""A program that maps, and its arguments, in which {images} stands for the folder of the photos."""
PipelineOptions = pycolmap.IncrementalPipelineOptions | WholePipelineOptions | ExternalMapper


@dataclass(frozen=True)
class MappingOptions:
    """Options of the mapping.

    Attributes:
        growing: options of the mapper.
        whole: options of a last adjustment of each model, which frees intrinsics that the mapper held fixed; None for a
            mapper that takes all photos at once, where it held none.
    """

    growing: PipelineOptions
    whole: pycolmap.IncrementalPipelineOptions | None


def pipeline_options(camera: CameraOptions, mapper: MapperOptions, seed: int) -> PipelineOptions:
    """Return the options of the chosen mapper.

    Raises:
        InputError: a key or value that COLMAP does not have, or there is no such external mapper.
    """
    if mapper.command:
        return _external_mapper(mapper.command)
    options: pycolmap.IncrementalPipelineOptions | WholePipelineOptions
    # Several threads search for an initial pair until one of them has found some pair, and Ceres adds up what they
    # compute in the order in which they finish: every run gives another map.
    num_threads = 1 if mapper.reproducible else mapper.num_threads
    if mapper.method == "global":
        options = pycolmap.GlobalPipelineOptions(num_threads=num_threads, random_seed=seed)
        positioning, adjustment = options.mapper.global_positioning, options.mapper.bundle_adjustment
        positioning.use_gpu = adjustment.ceres.use_gpu = uses_gpu(mapper)
        if any(table.intrinsics_in_mapping == "kept" for table in camera.tables):
            adjustment.refine_focal_length = adjustment.refine_extra_params = False
    elif mapper.method == "hierarchical":
        # COLMAP 4.2 passes this number of threads on to the clusters, whatever their own options say. The workers, each
        # with a cluster, keep all cores busy.
        options = pycolmap.HierarchicalPipelineOptions(num_threads=1, num_workers=mapper.num_cores)
        _set_seed(options.incremental_options, seed)
    else:
        options = pycolmap.IncrementalPipelineOptions(num_threads=num_threads, **WHILE_GROWING)
        _set_seed(options, seed)
    apply_options(options, mapper.pipeline, "mapper.pipeline")
    return options


def _external_mapper(command: str) -> ExternalMapper:
    try:
        words = shlex.split(command)
    except ValueError as error:
        raise InputError(f"[mapper] command is not a command line ({error}): {shown(command)}") from error
    program = words[0] if words else ""
    is_anywhere = Path(program).name == program or Path(program).is_absolute()
    if (found := shutil.which(program)) is None or not is_anywhere:
        expected = "expected a program on the PATH, or the absolute path of one"
        raise InputError(f"[mapper] command begins with {shown(program)}, {expected}")
    return (found, *words[1:])


def _set_seed(options: pycolmap.IncrementalPipelineOptions, seed: int) -> None:
    options.random_seed = options.mapper.random_seed = options.triangulation.random_seed = seed


def mapping_options(
    camera: CameraOptions, mapper: MapperOptions, rigs: Rigs, seed: int, database_path: Path
) -> MappingOptions:
    """Return mapping options that hold known intrinsics fixed, and rigs whose camera poses are all configured.

    The global mapper holds the intrinsics of all cameras or of none. It starts from the known rigs and refines them,
    because with rigs held fixed COLMAP 4.2's global positioning gives a senseless map, even from perfect matches.
    """
    growing = pipeline_options(camera, mapper, seed)
    if isinstance(growing, pycolmap.GlobalPipelineOptions | tuple):
        return MappingOptions(growing, None)
    options = growing
    if isinstance(options, pycolmap.HierarchicalPipelineOptions):
        options = options.incremental_options
    if any(rigs.are_known) and "ba_refine_sensor_from_rig" not in mapper.pipeline:
        options.constant_rigs = rigs.ids_of_known(database_path)
    with pycolmap.Database.open(database_path) as database:
        cameras = {found.camera_id: found for found in database.read_all_cameras()}
        camera_of_photo = [(image.name, cameras[image.camera_id]) for image in database.read_all_images()]
    as_given = cameras_as_given(camera, camera_of_photo)
    held: dict[str, set[int]] = {"kept": set(), "refined last": set(), "refined": set()}
    for name, found in camera_of_photo:
        table = camera.of_photo(name)
        # For photos of another shape than the calibrated ones COLMAP guesses the camera, and a guess is not held fixed.
        if found.camera_id in as_given or not table.params:
            held[table.intrinsics_in_mapping].add(found.camera_id)
    options.constant_cameras |= held["kept"]
    whole = copy.deepcopy(options)
    whole.num_threads = growing.num_threads
    for key in WHILE_GROWING.keys() - mapper.pipeline.keys():
        setattr(whole, key, getattr(pycolmap.IncrementalPipelineOptions(), key))
    options.constant_cameras |= held["refined last"]
    if options.constant_cameras >= set(cameras):
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        # Registration of a photo by its matches alone looks at these two options, not at constant_cameras.
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    is_due = held["refined last"] or options is growing
    return MappingOptions(growing, whole if is_due else None)


def map_photos(space: Workspace, photos: Photos, options: MappingOptions) -> None:
    """Map the photos of the database and write all models, the one with the most photos first.

    The incremental mapper continues from the newest snapshot, if there is one, and writes snapshots until it is done.

    Raises:
        ReconstructionError: there is not a single model, or COLMAP failed.
    """
    growing, whole = options.growing, options.whole
    if isinstance(growing, pycolmap.IncrementalPipelineOptions):
        models = _map_incrementally(space, photos, growing)
    else:
        models = _map_in_child(space, photos.folder, growing)
    if whole is not None:
        for model in models:
            adjust_whole(space.database, model, options=whole)
    if not models:
        with pycolmap.Database.open(space.database) as database:
            num_matching = num_matching_pairs(database)
        raise ReconstructionError(
            f"no model from {len(photos.names)} photos, of which {num_matching} pairs match: photos taken from more"
            " places, shifted sideways to the view, or known camera parameters may help"
        )
    with new_folder(space.models) as temporary:
        for index, model in enumerate(sorted(models, key=lambda model: -model.num_reg_images())):
            (temporary / str(index)).mkdir()
            write_binary_model(model, temporary / str(index))
    shutil.rmtree(space.snapshots, ignore_errors=True)


def _map_incrementally(
    space: Workspace, photos: Photos, options: pycolmap.IncrementalPipelineOptions
) -> list[pycolmap.Reconstruction]:
    """Return all models that COLMAP's incremental mapper makes; there may be none."""
    begun = newest_snapshot(space.snapshots)
    num_registered = 0  # in all models; a photo may be in more than one
    if begun is not None:
        num_registered = _num_registered(begun)
        space.progress.message(f"mapping: continues from {num_registered} photos of an earlier run")
    with scratch_folder(space.folder / "mapping") as folder:
        keep = snapshots(space.snapshots, folder, options.min_model_size)

        def add_photo(mapping: UnfinishedMapping) -> None:
            nonlocal num_registered
            num_registered = _num_registered(mapping)
            keep(mapping)

        return run_in_background(
            lambda token: incremental_mapping(
                space.database,
                photos.folder,
                options=options,
                unfinished=begun,
                callback=add_photo,
                cancellation_token=token,
            ),
            space.progress,
            lambda: num_registered,
            len(photos.names),
        )


def _num_registered(mapping: UnfinishedMapping) -> int:
    return sum(model.num_reg_images() for model in mapping.models)


def _map_in_child(
    space: Workspace, image_path: Path, mapper: WholePipelineOptions | ExternalMapper
) -> list[pycolmap.Reconstruction]:
    """Return all models of a mapper that takes all photos at once, in a process of its own.

    It works in a folder with a copy of the database, into which it may write what it finds about pairs.
    """
    space.progress.message("mapping: this mapper shows no progress, and starts anew after an interruption")
    with scratch_folder(space.folder / "mapping") as folder:
        database_path = Path(shutil.copyfile(space.database, folder / DATABASE_NAME))
        if isinstance(mapper, tuple):
            return _map_by_program(space, folder, image_path, mapper)
        # It does not notice a cancellation, so that Ctrl-C ends its process.
        run_child(partial(map_at_once, database_path, image_path, mapper, space.log_folder))
        return [read_model(path) for path in sorted(folder.iterdir()) if path.is_dir()]


def _map_by_program(
    space: Workspace, folder: Path, image_path: Path, mapper: ExternalMapper
) -> list[pycolmap.Reconstruction]:
    """Return the models that an external mapper writes into a folder with a copy of the database.

    Raises:
        ReconstructionError: it failed, wrote no model, or a model of other photos.
    """
    words = [word.replace("{images}", str(image_path.resolve())) for word in mapper]
    name, log = f"the external mapper {Path(mapper[0]).name}", space.log_folder / "external_mapper"
    status = run_child(partial(run_program, words, folder, dict(os.environ), log))
    if status:
        how = f"status {status}" if status > 0 else signal.Signals(-status).name
        printed = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        raise ReconstructionError(f"{name} ended with {how}" + (f": {printed[-1][:_MAX_LINE]}" if printed else ""))
    if not (folder / MODELS_NAME / "0").is_dir():
        raise ReconstructionError(f"{name} ended without an error, but wrote no model to sparse/0")
    try:
        models = list(read_mapped_models(folder / MODELS_NAME))
    except InputError as error:
        raise ReconstructionError(f"{name} wrote a model that cannot be used: {error}") from error
    with pycolmap.Database.open(space.database) as database:
        name_of = {image.image_id: image.name for image in database.read_all_images()}
    for model in models:
        for image_id, image in model.images.items():
            if name_of.get(image_id) != image.name:
                expected = "none" if image_id not in name_of else shown(name_of[image_id])
                raise ReconstructionError(
                    f"{name} wrote a model with {shown(image.name)} as image {image_id}, expected the images of "
                    f"database.db, where that is {expected}"
                )
    return models


def read_mapped_models(models_path: Path) -> tuple[pycolmap.Reconstruction, ...]:
    """Read the models that ``map_photos`` wrote, in their order."""
    folders = [folder for folder in models_path.iterdir() if folder.name.isdecimal()]
    return tuple(read_model(folder) for folder in sorted(folders, key=lambda folder: int(folder.name)))
