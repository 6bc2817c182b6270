"""Simulate other installations than the present one."""

from __future__ import annotations

import pycolmap
import pytest

from rangesfm import installed_versions
from rangesfm.installed_versions import installed_version


def with_installed(monkeypatch: pytest.MonkeyPatch, **versions: str | None) -> None:
    """Simulate packages in these versions (None: not installed); write an underscore for a hyphen."""
    known = {name.replace("_", "-"): version for name, version in versions.items()}
    monkeypatch.setattr(
        installed_versions, "installed_version", lambda name: known[name] if name in known else installed_version(name)
    )


def with_gpus(monkeypatch: pytest.MonkeyPatch, num: int | None) -> None:
    """Simulate a pycolmap that finds this number of GPUs (None: built without CUDA)."""
    if num is None:
        monkeypatch.delattr(pycolmap, "get_num_cuda_devices", raising=False)
    else:
        monkeypatch.setattr(pycolmap, "get_num_cuda_devices", lambda: num, raising=False)
