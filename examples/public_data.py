"""Write public data sets in the form in which this project is measured on them.

python public_data.py CLONE OUTPUT_FOLDER

CLONE is a clone of one of these repositories, recognised by its files:

- INRoL/inrol_uwb_localization: photos, ranges and truth of a hand-held camera in a room (``room_env1`` and
  ``room_env2``, for examples/handheld_room.toml), the same without photos (``room_filtering1`` and ``2``), and a log
  with the tag's own path to calibrate the radio with (``room_calibration``);
- utiasASRL/starloc, cjhhalla/RCV_uwb_dataset and LIAS-CUHKSZ/Efficient-Pose-Estimation-via-UWB-measurements: ranges and
  truth, no photos (``radios`` and ``uwb_only``, for the study tests/studies/real_logs.py).

Each folder has the ranges (``timestamp_s,anchor_id,range_m[,tag_id]``), the anchors and the true poses of the camera or
of the tracked body, in metres, world from body. Empty ranges and those of 0 or less are left out; all others are as
published.
"""

from __future__ import annotations

import csv
import json
import re
import shutil
import sys
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime, timezone
from pathlib import Path

import numpy as np
import numpy.typing as npt
from ruamel.yaml import YAML
from scipy.spatial.transform import Rotation

Array = npt.NDArray[np.float64]

RANGES, ANCHORS = ("timestamp_s", "anchor_id", "range_m"), ("anchor_id", "x_m", "y_m", "z_m")
POSES = ("timestamp_s", "x_m", "y_m", "z_m", "qx", "qy", "qz", "qw")
MIN_TRUTH_STEP_S = 0.05
LIAS_EVERY_NTH = 5


def main() -> None:
    clone, output = map(Path, sys.argv[1:3])
    for evidence, convert in (
        ("example/config/parameter.yaml", convert_inrol),
        ("dataset_params.json", convert_starloc),
        ("**/anchor_1.csv", convert_rcv),
        ("**/motion_capture_dynamic_exp_*.csv", convert_lias),
    ):
        if next(clone.glob(evidence), None):
            for folder in convert(clone, output):
                print(folder)
            return
    sys.exit(f"{clone}: none of the repositories that `python {sys.argv[0]}` knows; its first lines name them")


def convert_inrol(clone: Path, output: Path) -> Iterator[Path]:
    """Convert the sets of one camera with one tag in a motion-capture room.

    ``anchor.txt`` has the poses of the tracked bodies. The antennas are elsewhere on them, at ``T_mocap_anchor``.
    """
    parameters = YAML(typ="safe").load(clone / "example" / "config" / "parameter.yaml")
    extrinsics = {name: np.array(rows) for name, rows in parameters["extrinsics"].items()}
    for name, folder in (
        ("anchor_self_calibration1", "room_env1"),
        ("anchor_self_calibration2", "room_env2"),
        ("filtering_state_estimation1", "room_filtering1"),
        ("filtering_state_estimation2", "room_filtering2"),
        ("model_calibration", "room_calibration"),
    ):
        source, target = clone / "example" / name / "parsed_dataset", output / folder
        if not source.is_dir():
            continue
        write(target / "uwb.csv", RANGES, (row[1:] for row in words(source / "uwb.txt") if float(row[3]) > 0))
        bodies = list(words(source / "anchor.txt"))
        antennas = moved(bodies, extrinsics["T_mocap_anchor"])
        positions = ([body[0], *antenna[1:4]] for body, antenna in zip(bodies, antennas, strict=True))
        write(target / "anchors_antennas.csv", ANCHORS, positions)
        if (source / "tag_pose.txt").is_file():
            write(target / "tag_groundtruth.csv", POSES, words(source / "tag_pose.txt"))
        elif (source / "imu_pose.txt").is_file():
            imu_from_cam = np.linalg.inv(extrinsics["T_cam_imu"])
            write(target / "groundtruth.csv", POSES, moved(words(source / "imu_pose.txt"), imu_from_cam))
        else:
            write(target / "groundtruth.csv", POSES, words(source / "cam_pose.txt"))
        if (source / "images.txt").is_file():
            copy_photos(source, target)
        if (source / "imu.txt").is_file():
            shutil.copyfile(source / "imu.txt", target / "imu.txt")
        cam_from_tag = np.linalg.inv(extrinsics["T_mocap_cam"]) @ extrinsics["T_mocap_tag"]
        camera = {
            "camera_model": "OPENCV",
            "params": [parameters["camera"][name] for name in ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2")],
            "tag_in_cam_m": cam_from_tag[:3, 3].round(4).tolist(),
        }
        (target / "camera.json").write_text(json.dumps(camera, indent=1) + "\n", encoding="utf-8")
        yield target


def copy_photos(source: Path, target: Path) -> None:
    """Copy the photos that are listed in ``images.txt``, and write their times."""
    listed = [(source / name, time) for _, time, name in words(source / "images.txt")]
    (target / "images").mkdir(parents=True, exist_ok=True)
    for photo, _ in listed:
        shutil.copyfile(photo, target / "images" / photo.name)
    write(target / "images.csv", ("image_name", "timestamp_s"), ((photo.name, time) for photo, time in listed))


def convert_starloc(clone: Path, output: Path) -> Iterator[Path]:
    """Convert all sets that have ranges. The truth is in each row of the log, with the time of the range."""
    versions = {row["name"]: row["landmarks"] for row in json.loads((clone / "dataset_params.json").read_text())}
    for log in sorted(clone.glob("data/*/uwb.csv")):
        name = log.parent.name
        markers = clone / "mocap" / f"uwb_markers_{versions[name]}.csv"
        if name == "loop-2d_s5":
            (output / "uwb_only").mkdir(parents=True, exist_ok=True)
            shutil.copyfile(log, output / "uwb_only" / f"starloc_{name}_uwb.csv")
            shutil.copyfile(markers, output / "uwb_only" / "starloc_anchors.csv")
            yield output / "uwb_only"
            continue
        target = output / "radios" / f"starloc_{name.removeprefix('loop-2d-')}"
        measured = [row for row in named(log) if float(row["range"]) > 0]
        ranges = ((row["time_s"], row["to_id"], row["range"], row["from_id"]) for row in measured)
        write(target / "uwb.csv", (*RANGES, "tag_id"), ranges)
        write(target / "anchors.csv", ANCHORS, heard_markers(measured, markers))
        columns = ("time_s", "x", "y", "z", "rot_x", "rot_y", "rot_z", "w")
        write(target / "truth.csv", POSES, thinned([row[column] for column in columns] for row in measured))
        yield target


def heard_markers(rows: Sequence[dict[str, str]], markers: Path) -> list[list[str]]:
    """Return anchors by the ids of the log, which are not everywhere those of the table of markers.

    The log has the true range beside each one, so that the marker of an anchor is the one at these distances.
    """
    table = [list(row.values()) for row in named(markers)]
    places = np.array([row[1:] for row in table], dtype=np.float64)
    found = []
    for anchor_id in sorted({row["to_id"] for row in rows}, key=int):
        own = [row for row in rows if row["to_id"] == anchor_id]
        tags = np.array([[float(row[f"tag_pos_{axis}"]) for axis in "xyz"] for row in own])
        expected = np.linalg.norm(tags[:, None] - places, axis=2)
        off_m = np.abs(expected - np.array([[float(row["gt_range"])] for row in own])).max(axis=0)
        if off_m.min() > 0.001:
            sys.exit(f"{markers}: no marker is at the true distances of anchor {anchor_id}")
        found.append([anchor_id, *table[off_m.argmin()][1:]])
    return found


def convert_rcv(clone: Path, output: Path) -> Iterator[Path]:
    """Convert all sequences with truth: one log per anchor, civil times without a zone, taken as UTC."""
    for source in sorted(path.parent for path in clone.glob("**/anchor_1.csv")):
        if not (source / "gt.csv").is_file():
            continue
        target = output / "radios" / f"rcv_sequence{re.sub('[^0-9]', '', source.name)}"
        logs = {path.stem.replace("_", ""): list(named(path)) for path in sorted(source.glob("anchor_*.csv"))}
        rows = [row for each in logs.values() for row in each if float(row["Range"]) > 0]
        ranges = [(seconds(row["Time"]), row["Address"], row["Range"]) for row in rows]
        ranges.sort(key=lambda row: float(row[0]))
        write(target / "uwb.csv", RANGES, ranges)
        places = YAML(typ="safe").load(source / "anchor.yaml")
        anchors = ((own[0]["Address"], *places[name][0]["position"]["data"]) for name, own in logs.items())
        write(target / "anchors.csv", ANCHORS, anchors)
        poses = ([seconds(time), *rest] for time, *rest in (row.values() for row in named(source / "gt.csv")))
        write(target / "truth.csv", POSES, thinned(poses))
        yield target


def convert_lias(clone: Path, output: Path) -> Iterator[Path]:
    """Convert the trolley's logs: a row has the ranges of eight anchors to three tags, every fifth row is taken.

    The anchors are those of the table in the authors' description beside the logs.
    """
    (table,) = {
        tuple(found)
        for page in clone.rglob("README.md")
        if (
            found := re.findall(
                r"\| Anchor (\d) *\| *(\S+) *\| *(\S+) *\| *(\S+) *\|", page.read_text(encoding="utf-8")
            )
        )
    }
    for truth in sorted(clone.glob("**/motion_capture_dynamic_exp_*.csv")):
        log = truth.with_name(truth.name.replace("motion_capture", "UWB"))
        if not log.is_file():
            continue
        target = output / "radios" / f"lias_{truth.stem.rpartition('_')[2]}"
        ranges = (
            (seconds(time), column // 3, value, f"T{column % 3}")
            for time, *values in list(timed(log))[::LIAS_EVERY_NTH]
            for column, value in enumerate(values)
            if float(value or 0) > 0
        )
        write(target / "uwb.csv", (*RANGES, "tag_id"), ranges)
        write(target / "anchors.csv", ANCHORS, table)
        poses = ([seconds(time), x, y, z, qx, qy, qz, qw] for time, x, y, z, qw, qx, qy, qz in timed(truth))
        write(target / "truth.csv", POSES, thinned(poses))
        yield target


def words(path: Path) -> Iterator[list[str]]:
    """Return the words of each line that is no comment."""
    lines = path.read_text(encoding="utf-8").splitlines()
    return (line.split() for line in lines if line.strip() and not line.startswith("#"))


def named(path: Path) -> Iterator[dict[str, str]]:
    """Return the rows of a CSV by the names of its columns."""
    with path.open(encoding="utf-8", newline="") as file:
        yield from csv.DictReader(file)


def timed(path: Path) -> Iterator[list[str]]:
    """Return the rows of a CSV that begin with a date; the others are headers."""
    with path.open(encoding="utf-8", newline="") as file:
        yield from (row for row in csv.reader(file) if row and row[0][:1].isdigit())


def seconds(civil: str) -> str:
    """Return a civil time, taken as UTC, in seconds since 1970, with microseconds."""
    layout = "%Y-%m-%d %H:%M:%S.%f" if "." in civil else "%Y-%m-%d %H:%M:%S"
    return f"{datetime.strptime(civil, layout).replace(tzinfo=timezone.utc).timestamp():.6f}"


def moved(poses: Iterable[Sequence[str]], body_from_other: Array) -> Iterator[list[str]]:
    """Return the poses of another frame that is fixed to the body, as rows of time, position and quaternion.

    What stands in place of the time, such as a number, is kept as a number.
    """
    table = np.array(list(poses), dtype=np.float64)
    world_from_body = Rotation.from_quat(table[:, 4:])
    positions = table[:, 1:4] + world_from_body.apply(body_from_other[:3, 3])
    quaternions = (world_from_body * Rotation.from_matrix(body_from_other[:3, :3])).as_quat()
    return ([f"{value:.9f}" for value in row] for row in np.column_stack([table[:, 0], positions, quaternions]))


def thinned(poses: Iterable[Sequence[str]]) -> Iterator[Sequence[str]]:
    """Return poses in the order of time, at most 20 a second."""
    last = -np.inf
    for row in sorted(poses, key=lambda row: float(row[0])):
        if round(float(row[0]) - last, 6) >= MIN_TRUTH_STEP_S:  # the times have microseconds
            last = float(row[0])
            yield row


def write(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


if __name__ == "__main__":
    main()
