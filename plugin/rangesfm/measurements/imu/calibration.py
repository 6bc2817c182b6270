"""Noise of an inertial sensor, from kalibr's file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML
from ruamel.yaml.error import YAMLError

from rangesfm.errors import InputError
from rangesfm.measurements.imu.log import ImuNoise
from rangesfm.option_model import Bounds
from rangesfm.util.files.text_tables import read_text

_DENSITY = Bounds(0.0, 1e3, "noise density")
_KEYS = (
    *("gyroscope_noise_density", "accelerometer_noise_density"),
    *("gyroscope_random_walk", "accelerometer_random_walk"),
)


def read_imu_noise(path: Path) -> ImuNoise:
    """Read kalibr's ``imu.yaml``, in which the keys are at the top, or in a table for the sensor such as ``imu0``.

    Raises:
        InputError: it is no YAML, or lacks a density.
    """
    try:
        content = YAML(typ="safe", pure=True).load(read_text(path))
    except (YAMLError, ValueError, RecursionError) as error:
        raise InputError(f"cannot be read as YAML ({type(error).__name__}), expected kalibr's imu.yaml", path) from None
    table = _table(content)
    if table is None:
        raise InputError(f"has no noise of an inertial sensor, expected {', '.join(_KEYS)}", path)
    values = []
    for key in _KEYS:
        value = table.get(key)
        if not isinstance(value, (int, float)) or isinstance(value, bool) or not _DENSITY.hold(float(value)):
            raise InputError(f"{key} is {value!r}, expected a number from 0 to {_DENSITY.most:g}", path)
        values.append(float(value))
    return ImuNoise(*values)


def _table(content: Any) -> Mapping[str, Any] | None:
    """Return the table with any of the keys: the whole file, or the first table in it."""
    if not isinstance(content, Mapping):
        return None
    tables = [content, *(value for value in content.values() if isinstance(value, Mapping))]
    return next((table for table in tables if any(key in table for key in _KEYS)), None)
