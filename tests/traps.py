"""Modules that an untrusted survey may hold beside its photos, with names that every program imports."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

_NAMES = (
    "argparse",
    "csv",
    "json",
    "multiprocessing",
    "numpy",
    "pickle",
    "pycolmap",
    "pydantic",
    "scipy",
    "socket",
)


def set_traps(folder: Path) -> Callable[[], list[str]]:
    """Put the modules into a folder; return a function that lists which of them have been imported since."""
    said = folder / "imported.txt"
    for name in _NAMES:
        (folder / f"{name}.py").write_text(f"open({str(said)!r}, 'a').write('{name}\\n')\nraise SystemExit(77)\n")
    return lambda: said.read_text().split() if said.exists() else []
