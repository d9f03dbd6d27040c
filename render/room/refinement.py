"""Adaptive refinement of the film: the choice of cells that are sampled again, and their number of strata.

A cell is sampled on n x n strata, twice; half the difference, squared, is its variance. An edge through the cell leaves
spread / (2 n^3), with `spread` the variance of single samples: about n strata are crossed, and each counts for 1/n^2.
Once cells are refined, the larger of the two is taken: stopping by a cell's own estimate alone would flatter it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from phibench.render.room.noise_budget import allowed_per_s2, excess, is_full
from phibench.render.room.subpixel_grid import CellSampler, Crop, FilmGrid, Samples, Stack

_TILE_PX = 48
_SIDES = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128)  # strata along a cell; few values, few kernel launches
_NEAR_PX = 3  # an edge that both samples of a cell missed shows in a cell not far away
_GROWTH = 8.0  # of the strata along a side, in one round
_BLIND = (16.0, 500.0)  # excess from which a cell's first refinement has 4 and 6 strata along a side, 2 below
_SMALL = 0.1  # a cell below this part of its allowance is not what keeps a pixel above its budget
_WIDE_SIGMAS = 2.5  # cells of a lamp 20 times as bright as a full pixel count for pixels as far away
_SURELY = 2.0  # by two samples a pixel at the edge of a lamp may look full that is not
_AIM = 0.7  # of the allowed variance
_AGAIN = 1000  # first stream of cells that are sampled again by chance; rounds are fewer than 500


@dataclass
class Cells:
    """A window's cells and the pixels made of them; changed in place while they are refined.

    Attributes
    ----------
    grid : FilmGrid
    numbers : array, shape (rows, columns), uint32
    side : array, shape (rows, columns), int32
        Strata along a side.
    mean, variance : arrays, shape (3, rows, columns), float32
        Of the cells, electrons/s per square pixel and its square.
    pixels : list of two arrays, shape (3, height, width), float32
        Mean and variance of the pixels.
    tight : array, shape (height, width)
        Smallest allowed variance of the pixels around, sum of the colours.
    suspected : array, shape (height, width)
        Excess of the pixels by what may have been missed; 0 from the second round on.
    mirrored : bool array, shape (height, width)
        Pixels that see the mirror.
    budget : float
        Largest allowed error by noise, one of `noise_budget.BUDGETS`.
    lamps : array, shape (rows, columns), int32
        Lamp whose part of each cell is computed, -1 for none.
    """

    grid: FilmGrid
    numbers: NDArray[np.uint32]
    side: NDArray[np.int32]
    mean: Stack
    variance: Stack
    pixels: tuple[Stack, Stack]
    tight: Stack
    suspected: Stack
    mirrored: NDArray[np.bool_]
    budget: float
    lamps: NDArray[np.int32]


def render_refined(film: CellSampler, window: Crop, rounds: int, budget: float) -> tuple[Stack, Stack]:
    """Pixels of a window and their variance, shape (3, height, width) each.

    All cells get two samples. Those that see the mirror, and the few around them, are then refined.
    """
    grid, numbers = film.grid, film.grid.numbers(window)
    a, b = (film.sample_once(numbers.ravel(), half) for half in (0, 1))
    mean, variance = (plane.reshape(3, *numbers.shape) for plane in _estimate(a, b))
    pixels = grid.pixels(mean), grid.pixels(variance, power=2)
    mirrored = grid.inner((a.mirrored | b.mirrored).reshape(numbers.shape))
    if rounds and mirrored.any():
        box = _around(mirrored)
        part = tuple(slice(s.start * grid.cells, (s.stop + 2 * grid.margin_px) * grid.cells) for s in box)
        halves = [half.electrons_per_s.sum(axis=0).reshape(numbers.shape)[part] for half in (a, b)]
        own = [np.ascontiguousarray(plane[:, *part]) for plane in (mean, variance)]  # changed in place
        inner = (np.ascontiguousarray(pixels[0][:, *box]), np.ascontiguousarray(pixels[1][:, *box]))
        own_numbers = numbers[part].copy()
        lamps = _lamps_near(film, own_numbers, [half.patch.reshape(numbers.shape)[part] for half in (a, b)])
        cells = _cells(grid, own_numbers, own, inner, halves, mirrored[box], budget, lamps)
        del a, b, mean, variance, halves  # 200 MB that the rounds have no use for
        for turn in range(1, rounds + 1):
            if not refine(film, cells, turn):
                break
        for plane, refined in zip(pixels, cells.pixels, strict=True):
            plane[:, *box] = refined
    return pixels


def _around(marked: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Rows and columns of the pixels that are marked, and of their neighbours."""
    lines = (np.flatnonzero(marked.any(axis=axis)) for axis in (1, 0))
    (top, bottom), (left, right) = ((line[0], line[-1] + 1) for line in lines)
    height, width = marked.shape
    return (
        slice(max(top - _NEAR_PX, 0), min(bottom + _NEAR_PX, height)),
        slice(max(left - _NEAR_PX, 0), min(right + _NEAR_PX, width)),
    )


def _cells(
    grid: FilmGrid,
    numbers: NDArray[np.uint32],
    estimate: list[Stack],
    pixels: tuple[Stack, Stack],
    halves: list[Stack],
    mirrored: NDArray[np.bool_],
    budget: float,
    lamps: NDArray[np.int32],
) -> Cells:
    """Cells after their first two samples: mean and variance; `halves` are the samples' sums over the colours."""
    mean, variance = estimate
    allowed = allowed_per_s2(pixels[0], grid.blur_sigma_px, budget).sum(axis=0)
    tight = ndimage.minimum_filter(allowed, size=_NEAR_PX, mode="nearest")
    full = ndimage.minimum_filter(
        is_full(pixels[0] / _SURELY).all(axis=0), size=2 * _reach_px(grid) + 1, mode="nearest"
    )
    suspected = np.where(full, np.float32(0.0), _suspected(grid, *halves) / allowed)
    side = np.ones(numbers.shape, dtype=np.int32)
    return Cells(grid, numbers, side, mean, variance, pixels, tight, suspected, mirrored, budget, lamps)


def refine(film: CellSampler, cells: Cells, turn: int) -> bool:
    """Sample cells near pixels that are over their budget again; False if there are none.

    Parameters
    ----------
    turn : int, from 1
        Which round this is: each has its own random streams.
    """
    over = np.where(cells.mirrored, excess(*cells.pixels, cells.grid.blur_sigma_px, cells.budget), np.float32(0.0))
    near = ndimage.maximum_filter(over, size=_NEAR_PX, mode="nearest")
    near = np.where(cells.mirrored, np.maximum(near, cells.suspected), near)
    if not np.any(near > 1.0):
        return False
    chosen, pixel = cells.grid.cells_of(near > 1.0)
    near, tight = near.ravel()[pixel], cells.tight.ravel()[pixel]
    wanted = _wanted(cells, chosen, near, tight)
    more = wanted > cells.side.ravel()[chosen]
    if more.any():
        _sample_again(film, cells, chosen[more], wanted[more], turn)
        _update(cells, chosen[more])
    cells.suspected[:] = 0.0
    return True


def _suspected(grid: FilmGrid, a: Stack, b: Stack) -> Stack:
    """Variance of pixels, shape (height, width), if every cell were cut by whatever edge is near.

    Two samples may both miss what cuts a cell. If only the cells that hit it were refined, misses would stay and bias
    the mean; so what is refined first must not depend on a cell's own luck. An edge of contrast c that cuts cells at
    random leaves c^2 / 12; it is seen in the 3 x 3 pixels around, of which about a half of the cells are not cut.
    """
    edge, n = grid.margin_px * grid.cells, grid.cells
    rows, columns = a.shape[0] - 2 * edge, a.shape[1] - 2 * edge
    blocks = [half[edge : edge + rows, edge : edge + columns].reshape(rows // n, n, columns // n, n) for half in (a, b)]
    bright = np.maximum(*(block.max(axis=(1, 3)) for block in blocks))
    dark = np.minimum(*(block.min(axis=(1, 3)) for block in blocks))
    contrast = ndimage.maximum_filter(bright, _NEAR_PX) - ndimage.minimum_filter(dark, _NEAR_PX)
    return np.asarray(contrast**2 * np.float32(_share(grid) / 24.0))


def _reach_px(grid: FilmGrid) -> int:
    """Pixels from a pixel to the farthest cells that count for it."""
    return math.ceil(_WIDE_SIGMAS * grid.blur_sigma_px)


def _share(grid: FilmGrid) -> float:
    """Part of a cell's variance that is a pixel's, if all cells have the same."""
    return float(np.sum(grid.taps**2) ** 2)


def _wanted(cells: Cells, chosen: NDArray[np.intp], near: Stack, tight: Stack) -> NDArray[np.int32]:
    """Strata of cells, by their own share of the variance and by what was found around, whichever asks for less.

    Little is known of a cell with two samples: it gets more by the excess around it, whatever it seems to need, so that
    the corner of a lamp that is in it is found.
    """
    side = cells.side.ravel()[chosen]
    ratio = _share(cells.grid) * cells.variance.reshape(3, -1)[:, chosen].sum(axis=0) / tight
    growth = np.clip(np.cbrt(np.minimum(ratio, near) / _AIM), 1.2, _GROWTH)
    aim = np.where(ratio > _SMALL, np.ceil(side * growth), side)
    informed = np.array(_SIDES)[np.searchsorted(_SIDES, np.minimum(aim, _SIDES[-1]))]
    blind = np.select([near < _BLIND[0], near < _BLIND[1]], [2, 4], 6)
    return np.where(side == 1, blind, informed).astype(np.int32)


def _sample_again(
    film: CellSampler, cells: Cells, chosen: NDArray[np.intp], side: NDArray[np.int32], turn: int
) -> None:
    """Replace what is known of some cells (flat indices) by new samples."""
    lamps = cells.lamps.ravel()[chosen]
    for part, near in ((lamps < 0, None), (lamps >= 0, lamps[lamps >= 0])):
        if part.any():
            numbers = cells.numbers.ravel()[chosen[part]]
            halves = (film.sample(numbers, side[part], 2 * turn + half, near) for half in (0, 1))
            _replace(cells, chosen[part], side[part], *halves)
    _without_hidden_lamps(film, cells, turn)


def _without_hidden_lamps(film: CellSampler, cells: Cells, turn: int) -> None:
    """Sample cells again by chance around those whose mean is negative: no cell that sees its lamp has such a mean.

    The samples are new ones: those that told of it have met more of what hides the lamp than others.
    """
    computed = (cells.side > 1) & (cells.lamps >= 0)
    negative = computed & (cells.mean.min(axis=0) < 0.0)
    if not negative.any():
        return
    around = _in_reach(cells.grid, negative)
    again = np.flatnonzero(around & computed)
    cells.lamps[around] = -1
    side = cells.side.ravel()[again]
    streams = (_AGAIN + 2 * turn + half for half in (0, 1))
    halves = (film.sample(cells.numbers.ravel()[again], side, stream, None) for stream in streams)
    _replace(cells, again, side, *halves)
    _update(cells, again)


def _replace(cells: Cells, chosen: NDArray[np.intp], side: NDArray[np.int32], a: Samples, b: Samples) -> None:
    """Set mean and variance of cells by two halves."""
    mean, variance = _estimate(a, b)
    edges = (0.25 * (a.spread + b.spread)) / side.astype(np.float32) ** 3
    cells.mean.reshape(3, -1)[:, chosen] = mean
    cells.variance.reshape(3, -1)[:, chosen] = np.maximum(variance, edges)
    cells.side.ravel()[chosen] = side


def _lamps_near(film: CellSampler, numbers: NDArray[np.uint32], patches: list[NDArray[np.uint32]]) -> NDArray[np.int32]:
    """Brightest lamp that samples of cells within the blur's reach met, shape (rows, columns), -1 for none.

    None either where a sample in reach met the outline of that lamp but not the lamp. What a hidden lamp would cover
    is noise, of few and large errors: the halves of a cell agree by chance on a wrong mean.
    """
    if film.lamps is None:
        return np.full(patches[0].shape, -1, dtype=np.int32)
    seen = np.maximum(*(film.lamps.lamp(patch) for patch in patches))
    lamps = np.asarray(ndimage.maximum_filter(seen, size=2 * _reach_cells(film.grid) + 1, mode="nearest"))
    near = np.flatnonzero(lamps >= 0)
    if near.size:
        chosen = numbers.ravel()[near], lamps.ravel()[near]
        hidden = np.zeros(lamps.shape, dtype=bool)
        hidden.ravel()[near] = film.hidden(chosen[0], 0, chosen[1]) | film.hidden(chosen[0], 1, chosen[1])
        lamps[_in_reach(film.grid, hidden)] = -1
    return lamps


def _reach_cells(grid: FilmGrid) -> int:
    return grid.cells * _reach_px(grid)


def _in_reach(grid: FilmGrid, cells: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells within the blur's reach of some."""
    return np.asarray(ndimage.maximum_filter(cells, size=2 * _reach_cells(grid) + 1, mode="nearest"))


def _estimate(a: Samples, b: Samples) -> tuple[Stack, Stack]:
    """Mean of two independent halves and its variance."""
    return 0.5 * (a.electrons_per_s + b.electrons_per_s), (0.5 * (a.electrons_per_s - b.electrons_per_s)) ** 2


def _update(cells: Cells, changed: NDArray[np.intp]) -> None:
    """Fold the tiles that some cells (flat indices) belong to."""
    grid = cells.grid
    mark = np.zeros(cells.numbers.shape, dtype=bool)
    mark.ravel()[changed] = True
    height, width = cells.mirrored.shape
    span = 2 * grid.margin_px
    for v in range(0, height, _TILE_PX):
        for u in range(0, width, _TILE_PX):
            v1, u1 = min(v + _TILE_PX, height), min(u + _TILE_PX, width)
            part = (slice(v * grid.cells, (v1 + span) * grid.cells), slice(u * grid.cells, (u1 + span) * grid.cells))
            if mark[part].any():
                cells.pixels[0][:, v:v1, u:u1] = grid.pixels(cells.mean[:, *part])
                cells.pixels[1][:, v:v1, u:u1] = grid.pixels(cells.variance[:, *part], power=2)
