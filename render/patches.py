"""Surfaces of a scene cut into texels: where light maps live.

A patch is one rectangle; its texels form a grid of about `texel_m`, at least 2 x 2. All patches' texels lie one after
the other in flat arrays, row by row (local y): a light map is an array of shape (N, 3).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from phibench.scenes.frames import Array
from phibench.scenes.solids import Rectangle, Shape, faces


@dataclass(frozen=True)
class Patch:
    """One rectangle and its texel grid: `columns` along local x, `rows` along local y, texels from `start` on."""

    surface: Rectangle
    columns: int
    rows: int
    start: int

    @property
    def count(self) -> int:
        """Number of texels."""
        return self.columns * self.rows

    def centres_m(self) -> Array:
        """World points of the texel centres, shape (rows * columns, 3)."""
        x, y = ((np.arange(n) + 0.5) / n - 0.5 for n in (self.columns, self.rows))
        width, height = self.surface.size_m
        grid = np.stack(np.broadcast_arrays(width * x, height * y[:, None], 0.0), axis=-1)
        return self.surface.T_world_shape.points(grid.reshape(-1, 3))

    @property
    def normal(self) -> Array:
        """Unit normal, world frame, shape (3,)."""
        return self.surface.T_world_shape.R[:, 2]


def cut(shapes: Sequence[Shape], texel_m: float) -> tuple[Patch, ...]:
    """Patches of all faces of the shapes, in order; the index of a patch is its id in the Mitsuba scene."""
    patches, start = [], 0
    for shape in shapes:
        for surface in faces(shape):
            columns, rows = (max(2, math.ceil(length / texel_m)) for length in surface.size_m)
            patches.append(Patch(surface, columns, rows, start))
            start += columns * rows
    return tuple(patches)


def texel_count(patches: Sequence[Patch]) -> int:
    """Number of texels of all patches."""
    return sum(patch.count for patch in patches)
