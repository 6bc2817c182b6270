"""Parts of a COLMAP camera that other programs name one by one."""

from __future__ import annotations

import pycolmap


def distortion_params(camera: pycolmap.Camera) -> list[float]:
    """The parameters that are neither focal lengths nor principal point, in COLMAP's order."""
    others = {*camera.focal_length_idxs(), *camera.principal_point_idxs()}
    return [float(value) for index, value in enumerate(camera.params) if index not in others]
