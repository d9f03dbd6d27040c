"""Textures: albedo, or radiance, as an exact function of the position on a surface.

Positions are metres from the surface's centre along its local x and y. Values stand for the three ambient bands
(R, G, B). Each texture also gives the albedo at the laser's wavelength; where none is stated it is that of band R.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from pydantic_core import core_schema

from phibench.scenes.frames import Array, Vector
from phibench.scenes.validation import SceneError, finite_vector, positive, within


def check_albedo(owner: str, name: str, albedo: Vector) -> Vector:
    """Return three albedos in [0, 1], else raise `SceneError`."""
    values = finite_vector(owner, name, albedo, 3)
    for value in values:
        within(owner, name, value, 0.0, 1.0)
    return values


@dataclass(frozen=True)
class Uniform:
    """One albedo everywhere."""

    albedo: Vector

    def __post_init__(self) -> None:
        object.__setattr__(self, "albedo", check_albedo("Uniform", "albedo", self.albedo))

    def evaluate(self, xy_m: Array) -> Array:
        """Albedo, shape (..., 3), at positions (..., 2), metres."""
        return np.broadcast_to(np.array(self.albedo), (*xy_m.shape[:-1], 3))

    def laser_albedo(self, xy_m: Array) -> Array:
        """Albedo at the laser's wavelength, shape (...), at positions (..., 2)."""
        return self.evaluate(xy_m)[..., 0]


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

    def laser_albedo(self, xy_m: Array) -> Array:
        """Albedo at the laser's wavelength, shape (...), at positions (..., 2)."""
        return self.evaluate(xy_m)[..., 0]


@dataclass(frozen=True, eq=False)
class Bitmap:
    """Image on a surface, bilinear between texel centres, repeated without end in both directions.

    Two bitmaps are equal if their contents are. The image is the world's definition: nothing finer stands behind it.

    Parameters
    ----------
    values : array, shape (rows, columns, 4), float32
        Albedo in the bands R, G, B and at the laser's wavelength, in [0, 1]. Where `is_radiance` the bands are radiance
        in W/(m^2 sr); the fourth value stays an albedo: 0 on a screen, that of the wall in a photographed room.
    texel_m : 2 floats
        Size of a texel along the surface's x (columns) and y (rows, the first one at the bottom).
    origin_m : 2 floats
        Place of the first texel's lower left corner on the surface.
    is_radiance : bool
        The surface sends this light out and reflects none but the laser's: a screen, or a wall of a photographed room.
    """

    values: NDArray[np.float32]
    texel_m: Vector
    origin_m: Vector = (0.0, 0.0)
    is_radiance: bool = False

    def __post_init__(self) -> None:
        values = np.ascontiguousarray(self.values, dtype=np.float32)
        if values.ndim != 3 or values.shape[2] != 4 or 0 in values.shape:
            raise SceneError(f"Bitmap.values: shape {values.shape}: must be (rows, columns, 4) with at least one texel")
        albedos = values[..., 3] if self.is_radiance else values
        if not np.isfinite(values).all() or values.min() < 0.0 or albedos.max() > 1.0:
            limits = "0 or more, the laser's albedo up to 1" if self.is_radiance else "albedos from 0 to 1"
            raise SceneError(f"Bitmap.values: must be finite, {limits}")
        values.flags.writeable = False
        object.__setattr__(self, "values", values)
        for name in ("texel_m", "origin_m"):
            object.__setattr__(self, name, finite_vector("Bitmap", name, getattr(self, name), 2))
        for length in self.texel_m:
            positive("Bitmap", "texel_m", length)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of size and contents."""
        head = f"{self.values.shape} {self.texel_m} {self.origin_m} {self.is_radiance}".encode()
        return hashlib.sha256(head + self.values.tobytes()).hexdigest()

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Bitmap) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:
        return f"Bitmap({self.digest})"

    @classmethod
    def __get_pydantic_core_schema__(cls, *_: object) -> core_schema.CoreSchema:
        """In a document a bitmap is its digest."""
        told = core_schema.plain_serializer_function_ser_schema(repr)
        return core_schema.is_instance_schema(cls, serialization=told)

    def sample(self, xy_m: Array) -> Array:
        """All four values, shape (..., 4), at positions (..., 2)."""
        rows, columns = self.values.shape[:2]
        place = (np.asarray(xy_m, float) - np.array(self.origin_m)) / np.array(self.texel_m) - 0.5
        low = np.floor(place)
        (tx, ty), (i, j) = (np.moveaxis(place - low, -1, 0)[..., None], np.moveaxis(low.astype(int), -1, 0))
        left, right, down, up = i % columns, (i + 1) % columns, j % rows, (j + 1) % rows
        bottom = (1.0 - tx) * self.values[down, left] + tx * self.values[down, right]
        top = (1.0 - tx) * self.values[up, left] + tx * self.values[up, right]
        return np.asarray((1.0 - ty) * bottom + ty * top)

    def evaluate(self, xy_m: Array) -> Array:
        """Bands, shape (..., 3), at positions (..., 2), metres."""
        return self.sample(xy_m)[..., :3]

    def laser_albedo(self, xy_m: Array) -> Array:
        """Albedo at the laser's wavelength, shape (...), at positions (..., 2)."""
        return self.sample(xy_m)[..., 3]


Texture = Uniform | Checker | Bitmap
