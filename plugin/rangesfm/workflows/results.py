"""What a finished run hands over: all files of the result folder, the report on them, and a summary."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rangesfm.ceres.doctor import versions
from rangesfm.comparison.with_reference import format_table, papers_table, reference_in_frame
from rangesfm.distances.ends import locate_distances
from rangesfm.distances.rows import disagreements, distance_rows
from rangesfm.export import COVARIANCE_FORMATS
from rangesfm.geometry.georeference import Georeference
from rangesfm.geometry.reference import write_reference
from rangesfm.report import write_report
from rangesfm.result.content import survey_result
from rangesfm.result.metric_result import MetricResult
from rangesfm.result.outputs import (
    replacing_result,
    summary_lines,
    write_outputs,
    write_result,
    write_scale_tables,
)
from rangesfm.survey.input_hashes import input_hashes
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.workflows.journal import Journal


@dataclass(frozen=True)
class RunResult:
    """What a run left.

    Attributes:
        output_path: its folder.
        result: the content of ``result.json``; after a reconstruction alone, seconds and warnings.
        lines: a summary for people.
    """

    output_path: Path
    result: dict[str, Any]
    lines: tuple[str, ...]

    def summary_lines(self) -> list[str]:
        return list(self.lines)


def write_results(survey: Survey, inputs: RangingInputs, metric: MetricResult, journal: Journal) -> RunResult:
    """All files of the result, ``result.json`` after all others, and the report on them."""
    if not metric.center_covariance_m2 and (left_out := set(COVARIANCE_FORMATS) & set(survey.export.formats)):
        journal.warn(f"without covariances of the poses there is no {', '.join(sorted(left_out))}")
    if metric.estimate.frame == "site":
        metric = metric.moved(inputs.site.offset_m)
    distances = _distances(inputs, metric)
    disagreeing = tuple(disagreements(distances, metric.estimate.uncertainty.empirical))
    for note in disagreeing:
        journal.warn(note)
    metric = metric.doubted(disagreeing)
    result = survey_result(metric)
    with replacing_result(survey.output.path):
        with journal.stage("results"):
            result["distances"] = distances
            table = _compare(survey, inputs, metric, result)
            georeference = _georeference(inputs, metric)
            result["georeference"] = georeference and georeference.to_dict()
            write_outputs(
                metric, survey.export, survey.output.path, images_path=survey.images.path, georeference=georeference
            )
            write_scale_tables(metric, survey.output.path)
        result["versions"], result["settings"] = versions(), survey.to_dict()
        result["inputs"] = input_hashes(survey)
        result["seconds"], result["warnings"] = journal.all_seconds(), journal.warnings
        write_result(result, survey.output.path / "result.json")
    lines = [*summary_lines(metric, result, table, survey.output.path)]
    if survey.report.enabled:
        lines.append(f"report: {write_report(survey.output.path)}")
    return RunResult(survey.output.path, result, tuple(lines))


def _georeference(inputs: RangingInputs, metric: MetricResult) -> Georeference | None:
    """Of the final map: that of the anchors, if the map could be carried to them."""
    return inputs.site.georeference if metric.estimate.frame == "site" else None


def _distances(inputs: RangingInputs, metric: MetricResult) -> list[dict[str, Any]]:
    """The table of control and check distances in the final map."""
    if inputs.tape is None:
        return []
    located = locate_distances(inputs.tape, metric.final, [anchor.anchor_id for anchor in metric.anchors])
    anchors_m = np.array([anchor.position_m for anchor in metric.anchors]).reshape(-1, 3)
    return distance_rows(inputs.tape, located.lengths_m(1.0, anchors_m))


def _compare(survey: Survey, inputs: RangingInputs, metric: MetricResult, result: dict[str, Any]) -> str | None:
    """Add the paper's table to the result where there is a reference; returns it as text."""
    if inputs.reference is None:
        return None
    frame = metric.estimate.frame
    scaled = metric.path_of(metric.scaled)
    refined = None if metric.refined is None else metric.path_of(metric.refined)
    rows = papers_table(scaled, refined, inputs.reference, frame=frame)
    result["comparison"] = [asdict(row) for row in rows]
    in_frame = reference_in_frame(refined or scaled, inputs.reference, frame=frame)
    if in_frame is not None:
        write_reference(in_frame, survey.output.path / "reference.csv")
    return format_table(rows)
