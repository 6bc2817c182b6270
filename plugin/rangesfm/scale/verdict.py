"""Good, doubtful or refused, and why, in words a surveyor understands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rangesfm.errors import GeometryError
from rangesfm.geometry import path_shape
from rangesfm.options import ScaleOptions
from rangesfm.ranging.anchors import AnchorEstimate
from rangesfm.scale.estimate import ScaleUncertainty
from rangesfm.scale.problem import SurveyProblem
from rangesfm.scale.range_equation import RangeFit
from rangesfm.scale.solution import NEARLY_STRAIGHT, Solution

# Relative stddev of the scale from which it is called doubtful.
DOUBTFUL_ABOVE = 0.02
_PLANAR = 0.05
_MANY_OUTLIERS = 0.3
_FEW_RANGES = 50
_MAX_ANCHOR_SPREAD = 0.03


def judge(
    survey: SurveyProblem,
    solution: Solution,
    uncertainty: ScaleUncertainty,
    per_anchor: dict[str, float],
    anchors: Sequence[AnchorEstimate],
    options: ScaleOptions,
) -> tuple[str, tuple[str, ...]]:
    """The verdict ("good" or "doubtful") and its reasons.

    Raises:
        GeometryError: refused, as the scale is less certain than ``options.max_relative_stddev``.
    """
    relative = max(uncertainty.empirical, uncertainty.formal)
    doubts = [
        *survey.notes,
        *_path_doubts(solution, anchors),
        *_range_doubts(solution.fit),
        *_anchor_doubts(per_anchor),
    ]
    if relative > options.max_relative_stddev:
        why = f" ({doubts[0]})" if doubts else ": walk a wider path, or survey the anchors"
        raise GeometryError(
            f"the scale is only known to {100 * relative:.1f} % (1 stddev), "
            f"more than the {100 * options.max_relative_stddev:g} % allowed{why}"
        )
    summary = f"the scale is known to {100 * relative:.2f} % (1 stddev)"
    if relative > DOUBTFUL_ABOVE:
        doubts.insert(0, f"{summary}, worse than {100 * DOUBTFUL_ABOVE:g} %")
    return ("doubtful", tuple(doubts)) if doubts else ("good", (summary,))


def _path_doubts(solution: Solution, anchors: Sequence[AnchorEstimate]) -> list[str]:
    stddevs = path_shape(solution.problem.centers).stddevs
    doubts = []
    if stddevs[1] < NEARLY_STRAIGHT * stddevs[0]:
        if np.isinf(solution.problem.anchor_stddev_m).any():
            doubts.append("the path is nearly straight: an unknown anchor can lie anywhere on a circle around it")
        elif solution.problem.frame_is_free:
            doubts.append("the path is nearly straight: how the map is turned about it rests on little")
    elif stddevs[2] < _PLANAR * stddevs[0] and any(a.mirror_position_m is not None for a in anchors):
        doubts.append("the path is nearly flat: the side of the unknown anchors is open (the scale is not)")
    return doubts


def _range_doubts(fit: RangeFit) -> list[str]:
    doubts = []
    if len(fit.weights) < _FEW_RANGES:
        doubts.append(f"only {len(fit.weights)} ranges lie on the path")
    outliers = float(np.mean(fit.weights < 0.1))
    if outliers > _MANY_OUTLIERS:
        doubts.append(f"{100 * outliers:.0f} % of the ranges do not fit")
    return doubts


def _anchor_doubts(per_anchor: dict[str, float]) -> list[str]:
    """Anchors that disagree on the scale."""
    if len(per_anchor) < 2:
        return []
    spread = float(np.std(np.log(np.array(list(per_anchor.values()))), ddof=1))
    if spread <= _MAX_ANCHOR_SPREAD:
        return []
    return [f"the anchors disagree on the scale: each alone, they spread by {100 * spread:.1f} %"]
