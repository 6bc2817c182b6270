"""Check that maps without ranges lose their drift, and by how much they then err, against what they say of it.

Run: python -m tests.studies.drift_without_ranges [--kinds positions points ...] [--num_seeds 20] [--out FILE]

Each survey is a rover's lap of 330 m around a field with 90 photos, mapped from noisy features by COLMAP's bundle
adjustment in a frame of its own. No photo sees what an earlier lap saw, so that the map drifts by 0.5, 1, 2 or 5 m on
average over seeds. It is scaled and refined with all defaults, by one of these alone:

- ``positions``: of an antenna on the camera, with noise of 0.02, 0.1 and 1 m as stated, of each photo (even seeds) or
  two a second with times of the camera's clock (odd ones);
- ``receiver``: of an antenna with 0.05 m of noise, which is stated, and as much again that lasts for 20 s;
- ``points``: 6, 8, 10 or 12 control points along the path, each clicked in up to four photos with an error of one
  pixel, and surveyed to 1 cm;
- ``lengths``: 4, 6 or 8 taped lengths of some metres between such marks, each measured to 5 mm. They tell the scale of
  the map where they are, and nothing of its turns.

Prints for each survey and each kind: the drift (the keyframes of the unscaled map after the similarity that fits them
best), the root mean square error of the scaled and the refined map in the world of the result, and what the refined
one's covariance predicts for it; the error of the scale in its standard deviations, and whether its interval has it;
the share of keyframes within their 95 % ellipsoids, and the verdicts with their reasons. Exit status 1 if fewer than
90 % of the scales or of the keyframes are covered.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import special
from tests.simulated.path import lap_path
from tests.simulated.runs import run_stages
from tests.simulated.surveys import TAG_IN_CAM_M, MadeSurvey, Truth, expected_drift_m, made, truth_of
from tests.studies.drifting_maps import ROUND_THE_FIELD_M
from tests.studies.kept_runs import run_seeds, seeds_parser
from tests.studies.known_positions import NO_RANGES, POINT_STDDEV_M, RECEIVERS, Receiver, rms
from tests.studies.measured_distances import marks_in

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.errors import RangesfmError
from rangesfm.measurements.joint_map import find_kind
from rangesfm.measurements.lengths.length_scale import LengthScale
from rangesfm.measurements.lengths.tape import CONTROL, Marker, Tape, TapedDistance
from rangesfm.measurements.positions.antenna_track import AntennaTrack
from rangesfm.measurements.positions.control_points import ControlPoint, ControlPoints
from rangesfm.measurements.positions.position_log import PositionLog
from rangesfm.measurements.positions.position_scale import PositionScale
from rangesfm.measurements.positions.surveyed_positions import SurveyedPositions
from rangesfm.measurements.ranges.anchors.site import Site
from rangesfm.measurements.ranges.clock.offset import TimeOffset
from rangesfm.options import RangesOptions
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.survey.inputs import RangingInputs
from rangesfm.util.geometry.moments import ByPhoto, ByTime
from rangesfm.util.geometry.similarity import align_points, rmse

Array = npt.NDArray[np.float64]
Line = dict[str, Any]

LEVELS_M = (0.5, 1.0, 2.0, 5.0)
NOISES_M = (0.02, 0.1, 1.0)
NUM_POINTS, NUM_LENGTHS = (6, 8, 10, 12), (4, 6, 8)
NUM_KEYFRAMES, DURATION_S, LENGTH_STDDEV_M = 90, 120.0, 0.005
TAPED_M = (3.0, 25.0)
LEAST_COVERED = 0.9


@dataclass(frozen=True)
class Drifting:
    """A lap around a field, and its map; the numbers say how the survey is made."""

    level_m: float
    path: CameraPath
    truth: Truth
    survey: MadeSurvey
    seed: int

    @classmethod
    def of(cls, level_m: float, seed: int, frame: str) -> Drifting:
        path, times = lap_path(DURATION_S, share=0.98), np.linspace(0.0, DURATION_S, NUM_KEYFRAMES)
        in_site, truth = (truth_of(path, times, ROUND_THE_FIELD_M, each, 80, (6.0, 40.0)) for each in ("site", frame))
        survey = made(truth, path, times, level_m / expected_drift_m(in_site), seed, with_radio=False)
        return cls(level_m, path, truth, survey, seed)

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
        covariances = np.tile(receiver.noise_m**2 * np.eye(3), (len(times), 1, 1))
        moments = ByPhoto(self.survey.trajectory.image_names) if of_photos else ByTime(times)
        log = PositionLog(at_m, covariances, moments, np.arange(len(times)))
        offset = None if of_photos else TimeOffset.given(0.0)
        return SurveyedPositions(antenna=AntennaTrack(log, TAG_IN_CAM_M, offset, RangesOptions()))

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
                markers[f"mark{k}"] = self._clicked(ids[k], rng)
            measured_m = float(apart_m[other]) + LENGTH_STDDEV_M * float(rng.standard_normal())
            taped.append(TapedDistance((f"mark{start}", f"mark{other}"), measured_m, LENGTH_STDDEV_M, CONTROL, 0))
        return Tape(tuple(taped), markers)

    def _clicked(self, point_id: int, rng: np.random.Generator) -> Marker:
        model = self.truth.model.reconstruction
        point = model.point3D(point_id)
        images = [model.image(element.image_id) for element in point.track.elements][:4]
        pixels = np.array([image.project_point(point.xyz) for image in images], np.float64)
        return Marker(
            tuple(image.name for image in images),
            pixels + rng.standard_normal(pixels.shape),
            (0,) * len(images),
            1.0,
        )

    def run(self, positions: SurveyedPositions | None = None, tape: Tape | None = None) -> MetricResult:
        """Run all stages from the scale on, with all defaults."""
        known, no_arms = positions or SurveyedPositions(), np.zeros((0, 3))
        inputs = RangingInputs(NO_RANGES, no_arms, (), "unknown", Site(np.zeros(3)), tape or Tape(), positions=known)
        return run_stages(self.survey, self.seed, inputs)


def simulated(kind: str, seed: int) -> tuple[Drifting, str, dict[str, Any]]:
    """Return a survey of a kind, what is measured in words, and the arguments of ``Drifting.run``."""
    level_m = LEVELS_M[seed % len(LEVELS_M)]
    drifting = Drifting.of(level_m, seed, "unknown" if kind == "lengths" else "site")
    which = seed // len(LEVELS_M)
    if kind == "positions":
        noise_m = NOISES_M[which % len(NOISES_M)]
        return drifting, f"noise {noise_m} m", {"positions": drifting.positions(Receiver(noise_m, 0.0, 1.0))}
    if kind == "receiver":
        return drifting, "lasting", {"positions": drifting.positions(RECEIVERS["positions"])}
    if kind == "points":
        num = NUM_POINTS[which % len(NUM_POINTS)]
        return drifting, f"{num} points", {"positions": drifting.points(num)}
    num = NUM_LENGTHS[which % len(NUM_LENGTHS)]
    return drifting, f"{num} lengths", {"tape": drifting.lengths(num)}


def told(kind: str, seed: int) -> Line:
    """Run a survey, and return the figures that the report needs."""
    drifting, words, measured = simulated(kind, seed)
    survey, begin = drifting.survey, time.perf_counter()
    best = align_points(survey.trajectory.centers, survey.true_centers_m)
    drift_m = rmse(best.apply(survey.trajectory.centers) - survey.true_centers_m)
    line: Line = {"kind": kind, "seed": seed, "what": words, "level_m": drifting.level_m, "drift_m": drift_m}
    try:
        metric = drifting.run(**measured)
    except RangesfmError as error:
        return {**line, "refused": str(error)}
    scaled_m, final_m = (metric.trajectory.as_in(model).centers for model in (metric.scaled, metric.final))
    estimate, kept = metric.estimate, metric.kept is not None
    positions, lengths = find_kind(estimate.kinds, PositionScale), find_kind(estimate.kinds, LengthScale)
    low, high = estimate.interval_95
    off_m, variances = final_m - survey.true_centers_m, metric.center_covariance_m2
    line |= {
        "refused": "",
        "seconds": time.perf_counter() - begin,
        "scaled_m": rmse(scaled_m - survey.true_centers_m),
        "final_m": rmse(off_m),
        "bent_m": rmse(align_points(final_m, survey.true_centers_m).apply(final_m) - survey.true_centers_m),
        "kept": kept,
        "why_not": [] if metric.refined is None else list(metric.refined.why_broken),
        "covered": bool(low <= best.scale <= high),
        "half": estimate.uncertainty.half_width_95,
        "scale_stddevs": float(np.log(np.sqrt(low * high) / best.scale) / estimate.uncertainty.empirical),
        "verdict": estimate.verdict,
        "reasons": list(estimate.reasons),
        "place": None if metric.place is None else [metric.place.verdict, *metric.place.reasons],
        "worst_m": None if metric.place is None else metric.place.worst_keyframe_stddev_m,
        "num_off": None if positions is None else int(np.sum(~positions.used)),
        "num_lengths_off": None if lengths is None else len(lengths.left_out),
    }
    if variances:
        known = np.array([variances[name] for name in metric.trajectory.image_names])
        free = np.trace(known, axis1=1, axis2=2) > 1e-9
        squares = np.einsum("ni,nij,nj->n", off_m[free], np.linalg.inv(known[free]), off_m[free])
        line["predicted_m"] = float(np.sqrt(np.mean(np.trace(known, axis1=1, axis2=2))))
        line["within"] = float(np.mean(squares <= special.chdtri(3, 0.05)))
        line["median_stddevs"] = float(np.sqrt(np.median(squares) / special.chdtri(3, 0.5)))
    return line


def report(lines: Sequence[Line]) -> Iterator[str]:
    """Yield a row for each kind."""
    for kind in dict.fromkeys(line["kind"] for line in lines):
        own = [line for line in lines if line["kind"] == kind]
        found = [line for line in own if not line["refused"]]
        if not found:
            yield f"{kind}: {len(own)} surveys, all refused"
            continue
        sure = [line for line in found if "within" in line]
        ratios = [line["final_m"] / line["predicted_m"] for line in sure]
        yield (
            f"{kind}: {len(own)} surveys, {len(own) - len(found)} refused, {sum(not line['kept'] for line in found)} "
            f"not refined, {sum(line['verdict'] == 'good' for line in found)} good; drift "
            f"{np.median([line['drift_m'] for line in found]):.2f} m, refined "
            f"{np.median([line['final_m'] for line in found]):.3f} m (medians); scales covered "
            f"{100 * np.mean([line['covered'] for line in found]):.0f} %, error "
            f"{rms([line['scale_stddevs'] for line in found]):.2f} stddevs, half width "
            f"{100 * np.median([line['half'] for line in found]):.2f} %; keyframes covered "
            f"{100 * np.mean([line['within'] for line in sure]):.0f} %, error over predicted "
            f"{np.median(ratios):.2f} (median), {max(ratios):.2f} (largest)"
        )


def one(line: Line) -> str:
    """Return a survey as a row."""
    start = f"{line['kind']:9} {line['seed']:3} {line['what']:12} drift {line['drift_m']:5.2f} m"
    if line["refused"]:
        return f"{start}: refused: {line['refused']}"
    covered = f"predicted {line['predicted_m']:.3f}, {100 * line['within']:3.0f} % within, {line['median_stddevs']:.2f}"
    return (
        f"{start}: scaled {line['scaled_m']:5.2f}, refined {line['final_m']:.3f} m (bent {line['bent_m']:.3f}), "
        f"{covered if 'within' in line else 'no covariance'}; scale "
        f"{line['scale_stddevs']:+.1f} of {100 * line['half'] / 1.96:.2f} %{'' if line['covered'] else ', not covered'}"
        f"{'' if line['kept'] else ', NOT KEPT'}; {line['verdict']}: {'; '.join(line['reasons'])}"
        + ("" if line["place"] is None else f" | place {line['place'][0]}")
        + (f" | {line['num_off']} off" if line["num_off"] else "")
        + (f" | {line['num_lengths_off']} lengths off" if line["num_lengths_off"] else "")
    )


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the study."""
    asked = seeds_parser(__doc__, ["positions", "receiver", "points", "lengths"], 20).parse_args(arguments)
    lines = [line for line in run_seeds(asked, asked.kinds, told, one) if line["kind"] in asked.kinds]
    print(*report(lines), sep="\n")
    found = [line for line in lines if not line["refused"]]
    shares = [[line["covered"] for line in found], [line["within"] for line in found if "within" in line]]
    return int(not found or min(float(np.mean(of)) for of in shares) < LEAST_COVERED)


if __name__ == "__main__":
    sys.exit(main())
