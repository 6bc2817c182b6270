"""Merging of tracks: points that two passes saw apart become one where their photos match."""

from __future__ import annotations

from pathlib import Path

import pycolmap


def merge_tracks(model: pycolmap.Reconstruction, database_path: Path, *, seed: int) -> None:
    """Merge and complete the tracks of a model by all matches of its database, in place.

    Poses and cameras stay. The ids of photos and features are those of the database.
    """
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=seed)
    options.triangulation.random_seed = options.mapper.random_seed = seed
    triangulation = options.get_triangulation()
    with pycolmap.Database.open(database_path) as database:
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
