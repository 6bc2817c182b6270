"""Check a plan's numbers: predicted stddevs against those that simulated runs state, and against their spread.

Run: python -m tests.studies.planned_surveys [--out FILE] [--num_seeds 100] [--kinds NAME ...]

Twenty surveys of different kinds, with the radios of eight public logs and with a usual one, are planned. Then each is
measured and its scale found again and again, every time with other errors of its radio, other errors in surveying the
anchors and another bend of its map. The first eight runs of each are whole scale stages; others begin at the truth.
FILE keeps the runs that are done, one line each; when started again, the study continues there.

Prints for each survey the predicted stddev of the scale over the median that whole runs state, and over the spread of
all runs' errors; that of the place (of the keyframe known least) over the spread; and how many runs were refused.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from tests.estimation.scale.conftest import lengths_among
from tests.simulated.path import along, lap_path, loop_path, sequence_path
from tests.simulated.radio_errors import errors_of_radio
from tests.simulated.surveys import METRES_PER_UNIT, in_world_of_its_own
from tests.studies import kept_runs
from tests.studies.kept_runs import Row, seeds_parser, spread

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.measurements.lengths.lengths_on_map import BENDING
from rangesfm.measurements.lengths.locate_lengths import LocatedDistances
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.errors.components import COMPONENTS, stddevs_in
from rangesfm.measurements.ranges.errors.learned import widening
from rangesfm.measurements.ranges.errors.noise import START_STDDEV_M
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.scale.range_equation import RangeState
from rangesfm.measurements.ranges.scale.range_start import RangesOnPath
from rangesfm.measurements.ranges.scale.scale_problem import ScaleProblem
from rangesfm.measurements.ranges.scale.solution import solution_from
from rangesfm.options import ScaleOptions
from rangesfm.planning.expected import Expected, expect
from rangesfm.planning.paths import path_through
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.planned_ranges import true_state
from rangesfm.solver.bending import BENDS, WalkBending
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory, first_camera_from

Array = npt.NDArray[np.float64]

# How far maps bend.
BENDING_M = 0.007
Place = tuple[float, float, float]

RADIOS = {
    "room": stddevs_in("room_env1"),
    "slow": stddevs_in("starloc_s5"),
    "fast": stddevs_in("starloc_fast_s1"),
    "drone": stddevs_in("rcv_sequence1"),
    "drone, open": stddevs_in("rcv_sequence3"),
    "trolley": stddevs_in("lias_mid"),
    "mower": stddevs_in("plaza1"),
    "usual": {},
}
ROOM = ((6.0, 0.5, 2.5), (-6.0, 1.0, 0.4), (0.5, 6.0, 3.0), (1.0, -6.0, 0.2), (5.0, 5.0, 0.3), (-5.0, 4.5, 2.8),
        (-4.5, -5.0, 0.5), (5.0, -4.5, 2.2))  # fmt: skip
CORRIDOR = ((-2.0, 3.0, 2.5), (22.0, -3.0, 0.4), (10.0, 3.5, 0.5), (4.0, -3.0, 2.8), (16.0, 3.0, 2.0), (25.0, 3.0, 2.6))
FIELD = ((60.0, 40.0, 3.0), (-60.0, 40.0, 1.0), (-60.0, -40.0, 4.0), (60.0, -40.0, 0.5))
YARD = ((17.0, 2.0, 6.0), (-16.0, 3.0, 1.0), (1.0, 16.0, 9.0), (-2.0, -17.0, 2.0))
TAG_IN_CAM_M = (0.05, -0.1, -0.05)


def photographed(path: CameraPath, photo_rate_hz: float = 2.0) -> Trajectory:
    times = np.arange(path.start_s, path.end_s, 1 / photo_rate_hz)
    names = tuple(f"{k:05d}.jpg" for k in range(len(times)))
    return Trajectory(np.arange(1, len(times) + 1), names, *along(path, times))


def survey(
    trajectory: Trajectory, anchors_m: tuple[Place, ...], frame: str, of_radio: str, rate_hz: float, **others: Any
) -> PlannedSurvey:
    stddevs = RADIOS[of_radio] | others.pop("stddevs", {})
    told_to_m = others.pop("position_stddev_m", 0.01)
    anchors = tuple(Anchor(f"A{k}", np.array(at), told_to_m) for k, at in enumerate(anchors_m))
    return PlannedSurvey(trajectory, anchors, frame, rate_hz, TAG_IN_CAM_M, component_stddevs=stddevs, **others)


def walk(**options: Any) -> Trajectory:
    return photographed(loop_path(90.0, unsteadiness_m=0.2, **{"seed": 3, **options}))


def up_and_down() -> Trajectory:
    return walk(height_amplitude_m=1.0, num_turns=2.2)


def straight(length_m: float = 20.0) -> Trajectory:
    return path_through([(0.0, 0.0, 1.5), (length_m, 0.4, 1.6)], speed_m_per_s=0.3, photo_rate_hz=2.0)


def flight() -> Trajectory:
    path = loop_path(
        100.0, center_m=(0, 0, 6), semi_axes_m=(10, 7), height_amplitude_m=2.5, num_turns=2.1, unsteadiness_m=1.0,
        seed=5,
    )  # fmt: skip
    return photographed(path)


def lap() -> Trajectory:
    return photographed(lap_path(200.0), 1.0)


def onward() -> Trajectory:
    return photographed(sequence_path(60.0, speed_m_per_s=0.4, seed=2))


SURVEYS: dict[str, Callable[[], PlannedSurvey]] = {
    "room, 8 surveyed": lambda: survey(walk(), ROOM, "site", "room", 2.0),
    "room, 8 unknown": lambda: survey(walk(), ROOM, "unknown", "fast", 2.0),
    "room, 6 surveyed, up and down": lambda: survey(up_and_down(), ROOM[:6], "site", "slow", 3.0),
    "room, 5 known": lambda: survey(walk(), ROOM[:5], "first_camera", "usual", 3.0),
    "room, 4 surveyed, up and down": lambda: survey(up_and_down(), ROOM[:4], "site", "trolley", 4.0),
    "room, 3 surveyed": lambda: survey(up_and_down(), ROOM[:3], "site", "usual", 5.0),
    "room, 2 known": lambda: survey(walk(), ROOM[:2], "first_camera", "room", 5.0),
    "room, 1 known": lambda: survey(walk(), ROOM[:1], "first_camera", "usual", 10.0),
    "room, 1 unknown, up and down": lambda: survey(up_and_down(), ROOM[4:5], "unknown", "slow", 10.0),
    "wide loop, 1 unknown": lambda: survey(walk(semi_axes_m=(8, 6)), ((4.0, 3.0, 3.5),), "unknown", "trolley", 10.0),
    "room, 4 unknown": lambda: survey(up_and_down(), ROOM[:4], "unknown", "usual", 4.0),
    "corridor, 4 surveyed": lambda: survey(straight(), CORRIDOR[:4], "site", "room", 4.0),
    "corridor, 2 known": lambda: survey(straight(), CORRIDOR[:2], "first_camera", "drone", 8.0),
    "onward, 6 surveyed": lambda: survey(onward(), CORRIDOR, "site", "fast", 3.0),
    "field, 4 surveyed": lambda: survey(lap(), FIELD, "site", "mower", 2.0, position_stddev_m=0.03),
    "field, 1 known": lambda: survey(lap(), FIELD[:1], "first_camera", "trolley", 5.0),
    "flight, 4 surveyed": lambda: survey(flight(), YARD, "site", "drone, open", 4.0, position_stddev_m=0.02),
    "flight, 1 unknown": lambda: survey(flight(), ((4.0, -5.0, 1.0),), "unknown", "drone", 15.0),
    "room, 8 surveyed, learnt curve": lambda: survey(up_and_down(), ROOM, "site", "usual", 2.0, curve_stddev_m=0.02),
    "room, 7 surveyed, bent map": lambda: survey(walk(), ROOM[:7], "site", "slow", 2.0, stddevs={"bending": 0.04}),
}


def stddevs_of(planned: PlannedSurvey) -> dict[str, float]:
    """Stddevs of the components of the range errors: the plan's, or those that radios have on average."""
    is_calibrated, given = planned.curve_stddev_m is not None, planned.component_stddevs
    usual = {each.name: float(each.median_if(is_calibrated) * np.exp(each.spread**2)) for each in COMPONENTS}
    stddevs, larger = usual | {"bending": BENDING_M} | dict(given), widening(given.get("white", START_STDDEV_M))
    return {name: size * (1.0 if name in ("white", *BENDS) else larger) for name, size in stddevs.items()}


def measured(
    planned: PlannedSurvey, seed: int
) -> tuple[RangeObservations, Trajectory, tuple[Anchor, ...], LocatedDistances]:
    """Simulate one such survey: all of its ranges, on a bent map, the anchors as told, and the taped lengths."""
    rng = np.random.default_rng(seed)
    stddevs, true = stddevs_of(planned), planned.trajectory
    times = true.times_s
    ids = [anchor.anchor_id for anchor in planned.anchors]
    turn = np.arange(planned.num_ranges)
    at_s = times[0] + (turn + 0.5) / (planned.rate_hz * len(ids))
    log = RangeLog.from_arrays([ids[k] for k in turn % len(ids)], np.ones(len(turn)), timestamp_s=at_s)
    places = associate(log, true, planned.tag_in_cam_m)
    standing_m = np.array([planned.anchors_m[ids.index(name)] for name in log.anchor_ids])
    errors_m, distance_m = errors_of_radio(places, true, standing_m, stddevs, planned.curve_stddev_m, rng)
    ranges_m = np.maximum(np.nan_to_num(distance_m + errors_m, nan=1.0), 0.02)
    curve = np.full(len(log), np.nan if planned.curve_stddev_m is None else planned.curve_stddev_m)
    log = replace(log, range_m=ranges_m, shared_stddev_m=curve)
    bent = replace(true, centers=true.centers + stddevs["bending"] * _bend(times, rng))
    of_map = in_world_of_its_own(rng)
    seen = bent.transformed(of_map)
    return associate(log, seen, planned.tag_in_cam_m), seen, _told(planned, rng), _taped(planned, rng)


def _bend(times: Array, rng: np.random.Generator) -> Array:
    """(n, 3) curve of stddev 1 in each coordinate, smooth within an eighth of the time."""
    knots = np.linspace(times[0], times[-1], 60)
    apart = (knots[:, None] - knots) / (np.ptp(times) / 8)
    lower = np.linalg.cholesky(np.exp(-0.5 * apart**2) + 1e-9 * np.eye(len(knots)))
    return np.stack([np.interp(times, knots, lower @ rng.standard_normal(len(knots))) for _ in range(3)], axis=1)


def _told(planned: PlannedSurvey, rng: np.random.Generator) -> tuple[Anchor, ...]:
    if planned.anchor_frame == "unknown":
        return tuple(replace(anchor, position_m=None) for anchor in planned.anchors)
    path = planned.trajectory
    first = Similarity(1.0, path.world_from_cam[0], path.centers[0])
    into = first.inverse() if planned.anchor_frame == "first_camera" else Similarity(1.0, np.eye(3), np.zeros(3))
    return tuple(
        replace(anchor, position_m=into.apply(at) + anchor.position_stddev_m * rng.standard_normal(3))
        for anchor, at in zip(planned.anchors, planned.anchors_m, strict=True)
    )


def _taped(planned: PlannedSurvey, rng: np.random.Generator) -> LocatedDistances:
    lengths, stddevs = np.array(planned.taped, dtype=np.float64).reshape(-1, 2).T
    found = lengths + stddevs * rng.standard_normal(len(lengths))
    bent = lengths * (1 + BENDING * rng.standard_normal(len(lengths)))
    return LocatedDistances.between_points(found, stddevs, bent / METRES_PER_UNIT)


def one_run(planned: PlannedSurvey, keyframe: int | None, seed: int, *, is_whole: bool) -> Row:
    """Return the errors of the scale's logarithm and of one keyframe's place (metres).

    A whole run also has its stated stddev.
    """
    observations, trajectory, anchors, lengths = measured(planned, seed)
    found: Row = {}
    try:
        if is_whole:
            estimate = initialize_scale(
                observations,
                trajectory,
                anchors,
                anchor_frame=planned.anchor_frame,
                options=ScaleOptions(max_relative_stddev=0.5),
                range_model=planned.range_model,
                others=lengths_among(lengths, trajectory),
                seed=seed,
            )
            metric_from_map, found["stated"] = estimate.metric_from_sfm, estimate.uncertainty.empirical
        else:
            bending = WalkBending(trajectory)
            given = RangesOnPath(observations, bending, anchors, planned.anchor_frame, planned.range_model)
            posed = given.posed(lengths_among(lengths, trajectory))
            solved = solution_from(posed, truth(planned, posed))
            metric_from_map = solved.state.metric_from_model @ first_camera_from(trajectory)
    except GeometryError as error:
        return found | {"refused": str(error)}
    found["scale"] = float(np.log(metric_from_map.scale / METRES_PER_UNIT))
    if keyframe is not None:
        at = metric_from_map.apply(trajectory.centers[keyframe])
        found["place"] = (at - planned.trajectory.centers[keyframe]).tolist()
    return found


def truth(planned: PlannedSurvey, posed: ScaleProblem) -> RangeState:
    """Return a start at the truth; a whole search takes ten times as long and ends at the same solution."""
    state = true_state(planned, posed)
    return replace(state, metric_from_model=replace(state.metric_from_model, scale=METRES_PER_UNIT))


def worst_keyframe(expected: Expected) -> int | None:
    return None if expected.placement is None else int(np.argmax(expected.keyframe_stddevs_m))


def runs_of(asked: argparse.Namespace, name: str, planned: PlannedSurvey, num_whole: int = 8) -> list[Row]:
    """Run one survey; its first runs are whole scale stages."""
    keyframe = worst_keyframe(expect(planned))
    return kept_runs.runs_of(asked, name, lambda seed: one_run(planned, keyframe, seed, is_whole=seed < num_whole))


def main() -> None:
    asked = seeds_parser(__doc__, SURVEYS, 100).parse_args()
    print(
        f"{'survey':34}{'predicted':>10}{'stated':>9}{'ratio':>7}{'spread':>9}{'ratio':>14}{'place':>10}{'spread':>9}"
        f"{'ratio':>14}{'refused':>9}"
    )
    off: dict[str, list[float]] = {"stated scale": [], "scale": [], "place": []}
    for name in asked.kinds:
        planned = SURVEYS[name]()
        expected = expect(planned)
        rows = runs_of(asked, name, planned)
        scale, place_m = expected.uncertainty.empirical, expected.worst_keyframe_m
        (scale_spread, by_chance), (place_spread_m, of_place) = spread(rows, "scale"), spread(rows, "place")
        stated = [row["stated"] for row in rows if "stated" in row] or [float("nan")]
        median = float(np.median(stated))
        ratios = dict(zip(off, (scale / median, scale / scale_spread, place_m / place_spread_m), strict=True))
        for what, ratio in ratios.items():
            off[what] += [ratio - 1] if np.isfinite(ratio) else []
        print(
            f"{name:34}{100 * scale:8.2f} %{100 * median:7.2f} %{ratios['stated scale']:7.2f}"
            f"{100 * scale_spread:7.2f} %{ratios['scale']:7.2f} +-{ratios['scale'] * by_chance:4.2f}"
            f"{place_m:8.3f} m{place_spread_m:7.3f} m{ratios['place']:7.2f} +-{ratios['place'] * of_place:4.2f}"
            f"{sum('refused' in row for row in rows):9}",
            flush=True,
        )
    for what, each in off.items():
        print(
            f"{what}: {100 * np.median(each):+.0f} % in the median, off by {100 * np.median(np.abs(each)):.0f} % in "
            f"the median, {sum(np.abs(each) > 0.3)} of {len(each)} by more than 30 %"
        )


if __name__ == "__main__":
    main()
