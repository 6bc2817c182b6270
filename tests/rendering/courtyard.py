"""A paved yard between old walls, with crates, a container and a shed: the place of the demo.

Frame of the yard: metres, x east, y north, z up, origin on the ground in the south-west corner.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import numpy as np
from tests.rendering import materials
from tests.rendering.blocks import (
    Paint,
    block,
    box,
    decorated,
    fallen_leaves,
    ivy,
    ledge,
    lettering,
    posters,
    windows,
)
from tests.rendering.canvas import Canvas, Material, smooth_step
from tests.rendering.light import Light, Panel, light_panels
from tests.rendering.scene import Rectangle, Scene, Sky

from rangesfm.demo.survey import IN_YARD_M

WIDTH_M = 14.0
DEPTH_M = 11.0

_TEXEL_M = 0.006  # for the walls; smaller things are a little finer

_FRESH_PLANKS = partial(materials.planks, palette=materials.FRESH_WOOD)
_UPRIGHT_PLANKS = partial(materials.planks, palette=materials.FRESH_WOOD, upright=True)
_GREY_PLANKS = partial(materials.planks, palette=materials.GREY_WOOD)
_CRATE = partial(materials.planks, palette=materials.FRESH_WOOD, width_m=0.11, framed_m=0.09)
_OLD_CRATE = partial(materials.planks, palette=materials.GREY_WOOD, width_m=0.14, framed_m=0.10)
_STONE = partial(materials.concrete, board_m=0.8)
_WHITE = (206, 202, 192)

_NORTH = Rectangle(np.array([0, DEPTH_M, 4.2]), np.array([WIDTH_M, 0, 0]), np.array([0, 0, -4.2]))
_SOUTH = Rectangle(np.array([WIDTH_M, 0, 3.8]), np.array([-WIDTH_M, 0, 0]), np.array([0, 0, -3.8]))
_WEST = Rectangle(np.array([0, 0, 3.1]), np.array([0, DEPTH_M, 0]), np.array([0, 0, -3.1]))
_EAST = Rectangle(np.array([WIDTH_M, DEPTH_M, 3.5]), np.array([0, -DEPTH_M, 0]), np.array([0, 0, -3.5]))

_NORTH_WINDOWS = ((6.2, 1.2, 1.1, 1.5), (8.2, 1.2, 1.1, 1.5), (12.0, 1.2, 1.1, 1.5))
_SOUTH_WINDOWS = ((2.0, 1.0, 1.3, 1.4), (7.9, 1.0, 1.3, 1.4))


def courtyard() -> Scene:
    """Build, paint and light the yard."""
    parts = (_ground, _walls, _on_the_walls, _houses_beyond, _along_the_walls, _middle, _radios)
    panels = [panel for part in parts for panel in part()]
    rectangles = [panel.rectangle for panel in panels]
    shown = [index for index, rectangle in enumerate(rectangles) if _faces_the_yard(rectangle)]
    texels_m = [_TEXEL_M * _coarseness(rectangle) for rectangle in rectangles]
    surfaces = light_panels(panels, shown, Light.afternoon(), texels_m)
    return Scene(surfaces, _cloudy_sky(np.random.default_rng(0)))


def _coarseness(rectangle: Rectangle) -> float:
    """Return the texel size relative to the walls': large for what is far away, small for what one can walk up to."""
    is_far = rectangle.corners_m[:, 2].max() > 4.5
    is_small = rectangle.width_m * rectangle.height_m < 8
    return 3.0 if is_far else 0.65 if is_small else 1.0


def _faces_the_yard(rectangle: Rectangle) -> bool:
    """Return whether someone who walks in the yard could see its front."""
    where = np.array([(x, y, z) for x in (0.2, WIDTH_M - 0.2) for y in (0.2, DEPTH_M - 0.2) for z in (0.5, 2.2)])
    return bool(((where - rectangle.corner_m) @ rectangle.normal).max() > 0)


def _cloudy_sky(rng: np.random.Generator) -> Sky:
    field = Canvas((512, 512), (1 / 512, 1 / 512), rng).fractal(0.15, 7, gain=0.5)
    return Sky(0.95 * smooth_step(-0.15, 0.75, field))


def _ground() -> Iterator[Panel]:
    paint = decorated(materials.paving, lettering("27", 9.2, 5.6, 1.5, (214, 208, 190), 0.55), fallen_leaves(26))
    yard = Rectangle(np.array([0, DEPTH_M, 0]), np.array([WIDTH_M, 0, 0]), np.array([0, -DEPTH_M, 0]))
    yield Panel(yard, paint)


def _walls() -> Iterator[Panel]:
    north = decorated(
        materials.bricks,
        windows(_NORTH_WINDOWS, _WHITE),
        posters([(9.75, 2.2, 0.6, 0.85), (11.35, 2.5, 0.42, 0.6)]),
        lettering("LUMBER & TOOLS", 6.0, 0.35, 4.6, (222, 214, 190), 0.55),
    )
    south = decorated(
        partial(materials.plaster, colour=(206, 182, 132), peeled=0.85),
        windows(_SOUTH_WINDOWS, (96, 66, 48)),
        posters([(4.9, 1.5, 0.6, 0.85), (5.6, 1.7, 0.6, 0.85), (6.5, 1.45, 0.84, 1.2), (10.4, 1.6, 0.6, 0.85)]),
        lettering("No parking", 10.1, 1.0, 1.9, (150, 40, 34), 0.6),
        ivy(11.4, 1.1, 2.6),
    )
    west = decorated(
        materials.concrete,
        posters([(3.2, 1.1, 0.84, 1.19), (4.1, 1.2, 0.6, 0.85), (7.6, 1.3, 0.6, 0.85), (8.3, 1.15, 0.6, 0.85)]),
        lettering("YARD 27", 5.0, 1.05, 2.3, (44, 84, 140), 0.45),
        lettering("meet me here", 1.8, 2.35, 2.6, (150, 60, 64), 0.4),
        ivy(8.9, 0.9, 1.9),
    )
    east = decorated(
        partial(materials.bricks, palette=materials.YELLOW_BRICK),
        posters([(1.9, 1.4, 0.6, 0.85), (7.7, 1.2, 0.6, 0.85), (8.6, 1.5, 0.42, 0.6)]),
        lettering("GATE B", 4.6, 0.25, 1.6, (40, 44, 60), 0.5),
        ivy(9.6, 1.0, 3.2),
    )
    for wall, paint in ((_NORTH, north), (_SOUTH, south), (_WEST, west), (_EAST, east)):
        yield Panel(wall, paint)
        yield from ledge(wall, (0.0, -0.10), (wall.width_m, 0.12), 0.07, _STONE)


def _on_the_walls() -> Iterator[Panel]:
    """Things that stand out from the walls: sills, lintels, doors, pipes."""
    for wall, places in ((_NORTH, _NORTH_WINDOWS), (_SOUTH, _SOUTH_WINDOWS)):
        for left, top, width, height in places:
            yield from ledge(wall, (left - 0.10, top + height), (width + 0.20, 0.07), 0.12, _STONE)
            yield from ledge(wall, (left - 0.12, top - 0.18), (width + 0.24, 0.18), 0.03, _STONE)
    green_door = partial(materials.planks, palette=materials.GREEN_PAINT, width_m=0.14, upright=True)
    yield from ledge(_NORTH, (10.45, 2.0), (0.8, 2.2), 0.05, decorated(green_door, posters([(0.22, 0.5, 0.3, 0.42)])))
    yield from ledge(_NORTH, (10.2, 4.05), (1.3, 0.15), 0.55, _STONE)
    gate = partial(materials.planks, palette=materials.GREY_WOOD, width_m=0.16, upright=True, framed_m=0.16)
    yield from ledge(_EAST, (4.0, 0.8), (1.45, 2.7), 0.06, gate)
    yield from ledge(_EAST, (5.47, 0.8), (1.45, 2.7), 0.06, decorated(gate, posters([(0.4, 0.7, 0.6, 0.85)])))
    red_door = partial(materials.steel, colour=(120, 44, 38), rust=0.8)
    yield from ledge(_SOUTH, (3.6, 1.65), (0.95, 2.15), 0.05, red_door)
    zinc = partial(materials.steel, colour=(140, 144, 146), rust=0.9)
    for wall, left in ((_NORTH, 5.75), (_NORTH, 13.6), (_SOUTH, 0.4), (_EAST, 3.4)):
        yield from ledge(wall, (left, 0.05), (0.09, wall.height_m - 0.15), 0.10, zinc)
    meter_box = decorated(
        partial(materials.smooth_paint, colour=(168, 170, 160)), posters([(0.06, 0.1, 0.2, 0.14)], 0.1)
    )
    yield from ledge(_WEST, (10.0, 1.3), (0.55, 0.75), 0.2, meter_box)
    yield from ledge(_SOUTH, (9.6, 2.1), (0.35, 0.5), 0.16, partial(materials.smooth_paint, colour=(190, 160, 50)))


def _houses_beyond() -> Iterator[Panel]:
    rows = [(left, top, 1.1, 1.6) for top in (0.9, 3.4) for left in (1.2, 3.6, 6.1, 8.5, 11.2, 13.6)]
    north_house = decorated(partial(materials.plaster, colour=(170, 150, 140), peeled=1.1), windows(rows, _WHITE))
    yield from box(9.5, 20.0, (17.0, 6.0, 9.6), north_house)
    tiles = materials.roof_tiles
    yield from block(
        np.array([19.0, 17.0, 6.9]), np.array([0, -14.0, 0]), np.array([-3.6, 0, -3.2]), 0.2, tiles, tiles
    )  # fmt: skip
    brick_house = decorated(partial(materials.bricks, palette=materials.RED_BRICK), windows(rows[:10], (80, 60, 50)))
    yield from box(4.0, -9.0, (15.0, 5.0, 8.2), brick_house, yaw_deg=6.0)
    tower = decorated(_STONE, windows([(0.6, 1.0, 1.0, 1.6), (2.3, 1.0, 1.0, 1.6)], _WHITE))
    yield from box(-9.0, 7.0, (5.0, 4.5, 9.0), tower, yaw_deg=20.0)
    yield from box(-12.0, -1.0, (6.0, 7.0, 6.5), decorated(north_house), yaw_deg=-8.0)


def _along_the_walls() -> Iterator[Panel]:
    blue = partial(materials.steel, colour=(40, 84, 130), corrugation_m=0.24, rust=0.72)
    signed = decorated(blue, lettering("HARBOUR LINE", 0.35, 0.45, 2.4, (226, 226, 220), 0.4))
    yield from box(3.2, 10.3, (4.4, 1.3, 2.1), signed, yaw_deg=0.0)
    shed = partial(materials.planks, palette=materials.GREY_WOOD, width_m=0.13, upright=True)
    shed_window = decorated(shed, windows([(0.55, 0.5, 0.7, 0.6)], (206, 202, 192)), posters([(0.1, 1.3, 0.42, 0.6)]))
    yield from box(1.05, 0.85, (1.9, 1.5, 2.0), shed_window)
    yield from block(
        np.array([-0.05 + 0.1, -0.05, 2.12]), np.array([2.15, 0, 0]), np.array([0, 1.85, -0.08]), 0.05,
        partial(materials.steel, colour=(120, 122, 120), corrugation_m=0.15, rust=0.6), _GREY_PLANKS,
    )  # fmt: skip
    yield from box(12.9, 0.95, (1.15, 0.9, 1.0), decorated(_CRATE, lettering("FRAGILE", 0.25, 0.38, 0.6, (40, 36, 32))))
    yield from box(12.85, 0.9, (0.75, 0.6, 0.55), _OLD_CRATE, yaw_deg=17.0, base_m=1.0)
    yield from box(11.75, 0.7, (0.7, 0.7, 0.6), _OLD_CRATE, yaw_deg=-12.0)
    for layer in range(5):
        yield from box(0.85, 4.3, (1.2, 1.0, 0.12), _FRESH_PLANKS, yaw_deg=3.0 * (-1) ** layer, base_m=0.15 * layer)
    yield from box(6.3, 0.45, (1.9, 0.42, 0.07), _FRESH_PLANKS, base_m=0.42)
    for x in (5.6, 7.0):
        yield from box(x, 0.45, (0.12, 0.36, 0.42), _STONE)
    for y in (3.9, 7.3):
        yield from box(12.1, y, (0.32, 0.32, 2.75), materials.concrete, yaw_deg=2.0)
    yield from box(12.95, 5.6, (2.05, 4.2, 0.14), _GREY_PLANKS, partial(materials.concrete), base_m=2.75)
    yield from box(12.9, 9.9, (0.9, 0.7, 1.1), partial(materials.steel, colour=(56, 96, 62), rust=0.7))
    yield from box(11.9, 10.3, (0.55, 0.45, 0.4), materials.cardboard, yaw_deg=14.0)
    yield from box(7.7, 10.55, (1.8, 0.5, 0.5), partial(materials.bricks, damp_m=0.2), materials.soil)
    for x, lean, length in ((8.9, 0.55, 2.9), (9.15, 0.7, 2.5), (9.5, 0.5, 2.2)):
        height = np.sqrt(length**2 - lean**2)
        corner = np.array([x, DEPTH_M - 0.12, height])
        yield from block(
            corner, np.array([0.18, 0.02, 0]), np.array([0, -lean, -height]), 0.03, _UPRIGHT_PLANKS, _STONE
        )


def _middle() -> Iterator[Panel]:
    carton = decorated(materials.cardboard, lettering("THIS SIDE UP", 0.05, 0.06, 0.3, (50, 40, 36), 0.2))
    yield from box(
        6.1, 5.2, (1.05, 1.0, 0.9), decorated(_CRATE, lettering("DEPOT 4", 0.2, 0.3, 0.6, (46, 40, 36))), yaw_deg=20
    )
    yield from box(6.05, 5.25, (0.6, 0.6, 0.5), _OLD_CRATE, yaw_deg=48, base_m=0.9)
    yield from box(7.5, 6.1, (1.3, 0.8, 0.62), _OLD_CRATE, yaw_deg=-14)
    yield from box(7.3, 6.15, (0.5, 0.42, 0.38), carton, yaw_deg=5, base_m=0.62)
    yield from box(7.85, 6.0, (0.4, 0.35, 0.3), carton, yaw_deg=-30, base_m=0.62)
    planter = partial(materials.bricks, palette=materials.YELLOW_BRICK, damp_m=0.15)
    yield from box(8.2, 4.7, (1.7, 0.8, 0.48), planter, materials.soil, yaw_deg=12)
    yield from box(5.0, 6.5, (0.7, 0.55, 0.5), _STONE, yaw_deg=35)
    yield from box(7.0, 4.3, (0.45, 0.45, 0.4), carton, yaw_deg=-20)
    post = decorated(
        partial(materials.planks, palette=materials.GREY_WOOD, upright=True), posters([(0.01, 0.5, 0.11, 0.16)], 0.2)
    )
    yield from box(8.5, 5.7, (0.13, 0.13, 2.0), post, yaw_deg=25)
    yield from box(
        8.5, 5.7, (0.80, 0.15, 0.42), decorated(_sign, posters([(0.03, 0.03, 0.74, 0.36)], 0.2)), yaw_deg=25, base_m=2.0
    )


def _sign(canvas: Canvas) -> Material:
    return materials.smooth_paint(canvas, (200, 196, 186))


def _radios() -> Iterator[Panel]:
    """A small white case around each anchor's antenna."""
    case: Paint = partial(materials.smooth_paint, colour=(226, 226, 222))
    for x, y, z in IN_YARD_M.values():
        yield from box(x, y, (0.08, 0.08, 0.12), case, base_m=z - 0.06)
