"""Expected electrons of each pixel around one spot, and their derivatives by its place: the input of limits and fits.

Integer (u, v) are pixel centres; a region's origin is the image pixel of its first column and row.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.read import Sample
from phibench.render.sensor.camera_chain import Chain
from phibench.render.sensor.electrons import sampled_planes, stop_factor, vignetting
from phibench.render.sensor.light import Light, Region, SpotImage
from phibench.render.sensor.settings import Sensor
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array


@dataclass(frozen=True)
class ExpectedRegion:
    """Means and derivative images of one spot, electrons per exposure and pixel, shape (h, w).

    Attributes
    ----------
    u0_px, v0_px : int
        Image pixel of the first column and row.
    filters : array of int, shape (h, w)
        0, 1, 2 for R, G, B; 0 everywhere without a mosaic.
    background_e : array
        Room, other lights and dark current.
    spot_e, du_e_per_px, dv_e_per_px : arrays
        The spot, and its derivatives by a shift of its image by +u, +v.
    """

    u0_px: int
    v0_px: int
    filters: NDArray[np.int64]
    background_e: Array
    spot_e: Array
    du_e_per_px: Array
    dv_e_per_px: Array

    @property
    def mean_e(self) -> Array:
        """Expected electrons in all."""
        return self.background_e + self.spot_e


def expected_region(sample: Sample, position: str, sensor: Sensor, margin_px: int = 4) -> ExpectedRegion:
    """Region around the spot of a sample, at "down" or "up".

    Raises
    ------
    DatasetError
        If no light of the spot reaches the image.
    """
    camera = sample.rig.camera
    light = Light(sample.ambient(position), sample.spot(position), f_number=camera.f_number)
    return expected_of_light(light, sensor, camera, margin_px)


def expected_of_light(light: Light, sensor: Sensor, camera: Camera | None = None, margin_px: int = 4) -> ExpectedRegion:
    """Region of the spot's window and `margin_px` around, cut where the image ends; the spot stands still.

    Raises
    ------
    DatasetError
        If the light has no spot in the image.
    """
    camera, spot = camera or Camera(), light.spot
    if spot is None or spot.electrons_per_s.size == 0:
        raise DatasetError("no light of the spot reaches the image: it has no region; leave such spots out")
    region = _around(spot, light.size, margin_px)
    background = Chain(sensor, camera=camera).photo_electrons(light.without_spot(), region)
    scale = sensor.exposure_s * stop_factor(sensor, light) * light.laser_level
    factor = scale * vignetting(sensor.vignetting_exponent, camera, region)
    stacks = (spot.electrons_per_s, spot.du_electrons_per_s_px, spot.dv_electrons_per_s_px)
    phase = (region.v0_px, region.u0_px)
    images = [factor * sampled_planes(_placed(stack, spot, region), sensor, phase) for stack in stacks]
    filters = _filters(region) if sensor.mosaic == "bayer" else np.zeros(region.shape, np.int64)
    dark = sensor.dark_e_per_s * sensor.exposure_s
    return ExpectedRegion(region.u0_px, region.v0_px, filters, background + dark, *images)


def _around(spot: SpotImage, size: tuple[int, int], margin_px: int) -> Region:
    rows, columns = spot.electrons_per_s.shape[1:]
    u0, v0 = max(spot.u0_px - margin_px, 0), max(spot.v0_px - margin_px, 0)
    u1, v1 = min(spot.u0_px + columns + margin_px, size[1]), min(spot.v0_px + rows + margin_px, size[0])
    if u0 >= u1 or v0 >= v1:
        raise DatasetError(
            f"the spot's window at ({spot.u0_px}, {spot.v0_px}) lies outside the image of {size[1]} x {size[0]} "
            "pixels: it has no region; leave such spots out"
        )
    return Region(u0, v0, u1, v1)


def _placed(stack: Array, spot: SpotImage, region: Region) -> Array:
    """Planes of the spot's window, shape (3, h, w), on the region's pixels; zero elsewhere."""
    planes = np.zeros((3, *region.shape))
    rows, columns = stack.shape[1:]
    v, u = np.arange(region.v0_px, region.v1_px) - spot.v0_px, np.arange(region.u0_px, region.u1_px) - spot.u0_px
    inside_v, inside_u = np.flatnonzero((v >= 0) & (v < rows)), np.flatnonzero((u >= 0) & (u < columns))
    planes[:, inside_v[:, None], inside_u] = stack[:, v[inside_v, None], u[inside_u]]
    return planes


def _filters(region: Region) -> NDArray[np.int64]:
    v, u = np.arange(region.v0_px, region.v1_px), np.arange(region.u0_px, region.u1_px)
    return v[:, None] % 2 + u % 2
