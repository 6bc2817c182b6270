"""Check whether true distances and height differences are in their stated intervals, on simulated surveys of ten kinds.

Run: python -m tests.studies.measured_distances [--kinds yard hall ...] [--num_seeds 20] [--seed 0] [--out FILE]

Each survey is mapped from noisy features by COLMAP's bundle adjustment, then scaled and refined with all defaults. Its
radio is drawn from the population of real ones, one range in 25 is obstructed. Measured are pairs of marks, which
somebody clicked in up to four photos with an error of one pixel, and pairs of photos, of map points, and of a mark and
an anchor. The truth is that of the simulation.

Prints for each kind of survey the shares of distances and of height differences in their 95 % intervals, with the
standard error of the share over surveys (distances of one survey share the error of its scale), the median half width
of the intervals as a share of the distance, and the root mean square of the errors in stated standard deviations: of
all, and of the means over each survey. Both are 1 where only the scale errs, as between photos; then the share says
little more than in how many surveys the scale is in its interval. No two surveys have the same radio or path. Exit
status 1 if the share of distances between marks, over all surveys, is not within 93 to 97 %.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
from tests.simulated.path import lap_path, loop_path, orbit_path, sequence_path
from tests.simulated.runs import run_stages
from tests.simulated.surveys import HALL, SITE_ANCHORS_M, Kind, Truth, simulated
from tests.studies.kept_runs import runs_of, seeds_parser

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.errors import GeometryError, SolverError
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.measurements.points import NamedPoints
from rangesfm.pipeline.measure import Measurement, measured
from rangesfm.pipeline.metric_result import MetricResult
from rangesfm.util.geometry.gravity import UP_IN_SITE

Array = npt.NDArray[np.float64]
Line = dict[str, Any]

NUM_MARKS, MAX_NUM_PHOTOS, MARK_STDDEV_PX = 16, 4, 1.0
NUM_PAIRS = {"marks": 30, "photos": 15, "points": 15, "mark and anchor": 8}
MIN_DISTANCE_M = 0.3
WANTED = (0.93, 0.97)
Z_95 = 1.96

ROOM_M = {f"R{k}": (x, y, z) for k, (x, y, z) in enumerate(
    [(2.4, 2.9, 2.2), (-2.4, 2.8, 0.4), (-2.3, -2.9, 2.3), (2.5, -2.7, 0.3), (0.1, 3.0, 1.3), (0.0, -3.0, 0.8)], 1
)}  # fmt: skip
MAST_M = {"A1": (10.0, 5.0, 8.0)}
ALONG_M = {"B1": (-5.0, 8.0, 3.0), "B2": (15.0, -9.0, 1.0), "B3": (35.0, 9.0, 4.0), "B4": (55.0, -8.0, 0.5)}


def _yard(seed: int) -> CameraPath:
    return loop_path(40.0, height_amplitude_m=0.8, unsteadiness_m=0.1, seed=seed)


def _room(seed: int) -> CameraPath:
    return loop_path(
        60.0, center_m=(0, 0, 1.4), semi_axes_m=(1.3, 1.6), height_amplitude_m=0.5, num_turns=2.3,
        unsteadiness_m=0.1, seed=seed,
    )  # fmt: skip


ROOM = Kind("room", _room, ROOM_M, "site", interval_s=1.0, num_observations=120, depth_range_m=(0.8, 4.0))
_FIRST_IN_YARD_M, _THIRD_IN_YARD_M = ({name: SITE_ANCHORS_M[name]} for name in ("A1", "A3"))
KINDS = {
    kind.name: kind
    for kind in (
        Kind("yard", _yard, SITE_ANCHORS_M, "site", interval_s=0.7),
        Kind("yard, one anchor in the first camera's frame", _yard, _FIRST_IN_YARD_M, "first_camera", interval_s=0.7),
        Kind("yard, four unknown anchors", _yard, SITE_ANCHORS_M, "unknown", interval_s=0.7),
        Kind("yard, one unknown anchor", _yard, _THIRD_IN_YARD_M, "unknown", interval_s=0.7, rate_hz=10.0),
        ROOM,
        replace(ROOM, name="room, six unknown anchors", anchor_frame="unknown"),
        replace(HALL, interval_s=1.5, tag_in_cam_m=Kind.tag_in_cam_m),
        Kind(
            "orbit of a drone", lambda seed: orbit_path(60.0 + seed % 3, radius_m=15.0, height_amplitude_m=3.0),
            SITE_ANCHORS_M, "site", interval_s=1.0, num_observations=80, depth_range_m=(6.0, 40.0),
        ),
        Kind(
            "way that never returns", lambda seed: sequence_path(60.0, seed=seed), ALONG_M, "site", interval_s=0.8,
            num_observations=80, depth_range_m=(3.0, 25.0),
        ),
        Kind(
            "part of a lap, one anchor on a mast", lambda _: lap_path(40.0, share=0.13), MAST_M, "first_camera",
            interval_s=0.6, rate_hz=8.0, num_observations=120, depth_range_m=(6.0, 40.0), pixel_stddev=0.3,
        ),
    )
}  # fmt: skip


def clicked(place: Array, images: Sequence[pycolmap.Image], rng: np.random.Generator) -> Marker:
    """Return marks of a place (3,) in photos, with the errors of somebody who clicks."""
    pixels = np.array([image.project_point(place) for image in images], np.float64)
    pixels += MARK_STDDEV_PX * rng.standard_normal(pixels.shape)
    return Marker(tuple(image.name for image in images), pixels, (0,) * len(images), MARK_STDDEV_PX)


def marks_in(truth: Truth, rng: np.random.Generator) -> tuple[dict[str, Marker], dict[str, Array]]:
    """Return marks in photos at points of the scene, and their true positions."""
    model = truth.model.reconstruction
    ids = [i for i in sorted(model.point3D_ids()) if model.point3D(i).track.length() >= 3]
    markers, true_m = {}, {}
    for k, point_id in enumerate(rng.choice(ids, min(NUM_MARKS, len(ids)), replace=False).tolist()):
        point = model.point3D(point_id)
        images = [model.image(element.image_id) for element in point.track.elements]
        chosen = [images[i] for i in np.unique(np.linspace(0, len(images) - 1, MAX_NUM_PHOTOS).astype(int))]
        markers[f"mark{k}"] = clicked(point.xyz, chosen, rng)
        true_m[f"mark{k}"] = point.xyz
    return markers, true_m


def pairs_of(names: dict[str, list[str]], true_m: dict[str, Array], rng: np.random.Generator) -> Iterator[list[str]]:
    """Yield pairs with the kind of their ends."""
    for what, num in NUM_PAIRS.items():
        first, second = (names["marks"], names["anchors"]) if what == "mark and anchor" else (names[what], names[what])
        for _ in range(num):
            a, b = rng.choice(first), rng.choice(second)
            if np.linalg.norm(true_m[b] - true_m[a]) >= MIN_DISTANCE_M:
                yield [what, str(a), str(b)]


def measured_in(
    metric: MetricResult, markers: dict[str, Marker], pairs: Iterable[tuple[str, str]]
) -> tuple[Measurement, ...]:
    assert metric.kept is not None
    anchors_m = {anchor.anchor_id: anchor.position_m for anchor in metric.anchors}
    pixel_stddev = metric.kept.pixel_stddev
    points = NamedPoints.in_model(metric.final, markers, anchors_m, pixel_stddev=pixel_stddev)
    up = (UP_IN_SITE, 0.0) if metric.estimate.frame == "site" else None
    return measured(points, pairs, metric.map_errors, metric.estimate.uncertainty.empirical, up)


def told(name: str, seed: int) -> Line:
    """Run a survey, and return what was measured: errors and half widths, metres."""
    line: Line = {"kind": name, "seed": seed}
    own_seed = 1000 * list(KINDS).index(name) + seed
    truth, survey = simulated(KINDS[name], own_seed)
    rng = np.random.default_rng([own_seed, 21])
    try:
        metric = run_stages(survey, own_seed)
    except (GeometryError, SolverError) as error:
        return {**line, "refused": str(error)}
    if not metric.map_errors.are_known:
        return {**line, "refused": "no refined map with a covariance"}
    model = truth.model
    markers, true_m = marks_in(truth, rng)
    names = {"marks": list(markers), "photos": list(model.timestamps_s), "anchors": list(truth.anchors_m)}
    seen = [i for i in metric.final.point3D_ids() if metric.final.point3D(i).track.length() >= 3]
    names["points"] = [f"point:{i}" for i in rng.choice(sorted(seen), 30, replace=False).tolist()]
    true_m |= dict(zip(model.timestamps_s, model.centers_m, strict=True)) | truth.anchors_m
    true_m |= {name: model.reconstruction.point3D(int(name[6:])).xyz for name in names["points"]}
    pairs = [*pairs_of(names, true_m, rng)]
    found = measured_in(metric, markers, ((a, b) for _, a, b in pairs))
    rows = [_row(what, each, true_m) for (what, _, _), each in zip(pairs, found, strict=True)]
    return {**line, "refused": "", "verdict": metric.estimate.verdict, "rows": rows}


def _row(what: str, found: Measurement, true_m: dict[str, Array]) -> Line:
    apart = true_m[found.ends[1]] - true_m[found.ends[0]]
    row: Line = {"what": what, **_off("distance", found.distance_interval_m, float(np.linalg.norm(apart)))}
    row["distance_m"] = float(np.linalg.norm(apart))
    if found.height_interval_m is not None:
        row |= _off("height", found.height_interval_m, float(apart[2]))
    return row


def _off(name: str, interval: tuple[float, float], truth: float) -> Line:
    half = (interval[1] - interval[0]) / 2
    return {f"{name}_off_m": (interval[0] + interval[1]) / 2 - truth, f"{name}_half_m": half}


def share_covered(lines: list[Line], what: str, measure: str = "distance") -> tuple[float, float, int]:
    """Return the share of measurements in their intervals, its standard error over surveys, and their number."""
    shares, sizes = [], []
    for line in lines:
        rows = [row for row in line["rows"] if row["what"] == what and f"{measure}_half_m" in row]
        rows = [row for row in rows if row[f"{measure}_half_m"] > 1e-9]
        if rows:
            shares.append(np.mean([abs(row[f"{measure}_off_m"]) <= row[f"{measure}_half_m"] for row in rows]))
            sizes.append(len(rows))
    if not shares:
        return np.nan, np.nan, 0
    spread = float(np.std(shares, ddof=1) / np.sqrt(len(shares))) if len(shares) > 1 else np.nan
    return float(np.average(shares, weights=sizes)), spread, sum(sizes)


def in_stddevs(lines: list[Line], what: str) -> tuple[float, float]:
    """Return the RMS error of distances in stated standard deviations, and that of the means over each survey."""
    of_surveys = [
        [
            Z_95 * row["distance_off_m"] / row["distance_half_m"]
            for row in line["rows"]
            if row["what"] == what and row["distance_half_m"] > 1e-9
        ]
        for line in lines
    ]
    known = [np.array(errors) for errors in of_surveys if errors]
    means = np.array([errors.mean() for errors in known])
    return float(np.sqrt(np.mean(np.concatenate(known) ** 2))), float(np.sqrt(np.mean(means**2)))


def report(lines: list[Line]) -> Iterator[str]:
    """Yield a row for each kind of survey and of ends, and for all surveys together."""
    judged = [line for line in lines if not line["refused"]]
    for kind in [*dict.fromkeys(line["kind"] for line in lines), "all"]:
        own = [line for line in judged if kind in ("all", line["kind"])]
        num = sum(kind in ("all", line["kind"]) for line in lines)
        yield f"{kind}: {num} surveys, {num - len(own)} refused or without a refined map"
        for what in NUM_PAIRS:
            rows = [
                row for line in own for row in line["rows"] if row["what"] == what and row["distance_half_m"] > 1e-9
            ]
            if not rows:
                continue
            texts = []
            for measure in ("distance", "height"):
                share, error, size = share_covered(own, what, measure)
                if size:
                    texts.append(f"{measure}s {100 * share:.1f} % +- {100 * error:.1f} ({size})")
            width = np.median([row["distance_half_m"] / row["distance_m"] for row in rows])
            errors, of_surveys = in_stddevs(own, what)
            yield (
                f"  {what:16} {'; '.join(texts)}; half width {100 * width:.2f} %, errors {errors:.2f} stddevs, "
                f"common to a survey {of_surveys:.2f}"
            )


def main() -> int:
    asked = seeds_parser(__doc__, KINDS, 20).parse_args()
    lines = [line for kind in asked.kinds for line in runs_of(asked, kind, partial(told, kind))]
    print(*report(lines), sep="\n")
    share, _, _ = share_covered([line for line in lines if not line["refused"]], "marks")
    return 0 if WANTED[0] <= share <= WANTED[1] else 1


if __name__ == "__main__":
    sys.exit(main())
