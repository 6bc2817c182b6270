"""COLMAP's options as rangesfm passes them: COLMAP's own defaults, except for those listed here.

A newly built options object inside another one would replace defaults that COLMAP sets there.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypeGuard

import numpy as np
import pycolmap
import pytest
from tests.simulated.model import synthetic_model
from tests.simulated.path import along, loop_path

import rangesfm
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions, RefineOptions
from rangesfm.progress import Progress
from rangesfm.sfm.background import match_share
from rangesfm.sfm.camera import cameras_of_photos
from rangesfm.sfm.features import feature_options
from rangesfm.sfm.loops.resection import resection_options
from rangesfm.sfm.mapping import WHILE_GROWING, mapping_options, pipeline_options
from rangesfm.sfm.matching import matching_options
from rangesfm.sfm.photo_files import Photos
from rangesfm.sfm.rigs import NO_RIGS
from rangesfm.solver.bundle_adjustment import bundle_adjustment
from rangesfm.util.geometry.similarity import IDENTITY

SEED = 3
ON_PROCESSOR = {"use_gpu": False} if pycolmap.has_cuda else {}  # COLMAP sets this itself where it has no CUDA
KNOWN_CAMERA = CameraOptions(model="SIMPLE_PINHOLE", params=(240.0, 128.0, 96.0))


def changes(options: Any) -> dict[str, Any]:
    """Return the options that differ from COLMAP's defaults, by name; inner options as ``outer.inner``."""
    return dict(_changes(options.todict(), type(options)().todict()))


def _changes(found: dict[str, Any], default: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    assert found.keys() == default.keys()
    for key, value in found.items():
        if isinstance(value, dict):
            yield from ((f"{key}.{inner}", changed) for inner, changed in _changes(value, default[key]))
        elif not np.array_equal(value, default[key]):
            yield key, value


def test_features_are_found_as_colmap_finds_them() -> None:
    assert changes(feature_options(MapperOptions(device="cpu"))) == ON_PROCESSOR


@pytest.mark.parametrize(
    ("mapper", "num_photos", "pairing"),
    [
        (MapperOptions(device="cpu"), 60, pycolmap.ExhaustivePairingOptions),
        (MapperOptions(device="cpu"), 61, pycolmap.SequentialPairingOptions),
        (MapperOptions(device="cpu", matching="spatial"), 9, pycolmap.SpatialPairingOptions),
    ],
    ids=["all", "neighbours", "near ones"],
)
def test_photos_are_matched_as_colmap_matches_them(mapper: MapperOptions, num_photos: int, pairing: type) -> None:
    options = matching_options(mapper, num_photos, SEED)
    assert isinstance(options.pairing, pairing)
    assert changes(options.pairing) == {}
    assert changes(options.matcher) == ON_PROCESSOR | {"num_threads": 1}
    assert changes(options.verification) == {"ransac.random_seed": SEED}
    assert changes(options.verifier) == {}


@pytest.mark.parametrize("matching", ["vocabtree", "sequential"])
def test_a_vocabulary_tree_is_the_users(matching: str) -> None:
    mapper = MapperOptions(vocab_tree_path=Path("tree.bin")).changed(matching=matching)
    assert changes(matching_options(mapper, 100, SEED).pairing) == {"vocab_tree_path": Path("tree.bin")}


SEEDS = {"random_seed": SEED, "mapper.random_seed": SEED, "triangulation.random_seed": SEED}
GROWING = SEEDS | WHILE_GROWING
AS_GIVEN = {
    "constant_cameras": {1},
    "ba_refine_focal_length": False,
    "ba_refine_extra_params": False,
    "mapper.abs_pose_refine_focal_length": False,
    "mapper.abs_pose_refine_extra_params": False,
}
GLOBALLY = {
    "num_threads": 3,
    "random_seed": SEED,
    "mapper.global_positioning.use_gpu": False,
    "mapper.bundle_adjustment.ceres.use_gpu": False,
}
GLOBALLY_AS_GIVEN = {
    "mapper.bundle_adjustment.refine_focal_length": False,
    "mapper.bundle_adjustment.refine_extra_params": False,
}


def of_clusters(changes: dict[str, Any]) -> dict[str, Any]:
    return {"num_workers": 3, "num_threads": 1} | {f"incremental_options.{k}": v for k, v in changes.items()}


def database_of(path: Path, *sizes: tuple[int, int]) -> Path:
    """Write a database with one photo of each of these cameras; COLMAP numbers them 1, 2, ..."""
    with pycolmap.Database.open(path) as database:
        for number, (width, height) in enumerate(sizes, 1):
            camera = pycolmap.Camera.create_from_model_name(number, "SIMPLE_PINHOLE", 240.0, width, height)
            database.write_camera(camera, use_camera_id=True)
            database.write_image(pycolmap.Image(f"{number}.jpg", image_id=number, camera_id=number))
    return path


@pytest.mark.parametrize(
    ("method", "from_the_start", "as_given"),
    [
        ("incremental", {"num_threads": 3} | GROWING, AS_GIVEN),
        ("global", GLOBALLY, GLOBALLY_AS_GIVEN),
        ("hierarchical", of_clusters(SEEDS), of_clusters(AS_GIVEN)),
    ],
)
def test_models_are_mapped_as_colmap_maps_them(
    method: str, from_the_start: dict[str, Any], as_given: dict[str, Any], tmp_path: Path
) -> None:
    mapper = MapperOptions(device="cpu", num_threads=3).changed(method=method)
    database = database_of(tmp_path / "database.db", (256, 192))
    assert changes(pipeline_options(CameraOptions(), mapper, SEED)) == from_the_start
    alone = changes(pipeline_options(CameraOptions(), mapper.changed(reproducible=True), SEED))
    assert alone == from_the_start | {"num_threads": 1}
    kept = mapping_options(KNOWN_CAMERA.changed(refine_intrinsics=False), mapper, NO_RIGS, SEED, database)
    assert changes(kept.growing) == from_the_start | as_given
    if method == "incremental":
        assert changes(kept.whole) == {"num_threads": 3, "constant_cameras": {1}} | SEEDS
    else:
        assert kept.whole is None


@pytest.mark.parametrize(
    ("method", "growing"), [("incremental", GROWING | AS_GIVEN), ("hierarchical", of_clusters(SEEDS | AS_GIVEN))]
)
def test_a_calibration_holds_until_the_map_is_whole(method: str, growing: dict[str, Any], tmp_path: Path) -> None:
    mapper = MapperOptions(num_threads=3).changed(method=method)
    options = mapping_options(KNOWN_CAMERA, mapper, NO_RIGS, SEED, database_of(tmp_path / "database.db", (256, 192)))
    threads = {"num_threads": 1 if method == "hierarchical" else 3}
    assert changes(options.growing) == threads | growing
    assert options.whole is not None
    assert changes(options.whole) == threads | SEEDS


@pytest.mark.parametrize("refines", [None, False])
def test_a_camera_that_is_guessed_beside_a_calibrated_one_is_refined_from_the_start(
    refines: bool | None, tmp_path: Path
) -> None:
    database = database_of(tmp_path / "database.db", (256, 192), (256, 192), (300, 300))
    camera = KNOWN_CAMERA.changed(refine_intrinsics=refines)
    options = mapping_options(camera, MapperOptions(num_threads=3), NO_RIGS, SEED, database)
    held = {"constant_cameras": {1, 2}}
    assert changes(options.growing) == {"num_threads": 3} | held | GROWING
    assert changes(options.whole) == {"num_threads": 3} | SEEDS | (held if refines is False else {})


@pytest.mark.parametrize("camera", [CameraOptions(), KNOWN_CAMERA.changed(refine_intrinsics=True)])
def test_what_nobody_knows_is_refined_from_the_start(camera: CameraOptions, tmp_path: Path) -> None:
    database = database_of(tmp_path / "database.db", (256, 192))
    options = mapping_options(camera, MapperOptions(num_threads=3), NO_RIGS, SEED, database)
    assert changes(options.growing) == {"num_threads": 3} | GROWING
    assert changes(options.whole) == {"num_threads": 3} | SEEDS


def test_how_a_map_grows_is_the_users_too(tmp_path: Path) -> None:
    given = {"ba_global_frames_ratio": 1.2, "ba_global_max_refinements": 3}
    mapper, database = MapperOptions(num_threads=3, pipeline=given), database_of(tmp_path / "database.db", (256, 192))
    options = mapping_options(CameraOptions(), mapper, NO_RIGS, SEED, database)
    assert changes(options.growing) == {"num_threads": 3} | GROWING | given
    assert changes(options.whole) == {"num_threads": 3} | SEEDS | given


def test_a_camera_is_guessed_as_colmap_guesses_it(monkeypatch: pytest.MonkeyPatch) -> None:
    handed: list[Any] = []
    monkeypatch.setattr(pycolmap, "infer_camera_from_image", lambda _, reader: handed.append(reader))
    photos = Photos(Path(), ("photo.jpg",), ((640, 480),), {})
    cameras_of_photos(CameraOptions(model="OPENCV"), photos)
    assert changes(handed[0]) == {"camera_model": "OPENCV"}


def test_shares_of_pairs_are_matched_as_colmap_matches_pairs(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    handed: list[Any] = []
    monkeypatch.setattr(pycolmap, "match_image_pairs", lambda _, *options, **__: handed.extend(options))
    matcher, verification = pycolmap.FeatureMatchingOptions(), pycolmap.TwoViewGeometryOptions()
    match_share(tmp_path / "1.db", [(1, 2)], matcher, verification, tmp_path, Progress())
    assert (handed[0], handed[2]) == (matcher, verification)
    # The block size depends on the photos' features; in a database without any, it is one photo.
    assert changes(handed[1]) == {"match_list_path": tmp_path / "1.txt", "block_size": 1}


def test_a_model_is_adjusted_as_colmap_adjusts_it() -> None:
    times = np.arange(4, dtype=np.float64)
    path = loop_path(4.0)
    model = synthetic_model(*along(path, times), metric_from_sfm=IDENTITY)
    bundle = bundle_adjustment(
        model.reconstruction,
        CameraOptions(),
        RefineOptions(max_num_iterations=77),
        num_threads=1,
    )
    assert changes(bundle.adjuster.options) == {
        "print_summary": False,
        "refine_focal_length": False,
        "refine_extra_params": False,
        "ceres.solver_options.initial_trust_region_radius": 1e10,
        "ceres.solver_options.function_tolerance": 1e-12,
        "ceres.solver_options.gradient_tolerance": 0.0,
        "ceres.solver_options.max_num_iterations": 77,
        "ceres.solver_options.num_threads": 1,
        # Several threads would add up sums in a different order each time.
        "ceres.min_num_residuals_for_cpu_multi_threading": 2**31 - 1,
    }


def test_a_photo_of_a_loop_is_placed_as_colmap_places_one_with_the_error_of_its_matches() -> None:
    matches = pycolmap.TwoViewGeometryOptions().ransac.max_error
    assert changes(resection_options(SEED)) == {"ransac.random_seed": SEED, "ransac.max_error": matches}


def test_no_other_options_of_colmaps_are_made_and_none_inside_of_others() -> None:
    trees = [ast.parse(path.read_text(encoding="utf-8")) for path in Path(rangesfm.__file__).parent.rglob("*.py")]
    made = [node for tree in trees for node in ast.walk(tree) if _makes_options(node)]
    assert not [ast.unparse(node) for node in made if any(map(_makes_options, list(ast.walk(node))[1:]))]
    assert {ast.unparse(node.func).removeprefix("pycolmap.") for node in made} == {
        "AbsolutePoseEstimationOptions",
        "BundleAdjustmentOptions",
        "DatabaseCacheOptions",  # by its arguments alone: all photos, also those without matches
        "ExhaustivePairingOptions",
        "FeatureExtractionOptions",
        "FeatureMatchingOptions",
        "GeometricVerifierOptions",
        "GlobalPipelineOptions",
        "HierarchicalPipelineOptions",
        "ImageReaderOptions",
        "ImportedPairingOptions",
        "IncrementalMapperOptions",  # for a limit of its own that ties of models share
        "IncrementalPipelineOptions",
        "SequentialPairingOptions",
        "SpatialPairingOptions",
        "TwoViewGeometryOptions",
        "VocabTreePairingOptions",
    }, "one that this file does not look at"


def _makes_options(node: ast.AST) -> TypeGuard[ast.Call]:
    return isinstance(node, ast.Call) and re.fullmatch(r"pycolmap\.\w*Options", ast.unparse(node.func)) is not None
