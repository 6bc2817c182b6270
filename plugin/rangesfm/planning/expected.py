"""Expected result of a planned survey: what a run will state of its map, from its linear problem at the true one.

The kinds of measurement, their equations and errors, and the verdict are those of the run (sections 5 to 9 of
``model.md``). Only the sizes of the errors are given, as nothing has been measured that shows them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from rangesfm.arrays import Array, Indices
from rangesfm.diagnostics.place import by_similarity
from rangesfm.errors import GeometryError
from rangesfm.estimation.free_fit import GraphBending
from rangesfm.estimation.scale.scale_estimate import Verdict, judge
from rangesfm.estimation.vision_information import VisionInformation
from rangesfm.measurements.joint_map import JointMap, KindOnMap, observations, upward_by
from rangesfm.options import ScaleOptions
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.planned_kinds import kinds_at_truth
from rangesfm.planning.planned_ranges import OPEN
from rangesfm.solver.bending import Bending, MapBending, WalkBending
from rangesfm.solver.linear_map import Columns
from rangesfm.solver.noise import MAX_NUM_OBSERVATIONS
from rangesfm.solver.posterior import Observations, ScaleUncertainty, joined
from rangesfm.util.geometry.similarity import IDENTITY, similarity_motions
from rangesfm.util.geometry.trajectory import Trajectory

# Numbers of ranges, of observations of a kind and of keyframes in the quick computation that compares plans.
_NUM_COMPARED_RANGES, _NUM_COMPARED_OBSERVATIONS, _NUM_COMPARED_KEYFRAMES = 600, 120, 15
# Number of keyframes for which the uncertainty is computed; it is interpolated between them.
_NUM_KEYFRAMES = 40
# Name of the coordinates of keyframes, which are predicted.
_KEYFRAMES = "keyframes"


@dataclass(frozen=True)
class PlannedBending:
    """Bending of a map that has not been made yet, in which the sizes of all errors are given.

    Attributes:
        bending: of such maps.
        sizes: of errors in the map that are known better than from other surveys, by name. That of a part of the
            bending is its root mean square over the coordinates of the keyframes, metres.
    """

    bending: MapBending
    sizes: Mapping[str, float]

    @property
    def path(self) -> Trajectory:
        return self.bending.path

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> Bending:
        bent, usual_m = self.bending.of_functions(by_pose, frame_is_free=frame_is_free), dict[str, float]()
        if self.sizes.keys() & {part.name for part in bent.parts}:
            of_keyframes = _by_pose(np.arange(len(self.path)), len(self.path))
            found = self.bending.of_functions(of_keyframes, frame_is_free=frame_is_free)
            usual_m = {part.name: part.median for part in found.parts if part.name in self.sizes}
        parts = (
            replace(part, median=self.sizes[part.name] * part.median / usual_m[part.name], spread=0.0)
            if part.name in usual_m
            else part
            for part in bent.parts
        )
        return replace(bent, parts=tuple(parts), given_sizes=self.sizes)


@dataclass(frozen=True)
class Expected:
    """Uncertainty that a run will state.

    Attributes:
        planned: the planned survey.
        vision: information of its photos; None: the map bends as maps of poses do.
        on_map: all that is measured on the true map, with the keyframes; None: a run will refuse the survey.
        notes: why measurements are not used, in words; why a run will refuse the survey.
    """

    planned: PlannedSurvey
    vision: VisionInformation | None
    on_map: JointMap | None
    notes: tuple[str, ...] = ()

    @property
    def kinds(self) -> tuple[KindOnMap, ...]:
        """All that is measured on the map."""
        return () if self.on_map is None else self.on_map.kinds

    @property
    def uncertainty(self) -> ScaleUncertainty:
        """Uncertainty of the scale."""
        return ScaleUncertainty(np.inf, {}) if self.on_map is None else self.on_map.posterior.uncertainty

    @property
    def placement(self) -> Array | None:
        """Covariance (7, 7) of the map as a whole about its first camera; None if it is not placed in the site."""
        if self.on_map is None:
            return OPEN**4 * np.eye(7) if self.planned.anchor_frame == "site" else None
        return self.on_map.posterior.placement

    @property
    def frame(self) -> str:
        """Frame of the result, "site" or "first_camera"."""
        return "first_camera" if self.placement is None else "site"

    @property
    def verdict(self) -> Verdict:
        """Verdict of the run on the scale.

        Raises:
            GeometryError: the run will refuse the scale.
        """
        if self.on_map is None:
            raise GeometryError(*self.notes)
        return judge(self.kinds[0].doubts(self.uncertainty), (), self.uncertainty, ScaleOptions())

    @property
    def up_stddev_deg(self) -> float | None:
        """Standard deviation of the vertical; None where it is not measured."""
        gravity = upward_by(self.kinds, None)
        return None if gravity is None else float(np.rad2deg(gravity.stddev_rad))

    @property
    def map_stddevs(self) -> Array | None:
        """Standard deviations (7,) of the map's similarity about its mean; inf: not determined, None: not placed."""
        placement = self.placement
        if placement is None:
            return None
        return _stddevs(np.diag(by_similarity(placement, self.planned.trajectory.centers)[0]))

    def stddevs_at(self, places_m: Array) -> Array:
        """Return the standard deviations (n,) of points (n, 3) of a map in one piece, metres; inf if not determined.

        Each is the root of the summed variances of the three coordinates in the result's frame. If the map is not
        placed in the site, only the scale contributes, with the first camera fixed.
        """
        motions, placement = similarity_motions(places_m - self.planned.trajectory.centers[0]), self.placement
        if placement is None:
            placement = np.diag([self.uncertainty.empirical**2, *np.zeros(6)])
        return _stddevs(np.einsum("nij,jk,nik->n", motions, placement, motions))

    @cached_property
    def keyframe_stddevs_m(self) -> Array:
        """(n,) roots of the summed variances of each keyframe's position in the result's frame; inf: not determined.

        A keyframe's error is that of the map as a whole and its bending, as far as the measurements leave it open.
        """
        num = len(self.planned.trajectory)
        if self.on_map is None:
            return np.full(num, np.inf)
        covariance = self.on_map.problem.predicted_m2(_KEYFRAMES, self.on_map.posterior.covariance)
        stddevs_m = np.sqrt(np.maximum(np.diag(covariance).reshape(-1, 3).sum(axis=1), 0.0))
        of_all = np.interp(np.arange(num), _some(num, len(stddevs_m)), stddevs_m)
        return np.where(of_all < OPEN, of_all, np.inf)

    @property
    def worst_keyframe_m(self) -> float:
        """Standard deviation of the position of the least certain keyframe, metres; NaN if the map is not placed."""
        return float("nan") if self.frame != "site" else float(self.keyframe_stddevs_m.max())


def _stddevs(variances: Array) -> Array:
    stddevs = np.sqrt(np.maximum(variances, 0.0))
    return np.where(stddevs < OPEN, stddevs, np.inf)


def expect_roughly(planned: PlannedSurvey, vision: VisionInformation | None = None) -> Expected:
    """Compute ``expect`` with fewer ranges, observations and keyframes, in a tenth of the time, to compare plans."""
    few = replace(planned, max_num_ranges=_NUM_COMPARED_RANGES)
    # As many of each kind, whatever others there are, so that plans can be compared.
    max_num = _NUM_COMPARED_OBSERVATIONS * min(len(planned.by_kind), 2)
    return expect(few, max_num, _NUM_COMPARED_KEYFRAMES, vision)


def expect(
    planned: PlannedSurvey,
    max_num: int = MAX_NUM_OBSERVATIONS,
    num_keyframes: int = _NUM_KEYFRAMES,
    vision: VisionInformation | None = None,
) -> Expected:
    """Compute the uncertainty that a run will state.

    Args:
        max_num: about the largest number of observations; fewer are coarser.
        num_keyframes: number of keyframes for which the uncertainty is computed, and not interpolated.
        vision: of the planned photos, or of those of a similar path; None: it is computed where photos are planned.

    Raises:
        GeometryError: the run will find too few ranges on the path, nothing that determines the scale, or no two photos
            that see the same point.
    """
    path = planned.trajectory
    if vision is None and planned.photos is not None:
        vision = planned.photos.information(path)
    bending = PlannedBending(WalkBending(path) if vision is None else GraphBending(vision, path), planned.given_sizes)
    kinds, notes = kinds_at_truth(planned, bending)
    in_site = any(each.places_map for each in kinds)
    found = [*observations(kinds, IDENTITY, max_num), _keyframes(path, num_keyframes, in_site=in_site)]
    problem, observed = joined(found, bending), {each.kind: each for each in found}
    known = problem.posterior(is_refined=True)
    on_map = JointMap(kinds, IDENTITY, bending, True, observed, problem, known)
    return Expected(planned, vision, on_map, notes)


def _keyframes(path: Trajectory, num: int, *, in_site: bool) -> Observations:
    some, columns = _some(len(path), num), Columns.of_whole(7 if in_site else 1)
    motions = similarity_motions(path.centers[some] - path.centers[0]).reshape(-1, 7)
    none, by_pose = np.zeros(len(motions)), _by_pose(some, len(path))
    return Observations(
        columns,
        motions[:, : columns.num],
        none,
        kind=_KEYFRAMES,
        by_pose=by_pose,
        components=(),
        alone_m2=np.diag(none),
        is_used=none.astype(bool),
    )


def _some(num_keyframes: int, num: int) -> Indices:
    """Return the indices of about ``num`` keyframes, evenly chosen."""
    some: Indices = np.unique(np.linspace(0, num_keyframes - 1, num).astype(np.int64))
    return some


def _by_pose(keyframes: Indices, num: int) -> Array:
    """Return the (3 k, 6 n) derivatives of the coordinates of k keyframes by the poses of a path of n."""
    by_pose = np.zeros((len(keyframes), 3, num, 6))
    by_pose[np.arange(len(keyframes)), :, keyframes, 3:] = np.eye(3)
    return by_pose.reshape(3 * len(keyframes), -1)
