"""Damage what a command reads, or where it runs, in three hundred random ways.

    python -m tests.studies.hostile [--num_probes 300] [--seed 0] [--first 0]

Each probe takes a copy of a small photo survey that has been run once, and starts a random command on it. Before that,
one or two things are made hostile. A file that the command reads is cut, emptied, overwritten, exchanged, locked, made
a folder, a pipe or a link, or filled with far too much. Or one of its numbers is put at or beyond its bounds, or a key
of the survey is. Or the surroundings are odd: full or closed streams, no room for files, strange variables, Python
files with the names of libraries in the working folder. The files are those of users (photos, logs, tables, surveys,
plans, models, databases) and those that rangesfm wrote and reads again. Or files of other owners are put among inputs
and outputs: under names that rangesfm uses, in place of files that it wrote, inside its folders, as links, and as
further links to its files. A third of the commands that meet those are killed at a random moment, and another follows.

Each command must end in time and with an exit status of the contract. An error must be one line, without a traceback or
a library's own words. No input, nothing that a link leads to, no file that was damaged and none of another owner may be
changed. Prints a line for each probe that went wrong, and how the commands ended. Exit status 1 if anything went wrong.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import resource
import shutil
import signal
import sqlite3
import struct
import subprocess
import sys
import tempfile
import types
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Union, get_args, get_origin, get_type_hints

import numpy as np
from filelock import FileLock
from pydantic.fields import FieldInfo
from tests.simulated.files import write_marks
from tests.simulated.small_demo import make_small_demo

from rangesfm.colmap.model_files import read_model
from rangesfm.demo.survey import TIME_OFFSET_S
from rangesfm.export import EXPORTED_NAMES
from rangesfm.result.result_folder import PHOTOS_NAMES, RESULT_NAMES
from rangesfm.sfm.steps import RECONSTRUCTION_NAMES
from rangesfm.survey.settings import SURVEY_TABLES
from rangesfm.util.files.output_folder import LOCK_NAME, PRIVATE_NAME

STATUSES = (0, 2, 3, 4)
MAX_SECONDS = 300.0
# Of memory that can be written to, so that what reads for ever ends. The engine that draws pictures reserves far more
# address space than it uses.
MAX_BYTES = 8 << 30
OWN_WORDS = (
    *("Traceback", "internal error", "terminate called", "Warning:", "*** ", "Segmentation", "LAPACK", "** On entry"),
)
NUMBERS = (
    *(0.0, 1e-320, 1e-300, 1e-160, 1e-20, 1e-9, 1e-6, 1e3, 1e6, 1e9, 1e10, 1e15, 1e80, 1e160, 1e308, np.nan, np.inf),
)
VALUES: tuple[object, ...] = (None, True, [], {}, "text", "", [[]], {"a": 1}, "\x00", "../..", 10**400, -1, 2**63)
MODEL = ("out/sparse/0/cameras.bin", "out/sparse/0/images.bin", "out/sparse/0/points3D.bin", "out/sparse/0/frames.bin")
RECORDS = ("out/.rangesfm/manifest.json", "out/.rangesfm")
RESULT = (
    *("out/result.json", "out/ranges.csv", "out/images.csv", "out/pose_covariance.csv", "out/scale_consensus.csv"),
    *("out/scale_candidates.csv", "out/reference.csv", "out/sparse_metric/0/images.bin"),
    *("out/sparse_metric/0/points3D.bin", "out/sparse_metric/0/cameras.bin", "out/sparse_scaled/0/images.bin"),
    *("out/sparse_scaled/0/frames.bin", *RECORDS),
)
PHOTOS = ("images", "images/IMG_0001.jpg", "images/IMG_0002.jpg", "images/IMG_0009.jpg")
SURVEY = ("survey.toml", "uwb.csv", "anchors.csv", "reference.csv", *PHOTOS)
RECONSTRUCTION = (
    *("out/reconstruct.json", "out/database.db", "out/sparse", "out/mapper.log", *MODEL, *RECORDS, "out/result.json"),
    *("out/report.html", "out/trajectory.tum", "out/sparse_metric"),
)
FORMATS = ("colmap", "colmap_text", "undistorted", "tum", "ply", "opf", "transform", "nerfstudio", "opensfm")
RUN = ("run", "survey.toml", "--ranges_time_offset", str(TIME_OFFSET_S), "--num_threads", "1")
MODEL_FLAGS = ("--ranges", "uwb.csv", "--anchors", "anchors.csv", "--tag_in_cam", "0.03,-0.12,-0.05")
TABLES_READ = ("uwb.csv", "anchors.csv", "times.csv", "reference.csv", "distances.csv", "markers.csv", "curve.csv")
TAPED = ("--distances", "distances.csv", "--markers", "markers.csv", "--error_curve", "curve.csv")
TIMED = ("--images", "times.csv", "--reference", "reference.csv", "--ranges_time_offset", "auto")
# Commands, and the files that each reads.
COMMANDS: tuple[tuple[tuple[str, ...], tuple[str, ...]], ...] = (
    (RUN, (*SURVEY, *RECONSTRUCTION)),
    ((*RUN, "--restart"), (*SURVEY, *RECORDS)),
    ((*RUN, "--output_path", "new"), SURVEY),
    (("reconstruct", "--images", "images", "--output_path", "out", "--num_threads", "1"), (*PHOTOS, *RECONSTRUCTION)),
    (
        ("reconstruct", "--images", "images", "--database_path", "project/database.db", "--output_path", "new"),
        (*PHOTOS, "project/database.db", "project/database.db"),
    ),
    (
        ("refine", "--input_path", "out/sparse/0", *MODEL_FLAGS, *TIMED, *TAPED, "--output_path", "new"),
        (*TABLES_READ, *MODEL),
    ),
    (
        ("scale", "--input_path", "out/sparse/0", *MODEL_FLAGS, *TIMED, *TAPED, "--output_path", "out"),
        (*TABLES_READ, *MODEL, *RECORDS),
    ),
    (("export", "out", "--formats", ",".join(FORMATS)), (*RESULT, *PHOTOS, "out/database.db")),
    (("export", "out", "--apply_to", "out/points.ply", "out/sparse/0"), ("out/points.ply", "out/result.json", *MODEL)),
    (("report", "out", "--png"), (*RESULT, *PHOTOS)),
    (("compare", "out", "out/sparse_scaled/0", "--output_path", "comparison"), RESULT),
    (("plan", "--from", "out", "--output_path", "plan"), RESULT),
    (("plan", "plan.toml", "--output_path", "plan"), ("plan.toml", "anchors.csv")),
    (("join", "out", "out_2", "--output_path", "joined"), (*RESULT, "out_2/result.json", "out_2/ranges.csv")),
    (("ranges", "uwb.csv", "--output_path", "ranges.csv", "--plot", "ranges.png"), ("uwb.csv", "uwb.csv")),
    (("trilaterate", "uwb.csv", "--positions", "tag.csv", "--output_path", "found.csv"), ("uwb.csv", "tag.csv")),
    (
        (
            "ranges",
            "calibrate",
            "uwb.csv",
            "--positions",
            "tag.csv",
            "--anchors",
            "anchors.csv",
            "--output_path",
            "new.csv",
        ),
        ("uwb.csv", "tag.csv", "anchors.csv"),
    ),
    (("init", ".", "--images", "images", "--output_path", "new.toml"), (*SURVEY, "distances.csv", "camera.json")),
    (("check", "survey.toml"), (*SURVEY, "out/result.json")),
    (("check", "."), (*SURVEY, "camera.json")),
)
MAPS = (0, 1, 2, 5, 6)  # of COMMANDS: those that take the keys of a survey as flags
# More commands that write where files of other owners may be.
WRITING: tuple[tuple[str, ...], ...] = (
    *(command for command, _ in COMMANDS if "check" not in command),
    (*RUN, "--restart", "--formats", "tum,ply,colmap"),
    (*RUN, "--output_path", "."),
    (*RUN, "--check_share", "0.1"),
    ("reconstruct", "--images", "project/images", "--output_path", "project", "--num_threads", "1"),
    ("scale", "--input_path", "out/sparse_metric", *MODEL_FLAGS, "--output_path", "out"),
    ("refine", "--input_path", "out/sparse/0", *MODEL_FLAGS, "--images", "out/images.csv", "--output_path", "out"),
    ("export", "out", "--formats", ",".join(FORMATS), "--output_path", "exported"),
    ("compare", "out", "out/sparse_scaled/0", "--output_path", "out"),
    ("plan", "--from", "out", "--output_path", "out"),
    ("ranges", "uwb.csv", "--output_path", "uwb.csv"),
    ("ranges", "uwb.csv", "--output_path", "out/ranges.csv"),
    ("init", ".", "--output_path", "out"),
    ("demo", "."),
    ("join", "out", "out_2", "--output_path", "out"),
    ("join", "out", "out_2", "--output_path", "out_2/sparse"),
)
# Names that rangesfm uses, and folders where it does.
NAMES = (
    *RESULT_NAMES,
    *RECONSTRUCTION_NAMES,
    *PHOTOS_NAMES,
    *(name for names in EXPORTED_NAMES.values() for name in names),
    *("comparison.html", "plan.json", "plan.html", "figures", "applied", "batch.csv", "survey.toml"),
    *("database.db-wal", "database.db-shm", "mapping_snapshot", "given_database", "matching", "rigs"),
    *(".bashrc.20240101.old", ".mozilla.20210101.old", ".ranges.123.part.csv", ".result.unfinished", ".rangesfm.lock"),
)
FOLDERS = (
    *("", "out", "out/sparse/0", "out/sparse_metric/0", "out/sparse_scaled", "out/colmap", "out/undistorted/dense"),
    *("other", "exported", "project", "comparison", "plan", "new"),
)
PLAN = """[anchors]
path = "anchors.csv"
[path]
waypoints = [[2.0, 2.0, 1.5], [7.0, 2.0, 1.6], [7.0, 7.0, 1.4], [2.0, 7.0, 1.5]]
speed_m_per_s = 0.5
[radio]
rate_hz = 5.0
[tag]
tag_in_cam_m = [0.03, -0.12, -0.05]
"""


@dataclass
class Probe:
    """A survey's folder, and what is made hostile in it.

    Attributes:
        folder: where the command runs.
        outside: a folder that links lead to.
        said: what was done, in words.
        protected: each path that must not change, with its state.
        held: locks that are held while the command runs.
        streams: other values of the arguments of subprocess.Popen.
        limits: for the command's process.
        kill_after_s: when it is killed, if at all.
    """

    folder: Path
    outside: Path
    rng: np.random.Generator
    said: list[str] = field(default_factory=list)
    protected: dict[Path, bytes | str] = field(default_factory=dict)
    held: ExitStack = field(default_factory=ExitStack)
    environment: dict[str, str] = field(default_factory=dict)
    streams: dict[str, Any] = field(default_factory=dict)
    limits: list[Callable[[], None]] = field(default_factory=list)
    flags: list[str] = field(default_factory=list)
    kill_after_s: float | None = None

    def choose(self, things: Any) -> Any:
        """Return one of some things, by chance."""
        things = list(things)
        return things[int(self.rng.integers(len(things)))]

    def protect(self, path: Path) -> None:
        self.protected[path] = state_of(path)

    def protect_files_in(self, folder: Path) -> None:
        for path in folder.rglob("*"):
            if path.is_file() or path.is_symlink():
                self.protect(path)

    def changed(self) -> list[str]:
        """List the protected paths that are no longer what they were."""
        return [str(path) for path, before in self.protected.items() if state_of(path) != before]


def state_of(path: Path) -> bytes | str:
    """Return the content of a file, the target of a link, or a word for the kind of whatever else is there."""
    if path.is_symlink():
        return os.readlink(path)
    if path.is_file():
        return path.read_bytes()
    return "folder" if path.is_dir() else "pipe" if path.is_fifo() else "gone"


def damage_a_file(probe: Probe, names: tuple[str, ...]) -> None:
    """Damage one of the files or folders that a command reads."""
    path = probe.folder / probe.choose(names)
    if not os.path.lexists(path) or os.path.islink(path):
        return
    if path.is_dir():
        kind = probe.choose(["removed", "link", "loop", "file"])
        shutil.move(path, probe.outside / f"moved_{path.name}")
        for file in [file for file in probe.protected if file.is_relative_to(path)]:
            probe.protected.pop(file)
        replace_by(probe, path, kind)
    else:
        kinds = ["cut", "emptied", "overwritten", "noise", "exchanged", "value", "value", "filled", "zeros", "tail"]
        kinds += ["removed", "folder", "pipe", "link", "dead link", "loop", "device", "locked"]
        kind = probe.choose(kinds)
        change(probe, path, kind)
    probe.said.append(f"{path.relative_to(probe.folder)} {kind}")
    if kind != "locked":
        probe.protected.pop(path, None)
        # What rangesfm keeps to itself it may repair, and a file that is not there it may write.
        if os.path.lexists(path) and PRIVATE_NAME not in path.parts:
            probe.protect(path)


def change(probe: Probe, path: Path, kind: str) -> None:
    """Change the content of a file, lock it, or put something else in its place."""
    data, rng = path.read_bytes(), probe.rng
    if kind == "locked":
        probe.held.enter_context(locked(path))
    elif kind in ("removed", "folder", "pipe", "link", "dead link", "loop", "device"):
        path.unlink()
        replace_by(probe, path, kind)
    else:
        path.unlink()  # a new file, in case the old one has other names
        path.write_bytes(damaged(probe, path, data, kind, rng))


def damaged(probe: Probe, path: Path, data: bytes, kind: str, rng: np.random.Generator) -> bytes:
    """Return the new content of a file."""
    if kind == "cut":
        return data[: int(rng.integers(1, max(len(data), 2)))]
    if kind == "overwritten":
        new = bytearray(data)
        for place in rng.integers(0, max(len(data), 1), int(rng.integers(1, 30))) if data else ():
            new[place] = int(rng.integers(256))
        return bytes(new)
    if kind == "noise":
        return bytes(rng.bytes(int(rng.integers(1, 5000))))
    if kind == "exchanged":
        others = [file for file in sorted(probe.folder.rglob("*")) if file.is_file() and not file.is_symlink()]
        return bytes(probe.choose(others).read_bytes())
    if kind == "value":
        return with_another_value(probe, path, data)
    if kind == "filled":
        return data + bytes(probe.choose([b"x", b"9", b",", b"\n", b"[", b'{"a":', b'"'])) * 3_000_000
    if kind == "zeros":
        return bytes(len(data))
    return data + bytes(rng.bytes(200)) if kind == "tail" else b""


def with_another_value(probe: Probe, path: Path, data: bytes) -> bytes:
    """Return the content of a file with one of its numbers, or another value of a record, put at an extreme."""
    number = float(probe.choose(NUMBERS)) * probe.choose([1, -1])
    if path.suffix == ".json":
        content = json.loads(data)
        parent, key = probe.choose(places_in(content))
        parent[key] = number if probe.rng.random() < 0.5 else probe.choose(VALUES)
        return json.dumps(content).encode()
    if path.suffix in (".bin", ".db") and len(data) > 16:
        place = int(rng_place(probe, len(data) - 8))
        code = probe.choose(["<d", "<Q"])
        value = number if code == "<d" else int(probe.choose([0, 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1]))
        return data[:place] + struct.pack(code, value) + data[place + 8 :]
    numbers = [*re.finditer(rb"(?<![\w.])-?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w.])", data)]
    if not numbers:
        return data[: len(data) // 2]
    found = probe.choose(numbers)
    return data[: found.start()] + repr(number).encode() + data[found.end() :]


def rng_place(probe: Probe, num: int) -> int:
    """Return a place in a binary file; half of them near its beginning, where counts are."""
    return int(probe.rng.integers(min(num, 200) if probe.rng.random() < 0.5 else num))


def places_in(content: Any) -> list[tuple[Any, Any]]:
    """List all values in a JSON document, each as what it is in and its key there."""
    items = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    found = []
    for key, value in items:
        found += [(content, key), *places_in(value)]
    return found


def replace_by(probe: Probe, path: Path, kind: str) -> None:
    """Put something else in the place of a file or folder that has been removed."""
    if kind == "folder":
        path.mkdir()
        (path / "mine.txt").write_text("mine\n")
        probe.protect(path / "mine.txt")
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "file":
        path.write_bytes(probe.rng.bytes(100))
    elif kind != "removed":
        targets: dict[str, Path | str] = {
            "link": probe.outside / "file.txt",
            "dead link": probe.outside / "nothing",
            "loop": path.name,
        }
        path.symlink_to(targets.get(kind, Path("/dev/zero")))


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Lock a file as another program would: a database by a transaction, an output folder by its lock."""
    if path.suffix == ".db":
        with closing(sqlite3.connect(path, isolation_level=None)) as connection:
            connection.execute("BEGIN EXCLUSIVE")
            yield
    else:
        output = path.parent if path.parent.name != PRIVATE_NAME else path.parents[1]
        (output / PRIVATE_NAME).mkdir(exist_ok=True)
        with FileLock(output / LOCK_NAME, is_singleton=True):  # one probe may lock the same folder twice
            yield


def put_foreign_files(probe: Probe) -> None:
    """Put files that rangesfm did not write among inputs and outputs, or turn files that it wrote into such."""
    rng = probe.rng
    changes = [place_somewhere] * int(rng.integers(1, 12)) + [link_an_own_file] * int(rng.integers(0, 4))
    if rng.random() < 0.5:
        changes += [change_an_own_file] * int(rng.integers(1, 4))
    if rng.random() < 0.1:
        changes.append(move_a_folder_away)
    for k in rng.permutation(len(changes)):
        changes[k](probe)
    if rng.random() < 0.1 and (probe.folder / "out" / PRIVATE_NAME).is_dir():
        # As the result of a version that kept no record, in which all files count as foreign.
        shutil.rmtree(probe.folder / "out" / PRIVATE_NAME)
        probe.protect_files_in(probe.folder / "out")
    probe.said.append("foreign files")


def place_somewhere(probe: Probe) -> None:
    """Put a file, a folder that holds one, or a link under a name that rangesfm uses."""
    parent = probe.folder / probe.choose(FOLDERS)
    path = parent / probe.choose(NAMES)
    if any(other.is_symlink() or other.is_file() for other in (parent, *parent.parents)):
        return
    if os.path.lexists(path):
        if path.is_dir() and not path.is_symlink():
            path /= "mine.txt"
        if os.path.lexists(path):
            return
    path.parent.mkdir(parents=True, exist_ok=True)
    kind = probe.choose(["file", "folder", "link", "dead link", "hard link"])
    if kind == "hard link":
        os.link(probe.outside / "file.txt", path)
    else:
        replace_by(probe, path, kind)
    if kind != "folder":
        probe.protect(path)


def own_files(probe: Probe) -> list[Path]:
    """List the files that the earlier run left, without the hidden records."""
    files = [path for path in (probe.folder / "out").rglob("*") if path.is_file() and not path.is_symlink()]
    return sorted(path for path in files if PRIVATE_NAME not in path.parts and path not in probe.protected)


def change_an_own_file(probe: Probe) -> None:
    """Turn a file that rangesfm wrote into a foreign one, by changing or replacing its content, or by a link."""
    if not (own := own_files(probe)):
        return
    path, kind = probe.choose(own), probe.choose(["same file", "new file", "appended", "same size", "link"])
    data = path.read_bytes()
    # otherwise the content under its other name would change as well
    if kind in ("new file", "link") or path.stat().st_nlink > 1:
        path.unlink()
    if kind == "link":
        replace_by(probe, path, kind)
    elif kind == "appended":
        path.write_bytes(data + b"\n# mine\n")
    else:
        path.write_bytes(probe.rng.bytes(max(1, len(data) if kind == "same size" else 100)))
    probe.protect(path)


def link_an_own_file(probe: Probe) -> None:
    """Give a file that rangesfm wrote another name outside, as backups by hard links do."""
    if own := own_files(probe):
        backup = probe.outside / f"backup_{len(probe.protected)}"
        os.link(probe.choose(own), backup)
        probe.protect(backup)


def move_a_folder_away(probe: Probe) -> None:
    """Move a folder of results to another place, and leave a link."""
    folders = [path for path in (probe.folder / "out").iterdir() if path.is_dir() and path.name != PRIVATE_NAME]
    if folders := sorted(path for path in folders if not path.is_symlink()):
        path = probe.choose(folders)
        for file in [file for file in probe.protected if file.is_relative_to(path)]:
            probe.protected.pop(file)
        moved = Path(shutil.move(path, probe.outside / f"moved_{path.name}"))
        path.symlink_to(moved)
        probe.protect(path)
        probe.protect_files_in(moved)


def set_a_key(probe: Probe) -> None:
    """Put a key of the survey at one of its bounds, or a little beyond."""
    flag, value = probe.choose(KEYS_AT_BOUNDS)
    probe.flags.append(f"--{flag}={value}")
    probe.said.append(probe.flags[-1])


def _bounds(hint: Any) -> list[float]:
    """List the bounds of the numbers in a type, each with a number beyond it."""
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        constraints = [item for info in args[1:] if isinstance(info, FieldInfo) for item in info.metadata]
        bounds = [getattr(item, name) for item in constraints for name in ("ge", "le") if hasattr(item, name)]
        beyond = [1e-300, -1e300] if args[0] is float else [2**63]
        return [*bounds, *beyond] if bounds and args[0] in (int, float) else _bounds(args[0])
    if origin in (Union, types.UnionType, tuple, dict):
        return [bound for arg in args if arg not in (types.NoneType, Ellipsis) for bound in _bounds(arg)]
    return []


def _keys_at_bounds() -> list[tuple[str, str]]:
    found = []
    for model in SURVEY_TABLES.values():
        hints = get_type_hints(model, include_extras=True)
        for key in model.keys().values():
            num = 3 if key.name in ("tag_in_cam_m", "up_in_first_camera", "origin_lat_lon_height") else 1
            prefix = "tag:" if key.name == "lever_arms_m" else ""
            for bound in dict.fromkeys(_bounds(hints[key.name])):
                text = ",".join([repr(bound)] * (3 if prefix else num))
                found.append((key.flag, prefix + text))
    return found


KEYS_AT_BOUNDS = _keys_at_bounds()


def make_surroundings_odd(probe: Probe) -> None:
    """Choose odd surroundings for the command."""
    kind = probe.choose(["variable", "variable", "room", "streams", "library", "folder of temporary files"])
    if kind == "variable":
        name = probe.choose(
            ["OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "LC_ALL", "HOME", "TMPDIR", "COLUMNS", "PYTHONHASHSEED"]
        )
        values = ["", "0", "x", "100000", "C", "/nonexistent"] if name != "PYTHONHASHSEED" else ["0", "1"]
        probe.environment[name] = probe.choose(values)
        kind = f"{name}={probe.environment[name]}"
    elif kind == "room":
        kind = limit_file_size(probe)
    elif kind == "streams":
        name, what = probe.choose(["stdout", "stderr"]), probe.choose(["full", "closed"])
        number = {"stdout": 1, "stderr": 2}[name]
        probe.streams[name] = None
        probe.limits.append(lambda: _lead_to_nowhere(number, what == "full"))
        kind = f"{name} {what}"
    elif kind == "library":
        name = probe.choose(["numpy.py", "json.py", "pycolmap.py", "logging.py", "rangesfm.py", "sitecustomize.py"])
        (probe.folder / name).write_text("raise SystemExit('run by mistake')\n")
        probe.protect(probe.folder / name)
        kind = name
    else:
        probe.environment["TMPDIR"] = str(probe.outside / "file.txt")
    probe.said.append(kind)


def _lead_to_nowhere(number: int, is_full: bool) -> None:
    if is_full:
        os.dup2(os.open("/dev/full", os.O_WRONLY), number)
    else:
        os.close(number)


def limit_file_size(probe: Probe) -> str:
    """Let the command write no file beyond a random size, as on a full disk; return the limit in words."""
    max_bytes = int(10 ** probe.rng.uniform(2, 6.5))

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, max_bytes))

    probe.limits.append(limit)
    return f"files up to {max_bytes} bytes"


def make_template(folder: Path) -> None:
    """Make the survey that probes copy: with two results, exports, a project in COLMAP's layout, and further files."""
    survey = make_small_demo(folder / "survey", num_photos=10).folder
    for command in (RUN, ("export", "out", "--formats", ",".join(FORMATS)), ("report", "out")):
        done = subprocess.run([sys.executable, "-m", "rangesfm", *command], cwd=survey, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(done.stderr)
    shutil.copytree(survey / "out", survey / "out_2")
    header, *ranges = (survey / "out_2" / "ranges.csv").read_text().splitlines()
    assert header.startswith("timestamp_s,")
    later = [f"{float(time) + 1e4},{rest}" for time, _, rest in (row.partition(",") for row in ranges)]
    (survey / "out_2" / "ranges.csv").write_text("\n".join([header, *later]) + "\n")  # a copy is not joined
    shutil.copytree(survey / "images", survey / "project" / "images")
    shutil.copytree(survey / "out" / "sparse", survey / "project" / "sparse")
    shutil.copyfile(survey / "out" / "database.db", survey / "project" / "database.db")
    shutil.copyfile(survey / "out" / "images.csv", survey / "times.csv")
    rows = [line.split(",") for line in (survey / "times.csv").read_text().splitlines()[1:]]
    names, times = [row[0] for row in rows], np.array([float(row[1]) for row in rows])
    places = dict(line.split(",", 1) for line in (survey / "reference.csv").read_text().splitlines()[1:])
    path_m = np.array([places[name].split(",") for name in names], dtype=float)
    positions = ["timestamp_s,x_m,y_m,z_m"]
    for time in np.arange(times[0], times[-1], 0.05):
        x, y, z = (np.interp(time, times, column) for column in path_m.T)
        positions.append(f"{time - TIME_OFFSET_S:.3f},{x:.3f},{y:.3f},{z:.3f}")
    (survey / "tag.csv").write_text("\n".join(positions) + "\n")
    model = read_model(survey / "out" / "sparse" / "0")
    longest = max(model.points3D, key=lambda point_id: model.point3D(point_id).track.length())
    write_marks(survey / "markers.csv", model, {"m": longest})
    length_m = float(np.linalg.norm(path_m[0] - path_m[-1]))
    (survey / "distances.csv").write_text(f"from,to,distance_m,stddev_m\n{names[0]},{names[-1]},{length_m},0.05\n")
    curve = "".join(f"{distance},0.02,0.01,0.03\n" for distance in (1.0, 4.0, 9.0, 20.0))
    (survey / "curve.csv").write_text(f"distance_m,error_m,stddev_m,noise_stddev_m\n{curve}")
    (survey / "plan.toml").write_text(PLAN)
    camera = {"model": "SIMPLE_RADIAL", "width": 360, "height": 240, "params": [280.8, 180, 120, -0.04]}
    (survey / "camera.json").write_text(json.dumps(camera))


def prepared(template: Path, folder: Path, rng: np.random.Generator) -> tuple[Probe, tuple[str, ...]]:
    """Return a hostile copy of the template, and the command to start there."""
    shutil.copytree(template, folder / "survey", symlinks=True)
    probe = Probe(folder / "survey", folder / "outside", rng)
    probe.outside.mkdir()
    (probe.outside / "file.txt").write_text("mine\n")
    probe.protect(probe.outside / "file.txt")
    for path in probe.folder.rglob("*"):  # all inputs
        if path.relative_to(probe.folder).parts[0] not in ("out", "out_2", PRIVATE_NAME) and path.is_file():
            probe.protect(path)
    number = int(rng.integers(len(COMMANDS)))
    kind = rng.choice(["file", "two files", "file", "key", "surroundings", "foreign files", "foreign files"])
    if kind == "key":
        number = MAPS[number % len(MAPS)]
        set_a_key(probe)
    command, names = COMMANDS[number]
    if kind == "surroundings":
        make_surroundings_odd(probe)
    if kind == "foreign files":
        put_foreign_files(probe)
        command = probe.choose(WRITING)
        if rng.random() < 0.1:
            limit_file_size(probe)
        probe.kill_after_s = rng.exponential(4.0) if rng.random() < 1 / 3 else None
    for _ in range({"file": 1, "two files": 2}.get(str(kind), 0)):
        damage_a_file(probe, names)
    return probe, (*command, *probe.flags)


def start(command: tuple[str, ...], probe: Probe) -> tuple[int | None, str, str]:
    """Run a command; return its exit status, its output, and its error output.

    The status is None if the command does not end, and that of SIGKILL if it was killed at the probe's moment.
    """

    def limit() -> None:
        resource.setrlimit(resource.RLIMIT_DATA, (MAX_BYTES, MAX_BYTES))
        for one in probe.limits:
            one()

    streams = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **probe.streams}
    process = subprocess.Popen(
        [Path(sys.executable).with_name("rangesfm"), *command],
        cwd=probe.folder,
        env={**os.environ, **probe.environment},
        text=True,
        errors="replace",
        preexec_fn=limit,
        **streams,
    )
    try:
        output, errors = process.communicate(timeout=probe.kill_after_s or MAX_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()
        return None if probe.kill_after_s is None else -signal.SIGKILL, "", ""
    return process.returncode, output or "", errors or ""


def what_is_wrong(status: int | None, output: str, errors: str, probe: Probe) -> str | None:
    """Say what is wrong with how a command ended, or None."""
    if status is None:
        return "does not end"
    if status not in STATUSES:
        return f"status {status}"
    if said := [words for words in OWN_WORDS if words in output + errors]:
        return f"says {said[0]!r}"
    num_errors = len(re.findall("^rangesfm: error: ", errors, re.MULTILINE))
    # What `check` finds wrong is its output, and may be several lines.
    num_errors += bool(re.search("^error: ", output, re.MULTILINE))
    if "stderr" not in probe.streams and num_errors != (status != 0):
        return f"{num_errors} lines of errors"
    changed = probe.changed()
    return f"changed {changed}" if changed else None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_probes", type=int, default=300, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="(default: 0)")
    parser.add_argument("--first", type=int, default=0, metavar="N", help="number of the first probe (default: 0)")
    parser.add_argument("--verbose", action="store_true", help="print a line for each probe")
    arguments = parser.parse_args()
    ended, num_wrong = Counter[str](), 0
    with tempfile.TemporaryDirectory() as name:
        make_template(Path(name) / "template")
        for number in range(arguments.first, arguments.first + arguments.num_probes):
            rng, folder = np.random.default_rng([arguments.seed, number]), Path(name) / "probe"
            probe, command = prepared(Path(name) / "template" / "survey", folder, rng)
            with probe.held:
                status, output, errors = start(command, probe)
                if status == -signal.SIGKILL:
                    ended[f"{command[0]} killed"] += 1
                    probe.kill_after_s, command = None, probe.choose(WRITING)
                    status, output, errors = start(command, probe)
                wrong = what_is_wrong(status, output, errors, probe)
            ended[f"{command[0]} {status}"] += 1
            num_wrong += wrong is not None
            if wrong is not None or arguments.verbose:
                lines = errors.strip().splitlines() or [""]
                words = f"{'; '.join(probe.said)}: {' '.join(command)[:60]}: status {status}: {lines[-1][:300]}"
                print(f"{number:3} {'WRONG ' + wrong if wrong else 'ok'}: {words}", flush=True)
            shutil.rmtree(folder)
    first, last = arguments.first, arguments.first + arguments.num_probes - 1
    print(f"probes {first} to {last}, {num_wrong} wrong; commands ended {dict(sorted(ended.items()))}")
    return 1 if num_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
