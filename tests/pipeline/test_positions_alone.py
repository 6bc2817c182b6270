"""A map in the site by positions of an antenna: their clock, lever arm and outliers; and both beside ranges."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from tests.known import assert_scale, known
from tests.simulated.files import write_model, write_rows
from tests.simulated.model import SyntheticModel, synthetic_model
from tests.simulated.path import along, loop_path
from tests.simulated.surveys import mapped, yard_truth

from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.errors import GeometryError, InputError
from rangesfm.pipeline.run import refine_model, scale_model
from rangesfm.progress import Progress
from rangesfm.result.result_folder import ResultFolder
from rangesfm.result.summary import ResultSummary
from rangesfm.survey.settings import Survey
from rangesfm.util.geometry.similarity import rmse

Array = npt.NDArray[np.float64]
QUIET = Progress()
ANTENNA_IN_CAM_M = np.array([0.05, -0.3, -0.1])
NOISE_M, OFFSET_S = 0.05, 7.0
ANCHORS_M = {"A1": (6.0, 1.0, 2.5), "A2": (-6.0, 2.0, 0.4), "A3": (0.5, 7.0, 3.0)}


@dataclass(frozen=True)
class Walk:
    """A model of a walk with the times of its photos, and the true path."""

    folder: Path
    made: SyntheticModel
    path: CameraPath

    def survey(self, where: Path, **values: object) -> Survey:
        given = {key.replace("__", "."): value for key, value in values.items()}
        base = {"images.model": self.folder / "sparse", "images.times": self.folder / "images.csv"}
        return Survey().changed({**base, "output.path": where / "out", "report.enabled": False, **given})

    def positions(self, where: Path, clock_ahead_s: float = 0.0, num_wrong: int = 0) -> Path:
        """Write positions at 1 Hz, the first of which are five metres off."""
        rng = np.random.default_rng(4)
        times = np.arange(0.4, self.path.end_s - 1.0, 1.0)
        at_m = self.path.centers(times) + self.path.world_from_cam(times) @ ANTENNA_IN_CAM_M
        at_m += NOISE_M * rng.standard_normal(at_m.shape)
        at_m[:num_wrong, 0] += 5.0
        path = where / "positions.csv"
        rows = (f"{t + clock_ahead_s:.3f},{x:.4f},{y:.4f},{z:.4f}\n" for t, (x, y, z) in zip(times, at_m, strict=True))
        path.write_text(f"timestamp_s,x_m,y_m,z_m\n{''.join(rows)}")
        return path

    def radio_positions(self, where: Path, stretch: float) -> Path:
        """Write positions at 10 Hz of a radio system: errors that last for a second, in a frame of another size."""
        rng = np.random.default_rng(5)
        times = np.arange(0.4, self.path.end_s - 1.0, 0.1)
        at_m = self.path.centers(times) + self.path.world_from_cam(times) @ ANTENNA_IN_CAM_M
        off_m = 0.12 * rng.standard_normal(at_m.shape)
        for k in range(1, len(times)):
            off_m[k] = 0.9 * off_m[k - 1] + np.sqrt(1 - 0.9**2) * off_m[k]
        at_m = stretch * at_m + off_m
        rows = (f"{t:.3f},{x:.4f},{y:.4f},{z:.4f}\n" for t, (x, y, z) in zip(times, at_m, strict=True))
        path = where / "positions.csv"
        path.write_text(f"timestamp_s,x_m,y_m,z_m\n{''.join(rows)}")
        return path

    def ranges(self, where: Path, too_long: float) -> Path:
        """Write ranges to three anchors in turn, each too long by this factor."""
        rng, path = np.random.default_rng(8), where / "uwb.csv"
        times = np.arange(0.2, self.path.end_s - 1.2, 0.1)
        tags_m = self.path.centers(times) + self.path.world_from_cam(times) @ ANTENNA_IN_CAM_M
        names = [list(ANCHORS_M)[k % len(ANCHORS_M)] for k in range(len(times))]
        range_m = too_long * np.linalg.norm(tags_m - [ANCHORS_M[name] for name in names], axis=1)
        range_m += 0.05 * rng.standard_normal(len(times))
        rows = (f"{t:.3f},{name},{at_m:.4f}\n" for t, name, at_m in zip(times, names, range_m, strict=True))
        path.write_text(f"timestamp_s,anchor_id,range_m\n{''.join(rows)}")
        return path

    def with_both(self, where: Path, too_long: float) -> Survey:
        """Return a survey with positions and such ranges, whose antennas are one."""
        arm = tuple(ANTENNA_IN_CAM_M.tolist())
        return self.survey(
            where,
            positions__path=self.positions(where),
            positions__antenna_in_cam_m=arm,
            positions__time_offset=0.0,
            ranges__path=self.ranges(where, too_long),
            ranges__time_offset=0.0,
            tag__tag_in_cam_m=arm,
        )


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Walk:
    path, times = loop_path(30.0, height_amplitude_m=0.5, unsteadiness_m=0.1, seed=1), np.arange(0.0, 29.0, 1.0)
    made = synthetic_model(*along(path, times), num_observations=60, pixel_stddev=0.5, seed=2)
    folder = tmp_path_factory.mktemp("walk")
    (folder / "sparse").mkdir()
    made.reconstruction.write(folder / "sparse")
    rows = "".join(f"{name},{time:.3f}\n" for name, time in made.timestamps_s.items())
    (folder / "images.csv").write_text(f"image_name,timestamp_s\n{rows}")
    return Walk(folder, made, path)


def test_positions_with_a_lever_arm_and_another_clock_place_the_map(walk: Walk, tmp_path: Path) -> None:
    positions = walk.positions(tmp_path, clock_ahead_s=-OFFSET_S, num_wrong=3)
    arm = tuple(ANTENNA_IN_CAM_M.tolist())
    survey = walk.survey(tmp_path, positions__path=positions, positions__antenna_in_cam_m=arm, report__enabled=True)
    summary = refine_model(survey, progress=QUIET).summary
    assert_scale(summary, walk.made.metric_from_sfm.scale, 0.02)
    assert (summary.scale.method, summary.scale.verdict, summary.frame) == ("positions", "good", "site")
    entry = known(summary.positions)
    assert known(entry.time_offset_s) == pytest.approx(OFFSET_S, abs=0.1)
    assert entry.num_rejected == 3
    assert known(entry.rms_m) == pytest.approx(np.sqrt(3) * NOISE_M, rel=0.3)
    assert entry.stddev_m == pytest.approx(NOISE_M, rel=0.4)
    model = pycolmap.Reconstruction(tmp_path / "out" / "sparse_metric" / "0")
    found = np.array([image.projection_center() for _, image in sorted((i.name, i) for i in model.images.values())])
    assert np.linalg.norm(found - walk.made.centers_m, axis=1).max() < 0.15
    assert [test.name for test in summary.tests] == ["antenna's lever arm"]
    assert not any(test.rejected for test in summary.tests)
    assert ResultSummary.read(survey.output.path / "result.json") == summary


@pytest.mark.parametrize("run", [scale_model, refine_model])
def test_a_radio_system_that_measures_its_site_too_small_is_no_good_scale_and_its_interval_says_so(
    walk: Walk, tmp_path: Path, run: Callable[..., ResultFolder]
) -> None:
    survey = walk.survey(
        tmp_path,
        positions__path=walk.radio_positions(tmp_path, 0.97),
        positions__antenna_in_cam_m=tuple(ANTENNA_IN_CAM_M.tolist()),
    )
    scale = run(survey, progress=QUIET).summary.scale
    low, high = known(scale.interval_95)
    true = walk.made.metric_from_sfm.scale
    assert low < true < high
    assert scale.value < 0.99 * true
    assert scale.verdict == "doubtful"
    assert "may also measure the whole site too large or too small" in "; ".join(scale.reasons)
    assert "tape a long distance in the map" in "; ".join(scale.advice)


@pytest.mark.parametrize("stddev_m", [0.02, None])
def test_accurate_positions_keep_a_narrow_interval(walk: Walk, tmp_path: Path, stddev_m: float | None) -> None:
    path, rng = tmp_path / "positions.csv", np.random.default_rng(6)
    times = np.arange(0.4, walk.path.end_s - 1.0, 0.2)
    at_m = walk.path.centers(times) + 0.02 * rng.standard_normal((len(times), 3))
    rows = (f"{t:.3f},{x:.4f},{y:.4f},{z:.4f}\n" for t, (x, y, z) in zip(times, at_m, strict=True))
    path.write_text(f"timestamp_s,x_m,y_m,z_m\n{''.join(rows)}")
    survey = walk.survey(tmp_path, positions__path=path, positions__stddev_m=stddev_m)
    scale = scale_model(survey, progress=QUIET).summary.scale
    low, high = known(scale.interval_95)
    assert low < walk.made.metric_from_sfm.scale < high
    assert (high - low) / 2 / scale.value < 0.015
    assert scale.verdict == "good"


def test_a_lever_arm_that_is_off_is_found_with_its_size(walk: Walk, tmp_path: Path) -> None:
    positions = walk.positions(tmp_path)
    # Upward of a camera held level it could not be told from the height of the whole map.
    wrong_m = ANTENNA_IN_CAM_M + np.array([-0.3, 0.0, -0.4])
    survey = walk.survey(
        tmp_path,
        positions__path=positions,
        positions__time_offset=0.0,
        positions__antenna_in_cam_m=tuple(wrong_m.tolist()),
    )
    summary = scale_model(survey, progress=QUIET).summary
    found = next(test for test in summary.tests if test.name == "antenna's lever arm")
    assert found.rejected
    assert known(found.size) == pytest.approx(0.5, abs=0.2)
    assert "probably the antenna sits elsewhere on the camera, by +0.3" in " ".join(summary.scale.reasons)


def test_a_circle_at_even_speed_has_no_good_place_by_positions_of_another_clock(tmp_path: Path) -> None:
    """The camera and the positions are exactly level, as those of robots are."""
    times, end_s = np.arange(0.0, 60.0, 1.0), 60.0
    angle_of = 2 * np.pi * 1.7 / end_s

    def at(times_s: Array) -> Array:
        turned = angle_of * times_s
        return np.column_stack([2 * np.cos(turned), 2 * np.sin(turned), np.full(len(times_s), 1.5)])

    level = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    ahead = Rotation.from_rotvec(np.outer(angle_of * times, [0.0, 0.0, 1.0])).as_matrix() @ level
    made = synthetic_model(times, at(times), ahead, num_observations=20, pixel_stddev=0.5, seed=2)
    (tmp_path / "sparse").mkdir()
    made.reconstruction.write(tmp_path / "sparse")
    rows = "".join(f"{name},{time:.3f}\n" for name, time in made.timestamps_s.items())
    (tmp_path / "images.csv").write_text(f"image_name,timestamp_s\n{rows}")
    known_s = np.arange(0.0, end_s, 0.1)
    at_m = at(known_s) + 0.03 * np.random.default_rng(3).standard_normal((len(known_s), 3)) * [1.0, 1.0, 0.0]
    rows = "".join(f"{t:.3f},{x:.4f},{y:.4f},{z:.4f}\n" for t, (x, y, z) in zip(known_s, at_m, strict=True))
    (tmp_path / "positions.csv").write_text(f"timestamp_s,x_m,y_m,z_m\n{rows}")
    walk = Walk(tmp_path, made, CameraPath.through(times, at(times), ahead))
    survey = walk.survey(tmp_path, positions__path=tmp_path / "positions.csv")
    with pytest.raises(GeometryError, match="--positions_time_offset"):
        scale_model(survey, progress=QUIET)
    given = survey.changed({"positions.time_offset": 0.0})
    summary = scale_model(given, progress=QUIET).summary
    assert_scale(summary, made.metric_from_sfm.scale, 0.02)
    assert (summary.scale.verdict, known(summary.place).verdict) == ("good", "good")


def test_clocks_that_are_apart_by_leap_seconds_are_named(walk: Walk, tmp_path: Path) -> None:
    positions = walk.positions(tmp_path, clock_ahead_s=-18.0)
    survey = walk.survey(tmp_path, positions__path=positions, positions__time_offset=8.0)
    try:
        said = "; ".join(scale_model(survey, progress=QUIET).summary.scale.reasons)
    except GeometryError as error:  # a map of so wrong positions may also be refused
        said = str(error)
    assert "the positions fit the photos' path at a time offset of +18." in said
    assert "not at the given +8.00 s: their clock is 10." in said
    assert "s behind, as by leap seconds" in said


def test_positions_by_a_clock_that_the_motion_contradicts_leave_the_map_to_the_ranges(
    walk: Walk, tmp_path: Path
) -> None:
    survey = walk.with_both(tmp_path, 1.0).changed({"positions.time_offset": 8.0})
    walk.positions(tmp_path, clock_ahead_s=-18.0)
    summary = scale_model(survey, progress=QUIET).summary
    assert "s behind, as by leap seconds, or a time zone; they are not used" in "; ".join(summary.scale.reasons)
    assert_scale(summary, walk.made.metric_from_sfm.scale, 0.02)
    assert (summary.frame, summary.scale.verdict) == ("first_camera", "doubtful")


def test_positions_whose_clock_nothing_tells_leave_the_map_to_the_ranges(walk: Walk, tmp_path: Path) -> None:
    survey = walk.with_both(tmp_path, 1.0).changed({"positions.time_offset": "auto"})
    rows = "".join(f"{t:.1f},{(-1) ** t * 0.1:.1f},4.0,1.5\n" for t in range(30))
    (tmp_path / "positions.csv").write_text(f"timestamp_s,x_m,y_m,z_m\n{rows}")
    summary = scale_model(survey, progress=QUIET).summary
    assert "the positions of the antenna are not used: " in "; ".join(summary.warnings)
    assert "--positions_time_offset" in "; ".join(summary.warnings)
    assert_scale(summary, walk.made.metric_from_sfm.scale, 0.02)
    assert summary.positions is None


@pytest.mark.parametrize("too_long", [1.0, 1.1])
def test_positions_and_ranges_to_unknown_anchors_hold_the_map_together(
    walk: Walk, tmp_path: Path, too_long: float
) -> None:
    summary = refine_model(walk.with_both(tmp_path, too_long), progress=QUIET).summary
    found = next(test for test in summary.tests if test.name == "positions against ranges")
    assert found.rejected == (too_long > 1)
    assert (summary.scale.verdict == "good") == (too_long == 1)
    assert summary.frame == "site"
    assert set(summary.scale.by_kind) == {"ranges", "positions"}
    if too_long > 1:
        assert re.search(
            r"by the ranges the map is [\d.]+ % larger than by the known", "; ".join(summary.scale.reasons)
        )
        return
    assert_scale(summary, walk.made.metric_from_sfm.scale, 0.02)
    for anchor_id, at_m in ANCHORS_M.items():
        assert np.linalg.norm(np.array(known(summary.anchors[anchor_id].position_m)) - at_m) < 0.3


@pytest.mark.parametrize("run", [scale_model, refine_model])
def test_ranges_and_positions_have_the_say_on_the_scale_that_their_errors_allow(
    walk: Walk, tmp_path: Path, run: Callable[..., ResultFolder]
) -> None:
    scale = run(walk.with_both(tmp_path, 1.03), progress=QUIET).summary.scale
    values = {kind: np.log(entry.value) for kind, entry in scale.by_kind.items()}
    stddevs = {kind: known(entry.stddev) / entry.value for kind, entry in scale.by_kind.items()}
    apart = abs(values["ranges"] - values["positions"])
    assert apart > 0.02
    assert 0.8 < stddevs["ranges"] / stddevs["positions"] < 1.25
    # Neither counts much more than the other: the scale is in the middle half between what each says.
    assert abs(np.log(scale.value) - (values["ranges"] + values["positions"]) / 2) < apart / 4
    low, high = known(scale.interval_95)
    assert (high - low) / scale.value < 2 * 1.96 * stddevs["positions"]


def test_lengths_beside_ranges_and_positions_count_once_in_the_uncertainty_of_a_refined_map(
    walk: Walk, tmp_path: Path
) -> None:
    (first, *_, last), (start_m, *_, end_m) = walk.made.timestamps_s, walk.made.centers_m
    between = (list(walk.made.timestamps_s)[12], walk.made.centers_m[12])
    rows = (
        f"{name},{between[0]},{np.linalg.norm(at_m - between[1]):.4f},0.01\n"
        for name, at_m in ((first, start_m), (last, end_m))
    )
    (tmp_path / "tape.csv").write_text(f"from,to,distance_m,stddev_m\n{''.join(rows)}")
    survey = walk.with_both(tmp_path, 1.0).changed({"scale.distances": tmp_path / "tape.csv"})
    scale = refine_model(survey, progress=QUIET).summary.scale
    information = {kind: (entry.value / known(entry.stddev)) ** 2 for kind, entry in scale.by_kind.items()}
    assert (scale.value / known(scale.stddev_empirical)) ** 2 < 1.1 * sum(information.values())


def test_positions_in_the_photos_exif_data_place_the_map_without_times(walk: Walk, tmp_path: Path) -> None:
    rng, photos, made = np.random.default_rng(3), tmp_path / "photos", walk.made
    photos.mkdir()
    at_m = 10 * made.centers_m + rng.standard_normal(3) + 0.3 * rng.standard_normal(made.centers_m.shape)
    for name, (east_m, north_m, up_m) in zip(made.timestamps_s, at_m.tolist(), strict=True):
        exif = Image.Exif()
        metres = {2: 1e5 + north_m, 4: 1e5 + east_m}  # near the equator, some 110.6 and 111.3 km a degree
        degrees = {2: metres[2] / 110_574.3, 4: metres[4] / 111_319.5}
        exif[0x8825] = {1: "N", 3: "E", 5: b"\0", 6: 400.0 + up_m} | {k: (v, 0.0, 0.0) for k, v in degrees.items()}
        Image.new("L", (16, 12)).save(photos / name, exif=exif)
    survey = walk.survey(tmp_path, positions__path=photos, images__times=None)
    summary = scale_model(survey, progress=QUIET).summary
    assert_scale(summary, 10 * made.metric_from_sfm.scale, 0.02)
    entry = known(summary.positions)
    assert (entry.num, summary.frame, summary.scale.method) == (len(at_m), "site", "positions")
    # What three metres, which last, may do to a path of a hundred metres is in the interval.
    low, high = known(summary.scale.interval_95)
    assert 0.01 < (high - low) / 2 / summary.scale.value < 0.1


@pytest.mark.parametrize(
    "spelt",
    [str.upper, lambda name: name.partition(".")[0], lambda name: f"flight/{name}"],
    ids=["capitals", "no ending", "folder"],
)
def test_positions_name_photos_in_other_capitals_without_an_ending_or_with_a_folder(
    walk: Walk, tmp_path: Path, spelt: Callable[[str], str]
) -> None:
    result = scale_model(_by_photo(walk, tmp_path, spelt), progress=QUIET)
    assert known(result.summary.positions).num_used == walk.made.reconstruction.num_reg_images()
    assert_scale(result.summary, walk.made.metric_from_sfm.scale, 0.01)


def test_positions_between_photos_that_are_far_apart_are_told_to_be_so(walk: Walk, tmp_path: Path) -> None:
    given = {"positions__path": walk.positions(tmp_path), "ranges__max_interpolation_gap_s": 0.5}
    with pytest.raises(GeometryError, match="no position is near enough to a keyframe in time: use more photos, or"):
        scale_model(walk.survey(tmp_path, **given), progress=QUIET)


def test_positions_of_other_photos_are_refused_with_a_name_of_each(walk: Walk, tmp_path: Path) -> None:
    with pytest.raises(
        InputError, match=r"positions\.csv: none of the photos that the file names, such as x_"
    ) as caught:
        scale_model(_by_photo(walk, tmp_path, lambda name: f"x_{name}"), progress=QUIET)
    assert any(image.name in str(caught.value) for image in walk.made.reconstruction.images.values())


def _by_photo(walk: Walk, where: Path, spelt: Callable[[str], str]) -> Survey:
    """Return a survey with a position for each photo, whose names are spelt so."""
    model, rng = walk.made.reconstruction, np.random.default_rng(2)
    images = [(image.name, image.projection_center()) for image in model.images.values()]
    at_m = walk.made.metric_from_sfm.apply(np.array([center for _, center in images]))
    at_m += 0.01 * rng.standard_normal(at_m.shape)
    rows = (f"{spelt(name)},{x:.4f},{y:.4f},{z:.4f}\n" for (name, _), (x, y, z) in zip(images, at_m, strict=True))
    (where / "positions.csv").write_text(f"image_name,x_m,y_m,z_m\n{''.join(rows)}")
    return walk.survey(where, positions__path=where / "positions.csv", positions__antenna_in_cam_m=(0.0, 0.0, 0.0))


def test_positions_of_two_centimetres_bend_a_map_back_that_its_photos_let_drift(tmp_path: Path) -> None:
    truth = yard_truth(max_track_length=4)
    times_s, centers_m = truth.model.timestamps_s, truth.model.centers_m
    write_model(mapped(truth, 5.0, 1), tmp_path / "sparse", times_s, tmp_path / "images.csv")
    at_m = centers_m + 0.02 * np.random.default_rng(3).standard_normal(centers_m.shape)
    rows = ((time, *place_m, 0.02) for time, place_m in zip(times_s.values(), at_m.round(4).tolist(), strict=True))
    write_rows(tmp_path / "positions.csv", "timestamp_s,x_m,y_m,z_m,stddev_m", rows)
    walk = Walk(tmp_path, truth.model, loop_path(40.0))
    survey = walk.survey(
        tmp_path,
        positions__path=tmp_path / "positions.csv",
        positions__antenna_in_cam_m=(0.0, 0.0, 0.0),
        positions__time_offset=0.0,
    )
    refine_model(survey, progress=QUIET)
    off_m = {}
    for name in ("sparse_scaled", "sparse_metric"):
        model = pycolmap.Reconstruction(survey.output.path / name / "0")
        found = np.array([image.projection_center() for _, image in sorted((i.name, i) for i in model.images.values())])
        off_m[name] = rmse(found - centers_m)
    assert off_m["sparse_metric"] < 0.7 * off_m["sparse_scaled"]
