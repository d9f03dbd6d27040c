"""A rectangle of whole pixels, and what it needs around itself."""

from __future__ import annotations

import math
from dataclasses import dataclass

from phibench.render.sensor import SensorError


@dataclass(frozen=True)
class Region:
    """Pixels u0 <= u < u1, v0 <= v < v1."""

    u0_px: int
    v0_px: int
    u1_px: int
    v1_px: int

    @classmethod
    def whole(cls, size: tuple[int, int]) -> Region:
        """All of an image of size (height, width)."""
        return cls(0, 0, size[1], size[0])

    @classmethod
    def around(cls, u_px: float, v_px: float, size: tuple[int, int], side_px: int = 64) -> Region:
        """Square about a point, moved inwards where the image of size (height, width) ends.

        Raises
        ------
        SensorError
            If the point lies outside the image, or the square is larger than the image.
        """
        height, width = size
        if not (-0.5 <= u_px <= width - 0.5 and -0.5 <= v_px <= height - 0.5):
            raise SensorError(
                f"region around ({u_px:g}, {v_px:g}): outside the image, which spans [-0.5, {width - 0.5:g}] x "
                f"[-0.5, {height - 0.5:g}]; give a point inside"
            )
        if not 1 <= side_px <= min(size):
            raise SensorError(f"region of {side_px} px: allowed sides are 1 to {min(size)}, the image's shorter side")
        u0, v0 = (
            min(max(math.floor(centre + 0.5) - side_px // 2, 0), limit - side_px)
            for centre, limit in ((u_px, width), (v_px, height))
        )
        return cls(u0, v0, u0 + side_px, v0 + side_px)

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width)."""
        return self.v1_px - self.v0_px, self.u1_px - self.u0_px

    def slices(self, origin: Region | None = None) -> tuple[slice, slice]:
        """Rows and columns of this region in an image, or in an array that holds the region `origin`."""
        u0, v0 = (origin.u0_px, origin.v0_px) if origin else (0, 0)
        return slice(self.v0_px - v0, self.v1_px - v0), slice(self.u0_px - u0, self.u1_px - u0)

    def grown(self, size: tuple[int, int], step: tuple[int, int] = (1, 1), margin: tuple[int, int] = (0, 0)) -> Region:
        """Smallest region on a grid of `step` pixels (down, across) that holds this one and `margin` pixels around.

        It ends where the image of size (height, width) ends.
        """
        (down, across), (height, width) = step, size
        return Region(
            max((self.u0_px - margin[1]) // across * across, 0),
            max((self.v0_px - margin[0]) // down * down, 0),
            min(-(-(self.u1_px + margin[1]) // across) * across, width),
            min(-(-(self.v1_px + margin[0]) // down) * down, height),
        )

    def within(self, size: tuple[int, int]) -> Region:
        """Return the region itself if it is not empty and inside an image of size (height, width).

        Raises
        ------
        SensorError
            Otherwise.
        """
        height, width = size
        if not (0 <= self.u0_px < self.u1_px <= width and 0 <= self.v0_px < self.v1_px <= height):
            raise SensorError(
                f"region [{self.u0_px}, {self.u1_px}) x [{self.v0_px}, {self.v1_px}): must hold a pixel and lie inside "
                f"the image of {width} x {height} pixels; Region.around moves a square inside"
            )
        return self
