"""The end of mapping in submaps: what was joined is refined as a whole, as COLMAP ends a mapping in one piece."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from scipy.sparse import csr_array

from rangesfm.ceres.linear_solver import max_num_images_direct, overlaps_of
from rangesfm.progress import Progress
from rangesfm.vision.background import run_in_background


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
    ceres = adjustment.ceres
    ceres.max_num_images_direct_sparse_cpu_solver = max_num_images_direct(
        _matched(cache.correspondence_graph, model), ceres.max_num_images_direct_sparse_cpu_solver
    )
    adjustment.ceres = ceres
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


def _matched(graph: pycolmap.CorrespondenceGraph, model: pycolmap.Reconstruction) -> csr_array:
    """Which photos of a model may come to share points, by their matches."""
    index = {image_id: k for k, image_id in enumerate(model.reg_image_ids())}
    ids = [pycolmap.pair_id_to_image_pair(pair_id) for pair_id in graph.image_pairs()]
    pairs = [(index[a], index[b]) for a, b in ids if a in index and b in index]
    return overlaps_of(np.array(pairs, dtype=np.int64).reshape(-1, 2), len(index))
