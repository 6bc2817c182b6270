"""Made-up but plausible result folders: a loop through a room with eight anchors."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pycolmap
import pytest
from PIL import Image
from tests.result_document import REFINE, merged, result_document

Array = npt.NDArray[np.float64]
MakeResult = Callable[..., Path]

RANGES_HEADER = """
    timestamp_s image_name anchor_id tag_id range_m range_stddev_m keyframe_before keyframe_after weight
    predicted_scaled_m predicted_refined_m residual_m robust_weight status
"""
ANCHORS = np.array([(x, y, z) for x in (-2.6, 2.6) for y in (-3.1, 3.1) for z in (0.3, 2.1)])


@pytest.fixture
def make_result(tmp_path: Path) -> MakeResult:
    """Return a function that writes a result folder; ``write_result`` documents what can be varied."""

    def make(name: str = "survey", **options: Any) -> Path:
        return write_result(tmp_path / name, **options)

    return make


@pytest.fixture(scope="session")
def make_shared_result() -> MakeResult:
    """Return ``write_result``, which takes a path, for results that several tests share."""
    return write_result


def write_result(
    folder: Path,
    *,
    num_keyframes: int = 60,
    num_ranges_per_anchor: int = 120,
    anchor_ids: tuple[str, ...] = ("1", "2", "3", "4", "5", "6", "7", "8"),
    is_refined: bool = True,
    has_reference: bool = True,
    has_photos: bool = False,
    num_points: int = 2000,
    offset_m: tuple[float, float, float] | Array = (0.0, 0.0, 0.0),
    changes: dict[str, Any] | None = None,
) -> Path:
    """Write a whole result folder; ``changes`` are applied to result.json (see ``merged``).

    Args:
        offset_m: of the whole site, as in the coordinates of a national grid.
    """
    rng = np.random.default_rng(3)
    times = np.linspace(0.0, 190.0, num_keyframes)
    truth = _loop(times)
    refined = truth + 0.012 * _wander(rng, num_keyframes)
    scaled = 1.011 * (truth - truth[0]) + truth[0] + 0.07 * _wander(rng, num_keyframes)
    folder.mkdir(parents=True)
    points = _room(rng, num_points) + offset_m
    _write_model(folder / "sparse_scaled" / "0", scaled + offset_m, points)
    if is_refined:
        _write_model(folder / "sparse_metric" / "0", refined + offset_m, points)
    _write_csv(folder / "images.csv", ["image_name", "timestamp_s"], zip(_names(num_keyframes), times))
    if has_reference:
        rows = [[name, *position] for name, position in zip(_names(num_keyframes), truth + offset_m)]
        _write_csv(folder / "reference.csv", ["image_name", "x_m", "y_m", "z_m"], rows)
    rows = _ranges(rng, times, truth, scaled, refined if is_refined else None, anchor_ids, num_ranges_per_anchor)
    _write_csv(folder / "ranges.csv", RANGES_HEADER.split(), rows)
    _write_scale_tables(folder, rows)
    summary = _summary(rows, anchor_ids, is_refined, has_reference)
    for anchor in summary["anchors"].values():
        for key in ("position_m", "surveyed_position_m"):
            anchor[key] = np.add(anchor[key], offset_m).tolist()
    if has_photos:
        summary["settings"]["images"]["path"] = str(_write_photos(folder / "photos", num_keyframes))
    (folder / "result.json").write_text(json.dumps(merged(summary, changes or {})))
    return folder


def _write_scale_tables(folder: Path, rows: list[list[Any]]) -> None:
    """Write the tables about the estimates of scale and time offset, with plausible shapes."""
    rng = np.random.default_rng(5)
    times = [float(row[0]) for row in rows]
    noise = rng.normal(0, 0.02, len(rows))
    duplets = [[t, row[2], 0.4 - 0.5 * np.sin(t / 9), 0.742 + e] for t, row, e in zip(times, rows, noise)]
    _write_csv(folder / "scale_candidates.csv", ["timestamp_s", "anchor_id", "alpha0", "alpha1"], duplets)
    scales = np.geomspace(0.25, 2.2, 101)
    counts = np.round(2500 * np.exp(-(((scales - 0.742) / 0.1) ** 2))).astype(int)
    _write_csv(folder / "scale_consensus.csv", ["scale", "num_agreeing"], zip(scales, counts))
    offsets = np.linspace(-2.0, 2.0, 81)
    _write_csv(folder / "time_offset_curve.csv", ["time_offset_s", "cost"], zip(offsets, (offsets - 0.012) ** 2))


def _write_photos(folder: Path, num: int) -> Path:
    """Write one plain picture for each photo, each of another colour."""
    folder.mkdir()
    for i, name in enumerate(_names(num)):
        Image.new("RGB", (320, 240), (i * 255 // num, 80, 255 - i * 255 // num)).save(folder / name)
    return folder


def _names(num: int) -> list[str]:
    return [f"image{i:05d}.jpg" for i in range(num)]


def _loop(times: Array) -> Array:
    turn = 2 * np.pi * times / 63.0
    return np.column_stack(
        [1.5 * np.cos(turn) + 0.3 * np.cos(3.1 * turn), 2.0 * np.sin(turn), 1.2 + 0.35 * np.sin(2.3 * turn)]
    )


def _wander(rng: np.random.Generator, num: int) -> Array:
    """A smooth random walk of unit size."""
    walk = np.cumsum(rng.normal(size=(num, 3)), axis=0)
    smooth = np.column_stack([np.convolve(column, np.ones(5) / 5, "same") for column in walk.T])
    return np.asarray(smooth / smooth.std())


def _room(rng: np.random.Generator, num: int) -> Array:
    points = rng.uniform((-2.4, -2.9, 0.0), (2.4, 2.9, 2.3), size=(num, 3))
    wall = rng.integers(0, 5, num)
    for index, (axis, value) in enumerate([(0, -2.4), (0, 2.4), (1, -2.9), (1, 2.9), (2, 0.0)]):
        points[wall == index, axis] = value + rng.normal(0, 0.02, (wall == index).sum())
    return points


def _write_model(path: Path, centers: Array, points: Array) -> None:
    reconstruction = pycolmap.Reconstruction()
    camera = pycolmap.Camera(model="SIMPLE_PINHOLE", width=640, height=480, params=[420.0, 320.0, 240.0], camera_id=1)
    reconstruction.add_camera_with_trivial_rig(camera)
    looking_ahead = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    for index, (name, center) in enumerate(zip(_names(len(centers)), centers), start=1):
        turn = pycolmap.Rotation3d(np.array([0.0, 0.0, -0.05 * index])).matrix()
        rotation = looking_ahead @ turn
        image = pycolmap.Image(name=name, camera_id=1, image_id=index)
        pose = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), -rotation @ center)
        reconstruction.add_image_with_trivial_frame(image, pose)
    for point in points:
        reconstruction.add_point3D(point, pycolmap.Track(), (40 + 70 * (np.abs(point) % 9) / 3).astype(np.uint8))
    path.mkdir(parents=True)
    reconstruction.write_binary(path)


def _ranges(
    rng: np.random.Generator,
    times: Array,
    truth: Array,
    scaled: Array,
    refined: Array | None,
    anchor_ids: tuple[str, ...],
    num_per_anchor: int,
) -> list[list[Any]]:
    def predicted(path: Array, when: float, anchor: Array) -> float:
        position = np.array([np.interp(when, times, column) for column in path.T])
        return float(np.linalg.norm(position - anchor))

    names = _names(len(times))
    rows: list[list[Any]] = []
    for when in np.sort(rng.uniform(-3.0, times[-1] + 2.0, num_per_anchor * len(anchor_ids))):
        index = int(rng.integers(len(anchor_ids)))
        anchor, outlier = ANCHORS[index % len(ANCHORS)], rng.random() < 0.06
        measured = predicted(truth, when, anchor) + 0.02 * (index % 4) + rng.normal(0, 0.07)
        measured += rng.exponential(0.8) if outlier else 0.0
        is_outside = when < 0 or when > times[-1]
        before = "" if is_outside else predicted(scaled, when, anchor)
        after = "" if is_outside or refined is None else predicted(refined, when, anchor)
        final = before if refined is None else after
        residual = "" if final == "" else float(final) - measured
        status = "used"
        if is_outside:
            status = "outside-path"
        elif abs(float(residual)) > 0.45:
            status = "outlier"
        elif abs(float(residual)) > 0.2:
            status = "down-weighted"
        elif rng.random() < 0.05:
            status = "check"
        place: list[Any] = ["", "", ""]
        if not is_outside:
            later = max(int(np.searchsorted(times, when)), 1)
            share = (when - times[later - 1]) / (times[later] - times[later - 1])
            place = [names[later - 1], names[later], share]
        rows.append(
            [f"{when:.6f}", "", anchor_ids[index], "tag", measured, "", *place, before, after, residual, 1.0, status]
        )
    return rows


def _summary(
    rows: list[list[Any]], anchor_ids: tuple[str, ...], is_refined: bool, has_reference: bool
) -> dict[str, Any]:
    used = np.array([row[11] for row in rows if row[13] in ("used", "down-weighted")], dtype=float)
    held_out = np.array([row[11] for row in rows if row[13] == "check"], dtype=float)
    summary: dict[str, Any] = {
        "scale": {
            "value": 0.74213,
            "stddev_formal": 0.00031,
            "stddev_empirical": 0.00412,
            "interval_95": [0.73406, 0.75021],
            "method": "robust",
            "verdict": "good",
            "reasons": ["eight anchors agree within 1.5 %", "the path fills the room in all three directions"],
            "per_anchor": {id_: 0.74213 * (1 + 0.015 * np.sin(2.4 * i)) for i, id_ in enumerate(anchor_ids)},
            "two_candidate": {
                "alpha0": {"mean": 1.9132, "std": 4.1021},
                "alpha1": {"mean": 0.7688, "std": 0.2215},
                "chosen": "alpha1",
                "num_without_root": 9,
            },
        },
        "metric_from_sfm": {"scale": 0.74213, "rotation_xyzw": [0.0, 0.0, 0.0, 1.0], "translation_m": [0.0, 0.0, 1.0]},
        "frame": "site",
        "anchors": {
            id_: {
                "position_m": ANCHORS[i % len(ANCHORS)].tolist(),
                "stddev_m": 0.02,
                "range_bias_m": 0.02 * (i % 4),
                "mirror_position_m": None,
                "surveyed_position_m": (ANCHORS[i % len(ANCHORS)] + 0.004).tolist(),
            }
            for i, id_ in enumerate(anchor_ids)
        },
        "time_offset": {"value_s": 0.0123, "stddev_s": 0.0041},
        "ranges": {
            "num": len(rows),
            "num_used": len(used),
            "num_rejected": sum(row[13] == "outlier" for row in rows),
            "rms_m": _rms(used),
            "median_abs_m": float(np.median(np.abs(used))),
        },
        "check_ranges": {"num": len(held_out), "rms_m": _rms(held_out)},
        "refine": REFINE if is_refined else None,
        "comparison": [
            _comparison_row("true scale", 0.0712, 0.0633, 0.0633, 0.0),
            _comparison_row("scaled", 0.0801, 0.0702, 0.0633, 1.094),
            _comparison_row("refined", 0.0214, 0.0187, 0.0186, -0.051),
        ],
        "inputs": [{"path": "uwb.csv", "sha256": "0" * 64, "bytes": 12345, "hashed": "content"}],
        "distances": [
            {
                "from": "image00003.jpg",
                "to": "marker 2",
                "kind": "check",
                "measured_m": 2.5,
                "stddev_m": 0.003,
                "estimated_m": 2.5127,
                "residual_m": 0.0127,
            }
        ],
        "tests": [
            _test("anchor coordinate", f"{anchor_ids[0]} y", 38.2, rejected=True),
            _test("lever arm", "", 4.1, rejected=False),
            {**_test("range scale", "", 0.3, rejected=False), "smallest_detectable": None, "effect_on_scale": None},
        ],
        "versions": {"rangesfm": "0.1.0", "pycolmap": "4.2.1", "pyceres": "2.6", "numpy": "2.3.1"},
        "settings": {
            "images": {"path": "images", "every_nth": 3},
            "anchors": {"path": "anchors.csv", "frame": "site"},
            "tag": {"tag_in_cam_m": [-0.0012, -0.09, -0.0663]},
            "refine": {"enabled": is_refined, "max_num_iterations": 200, "range_loss_scale": 3.46},
        },
        "seconds": {"features": 31.2, "matching": 18.4, "mapping": 64.0, "scale": 3.1, "refine": 12.3, "output": 1.2},
        "warnings": ["12 ranges were taken before the first photo"],
    }
    if not has_reference:
        del summary["comparison"]
    return result_document(**summary)


def _comparison_row(name: str, *values: float) -> dict[str, Any]:
    keys = ("rmse_m", "rmse_se3_m", "rmse_sim3_m", "scale_error_percent")
    return {"name": name, "num_keyframes": 160, **dict(zip(keys, values, strict=True))}


def _test(name: str, subject: str, statistic: float, *, rejected: bool) -> dict[str, Any]:
    return {
        "name": name,
        "subject": subject,
        "statistic": statistic,
        "threshold": 16.4,
        "size": -0.4042,
        "stddev": 0.0311,
        "unit": "m",
        "smallest_detectable": 0.1288,
        "effect_on_scale": 0.0042,
        "effect_on_place_m": 0.0711,
        "rejected": rejected,
        "words": f"{name} {subject}",
        "remedy": "measure it again",
    }


def _rms(residuals: Array) -> float:
    return float(np.sqrt(np.mean(residuals**2))) if len(residuals) else 0.0


def _write_csv(path: Path, header: list[str], rows: Any) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)
