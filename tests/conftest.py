"""Fixtures that the tests of whole commands share: the command itself, and a survey without photos."""

from __future__ import annotations

import fcntl
import io
import json
import os

# The command line sets this too. numpy reads it when it is imported.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import hypothesis
import numpy as np
import numpy.typing as npt
import pytest
from tests.simulated.files import write_anchors, write_model
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, loop_path
from tests.simulated.small_demo import make_small_demo

from rangesfm.cli import main
from rangesfm.demo.simulated_radio import Radio, simulate_ranges
from rangesfm.demo.survey import TIME_OFFSET_S as DEMO_TIME_OFFSET_S
from rangesfm.demo.survey import DemoSurvey
from rangesfm.measurements.ranges.readers import write_ranges_csv
from rangesfm.survey.settings import Survey
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import Reference, write_reference
from rangesfm.util.geometry.similarity import Similarity

Array = npt.NDArray[np.float64]
Command = Callable[..., "subprocess.CompletedProcess[str]"]

TAG_IN_CAM_M = (0.03, -0.12, -0.05)
TIME_OFFSET_S = 2.0
SITE_M = (1012.0, 5003.0, 413.0)
"""Where the walk is in its site. As in a real one, it is not around zero: a text in any other frame would be wrong."""
_AROUND_WALK_M = {"A1": (-6.0, -5.0, 0.5), "A2": (6.0, -5.0, 2.5), "A3": (6.0, 5.0, 0.7), "A4": (-6.0, 5.0, 2.2)}
ANCHORS_M = {name: (SITE_M[0] + x, SITE_M[1] + y, SITE_M[2] + z) for name, (x, y, z) in _AROUND_WALK_M.items()}


# On a busy machine any example, and drawing it, may take longer than hypothesis allows. All runs draw the same
# examples, so that a change is not blamed for what another draw finds; ``tests/fuzz`` draws others.
hypothesis.settings.register_profile(
    "tests",
    deadline=None,
    derandomize=True,
    suppress_health_check=[hypothesis.HealthCheck.too_slow, hypothesis.HealthCheck.function_scoped_fixture],
)
hypothesis.settings.load_profile("tests")

# Background jobs of a shell ignore Ctrl-C, and the commands that tests start from there would ignore it too.
signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_report_header() -> str:
    return f"BLAS kernels: {', '.join(blas_kernels())}"


def blas_kernels() -> list[str]:
    """Return the names of the BLAS kernels in use, chosen by the processor or by OPENBLAS_CORETYPE.

    numpy and scipy each have their own.
    """
    import scipy.linalg  # noqa: F401 (loads scipy's)
    from threadpoolctl import threadpool_info

    return [str(library.get("architecture")) for library in threadpool_info() if library["user_api"] == "blas"]


# Test files that take seven seconds or more, the longest first, by the sums of ``pytest --durations=0``, and then those
# of which the slow tests take 15 seconds or more.
LONG_FILES = """
    test_cpp_part test_inertial_sensor test_commands test_surroundings test_initialize test_report_page
    test_same_everywhere test_view test_inertial_scale test_alignment test_poses_alone test_same_results
    test_planned_sensor test_bad_input test_imu test_run test_with_ranges test_reconstruct test_pages test_time_offset
    test_trilateration test_survey_plan test_positions_alone test_external_mapping test_loose_pieces test_join_models
    test_drifting_maps test_mistakes test_close_loops test_site_anchors test_measure test_rigs test_scale_verdict
    test_learned test_anchor_sides test_main test_uncertainty test_broken_refinement test_kernels test_kills test_batch
    test_numbers test_workflows
"""
# Tests that take seconds and are left out unless they are asked for: see the head of ``slow_tests.txt``.
SLOW_TESTS = Path(__file__).parent / "slow_tests.txt"


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark the slow tests, and start the longest files first; otherwise one of two processes would end alone.

    Raises:
        pytest.UsageError: a test that the list of slow tests names is not there.
    """
    slow = {line for line in SLOW_TESTS.read_text(encoding="utf-8").splitlines() if line.startswith("tests/")}
    for item in items:
        if item.nodeid in slow:
            item.add_marker("slow")
    if not any("::" in argument for argument in config.args):
        files = {item.nodeid.split("::")[0] for item in items}
        missing = {name for name in slow if name.split("::")[0] in files} - {item.nodeid for item in items}
        if missing:
            raise pytest.UsageError(f"{SLOW_TESTS.name} names tests that are not there: {', '.join(sorted(missing))}")
    place = {name: number for number, name in enumerate(LONG_FILES.split())}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


@dataclass(frozen=True)
class WalkedSurvey:
    """An unscaled model, a radio log and the truth, in one folder.

    The folder holds the model ``sparse/0``, ``images.csv``, ``uwb.csv``, ``anchors.csv`` (site frame, exact),
    ``anchors_first_camera.csv`` and ``reference.csv`` (site frame).

    Attributes:
        folder: the folder that holds these files.
        site_from_sfm: the true similarity.
        centers_m: (n, 3) true centres in the site frame, by photo in time order.
        image_names: n names.
        flags: arguments with which a command, run inside the folder, reads everything but the anchors.
    """

    folder: Path
    site_from_sfm: Similarity
    centers_m: Array
    image_names: tuple[str, ...]

    @property
    def flags(self) -> tuple[str, ...]:
        tag = ",".join(map(str, TAG_IN_CAM_M))
        files = ("--input_path", "sparse/0", "--ranges", "uwb.csv", "--images", "images.csv")
        return (*files, "--tag_in_cam", tag, "--ranges_time_offset", str(TIME_OFFSET_S))

    def survey(self, output_path: Path) -> Survey:
        """Return the same as a survey, with the anchors in the site's frame."""
        files = {"images.model": "sparse/0", "images.times": "images.csv", "ranges.path": "uwb.csv"}
        files["anchors.path"] = "anchors.csv"
        numbers = {"ranges.time_offset": TIME_OFFSET_S, "tag.tag_in_cam_m": TAG_IN_CAM_M}
        paths = {key: self.folder / name for key, name in files.items()}
        return Survey().changed({**paths, **numbers, "output.path": output_path})


@pytest.fixture(scope="session")
def rangesfm_process() -> Command:
    """Return a function that runs ``rangesfm`` in a folder as a process of its own."""

    def run(*arguments: str | Path, cwd: Path, status: int | None = 0) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "rangesfm", *map(str, arguments)]
        return _checked(subprocess.run(command, cwd=cwd, capture_output=True, text=True, check=False), status)

    return run


@pytest.fixture(scope="session")
def rangesfm_command() -> Command:
    """Return a function that runs ``rangesfm`` in this process.

    This saves the imports, which take half of a command's time.
    """

    def run(*arguments: str | Path, cwd: Path, status: int | None = 0) -> subprocess.CompletedProcess[str]:
        with pytest.MonkeyPatch.context() as patch, redirect_stdout(io.StringIO()) as out:
            patch.chdir(cwd)
            with redirect_stderr(io.StringIO()) as err:
                ended = main([str(argument) for argument in arguments])
        return _checked(subprocess.CompletedProcess(arguments, ended, out.getvalue(), err.getvalue()), status)

    return run


def _checked(done: subprocess.CompletedProcess[str], status: int | None) -> subprocess.CompletedProcess[str]:
    assert status in (None, done.returncode), f"exit status {done.returncode}\n{done.stdout}{done.stderr}"
    return done


@pytest.fixture(scope="session")
def walked_survey(tmp_path_factory: pytest.TempPathFactory) -> WalkedSurvey:
    """A walk of 40 photos and of 42 ranges to each of four anchors, one a second. Tests must not write to it."""
    return make_walked_survey(tmp_path_factory.mktemp("walked_survey"))


def make_walked_survey(folder: Path, *, rate_hz: float = 1.0) -> WalkedSurvey:
    """Write the files of a ``WalkedSurvey`` into a folder, with so many ranges a second to each anchor."""
    path = loop_path(42.0, start_s=99.0, seed=3)
    times: Array = np.arange(100, 140, dtype=np.float64)
    made = synthetic_model(
        *along(path, times),
        num_observations=60,
        max_track_length=8,
        pixel_stddev=0.5,
        seed=1,
    )
    radio = Radio(rate_hz=rate_hz, range_stddev_m=0.05, time_offset_s=TIME_OFFSET_S)
    write_model(made.reconstruction, folder / "sparse" / "0", made.timestamps_s, folder / "images.csv")
    write_ranges_csv(simulate_ranges(path, _AROUND_WALK_M, TAG_IN_CAM_M, radio, seed=5), folder / "uwb.csv")
    write_anchors(folder / "anchors.csv", ANCHORS_M)
    in_first_camera = (np.array(list(_AROUND_WALK_M.values())) - made.centers_m[0]) @ made.world_from_cam[0]
    write_anchors(folder / "anchors_first_camera.csv", dict(zip(ANCHORS_M, in_first_camera, strict=True)))
    names, centers_m = tuple(made.timestamps_s), made.centers_m + SITE_M
    write_reference(Reference(centers_m, ByPhoto(names)), folder / "reference.csv")
    site_from_sfm = Similarity(1.0, np.eye(3), np.array(SITE_M)) @ made.metric_from_sfm
    return WalkedSurvey(folder, site_from_sfm, centers_m, names)


@pytest.fixture(scope="session")
def dense_survey(tmp_path_factory: pytest.TempPathFactory) -> WalkedSurvey:
    """The same walk with five times as many ranges, for tests of how right results are. Tests must not write to it."""
    return make_walked_survey(tmp_path_factory.mktemp("dense_survey"), rate_hz=5.0)


@pytest.fixture
def own_survey(walked_survey: WalkedSurvey, tmp_path: Path) -> WalkedSurvey:
    """A copy of ``walked_survey`` that a test may spoil."""
    folder = shutil.copytree(walked_survey.folder, tmp_path / "survey")
    return WalkedSurvey(folder, walked_survey.site_from_sfm, walked_survey.centers_m, walked_survey.image_names)


@dataclass(frozen=True)
class PhotoRun:
    """A small survey with photographs, and the first run on it.

    Attributes:
        survey: the command ran in its folder.
        flags: those of that command, except the output path.
        output_path: the output folder of the run.
        stdout, stderr: what the command printed.
    """

    survey: DemoSurvey
    flags: tuple[str, ...]
    output_path: Path
    stdout: str
    stderr: str


@pytest.fixture(scope="session")
def photo_run(rangesfm_process: Command, tmp_path_factory: pytest.TempPathFactory) -> PhotoRun:
    """A run on 14 small photos of the demo's yard. Tests must not write to it."""
    flags = ("survey.toml", "--ranges_time_offset", str(DEMO_TIME_OFFSET_S), "--reproducible")
    with _shared_folder(tmp_path_factory, "photo_run") as folder:
        survey = make_small_demo(folder / "yard")
        printed = folder / "printed.json"
        if not printed.exists():
            done = rangesfm_process("run", *flags, cwd=survey.folder)
            printed.write_text(json.dumps([done.stdout, done.stderr]))
        stdout, stderr = json.loads(printed.read_text())
    return PhotoRun(survey, flags, survey.folder / "out", stdout, stderr)


@contextmanager
def _shared_folder(factory: pytest.TempPathFactory, name: str) -> Iterator[Path]:
    """Lock and yield a folder that all processes of one test run share."""
    base = factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / name
    folder.mkdir(exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the system releases the lock, however the block ends
        yield folder
