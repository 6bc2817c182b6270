"""COLMAP's incremental mapping with the same result in every run, optionally with another global bundle adjustment.

pycolmap.incremental_mapping searches for the initial pair in several threads. Sometimes a thread finds a pair that
comes late in the order, and this ends another thread's search for an earlier pair. Here a single thread searches.

With another adjustment, the steps follow COLMAP's IncrementalPipeline, whose parts do everything except the global
adjustment. If that adjustment is COLMAP's own, the models are the same as COLMAP's.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Protocol

import pycolmap

from rangesfm.vision.snapshots import write_snapshot


class GlobalAdjustment(Protocol):
    """A global bundle adjustment in place of COLMAP's."""

    @property
    def inputs(self) -> Any:
        """Plain values that differ whenever the adjustment would give another result."""

    def adjust(self, model: pycolmap.Reconstruction) -> bool:
        """Adjust a whole model in place; return False to leave the unchanged model to COLMAP's adjustment."""


# Photos that are tried in vain before a model below the minimal size is given up, as in COLMAP's IncrementalPipeline.
_MAX_NUM_INITIAL_TRIALS = 30
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
    adjustment: GlobalAdjustment | None = None,
    input_path: Path | None = None,
    initial_image_pair_callback: Callable[[], None] = lambda: None,
    next_image_callback: Callable[[pycolmap.Reconstruction], None] = lambda model: None,
    cancellation_token: pycolmap.CancellationToken | None = None,
) -> list[pycolmap.Reconstruction]:
    """Run the incremental mapping and return all models, in the order in which they were begun.

    COLMAP's parts do not release Python's global lock, so that other threads run only during the callbacks.

    Args:
        adjustment: takes the place of COLMAP's global bundle adjustment.
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
        _map_with_relaxed_demands(pipeline, adjustment)
    return [manager.get(index) for index in range(manager.size())]


def adjust_whole(
    database_path: Path,
    model: pycolmap.Reconstruction,
    *,
    options: pycolmap.IncrementalPipelineOptions,
    adjustment: GlobalAdjustment | None = None,
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
    _MappingLoop(pipeline, mapper, options.get_mapper(), adjustment).adjust_all(model, to_the_end)
    model.update_point_3d_errors()
    mapper.end_reconstruction(discard=False)


def _map_with_relaxed_demands(pipeline: pycolmap.IncrementalPipeline, adjustment: GlobalAdjustment | None) -> None:
    """Map until nothing is left to register, lowering the demands on the initial pair step by step."""
    mapper = pycolmap.IncrementalMapper(pipeline.database_cache)
    goes_on = pipeline.reconstruction_manager.size() > 0
    for options in _relaxed(pipeline.options.get_mapper(), mapper):
        try:
            if adjustment is None:
                is_done = pipeline.reconstruct(mapper, options, goes_on) != pycolmap.IncrementalPipelineStatus.CONTINUE
            else:
                is_done = _MappingLoop(pipeline, mapper, options, adjustment).map_models(goes_on)
        except _StoppedError:
            mapper.reconstruction.update_point_3d_errors()
            mapper.end_reconstruction(discard=False)
            return
        goes_on = False
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


@dataclass(frozen=True)
class _MappingLoop:
    """One run of the mapper over a database, with one set of demands on an initial pair (``mapper_options``)."""

    pipeline: pycolmap.IncrementalPipeline
    mapper: pycolmap.IncrementalMapper
    mapper_options: pycolmap.IncrementalMapperOptions
    adjustment: GlobalAdjustment | None

    def map_models(self, goes_on: bool) -> bool:
        """Build models, each from another initial pair; return False if lower demands might give further models.

        Args:
            goes_on: continue the existing model first.
        """
        options, manager = self.pipeline.options, self.pipeline.reconstruction_manager
        for trial in range(options.init_num_trials):
            index = 0 if goes_on and trial == 0 else manager.add()
            model = manager.get(index)
            status = self._map_model(model)
            num_images, is_another = model.num_reg_images(), options.multiple_models and manager.size() > 1
            is_kept = status == pycolmap.IncrementalPipelineStatus.SUCCESS and num_images > 0
            is_kept = is_kept and not (is_another and num_images < options.min_model_size)
            # Counted now, because the mapper is about to forget the photos of a discarded model. They have been tried.
            num_tried = self.mapper.num_total_reg_images()
            if is_kept:
                model.update_point_3d_errors()
            self.mapper.end_reconstruction(discard=not is_kept)
            if not is_kept:
                manager.delete(index)
            if status == pycolmap.IncrementalPipelineStatus.NO_INITIAL_PAIR:
                return False
            if status == pycolmap.IncrementalPipelineStatus.SUCCESS and (
                not options.multiple_models
                or manager.size() >= options.max_num_models
                or num_tried >= self.pipeline.database_cache.num_images() - 1
            ):
                return True
        return False

    def _map_model(self, model: pycolmap.Reconstruction) -> pycolmap.IncrementalPipelineStatus:
        """Build one model: find an initial pair unless the model has photos, then add photo after photo."""
        options, mapper = self.pipeline.options, self.mapper
        mapper.begin_reconstruction(model)
        if not model.num_reg_frames():
            status = self.pipeline.initialize_reconstruction(mapper, self.mapper_options, model)
            if status != pycolmap.IncrementalPipelineStatus.SUCCESS:
                return status
        self.pipeline.callback(pycolmap.IncrementalPipelineCallback.INITIAL_IMAGE_PAIR_REG_CALLBACK)
        adjusted = model.num_reg_frames(), model.num_points3D()
        num_in_snapshot, has_failed = model.num_reg_frames(), False
        while mapper.num_shared_reg_images() < options.max_model_overlap:
            image_id = self._register_next(model)
            if image_id is None:
                # A global adjustment may make further photos registrable, so it is followed by one more attempt.
                if has_failed:
                    break
                self.adjust_all(model)
            else:
                self._refine_around(model, image_id)
                if self.pipeline.check_run_global_refinement(model, *adjusted):
                    self.adjust_all(model)
                    adjusted = model.num_reg_frames(), model.num_points3D()
                if options.extract_colors:
                    model.extract_colors_for_image(image_id, options.image_path)
                if 0 < options.snapshot_frames_freq <= model.num_reg_frames() - num_in_snapshot:
                    num_in_snapshot = model.num_reg_frames()
                    write_snapshot(model, Path(options.snapshot_path))
                self.pipeline.callback(pycolmap.IncrementalPipelineCallback.NEXT_IMAGE_REG_CALLBACK)
            has_failed = image_id is None
        if model.num_reg_frames() != adjusted[0] and model.num_points3D() != adjusted[1]:
            self.adjust_all(model)
        return pycolmap.IncrementalPipelineStatus.SUCCESS

    def _register_next(self, model: pycolmap.Reconstruction) -> int | None:
        """Register a photo by its points, or else by its matches; return its id, or None if no photo could be."""
        options, mapper = self.pipeline.options, self.mapper
        only, fallback = options.structure_less_registration_only, options.structure_less_registration_fallback
        for structure_less in (True,) if only else (False, True) if fallback else (False,):
            register = mapper.register_next_structure_less_image if structure_less else mapper.register_next_image
            next_images = mapper.find_next_images(self.mapper_options, structure_less=structure_less)
            for trial, image_id in enumerate(next_images):
                if register(self.mapper_options, image_id):
                    return image_id
                if trial >= _MAX_NUM_INITIAL_TRIALS and model.num_reg_images() < options.min_model_size:
                    break
        return None

    def _refine_around(self, model: pycolmap.Reconstruction, image_id: int) -> None:
        options = self.pipeline.options
        self.mapper.triangulate_image(options.get_triangulation(), image_id)
        self.mapper.iterative_local_refinement(
            options.ba_local_max_refinements,
            options.ba_local_max_refinement_change,
            self.mapper_options,
            options.get_local_bundle_adjustment(),
            options.get_triangulation(),
            image_id,
        )

    def adjust_all(
        self, model: pycolmap.Reconstruction, bundle_adjustment: pycolmap.BundleAdjustmentOptions | None = None
    ) -> None:
        """Adjust the whole model and update its tracks in turns, until the tracks hardly change."""
        bundle_adjustment = bundle_adjustment or self.pipeline.options.get_global_bundle_adjustment()
        options, mapper = self.pipeline.options, self.mapper
        triangulation = options.get_triangulation()
        mapper.complete_and_merge_tracks(triangulation)
        mapper.retriangulate(triangulation)
        for _ in range(options.ba_global_max_refinements):
            num_observations = model.compute_num_observations()
            mapper.observation_manager.filter_observations_with_negative_depth()
            if self.adjustment is None or not self.adjustment.adjust(model):
                mapper.adjust_global_bundle(self.mapper_options, bundle_adjustment)
            model.normalize()
            num_changed = mapper.complete_and_merge_tracks(triangulation) + mapper.filter_points(self.mapper_options)
            if num_changed < options.ba_global_max_refinement_change * num_observations:
                break
        mapper.filter_frames(self.mapper_options)
