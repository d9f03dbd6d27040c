"""Pixels of an image window, some cut into cells: arrays, blurred means and variances, and neighbourhood filters.

A pixel's mean and variance are weighted sums over all pixels and cells within the blur (`subpixel_grid`). Sums run over
bands of rows, which stay in the processor's cache.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.render.room.lamp_outlines import LampCells
from phibench.render.room.noise_budget import allowed_per_s2
from phibench.render.room.subpixel_grid import FilmGrid, Stack

NEAR_PX = 3  # pixels beside the mirror that are treated as those in it
_BAND_PX = 48  # rows that are summed at a time
_GAP_PX = 64  # columns without a change, or without cells, that are worth treating apart
_WIDE_SIGMAS = 2.5  # cells of a lamp 20 times as bright as a full pixel count for pixels as far away

Box = tuple[slice, slice]


@dataclass
class Cells:
    """A window's pixels, and cells of those that are cut; changed in place.

    Arrays of whole pixels have the shape (rows, columns) of the window and the blur's margin. Those of cells have the
    shape (N, k) or (3, N, k), with k cells of each pixel that is cut, by rows. N may be more than the pixels that are.

    Attributes
    ----------
    squares : uint32
        Numbers of whole pixels.
    mirrored : bool array
        Pixels that see the mirror.
    full : bool array
        Pixels that are full, with all around that count for them.
    contrast : float32
        Largest difference between a pixel's own scouts, sum of the colours; 0 of a single one.
    whole : tuple of two arrays, shape (3, rows, columns), float32
        Mean and variance of pixels that are not cut, electrons/s per square pixel and its square.
    met : int32
        Brightest lamp that samples of a pixel met, -1 for none.
    rank : int32
        Place of a pixel among those that are cut, -1 for others.
    count : int
        Pixels that are cut.
    numbers : array, shape (N, k), uint32
    halves : list of two arrays, shape (3, N, k), float32
    side : list of two arrays, shape (N, k), int32
        Strata along a side, of each half.
    edges : array, shape (3, N, k), float32
        Least variance, by the spread of single samples.
    lamps : array, shape (N, k), int32
        Place in `cover` of each cell of which a lamp's part is computed, -1 for none.
    cover : LampCells, or None
    """

    grid: FilmGrid
    squares: NDArray[np.uint32]
    mirrored: NDArray[np.bool_]
    full: NDArray[np.bool_]
    contrast: Stack
    whole: tuple[Stack, Stack]
    met: NDArray[np.int32]
    rank: NDArray[np.int32]
    count: int
    numbers: NDArray[np.uint32]
    halves: list[Stack]
    side: list[NDArray[np.int32]]
    edges: Stack
    lamps: NDArray[np.int32]
    cover: LampCells | None = None

    @classmethod
    def uncut(
        cls,
        grid: FilmGrid,
        squares: NDArray[np.uint32],
        mirrored: NDArray[np.bool_],
        full: NDArray[np.bool_],
        contrast: Stack,
    ) -> Cells:
        """Pixels of which none is cut, without samples."""
        shape, none = squares.shape, (0, grid.cells**2)
        whole = np.zeros((3, *shape), dtype=np.float32), np.zeros((3, *shape), dtype=np.float32)
        met, rank = (np.full(shape, -1, dtype=np.int32) for _ in range(2))
        a, b, edges = (np.zeros((3, *none), dtype=np.float32) for _ in range(3))
        one, other, lamps = (np.zeros(none, dtype=np.int32) for _ in range(3))
        numbers = np.zeros(none, dtype=np.uint32)
        return cls(
            grid, squares, mirrored, full, contrast, whole, met, rank, 0, numbers, [a, b], [one, other], edges, lamps
        )

    def cut(self, row: NDArray[np.intp], column: NDArray[np.intp]) -> slice:
        """Give pixels a rank, and cells without samples; the ranks."""
        own = slice(self.count, self.count + len(row))
        self.rank[row, column] = np.arange(own.start, own.stop)
        self.count = own.stop
        if own.stop > len(self.numbers):  # some more than are needed: few rounds cut many
            more = own.stop + own.stop // 8 - len(self.numbers)
            self.numbers = _longer(self.numbers, more, 0)
            self.halves = [_longer(one, more, 0.0) for one in self.halves]
            self.side = [_longer(one, more, 1) for one in self.side]
            self.edges, self.lamps = _longer(self.edges, more, 0.0), _longer(self.lamps, more, -1)
        self.numbers[own] = self.grid.cells_of(self.squares[row, column])
        return own


def _longer(values: NDArray[Any], more: int, fill: float) -> NDArray[Any]:
    """Values of cells, shape (.., N, k), and room for those of more pixels."""
    *planes, count, cells = values.shape
    result = np.empty((*planes, count + more, cells), dtype=values.dtype)
    result[..., :count, :], result[..., count:, :] = values, fill
    return result


def moments_of(cells: Cells, rank: NDArray[np.int32]) -> tuple[Stack, Stack]:
    """Means of cells and their variances, shape (3, N, k), of pixels of some ranks."""
    a, b = (of_rank(half, rank) for half in cells.halves)
    variance = np.square(0.5 * (a - b))
    return 0.5 * (a + b), np.maximum(variance, of_rank(cells.edges, rank), out=variance)


def of_rank(values: NDArray[Any], rank: NDArray[np.int32]) -> NDArray[Any]:
    """Values, shape (.., N, k), of some pixels that are cut; those of whole rows lie together."""
    if len(rank) and len(rank) == rank[-1] - rank[0] + 1 and np.all(np.diff(rank) == 1):
        return values[..., rank[0] : rank[-1] + 1, :]
    return np.take(values, rank, axis=-2)


def fold(cells: Cells, pixels: Stack, rows: slice, columns: slice) -> None:
    """Set pixels of a part of the window by their cells, some rows at a time; where none is cut, by whole pixels."""
    grid, span = cells.grid, 2 * cells.grid.margin_px
    for first in range(rows.start, rows.stop, _BAND_PX):
        last = min(first + _BAND_PX, rows.stop)
        down = slice(first, last + span)
        for low, high, cut in _runs(cells.rank[down, columns.start : columns.stop + span] >= 0, span):
            run = slice(columns.start + low, columns.start + high)
            part = (down, slice(run.start, run.stop + span))
            mean, variance = (plane[:, *part] for plane in cells.whole)
            if not cut:
                for k, whole in enumerate((mean, variance)):
                    pixels[k, :, first:last, run] = grid.pixels_of_whole(whole, power=k + 1)
                continue
            row, column, rank = cut_in(cells, part)
            variance = variance * np.float32(grid.cells**2)  # a whole pixel's, shared by all its cells
            for k, (whole, values) in enumerate(zip((mean, variance), moments_of(cells, rank), strict=True)):
                pixels[k, :, first:last, run] = grid.pixels(cell_plane(grid, whole, row, column, values), power=k + 1)


def _runs(cut: NDArray[np.bool_], span: int) -> Iterator[tuple[int, int, bool]]:
    """First and last column of runs of pixels, and whether any that is cut counts for them; `cut` is wider by a span.

    Runs begin at multiples of `_GAP_PX`.
    """
    width = cut.shape[1] - span
    reached = np.concatenate([[0], np.cumsum(cut.any(axis=0))])
    reached = np.add.reduceat(reached[span + 1 :] > reached[: -span - 1], np.arange(0, width, _GAP_PX)) > 0
    starts = np.flatnonzero(np.diff(reached, prepend=not reached[0]))
    for start, stop in zip(starts, [*starts[1:], len(reached)], strict=True):
        yield int(start) * _GAP_PX, min(int(stop) * _GAP_PX, width), bool(reached[start])


def cut_in(cells: Cells, part: Box) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.int32]]:
    """Row, column and rank of the pixels of a part that are cut."""
    rank = cells.rank[part]
    row, column = np.nonzero(rank >= 0)
    return row, column, rank[row, column]


def cell_plane(grid: FilmGrid, whole: Stack, row: NDArray[np.intp], column: NDArray[np.intp], cut: Stack) -> Stack:
    """Planes of cells, shape (m, rows, columns): values of whole pixels, and of those that are cut, (m, N, k)."""
    n, (count, height, width) = grid.cells, whole.shape
    plane = np.empty((count, height * n, width * n), dtype=np.float32)
    for j in range(n):
        plane[:, ::n, j::n] = whole
    for i in range(1, n):
        plane[:, i::n] = plane[:, ::n]
    pair = 2 - n % 2  # cells that are moved as one
    kind = np.dtype(f"f{4 * pair}")
    per_row = n // pair
    corner = (row * (width * n) + column) * per_row
    for of_cells, of_cut in zip(plane, cut, strict=True):
        places, values = of_cells.reshape(-1).view(kind), of_cut.reshape(len(row), n * n).view(kind)
        for i in range(n):
            for j in range(per_row):
                places[corner + (i * width * per_row + j)] = values[:, i * per_row + j]
    return plane


def of_cells(grid: FilmGrid, plane: Stack, row: NDArray[np.intp], column: NDArray[np.intp]) -> Stack:
    """Values of the cells of some pixels, shape (N, k), from a plane of cells."""
    n = grid.cells
    within = np.arange(n)[:, None] * plane.shape[1] + np.arange(n)
    return np.take(plane, ((row * plane.shape[1] + column) * n)[:, None] + within.ravel())


def strips_of(grid: FilmGrid, changed: NDArray[np.bool_]) -> Iterator[Box]:
    """Parts of the window that changed pixels count for: bands of rows, each cut where nothing changes for a while."""
    m = grid.margin_px
    height, width = (length - 2 * m for length in changed.shape)
    for first in range(0, height, _BAND_PX):
        last = min(first + _BAND_PX, height)
        columns = np.flatnonzero(changed[first : last + 2 * m].any(axis=0))
        for run in np.split(columns, np.flatnonzero(np.diff(columns) > _GAP_PX) + 1) if columns.size else ():
            low, high = max(int(run[0]) - 2 * m, 0), min(int(run[-1]) + 1, width)
            if low < high:
                yield slice(first, last), slice(low, high)


def moved_box(box: Box, down: int, right: int) -> Box:
    """Rows and columns, moved."""
    return slice(box[0].start + down, box[0].stop + down), slice(box[1].start + right, box[1].stop + right)


def inner(grid: FilmGrid, plane: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels of the window itself."""
    m = grid.margin_px
    return plane[m : plane.shape[0] - m, m : plane.shape[1] - m]


def bounds(marked: NDArray[np.bool_]) -> Box | None:
    """Rows and columns of the pixels that are marked, and of their neighbours."""
    if not marked.any():
        return None
    lines = (np.flatnonzero(marked.any(axis=axis)) for axis in (1, 0))
    (top, bottom), (left, right) = ((line[0], line[-1] + 1) for line in lines)
    height, width = marked.shape
    return (
        slice(max(top - NEAR_PX, 0), min(bottom + NEAR_PX, height)),
        slice(max(left - NEAR_PX, 0), min(right + NEAR_PX, width)),
    )


def contrast(plane: Stack) -> Stack:
    """Largest difference within 3 x 3 of each place."""
    return np.asarray(extreme(np.maximum, plane, 1) - extreme(np.minimum, plane, 1))


def mean_of_nine(plane: Stack) -> Stack:
    """Mean of 3 x 3 places around each."""
    return np.asarray(ndimage.uniform_filter(plane, size=3, mode="nearest"))


def grown(marked: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """True within a reach of what is marked, along rows and columns."""
    return np.asarray(extreme(np.logical_or, marked, reach))


def extreme(function: np.ufunc, plane: NDArray[Any], reach: int) -> NDArray[Any]:
    """Largest (`np.maximum`) or least values within a reach, along rows and columns; SciPy's take longer."""
    for axis in (0, 1):
        spread = plane.copy()
        for step in range(1, min(reach, plane.shape[axis] - 1) + 1):
            low, high = ((slice(None),) * axis + (cut,) for cut in (slice(None, -step), slice(step, None)))
            function(spread[low], plane[high], out=spread[low])
            function(spread[high], plane[low], out=spread[high])
        plane = spread
    return plane


def sum_of_colours(planes: Stack) -> Stack:
    """Sum of three planes along the first axis; NumPy's own takes three times as long."""
    return planes[0] + planes[1] + planes[2]


def any_cell(of_cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Pixels with a cell that is true, by cells (N, k); NumPy's own takes longer along few."""
    return np.asarray(np.logical_or.reduce(of_cells.T.copy()))


def allowed_of_sum(total: Stack, grid: FilmGrid, budget: float) -> Stack:
    """Largest variance of the sum over the colours, by that sum."""
    dark = allowed_per_s2(np.zeros(1, dtype=np.float32), grid.blur_sigma_px, budget)
    return allowed_per_s2(total, grid.blur_sigma_px, budget) + 2.0 * dark


def reach_px(grid: FilmGrid) -> int:
    """Pixels from a pixel to the farthest cells that count for it."""
    return math.ceil(_WIDE_SIGMAS * grid.blur_sigma_px)


def share_of_cell(grid: FilmGrid) -> float:
    """Part of a cell's variance that is a pixel's, if all cells have the same."""
    return float(np.sum(grid.taps**2) ** 2)


def taps_of_pixels(grid: FilmGrid) -> Stack:
    """Weights of whole pixels along one axis."""
    return grid.taps.reshape(-1, grid.cells).sum(axis=1)


def means_of_cells(plane: Stack, n: int) -> Stack:
    """Means over n x n cells."""
    parts = [plane[i::n, j::n] for i in range(n) for j in range(n)]
    return np.asarray(sum(parts[1:], parts[0]) / np.float32(n * n))
