"""Closing of the loops of a mapper's model, before anything is known in metres: by its photos alone."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import pycolmap

from rangesfm.colmap.model_files import write_binary_model
from rangesfm.colmap.reprojection import point_errors
from rangesfm.errors import GeometryError, SolverError
from rangesfm.estimation.map_problem import MapProblem
from rangesfm.estimation.photo_bending import LARGEST_FACTOR
from rangesfm.estimation.refinement import MapAtRest, joint_errors, refine, refine_with_loops
from rangesfm.estimation.vision_information import LoopPoses
from rangesfm.pipeline.loop_matching import loop_matching
from rangesfm.pipeline.matched_map import MatchedMap, MergeTracks
from rangesfm.progress import Journal
from rangesfm.result.result_folder import RESULT_NAMES
from rangesfm.sfm.loop_database import LoopMatching, has_closed_loops
from rangesfm.sfm.loops.rounds import TriedPairs, close_in_rounds
from rangesfm.sfm.steps import MODELS_NAME, Workspace
from rangesfm.survey.settings import Survey
from rangesfm.util.files.output_folder import OutputFolder, sole_writer
from rangesfm.util.geometry.map_errors import MapErrors
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction


def close_loops_of_models(
    survey: Survey, models: Sequence[pycolmap.Reconstruction], journal: Journal
) -> pycolmap.Reconstruction:
    """Close the loops of the largest model of a reconstruction, in its place, and return the model.

    Where they are not to be closed, or an earlier run has closed them, the model stays as it is.

    Args:
        models: of the output folder, which has their database and record.
    """
    with sole_writer(survey.output.path) as output:
        if has_closed_loops(Workspace(output.path, journal.progress)):
            return models[0]
        if (matching := loop_matching(survey, journal.progress, output)) is None:
            return models[0]
        try:
            closed = _closed(survey, models[0], matching, journal)
        except (GeometryError, SolverError) as error:
            journal.warn(f"loops are not closed: {error}")
            matching.discard()
            return models[0]
        _publish(output, matching, closed)
        return closed or models[0]


def _closed(
    survey: Survey, model: pycolmap.Reconstruction, matching: LoopMatching, journal: Journal
) -> pycolmap.Reconstruction | None:
    """Return a copy of a model with its loops closed; None if no loops are found.

    Raises:
        GeometryError: the photos do not determine the poses, or have other features in the database.
        SolverError: the model cannot be adjusted.
    """
    if why_not := matching.why_unfit(model):
        raise GeometryError(why_not)
    with journal.stage("refinement"):
        start = _UnscaledMap.at_rest_by_photos(survey, model)
    if start.errors is None:
        raise GeometryError("the covariance of the poses is not known")
    last, tried = close_in_rounds(MatchedMap(start, matching, journal, survey.output.seed, asks_vocabulary=True))
    last.keep(tried)
    matching.keep_closed()
    journal.progress.message(_told(tried))
    return last.map.model if tried.closed else None


@dataclass(frozen=True)
class _UnscaledMap:
    """A model at rest, in any unit.

    Attributes:
        survey: its options. trajectory: path of its keyframes.
        at_rest: the model, with no measurements but its photos.
    """

    survey: Survey
    trajectory: Trajectory
    at_rest: MapAtRest

    @classmethod
    def at_rest_by_photos(cls, survey: Survey, model: pycolmap.Reconstruction) -> _UnscaledMap:
        """Adjust a copy of a mapper's model until it is at rest."""
        path = trajectory_from_reconstruction(model)
        return cls(survey, path, refine(_problem(survey, path, model, is_refined=False), {}))

    @property
    def model(self) -> pycolmap.Reconstruction:
        return self.at_rest.problem.metric

    @property
    def pixel_stddev(self) -> float:
        return self.at_rest.pixel_stddev

    @cached_property
    def errors(self) -> MapErrors | None:
        """Return the errors of a map that is bent as much as photos usually bend maps, since nothing tells how much."""
        found = joint_errors(self.at_rest, LARGEST_FACTOR)
        return None if found is None else found.errors

    @property
    def why_broken(self) -> tuple[str, ...]:
        errors = point_errors(self.model)
        return () if errors.fit else (errors.apart("the refined map"),)

    def with_loops(self, loops: LoopPoses, merge: MergeTracks) -> _UnscaledMap | None:
        problem = _problem(self.survey, self.trajectory, self.model, is_refined=True)
        rest = refine_with_loops(problem, problem, {}, loops, merge)
        return None if rest is None else _UnscaledMap(self.survey, self.trajectory, rest)


def _problem(survey: Survey, path: Trajectory, model: pycolmap.Reconstruction, *, is_refined: bool) -> MapProblem:
    return MapProblem(
        pycolmap.Reconstruction(model),
        (),
        path.frame_ids,
        survey.camera,
        survey.refine,
        first_pose_is_fixed=True,
        is_placed=False,
        num_threads=survey.mapper.num_threads,
        is_refined=is_refined,
    )


def _told(tried: TriedPairs) -> str:
    """Return the line that says which loops were closed."""
    wrong = f"; {len(tried.contradicted)} contradict the model and were not used" if tried.contradicted else ""
    return (
        f"loops: {len(tried.proposed)} pairs of photos may show the same place; {len(tried.verified)} of them match; "
        f"{len(tried.closed)} were used to close loops{wrong}"
    )


def _publish(output: OutputFolder, matching: LoopMatching, closed: pycolmap.Reconstruction | None) -> None:
    """Put a closed model in the place of ``sparse/0``, with its database and record; None: no loop was closed.

    Results that were made from the model before are removed.
    """
    if closed is None:
        matching.publish_with(output)
        return
    models, staged = output.path / MODELS_NAME, matching.folder / MODELS_NAME
    shutil.copytree(models, staged, dirs_exist_ok=True, ignore=lambda *_: ["0"])
    (staged / "0").mkdir(exist_ok=True)
    write_binary_model(closed, staged / "0")
    matching.publish_with(output, {models: staged}, [output.path / name for name in RESULT_NAMES])
