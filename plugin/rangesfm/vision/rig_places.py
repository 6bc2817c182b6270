"""Where the cameras of a rig sit while its photos are mapped: held where that is known, else found without the rig."""

from __future__ import annotations

import shutil
from pathlib import Path

import pycolmap

from rangesfm.errors import InputError, ReconstructionError
from rangesfm.files.atomic import scratch_folder
from rangesfm.vision.mapping import map_photos, read_models
from rangesfm.vision.matched_photos import Workspace
from rangesfm.vision.photos import Photos
from rangesfm.vision.rigs import Rigs
from rangesfm.vision.whole_mapping import WholePipelineOptions

PipelineOptions = pycolmap.IncrementalPipelineOptions | WholePipelineOptions


def place_cameras(photos: Photos, rigs: Rigs, options: PipelineOptions, space: Workspace) -> None:
    """Map the photos as if there were no rigs, and enter in the database where their cameras sit in that model.

    Places that are known say what its unit is, so that all go together.

    Raises:
        ReconstructionError: there is no model, or a camera of a rig is not in it together with its reference camera.
    """
    with scratch_folder(space.output / "rigs") as folder:
        database_path = Path(shutil.copyfile(space.database, folder / "database.db"))
        with pycolmap.Database.open(database_path) as database:
            pycolmap.apply_rig_config([], database)
        models = folder / "sparse"
        map_photos(database_path, photos, models, folder / "snapshots", options, space.log, space.progress)
        model = read_models(models)[0]
    rigs.rescale(model)
    try:
        rigs.apply(space.database, model)
    except InputError as error:  # there are frames of which it has no other camera's photo
        raise ReconstructionError(_why_not(rigs)) from error
    with pycolmap.Database.open(space.database) as database:
        if any(pose is None for rig in database.read_all_rigs() for pose in rig.non_ref_sensors.values()):
            raise ReconstructionError(_why_not(rigs))


def _why_not(rigs: Rigs) -> str:
    return (
        "without the rig no photos of its cameras that were taken at once come into one model: say in"
        f" {rigs.path} where they sit (cam_from_rig)"
    )


def hold_rigs(options: PipelineOptions, rigs: Rigs, database_path: Path) -> None:
    """Have the mapping keep the rigs whose configuration says where all of their cameras sit.

    The global mapper begins with what is known and refines it: with rigs held, COLMAP 4.2's global positioning ends in
    a map without sense, of perfect matches too.
    """
    if isinstance(options, pycolmap.HierarchicalPipelineOptions):
        options = options.incremental_options
    if isinstance(options, pycolmap.IncrementalPipelineOptions) and any(rigs.are_known):
        options.constant_rigs = rigs.ids_of_known(database_path)
