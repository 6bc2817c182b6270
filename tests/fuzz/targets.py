"""Targets of the fuzzing: the readers of all files that a user brings, and checks of whatever they accept."""

from __future__ import annotations

import contextlib
import random
import tempfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from tests.fuzz.model_bytes import PARSED, spoilt
from tests.fuzz.mutation import mutated

from rangesfm.colmap.model_files import read_model
from rangesfm.colmap.transform import rescale
from rangesfm.errors import GeometryError, InputError, RangesfmError
from rangesfm.export.apply import apply_to
from rangesfm.export.ply import write_points
from rangesfm.measurements.lengths.tape import Tape
from rangesfm.measurements.lengths.tape_file import read_markers, read_tape
from rangesfm.measurements.ranges.anchors.anchor import Anchor
from rangesfm.measurements.ranges.anchors.anchor_file import read_anchors
from rangesfm.measurements.ranges.errors.error_curve import ErrorCurve, read_error_curve
from rangesfm.measurements.ranges.range_log import RangeLog
from rangesfm.measurements.ranges.range_summary import summarize_ranges
from rangesfm.measurements.ranges.readers import read_anchors_in_log, read_ranges, write_ranges_csv
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.result.result_folder import ResultFolder, read_result_folder
from rangesfm.result.summary import ResultSummary
from rangesfm.sfm.image_times import ImageTimes, read_image_times_csv
from rangesfm.solver.bundle_adjustment import bundle_adjustment, solve_bundle_adjustment
from rangesfm.survey.settings import Survey
from rangesfm.survey.survey_reader import read_survey
from rangesfm.util.geometry.moments import ByPhoto
from rangesfm.util.geometry.reference import Reference, read_reference
from rangesfm.util.geometry.similarity import Similarity
from rangesfm.util.geometry.trajectory import trajectory_from_reconstruction

CORPUS = Path(__file__).parent / "corpus"
_WHOLE_CHECK_EVERY = 8  # only some inputs, chosen by a checksum, because this check takes the longest
REFUSALS = (InputError, GeometryError)


class SilentAcceptanceError(Exception):
    """A reader accepted what it should have refused, or returned something that its type does not allow."""


@dataclass(frozen=True)
class Target:
    """A reader to fuzz.

    Attributes:
        name: of the target, and of its folder of seeds.
        file_name: the name of the file to read; its ending may matter.
        read: reads the file, or refuses it with one of REFUSALS.
        check: raises SilentAcceptanceError for what should not have been accepted.
        companions: further files beside it, which stay as they are: their names, and their paths in the corpus.
        mutate: returns damaged content, no longer than a number of bytes.
    """

    name: str
    file_name: str
    read: Callable[[Path], Any]
    check: Callable[[Any], None]
    companions: tuple[tuple[str, str], ...] = ()
    mutate: Callable[[bytes, random.Random, int], bytes] = mutated

    def seeds(self) -> list[Path]:
        return sorted((CORPUS / self.name).iterdir())

    def run(self, data: bytes, folder: Path) -> bool:
        """Return whether the file is accepted; any other exception is a finding."""
        path = folder / self.file_name
        path.write_bytes(data)
        for name, seed in self.companions:
            (folder / name).write_bytes((CORPUS / seed).read_bytes())
        try:
            found = self.read(path)
        except REFUSALS as refusal:
            _expect("\n" not in str(refusal) and str(refusal).isprintable(), f"a message of one line: {refusal!r}")
            return False
        self.check(found)
        return True


def _expect(holds: object, what: str) -> None:
    if not holds:
        raise SilentAcceptanceError(what)


def _check_log(log: RangeLog) -> None:
    """Check what the type of a log promises; some logs are also summed up, written and read again without loss."""
    _expect(len(log) > 0, "a log without ranges")
    _expect(np.all(np.isfinite(log.range_m)) and np.all(log.range_m > 0), "ranges that are finite and positive")
    _expect(isinstance(log.moments, ByPhoto) or np.all(np.isfinite(log.timestamp_s)), "times that are finite")
    _expect(not np.any(log.range_stddev_m <= 0), "stddevs that are positive or unknown")
    _expect(not np.any(np.isinf(log.range_stddev_m)), "stddevs that are finite or unknown")
    _expect(all(name == name.strip() and name for name in (*log.anchor_ids, *log.tag_ids)), "ids that are some text")
    if zlib.crc32(log.range_m.tobytes()) % _WHOLE_CHECK_EVERY:
        return
    summarize_ranges(log)
    with tempfile.TemporaryDirectory() as folder:
        write_ranges_csv(log, Path(folder) / "ranges.csv")
        again = read_ranges(Path(folder) / "ranges.csv", format="canonical")
    _expect(np.array_equal(again.range_m, log.range_m), "a log that is read as it was written")
    _expect(again.end_ids()[1] == log.end_ids()[1], "ids that are read as they were written")


def _check_anchors(anchors: tuple[Anchor, ...]) -> None:
    ids = [anchor.anchor_id for anchor in anchors]
    _expect(len(set(ids)) == len(ids), "each anchor once")
    for anchor in anchors:
        _expect(anchor.position_m is None or np.all(np.isfinite(anchor.position_m)), "positions that are finite")
        _expect(0 <= anchor.position_stddev_m < np.inf, "a stddev")


def _check_times(times: ImageTimes) -> None:
    _expect(len(times) > 0, "a time")
    _expect(np.all(np.isfinite(times.timestamps_s)), "times that are finite")
    _expect(np.all(np.diff(times.timestamps_s) > 0), "times in order")


def _check_reference(reference: Reference) -> None:
    _expect(len(reference) > 0, "a pose")
    _expect(np.all(np.isfinite(reference.positions_m)), "positions that are finite")
    rotations = reference.world_from_cam
    _expect(rotations is None or np.allclose(np.linalg.det(rotations), 1), "rotations")


def _check_tape(tape: Tape) -> None:
    for taped in tape.distances:
        _expect(0 < taped.distance_m < np.inf, "distances that are finite and positive")
        _expect(0 < taped.stddev_m < np.inf, "stddevs that are finite and positive")
    for marker in tape.markers.values():
        _expect(np.all(np.isfinite(marker.pixels)), "pixels that are finite")


def _check_curve(curve: ErrorCurve) -> None:
    distance, stddev = curve.true_distance(np.array([1e-3, 1.0, 50.0]))
    _expect(np.all(distance > 0) and np.all(np.isfinite(distance)), "distances that are finite and positive")
    _expect(np.all(stddev >= 0) and np.all(np.isfinite(stddev)), "stddevs that are finite")


def _check_survey(survey: Survey) -> None:
    _expect(survey.output.path.is_absolute(), "an absolute path")
    _expect(isinstance(survey.to_dict(), dict), "plain values")


def _read_whole_result(path: Path) -> ResultFolder:
    """Read everything that pages and exports ask for."""
    result = read_result_folder(path.parent)
    summary = result.summary
    summary.metric_from_sfm.similarity, summary.scale.relative_stddev_empirical, summary.scale.in_words  # noqa: B018
    result.anchor_positions_m, result.images_path, result.lever_arms_m(["T1"])
    _expect(summary.georeference is None or summary.georeference.georeference.crs, "a coordinate system")
    _expect(list(summary.lines(path.parent)), "lines for people")
    summary.write(path.with_name("again.json"))
    _expect(ResultSummary.read(path.with_name("again.json")) == summary, "a result that is read as it was written")
    return result


def _carry(path: Path) -> Path:
    """Transform a file to another world and back, so that what is written is read again."""
    similarity = Similarity(2.0, np.eye(3), np.array([1.0, 2.0, 3.0]))
    with tempfile.TemporaryDirectory() as folder:
        (written,) = apply_to({path: similarity}, Path(folder))
        with tempfile.TemporaryDirectory() as other_folder:
            apply_to({written: similarity.inverse()}, Path(other_folder))
    return path


def _accept_all(found: object) -> None:
    pass


def _use_model(model: pycolmap.Reconstruction) -> None:
    """Do what is done with models."""
    path = trajectory_from_reconstruction(model)
    _expect(np.all(np.isfinite(path.centers)), "centres that are finite")
    _expect(np.allclose(np.linalg.det(path.world_from_cam), 1), "rotations")
    metric = rescale(model, Similarity(2.0, np.eye(3), np.ones(3)))
    metric.update_point_3d_errors()
    _expect(all(np.all(np.isfinite(point.xyz)) for point in metric.points3D.values()), "points that are finite")
    with tempfile.TemporaryDirectory() as folder:
        metric.write_binary(folder)
        write_points(metric, Path(folder) / "points.ply")
    with contextlib.suppress(RangesfmError):
        problem = bundle_adjustment(metric, CameraOptions(), RefineOptions(max_num_iterations=2), num_threads=1)
        solve_bundle_adjustment(problem, tolerance_m=1e-3)


def _model_target(file_name: str) -> Target:
    """Return the target of one file of a COLMAP model, binary or text, with the others beside it."""
    files = [f"{Path(name).stem}{Path(file_name).suffix}" for name in PARSED]
    others = tuple((name, f"model_{name}/{name}") for name in files if name != file_name)
    mutate = partial(spoilt, file_name) if file_name in PARSED else mutated
    return Target(f"model_{file_name}", file_name, lambda path: read_model(path.parent), _use_model, others, mutate)


def _log_target(format: str, **options: Any) -> Target:
    return Target(format, "uwb.log", partial(read_ranges, format=format, **options), _check_log)


def _read_any_log(path: Path) -> RangeLog:
    read_anchors_in_log(path)
    return read_ranges(path)


def _read_bag_folder(path: Path) -> RangeLog:
    return read_ranges(path.parent)


_COLUMNS = {"timestamp": "t", "anchor_id": "node", "range": "d", "tag_id": "tag", "range_stddev": "s", "los": "los"}
_UNITS = {"range_unit": "mm", "timestamp_unit": "us"}
_STAMPED = {"timestamp": "t", "anchor_id": "node"}
_LOG_FORMATS = (
    *("canonical", "starloc", "miluv", "uwb_init", "inrol", "leaps_meas", "leaps_lea", "dwm1001_lec", "dwm1001_les"),
    *("qorvo", "mauwb", "arduino", "makerfabs_json", "table", "librsf", "pyfg"),
)

TARGETS: tuple[Target, ...] = (
    Target("any_log", "uwb.log", _read_any_log, _check_log),
    *(_log_target(format) for format in _LOG_FORMATS),
    Target("ros1", "uwb.bag", _read_any_log, _check_log),
    Target("ros2_mcap", "log.mcap", _read_bag_folder, _check_log, (("metadata.yaml", "ros2_metadata/metadata.yaml"),)),
    Target("ros2_metadata", "metadata.yaml", _read_bag_folder, _check_log, (("log.mcap", "ros2_mcap/log.mcap"),)),
    Target(
        "mapped", "uwb.csv", partial(read_ranges, columns=_COLUMNS, range_unit="mm", timestamp_unit="us"), _check_log
    ),
    Target("mapped_iso", "uwb.csv", partial(read_ranges, columns=_COLUMNS, timestamp_unit="iso"), _check_log),
    Target("mapped_stamps", "uwb.csv", partial(read_ranges, columns=_STAMPED), _check_log),
    Target("anchors", "anchors.csv", read_anchors, _check_anchors),
    Target("image_times", "images.csv", read_image_times_csv, _check_times),
    Target("reference", "reference.csv", read_reference, _check_reference),
    Target("tum", "reference.tum", read_reference, _check_reference),
    Target("distances", "distances.csv", read_tape, _check_tape),
    Target("markers", "markers.csv", lambda path: Tape(markers=read_markers(path)), _check_tape),
    Target("error_curve", "curve.csv", read_error_curve, _check_curve),
    Target("survey", "survey.toml", read_survey, _check_survey),
    Target("result_json", "result.json", _read_whole_result, _accept_all),
    Target("apply_ply", "mesh.ply", _carry, _accept_all),
    Target("apply_obj", "mesh.obj", _carry, _accept_all),
    Target("apply_json", "cameras.json", _carry, _accept_all),
    *(_model_target(name) for name in PARSED),
    *(_model_target(name.replace(".bin", ".txt")) for name in PARSED),
)
