"""Matches of loops, in a copy of a reconstruction's database that takes its place once the result is complete.

The record of the reconstruction's steps notes these pairs, because a mapping that is done again starts without them.
"""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Collection
from pathlib import Path

import numpy as np
import pycolmap

from rangesfm.arrays import Indices
from rangesfm.colmap.colmap_log import colmap_log
from rangesfm.colmap.pieces import MIN_NUM_SHARED
from rangesfm.progress import Progress
from rangesfm.sfm.database import copy_database
from rangesfm.sfm.matching import MatchingOptions, match_pairs
from rangesfm.sfm.steps import DATABASE_NAME, RECORD_NAME, Workspace
from rangesfm.util.files.manifest import content_hash
from rangesfm.util.files.output_folder import OutputFolder, remove

Pair = tuple[int, int]
"""Ids of two photos, the smaller one first."""
_FOLDER_NAME, _SOURCE_NAME, _NOTE = "loops", "source.txt", "loops"
# Pairs that were tried as loops, pairs that tie models, and pairs whose loops are closed in the models themselves.
_LOOPS, _TIES, _CLOSED = "pairs", "ties", "closed"


def forget_loops(space: Workspace, *, with_matches: bool = False) -> None:
    """Remove the notes of loops from a reconstruction's record, and if asked for their matches from its database."""
    if noted := space.notes.get(_NOTE, {}):
        if with_matches:
            _forget(space.database, set[Pair]().union(*(_noted(space, kind) for kind in noted)))
        space.note(_NOTE, {})


def has_closed_loops(space: Workspace) -> bool:
    """Return whether the loops of a reconstruction's models were closed, as far as there are any."""
    return _CLOSED in space.notes.get(_NOTE, {})


def _noted(space: Workspace, kind: str) -> set[Pair]:
    return {(first, second) for first, second in space.notes.get(_NOTE, {}).get(kind, [])}


def _forget(path: Path, pairs: Collection[Pair]) -> None:
    with pycolmap.Database.open(path) as database, pycolmap.DatabaseTransaction(database):
        for pair in pairs:
            database.delete_matches(*pair)
            database.delete_two_view_geometry(*pair)


class LoopMatching(Workspace):
    """A copy of a database, in a folder of its own, in which pairs of photos are matched that may be loops.

    Its notes tell all pairs that were tried.

    Args:
        source: the database. An interrupted run may have copied the same one and added matches to it.
    """

    def __init__(self, source: Path, options: MatchingOptions, progress: Progress, output: OutputFolder):
        folder, record = output.private / _FOLDER_NAME, output.newest(output.path / RECORD_NAME)
        self.options = options
        self._output = output
        # Whether the database is that of a reconstruction in the output folder.
        self._has_record = record.is_file() and source == output.newest(output.path / DATABASE_NAME)
        if source.parent != folder:  # else this run has closed loops before, and closes them again
            made_from = f"{content_hash(source)} {content_hash(record) if self._has_record else ''}"
            mark = folder / _SOURCE_NAME
            if not (mark.is_file() and mark.read_text() == made_from and (folder / DATABASE_NAME).is_file()):
                remove(folder)
                folder.mkdir()
                copy_database(source, folder / DATABASE_NAME)
                if self._has_record:
                    shutil.copyfile(record, folder / RECORD_NAME)
                mark.write_text(made_from)
        super().__init__(folder, progress)

    def why_unfit(self, model: pycolmap.Reconstruction) -> str | None:
        """Return why the photos of a model cannot be matched by this database; None if they can."""
        with pycolmap.Database.open(self.database) as database:
            name_of = {image.image_id: image.name for image in database.read_all_images()}
            rig_of = {frame.frame_id: frame.rig_id for frame in database.read_all_frames()}
            for image_id in model.reg_image_ids():
                image = model.image(image_id)
                same_features = database.num_keypoints_for_image(image_id) == image.num_points2D()
                if name_of.get(image_id) != image.name or not same_features:
                    return f"{image.name} has other features in the model, expected the database it was made from"
                if rig_of.get(image.frame_id) != model.frame(image.frame_id).rig_id:
                    return f"{image.name} has another camera in the model, expected the database it was made from"
                if not database.exists_descriptors(image_id):
                    return f"{image.name} has no descriptors in the database"
        return None

    def known(self) -> dict[int, set[int]]:
        """Return the photos that each photo was matched with by the mapping or tied with, by its id."""
        known: dict[int, set[int]] = defaultdict(set)
        with pycolmap.Database.open(self.database) as database:
            pairs = {*map(pycolmap.pair_id_to_image_pair, database.read_num_matches()[0])}
        for first, second in pairs - _noted(self, _LOOPS):
            known[first].add(second)
            known[second].add(first)
        return known

    def match(self, pairs: list[Pair]) -> dict[Pair, Indices]:
        """Match pairs, and return the matches (m, 2) of those that are verified by a two-view geometry."""
        self._note_pairs(_LOOPS, {*_noted(self, _LOOPS), *pairs} - _noted(self, _TIES))
        with self.logged():
            match_pairs(self, pairs, self.options)
        verified: dict[Pair, Indices] = {}
        with pycolmap.Database.open(self.database) as database:
            for pair in pairs:
                matches = np.asarray(database.read_two_view_geometry(*pair).inlier_matches, dtype=np.int64)
                if len(matches) >= MIN_NUM_SHARED:
                    verified[pair] = matches
        return verified

    def merge_tracks(self, model: pycolmap.Reconstruction) -> None:
        """Merge and complete the tracks of a model by all matches, in place: points that two passes saw become one.

        Poses and cameras stay. The ids of photos and features are those of the database.
        """
        seed = self.options.seed
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed)
        options.triangulation.random_seed = options.mapper.random_seed = seed
        triangulation = options.get_triangulation()
        with colmap_log(self.log):
            with pycolmap.Database.open(self.database) as database:
                cache = pycolmap.DatabaseCache.create(database, pycolmap.DatabaseCacheOptions(load_all_images=True))
            mapper = pycolmap.IncrementalMapper(cache)
            mapper.begin_reconstruction(model)
            mapper.complete_and_merge_tracks(triangulation)
            mapper.retriangulate(triangulation)
            mapper.complete_and_merge_tracks(triangulation)
            mapper.observation_manager.filter_observations_with_negative_depth()
            mapper.filter_points(options.get_mapper())
            mapper.end_reconstruction(discard=False)
            model.update_point_3d_errors()

    def keep(self, proposed: Collection[Pair], verified: Collection[Pair], accepted: Collection[Pair]) -> None:
        """Forget the matches of all pairs that were tried as loops, except those that are accepted or do not match."""
        right = {*accepted, *(set(proposed) - set(verified))}
        _forget(self.database, _noted(self, _LOOPS) - right)
        self._note_pairs(_LOOPS, right)

    def keep_ties(self, proposed: Collection[Pair], accepted: Collection[Pair]) -> None:
        """Forget the matches of all pairs that were proposed as ties, now or before, except those that are accepted."""
        _forget(self.database, _noted(self, _TIES).union(proposed).difference(accepted))
        self._note_pairs(_LOOPS, _noted(self, _LOOPS).difference(proposed))
        self._note_pairs(_TIES, accepted)

    def keep_closed(self) -> None:
        """Let the pairs that were kept as loops belong to the models, which are to be published with the database."""
        (self.folder / _SOURCE_NAME).unlink()  # a run that is stopped before that must not go on with this copy
        self._note_pairs(_CLOSED, _noted(self, _LOOPS))
        self._note_pairs(_LOOPS, ())

    @property
    def places(self) -> dict[Path, Path]:
        """The database and the record that notes its loops, by the places in the output folder that they are to take.

        See ``OutputFolder.publish`` and ``OutputFolder.defer``.
        """
        names = (DATABASE_NAME, RECORD_NAME) if self._has_record else (DATABASE_NAME,)
        return {self._output.path / name: self.folder / name for name in names}

    def discard(self) -> None:
        """Remove the copy."""
        remove(self.folder)

    def _note_pairs(self, kind: str, pairs: Collection[Pair]) -> None:
        self.note(_NOTE, {**self.notes.get(_NOTE, {}), kind: sorted(pairs)})
