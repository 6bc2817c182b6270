"""What computes features and matches: the processor or a GPU, and which methods the installed pycolmap has."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pycolmap

from rangesfm.colmap.passthrough import apply_options
from rangesfm.errors import OptionError
from rangesfm.installed_versions import OTHER_BUILDS, num_gpus
from rangesfm.mapper_options import MapperOptions


def uses_gpu(mapper: MapperOptions) -> bool:
    """Return whether COLMAP is to work on a GPU; without one it would fail in the middle of its work.

    Raises:
        OptionError: a GPU is asked for, and there is none.
    """
    if mapper.device == "cpu":
        return False
    num = num_gpus()
    if mapper.device == "cuda" and not num:
        others = " or ".join(OTHER_BUILDS["pycolmap"])
        why = "pycolmap finds no GPU" if num == 0 else f"this pycolmap is built without CUDA; install {others}"
        raise OptionError(f"[mapper] device is 'cuda', expected 'auto' or 'cpu': {why}", "mapper", "device")
    return bool(num)


def apply_options_of_device(
    options: pycolmap.FeatureExtractionOptions | pycolmap.FeatureMatchingOptions, values: Mapping[str, Any], table: str
) -> None:
    """Set attributes of COLMAP's options for features or matches as ``apply_options``.

    Raises:
        OptionError: as there; or ``type`` is a learned method, which the installed pycolmap cannot run, or ``use_gpu``
            is true, and pycolmap, built with CUDA, finds no GPU.
    """
    apply_options(options, values, table)
    name = options.type.name
    is_learned = not name.startswith("SIFT") or name.endswith("LIGHTGLUE")
    if is_learned and "aliked" not in pycolmap.FeatureExtractionOptions().todict():
        raise OptionError(
            f"[{table}] type is '{name}', expected SIFT: the installed pycolmap {pycolmap.__version__} is built without"
            " ONNX, which runs networks; use database_path for features of other programs",
            table,
            "type",
        )
    if options.use_gpu and num_gpus() == 0:
        raise OptionError(f"[{table}] use_gpu is true, expected false: pycolmap finds no GPU", table, "use_gpu")
