"""The visible content of an output folder, without the hidden folder that holds the tool's own records."""

from __future__ import annotations

from pathlib import Path

from rangesfm.util.files.output_folder import PRIVATE_NAME


def paths_in(folder: Path) -> list[Path]:
    """List the files and folders in a folder, in order of their names."""
    return sorted(path for path in folder.iterdir() if path.name != PRIVATE_NAME)


def names_in(folder: Path) -> list[str]:
    """List the names of the files and folders in a folder, in order."""
    return [path.name for path in paths_in(folder)]


def paths_below(folder: Path) -> list[Path]:
    """List all files and folders below a folder, in order."""
    return sorted(path for path in folder.rglob("*") if PRIVATE_NAME not in path.relative_to(folder).parts)


def unfinished(output: Path) -> Path:
    """Return the folder of a reconstruction that is not finished, or was given up."""
    return output / PRIVATE_NAME / "reconstruction"
