"""Things on walls: posters, signs, windows, doors, fallen leaves; drawn, worn and pasted on a material."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw, ImageFont
from tests.rendering.canvas import Canvas, FloatArray, Material, smooth_step
from tests.rendering.materials import Colour

WORDS = (
    "MARKET", "HARBOUR", "CONCERT", "SUMMER", "STATION", "ORCHESTRA", "GARDEN", "LIGHT", "THEATRE", "WORKSHOP",
    "CIRCUS", "NORTH", "RIVER", "OPEN AIR", "MUSEUM", "BICYCLES", "COFFEE", "VOTE", "JAZZ", "REPAIRS", "TO LET",
)  # fmt: skip
POSTER_COLOURS: tuple[Colour, ...] = (
    (172, 66, 56), (48, 80, 122), (214, 182, 84), (46, 46, 50), (226, 220, 206), (62, 118, 102), (198, 122, 72),
    (112, 72, 112), (214, 210, 198),
)  # fmt: skip
FALLEN_LEAVES: tuple[Colour, ...] = ((132, 104, 58), (146, 120, 72), (104, 74, 46), (98, 100, 58), (142, 92, 56))
IVY_LEAVES: tuple[Colour, ...] = ((40, 58, 34), (54, 74, 42), (66, 88, 48), (82, 102, 58), (48, 70, 44))


def paste(
    canvas: Canvas,
    material: Material,
    picture: Image.Image,
    left_m: float,
    top_m: float,
    wear: float = 0.3,
    relief_m: float = 0.0,
) -> None:
    """Paste an RGBA picture in place, one pixel per texel; a picture that does not fit on the canvas is left out.

    ``wear`` in [0, 1] is the share that has come off; with ``relief_m`` the picture has its own height.
    """
    row, column = max(0, round(top_m / canvas.texel_m[0])), max(0, round(left_m / canvas.texel_m[1]))
    rows, columns = slice(row, row + picture.height), slice(column, column + picture.width)
    if rows.stop > canvas.shape[0] or columns.stop > canvas.shape[1]:
        return
    pixels = np.asarray(picture, dtype=np.float32)
    patch = canvas.part((picture.height, picture.width))
    alpha = pixels[..., 3] / 255
    if wear > 0:
        alpha = alpha * smooth_step(1.5 * wear - 1.3, 1.5 * wear - 1.2, patch.fractal(0.25, 6))
    tone = 1 + 0.16 * patch.fractal(0.2, 5) + 0.06 * patch.grain()
    colour = (pixels[..., :3].transpose(2, 0, 1) / 255) ** 2.2 * tone
    # Sun and rain bleach things that hang outside.
    colour += np.float32(0.25) * (np.float32(0.35) - colour) * np.clip(wear * 2, 0, 1)
    albedo = material.albedo[:, rows, columns]
    albedo += alpha * (colour - albedo)
    height = material.height_m[rows, columns]
    height += alpha * (np.float32(relief_m) - (1 if relief_m else 0) * height)


def poster(canvas: Canvas, width_m: float, height_m: float) -> Image.Image:
    """A bill with a big word, shapes and lines of small print."""
    rng = canvas.rng
    size = _size_in_texels(canvas, width_m, height_m)
    colours = [POSTER_COLOURS[i] for i in rng.permutation(len(POSTER_COLOURS))]
    picture = Image.new("RGBA", size, (*colours[0], 255))
    draw = ImageDraw.Draw(picture)
    for colour in colours[1:5]:
        x, y = rng.random() * size[0], (0.15 + 0.5 * rng.random()) * size[1]
        radius = (0.1 + 0.25 * rng.random()) * size[0]
        shape = rng.integers(3)
        if shape == 0:
            draw.ellipse((x - radius, y - radius, x + radius, y + radius), fill=colour)
        elif shape == 1:
            draw.rectangle((x - radius, y - radius / 3, x + radius, y + radius / 2), fill=colour)
        else:
            corners = [(x + radius * np.cos(a), y + radius * np.sin(a)) for a in rng.random(3) * 2 * np.pi]
            draw.polygon(corners, fill=colour)
    _write(draw, str(rng.choice(WORDS)), (0.06 * size[0], 0.06 * size[1]), 0.88 * size[0], colours[5])
    _write(draw, str(rng.choice(WORDS)), (0.06 * size[0], 0.62 * size[1]), 0.6 * size[0], colours[6])
    for line in range(5):
        text = " ".join(str(rng.choice(WORDS)).lower() for _ in range(3)) + f" {rng.integers(10, 99)}"
        draw.text(
            (0.06 * size[0], (0.76 + 0.045 * line) * size[1]),
            text,
            fill=(*colours[5], 255),
            font=_font(max(4, size[1] // 28)),
        )
    return picture


def lettering(canvas: Canvas, text: str, width_m: float, colour: Colour) -> Image.Image:
    """Painted letters without a background, ``width_m`` long."""
    size = _size_in_texels(canvas, width_m, 0.5 * width_m)
    picture = Image.new("RGBA", size, (*colour, 0))
    bottom = _write(ImageDraw.Draw(picture), text, (0, 0), size[0], colour)
    return picture.crop((0, 0, size[0], max(1, min(size[1], bottom))))


def window(canvas: Canvas, width_m: float, height_m: float, frame: Colour) -> Image.Image:
    """A casement window: dark panes that mirror some sky, half-drawn curtains, a cross of frame."""
    rng = canvas.rng
    size = _size_in_texels(canvas, width_m, height_m)
    rows, columns = np.linspace(0, 1, size[1])[:, None], np.linspace(0, 1, size[0])[None, :]
    cloud = np.clip(0.5 + 0.5 * canvas.part((size[1], size[0])).fractal(0.5, 5), 0, 1)
    slanted = smooth_step(0.1, 0.3, (columns - 0.5 * rows + 0.3 * rng.random()).astype(np.float32))
    shade = (30 + 26 * rows + 70 * cloud**2 * (0.3 + 0.7 * slanted))[..., None] * np.array([0.92, 1.0, 1.08])
    curtain_end = 0.12 + 0.3 * rng.random()
    folds = 150 + 30 * np.sin(columns * (60 + 30 * rng.random()) + 2 * rows) - 40 * rows
    drawn = ((columns < curtain_end) | (columns > 1.05 - curtain_end))[..., None]
    shade = np.where(drawn, 0.55 * folds[..., None] * np.array([1.0, 0.97, 0.9]) + 0.3 * shade, shade)
    pixels = np.concatenate([np.clip(shade, 0, 255), np.full((size[1], size[0], 1), 255)], axis=2)
    picture = Image.fromarray(pixels.astype(np.uint8))
    draw = ImageDraw.Draw(picture)
    bar = max(1, round(0.05 / canvas.texel_m[1]))
    draw.rectangle((0, 0, size[0] - 1, size[1] - 1), outline=frame, width=bar)
    draw.rectangle((size[0] / 2 - bar / 2, 0, size[0] / 2 + bar / 2, size[1]), fill=frame)
    draw.rectangle((0, 0.32 * size[1], size[0], 0.32 * size[1] + 0.8 * bar), fill=frame)
    return picture


def leaves(canvas: Canvas, per_square_metre: float, colours: tuple[Colour, ...], density: FloatArray) -> Image.Image:
    """Leaves on a transparent ground as large as the canvas, kept with the probabilities ``density`` (h, w)."""
    rng = canvas.rng
    picture = Image.new("RGBA", (canvas.shape[1], canvas.shape[0]), (*colours[0], 0))
    draw = ImageDraw.Draw(picture)
    count = int(per_square_metre * canvas.width_m * canvas.height_m)
    rows, columns = rng.integers(canvas.shape[0], size=count), rng.integers(canvas.shape[1], size=count)
    kept = density[rows, columns] > rng.random(count)
    for row, column in zip(rows[kept], columns[kept], strict=True):
        colour = np.array(colours[rng.integers(len(colours))]) * (0.7 + 0.5 * rng.random())
        outline = _leaf_outline(rng) / canvas.texel_m[::-1] + (column, row)
        draw.polygon([(float(x), float(y)) for x, y in outline], fill=tuple(int(c) for c in np.clip(colour, 0, 255)))
    return picture


def _leaf_outline(rng: np.random.Generator) -> npt.NDArray[np.float64]:
    """(n, 2) metres around the leaf's middle."""
    length, width, turn = 0.025 + 0.045 * rng.random(), 0.4 + 0.3 * rng.random(), 2 * np.pi * rng.random()
    angle = np.linspace(0, 2 * np.pi, 11)[:-1]
    radius = length * (0.7 + 0.3 * np.cos(5 * angle) * rng.random()) * (1 + 0.15 * rng.standard_normal(10))
    x, y = radius * np.cos(angle), width * radius * np.sin(angle)
    return np.stack([x * np.cos(turn) - y * np.sin(turn), x * np.sin(turn) + y * np.cos(turn)], axis=1)


def _write(draw: ImageDraw.ImageDraw, text: str, corner: tuple[float, float], width: float, colour: Colour) -> int:
    """Write a line as wide as ``width`` pixels; return the row below it."""
    length = draw.textlength(text, font=_font(64)) / 64
    size = max(4, int(0.97 * width / length))
    draw.text(corner, text, fill=(*colour, 255), font=_font(size))
    return round(corner[1] + 1.15 * size)


@cache
def _font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    return ImageFont.load_default(size)


def _size_in_texels(canvas: Canvas, width_m: float, height_m: float) -> tuple[int, int]:
    return max(4, round(width_m / canvas.texel_m[1])), max(4, round(height_m / canvas.texel_m[0]))
