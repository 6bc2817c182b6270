"""Carries a model into the metric world."""

from __future__ import annotations

import pycolmap

from rangesfm.geometry import Similarity


def rescale(reconstruction: pycolmap.Reconstruction, metric_from_sfm: Similarity) -> pycolmap.Reconstruction:
    """A copy of the model in the metric world; poses and points move, the original stays.

    In a rig the distances between its cameras scale along, as COLMAP has them in model units.
    """
    metric = pycolmap.Reconstruction(reconstruction)
    metric.transform(
        pycolmap.Sim3d(
            metric_from_sfm.scale, pycolmap.Rotation3d(metric_from_sfm.rotation), metric_from_sfm.translation
        )
    )
    return metric
