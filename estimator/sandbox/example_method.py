"""A method for phibench; try it with `phibench method check my_phi.py:extract`.

It gets a Pair (two images of one laser spot in a mirror, taken at both ends of a stroke) and returns an Answer. This
one takes the centroid of what is red; make it better.

Pixels: (u, v) with u along the columns to the right and v along the rows downwards; the centre of the first pixel is
(0, 0). Raw images are a mosaic, red at even rows and even columns. All that a pair holds: phibench.estimator.interface.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.interface import Answer, Box, Pair, Spot

HALF_PX = 4  # of the window around the brightest place
LEAST_SIGMAS = 6.0  # of the room's scatter that a spot must exceed


def extract(pair: Pair) -> Answer:
    """Find the spot in both images; the depth follows from the positions."""
    return Answer(find(pair, pair.down, pair.box_down), find(pair, pair.up, pair.box_up))


def find(pair: Pair, image: NDArray[Any], box: Box | None) -> Spot:
    """Position of the spot in one image, shape (H, W) or (H, W, 3)."""
    red, step = red_plane(pair, image)
    # a box says where the spot is; sets without hints have None there
    u0, v0 = (0, 0) if box is None else (box.u0_px // step, box.v0_px // step)
    if box is not None:
        red = red[v0 : v0 + box.height_px // step, u0 : u0 + box.width_px // step]
    above = red - np.median(red)
    scatter = 1.48 * np.median(np.abs(above))
    row, column = (int(i) for i in np.unravel_index(np.argmax(above), above.shape))
    if above[row, column] < LEAST_SIGMAS * scatter:
        return Spot.missing("nothing bright enough")
    top, left = max(row - HALF_PX, 0), max(column - HALF_PX, 0)
    window = above[top : row + HALF_PX + 1, left : column + HALF_PX + 1]
    weight = np.maximum(window - 0.1 * window.max(), 0.0)
    rows, columns = np.indices(weight.shape)
    u = u0 + left + (weight * columns).sum() / weight.sum()
    v = v0 + top + (weight * rows).sum() / weight.sum()
    # pixel k of the red plane is pixel step * k of the image
    return Spot((float(step * u), float(step * v)))


def red_plane(pair: Pair, image: NDArray[Any]) -> tuple[NDArray[np.float64], int]:
    """Red pixels, a new array (images are read-only), and their distance in pixels of the image."""
    if pair.card.output != "raw":
        return image[..., 0].astype(float), 1
    if pair.card.mosaic == "bayer":
        return image[::2, ::2].astype(float), 2
    return image.astype(float), 1
