"""rangesfm: metric COLMAP models from photos and ultra-wideband ranges.

The stages are plain functions. Each is found here by name, and its module is imported on first use:

    import rangesfm

    log = rangesfm.read_ranges("uwb.csv")
    trajectory = rangesfm.trajectory_from_reconstruction(reconstruction, image_times)
    observations = rangesfm.associate(log, trajectory, tag_in_cam_m)
    estimate = rangesfm.initialize_scale(observations, trajectory, anchors, anchor_frame="unknown")
    metric = rangesfm.rescale(reconstruction, estimate.metric_from_sfm)
"""

from __future__ import annotations

import importlib
import logging
import zlib as zlib  # before pycolmap 4.2.1, because Python's zlib hangs or aborts if pycolmap's copy is loaded first
from typing import Any

__version__ = "0.1.0"

_HOME = {
    "Anchor": "rangesfm.measurements.ranges.anchors.anchor",
    "GeometryError": "rangesfm.errors",
    "InputError": "rangesfm.errors",
    "PlannedSurvey": "rangesfm.planning.planned",
    "RangeLog": "rangesfm.measurements.ranges.range_log",
    "RangesfmError": "rangesfm.errors",
    "ReconstructionError": "rangesfm.errors",
    "Similarity": "rangesfm.util.geometry.similarity",
    "SolverError": "rangesfm.errors",
    "Survey": "rangesfm.survey.settings",
    "Trajectory": "rangesfm.util.geometry.trajectory",
    "associate": "rangesfm.measurements.ranges.association",
    "compare": "rangesfm.comparison.with_reference",
    "compare_models": "rangesfm.comparison.before_after",
    "estimate_time_offset": "rangesfm.measurements.ranges.time_offset",
    "export_model": "rangesfm.export",
    "export_result": "rangesfm.pipeline.export_result",
    "find_image_times": "rangesfm.sfm.image_times",
    "initialize_scale": "rangesfm.estimation.scale.initialize",
    "measure": "rangesfm.pipeline.measure",
    "plan_survey": "rangesfm.planning.survey_plan",
    "read_anchors": "rangesfm.measurements.ranges.anchors.anchor_file",
    "read_image_times_csv": "rangesfm.sfm.image_times",
    "read_plan": "rangesfm.planning.plan_file",
    "read_ranges": "rangesfm.measurements.ranges.readers",
    "read_reference": "rangesfm.util.geometry.reference",
    "read_survey": "rangesfm.survey.survey_reader",
    "reconstruct": "rangesfm.sfm.reconstruct",
    "refine_with_ranges": "rangesfm.estimation.with_ranges",
    "rescale": "rangesfm.colmap.transform",
    "run_survey": "rangesfm.pipeline.run",
    "select_keyframes": "rangesfm.sfm.keyframes",
    "tag_positions": "rangesfm.measurements.ranges.known_path",
    "trajectory_from_reconstruction": "rangesfm.util.geometry.trajectory",
    "trilaterate": "rangesfm.measurements.ranges.anchors.trilateration",
    "trilaterate_anchors": "rangesfm.measurements.ranges.anchors.trilateration",
    "two_candidate": "rangesfm.measurements.ranges.scale.two_candidate",
    "write_report": "rangesfm.report",
}

__all__ = ["__version__", *sorted(_HOME)]

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    """Import a public name from its module on first use, because pycolmap and scipy are slow to load.

    All names but the error classes may need pycolmap and pyceres, so the installed versions are checked first.

    Raises:
        AttributeError: there is no such public name.
        SolverError: pycolmap or pyceres is missing or installed in another version than this package is built for.
    """
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    if _HOME[name] != "rangesfm.errors":
        importlib.import_module("rangesfm.installed_versions").check_versions()
    value = getattr(importlib.import_module(_HOME[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
