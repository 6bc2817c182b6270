"""The end of mapping in submaps: what was joined is refined as a whole, as COLMAP ends a mapping in one piece."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import pycolmap

from rangesfm.progress import Progress
from rangesfm.vision.background import run_in_background

# A direct solver takes time and memory as the number of photos where each sees what few others see, as along a path.
# The iterative one, which COLMAP takes from a thousand photos on, creeps there: six times the time at five thousand.
_MAX_NUM_NEIGHBOURS = 50


def refine_joined(
    database: Path,
    image_path: Path,
    models: Sequence[pycolmap.Reconstruction],
    options: pycolmap.IncrementalPipelineOptions,
    progress: Progress,
) -> None:
    """Complete and merge tracks by all matches, also those over submaps, and adjust each model as a whole; in place.

    Args:
        models: of photos of the database; without common photos or not.

    Raises:
        ReconstructionError: COLMAP failed.
    """
    num_total = sum(model.num_reg_images() for model in models)
    num_done = 0
    for model in models:
        work, count = partial(_refine, database, image_path, model, options), partial(int, num_done)
        run_in_background(work, progress, count, num_total)
        num_done += model.num_reg_images()
    progress.update(num_done, num_total)


def _refine(
    database_path: Path,
    image_path: Path,
    model: pycolmap.Reconstruction,
    options: pycolmap.IncrementalPipelineOptions,
    _: pycolmap.CancellationToken,
) -> None:
    names = {model.image(image_id).name for image_id in model.reg_image_ids()}
    with pycolmap.Database.open(database_path) as database:
        cache = pycolmap.DatabaseCache.create(
            database,
            pycolmap.DatabaseCacheOptions(
                min_num_matches=options.min_num_matches, ignore_watermarks=options.ignore_watermarks, image_names=names
            ),
        )
    adjustment = options.get_global_bundle_adjustment()
    if cache.correspondence_graph.num_image_pairs() <= _MAX_NUM_NEIGHBOURS * model.num_reg_images():
        adjustment.ceres.max_num_images_direct_sparse_cpu_solver = max(
            adjustment.ceres.max_num_images_direct_sparse_cpu_solver, model.num_reg_images()
        )
    mapper = pycolmap.IncrementalMapper(cache)
    mapper.begin_reconstruction(model)
    mapper.iterative_global_refinement(
        options.ba_global_max_refinements,
        options.ba_global_max_refinement_change,
        options.get_mapper(),
        adjustment,
        options.get_triangulation(),
    )
    mapper.end_reconstruction(discard=False)
    if options.extract_colors:
        model.extract_colors_for_all_images(image_path, options.num_threads)
    model.update_point_3d_errors()
