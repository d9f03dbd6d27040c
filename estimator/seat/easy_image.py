"""Pixels of an easy spot: expected electrons, noise, the converter, and a plain processing to 8 bits.

The spot is a Gaussian integrated over the pixels, the room a smooth slope. Noise is Gaussian with the variance of
Poisson's law, which no easy spot can tell from it; PRNU and DSNU belong to the camera and stay.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image as Pillow

from phibench.datasets.expected import ExpectedRegion
from phibench.datasets.sensor_card import SensorCard
from phibench.estimator.gaussian_spot import outer, profile
from phibench.estimator.methods.linear import linear_planes, linear_to_srgb
from phibench.estimator.methods.window import around
from phibench.estimator.raw_pixels import bayer_filters
from phibench.estimator.seat.easy_scene import EasySpot
from phibench.estimator.seat.pair import Box
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.streams import Name, generator

ROOM_E = np.array([200.0, 180.0, 90.0])  # behind R, G, B in the middle of the image
_SLOPE = (0.25, 0.15)  # of the room's light, relative, from the middle to the border, along u and v
_WINDOW_PX = 41


@dataclass(frozen=True)
class EasyCamera:
    """A camera with a fixed pattern.

    Parameters
    ----------
    camera : Camera
    card : SensorCard
    """

    camera: Camera
    card: SensorCard

    @property
    def shape(self) -> tuple[int, int]:
        """(H, W) of an image."""
        return self.camera.height_px, self.camera.width_px

    def expected(self, spot: EasySpot, flux_e: float) -> ExpectedRegion:
        """Means and derivatives on 41 x 41 pixels around a spot."""
        box = around(spot.uv_px, self.shape, _WINDOW_PX)
        sigma = np.array([spot.sigma_px])
        across = profile(np.array([spot.uv_px[0] - box.u0_px]), sigma, box.width_px)
        down = profile(np.array([spot.uv_px[1] - box.v0_px]), sigma, box.height_px)
        filters, response = self._filters(box)
        images = (
            flux_e * response * outer(a, b)[0]
            for a, b in ((down.share, across.share), (down.share, across.by_centre), (down.by_centre, across.share))
        )
        return ExpectedRegion(box.u0_px, box.v0_px, filters, self._room()[box.slices], *images)

    def image(self, spot: EasySpot | None, flux_e: float, stream: tuple[Name, ...]) -> NDArray[Any]:
        """One frame, the spot left out if it is None; as `Pair` describes the card's output."""
        mean = self._room().copy()
        if spot is not None:
            region = self.expected(spot, flux_e)
            rows, columns = region.spot_e.shape
            mean[region.v0_px : region.v0_px + rows, region.u0_px : region.u0_px + columns] += region.spot_e
        dn = self._digitised(mean, generator("easy pairs", "noise", *stream))
        return dn if self.card.output == "raw" else self._processed(dn)

    def _room(self) -> Array:
        """Expected electrons of room and dark current, shape (H, W), read-only."""
        return _room(self.shape, self.card.mosaic == "bayer", self.card.dark_e_per_s * self.card.exposure_s)

    def _filters(self, box: Box) -> tuple[NDArray[np.int64], Array]:
        """Filter of each pixel of a box and its response to the laser."""
        shape = (box.height_px, box.width_px)
        response = np.array(self.camera.detector.laser_filter_response)
        if self.card.mosaic == "mono":
            return np.zeros(shape, np.int64), np.full(shape, response.sum())
        filters = bayer_filters(np.array([(box.u0_px, box.v0_px)]), shape)[0]
        return filters, response[filters]

    def _digitised(self, mean_e: Array, rng: np.random.Generator) -> NDArray[np.uint16]:
        card = self.card
        responsivity, offset = _pattern(self.shape)
        mean = mean_e * (1.0 + card.prnu * responsivity)
        charge = mean + np.sqrt(mean) * rng.standard_normal(self.shape, np.float32)
        charge = np.clip(charge, 0.0, card.full_well_e) + card.read_noise_e * rng.standard_normal(
            self.shape, np.float32
        )
        dn = np.rint((charge + card.dsnu_e * offset) * card.dn_per_e + card.black_level_dn)
        return np.clip(dn, 0, card.top_dn).astype(np.uint16)

    def _processed(self, dn: NDArray[np.uint16]) -> NDArray[np.uint8]:
        planes = linear_planes(dn, _raw(self.card)).astype(np.float32)  # a power of half the bytes takes half the time
        planes = np.repeat(planes, 3, axis=0) if len(planes) == 1 else planes
        image = np.rint(255.0 * np.moveaxis(linear_to_srgb(planes), 0, -1)).astype(np.uint8)
        return _through_jpeg(image, self.card) if self.card.output == "mjpeg" else image


@lru_cache(maxsize=2)
def _room(shape: tuple[int, int], bayer: bool, dark_e: float) -> Array:
    """Smooth light, kept for the next frame."""
    across, down = np.linspace(-1.0, 1.0, shape[1]), np.linspace(-1.0, 1.0, shape[0])
    light = 1.0 + _SLOPE[0] * across + (_SLOPE[1] * down)[:, None]
    level = ROOM_E[bayer_filters(np.array([(0, 0)]), shape)[0]] if bayer else ROOM_E.sum()
    room: Array = light * level + dark_e
    room.setflags(write=False)
    return room


@lru_cache(maxsize=2)
def _pattern(shape: tuple[int, int]) -> NDArray[np.float32]:
    """Responsivity and offset of the camera's pixels, standard normal, shape (2, H, W); kept for the next frame."""
    pattern = generator("easy pairs", "camera").standard_normal((2, *shape), np.float32)
    pattern.setflags(write=False)
    return pattern


def _raw(card: SensorCard) -> SensorCard:
    return replace(card, output="raw")


def _through_jpeg(image: NDArray[np.uint8], card: SensorCard) -> NDArray[np.uint8]:
    file = io.BytesIO()
    Pillow.fromarray(image).save(file, "JPEG", quality=card.jpeg_quality, subsampling=card.jpeg_subsampling)
    return np.array(Pillow.open(file))
