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
SETS: dict[str, dict[str, Any]] = json.loads(Path(__file__).with_suffix(".json").read_text(encoding="utf-8"))


@dataclass(frozen=True)
class Case:
    """One way to survey with a log."""

    name: str
    frame: str
    anchors: list[Anchor]


@dataclass(frozen=True)
class RealLog:
    """A log, its anchors as surveyed, and the true path in another unit.

    Attributes:
        described: its entry in real_logs.json.
    """

    described: dict[str, Any]
    log: RangeLog
    anchors: list[Anchor]
    path: Trajectory

    @classmethod
    def read(cls, data: Path, name: str) -> RealLog:
        described = SETS[name]
        ranges = data / described["ranges"]
        if "truth" in described:
            anchors = list(read_anchors(data / described["anchors"]))
            reference = read_reference(data / described["truth"])
        else:  # STAR-loc: the tag's position is beside each range, and the anchors' ids are in a column without a name
            table = rows(data / described["anchors"])
            anchors = [Anchor(row[""], np.array([float(row[a]) for a in "xyz"])) for row in table]
            times, first = np.unique([float(row["time_s"]) for row in rows(ranges)], return_index=True)
            places = np.array([[float(row[f"tag_pos_{a}"]) for a in "xyz"] for row in rows(ranges)])
            reference = Reference(places[first], ByTime(times))
        log = read_ranges(ranges, anchor_ids=[anchor.anchor_id for anchor in anchors])
        return cls(described, log, anchors, path_of(reference))

    def cases(self) -> Iterator[Case]:
        heard = [anchor for anchor in self.anchors if anchor.anchor_id in self.log.anchor_ids]
        yield Case("surveyed", "site", heard)
        turn, origin = self.path.world_from_cam[0], FACTOR * self.path.centers[0]
        from_there = [replace(a, position_m=(np.asarray(a.position_m) - origin) @ turn) for a in heard]
        yield Case("known", "first_camera", from_there)
        yield Case("unknown", "unknown", heard)
        for anchor in heard:
            yield Case(f"only {anchor.anchor_id}", "unknown", [anchor])

    def case(self, name: str) -> Case:
        return next(case for case in self.cases() if case.name == name)

    def placed(self, case: Case, path: Trajectory, *, by_photo: bool = False) -> RangeObservations:
        """Return the ranges to the anchors of a case on the true path, or on the same in another world."""
        wanted = [anchor.anchor_id for anchor in case.anchors]
        part = self.log.subset(np.isin(np.array(self.log.anchor_ids)[self.log.anchor_index], wanted))
        arms: npt.ArrayLike = self.described.get("tag_in_body_m", (0.0, 0.0, 0.0))
        if "tags_in_body_m" in self.described:
            arms = [self.described["tags_in_body_m"][tag] for tag in part.tag_ids]
        offset_s = self.described.get("time_offset_s", 0.0)
        if by_photo:
            part, path, offset_s = at_photos(part, path, offset_s)
        options = RangesOptions(max_interpolation_gap_s=max(self.described.get("max_gap_s", 0.0), MAX_GAP_S))
        return associate(part, path, arms, time_offset_s=offset_s, options=options)


@dataclass(frozen=True)
class Outcome:
    """What the scale stage gives of a case.

    Attributes:
        error: of the scale's logarithm. low, high: its 95 % interval about the estimate. num_named: mistakes.
        away_m: root mean square error of the path in the site; None where it is not placed there.
    """

    error: float
    low: float
    high: float
    num_named: int
    away_m: float | None

    @property
    def is_covered(self) -> bool:
        return self.low <= -self.error <= self.high


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--sets", nargs="*", choices=SETS, metavar="NAME")
    parser.add_argument("--no_singles", action="store_true")
    parser.add_argument("--by_photo", action="store_true")
    parser.add_argument("--turned", type=int)
    parser.add_argument("--leave_radio_out", action="store_true")
    parser.add_argument("--calibrated", action="store_true")
    args = parser.parse_args()
    found = []
    for name in args.sets or [name for name in SETS if not args.calibrated or "same_radio" in SETS[name]]:
        real = RealLog.read(args.data, name)
        if args.calibrated:
            curve = curve_of(RealLog.read(args.data, real.described["same_radio"]))
            real = replace(real, log=correct_ranges(real.log, curve)[0])
        given = real.path if args.turned is None else turned(real.path, args.turned)
        expected = components(population(without=name if args.leave_radio_out else None))
        for case in real.cases():
            if not (args.no_singles and case.name.startswith("only")):
                observations = real.placed(case, given, by_photo=args.by_photo)
                with patch("rangesfm.measurements.ranges.errors.learned.COMPONENTS", expected):
                    found.append(one_survey(name, case, observations, given))
    if known := [outcome for outcome in found if outcome is not None]:
        half_widths = np.array([(outcome.high - outcome.low) / 2 for outcome in known])
        from_middle = 1.96 * np.array([each.error + (each.low + each.high) / 2 for each in known]) / half_widths
        away_m = [outcome.away_m for outcome in known if outcome.away_m is not None]
        print(
            f"{len(known)} of {len(found)}: {100 * np.mean([each.is_covered for each in known]):.0f} % covered, the "
            f"truth from the middle in stddevs {np.sqrt(np.mean(from_middle**2)):.2f} (rms), median half width "
            f"{100 * np.median(half_widths):.2f} %, a mistake named in {sum(each.num_named > 0 for each in known)}"
            + (f"; {len(away_m)} paths in a site off by {np.median(away_m):.2g} m (median)" if away_m else "")
        )


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


def at_photos(log: RangeLog, path: Trajectory, offset_s: float) -> tuple[RangeLog, Trajectory, float]:
    """Keep the ranges within 50 ms of a pose, and refer to it by its name instead of the time."""
    times = log.timestamp_s + offset_s
    nearest = np.abs(times[:, None] - path.times_s).argmin(axis=1)
    near = np.abs(times - path.times_s[nearest]) < 0.05
    names = tuple(path.image_names[k] for k in nearest[near])
    return replace(log.subset(near), moments=ByPhoto(names)), replace(path, timestamps_s=None), 0.0


def curve_of(real: RealLog) -> ErrorCurve:
    observations = real.placed(real.case("surveyed"), real.path)
    tags_m = FACTOR * observations.centers + observations.tag_from_center
    return calibrate_ranges(observations.log, tags_m, real.anchors).curve


def one_survey(name: str, case: Case, observations: RangeObservations, path: Trajectory) -> Outcome | None:
    """Find the scale, and print what was found; return None if it is refused."""
    began = time.process_time()
    options = ScaleOptions(max_relative_stddev=1.0)
    try:
        found, causes = judged(
            initialize_scale(observations, path, case.anchors, anchor_frame=case.frame, options=options), options
        )
    except GeometryError as refusal:
        print(f"{name:16}{case.name:10} refused: {refusal}", flush=True)
        return None
    away_m = found.metric_from_sfm.apply(path.centers) - FACTOR * path.centers
    outcome = Outcome(
        float(np.log(found.value / FACTOR)), *found.uncertainty.interval_95, len(causes),
        rmse(away_m) if found.frame == "site" else None,
    )  # fmt: skip
    seconds = time.process_time() - began
    largest = sorted(found.uncertainty.components.items(), key=lambda part: -part[1])[:3]
    print(
        f"{name:16}{case.name:10}{100 * outcome.error:+7.2f} %, truth within {100 * outcome.low:+6.2f} to "
        f"{100 * outcome.high:+6.2f} % {'covered' if outcome.is_covered else 'MISSED '} {found.verdict:9}"
        f"{seconds:5.1f} s  {', '.join(f'{part} {196 * stddev:.1f}' for part, stddev in largest)}; {causes}",
        flush=True,
    )
    return outcome


def judged(found: ScaleEstimate, options: ScaleOptions) -> tuple[ScaleEstimate, list[str]]:
    """Return the estimate as a run delivers it, and the likeliest mistake and those not told from it, in words."""
    ranges, on_map = find_kind(found.on_map.kinds, RangeScale), found.on_map
    assert ranges is not None
    return found.where_bent(options), [cause.words for cause in ranges.tests(on_map, {}).causes]


if __name__ == "__main__":
    main()
