"""Bending of a map, as it affects what is measured in it (section 3 of ``model.md``)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from typing import NamedTuple, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.solver.noise import Component
from rangesfm.util.geometry.similarity import Similarity, align_points, similarity_motions
from rangesfm.util.geometry.trajectory import Trajectory

BENDS = {
    "scale_drift": "drift of the map's scale along the path",
    "heading_drift": "drift of the map's heading along the path",
    "bending": "bending of the map",
    "loose_parts": "size and place of parts of the map that its photos hardly tie to the rest",
}
"""Components that are errors of the map itself, with descriptions; their effect depends on the map."""

# Weight of turns against shifts in the fit of a similarity. Turns only matter for a turn about a straight path, which
# nothing else shows; elsewhere this weight is too small to have an effect.
_TURNS_COUNT = 1e-3
# Largest number of steps of a random walk: with more, the walk follows what errors that jump do.
_MAX_NUM_STEPS = 100
# Random drift from the start to the end of a path: relative change of the scale, turn in radians, and shift as a share
# of the path's length (medians over maps of poses alone); _SPREAD is the standard deviation of their logarithms.
# Source: tests.studies.drifting_maps. From its first to its last third the real path (ORB-SLAM, fr2_desk) changes by
# 0.6 % and 0.002 rad, simulated halls by 0.6 to 1.0 % and 0.003 to 0.004 rad, laps with 0.5 and 2 m of drift by 0.3 to
# 0.9 % and 0.001 to 0.004 rad. The remaining shift was learnt there as 0.0003 to 0.002. So few maps give the order of
# magnitude.
_OF_PATH = {"scale_drift": 0.004, "heading_drift": 0.002, "bending": 0.0005}
_SPREAD = 1.0
# What each of the numbers of a step belongs to: the logarithm of the scale, three of the turn and three of the shift.
_OF_STEP = np.array(["scale_drift", "heading_drift", "heading_drift", "heading_drift", "bending", "bending", "bending"])

LearnedSizes = Mapping[str, float]


@dataclass(frozen=True)
class Bending:
    """Effect of a map's bending on c functions of its path, such as observations.

    Attributes:
        parts: components of these errors, in metres.
        formal_m2: (c, c) covariance expected from the photos' residuals, without that of loose parts; zero if photos
            were not used.
        shift_m: (c,) change of the functions if the map moves to the minimum of the photos alone.
        given_sizes: sizes of errors in the map, by name, if none is to be learnt, as where nothing was measured yet;
            those that are missing are usual ones. None: they are learnt.
    """

    parts: tuple[Component, ...]
    formal_m2: Array
    shift_m: Array
    given_sizes: LearnedSizes | None = None


class FrameSteps(NamedTuple):
    """Steps of m frames of a map from where they are.

    Attributes:
        frame_ids: (m,). turns: (m, 3) in the frames' own axes, radians. shifts_m: (m, 3) in the map's world, metres.
    """

    frame_ids: Indices
    turns: Array
    shifts_m: Array

    def at(self, frame_ids: Indices) -> tuple[Array, Array]:
        """Return the turns (k, 3) and shifts (k, 3) of some frames; 0 for those that make none."""
        turns, shifts_m = np.zeros((2, len(frame_ids), 3))
        _, row, own = np.intersect1d(frame_ids, self.frame_ids, return_indices=True)
        turns[row], shifts_m[row] = self.turns[own], self.shifts_m[own]
        return turns, shifts_m


NO_STEPS = FrameSteps(np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3)))


class MapBending(Protocol):
    """Prior knowledge of how a map is bent."""

    @property
    def path(self) -> Trajectory:
        """Return the path of k poses that is bent, in the map's world and unit."""
        ...

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> Bending:
        """Return the bending of c functions of the path, such as coordinates.

        Args:
            by_pose: (c, 6 k) derivatives by turns of the poses in their own frames, and by shifts in the map's world.
            frame_is_free: whether the map's place is estimated; otherwise it is fixed to the first pose.
        """
        ...


def bending_parts(name: str, covariance: Array, factor: float, spread: float) -> tuple[Component, ...]:
    """Return a part in metres with ``factor`` as the median of its size; none if the functions are not affected.

    Args:
        covariance: (c, c) for a factor of 1. spread: standard deviation of the logarithm of the factor.
    """
    size_m = float(np.sqrt(np.trace(covariance) / max(len(covariance), 1)))
    return (Component(name, covariance / size_m**2, factor * size_m, spread),) if size_m > 0 else ()


def without_similarity(by_pose: Array, path: Trajectory, is_firm: Mask, *, frame_is_free: bool) -> Array:
    """Return the (c, 6 k) derivatives of functions made independent of the map's scale and place.

    The scale is that of the similarity that fits the centres best. The place is also that of the similarity if it is
    free; otherwise it is that of the first pose.

    Args:
        path: the k poses, in the map's world.
        is_firm: (k,) True for the poses whose centres count. One that hangs loose on the others may be anywhere, and
            would make size and place of the whole map as uncertain.
    """
    motions = _motions(path)
    return np.asarray(by_pose - (by_pose @ motions) @ similarity_of(path, is_firm, frame_is_free=frame_is_free))


def similarity_of(path: Trajectory, is_firm: Mask, *, frame_is_free: bool) -> Array:
    """Return the (7, 6 k) derivatives of the similarity of a path by its poses; arguments as above."""
    motions = _motions(path)
    size = float(np.linalg.norm(path.centers.std(axis=0))) or 1.0
    weights = np.outer(is_firm, np.repeat([size * _TURNS_COUNT, 1.0], 3)).ravel()
    weighted = motions * weights[:, None]
    lengths = np.maximum(np.linalg.norm(weighted, axis=0), 1e-300)  # in no unit, so that none is too small to count
    of_poses = np.linalg.pinv(weighted / lengths, rcond=1e-6) / lengths[:, None] * weights
    if not frame_is_free:
        of_poses[1:] = 0.0
        of_poses[1:4, :3] = path.world_from_cam[0]
        of_poses[4:, 3:6] = np.eye(3)
    return np.asarray(of_poses)


def motions_of_poses(world_from_rig: Array, from_origin: Array) -> Array:
    """Return the (n, 6, 7) motions of poses by the logarithm of the scale, a turn and a shift about an origin.

    Args:
        world_from_rig: (n, 3, 3). from_origin: (n, 3) their centres.
    """
    motions = np.zeros((len(from_origin), 6, 7))
    motions[:, :3, 1:4] = np.swapaxes(world_from_rig, 1, 2)
    motions[:, 3:] = similarity_motions(from_origin)
    return motions


def _motions(path: Trajectory) -> Array:
    return motions_of_poses(path.world_from_cam, path.centers - path.centers[0]).reshape(-1, 7)


@dataclass(frozen=True)
class WalkBending:
    """Random-walk drift of a map of poses alone.

    Scale, heading and place change randomly from pose to pose. A change at one pose carries all later poses along, so
    these are random walks along the path.

    Attributes:
        given: the original path, in the map's world.
        steps: (s, 7) corrections at some of the poses: logarithm of the scale, turn and shift, in units of the walks'
            standard deviations from start to end; empty: no correction.
        frame_is_free: as in ``of_functions``, for the corrected path.
    """

    given: Trajectory
    steps: Array = field(default_factory=lambda: np.zeros((0, 7)))
    frame_is_free: bool = False

    @property
    def is_corrected(self) -> bool:
        """Whether there are corrections."""
        return len(self.steps) > 0

    def of_functions(self, by_pose: Array, *, frame_is_free: bool) -> Bending:
        num = len(by_pose)
        factors = self.factors(by_pose, frame_is_free=frame_is_free)
        shift_m = -np.einsum("csi,si->c", factors, self.steps) if self.is_corrected else np.zeros(num)
        found = list[Component]()
        for name, median in _OF_PATH.items():
            own = factors[:, :, name == _OF_STEP].reshape(num, -1)
            found += bending_parts(name, own @ own.T, median, _SPREAD)
        return Bending(tuple(found), np.zeros((num, num)), shift_m)

    def factors(self, by_pose: Array, *, frame_is_free: bool) -> Array:
        """Return the (c, s, 7) derivatives of c functions of the path by each step; arguments as in of_functions."""
        path = self.path
        functions = without_similarity(by_pose, path, np.ones(len(path), dtype=bool), frame_is_free=frame_is_free)
        starts, unit = self._steps_of_path
        return np.asarray(_after(functions, path, starts) * unit)

    def bent_back(self, pull: Array, sizes: LearnedSizes, *, frame_is_free: bool) -> WalkBending:
        """Return the walk corrected by the most likely steps.

        Args:
            pull: (6 k,) derivatives by the poses of the sum of all bins, each multiplied by its residual times the
                inverse covariance.
            sizes: learnt sizes of the parts, in medians, by name.
        """
        steps = -self.factors(pull[None], frame_is_free=frame_is_free)[0]
        for name, median in _OF_PATH.items():
            steps[:, name == _OF_STEP] *= (sizes.get(name, 0.0) * median) ** 2
        return WalkBending(self.given, steps, frame_is_free)

    @cached_property
    def _steps_of_path(self) -> tuple[Indices, Array]:
        """Indices (s,) of the poses with a step, and (s, 7) standard deviations for a walk of 1 from start to end."""
        steps = np.linalg.norm(np.diff(self.given.centers, axis=0), axis=1)
        starts = np.unique(np.linspace(0, len(steps), min(len(steps), _MAX_NUM_STEPS) + 1).astype(np.int64))[:-1]
        length = float(steps.sum())
        share = np.add.reduceat(steps, starts) / length if length > 0 else np.zeros(len(starts))
        return starts, np.sqrt(share)[:, None] * np.repeat([1.0, length], [4, 3])

    @cached_property
    def path(self) -> Trajectory:
        """The corrected path, with the size and the place of the original path."""
        given = self.given
        if not self.is_corrected:
            return given
        starts, unit = self._steps_of_path
        bent = bent_path(given, starts, self.steps * unit)
        away = align_points(given.centers, bent.centers)
        if self.frame_is_free:
            back = away.inverse()
            return bent.transformed(back)
        return bent.transformed(Similarity(1 / away.scale, np.eye(3), (1 - 1 / away.scale) * bent.centers[0]))


def bent_path(path: Trajectory, starts: Indices, steps: Array) -> Trajectory:
    """Return the path with all poses after each of some moved together.

    Args:
        starts: (s,) poses about which the later ones move. steps: (s, 7) logarithm of scale, turn and shift.
    """
    each = Rotation.from_rotvec(steps[:, 1:4]).as_matrix()
    turns = np.array(list(accumulate(each, lambda before, turn: turn @ before, initial=np.eye(3))))
    grown = np.exp(np.cumsum(np.append(0.0, steps[:, 0])))[:, None, None] * turns
    # Each step leaves the pose about which it moves where the steps before have it.
    shifts = np.einsum("sij,sj->si", grown[:-1] - grown[1:], path.centers[starts]) + steps[:, 4:]
    shifts = np.cumsum(np.vstack([np.zeros(3), shifts]), axis=0)
    num_before = np.searchsorted(starts, np.arange(len(path)))
    centers = np.einsum("kij,kj->ki", grown[num_before], path.centers) + shifts[num_before]
    return replace(path, centers=centers, world_from_cam=turns[num_before] @ path.world_from_cam)


def _after(functions: Array, path: Trajectory, starts: Indices) -> Array:
    """Return the (c, s, 7) change of functions as all poses after each of s move together about that pose."""
    of_poses = functions.reshape(len(functions), len(path), 6).swapaxes(0, 1)
    about_first = of_poses @ _motions(path).reshape(len(path), 6, 7)
    after = np.cumsum(np.add.reduceat(about_first, starts + 1)[::-1], axis=0)[::-1]
    about_starts = similarity_motions(path.centers[starts] - path.centers[0])[:, :, :4]
    after[:, :, :4] -= after[:, :, 4:] @ about_starts
    return after.swapaxes(0, 1)
