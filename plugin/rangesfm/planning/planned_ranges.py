"""Ranges of a planned survey on its true map, as they may turn out, and the mistakes that would be found in them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from rangesfm.arrays import Array
from rangesfm.errors import GeometryError
from rangesfm.measurements.joint_map import JointMap, KindOnMap, find_kind
from rangesfm.measurements.mistakes import MistakeTest
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.errors.noise import START_STDDEV_M
from rangesfm.measurements.ranges.mistakes.catalogue import STANDING
from rangesfm.measurements.ranges.mistakes.linearized import Linearized
from rangesfm.measurements.ranges.mistakes.thresholds import estimates
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.anchor_plane import mirrored_map
from rangesfm.measurements.ranges.scale.binned_ranges import in_bins
from rangesfm.measurements.ranges.scale.range_equation import RangeState, antenna_positions
from rangesfm.measurements.ranges.scale.range_scale import RangeScale, bins_on
from rangesfm.measurements.ranges.scale.range_start import RangesOnPath
from rangesfm.measurements.ranges.scale.ranges_on_map import RangesOnMap
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem, scale_problem
from rangesfm.measurements.ranges.scale.solution import refuse_ambiguity, solution_from
from rangesfm.measurements.ranges.words import RANGES
from rangesfm.options import LENGTH_M
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.solver.bending import MapBending
from rangesfm.util.geometry.similarity import IDENTITY
from rangesfm.util.geometry.trajectory import first_camera_from

OPEN = 1e3
"""Standard deviation, in metres or radians, from which on a number counts as not determined."""
SIZES = ("smallest_detectable", "effect_on_scale", "effect_on_place_m")
"""Columns of a mistake's test that do not depend on the measured ranges."""
# Offset of anchors with unknown positions, metres. In practice no anchor is exactly in line with a path or in its
# plane. In a plan it may be, and the linearized problem would then miss what is not determined.
_OFF_LINE_M = (0.07, 0.07, 0.1)


def ranges_at_truth(planned: PlannedSurvey, bending: MapBending, others: Sequence[KindOnMap]) -> RangeScale:
    """Return the ranges of a plan on its true map, where a run would solve their problem beside the other kinds.

    Raises:
        GeometryError: the run will refuse them.
    """
    first_camera = first_camera_from(planned.trajectory)
    into = first_camera if planned.anchor_frame == "first_camera" else IDENTITY
    told = [replace(a, position_m=into.apply(at)) for a, at in zip(planned.anchors, planned.anchors_m, strict=True)]
    given = RangesOnPath(_observations(planned), bending, told, planned.anchor_frame, planned.range_model)
    posed = given.posed(others)
    state, prior = true_state(planned, posed), posed.prior_errors
    tags_m, placing_m = antenna_positions(posed.ranges, state.metric_from_model), posed.placing_stddev_m(1.0)
    noise_m = planned.given_sizes.get("white", START_STDDEV_M)
    stddev_m = np.sqrt(noise_m**2 + placing_m**2 + prior.shared_m**2)
    errors = replace(prior.at(tags_m, placing_m), stddev_m=stddev_m)
    weights = np.full(len(posed.rows), float(planned.num_alike))
    return RangeScale.begun(RangesOnMap(posed, state, weights, errors, noise_m))


def true_state(planned: PlannedSurvey, posed: ScaleProblem) -> RangeState:
    """Return the true state in the frame of a problem of the ranges of a plan."""
    ids, first_camera = [anchor.anchor_id for anchor in planned.anchors], first_camera_from(planned.trajectory)
    places_m = _standing_m(planned)[[ids.index(anchor_id) for anchor_id in posed.observations.log.anchor_ids]]
    biases_m = posed.ranges.bias_mean_m.copy()
    if posed.ranges.frame_is_free:
        return RangeState(first_camera.inverse(), places_m, biases_m)
    return RangeState(IDENTITY, first_camera.apply(places_m), biases_m)


def _standing_m(planned: PlannedSurvey) -> Array:
    """Return the positions of the anchors in the computation (m, 3)."""
    return planned.anchors_m + _OFF_LINE_M if planned.anchor_frame == "unknown" else planned.anchors_m


def _observations(planned: PlannedSurvey) -> RangeObservations:
    """Simulate ranges without errors on the path; if there are many, each stands for several."""
    num_anchors, path = len(planned.anchors), planned.trajectory
    turn = np.arange(planned.num_ranges // planned.num_alike)
    first_s = 0.0 if path.timestamps_s is None else float(path.timestamps_s[0])
    times = first_s + (turn + 0.5) * planned.num_alike / (planned.rate_hz * num_anchors)
    ids = [anchor.anchor_id for anchor in planned.anchors]
    log = RangeLog.from_arrays([ids[k] for k in turn % num_anchors], np.ones(len(turn)), timestamp_s=times)
    places = associate(log, path, planned.tag_in_cam_m)
    at = _standing_m(planned)[[ids.index(anchor_id) for anchor_id in log.anchor_ids]]
    distances = np.linalg.norm(places.centers + places.tag_from_center - at[log.anchor_index], axis=1)
    curve = np.full(len(log), np.nan if planned.curve_stddev_m is None else planned.curve_stddev_m)
    # A range without a position on the path is not used; it only needs a valid number.
    measured = replace(log, range_m=np.nan_to_num(distances, nan=1.0), shared_stddev_m=curve)
    return replace(places, log=measured)


def turned_out(on_map: JointMap, seed: int) -> RangeObservations:
    """Return the planned ranges on a map with errors drawn from those to expect."""
    ranges = find_kind(on_map.kinds, RangeScale)
    assert ranges is not None, "a plan with ranges"
    posed, noise, rng = ranges.solved.posed, on_map.problem.noise_of(RANGES), np.random.default_rng(seed)
    values, vectors = np.linalg.eigh(noise.without("white").covariance_m2)
    of_bins = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.standard_normal(len(values)))
    white_m = noise.stddev_of_component["white"] / np.sqrt(ranges.solved.weights)
    range_m = posed.observations.log.range_m.copy()
    range_m[posed.rows] += of_bins[bins_on(on_map).of_range] + white_m * rng.standard_normal(len(posed.rows))
    log = replace(posed.observations.log, range_m=np.maximum(range_m, LENGTH_M.least))
    return replace(posed.observations, log=log)


def why_place_is_open(on_map: JointMap) -> str:
    """Return why the run will leave the place of a planned map open; empty if it will not.

    It is open if the map's mirror image in the anchors' plane fits ranges as they may turn out.
    """
    ranges = find_kind(on_map.kinds, RangeScale)
    if ranges is None or not ranges.places_map or ranges.solved.problem.placement is not None:
        return ""
    state, given = ranges.solved.state, ranges.solved.posed.given
    mirrored = mirrored_map(ranges.solved.problem, state)
    if mirrored is None:
        return ""
    try:
        # For a path in that plane the height is not determined, and the solver divides 0 by 0.
        with np.errstate(invalid="ignore", divide="ignore"):
            posed = scale_problem(replace(given, observations=turned_out(on_map, 0)))
            return refuse_ambiguity(solution_from(posed, state), [mirrored], None)
    except GeometryError as error:
        return str(error)


def mistakes(on_map: JointMap) -> tuple[MistakeTest, ...]:
    """Return a row for every possible mistake in planned ranges that lasts for the whole survey, without statistics.

    Nothing has been measured yet, so that there is nothing to test. The sizes and effects are known all the same.
    """
    ranges = find_kind(on_map.kinds, RangeScale)
    if ranges is None:
        return ()
    here, bins = ranges.solved, bins_on(on_map)
    problem = Linearized.by_ranges(in_bins(here, bins, here.noise_stddev_m, {}, np.zeros(len(bins))), here, 0.0)
    found = []
    for test in estimates(problem, [each for of_kind in STANDING for each in of_kind(problem)]):
        row = test.row
        sizes: dict[str, float] = {name: getattr(row, name) for name in SIZES}
        if not test.is_checked:  # no size that can happen would be found, and none has a larger effect than the largest
            share = test.mistake.most / test.smallest_detectable if np.isfinite(test.smallest_detectable) else np.inf
            sizes = {name: share * size for name, size in sizes.items()} | {"smallest_detectable": np.inf}
        limited: dict[str, Any] = {name: np.inf if size > OPEN else size for name, size in sizes.items()}
        found.append(replace(row, **limited))
    return tuple(sorted(found, key=lambda each: -each.effect_on_scale))
