"""Boxes made of rectangles and decorations of their paint, from which scenes are built."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import numpy.typing as npt
from tests.rendering import decals
from tests.rendering.canvas import Canvas, Material
from tests.rendering.light import Panel
from tests.rendering.materials import Colour
from tests.rendering.scene import Rectangle

Paint = Callable[[Canvas], Material]
Decoration = Callable[[Canvas, Material], None]
Vector = npt.NDArray[np.float64]


def block(
    corner_m: Vector, right_m: Vector, down_m: Vector, depth_m: float, paint: Paint, top: Paint
) -> Iterator[Panel]:
    """Six sides of a cuboid, given by its front as it is seen: upper left corner and edges; ``depth_m`` behind it."""
    out = depth_m * Rectangle(corner_m, right_m, down_m).normal
    sides = (
        (corner_m, right_m, down_m),
        (corner_m + right_m, -out, down_m),
        (corner_m + right_m - out, -right_m, down_m),
        (corner_m - out, out, down_m),
        (corner_m + down_m, right_m, -out),
    )
    for side in sides:
        yield Panel(Rectangle(*side), paint)
    yield Panel(Rectangle(corner_m - out, right_m, out), top)


def box(
    x_m: float,
    y_m: float,
    size_m: tuple[float, float, float],
    paint: Paint,
    top: Paint | None = None,
    yaw_deg: float = 0.0,
    base_m: float = 0.0,
) -> Iterator[Panel]:
    """A box of width, depth and height on the ground (or at ``base_m``), its middle at x, y, its front facing south."""
    width, depth, height = size_m
    yaw = np.radians(yaw_deg)
    right = width * np.array([np.cos(yaw), np.sin(yaw), 0.0])
    front = depth * np.array([np.sin(yaw), -np.cos(yaw), 0.0])
    corner = np.array([x_m, y_m, base_m + height]) - right / 2 + front / 2
    return block(corner, right, np.array([0.0, 0.0, -height]), depth, paint, top or paint)


def ledge(
    wall: Rectangle, at_m: tuple[float, float], size_m: tuple[float, float], depth_m: float, paint: Paint
) -> Iterator[Panel]:
    """A block that stands out from a wall; ``at_m`` is its corner, right and down on the wall."""
    right, down = wall.edge_u_m / wall.width_m, wall.edge_v_m / wall.height_m
    corner = wall.corner_m + at_m[0] * right + at_m[1] * down + depth_m * wall.normal
    return block(corner, size_m[0] * right, size_m[1] * down, depth_m, paint, paint)


def decorated(paint: Paint, *decorations: Decoration) -> Paint:
    """Return the paint with decorations pasted on it, in this order."""

    def decorated_paint(canvas: Canvas) -> Material:
        material = paint(canvas)
        for decorate in decorations:
            decorate(canvas, material)
        return material

    return decorated_paint


def posters(places_m: Sequence[tuple[float, float, float, float]], wear: float = 0.35) -> Decoration:
    """Bills at (left, top, width, height)."""

    def decorate(canvas: Canvas, material: Material) -> None:
        for left, top, width, height in places_m:
            decals.paste(canvas, material, decals.poster(canvas, width, height), left, top, wear)

    return decorate


def windows(places_m: Sequence[tuple[float, float, float, float]], frame: Colour) -> Decoration:
    """Windows at (left, top, width, height)."""

    def decorate(canvas: Canvas, material: Material) -> None:
        for left, top, width, height in places_m:
            decals.paste(canvas, material, decals.window(canvas, width, height, frame), left, top, 0.0, -0.03)

    return decorate


def lettering(text: str, left_m: float, top_m: float, width_m: float, colour: Colour, wear: float = 0.5) -> Decoration:
    """Painted letters."""

    def decorate(canvas: Canvas, material: Material) -> None:
        decals.paste(canvas, material, decals.lettering(canvas, text, width_m, colour), left_m, top_m, wear)

    return decorate


def fallen_leaves(per_square_metre: float) -> Decoration:
    """Leaves that the wind has swept together here and there."""

    def decorate(canvas: Canvas, material: Material) -> None:
        density = 0.5 + 0.7 * canvas.fractal(1.8, 4)
        picture = decals.leaves(canvas, per_square_metre, decals.FALLEN_LEAVES, density)
        decals.paste(canvas, material, picture, 0.0, 0.0, wear=0.0)

    return decorate


def ivy(left_m: float, width_m: float, height_m: float) -> Decoration:
    """Ivy that climbs from the foot of a wall around ``left_m``, about so wide and high."""

    def decorate(canvas: Canvas, material: Material) -> None:
        aside = np.abs(canvas.x - np.float32(left_m)) / np.float32(width_m)
        up = (canvas.height_m - canvas.y) / np.float32(height_m)
        density = 6 * (1.0 - up - aside**2 + 0.45 * canvas.fractal(0.8, 5))
        picture = decals.leaves(canvas, 700.0, decals.IVY_LEAVES, density)
        decals.paste(canvas, material, picture, 0.0, 0.0, wear=0.0)
        material.height_m[...] += 0.01 * canvas.noise(0.05) * (density > 0.5)

    return decorate
