"""Texels of a room's faces: the grid of each patch, and the places where its irradiance is computed.

The texels of all patches lie one after the other in flat arrays, row by row (local y): a light map is an array of shape
(N, 3). A patch has at least 2 x 2 texels, spread over the rectangle around it. Two-sided patches have two grids, front
and back. Lamps and faces that shine by their texture have none.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phibench.render.optics.faces import FaceTable, IntArray
from phibench.scenes.frames import Array

_ACROSS, _FINEST_M = 8.0, 0.05  # texels across a small face, and their least size


def texel_sizes_m(table: FaceTable, texel_m: float) -> Array:
    """Sizes of the texels of patches, shape (P,): `texel_m` on large faces.

    Smaller ones, where shadows of near things count for more, get eight texels across, down to half the size, or 5 cm
    if that is more. Strips narrower than a texel would gain nothing.
    """
    short, finest = table.size_m.min(axis=1, initial=np.inf), min(texel_m, max(0.5 * texel_m, _FINEST_M))
    return np.where(short < texel_m, texel_m, np.clip(short / _ACROSS, finest, texel_m))


@dataclass(frozen=True, eq=False)
class TexelGrid:
    """Texel grids of the patches of a table.

    Attributes
    ----------
    table : FaceTable
    columns, rows : int arrays, shape (P,)
        Along local x and y; 0 where there is no grid.
    start : int array, shape (P,)
        First texel of a patch's front.
    """

    table: FaceTable
    columns: IntArray
    rows: IntArray
    start: IntArray

    @classmethod
    def of(cls, table: FaceTable, texel_m: float | Array) -> TexelGrid:
        """Grid with texels of at most `texel_m`: sizes of patches, shape (P,), or one for `texel_sizes_m`."""
        if np.ndim(texel_m) == 0:
            texel_m = texel_sizes_m(table, float(texel_m))
        sides = np.maximum(np.ceil(table.size_m / np.reshape(texel_m, (-1, 1)) - 1e-9), 2).astype(np.int64)
        columns, rows = np.where(table.emits | table.is_radiance, 0, sides.T)
        counts = columns * rows * np.where(table.two_sided, 2, 1)
        return cls(table, columns, rows, np.concatenate([[0], np.cumsum(counts)[:-1]]).astype(np.int64))

    @property
    def back(self) -> IntArray:
        """First texel of a patch's back, shape (P,); -1 where it has none."""
        return np.where(self.table.two_sided & (self.columns > 0), self.start + self.columns * self.rows, -1)

    @cached_property
    def count(self) -> int:
        """Number of texels."""
        return int(np.sum(self.columns * self.rows * np.where(self.table.two_sided, 2, 1)))

    def texels_of(self, patches: int) -> int:
        """Number of texels of the first so many patches."""
        return int(self.start[patches]) if patches < len(self.start) else self.count

    def grids(self) -> Iterator[tuple[slice, int, int]]:
        """Texels, rows and columns of every grid."""
        sides = zip(self.start.tolist(), self.back.tolist(), self.rows.tolist(), self.columns.tolist(), strict=True)
        for start, back, rows, columns in sides:
            for first in (start, back):
                if columns and first >= 0:
                    yield slice(first, first + rows * columns), rows, columns

    @cached_property
    def alike(self) -> list[IntArray]:
        """Texels of all grids, those of as many rows and columns together, shape (grids, rows, columns) each.

        A room has a thousand grids of few shapes: what is done to all of one shape at once costs a tenth of the time.
        """
        found: dict[tuple[int, int], list[int]] = {}
        for part, *size in self.grids():
            found.setdefault((size[0], size[1]), []).append(part.start)
        return [
            np.array(starts)[:, None, None] + np.arange(rows * columns).reshape(rows, columns)
            for (rows, columns), starts in found.items()
        ]

    def patch(self) -> tuple[IntArray, IntArray]:
        """Patch and number within its grid of every texel, shape (N,) each."""
        each = self.columns * self.rows
        counts = np.stack([each, np.where(self.table.two_sided, each, 0)], axis=1).ravel()
        grid = np.repeat(np.arange(len(counts)), counts)
        first = np.cumsum(counts) - counts
        return grid // 2, np.arange(len(grid)) - first[grid]

    def areas_m2(self) -> Array:
        """Area of every texel, shape (N,)."""
        each = self.table.size_m.prod(axis=1) / np.maximum(self.columns * self.rows, 1)
        return np.asarray(each[self.patch()[0]])

    def points(self) -> tuple[Array, Array]:
        """World points of the texels' middles and the normals of their side, shape (N, 3) each.

        Those beyond the outline of a patch that is no rectangle lie in its plane all the same: the light there is what
        goes on smoothly from the patch, or they are covered by what stands there.
        """
        table, (patch, number) = self.table, self.patch()
        column, row = number % self.columns[patch], number // self.columns[patch]
        x = ((column + 0.5) / self.columns[patch] - 0.5) * table.size_m[patch, 0]
        y = ((row + 0.5) / self.rows[patch] - 0.5) * table.size_m[patch, 1]
        points = table.centre_m[patch] + x[:, None] * table.x_axis[patch] + y[:, None] * table.y_axis[patch]
        behind = np.arange(len(patch)) >= np.where(self.back >= 0, self.back, self.count + 1)[patch]
        return points, np.where(behind[:, None], -1.0, 1.0) * table.normal[patch]
