"""Installations other than the one at hand."""

from __future__ import annotations

import pycolmap
import pytest

from rangesfm import installed_versions
from rangesfm.installed_versions import installed_version


def with_installed(monkeypatch: pytest.MonkeyPatch, **versions: str | None) -> None:
    """Have these packages installed in these versions (None: not there), an underscore for a hyphen."""
    known = {name.replace("_", "-"): version for name, version in versions.items()}
    monkeypatch.setattr(
        installed_versions, "installed_version", lambda name: known[name] if name in known else installed_version(name)
    )


def with_gpus(monkeypatch: pytest.MonkeyPatch, num: int | None) -> None:
    """Have a pycolmap that finds so many GPUs; None: one that is built without CUDA."""
    if num is None:
        monkeypatch.delattr(pycolmap, "get_num_cuda_devices", raising=False)
    else:
        monkeypatch.setattr(pycolmap, "get_num_cuda_devices", lambda: num, raising=False)
