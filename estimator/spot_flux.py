"""Electrons per second of a laser spot's image in the mirror, in closed form: radiance times etendue.

A mirror keeps radiance but for its reflectance rho. A Lambertian spot of power P on a wall of albedo a has the
radiance integral a P / pi over its area; its image covers |d(u, v) / d(wall)| square pixels per square metre, and a
square pixel collects the etendue A cos(alpha) dOmega, alpha the chief ray's angle to the axis and A the aperture:

    watts = rho(i) (a P / pi) |d(u, v) / d(wall)| A cos^4(alpha) |d(x, y) / d(u, v)|.

The aperture is taken as a point; the spot layer's quadrature over it is the simulator's (DESIGN, section 5).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from phibench.estimator.mirror_image import MirrorImage
from phibench.estimator.reflection import reflect
from phibench.scenes.frames import Array
from phibench.scenes.rig import Rig


@dataclass(frozen=True)
class Laser:
    """The laser and the wall that it hits.

    Parameters
    ----------
    power_w : float
    albedo : float, of the wall at the wavelength; the wall scatters like a Lambertian one
    wavelength_nm : float
    """

    power_w: float = 1e-3
    albedo: float = 0.7
    wavelength_nm: float = 650.0


def spot_electrons_per_s(rig: Rig, laser: Laser, image: MirrorImage, wall_normals: Array) -> Array:
    """Electrons per second behind the red filter of the whole spot, shape (...).

    Parameters
    ----------
    rig : Rig
        At the down position, from which `image` is seen; a raised rig sees a lowered point.
    laser : Laser
    image : MirrorImage, shape (...)
    wall_normals : shape (..., 3), unit vectors
    """
    camera, uv = rig.camera, image.uv_px
    hit = reflect(rig.at(0.0), uv)
    watts = rig.mirror.reflectance(np.cos(hit.incidence_rad), laser.wavelength_nm) * laser.albedo * laser.power_w
    xy = camera.normalised(uv)
    cosine = 1.0 / np.sqrt(1.0 + np.sum(xy * xy, axis=-1))
    etendue = math.pi * camera.aperture_radius_m**2 * cosine**4 * camera.solid_angle_density(xy)
    electrons = camera.detector.laser_electrons_per_joule(laser.wavelength_nm)[0]
    return np.asarray(watts / math.pi * _area_px2_per_m2(image.px_per_m, wall_normals) * etendue * electrons)


def _area_px2_per_m2(px_per_m: Array, normals: Array) -> Array:
    """Area of the image per area of a wall: |(du/dX x dv/dX) . n|."""
    return np.abs(np.sum(np.cross(px_per_m[..., 0, :], px_per_m[..., 1, :]) * normals, axis=-1))
