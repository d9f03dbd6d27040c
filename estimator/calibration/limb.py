"""The light across the limb of a polished sphere, seen by a pinhole.

At the limb a ray grazes the sphere and goes on undeviated: radiance is continuous over the limb but for the steel's
reflectance, which rises to 1 at grazing incidence. Across the limb the light is therefore the room's, a smooth
function of the angle by which the mirror turns the ray, x the Fresnel reflectance, 1 outside, blurred by lens, defocus
and pixel. d is the distance from the limb across it, pixels, outwards positive.

Symbols: s sphere centre in the camera frame, R radius, a angle of a ray from s, a0 = asin(R / |s|) that of the limb.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.signal import fftconvolve

from phibench.scenes.camera import Camera
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig

_STEP_PX = 0.01
_REACH_PX = 30.0
_PIXEL_VARIANCE_PX2 = 1.0 / 12.0  # of a square pixel, in every direction


@dataclass(frozen=True)
class Limb:
    """Light across the limb for a level of 1 outside, per filter R, G, B.

    Attributes
    ----------
    d_px : shape (n,)
    light, slope_per_px, curvature_per_px2 : shape (3, n)
        The light, its first and its second derivative by d.
    turned, turned_squared : shape (3, n)
        The light times the angle by which the mirror turns the ray, 0 outside, and times its square: what the room's
        light adds that changes with direction. That angle grows as the root of -d: 15 degrees at 3 px.
    """

    d_px: Array
    light: Array
    slope_per_px: Array
    curvature_per_px2: Array
    turned: Array
    turned_squared: Array

    @cached_property
    def rows(self) -> Array:
        """All five, shape (3, n, 5): what one distance needs lies together."""
        tables = (self.light, self.slope_per_px, self.curvature_per_px2, self.turned, self.turned_squared)
        return np.ascontiguousarray(np.stack(tables, axis=-1))

    def all_at(self, filter_index: int, d_px: Array) -> Array:
        """Values of the five at distances, shape (..., 5), linear between the table's evenly spaced rows."""
        at = np.clip((d_px - self.d_px[0]) / _STEP_PX, 0.0, len(self.d_px) - 1.001)
        row = at.astype(np.intp)
        rows, part = self.rows[filter_index], (at - row)[..., None]
        return np.asarray(rows[row] * (1.0 - part) + rows[row + 1] * part)


def limb_angle_rad(s: Array, radius_m: float) -> float:
    """a0 = asin(R / |s|), radians."""
    return float(np.arcsin(radius_m / np.linalg.norm(s)))


def limb_of(rig: Rig, s: Array, blur_px2: float) -> Limb:
    """Light across the limb of a sphere at `s`.

    Parameters
    ----------
    rig : Rig
        For radius, steel, focal length, focus and filters.
    s : shape (3,), metres
    blur_px2 : float
        Variance of the lens's blur, besides defocus and pixel.
    """
    camera, distance = rig.camera, float(np.linalg.norm(s))
    a0 = limb_angle_rad(s, rig.mirror.radius_m)
    scale = np.sqrt(camera.fx_px * camera.fy_px) / np.cos(a0) ** 2  # pixels per radian across the limb
    d = np.arange(-_REACH_PX, _REACH_PX + _STEP_PX / 2.0, _STEP_PX)
    miss = distance / rig.mirror.radius_m * np.sin(a0 + d / scale)  # sine of the angle of incidence
    cos_i = np.sqrt(np.clip(1.0 - miss * miss, 0.0, None))
    kernel = _kernel(camera, limb_depth_m=distance * np.cos(a0) ** 2, blur_px2=blur_px2)
    light, turned, squared = [], [], []
    turn = 2.0 * np.arcsin(cos_i)
    for wavelength_nm in camera.detector.band_wavelength_nm:
        sharp = np.where(d < 0.0, rig.mirror.reflectance(cos_i, wavelength_nm), 1.0)
        light.append(_blurred(sharp, kernel))
        turned.append(_blurred(sharp * turn, kernel))
        squared.append(_blurred(sharp * turn**2, kernel))
    table = np.array(light)
    slope = np.gradient(table, _STEP_PX, axis=-1)
    return Limb(d, table, slope, np.gradient(slope, _STEP_PX, axis=-1), np.array(turned), np.array(squared))


def _kernel(camera: Camera, limb_depth_m: float, blur_px2: float) -> Array:
    """Line spread: Gaussian for lens and pixel, and the projection of the disc of defocus."""
    x = np.arange(-8.0, 8.0 + _STEP_PX / 2.0, _STEP_PX)
    kernel = np.exp(-0.5 * x * x / (blur_px2 + _PIXEL_VARIANCE_PX2))
    disc_px = camera.aperture_radius_m * camera.fx_px * abs(1.0 / camera.focus_distance_m - 1.0 / limb_depth_m)
    if disc_px > 2.0 * _STEP_PX:
        kernel = fftconvolve(kernel, np.sqrt(np.clip(disc_px**2 - x * x, 0.0, None)), mode="same")
    return np.asarray(kernel / kernel.sum())


def _blurred(sharp: Array, kernel: Array) -> Array:
    half = len(kernel) // 2
    padded = np.concatenate([np.full(half, sharp[0]), sharp, np.full(half, sharp[-1])])
    return np.asarray(fftconvolve(padded, kernel, mode="valid"))
