"""The area that a procedural material is painted on, with its noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.ndimage import zoom

FloatArray = npt.NDArray[np.float32]

# Textures are sized in multiples of this, so that the first mip levels halve exactly.
SIZE_MULTIPLE = 16


@dataclass(frozen=True)
class Material:
    """The appearance of a surface, seen from its front; row 0 is the upper edge.

    Attributes:
        albedo: (3, h, w) linear reflectance in [0, 1].
        height_m: (h, w) relief towards the viewer, metres.
    """

    albedo: FloatArray
    height_m: FloatArray


class Canvas:
    """A rectangle in texels; x runs right and y down from the upper left corner, in metres.

    Attributes:
        shape: rows and columns.
        texel_m: height and width of a texel.
        rng: of everything random on it.
    """

    def __init__(self, shape: tuple[int, int], texel_m: tuple[float, float], rng: np.random.Generator):
        self.shape = shape
        self.texel_m = texel_m
        self.rng = rng

    @classmethod
    def of_size(cls, width_m: float, height_m: float, texel_m: float, rng: np.random.Generator) -> Canvas:
        """A canvas of exactly this size, with texels of about ``texel_m``."""
        shape = (_num_texels(height_m, texel_m), _num_texels(width_m, texel_m))
        return cls(shape, (height_m / shape[0], width_m / shape[1]), rng)

    def transposed(self) -> Canvas:
        """A canvas whose x is this one's y."""
        return Canvas((self.shape[1], self.shape[0]), (self.texel_m[1], self.texel_m[0]), self.rng)

    def part(self, shape: tuple[int, int]) -> Canvas:
        """A canvas of other extent with the same texels."""
        return Canvas(shape, self.texel_m, self.rng)

    @property
    def width_m(self) -> float:
        return self.shape[1] * self.texel_m[1]

    @property
    def height_m(self) -> float:
        return self.shape[0] * self.texel_m[0]

    @property
    def x(self) -> FloatArray:
        """(1, w) metres from the left edge."""
        return _centers(self.shape[1], self.texel_m[1])[None, :]

    @property
    def y(self) -> FloatArray:
        """(h, 1) metres from the upper edge."""
        return _centers(self.shape[0], self.texel_m[0])[:, None]

    def noise(self, cell_m: float, stretch_x: float = 1.0, stretch_y: float = 1.0) -> FloatArray:
        """(h, w) smooth random field in [-1, 1] whose bumps are about ``cell_m`` wide."""
        return self.fractal(cell_m, 1, stretch_x=stretch_x, stretch_y=stretch_y)

    def fractal(
        self, cell_m: float, octaves: int = 4, gain: float = 0.55, stretch_x: float = 1.0, stretch_y: float = 1.0
    ) -> FloatArray:
        """(h, w) sum of noises, each of half the cell and ``gain`` times the amplitude of the last; about in [-1, 1].

        The octaves are added on the lattice of the coarser ones, refined by two each time, so that only the finest is
        interpolated to all texels.
        """
        cell = np.array([cell_m * stretch_y / self.texel_m[0], cell_m * stretch_x / self.texel_m[1]])
        octaves = max(1, min(octaves, 1 + int(np.log2(max(1.0, cell.max())))))
        extent = np.array(self.shape) / cell
        field = self._lattice(extent)
        for octave in range(1, octaves):
            finer = self._lattice(extent * 2**octave)
            for axis in (0, 1):
                # Corner cutting: repeated, it tends to a smooth quadratic B-spline.
                position = np.arange(finer.shape[axis]) / 2 + 0.25
                field = _interpolate(field, position, axis, smooth=False)
            field += np.float32(gain**octave) * finer
        shift = self.rng.random(2)
        for axis in (0, 1):
            position = (np.arange(self.shape[axis]) + 0.5) * (2.0 ** (octaves - 1) / cell[axis]) + shift[axis]
            field = _interpolate(field, position, axis)
        return field

    def _lattice(self, extent: npt.NDArray[np.float64]) -> FloatArray:
        """Independent values in [-1, 1] on a lattice a little larger than ``extent`` cells."""
        num_rows, num_columns = np.ceil(extent).astype(int) + 4
        return self.rng.random((num_rows, num_columns), dtype=np.float32) * 2 - 1

    def grain(self) -> FloatArray:
        """(h, w) independent values in [-1, 1], one per texel."""
        return self.rng.random(self.shape, dtype=np.float32) * 2 - 1


def smooth_step(low: float, high: float, value: FloatArray) -> FloatArray:
    """0 below ``low``, 1 above ``high``, smooth between."""
    t = np.clip((value - np.float32(low)) / np.float32(high - low), 0, 1)
    return np.asarray(t * t * (3 - 2 * t))


def resize_linear(values: FloatArray, shape: tuple[int, int]) -> FloatArray:
    """Resample a grid of cell means, linearly, to ``shape``; the borders are held."""
    return np.asarray(zoom(values, np.divide(shape, values.shape), order=1, mode="nearest", grid_mode=True))


def _centers(count: int, texel_m: float) -> FloatArray:
    return ((np.arange(count) + 0.5) * texel_m).astype(np.float32)


def _num_texels(length_m: float, texel_m: float) -> int:
    return SIZE_MULTIPLE * max(1, round(length_m / texel_m / SIZE_MULTIPLE))


def _interpolate(values: FloatArray, position: npt.NDArray[np.float64], axis: int, smooth: bool = True) -> FloatArray:
    """Values at fractional indices along one axis; ``smooth`` eases between them."""
    index = np.minimum(position.astype(np.intp), values.shape[axis] - 1)
    following = np.minimum(index + 1, values.shape[axis] - 1)
    weight = (position - index).astype(np.float32)
    if smooth:
        weight = weight * weight * (3 - 2 * weight)
    weight = weight.reshape((-1, 1) if axis == 0 else (1, -1))
    low = values.take(index, axis)
    high = values.take(following, axis)
    high -= low
    high *= weight
    high += low
    return np.asarray(high)
