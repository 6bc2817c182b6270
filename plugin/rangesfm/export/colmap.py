"""COLMAP's own model folders."""

from __future__ import annotations

from pathlib import Path

import pycolmap

from rangesfm.colmap.model_files import write_binary_model
from rangesfm.files.atomic import new_folder


def write_model(reconstruction: pycolmap.Reconstruction, path: Path, *, as_text: bool = False) -> Path:
    """Write the model as the folder ``path``, whole or not at all; an older one is replaced."""
    with new_folder(path) as folder:
        if as_text:
            reconstruction.write_text(folder)
        else:
            write_binary_model(reconstruction, folder)
    return path
