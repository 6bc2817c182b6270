"""Steps 1 and 2 in COLMAP's database; when photos or options change, the parts that are still valid are kept."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import pycolmap

from rangesfm.files.atomic import new_file
from rangesfm.options import MapperOptions
from rangesfm.vision.camera import PhotoCameras
from rangesfm.vision.database import (
    clear_matches,
    copy_features,
    copy_matches,
    copying,
    create_database,
    name_photos,
    remove_database,
    write_position_priors,
)
from rangesfm.vision.features import extract_features
from rangesfm.vision.given_database import GivenDatabase
from rangesfm.vision.loop_database import forget_loops
from rangesfm.vision.matching import MatchingOptions, match_features, verify_matches
from rangesfm.vision.pairs import pairs_to_match
from rangesfm.vision.photo_files import Photos, exif_position
from rangesfm.vision.rigs import Rigs
from rangesfm.vision.steps import Workspace, fingerprint

_NOTE = "database"


@dataclass(frozen=True)
class RenewedDatabase:
    """The database of a reconstruction, with a note in the record of its steps that says what it was made from.

    If the process is killed at any moment, the note is either true or missing. Without a note nothing of the database
    is used.

    Attributes:
        photos: in the order of their ids.
        given: the user's database, whose features replace all that an earlier run has found.
        masks: SHA-256 of each photo's mask, by the photo's name.
    """

    space: Workspace
    photos: Photos
    cameras: PhotoCameras
    rigs: Rigs
    given: GivenDatabase | None
    mapper: MapperOptions
    masks: Mapping[str, str]
    features: pycolmap.FeatureExtractionOptions
    matching: MatchingOptions

    @cached_property
    def contents(self) -> dict[str, str]:
        """SHA-256 of each photo, by name."""
        steps = self.space.steps
        steps.note("photos", self.photos.contents(steps.notes.get("photos", {})))
        return {name: sha256 for name, (_, sha256) in steps.notes["photos"].items()}

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

    def fill(self, log_folder: Path) -> str:
        """Find the features and matches that no earlier run has found; return the fingerprint of all they depend on."""
        database, photos, steps = self.space.database, self.photos, self.space.steps
        contents = list(self.contents.items())
        inputs = fingerprint(self.feature_inputs, self.cameras.inputs, contents, *self.rigs.inputs)
        progress, masks = self.space.progress, self.mapper.mask_path
        find = partial(extract_features, database, photos, self.features, log_folder, progress, masks)
        steps.run("features", inputs, database, self._begin, find)
        inputs = fingerprint(inputs, self.match_inputs)
        steps.run("matching", inputs, database, self._begin_matching, partial(self._match, log_folder))
        return inputs

    def _begin(self) -> None:
        """Replace the earlier database by a new one, with the earlier features and matches of unchanged photos."""
        space = self.space
        space.remove_old_models()
        space.log.unlink(missing_ok=True)
        earlier = space.steps.notes.get(_NOTE, {})
        space.steps.note(_NOTE, {})  # until the new note is written, nothing is taken over from the database
        with new_file(space.database) as fresh:
            self._create(fresh)
            if self.given is not None:
                self.given.copy_to(fresh)
            elif num_taken := self._take_over(earlier, fresh):
                space.progress.message(f"features: those of {num_taken} photos are taken over from an earlier run")
            # SQLite would take files that it kept beside the old database for parts of the new one.
            remove_database(space.database)
        forget_loops(space.steps)
        self._write_note()

    def _begin_matching(self) -> None:
        """Forget the matches, unless they were made with the same options."""
        self.space.remove_old_models()
        # A process that was killed may have left the photos under the temporary names that sequential matching needs.
        name_photos(self.space.database, self.photos.names)
        forget_loops(self.space.steps, self.space.database)
        if self.space.steps.notes.get(_NOTE, {}).get("matches") != self.match_inputs:
            clear_matches(self.space.database)
        self._write_note()

    def _match(self, log_folder: Path) -> None:
        database, progress = self.space.database, self.space.progress
        if self.has_matches:
            verify_matches(database, self.photos, self.matching, progress)
        else:
            match_features(database, self.photos, self.matching, log_folder, progress)

    def _create(self, path: Path) -> None:
        create_database(path, self.photos.names, self.cameras.cameras, self.cameras.of_photo)
        self.rigs.apply(path)
        write_position_priors(path, (exif_position(self.photos.folder / name) for name in self.photos.names))

    def _take_over(self, earlier: Mapping[str, Any], fresh: Path) -> int:
        """Copy features and matches of unchanged photos; return the number of photos with features."""
        ids, path = self._earlier_ids(earlier), self.space.database
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
        contents = enumerate(((name, self.contents[name]) for name in self.photos.names), 1)
        return {new_id: ids[content] for new_id, content in contents if content in ids}

    def _write_note(self) -> None:
        note = {"features": self.feature_inputs, "matches": self.match_inputs, "photos": self.contents}
        self.space.steps.note(_NOTE, note)
