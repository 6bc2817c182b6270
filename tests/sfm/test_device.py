"""The device that computes features and matches."""

from __future__ import annotations

from pathlib import Path

import pycolmap
import pytest
from tests.installed import with_gpus

from rangesfm.errors import OptionError
from rangesfm.mapper_options import MapperOptions
from rangesfm.options import CameraOptions
from rangesfm.progress import Progress
from rangesfm.sfm.background import find_features, match_share
from rangesfm.sfm.features import feature_options
from rangesfm.sfm.mapping import pipeline_options
from rangesfm.sfm.matching import matching_options

NUM_CORES = 3
SILENT = Progress()


def mapper_on(device: str) -> MapperOptions:
    return MapperOptions(num_threads=NUM_CORES).changed(device=device)


@pytest.mark.parametrize(
    ("device", "num", "on_gpu"),
    [
        ("auto", None, False),
        ("auto", 0, False),
        ("auto", 2, True),
        ("cpu", None, False),
        ("cpu", 1, False),
        ("cuda", 1, True),
    ],
)
def test_a_gpu_is_used_where_there_is_one_and_it_is_wanted(
    device: str, num: int | None, on_gpu: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_gpus(monkeypatch, num)
    # COLMAP would check the device against its own build, which has no CUDA.
    monkeypatch.setattr(pycolmap.FeatureMatchingOptions, "check", lambda _: True, raising=False)
    mapper = mapper_on(device)
    matching = matching_options(mapper, 9, seed=0)
    assert feature_options(mapper).use_gpu == matching.matcher.use_gpu == on_gpu
    # On the processor, several processes take the place of threads.
    assert (matching.num_processes, matching.matcher.num_threads) == ((1, NUM_CORES) if on_gpu else (NUM_CORES, 1))
    pipeline = pipeline_options(CameraOptions(), mapper.changed(method="global"), seed=0)
    assert isinstance(pipeline, pycolmap.GlobalPipelineOptions)
    assert pipeline.mapper.global_positioning.use_gpu == pipeline.mapper.bundle_adjustment.ceres.use_gpu == on_gpu


@pytest.mark.parametrize(
    ("num", "why"), [(0, "pycolmap finds no GPU"), (None, "built without CUDA; install pycolmap-cuda12")]
)
def test_a_gpu_that_is_asked_for_and_not_there_is_refused_before_anything_is_computed(
    num: int | None, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with_gpus(monkeypatch, num)
    with pytest.raises(OptionError, match=rf"^\[mapper\] device is 'cuda', expected 'auto' or 'cpu': .*{why}$"):
        feature_options(mapper_on("cuda"))


def test_colmaps_own_key_for_a_gpu_is_refused_where_there_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    with_gpus(monkeypatch, 0)
    monkeypatch.setattr(pycolmap.FeatureExtractionOptions, "check", lambda _: True)
    with pytest.raises(
        OptionError, match=r"^\[mapper.features\] use_gpu is true, expected false: pycolmap finds no GPU"
    ):
        feature_options(MapperOptions(features={"use_gpu": True}))


@pytest.mark.parametrize("on_gpu", [False, True])
def test_colmap_is_told_the_device_beside_the_options_which_it_would_not_heed_alone(
    on_gpu: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Told only by the options, a build with CUDA would take a GPU, and stop if there is none."""
    told: list[pycolmap.Device] = []
    for name in ("extract_features", "match_image_pairs"):
        monkeypatch.setattr(pycolmap, name, lambda *_, device, **__: told.append(device))
    for_features = pycolmap.FeatureExtractionOptions(use_gpu=on_gpu)
    matcher = pycolmap.FeatureMatchingOptions(use_gpu=on_gpu)
    find_features(tmp_path / "1.db", tmp_path, ["1.jpg"], None, for_features, tmp_path, SILENT)
    match_share(tmp_path / "1.db", [(1, 2)], matcher, pycolmap.TwoViewGeometryOptions(), tmp_path, SILENT)
    assert told == [pycolmap.Device.cuda if on_gpu else pycolmap.Device.cpu] * 2
