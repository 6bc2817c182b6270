"""The verdict on a scale, good, doubtful or refused, with reasons and advice in a surveyor's words."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.range_equation import RangeFit
from rangesfm.estimation.scale.scale_problem import ScaleProblem
from rangesfm.estimation.scale.solution import MANY_OUTLIERS, WHY_SCALE_IS_OPEN, Solution
from rangesfm.measurements.joint_map import Doubt, JointMap
from rangesfm.measurements.ranges.anchors.anchor import Anchor, AnchorEstimate
from rangesfm.measurements.ranges.range_observations import OUTLIER_BELOW
from rangesfm.options import ScaleOptions
from rangesfm.solver.bending import BENDS
from rangesfm.solver.posterior import ScaleUncertainty
from rangesfm.util.geometry.gravity import Gravity
from rangesfm.util.geometry.numerics import DOUBTFUL_ABOVE, NORMAL_95
from rangesfm.util.geometry.similarity import NEARLY_FLAT, NEARLY_STRAIGHT, path_kind, path_shape

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


def judge(
    doubts: Iterable[Doubt], remarks: Iterable[Doubt], uncertainty: ScaleUncertainty, options: ScaleOptions
) -> Verdict:
    """Return the verdict by the 95 % interval, and by faults that make the interval itself doubtful.

    Args:
        doubts: such faults. remarks: what is to be said without any doubt.

    Raises:
        GeometryError: refused, because the scale is less certain than ``options.max_relative_stddev`` allows.
    """
    half_width, doubts = uncertainty.half_width_95, [*doubts]
    why, advised = [doubt.reason for doubt in doubts], [doubt.advice for doubt in doubts if doubt.advice]
    refuse_unknown(half_width, why, advised, options)
    percent = f"{100 * half_width:.1f}" if half_width >= 1e-3 else f"{100 * half_width:.1g}"
    summary = f"the scale is known to {percent} % (95 % interval)"
    if half_width > DOUBTFUL_ABOVE:
        doubts.insert(0, Doubt(f"{summary}, worse than {100 * DOUBTFUL_ABOVE:g} %"))
    said = [*doubts, *remarks]
    advice = tuple(dict.fromkeys(each.advice for each in said if each.advice))
    reasons = tuple(each.reason for each in said)
    if not doubts:
        return Verdict("good", (summary, *reasons), advice)
    return Verdict("doubtful", reasons, advice)


def judge_map_of_kinds(on_map: JointMap, options: ScaleOptions) -> Verdict:
    """Return the verdict on a map with all that is measured in it, as ``judge``.

    The first kind that is used says what makes the interval doubtful.
    """
    first = next(each for each in on_map.kinds if each.is_used)
    uncertainty = on_map.posterior.uncertainty
    remarks = itertools.chain.from_iterable(each.remarks(on_map) for each in on_map.kinds)
    return judge(first.doubts(uncertainty), remarks, uncertainty, options)


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


def doubts_of_ranges(
    posed: ScaleProblem, solution: Solution, uncertainty: ScaleUncertainty, per_anchor: Mapping[str, float]
) -> Iterator[Doubt]:
    """Yield the faults of the path, of the anchors and of the ranges; ``per_anchor``: scales, by anchor id."""
    yield from _doubts_of_survey(posed, solution, uncertainty)
    yield from _doubts_of_fit(solution.fit, per_anchor)


def _doubts_of_survey(posed: ScaleProblem, solution: Solution, uncertainty: ScaleUncertainty) -> Iterator[Doubt]:
    """Return the faults of the path and of the anchors."""
    problem, half_width = solution.problem, uncertainty.half_width_95
    kind, heard = path_kind(problem.centers), np.unique(problem.anchor_index)
    is_round = kind in ("circular", "spherical") and not np.isfinite(problem.anchor_stddev_m[heard]).any()
    # On these paths the scale is uncertain because of their shape: a longer walk of the same shape would not help.
    if half_width > DOUBTFUL_ABOVE and is_round:
        yield Doubt(*WHY_SCALE_IS_OPEN[kind])
    elif np.linalg.norm([uncertainty.components.get(name, 0.0) for name in BENDS]) > NOTHING_KNOWN:
        overlap = "take photos that overlap more, and range more often"
        yield Doubt("ranges and photos leave the shape of the map open", overlap)
    elif half_width > NORMAL_95 * NOTHING_KNOWN:
        yield Doubt("the ranges do not show that the camera moved", "walk a loop of several metres")
    for note in posed.notes:
        yield Doubt(note, "survey three anchors or more that are not on one line")
    if ids := posed.left_out:
        which = f"anchor {ids[0]} has" if len(ids) == 1 else f"anchors {', '.join(ids)} have"
        reason = f"{which} too few ranges on the path to be placed: left out"
        yield Doubt(reason, "range more often, or survey them all")
    stddevs = path_shape(problem.centers).stddevs
    if stddevs[1] < NEARLY_STRAIGHT * stddevs[0]:
        if np.isinf(problem.anchor_stddev_m).any():
            yield Doubt("the path is nearly straight: an unknown anchor may stand anywhere on a circle around it")
        elif problem.frame_is_free:
            yield Doubt("the path is nearly straight: the map's roll about it is uncertain")


def _doubts_of_fit(fit: RangeFit, per_anchor: Mapping[str, float]) -> Iterator[Doubt]:
    if len(fit.weights) < FEW_RANGES:
        reason = f"only {len(fit.weights)} ranges lie on the path"
        yield Doubt(reason, "range more often, and all along the path")
    outliers = float(np.mean(fit.weights < OUTLIER_BELOW))
    if outliers > MANY_OUTLIERS:
        reason = f"{100 * outliers:.0f} % of the ranges do not fit the map: blocked, reflected, or of another anchor"
        yield Doubt(reason, "place the anchors where nothing stands between them and the path")
    if len(per_anchor) > 1:
        spread = float(np.std(np.log(np.array(list(per_anchor.values()))), ddof=1))
        if spread > _MAX_ANCHOR_SPREAD:
            reason = f"the anchors disagree: the scales found with each of them alone scatter by {100 * spread:.1f} %"
            yield Doubt(reason, "check the anchors' positions and antenna delays, and place them in the open")


def remarks_on_anchors(solution: Solution, anchors: Sequence[AnchorEstimate]) -> Iterator[Doubt]:
    """Yield what is not determined but does not affect the scale."""
    stddevs = path_shape(solution.problem.centers).stddevs
    if stddevs[2] >= NEARLY_FLAT * stddevs[0] or all(a.mirror_position_m is None for a in anchors):
        return
    reason = "the path is nearly flat: nothing tells on which side of it the unknown anchors stand (the scale is right)"
    yield Doubt(reason, "raise and lower the camera on the way, or survey the anchors")


def remarks_on_places(uncertainty: ScaleUncertainty, with_unknown_anchors: ScaleUncertainty) -> Iterator[Doubt]:
    """Yield that the anchors' coordinates widen the interval, as they do where they contradict the ranges.

    Args:
        with_unknown_anchors: uncertainty if no place of an anchor were known.
    """
    if not uncertainty.half_width_95 > _WIDENED * with_unknown_anchors.half_width_95:
        return
    yield Doubt(
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
