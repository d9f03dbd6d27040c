"""Both images of a dense pair as panoramas on one grid, in codes of luma, and the way back to the image's pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
from phibench.estimator.dense.smooth_maps import PanoramaMaps, maps_of
from phibench.estimator.geometry.reflection import room_rays
from phibench.estimator.geometry.triangulate import approx_estimator, meeting
from phibench.estimator.spots.camera_codes import rgb_codes, tone_of
from phibench.estimator.spots.image_planes import KINDS, kind_of, linear_planes
from phibench.estimator.spots.simple_spots import LUMA
from phibench.scenes.frames import Array, BoolArray

WIDTH_PX = 960  # a column is 6.5 mrad; a pixel of the default rig is 7.6 mrad along the radius
NEAREST_M, FARTHEST_M = 0.4, 20.0  # of answers
Float32 = NDArray[np.float32]


def luma_codes(image: NDArray[Any], card: SensorCard) -> Float32:
    """Luma on 0 to 255, shape (h, w), behind the tone curve: there noise is nearly the same at all levels."""
    if kind_of(card) not in KINDS:
        raise DatasetError(f"an image of '{card.output}': dense methods take {', '.join(KINDS)}")
    if card.output == "raw":
        planes = 255.0 * tone_of(linear_planes(image, card), card)
    else:
        planes = np.moveaxis(np.asarray(rgb_codes(image, card)), -1, 0)
    grey = planes[0] if len(planes) == 1 else np.tensordot(LUMA, planes, axes=1)
    return np.asarray(grey, np.float32)


def at_places(coefficients: Float32, uv_px: Array, order: int = 3) -> Float32:
    """Values of an image, given by its spline coefficients, at pixels (..., 2)."""
    where = (uv_px[..., 1], uv_px[..., 0])
    return np.asarray(map_coordinates(coefficients, where, order=order, prefilter=False, mode="nearest"), np.float32)


@dataclass(frozen=True)
class UnrolledPair:
    """Panoramas of a pair.

    Parameters
    ----------
    pair : DensePair
    maps : PanoramaMaps
    """

    pair: DensePair
    maps: PanoramaMaps

    @classmethod
    def of(cls, pair: DensePair, width_px: int = WIDTH_PX) -> UnrolledPair:
        """Panoramas of a width."""
        return cls(pair, maps_of(pair.rig, pair.stroke_m, width_px))

    @cached_property
    def up_image(self) -> Float32:
        """Luma of the up image, shape (h, w)."""
        return luma_codes(self.pair.up, self.pair.card)

    @cached_property
    def up_spline(self) -> Float32:
        """Coefficients of the cubic spline through the up image."""
        return np.asarray(spline_filter(self.up_image, 3, output=np.float32))

    @cached_property
    def down(self) -> Float32:
        """Panorama of the down image, shape (H, W)."""
        coefficients = spline_filter(luma_codes(self.pair.down, self.pair.card), 3, output=np.float32)
        return at_places(coefficients, self.maps.down_px)

    @cached_property
    def up(self) -> Float32:
        """Panorama of the up image on the same directions, shape (H, W)."""
        return at_places(self.up_spline, self.maps.up_far_px)

    @cached_property
    def seen(self) -> BoolArray:
        """Mask of the directions that the down image shows, shape (H, W)."""
        return self.pair.rig.camera.contains(self.maps.down_px)

    @cached_property
    def _places(self) -> tuple[NDArray[np.intp], Array, Array]:
        """Image pixels that the panorama holds: flat index (n,), place (u, v), shape (n, 2), and column and row."""
        height, width = self.pair.shape
        v, u = np.divmod(np.arange(height * width), width)
        uv = np.stack([u, v], axis=-1).astype(float)
        around = self.maps.rig.outline_px(72)
        near = np.flatnonzero(((uv > around.min(axis=0)) & (uv < around.max(axis=0))).all(axis=-1))
        place = self.maps.grid.place(room_rays(self.maps.rig.at(0.0), uv[near]).direction_world)
        inside = np.isfinite(place[:, 0]) & (place[:, 1] >= 0.0) & (place[:, 1] <= self.maps.grid.height_px - 1)
        return near[inside], uv[near[inside]], place[inside]

    def at_pixels(self, values: Array) -> Array:
        """Values at the image's pixels of `_places`, shape (n,), bilinear; NaN where one of the four around is."""
        place = self._places[2]
        closed = np.concatenate([values[:, -1:], values, values[:, :1]], axis=1)
        return np.asarray(map_coordinates(closed, (place[:, 1], place[:, 0] + 1.0), order=1, mode="nearest"))

    def plane(self, values: Array) -> Array:
        """Plane of the down image, shape (h, w), of values at `_places`, shape (n,); NaN elsewhere."""
        plane = np.full(self.pair.shape, np.nan)
        plane.reshape(-1)[self._places[0]] = values
        return plane

    def answer(self, inverse_depth_per_m: Array, sigma_per_m: Array) -> DenseAnswer:
        """Answer of 1 / D and its sigma on the grid, shape (H, W); NaN where there is none."""
        q, sigma = self.at_pixels(inverse_depth_per_m), self.at_pixels(sigma_per_m)
        known = (q > 1.0 / FARTHEST_M) & (q < 1.0 / NEAREST_M) & (sigma > 0.0)
        q = np.where(known, q, np.nan)
        return DenseAnswer(depth_m=self.plane(1.0 / q), sigma_depth_m=self.plane(sigma / q**2))

    def answer_of_places(self, row: Array, column: Array, central: bool) -> DenseAnswer:
        """Answer of the places, in the up panorama, of the grid's points, shape (H, W) each; NaN where unknown.

        Parameters
        ----------
        row, column : arrays
        central : bool
            By the central model: every ray comes from the sphere's centre, which is eq. (5). Otherwise by the rays.
        """
        known = np.isfinite(row) & np.isfinite(column)
        wrapped = np.concatenate([self.maps.up_far_px, self.maps.up_far_px[:, :1]], axis=1)
        where = np.where(known, row, 0.0), np.where(known, column, 0.0) % self.maps.grid.width_px
        target = [map_coordinates(wrapped[..., k], where, order=1, mode="nearest") for k in (0, 1)]
        up = np.stack([self.at_pixels(np.where(known, part, np.nan)) for part in target], axis=-1)
        return DenseAnswer(depth_m=self.plane(depths(self.pair, self._places[1], up, central)))


def depths(pair: DensePair, down_px: Array, up_px: Array, central: bool) -> Array:
    """D of matches (n, 2), shape (n,), by the pair's rig or by the central model; NaN where the rays do not meet."""
    known = np.flatnonzero(np.isfinite(up_px).all(axis=-1))
    result = np.full(len(down_px), np.nan)
    down, up = down_px[known], up_px[known]
    if central:
        found = approx_estimator("ray", pair.rig, pair.stroke_m, down, up).depth_m
    else:
        at = meeting(pair.rig, pair.stroke_m, down, up)
        found = np.where(at.status == 0, at.depth_m, np.nan)
    with np.errstate(invalid="ignore"):
        result[known] = np.where((found > NEAREST_M) & (found < FARTHEST_M), found, np.nan)
    return result
