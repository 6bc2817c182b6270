"""Damaged COLMAP models: each must be refused, or be usable for everything that is done with models; prints a table.

    python -m tests.fuzz.model_files --num 10000 --output_path /tmp/fuzz_models

Each model is read and used in a child process, so that a crash is noticed and the campaign continues. Models that did
harm are kept in the output folder. ``--first N --num 1`` repeats model N.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import multiprocessing
import os
import random
import shutil
import sys
import tempfile
import traceback
import warnings
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path

import numpy as np
from tests.fuzz.model_bytes import parse, spoil
from tests.fuzz.mutation import mutated
from tests.peak_memory import peak_bytes

FILES = ("cameras.bin", "rigs.bin", "frames.bin", "images.bin", "points3D.bin")
TEXT_FILES = tuple(name.replace(".bin", ".txt") for name in FILES)
TIMEOUT_S = 60
_MEMORY_BYTES = 200 << 20
_WHOLE_COMMAND_EVERY = 20
_TEXT_EVERY = 8
UNDAMAGED = 0
_TAG_IN_CAM_M = (0.03, -0.12, -0.05)


def make_survey(folder: Path) -> None:
    """Write a model of ten photos along a loop, binary and as text, with ranges to four anchors."""
    from tests.simulated.model import synthetic_model
    from tests.simulated.path import loop_path

    from rangesfm.demo.simulated_radio import Radio, simulate_ranges
    from rangesfm.measurements.ranges.readers import write_ranges_csv

    anchors_m = {"A1": (-6.0, -5.0, 0.5), "A2": (6.0, -5.0, 2.5), "A3": (6.0, 5.0, 0.7), "A4": (-6.0, 5.0, 2.2)}
    path = loop_path(15.0, start_s=0.0, seed=3)
    times = np.linspace(0.5, 14.5, 10)
    made = synthetic_model(
        times, path.centers(times), path.world_from_cam(times), num_observations=15, pixel_stddev=0.5, seed=1
    )
    for name in ("binary", "text"):
        (folder / name).mkdir()
    made.reconstruction.write_binary(folder / "binary")
    made.reconstruction.write_text(folder / "text")
    radio = Radio(rate_hz=2.0, range_stddev_m=0.05)
    write_ranges_csv(simulate_ranges(path, anchors_m, _TAG_IN_CAM_M, radio, seed=5), folder / "uwb.csv")
    rows = [f"{name},{time!r}\n" for name, time in made.timestamps_s.items()]
    (folder / "images.csv").write_text("image_name,timestamp_s\n" + "".join(rows))
    rows = [f"{name},{x},{y},{z}\n" for name, (x, y, z) in anchors_m.items()]
    (folder / "anchors.csv").write_text("anchor_id,x_m,y_m,z_m\n" + "".join(rows))


def damage(survey: Path, number: int, model_path: Path) -> str:
    """Write the damaged model of that number, and return a description of the damage."""
    rng = random.Random(number)
    is_text = number % _TEXT_EVERY == 0
    shutil.rmtree(model_path, ignore_errors=True)
    shutil.copytree(survey / ("text" if is_text else "binary"), model_path)
    changes = []
    for _ in range(rng.choice((1, 1, 1, 2, 4))):
        path = model_path / rng.choice(TEXT_FILES if is_text else FILES)
        if not path.exists():
            continue
        data = path.read_bytes()
        if rng.random() < 0.02:
            path.unlink()
            changes.append(f"{path.name} is gone")
        elif is_text or rng.random() < 0.2:
            path.write_bytes(mutated(data, rng, 2 * len(data)))
            changes.append(f"{path.name}: bytes")
        else:
            changes.append(f"{path.name}: {_spoil_file(path, data, rng)}")
    return "; ".join(changes)


def _spoil_file(path: Path, data: bytes, rng: random.Random) -> str:
    try:
        file = parse(path.name, data)
        change = spoil(file, rng)
        path.write_bytes(file.pack())
    except Exception:  # an earlier change has left a file that does not parse
        return "left"
    return change


def use(survey: Path, number: int, model_path: Path) -> str:
    """Read and use a model; return "refused" or "accepted". Any other outcome raises an exception."""
    from rangesfm.colmap.model_files import read_model
    from rangesfm.errors import InputError

    try:
        model = read_model(model_path)
    except InputError as refusal:
        return "refused" if str(refusal).isprintable() else "refused in more than one line"
    _do_what_is_done_with_models(model, model_path)
    if number % _WHOLE_COMMAND_EVERY == 0:
        status = _refine(survey, model_path)
        assert number != UNDAMAGED or status == 0, status
    return "accepted"


def _do_what_is_done_with_models(model: object, model_path: Path) -> None:
    import pycolmap

    from rangesfm.colmap.transform import rescale
    from rangesfm.errors import RangesfmError
    from rangesfm.export.ply import write_points
    from rangesfm.options import CameraOptions, RefineOptions
    from rangesfm.solver.bundle_adjustment import bundle_adjustment, solve_bundle_adjustment
    from rangesfm.util.geometry.similarity import Similarity
    from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

    assert isinstance(model, pycolmap.Reconstruction)
    path = trajectory_from_reconstruction(model)
    assert np.all(np.isfinite(path.centers))
    assert np.allclose(np.linalg.det(path.world_from_cam), 1)
    metric = rescale(model, Similarity(2.0, np.eye(3), np.ones(3)))
    metric.update_point_3d_errors()
    for point in metric.points3D.values():
        assert np.all(np.isfinite(point.xyz))
    with tempfile.TemporaryDirectory() as folder:
        metric.write_binary(folder)
        write_points(metric, Path(folder) / "points.ply")
    with contextlib.suppress(RangesfmError):
        options = RefineOptions(max_num_iterations=2)
        problem = bundle_adjustment(metric, CameraOptions(), options, num_threads=1)
        solve_bundle_adjustment(problem, tolerance_m=1e-3)


def _refine(survey: Path, model_path: Path) -> int:
    """Return the exit status of the whole command, which must not be an internal error."""
    from rangesfm.cli import main as rangesfm

    files = ("--ranges", "uwb.csv", "--anchors", "anchors.csv", "--images", "images.csv", "--output_path", "out")
    flags = ("--tag_in_cam", ",".join(map(str, _TAG_IN_CAM_M)), "--ranges_time_offset", "0", "--quiet")
    os.chdir(survey)
    said = io.StringIO()
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        status = rangesfm(["refine", "--input_path", str(model_path), *files, *flags])
    assert status in (0, 2, 3, 4), said.getvalue()
    return status


def _serve(pipe: Connection, survey: Path, model_path: Path) -> None:
    """Use one model after the other. If this process dies, the parent knows which model it was working on."""
    warnings.simplefilter("error")
    os.environ["RANGESFM_DEBUG"] = "1"
    silent = os.open(os.devnull, os.O_WRONLY)  # silences COLMAP's own log
    os.dup2(silent, sys.stderr.fileno())
    while True:
        number = pipe.recv()
        before = peak_bytes()
        try:
            outcome, text = use(survey, number, model_path), ""
        except BaseException:
            outcome, text = "failed", traceback.format_exc()
        taken = peak_bytes() - before
        if taken > _MEMORY_BYTES and outcome != "failed":
            outcome, text = "failed", f"{taken >> 20} MB of memory"
        pipe.send((outcome, text))


class _Worker:
    """A child process that is started anew when it has died."""

    def __init__(self, survey: Path, model_path: Path):
        self._arguments = (survey, model_path)
        self._context = multiprocessing.get_context("spawn")
        self._start()

    def _start(self) -> None:
        self._pipe, end = self._context.Pipe()
        self._process = self._context.Process(target=_serve, args=(end, *self._arguments), daemon=True)
        self._process.start()
        end.close()

    def outcome(self, number: int) -> tuple[str, str]:
        """Return what became of one model, with the traceback of a failure.

        "crashed" and "hung" are outcomes of the process itself.
        """
        self._pipe.send(number)
        try:
            if self._pipe.poll(TIMEOUT_S):
                outcome, text = self._pipe.recv()
                return str(outcome), str(text)
            outcome = "hung"
        except (EOFError, ConnectionResetError):
            outcome = "crashed"
        self._process.kill()
        self._process.join()
        ended = f"the process ended with {self._process.exitcode}"
        self._start()
        return outcome, ended


def run(first: int, num: int, output_path: Path) -> Counter[str]:
    """Use ``num`` damaged models and count the outcomes; keep the models that did harm."""
    outcomes: Counter[str] = Counter()
    with tempfile.TemporaryDirectory(prefix="fuzz_models_") as temporary:
        survey, model_path = Path(temporary), Path(temporary) / "model"
        make_survey(survey)
        worker = _Worker(survey, model_path)
        shutil.copytree(survey / "binary", model_path)
        assert worker.outcome(UNDAMAGED) == ("accepted", "")
        for number in range(first, first + num):
            change = damage(survey, number, model_path)
            outcome, text = worker.outcome(number)
            outcomes[outcome] += 1
            if outcome not in ("refused", "accepted"):
                print(f"{number}: {outcome}: {change}\n{text[-1500:]}", file=sys.stderr, flush=True)
                shutil.copytree(model_path, output_path / str(number), dirs_exist_ok=True)
    return outcomes


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--num", type=int, default=500)
    parser.add_argument("--first", type=int, default=1, help="number of the first one; it is also its seed")
    parser.add_argument("--output_path", type=Path, required=True)
    args = parser.parse_args()
    args.output_path.mkdir(parents=True, exist_ok=True)
    outcomes = run(args.first, args.num, args.output_path)
    print("| models | accepted | refused | crashed | hung | failed |")
    print("|---|---|---|---|---|---|")
    cells = [outcomes[key] for key in ("accepted", "refused", "crashed", "hung", "failed")]
    print("|", " | ".join(map(str, [args.num, *cells])), "|")


if __name__ == "__main__":
    main()
