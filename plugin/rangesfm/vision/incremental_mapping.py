"""COLMAP's incremental mapping with the same result in every run.

pycolmap.incremental_mapping searches for the initial pair in several threads. Sometimes a thread finds a pair that
comes late in the order, and this ends another thread's search for an earlier pair. Here a single thread searches.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pycolmap

# Rounds of lower demands on the initial pair, as in COLMAP.
_NUM_RELAXATIONS = 2
# The last adjustment ends when the cost decreases by less than this fraction, which is Ceres' default.
_WHOLE_FUNCTION_TOLERANCE = 1e-6


class _StoppedError(Exception):
    """Raised in a callback to stop COLMAP's mapping, whose parts watch neither a cancellation nor the time."""


def incremental_mapping(
    database_path: Path,
    image_path: Path,
    *,
    options: pycolmap.IncrementalPipelineOptions,
    input_path: Path | None = None,
    initial_image_pair_callback: Callable[[], None] = lambda: None,
    next_image_callback: Callable[[pycolmap.Reconstruction], None] = lambda model: None,
    cancellation_token: pycolmap.CancellationToken | None = None,
) -> list[pycolmap.Reconstruction]:
    """Run the incremental mapping and return all models, in the order in which they were begun.

    COLMAP's parts do not release Python's global lock, so that other threads run only during the callbacks.

    Args:
        input_path: folder of a model to continue.
        initial_image_pair_callback: called when a model has its initial pair, or is continued.
        next_image_callback: called for each further photo, with the model that the photo was added to.
        cancellation_token: ends the mapping after the current photo, as does ``options.max_runtime_seconds``.
    """
    options.image_path = image_path
    manager = pycolmap.ReconstructionManager()
    if input_path is not None:
        manager.read(input_path)
    with pycolmap.Database.open(database_path) as database:
        pipeline = pycolmap.IncrementalPipeline(options, database, manager)
    token, begin_s = cancellation_token or pycolmap.CancellationToken(), time.monotonic()

    def call(callback: Callable[[], None]) -> None:
        callback()
        if token.is_cancelled or 0 < options.max_runtime_seconds <= time.monotonic() - begin_s:
            raise _StoppedError

    def add_photo() -> None:
        next_image_callback(manager.get(manager.size() - 1))

    whens = pycolmap.IncrementalPipelineCallback
    pipeline.add_callback(whens.INITIAL_IMAGE_PAIR_REG_CALLBACK, partial(call, initial_image_pair_callback))
    pipeline.add_callback(whens.NEXT_IMAGE_REG_CALLBACK, partial(call, add_photo))
    if pipeline.database_cache.num_images():
        _map_with_relaxed_demands(pipeline)
    return [manager.get(index) for index in range(manager.size())]


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
    _adjust_all(mapper, model, options, to_the_end)
    model.update_point_3d_errors()
    mapper.end_reconstruction(discard=False)


def _adjust_all(
    mapper: pycolmap.IncrementalMapper,
    model: pycolmap.Reconstruction,
    options: pycolmap.IncrementalPipelineOptions,
    bundle_adjustment: pycolmap.BundleAdjustmentOptions,
) -> None:
    """Adjust the whole model and update its tracks in turns, until the tracks hardly change, as COLMAP does."""
    of_mapper, triangulation = options.get_mapper(), options.get_triangulation()
    mapper.complete_and_merge_tracks(triangulation)
    mapper.retriangulate(triangulation)
    for _ in range(options.ba_global_max_refinements):
        num_observations = model.compute_num_observations()
        mapper.observation_manager.filter_observations_with_negative_depth()
        mapper.adjust_global_bundle(of_mapper, bundle_adjustment)
        model.normalize()
        num_changed = mapper.complete_and_merge_tracks(triangulation) + mapper.filter_points(of_mapper)
        if num_changed < options.ba_global_max_refinement_change * num_observations:
            break
    mapper.filter_frames(of_mapper)


def _map_with_relaxed_demands(pipeline: pycolmap.IncrementalPipeline) -> None:
    """Map until nothing is left to register, lowering the demands on the initial pair step by step."""
    mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
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
    options.num_threads = 1  # COLMAP uses these threads only in the search for an initial pair
    yield options
    for _ in range(_NUM_RELAXATIONS):
        options.init_min_num_inliers //= 2
        mapper.reset_initialization_stats()
        yield options
        options.init_min_tri_angle /= 2
        mapper.reset_initialization_stats()
        yield options
