"""Measure error, 95 % interval and verdict of the scale on real logs with truth, for each knowledge of the anchors.

Run: python -m tests.studies.real_logs --data FOLDER [--sets NAME ...] [--no_singles] [--by_photo]
     [--turned SEED] [--leave_radio_out] [--calibrated]

The sets are described in real_logs.json: public logs below the folder, with the position of each tag in the tracked
body, the offset of the clocks (time of the truth minus time of the ranges) and the longest gap in the truth. The path
is the true one, with at most ten poses a second, divided by a factor that has to be found again. The anchors are all
surveyed (site frame), known in the first pose's frame, all unknown, or each one alone and unknown.

With --by_photo, ranges name the nearest pose instead of a time. With --turned, the unscaled path lies in another frame,
which should change nothing. With --leave_radio_out, the expected errors come from all radios but the present one. With
--calibrated, an error curve is subtracted that was learnt on another log of the same radio, if there is one.
The last column has the mistakes that the tests of the map name; none is known to have been made.
"""

from __future__ import annotations

import argparse
import csv
import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from rangesfm.errors import GeometryError
from rangesfm.estimation.scale.initialize import initialize_scale
from rangesfm.estimation.scale.scale_estimate import ScaleEstimate
from rangesfm.measurements.joint_map import find_kind
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.errors.components import components, population
from rangesfm.measurements.ranges.errors.error_curve import ErrorCurve, correct_ranges
from rangesfm.measurements.ranges.errors.radio_calibration import calibrate_ranges
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations
from rangesfm.measurements.ranges.readers import read_ranges
from rangesfm.measurements.ranges.scale.range_scale import RangeScale
from rangesfm.options import RangesOptions, ScaleOptions
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.reference import Reference, read_reference
from rangesfm.util.geometry.similarity import Similarity, rmse
from rangesfm.util.geometry.trajectory import Trajectory

FACTOR, MIN_STEP_S, MAX_GAP_S = 4.63, 0.1, 0.25


@dataclass(frozen=True)
class Case:
    """One way to survey with a log."""

    name: str
    frame: str
    anchors: list[Anchor]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sets", nargs="*")
    parser.add_argument("--no_singles", action="store_true")
    parser.add_argument("--by_photo", action="store_true")
    parser.add_argument("--turned", type=int)
    parser.add_argument("--leave_radio_out", action="store_true")
    parser.add_argument("--calibrated", action="store_true")
    args = parser.parse_args()
    sets = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))
    found = []
    for name in args.sets or [name for name in sets if not args.calibrated or "same_radio" in sets[name]]:
        log, anchors, reference = read_set(args.data, sets[name])
        if args.calibrated:
            log = correct_ranges(log, curve_of(args.data, sets[sets[name]["same_radio"]]))[0]
        path = path_of(reference)
        given = path if args.turned is None else turned(path, args.turned)
        expected = components(population(without=name if args.leave_radio_out else None))
        for case in cases(log, anchors, path):
            if not (args.no_singles and case.name.startswith("only")):
                observations = placed(log, case, given, sets[name], by_photo=args.by_photo)
                with patch("rangesfm.measurements.ranges.errors.learned.COMPONENTS", expected):
                    found.append(one_survey(name, case, observations, given))
    known = np.array([row for row in found if row is not None], dtype=np.float64)
    if len(known):
        errors, low, high, num_named, away_m = known.T
        half_widths = (high - low) / 2
        from_middle = 1.96 * (errors + (low + high) / 2) / half_widths
        print(
            f"{len(known)} of {len(found)}: {100 * np.mean((low <= -errors) & (-errors <= high)):.0f} % covered, the "
            f"truth from the middle in stddevs {np.sqrt(np.mean(from_middle**2)):.2f} (rms), median half width "
            f"{100 * np.median(half_widths):.2f} %, a mistake named in {np.count_nonzero(num_named)}; paths in a "
            f"site off by {np.nanmedian(away_m):.2g} m (median)"
        )


def read_set(data: Path, described: dict[str, Any]) -> tuple[RangeLog, list[Anchor], Reference]:
    ranges = data / described["ranges"]
    if "truth" in described:
        anchors = list(read_anchors(data / described["anchors"]))
        reference = read_reference(data / described["truth"])
    else:  # STAR-loc: the tag's position is beside each range, and the anchors' ids are in a column without a name
        anchors = [
            Anchor(row[""], np.array([float(row[a]) for a in "xyz"])) for row in rows(data / described["anchors"])
        ]
        times, first = np.unique([float(row["time_s"]) for row in rows(ranges)], return_index=True)
        places = np.array([[float(row[f"tag_pos_{a}"]) for a in "xyz"] for row in rows(ranges)])
        reference = Reference(places[first], ByTime(times))
    return read_ranges(ranges, anchor_ids=[anchor.anchor_id for anchor in anchors]), anchors, reference


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def path_of(reference: Reference) -> Trajectory:
    times = reference.moments.timestamp_s
    kept = [0]
    for i, at in enumerate(times):
        if at - times[kept[-1]] >= MIN_STEP_S:
            kept.append(i)
    num, turns = len(kept), reference.world_from_cam
    rotations = np.tile(np.eye(3), (num, 1, 1)) if turns is None else turns[kept]
    names = tuple(f"{i:06d}" for i in range(num))
    return Trajectory(np.arange(1, num + 1), names, times[kept], reference.positions_m[kept] / FACTOR, rotations)


def turned(path: Trajectory, seed: int) -> Trajectory:
    return path.transformed(Similarity(1.0, Rotation.random(random_state=seed).as_matrix(), np.array([3.0, -2.0, 1.0])))


def cases(log: RangeLog, anchors: list[Anchor], path: Trajectory) -> Iterator[Case]:
    heard = [anchor for anchor in anchors if anchor.anchor_id in log.anchor_ids]
    yield Case("surveyed", "site", heard)
    turn, origin = path.world_from_cam[0], FACTOR * path.centers[0]
    from_there = [replace(a, position_m=(np.asarray(a.position_m) - origin) @ turn) for a in heard]
    yield Case("known", "first_camera", from_there)
    yield Case("unknown", "unknown", heard)
    for anchor in heard:
        yield Case(f"only {anchor.anchor_id}", "unknown", [anchor])


def placed(
    log: RangeLog, case: Case, path: Trajectory, described: dict[str, Any], *, by_photo: bool
) -> RangeObservations:
    wanted = [anchor.anchor_id for anchor in case.anchors]
    part = log.subset(np.isin(np.array(log.anchor_ids)[log.anchor_index], wanted))
    arms: npt.ArrayLike = described.get("tag_in_body_m", (0.0, 0.0, 0.0))
    if "tags_in_body_m" in described:
        arms = [described["tags_in_body_m"][tag] for tag in part.tag_ids]
    offset_s = described.get("time_offset_s", 0.0)
    if by_photo:
        part, path, offset_s = at_photos(part, path, offset_s)
    options = RangesOptions(max_interpolation_gap_s=max(described.get("max_gap_s", 0.0), MAX_GAP_S))
    return associate(part, path, arms, time_offset_s=offset_s, options=options)


def at_photos(log: RangeLog, path: Trajectory, offset_s: float) -> tuple[RangeLog, Trajectory, float]:
    """Keep the ranges within 50 ms of a pose, and refer to it by its name instead of the time."""
    times = log.timestamp_s + offset_s
    nearest = np.abs(times[:, None] - path.times_s).argmin(axis=1)
    near = np.abs(times - path.times_s[nearest]) < 0.05
    names = tuple(path.image_names[k] for k in nearest[near])
    return replace(log.subset(near), moments=ByPhoto(names)), replace(path, timestamps_s=None), 0.0


def curve_of(data: Path, described: dict[str, Any]) -> ErrorCurve:
    log, anchors, reference = read_set(data, described)
    path = path_of(reference)
    observations = placed(log, next(cases(log, anchors, path)), path, described, by_photo=False)
    tags_m = FACTOR * observations.centers + observations.tag_from_center
    return calibrate_ranges(observations.log, tags_m, anchors).curve


def one_survey(
    name: str, case: Case, observations: RangeObservations, path: Trajectory
) -> tuple[float, float, float, int, float | None] | None:
    """Return the error of the scale's logarithm, its interval about the estimate, and the number of mistakes named.

    The last number is the root mean square error of the path in the site, metres; None where it is not placed there.
    None if refused.
    """
    began = time.process_time()
    options = ScaleOptions(max_relative_stddev=1.0)
    try:
        found, causes = judged(
            initialize_scale(observations, path, case.anchors, anchor_frame=case.frame, options=options), options
        )
    except GeometryError as refusal:
        print(f"{name:16}{case.name:10} refused: {refusal}", flush=True)
        return None
    error, (low, high) = float(np.log(found.value / FACTOR)), found.uncertainty.interval_95
    seconds = time.process_time() - began
    largest = sorted(found.uncertainty.components.items(), key=lambda part: -part[1])[:3]
    print(
        f"{name:16}{case.name:10}{100 * error:+7.2f} %, truth within {100 * low:+6.2f} to {100 * high:+6.2f} % "
        f"{'covered' if low <= -error <= high else 'MISSED '} {found.verdict:9}"
        f"{seconds:5.1f} s  {', '.join(f'{part} {196 * stddev:.1f}' for part, stddev in largest)}; {causes}",
        flush=True,
    )
    away_m = found.metric_from_sfm.apply(path.centers) - FACTOR * path.centers
    return error, low, high, len(causes), rmse(away_m) if found.frame == "site" else None


def judged(found: ScaleEstimate, options: ScaleOptions) -> tuple[ScaleEstimate, list[str]]:
    """Return the estimate as a run delivers it, and the likeliest mistake and those not told from it, in words."""
    ranges, on_map = find_kind(found.on_map.kinds, RangeScale), found.on_map
    assert ranges is not None
    return found.where_bent(options), [cause.words for cause in ranges.tests(on_map, {}).causes]


if __name__ == "__main__":
    main()
