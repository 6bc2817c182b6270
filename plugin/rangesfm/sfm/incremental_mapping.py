"""COLMAP's incremental mapping, which goes on after any photo much as if it had not been interrupted.

It goes on from its newest snapshot. It has forgotten only which photos and points COLMAP has tried in vain, and tries
them again.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TypeAlias

import pycolmap

from rangesfm.colmap.model_files import read_model
from rangesfm.errors import InputError
from rangesfm.util.files.contents import open_regular
from rangesfm.util.files.records import write_json

# Rounds of lower demands on the initial pair, as in COLMAP.
_NUM_RELAXATIONS = 2
# The last adjustment ends when the cost decreases by less than this fraction, which is Ceres' default.
_WHOLE_FUNCTION_TOLERANCE = 1e-6


class _StoppedError(Exception):
    """Raised in a callback to stop COLMAP's mapping, whose parts watch neither a cancellation nor the time."""


Size: TypeAlias = tuple[int, int]
"""Size of a model: numbers of its registered frames and of its points."""


def size_of(model: pycolmap.Reconstruction) -> Size:
    """Return the size of a model."""
    return model.num_reg_frames(), model.num_points3D()


@dataclass(frozen=True)
class UnfinishedMapping:
    """All that a mapping needs to go on.

    Attributes:
        finished: the models that are done. growing: the model to which photos are being added.
        size_at_adjustment: of the growing model when it was last adjusted as a whole.
    """

    finished: tuple[pycolmap.Reconstruction, ...]
    growing: pycolmap.Reconstruction
    size_at_adjustment: Size

    @property
    def models(self) -> tuple[pycolmap.Reconstruction, ...]:
        return (*self.finished, self.growing)


def incremental_mapping(
    database_path: Path,
    image_path: Path,
    *,
    options: pycolmap.IncrementalPipelineOptions,
    unfinished: UnfinishedMapping | None = None,
    callback: Callable[[UnfinishedMapping], object] = lambda unfinished: None,
    cancellation_token: pycolmap.CancellationToken | None = None,
) -> list[pycolmap.Reconstruction]:
    """Run the incremental mapping and return all models, in the order in which they were begun.

    COLMAP's parts do not release Python's global lock, so that other threads run only during the callbacks.

    Args:
        callback: called when a model has its initial pair or is continued, and after each further photo.
        cancellation_token: ends the mapping after the current photo, as does ``options.max_runtime_seconds``.
    """
    options.image_path = image_path
    manager = pycolmap.ReconstructionManager()
    finished = () if unfinished is None else unfinished.finished
    with pycolmap.Database.open(database_path) as database:
        pipeline = pycolmap.IncrementalPipeline(options, database, manager)
    token, begin_s = cancellation_token or pycolmap.CancellationToken(), time.monotonic()
    adjustments = _WholeAdjustments(pipeline)
    left = [] if unfinished is None else [unfinished]

    def models() -> list[pycolmap.Reconstruction]:
        return [*finished, *(manager.get(index) for index in range(manager.size()))]

    def call(note: Callable[[pycolmap.Reconstruction], object]) -> None:
        *done, growing = models()
        note(growing)
        callback(UnfinishedMapping(tuple(done), growing, adjustments.size_at_last))
        if token.is_cancelled or 0 < options.max_runtime_seconds <= time.monotonic() - begin_s:
            raise _StoppedError

    def begin(growing: pycolmap.Reconstruction) -> None:
        adjustments.begin(growing, left.pop().size_at_adjustment if left else size_of(growing))

    whens = pycolmap.IncrementalPipelineCallback
    pipeline.add_callback(whens.INITIAL_IMAGE_PAIR_REG_CALLBACK, partial(call, begin))
    pipeline.add_callback(whens.NEXT_IMAGE_REG_CALLBACK, partial(call, adjustments.add_photo))
    if pipeline.database_cache.num_images():
        mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
        if unfinished is not None:
            for model in finished:  # so that COLMAP knows which photos they have
                mapper.begin_reconstruction(model)
                mapper.end_reconstruction(discard=False)
            with TemporaryDirectory() as folder:  # a manager only takes a model from the disk
                unfinished.growing.write_binary(folder)
                manager.read(folder)
        _map_with_relaxed_demands(pipeline, mapper)
    return models()


class _WholeAdjustments:
    """Keeper of the size at which a growing model was last adjusted as a whole.

    COLMAP does that each time the model has grown by a given share since the last time. It begins to count at the size
    at which it begins to map. So the first adjustment of a continued model is made due at the size at which it would
    have been without the interruption.

    Args:
        pipeline: reads its options again after each photo.
    """

    def __init__(self, pipeline: pycolmap.IncrementalPipeline):
        self._pipeline = pipeline
        options = pipeline.options
        self._ratios = options.ba_global_frames_ratio, options.ba_global_points_ratio
        self._steps = options.ba_global_frames_freq, options.ba_global_points_freq
        self._counted_from: Size = (0, 0)
        self.size_at_last: Size = (0, 0)

    def begin(self, model: pycolmap.Reconstruction, size_at_last: Size) -> None:
        """Begin with a model, new or continued."""
        self.size_at_last = last = size_at_last
        self._counted_from = now = size_of(model)
        if now == last:
            self._count(self._ratios, self._steps)
            return
        of_frames, of_points = self._ratios
        # Half a frame less, so that rounding does not matter.
        ratios = (math.ceil(of_frames * last[0]) - 0.5) / now[0], (math.ceil(of_points * last[1]) - 0.5) / now[1]
        self._count(ratios, (self._steps[0] + last[0] - now[0], self._steps[1] + last[1] - now[1]))

    def add_photo(self, model: pycolmap.Reconstruction) -> None:
        """Note whether the model has been adjusted, by COLMAP's rule."""
        if self._pipeline.check_run_global_refinement(model, *self._counted_from):
            self.size_at_last = self._counted_from = size_of(model)
            self._count(self._ratios, self._steps)

    def _count(self, ratios: tuple[float, float], steps: tuple[int, int]) -> None:
        options = self._pipeline.options
        options.ba_global_frames_ratio, options.ba_global_points_ratio = ratios
        options.ba_global_frames_freq, options.ba_global_points_freq = steps


def adjust_whole(
    database_path: Path, model: pycolmap.Reconstruction, *, options: pycolmap.IncrementalPipelineOptions
) -> None:
    """Adjust a whole model of this database once more, in place, as the mapping does at its end, until it converges.

    COLMAP's gradient tolerance stops an adjustment too early where few photos determine the focal length: with six
    photos it would stay 10 % off.
    """
    with pycolmap.Database.open(database_path) as database:
        pipeline = pycolmap.IncrementalPipeline(options, database, pycolmap.ReconstructionManager())
    mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
    mapper.begin_reconstruction(model)
    to_the_end = options.get_global_bundle_adjustment()
    solver = to_the_end.ceres.solver_options
    solver.function_tolerance, solver.gradient_tolerance = _WHOLE_FUNCTION_TOLERANCE, 0.0
    to_the_end.ceres.solver_options = solver
    of_mapper, rounds = options.get_mapper(), options.ba_global_max_refinements
    mapper.iterative_global_refinement(
        rounds, options.ba_global_max_refinement_change, of_mapper, to_the_end, options.get_triangulation()
    )
    mapper.filter_frames(of_mapper)
    pycolmap.align_reconstruction_to_orig_rig_scales(pipeline.database_cache.rigs, model)
    model.update_point_3d_errors()
    mapper.end_reconstruction(discard=False)


def _map_with_relaxed_demands(pipeline: pycolmap.IncrementalPipeline, mapper: pycolmap.IncrementalMapper) -> None:
    """Map until nothing is left to register, lowering the demands on the initial pair step by step."""
    goes_on = pipeline.reconstruction_manager.size() > 0
    for options in _relaxed(pipeline.options.get_mapper(), mapper):
        try:
            status = pipeline.reconstruct(mapper, options, goes_on)
        except _StoppedError:
            mapper.reconstruction.update_point_3d_errors()
            mapper.end_reconstruction(discard=False)
            return
        goes_on = False
        is_done = status != pycolmap.IncrementalPipelineStatus.CONTINUE
        if is_done or mapper.num_total_reg_images() == pipeline.database_cache.num_images():
            return


def _relaxed(
    options: pycolmap.IncrementalMapperOptions, mapper: pycolmap.IncrementalMapper
) -> Iterator[pycolmap.IncrementalMapperOptions]:
    yield options
    for _ in range(_NUM_RELAXATIONS):
        options.init_min_num_inliers //= 2
        mapper.reset_initialization_stats()
        yield options
        options.init_min_tri_angle /= 2
        mapper.reset_initialization_stats()
        yield options


# Time between two snapshots: at least this, and so long that writing them takes a twentieth of the time at most.
_MIN_INTERVAL_S = 5.0
_INTERVAL_OVER_DURATION = 20.0
_SIZE_NAME = "size_at_adjustment.json"


def snapshots(path: Path, scratch: Path, min_model_size: int) -> Callable[[UnfinishedMapping], None]:
    """Return a function that takes a snapshot if one is due; it is called when COLMAP has added a photo.

    Args:
        path: folder of the newest snapshot, made with the first snapshot.
        scratch: folder on the same disk, where a snapshot is written before it is moved to ``path``.
        min_model_size: a further model with fewer photos than that may not be kept by COLMAP, and has no snapshot.
    """
    newest_ms, next_s = 0, time.monotonic() + _MIN_INTERVAL_S

    def keep(mapping: UnfinishedMapping) -> None:
        nonlocal newest_ms, next_s
        begin_s = time.monotonic()
        if begin_s < next_s or (mapping.finished and mapping.growing.num_reg_frames() < min_model_size):
            return
        # The name is the time, as COLMAP's are. Two snapshots within a millisecond must not have the same one.
        newest_ms = max(time.time_ns() // 1_000_000, newest_ms + 1)
        folder = scratch / f"{newest_ms:013d}"
        folder.mkdir()
        write_json([*mapping.size_at_adjustment], folder / _SIZE_NAME)
        for number, model in enumerate(mapping.models):
            (folder / str(number)).mkdir()
            model.write_binary(folder / str(number))
        _keep(folder, path)
        end_s = time.monotonic()
        next_s = end_s + max(_MIN_INTERVAL_S, _INTERVAL_OVER_DURATION * (end_s - begin_s))

    return keep


def newest_snapshot(path: Path) -> UnfinishedMapping | None:
    """Return the newest complete snapshot, or None if there is none."""
    for folder in sorted(path.iterdir(), reverse=True) if path.is_dir() else ():
        try:
            with open_regular(folder / _SIZE_NAME) as file:
                num_frames, num_points = map(int, json.loads(file.read()))
            numbers = sorted(int(model.name) for model in folder.iterdir() if model.name.isdecimal())
            *finished, growing = (read_model(folder / str(number)) for number in numbers)
        except (InputError, OSError, ValueError, TypeError):
            continue
        return UnfinishedMapping(tuple(finished), growing, (num_frames, num_points))
    return None


def _keep(snapshot: Path, path: Path) -> None:
    """Move a complete snapshot into the folder of snapshots, and remove the older ones."""
    path.mkdir(exist_ok=True)
    older = list(path.iterdir())
    os.replace(snapshot, path / snapshot.name)
    for folder in older:
        shutil.rmtree(folder)
