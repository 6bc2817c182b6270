"""What a user sees in an output folder: all but the hidden folder in which the tool keeps what is its own."""

from __future__ import annotations

from pathlib import Path

from rangesfm.files.output_folder import PRIVATE_NAME


def paths_in(folder: Path) -> list[Path]:
    """Files and folders in a folder, in order of their names."""
    return sorted(path for path in folder.iterdir() if path.name != PRIVATE_NAME)


def names_in(folder: Path) -> list[str]:
    """Names of the files and folders in a folder, sorted."""
    return [path.name for path in paths_in(folder)]


def paths_below(folder: Path) -> list[Path]:
    """All files and folders in a folder, however deep, in order."""
    return sorted(path for path in folder.rglob("*") if PRIVATE_NAME not in path.relative_to(folder).parts)


def unfinished(output: Path) -> Path:
    """Folder of a reconstruction that is being made, or was given up."""
    return output / PRIVATE_NAME / "reconstruction"
