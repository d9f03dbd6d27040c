"""Sensor stages from light to DN (mosaic, shot noise, PRNU, DSNU, read noise, gain), and their named noise streams.

Order: mosaic, exposure, vignetting, PRNU, shot noise, full well, DSNU and read noise, gain, black level, rounding,
clipping. Shot noise is that of light and dark current together: a sum of Poisson numbers is a Poisson number.

Planes R, G, B have the shape (3, h, w); a pixel's electrons and DN have the shape (h, w). NumPy only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.render.sensor.light import Light, Region, SpotImage
from phibench.render.sensor.settings import Sensor, SensorError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.random_streams import Name, philox_key

# Repeatable noise, drawn in tiles: a pixel's numbers depend on its place and on the names of frame and stage.
#
# The image is cut into tiles of 32 x 32 pixels. The names of a stage give the key of a Philox generator, the tile's row
# and column two words of its counter (J. K. Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC11, 2011).
# Changing the counter is cheap, and every tile has 2^64 draws of its own. Poisson draws, which use a variable number of
# them, therefore disturb no other tile. A tile is drawn row by row from its first one, over its whole width.


TILE_PX = 32
Draw = Callable[[np.random.Generator, tuple[slice, slice]], NDArray[Any]]


@dataclass(frozen=True)
class NoiseStream:
    """A named source of noise, such as (data set, seed, sample, "down", "on", draw)."""

    names: tuple[Name, ...]

    def stage(self, *names: Name) -> NoiseStream:
        """Stream of one stage."""
        return NoiseStream((*self.names, *names))

    def generator(self) -> np.random.Generator:
        """Generator for what is drawn once per frame."""
        return np.random.Generator(np.random.Philox(key=philox_key(*self.names)))


def frame_stream(dataset: str, seed: int, sample: str, position: str, laser: bool, draw: int) -> NoiseStream:
    """Stream of one frame: every frame of a data set has its own, so that down and up, on and off are independent."""
    return NoiseStream((dataset, seed, sample, position, "on" if laser else "off", draw))


def whole_tiles(region: Region, size: tuple[int, int]) -> Region:
    """Smallest region of tiles around `region`, in an image of size (height, width).

    A tile is drawn row by row, so that the lowest tiles may end with the region: the rows before are the same.
    """
    tiles = region.grown(size, (TILE_PX, TILE_PX))
    return Region(tiles.u0_px, tiles.v0_px, tiles.u1_px, region.v1_px)


def poisson(stream: NoiseStream, mean: Array, region: Region) -> Array:
    """Poisson draws, shape (h, w); `mean` is that of `region`, which must be of whole tiles."""
    return _by_tiles(stream, region, lambda generator, part: generator.poisson(mean[part]))


def normal(stream: NoiseStream, region: Region) -> Array:
    """Standard normal draws, shape (h, w), on a region of whole tiles."""
    height, width = region.shape

    def draw(generator: np.random.Generator, part: tuple[slice, slice]) -> Array:
        v, u = part[0].start, part[1].start
        return generator.standard_normal((min(TILE_PX, height - v), min(TILE_PX, width - u)))

    return _by_tiles(stream, region, draw)


def row_normal(stream: NoiseStream, region: Region) -> Array:
    """Standard normal draws, one per row, shape (h, 1): the same in every column of the image."""
    column = Region(0, region.v0_px, 1, region.v1_px)
    return normal(stream, column)


def _by_tiles(stream: NoiseStream, region: Region, draw: Draw) -> Array:
    """Put together what `draw` gives for each tile of `region`."""
    bits = np.random.Philox(key=philox_key(*stream.names))
    generator = np.random.Generator(bits)
    state: Any = bits.state
    # plain integers: numpy reads them three times as fast as its own arrays' elements
    state["state"] = {name: words.tolist() for name, words in state["state"].items()}
    state["buffer"] = state["buffer"].tolist()
    result = np.empty(region.shape)
    height, width = region.shape
    for v in range(0, height, TILE_PX):
        for u in range(0, width, TILE_PX):
            # word 0 counts the tile's own draws
            state["state"]["counter"] = (0, (region.v0_px + v) // TILE_PX, (region.u0_px + u) // TILE_PX, 0)
            bits.state = state
            part = slice(v, v + TILE_PX), slice(u, u + TILE_PX)
            result[part] = draw(generator, part)
    return result


def mosaic(planes: Array, phase: tuple[int, int] = (0, 0)) -> Array:
    """RGGB mosaic, shape (..., H, W), of planes R, G, B, shape (..., 3, H, W).

    `phase` is the (row, column) of the first pixel, of which only even or odd matters: red at even row, even column.
    """
    result = np.empty((*planes.shape[:-3], *planes.shape[-2:]), planes.dtype)
    for row in (0, 1):
        for column in (0, 1):
            # RGGB: R where row and column are even, B where both are odd: their sum is the plane
            site = (..., slice(row, None, 2), slice(column, None, 2))
            result[site] = planes[..., (row + phase[0]) % 2 + (column + phase[1]) % 2, :, :][site]
    return result


def mono(planes: Array, weights: tuple[float, float, float]) -> Array:
    """Pixels without filters, shape (..., H, W): the weighted sum of planes, shape (..., 3, H, W)."""
    red, green, blue = (planes[..., i, :, :] * weights[i] for i in range(3))
    return red + green + blue


def sampled_planes(planes: Array, sensor: Sensor, phase: tuple[int, int]) -> Array:
    """Planes R, G, B as the sensor's pixels sample them; all three planes if its output is electrons."""
    if sensor.output == "electrons":
        return planes
    return mosaic(planes, phase) if sensor.mosaic == "bayer" else mono(planes, sensor.mono_weights)


def stop_factor(sensor: Sensor, light: Light) -> float:
    """Light at the sensor's stop relative to the layers'; the depth of field stays that of the layers."""
    # light goes with the area of the aperture: as 1 / N^2
    return 1.0 if sensor.f_number is None else (light.f_number / sensor.f_number) ** 2


def vignetting(exponent: float, camera: Camera, region: Region) -> Array | float:
    """Extra fall-off cos^n of the angle to the optical axis, shape (h, w); 1 for n = 0.

    On top of the natural cos^4, which the layers contain.
    """
    if exponent == 0.0:
        return 1.0
    x = (np.arange(region.u0_px, region.u1_px) - camera.cx_px) / camera.fx_px
    y = (np.arange(region.v0_px, region.v1_px) - camera.cy_px) / camera.fy_px
    # 1 / sqrt(1 + x^2 + y^2) is the cosine of the angle from the optical axis
    return (1.0 + x * x + (y * y)[:, None]) ** (-0.5 * exponent)


def expected_electrons(light: Light, sensor: Sensor, camera: Camera, region: Region, flicker: float = 1.0) -> Array:
    """Expected photo-electrons in one exposure, shape (h, w) (planes, shape (3, h, w), for the output "electrons")."""
    phase = (region.v0_px, region.u0_px)
    # layers are rates at their own stop: electrons are rate x time x ratio of apertures
    seconds = sensor.exposure_s * stop_factor(sensor, light)
    part = light.ambient_electrons_per_s[(slice(None), *region.slices())]
    electrons = sampled_planes(part, sensor, phase).astype(float) * (seconds * light.lamp_level)
    if light.spot is not None:
        factor = seconds * light.laser_level * flicker
        _add_spot(electrons, light.spot, factor, sensor, region)
    for other in light.others:
        factor = seconds * (light.laser_level if other.follows_laser else 1.0)
        _add_spot(electrons, other.image, factor, sensor, region)
    return electrons * vignetting(sensor.vignetting_exponent, camera, region)


def _add_spot(electrons: Array, spot: SpotImage, factor: float, sensor: Sensor, region: Region) -> None:
    """Add `factor` times a spot to what `expected_electrons` has of the ambient light, in place."""
    if factor == 0.0:
        return
    u0, v0, planes = spot.u0_px, spot.v0_px, spot.electrons_per_s
    window = Region(u0, v0, u0 + planes.shape[2], v0 + planes.shape[1])
    common = Region(
        max(window.u0_px, region.u0_px),
        max(window.v0_px, region.v0_px),
        min(window.u1_px, region.u1_px),
        min(window.v1_px, region.v1_px),
    )
    if min(common.shape) > 0:
        part = planes[(slice(None), *common.slices(window))]
        here = electrons[(..., *common.slices(region))]
        here += factor * sampled_planes(part, sensor, (common.v0_px, common.u0_px))
        np.maximum(here, 0.0, out=here)  # a moving spot may undershoot


@dataclass(frozen=True)
class FixedPattern:
    """Fixed pattern of one camera: the same in all its frames.

    Attributes
    ----------
    responsivity : array, shape (h, w), or 1
        Relative, mean 1, standard deviation PRNU.
    offset_e : array, shape (h, w), or 0
        Dark offset, electrons, mean 0, standard deviation DSNU.
    """

    responsivity: Array | float
    offset_e: Array | float

    def rows(self, part: slice) -> FixedPattern:
        """Pattern of some rows."""
        each = (
            values[part] if isinstance(values, np.ndarray) else values for values in (self.responsivity, self.offset_e)
        )
        return FixedPattern(*each)


def fixed_pattern(sensor: Sensor, camera_seed: int, region: Region) -> FixedPattern:
    """Fixed pattern of one camera on a region of whole tiles; read only, and kept for the next frame."""
    return _pattern(sensor.prnu, sensor.dsnu_e, camera_seed, region)


@lru_cache(maxsize=4)
def _pattern(prnu: float, dsnu_e: float, camera_seed: int, region: Region) -> FixedPattern:
    stream = NoiseStream(("camera", camera_seed))
    responsivity: Array | float = 1.0
    offset_e: Array | float = 0.0
    if prnu > 0.0:
        # a spread of 20 % may go below 0: such a pixel is dead
        responsivity = _kept(np.maximum(1.0 + prnu * normal(stream.stage("prnu"), region), 0.0))
    if dsnu_e > 0.0:
        offset_e = _kept(dsnu_e * normal(stream.stage("dsnu"), region))
    return FixedPattern(responsivity, offset_e)


def _kept(values: Array) -> Array:
    values.flags.writeable = False
    return values


def speckle_gain(sensor: Sensor, stream: NoiseStream) -> float:
    """Flicker of the whole spot in one frame: gamma distributed, mean 1, variance 1/M.

    The pupil seen through the mirror is smaller than a speckle, so that the spot changes as a whole (J. W. Goodman,
    "Speckle Phenomena in Optics", 2nd ed., 2020, section 4.6: gamma law of integrated intensity).
    """
    if sensor.speckle_m is None:
        return 1.0
    return float(stream.stage("speckle").generator().gamma(sensor.speckle_m, 1.0 / sensor.speckle_m))


def mean_charge(photo_e: Array, sensor: Sensor, pattern: FixedPattern) -> Array:
    """Expected charge of each pixel before the full well, electrons, shape (h, w): light, PRNU, dark current."""
    return photo_e * pattern.responsivity + sensor.dark_e_per_s * sensor.exposure_s


def collected_charge(mean_e: Array, sensor: Sensor, stream: NoiseStream, region: Region) -> Array:
    """Charge in the wells, shape (h, w), on whole tiles: Poisson, cut at the full well."""
    charge = mean_e
    if sensor.shot_noise:
        try:
            charge = poisson(stream.stage("shot"), mean_e, region)
        except ValueError as error:  # what numpy says of a mean below 0, NaN or above 9e18
            raise SensorError(
                f"layers: {mean_e.min():g} to {mean_e.max():g} expected electrons in a pixel; a layer must hold finite "
                "numbers from 0 up, render it again"
            ) from error
    # the well is full before the reading adds its noise
    return np.minimum(charge, sensor.full_well_e)


def read_out(charge_e: Array, sensor: Sensor, pattern: FixedPattern, stream: NoiseStream, region: Region) -> Array:
    """Signal at the converter, electrons, shape (h, w), on whole tiles: DSNU, read noise and row noise added."""
    signal = charge_e + pattern.offset_e
    if sensor.read_noise_e > 0.0:
        signal = signal + sensor.read_noise_e * normal(stream.stage("read"), region)
    if sensor.row_noise_e > 0.0:
        signal = signal + sensor.row_noise_e * row_normal(stream.stage("row"), region)
    return signal


def digitised_signal(signal_e: Array, sensor: Sensor) -> NDArray[np.uint16]:
    """DN: gain, black level, rounding to the nearest code, clipping to what the converter has."""
    # the converter rounds to the nearest code and clips at both ends
    dn = np.rint(sensor.black_level_dn + sensor.dn_per_e * signal_e)
    return np.clip(dn, 0.0, sensor.top_dn).astype(np.uint16)
