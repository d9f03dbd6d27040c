"""A method for phibench; try it with `phibench method check my_phi.py:extract`.

It gets a Pair, two images of one laser spot in a mirror, and returns an Answer. This one subtracts the frame with the
laser off, takes the brightest place inside the mirror, and its centroid. Make it better.

Pixels: (u, v), u along the columns to the right, v along the rows downwards; the first pixel's centre is (0, 0).
Raw images are a mosaic, red at even rows and even columns. All that a pair holds: phibench.estimator.interface.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import center_of_mass, gaussian_filter, maximum_filter

from phibench.estimator.interface import Answer, Box, Image, Pair, Spot
from phibench.estimator.methods.simple import detected_spots

HALF_PX = 3  # of the window of the centroid
LEAST_SIGMAS = 6.0  # of the noise that a spot must exceed
LAMP = 1.8  # times the median light: brighter areas are lamps, whose noise and JPEG errors look like spots


def extract(pair: Pair) -> Answer:
    """Find the spot in both images; the depth follows from the positions."""
    if pair.down_off is None or pair.up_off is None:
        return detected_spots(pair)  # nothing to subtract: the built-in search
    down = find(pair, pair.down, pair.down_off, pair.box_down)
    up = find(pair, pair.up, pair.up_off, pair.box_up)
    return Answer(down, up)


def find(pair: Pair, image: Image, off: Image, box: Box | None) -> Spot:
    """Position of the spot in one image."""
    room, step = red_plane(pair, off)
    laser = red_plane(pair, image)[0] - room
    inside = mirror(pair, box)[::step, ::step]
    lamps = gaussian_filter(room, 4.0 / step) > LAMP * np.median(room[inside])
    inside &= ~maximum_filter(lamps, 24 // step + 1)  # a JPEG block and a half around them
    # narrow minus wide Gaussian: small things stay, slow changes of the light go
    likeness = gaussian_filter(laser, 1.0 / step) - gaussian_filter(laser, 4.0 / step)
    noise = 1.48 * np.median(np.abs(likeness[inside]))  # standard deviation from the median absolute value
    likeness[~inside] = -np.inf
    row, column = (int(i) for i in np.unravel_index(np.argmax(likeness), likeness.shape))
    if not likeness[row, column] > LEAST_SIGMAS * noise:
        return Spot.missing("nothing bright enough in the mirror")
    top, left = max(row - HALF_PX, 0), max(column - HALF_PX, 0)
    window = laser[top : row + HALF_PX + 1, left : column + HALF_PX + 1]
    window = window - np.median(window)
    v, u = center_of_mass(np.maximum(window - 0.1 * window.max(), 0.0))
    return Spot(
        (float(step * (left + u)), float(step * (top + v)))
    )  # pixel k of the red plane is step * k of the image


def mirror(pair: Pair, box: Box | None) -> np.ndarray:
    """Pixels in which the spot may be: inside the mirror's outline, and in the box of a pair that has one."""
    v, u = np.indices(pair.down.shape[:2])
    outline = pair.rig.outline_px()
    centre = outline.mean(axis=0)
    inside = np.hypot(u - centre[0], v - centre[1]) < np.linalg.norm(outline - centre, axis=1).min() - 3.0
    if box is not None:
        hinted = np.zeros_like(inside)
        hinted[box.slices] = True
        inside &= hinted
    return inside


def red_plane(pair: Pair, image: Image) -> tuple[np.ndarray, int]:
    """Red pixels, a new array (images are read-only), and their distance in pixels of the image."""
    if pair.card.output != "raw":
        return image[..., 0].astype(float), 1
    step = 2 if pair.card.mosaic == "bayer" else 1
    return image[::step, ::step].astype(float), step
