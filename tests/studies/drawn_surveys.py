"""Small surveys drawn at random over everything that a user may have, as files with a command.

A survey that is honest has only what a program must cope with: a radio's errors, failure codes, held values, gaps, rows
without a fix, clocks of their own. The others also hold one mistake of the surveyor, such as a unit that slipped.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
from scipy.spatial.transform import Rotation
from tests.simulated.files import write_rows
from tests.simulated.path import look_at, loop_path, sequence_path
from tests.simulated.surveys import TAG_IN_CAM_M, Truth, errors_in, mapped, model_of_poses, truth_of
from tests.studies.known_positions import POINT_STDDEV_M, Receiver
from tests.studies.measured_distances import marks_in

from rangesfm.colmap.transform import rescale
from rangesfm.demo.simulated_radio import CameraPath
from rangesfm.measurements.lengths.tape import Marker
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import Trajectory, trajectory_from_reconstruction

Array = npt.NDArray[np.float64]
Row = dict[str, Any]

FOOT_M = 0.3048
MEASUREMENTS = ("ranges", "positions", "points", "distances", "up")
MISTAKES = (
    "none",
    "anchors in feet",
    "ranges in feet",
    "labels swapped",
    "anchor moved",
    "lever arm turned",
    "clock off",
)
# With an anchor frame of their own, all anchors, or all but one, are known; with "one" there is but one.
ANCHORS = ("surveyed", "surveyed", "some unknown", "unknown", "one unknown", "first_camera", "one in first_camera")
CLOCKS = ("same", "given", "found", "found", "drifting", "wrapped")
DAMAGES = ("none", "none", "none", "one code", "two codes", "garbage", "one huge", "held", "gaps", "nan", "obstructed")
CODES = ((65535.0, 65534.0), (65.535, 65.534), (655.35, 655.34), (0.0, -1.0), (9999.0, 9998.0), (4294967.295, 8191.0))


@dataclass
class DrawnSurvey:
    """The files of a survey in a folder, the command that takes them, and the truth.

    Attributes:
        words: what was drawn, in the order of the drawing.
        mistake: of the surveyor; "none" where the survey is honest.
        sfm_centers: (n, 3) of the model as handed over. centers_m: (n, 3) the true ones, in the site's frame.
        names: of the n photos.
    """

    folder: Path
    command: list[str]
    words: list[str]
    mistake: str
    sfm_centers: Array
    centers_m: Array
    names: tuple[str, ...]

    @property
    def is_honest(self) -> bool:
        return self.mistake == "none"


def draw(seed: int, folder: Path) -> DrawnSurvey:
    """Draw a survey, and write its files into an empty folder."""
    return _Drawing(seed, folder).survey()


@dataclass
class _Drawing:
    """A survey while it is drawn.

    Attributes:
        flags: of the command. words: what was drawn.
    """

    seed: int
    folder: Path
    flags: list[str] = field(default_factory=list)
    words: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng([self.seed, 77])

    def choose(self, things: Sequence[Any], what: str = "") -> Any:
        """Choose one of some things, and note it after a word for what it is."""
        chosen = things[int(self.rng.integers(len(things)))]
        self.words.append(f"{what} {chosen:g}" if isinstance(chosen, float) else f"{what} {chosen}".strip())
        return chosen

    def happens(self, share: float, word: str) -> bool:
        """Return whether something happens that does so in this share of the surveys, and note it if so."""
        does = bool(self.rng.random() < share)
        self.words += [word] * does
        return does

    def between(self, low: float, high: float) -> float:
        """Draw a number, even in its logarithm."""
        return float(np.exp(self.rng.uniform(np.log(low), np.log(high))))

    def survey(self) -> DrawnSurvey:
        rng = self.rng
        size_m = self.between(1.5, 25.0)
        path, times = self.path(size_m)
        has = self.measurements()
        has_points = self.happens(0.5, "map with points")
        kinds = [kind for kind in ANCHORS if not (has & {"positions", "points"} and kind.endswith("first_camera"))]
        anchors_m, kind = self.anchors(size_m, kinds) if "ranges" in has else ({}, "")
        depth_range_m = (0.5 * size_m, 4 * size_m)
        truth = truth_of(path, times, anchors_m, "site", 40 if has_points else 20, depth_range_m)
        sfm, path_in_sfm = self.map(truth, has_points)
        names, frame_m = path_in_sfm.image_names, truth.model.centers_m
        self.mistake = self.choose(MISTAKES, "mistake") if "ranges" in has and self.rng.random() < 0.2 else "none"
        self.start_s = self.choose((0.0, 0.0, 5000.0, 1.7e9), "start")
        # The origin of the site's coordinates is far from the map by any power of ten.
        far = self.choose((0.0, 0.0, 100.0, 5000.0, 5e6), "origin")
        self.origin_m = np.round(rng.uniform(0.2, 1.0, 3) * [far, far, min(far, 500.0)], 2)
        (self.folder / "sparse" / "0").mkdir(parents=True)
        sfm.write(self.folder / "sparse" / "0")
        self.write("images.csv", [{"image_name": name, "timestamp_s": f"{time + self.start_s:.4f}"}
                                  for name, time in zip(names, times.tolist(), strict=True)])  # fmt: skip
        self.flags += ["--input_path", "sparse/0", "--images", "images.csv"]
        markers, marks_m = marks_in(truth, rng)
        if "ranges" in has:
            self.ranges(truth, path, times, names)
            self.write_anchors(anchors_m, kind, truth, times)
        if "positions" in has:
            self.positions(path, times, names)
        if "points" in has:
            self.points(marks_m)
        if "distances" in has:
            self.distances(marks_m, dict(zip(names, frame_m, strict=True)))
        if has & {"points", "distances"}:
            self.write_markers(markers)
        if "up" in has:
            self.flags += ["--up_in_first_camera", ",".join(f"{x:.5f}" for x in truth.model.world_from_cam[0].T[:, 2])]
        command = "refine" if has_points and self.happens(0.7, "refine") else "scale"
        if not self.happens(0.1, "report"):
            self.flags.append("--no_report")
        argv = [command, *self.flags, "--output_path", "out"]
        return DrawnSurvey(
            self.folder, argv, self.words, self.mistake, path_in_sfm.centers, frame_m + self.origin_m, names
        )

    def measurements(self) -> set[str]:
        """Draw what is measured, of which something gives the map its metres."""
        shares = {"ranges": 0.75, "positions": 0.25, "points": 0.2, "distances": 0.2, "up": 0.15}
        has = {name for name in MEASUREMENTS if self.rng.random() < shares[name]}
        if not has - {"up"}:
            has.add(("ranges", "positions", "points", "distances")[int(self.rng.integers(4))])
        if "ranges" not in has:
            has.discard("up")
        self.words.append("+".join(name for name in MEASUREMENTS if name in has))
        return has

    def path(self, size_m: float) -> tuple[CameraPath, Array]:
        """Draw the camera's path, and the times of its photos."""
        kind = self.choose(("walk", "walk", "walk", "circle", "laps", "eight", "line", "there and back", "ahead"))
        num, interval_s = int(self.rng.integers(24, 46)), self.between(0.4, 1.2)
        duration_s = num * interval_s
        is_level = self.happens(0.3, "level")
        rise = 0.0 if is_level else float(self.rng.uniform(0.05, 0.3))
        seed, sway = int(self.rng.integers(1 << 30)), 0.0 if is_level else float(self.rng.uniform(0.01, 0.03))
        turns = {"walk": float(self.rng.uniform(0.9, 2.2)), "circle": 1.0, "laps": float(self.rng.integers(2, 4))}
        if kind in turns:
            shape = (size_m, size_m * (1.0 if kind == "circle" else float(self.rng.uniform(0.5, 1.0))))
            path = loop_path(
                duration_s, semi_axes_m=shape, height_amplitude_m=rise * size_m, num_turns=turns[kind],
                unsteadiness_m=sway * size_m * (kind == "walk"), seed=seed,
            )  # fmt: skip
        elif kind == "ahead" and not is_level:
            path = sequence_path(duration_s, speed_m_per_s=2 * size_m / duration_s, seed=seed)
        else:
            path = _shown_ahead(kind, duration_s, size_m, rise * size_m)
        times = interval_s * np.arange(0.2, num, dtype=np.float64)
        return path, times[times < path.end_s - 1e-6]

    def anchors(self, size_m: float, kinds: list[str]) -> tuple[dict[str, tuple[float, float, float]], str]:
        """Draw the anchors' places around the path, and what is known of them."""
        kind = self.choose(kinds)
        num = 1 if kind.startswith("one") else int(self.rng.choice([2, 3, 4, 4, 5, 6, 8]))
        self.words.append(f"{num} anchors")
        is_plane = self.happens(0.15, "anchors in a plane")
        angles = 2 * np.pi * (np.arange(num) + 0.3 * self.rng.standard_normal(num)) / num
        radii_m = size_m * self.rng.uniform(1.1, 2.0, num)
        heights_m = self.rng.uniform(0.0, 0.25 * size_m + 2.5, num) if not is_plane else np.full(num, 2.0)
        rows = np.column_stack([radii_m * np.cos(angles), radii_m * np.sin(angles), heights_m]).round(3).tolist()
        first = self.choose((1, 101), "ids from")
        return {f"A{first + k}" if first == 1 else str(first + k): (x, y, z) for k, (x, y, z) in enumerate(rows)}, kind

    def map(self, truth: Truth, has_points: bool) -> tuple[pycolmap.Reconstruction, Trajectory]:
        """Map the survey: from noisy features, or as a path that may drift, in a world and a unit of its own."""
        rng, model = self.rng, truth.model
        times = model.timestamps_s
        if has_points:
            sfm = mapped(truth, float(rng.uniform(0.2, 0.8)), self.seed)
        else:
            path = trajectory_from_reconstruction(model.reconstruction, times)
            size_m = float(np.linalg.norm(np.std(path.centers, axis=0)))
            drift = self.choose((0.0, 0.0, 0.003, 0.01, 0.05), "drift")
            steps = np.cumsum(rng.standard_normal(path.centers.shape), axis=0) / np.sqrt(len(path))
            turned = Rotation.from_rotvec(
                drift * np.cumsum(rng.standard_normal(steps.shape), axis=0) / np.sqrt(len(path))
            )
            seen = path.centers + drift * size_m * steps
            sfm = model_of_poses(
                Trajectory(
                    path.frame_ids, path.image_names, path.timestamps_s, seen, turned.as_matrix() @ path.world_from_cam
                )
            )
        unit = self.between(0.2, 5.0) / self.between(1.0, 10.0)
        turn = Rotation.from_quat(rng.normal(size=4)).as_matrix()
        sfm = rescale(sfm, Similarity(unit, turn, 3 * rng.normal(size=3)))
        return sfm, trajectory_from_reconstruction(sfm, times)

    def ranges(self, truth: Truth, path: CameraPath, times: Array, names: tuple[str, ...]) -> None:
        """Write a log of ranges with a radio's errors, on a clock of its own."""
        rng, ids = self.rng, np.array(list(truth.anchors_m))
        by_photo = self.happens(0.12, "ranges by photo")
        step_s = 1 / (self.between(2.0, 8.0) * len(ids))
        at_s = np.repeat(times, len(ids)) if by_photo else np.arange(times[0], times[-1], step_s)
        anchor = np.arange(len(at_s)) % len(ids)
        tag_m = TAG_IN_CAM_M * self.choose((0.0, 1.0, 1.0), "tag arm")
        true_m = path.centers(at_s) + path.world_from_cam(at_s) @ tag_m
        stood_m = np.array(list(truth.anchors_m.values()))[anchor]
        if self.mistake == "anchor moved":
            stood_m = stood_m + ((anchor == 0) & (at_s > at_s.mean()))[:, None] * rng.uniform(0.3, 2.0, 3)
        range_m = np.linalg.norm(true_m - stood_m, axis=1) + errors_in(truth, at_s, ids[anchor], TAG_IN_CAM_M, rng)
        range_m = np.maximum(range_m, 0.02) / (FOOT_M if self.mistake == "ranges in feet" else 1.0)
        told_m = tag_m[[2, 0, 1]] if self.mistake == "lever arm turned" else tag_m
        labels = ids[::-1] if self.mistake == "labels swapped" else ids
        rows = [
            {"anchor_id": labels[k], "range_m": f"{x:.3f}", "time_s": time}
            for k, x, time in zip(anchor, range_m.tolist(), at_s.tolist(), strict=True)
        ]
        self.flags += ["--ranges", "uwb.csv", f"--tag_in_cam={','.join(f'{x:.4f}' for x in told_m)}"]
        rows = self.damaged(rows, by_photo)
        if by_photo:
            by_time = dict(zip(times.tolist(), names, strict=True))
            rows = [{"image_name": by_time[row["time_s"]], **row} for row in rows]
        else:
            rows = self.timed(rows)
        for row in rows:
            del row["time_s"]
        self.write("uwb.csv", rows)

    def damaged(self, rows: list[Row], by_photo: bool) -> list[Row]:
        """Return the rows of the log with what loggers and radios do to them."""
        rng, kind = self.rng, self.choose(DAMAGES, "damage")
        share, codes = float(rng.uniform(0.03, 0.2)), CODES[int(rng.integers(len(CODES)))]
        for row in rows:
            if kind in ("one code", "two codes", "nan") and rng.random() < share:
                code = codes[int(rng.integers(2)) * (kind == "two codes")]
                row["range_m"] = "nan" if kind == "nan" else f"{code:g}"
            elif kind == "garbage" and rng.random() < 0.5 * share:
                row["range_m"] = f"{rng.uniform(0.0, 3e5):.3f}"
            elif kind == "obstructed" and rng.random() < 2 * share:
                row["range_m"] = f"{float(row['range_m']) + rng.exponential(1.5):.3f}"
        if kind == "one huge":
            rows[len(rows) // 3]["range_m"] = "4294967.295"
        if kind == "gaps":
            first_s, last_s = rows[0]["time_s"], rows[-1]["time_s"]
            gap_s = first_s + float(rng.uniform(0.1, 0.6)) * (last_s - first_s)
            rows = [row for row in rows if not gap_s < row["time_s"] < gap_s + 0.25 * (last_s - first_s)]
        return _held(rows) if kind == "held" and not by_photo else rows

    def timed(self, rows: list[Row]) -> list[Row]:
        """Return the rows with times of the radio's clock."""
        kind = self.choose(CLOCKS, "clock")
        offset_s = 0.0 if kind == "same" else float(self.rng.uniform(-20.0, 20.0))
        ahead_s = 1.0 if self.mistake == "clock off" else 0.0
        rate = 1 + 1e-4 * float(self.rng.standard_normal()) * (kind == "drifting")
        seconds = np.array([row["time_s"] for row in rows]) * rate + self.start_s - offset_s
        if kind == "wrapped":
            period_s = 2**32 / 1e6
            seconds = np.mod(seconds - seconds.mean() + period_s, period_s)
        if kind in ("same", "given"):
            self.flags.append(f"--ranges_time_offset={offset_s + ahead_s:.3f}")
        return [{"timestamp_s": f"{time:.6f}", **row} for row, time in zip(rows, seconds.tolist(), strict=True)]

    def write_anchors(self, anchors_m: dict[str, Any], kind: str, truth: Truth, times: Array) -> None:
        """Write what is known of the anchors."""
        if kind in ("unknown", "one unknown"):
            self.flags += ["--anchor_frame", "unknown"]
            return
        stddev_m, model = self.choose((0.005, 0.02, 0.1), "anchors to"), truth.model
        in_camera = kind.endswith("first_camera")
        rows = []
        for k, (name, place_m) in enumerate(anchors_m.items()):
            at_m = np.array(place_m) + stddev_m * self.rng.standard_normal(3)
            at_m = (at_m - model.centers_m[0]) @ model.world_from_cam[0] if in_camera else at_m + self.origin_m
            at_m = at_m / (FOOT_M if self.mistake == "anchors in feet" else 1.0)
            is_known = kind != "some unknown" or k % 3 != 0
            cells = [f"{x:.3f}" for x in at_m] if is_known else [""] * 3
            rows.append(dict(zip(("anchor_id", "x_m", "y_m", "z_m", "position_stddev_m"), (name, *cells, stddev_m),
                                 strict=True)))  # fmt: skip
        self.write("anchors.csv", rows)
        self.flags += ["--anchors", "anchors.csv", "--anchor_frame", "first_camera" if in_camera else "site"]

    def positions(self, path: CameraPath, times: Array, names: tuple[str, ...]) -> None:
        """Write positions of an antenna on the camera, by time or by photo."""
        rng = self.rng
        by_photo = self.happens(0.4, "positions by photo")
        # Nothing in a short survey tells an error that lasts longer, so it is part of what a file states.
        noise_m = self.between(0.01, 0.3)
        receiver = Receiver(noise_m, noise_m * self.between(0.2, 1.5), self.between(3.0, 60.0))
        stated_m = float(np.hypot(receiver.noise_m, receiver.lasting_m))
        at_s = (
            times if by_photo else np.arange(times[0] - 3.0, times[-1] + 3.0, self.choose((0.2, 1.0), "positions each"))
        )
        at_s = at_s[(at_s >= path.start_s) & (at_s <= path.end_s)]
        arm_m = np.array([0.02, -0.3, 0.05]) * self.choose((0.0, 1.0), "antenna arm")
        at_m = path.centers(at_s) + path.world_from_cam(at_s) @ arm_m + receiver.errors_m(at_s, rng) + self.origin_m
        with_stddev, without_fix = self.happens(0.5, "with stddevs"), 0.1 * self.happens(0.3, "rows without a fix")
        offset_s = 0.0 if by_photo else self.choose((0.0, float(rng.uniform(-18.0, 18.0))), "their offset")
        rows: list[Row] = []
        for k, (time, place_m) in enumerate(zip(at_s.tolist(), at_m.tolist(), strict=True)):
            row: Row = (
                {"image_name": names[k]} if by_photo else {"timestamp_s": f"{time + self.start_s - offset_s:.4f}"}
            )
            is_fixed = rng.random() >= without_fix
            row |= {
                axis: f"{x:.4f}" if is_fixed else "nan" for axis, x in zip(("x_m", "y_m", "z_m"), place_m, strict=True)
            }
            rows.append(row | ({"stddev_m": f"{stated_m:.4f}"} if with_stddev else {}))
        self.write("positions.csv", rows)
        self.flags += ["--positions", "positions.csv", f"--antenna_in_cam={','.join(map(str, arm_m))}"]
        if not by_photo and self.happens(0.4, "offset given"):
            self.flags.append(f"--positions_time_offset={offset_s:.3f}")

    def points(self, marks_m: dict[str, Array]) -> None:
        """Write control and check points."""
        num = self.choose((3, 4, 6, 16), "points")
        rows = []
        for k, (name, at_m) in enumerate([*marks_m.items()][:num]):
            place_m = at_m + POINT_STDDEV_M * self.rng.standard_normal(3) + self.origin_m
            kind = "check" if k % 4 == 3 else "control"
            cells = (name, *(f"{x:.4f}" for x in place_m), POINT_STDDEV_M, kind)
            rows.append(dict(zip(("marker", "x_m", "y_m", "z_m", "stddev_m", "kind"), cells, strict=True)))
        self.write("points.csv", rows)
        self.flags += ["--points", "points.csv"]

    def distances(self, marks_m: dict[str, Array], photos_m: dict[str, Array]) -> None:
        """Write taped lengths between marks, or between photos."""
        ends_m = photos_m if len(marks_m) < 2 or self.happens(0.5, "taped between photos") else marks_m
        stddev_m, rows = self.choose((0.003, 0.02), "taped to"), []
        for _ in range(self.choose((1, 2, 3, 5), "lengths")):
            first, second = self.rng.choice([*ends_m], 2, replace=False).tolist()
            length_m = float(np.linalg.norm(ends_m[first] - ends_m[second])) + stddev_m * self.rng.standard_normal()
            if length_m > 10 * stddev_m:
                cells = (first, second, f"{length_m:.4f}", stddev_m)
                rows.append(dict(zip(("from", "to", "distance_m", "stddev_m"), cells, strict=True)))
        if rows:
            self.write("distances.csv", rows)
            self.flags += ["--distances", "distances.csv"]

    def write_markers(self, markers: dict[str, Marker]) -> None:
        rows = [
            {"marker": name, "image_name": photo, "x_px": f"{x:.3f}", "y_px": f"{y:.3f}"}
            for name, marker in markers.items()
            for photo, (x, y) in zip(marker.image_names, marker.pixels, strict=True)
        ]
        if rows:
            self.write("markers.csv", rows)
            self.flags += ["--markers", "markers.csv"]

    def write(self, name: str, rows: list[Row]) -> None:
        """Write a table."""
        write_rows(self.folder / name, ",".join(rows[0]), (row.values() for row in rows))


def _shown_ahead(kind: str, duration_s: float, size_m: float, rise_m: float) -> CameraPath:
    """Return a path that a machine drives exactly, with a camera that keeps its direction but for some sway."""
    times = np.linspace(0.0, duration_s, 60)
    turn = 2 * np.pi * times / duration_s
    shapes: dict[str, Callable[[], tuple[Array, Array]]] = {
        "eight": lambda: (np.sin(turn), 0.6 * np.sin(2 * turn)),
        "there and back": lambda: (-np.cos(turn), 0 * turn),
    }
    x, y = shapes.get(kind, lambda: (turn / np.pi - 1, 0 * turn))()
    centers = np.column_stack([size_m * x, size_m * y, 1.5 + rise_m * np.sin(1.7 * turn)])
    ahead = np.column_stack([1 + 0 * turn, 0.2 * np.sin(2.3 * turn), 0.1 * np.cos(1.9 * turn)])
    return CameraPath.through(times, centers, look_at(centers, centers + ahead))


def _held(rows: list[Row]) -> list[Row]:
    """Return the rows that a logger writes who repeats the last range of each anchor four times as often."""
    step_s = (rows[-1]["time_s"] - rows[0]["time_s"]) / (4 * len(rows))
    last: dict[str, Row] = {}
    held, coming, now_s = [], iter(rows), float(rows[0]["time_s"])
    following: Row | None = next(coming)
    ids = sorted({row["anchor_id"] for row in rows})
    for k in range(4 * len(rows)):
        now_s = rows[0]["time_s"] + k * step_s
        while following is not None and following["time_s"] <= now_s:
            last[following["anchor_id"]] = following
            following = next(coming, None)
        name = ids[k % len(ids)]
        if name in last:
            held.append({**last[name], "time_s": now_s})
    return held
