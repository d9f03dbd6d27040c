"""Windows of an image: boxes around a position, and what is cut out by them.

Integer (u, v) are pixel centres, u along the columns, v along the rows.
"""

from __future__ import annotations

from typing import Any

from numpy.typing import NDArray

from phibench.estimator.seat.pair import Box

SIDE_PX = 15  # holds 99.9 % of a spot with a blur of up to 2 px, and a border to take the background from


def around(uv_px: tuple[float, float], shape: tuple[int, ...], side_px: int = SIDE_PX) -> Box:
    """Square box with the nearest pixel of a position in its middle, cut at the image's border.

    Parameters
    ----------
    uv_px : (u, v), pixels
    shape : (H, W, ...) of the image
    side_px : int, odd
    """
    half = side_px // 2
    u, v = (round(x) for x in uv_px)
    return clipped(Box(u - half, v - half, 2 * half + 1, 2 * half + 1), shape)


def clipped(box: Box, shape: tuple[int, ...]) -> Box:
    """Part of a box that lies in an image of the shape (H, W, ...)."""
    u0, v0 = max(box.u0_px, 0), max(box.v0_px, 0)
    u1, v1 = min(box.u0_px + box.width_px, shape[1]), min(box.v0_px + box.height_px, shape[0])
    return Box(u0, v0, max(u1 - u0, 0), max(v1 - v0, 0))


def cut(image: NDArray[Any], box: Box) -> NDArray[Any]:
    """Pixels of a box, shape (height, width, ...)."""
    return image[box.slices]
