"""Check a plan's bending of the map by photos: predicted stddevs of keyframes, and the spread of refined maps.

Run: python -m tests.studies.planned_bends [--out FILE] [--num_seeds 40] [--kinds NAME ...]

Simulated features of known noise are mapped, scaled and refined with ranges by the stages themselves. Prints for each
survey the predicted stddev of keyframes (root mean square over the path) for a map whose photos are not planned, and
for one that can bend as its photos allow; the spread of the refined keyframes about the truth, with its stddev by
chance; and the map's bend alone, predicted and as found in the maps before any range is used.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from tests.planning.plans import free_bend_m
from tests.simulated.looped import ScaledMap
from tests.simulated.path import lap_path
from tests.simulated.surveys import (
    RANGE_STDDEV_M,
    TAG_IN_CAM_M,
    Array,
    Truth,
    mapped,
    range_log,
    truth_of,
    yard_truth,
)
from tests.studies.kept_runs import Row, runs_of, seeds_parser, spread

from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.errors.components import COMPONENTS
from rangesfm.options import RangeModelOptions
from rangesfm.planning.expected import Expected, expect
from rangesfm.planning.planned import PlannedSurvey
from rangesfm.planning.planned_photos import PlannedPhotos
from rangesfm.util.geometry.similarity import align_points, rmse
from rangesfm.util.geometry.trajectory import Trajectory

RANGE_MODEL = RangeModelOptions()
# Of the simulated camera.
_WIDTH_PX, _FOCAL_PX = 960, 750.0
_FIELD_OF_VIEW_DEG = float(2 * np.rad2deg(np.arctan(_WIDTH_PX / 2 / _FOCAL_PX)))


def photos(num_points: int, seen_m: tuple[float, float], max_track_length: int | None, pixels: float) -> PlannedPhotos:
    return PlannedPhotos(
        field_of_view_deg=_FIELD_OF_VIEW_DEG,
        seen_m=seen_m,
        num_points=num_points,
        num_photos_of_point=max_track_length or 1000,
        closes_loops=max_track_length is None,
        feature_stddev=pixels / _WIDTH_PX,
    )


def lap(num_observations: int) -> Truth:
    """A quarter of a rover's lap around a soccer field, with 150 keyframes; the anchor is beside the field's middle."""
    path, times = lap_path(300.0, share=0.98 / 4), np.linspace(0.0, 300.0, 150)
    return truth_of(path, times, {"A1": (10.0, 5.0, 4.0)}, "first_camera", num_observations, (6.0, 40.0))


IN_YARD, ON_LAP = (2.0, 20.0), (6.0, 40.0)
SURVEYS: dict[str, tuple[Callable[[], Truth], PlannedPhotos, float]] = {
    "yard, closed loop": (yard_truth, photos(80, IN_YARD, None, 1.0), 1.0),
    "yard, open": (partial(yard_truth, max_track_length=8), photos(80, IN_YARD, 8, 1.0), 1.0),
    "yard, open, one known anchor": (
        partial(yard_truth, anchor_frame="first_camera", max_track_length=8),
        photos(80, IN_YARD, 8, 1.0),
        1.0,
    ),
    "lap, open, sharp": (partial(lap, 100), photos(100, ON_LAP, 8, 0.5), 0.5),
    "lap, open, blurred": (partial(lap, 60), photos(60, ON_LAP, 8, 1.0), 1.0),
}


def planned(survey: Truth, seen: PlannedPhotos) -> PlannedSurvey:
    model = survey.model
    # One range to each anchor at each photo, however far apart the photos are.
    times = np.arange(len(model.timestamps_s)) / 2
    path = Trajectory(np.arange(len(times)), tuple(model.timestamps_s), times, model.centers_m, model.world_from_cam)
    nothing = {component.name: 1e-6 for component in COMPONENTS}
    return PlannedSurvey(
        path,
        tuple(Anchor(name, at) for name, at in survey.anchors_m.items()),
        survey.anchor_frame,
        2.0,
        (float(TAG_IN_CAM_M[0]), float(TAG_IN_CAM_M[1]), float(TAG_IN_CAM_M[2])),
        RANGE_MODEL,
        component_stddevs=nothing
        | {
            "white": RANGE_STDDEV_M,
            "bias": RANGE_MODEL.range_bias_stddev_m,
            "common_bias": RANGE_MODEL.common_bias_stddev_m,
        },
        photos=seen,
    )


def drawn_biases(survey: Truth, seed: int) -> Array:
    """Draw (num_anchors,) biases from the prior that the stages assume: a part for each anchor, and a common part."""
    rng = np.random.default_rng([seed, 2])
    own = RANGE_MODEL.range_bias_stddev_m * rng.standard_normal(len(survey.anchors_m))
    return np.asarray(own + RANGE_MODEL.common_bias_stddev_m * rng.standard_normal())


def one_run(survey: Truth, pixel_stddev: float, seed: int) -> Row:
    """Return the root mean square errors of the keyframes: refined, and before that after the best similarity."""
    sfm = mapped(survey, pixel_stddev, seed)
    made = ScaledMap.of(survey, sfm, range_log(survey, seed, biases_m=drawn_biases(survey, seed)))
    truth, free = survey.model.centers_m, made.trajectory.centers
    return {
        "refined": made.error_m(made.refined_by_default()),
        "bend": rmse(align_points(free, truth).apply(free) - truth),
    }


def rms(stddevs: Expected) -> float:
    return float(np.sqrt(np.mean(stddevs.keyframe_stddevs_m**2)))


def main() -> None:
    asked = seeds_parser(__doc__, SURVEYS, 40).parse_args()
    print(f"{'survey':30}{'poses':>9}{'planned':>10}{'spread':>9}{'ratio':>16}{'bend':>10}{'spread':>9}{'ratio':>16}")
    for name in asked.kinds:
        make, seen, pixel_stddev = SURVEYS[name]
        survey = make()
        plan = planned(survey, seen)
        poses, expected = expect(replace(plan, photos=None)), expect(plan)
        rows = runs_of(asked, name, partial(one_run, survey, pixel_stddev))
        told = [f"{name:30}{rms(poses):7.3f} m"]
        for predicted, of in ((rms(expected), "refined"), (free_bend_m(expected), "bend")):
            found, chance = spread(rows, of)
            ratio = predicted / found
            told.append(f"{predicted:8.3f} m{found:7.3f} m{ratio:8.2f} +-{ratio * chance:4.2f}")
        print("".join(told), flush=True)


if __name__ == "__main__":
    main()
