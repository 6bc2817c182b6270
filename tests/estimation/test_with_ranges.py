"""Bundle adjustment with ranges finds the scale, keeps what is known, and bends drift back."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from scipy.spatial.transform import Rotation
from tests.known_errors import known_errors, predicted_by_model
from tests.simulated.looped import ScaledMap, two_laps
from tests.simulated.model import synthetic_model
from tests.simulated.outliers import spoilt
from tests.simulated.path import along, loop_path, sequence_path
from tests.simulated.ranges import simulate_ranges_at
from tests.simulated.surveys import adjusted, range_log

from rangesfm.colmap.transform import rescale
from rangesfm.demo.simulated_radio import CameraPath, Radio, simulate_ranges
from rangesfm.errors import InputError, SolverError
from rangesfm.estimation.with_ranges import RefineSummary, refine_with_ranges
from rangesfm.measurements.lengths.locate_lengths import locate_distances
from rangesfm.measurements.lengths.tape import Marker, Tape, TapedDistance
from rangesfm.measurements.ranges.anchors.anchor import AnchorEstimate
from rangesfm.measurements.ranges.association import associate
from rangesfm.measurements.ranges.errors.noise import short_range_stddev
from rangesfm.measurements.ranges.errors.range_errors import RangeErrors
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_observations import RangeObservations, RangeStatus
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.util.geometry.gravity import UP_IN_SITE, Gravity
from rangesfm.util.geometry.similarity import IDENTITY, Similarity, align_points, rmse
from rangesfm.util.geometry.trajectory import Trajectory, pose_of, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]

TAG_IN_CAM_M = np.array([0.05, -0.12, -0.03])
ANCHORS_M = {"A": (6.0, 0.0, 2.5), "B": (-6.0, 1.0, 0.4), "C": (0.5, 6.0, 3.0), "D": (1.0, -6.0, 0.2)}
RANGE_STDDEV_M = 0.1


@dataclass(frozen=True)
class Survey:
    """An unscaled model, ranges on its path, and the truth in a metric frame.

    Attributes:
        sfm: the model.
        timestamps_s: times of its photos.
        frame: the metric frame, "site" or "first_camera".
        metric_from_sfm, centers_m, anchors_m: the truth in that frame.
    """

    sfm: pycolmap.Reconstruction
    timestamps_s: dict[str, float]
    trajectory: Trajectory
    observations: RangeObservations
    frame: str
    metric_from_sfm: Similarity
    centers_m: Array
    anchors_m: dict[str, Array]

    def anchors(self, stddev_m: float, bias_stddev_m: float = 0.0) -> list[AnchorEstimate]:
        """Return the anchors at their true positions, with priors of this stddev there (inf: no prior)."""
        return [
            AnchorEstimate(
                anchor_id=name,
                position_m=self.anchors_m[name],
                position_stddev_m=stddev_m,
                prior_position_m=self.anchors_m[name] if np.isfinite(stddev_m) else None,
                prior_position_stddev_m=stddev_m,
                range_bias_m=0.0,
                prior_bias_m=0.0,
                prior_bias_stddev_m=bias_stddev_m,
            )
            for name in self.observations.log.anchor_ids
        ]

    def refine(
        self,
        anchors: Sequence[AnchorEstimate],
        scale_error: float = 1.0,
        **changes: Any,
    ) -> tuple[pycolmap.Reconstruction, RefineSummary]:
        """Refine from the true similarity with a wrong scale; ``errors`` may be the stddev of all ranges."""
        start = Similarity(scale_error, np.eye(3), np.zeros(3)) @ self.metric_from_sfm
        observations = changes.pop("observations", self.observations)
        errors = changes.pop("errors", RANGE_STDDEV_M)
        if not isinstance(errors, RangeErrors):
            errors = known_errors(observations, errors)
        arguments: dict[str, Any] = {
            "tag_in_cam_m": TAG_IN_CAM_M,
            "first_pose_is_fixed": self.frame != "site",
            "camera": CameraOptions(refine_intrinsics=False),
            "num_threads": 1,
        }
        model = rescale(self.sfm, start)
        return refine_with_ranges(model, self.trajectory, observations, start, anchors, errors, **(arguments | changes))

    def centers(self, model: pycolmap.Reconstruction) -> Array:
        return trajectory_from_reconstruction(model, self.timestamps_s).centers

    def scale_error(self, model: pycolmap.Reconstruction) -> float:
        return align_points(self.centers_m, self.centers(model)).scale - 1


def make_survey(
    frame: str = "site",
    *,
    path: CameraPath | None = None,
    num_keyframes: int = 20,
    pixel_stddev: float = 0.0,
    radio: Radio | None = None,
    at_keyframes: bool = True,
    num_epochs: int = 1,
    anchors_m: dict[str, tuple[float, float, float]] = ANCHORS_M,
    seed: int = 0,
    **model_options: Any,
) -> Survey:
    """Simulate a loop of 20 s, with ranges at the keyframes, or all the time at the radio's rate."""
    path = path or loop_path(20.0, unsteadiness_m=0.1, seed=3)
    times = np.linspace(path.start_s, path.end_s, num_keyframes)
    model_options = {"num_observations": 60, **model_options}
    model = synthetic_model(*along(path, times), pixel_stddev=pixel_stddev, seed=seed, **model_options)
    if pixel_stddev > 0:
        adjusted(model.reconstruction)
    radio = radio or Radio()
    if at_keyframes:
        each = np.repeat(np.arange(num_keyframes), num_epochs)
        centers, rotations = model.centers_m[each], model.world_from_cam[each]
        log = simulate_ranges_at(times[each], centers, rotations, anchors_m, TAG_IN_CAM_M, radio, seed)
    else:
        log = simulate_ranges(path, anchors_m, TAG_IN_CAM_M, radio, seed)
    trajectory = trajectory_from_reconstruction(model.reconstruction, model.timestamps_s)
    first_camera = Similarity(1.0, model.world_from_cam[0], model.centers_m[0])
    from_world = IDENTITY if frame == "site" else first_camera.inverse()
    return Survey(
        model.reconstruction,
        model.timestamps_s,
        trajectory,
        associate(log, trajectory, TAG_IN_CAM_M),
        frame,
        from_world @ model.metric_from_sfm,
        from_world.apply(model.centers_m),
        {name: from_world.apply(np.array(position)) for name, position in anchors_m.items()},
    )


class TestWithoutNoise:
    @pytest.mark.parametrize("scale_error", [1.05, 0.95])
    @pytest.mark.parametrize(
        ("frame", "stddev_m"),
        [("site", 0.0), ("first_camera", 0.0), ("first_camera", np.inf)],
        ids=["site", "first camera", "unknown"],
    )
    def test_a_wrong_scale_is_put_right(self, frame: str, stddev_m: float, scale_error: float) -> None:
        survey = make_survey(frame)
        refined, summary = survey.refine(survey.anchors(stddev_m), scale_error)
        assert summary.converged
        np.testing.assert_allclose(survey.centers(refined), survey.centers_m, atol=1e-6)
        for anchor in summary.ranges.anchors:
            np.testing.assert_allclose(anchor.position_m, survey.anchors_m[anchor.anchor_id], atol=1e-5)
        assert summary.final_cost < 1e-9
        assert summary.reprojection_rms_px < 1e-4
        np.testing.assert_allclose(summary.ranges.predicted_m, survey.observations.log.range_m, atol=1e-6)

    def test_a_bias_within_its_prior_is_found(self) -> None:
        survey = make_survey(radio=Radio(range_bias_m={"A": 0.2, "C": -0.1}), num_epochs=4)
        refined, summary = survey.refine(survey.anchors(0.0, bias_stddev_m=1.0))
        biases = {anchor.anchor_id: anchor.range_bias_m for anchor in summary.ranges.anchors}
        assert biases == pytest.approx({"A": 0.2, "B": 0.0, "C": -0.1, "D": 0.0}, abs=0.005)
        assert rmse(survey.centers(refined) - survey.centers_m) < 0.02

    def test_a_bias_that_all_anchors_share_is_found_though_their_own_are_small(self) -> None:
        survey = make_survey(radio=Radio(range_bias_m=dict.fromkeys(ANCHORS_M, 0.08)))
        errors = [
            known_errors(survey.observations, RANGE_STDDEV_M, common_bias_stddev_m=stddev_m) for stddev_m in (0.1, 0.0)
        ]
        _, summary = survey.refine(survey.anchors(0.0, bias_stddev_m=0.001), errors=errors[0])
        np.testing.assert_allclose([anchor.range_bias_m for anchor in summary.ranges.anchors], 0.08, atol=0.005)
        _, apart = survey.refine(survey.anchors(0.0, bias_stddev_m=0.001), errors=errors[1])
        assert all(abs(anchor.range_bias_m) < 0.04 for anchor in apart.ranges.anchors)

    def test_ranges_between_keyframes_count_as_well(self) -> None:
        survey = make_survey(num_keyframes=41, radio=Radio(rate_hz=5.0), at_keyframes=False)
        between = survey.observations.before != survey.observations.after
        assert np.mean(between) > 0.5
        only_between = replace(
            survey.observations,
            status=np.where(between, survey.observations.status, RangeStatus.UNKNOWN_ANCHOR).astype(np.int8),
        )
        refined, _ = survey.refine(survey.anchors(0.0), 1.05, observations=only_between)
        assert rmse(survey.centers(refined) - survey.centers_m) < 0.002

    @pytest.mark.parametrize("at_keyframes", [True, False], ids=["at keyframes", "between"])
    def test_each_range_belongs_to_the_tag_that_took_it(self, at_keyframes: bool) -> None:
        survey = make_survey(num_keyframes=41, at_keyframes=at_keyframes)
        tags = np.array([TAG_IN_CAM_M, [-0.4, 0.3, 0.5]])
        metric = rescale(survey.sfm, survey.metric_from_sfm)
        log, similarity = survey.observations.log, survey.metric_from_sfm
        places = [associate(log, survey.trajectory, tag) for tag in tags]
        each = [
            predicted_by_model(metric, survey.trajectory, places[k], similarity, tags[k], survey.anchors(0.0))
            for k in range(2)
        ]
        assert np.nanmedian(np.abs(each[1] - each[0])) > 0.1
        index = np.arange(len(log)) % 2
        range_m = np.where(places[0].has_place, np.where(index, each[1], each[0]), log.range_m)
        log = replace(log, tag_ids=("left", "right"), tag_index=index, range_m=range_m)
        lever = np.where(index[:, None], places[1].tag_from_center, places[0].tag_from_center)
        observations = replace(places[0], log=log, tag_from_center=lever)
        refined, summary = survey.refine(survey.anchors(0.0), 1.05, observations=observations, tag_in_cam_m=tags)
        np.testing.assert_allclose(survey.centers(refined), survey.centers_m, atol=1e-2)
        placed = observations.has_place
        np.testing.assert_allclose(summary.ranges.predicted_m[placed], log.range_m[placed], atol=1e-2)
        with pytest.raises(InputError, match=r"expected \(3,\) or \(2, 3\)"):
            survey.refine(survey.anchors(0.0), observations=observations, tag_in_cam_m=np.zeros((3, 3)))

    def test_a_rig_carries_the_tag_in_its_own_frame(self) -> None:
        pycolmap.set_random_seed(0)
        sfm = pycolmap.synthesize_dataset(
            pycolmap.SyntheticDatasetOptions(
                num_rigs=1, num_cameras_per_rig=2, num_frames_per_rig=12, num_points3D=80, track_length=6
            )
        )
        trajectory = trajectory_from_reconstruction(sfm)
        tags = trajectory.centers + trajectory.world_from_cam @ TAG_IN_CAM_M
        names, frames = list(ANCHORS_M), np.repeat(np.arange(12), len(ANCHORS_M))
        log = RangeLog.from_arrays(
            names * 12,
            np.linalg.norm(tags[frames] - np.array(list(ANCHORS_M.values()) * 12), axis=1),
            image_name=[trajectory.image_names[frame] for frame in frames],
        )
        truth = {name: np.array(position) for name, position in ANCHORS_M.items()}
        observations = associate(log, trajectory, TAG_IN_CAM_M)
        survey = Survey(sfm, {}, trajectory, observations, "site", IDENTITY, trajectory.centers, truth)
        refined, summary = survey.refine(survey.anchors(0.0), 1.05)
        assert summary.converged
        np.testing.assert_allclose(trajectory_from_reconstruction(refined).centers, trajectory.centers, atol=1e-5)


class TestWhatIsKnownStays:
    @pytest.mark.parametrize("stddev_m", [0.0, np.inf], ids=["known", "unknown"])
    def test_the_first_pose_in_its_own_frame(self, stddev_m: float) -> None:
        radio = Radio(range_stddev_m=RANGE_STDDEV_M)
        survey = make_survey("first_camera", pixel_stddev=0.5, radio=radio, num_epochs=3)
        refined, _ = survey.refine(survey.anchors(stddev_m), 1.05)
        start = rescale(survey.sfm, Similarity(1.05, np.eye(3), np.zeros(3)) @ survey.metric_from_sfm)
        first, last = survey.trajectory.frame_ids[[0, -1]]
        np.testing.assert_array_equal(pose_of(refined.frame(first)).params, pose_of(start.frame(first)).params)
        assert np.abs(pose_of(refined.frame(last)).params - pose_of(start.frame(last)).params).max() > 1e-3

    def test_the_vertical_where_two_anchors_leave_a_turn_open(self) -> None:
        survey = make_survey(anchors_m={name: ANCHORS_M[name] for name in "AB"})
        truth = survey.metric_from_sfm
        along = survey.anchors_m["B"] - survey.anchors_m["A"]
        turn = Rotation.from_rotvec(np.deg2rad(3.0) * along / np.linalg.norm(along)).as_matrix()
        at = survey.anchors_m["A"]
        turned = replace(survey, metric_from_sfm=Similarity(1.0, turn, at - turn @ at) @ truth)
        from_first_camera = truth.rotation @ survey.trajectory.world_from_cam[0]
        gravity = Gravity(from_first_camera.T @ UP_IN_SITE, 0.05)
        refined, _ = turned.refine(survey.anchors(0.0), gravity=gravity)
        np.testing.assert_allclose(survey.centers(refined), survey.centers_m, atol=1e-5)

    def test_anchors_without_uncertainty(self) -> None:
        survey = make_survey(pixel_stddev=0.5, radio=Radio(range_stddev_m=RANGE_STDDEV_M))
        _, summary = survey.refine(survey.anchors(0.0), 1.05)
        for anchor in summary.ranges.anchors:
            np.testing.assert_array_equal(anchor.position_m, survey.anchors_m[anchor.anchor_id])

    def test_surveyed_anchors_move_by_no_more_than_they_may(self) -> None:
        """One of four anchors was written down 0.2 m off; the ranges correct it as far as its stddev allows."""
        survey = make_survey(pixel_stddev=0.5, num_epochs=5)
        wrong = survey.anchors_m["A"] + [0.0, 0.0, 0.2]
        moved = {}
        for stddev_m in (0.001, 1.0):
            first, *others = survey.anchors(0.001)
            first = replace(
                first,
                position_m=wrong,
                prior_position_m=wrong,
                position_stddev_m=stddev_m,
                prior_position_stddev_m=stddev_m,
            )
            _, summary = survey.refine([first, *others])
            moved[stddev_m] = float(np.linalg.norm(summary.ranges.anchors[0].position_m - wrong))
            for anchor in summary.ranges.anchors[1:]:
                assert np.linalg.norm(anchor.position_m - survey.anchors_m[anchor.anchor_id]) < 0.003
        assert moved[0.001] < 0.003
        assert moved[1.0] == pytest.approx(0.2, abs=0.02)

    def test_known_intrinsics_unless_they_are_to_be_refined(self) -> None:
        survey = make_survey(pixel_stddev=0.5)
        held, _ = survey.refine(survey.anchors(0.0))
        np.testing.assert_array_equal(held.camera(1).params, survey.sfm.camera(1).params)
        freed, _ = survey.refine(survey.anchors(0.0), camera=CameraOptions(refine_intrinsics=True))
        assert np.abs(freed.camera(1).params - survey.sfm.camera(1).params).max() > 1e-3


def with_ranges_between_anchors(survey: Survey, error_m: float = 0.0, first_pair: int = 0) -> RangeObservations:
    """Return the survey's ranges, and one range between each pair of anchors."""
    log, ids = survey.observations.log, list(survey.anchors_m)
    pairs = list(itertools.combinations(ids, 2))[first_pair:]
    lengths = [np.linalg.norm(survey.anchors_m[a] - survey.anchors_m[b]) + error_m for a, b in pairs]
    both = RangeLog.from_arrays(
        [*np.array(log.anchor_ids)[log.anchor_index], *[b for _, b in pairs]],
        np.append(log.range_m, lengths),
        timestamp_s=np.append(log.timestamp_s, np.full(len(pairs), log.timestamp_s[0])),
        tag_id=["tag"] * len(log) + [a for a, _ in pairs],
    )
    return associate(both.with_anchors(set(ids)), survey.trajectory, TAG_IN_CAM_M)


def with_long_ranges(survey: Survey) -> RangeObservations:
    log = survey.observations.log
    return replace(survey.observations, log=replace(log, range_m=1.04 * log.range_m))


def marker_of(sfm: pycolmap.Reconstruction, point: pycolmap.Point3D) -> Marker:
    images = [(sfm.image(element.image_id), element.point2D_idx) for element in point.track.elements]
    pixels = np.array([image.points2D[index].xy for image, index in images])
    return Marker(tuple(image.name for image, _ in images), pixels, tuple(range(2, 2 + len(images))), stddev_px=0.5)


class TestDistances:
    def test_control_distances_between_cameras_hold_the_map_though_all_ranges_are_long(self) -> None:
        survey = make_survey("first_camera", pixel_stddev=0.5, radio=Radio(range_stddev_m=RANGE_STDDEV_M))
        names, stddev_m = survey.trajectory.image_names, 0.005
        pairs = [(2, 11), (5, 15)]
        lengths = [float(np.linalg.norm(survey.centers_m[a] - survey.centers_m[b])) for a, b in pairs]
        tape = Tape(
            tuple(
                TapedDistance((names[a], names[b]), length, stddev_m, "control", 2)
                for (a, b), length in zip(pairs, lengths, strict=True)
            )
        )
        long = with_long_ranges(survey)
        alone, _ = survey.refine(survey.anchors(np.inf), 1.04, observations=long)
        assert survey.scale_error(alone) > 0.02
        held, summary = survey.refine(survey.anchors(np.inf), 1.04, observations=long, tape=tape)
        assert summary.converged
        np.testing.assert_allclose(located_m(tape, held), lengths, atol=2 * stddev_m)

    def test_ranges_that_share_an_error_keep_the_shape_and_leave_the_scale_to_a_distance(self) -> None:
        """All ranges are 4 % long; a distance of 1 % says so, if the ranges may share such an error."""
        survey, exact = (
            make_survey("first_camera", pixel_stddev=0.5, radio=radio, num_epochs=10, seed=2)
            for radio in (Radio(range_stddev_m=RANGE_STDDEV_M), None)
        )
        names, length = survey.trajectory.image_names, float(np.linalg.norm(survey.centers_m[2] - survey.centers_m[11]))
        tape = Tape((TapedDistance((names[2], names[11]), length, 0.01 * length, "control", 2),))
        told: dict[str, Any] = {"observations": with_long_ranges(survey), "tape": tape}
        alike_m = 0.04 * exact.observations.log.range_m[:, None]
        stiff, _ = survey.refine(survey.anchors(np.inf), 1.04, **told)
        free, summary = survey.refine(survey.anchors(np.inf), 1.04, **told, shared_errors_m=alike_m)
        assert summary.converged
        assert survey.scale_error(stiff) > 0.02
        assert abs(survey.scale_error(free)) < 0.01
        residuals_m = summary.ranges.predicted_m - told["observations"].log.range_m
        assert np.median(np.abs(residuals_m)) < 2 * RANGE_STDDEV_M
        covariance = summary.covariance
        assert 0.005 < covariance.scale_stddev < 0.02

    def test_control_distances_between_markers_do_so_as_well_and_leave_no_trace(self) -> None:
        survey = make_survey("first_camera", pixel_stddev=0.5, radio=Radio(range_stddev_m=RANGE_STDDEV_M))
        points = sorted(survey.sfm.points3D.values(), key=lambda point: -point.track.length())[:2]
        length = survey.metric_from_sfm.scale * float(np.linalg.norm(points[0].xyz - points[1].xyz))
        distance = TapedDistance(("door", "wall"), length, 0.002, "control", 2)
        tape = Tape((distance,), {"door": marker_of(survey.sfm, points[0]), "wall": marker_of(survey.sfm, points[1])})
        held, summary = survey.refine(survey.anchors(np.inf), 1.04, observations=with_long_ranges(survey), tape=tape)
        # The anchors start metres off; without care they would limit the solver to steps of micrometres.
        assert summary.converged
        assert located_m(tape, held) == pytest.approx([length], abs=2 * distance.stddev_m)
        assert set(held.points3D) == set(survey.sfm.points3D)
        for image_id, image in survey.sfm.images.items():
            assert len(held.image(image_id).points2D) == len(image.points2D)

    def test_ranges_between_anchors_put_unknown_ones_nearer_to_their_places(self) -> None:
        survey = make_survey("first_camera", pixel_stddev=0.5, radio=Radio(range_stddev_m=0.3))
        observations, without = with_ranges_between_anchors(survey, error_m=0.05), survey.observations
        off_m = {}
        for name, taken in {"with": observations, "without": without}.items():
            errors = known_errors(taken, 0.3, common_bias_stddev_m=0.05)
            _, summary = survey.refine(survey.anchors(np.inf), observations=taken, errors=errors)
            places = np.array([anchor.position_m for anchor in summary.ranges.anchors])
            truth = np.array([survey.anchors_m[anchor.anchor_id] for anchor in summary.ranges.anchors])
            lengths = [[np.linalg.norm(a - b) for a, b in itertools.combinations(at, 2)] for at in (places, truth)]
            off_m[name] = rmse(np.diff(lengths, axis=0).T)
        assert off_m["with"] < 0.5 * off_m["without"]

    def test_a_range_between_anchors_that_is_far_off_has_no_say(self) -> None:
        survey = make_survey("first_camera", pixel_stddev=0.5, radio=Radio(range_stddev_m=RANGE_STDDEV_M))
        observations = with_ranges_between_anchors(survey)
        range_m = observations.log.range_m.copy()
        range_m[np.flatnonzero(observations.status == RangeStatus.ANCHOR_ANCHOR)[0]] += 5.0
        places = []
        for taken in (
            replace(observations, log=replace(observations.log, range_m=range_m)),
            with_ranges_between_anchors(survey, first_pair=1),
        ):
            errors = known_errors(taken, RANGE_STDDEV_M, common_bias_stddev_m=0.05)
            _, summary = survey.refine(survey.anchors(np.inf), observations=taken, errors=errors)
            places.append(np.array([anchor.position_m for anchor in summary.ranges.anchors]))
        assert rmse(places[1] - places[0]) < 0.001


def located_m(tape: Tape, model: pycolmap.Reconstruction) -> Array:
    return locate_distances(tape, model, []).lengths_m(1.0, np.zeros((0, 3)))


class TestWithNoise:
    def test_the_pixel_stddev_is_found(self) -> None:
        survey = make_survey(pixel_stddev=0.7, num_keyframes=30, num_observations=150)
        _, summary = survey.refine(survey.anchors(0.0))
        assert summary.pixel_stddev == pytest.approx(0.7, rel=0.05)

    def test_outliers_are_marked_and_do_not_bend_the_map(self) -> None:
        radio = Radio(range_stddev_m=0.03, obstructed_share=0.2, obstructed_mean_m=5.0)
        survey = make_survey(pixel_stddev=0.5, radio=radio, num_epochs=3)
        refined, summary = survey.refine(survey.anchors(0.0), errors=0.03)
        assert rmse(survey.centers(refined) - survey.centers_m) < 0.03
        off = np.abs(summary.ranges.predicted_m - survey.observations.log.range_m)
        assert np.all(summary.ranges.observations.status[off > 0.5] == RangeStatus.OUTLIER)
        assert np.all(summary.ranges.observations.status[off < 0.05] == RangeStatus.USED)
        assert np.mean(off > 0.5) > 0.1

    @pytest.mark.parametrize("assumed_stddev_m", [RANGE_STDDEV_M, 3 * RANGE_STDDEV_M])
    @pytest.mark.parametrize(
        ("frame", "num_epochs", "kind", "share", "max_error_m"),
        [
            ("first_camera", 8, "long", 0.7, 0.04),
            ("first_camera", 8, "long", 0.8, 0.06),
            ("site", 4, "short", 0.7, 0.2),
        ],
    )
    def test_where_most_ranges_are_wrong_the_map_does_not_follow_them(
        self, frame: str, num_epochs: int, kind: str, share: float, max_error_m: float, assumed_stddev_m: float
    ) -> None:
        """Moreover, an anchor's good ranges do not lose weight because it has more wrong ones."""
        survey = make_survey(
            frame, pixel_stddev=0.3, radio=Radio(range_stddev_m=RANGE_STDDEV_M), num_epochs=num_epochs, seed=1
        )
        log = survey.observations.log
        wrong = replace(log, range_m=spoilt(log.range_m, kind, share, np.random.default_rng(1)))
        observations = replace(survey.observations, log=wrong, center_stddev=np.zeros(len(log)))
        refined, _ = survey.refine(
            survey.anchors(0.0, bias_stddev_m=0.01),
            observations=observations,
            errors=known_errors(observations, assumed_stddev_m, is_estimated=True),
        )
        assert rmse(survey.centers(refined) - survey.centers_m) < max_error_m

    def test_drift_is_bent_back(self) -> None:
        """No similarity can do this: the refined centres are nearer to the truth than after the best similarity."""
        path = sequence_path(59.0, seed=2)
        anchors = {"A": (10.0, 12.0, 3.0), "B": (25.0, -10.0, 5.0), "C": (40.0, 11.0, 0.0), "D": (55.0, -9.0, 2.0)}
        survey = make_survey(
            path=path,
            num_keyframes=60,
            pixel_stddev=1.0,
            radio=Radio(range_stddev_m=RANGE_STDDEV_M),
            num_epochs=5,
            anchors_m=anchors,
            num_observations=40,
            max_track_length=3,
        )
        best = align_points(survey.trajectory.centers, survey.centers_m)
        drift = rmse(best.apply(survey.trajectory.centers) - survey.centers_m)
        assert drift > 0.2
        refined, _ = replace(survey, metric_from_sfm=best).refine(survey.anchors(0.0))
        assert rmse(survey.centers(refined) - survey.centers_m) < 0.3 * drift

    def test_a_map_that_was_bent_to_its_ranges_is_not_bent_again(self) -> None:
        looped = two_laps(100, size_m=(24.0, 16.0), num_observations=40, pixel_stddev=1.0)
        laps = looped.survey
        scaled = ScaledMap.of(laps, looped.chain(), range_log(laps, 1))
        refined = scaled.refined_by_default()
        scaled_m, refined_m, again_m = (
            trajectory_from_reconstruction(model, laps.model.timestamps_s).centers
            for model in (scaled.scaled, refined, scaled.refined_by_default(refined))
        )
        assert rmse(again_m - refined_m) < 0.005 * rmse(refined_m - scaled_m)


class TestBesideTheMap:
    """Parameters beside the map that are held by default, and estimated when they are given a stddev."""

    def survey(self, **options: Any) -> Survey:
        options = {"num_keyframes": 41, "radio": Radio(rate_hz=10.0, range_stddev_m=0.03), **options}
        return make_survey(pixel_stddev=0.5, at_keyframes=False, **options)

    @pytest.mark.parametrize("at_keyframes", [True, False], ids=["at keyframes", "between"])
    def test_a_wrong_lever_arm_is_put_right(self, at_keyframes: bool) -> None:
        survey = (
            make_survey(num_keyframes=41, pixel_stddev=0.5, radio=Radio(range_stddev_m=0.01), num_epochs=5)
            if at_keyframes
            else self.survey(radio=Radio(rate_hz=10.0, range_stddev_m=0.01))
        )
        wrong = TAG_IN_CAM_M + np.array([0.1, -0.05, 0.08])
        placed = associate(survey.observations.log, survey.trajectory, wrong)
        given: dict[str, Any] = {"observations": placed, "tag_in_cam_m": wrong}
        given["errors"] = 0.01
        if not at_keyframes:  # as the scale stage passes them on: with the stddev of each place
            given["errors"] = np.hypot(0.01, placed.placing_stddev_m(survey.metric_from_sfm.scale))
        bent, held = survey.refine(survey.anchors(0.0), **given)
        np.testing.assert_array_equal(held.ranges.tags_in_cam_m, [wrong])
        options = RefineOptions(lever_arm_stddev_m=0.1)
        refined, summary = survey.refine(survey.anchors(0.0), options=options, **given)
        np.testing.assert_allclose(summary.ranges.tags_in_cam_m, [TAG_IN_CAM_M], atol=0.015)
        assert rmse(survey.centers(refined) - survey.centers_m) < 0.02
        assert rmse(survey.centers(refined) - survey.centers_m) < 0.5 * rmse(survey.centers(bent) - survey.centers_m)

    def test_a_prior_holds_the_lever_arm_as_far_as_it_is_sure(self) -> None:
        survey = self.survey()
        wrong = TAG_IN_CAM_M + np.array([0.1, 0.0, 0.0])
        placed = associate(survey.observations.log, survey.trajectory, wrong)
        options = RefineOptions(lever_arm_stddev_m=1e-4)
        _, summary = survey.refine(survey.anchors(0.0), observations=placed, tag_in_cam_m=wrong, options=options)
        np.testing.assert_allclose(summary.ranges.tags_in_cam_m, [wrong], atol=1e-3)
        assert (summary.ranges.tags_in_cam_m != wrong).any()

    def test_a_wrong_clock_offset_is_put_right(self) -> None:
        # At an even speed around a loop, a late clock cannot be distinguished from a map that is turned back.
        survey = self.survey(path=loop_path(20.0, unsteadiness_m=1.0, seed=3), num_keyframes=81)
        late = associate(survey.observations.log, survey.trajectory, TAG_IN_CAM_M, time_offset_s=-0.1)
        bent, held = survey.refine(survey.anchors(0.0), observations=late, errors=0.03)
        assert held.ranges.time_shift_s is None
        options = RefineOptions(time_offset_stddev_s=0.1)
        refined, summary = survey.refine(survey.anchors(0.0), observations=late, errors=0.03, options=options)
        assert summary.ranges.time_shift_s == pytest.approx(0.1, abs=0.01)
        assert rmse(survey.centers(refined) - survey.centers_m) < 0.02
        assert rmse(survey.centers(refined) - survey.centers_m) < 0.5 * rmse(survey.centers(bent) - survey.centers_m)

    def test_an_error_that_all_short_ranges_share_is_found(self) -> None:
        near = {"A": (3.0, 0.5, 0.5), "B": (-6.0, 1.0, 0.4), "C": (0.5, 4.0, 1.0), "D": (1.0, -3.5, 0.2)}
        survey = self.survey(anchors_m=near)
        log = survey.observations.log
        short = -0.3 * np.exp(-log.range_m)
        assert np.abs(short).max() > 0.05
        observations = replace(survey.observations, log=replace(log, range_m=log.range_m + short))
        stddev = np.hypot(0.03, short_range_stddev(observations.log.range_m))
        _, held = survey.refine(survey.anchors(0.0), observations=observations, errors=stddev)
        assert held.ranges.short_range_error_m is None
        options = RefineOptions(short_range_stddev_m=0.3)
        _, summary = survey.refine(survey.anchors(0.0), observations=observations, errors=stddev, options=options)
        assert summary.ranges.short_range_error_m == pytest.approx(-0.3, abs=0.05)


class TestCovariance:
    def test_errors_of_centres_are_as_large_as_their_covariances_say(self) -> None:
        squares, noise_m = [], 0.1
        for seed in range(4):
            survey = make_survey(
                num_keyframes=15, pixel_stddev=0.5, radio=Radio(range_stddev_m=noise_m), num_epochs=2, seed=seed
            )
            refined, summary = survey.refine(survey.anchors(0.0), errors=noise_m)
            off = survey.centers(refined) - survey.centers_m
            covariances = summary.covariance.centers_m2(survey.trajectory.frame_ids)
            squares += [e @ np.linalg.solve(c, e) for e, c in zip(off, covariances, strict=True)]
        assert 0.5 < np.mean(squares) / 3 < 2.0

    def test_anchors_have_the_stddevs_of_the_joint_problem(self) -> None:
        survey = make_survey("first_camera", pixel_stddev=0.5, radio=Radio(range_stddev_m=RANGE_STDDEV_M))
        _, free = survey.refine(survey.anchors(np.inf))
        assert all(0.01 < anchor.position_stddev_m < 2.0 for anchor in free.ranges.anchors)
        _, held = survey.refine(survey.anchors(0.0))
        assert all(anchor.position_stddev_m == 0.0 for anchor in held.ranges.anchors)

    def test_none_is_found_where_none_is_wanted(self) -> None:
        survey = make_survey(pixel_stddev=0.5)
        _, summary = survey.refine(survey.anchors(0.0), options=RefineOptions(covariance=False))
        assert not summary.covariance.are_known


class TestProblem:
    def test_predictions_by_the_true_model_are_the_true_ranges(self) -> None:
        survey = make_survey(num_keyframes=41, radio=Radio(rate_hz=3.0), at_keyframes=False)
        predicted = predicted_by_model(
            rescale(survey.sfm, survey.metric_from_sfm),
            survey.trajectory,
            survey.observations,
            survey.metric_from_sfm,
            TAG_IN_CAM_M,
            survey.anchors(0.0),
        )
        placed = survey.observations.has_place
        # The tolerance is the error of the interpolation.
        np.testing.assert_allclose(predicted[placed], survey.observations.log.range_m[placed], atol=0.02)
        assert np.all(np.isnan(predicted[~placed]))

    def test_correlated_ranges_weigh_less(self) -> None:
        radio = Radio(range_stddev_m=RANGE_STDDEV_M)
        survey = make_survey(pixel_stddev=2.0, radio=radio, num_epochs=5)
        reprojection = [
            survey.refine(
                survey.anchors(0.0), errors=known_errors(survey.observations, RANGE_STDDEV_M, inflation=inflation)
            )[1].reprojection_rms_px
            for inflation in (1.0, 10.0)
        ]
        assert reprojection[1] < reprojection[0]

    def test_a_model_whose_points_nobody_sees_is_refused(self) -> None:
        survey = make_survey()
        for point_id in list(survey.sfm.points3D):
            survey.sfm.delete_point3D(point_id)
        with pytest.raises(SolverError, match="no photo of the model sees any of its points"):
            survey.refine(survey.anchors(0.0))
