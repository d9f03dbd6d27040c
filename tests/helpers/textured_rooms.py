"""Pairs of images of a square room with printed walls and floor, by other means than the renderer: rays and sines.

Not a test file.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from helpers.dense_truths import smaller

from phibench.datasets.frames.sensor_card import sensor_card
from phibench.estimator.dense.dense_interface import DensePair
from phibench.estimator.geometry.reflection import room_rays
from phibench.scenes.frames import Array
from phibench.scenes.misalignment import Misalignment
from phibench.scenes.rig import Rig, View
from phibench.scenes.room import default_rig

WALL_M, CEILING_M = 2.5, 3.0
SMALL = 3.0  # times larger pixels than the default rig's, to be quick
TILTED = Misalignment(tilt_x_rad=0.01, decentre_y_m=1e-3, stroke_tilt_y_rad=0.006)


def small_rig(misalignment: Misalignment | None = None) -> Rig:
    """Rig with the default's field of view and fewer pixels."""
    return smaller(default_rig(), SMALL).perturbed(misalignment or Misalignment())


@dataclass(frozen=True)
class TexturedRoom:
    """Smooth print: a sum of plane waves in the room, drawn by a seed, codes about 110."""

    seed: int = 0
    contrast: float = 12.0
    shortest_m: float = 0.35
    stripes_m: float | None = None  # period of stripes around the room, in place of the waves

    def codes(self, points_m: Array) -> Array:
        """Luma at points (..., 3)."""
        rng = np.random.default_rng(self.seed)
        result = np.full(points_m.shape[:-1], 110.0)
        if self.stripes_m is not None:
            return result + self.contrast * np.sin(2.0 * np.pi * points_m.sum(axis=-1) / self.stripes_m)
        for _ in range(24):
            direction = rng.normal(size=3)
            wave = direction / np.linalg.norm(direction) * 2.0 * np.pi / rng.uniform(self.shortest_m, 1.2)
            result += self.contrast / np.sqrt(12.0) * np.sin(points_m @ wave + rng.uniform(0.0, 2.0 * np.pi))
        return result

    def points(self, view: View, uv_px: Array) -> Array:
        """Room points that pixels see, shape (..., 3); NaN beside the mirror."""
        ray = room_rays(view, uv_px)
        P, r = ray.origin_world_m, ray.direction_world
        far, near = np.array([WALL_M, WALL_M, CEILING_M]), np.array([-WALL_M, -WALL_M, 0.0])
        with np.errstate(divide="ignore"):
            faces = np.where(r > 0.0, far - P, near - P) / r
        return P + faces.min(axis=-1, keepdims=True) * r

    def image(self, view: View) -> Array:
        """Image, shape (H, W), codes; 0 beside the mirror."""
        camera = view.rig.camera
        uv = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1).astype(float)
        return np.nan_to_num(self.codes(self.points(view, uv)))

    def pair(
        self, rig: Rig, stroke_m: float, noise: float = 1.0, between_m: tuple[float, ...] = ()
    ) -> tuple[DensePair, Array]:
        """Pair as 8-bit pictures with white noise, codes, and D of the down image's pixels, shape (H, W)."""
        rng = np.random.default_rng(self.seed + 1)
        images = [self.image(rig.at(h)) for h in (0.0, stroke_m, *between_m)]
        coded = [np.clip(np.rint(x + noise * rng.normal(size=x.shape)), 0, 255).astype(np.uint8) for x in images]
        down, up, *between = (np.repeat(x[..., None], 3, axis=-1) for x in coded)
        camera = rig.camera
        uv = np.stack(np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px)), axis=-1).astype(float)
        view = rig.at(0.0)
        depth = np.linalg.norm((self.points(view, uv) - view.sphere_centre_m)[..., :2], axis=-1)
        pair = DensePair(0, down, up, rig, stroke_m, sensor_card("srgb8"))
        return replace(pair, between=np.stack(between), between_m=between_m) if between else pair, depth
