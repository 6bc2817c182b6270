"""Known positions as observations of a map: groups, with the errors of points and receivers; and a start of their fit.

A known position p of something with the place c in the model and the lever arm a obeys p = scale * R c + R a + t. Its
error has several parts: the survey of the point, the marks in the photos, noise of the antenna's positions, and errors
of these that last for some time or belong to a place (section 4 of ``model.md``).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy import special
from scipy.sparse import block_diag, csr_array, kron
from scipy.spatial.distance import cdist

from rangesfm.arrays import Array, Indices, Mask
from rangesfm.measurements.positions.known_positions import MIN_NUM_POSITIONS, KnownPositions
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.positions.words import FRAME
from rangesfm.measurements.ranges.errors.components import CLOCKS
from rangesfm.measurements.ranges.range_observations import OUTLIER_BELOW
from rangesfm.solver.noise import Component, independent_unknowns
from rangesfm.util.geometry.numerics import UNDETERMINED
from rangesfm.util.geometry.robust_statistics import MIN_STDDEV_M
from rangesfm.util.geometry.similarity import Similarity, align_points, path_shape, similarity_motions
from rangesfm.util.geometry.trajectory import Trajectory

# Names of errors of an antenna's positions that last for some time start with this, as do all of its positions.
_LASTING = "positions_"
_WARP = f"{_LASTING}warp"
# Standard deviation of the logarithm of what a system says of its own errors, and of what is guessed of them; and the
# share of the noise that lasts, before anything is known.
_SPREAD_GIVEN, _SPREAD_GUESSED, _LASTING_SHARE = 0.5, 1.0, 0.3
# Most triples for a start.
_MAX_NUM_TRIPLES = 300
# Number of times of a group over which its correlation with others is averaged.
_NUM_WITHIN = 8


def determine(known: KnownPositions, used: Mask) -> bool:
    """Return whether positions determine a similarity: three or more that are not on one line."""
    if used.sum() < MIN_NUM_POSITIONS:
        return False
    stddevs = path_shape(known.places[used]).stddevs
    return bool(stddevs[1] > UNDETERMINED * stddevs[0])


def stddevs_as_shown(known: KnownPositions, off_m: Array, used: Mask) -> Array:
    """Return (k,) standard deviations of a coordinate: as given, or larger if the residuals of its kind are."""
    stddevs, given = np.ones(len(known)), stddev_of(known.covariance_m2)
    freedom = np.sqrt(3 * used.sum() / max(3 * used.sum() - 7, 1))
    # Half of all vectors of three normally distributed numbers are shorter than this.
    median_length = np.sqrt(special.chdtri(3, 0.5))
    for of_kind in (known.is_mark, ~known.is_mark):
        if (rows := used & of_kind).any():
            is_given = bool(np.isfinite(given[of_kind]).all())
            ratio = given if is_given else np.ones(len(known))
            shown = freedom * float(np.median(np.linalg.norm(off_m[rows], axis=1) / ratio[rows])) / median_length
            stddevs[of_kind] = ratio[of_kind] * max(shown, 1.0 if is_given else MIN_STDDEV_M)
    return stddevs


def start_of_triples(known: KnownPositions, rows: Indices) -> Similarity:
    """Return the similarity of three positions with the least sum of distances of all: a robust start.

    Lever arms are taken off with the rotation of a first fit.
    """
    places, targets = known.places[rows], known.position_m[rows]
    for _ in range(2):
        candidates = [align_points(places, targets)]
        for chosen in map(list, _triples(len(rows))):
            if not any(path_shape(each).is_line for each in (places[chosen], targets[chosen])):
                candidates.append(align_points(places[chosen], targets[chosen]))
        distances = [np.linalg.norm(each.apply(places) - targets, axis=1).sum() for each in candidates]
        best = candidates[int(np.argmin(distances))]
        targets = known.position_m[rows] - known.arms_m[rows] @ best.rotation.T
    return best


def _triples(num: int) -> Iterator[tuple[int, ...]]:
    """Yield triples of numbers below ``num``: all if they are few, else some that are spread over them."""
    if num * (num - 1) * (num - 2) // 6 <= _MAX_NUM_TRIPLES:
        yield from itertools.combinations(range(num), MIN_NUM_POSITIONS)
        return
    rng = np.random.default_rng(0)
    for _ in range(_MAX_NUM_TRIPLES):
        yield tuple(rng.choice(num, MIN_NUM_POSITIONS, replace=False).tolist())


def design_of_positions(known: KnownPositions, site_from_model: Similarity, path: Trajectory) -> Array:
    """Return the (3 k, 7) derivatives of the positions by scale, turn and shift about the first camera."""
    origin = site_from_model.apply(path.centers[:1])[0]
    motions = similarity_motions(known.predicted_m(site_from_model) - origin)
    motions[:, :, 0] = site_from_model.apply(known.places) - origin  # the lever arm does not scale
    return motions.reshape(-1, 7)


def groups_by_pose(known: KnownPositions, similarity: Similarity, grouping: csr_array) -> Array:
    """Return (3 g, 6 n) derivatives of groups of positions by the poses of the path they are on."""
    rotation = kron(np.eye(len(known)), similarity.rotation, format="csr")
    by_pose = grouping @ rotation @ (similarity.scale * known.by_pose + known.arms_by_pose)
    return np.asarray(by_pose.toarray())


def at_point(known: KnownPositions, row: int) -> Array:
    """Return the (3 k, 3) effect of a known position that is too large by a metre in each coordinate."""
    columns = np.zeros((3 * len(known), 3))
    columns[3 * row : 3 * row + 3] = np.eye(3)
    return columns


def stddev_of(covariances: Array) -> Array:
    """Return (k,) standard deviations of a coordinate: the root of the mean variance."""
    return np.asarray(np.sqrt(np.trace(covariances, axis1=1, axis2=2) / 3))


def grouped_by_time(known: KnownPositions, weights: Array, max_num: int) -> csr_array:
    """Return the (3 g, 3 k) weights of positions in groups: marks alone, an antenna's averaged in the order of time."""
    marks = np.flatnonzero(known.is_mark)
    others = np.flatnonzero(~known.is_mark & (weights >= OUTLIER_BELOW))
    order = (
        others[np.argsort(known.time_s[others], kind="stable")] if np.isfinite(known.time_s[others]).all() else others
    )
    groups = [np.array([row]) for row in marks]
    groups += [part for part in np.array_split(order, min(len(order), max_num) or 1) if len(part)]
    shares = [np.ones(1) if known.is_mark[rows[0]] else weights[rows] / weights[rows].sum() for rows in groups]
    lines = np.repeat(np.arange(len(groups)), [len(rows) for rows in groups])
    shape = (len(groups), len(known))
    alone = csr_array((np.concatenate(shares), (lines, np.concatenate(groups))), shape=shape)
    return kron(alone, np.eye(3), format="csr")


def _alone(
    known: KnownPositions, similarity: Similarity, grouping: csr_array, stddev_m: Array, surveyed: SurveyedPositions
) -> Iterator[Component]:
    """Yield the components of the errors without that of the frame; arguments as for ``components_of``."""
    rotation = similarity.rotation
    places = similarity.scale**2 * rotation @ known.own_covariance @ rotation.T
    places += known.arm_stddev_m[:, None, None] ** 2 * np.eye(3)
    covariance = known.covariance_m2
    assumed = stddev_m[:, None, None] ** 2 * np.eye(3)
    for name, of_kind, names_of_place in (("points", known.is_mark, "marks"), ("positions", ~known.is_mark, "places")):
        if not of_kind.any():
            continue
        yield Component(names_of_place, _covariance_of_groups(grouping, places, of_kind))
        is_known = bool(np.isfinite(covariance[of_kind]).all())
        own = _covariance_of_groups(grouping, covariance if is_known else assumed, of_kind)
        spread = 0.0 if surveyed.points.stddevs_are_given and name == "points" else _SPREAD_GIVEN
        yield Component(name, own, spread=spread if is_known else _SPREAD_GUESSED)
    if surveyed.clock_stddev_s and known.velocity.any():
        of_clock = surveyed.clock_stddev_s * (grouping @ (similarity.scale * known.velocity @ rotation.T).ravel())
        yield Component(CLOCKS, np.outer(of_clock, of_clock))
    if not (rows := np.flatnonzero(~known.is_mark & np.isfinite(known.time_s))).size:
        return
    size_m = np.where(np.isfinite(stddev_of(covariance)), stddev_of(covariance), stddev_m)
    of_groups, times_s = _times_of_groups(grouping, known, size_m, rows)
    for within_s in surveyed.lasting_s:
        apart = np.exp(-np.abs(times_s.reshape(-1, 1) - times_s.ravel()) / within_s)
        alike = apart.reshape(len(times_s), _NUM_WITHIN, -1, _NUM_WITHIN).mean(axis=(1, 3))
        own = np.kron(alike * np.outer(of_groups, of_groups), np.eye(3))
        yield Component(f"{_LASTING}{within_s:g}s", own, _LASTING_SHARE, _SPREAD_GUESSED)
    if (off_middle := _off_middle(known, similarity, grouping)) is not None:
        places_m, _, _, extent_m = off_middle
        warp = np.exp(-cdist(places_m, places_m) / extent_m) * np.outer(of_groups, of_groups)
        yield Component(_WARP, np.asarray(np.kron(warp, np.eye(3))), _LASTING_SHARE, _SPREAD_GUESSED)


def components_of(
    known: KnownPositions,
    similarity: Similarity,
    grouping: csr_array,
    stddev_m: Array,
    surveyed: SurveyedPositions,
    design: Array,
    used: Mask,
) -> tuple[Component, ...]:
    """Return the components of the errors of groups, with that of the frame of an antenna's positions.

    Positions alone do not show by how much that frame is shifted and stretched, as place and scale of the map are no
    other. A system is taken to do so (as a root mean square over the path) by as much as a coordinate errs for some
    time, or at some place: by what of these errors a similarity does not take up.

    Args:
        grouping: (3 g, 3 k) weights of positions in groups. stddev_m: (k,) of a coordinate, where none is given.
        surveyed: what the positions were given as. design: (3 g, 7) derivatives. used: (3 g,) that take part.
    """
    components = tuple(_alone(known, similarity, grouping, stddev_m, surveyed))
    off_middle = _off_middle(known, similarity, grouping)
    if off_middle is None or not used.any():
        return components
    _, has_frame, from_middle, extent_m = off_middle
    stretch = (0.0 if surveyed.is_geodetic else 1.0) / extent_m * from_middle.ravel()
    frame = np.kron(np.outer(has_frame, has_frame), np.eye(3)) + np.outer(stretch, stretch)
    taken_up, _ = independent_unknowns(design[used], np.zeros((0, design.shape[1])))

    def left(component: Component) -> float:
        alike = component.alike[np.ix_(used, used)]
        return max(float(np.trace(alike) - np.sum(taken_up * (alike @ taken_up))), 0.0) / np.count_nonzero(used)

    return tuple(
        replace(each, tied={FRAME: left(each) * frame}) if each.name.startswith(_LASTING) else each
        for each in components
    )


def _off_middle(
    known: KnownPositions, similarity: Similarity, grouping: csr_array
) -> tuple[Array, Array, Array, float] | None:
    """Return (g, 3) places of groups, (g,) which are an antenna's, (g, 3) these from their middle, and their extent.

    None for an antenna that did not move, and without any.
    """
    is_timed = ~known.is_mark & np.isfinite(known.time_s)
    of_groups = grouping[::3, ::3]
    has_frame = (of_groups @ is_timed > 0).astype(np.float64)
    if not has_frame.any():
        return None
    places_m: Array = of_groups @ known.predicted_m(similarity)
    from_middle = has_frame[:, None] * (places_m - has_frame @ places_m / has_frame.sum())
    extent_m = float(np.sqrt(np.sum(from_middle**2) / has_frame.sum()))
    return (places_m, has_frame, from_middle, extent_m) if extent_m > 0 else None


def _covariance_of_groups(grouping: csr_array, covariances: Array, rows: Mask) -> Array:
    """Return the (3 g, 3 g) covariance of groups from independent (k, 3, 3) ones of the positions in ``rows``."""
    blocks = block_diag(list(np.where(rows[:, None, None], covariances, 0.0)), format="csr")
    return np.asarray((grouping @ blocks @ grouping.T).toarray())


def _times_of_groups(grouping: csr_array, known: KnownPositions, size_m: Array, rows: Indices) -> tuple[Array, Array]:
    """Return (g,) mean standard deviations of the antenna's positions in each group (0: marks), and (g, t) times."""
    of_groups = grouping[::3, ::3]
    is_timed = np.zeros(len(known))
    is_timed[rows] = 1.0
    times = np.zeros((of_groups.shape[0], _NUM_WITHIN))
    for group in range(of_groups.shape[0]):
        members = of_groups.indices[of_groups.indptr[group] : of_groups.indptr[group + 1]]
        if is_timed[members].all():
            times[group] = np.quantile(known.time_s[members], np.linspace(0, 1, _NUM_WITHIN))
    return of_groups @ (is_timed * size_m), times
