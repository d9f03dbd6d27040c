"""Image grid finer than the pixels: samples of its square cells, summed into pixels with the camera's blur.

A cell holds the mean radiance over its area; a pixel is the sum of cells times weights. The weight of a cell is the
pixel's square, blurred by a Gaussian of variance sigma^2 - h^2/12, at the cell's centre: with the cell's own square of
side h this has the variance of the camera's blur. An edge keeps its place to h^2/4: 0.02 px for two cells a pixel in
the worst phase, 0 on average over phases. Every sample serves all pixels within the blur, which keeps edges quiet.

Samples are stratified over the cell and quasi-random over the aperture. Point s of lane n in dimension d of the
Kronecker sequence is frac(shift(n, d) + s alpha_d), with alpha_d the powers of the inverse of the root of
x^(D+1) = x + 1 (the D-dimensional golden ratio): a few points already fill the cube evenly. The shifts are hashed from
lane, dimension and seed, so that lanes are independent.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.special import ndtr

from phibench.render.room.shading import Look
from phibench.render.room.surfaces import aligned
from phibench.scenes.camera import Camera
from phibench.scenes.validation import SceneError

MOST_CELLS = 2**32 - 1
_TAIL_SIGMAS = 5.0  # 6e-7 of the light is beyond
Stack = NDArray[np.float32]
Crop = tuple[int, int, int, int]


@dataclass(frozen=True)
class FilmGrid:
    """Cells over an image and a margin of the blur's width.

    Parameters
    ----------
    width_px, height_px : int
        Image size.
    blur_sigma_px : float
    wanted : int
        Cells per pixel side; `cells` may be more, where the blur is narrower than a cell.
    """

    width_px: int
    height_px: int
    blur_sigma_px: float
    wanted: int

    @classmethod
    def of(cls, camera: Camera, wanted: int) -> FilmGrid:
        """Grid of a camera's film."""
        return cls(camera.width_px, camera.height_px, camera.blur_sigma_px, wanted)

    @cached_property
    def cells(self) -> int:
        """Cells per pixel side: h / sqrt(12) must not exceed the blur."""
        return max(self.wanted, math.ceil(1.0 / (math.sqrt(12.0) * self.blur_sigma_px)))

    @cached_property
    def margin_px(self) -> int:
        """Pixels beyond the image that send light into it."""
        return math.ceil(_TAIL_SIGMAS * self.blur_sigma_px)

    def __post_init__(self) -> None:
        if self.count > MOST_CELLS:
            raise SceneError(
                f"Camera: {self.width_px} x {self.height_px} pixels of {self.cells} x {self.cells} cells are "
                f"{self.count:.2g} cells, more than {MOST_CELLS:.2g}; take a smaller image, fewer cells_per_pixel, or "
                "a larger blur_sigma_px"
            )

    @property
    def count(self) -> int:
        """Cells of the whole grid; their numbers have 32 bits."""
        return self.columns * (self.height_px + 2 * self.margin_px) * self.cells

    @property
    def columns(self) -> int:
        """Cells in a row of the whole grid."""
        return (self.width_px + 2 * self.margin_px) * self.cells

    @cached_property
    def taps(self) -> Stack:
        """Weights along one axis of the cells around a pixel, shape ((2 margin + 1) cells,)."""
        h = 1.0 / self.cells
        centres = (np.arange((2 * self.margin_px + 1) * self.cells) + 0.5) * h - 0.5 - self.margin_px
        sigma = math.sqrt(max(self.blur_sigma_px**2 - h * h / 12.0, 1e-18))
        return (h * (ndtr((centres + 0.5) / sigma) - ndtr((centres - 0.5) / sigma))).astype(np.float32)

    def numbers(self, window: Crop) -> NDArray[np.uint32]:
        """Numbers of the cells that a window (u0, v0, width, height) of the image needs, shape (rows, columns)."""
        u0, v0, width, height = window
        span = 2 * self.margin_px
        rows = np.arange(v0 * self.cells, (v0 + height + span) * self.cells, dtype=np.uint32)
        columns = np.arange(u0 * self.cells, (u0 + width + span) * self.cells, dtype=np.uint32)
        return rows[:, None] * np.uint32(self.columns) + columns

    def pixels(self, cells: Stack, power: int = 1) -> Stack:
        """Pixels (n, height, width) of cells (n, rows, columns), with weights to a power: 2 for variances."""
        down, across = (_fold(self, length, power) for length in cells.shape[1:])
        return np.stack([(across @ np.ascontiguousarray((down @ plane).T)).T for plane in cells])

    def inner(self, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """True where any cell inside a pixel's own square is true, shape (height, width)."""
        edge, n = self.margin_px * self.cells, self.cells
        core = cells[edge : cells.shape[0] - edge, edge : cells.shape[1] - edge]
        return np.asarray(core.reshape(core.shape[0] // n, n, core.shape[1] // n, n).any(axis=(1, 3)))

    def cells_of(self, pixels: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Flat indices of the cells of some pixels (height, width), and of each one's pixel.

        The margin belongs to the pixels of the border.
        """
        (height, width), m, n = pixels.shape, self.margin_px, self.cells
        row, column = np.nonzero(np.pad(pixels, m, mode="edge"))
        inside = np.clip(row - m, 0, height - 1) * width + np.clip(column - m, 0, width - 1)
        cell = (np.arange(n)[:, None] * (width + 2 * m) * n + np.arange(n)).ravel()
        corner = (row * (width + 2 * m) * n + column) * n
        return (corner[:, None] + cell).ravel(), np.repeat(inside, n * n)


@lru_cache(maxsize=32)
def _fold(grid: FilmGrid, cells: int, power: int) -> Any:
    """Matrix (pixels, cells along an axis) of the weights."""
    taps, step = grid.taps**power, grid.cells
    pixels = (cells - len(taps)) // step + 1
    columns = (np.arange(pixels)[:, None] * step + np.arange(len(taps))).ravel()
    starts = np.arange(pixels + 1) * len(taps)
    return sparse.csr_array((np.tile(taps, pixels), columns, starts), shape=(pixels, cells))


# Kronecker sequences inside Dr.Jit kernels.


def golden_steps(dimensions: int) -> tuple[float, ...]:
    """Steps alpha_1 .. alpha_D, the powers of 1 / phi_D."""
    root = 2.0
    for _ in range(60):  # fixed-point iteration of x = (1 + x)^(1 / (D + 1)), contraction below 1/2
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    return tuple(root ** -(d + 1) for d in range(dimensions))


_ROUNDS = 12  # of the Tiny Encryption Algorithm; with Mitsuba's usual 4, neighbouring lanes correlate by 0.48


def shifts(mi: ModuleType, lanes: Any, dimensions: int, seed: Any) -> list[Any]:
    """One uniform shift per lane for each dimension; `seed`, an integer or a Dr.Jit one, from a named stream."""
    keys = [mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(d), _ROUNDS)[1] for d in range(dimensions)]
    return [_uniform(mi, mi.sample_tea_32(lanes, key, _ROUNDS)[1]) for key in keys]


def points(mi: ModuleType, shift: list[Any], index: Any) -> list[Any]:
    """Coordinates of point number `index` (an unsigned integer array) of every lane."""
    import drjit as dr

    steps = golden_steps(len(shift))
    moved = [offset + mi.Float(index) * step for offset, step in zip(shift, steps, strict=True)]
    return [value - dr.floor(value) for value in moved]


def _uniform(mi: ModuleType, word: Any) -> Any:
    return mi.Float(word >> 8) * (1.0 / 16777216.0)


# Sampling.


@dataclass(frozen=True)
class Samples:
    """Samples of n cells.

    Attributes
    ----------
    electrons_per_s : array, shape (3, n), float32
        Mean over the cell, per square pixel.
    square : array, shape (3, n), float32
        Mean square.
    mirrored : bool array, shape (n,)
        Whether a sample saw the mirror.
    """

    electrons_per_s: Stack
    square: Stack
    mirrored: NDArray[np.bool_]


class Film:
    """Samples cells; what a cell gets depends on its number, the seed and the stream alone."""

    def __init__(self, mi: ModuleType, look: Look, grid: FilmGrid, seed: int) -> None:
        self._mi, self._look, self.grid, self._seed = mi, look, grid, seed
        self._dimensions = 4 if look.view.rig.mirror.roughness_alpha == 0.0 else 6

    def sample(self, numbers: NDArray[np.uint32], side: int, stream: int) -> Samples:
        """Sample cells, shape (n,), with side x side points each."""
        import drjit as dr

        mi, grid = self._mi, self.grid
        lanes = mi.UInt32(aligned(numbers, np.uint32))
        m, key = (dr.opaque(mi.UInt32, value) for value in (side, self._key(stream)))
        shift = shifts(mi, lanes, self._dimensions, key)
        # opaque: one kernel for all cameras
        columns = dr.opaque(mi.UInt32, grid.columns)
        h, start = (dr.opaque(mi.Float64, value) for value in (1.0 / grid.cells, -0.5 - grid.margin_px))
        column, row = mi.Float64(lanes % columns), mi.Float64(lanes // columns)

        def body(i: Any, total: Any, square: Any, seen: Any) -> tuple[Any, Any, Any, Any]:
            x = points(mi, shift, i)
            u = (column + (mi.Float64(i % m) + mi.Float64(x[0])) / mi.Float64(m)) * h + start
            v = (row + (mi.Float64(i // m) + mi.Float64(x[1])) / mi.Float64(m)) * h + start
            value, mirrored = self._look.electrons(u, v, x[2:])
            return i + 1, total + value, square + value * value, seen | mirrored

        n = len(numbers)
        zero = (mi.UInt32(0), dr.zeros(mi.Color3f, n), dr.zeros(mi.Color3f, n), dr.zeros(mi.Bool, n))
        _, total, square, seen = dr.while_loop(zero, lambda i, *_: i < m * m, body)
        total, square = total / mi.Float(m * m), square / mi.Float(m * m)
        dr.eval(total, square, seen)
        return Samples(_planes(total), _planes(square), np.array(seen, dtype=bool))

    def _key(self, stream: int) -> int:
        """32-bit seed of one of the view's streams."""
        return int(np.random.SeedSequence([self._seed, stream]).generate_state(1, np.uint32)[0])


def _planes(colour: Any) -> Stack:
    return np.stack([np.array(colour[k], dtype=np.float32) for k in range(3)])
