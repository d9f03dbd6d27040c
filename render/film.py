"""Sampling the cells of one view's film: stratified over the cell, quasi-random over the aperture."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.film_grid import FilmGrid, Stack
from phibench.render.quasi import points, shifts
from phibench.render.surfaces import Surfaces
from phibench.render.view_rays import look


@dataclass(frozen=True)
class Samples:
    """What n cells see.

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

    def __init__(self, mi: ModuleType, surfaces: Surfaces, grid: FilmGrid, seed: int) -> None:
        self._mi, self._surfaces, self.grid, self._seed = mi, surfaces, grid, seed
        self._dimensions = 4 if surfaces.view.rig.mirror.roughness_alpha == 0.0 else 6

    def sample(self, numbers: NDArray[np.uint32], side: int, stream: int) -> Samples:
        """Sample cells, shape (n,), with side x side points each."""
        import drjit as dr

        mi, grid = self._mi, self.grid
        lanes = mi.UInt32(numbers)
        m, key = (dr.opaque(mi.UInt32, value) for value in (side, self._key(stream)))
        shift = shifts(mi, lanes, self._dimensions, key)
        column, row = mi.Float64(lanes % grid.columns), mi.Float64(lanes // grid.columns)
        h, start = 1.0 / grid.cells, -0.5 - grid.margin_px

        def body(i: Any, total: Any, square: Any, seen: Any) -> tuple[Any, Any, Any, Any]:
            x = points(mi, shift, i)
            u = (column + (mi.Float64(i % m) + mi.Float64(x[0])) / mi.Float64(m)) * h + start
            v = (row + (mi.Float64(i // m) + mi.Float64(x[1])) / mi.Float64(m)) * h + start
            value, mirrored = look(mi, self._surfaces, u, v, x[2:])
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
