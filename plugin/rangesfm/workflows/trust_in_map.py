"""Tests of mistakes on a survey's map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.geometry.trajectory import Trajectory
from rangesfm.result.metric_result import MetricResult
from rangesfm.scale.estimate import ScaleEstimate
from rangesfm.survey.settings import Survey
from rangesfm.trust.lengths import trust_in_lengths
from rangesfm.trust.ranges_on_map import RangesOnMap, ranges_on_map
from rangesfm.trust.verdict import sentence, trust_in
from rangesfm.workflows.journal import Journal


def tested(survey: Survey, metric: MetricResult, journal: Journal) -> MetricResult:
    """The map with what the tests of mistakes say of it, and doubted if one was found.

    The scaled map is looked at, refined or not: a refinement bends a map to ranges that are wrong.
    """
    trust = trust_in_lengths(metric.estimate, metric.tape)
    try:
        if (on_map := scaled_ranges(metric.estimate, metric.trajectory)) is not None:
            trust = trust_in(on_map, seed=survey.output.seed).with_more(trust)
    except np.linalg.LinAlgError as error:
        journal.warn(f"mistakes were not looked for, as the ranges determine too little: {error}")
    for reason in trust.reasons:
        journal.warn(reason)
    return replace(metric, trust=trust).doubted(trust.reasons)


def named_causes(estimate: ScaleEstimate, trajectory: Trajectory, seed: int) -> str:
    """The likeliest mistake in a sentence; nothing where none is found."""
    on_map = scaled_ranges(estimate, trajectory)
    try:
        causes = () if on_map is None else trust_in(on_map, seed=seed).causes
    except np.linalg.LinAlgError:
        return ""
    return sentence(causes) if causes else ""


def scaled_ranges(estimate: ScaleEstimate, trajectory: Trajectory) -> RangesOnMap | None:
    """The ranges on the scaled map; None where there are none."""
    if estimate.problem is None or estimate.solution is None:
        return None
    return ranges_on_map(estimate.problem, estimate.solution, estimate.observations, trajectory)
