"""Sensor chain: expected electrons per second in, a frame of the camera out; and auto exposure.

A frame is a pure function of the light, the sensor, the camera's seed and the names of its noise stream. A region of it
has the same pixels as the whole frame, to the bit, and costs what its pixels cost. Stages that look at neighbours get a
margin, noise comes in tiles that are drawn whole, and JPEG works on whole units plus one around.

Auto exposure chooses the time and the gain at which the expected image has the level that the camera aims at. It looks
at the expectation, never at a draw, so that all draws have the same exposure, with the laser on or off. The light of
the room alone decides: the spot is too small to count.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.sensor.electrons import (
    TILE_PX,
    FixedPattern,
    NoiseStream,
    collected_charge,
    digitised_signal,
    expected_electrons,
    fixed_pattern,
    mean_charge,
    mono,
    read_out,
    speckle_gain,
    stop_factor,
    whole_tiles,
)
from phibench.render.sensor.light import Light, Region
from phibench.render.sensor.processing import (
    LUMA,
    MCU_PX,
    colour_corrected,
    compressed,
    denoise_margin_px,
    eight_bit,
    jpeg_bytes,
    linear_rgb,
    linear_signal,
    rendered,
    tone_encoded,
    white_balanced,
    yuyv,
)
from phibench.render.sensor.settings import Sensor, SensorError, preset_outputs
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array

_BAND_PX = 64  # rows that are processed at a time: what a core's cache holds


@dataclass(frozen=True)
class Chain:
    """One camera: its sensor, the seed of its fixed pattern, and the lens (used by the extra vignetting alone).

    Examples
    --------
    >>> from phibench.render.sensor.settings import sensor
    >>> chain = Chain(sensor("mjpeg"))
    >>> light = Light.flat((9e4, 9e4, 6e4), (72, 128))
    >>> chain.frame(light, NoiseStream(("readme", 0, "down", "on", 0))).shape
    (72, 128, 3)
    """

    sensor: Sensor
    camera_seed: int = 0
    camera: Camera = Camera()

    def frame(self, light: Light, stream: NoiseStream, region: Region | None = None) -> NDArray[Any]:
        """One draw.

        Parameters
        ----------
        light : Light
            Expected electrons per second.
        stream : NoiseStream
            Name it after all that makes the frame: data set, seed, sample, position, laser on or off, draw.
        region : Region, optional
            Part of the image; all of it if not given.

        Returns
        -------
        array
            By `sensor.output`: "electrons" (3, h, w) float64, expected; "raw" (h, w) uint16 DN; "srgb8" and "mjpeg"
            (h, w, 3) uint8, R, G, B; "yuyv" (h, w, 2) uint8, Y' and in turns Cb (even columns of the image) and Cr.

        Raises
        ------
        SensorError
            If the region is not inside the image, or the image of "yuyv" has an odd number of columns.
        """
        region = (region or Region.whole(light.size)).within(light.size)
        if self.sensor.output == "electrons":
            gain = speckle_gain(self.sensor, stream)
            return expected_electrons(light, self.sensor, self.camera, region, gain)
        if self.sensor.output == "raw":
            return self.raw(light, stream, region)
        if self.sensor.output in ("srgb8", "yuyv"):
            return self.developed(light, stream, region)
        box = self.jpeg_region(region, light.size)
        return compressed(self.developed(light, stream, box), self.sensor)[region.slices(box)]

    def jpeg_bytes(self, light: Light, stream: NoiseStream) -> bytes:
        """Return the whole frame as the camera sends it, one JPEG file."""
        image = self.developed(light, stream, Region.whole(light.size))
        return jpeg_bytes(image, self.sensor)

    def raw(self, light: Light, stream: NoiseStream, region: Region) -> NDArray[np.uint16]:
        """Return the converter's DN, shape (h, w)."""
        s, tiles = self.sensor, whole_tiles(region, light.size)
        photo = self.photo_electrons(light, tiles, speckle_gain(s, stream))
        pattern, dn = self.pattern(tiles), np.empty(tiles.shape, np.uint16)
        for band in tiles.bands(TILE_PX):
            rows, _ = band.slices(tiles)
            part = pattern.rows(rows)
            charge = collected_charge(mean_charge(photo[rows], s, part), s, stream, band)
            dn[rows] = digitised_signal(read_out(charge, s, part, stream, band), s)
        return dn[region.slices(tiles)]

    def developed(self, light: Light, stream: NoiseStream, region: Region) -> NDArray[np.uint8]:
        """Return the processed image before JPEG, shape (h, w, 3), or (h, w, 2) of "yuyv"."""
        yuv, size = self.sensor.output == "yuyv", light.size
        if yuv and size[1] % 2:
            raise SensorError(f"image of {size[1]} columns: YUYV holds pairs of them, give an even number")
        box = self.raw_region(region, size)
        raw, image = self.raw(light, stream, box), np.empty((*region.shape, 2 if yuv else 3), np.uint8)
        for band in region.bands(_BAND_PX):
            around = self.raw_region(band, size)
            signal = linear_signal(raw[around.slices(box)], self.sensor, np.float32)
            planes = rendered(linear_rgb(signal, self.sensor), self.sensor)
            image[band.slices(region)] = (yuyv(planes, self.sensor) if yuv else eight_bit(planes))[band.slices(around)]
        return image

    def shrunk_frame(self, light: Light, stream: NoiseStream, factor: int) -> NDArray[np.uint8]:
        """Whole frame of a camera that shrinks its image, shape (h, w, 3) or (h, w, 2) of "yuyv".

        The light has `factor` times its rows and columns: of the sensor's own pixels.

        Raises
        ------
        SensorError
            If the light's size is no multiple of the factor.
        """
        if light.size[0] % factor or light.size[1] % (2 * factor):
            raise SensorError(f"image of {light.size[1]} x {light.size[0]} pixels: cannot be shrunk {factor} times")
        raw = self.raw(light, stream, Region.whole(light.size))
        linear = linear_rgb(linear_signal(raw, self.sensor, np.float32), self.sensor)
        planes = rendered(linear, self.sensor, factor)
        if self.sensor.output == "yuyv":
            return yuyv(planes, self.sensor)
        image = eight_bit(planes)
        return compressed(image, self.sensor) if self.sensor.output == "mjpeg" else image

    def photo_electrons(self, light: Light, region: Region, gain: float = 1.0) -> Array:
        """Expected photo-electrons of the pixels, shape (h, w), without the fixed pattern."""
        if self.sensor.output == "electrons":
            raw = " or ".join(repr(name) for name, output in preset_outputs().items() if output == "raw")
            raise SensorError(f"sensor preset '{self.sensor.name}' ends before the pixels: take {raw}")
        return expected_electrons(light, self.sensor, self.camera, region, gain)

    def pattern(self, region: Region) -> FixedPattern:
        """Fixed pattern on a region of whole tiles."""
        return fixed_pattern(self.sensor, self.camera_seed, region)

    def raw_region(self, region: Region, size: tuple[int, int]) -> Region:
        """Pixels of the mosaic that the processed pixels of `region` depend on, red first."""
        s = self.sensor
        # demosaicing, unsharp mask, denoising, and the chroma's column to the left of a pair
        margin = 1 + (s.sharpen_amount > 0.0) + denoise_margin_px(s)
        pair = 2 if s.output == "yuyv" else 0
        return region.grown(size, (2, 2), (margin, margin + pair))

    def jpeg_region(self, region: Region, size: tuple[int, int]) -> Region:
        """Pixels that the JPEG's pixels of `region` depend on: whole units, and one more on each side."""
        unit = MCU_PX[self.sensor.jpeg_subsampling]
        return region.grown(size, unit, unit)


# Auto exposure.


_STEP_PX = 8  # every eighth row and column are enough for a mean


def auto_exposed(sensor: Sensor, light: Light) -> Sensor:
    """Return the sensor with the exposure time and the gain that auto exposure chooses for this light.

    The time goes first, from `exposure_min_s` to `exposure_max_s`; the gain rises from 1 to `gain_max` where the
    longest time is not enough. What no setting reaches ends at the limit.
    """
    rates = light.ambient_electrons_per_s[:, ::_STEP_PX, ::_STEP_PX].astype(float)
    rates *= light.lamp_level * stop_factor(sensor, light)

    from scipy.optimize import brentq  # a quarter of a second that a fixed exposure does not need

    def excess(log_gain_s: float) -> float:
        return mean_level(rates * np.exp(log_gain_s), sensor) - sensor.auto_exposure_level

    low, high = np.log(sensor.exposure_min_s), np.log(sensor.exposure_max_s * sensor.gain_max)
    if excess(low) >= 0.0:
        product = sensor.exposure_min_s
    elif excess(high) <= 0.0:
        product = sensor.exposure_max_s * sensor.gain_max
    else:
        product = float(np.exp(brentq(excess, low, high, xtol=1e-6)))  # of a logarithm: 1e-6 of the product
    seconds = min(product, sensor.exposure_max_s)
    return sensor.replace(exposure_s=seconds, analogue_gain=min(max(product / seconds, 1.0), sensor.gain_max))


def mean_level(electrons: Array, sensor: Sensor) -> float:
    """Mean 8-bit luma, 0 to 255, of expected electrons behind R, G, B, shape (3, h, w), at gain 1.

    The converter's upper end cuts, as it does in a frame; noise, dark current, full well, extra vignetting, the Bayer
    pattern and sharpening are left out. A sensor without filters shows its one plane as grey.
    """
    full_scale_e = (sensor.top_dn - sensor.black_level_dn) / sensor.gain_dn_per_e
    if sensor.mosaic == "mono":
        grey = np.minimum(mono(electrons, sensor.mono_weights) / full_scale_e, 1.0)
        return 255.0 * float(tone_encoded(grey, sensor).mean())
    planes = np.minimum(electrons / full_scale_e, 1.0)
    linear = colour_corrected(white_balanced(planes, sensor.white_balance), sensor.colour_matrix)
    return 255.0 * float(np.average(tone_encoded(linear, sensor).mean(axis=(1, 2)), weights=LUMA))
