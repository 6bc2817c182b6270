"""Photos to an unscaled COLMAP model: features, matching, incremental mapping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import pycolmap

from rangesfm.errors import ReconstructionError
from rangesfm.options import CameraOptions, MapperOptions
from rangesfm.progress import Progress, SilentProgress
from rangesfm.vision.mapping import map_incrementally, pipeline_options, read_models, write_models
from rangesfm.vision.mapping_loop import GlobalAdjustment
from rangesfm.vision.matched_photos import MatchedPhotos, Workspace, match_photos
from rangesfm.vision.steps import fingerprint
from rangesfm.vision.submap_joining import join_submaps
from rangesfm.vision.submap_processes import map_submaps
from rangesfm.vision.submap_refinement import refine_joined
from rangesfm.vision.submaps import Submap, check_submap_options, plan_submaps


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

    With ``mapper.submap_size``, stretches of so many photos are mapped in ``submaps``, each by a process of its own,
    and joined by the photos that they share; those that cannot be are separate models. An earlier run's submaps of the
    same photos are taken over.

    Args:
        image_path: folder of the photos.
        image_names: the keyframes, relative to it, in time order.
        output_path: made if it does not exist.
        camera: of all photos; photos of another size are left out.
        seed: the same one gives the same models.
        restart: take nothing over.
        before_change: called before models of an earlier run are removed or replaced.
        adjustment: takes the place of COLMAP's global bundle adjustment while the map grows; not in submaps.

    Raises:
        InputError: options that COLMAP does not take, or a folder that cannot be written to.
        ReconstructionError: the photos cannot be read, or do not give a model.
        KeyboardInterrupt: as soon as COLMAP has stopped.
    """
    progress = progress or SilentProgress()
    space = Workspace(Path(output_path), progress, before_change)
    mapping = _Mapping(camera, mapper, seed, space, adjustment)
    matched = mapping.match(Path(image_path), image_names, restart=restart)
    mapping.map(matched)
    found = read_models(space.models)
    _say_separate(found, progress)
    return ReconstructionSummary(found, len(image_names), found[0].num_reg_images(), space.steps.seconds, space.log)


def prepare_submaps(
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
) -> tuple[Submap, ...]:
    """What ``reconstruct`` does before it maps, for those who map submaps elsewhere: it takes over all that are mapped.

    Arguments and errors as of ``reconstruct``.

    Returns:
        The submaps that are still to be mapped (``Submap.map``), each independent of the others; none where the photos
        are mapped in one piece.
    """
    space = Workspace(Path(output_path), progress or SilentProgress(), before_change)
    mapping = _Mapping(camera, mapper, seed, space)
    matched = mapping.match(Path(image_path), image_names, restart=restart)
    if mapping.is_done(matched) or not mapping.is_in_submaps(matched):
        return ()
    return tuple(submap for submap in mapping.submaps(matched) if not submap.is_mapped)


@dataclass(frozen=True)
class _Mapping:
    """Step 3: of matched photos, in one piece or in submaps."""

    camera: CameraOptions
    mapper: MapperOptions
    seed: int
    space: Workspace
    adjustment: GlobalAdjustment | None = None

    def match(self, image_path: Path, image_names: Sequence[str], *, restart: bool) -> MatchedPhotos:
        """Steps 1 and 2; all options are looked at before."""
        self._options()
        check_submap_options(self.mapper)
        return match_photos(image_path, image_names, self.camera, self.mapper, self.seed, self.space, restart=restart)

    def map(self, matched: MatchedPhotos) -> None:
        """Write the models, unless an earlier run has done so with the same inputs."""
        in_submaps = self.is_in_submaps(matched)
        with self.space.logged():
            self.space.steps.run(
                "mapping",
                self._inputs(matched),
                self._output,
                self.space.remove_old_models,
                lambda: self._in_submaps(matched) if in_submaps else self._in_one_piece(matched),
                unfinished=self.space.submaps if in_submaps else self.space.snapshots,
            )

    def is_done(self, matched: MatchedPhotos) -> bool:
        return self.space.steps.is_done("mapping", self._inputs(matched), self._output)

    def is_in_submaps(self, matched: MatchedPhotos) -> bool:
        return self.mapper.submap_size is not None and self.mapper.submap_size < len(matched.photos.names)

    def submaps(self, matched: MatchedPhotos) -> tuple[Submap, ...]:
        space = self.space
        return plan_submaps(matched, space.database, space.submaps, self.camera, self.mapper, self.seed)

    @property
    def _output(self) -> Path:
        return self.space.models / "0"

    def _options(self) -> pycolmap.IncrementalPipelineOptions:
        return pipeline_options(self.camera, self.mapper, self.seed)

    def _inputs(self, matched: MatchedPhotos) -> str:
        inputs = [matched.inputs, self.mapper.pipeline, self.camera.mapping_refines_intrinsics]
        if self.adjustment is not None:
            inputs.append(self.adjustment.inputs)
        if self.is_in_submaps(matched):
            inputs += [self.mapper.submap_size, self.mapper.submap_overlap]
        return fingerprint(*inputs)

    def _in_one_piece(self, matched: MatchedPhotos) -> None:
        space = self.space
        map_incrementally(
            space.database,
            matched.photos,
            space.models,
            space.snapshots,
            self._options(),
            space.progress,
            self.adjustment,
        )

    def _in_submaps(self, matched: MatchedPhotos) -> None:
        space, submaps = self.space, self.submaps(matched)
        space.progress.message(f"mapping: {len(submaps)} submaps of {len(submaps[0].photos.names)} photos")
        map_submaps(submaps, self.mapper.num_submaps_at_once, space.progress)
        models = join_submaps([model for submap in submaps for model in submap.models()], self.seed)
        if not models:
            raise ReconstructionError(f"no model from any of {len(submaps)} submaps")
        refine_joined(space.database, matched.photos.folder, models, self._options(), space.progress)
        write_models(models, space.models)


def _say_separate(models: tuple[pycolmap.Reconstruction, ...], progress: Progress) -> None:
    if len(models) > 1:
        sizes = ", ".join(str(model.num_reg_images()) for model in models)
        progress.message(f"{len(models)} separate models of {sizes} photos")
