"""Image pixels of a grid of directions and distances, from a coarse table of exact solutions.

A pixel is a smooth function of azimuth, elevation and 1 / D, and periodic in azimuth. So trigonometric interpolation in
azimuth and polynomials through Chebyshev's nodes in the other two reach 1e-4 px from 16 000 exact solutions
(L. N. Trefethen, Approximation Theory and Approximation Practice, 2013). Each sum is a product of matrices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from phibench.datasets.common.errors import DatasetError
from phibench.estimator.geometry.mirror_image import image_of, range_at
from phibench.estimator.geometry.panorama import FAR_M, PanoramaGrid
from phibench.estimator.geometry.reflection import room_rays
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

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
    rig : Rig
    stroke_m : float
    grid : PanoramaGrid
    nearest_m : float
        Least D of `up_px` and `up_px_of`.
    """

    rig: Rig
    stroke_m: float
    grid: PanoramaGrid
    nearest_m: float = 0.4

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
        raised = image_of(self.rig.at(self.stroke_m), P + t[..., None] * r).uv_px
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
