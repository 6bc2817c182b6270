"""Procedural building materials: each function paints a canvas, and no two places of one look alike."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from tests.rendering.canvas import Canvas, FloatArray, Material, smooth_step

Colour = tuple[int, int, int]

RED_BRICK: tuple[Colour, ...] = ((158, 82, 58), (140, 68, 50), (172, 98, 70), (120, 62, 50), (182, 112, 82))
YELLOW_BRICK: tuple[Colour, ...] = ((196, 164, 112), (182, 148, 98), (206, 178, 130), (168, 134, 92))
GREY_STONE: tuple[Colour, ...] = ((142, 138, 130), (122, 120, 116), (160, 154, 142), (134, 126, 114), (110, 108, 106))
FRESH_WOOD: tuple[Colour, ...] = ((176, 146, 108), (162, 130, 94), (188, 158, 120), (150, 120, 86))
GREY_WOOD: tuple[Colour, ...] = ((132, 118, 100), (116, 104, 90), (146, 130, 110), (104, 94, 82))
GREEN_PAINT: tuple[Colour, ...] = ((64, 92, 74), (58, 84, 68), (70, 98, 80))
ROOF_TILE: tuple[Colour, ...] = ((140, 96, 78), (124, 84, 68), (150, 108, 90), (108, 80, 70))


def linear(colour: Colour) -> FloatArray:
    """(3, 1, 1) linear reflectance of a colour given as sRGB bytes."""
    return ((np.array(colour) / 255.0) ** 2.2).astype(np.float32)[:, None, None]


def bricks(canvas: Canvas, palette: Sequence[Colour] = RED_BRICK, damp_m: float = 0.6) -> Material:
    """Brickwork in running bond, weathered, darker where damp rises from the ground."""
    pattern = _courses(canvas, height_m=0.077, length_m=0.25, length_variation=0.06, wobble_m=0.004)
    colour = _colour_of_cells(canvas, pattern, palette, variation=0.22)
    colour *= 1 + 0.14 * canvas.fractal(0.05, 4) + 0.10 * canvas.grain()
    face = smooth_step(0.003, 0.009, pattern.edge_distance_m + 0.003 * canvas.noise(0.02))
    mortar = linear((168, 160, 148)) * (1 + 0.2 * canvas.fractal(0.1, 4) + 0.08 * canvas.grain())
    albedo = mortar + face * (colour - mortar)
    bloom = smooth_step(0.5, 1.1, canvas.fractal(0.7, 5))
    albedo += (0.35 * bloom) * (linear((196, 188, 178)) - albedo)
    _weather(canvas, albedo, damp_m)
    height = 0.007 * face + 0.0012 * canvas.noise(0.012) + 0.004 * pattern.per_cell(canvas)
    return Material(albedo, height)


def plaster(canvas: Canvas, colour: Colour, peeled: float = 0.9) -> Material:
    """Painted plaster with stains and cracks; where it has come off, bricks show (more for a lower ``peeled``)."""
    stains = canvas.fractal(1.3, 5)
    paint = linear(colour) * (1 + 0.10 * stains + 0.05 * canvas.fractal(0.08, 4) + 0.05 * canvas.grain())
    paint *= 1 - 0.35 * _cracks(canvas, 1.1, 0.012)
    repairs = smooth_step(0.62, 0.66, canvas.fractal(0.9, 3))
    paint += (0.5 * repairs) * (linear((170, 164, 152)) - paint)
    low = np.clip(1 - (canvas.height_m - canvas.y) / 1.6, 0, 1)
    gone = smooth_step(peeled, peeled + 0.03, canvas.fractal(0.8, 6) + 0.35 * low)
    under = bricks(canvas, damp_m=0.7)
    albedo = paint + gone * (under.albedo * 0.9 - paint)
    _weather(canvas, albedo, 0.7)
    height = (1 - gone) * 0.012 + gone * under.height_m + 0.0015 * canvas.fractal(0.05, 3)
    return Material(albedo, height)


def concrete(canvas: Canvas, board_m: float = 1.25) -> Material:
    """Cast concrete: marks of the formwork, pores, stains, hairline cracks."""
    pattern = _courses(canvas, height_m=board_m, length_m=2.4, length_variation=0.0, wobble_m=0.0)
    tone = 1 + 0.08 * pattern.per_cell(canvas) + 0.14 * canvas.fractal(0.7, 6) + 0.06 * canvas.grain()
    tone *= 1 - 0.30 * smooth_step(0.006, 0.002, pattern.edge_distance_m)
    tone *= 1 - 0.25 * _cracks(canvas, 1.5, 0.007)
    pores = smooth_step(0.72, 0.85, canvas.noise(0.014)) * smooth_step(-0.4, 0.6, canvas.fractal(0.4, 3))
    tone *= 1 - 0.55 * pores
    albedo = linear((158, 154, 146)) * tone
    patches = smooth_step(0.7, 0.75, canvas.fractal(0.5, 5))
    albedo += (0.35 * patches) * (linear((112, 108, 100)) - albedo)
    _weather(canvas, albedo, 0.4)
    height = -0.004 * pores - 0.004 * smooth_step(0.008, 0.002, pattern.edge_distance_m) + 0.001 * canvas.noise(0.02)
    return Material(albedo, height)


def paving(canvas: Canvas, stone_m: float = 0.42) -> Material:
    """Stone slabs of uneven length with moss in the joints, cracks, dirt and puddle stains."""
    pattern = _courses(canvas, stone_m, 1.35 * stone_m, length_variation=0.5, wobble_m=0.012)
    colour = _colour_of_cells(canvas, pattern, GREY_STONE, variation=0.22)
    colour *= 1 + 0.16 * canvas.fractal(0.12, 5) + 0.10 * canvas.grain()
    colour *= 1 - 0.5 * _cracks(canvas, 0.8, 0.009)
    specks = smooth_step(0.70, 0.82, canvas.noise(0.022))
    colour += (0.5 * specks) * (linear((196, 190, 178)) - colour)
    face = smooth_step(0.004, 0.014, pattern.edge_distance_m + 0.006 * canvas.noise(0.03))
    moss = smooth_step(-0.1, 0.5, canvas.fractal(0.9, 4))
    joint = linear((96, 86, 70)) + moss * (linear((82, 92, 58)) - linear((96, 86, 70)))
    joint = joint * (1 + 0.4 * canvas.grain())
    albedo = joint + face * (colour - joint)
    dirt = smooth_step(0.1, 1.0, canvas.fractal(1.7, 6))
    albedo += (0.55 * dirt) * (linear((92, 82, 68)) - albedo)
    albedo *= 1 - 0.40 * smooth_step(0.62, 0.70, canvas.fractal(1.1, 5))
    height = 0.008 * face + 0.010 * pattern.per_cell(canvas) * face + 0.003 * canvas.fractal(0.06, 3)
    return Material(albedo, height)


def planks(
    canvas: Canvas,
    palette: Sequence[Colour] = FRESH_WOOD,
    width_m: float = 0.12,
    upright: bool = False,
    framed_m: float = 0.0,
) -> Material:
    """Boards with grain, knots and nails, across or ``upright``; ``framed_m`` wide boards around a crate's side."""
    if upright:
        turned = planks(canvas.transposed(), palette, width_m)
        material = Material(turned.albedo.transpose(0, 2, 1), turned.height_m.T)
    else:
        material = _boards(canvas, palette, width_m)
    if framed_m > 0:
        frame = _boards(canvas, palette, framed_m)
        upright_frame = _boards(canvas.transposed(), palette, framed_m)
        from_side = np.minimum(canvas.x, canvas.width_m - canvas.x)
        from_end = np.minimum(canvas.y, canvas.height_m - canvas.y)
        for inside, wood, tone in (
            (from_end - framed_m, frame.albedo, 1.0),
            (from_side - framed_m, upright_frame.albedo.transpose(0, 2, 1), 0.93),
        ):
            on_frame = np.broadcast_to(inside < 0, canvas.shape)
            gap = smooth_step(0.009, 0.0, np.abs(np.broadcast_to(inside, canvas.shape)))
            np.copyto(material.albedo, tone * wood, where=on_frame)
            np.multiply(material.albedo, 1 - 0.6 * gap, out=material.albedo)
            material.height_m[...] = np.where(on_frame, 0.02, material.height_m)
    return material


def steel(canvas: Canvas, colour: Colour, corrugation_m: float = 0.0, rust: float = 0.75) -> Material:
    """Painted sheet metal, corrugated if asked, with scratches, chipped paint and running rust."""
    wave = np.zeros((1, canvas.shape[1]), dtype=np.float32)
    if corrugation_m > 0:
        wave = np.clip(1.6 * np.sin(2 * np.pi * canvas.x / np.float32(corrugation_m)), -1, 1).astype(np.float32)
    paint = linear(colour) * (1 + 0.10 * canvas.fractal(0.8, 5) + 0.04 * canvas.grain() + 0.06 * wave)
    faded = smooth_step(0.2, 1.1, canvas.fractal(0.6, 5, stretch_y=2.5))
    paint += (0.22 * faded) * (linear((176, 172, 164)) - paint)
    edge = np.minimum(np.minimum(canvas.x, canvas.width_m - canvas.x), np.minimum(canvas.y, canvas.height_m - canvas.y))
    worn = canvas.fractal(0.35, 6) + 0.5 * np.exp(-edge / np.float32(0.08))
    chipped = smooth_step(rust, rust + 0.06, worn)
    runs = smooth_step(0.55, 1.2, canvas.fractal(0.05, 4, stretch_y=14.0)) * smooth_step(-0.3, 0.9, worn)
    brown = linear((116, 66, 40)) * (1 + 0.35 * canvas.fractal(0.03, 3) + 0.15 * canvas.grain())
    albedo = paint + np.clip(chipped + 0.55 * runs, 0, 1) * (brown - paint)
    _weather(canvas, albedo, 0.25)
    height = 0.018 * wave - 0.001 * chipped + 0.0008 * canvas.noise(0.02)
    return Material(albedo, height.astype(np.float32))


def cardboard(canvas: Canvas) -> Material:
    """A carton's side: faint corrugation, dents, tape along the middle."""
    tone = 1 + 0.07 * canvas.fractal(0.2, 5) + 0.05 * canvas.grain() + 0.03 * np.sin(canvas.x * np.float32(900))
    albedo = linear((168, 138, 104)) * tone.astype(np.float32)
    tape = smooth_step(0.03, 0.026, np.abs(canvas.y - canvas.height_m / 2) + 0.004 * canvas.noise(0.05))
    albedo += (0.5 * tape) * (linear((198, 172, 126)) - albedo)
    stains = smooth_step(0.6, 0.9, canvas.fractal(0.25, 5))
    albedo *= 1 - 0.35 * stains
    return Material(albedo, 0.006 * canvas.fractal(0.15, 4))


def soil(canvas: Canvas) -> Material:
    """Earth with pebbles and weeds."""
    lumps = canvas.fractal(0.06, 5)
    albedo = linear((88, 70, 52)) * (1 + 0.35 * lumps + 0.25 * canvas.grain())
    weeds = smooth_step(0.3, 0.7, canvas.fractal(0.18, 5))
    albedo += weeds * (linear((94, 98, 68)) * (1 + 0.6 * canvas.grain()) - albedo)
    pebbles = smooth_step(0.72, 0.8, canvas.noise(0.03))
    albedo += pebbles * (linear((164, 156, 144)) - albedo)
    return Material(albedo, 0.02 * lumps + 0.02 * pebbles)


def roof_tiles(canvas: Canvas) -> Material:
    """Rows of clay tiles with lichen."""
    pattern = _courses(canvas, height_m=0.30, length_m=0.22, length_variation=0.05, wobble_m=0.008)
    colour = _colour_of_cells(canvas, pattern, ROOF_TILE, variation=0.3)
    colour *= 1 + 0.2 * canvas.fractal(0.2, 4) + 0.1 * canvas.grain()
    colour *= 0.45 + 0.55 * smooth_step(0.0, 0.03, pattern.edge_distance_m)
    lichen = smooth_step(0.5, 1.0, canvas.fractal(0.5, 5))
    colour += (0.5 * lichen) * (linear((150, 150, 120)) - colour)
    return Material(colour, 0.02 * smooth_step(0.0, 0.04, pattern.edge_distance_m))


def smooth_paint(canvas: Canvas, colour: Colour) -> Material:
    """Evenly painted, slightly dirty: frames, sills, small devices."""
    tone = 1 + 0.08 * canvas.fractal(0.15, 5) + 0.04 * canvas.grain()
    return Material(linear(colour) * tone, 0.0008 * canvas.noise(0.03))


@dataclass(frozen=True)
class _Courses:
    """Rows of stones: which stone a texel belongs to and how far its nearest edge is."""

    cell: npt.NDArray[np.int32]
    num_cells: int
    edge_distance_m: FloatArray

    def per_cell(self, canvas: Canvas) -> FloatArray:
        """(h, w) one random value in [-1, 1] per stone."""
        return (canvas.rng.random(self.num_cells, dtype=np.float32) * 2 - 1)[self.cell]


def _courses(canvas: Canvas, height_m: float, length_m: float, length_variation: float, wobble_m: float) -> _Courses:
    """Divide the canvas into rows of stones, every other row shifted by about half a stone."""
    y = np.broadcast_to(canvas.y, canvas.shape)
    column = np.broadcast_to(np.arange(canvas.shape[1], dtype=np.int32), canvas.shape)
    if wobble_m > 0:
        y = y + np.float32(wobble_m) * canvas.noise(0.4)
        shift = canvas.noise(0.3) * np.float32(wobble_m / canvas.texel_m[1])
        column = np.clip(column + np.rint(shift).astype(np.int32), 0, canvas.shape[1] - 1)
    num_rows = int(np.ceil(canvas.height_m / height_m)) + 2
    row = np.clip(np.floor(y / np.float32(height_m)).astype(np.int32) + 1, 0, num_rows - 1)
    cells, distances, num_cells = _stones_of_rows(canvas, num_rows, length_m, length_variation)
    into_row = y - (row - 1) * np.float32(height_m)
    edge_distance = np.minimum(np.minimum(into_row, np.float32(height_m) - into_row), distances[row, column])
    return _Courses(cells[row, column], num_cells, edge_distance)


def _stones_of_rows(
    canvas: Canvas, num_rows: int, length_m: float, length_variation: float
) -> tuple[npt.NDArray[np.int32], FloatArray, int]:
    """Return each texel row's and column's stone number and distance to its ends, and the number of stones."""
    x = canvas.x[0]
    cells = np.empty((num_rows, canvas.shape[1]), dtype=np.int32)
    distances = np.empty((num_rows, canvas.shape[1]), dtype=np.float32)
    num_stones = int(canvas.width_m / (length_m * (1 - length_variation / 2))) + 3
    for row in range(num_rows):
        lengths = length_m * (1 + length_variation * (canvas.rng.random(num_stones) - 0.5))
        start = -length_m * (0.5 * (row % 2) + 0.2 + 0.2 * canvas.rng.random())
        joints = start + np.concatenate([[0.0], np.cumsum(lengths)])
        index = np.clip(np.searchsorted(joints, x) - 1, 0, num_stones - 1)
        cells[row] = index + row * num_stones
        distances[row] = np.minimum(x - joints[index], joints[index + 1] - x)
    return cells, distances, num_rows * num_stones


def _colour_of_cells(canvas: Canvas, pattern: _Courses, palette: Sequence[Colour], variation: float) -> FloatArray:
    """(3, h, w) a colour of the palette for each stone, lighter or darker by up to ``variation``."""
    chosen = _pick(canvas, palette, pattern.num_cells)
    chosen *= 1 + np.float32(variation) * (canvas.rng.random(pattern.num_cells, dtype=np.float32) * 2 - 1)
    return chosen.take(pattern.cell, axis=1)


def _pick(canvas: Canvas, palette: Sequence[Colour], count: int) -> FloatArray:
    """(3, count) linear colours drawn from the palette."""
    colours = np.concatenate([linear(colour)[:, :, 0] for colour in palette], axis=1)
    return colours[:, canvas.rng.integers(len(palette), size=count)]


def _boards(canvas: Canvas, palette: Sequence[Colour], width_m: float) -> Material:
    """Boards across the canvas."""
    count = max(1, round(canvas.height_m / width_m))
    width = np.float32(canvas.height_m / count)
    position = canvas.y / width
    board = np.minimum(position.astype(np.int32), count - 1)
    colours = _pick(canvas, palette, count) * (1 + 0.2 * (canvas.rng.random(count, dtype=np.float32) * 2 - 1))
    grain = canvas.fractal(0.03, 5, stretch_x=16.0)
    hearts = _knots(canvas)
    # Rings: level lines of a field drawn out along the board and bent around a few knots.
    rings = np.sin(9 * (canvas.noise(0.16, stretch_x=6.0) + 0.8 * hearts) + 2 * grain)
    tone = 1 + 0.13 * grain + 0.09 * rings + 0.09 * canvas.fractal(0.012, 2, stretch_x=5.0) + 0.08 * canvas.grain()
    albedo = colours[:, board] * tone
    knots = smooth_step(0.55, 0.85, hearts)
    albedo += (0.75 * knots) * (linear((74, 50, 32)) - albedo)
    albedo *= 1 - 0.3 * smooth_step(0.3, 1.0, canvas.fractal(0.4, 5))
    into_board = (position - board) * width
    gap_distance = np.minimum(into_board, width - into_board) + 0.002 * canvas.noise(0.1)
    face = smooth_step(0.001, 0.007, gap_distance)
    albedo *= 0.25 + 0.75 * face
    for nail_x in (0.05, canvas.width_m - 0.05):
        nail_y = into_board - width / 2
        nail = smooth_step(0.007, 0.004, np.hypot(np.abs(canvas.x - np.float32(nail_x)), nail_y))
        albedo *= 1 - 0.7 * nail
    height = 0.006 * face + 0.001 * grain
    return Material(albedo, height)


def _knots(canvas: Canvas) -> FloatArray:
    """(h, w) in [0, 1]: 1 at the heart of a few knots, falling off around them."""
    field = np.zeros(canvas.shape, dtype=np.float32)
    for _ in range(int(1 + 4 * canvas.width_m * canvas.height_m)):
        size = 0.012 + 0.02 * canvas.rng.random()
        center_x, center_y = canvas.rng.random() * canvas.width_m, canvas.rng.random() * canvas.height_m
        columns = np.flatnonzero(np.abs(canvas.x[0] - center_x) < 5 * size)
        rows = np.flatnonzero(np.abs(canvas.y[:, 0] - center_y) < 3 * size)
        along = np.exp(-(((canvas.x[:, columns] - np.float32(center_x)) / np.float32(1.6 * size)) ** 2))
        across = np.exp(-(((canvas.y[rows] - np.float32(center_y)) / np.float32(size)) ** 2))
        field[np.ix_(rows, columns)] += along * across
    return field


def _cracks(canvas: Canvas, cell_m: float, width: float) -> FloatArray:
    """(h, w) in [0, 1]: 1 on thin wandering lines, the zero level of a field, present here and there."""
    line = smooth_step(width, 0.3 * width, np.abs(canvas.fractal(cell_m, 6)))
    return line * smooth_step(0.0, 0.4, canvas.noise(1.3 * cell_m))


def _weather(canvas: Canvas, albedo: FloatArray, damp_m: float) -> None:
    """Darken in place: damp at the foot, dirt run down by rain."""
    above_foot = canvas.height_m - canvas.y + 0.25 * canvas.fractal(0.5, 4)
    albedo *= 1 - 0.35 * smooth_step(damp_m, 0.3 * damp_m, above_foot)
    runs = smooth_step(0.35, 1.2, canvas.fractal(0.12, 5, stretch_y=16.0))
    albedo *= 1 - 0.30 * runs
