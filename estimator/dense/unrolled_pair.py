"""Both images of a dense pair as panoramas, by interpolated pixel maps; matches between them turned into depth D."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates, spline_filter

from phibench.datasets.common.errors import DatasetError
from phibench.datasets.frames.sensor_card import SensorCard
from phibench.estimator.dense.dense_interface import DenseAnswer, DensePair
from phibench.estimator.geometry.epipolar_line import range_at
from phibench.estimator.geometry.panorama import FAR_M, PanoramaGrid
from phibench.estimator.geometry.reflection import image_of, room_rays
from phibench.estimator.geometry.triangulate import approx_estimator, meeting
from phibench.estimator.spots.camera_codes import rgb_codes, tone_of
from phibench.estimator.spots.image_planes import KINDS, kind_of, linear_planes
from phibench.estimator.spots.simple_spots import LUMA
from phibench.scenes.frames import Array, BoolArray
from phibench.scenes.rig import Rig

# Image pixels of a grid of directions and distances, from a coarse table of exact solutions.
#
# A pixel is a smooth function of azimuth, elevation and 1 / D, and periodic in azimuth. So trigonometric interpolation
# in azimuth and polynomials through Chebyshev's nodes in the other two reach 1e-4 px from 16 000 exact solutions
# (L. N. Trefethen, Approximation Theory and Approximation Practice, 2013). Each sum is a product of matrices.


AZIMUTHS, ELEVATIONS, INVERSES = 16, 32, 32  # nodes: an even number around, so that the sum is a cotangent
LOW_DEG, HIGH_DEG = -70.0, 60.0  # below stands the robot, above the mirror's outline is near
_RIM = 0.98  # of the outline's radius, where rays still reflect


def chebyshev_nodes(count: int, low: float, high: float) -> Array:
    """Roots of Chebyshev's polynomial on an interval."""
    x = np.cos((np.arange(count) + 0.5) * math.pi / count)
    return np.asarray(0.5 * (low + high) + 0.5 * (high - low) * x)


def barycentric_weights(count: int) -> Array:
    """Weights of the barycentric formula at Chebyshev's roots."""
    k = np.arange(count)
    return np.asarray((-1.0) ** k * np.sin((k + 0.5) * math.pi / count))


def polynomial_matrix(nodes: Array, at: Array) -> Array:
    """Matrix, shape (n, m), from values at Chebyshev nodes (m,) to values of the polynomial at places (n,).

    Barycentric formula (J.-P. Berrut and L. N. Trefethen, SIAM Review 46, 501, 2004).
    """
    weights = barycentric_weights(len(nodes))
    away = np.asarray(at, float)[:, None] - nodes
    exact = away == 0.0
    terms = weights / np.where(exact, 1.0, away)
    rows = terms / terms.sum(axis=1, keepdims=True)
    hit = exact.any(axis=1)
    rows[hit] = exact[hit]
    return np.asarray(rows)


def periodic_matrix(count: int, at: Array) -> Array:
    """Matrix, shape (n, m), from values at m = count angles 2 pi k / m to those of the trigonometric sum at angles."""
    half = (np.asarray(at, float)[:, None] - 2.0 * math.pi * np.arange(count) / count) / 2.0
    with np.errstate(divide="ignore", invalid="ignore"):
        rows = np.sin(count * half) / (count * np.tan(half))  # m even
    return np.asarray(np.where(np.abs(np.sin(half)) < 1e-12, 1.0, rows))


@dataclass(frozen=True)
class PanoramaMaps:
    """Pixels (u, v) of both images on one grid, by the rig.

    Parameters
    ----------
    nearest_m : float
        Least D of `up_px` and `up_px_of`.
    row_m : float
        Rise of the carriage from row to row of the up image, about its middle row: a rolling shutter on the way.
    """

    rig: Rig
    stroke_m: float
    grid: PanoramaGrid
    nearest_m: float = 0.4
    row_m: float = 0.0

    @cached_property
    def inverses(self) -> Array:
        """Nodes of 1 / D, shape (Q,)."""
        return chebyshev_nodes(INVERSES, 0.0, 1.0 / self.nearest_m)

    @cached_property
    def _table(self) -> tuple[Array, Array]:
        """Pixels (u, v) at the nodes, of the down image, shape (2, E, A), and of the up image, shape (Q, 2, E, A)."""
        turn = 2.0 * math.pi * np.arange(AZIMUTHS) / AZIMUTHS
        up = chebyshev_nodes(ELEVATIONS, self.grid.low_rad, self.grid.high_rad)[:, None]
        parts = np.cos(up) * np.cos(turn), np.cos(up) * np.sin(turn), np.sin(up)
        view = self.rig.at(0.0)
        down = image_of(view, view.sphere_centre_m + FAR_M * np.stack(np.broadcast_arrays(*parts), axis=-1)).uv_px
        ray = room_rays(view, down)
        P, r = ray.origin_world_m, ray.direction_world
        t = range_at(P - view.sphere_centre_m, r, 1.0 / self.inverses[:, None, None])
        points, above = P + t[..., None] * r, self.rig.at(self.stroke_m)
        raised = image_of(above, points).uv_px
        if self.row_m:
            # a camera higher by d sees points lower by d; one step, as a row's height moves the image by < 0.01 rows
            later_m = self.row_m * (raised[..., 1] - 0.5 * (self.rig.camera.height_px - 1))
            raised = image_of(above, points - later_m[..., None] * np.array(self.rig.stroke_axis_world)).uv_px
        if not (np.isfinite(down).all() and np.isfinite(raised).all()):
            raise DatasetError(
                f"this mirror does not show all elevations from {math.degrees(self.grid.low_rad):.0f} to "
                f"{math.degrees(self.grid.high_rad):.0f} degrees in both images, which a panorama of both needs: "
                "methods that unroll take a sphere, or a mirror of revolution with a round vertex"
            )
        return np.moveaxis(down, -1, 0), np.moveaxis(raised, -1, 1)

    @cached_property
    def _across(self) -> tuple[Array, Array]:
        """Matrices from the nodes to the grid's rows and columns."""
        nodes = chebyshev_nodes(ELEVATIONS, self.grid.low_rad, self.grid.high_rad)
        rows = polynomial_matrix(nodes, self.grid.elevations_rad)
        return rows, periodic_matrix(AZIMUTHS, self.grid.azimuths_rad).T

    def _spread(self, table: Array) -> Array:
        """Values on the grid, shape (H, W, 2), of values at the nodes, shape (2, E, A)."""
        rows, columns = self._across
        return np.moveaxis((rows @ table) @ columns, 0, -1)

    @cached_property
    def down_px(self) -> Array:
        """Of the grid's directions in the down image, shape (H, W, 2)."""
        return self._spread(self._table[0])

    @cached_property
    def up_far_px(self) -> Array:
        """Of the grid's directions in the up image, far away, shape (H, W, 2)."""
        return self.up_px(0.0)

    def up_px(self, inverse_depth_per_m: float) -> Array:
        """Of the points at one 1 / D on the rays of the down image, in the up image, shape (H, W, 2)."""
        at = polynomial_matrix(self.inverses, np.array([inverse_depth_per_m]))[0]
        return self._spread(np.tensordot(at, self._table[1], axes=1))

    def up_px_of(self, inverse_depth_per_m: Array) -> Array:
        """The same at a 1 / D of each grid point, shape (H, W)."""
        q = np.asarray(inverse_depth_per_m, float)
        signed = barycentric_weights(INVERSES)
        above, below = np.zeros((2, *q.shape)), np.zeros(q.shape)
        for weight, node, values in zip(signed, self.inverses, self._table[1], strict=True):
            away = q - node
            term = weight / np.where(away == 0.0, 1e-300, away)  # the sum's limit at a node
            above += term * np.moveaxis(self._spread(values), -1, 0)
            below += term
        return np.moveaxis(above / below, 0, -1)


def maps_of(rig: Rig, stroke_m: float, width_px: int) -> PanoramaMaps:
    """Maps of a panorama from 70 degrees below the horizon to 60 above it, or to the mirror's rim."""
    view = rig.at(0.0)
    outline = rig.outline_px(72)
    inside = outline.mean(axis=0) + _RIM * (outline - outline.mean(axis=0))
    rim = float(np.nanmin(np.arcsin(room_rays(view, inside).direction_world[:, 2])))
    high = min(math.radians(HIGH_DEG), rim)
    return PanoramaMaps(rig, stroke_m, PanoramaGrid(width_px, math.radians(LOW_DEG), high))


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
    """Panoramas of a pair."""

    pair: DensePair
    maps: PanoramaMaps

    @classmethod
    def of(cls, pair: DensePair, width_px: int = WIDTH_PX) -> UnrolledPair:
        """Panoramas of a width."""
        return cls(pair, maps_of(pair.rig, pair.stroke_m, width_px))

    def at_heights(self) -> tuple[UnrolledPair, ...]:
        """Pair itself, and one of the down image with each image between, on the same grid."""
        pair = replace(self.pair, between=None, between_m=(), between_row_m=())
        rows_m = self.pair.between_row_m or (0.0,) * len(self.pair.between_m)
        between = zip(self.pair.between_m, rows_m, () if self.pair.between is None else self.pair.between, strict=True)
        lower = [
            UnrolledPair(replace(pair, up=image, stroke_m=height_m), replace(self.maps, stroke_m=height_m, row_m=row_m))
            for height_m, row_m, image in between
        ]
        return self, *lower

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
        return DenseAnswer(depth_m=self.plane(depths_of_matches(self.pair, self._places[1], up, central)))


def depths_of_matches(pair: DensePair, down_px: Array, up_px: Array, central: bool) -> Array:
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
