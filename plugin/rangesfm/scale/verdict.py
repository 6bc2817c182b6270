"""Good, doubtful or refused, and why, in words a surveyor understands."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rangesfm.errors import GeometryError
from rangesfm.geometry.similarity import NEARLY_FLAT, NEARLY_STRAIGHT, path_kind, path_shape
from rangesfm.options import ScaleOptions
from rangesfm.ranging.anchors.anchor import AnchorEstimate
from rangesfm.scale.cutoff import scale_drift
from rangesfm.scale.estimate import NORMAL_95, CutoffTest, ScaleUncertainty
from rangesfm.scale.problem import ScaleProblem
from rangesfm.scale.range_equation import RangeFit
from rangesfm.scale.solution import WHY_SCALE_IS_OPEN, Solution

# Half of the 95 % interval of the scale, relative, from which it is called doubtful.
DOUBTFUL_ABOVE = 0.04
# Smaller changes with the least range are no news to a surveyor.
_MIN_DRIFT_PERCENT = 1.0
_MANY_OUTLIERS = 0.3
_FEW_RANGES = 50
# Relative stddev of a scale that may as well be nothing.
_NOTHING_KNOWN = 1.0
_MAX_ANCHOR_SPREAD = 0.03
_CALIBRATE = "calibrate the radio at the distances of this survey (rangesfm ranges calibrate)"


@dataclass(frozen=True)
class Verdict:
    """What to think of a scale.

    Attributes:
        verdict: "good" or "doubtful".
        reasons: why.
        advice: what to do next time.
    """

    verdict: str
    reasons: tuple[str, ...]
    advice: tuple[str, ...]


@dataclass(frozen=True)
class _Doubt:
    reason: str
    advice: str


def judge(
    problem: ScaleProblem,
    solution: Solution,
    uncertainty: ScaleUncertainty,
    per_anchor: dict[str, float],
    anchors: Sequence[AnchorEstimate],
    cutoff_tests: tuple[CutoffTest, ...],
    options: ScaleOptions,
) -> Verdict:
    """The verdict, by the 95 % interval and by what makes even that doubtful.

    Raises:
        GeometryError: refused, as the scale is less certain than ``options.max_relative_stddev``.
    """
    half_width = uncertainty.half_width_95
    weak = _weakness_doubts(solution, half_width)
    narrower = weak[0].advice if weak else _what_narrows_it(solution, uncertainty)
    doubts = [
        *weak,
        *(_Doubt(note, "survey three anchors or more that are not on one line") for note in problem.notes),
        *_left_out_doubts(problem.left_out),
        *_path_doubts(solution, anchors),
        *_range_doubts(solution.fit),
        *_anchor_doubts(per_anchor),
        *_drift_doubts(cutoff_tests),
    ]
    if half_width > NORMAL_95 * options.max_relative_stddev:
        why = f"{doubts[0].reason}; " if doubts else ""
        raise GeometryError(
            f"the scale is only known to {100 * half_width / NORMAL_95:.1f} % (1 stddev), "
            f"more than the {100 * options.max_relative_stddev:g} % allowed (max_relative_stddev): {why}"
            f"next time: {narrower}"
        )
    summary = f"the scale is known to {100 * half_width:.1f} % (95 % interval)"
    if half_width > DOUBTFUL_ABOVE:
        doubts.insert(0, _Doubt(f"{summary}, worse than {100 * DOUBTFUL_ABOVE:g} %", narrower))
    if not doubts:
        return Verdict("good", (summary,), ())
    advice: dict[str, str] = {}
    for doubt in doubts:  # calibration is advised once, whatever else goes with it
        advice.setdefault(_CALIBRATE if doubt.advice.startswith(_CALIBRATE) else doubt.advice, doubt.advice)
    return Verdict("doubtful", tuple(doubt.reason for doubt in doubts), tuple(advice.values()))


def _what_narrows_it(solution: Solution, uncertainty: ScaleUncertainty) -> str:
    """Advice by the largest part of the uncertainty."""
    seen, by_anchor = max(uncertainty.bootstrap, uncertainty.correlated), uncertainty.jackknife or 0.0
    some_unknown = bool(np.isinf(solution.problem.anchor_stddev_m).any())
    if uncertainty.range_model > max(seen, by_anchor, uncertainty.antennas):
        return (
            f"{_CALIBRATE}, or tape a distance between two photos or points; failing both, keep the anchors farther "
            "from the path"
        )
    if by_anchor > max(seen, uncertainty.antennas):
        survey = "survey the anchors" if some_unknown else "check the surveyed positions of the anchors"
        return f"{survey}, and place them where they see the whole path"
    if uncertainty.antennas > seen:
        return "range to more anchors, on all sides of the path: a single antenna errs with the direction"
    return "walk a wider or longer loop, or survey the anchors" if some_unknown else "walk a wider or longer loop"


def _left_out_doubts(anchor_ids: tuple[str, ...]) -> list[_Doubt]:
    if not anchor_ids:
        return []
    which = f"anchor {anchor_ids[0]} has" if len(anchor_ids) == 1 else f"anchors {', '.join(anchor_ids)} have"
    return [
        _Doubt(f"{which} too few ranges on the path to be placed: left out", "range more often, or survey them all")
    ]


def _weakness_doubts(solution: Solution, half_width: float) -> list[_Doubt]:
    """Why the scale is uncertain, where a longer walk of the same shape would not help."""
    problem = solution.problem
    kind, heard = path_kind(problem.centers), np.unique(problem.anchor_index)
    is_round = kind in ("circular", "spherical") and not np.isfinite(problem.anchor_stddev_m[heard]).any()
    if half_width > DOUBTFUL_ABOVE and is_round:
        reason, advice = WHY_SCALE_IS_OPEN[kind]
        return [_Doubt(reason, advice)]
    if half_width > NORMAL_95 * _NOTHING_KNOWN:
        return [_Doubt("the ranges do not show that the camera moved", "walk a loop of several metres")]
    return []


def _path_doubts(solution: Solution, anchors: Sequence[AnchorEstimate]) -> list[_Doubt]:
    stddevs = path_shape(solution.problem.centers).stddevs
    if stddevs[1] < NEARLY_STRAIGHT * stddevs[0]:
        bend = "walk a bend or a loop instead of a straight line"
        if np.isinf(solution.problem.anchor_stddev_m).any():
            reason = "the path is nearly straight: an unknown anchor may stand anywhere on a circle around it"
            return [_Doubt(reason, f"{bend}, or survey the anchors")]
        if solution.problem.frame_is_free:
            return [_Doubt("the path is nearly straight: how far the map is rolled about it is uncertain", bend)]
    elif stddevs[2] < NEARLY_FLAT * stddevs[0] and any(a.mirror_position_m is not None for a in anchors):
        reason = (
            "the path is nearly flat: on which side of it the unknown anchors stand is open; the scale does not "
            "depend on it"
        )
        return [_Doubt(reason, "raise and lower the camera on the way, or survey the anchors")]
    return []


def _range_doubts(fit: RangeFit) -> list[_Doubt]:
    doubts = []
    if len(fit.weights) < _FEW_RANGES:
        reason = f"only {len(fit.weights)} ranges lie on the path"
        doubts.append(_Doubt(reason, "range more often, and all along the path"))
    outliers = float(np.mean(fit.weights < 0.1))
    if outliers > _MANY_OUTLIERS:
        reason = f"{100 * outliers:.0f} % of the ranges do not fit the map: blocked, reflected, or of another anchor"
        doubts.append(_Doubt(reason, "place the anchors where nothing stands between them and the path"))
    return doubts


def _anchor_doubts(per_anchor: dict[str, float]) -> list[_Doubt]:
    """Anchors that disagree on the scale."""
    if len(per_anchor) < 2:
        return []
    spread = float(np.std(np.log(np.array(list(per_anchor.values()))), ddof=1))
    if spread <= _MAX_ANCHOR_SPREAD:
        return []
    reason = f"the anchors disagree: the scales found with each of them alone scatter by {100 * spread:.1f} %"
    return [_Doubt(reason, "check the anchors' positions and antenna delays, and place them in the open")]


def _drift_doubts(tests: tuple[CutoffTest, ...]) -> list[_Doubt]:
    """A scale that moves as short ranges are left out."""
    drift = scale_drift(tests)
    if drift is None or abs(percent := 100 * (drift.scale / tests[0].scale - 1)) < _MIN_DRIFT_PERCENT:
        return []
    reason = (
        f"short ranges disagree with long ones: without those under {drift.min_range_m:g} m the scale would change by "
        f"{percent:+.1f} %"
    )
    return [_Doubt(reason, f"{_CALIBRATE}, and keep the anchors farther from the path")]
