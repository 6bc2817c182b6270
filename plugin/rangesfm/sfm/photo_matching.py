"""Steps 1 and 2, features and matches; when photos or options change, the parts that are still valid are kept."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pycolmap

from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.sfm.camera import PhotoCameras, cameras_of_photos, check_camera
from rangesfm.sfm.database import (
    clear_matches,
    copy_features,
    copy_matches,
    copying,
    create_database,
    name_photos,
    remove_database,
    write_position_priors,
)
from rangesfm.sfm.features import extract_features, feature_options
from rangesfm.sfm.given_database import GivenDatabase, opened
from rangesfm.sfm.loop_database import forget_loops
from rangesfm.sfm.matching import MatchingOptions, match_features, matching_options, verify_matches
from rangesfm.sfm.pairs import pairs_to_match
from rangesfm.sfm.photo_files import Photos, contents_of_masks, exif_position, usable_photos
from rangesfm.sfm.rigs import Rigs
from rangesfm.sfm.steps import Workspace, fingerprint
from rangesfm.sfm.unpublished import UnpublishedReconstruction
from rangesfm.util.files.atomic import new_file

_NOTE = "database"


@dataclass(frozen=True)
class PhotoMatching:
    """Photos whose features and matches are to be found, and all that these depend on.

    Attributes:
        photos: in the order of their ids.
        contents: state and SHA-256 of each photo, by name.
        given: the user's database, whose features replace all that an earlier run has found.
        masks: SHA-256 of each photo's mask, by the photo's name.
    """

    photos: Photos
    contents: Mapping[str, tuple[Any, str]]
    cameras: PhotoCameras
    rigs: Rigs
    given: GivenDatabase | None
    mapper: MapperOptions
    masks: Mapping[str, str]
    features: pycolmap.FeatureExtractionOptions
    matching: MatchingOptions

    @cached_property
    def hashes(self) -> dict[str, str]:
        """SHA-256 of each photo, by name."""
        return {name: sha256 for name, (_, sha256) in self.contents.items()}

    @cached_property
    def feature_inputs(self) -> str:
        """Fingerprint of what features depend on besides the photo itself."""
        sources = [self.mapper.features, *([self.masks] if self.masks else [])]
        on_gpu = ["GPU"] if self.features.use_gpu else []  # a GPU finds other features and other matches
        return fingerprint(pycolmap.__version__, *(sources if self.given is None else self.given.inputs), *on_gpu)

    @property
    def has_matches(self) -> bool:
        return self.given is not None and self.given.num_pairs > 0

    @cached_property
    def match_inputs(self) -> str:
        """Fingerprint of what matches depend on besides the two photos."""
        how = [self.matching.pairing_inputs, self.mapper.matcher, self.matching.seed]
        return fingerprint(self.feature_inputs, self.cameras.inputs, *([] if self.has_matches else how))

    @cached_property
    def plan(self) -> dict[str, str]:
        """Fingerprint of all that each step depends on."""
        contents = list(self.hashes.items())
        features = fingerprint(self.feature_inputs, self.cameras.inputs, contents, *self.rigs.inputs)
        return {"features": features, "matching": fingerprint(features, self.match_inputs)}

    def fill(self, space: Workspace) -> None:
        """Find the features and matches that no earlier run has found, in the database of a workspace."""
        space.run(
            "features",
            self.plan["features"],
            partial(self._begin, space),
            lambda: extract_features(space, self.photos, self.features, self.mapper.mask_path),
        )
        space.run(
            "matching",
            self.plan["matching"],
            partial(self._begin_matching, space),
            partial(self._match, space),
        )

    def _begin(self, space: Workspace) -> None:
        """Replace the earlier database by a new one, with the earlier features and matches of unchanged photos."""
        space.remove_old_models()
        space.log.unlink(missing_ok=True)
        space.note("photos", dict(self.contents))
        earlier = space.notes.get(_NOTE, {})
        space.note(_NOTE, {})  # until the new note is written, nothing is taken over from the database
        with new_file(space.database) as fresh:
            self._create(fresh)
            if self.given is not None:
                self.given.copy_to(fresh)
            elif num_taken := self._take_over(space.database, earlier, fresh):
                space.progress.message(f"features: those of {num_taken} photos are taken over from an earlier run")
            # SQLite would take files that it kept beside the old database for parts of the new one.
            remove_database(space.database)
        forget_loops(space)
        self._write_note(space)

    def _begin_matching(self, space: Workspace) -> None:
        """Forget the matches, unless they were made with the same options."""
        space.remove_old_models()
        # A process that was killed may have left the photos under the temporary names that sequential matching needs.
        name_photos(space.database, self.photos.names)
        forget_loops(space, with_matches=True)
        if space.notes.get(_NOTE, {}).get("matches") != self.match_inputs:
            clear_matches(space.database)
        self._write_note(space)

    def _match(self, space: Workspace) -> None:
        if self.has_matches:
            verify_matches(space, self.photos, self.matching)
        else:
            match_features(space, self.photos, self.matching)

    def _create(self, path: Path) -> None:
        create_database(path, self.photos.names, self.cameras.cameras, self.cameras.of_photo)
        self.rigs.apply(path)
        write_position_priors(path, (exif_position(self.photos.folder / name) for name in self.photos.names))

    def _take_over(self, path: Path, earlier: Mapping[str, Any], fresh: Path) -> int:
        """Copy features and matches of unchanged photos; return the number of photos with features."""
        ids = self._earlier_ids(earlier)
        if not ids or not path.exists():
            return 0
        try:
            same_matches = self.matching.is_by_place and earlier.get("matches") == self.match_inputs
            pairs = pairs_to_match(fresh, self.photos, self.matching.pairing) if same_matches else []
            with copying(path, fresh) as (source, target):
                taken = {
                    new_id: old_id
                    for new_id, old_id in ids.items()
                    if source.exists_keypoints(old_id) and source.exists_descriptors(old_id)
                }
                copy_features(source, target, {old_id: new_id for new_id, old_id in taken.items()})
            of_pairs = (((taken.get(first, 0), taken.get(second, 0)), (first, second)) for first, second in pairs)
            # A pair whose photos were in the other order is left out: COLMAP's matches depend on the order of the two.
            copy_matches(path, fresh, ((old, pair) for old, pair in of_pairs if 0 < old[0] < old[1]))
            return len(taken)
        except RuntimeError:  # the earlier database is damaged
            self._create(fresh)
            return 0

    def _earlier_ids(self, earlier: Mapping[str, Any]) -> dict[int, int]:
        """Return the id in the earlier database of each photo that has not changed, by its new id."""
        if earlier.get("features") != self.feature_inputs:
            return {}
        photos = earlier.get("photos")
        if not isinstance(photos, dict) or not all(isinstance(sha256, str) for sha256 in photos.values()):
            return {}
        ids = {content: id_ for id_, content in enumerate(photos.items(), 1)}
        contents = enumerate(((name, self.hashes[name]) for name in self.photos.names), 1)
        return {new_id: ids[content] for new_id, content in contents if content in ids}

    def _write_note(self, space: Workspace) -> None:
        """Note what the database was made from.

        If the process is killed at any moment, the note is either true or missing. Without a note nothing of the
        database is used.
        """
        space.note(_NOTE, {"features": self.feature_inputs, "matches": self.match_inputs, "photos": self.hashes})


@contextmanager
def photo_matching(
    image_path: Path,
    image_names: Sequence[str],
    camera: CameraOptions,
    mapper: MapperOptions,
    rigs: Rigs,
    seed: int,
    unpublished: UnpublishedReconstruction,
) -> Iterator[PhotoMatching]:
    """Read the photos, and for the block a given database; arguments and errors are those of ``reconstruct_in``."""
    progress = unpublished.progress
    check_camera(camera)
    for_features = feature_options(mapper)
    for_matching = matching_options(mapper, len(image_names), seed)
    if for_features.use_gpu:
        progress.message("features and matching: on the GPU")
    photos = usable_photos(image_path, image_names)
    cameras = cameras_of_photos(camera, photos, rigs)
    masks = {} if mapper.mask_path is None else contents_of_masks(mapper.mask_path, photos)
    if photos.left_out:
        name, reason = next(iter(photos.left_out.items()))
        num, num_all = len(photos.left_out), len(photos.left_out) + len(photos.names)
        progress.message(f"{num} of {num_all} photos are left out; the first, {name}, {reason}")
    path = mapper.database_path
    with nullcontext() if path is None else opened(path, photos, unpublished.folder) as given:
        if given is not None:
            progress.message(given.note)
            photos = given.photos
            is_open = not any(table.model for table in camera.tables)
            cameras = given.cameras() if is_open else cameras_of_photos(camera, photos, rigs)
        if cameras.guessed:
            progress.message(
                f"the camera's parameters belong to photos of another shape than {cameras.guessed[0]}: COLMAP guesses"
                f" its camera ({len(cameras.guessed)} of {len(cameras.cameras)} cameras)"
            )
        contents = photos.contents(unpublished.known("photos"))
        yield PhotoMatching(photos, contents, cameras, rigs, given, mapper, masks, for_features, for_matching)
