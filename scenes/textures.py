"""Diffuse albedo as an exact function of the position on a surface.

Albedo has three values, one per ambient band (R, G, B). Positions are metres from the surface's centre.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from phibench.scenes.checks import finite_vector, positive, within
from phibench.scenes.frames import Array, Vector


@dataclass(frozen=True)
class Uniform:
    """One albedo everywhere."""

    albedo: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", check_albedo("Uniform", "albedo", self.albedo))

    def evaluate(self, xy_m: Array) -> Array:
        """Albedo, shape (..., 3), at positions (..., 2), metres."""
        return np.broadcast_to(np.array(self.albedo), (*xy_m.shape[:-1], 3))


@dataclass(frozen=True)
class Checker:
    """Checkerboard whose cells measure `cell_m` (x, y); a corner of four cells lies at the surface's corner (-x, -y).

    A cell longer than the surface in one direction makes stripes.
    """

    albedo_even: Vector
    albedo_odd: Vector
    cell_m: Vector
    origin_m: Vector

    def __post_init__(self) -> None:
        for name in ("albedo_even", "albedo_odd"):
            object.__setattr__(self, name, check_albedo("Checker", name, getattr(self, name)))
        for name in ("cell_m", "origin_m"):
            object.__setattr__(self, name, finite_vector("Checker", name, getattr(self, name), 2))
        for length in self.cell_m:
            positive("Checker", "cell_m", length)

    def evaluate(self, xy_m: Array) -> Array:
        """Albedo, shape (..., 3), at positions (..., 2), metres."""
        cells = np.floor((xy_m - np.array(self.origin_m)) / np.array(self.cell_m))
        odd = np.mod(cells.sum(axis=-1), 2.0)[..., None] > 0.5
        return np.where(odd, np.array(self.albedo_odd), np.array(self.albedo_even))


Texture = Uniform | Checker


def check_albedo(owner: str, name: str, albedo: Vector) -> Vector:
    """Return three albedos in [0, 1], else raise `SceneError`."""
    values = finite_vector(owner, name, albedo, 3)
    for value in values:
        within(owner, name, value, 0.0, 1.0)
    return values
