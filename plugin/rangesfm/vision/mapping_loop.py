"""COLMAP's incremental mapping, the same in every run, and with a global bundle adjustment of one's own if wanted.

pycolmap.incremental_mapping searches for an initial pair in several threads. Now and then one of them finds a pair that
comes late in the order, and ends the search of another for an earlier one; so the search is left to one thread here.

With an adjustment of one's own, the order of things is that of COLMAP's IncrementalPipeline, whose parts do all the
work but the global adjustment: with COLMAP's own there, the models are the same.
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
        """Plain values; others whenever it would adjust otherwise."""

    def adjust(self, model: pycolmap.Reconstruction) -> bool:
        """Adjust all of a model, in place; False leaves it, as it was, to COLMAP."""


# As in COLMAP: an initial pair that cannot be continued is given up after so many photos.
_MAX_NUM_INITIAL_TRIALS = 30
_NUM_RELAXATIONS = 2
# Relative, of the cost: Ceres' own.
_WHOLE_FUNCTION_TOLERANCE = 1e-6


class _StoppedError(Exception):
    """Goes through COLMAP's mapping, whose parts hear of a cancellation and of the time only so."""


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
    """All models, in the order in which they were begun.

    Python's lock is held but for the callbacks: COLMAP's parts do not release it.

    Args:
        adjustment: takes the place of COLMAP's global bundle adjustment.
        input_path: a model to go on from.
        next_image_callback: given the model that the photo was added to.
        cancellation_token: ends the mapping with the photo at hand, as the time does that the options allow.
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
    """Adjust all of a model of this database once more, in place, as the mapping does at its end, but to the end.

    COLMAP stops at a slope that is steep for a focal length which few photos tell: it would stay 10 % off among six.
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
    """Map until nothing is left to register, with lower and lower demands on the initial pair."""
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
    options.num_threads = 1  # for nothing but the search for an initial pair
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
    """One run of the mapper over a database, with the present demands on an initial pair (``mapper_options``)."""

    pipeline: pycolmap.IncrementalPipeline
    mapper: pycolmap.IncrementalMapper
    mapper_options: pycolmap.IncrementalMapperOptions
    adjustment: GlobalAdjustment | None

    def map_models(self, goes_on: bool) -> bool:
        """Model after model, each from another initial pair; whether that was all that is wanted.

        Args:
            goes_on: with the model that is there, at first.
        """
        options, manager = self.pipeline.options, self.pipeline.reconstruction_manager
        for trial in range(options.init_num_trials):
            index = 0 if goes_on and trial == 0 else manager.add()
            model = manager.get(index)
            status = self._map_model(model)
            num_images, is_another = model.num_reg_images(), options.multiple_models and manager.size() > 1
            is_kept = status == pycolmap.IncrementalPipelineStatus.SUCCESS and num_images > 0
            is_kept = is_kept and not (is_another and num_images < options.min_model_size)
            # Before the mapper forgets those of a model that is not kept: it has tried them.
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
        """An initial pair, and photo after photo from there."""
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
                # Once more after an adjustment, which may bring photos into reach.
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
        """The photo that was registered, by its points or else by its matches; None: none could be."""
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
        """Adjust the whole model, and its tracks to it, until they change no more."""
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
