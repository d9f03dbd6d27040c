"""Camera simulated on the stored layers of one sample (`FrameSource`): frames of both positions, laser on and off.

The layers are read once and kept. A frame is what the camera delivers for one draw of its noise, as an array and, for
MJPEG, as the file. It is a pure function of (data set, seed, sample, position, laser on or off, draw) and of the
request. The order of draws, processes and other draws do not enter. NumPy only.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError, whole_number
from phibench.datasets.common.shown_text import ShortForm
from phibench.datasets.frames.distractors import Distractor
from phibench.datasets.frames.frame_request import FrameRequest, request_faults
from phibench.datasets.store.layers import SpotWindow
from phibench.datasets.store.schema import ManifestRow, SpotRow
from phibench.render.sensor.camera_chain import Chain, auto_exposed
from phibench.render.sensor.electrons import frame_stream
from phibench.render.sensor.light import Light, Region, moved_spot, spot_velocity_px_per_s
from phibench.render.sensor.processing import jpeg_image
from phibench.render.sensor.settings import Sensor
from phibench.scenes.laser import LaserSpot
from phibench.scenes.rig import POSITIONS, Rig, View

Image = NDArray[Any]


@dataclass(frozen=True)
class Frame:
    """One frame.

    Attributes
    ----------
    image : array
        By `sensor.output`: "electrons" (3, h, w) float64, expected electrons behind R, G, B; "raw" (h, w) uint16, DN;
        "srgb8" and "mjpeg" (h, w, 3) uint8; "yuyv" (h, w, 2) uint8, Y' and in turns Cb and Cr.
    jpeg : bytes or None
        The file that the camera sends; None for a region and for other outputs than "mjpeg".
    position : "down" or "up"
        Stroke position.
    laser : bool
        The spot is in the image.
    draw : int
        Number of the noise realisation.
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


@dataclass(frozen=True, repr=False)
class Frames(ShortForm):
    """Frames of one pair of images (down, up) in one noise realisation; images as `Frame.image`.

    Attributes
    ----------
    by_name : mapping of str to Frame
        "down" and "up", and "down_off" and "up_off" where they were asked for.
    """

    by_name: Mapping[str, Frame]

    def _shown(self) -> dict[str, Any]:
        return {name: frame.image for name, frame in self.by_name.items()}

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


_FIRST = ("mono-raw", "bayer-raw", "srgb8", "mjpeg")  # presets of the first version: their draws keep their numbers
_FIRST_OF = {"yuyv": 2**32}  # first draw of a later preset
_OTHER_BITS = 64  # presets of others begin above
_REPEATS = 2**40  # draws between the frames of one image: more than any data set has


def noise_draw(preset: str, draw: int, repeat: int = 0) -> int:
    """Number of a noise stream: another one in each preset, or JPEG frames would have a raw twin's noise.

    `repeat` counts the frames of one image in one draw, from 0.
    """
    if preset in _FIRST:
        number = draw * len(_FIRST) + _FIRST.index(preset)
    elif preset in _FIRST_OF:
        number = _FIRST_OF[preset] + draw
    else:
        number = (int.from_bytes(preset.encode()) << _OTHER_BITS) + draw
    return number + repeat * _REPEATS


class SampleLayers(Protocol):
    """Layers and numbers of a sample, as `phibench.datasets.read.Sample` has them."""

    @property
    def row(self) -> ManifestRow:
        """Exact numbers."""

    @property
    def rig(self) -> Rig:
        """The rig."""

    @property
    def laser_spot(self) -> LaserSpot:
        """The spot."""

    @property
    def stream_names(self) -> tuple[str, int, str]:
        """Data set, its seed, sample id."""

    def view(self, position: str) -> View:
        """Rig at a position."""

    def ambient(self, position: str) -> NDArray[np.float32]:
        """Ambient layer."""

    def spot(self, position: str) -> SpotWindow:
        """Spot layer."""

    @property
    def distractors(self) -> tuple[Distractor, ...]:
        """Other lights, standing still."""


@dataclass(frozen=True)
class PositionLight:
    """One position: the camera, the light that falls on it, and which pixels are read."""

    chain: Chain
    light: Light = field(repr=False)
    region: Region


@dataclass(frozen=True)
class FrameSource:
    """Simulates frames of one pair of images (down, up); it holds the layers, so keep it to simulate many.

    Examples
    --------
    >>> source = sample.region_frames("mjpeg", 64)  # doctest: +SKIP
    >>> spots = [source.frames(k).down for k in range(10_000)]  # doctest: +SKIP

    Attributes
    ----------
    request : FrameRequest
        Sensor, levels and region that were asked for.
    names : tuple of str, int, str
        Data set, seed and sample id, which name the noise.
    sides : mapping of str to PositionLight
        For "down" and "up".
    """

    request: FrameRequest
    names: tuple[str, int, str]
    sides: Mapping[str, PositionLight]

    @classmethod
    def from_request(cls, sample: SampleLayers, request: FrameRequest) -> FrameSource:
        """Read the layers of a sample; auto exposure looks at the down image, without spots.

        Raises
        ------
        DatasetError
            If the request cannot be met or a layer cannot be read; in one sentence.
        """
        with request_faults():
            sensor = _exposed(sample, request)
            sides = {position: _side(sample, position, request, sensor) for position in POSITIONS}
        return cls(request, sample.stream_names, sides)

    @property
    def jpeg_quality(self) -> int | None:
        """libjpeg's quality; None unless the output is MJPEG."""
        sensor = self.sides["down"].chain.sensor
        return sensor.jpeg_quality if sensor.output == "mjpeg" else None

    def frames(self, draw: int = 0, *, laser_off: bool = False) -> Frames:
        """Both positions with the laser on, and, if asked for, both with the laser off."""
        return Frames.of(
            [self.frame(p, draw, on) for on in ((True, False) if laser_off else (True,)) for p in POSITIONS]
        )

    def frame(self, position: str, draw: int = 0, laser: bool = True, repeat: int = 0) -> Frame:
        """One frame; `repeat` counts the frames of one image, where a pair has several of each.

        Raises
        ------
        DatasetError
            If the position is not "down" or "up", the draw not an integer from 0 up, or a layer holds no light.
        """
        if position not in self.sides:
            raise DatasetError(f"position '{position}': must be 'down' or 'up'")
        side, draw = self.sides[position], whole_number("draw", draw)
        stream = frame_stream(*self.names, position, laser, noise_draw(self.request.preset, draw, repeat))
        light, jpeg = side.light if laser else side.light.laser_off(), None
        with request_faults():
            if side.chain.sensor.output == "mjpeg" and side.region == Region.whole(light.size):
                jpeg = side.chain.jpeg_bytes(light, stream)  # encoded once: the image is what is in the file
                image: NDArray[Any] = jpeg_image(jpeg)
            else:
                image = side.chain.frame(light, stream, side.region)
        return Frame(image, jpeg, position, laser, draw, side.chain.sensor, side.region)


def _exposed(sample: SampleLayers, request: FrameRequest) -> Sensor:
    """Sensor of all frames of a pair."""
    if request.exposure != "auto":
        return request.sensor()
    ambient, f_number = sample.ambient("down"), sample.rig.camera.f_number
    return auto_exposed(request.sensor(), Light(ambient, lamp_level=request.lamp_level, f_number=f_number))


def _side(sample: SampleLayers, position: str, request: FrameRequest, sensor: Sensor) -> PositionLight:
    camera = sample.rig.camera
    spot = sample.spot(position)
    light = Light(
        sample.ambient(position),
        spot,
        lamp_level=request.lamp_level,
        laser_level=request.laser_level,
        f_number=camera.f_number,
        others=tuple(distractor.other(position, request.laser_level) for distractor in sample.distractors),
    )
    moving = _moving(sample, position, spot, sensor, request.carriage_speed_m_s)
    region = _region(sample.row, position, request.region, light.size)
    return PositionLight(Chain(sensor, request.camera_seed, camera), replace(light, spot=moving), region)


def _moving(sample: SampleLayers, position: str, spot: SpotWindow, sensor: Sensor, speed_m_s: float) -> SpotWindow:
    """Spot as the rolling shutter sees it; its mean is the same in all draws, so it is moved once."""
    if speed_m_s == 0.0 or spot.electrons_per_s.size == 0:
        return spot
    velocity = spot_velocity_px_per_s(sample.view(position), sample.laser_spot, speed_m_s)
    height = sample.rig.camera.height_px
    u0, v0, planes = moved_spot(spot, velocity, sensor.exposure_s, sensor.readout_s, height)
    nothing = np.zeros_like(planes)
    return SpotWindow(u0, v0, planes, nothing, nothing)


def _region(row: ManifestRow, position: str, wanted: int | Region | None, size: tuple[int, int]) -> Region:
    if wanted is None:
        return Region.whole(size)
    if isinstance(wanted, Region):
        return wanted.within(size)
    spot = row.position(position)
    if not has_place(spot, size):
        raise DatasetError(
            f"{row.sample_id} {position}: no image of the spot ({spot.cause}) to put a region of {wanted} px around; "
            "ask for whole frames or give a Region"
        )
    return Region.around(spot.centre.u_px, spot.centre.v_px, size, wanted)


def has_place(spot: SpotRow, size: tuple[int, int]) -> bool:
    """True if the spot, seen or hidden, has a place on an image of (height, width)."""
    return -0.5 <= spot.u_px <= size[1] - 0.5 and -0.5 <= spot.v_px <= size[0] - 0.5
