"""COLMAP's database begun anew where photos or options are other ones; what still holds of an earlier one stays."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rangesfm.files.atomic import new_file
from rangesfm.progress import Progress
from rangesfm.vision.camera import PhotoCameras
from rangesfm.vision.database import (
    clear_matches,
    copy_features,
    copy_matches,
    copying,
    create_database,
    name_photos,
    remove_database,
    write_positions,
)
from rangesfm.vision.given_database import GivenDatabase
from rangesfm.vision.matching import MatchingOptions
from rangesfm.vision.pairs import pairs_to_match
from rangesfm.vision.photos import Photos, exif_position
from rangesfm.vision.rigs import Rigs
from rangesfm.vision.steps import Steps

_NOTE = "database"


@dataclass(frozen=True)
class RenewedDatabase:
    """The database of a reconstruction, with a note in the record of its steps of what it was made from.

    Killed at any moment, it leaves a note that is true or none; without one nothing of the database is used.

    Attributes:
        photos: in the order of their ids. contents: SHA-256 of each, by name.
        given: the user's database, whose features take the place of all that an earlier run has found.
        feature_inputs: fingerprint of what features depend on beside the photo itself.
        match_inputs: likewise, of matches beside the two photos.
    """

    path: Path
    photos: Photos
    contents: Mapping[str, str]
    cameras: PhotoCameras
    rigs: Rigs
    given: GivenDatabase | None
    matching: MatchingOptions
    feature_inputs: str
    match_inputs: str
    steps: Steps

    def begin(self, progress: Progress) -> None:
        """Put a new database in the place of the earlier one, with what that has of the same photos."""
        earlier = self.steps.notes.get(_NOTE, {})
        forget_database(self.steps)
        with new_file(self.path) as fresh:
            self._create(fresh)
            if self.given is not None:
                self.given.copy_to(fresh)
            elif num_taken := self._take_over(earlier, fresh):
                progress.message(f"features: those of {num_taken} photos are taken over from an earlier run")
            remove_database(self.path)  # also what SQLite keeps beside it, which would be taken for the new one's
        self._write_note()

    def begin_matching(self) -> None:
        """Forget the matches, unless they were made with the same options."""
        # In the place of those under which a process that was killed may have been matching.
        name_photos(self.path, self.photos.names)
        if self.steps.notes.get(_NOTE, {}).get("matches") != self.match_inputs:
            clear_matches(self.path)
        self._write_note()

    def _create(self, path: Path) -> None:
        create_database(path, self.photos.names, self.cameras.cameras, self.cameras.of_photo)
        self.rigs.apply(path)
        write_positions(path, (exif_position(self.photos.folder / name) for name in self.photos.names))

    def _take_over(self, earlier: Mapping[str, Any], fresh: Path) -> int:
        """Returns of how many photos there were features."""
        ids = self._earlier_ids(earlier)
        if not ids or not self.path.exists():
            return 0
        try:
            same_matches = self.matching.is_by_place and earlier.get("matches") == self.match_inputs
            pairs = pairs_to_match(fresh, self.photos, self.matching.pairing) if same_matches else []
            with copying(self.path, fresh) as (source, target):
                taken = {
                    new_id: old_id
                    for new_id, old_id in ids.items()
                    if source.exists_keypoints(old_id) and source.exists_descriptors(old_id)
                }
                copy_features(source, target, {old_id: new_id for new_id, old_id in taken.items()})
            of_pairs = (((taken.get(first, 0), taken.get(second, 0)), (first, second)) for first, second in pairs)
            # Not of photos that stood in the other order: COLMAP does not match two as it would the other way round.
            copy_matches(self.path, fresh, ((old, pair) for old, pair in of_pairs if 0 < old[0] < old[1]))
            return len(taken)
        except RuntimeError:  # somebody has damaged the earlier one
            self._create(fresh)
            return 0

    def _earlier_ids(self, earlier: Mapping[str, Any]) -> dict[int, int]:
        """Id in the earlier database of each photo that has not changed, by its new one."""
        if earlier.get("features") != self.feature_inputs:
            return {}
        ids = {(name, sha256): id_ for id_, (name, sha256) in enumerate(earlier.get("photos", {}).items(), 1)}
        contents = enumerate(((name, self.contents[name]) for name in self.photos.names), 1)
        return {new_id: ids[content] for new_id, content in contents if content in ids}

    def _write_note(self) -> None:
        note = {"features": self.feature_inputs, "matches": self.match_inputs, "photos": dict(self.contents)}
        self.steps.note(_NOTE, note)


def forget_database(steps: Steps) -> None:
    """Take nothing over from the database."""
    steps.note(_NOTE, {})
