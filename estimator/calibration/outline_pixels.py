"""The pixels around an outline: their rays, their distance from the limb, and the light a model puts on them.

s is the sphere centre in the camera frame, a0 = asin(R / |s|) the angle of the limb from it; d is the distance of a
pixel from the limb, across it, outwards positive, pixels.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from phibench.estimator.calibration.limb import Limb, limb_angle_rad
from phibench.estimator.calibration.limb_image import Plane
from phibench.estimator.reflection import ray_jacobian
from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.rig import Rig

_OUTLINE_POINTS = 720
_RING_MARGIN_PX = 2.5


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
    """Usable pixels within `half_px` of the outline."""
    height, width = planes[0].values.shape
    u, v = _ring(camera, s, radius_m, half_px)
    uv = np.stack([u, v], axis=-1).astype(float)
    ray, by_pixel = camera.rays(uv), ray_jacobian(camera, uv)
    near = np.abs(place_of_rays(ray, by_pixel, s, radius_m).d_px) < half_px
    inside = (u >= 2) & (v >= 2) & (u < width - 2) & (v < height - 2)
    parts = []
    for number, plane in enumerate(planes):
        keep = near & inside & plane.usable[v, u]
        y = plane.values[v[keep], u[keep]] / ray[keep, 2] ** 4  # natural fall-off of a thin lens
        parts.append(OutlinePixels(np.full(y.size, number), u[keep], v[keep], ray[keep], by_pixel[keep], y))
    return OutlinePixels(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in OutlinePixels.__dataclass_fields__)
    )


def _ring(camera: Camera, s: Array, radius_m: float, half_px: float) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Pixels (u, v) that may be within `half_px`: by their distance from the outline's centre, at its own azimuths."""
    mark = Rig(camera=camera)
    uv = replace(
        mark,
        mirror=replace(mark.mirror, radius_m=radius_m),
        T_camera_sphere=replace(mark.T_camera_sphere, translation_m=as_vector(s)),
    ).outline_px(_OUTLINE_POINTS)
    low = np.clip(np.floor(uv.min(axis=0) - half_px).astype(int), 0, None)
    high = np.clip(np.ceil(uv.max(axis=0) + half_px).astype(int) + 1, 0, (camera.width_px, camera.height_px))
    centre = uv.mean(axis=0)
    v, u = np.mgrid[low[1] : high[1], low[0] : high[0]]
    off = np.hypot(u - centre[0], v - centre[1])
    own = np.hypot(*(uv - centre).T)
    rough = np.abs(off - 0.5 * (own.min() + own.max())) < half_px + 0.5 * np.ptp(own) + _RING_MARGIN_PX
    u, v, off = u[rough], v[rough], off[rough]
    azimuth = np.arctan2(uv[:, 1] - centre[1], uv[:, 0] - centre[0])
    order = np.argsort(azimuth)
    there = np.interp(np.arctan2(v - centre[1], u - centre[0]), azimuth[order], own[order], period=2.0 * np.pi)
    near = np.abs(off - there) < half_px + _RING_MARGIN_PX
    return u[near], v[near]


def place_of(rays: OutlinePixels, s: Array, radius_m: float) -> Place:
    """Where pixels are from the limb of a sphere at `s`."""
    return place_of_rays(rays.ray, rays.by_pixel, s, radius_m)


def place_of_rays(ray: Array, by_pixel: Array, s: Array, radius_m: float) -> Place:
    """With n = s / |s|, cos a = ray . n: d a = -n . d ray / sin a, and d a / d s = -(ray - n cos a) / (|s| sin a)."""
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
