"""The film as square cells, finer than pixels, and the blur that turns cells into pixels.

A cell holds the mean radiance over its area; a pixel is the sum of cells times weights. The weight of a cell is the
pixel's square, blurred by a Gaussian of variance sigma^2 - h^2/12 and taken at the cell's centre: with the cell's own
square of side h this has the variance of the camera's blur. An edge is kept in place to h^2/4 (0.02 px for two cells a
pixel, in the worst phase; 0 on average over phases). Every sample serves all pixels within the blur, which is what
keeps edges quiet.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.special import ndtr

from phibench.scenes.camera import Camera
from phibench.scenes.checks import SceneError

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
        """Whether any cell inside a pixel's own square is true, shape (height, width)."""
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
