"""Results of a finished run: all files of the result folder, the report, and a summary for the terminal."""

from __future__ import annotations

from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path

from rangesfm.comparison.with_reference import papers_table, reference_in_frame
from rangesfm.errors import BAD_INPUT, InputError
from rangesfm.export import COVARIANCE_FORMATS, export_map, write_model
from rangesfm.pipeline.export_result import map_of_result
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.pipeline.result_records import summary_of, tables_of
from rangesfm.report import write_report_of
from rangesfm.report.content import Content
from rangesfm.result.comparison_row import ComparisonRow
from rangesfm.result.joint_covariance import write_map_errors
from rangesfm.result.places import recorded_path, recorded_settings
from rangesfm.result.result_folder import REFERENCE_NAME, ResultFolder, new_result, read_result_folder
from rangesfm.solver.installation_checks import recorded_versions
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import input_hashes
from rangesfm.survey.survey_run import SurveyRun
from rangesfm.util.files.atomic import path_of
from rangesfm.util.geometry.reference import write_reference


def write_results(run: SurveyRun, metric: MetricResult) -> ResultFolder:
    """Write all files of the result, with ``result.json`` last, and the report.

    Raises:
        InputError: a format of [export] cannot be written, but everything else has been; or a file that a result would
            replace was not written by this tool, and nothing has been written.
    """
    survey, journal = run.survey, run.journal
    if not metric.center_covariance_m2 and (left_out := set(COVARIANCE_FORMATS) & set(survey.export.formats)):
        journal.warn(f"without covariances of the poses there is no {', '.join(sorted(left_out))}")
    folder = survey.output.path
    with new_result(folder, survey.images.path) as staged:
        with journal.stage("results"):
            comparison = _comparison(metric, staged)
            _write_models_and_tables(metric, staged)
            summary = summary_of(
                metric,
                **({"comparison": comparison} if comparison else {}),
                versions=recorded_versions(),
                settings=recorded_settings(survey),
                inputs=[{**one, "path": recorded_path(path_of(one["path"]), folder)} for one in input_hashes(survey)],
                seconds={},
                computed=datetime.now(timezone.utc).isoformat(timespec="seconds"),
                warnings=journal.warnings,
                notes=journal.notes,
            )
            result = ResultFolder(folder, summary, metric.trajectory.times_by_name)
            not_exported = _export(survey, metric, result, staged)
        summary = summary.model_copy(update={"seconds": journal.all_seconds()})
        summary.write(staged / summary.NAME)
        if survey.report.enabled:
            with journal.stage("report"):
                content = Content(read_result_folder(staged), images_path=survey.images.path, home=folder)
                write_report_of(content, staged)
    if not_exported is not None:
        raise not_exported
    return replace(result, summary=summary)


def _comparison(metric: MetricResult, folder: Path) -> tuple[ComparisonRow, ...]:
    """Return the comparison with the reference, empty without one; write the reference in the frame of the map."""
    reference = metric.inputs.reference
    if not len(reference):
        return ()
    frame, paths = metric.estimate.frame, {"scaled": metric.trajectory.as_in(metric.scaled)}
    if metric.kept is not None:
        if metric.kept.loops is not None and metric.kept.loops.closed:
            paths["refined, loops open"] = metric.kept.loops.before
        paths["refined"] = metric.trajectory.as_in(metric.final)
    rows = papers_table(paths, reference, frame=frame)
    *_, final = paths.values()
    in_frame = reference_in_frame(final, reference, frame=frame)
    if len(in_frame):
        write_reference(in_frame, folder / REFERENCE_NAME)
    return rows


def _write_models_and_tables(found: MetricResult, folder: Path) -> None:
    write_model(found.scaled, folder / "sparse_scaled" / "0")
    if found.refined is not None:
        write_model(found.final, folder / "sparse_metric" / "0")
    for table in tables_of(found):
        table.write(folder)
    if found.map_errors.are_known:
        write_map_errors(found.map_errors, folder)


def _export(survey: Survey, found: MetricResult, result: ResultFolder, folder: Path) -> InputError | None:
    """Write the export formats of a result into a new folder.

    Formats that this result cannot have (points or covariances without any) are left out.

    Returns:
        The error of a format that cannot be written, for a warning; None if all were written.

    Raises:
        RangesfmError: something else failed, such as a full disk.
    """
    map_ = map_of_result(result, found.final, found.center_covariance_m2)
    impossible = [] if found.final.num_points3D() else ["ply"]
    impossible += [] if found.center_covariance_m2 else COVARIANCE_FORMATS
    formats = tuple(name for name in survey.export.formats if name not in impossible)
    try:
        export_map(replace(map_, images_path=survey.images.path), folder, survey.export.changed(formats=formats))
    except InputError as error:
        if error.exit_status != BAD_INPUT:  # a full disk, on which the rest of the result cannot be written either
            raise
        return error
    return None
