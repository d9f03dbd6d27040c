"""Light on the sensor: layers with the levels of lamps and laser, the spot's motion, and regions of the image.

Layers have the shape (3, H, W), planes R, G, B; a region is a rectangle of whole pixels.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from phibench.render.sensor.settings import SensorError
from phibench.scenes.frames import Array


class SpotImage(Protocol):
    """A spot layer, rendered or read: see `phibench.render.optics.spot_layer.SpotLayer`."""

    @property
    def u0_px(self) -> int:
        """Image column of the window's first column."""

    @property
    def v0_px(self) -> int:
        """Image row of the window's first row."""

    @property
    def electrons_per_s(self) -> Array:
        """Expected electrons per second, shape (3, h, w)."""

    @property
    def du_electrons_per_s_px(self) -> Array:
        """Derivative by a shift of the spot's image by +u, shape (3, h, w)."""

    @property
    def dv_electrons_per_s_px(self) -> Array:
        """Derivative by a shift of the spot's image by +v, shape (3, h, w)."""


@dataclass(frozen=True)
class OtherSpot:
    """Another small light in the view, for which a method may take the spot; it stands still.

    Parameters
    ----------
    image : spot layer
    follows_laser : bool
        Whether the laser's level is its factor, so that it goes out with the laser; otherwise it is as the layer says.
    """

    image: SpotImage = field(repr=False)
    follows_laser: bool = True


@dataclass(frozen=True)
class Light:
    """Expected photo-electrons per second behind the filters R, G, B, of one view.

    The layers are radiance times etendue: the natural cos^4 fall-off is in them and is applied nowhere else.

    Parameters
    ----------
    ambient_electrons_per_s : array, shape (3, H, W)
    spot : spot layer or None
    lamp_level, laser_level : float
        Factors of the ambient and of the spot layer; `laser_level` 0 is laser off.
    velocity_px_per_s : 2 floats
        Velocity (u, v) of the spot's image; see `rolling_shutter`. The room is taken to stand still.
    f_number : float
        Lens stop at which the layers were rendered.
    others : tuple of OtherSpot
        Added to the spot. Neither `velocity_px_per_s` nor the spot's speckle flicker is theirs.
    """

    ambient_electrons_per_s: NDArray[Any] = field(repr=False)
    spot: SpotImage | None = field(default=None, repr=False)
    lamp_level: float = 1.0
    laser_level: float = 1.0
    velocity_px_per_s: tuple[float, float] = (0.0, 0.0)
    f_number: float = 2.4
    others: tuple[OtherSpot, ...] = ()

    def __post_init__(self) -> None:
        shape = self.ambient_electrons_per_s.shape
        if len(shape) != 3 or shape[0] != 3 or min(shape) < 2:
            raise SensorError(
                f"Light.ambient_electrons_per_s has the shape {shape}: (3, H, W) of 2 pixels or more is needed"
            )
        for name in ("lamp_level", "laser_level"):
            _not_negative(name, getattr(self, name))
        if not all(map(math.isfinite, self.velocity_px_per_s)):
            raise SensorError(f"Light.velocity_px_per_s = {self.velocity_px_per_s}: must be two finite numbers")
        if not 0.5 <= self.f_number <= 256.0:
            raise SensorError(f"Light.f_number = {self.f_number:g}: allowed range is 0.5 to 256")

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the image, pixels."""
        return self.ambient_electrons_per_s.shape[1], self.ambient_electrons_per_s.shape[2]

    def laser_off(self) -> Light:
        """Return the same view without the laser: neither the spot nor what follows the laser."""
        return replace(self, laser_level=0.0)

    def without_spot(self) -> Light:
        """Return the same view without the spot, but with every other light: what lies under the spot."""
        return replace(self, spot=None)

    @classmethod
    def flat(cls, electrons_per_s: tuple[float, float, float], size: tuple[int, int]) -> Light:
        """Return a uniform field, for tests and photon transfer; `size` is (height, width)."""
        return cls(np.broadcast_to(np.array(electrons_per_s)[:, None, None], (3, *size)))


def _not_negative(name: str, value: float) -> None:
    if not (math.isfinite(value) and value >= 0.0):
        raise SensorError(f"Light.{name} = {value}: must be 0 or above")


@dataclass(frozen=True)
class Region:
    """Pixels u0 <= u < u1, v0 <= v < v1."""

    u0_px: int
    v0_px: int
    u1_px: int
    v1_px: int

    @classmethod
    def whole(cls, size: tuple[int, int]) -> Region:
        """Region of a whole image of size (height, width)."""
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
        # pixel centres are integers: the middle pixel is the nearest one
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

    def bands(self, rows: int) -> Iterator[Region]:
        """Parts of so many rows, from above; the last one may have less."""
        for v in range(self.v0_px, self.v1_px, rows):
            yield Region(self.u0_px, v, self.u1_px, min(v + rows, self.v1_px))

    def grown(self, size: tuple[int, int], step: tuple[int, int] = (1, 1), margin: tuple[int, int] = (0, 0)) -> Region:
        """Smallest region on a grid of `step` pixels (down, across) that holds this one and `margin` pixels around.

        It ends where the image of size (height, width) ends.
        """
        (down, across), (height, width) = step, size
        # -(-a // b) rounds up
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
