"""Photos to an unscaled COLMAP model: features, matching, mapping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.progress import Progress, SilentProgress
from rangesfm.vision.mapping import hold_cameras, map_photos, pipeline_options, read_models
from rangesfm.vision.mapping_loop import GlobalAdjustment
from rangesfm.vision.matched_photos import Workspace, match_photos
from rangesfm.vision.rig_places import hold_rigs, place_cameras
from rangesfm.vision.rigs import NO_RIGS, Rigs
from rangesfm.vision.steps import fingerprint


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
    before_change: Callable[[], None] = lambda: None,
    adjustment: GlobalAdjustment | None = None,
) -> ReconstructionSummary:
    """Reconstruct photos.

    Writes ``database.db``, the models ``sparse/0`` (the largest), ``sparse/1``, ..., ``mapper.log``
    and ``reconstruct.json`` to ``output_path``. Steps that an earlier run into the same folder did
    with the same photos (by their content) and options are taken over, and so are the features and matches that an
    interrupted one had found, and its newest snapshot of the mapping (``mapping_snapshot``). Where only some photos
    are other ones, so are the features of those that are the same, and the matches of pairs of them.

    Args:
        image_path: folder of the photos.
        image_names: the keyframes, relative to it, in time order.
        output_path: made if it does not exist.
        camera: which photos share one, and what is known of it.
        rigs: that cameras are on.
        seed: the same one gives the same models.
        restart: take nothing over.
        before_change: called before models of an earlier run are removed or replaced.
        adjustment: takes the place of COLMAP's global bundle adjustment while the map grows, photo by photo.

    Raises:
        InputError: options that COLMAP does not take, or a folder that cannot be written to.
        ReconstructionError: the photos cannot be read, or do not give a model.
        KeyboardInterrupt: as soon as COLMAP has stopped.
    """
    progress = progress or SilentProgress()
    space = Workspace(Path(output_path), progress, before_change)
    options = pipeline_options(camera, mapper, seed)
    matched = match_photos(Path(image_path), image_names, camera, mapper, rigs, seed, space, restart=restart)
    refines = [table.mapping_refines_intrinsics for table in camera.tables]
    inputs = [matched.inputs, mapper.method, mapper.pipeline, *refines]
    if adjustment is not None:
        inputs.append(adjustment.inputs)
    with space.logged():
        if not all(rigs.are_known):
            space.steps.run(
                "rigs",
                fingerprint(*inputs),
                space.database,
                lambda: rigs.apply(space.database),
                lambda: place_cameras(matched.photos, rigs, pipeline_options(camera, mapper, seed), space),
            )
        hold_cameras(options, camera, space.database)
        if "ba_refine_sensor_from_rig" not in mapper.pipeline:
            hold_rigs(options, rigs, space.database)
        space.steps.run(
            "mapping",
            fingerprint(*inputs),
            space.models / "0",
            space.remove_old_models,
            lambda: map_photos(
                space.database, matched.photos, space.models, space.snapshots, options, space.log, progress, adjustment
            ),
            unfinished=space.snapshots,
        )
    found = read_models(space.models)
    _say_separate(found, progress)
    return ReconstructionSummary(found, len(image_names), found[0].num_reg_images(), space.steps.seconds, space.log)


def _say_separate(models: tuple[pycolmap.Reconstruction, ...], progress: Progress) -> None:
    if len(models) > 1:
        sizes = ", ".join(str(model.num_reg_images()) for model in models)
        progress.message(f"{len(models)} separate models of {sizes} photos")
