"""A camera as OpenCV, Kalibr and ROS describe it, as COLMAP does."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from rangesfm.errors import InputError

# To OpenCV, and so to Kalibr and ROS, the centre of the first pixel is (0, 0); to COLMAP it is (0.5, 0.5).
_CORNER_PX = 0.5
# COLMAP's model and how many parameters it has beside fx, fy, cx, cy.
_MODELS = {
    "none": ("PINHOLE", 0),
    "radtan": ("OPENCV", 4),
    "plumb_bob": ("OPENCV", 4),
    "rational_polynomial": ("FULL_OPENCV", 8),
    "equidistant": ("OPENCV_FISHEYE", 4),
    "fisheye": ("OPENCV_FISHEYE", 4),
}


def colmap_camera(
    distortion: str, pinhole: Iterable[float], coefficients: Iterable[float], path: Path
) -> tuple[str, tuple[float, ...]]:
    """COLMAP's name of the model and its parameters.

    Args:
        distortion: the model's name in Kalibr or ROS.
        pinhole: fx, fy, cx, cy in pixels.
        path: where it stands, for the message.

    Raises:
        InputError: COLMAP has no such model.
    """
    if distortion not in _MODELS:
        raise InputError(f"distortion_model is '{distortion}', expected one of {', '.join(_MODELS)}", path)
    model, num = _MODELS[distortion]
    given = [*map(float, coefficients)]
    if model == "OPENCV" and any(given[num:]):  # a third radial coefficient
        model, num = "FULL_OPENCV", 8
    fx, fy, cx, cy = map(float, pinhole)
    return model, (fx, fy, cx + _CORNER_PX, cy + _CORNER_PX, *[*given, *[0.0] * num][:num])
