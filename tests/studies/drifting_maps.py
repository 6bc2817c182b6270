"""Check how clean surveys of drifting maps are judged: what is kept, what is stated, and what is wrongly named.

Run: python -m tests.studies.drifting_maps [--kinds lap hall ...] [--num_seeds 2] [--seed 0] [--out FILE]

These surveys have only the errors that all surveys have: features are noisy (0.7 pixels in the hall), so that COLMAP's
bundle adjustment of them bends and drifts, and radios have errors.

- ``lap``: a rover's lap of 300 m around a field, forward camera, tracks of at most 8 photos, no loop closed, one anchor
  on a mast beside the middle, known in the first camera's frame, Gaussian ranges of 0.1 m. The number of features in a
  photo and their noise give it a drift of 0.2, 0.5, 1, 2, 5 and 15 m on average over seeds.
- ``lap_unknown``: the same with an unknown anchor. ``lap_site``: four surveyed anchors around the field.
- ``lap_radio``: like ``lap_site``, with a radio drawn from the population of real ones, one range in 25 obstructed.
- ``hall``: 120 s in a hall, tracks of at most 8 photos, six surveyed anchors, with the same kind of radio.
- ``poses``: keyframes of ``lap_site`` with such a radio and without points, scaled only.
- ``desk``: real monocular keyframes (ORB-SLAM on TUM's fr2_desk), scaled only, with four surveyed anchors around the
  desk and simulated ranges of 0.08 m. Needs --data.

The others have no ranges. They are laps like those above with 90 photos and a drift of 0.5, 1, 2 or 5 m, and have one
of these alone:

- ``positions``: of an antenna on the camera, with noise of 0.02, 0.1 and 1 m as stated, of each photo (even seeds) or
  two a second with times of the camera's clock (odd ones);
- ``receiver``: of an antenna with 0.05 m of noise, which is stated, and as much again that lasts for 20 s;
- ``points``: 6, 8, 10 or 12 control points along the path, each clicked in up to four photos with an error of one
  pixel, and surveyed to 1 cm;
- ``lengths``: 4, 6 or 8 taped lengths of some metres between such marks, each measured to 5 mm. They tell the scale of
  the map where they are, and nothing of its turns.

Prints for each kind: the median drift (after the similarity that fits the unscaled map best) and the median error of
the delivered map; how many refined maps are nearer to the truth than the scaled map, and how many of these are kept;
how many of the delivered scales lie in their 95 % interval, and its median half width; errors of scale and of keyframes
in their stated stddevs (root mean square: 1 if the stddevs are honest); and how many surveys are doubted, and have a
mistake named. With --out each run is a line of a file, and runs that are there already are not repeated. Exit status 1
if fewer than 90 % of the scales are covered.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation
from tests.simulated.path import lap_path
from tests.simulated.runs import inputs_of, run_stages
from tests.simulated.surveys import (
    HALL,
    TAG_IN_CAM_M,
    Kind,
    MadeSurvey,
    Truth,
    expected_drift_m,
    in_turn,
    made,
    truth_of,
)
from tests.studies.kept_runs import runs_of, seeds_parser
from tests.studies.known_positions import POINT_STDDEV_M, RECEIVERS, Receiver, antenna_track
from tests.studies.measured_distances import MAST_M, MAX_NUM_PHOTOS, clicked, marks_in

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.errors import RangesfmError
from rangesfm.measurements.clock.offset import TimeOffset
from rangesfm.measurements.lengths.tape import CONTROL, Marker, Tape, TapedDistance
from rangesfm.measurements.positions.control_points import ControlPoint, ControlPoints
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.survey.inputs import RangingInputs
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.similarity import align_points, rmse
from rangesfm.util.geometry.trajectory import Trajectory

Array = npt.NDArray[np.float64]
Line = dict[str, Any]

LEVELS_M = (0.2, 0.5, 1.0, 2.0, 5.0, 15.0)
# At heights that distinguish the map from its mirror image.
ROUND_THE_FIELD_M = {"N": (5.0, 52.0, 14.0), "E": (68.0, -4.0, 2.0), "S": (-8.0, -50.0, 18.0), "W": (-66.0, 9.0, 4.0)}

# Of the laps without ranges.
LEVELS_WITHOUT_RANGES_M = (0.5, 1.0, 2.0, 5.0)
NOISES_M = (0.02, 0.1, 1.0)
NUM_POINTS, NUM_LENGTHS = (6, 8, 10, 12), (4, 6, 8)
NUM_KEYFRAMES, DURATION_S, LENGTH_STDDEV_M = 90, 120.0, 0.005
TAPED_M = (3.0, 25.0)
LEAST_COVERED = 0.9
WITHOUT_RANGES = ("positions", "receiver", "points", "lengths")


def lap(seed: int, anchor_frame: str = "first_camera", *, with_radio: bool = False) -> MadeSurvey:
    """Simulate one lap; successive seeds go through the levels of drift."""
    return lap_of_drift(LEVELS_M[seed % len(LEVELS_M)], seed, anchor_frame, with_radio=with_radio)


def lap_of_drift(
    level_m: float,
    seed: int,
    anchor_frame: str = "first_camera",
    *,
    with_radio: bool = False,
    num_keyframes: int = 600,
) -> MadeSurvey:
    """Simulate one lap with this drift on average."""
    num_observations = 150 if level_m < 3 else 60 if level_m < 10 else 40
    anchors_m = ROUND_THE_FIELD_M if anchor_frame == "site" else MAST_M
    path, times = lap_path(300.0, share=0.98), np.linspace(0.0, 300.0, num_keyframes)
    truth = truth_of(path, times, anchors_m, anchor_frame, num_observations, (6.0, 40.0))
    pixels = level_m / expected_drift_m(truth)
    return made(truth, path, np.repeat(times, len(anchors_m)), pixels, seed, with_radio=with_radio)


def hall(seed: int) -> MadeSurvey:
    kind, path = replace(HALL, num_observations=120, tag_in_cam_m=Kind.tag_in_cam_m), HALL.path(seed)
    truth = kind.truth(path)
    return made(truth, path, in_turn(kind, path, truth), kind.pixel_stddev, seed)


def poses(seed: int) -> MadeSurvey:
    return without_points(lap(seed, "site", with_radio=True))


def without_points(survey: MadeSurvey) -> MadeSurvey:
    """Return the survey with its path alone, which can only be scaled."""
    return replace(survey, sfm=None)


def desk(folder: Path, seed: int) -> MadeSurvey:
    """Read real keyframes, matched with the truth by time; those in gaps of the truth are left out."""
    keyframes, truth = (np.loadtxt(folder / name) for name in ("fr2_desk_ORB_kf_mono.txt", "fr2_desk_groundtruth.txt"))
    rng = np.random.default_rng([seed, 11])
    nearest = np.abs(truth[:, 0] - keyframes[:, :1]).argmin(axis=1)
    known = np.abs(truth[nearest, 0] - keyframes[:, 0]) < 0.02
    keyframes, truth = keyframes[known], truth[nearest[known]]
    times, centers_m = keyframes[:, 0] - keyframes[0, 0], truth[:, 1:4]
    true_cam, seen_cam = (Rotation.from_quat(rows[:, 4:8]).as_matrix() for rows in (truth, keyframes))
    middle, size = centers_m.mean(axis=0), np.ptp(centers_m, axis=0)
    corners = np.array([(-1, -1, 0.3), (1, -1, -0.6), (1, 1, 0.8), (-1, 1, -0.2)])
    anchors_m = {f"A{k}": middle + corner * (0.6 * size + 0.8) for k, corner in enumerate(corners, 1)}
    path = Trajectory(
        np.arange(1, len(times) + 1), tuple(f"{k:05d}.png" for k in range(len(times))), times, keyframes[:, 1:4],
        seen_cam,
    )  # fmt: skip
    at = np.repeat(np.arange(len(times)), len(anchors_m))
    ids = np.tile(np.arange(len(anchors_m)), len(times))
    tags_m = centers_m[at] + true_cam[at] @ TAG_IN_CAM_M
    survey = MadeSurvey(
        None, path, anchors_m, "site", TAG_IN_CAM_M, times[at], ids, np.zeros(len(at)), tags_m, true_cam[at], anchors_m,
        centers_m, align_points(path.centers, centers_m).scale,
    )  # fmt: skip
    survey.range_m = survey.distances_m + 0.08 * rng.normal(size=len(at))
    return survey


@dataclass(frozen=True)
class LapWithoutRanges:
    """A lap around a field, and its map."""

    path: CameraPath
    truth: Truth
    survey: MadeSurvey
    seed: int

    @classmethod
    def of(cls, kind: str, seed: int) -> LapWithoutRanges:
        level_m = LEVELS_WITHOUT_RANGES_M[seed % len(LEVELS_WITHOUT_RANGES_M)]
        frame = "unknown" if kind == "lengths" else "site"
        path, times = lap_path(DURATION_S, share=0.98), np.linspace(0.0, DURATION_S, NUM_KEYFRAMES)
        in_site, truth = (truth_of(path, times, ROUND_THE_FIELD_M, each, 80, (6.0, 40.0)) for each in ("site", frame))
        survey = made(truth, path, times, level_m / expected_drift_m(in_site), seed, with_radio=False)
        return cls(path, truth, survey, seed)

    @property
    def rng(self) -> np.random.Generator:
        return np.random.default_rng([self.seed, 41])

    def positions(self, receiver: Receiver) -> SurveyedPositions:
        """Return positions of the antenna with its noise as stated: of each photo, or two a second."""
        of_photos = self.seed % 2 == 0
        times = np.array(list(self.truth.model.timestamps_s.values()))
        if not of_photos:
            times = np.arange(times[0] + 0.2, times[-1], 0.5)
        at_m = self.path.centers(times) + self.path.world_from_cam(times) @ TAG_IN_CAM_M
        at_m = at_m + receiver.errors_m(times, self.rng)
        moments = ByPhoto(self.survey.trajectory.image_names) if of_photos else ByTime(times)
        offset = None if of_photos else TimeOffset.given(0.0)
        return SurveyedPositions(antenna=antenna_track(at_m, receiver.noise_m, moments, TAG_IN_CAM_M, offset))

    def marks(self, num: int) -> tuple[dict[str, Marker], dict[str, Array]]:
        """Return marks and their true positions, evenly along the path."""
        markers, true_m = marks_in(self.truth, self.rng)
        along = sorted(markers, key=lambda name: markers[name].image_names[0])
        chosen = [along[k] for k in np.linspace(0, len(along) - 1, num).round().astype(int)]
        return {name: markers[name] for name in chosen}, {name: true_m[name] for name in chosen}

    def points(self, num: int) -> SurveyedPositions:
        markers, true_m = self.marks(num)
        points = (
            ControlPoint(name, at + POINT_STDDEV_M * self.rng.standard_normal(3), POINT_STDDEV_M, CONTROL, 0)
            for name, at in true_m.items()
        )
        return SurveyedPositions(ControlPoints(tuple(points), markers))

    def lengths(self, num: int) -> Tape:
        """Return lengths between marks that are near each other, along the path."""
        model, rng = self.truth.model.reconstruction, self.rng
        ids = [i for i in sorted(model.point3D_ids()) if model.point3D(i).track.length() >= 4]
        places = np.array([model.point3D(i).xyz for i in ids])
        markers: dict[str, Marker] = {}
        taped = []
        for start in np.linspace(0, len(ids) - 1, num + 2).round().astype(int)[1:-1].tolist():
            apart_m = np.linalg.norm(places - places[start], axis=1)
            other = int(rng.choice(np.flatnonzero((apart_m > TAPED_M[0]) & (apart_m < TAPED_M[1]))))
            for k in (start, other):
                seen_by = model.point3D(ids[k]).track.elements[:MAX_NUM_PHOTOS]
                markers[f"mark{k}"] = clicked(places[k], [model.image(each.image_id) for each in seen_by], rng)
            measured_m = float(apart_m[other]) + LENGTH_STDDEV_M * float(rng.standard_normal())
            taped.append(TapedDistance((f"mark{start}", f"mark{other}"), measured_m, LENGTH_STDDEV_M, CONTROL, 0))
        return Tape(tuple(taped), markers)

    def inputs(self, kind: str) -> RangingInputs:
        """Return what is measured in a survey of a kind; successive seeds go through the numbers of it."""
        which, tape, known = self.seed // len(LEVELS_WITHOUT_RANGES_M), Tape(), SurveyedPositions()
        if kind == "positions":
            known = self.positions(Receiver(NOISES_M[which % len(NOISES_M)], 0.0, 1.0))
        elif kind == "receiver":
            known = self.positions(RECEIVERS["positions"])
        elif kind == "points":
            known = self.points(NUM_POINTS[which % len(NUM_POINTS)])
        else:
            tape = self.lengths(NUM_LENGTHS[which % len(NUM_LENGTHS)])
        return inputs_of(None, tape, known)


def told(kind: str, seed: int, data: Path | None = None) -> Line:
    """Run a survey, and return the figures that the report needs."""
    if kind in WITHOUT_RANGES:
        lap = LapWithoutRanges.of(kind, seed)
        survey, inputs = lap.survey, lap.inputs(kind)
    else:
        survey, inputs = surveys(data)[kind](seed), None
    unscaled = align_points(survey.trajectory.centers, survey.true_centers_m).apply(survey.trajectory.centers)
    line: Line = {"kind": kind, "seed": seed, "drift_m": rmse(unscaled - survey.true_centers_m)}
    try:
        metric = run_stages(survey, seed, inputs)
    except RangesfmError as error:
        return {**line, "refused": str(error)}
    scaled_m, final_m = (metric.trajectory.as_in(model).centers for model in (metric.scaled, metric.final))
    estimate, refined = metric.estimate, metric.refined
    # The interval belongs to the delivered map, so the error is that of its scale.
    delivered = estimate.value if metric.kept is None else metric.kept.scale
    low, high = estimate.interval_95
    variances = metric.center_covariance_m2
    known = np.array([variances[name] for name in metric.trajectory.image_names]) if variances else None
    refined_m = None if refined is None else metric.trajectory.as_in(refined.model).centers
    off_m = final_m - survey.true_centers_m
    return {
        **line,
        "refused": "",
        "scaled_m": rmse(scaled_m - survey.true_centers_m),
        "final_m": rmse(off_m),
        "refined_m": None if refined_m is None else rmse(refined_m - survey.true_centers_m),
        "kept": metric.kept is not None,
        "why_not": [] if refined is None else list(refined.why_broken),
        "log_error": float(np.log(delivered / survey.metres_per_unit)),
        "half_width": estimate.uncertainty.half_width_95,
        "stddev": estimate.uncertainty.empirical,
        "covered": bool(low <= survey.metres_per_unit <= high),
        "places": None if known is None else float(np.sqrt(np.mean(np.sum(off_m**2, axis=1) / _traces(known)))),
        "places_covered": None if known is None else _covered(off_m, known),
        "verdict": estimate.verdict,
        "reasons": list(estimate.reasons),
        "causes": [f"{c.name} {c.subject}".strip() for c in metric.diagnosis.causes],
        "of_evidence": [t.name for t in metric.diagnosis.tests if t.rejected and not t.stddev],
    }


def _traces(covariances: Array) -> Array:
    return np.asarray(np.maximum(np.trace(covariances, axis1=1, axis2=2), 1e-12))


def _covered(off_m: Array, covariances: Array) -> float:
    """Return the share of coordinates within 1.96 of their stddevs, over all keyframes that are not held."""
    stddevs = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    free = stddevs.min(axis=1) > 1e-9
    return float(np.mean(np.abs(off_m[free]) <= 1.96 * stddevs[free]))


def surveys(data: Path | None) -> dict[str, Callable[[int], MadeSurvey]]:
    """Functions that simulate a survey with ranges, by kind."""
    found: dict[str, Callable[[int], MadeSurvey]] = {
        "lap": lap,
        "lap_unknown": lambda seed: lap(seed, "unknown"),
        "lap_site": lambda seed: lap(seed, "site"),
        "lap_radio": lambda seed: lap(seed, "site", with_radio=True),
        "hall": hall,
        "poses": poses,
    }
    if data is not None:
        found["desk"] = lambda seed: desk(data / "slam_keyframes", seed)
    return found


def report(lines: list[Line]) -> Iterator[str]:
    """Yield a row for each kind."""
    for kind in dict.fromkeys(line["kind"] for line in lines):
        own = [line for line in lines if line["kind"] == kind]
        judged = [line for line in own if not line["refused"]]
        if not judged:
            yield f"{kind:12}{len(own):4} runs, all refused"
            continue
        refined = [line for line in judged if line["refined_m"] is not None]
        nearer = [line for line in refined if line["refined_m"] < line["scaled_m"]]
        in_stddevs = np.array([line["log_error"] / line["stddev"] for line in judged])
        places = [line["places"] for line in judged if line["places"] is not None]
        share = [line["places_covered"] for line in judged if line["places_covered"] is not None]
        yield (
            f"{kind:12}{len(own):4} runs, {len(own) - len(judged)} refused; drift "
            f"{np.median([line['drift_m'] for line in judged]):.2f} m, delivered "
            f"{np.median([line['final_m'] for line in judged]):.3f} m; nearer to the truth {len(nearer)} of "
            f"{len(refined)} refined, of these kept {sum(line['kept'] for line in nearer)}; scale covered "
            f"{100 * np.mean([line['covered'] for line in judged]):.0f} %, half width "
            f"{100 * np.median([line['half_width'] for line in judged]):.2f} %, errors in stddevs "
            f"{np.sqrt(np.mean(in_stddevs**2)):.2f}, of places {np.median(places) if places else np.nan:.2f}, places "
            f"covered {100 * np.mean(share) if share else np.nan:.0f} %; doubted "
            f"{sum(line['verdict'] != 'good' for line in judged)}, mistake named "
            f"{sum(bool(line['causes']) for line in judged)}"
        )


def main() -> int:
    parser = seeds_parser(__doc__, [*surveys(Path()), *WITHOUT_RANGES], 6)
    parser.add_argument("--data", type=Path)
    asked = parser.parse_args()
    there = [kind for kind in asked.kinds if kind in WITHOUT_RANGES or kind in surveys(asked.data)]
    lines = [line for kind in there for line in runs_of(asked, kind, partial(told, kind, data=asked.data))]
    print(*report(lines), sep="\n")
    covered = [line["covered"] for line in lines if not line["refused"]]
    return int(not covered or float(np.mean(covered)) < LEAST_COVERED)


if __name__ == "__main__":
    sys.exit(main())
