"""The verdict on a scale, good, doubtful or refused, with reasons and advice in a surveyor's words."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rangesfm.errors import GeometryError
from rangesfm.geometry.gravity import Gravity
from rangesfm.geometry.numerics import DOUBTFUL_ABOVE, NORMAL_95
from rangesfm.geometry.similarity import NEARLY_FLAT, NEARLY_STRAIGHT, path_kind, path_shape
from rangesfm.inference.bending import BENDS
from rangesfm.inference.posterior import ScaleUncertainty
from rangesfm.options import ScaleOptions
from rangesfm.ranging.anchors.anchor import Anchor, AnchorEstimate
from rangesfm.ranging.errors.components import FRAME
from rangesfm.ranging.range_observations import OUTLIER_BELOW
from rangesfm.scale.range_equation import RangeFit
from rangesfm.scale.scale_by_lengths import LengthScale
from rangesfm.scale.scale_by_positions import MIN_NUM_POSITIONS
from rangesfm.scale.scale_problem import ScaleProblem
from rangesfm.scale.solution import MANY_OUTLIERS, WHY_SCALE_IS_OPEN, Solution

FEW_RANGES = 50
"""Number of ranges below which outliers and noise can hardly be told apart."""
NOTHING_KNOWN = 1.0
"""Relative standard deviation of the scale from which nothing is known about it: it may as well be zero."""
# Scatter of the scales from single anchors above which they disagree. Antennas and short paths alone cause less.
_MAX_ANCHOR_SPREAD = 0.05
# How much wider the interval is with the anchors' coordinates, where that is said; less is chance.
_WIDENED = 1.1
CALIBRATE = "calibrate the radio at the distances of this survey (rangesfm ranges calibrate)"


@dataclass(frozen=True)
class Verdict:
    """The verdict on a scale.

    Attributes:
        verdict: "good" or "doubtful".
        reasons: in words.
        advice: what to do about the faults, in words; what would improve the survey most is part of its plan.
    """

    verdict: str
    reasons: tuple[str, ...]
    advice: tuple[str, ...]


class _Doubt(NamedTuple):
    reason: str
    advice: str = ""


def judge(
    problem: ScaleProblem,
    solution: Solution,
    uncertainty: ScaleUncertainty,
    per_anchor: dict[str, float],
    anchors: Sequence[AnchorEstimate],
    options: ScaleOptions,
    with_unknown_anchors: ScaleUncertainty | None = None,
) -> Verdict:
    """Return the verdict by the 95 % interval, and by faults that make the interval itself doubtful.

    Args:
        with_unknown_anchors: uncertainty if no place of an anchor were known; None where none is.

    Raises:
        GeometryError: refused, because the scale is less certain than ``options.max_relative_stddev`` allows.
    """
    half_width = uncertainty.half_width_95
    doubts = [*_doubts_of_survey(problem, solution, uncertainty), *_doubts_of_ranges(solution.fit, per_anchor)]
    remarks = [*_remarks(solution, anchors), *_remarks_on_places(half_width, with_unknown_anchors)]
    return _verdict(doubts, remarks, half_width, options)


def judge_lengths(lengths: LengthScale, uncertainty: ScaleUncertainty, options: ScaleOptions) -> Verdict:
    """Return the verdict on a scale that was found from measured lengths alone."""
    another = "measure another length, far from the first and in another direction"
    doubts = []
    if len(lengths.rows) == 1:
        reason = "the scale depends on one length that nothing checks: a mistake in it changes the whole map"
        doubts.append(_Doubt(reason, another))
    if uncertainty.half_width_95 > DOUBTFUL_ABOVE:
        doubts.append(
            _Doubt(
                "the measured lengths are too short for their standard deviations", "measure more and longer lengths"
            )
        )
    return _verdict(doubts, [], uncertainty.half_width_95, options)


def judge_positions(num_used: int, uncertainty: ScaleUncertainty, options: ScaleOptions, *, has_check: bool) -> Verdict:
    """Return the verdict on a scale from known positions, perhaps with measured lengths.

    Args:
        num_used: number of positions. has_check: whether others check them.
    """
    doubts = []
    if num_used == MIN_NUM_POSITIONS and not has_check:
        reason = f"the map rests on {num_used} known positions, so that nothing tells which of them is wrong if one is"
        doubts.append(_Doubt(reason, "survey a fourth control point, far from the others"))
    by_frame = uncertainty.components.get(FRAME, 0.0)
    if NORMAL_95 * by_frame > DOUBTFUL_ABOVE:
        reason = (
            "a system whose positions err as these do may also measure the whole site too large or too small, by up to "
            f"{100 * NORMAL_95 * by_frame:.1f} % (95 %): its positions alone cannot show that"
        )
        doubts.append(
            _Doubt(reason, "tape a long distance in the map (--distances), or survey control points (--points)")
        )
    elif uncertainty.half_width_95 > DOUBTFUL_ABOVE:
        reason = "the known positions are too close together for their standard deviations"
        doubts.append(_Doubt(reason, "survey control points at the ends of the site, or walk farther"))
    return _verdict(doubts, [], uncertainty.half_width_95, options)


def refuse_unknown(half_width: float, reasons: Sequence[str], advice: Sequence[str], options: ScaleOptions) -> None:
    """Raise GeometryError if a scale is less certain than allowed, with the first reason and the first advice.

    Args:
        half_width: half of the 95 % interval of the scale, relative.
    """
    if half_width > NORMAL_95 * options.max_relative_stddev:
        planned = "plan the survey first (rangesfm plan), to see what would make the scale more certain"
        if half_width > NORMAL_95 * NOTHING_KNOWN:
            known = "the scale is not determined"
        else:
            allowed = 100 * NORMAL_95 * options.max_relative_stddev
            known = (
                f"the scale is only known to {100 * half_width:.1f} % (95 % interval), worse than the {allowed:.3g} % "
                f"allowed ({NORMAL_95} times max_relative_stddev)"
            )
        raise GeometryError(
            f"{known}{''.join(f': {reason}' for reason in reasons[:1])}; next time: {next(iter(advice), planned)}"
        )


def _verdict(doubts: list[_Doubt], remarks: list[_Doubt], half_width: float, options: ScaleOptions) -> Verdict:
    why, advised = [doubt.reason for doubt in doubts], [doubt.advice for doubt in doubts if doubt.advice]
    refuse_unknown(half_width, why, advised, options)
    percent = f"{100 * half_width:.1f}" if half_width >= 1e-3 else f"{100 * half_width:.1g}"
    summary = f"the scale is known to {percent} % (95 % interval)"
    if half_width > DOUBTFUL_ABOVE:
        doubts.insert(0, _Doubt(f"{summary}, worse than {100 * DOUBTFUL_ABOVE:g} %"))
    said = [*doubts, *remarks]
    advice = tuple(dict.fromkeys(each.advice for each in said if each.advice))
    reasons = tuple(each.reason for each in said)
    if not doubts:
        return Verdict("good", (summary, *reasons), advice)
    return Verdict("doubtful", reasons, advice)


def _doubts_of_survey(posed: ScaleProblem, solution: Solution, uncertainty: ScaleUncertainty) -> Iterator[_Doubt]:
    """Return the faults of the path and of the anchors."""
    problem, half_width = solution.problem, uncertainty.half_width_95
    kind, heard = path_kind(problem.centers), np.unique(problem.anchor_index)
    is_round = kind in ("circular", "spherical") and not np.isfinite(problem.anchor_stddev_m[heard]).any()
    # On these paths the scale is uncertain because of their shape: a longer walk of the same shape would not help.
    if half_width > DOUBTFUL_ABOVE and is_round:
        yield _Doubt(*WHY_SCALE_IS_OPEN[kind])
    elif np.linalg.norm([uncertainty.components.get(name, 0.0) for name in BENDS]) > NOTHING_KNOWN:
        overlap = "take photos that overlap more, and range more often"
        yield _Doubt("ranges and photos leave the shape of the map open", overlap)
    elif half_width > NORMAL_95 * NOTHING_KNOWN:
        yield _Doubt("the ranges do not show that the camera moved", "walk a loop of several metres")
    for note in posed.notes:
        yield _Doubt(note, "survey three anchors or more that are not on one line")
    if ids := posed.left_out:
        which = f"anchor {ids[0]} has" if len(ids) == 1 else f"anchors {', '.join(ids)} have"
        reason = f"{which} too few ranges on the path to be placed: left out"
        yield _Doubt(reason, "range more often, or survey them all")
    stddevs = path_shape(problem.centers).stddevs
    if stddevs[1] < NEARLY_STRAIGHT * stddevs[0]:
        if np.isinf(problem.anchor_stddev_m).any():
            yield _Doubt("the path is nearly straight: an unknown anchor may stand anywhere on a circle around it")
        elif problem.frame_is_free:
            yield _Doubt("the path is nearly straight: the map's roll about it is uncertain")


def _doubts_of_ranges(fit: RangeFit, per_anchor: dict[str, float]) -> Iterator[_Doubt]:
    if len(fit.weights) < FEW_RANGES:
        reason = f"only {len(fit.weights)} ranges lie on the path"
        yield _Doubt(reason, "range more often, and all along the path")
    outliers = float(np.mean(fit.weights < OUTLIER_BELOW))
    if outliers > MANY_OUTLIERS:
        reason = f"{100 * outliers:.0f} % of the ranges do not fit the map: blocked, reflected, or of another anchor"
        yield _Doubt(reason, "place the anchors where nothing stands between them and the path")
    if len(per_anchor) > 1:
        spread = float(np.std(np.log(np.array(list(per_anchor.values()))), ddof=1))
        if spread > _MAX_ANCHOR_SPREAD:
            reason = f"the anchors disagree: the scales found with each of them alone scatter by {100 * spread:.1f} %"
            yield _Doubt(reason, "check the anchors' positions and antenna delays, and place them in the open")


def _remarks(solution: Solution, anchors: Sequence[AnchorEstimate]) -> list[_Doubt]:
    """Return what is not determined but does not affect the scale."""
    stddevs = path_shape(solution.problem.centers).stddevs
    if stddevs[2] >= NEARLY_FLAT * stddevs[0] or all(a.mirror_position_m is None for a in anchors):
        return []
    reason = "the path is nearly flat: nothing tells on which side of it the unknown anchors stand (the scale is right)"
    return [_Doubt(reason, "raise and lower the camera on the way, or survey the anchors")]


def _remarks_on_places(half_width: float, with_unknown_anchors: ScaleUncertainty | None) -> Iterator[_Doubt]:
    """Yield that the anchors' coordinates widen the interval, as they do where they contradict the ranges."""
    if with_unknown_anchors is None or not half_width > _WIDENED * with_unknown_anchors.half_width_95:
        return
    yield _Doubt(
        "the anchors' coordinates do not quite fit the ranges, which makes the scale less certain: with the anchors "
        f"unknown it would be known to {100 * with_unknown_anchors.half_width_95:.1f} %",
        "measure the coordinates of the anchors' antennas, not of their stands or housings, and give their stddev "
        "(position_stddev_m)",
    )


def levelled_places(gravity: Gravity, surveyed: Sequence[Anchor], found: Sequence[AnchorEstimate]) -> tuple[str, ...]:
    """Describe in words where gravity puts the first camera if the site's anchors do not fix the map's heading.

    Args:
        surveyed: anchors in the site frame. found: anchors in the first camera's frame.
    """
    height_of = {anchor.anchor_id: anchor.position_m[2] for anchor in surveyed if anchor.position_m is not None}
    texts = []
    for anchor in found:
        if anchor.anchor_id not in height_of or not np.isfinite(anchor.position_m).all():
            continue
        wheres = []
        for place in (anchor.position_m, anchor.mirror_position_m):
            if place is not None:
                rise = float(place @ gravity.up_in_first_camera)
                away = float(np.linalg.norm(place - rise * gravity.up_in_first_camera))
                wheres.append(f"at site height {height_of[anchor.anchor_id] - rise:.2f} m, {away:.2f} m horizontally")
        # An anchor on the path's plane is its own mirror image.
        where = " or ".join(dict.fromkeys(wheres))
        texts.append(
            f"the first camera was {where} from anchor {anchor.anchor_id}; in which direction is not determined"
        )
    return tuple(texts)
