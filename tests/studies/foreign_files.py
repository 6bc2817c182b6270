"""Put files of other owners at a command's inputs and outputs, in five hundred random runs.

    python -m tests.studies.foreign_files [--num_runs 500] [--seed 0]

Each run takes a copy of a small photo survey that has been run once. It puts files that rangesfm did not write at
random among the inputs and outputs: under every name that the tool uses, in place of files that it wrote, inside
folders that it wrote, as links, and as further links to files that it wrote. Then it starts a random command there. A
third of the commands are killed at a random moment, and another command follows. A tenth may write no file beyond a
random size, as on a full disk. A tenth find the result of a version that kept no record of what it wrote.

Afterwards every such file, every input and everything that a link leads to must be unchanged, byte by byte, and every
command must end with an exit status of the contract. Prints a line for each run that went wrong, and how the commands
ended. Exit status 1 if anything went wrong.
"""

from __future__ import annotations

import argparse
import os
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from tests.simulated.small_demo import make_small_demo

from rangesfm.demo.survey import TIME_OFFSET_S
from rangesfm.export import EXPORTED_NAMES
from rangesfm.result.result_folder import PHOTOS_NAMES, RESULT_NAMES
from rangesfm.sfm.steps import RECONSTRUCTION_NAMES
from rangesfm.util.files.output_folder import PRIVATE_NAME

STATUSES = (0, 2, 3, 4, -signal.SIGKILL)
FORMATS = ("colmap", "colmap_text", "undistorted", "tum", "ply", "opf", "transform", "nerfstudio", "opensfm")
RUN = ("run", "survey.toml", "--ranges_time_offset", str(TIME_OFFSET_S), "--num_threads", "1")
MODEL_FLAGS = ("--ranges", "uwb.csv", "--anchors", "anchors.csv", "--tag_in_cam", "0.03,-0.12,-0.05")
COMMANDS: tuple[tuple[str, ...], ...] = (
    RUN,
    (*RUN, "--camera_params", "281,180,120,-0.04"),
    (*RUN, "--restart", "--formats", "tum,ply,colmap"),
    (*RUN, "--output_path", "."),
    (*RUN, "--check_share", "0.1"),
    ("reconstruct", "--images", "images", "--output_path", "out", "--num_threads", "1"),
    ("reconstruct", "--images", "project/images", "--output_path", "project", "--num_threads", "1"),
    ("scale", "--input_path", "out/sparse/0", *MODEL_FLAGS, "--output_path", "out"),
    ("scale", "--input_path", "out/sparse_metric", *MODEL_FLAGS, "--output_path", "out"),
    ("refine", "--input_path", "out/sparse/0", *MODEL_FLAGS, "--images", "out/images.csv", "--output_path", "other"),
    ("refine", "--input_path", "out/sparse/0", *MODEL_FLAGS, "--images", "out/images.csv", "--output_path", "out"),
    ("export", "out", "--formats", ",".join(FORMATS)),
    ("export", "out", "--formats", ",".join(FORMATS), "--output_path", "exported"),
    ("export", "out", "--apply_to", "out/points.ply", "out/sparse/0"),
    ("report", "out"),
    ("report", "out", "--png"),
    ("compare", "out", "out/sparse_scaled/0", "--output_path", "comparison"),
    ("compare", "out", "out/sparse_scaled/0", "--output_path", "out"),
    ("plan", "--from", "out", "--output_path", "plan"),
    ("plan", "--from", "out", "--output_path", "out"),
    ("ranges", "uwb.csv", "--output_path", "uwb.csv"),
    ("ranges", "uwb.csv", "--output_path", "ranges.csv", "--plot", "ranges.png"),
    ("ranges", "uwb.csv", "--output_path", "out/ranges.csv"),
    ("init", "."),
    ("init", ".", "--output_path", "out"),
    ("demo", "."),
    ("join", "out", "out_2", "--output_path", "out"),
    ("join", "out", "out_2", "--output_path", "out_2/sparse"),
)
NAMES = (
    *RESULT_NAMES,
    *RECONSTRUCTION_NAMES,
    *PHOTOS_NAMES,
    *(name for names in EXPORTED_NAMES.values() for name in names),
    *("comparison.html", "plan.json", "plan.html", "figures", "applied", "batch.csv", "survey.toml"),
    *("database.db-wal", "database.db-shm", "mapping_snapshot", "given_database", "matching", "rigs"),
    *(".bashrc.20240101.old", ".mozilla.20210101.old", ".ranges.123.part.csv", ".result.unfinished", ".rangesfm.lock"),
)
FOLDERS = ("", "out", "out/sparse/0", "out/sparse_metric/0", "out/sparse_scaled", "out/colmap", "out/undistorted/dense")
OUTPUTS = ("out", "other", "exported", "project", "comparison", "plan")


@dataclass
class Site:
    """A survey with its results, and files that are not the tool's.

    Attributes:
        folder: where commands run.
        outside: a folder that links lead to.
        foreign: each path that must not change, with its content.
    """

    folder: Path
    outside: Path
    rng: np.random.Generator
    foreign: dict[Path, bytes | str] = field(default_factory=dict)

    def protect(self, path: Path) -> None:
        if path.is_symlink() or path.is_file():
            self.foreign[path] = content_of(path)

    def own_files(self) -> list[Path]:
        """List the files that the earlier run left, without the tool's hidden records."""
        files = [path for path in (self.folder / "out").rglob("*") if path.is_file() and not path.is_symlink()]
        return sorted(path for path in files if PRIVATE_NAME not in path.parts and path not in self.foreign)

    def place_somewhere(self) -> None:
        """Put a file, a folder that holds one, or a link under a name that the tool uses."""
        parent = self.folder / str(self.rng.choice([*FOLDERS, *OUTPUTS]))
        path = parent / str(self.rng.choice(NAMES))
        if any(other.is_symlink() or other.is_file() for other in (parent, *parent.parents)):
            return
        if os.path.lexists(path):
            if path.is_dir() and not path.is_symlink():
                path /= "mine.txt"
            if os.path.lexists(path):
                return
        path.parent.mkdir(parents=True, exist_ok=True)
        kind = self.rng.choice(["file", "folder", "link", "dead link", "hard link"])
        if kind == "folder":
            path.mkdir()
            path /= "mine.txt"
        if kind in ("file", "folder"):
            path.write_bytes(self.rng.bytes(100))
        elif kind == "hard link":
            os.link(self.outside / "file.txt", path)
        else:
            path.symlink_to(self.outside / ("nothing" if kind == "dead link" else "file.txt"))
        self.protect(path)

    def change_an_own_file(self) -> None:
        """Turn one of the tool's files into a foreign one, by changing or replacing its content, or by a link."""
        if not (own := self.own_files()):
            return
        path = own[self.rng.integers(len(own))]
        kind = self.rng.choice(["same file", "new file", "appended", "same size", "link"])
        data = path.read_bytes()
        # otherwise the content under its other name would change as well
        if kind in ("new file", "link") or path.stat().st_nlink > 1:
            path.unlink()
        if kind == "link":
            path.symlink_to(self.outside / "file.txt")
        elif kind == "appended":
            path.write_bytes(data + b"\n# mine\n")
        else:
            path.write_bytes(self.rng.bytes(max(1, len(data) if kind == "same size" else 100)))
        self.protect(path)

    def link_an_own_file(self) -> None:
        """Give a file of the tool's another name outside, as backups by hard links do."""
        if own := self.own_files():
            path = own[self.rng.integers(len(own))]
            backup = self.outside / f"backup_{len(self.foreign)}"
            os.link(path, backup)
            self.protect(backup)

    def move_a_folder_away(self) -> None:
        """Move a folder of results to another place, and leave a link."""
        folders = [path for path in (self.folder / "out").iterdir() if path.is_dir() and path.name != PRIVATE_NAME]
        if folders := sorted(path for path in folders if not path.is_symlink()):
            path = folders[self.rng.integers(len(folders))]
            moved = self.outside / f"moved_{path.name}"
            if not moved.exists():
                shutil.move(path, moved)
                self.foreign = {_moved(other, path, moved): what for other, what in self.foreign.items()}
                path.symlink_to(moved)
                self.protect(path)
                for file in moved.rglob("*"):
                    self.protect(file)

    def forget_the_record(self) -> None:
        """Turn the results into those of a version that kept no record, so that all of them count as foreign."""
        shutil.rmtree(self.folder / "out" / PRIVATE_NAME)
        for path in (self.folder / "out").rglob("*"):
            self.protect(path)

    def lost(self) -> list[str]:
        """List the paths that have changed."""
        return [str(path) for path, before in self.foreign.items() if content_of(path) != before]


def _moved(path: Path, source: Path, target: Path) -> Path:
    return target / path.relative_to(source) if path.is_relative_to(source) else path


def content_of(path: Path) -> bytes | str:
    """Return the target of a link, the bytes of a file, or the word "gone"."""
    if path.is_symlink():
        return os.readlink(path)
    return path.read_bytes() if path.is_file() else "gone"


def make_template(folder: Path) -> None:
    """Make a survey that was run, a second result of it, exports, and a project in COLMAP's own layout."""
    survey = make_small_demo(folder / "survey", num_photos=10).folder
    for command in (RUN, ("export", "out", "--formats", ",".join(FORMATS)), ("report", "out")):
        words = [sys.executable, "-m", "rangesfm", *command]
        done = subprocess.run(words, cwd=survey, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(done.stderr)
    shutil.copytree(survey / "out", survey / "out_2")
    shutil.copytree(survey / "images", survey / "project" / "images")
    shutil.copytree(survey / "out" / "sparse", survey / "project" / "sparse")
    shutil.copyfile(survey / "out" / "database.db", survey / "project" / "database.db")


def make_site(template: Path, folder: Path, rng: np.random.Generator) -> Site:
    """Copy the template, and put foreign files into it."""
    shutil.copytree(template, folder / "survey", symlinks=True)
    site = Site(folder / "survey", folder / "outside", rng)
    site.outside.mkdir()
    (site.outside / "file.txt").write_text("mine\n")
    site.protect(site.outside / "file.txt")
    for path in site.folder.rglob("*"):  # all inputs
        if path.relative_to(site.folder).parts[0] not in ("out", "out_2", PRIVATE_NAME):
            site.protect(path)
    changes: list[Callable[[], None]] = [site.place_somewhere] * int(rng.integers(1, 12))
    if rng.random() < 0.5:
        changes += [site.change_an_own_file] * int(rng.integers(1, 4))
    changes += [site.link_an_own_file] * int(rng.integers(0, 4))
    if rng.random() < 0.1:
        changes.append(site.move_a_folder_away)
    for k in rng.permutation(len(changes)):
        changes[k]()
    if rng.random() < 0.1 and (site.folder / "out" / PRIVATE_NAME).is_dir():
        site.forget_the_record()
    return site


def start(command: tuple[str, ...], site: Site) -> tuple[int, str]:
    """Run a command, in some cases with limited file size or until it is killed; return exit status and messages."""
    rng = site.rng
    max_bytes = int(10 ** rng.uniform(2, 6.5)) if rng.random() < 0.1 else resource.RLIM_INFINITY
    after_s = rng.exponential(4.0) if rng.random() < 1 / 3 else None

    def limit() -> None:
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (max_bytes, max_bytes))

    process = subprocess.Popen(
        [sys.executable, "-m", "rangesfm", *command],
        cwd=site.folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        preexec_fn=limit,
    )
    try:
        _, errors = process.communicate(timeout=after_s)
    except subprocess.TimeoutExpired:
        process.kill()
        _, errors = process.communicate()
    return process.returncode, errors


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num_runs", type=int, default=500, metavar="N")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="(default: 0)")
    arguments = parser.parse_args()
    ended, num_wrong = Counter[str](), 0
    with tempfile.TemporaryDirectory() as name:
        make_template(Path(name) / "template")
        for number in range(arguments.num_runs):
            rng, folder = np.random.default_rng([arguments.seed, number]), Path(name) / "run"
            site = make_site(Path(name) / "template" / "survey", folder, rng)
            said = []
            for _ in range(2):
                command = COMMANDS[rng.integers(len(COMMANDS))]
                status, errors = start(command, site)
                ended[f"{command[0]} {status}"] += 1
                said.append(f"{' '.join(command)}: status {status}: {errors.strip().splitlines()[-1:]}")
                if status not in STATUSES or "Traceback" in errors:
                    num_wrong += 1
                    print(f"{number:3} ended wrongly: {said[-1]}", flush=True)
                if status != -signal.SIGKILL:
                    break
            if lost := site.lost():
                num_wrong += 1
                print(f"{number:3} LOST {lost} by {said}", flush=True)
            shutil.rmtree(folder)
    print(f"{arguments.num_runs} runs, {num_wrong} wrong; commands ended {dict(sorted(ended.items()))}")
    return 1 if num_wrong else 0


if __name__ == "__main__":
    sys.exit(main())
