"""Photos to an unscaled COLMAP model: features, matching, mapping."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.errors import InputError, ReconstructionError
from rangesfm.files.atomic import scratch_folder, sole_writer
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.progress import Progress, SilentProgress
from rangesfm.vision.camera import cameras_of_photos, check_camera
from rangesfm.vision.features import feature_options
from rangesfm.vision.given_database import opened
from rangesfm.vision.mapping import MappingOptions, map_photos, mapping_options, pipeline_options, read_models
from rangesfm.vision.mapping_loop import GlobalAdjustment
from rangesfm.vision.matching import matching_options
from rangesfm.vision.photos import Photos, contents_of_masks, usable_photos
from rangesfm.vision.renewed_database import RenewedDatabase
from rangesfm.vision.rigs import NO_RIGS, Rigs
from rangesfm.vision.steps import LOG_NAME, Workspace, fingerprint
from rangesfm.vision.unpublished import UnpublishedReconstruction


@dataclass(frozen=True)
class ReconstructionSummary:
    """What became of the photos.

    Attributes:
        models: the separate models, the one with the most photos first.
        num_keyframes: photos asked for.
        num_registered: photos in the first model.
        seconds: by step ("features", "matching", "mapping"); one that was taken over has none.
        log_path: COLMAP's own log.
    """

    models: tuple[pycolmap.Reconstruction, ...]
    num_keyframes: int
    num_registered: int
    seconds: dict[str, float]
    log_path: Path


def reconstruct(
    image_path: str | Path,
    image_names: Sequence[str],
    output_path: str | Path,
    *,
    camera: CameraOptions,
    mapper: MapperOptions,
    rigs: Rigs = NO_RIGS,
    seed: int = 0,
    progress: Progress | None = None,
    restart: bool = False,
    adjustment: GlobalAdjustment | None = None,
    superseded: Sequence[str] = (),
    deferred: bool = False,
) -> ReconstructionSummary:
    """Reconstruct photos.

    Writes ``database.db``, the models ``sparse/0`` (the largest), ``sparse/1``, ..., ``mapper.log``
    and ``reconstruct.json`` to ``output_path``, once all of them are complete. Steps that an earlier run into the same
    folder did with the same photos (by their content) and options are taken over, and so are the features and matches
    that an interrupted one had found, and its newest snapshot of the mapping. Where only some photos are other ones, so
    are the features of those that are the same, and the matches of pairs of them.

    Args:
        image_path: folder of the photos.
        image_names: the keyframes, relative to it, in time order.
        output_path: made if it does not exist.
        camera: which photos share one, and what is known of it.
        rigs: that cameras are on.
        seed: the same one gives the same models.
        restart: take nothing over.
        adjustment: takes the place of COLMAP's global bundle adjustment while the map grows, photo by photo.
        superseded: names of what was made from the earlier models, in the output folder; it goes with them.
        deferred: leave the earlier reconstruction in its place until a result is published (``OutputFolder.defer``).

    Raises:
        InputError: options that COLMAP does not take, a folder that cannot be written to, or files in the places of
            the results that this tool did not write.
        ReconstructionError: the photos cannot be read, or do not give a model.
        KeyboardInterrupt: as soon as COLMAP has stopped.
    """
    pipeline_options(camera, mapper, seed)  # what COLMAP does not take is refused before anything is computed
    progress = progress or SilentProgress()
    with (
        sole_writer(Path(output_path)) as output,
        UnpublishedReconstruction(output, progress, restart=restart) as unpublished,
    ):
        space = unpublished.space
        photos, inputs = match_photos(Path(image_path), image_names, camera, mapper, rigs, seed, space)
        _map(space, photos, inputs, camera, mapper, rigs, seed, adjustment)
        found, log_path = read_models(unpublished.models_path), output.path / LOG_NAME
        files = unpublished.files()
        if files and deferred:
            output.defer(files)
            log_path = space.log
        else:
            if files:
                output.publish(files, [output.path / name for name in superseded])
            unpublished.discard()
    if len(found) > 1:
        sizes = ", ".join(str(model.num_reg_images()) for model in found)
        progress.message(f"{len(found)} separate models of {sizes} photos")
    return ReconstructionSummary(found, len(image_names), found[0].num_reg_images(), space.steps.seconds, log_path)


def _map(
    space: Workspace,
    photos: Photos,
    of_matches: str,
    camera: CameraOptions,
    mapper: MapperOptions,
    rigs: Rigs,
    seed: int,
    adjustment: GlobalAdjustment | None,
) -> None:
    """Write the models of the matches, whose fingerprint is given, into the workspace."""
    intrinsics = [table.intrinsics_in_mapping for table in camera.tables]
    of_adjustment = [] if adjustment is None else [adjustment.inputs]
    inputs = fingerprint(of_matches, mapper.method, mapper.pipeline, *intrinsics, *of_adjustment)
    with space.logged():
        if not all(rigs.are_known):
            space.steps.run(
                "rigs",
                inputs,
                space.database,
                lambda: rigs.apply(space.database),
                lambda: _place_cameras(
                    space, photos, rigs, mapping_options(camera, mapper, NO_RIGS, seed, space.database)
                ),
            )
        space.steps.run(
            "mapping",
            inputs,
            space.models / "0",
            space.remove_old_models,
            lambda: map_photos(space, photos, mapping_options(camera, mapper, rigs, seed, space.database), adjustment),
            unfinished=space.snapshots,
        )


def _place_cameras(space: Workspace, photos: Photos, rigs: Rigs, options: MappingOptions) -> None:
    """Map the photos as if there were no rigs, and enter in the database where their cameras sit in that model.

    Places that are known say what its unit is, so that all go together.

    Raises:
        ReconstructionError: there is no model, or a camera of a rig is not in it together with its reference camera.
    """
    with scratch_folder(space.output / "rigs") as folder:
        without_rigs = Workspace(folder, space.progress, log=space.log)
        shutil.copyfile(space.database, without_rigs.database)
        with pycolmap.Database.open(without_rigs.database) as database:
            pycolmap.apply_rig_config([], database)
        map_photos(without_rigs, photos, options)
        model = read_models(without_rigs.models)[0]
    rigs.rescale(model)
    why_not = (
        "without the rig no photos of its cameras that were taken at once come into one model: say in"
        f" {rigs.path} where they sit (cam_from_rig)"
    )
    try:
        rigs.apply(space.database, model)
    except InputError as error:  # there are frames of which it has no other camera's photo
        raise ReconstructionError(why_not) from error
    with pycolmap.Database.open(space.database) as database:
        if any(pose is None for rig in database.read_all_rigs() for pose in rig.non_ref_sensors.values()):
            raise ReconstructionError(why_not)


def match_photos(
    image_path: Path,
    image_names: Sequence[str],
    camera: CameraOptions,
    mapper: MapperOptions,
    rigs: Rigs,
    seed: int,
    space: Workspace,
) -> tuple[Photos, str]:
    """Features and matches of photos, returned by their ids 1, 2, ..., with the matches' fingerprint.

    Arguments and errors as of ``reconstruct``.
    """
    check_camera(camera)
    for_features = feature_options(mapper)
    for_matching = matching_options(mapper, len(image_names), seed)
    if for_features.use_gpu:
        space.progress.message("features and matching: on the GPU")
    photos = usable_photos(image_path, image_names)
    cameras = cameras_of_photos(camera, photos, rigs)
    masks = contents_of_masks(mapper.mask_path, photos)
    if photos.left_out:
        name, reason = next(iter(photos.left_out.items()))
        num, num_all = len(photos.left_out), len(photos.left_out) + len(photos.names)
        space.progress.message(f"{num} of {num_all} photos are left out; the first, {name}, {reason}")
    with opened(mapper.database_path, photos, space.output) as given:
        if given is not None:
            space.progress.message(given.note)
            photos = given.photos
            is_open = all(table.model is None for table in camera.tables)
            cameras = given.cameras() if is_open else cameras_of_photos(camera, photos, rigs)
        if cameras.guessed:
            space.progress.message(
                f"the camera's parameters are of photos of another shape than {cameras.guessed[0]}: COLMAP guesses its"
                f" camera ({len(cameras.guessed)} of {len(cameras.cameras)} cameras)"
            )
        renewed = RenewedDatabase(space, photos, cameras, rigs, given, mapper, masks, for_features, for_matching)
        with space.logged():
            return photos, renewed.fill()
