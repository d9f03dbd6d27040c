"""Frames of a stroke pair: what the C310 delivers for one draw of its noise, as arrays and as JPEG files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from numpy.typing import NDArray

from phibench.datasets.errors import DatasetError
from phibench.render.region import Region
from phibench.render.sensor import Sensor

Image = NDArray[Any]


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes
    ----------
    image : array
        By `sensor.output`: "electrons" (3, h, w) float64, expected electrons behind R, G, B; "raw" (h, w) uint16, DN;
        "srgb8" and "mjpeg" (h, w, 3) uint8.
    jpeg : bytes or None
        The file that the camera sends; None for a region and for other outputs than "mjpeg".
    position : "down" or "up"
    laser : bool
    draw : int
    sensor : Sensor
        With the exposure and the gain that were used.
    region : Region
        Pixels of the sensor that `image` holds.
    """

    image: Image = field(repr=False)
    jpeg: bytes | None = field(repr=False)
    position: str
    laser: bool
    draw: int
    sensor: Sensor
    region: Region

    @property
    def name(self) -> str:
        """Its name in `Frames`: "down", "up", "down_off" or "up_off"."""
        return self.position if self.laser else f"{self.position}_off"


@dataclass(frozen=True)
class Frames:
    """One draw of a stroke pair; images as `Frame.image`.

    Attributes
    ----------
    by_name : mapping of str to Frame
        "down" and "up", and "down_off" and "up_off" where they were asked for.
    """

    by_name: Mapping[str, Frame]

    @classmethod
    def of(cls, frames: list[Frame]) -> Frames:
        """Put frames of one draw together."""
        return cls(MappingProxyType({frame.name: frame for frame in frames}))

    @property
    def down(self) -> Image:
        """Stroke position 1, laser on."""
        return self._image("down")

    @property
    def up(self) -> Image:
        """Stroke position 2, laser on."""
        return self._image("up")

    @property
    def down_off(self) -> Image:
        """Stroke position 1, laser off."""
        return self._image("down_off")

    @property
    def up_off(self) -> Image:
        """Stroke position 2, laser off."""
        return self._image("up_off")

    @property
    def jpeg(self) -> dict[str, bytes]:
        """JPEG files by name; empty where the frames are not whole MJPEG frames."""
        return {name: frame.jpeg for name, frame in self.by_name.items() if frame.jpeg is not None}

    def _image(self, name: str) -> Image:
        if name not in self.by_name:
            raise DatasetError(f"'{name}' was not drawn: ask for frames(laser_off=True)")
        return self.by_name[name].image
