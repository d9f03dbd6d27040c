"""Photographs of a mirror ball in made-up surroundings full of patterns, by plain ray casting. Not a test file.

The surroundings are a far sphere of tiles, stripes and lamps of random colours. The camera sees them past the ball and
in it. Rays through 2 x 2 points of every pixel; the blur is a Gaussian of 0.7 px.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

FINE = 2
_BLUR_PX = 0.7


@dataclass(frozen=True)
class BallPhotograph:
    """A photograph and the ball's true outline.

    Attributes
    ----------
    light : float32 array, shape (H, W, 3), linear
    outline_px : array, shape (n, 2)
        Points of the limb.
    radius_px : float
        Their mean distance from their mean.
    focal_px : float
        The principal point is the middle of the picture.
    centre : array, shape (3,)
        Of the ball in the camera frame, in radii of the ball.
    """

    light: np.ndarray
    outline_px: np.ndarray
    radius_px: float
    focal_px: float
    centre: np.ndarray

    def distance_px(self, points_px: np.ndarray) -> float:
        """Largest distance of points from the outline."""
        apart = np.linalg.norm(points_px[:, None] - self.outline_px[None], axis=-1)
        return float(apart.min(axis=1).max())


def ball_photograph(
    rng: np.random.Generator, size: tuple[int, int] = (480, 640), ball: bool = True, reflectance: float = 0.6
) -> BallPhotograph:
    """Photograph with a ball of 0.2 to 0.45 of the short side, somewhere near the middle; or the room alone."""
    short = min(size)
    focal = short * rng.uniform(1.2, 3.0)
    radius = short * rng.uniform(0.2, 0.45)
    away = rng.uniform(-0.05, 0.05, 2) * short
    axis = np.array([away[0] / focal, away[1] / focal, 1.0])
    axis /= np.linalg.norm(axis)
    half = np.arctan(radius / focal)  # of the cone around it
    centre = axis / np.sin(half)  # of a ball of radius 1
    v, u = (np.mgrid[: FINE * size[0], : FINE * size[1]] + 0.5) / FINE - 0.5
    d = np.stack([(u - 0.5 * (size[1] - 1)) / focal, (v - 0.5 * (size[0] - 1)) / focal, np.ones(u.shape)], axis=-1)
    d /= np.linalg.norm(d, axis=-1, keepdims=True)
    b = d @ centre
    root = b**2 - centre @ centre + 1.0
    hit = (root > 0.0) & ball
    n = d[hit] * (b[hit] - np.sqrt(root[hit]))[:, None] - centre
    onward = d.copy()
    onward[hit] = d[hit] - 2.0 * np.sum(d[hit] * n, axis=-1, keepdims=True) * n
    light = _surroundings(rng, onward)
    light[hit] *= reflectance
    light = ndimage.gaussian_filter(light, (FINE * _BLUR_PX, FINE * _BLUR_PX, 0.0))
    light = light.reshape(size[0], FINE, size[1], FINE, 3).mean(axis=(1, 3))
    light *= 1.0 + 0.02 * rng.standard_normal(light.shape)
    across = np.cross(axis, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    turn = np.linspace(0.0, 2.0 * np.pi, 4000)[:, None]
    limb = np.cos(half) * axis + np.sin(half) * (np.cos(turn) * across + np.sin(turn) * np.cross(axis, across))
    outline = focal * limb[:, :2] / limb[:, 2:] + 0.5 * (np.array(size[::-1]) - 1.0)
    mean = float(np.linalg.norm(outline - outline.mean(axis=0), axis=1).mean())
    return BallPhotograph(light.astype(np.float32), outline, mean, focal, centre)


def _surroundings(rng: np.random.Generator, d: np.ndarray) -> np.ndarray:
    """Light by direction: six walls of a cube with tiles of their own size and colours, and lamps."""
    light = np.zeros(d.shape)
    largest = np.argmax(np.abs(d), axis=-1)
    for wall in range(6):
        axis, sign = wall // 2, 1.0 - 2.0 * (wall % 2)
        here = (largest == axis) & (np.sign(d[..., axis]) == sign)
        a, b = (d[here][:, k] / np.abs(d[here][:, axis]) for k in range(3) if k != axis)
        tiles = rng.uniform(0.05, 0.9, (24, 24, 3)) * rng.uniform(0.3, 1.0, 3)
        count = rng.integers(6, 24, 2)
        i, j = ((x + 1.0) / 2.0 * n for x, n in zip((a, b), count, strict=True))
        colour = tiles[np.clip(i, 0, 23).astype(int), np.clip(j, 0, 23).astype(int)]
        colour *= (1.0 + 0.3 * np.sin(rng.uniform(20.0, 60.0) * a + rng.uniform(5.0, 30.0) * b))[:, None]
        centre = rng.uniform(-0.6, 0.6, 2)
        colour[(np.abs(a - centre[0]) < 0.12) & (np.abs(b - centre[1]) < 0.08)] = 6.0
        light[here] = colour
    return light
