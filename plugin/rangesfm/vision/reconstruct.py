"""Photos to an unscaled COLMAP model: features, matching, incremental mapping."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pycolmap

from rangesfm.colmap_log import colmap_log
from rangesfm.errors import ReconstructionError
from rangesfm.files import make_output_folder
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.progress import Progress, SilentProgress
from rangesfm.vision.camera import camera_of_photos, check_camera
from rangesfm.vision.features import extract_features, feature_options
from rangesfm.vision.mapping import map_incrementally, pipeline_options, read_models, remove_models
from rangesfm.vision.mapping_loop import GlobalAdjustment, mapping_with
from rangesfm.vision.matching import match_features, matching_options
from rangesfm.vision.photos import Photos, usable_photos
from rangesfm.vision.renewed_database import RenewedDatabase, forget_database
from rangesfm.vision.snapshots import remove_snapshots
from rangesfm.vision.steps import Steps, fingerprint


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
    seed: int = 0,
    progress: Progress | None = None,
    restart: bool = False,
    before_change: Callable[[], None] = lambda: None,
    adjustment: GlobalAdjustment | None = None,
) -> ReconstructionSummary:
    """Reconstruct photos of one camera.

    Writes ``database.db``, the models ``sparse/0`` (the largest), ``sparse/1``, ..., ``mapper.log``
    and ``reconstruct.json`` to ``output_path``. Steps that an earlier run into the same folder did
    with the same photos (by their content) and options are taken over, and so are the features and matches that an
    interrupted one had found, and its newest snapshot of the mapping (``mapping_snapshot``). Where only some photos
    are other ones, so are the features of those that are the same, and the matches of pairs of them.

    Args:
        image_path: folder of the photos.
        image_names: the keyframes, relative to it, in time order.
        output_path: made if it does not exist.
        camera: of all photos; photos of another size are left out.
        seed: the same one gives the same models.
        restart: take nothing over.
        before_change: called before models of an earlier run are removed or replaced.
        adjustment: takes the place of COLMAP's global bundle adjustment while the map grows.

    Raises:
        InputError: options that COLMAP does not take, or a folder that cannot be written to.
        ReconstructionError: the photos cannot be read, or do not give a model.
        KeyboardInterrupt: as soon as COLMAP has stopped.
    """
    progress, output = progress or SilentProgress(), Path(output_path)
    check_camera(camera)
    for_features = feature_options(mapper)
    for_matching = matching_options(mapper, len(image_names), seed)
    for_mapping = pipeline_options(camera, mapper, seed)
    photos = usable_photos(Path(image_path), image_names)
    its_camera = camera_of_photos(camera, photos.folder / photos.names[0], photos.width, photos.height)
    _say_left_out(photos, progress)
    make_output_folder(output)

    database, models, log = output / "database.db", output / "sparse", output / "mapper.log"
    snapshots = output / "mapping_snapshot"
    steps = Steps(output / "reconstruct.json", progress)
    if restart:
        steps.forget("features")
        forget_database(steps)

    def remove_old_models() -> None:
        before_change()
        remove_models(models)
        remove_snapshots(snapshots)

    def prepare_features() -> None:
        remove_old_models()
        log.unlink(missing_ok=True)
        renewed.begin(progress)

    def prepare_matching() -> None:
        remove_old_models()
        renewed.begin_matching()

    with colmap_log(log), _pointing_to(log):
        steps.note("photos", photos.contents(steps.notes.get("photos", {})))
        contents = {name: sha256 for name, (_, sha256) in steps.notes["photos"].items()}
        of_features = fingerprint(pycolmap.__version__, mapper.features)
        of_matches = fingerprint(
            of_features, _plain(its_camera), for_matching.is_sequential, mapper.pairing, mapper.matcher, seed
        )
        renewed = RenewedDatabase(database, photos, contents, its_camera, for_matching, of_features, of_matches, steps)
        inputs = fingerprint(of_features, _plain(its_camera), list(contents.items()))
        steps.run(
            "features",
            inputs,
            database,
            prepare_features,
            lambda: extract_features(database, photos, for_features, progress),
        )
        inputs = fingerprint(inputs, of_matches)
        steps.run(
            "matching",
            inputs,
            database,
            prepare_matching,
            lambda: match_features(database, photos, for_matching, progress),
        )
        own = () if adjustment is None else (adjustment.inputs,)
        inputs = fingerprint(inputs, mapper.pipeline, camera.mapping_refines_intrinsics, *own)
        steps.run(
            "mapping",
            inputs,
            models / "0",
            remove_old_models,
            lambda: map_incrementally(
                database, photos, models, snapshots, for_mapping, progress, mapping_with(adjustment)
            ),
            unfinished=snapshots,
        )
    found = read_models(models)
    _say_separate(found, progress)
    return ReconstructionSummary(found, len(image_names), found[0].num_reg_images(), steps.seconds, log)


def _plain(camera: pycolmap.Camera) -> list[Any]:
    return [camera.model_name, camera.params.tolist(), camera.width, camera.height, camera.has_prior_focal_length]


@contextmanager
def _pointing_to(log: Path) -> Iterator[None]:
    """Say in a failure where COLMAP's own words are."""
    try:
        yield
    except ReconstructionError as error:
        raise ReconstructionError(f"{error} (COLMAP's log: {log})") from error


def _say_left_out(photos: Photos, progress: Progress) -> None:
    if photos.left_out:
        name, reason = next(iter(photos.left_out.items()))
        num = len(photos.left_out)
        progress.message(f"{num} of {num + len(photos.names)} photos are left out; the first, {name}, {reason}")


def _say_separate(models: tuple[pycolmap.Reconstruction, ...], progress: Progress) -> None:
    if len(models) > 1:
        sizes = ", ".join(str(model.num_reg_images()) for model in models)
        progress.message(f"{len(models)} separate models of {sizes} photos")
