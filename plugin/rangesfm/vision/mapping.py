"""Step 3: mapping by COLMAP's mappers, and their models on disk."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.colmap.calibrated_cameras import cameras_as_given
from rangesfm.colmap.colmap_log import append_log
from rangesfm.colmap.model_files import read_model, write_binary_model
from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import ReconstructionError
from rangesfm.files.atomic import new_folder, scratch_folder
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.processes.supervision import run_children
from rangesfm.vision.background import run_in_background
from rangesfm.vision.database import num_matching_pairs
from rangesfm.vision.device import uses_gpu
from rangesfm.vision.incremental_mapping import adjust_whole, incremental_mapping
from rangesfm.vision.own_process import MODULE, WholeMapping, WholePipelineOptions
from rangesfm.vision.photo_files import Photos
from rangesfm.vision.rigs import Rigs
from rangesfm.vision.snapshots import Snapshots, newest_snapshot
from rangesfm.vision.steps import Workspace

# With several threads Ceres adds up in the order in which they finish, also with a fixed number of threads: every run
# would give another map. Two threads would save 7 to 21 % of the mapping's time (see "One thread for the
# mapping" in examples/measured.md). [mapper.pipeline] num_threads overrides this.
_NUM_THREADS = 1
PipelineOptions = pycolmap.IncrementalPipelineOptions | WholePipelineOptions


@dataclass(frozen=True)
class MappingOptions:
    """Options of the mapping.

    Attributes:
        growing: options of the mapper.
        whole: options of a last adjustment of each model, which frees intrinsics that the mapper held fixed; None where
            it held none.
    """

    growing: PipelineOptions
    whole: pycolmap.IncrementalPipelineOptions | None


def pipeline_options(camera: CameraOptions, mapper: MapperOptions, seed: int) -> PipelineOptions:
    """Return the options of the chosen mapper.

    Raises:
        InputError: a key or value that COLMAP does not have.
    """
    options: PipelineOptions
    if mapper.method == "global":
        options = pycolmap.GlobalPipelineOptions(num_threads=_NUM_THREADS, random_seed=seed)
        positioning, adjustment = options.mapper.global_positioning, options.mapper.bundle_adjustment
        positioning.use_gpu = adjustment.ceres.use_gpu = uses_gpu(mapper)
        if any(table.intrinsics_in_mapping == "kept" for table in camera.tables):
            adjustment.refine_focal_length = adjustment.refine_extra_params = False
    elif mapper.method == "hierarchical":
        # COLMAP 4.2 passes this number of threads on to the clusters, whatever their own options say.
        options = pycolmap.HierarchicalPipelineOptions(num_threads=_NUM_THREADS, num_workers=mapper.num_cores)
        _set_seed(options.incremental_options, seed)
    else:
        options = pycolmap.IncrementalPipelineOptions(num_threads=_NUM_THREADS)
        _set_seed(options, seed)
    apply_options(options, mapper.pipeline, "mapper.pipeline")
    return options


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
    if isinstance(growing, pycolmap.GlobalPipelineOptions):
        return MappingOptions(growing, None)
    options = growing
    if isinstance(options, pycolmap.HierarchicalPipelineOptions):
        options = options.incremental_options
    if any(rigs.are_known) and "ba_refine_sensor_from_rig" not in mapper.pipeline:
        options.constant_rigs = rigs.ids_of_known(database_path)
    with pycolmap.Database.open(database_path) as database:
        cameras = {found.camera_id: found for found in database.read_all_cameras()}
        camera_of_photo = [(image.name, cameras[image.camera_id]) for image in database.read_all_images()]
    kept, refined_last = _held_cameras(camera, camera_of_photo)
    options.constant_cameras |= kept
    whole = copy.deepcopy(options)
    whole.num_threads = growing.num_threads
    options.constant_cameras |= refined_last
    if options.constant_cameras >= set(cameras):
        options.ba_refine_focal_length = options.ba_refine_extra_params = False
        # Registration of a photo by its matches alone looks at these two options, not at constant_cameras.
        options.mapper.abs_pose_refine_focal_length = options.mapper.abs_pose_refine_extra_params = False
    return MappingOptions(growing, whole if refined_last else None)


def _held_cameras(
    camera: CameraOptions, camera_of_photo: Sequence[tuple[str, pycolmap.Camera]]
) -> tuple[set[int], set[int]]:
    """Return the ids of cameras that are held fixed throughout, and of those held fixed while the map grows."""
    as_given = cameras_as_given(camera, camera_of_photo)
    held: dict[str, set[int]] = {"kept": set(), "refined last": set(), "refined": set()}
    for name, found in camera_of_photo:
        table = camera.of_photo(name)
        # For photos of another shape than the calibrated ones COLMAP guesses the camera, and a guess is not held fixed.
        if found.camera_id in as_given or table.params is None:
            held[table.intrinsics_in_mapping].add(found.camera_id)
    return held["kept"], held["refined last"]


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
        models = _map_at_once(space, photos.folder, growing)
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
    num_begun = 0
    if begun is not None:
        num_begun = pycolmap.Reconstruction(begun).num_reg_images()
        space.progress.message(f"mapping: continues from {num_begun} photos of an earlier run")
    num_registered: list[int] = []  # photos of each model; a photo may be in more than one
    with scratch_folder(space.output / "mapping") as folder:
        snapshots = Snapshots(space.snapshots, folder)

        def begin_model() -> None:
            num_registered.append(0 if num_registered else num_begun)

        def add_photo(model: pycolmap.Reconstruction) -> None:
            num_registered[-1] = model.num_reg_images()
            if len(num_registered) == 1:
                snapshots.add_photo(model)

        return run_in_background(
            lambda token: incremental_mapping(
                space.database,
                photos.folder,
                options=options,
                input_path=begun,
                initial_image_pair_callback=begin_model,
                next_image_callback=add_photo,
                cancellation_token=token,
            ),
            space.progress,
            lambda: sum(num_registered),
            len(photos.names),
        )


def _map_at_once(space: Workspace, image_path: Path, options: WholePipelineOptions) -> list[pycolmap.Reconstruction]:
    """Return all models of a mapper that takes all photos at once, and append COLMAP's messages to the log."""
    space.progress.message("mapping: this mapper shows no progress, and starts anew after an interruption")
    with scratch_folder(space.output / "mapping") as folder:
        # The mapper works on a copy of the database, because it writes what it finds about pairs into it.
        work = WholeMapping(Path(shutil.copyfile(space.database, folder / "database.db")), image_path, options)
        try:
            with closing(run_children(MODULE, [work], 1, lambda _: None)) as ended:
                list(ended)
        finally:
            append_log(work.log, space.log)
        return [read_model(path) for path in sorted(folder.iterdir()) if path.is_dir()]


def read_mapped_models(models_path: Path) -> tuple[pycolmap.Reconstruction, ...]:
    """Read the models that ``map_photos`` wrote, in their order."""
    folders = [folder for folder in models_path.iterdir() if folder.name.isdecimal()]
    return tuple(read_model(folder) for folder in sorted(folders, key=lambda folder: int(folder.name)))
