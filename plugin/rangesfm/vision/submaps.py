"""Submaps: stretches of the photos in their order, each mapped on its own, so that the cost grows with their number.

Mapping one is a unit of work that stands alone: its folder holds all that it needs and all that it leaves.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import pycolmap

from rangesfm.colmap.log import colmap_log
from rangesfm.errors import OptionError
from rangesfm.files.atomic import new_file, sole_writer
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.progress import Progress, SilentProgress
from rangesfm.vision.database import copy_stretch, remove_database
from rangesfm.vision.mapping import NoModelError, map_incrementally, pipeline_options, read_models, remove_models
from rangesfm.vision.matched_photos import MatchedPhotos
from rangesfm.vision.photos import Photos
from rangesfm.vision.snapshots import remove_snapshots
from rangesfm.vision.steps import Steps, fingerprint

# These are of one mapping, and would be of all.
_OF_ONE_MAPPING = ("image_names", "init_image_id1", "init_image_id2", "snapshot_path", "snapshot_frames_freq")


@dataclass(frozen=True)
class Submap:
    """A stretch of the photos.

    Attributes:
        folder: for its database, its models and what it leaves.
        photos: in their order.
        camera, mapper, seed: as in ``reconstruct``.
        inputs: fingerprint of all that its models depend on.
    """

    folder: Path
    photos: Photos
    camera: CameraOptions
    mapper: MapperOptions
    seed: int
    inputs: str

    @property
    def database(self) -> Path:
        return self.folder / "database.db"

    @property
    def is_mapped(self) -> bool:
        return Steps(self._record, SilentProgress()).is_done("mapping", self.inputs, self._models)

    def with_threads(self, num_threads: int) -> Submap:
        """The same, mapped with so many threads."""
        return replace(self, mapper=self.mapper.model_copy(update={"num_threads": num_threads}))

    def models(self) -> tuple[pycolmap.Reconstruction, ...]:
        """Those that its photos gave, with the ids of the whole survey's database; there may be none."""
        return read_models(self._models)

    def map(self, progress: Progress) -> None:
        """Map it, if that is not done; an interrupted mapping goes on from its snapshot.

        Raises:
            InputError: another process is at it.
            ReconstructionError: COLMAP failed. It is none to find no model: nothing may be there to be seen.
        """
        with sole_writer(self.folder), colmap_log(self.folder / "mapper.log"):
            steps = Steps(self._record, progress)
            steps.run(
                "mapping", self.inputs, self._models, self._prepare, lambda: self._map(progress), unfinished=self._begun
            )
            remove_database(self.database)

    @property
    def _record(self) -> Path:
        return self.folder / "submap.json"

    @property
    def _models(self) -> Path:
        return self.folder / "sparse"

    @property
    def _begun(self) -> Path:
        return self.folder / "mapping_snapshot"

    def _prepare(self) -> None:
        remove_models(self._models)
        remove_snapshots(self._begun)

    def _map(self, progress: Progress) -> None:
        options = pipeline_options(self.camera, self.mapper, self.seed)
        options.extract_colors = False  # of photos that are in two submaps, and once is enough
        try:
            map_incrementally(self.database, self.photos, self._models, self._begun, options, progress)
        except NoModelError:
            self._models.mkdir()


def check_submap_options(mapper: MapperOptions) -> None:
    """Raises InputError for sizes that do not fit together, and options of pycolmap that fit no submap."""
    if mapper.submap_size is None:
        return
    if mapper.submap_overlap >= mapper.submap_size:
        found = f"[mapper] submap_overlap is {mapper.submap_overlap}"
        raise OptionError(
            f"{found}, expected 3 to {mapper.submap_size - 1} of a submap_size of {mapper.submap_size}",
            "mapper",
            "submap_overlap",
        )
    of_one_mapping = [key for key in _OF_ONE_MAPPING if key in mapper.pipeline]
    if mapper.ranges_in_mapping:
        of_one_mapping.append("ranges_in_mapping")
    for key in of_one_mapping:
        raise OptionError(f"[mapper] {key} is of one mapping, expected none beside submap_size", "mapper", key)


def submap_places(num_photos: int, size: int, overlap: int) -> list[range]:
    """The photos of each submap, by their place; the last has as many as the others, and so may overlap more."""
    starts = list(range(0, max(num_photos - size, 0) + 1, size - overlap))
    if starts[-1] + size < num_photos:
        starts.append(num_photos - size)
    return [range(start, min(start + size, num_photos)) for start in starts]


def plan_submaps(
    matched: MatchedPhotos, database: Path, folder: Path, camera: CameraOptions, mapper: MapperOptions, seed: int
) -> tuple[Submap, ...]:
    """The submaps of a survey, ready to be mapped, in folders of their own in ``folder``.

    One that an earlier run has mapped with the same photos, under the same ids, and options is mapped.
    """
    if mapper.submap_size is None:
        raise ValueError("a survey without a size of submaps has none")
    places = submap_places(len(matched.photos.names), mapper.submap_size, mapper.submap_overlap)
    of_all = [] if matched.only_by_place else [matched.inputs]
    options = [matched.match_inputs, mapper.pipeline, camera.mapping_refines_intrinsics, *of_all]
    submaps = []
    for number, stretch in enumerate(places):
        names = tuple(matched.photos.names[place] for place in stretch)
        inputs = fingerprint(
            options, [(place, name, matched.contents[name]) for place, name in zip(stretch, names, strict=True)]
        )
        photos = replace(matched.photos, names=names, left_out={})
        submap = Submap(folder / f"{number:06d}", photos, camera, mapper, seed, inputs)
        if not submap.is_mapped:
            submap.folder.mkdir(parents=True, exist_ok=True)
            with new_file(submap.database) as fresh:
                copy_stretch(database, fresh, [place + 1 for place in stretch])
                remove_database(submap.database)  # also what SQLite left beside it when its process was killed
        submaps.append(submap)
    _remove_others(folder, len(submaps))
    return tuple(submaps)


def _remove_others(folder: Path, num_submaps: int) -> None:
    """Submaps of an earlier run that had more."""
    for path in folder.iterdir():
        if path.name.isdecimal() and int(path.name) >= num_submaps:
            shutil.rmtree(path, ignore_errors=True)
