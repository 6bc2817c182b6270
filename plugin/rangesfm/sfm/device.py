"""What computes features and matches: the processor or a GPU, and which methods the installed pycolmap has."""

from __future__ import annotations

import pycolmap

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


def refuse_missing_gpu(use_gpu: bool, table: str) -> None:
    """Refuse COLMAP's own key ``use_gpu`` where there is no GPU.

    Raises:
        OptionError: the key is true, and pycolmap, built with CUDA, finds no GPU.
    """
    if use_gpu and num_gpus() == 0:
        raise OptionError(f"[{table}] use_gpu is true, expected false: pycolmap finds no GPU", table, "use_gpu")


def refuse_learned(name: str, table: str) -> None:
    """Refuse learned features and learned matching where pycolmap is built without them.

    Raises:
        OptionError: ``name``, the key ``type`` of the table, is a learned method and pycolmap cannot run it.
    """
    if not name.startswith("SIFT") or name.endswith("LIGHTGLUE"):
        known = pycolmap.FeatureExtractionOptions().todict()
        if "aliked" not in known:
            raise OptionError(
                f"[{table}] type is '{name}', expected SIFT: the installed pycolmap {pycolmap.__version__} is built"
                " without ONNX, which runs networks; use database_path for features of other programs",
                table,
                "type",
            )
