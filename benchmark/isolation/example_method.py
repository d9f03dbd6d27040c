"""Example of a method, the centroid of the laser's light; try it with `phibench method check my_phi.py:extract`.

It gets a Pair, two images of one laser spot in a mirror, and returns an Answer. This one takes the light that the laser
adds, the most spot-like place inside the mirror, and its centroid. Make it better.

Pixels: (u, v), u along the columns to the right, v along the rows downwards; the first pixel's centre is (0, 0).
All that a pair holds: phibench.estimator.interface. What the functions below take and give: docs/method.md.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import center_of_mass, gaussian_filter

from phibench.estimator.interface import Answer, Pair, Spot
from phibench.estimator.methods.pair_light import lamp_mask, laser_light, mirror_mask, noise_of

HALF_PX = 5  # of the pixels around the brightest one
WINDOW_SIGMA_PX, ROUNDS = 1.5, 10  # of the Gaussian window of the centroid
LEAST_SIGMAS = 6.0  # of the noise that a spot must exceed


def extract(pair: Pair) -> Answer:
    """Find the spot in both images; the depth follows from the positions."""
    return Answer(find(pair, "down"), find(pair, "up"))


def find(pair: Pair, position: str) -> Spot:
    """Position of the spot in one image, "down" or "up"."""
    light = laser_light(pair, position)  # shape (H, W): red light, laser on minus laser off
    inside = mirror_mask(pair, position) & ~lamp_mask(pair, position)
    # narrow minus wide Gaussian: small things stay, slow changes of the light go
    likeness = gaussian_filter(light, 1.0) - gaussian_filter(light, 4.0)
    noise = noise_of(likeness, inside)
    likeness[~inside] = -np.inf
    v, u = (int(i) for i in np.unravel_index(np.argmax(likeness), likeness.shape))
    if not likeness[v, u] > LEAST_SIGMAS * noise:
        return Spot.missing("nothing bright enough in the mirror")
    top, left = max(v - HALF_PX, 0), max(u - HALF_PX, 0)
    window = light[top : v + HALF_PX + 1, left : u + HALF_PX + 1]
    window = np.maximum(window - np.median(window), 0.0)
    rows, columns = np.mgrid[: window.shape[0], : window.shape[1]]
    row, column = float(v - top), float(u - left)
    for _ in range(ROUNDS):  # a window that moves with the centroid does not draw it to the brightest pixel
        weight = window * np.exp(-0.5 * ((rows - row) ** 2 + (columns - column) ** 2) / WINDOW_SIGMA_PX**2)
        found_row, found_column = center_of_mass(weight)
        row, column = row + 2.0 * (found_row - row), column + 2.0 * (found_column - column)
    if not (0.0 <= row < len(window) and 0.0 <= column < len(window[0])):
        return Spot.missing("no round spot")
    return Spot((left + column, top + row))
