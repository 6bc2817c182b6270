"""Tests of mistakes on a survey's map."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rangesfm.result.metric_result import MetricResult
from rangesfm.survey.settings import Survey
from rangesfm.trust.ranges_on_map import RangesOnMap, ranges_on_map
from rangesfm.trust.verdict import trust_in
from rangesfm.workflows.journal import Journal


def tested(survey: Survey, metric: MetricResult, journal: Journal) -> MetricResult:
    """The map with what the tests of mistakes say of it, and doubted if one was found.

    The scaled map is looked at, refined or not: a refinement bends a map to ranges that are wrong.
    """
    try:
        trust = trust_in(scaled_ranges(metric), seed=survey.output.seed)
    except np.linalg.LinAlgError as error:
        journal.warn(f"mistakes were not looked for, as the ranges determine too little: {error}")
        return metric
    for reason in trust.reasons:
        journal.warn(reason)
    return replace(metric, trust=trust).doubted(trust.reasons)


def scaled_ranges(metric: MetricResult) -> RangesOnMap:
    """The ranges on the scaled map."""
    estimate = metric.estimate
    return ranges_on_map(estimate.problem, estimate.solution, estimate.observations, metric.trajectory)
