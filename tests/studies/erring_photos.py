"""Simulated surveys with photos that may contain a mistake, and all stages from the scale on, with their tests."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from tests.studies.drifting_maps import HALL_PIXELS, made
from tests.studies.erring_surveys import Given, Run, Site, distances, radio_errors
from tests.studies.simulated_survey import truth_of

from rangesfm.distances.tape import Tape
from rangesfm.errors import GeometryError, SolverError
from rangesfm.geometry.similarity import align_points
from rangesfm.progress import Journal, SilentProgress
from rangesfm.ranging.anchors.anchor import Anchor
from rangesfm.ranging.anchors.site import Site as SiteFrame
from rangesfm.ranging.association import associate
from rangesfm.ranging.range_log import RangeLog
from rangesfm.survey.inputs import RangingInputs
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_run import PathOfModel, SurveyRun
from rangesfm.workflows.metric_result import MetricResult
from rangesfm.workflows.run import map_in_metres

# One photo a second with this many features, each seen in up to eight photos, at these distances: the map of a hall
# bends by a decimetre.
INTERVAL_S, NUM_FEATURES, DEPTH_RANGE_M = 1.0, 30, (1.5, 9.0)


@dataclass(frozen=True)
class RunOfPhotos(Run):
    """The outcome of one survey with photos; no result where it was refused."""

    metric: MetricResult | None = None

    @property
    def doubts(self) -> list[str]:
        """List everything that speaks against the map."""
        assert self.metric is not None
        estimate, place = self.metric.estimate, self.metric.place
        of_place = place.reasons if place is not None and place.verdict != "good" else ()
        return [*(estimate.reasons if estimate.verdict != "good" else ()), *of_place]

    @property
    def place_in_stddevs(self) -> float:
        """Return how far the middle of the map is displaced, in its stated stddevs; 0 without a place."""
        if self.metric is None or self.metric.place is None:
            return 0.0
        centers_m = self.metric.trajectory.as_in(self.metric.final).centers
        off_m = np.mean(centers_m - self.given.true_centers_m, axis=0)
        return float(np.linalg.norm(off_m) / np.linalg.norm(self.metric.place.stddev_m))


def surveyed_with_photos(site: Site, seed: int) -> Given:
    """Simulate a clean survey in the site's frame, whose map comes from noisy features."""
    path = site.path(seed)
    times = np.arange(path.start_s, path.end_s, INTERVAL_S)
    truth = truth_of(path, times, site.anchors_m, "site", num_observations=NUM_FEATURES, depth_range_m=DEPTH_RANGE_M)
    mapped = made(truth, path, times, HALL_PIXELS, seed, site.stddev_m, with_radio=False)
    num = int((path.end_s - path.start_s) * site.rate_hz) * len(site.anchors_m)
    at_s = path.start_s + (np.arange(num) + 0.5) / (site.rate_hz * len(site.anchors_m))
    at_s = at_s[at_s < times[-1]]
    tag_in_cam_m, world_from_cam = np.array(site.tag_in_cam_m), path.world_from_cam(at_s)
    anchors_m, true_m = truth.anchors_m, truth.model.centers_m
    given = Given(
        mapped.trajectory, dict(anchors_m), "site", tag_in_cam_m, at_s, np.arange(len(at_s)) % len(anchors_m),
        np.zeros(len(at_s)), path.centers(at_s) + world_from_cam @ tag_in_cam_m, anchors_m, world_from_cam, true_m,
        metres_per_unit=align_points(mapped.trajectory.centers, true_m).scale, sfm=mapped.sfm,
    )  # fmt: skip
    rng = np.random.default_rng([seed, len(site.name)])
    given.range_m = distances(given) + radio_errors(given, site.stddev_m, rng)
    return given


def run_with_photos(given: Given, seed: int) -> RunOfPhotos:
    """Scale, refine and judge a survey, with all defaults."""
    assert given.sfm is not None
    ids = np.array(given.ids)[given.anchor]
    log = RangeLog.from_arrays(ids, np.maximum(given.range_m, 0.02), timestamp_s=given.time_s)
    settings = Survey().changed({"output.seed": seed, "camera.refine_intrinsics": False, "mapper.num_threads": 1})
    anchors = tuple(Anchor(name, at) for name, at in given.anchors_m.items())
    inputs = RangingInputs(
        log, given.tag_in_cam_m[None], anchors, given.frame, SiteFrame(np.zeros(3)), Tape(), None, ()
    )
    observations = associate(log, given.trajectory, given.tag_in_cam_m, time_offset_s=given.time_offset_s)
    path = PathOfModel("sparse/0", given.sfm, given.trajectory, observations)
    try:
        run = SurveyRun(settings, inputs, Journal(SilentProgress()))
        metric = map_in_metres(run, [path], refine=True)[1]
    except (GeometryError, SolverError) as error:
        return RunOfPhotos(given, None, None, refusal=str(error))
    return RunOfPhotos(given, metric.estimate, metric.diagnosis, metric=metric)
