"""Results of a finished run: all files of the result folder, the report, and a summary for the terminal."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path

import numpy as np

from rangesfm.ceres.installation_checks import recorded_versions
from rangesfm.comparison.with_reference import format_table, papers_table, reference_in_frame
from rangesfm.distances.locate_lengths import locate_distances
from rangesfm.distances.tape import DistanceRow, disagreements, distance_rows
from rangesfm.export import COVARIANCE_FORMATS
from rangesfm.geometry.reference import write_reference
from rangesfm.positions.surveyed_positions import PointsEntry
from rangesfm.report import write_report_of
from rangesfm.report.content import Content
from rangesfm.result.entries import ComparisonRow
from rangesfm.result.metric_result import MetricResult
from rangesfm.result.places import recorded_inputs, recorded_settings
from rangesfm.result.result_folder import (
    REFERENCE_NAME,
    REPORT_NAME,
    new_result,
    read_result_folder,
    write_models_and_tables,
)
from rangesfm.result.summary import ResultSummary
from rangesfm.scale.scale_by_lengths import BENDING
from rangesfm.survey.inputs import RangingInputs, input_hashes
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.vision.steps import DATABASE_NAME


@dataclass(frozen=True)
class RunResult:
    """Outcome of a run. Its files are read by ``read_result_folder``.

    Attributes:
        output_path: folder of the result.
        summary: content of ``result.json``.
        lines: summary for the user.
    """

    output_path: Path
    summary: ResultSummary
    lines: tuple[str, ...]

    def __repr__(self) -> str:
        """Return the summary for the user."""
        return "\n".join(self.lines)


def write_results(run: SurveyRun, metric: MetricResult) -> RunResult:
    """Write all files of the result, with ``result.json`` last, and the report.

    Raises:
        InputError: a format of [export] cannot be written, but everything else has been; or a file that a result would
            replace was not written by this tool, and nothing has been written.
    """
    survey, inputs, journal = run.survey, run.inputs, run.journal
    if not metric.center_covariance_m2 and (left_out := set(COVARIANCE_FORMATS) & set(survey.export.formats)):
        journal.warn(f"without covariances of the poses there is no {', '.join(sorted(left_out))}")
    distances = _distances(metric)
    disagreeing = tuple(disagreements(distances, metric.estimate.uncertainty.empirical, BENDING))
    journal.warn(*disagreeing)
    metric = metric.doubted(disagreeing)
    folder = survey.output.path
    with new_result(folder, survey.images.path) as staged:
        with journal.stage("results"):
            comparison = _comparison(inputs, metric, staged)
            # The georeference of the anchors is that of the map, if the map is in their frame.
            georeference = inputs.site.georeference if metric.estimate.frame == "site" else None
            not_exported = write_models_and_tables(
                metric,
                survey.export,
                staged,
                database_path=folder / DATABASE_NAME,
                images_path=survey.images.path,
                georeference=georeference,
            )
        summary = ResultSummary.of(
            metric,
            distances=distances,
            points=_points(metric),
            **({"comparison": comparison} if comparison else {}),
            georeference=georeference,
            versions=recorded_versions(),
            settings=recorded_settings(survey),
            inputs=recorded_inputs(input_hashes(survey), survey),
            seconds=journal.all_seconds(),
            computed=datetime.now(timezone.utc).isoformat(timespec="seconds"),
            warnings=journal.warnings,
            notes=journal.notes,
        )
        summary.write(staged / summary.NAME)
        if survey.report.enabled:
            with journal.stage("report"):
                content = Content(read_result_folder(staged), images_path=survey.images.path, home=folder)
                write_report_of(content, staged)
    lines = [*summary.lines(folder, format_table(comparison, summary.frame) if comparison else None)]
    if survey.report.enabled:
        lines.append(f"report: {folder / REPORT_NAME}")
    if not_exported is not None:
        raise not_exported
    return RunResult(folder, summary, tuple(lines))


def _distances(metric: MetricResult) -> list[DistanceRow]:
    """Return the table of control and check distances in the final map; empty without measured lengths."""
    if metric.tape is None:
        return []
    located = locate_distances(metric.tape, metric.final, [anchor.anchor_id for anchor in metric.anchors])
    anchors_m = np.array([anchor.position_m for anchor in metric.anchors]).reshape(-1, 3)
    return distance_rows(metric.tape, located.lengths_m(1.0, anchors_m))


def _points(metric: MetricResult) -> PointsEntry | None:
    if metric.estimate.frame != "site":
        return None
    return PointsEntry.of(metric.positions, metric.final, metric.trajectory.as_in(metric.final))


def _comparison(inputs: RangingInputs, metric: MetricResult, folder: Path) -> tuple[ComparisonRow, ...]:
    """Return the comparison with the reference, empty without one; write the reference in the frame of the map."""
    if inputs.reference is None:
        return ()
    frame = metric.estimate.frame
    scaled = metric.trajectory.as_in(metric.scaled)
    refined = None if metric.kept_refinement is None else metric.trajectory.as_in(metric.final)
    loops_open = None if metric.loops is None else metric.loops.before
    rows = papers_table(scaled, refined, inputs.reference, frame=frame, loops_open=loops_open)
    in_frame = reference_in_frame(refined or scaled, inputs.reference, frame=frame)
    if in_frame is not None:
        write_reference(in_frame, folder / REFERENCE_NAME)
    return rows
