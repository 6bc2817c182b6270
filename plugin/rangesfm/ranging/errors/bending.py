"""How a map may be bent, as the ranges on it see it: what every range model is told of the map's own errors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.spatial.transform import Rotation

from rangesfm.arrays import Array, Indices
from rangesfm.geometry.similarity import IDENTITY, Similarity, align_points, similarity_motions
from rangesfm.geometry.trajectory import Trajectory
from rangesfm.ranging.errors.components import BENDS, Component
from rangesfm.ranging.errors.range_bins import Cells
from rangesfm.ranging.range_gradient import RangeGradient
from rangesfm.ranging.range_observations import OnPath

# A turn about a straight path is seen by how the cameras turn alone: by so little that elsewhere it has no say.
_TURNS_COUNT = 1e-3
# Steps of a random walk: cells are fewer still.
_MAX_NUM_STEPS = 100
# Start to end of a path: the relative change of the scale, the turn in radians and the shift as a share of the path's
# length, in the median over maps of poses alone; and the spread of their logarithms. From its first to its last third
# the real path of tests.studies.drifting_maps (ORB-SLAM, fr2_desk) changes by 0.6 % and 0.002 rad, simulated
# halls by 0.6 to 1.0 % and 0.003 to 0.004 rad, laps of 0.5 and 2 m of drift by 0.3 to 0.9 % and 0.001 to 0.004 rad; the
# shift that these leave was learnt at 0.0003 to 0.002 there. So few show no more than the order of magnitude.
_OF_PATH = {"scale_drift": 0.004, "heading_drift": 0.002, "bending": 0.0005}
_SPREAD = 1.0
_OF_STEP = {"scale_drift": slice(0, 1), "heading_drift": slice(1, 4), "bending": slice(4, 7)}

LearnedSizes = Mapping[str, float]


def by_poses(
    gradient: RangeGradient,
    metric_from_model: Similarity,
    model_from_cam: Array,
    tag_from_center: Array,
    on_path: OnPath,
) -> csr_array:
    """(n, 6 k) by how much distances grow as each of k poses turns in its own frame, and shifts in the model's world.

    Args:
        model_from_cam: (n, 3, 3). tag_from_center: (n, 3) metres, in the axes of the model.
    """
    num_poses = int(max(on_path.before.max(), on_path.after.max())) + 1
    by_shift = metric_from_model.scale * gradient.by_tag @ metric_from_model.rotation
    in_cam = np.einsum("nji,nj->ni", model_from_cam, gradient.by_tag @ metric_from_model.rotation)
    by_turn = np.cross(np.einsum("nji,nj->ni", model_from_cam, tag_from_center), in_cam)
    values = np.hstack([by_turn, by_shift])
    rows = np.repeat(np.arange(len(values)), 6)
    parts = [
        ((share[:, None] * values).ravel(), rows, (6 * pose[:, None] + np.arange(6)).ravel())
        for pose, share in ((on_path.before, 1 - on_path.weight), (on_path.after, on_path.weight))
    ]
    value, row, column = (np.concatenate(each) for each in zip(*parts, strict=True))
    return coo_array((value, (row, column)), shape=(len(values), 6 * num_poses)).tocsr()


@dataclass(frozen=True)
class BendingOfCells:
    """What a map's bending does to c cells of ranges.

    Attributes:
        components: of the ranges' errors, in metres.
        formal_m2: (c, c) covariance by what the photos' residuals let expect; zero where nobody has looked at photos.
        shift_m: (c,) by how much the predicted ranges grow as the map goes to where the photos alone would have it.
    """

    components: tuple[Component, ...]
    formal_m2: Array
    shift_m: Array


class MapBending(Protocol):
    """What is known of how a map is bent."""

    def of_cells(self, cells: Cells, by_pose: csr_array, *, frame_is_free: bool) -> BendingOfCells:
        """As cells of ranges see it.

        Args:
            by_pose: (n, 6 k) of each range, by the path's poses, as of ``by_poses``.
            frame_is_free: whether the map's place is estimated, or hangs on the first pose.
        """
        ...


def component_of(name: str, covariance: Array, factor: float, spread: float) -> Component | None:
    """A component in metres, of which so many times the covariance is expected; None if the cells do not see it."""
    size_m = float(np.sqrt(np.trace(covariance) / max(len(covariance), 1)))
    if not size_m > 0:
        return None
    alike = covariance / size_m**2
    return Component(name, factor * size_m, spread, None, False, lambda _: alike, BENDS[name])


def averaged(cells: Cells, by_range: csr_array, num_poses: int) -> Array:
    """(c, 6 k) of (n, 6 k'), where the last of k poses may have no ranges."""
    of_range, shape = cells.of_range, (len(cells), len(cells.of_range))
    share = cells.weight / np.maximum(cells.worth, 1e-12)[of_range]
    sums = csr_array((share, (of_range, np.arange(len(of_range)))), shape=shape) @ by_range
    return np.pad(sums.toarray(), ((0, 0), (0, 6 * num_poses - sums.shape[1])))


def without_similarity(by_pose: Array, path: Trajectory, *, frame_is_free: bool) -> Array:
    """(c, 6 k) of functions that do not see the map's scale and place any more.

    The scale is that of the similarity that fits all centres best; so is the place where it is free, else it is that of
    the first pose.

    Args:
        path: in the model's world.
    """
    motions = _motions(path)
    weighted = motions * np.tile(np.repeat([_size(path) * _TURNS_COUNT, 1.0], 3), len(path))[:, None] ** 2
    of_poses = np.linalg.pinv(motions.T @ weighted, rcond=1e-12, hermitian=True) @ weighted.T
    if not frame_is_free:
        of_poses[1:] = 0.0
        of_poses[1:4, :3] = path.world_from_cam[0]
        of_poses[4:, 3:6] = np.eye(3)
    return np.asarray(by_pose - (by_pose @ motions) @ of_poses)


def _motions(path: Trajectory) -> Array:
    """(6 k, 7) how poses move with the logarithm of the scale, a turn and a shift about the first of them."""
    motions = np.zeros((len(path), 6, 7))
    motions[:, :3, 1:4] = np.swapaxes(path.world_from_cam, 1, 2)
    motions[:, 3:] = similarity_motions(path.centers - path.centers[0])
    return motions.reshape(-1, 7)


def _size(path: Trajectory) -> float:
    return float(np.linalg.norm(path.centers.std(axis=0))) or 1.0


@dataclass(frozen=True)
class WalkBending:
    """Of a map of poses alone: from pose to pose its scale, its heading and its place go astray by chance.

    What goes astray at a pose takes all that comes after with it, so that these are random walks along the path.

    Attributes:
        given: the path as it came, in the model's world.
        steps: (s, 7) by how much it is bent back at each of some poses: logarithm of the scale, turn and shift, in
            units of the walks' stddevs from start to end; None: not at all.
        frame_is_free: as of ``of_cells``, for the path as bent back.
    """

    given: Trajectory
    steps: Array | None = None
    frame_is_free: bool = False

    def of_cells(self, cells: Cells, by_pose: csr_array, *, frame_is_free: bool) -> BendingOfCells:
        nothing = np.zeros((len(cells), len(cells)))
        factors = self.factors(cells, by_pose, frame_is_free=frame_is_free)
        shift_m = np.zeros(len(cells)) if self.steps is None else -np.einsum("csi,si->c", factors, self.steps)
        found = []
        for name, which in _OF_STEP.items():
            own = factors[:, :, which].reshape(len(cells), -1)
            found.append(component_of(name, own @ own.T, _OF_PATH[name], _SPREAD))
        return BendingOfCells(tuple(each for each in found if each is not None), nothing, shift_m)

    def factors(self, cells: Cells, by_pose: csr_array, *, frame_is_free: bool) -> Array:
        """(c, s, 7) by how much cells grow with each step."""
        path = self.path
        functions = without_similarity(averaged(cells, by_pose, len(path)), path, frame_is_free=frame_is_free)
        starts, unit = self._steps_of_path
        return np.asarray(_after(functions, path, starts) * unit)

    def bent_back(self, factors: Array, pulls: Array, errors: LearnedSizes, *, frame_is_free: bool) -> WalkBending:
        """By the likeliest steps.

        Args:
            factors: of the cells. pulls: (c,) residuals, solved by their covariance.
            errors: stddevs in metres by name, as learnt.
        """
        steps = -np.einsum("csi,c->si", factors, pulls)
        for name, which in _OF_STEP.items():
            size_m2 = float(np.sum(factors[:, :, which] ** 2)) / len(factors)
            steps[:, which] *= errors.get(name, 0.0) ** 2 / size_m2 if size_m2 > 0 else 0.0
        return WalkBending(self.given, steps, frame_is_free)

    @cached_property
    def _steps_of_path(self) -> tuple[Indices, Array]:
        """(s,) poses at which it is bent, and (s, 7) stddevs there if those from start to end are 1."""
        steps = np.linalg.norm(np.diff(self.given.centers, axis=0), axis=1)
        starts = np.unique(np.linspace(0, len(steps), min(len(steps), _MAX_NUM_STEPS) + 1).astype(np.int64))[:-1]
        length = float(steps.sum())
        share = np.add.reduceat(steps, starts) / length if length > 0 else np.zeros(len(starts))
        return starts, np.sqrt(share)[:, None] * np.repeat([1.0, length], [4, 3])

    @cached_property
    def path(self) -> Trajectory:
        """As bent back, as large as it came, and lying as it came."""
        given = self.given
        if self.steps is None:
            return given
        starts, unit = self._steps_of_path
        bent = bent_path(given, starts, self.steps * unit)
        away = align_points(given.centers, bent.centers)
        if self.frame_is_free:
            back = away.inverse()
            return bent.transformed(back.scale, back.rotation, back.translation)
        return bent.transformed(1 / away.scale, np.eye(3), (1 - 1 / away.scale) * bent.centers[0])


def bent_path(path: Trajectory, starts: Indices, steps: Array) -> Trajectory:
    """With all poses after each of some moved as one, about that one, by (s, 7) logarithm of scale, turn and shift."""
    centers, rotations = path.centers.copy(), path.world_from_cam.copy()
    total = IDENTITY
    ends = np.append(starts[1:], len(path) - 1)
    for start, end, step in zip(starts.tolist(), ends.tolist(), steps, strict=True):
        at = centers[start]
        scale, turn = float(np.exp(step[0])), Rotation.from_rotvec(step[1:4]).as_matrix()
        total = Similarity(scale, turn, at - scale * turn @ at + step[4:]) @ total
        rows = slice(start + 1, end + 1)
        centers[rows] = total.apply(path.centers[rows])
        rotations[rows] = total.rotation @ path.world_from_cam[rows]
    return replace(path, centers=centers, world_from_cam=rotations)


def _after(functions: Array, path: Trajectory, starts: Indices) -> Array:
    """(c, s, 7) how functions change as all poses after each of s move as one, about that one."""
    parts = functions.reshape(len(functions), len(path), 6)
    turns = np.einsum("cki,kji->ckj", parts[:, :, :3], path.world_from_cam)
    centers = path.centers - path.centers[0]
    about_first = np.concatenate(
        [
            np.einsum("cki,ki->ck", parts[:, :, 3:], centers)[:, :, None],
            turns + np.cross(centers, parts[:, :, 3:]),
            parts[:, :, 3:],
        ],
        axis=2,
    )
    later = np.cumsum(about_first[:, ::-1], axis=1)[:, ::-1]
    after = np.concatenate([later[:, 1:], np.zeros_like(later[:, :1])], axis=1)[:, starts]
    at = centers[starts]
    after[:, :, 0] -= np.einsum("csi,si->cs", after[:, :, 4:], at)
    after[:, :, 1:4] -= np.cross(at, after[:, :, 4:])
    return np.asarray(after)
