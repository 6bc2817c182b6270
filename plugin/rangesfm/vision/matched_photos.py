"""Steps 1 and 2: photos to features and matches in a database, taken over where an earlier run has done them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import pycolmap

from rangesfm.colmap.log import colmap_log
from rangesfm.errors import ReconstructionError
from rangesfm.files.atomic import make_output_folder
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.progress import Progress
from rangesfm.vision.camera import PhotoCameras, cameras_of_photos, check_camera
from rangesfm.vision.features import extract_features, feature_options
from rangesfm.vision.given_database import GivenDatabase, opened
from rangesfm.vision.matching import MatchingOptions, match_features, matching_options, verify_matches
from rangesfm.vision.photos import Photos, contents_of_masks, usable_photos
from rangesfm.vision.renewed_database import RenewedDatabase, forget_database
from rangesfm.vision.rigs import Rigs
from rangesfm.vision.steps import Steps, fingerprint


class Workspace:
    """The output folder of a reconstruction: what is where, and what of it an earlier run has done.

    Attributes:
        output: the folder, which ``begin`` makes.
        database, models, snapshots, log: in it.
        steps: the record of what is done.
        progress: who listens.
    """

    def __init__(self, output: Path, progress: Progress, before_change: Callable[[], None]):
        self.progress = progress
        self.output = output
        self.database = output / "database.db"
        self.models = output / "sparse"
        self.snapshots = output / "mapping_snapshot"
        self.log = output / "mapper.log"
        self.steps = Steps(output / "reconstruct.json", progress)
        self._before_change = before_change

    def begin(self, *, restart: bool) -> None:
        """Make the folder; with ``restart`` nothing of an earlier run is taken over."""
        make_output_folder(self.output)
        if restart:
            self.steps.forget("features")
            forget_database(self.steps)

    def remove_old_models(self) -> None:
        self._before_change()
        for folder in (self.models, self.snapshots):
            shutil.rmtree(folder, ignore_errors=True)

    @contextmanager
    def logged(self) -> Iterator[None]:
        """Have COLMAP's own words in the log, and say in a failure where they are."""
        with colmap_log(self.log):
            try:
                yield
            except ReconstructionError as error:
                raise ReconstructionError(f"{error} (COLMAP's log: {self.log})") from error


def match_photos(
    image_path: Path,
    image_names: Sequence[str],
    camera: CameraOptions,
    mapper: MapperOptions,
    rigs: Rigs,
    seed: int,
    space: Workspace,
    *,
    restart: bool,
) -> tuple[Photos, str]:
    """Features and matches of photos, returned by their ids 1, 2, ..., with the matches' fingerprint.

    Arguments and errors as of ``reconstruct``.
    """
    check_camera(camera)
    for_features = feature_options(mapper)
    for_matching = matching_options(mapper, len(image_names), seed)
    photos = usable_photos(image_path, image_names)
    cameras = cameras_of_photos(camera, photos, rigs)
    masks = contents_of_masks(mapper.mask_path, photos)
    space.begin(restart=restart)
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
        return _match(photos, cameras, rigs, given, masks, mapper, for_features, for_matching, space)


def _match(
    photos: Photos,
    cameras: PhotoCameras,
    rigs: Rigs,
    given: GivenDatabase | None,
    masks: dict[str, str],
    mapper: MapperOptions,
    for_features: pycolmap.FeatureExtractionOptions,
    for_matching: MatchingOptions,
    space: Workspace,
) -> tuple[Photos, str]:
    steps, progress, database = space.steps, space.progress, space.database
    has_matches = given is not None and given.num_pairs > 0

    def prepare_features() -> None:
        space.remove_old_models()
        space.log.unlink(missing_ok=True)
        renewed.begin(progress)

    def prepare_matching() -> None:
        space.remove_old_models()
        renewed.begin_matching()

    def match() -> None:
        if has_matches:
            verify_matches(database, photos, for_matching, progress)
        else:
            match_features(database, photos, for_matching, space.log, progress)

    with space.logged():
        steps.note("photos", photos.contents(steps.notes.get("photos", {})))
        contents = {name: sha256 for name, (_, sha256) in steps.notes["photos"].items()}
        sources = [mapper.features, *([masks] if masks else [])] if given is None else given.inputs
        of_features = fingerprint(pycolmap.__version__, *sources)
        how = [] if has_matches else [for_matching.pairing_inputs, mapper.matcher, for_matching.seed]
        of_matches = fingerprint(of_features, cameras.inputs, *how)
        renewed = RenewedDatabase(
            database, photos, contents, cameras, rigs, given, for_matching, of_features, of_matches, steps
        )
        inputs = fingerprint(of_features, cameras.inputs, list(contents.items()), *rigs.inputs)
        steps.run(
            "features",
            inputs,
            database,
            prepare_features,
            lambda: extract_features(database, photos, for_features, progress, mapper.mask_path),
        )
        inputs = fingerprint(inputs, of_matches)
        steps.run("matching", inputs, database, prepare_matching, match)
    return photos, inputs
