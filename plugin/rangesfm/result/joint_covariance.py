"""The file ``joint_covariance.npz`` of a result: how all parts of the refined map err together."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import get_args

import numpy as np

from rangesfm.errors import InputError
from rangesfm.util.files.atomic import new_file
from rangesfm.util.geometry.map_errors import UNKNOWN_ERRORS, Kind, MapErrors, PartErrors

JOINT_COVARIANCE_NAME = "joint_covariance.npz"
_KINDS: tuple[Kind, ...] = get_args(Kind)
_SCALE_STDDEV = "relative_scale_stddev"


def write_map_errors(errors: MapErrors, folder: Path) -> None:
    """Write the file into a folder: for each kind of part ``frame_ids``, ``frame_modes`` and so on; see MapErrors.

    Modes have single precision, which is a relative error of the covariance of 1e-7.
    """
    arrays = {_SCALE_STDDEV: np.array(errors.scale_stddev)}
    for kind, parts in errors.parts.items():
        arrays[f"{kind}_ids"] = np.array(parts.ids)
        arrays[f"{kind}_modes"] = parts.modes.astype(np.float32)
        arrays[f"{kind}_rests"] = parts.rests
        arrays[f"{kind}_by_scale"] = parts.by_scale
    with new_file(folder / JOINT_COVARIANCE_NAME) as temporary, temporary.open("wb") as stream:
        np.savez_compressed(stream, **arrays)  # type: ignore[arg-type]


def read_map_errors(folder: Path) -> MapErrors:
    """Read the file of a folder; without it, it is not known how the parts err.

    Raises:
        InputError: the file was not written by a run.
    """
    path = folder / JOINT_COVARIANCE_NAME
    if not path.is_file():
        return UNKNOWN_ERRORS
    parts: dict[Kind, PartErrors] = {}
    sizes: set[int] = set()
    try:
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            scale_stddev = float(arrays[_SCALE_STDDEV])
            for kind in _KINDS:
                if f"{kind}_ids" not in arrays:
                    continue
                ids = arrays[f"{kind}_ids"].tolist()
                modes, rests, by_scale = (
                    arrays[f"{kind}_{name}"].astype(np.float64) for name in ("modes", "rests", "by_scale")
                )
                num, size, num_modes = modes.shape
                if (len(ids), rests.shape, by_scale.shape) != (num, (num, size, size), (num, size)):
                    raise ValueError("arrays of different lengths")
                if not all(np.isfinite(values).all() for values in (modes, rests, by_scale)):
                    raise ValueError("not finite")
                parts[kind] = PartErrors(tuple(ids), modes, rests, by_scale)
                sizes.add(num_modes)
    except (
        *(ArithmeticError, EOFError, LookupError, MemoryError, NotImplementedError, OSError, RuntimeError, TypeError),
        *(ValueError, zipfile.BadZipFile, zlib.error),
    ) as error:
        raise InputError("is damaged, expected the file as a run wrote it", path) from error
    if len(sizes) != 1:
        raise InputError("is damaged, expected the file as a run wrote it", path)
    return MapErrors(parts, scale_stddev)
