"""Example of a dense method, a sweep over 1 / D; try it with `phibench dense check my_depth.py:depth`.

It gets a DensePair, two images of a room in a mirror with the laser off, and returns a DenseAnswer: D of every pixel of
the down image, NaN for "do not know". This one tries 64 distances for every fourth pixel and keeps the one whose place
in the up image looks most alike. Make it better.

Pixels: (u, v), u to the right, v downwards; planes are indexed [v, u]. D is the horizontal distance of the room point
from the vertical line through the sphere centre at the down position. What a pair holds: docs/dense.md.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter, map_coordinates, uniform_filter

from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
from phibench.estimator.geometry.epipolar_line import up_image

STEP_PX = 4  # of the pixels that are looked at
NEAREST_M, FARTHEST_M = 0.5, 8.0
NODES, DISTANCES = 10, 64  # exact places, and those between them
WINDOW = 5  # looked-at pixels along a side that are compared
LEAST_GAIN = 0.7  # of the median cost: a best one above it is no clear match


def depth(pair: DensePair) -> DenseAnswer:
    """D of every pixel by a sweep over 1 / D."""
    height, width = pair.shape
    down, up = (grey(image) for image in (pair.down, pair.up))
    v, u = np.mgrid[STEP_PX // 2 : height : STEP_PX, STEP_PX // 2 : width : STEP_PX]
    pixels = np.stack([u, v], axis=-1).astype(float)
    # places in the up image move smoothly with 1 / D: some are exact, a spline gives the others
    nodes = np.linspace(1.0 / FARTHEST_M, 1.0 / NEAREST_M, NODES)
    exact = np.stack([up_image(pair.rig, pair.stroke_m, pixels, np.full(u.shape, q)).uv_px for q in nodes])
    known = np.isfinite(exact.sum(axis=(0, 3)))
    places = CubicSpline(nodes, np.where(known[..., None], exact, 0.0))
    inverse = np.linspace(nodes[0], nodes[-1], DISTANCES)
    here = down[v, u]
    costs = np.stack([cost(here, up, places(q)) for q in inverse])
    best = np.argmin(costs, axis=0)
    clear = costs.min(axis=0) < LEAST_GAIN * np.median(costs, axis=0)
    inside = (best > 0) & (best < DISTANCES - 1)
    found = np.where(known & clear & inside, 1.0 / finer(inverse, costs, best), np.nan)
    whole = np.kron(found, np.ones((STEP_PX, STEP_PX)))
    return DenseAnswer(depth_m=whole[:height, :width])


def grey(image: np.ndarray) -> np.ndarray:
    """Brightness of an image of any kind, shape (H, W), smoothed by about a pixel."""
    values = np.asarray(image, float)
    if values.ndim == 3:  # R, G, B; or Y' and colour
        values = values[..., 0] if values.shape[2] == 2 else values.mean(axis=2)
    return np.asarray(gaussian_filter(values, 1.2))


def cost(here: np.ndarray, up: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Mean squared difference in windows between the down image and the places of one distance in the up image."""
    there = map_coordinates(up, [places[..., 1], places[..., 0]], order=1, mode="nearest")
    return np.asarray(uniform_filter((there - here) ** 2, WINDOW))


def finer(inverse: np.ndarray, costs: np.ndarray, best: np.ndarray) -> np.ndarray:
    """1 / D at the vertex of the parabola through the best cost and its neighbours."""
    k = np.clip(best, 1, len(inverse) - 2)[None]
    before, at, after = (np.take_along_axis(costs, k + shift, axis=0)[0] for shift in (-1, 0, 1))
    bend = before - 2.0 * at + after
    shift = np.where(bend > 0.0, 0.5 * (before - after) / np.where(bend > 0.0, bend, 1.0), 0.0)
    return np.asarray(inverse[k[0]] + np.clip(shift, -1.0, 1.0) * (inverse[1] - inverse[0]))
