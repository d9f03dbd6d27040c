"""Image grid finer than pixels: samples of its square cells, summed into pixels with the blur; and quasi-random points.

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
from dataclasses import dataclass, fields
from functools import cached_property, lru_cache
from itertools import pairwise
from types import ModuleType
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from phibench.render.room.lamp_outlines import PARTS, LampCells, LampOutlines
from phibench.render.room.shading import Look
from phibench.render.room.surfaces import aligned, colour_planes
from phibench.scenes.camera import Camera
from phibench.scenes.validation import SceneError

MOST_CELLS = 2**32 - 1
_TAIL_SIGMAS = 5.0  # 6e-7 of the light is beyond
_SCOUTS = 1 << 19  # of an image, at least
RIM_PX = 3  # around all that reaches a window: what is decided there looks as far
Stack = NDArray[np.float32]
Crop = tuple[int, int, int, int]


@dataclass(frozen=True)
class FilmGrid:
    """Cells over an image and a margin of the blur's width.

    Parameters
    ----------
    width_px, height_px : int
        Image size.
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
        return _across(self, _down(self, cells, power, self.cells), power, self.cells)

    def pixels_of_whole(self, squares: Stack, power: int = 1) -> Stack:
        """The same of whole pixels (n, rows, columns), whose cells are alike; a variance is that of their mean."""
        return _across(self, _down(self, squares, power, 1), power, 1)

    def squares(self, window: Crop) -> NDArray[np.uint32]:
        """Numbers of whole pixels of a window and `RIM_PX` more around it than its blur asks for."""
        u0, v0, width, height = window
        span = 2 * (self.margin_px + RIM_PX)
        rows, columns = np.arange(v0, v0 + height + span), np.arange(u0, u0 + width + span)
        return (rows[:, None] * self.square_columns + columns).astype(np.uint32)

    @property
    def square_columns(self) -> int:
        """Whole pixels in a row of the grid of `squares`."""
        return self.width_px + 2 * (self.margin_px + RIM_PX)

    @cached_property
    def scouts(self) -> int:
        """Parts of a pixel's side with a scout each: a small image's pixels hide more than a large one's."""
        return max(1, round(math.sqrt(_SCOUTS / (self.width_px * self.height_px))))

    def scouts_of(self, squares: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """Numbers of the parts of whole pixels, shape (scouts^2, n)."""
        row, column = np.divmod(squares, np.uint32(self.square_columns))
        return np.ascontiguousarray(_parts(row, column, self.scouts, self.square_columns * self.scouts).T)

    def cells_of(self, squares: NDArray[np.uint32]) -> NDArray[np.uint32]:
        """Numbers of the cells of whole pixels, shape (n, cells^2), by rows; none of them lies in the rim."""
        row, column = (part - RIM_PX for part in np.divmod(squares, np.uint32(self.square_columns)))
        return _parts(row, column, self.cells, self.columns)


def _parts(row: NDArray[np.uint32], column: NDArray[np.uint32], n: int, columns: int) -> NDArray[np.uint32]:
    """Numbers of n x n parts of squares, shape (squares, n^2), in a grid that has so many columns of parts."""
    corner = (row.astype(np.int64) * columns + column) * n
    place = np.arange(n)[:, None] * columns + np.arange(n)
    return (corner[:, None] + place.ravel()).astype(np.uint32)


_BLOCK_PX = 16  # pixels whose weights are one dense matrix: three times as fast as a sparse one


@lru_cache(maxsize=64)
def _fold(grid: FilmGrid, pixels: int, power: int, step: int) -> Stack:
    """Matrix (pixels, places along an axis) of the weights; `step` places a pixel: its cells, or 1 for the whole."""
    taps = grid.taps**power
    if step == 1:  # a mean of n cells has a variance n times smaller than each
        taps = np.float32(grid.cells ** (power - 1)) * taps.reshape(-1, grid.cells).sum(axis=1)
    matrix = np.zeros((pixels, (pixels - 1) * step + len(taps)), dtype=np.float32)
    for k in range(pixels):
        matrix[k, k * step : k * step + len(taps)] = taps
    return matrix


def _down(grid: FilmGrid, places: Stack, power: int, step: int) -> Stack:
    """Pixels along the rows' axis: (n, rows, columns) to (n, height, columns)."""
    count, rows, columns = places.shape
    height = rows // step - 2 * grid.margin_px
    result = np.empty((count, height, columns), dtype=np.float32)
    for first in range(0, height, _BLOCK_PX):
        weights = _fold(grid, min(_BLOCK_PX, height - first), power, step)
        start = first * step
        np.matmul(weights, places[:, start : start + weights.shape[1]], out=result[:, first : first + len(weights)])
    return result


def _across(grid: FilmGrid, lines: Stack, power: int, step: int) -> Stack:
    """Pixels along the other axis: (n, height, columns) to (n, height, width)."""
    count, height, columns = lines.shape
    width = columns // step - 2 * grid.margin_px
    result = np.empty((count, height, width), dtype=np.float32)
    for first in range(0, width, _BLOCK_PX):
        weights = _fold(grid, min(_BLOCK_PX, width - first), power, step)
        start = first * step
        part = lines[:, :, start : start + weights.shape[1]]
        np.matmul(part, weights.T, out=result[:, :, first : first + len(weights)])
    return result


# Kronecker sequences inside Dr.Jit kernels.


def golden_steps(dimensions: int) -> tuple[float, ...]:
    """Steps alpha_1 .. alpha_D, the powers of 1 / phi_D."""
    root = 2.0
    for _ in range(60):  # fixed-point iteration of x = (1 + x)^(1 / (D + 1)), contraction below 1/2
        root = (1.0 + root) ** (1.0 / (dimensions + 1))
    return tuple(root ** -(d + 1) for d in range(dimensions))


_GOLDEN = 0x9E3779B9  # between the keys of pairs of dimensions: far from those of other streams
_ROUNDS = 12  # of the Tiny Encryption Algorithm; with Mitsuba's usual 4, neighbouring lanes correlate by 0.48


def point_shifts(mi: ModuleType, lanes: Any, dimensions: int, seed: Any) -> list[Any]:
    """One uniform shift per lane for each dimension; `seed`, an integer or a Dr.Jit one, from a named stream."""
    return [_uniform(mi, word) for word in hashed_bits(mi, lanes, dimensions, seed)]


def hashed_bits(mi: ModuleType, lanes: Any, dimensions: int, seed: Any) -> list[Any]:
    """32 random bits per lane for each dimension."""
    keys = [mi.sample_tea_32(mi.UInt32(seed), mi.UInt32(d), _ROUNDS)[1] for d in range(dimensions)]
    return [mi.sample_tea_32(lanes, key, _ROUNDS)[1] for key in keys]


def paired_shifts(mi: ModuleType, lanes: Any, dimensions: int, seed: Any) -> list[Any]:
    """The same by a quarter of the hashes, which take a third of a view's time; `seed` must be a hash itself."""
    keys = [mi.UInt32(seed) + mi.UInt32(pair * _GOLDEN % 2**32) for pair in range((dimensions + 1) // 2)]
    words = [word for key in keys for word in mi.sample_tea_32(lanes, key, _ROUNDS)]
    return [_uniform(mi, word) for word in words[:dimensions]]


def quasi_random_points(mi: ModuleType, shift: list[Any], index: Any) -> list[Any]:
    """Coordinates of point number `index` (an unsigned integer array) of every lane."""
    import drjit as dr

    steps = golden_steps(len(shift))
    moved = [offset + mi.Float(index) * step for offset, step in zip(shift, steps, strict=True)]
    return [value - dr.floor(value) for value in moved]


def _uniform(mi: ModuleType, word: Any) -> Any:
    return mi.Float(word >> 8) * (1.0 / 16777216.0)


# Sampling.

_LENS_POINTS = 32  # for each of the strata along a cell's side
_CELLS_AT_A_TIME = 1 << 19
_POINTS_AT_A_TIME = 1 << 20  # of strata, with the rest of a cell


@dataclass(frozen=True)
class Samples:
    """Samples of n cells.

    Attributes
    ----------
    electrons_per_s : array, shape (3, n), float32
        Mean over the cell, per square pixel.
    spread : array, shape (3, n), float32
        Variance of single samples, without what the outlines of lamps contribute; (3, 0) of a single one.
    mirrored : bool array, shape (n,)
        Whether a sample saw the mirror.
    lamp : array, shape (n,), int32
        Lamp that a sample met by the mirror, -1 for none; brighter ones have higher numbers.
    """

    electrons_per_s: Stack
    spread: Stack
    mirrored: NDArray[np.bool_]
    lamp: NDArray[np.int32]


class CellSampler:
    """Samples cells; what a cell gets depends on its number, the seed and the stream alone.

    Parameters
    ----------
    lamps : LampOutlines, or None
        Outlines of lamps that are known in closed form.
    """

    def __init__(self, mi: ModuleType, look: Look, grid: FilmGrid, seed: int, lamps: LampOutlines | None) -> None:
        self._mi, self._look, self.grid, self._seed, self.lamps = mi, look, grid, seed, lamps
        self._dimensions = 4 if look.view.rig.mirror.roughness_alpha == 0.0 else 6

    def sample_once(self, numbers: NDArray[np.uint32], stream: int, parts: int = 0) -> Samples:
        """Sample cells, shape (n,), with one point each; or `parts` of a pixel's side, 1 for `FilmGrid.squares`."""
        return _joined([self._once(part, stream, parts) for part in np.split(numbers, _starts(len(numbers)))])

    def _once(self, numbers: NDArray[np.uint32], stream: int, parts: int) -> Samples:
        import drjit as dr

        value, mirrored, patch, _ = self._first(numbers, stream, parts)
        lamp = self._mi.Int32(-1) if self.lamps is None else self.lamps.of_patch(patch)
        dr.eval(value, mirrored, lamp)
        none, met = np.zeros((3, 0), dtype=np.float32), np.array(lamp, dtype=np.int32)
        return Samples(colour_planes(value), none, np.array(mirrored, dtype=bool), np.broadcast_to(met, numbers.shape))

    def _first(self, numbers: NDArray[np.uint32], stream: int, parts: int = 0) -> tuple[Any, Any, Any, Any]:
        """Light, mirror, patch and ray of the one point of each cell, as `Look.electrons` gives them."""
        import drjit as dr

        mi = self._mi
        lanes = mi.UInt32(aligned(numbers, np.uint32))
        x = paired_shifts(mi, lanes, self._dimensions, dr.opaque(mi.UInt32, self._key(stream)))
        corner, h = self._corner(lanes, parts)
        u, v = (start + mi.Float64(value) * h for start, value in zip(corner, x[:2], strict=True))
        return self._look.electrons(u, v, x[2:])

    def hidden(self, numbers: NDArray[np.uint32], stream: int, lamp: NDArray[np.int32]) -> NDArray[np.bool_]:
        """True where the point of `sample_once` lies within a lamp's outline and sees something else; shape (n,)."""
        starts = _starts(len(numbers))
        parts = zip(np.split(numbers, starts), np.split(lamp, starts), strict=True)
        return np.concatenate([self._hidden(some, stream, near) for some, near in parts])

    def _hidden(self, numbers: NDArray[np.uint32], stream: int, lamp: NDArray[np.int32]) -> NDArray[np.bool_]:
        import drjit as dr

        assert self.lamps is not None
        _, _, patch, ray = self._first(numbers, stream)
        which = self._mi.Int32(aligned(lamp, np.int32))
        hidden = self.lamps.meets(ray, which) & (self.lamps.of_patch(patch) != which)
        dr.eval(hidden)
        return np.array(hidden, dtype=bool)

    def cover(self, numbers: NDArray[np.uint32], lamp: NDArray[np.int32]) -> LampCells:
        """Parts of cells that lamps, shape (n,), cover."""
        assert self.lamps is not None
        starts = range(_CELLS_AT_A_TIME // PARTS**2, len(numbers), _CELLS_AT_A_TIME // PARTS**2)
        parts = zip(np.split(numbers, starts), np.split(lamp, starts), strict=True)
        return _joined([self.lamps.cells(*self._quarters(cells), near) for cells, near in parts])

    def sample(
        self, numbers: NDArray[np.uint32], side: NDArray[np.int32], stream: int, cover: LampCells | None
    ) -> Samples:
        """Sample cells, shape (n,), with side x side points each; `cover` is what lamps cover of them, if anything."""
        taken = np.cumsum(np.square(side, dtype=np.int64))
        starts = np.searchsorted(taken, np.arange(_POINTS_AT_A_TIME, taken[-1], _POINTS_AT_A_TIME)) + 1
        bounds = [0, *np.unique(starts[starts < len(numbers)]).tolist(), len(numbers)]
        parts = [slice(*pair) for pair in pairwise(bounds)]
        return _joined([self._again(numbers[k], side[k], stream, cover.of(k) if cover else None) for k in parts])

    def _again(
        self, numbers: NDArray[np.uint32], side: NDArray[np.int32], stream: int, cover: LampCells | None
    ) -> Samples:
        """A lane for each point: those of a cell and of its neighbour lie together, and so do their rays."""
        import drjit as dr

        mi, key, count = self._mi, self._key(stream), np.square(side, dtype=np.int64)
        cell = mi.UInt32(aligned(np.repeat(np.arange(len(side), dtype=np.uint32), count), np.uint32))
        lane, m, first = (mi.UInt32(aligned(a, np.uint32)) for a in (numbers, side, np.cumsum(count) - count))
        lanes, sides, index = (dr.gather(mi.UInt32, one, cell) for one in (lane, m, first))
        shift = paired_shifts(mi, lanes, self._dimensions, dr.opaque(mi.UInt32, key))
        index, per_m = dr.arange(mi.UInt32, len(cell)) - index, 1.0 / mi.Float(sides)
        x, place = quasi_random_points(mi, shift, index), mi.Float(index)
        row = dr.floor((place + 0.5) * per_m)  # exact, and faster than a division of whole numbers
        corner, h = self._corner(lanes)
        step = h / mi.Float64(sides)
        u, v = (
            low + (mi.Float64(k) + mi.Float64(value)) * step
            for low, k, value in zip(corner, (place - row * mi.Float(sides), row), x[:2], strict=True)
        )
        value, _, _, ray = self._look.electrons(u, v, x[2:])
        if cover is not None:
            value -= self._shine(cover, cell, ray)
        mean, spread = _moments(mi, value, first, m * m)
        if cover is not None:
            mean = mean + cover.light * self._covered(cover, numbers, side, key)
        none = np.zeros(0, dtype=np.int32)
        return Samples(mean, spread, none.astype(bool), none)

    def _shine(self, cover: LampCells, cell: Any, ray: tuple[Any, Any, Any]) -> Any:
        """Light of the lamps of cells, where rays meet the lamp or what hides it."""
        import drjit as dr

        assert self.lamps is not None
        mi = self._mi
        light = mi.Color3f(*(dr.gather(mi.Float, mi.Float(aligned(plane)), cell) for plane in cover.light))
        which = dr.gather(mi.Int32, mi.Int32(aligned(cover.lamp, np.int32)), cell)
        return dr.select(self.lamps.meets(ray, which), light, 0.0)

    def _covered(
        self, cover: LampCells, numbers: NDArray[np.uint32], side: NDArray[np.int32], key: int
    ) -> NDArray[np.float32]:
        """Part of cells that lamps cover, shape (n,), with some lens points for each of the strata along a side."""
        import drjit as dr

        assert self.lamps is not None
        mi, part = self._mi, cover.within.astype(np.float32)
        quarter, cell = np.nonzero(cover.crossed)
        if cell.size:
            middle, half, lanes = self._quarters(numbers[cell], quarter)
            points = mi.UInt32(aligned(_LENS_POINTS * side[cell], np.uint32))
            turn = paired_shifts(mi, lanes, 2, dr.opaque(mi.UInt32, key))
            which = mi.Int32(aligned(cover.lamp[cell], np.int32))
            part[quarter, cell] = np.array(self.lamps.share(middle, half, points, turn, which))
        return np.asarray(part.mean(axis=0))

    def _quarters(
        self, numbers: NDArray[np.uint32], place: NDArray[np.intp] | None = None
    ) -> tuple[list[Any], Any, Any]:
        """Middle and half side of parts of cells, all of them or one of each, and their numbers."""
        mi, n = self._mi, PARTS
        if place is None:
            numbers, place = np.repeat(numbers, n * n), np.tile(np.arange(n * n), len(numbers))
        lanes, column, row = (mi.UInt32(aligned(one, np.uint32)) for one in (numbers, place % n, place // n))
        corner, h = self._corner(lanes)
        h = h / n
        middle = [low + (mi.Float64(k) + 0.5) * h for low, k in zip(corner, (column, row), strict=True)]
        return middle, 0.5 * h, lanes * (n * n) + row * n + column

    def _corner(self, lanes: Any, parts: int = 0) -> tuple[list[Any], Any]:
        """Corner (u, v) of cells, or parts of pixels, and their side, float64 pixels; opaque: one kernel for all."""
        import drjit as dr

        mi, grid = self._mi, self.grid
        columns = grid.square_columns * parts if parts else grid.columns
        edge = grid.margin_px + (RIM_PX if parts else 0)
        numbers = (1.0 / (parts or grid.cells), -0.5 - edge, columns, 1.0 / columns)
        h, start, across, per_row = (dr.opaque(mi.Float64, float(value)) for value in numbers)
        lane = mi.Float64(lanes)
        row = dr.floor((lane + 0.5) * per_row)  # exact, and faster than a division of whole numbers
        return [place * h + start for place in (lane - row * across, row)], h

    def _key(self, stream: int) -> int:
        """32-bit seed of one of the view's streams."""
        return int(np.random.SeedSequence([self._seed, stream]).generate_state(1, np.uint32)[0])


def _moments(mi: ModuleType, value: Any, first: Any, count: Any) -> tuple[Stack, Stack]:
    """Mean and variance of the values of each cell, which lie together; NumPy's sums of few take five times as long."""
    import drjit as dr

    dr.eval(value)

    def body(i: Any, total: Any, square: Any) -> tuple[Any, Any, Any]:
        one = mi.Color3f(*(dr.gather(mi.Float, plane, i) for plane in value))
        return i + 1, total + one, square + one * one

    end, zero = first + count, dr.zeros(mi.Color3f, dr.width(first))
    _, total, square = dr.while_loop((first, zero, zero), lambda i, *_: i < end, body)
    mean = total / mi.Float(count)
    spread = dr.maximum(square / mi.Float(count) - mean * mean, 0.0)
    dr.eval(mean, spread)
    return colour_planes(mean), colour_planes(spread)


def _starts(cells: int) -> range:
    """Beginnings of parts of some cells, without the first: what is sampled at a time bounds the memory."""
    return range(_CELLS_AT_A_TIME, cells, _CELLS_AT_A_TIME)


_Arrays = TypeVar("_Arrays", Samples, LampCells)


def _joined(parts: list[_Arrays]) -> _Arrays:
    """Arrays of all parts, in their order; cells are the last axis of each."""
    if len(parts) == 1:
        return parts[0]
    names = [field.name for field in fields(parts[0])]
    return type(parts[0])(*(np.concatenate([getattr(part, name) for part in parts], axis=-1) for name in names))
