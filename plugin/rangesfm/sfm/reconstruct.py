"""Reconstruction of an unscaled COLMAP model from photos: features, matching, mapping."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.errors import InputError, ReconstructionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.progress import SILENT, Progress
from rangesfm.sfm.loop_database import forget_loops
from rangesfm.sfm.mapping import MappingOptions, map_photos, mapping_options, pipeline_options, read_mapped_models
from rangesfm.sfm.photo_files import Photos
from rangesfm.sfm.photo_matching import photo_matching
from rangesfm.sfm.rigs import NO_RIGS, Rigs
from rangesfm.sfm.steps import Workspace, fingerprint
from rangesfm.sfm.unpublished import UnpublishedReconstruction
from rangesfm.util.files.atomic import scratch_folder
from rangesfm.util.files.contents import AnyPath
from rangesfm.util.files.output_folder import sole_writer


@dataclass(frozen=True)
class ReconstructionSummary:
    """Outcome of a reconstruction.

    Attributes:
        models: the separate models, the one with the most photos first.
        seconds: duration of each step ("features", "matching", "mapping"), without those taken over from earlier runs.
        earlier_seconds: of those taken over, as far as known.
        log_path: COLMAP's own log.
    """

    models: tuple[pycolmap.Reconstruction, ...]
    seconds: dict[str, float]
    earlier_seconds: dict[str, float]
    log_path: Path

    @property
    def num_registered(self) -> int:
        """Number of photos in the first model."""
        return self.models[0].num_reg_images()


def reconstruct(
    image_path: AnyPath,
    image_names: Sequence[str],
    output_path: AnyPath,
    *,
    camera: CameraOptions,
    mapper: MapperOptions,
    rigs: Rigs = NO_RIGS,
    seed: int = 0,
    progress: Progress = SILENT,
) -> ReconstructionSummary:
    """Reconstruct photos.

    Writes ``database.db``, the models ``sparse/0`` (the largest), ``sparse/1``, ..., ``mapper.log``
    and ``reconstruct.json`` to ``output_path``, once all of them are complete.

    Steps that an earlier run into the same folder did with the same photos (by their content) and options are taken
    over. Of an interrupted run, the features and matches found so far and the newest snapshot of the mapping are taken
    over. Where only some of the photos have changed, the features of the others and the matches between them are.

    Args:
        image_path: folder of the photos.
        image_names: the keyframes, relative to that folder, in time order.
        output_path: made if it does not exist.
        camera: which photos share a camera, and what is known of the cameras.
        rigs: the rigs that cameras are mounted on.
        seed: the same seed gives the same models.

    Raises:
        InputError: COLMAP does not accept an option, a folder cannot be written to, or files that this tool did not
            write are in the places of the results.
        ReconstructionError: the photos cannot be read, or do not give a model.
        KeyboardInterrupt: as soon as COLMAP has stopped.
    """
    pipeline_options(camera, mapper, seed)  # so that bad options are refused before anything is written
    with (
        sole_writer(Path(output_path)) as output,
        UnpublishedReconstruction(output, progress, restart=False) as unpublished,
    ):
        summary = reconstruct_in(unpublished, Path(image_path), image_names, camera, mapper, rigs, seed)
        unpublished.publish()
        return summary


def reconstruct_in(
    unpublished: UnpublishedReconstruction,
    image_path: Path,
    image_names: Sequence[str],
    camera: CameraOptions,
    mapper: MapperOptions,
    rigs: Rigs,
    seed: int,
) -> ReconstructionSummary:
    """Reconstruct photos as ``reconstruct`` does, in a workspace that is not published yet.

    The options have been checked by ``pipeline_options``.
    """
    progress = unpublished.progress
    with photo_matching(image_path, image_names, camera, mapper, rigs, seed, unpublished) as matching:
        intrinsics = [table.intrinsics_in_mapping for table in camera.tables]
        command = [mapper.command] if mapper.command else []
        of_matches = matching.plan["matching"]
        mapping = fingerprint(of_matches, mapper.method, *command, mapper.reproducible, mapper.pipeline, *intrinsics)
        placing = {} if all(rigs.are_known) else {"rigs": mapping}
        plan = {**matching.plan, **placing, "mapping": mapping}
        space = unpublished.begin(plan, with_loops_closed=mapper.close_loops)
        with space.logged():

            def options(rigs: Rigs) -> MappingOptions:
                return mapping_options(camera, mapper, rigs, seed, space.database)

            def begin_mapping() -> None:
                """Remove old models, and the matches of the loops that were found by them."""
                space.remove_old_models()
                forget_loops(space, with_matches=True)

            matching.fill(space)
            if placing:
                space.run(
                    "rigs",
                    mapping,
                    lambda: rigs.apply(space.database),
                    lambda: _place_cameras(space, matching.photos, rigs, options(NO_RIGS)),
                )
            space.run(
                "mapping",
                mapping,
                begin_mapping,
                lambda: map_photos(space, matching.photos, options(rigs)),
            )
    found = read_mapped_models(space.models)
    if len(found) > 1:
        sizes = ", ".join(str(model.num_reg_images()) for model in found)
        progress.message(f"{len(found)} separate models of {sizes} photos")
    return ReconstructionSummary(found, space.seconds, space.earlier_seconds, unpublished.log_path)


def _place_cameras(space: Workspace, photos: Photos, rigs: Rigs, options: MappingOptions) -> None:
    """Map the photos without rigs, and write the rigs' poses found in that model into the database.

    Camera poses that the configuration does give set the scale of that model, so that all poses have one unit.

    Raises:
        ReconstructionError: there is no model, or no photo of some rig camera is in it together with one of its
            reference camera, taken at the same time.
    """
    with scratch_folder(space.folder / "rigs") as folder:
        without_rigs = Workspace(folder, space.progress)
        without_rigs.log_folder = space.log_folder
        shutil.copyfile(space.database, without_rigs.database)
        with pycolmap.Database.open(without_rigs.database) as database:
            pycolmap.apply_rig_config([], database)
        map_photos(without_rigs, photos, options)
        model = read_mapped_models(without_rigs.models)[0]
    rigs.rescale(model)
    why_not = (
        "mapped without the rig, no photos that its cameras took at once are in one model: add the cameras' poses"
        f" (cam_from_rig) to {rigs.path}"
    )
    try:
        rigs.apply(space.database, model)
    except InputError as error:  # in no frame does the model have the photo of another camera
        raise ReconstructionError(why_not) from error
    with pycolmap.Database.open(space.database) as database:
        if any(pose is None for rig in database.read_all_rigs() for pose in rig.non_ref_sensors.values()):
            raise ReconstructionError(why_not)
