"""Gauss-Newton step of an outline fit: pixels near it, distances from a sphere's limb, least squares and covariance.

s is the sphere centre in the camera frame, a0 = asin(R / |s|) the angle of the limb from it. d is the distance of a
pixel from the limb, across it, outwards positive, pixels. `step_from` is the entry: it gives the step of s and blur
with a covariance from the scatter of the sectors.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.calibration.outline.limb_image import Limb, Plane, limb_angle_rad, limb_of
from phibench.calibration.outline.limb_sectors import SectorFit, Sectors, scatter, sector_weights
from phibench.estimator.geometry.reflection import ray_jacobian
from phibench.estimator.spots.image_planes import ImageError
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.rig import Rig

_OUTLINE_POINTS = 720  # two to a degree: the band of pixels is chosen by them
_RING_MARGIN_PX = 2.5  # of the band that is looked at: the outline is taken by points and by squares


@dataclass(frozen=True)
class OutlinePixels:
    """Pixels around the outline; rows belong together."""

    plane: NDArray[np.int64]
    u: NDArray[np.int64]
    v: NDArray[np.int64]
    ray: Array
    by_pixel: Array  # d ray / d (u, v), shape (N, 3, 2)
    y: Array

    def __getitem__(self, keep: NDArray[Any]) -> OutlinePixels:
        return OutlinePixels(*(getattr(self, name)[keep] for name in self.__dataclass_fields__))


@dataclass(frozen=True)
class Place:
    """Distance from the limb of every pixel, its gradients, and where along the limb it is."""

    d_px: Array
    by_s: Array  # (N, 3), pixels per metre
    by_uv: Array  # (N, 2), unit vectors
    turn_rad: Array


def band(planes: tuple[Plane, ...], camera: Camera, s: Array, radius_m: float, half_px: float) -> OutlinePixels:
    """Usable pixels within `half_px` of a sphere's outline."""
    mark = Rig(camera=camera)
    outline_px = replace(
        mark,
        mirror=replace(mark.sphere, radius_m=radius_m),
        T_camera_sphere=replace(mark.T_camera_sphere, translation_m=as_vector(s)),
    ).outline_px(_OUTLINE_POINTS)
    return pixels_near(planes, camera, outline_px, half_px, lambda rays: place_of(rays, s, radius_m).d_px)


def pixels_near(
    planes: tuple[Plane, ...],
    camera: Camera,
    outline_px: Array,
    half_px: float,
    distance_px: Callable[[OutlinePixels], Array],
) -> OutlinePixels:
    """Usable pixels within `half_px` of an outline, of which points (n, 2) are given, and distances of pixels."""
    height, width = planes[0].values.shape
    u, v = _ring(camera, outline_px, half_px)
    uv = np.stack([u, v], axis=-1).astype(float)
    ray, by_pixel = camera.rays(uv), ray_jacobian(camera, uv)
    whole = OutlinePixels(np.zeros(u.size, np.int64), u, v, ray, by_pixel, np.zeros(u.size))
    near = np.abs(distance_px(whole)) < half_px
    inside = (u >= 2) & (v >= 2) & (u < width - 2) & (v < height - 2)
    parts = []
    for number, plane in enumerate(planes):
        keep = near & inside & plane.usable[v, u]
        y = plane.values[v[keep], u[keep]] / ray[keep, 2] ** 4  # natural fall-off of a thin lens
        parts.append(OutlinePixels(np.full(y.size, number), u[keep], v[keep], ray[keep], by_pixel[keep], y))
    return OutlinePixels(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in OutlinePixels.__dataclass_fields__)
    )


def _ring(camera: Camera, uv: Array, half_px: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pixels (u, v) that may be within `half_px`: by their distance from the outline's centre, at its own azimuths."""
    low = np.clip(np.floor(uv.min(axis=0) - half_px).astype(int), 0, None)
    high = np.clip(np.ceil(uv.max(axis=0) + half_px).astype(int) + 1, 0, (camera.width_px, camera.height_px))
    centre = uv.mean(axis=0)
    own = np.hypot(*(uv - centre).T)
    middle, reach = 0.5 * (own.min() + own.max()), half_px + 0.5 * np.ptp(own) + _RING_MARGIN_PX
    # squares, and both axes apart: of twelve megapixels every array of the whole box counts
    square = (np.arange(low[1], high[1])[:, None] - centre[1]) ** 2 + (np.arange(low[0], high[0]) - centre[0]) ** 2
    v, u = np.nonzero((square > max(middle - reach, 0.0) ** 2) & (square < (middle + reach) ** 2))
    v, u = v + low[1], u + low[0]
    off = np.hypot(u - centre[0], v - centre[1])
    azimuth = np.arctan2(uv[:, 1] - centre[1], uv[:, 0] - centre[0])
    order = np.argsort(azimuth)
    there = np.interp(np.arctan2(v - centre[1], u - centre[0]), azimuth[order], own[order], period=2.0 * np.pi)
    near = np.abs(off - there) < half_px + _RING_MARGIN_PX
    return u[near], v[near]


def place_of(rays: OutlinePixels, s: Array, radius_m: float) -> Place:
    """Place of pixels relative to the limb of a sphere at `s`."""
    return place_of_rays(rays.ray, rays.by_pixel, s, radius_m)


def place_of_rays(ray: Array, by_pixel: Array, s: Array, radius_m: float) -> Place:
    """Place of rays.

    n = s / |s|, cos a = ray . n: d a = -n . d ray / sin a, and d a / d s = -(ray - n cos a) / (|s| sin a).
    """
    distance = float(np.linalg.norm(s))
    n, a0 = s / distance, limb_angle_rad(s, radius_m)
    across = ray - (ray @ n)[:, None] * n
    sine = np.linalg.norm(across, axis=-1)
    angle = np.arctan2(sine, ray @ n)
    by_uv = -np.einsum("i,nij->nj", n, by_pixel) / sine[:, None]
    scale = 1.0 / np.linalg.norm(by_uv, axis=-1)  # pixels per radian across the limb
    by_s = -across / (sine * distance)[:, None] + np.tan(a0) * n / distance
    turn = np.arctan2(across[:, 1], across[:, 0])
    return Place((angle - a0) * scale, by_s * scale[:, None], by_uv * scale[:, None], turn)


def through_taps(
    rays: OutlinePixels, planes: tuple[Plane, ...], limb: Limb, place: Place
) -> tuple[Array, Array, Array, Array, Array]:
    """Light, slope, curvature, turned and turned squared for every pixel, summed over its taps."""
    sums = np.zeros((rays.y.size, 5))
    parity = 2 * (rays.v % 2) + rays.u % 2
    for number, plane in enumerate(planes):
        for kind in range(4):
            rows = np.flatnonzero((rays.plane == number) & (parity == kind))
            for tap in plane.taps[kind]:
                d = place.d_px[rows] + place.by_uv[rows] @ np.array([tap.du_px, tap.dv_px], float)
                sums[rows] += tap.weight * limb.all_at(tap.filter_index, d)
    light, slope, curvature, turned, squared = sums.T
    return light, slope, curvature, turned, squared


# -- one step ----------------------------------------------------------------------------------------------------------

_MIN_SLACK = 0.5


@dataclass(frozen=True)
class Step:
    """A step of p parameters, of which the blur's variance is the last, and what is known where it starts.

    The others are x, y, z of s, or those of a `contour`.

    Attributes
    ----------
    move : shape (p,), metres and square pixels
    residual : float
        See `outline_result.Outline`.
    y, model, light, depth : shape (N,)
        Light of the pixels, as seen, as fitted, and as the limb alone has it; distance from the limb over the band's.
    by_parameters : shape (N, p)
        Derivatives of the model.
    solution : Solution
    """

    move: Array
    residual: float
    y: Array
    model: Array
    light: Array
    depth: Array
    by_parameters: Array
    solution: Solution

    @cached_property
    def covariance(self) -> Array:
        """Covariance of the step, shape (p, p)."""
        return self.solution.covariance(self.y - self.model)

    @cached_property
    def contrast(self) -> float:
        """See `outline_result.Outline`."""
        return _contrast(self.solution.where, self.y, self.light, self.depth)

    @property
    def sectors_used(self) -> int:
        """Sectors with a weight."""
        return int(np.unique(self.solution.where.sector[self.solution.weight > 0.0]).size)


@dataclass(frozen=True)
class Solution:
    """The step as a linear function of the light, weights held.

    Attributes
    ----------
    where : Sectors
    J : shape (N, p)
        Derivatives, less what the sectors' coefficients can imitate.
    shift : shape (N,)
        The same of a limb that is displaced by 1 px.
    own : shape (N,)
        Weights of the pixels, one over variance.
    trust : shape (count,)
        Of the sectors, 0 to 1.
    slack : float
        Part of the information that is left when the weights' own change with the errors is counted (M-estimators:
        psi' in place of psi / x).
    """

    where: Sectors
    J: Array
    shift: Array
    own: Array
    trust: Array
    slack: float = 1.0

    @property
    def weight(self) -> Array:
        """Weights of pixels and sectors, shape (N,)."""
        return np.asarray(self.own * self.trust[self.where.sector])

    def move(self, residual: Array) -> Array:
        """Step of the parameters, shape (p,), for residuals (N,)."""
        # a direction that nothing tells gets no step
        return np.asarray(np.linalg.lstsq(self.normal(), self.J.T @ (self.weight * residual), rcond=1e-14)[0])

    def sector_shifts(self, residual: Array) -> Array:
        """Shift of the limb, outwards, that each sector has left, shape (count,), px; NaN where it is not used."""
        where, weight = self.where, self.weight
        left = where.summed((weight * self.shift * (residual - self.J @ self.move(residual)))[:, None])[:, 0]
        information = where.summed((weight * self.shift**2)[:, None])[:, 0]
        # light moves with the distance from the limb: a limb further out is light from further in
        return np.where(information > 0.0, -left / np.where(information > 0.0, information, 1.0), np.nan)

    def scatter(self, residual: Array) -> float:
        """Variance of the sectors' shifts that the residuals (N,) leave, over what their pixels promise."""
        where, own, trust = self.where, self.own, self.trust
        information = where.summed((own * self.shift**2)[:, None])[:, 0]
        root = np.sqrt(np.maximum(information, 1e-300))  # a sector without pixels: z is 0
        left = (own * self.shift * (residual - self.J @ self.move(residual)))[:, None]
        z = np.sqrt(trust) * np.where(information > 0.0, where.summed(left)[:, 0] / root, 0.0)
        by_s = where.summed((own * self.shift)[:, None] * self.J[:, :-1])
        directions = np.where(information > 0.0, np.sqrt(trust) / root, 0.0)[:, None] * by_s
        return float(scatter(z, trust * (information > 0.0), directions / np.abs(directions).max()))

    def covariance(self, residual: Array) -> Array:
        """Covariance of the step, shape (p, p), from the scatter of the residuals (N,) that it leaves."""
        inverse = np.linalg.inv(self.normal())
        meat = self.J.T @ ((self.weight * self.trust[self.where.sector])[:, None] * self.J)
        return np.asarray(inverse @ meat @ inverse * self.scatter(residual) / self.slack**2)

    def normal(self) -> Array:
        """Normal matrix, shape (p, p)."""
        return np.asarray(self.J.T @ (self.weight[:, None] * self.J))


def step_from(
    pixels: OutlinePixels,
    planes: tuple[Plane, ...],
    rig: Rig,
    s: Array,
    blur_px2: float,
    sectors: int,
    half_px: float,
    near: bool = False,
) -> Step:
    """Linearise the light around (s, blur) and solve, robustly within sectors and over them.

    `near` leaves out the sectors whose light is not described; far from the limb that is all of them.

    Raises
    ------
    ImageError
        If there is no light across the outline.
    """
    place, limb = place_of(pixels, s, rig.sphere.radius_m), limb_of(rig, s, blur_px2)
    light, slope, curvature, turned, squared = through_taps(pixels, planes, limb, place)
    where = Sectors.of(pixels.plane, place.turn_rad, sectors)
    d = place.d_px / half_px
    # JPEG's lack of fine waves looks like a slope on both sides of the limb more than like the room's curvature
    room = np.stack([light, light * where.offset, turned, squared], axis=-1)
    fit = where.fit(pixels.y, room)
    level = fit.model / light
    by_parameters = np.concatenate([place.by_s * slope[:, None], 0.5 * curvature[:, None]], axis=-1) * level[:, None]
    columns = fit.without_nuisance(np.concatenate([by_parameters, (slope * level)[:, None]], axis=-1))
    trust = where.described(pixels.y, fit.residual) if near else np.ones(sectors)
    solution = solution_of(where, fit, columns, trust)
    move = solution.move(fit.residual)
    return Step(move, fit.relative_residual, pixels.y, fit.model, light, d, by_parameters, solution)


def solution_of(where: Sectors, fit: SectorFit, columns: Array, described: Array) -> Solution:
    """Weights of the sectors by their shifts, and with them the whole step.

    Parameters
    ----------
    where, fit
    columns : shape (N, p + 1)
        Derivatives of the model by the p parameters, the blur last, and by a displacement of the outline by 1 px; less
        what the sectors' coefficients can imitate.
    described : shape (count,)
        See `Sectors.described`.
    """
    J, shift = columns[:, :-1], columns[:, -1]
    own = fit.weight * (described > 0.0)[where.sector]
    trust = bread = described
    for _ in range(4):
        solution = Solution(where, J, shift, own, trust)
        A = solution.normal()
        if not np.isfinite(A).all() or np.linalg.matrix_rank(A, tol=1e-12 * np.abs(A).max()) < 1:
            raise ImageError("an image without a mirror: there is no light across the outline")
        weights = sector_weights(where, own, shift, fit.residual - J @ solution.move(fit.residual))
        trust, bread = described * weights.trust, described * weights.bread
    core = np.sum(own * fit.core * bread[where.sector] * shift * shift)
    whole = np.sum(own * trust[where.sector] * shift * shift)
    slack = float(np.clip(core / max(float(whole), 1e-300), _MIN_SLACK, 1.0))
    return Solution(where, J, shift, own, trust, slack)


def _contrast(where: Sectors, y: Array, light: Array, d: Array) -> float:
    """Median over sectors of the steel's fall of light, in units of itself, with level and slope free."""
    fit = where.fit(y, np.stack([np.ones_like(y), d, light - 1.0], axis=-1))
    with np.errstate(all="ignore"):
        ratio = fit.coefficients[:, 2] / fit.coefficients[:, 0]
    good = ratio[np.isfinite(ratio)]
    return float(np.median(good)) if good.size else 0.0
