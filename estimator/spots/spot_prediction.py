"""Prediction of a spot's image from the rig and the `Laser`: its blur, and its electrons per second.

Blur: second moments of lens, defocus with the mirror's astigmatism, and the beam's size. The size matters: a spot of
4 mm at 1 m adds 0.02 to 0.05 px^2 to 0.5 px^2. A fit that leaves it out is off by up to 0.04 px there, and by 0.01 px
at 2 m, wherever a Bayer mosaic lets one or two pixels see most of the spot.

A mirror of revolution may draw the aperture to a disc or a streak that is wider than the blur, and bent: a cone, flat
along its side, to one of 8 px. Its centroid lies beside the chief ray's place: by 0.1 px in a cone, 4 mpx in a
hyperboloid. There the image is made of parts: what is seen through single points of the lens.

Electrons: radiance times etendue, in closed form. A mirror keeps radiance but for its reflectance rho. A Lambertian
spot of power P on a wall of albedo a has the radiance integral a P / pi over its area. Its image covers
|d(u, v) / d(wall)| square pixels per square metre, and a square pixel collects the etendue A cos(alpha) dOmega, alpha
the chief ray's angle to the axis and A the aperture:

    watts = rho(i) (a P / pi) |d(u, v) / d(wall)| A cos^4(alpha) |d(x, y) / d(u, v)|.

The aperture is taken as a point; the quadrature over it is the simulator's (`render.optics.spot_layer`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike

from phibench.estimator.geometry.reflection import ON_AXIS_SINE, MirrorImage, Reflection, image_of, reflect
from phibench.estimator.spots.gaussian_spot import SpotBlur, SpotParts
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.laser import Beam
from phibench.scenes.rig import Rig, View


def spot_blur(rig: Rig, uv_px: ArrayLike, depth_m: float | None = None, beam: Beam | None = None) -> SpotBlur:
    """Blur of a spot's image by the rig; the lens's alone where the pixel does not see the mirror.

    The virtual images of a point at the distance s from the mirror lie 1 / (1/s + 2/(R cos i)) (tangential: along the
    radius from the mirror's centre) and 1 / (1/s + 2 cos(i)/R) (sagittal) behind it (Coddington's equations). A point
    at the depth z is a disc of the radius fx a |1/z - 1/z_f|, a the lens's aperture, whose variance along an axis is a
    quarter of its radius squared. The mirror's roughness is left out.

    Parameters
    ----------
    uv_px : shape (2,)
    depth_m : float, optional
        Horizontal distance of the spot from the mirror's axis; without it the spot is far away.
    beam : Beam, optional
        With the distance, the spot's own size counts, on an upright wall that faces the axis.
    """
    camera, view, uv = rig.camera, rig.at(0.0), np.asarray(uv_px, float)
    point = None if depth_m is None else _point_m(view, uv, depth_m)
    of_point = camera.blur_sigma_px**2 * np.eye(2)
    if point is not None and beam is not None and depth_m is not None:
        of_point = of_point + _beam_px2(view, point, beam.diameter_m(depth_m))
    lens = _defocus_px2(view, uv, point)
    if not np.isfinite(lens).all():
        return SpotBlur(camera.blur_sigma_px)
    whole = SpotBlur.of(of_point + lens)
    parts = _parts(view, uv, point, lens, of_point) if rig.mirror.radius_m is None else None
    return whole if parts is None else replace(whole, parts=parts)


_FAR_M = 100.0  # where a point is whose distance is not known
_FEWEST, _PER_BLUR = 2, 1.2  # chords of the lens: exp(i k x) with k = 2 / blur over a disc of so many blurs


def _parts(view: View, uv_px: Array, point_m: Array | None, lens_px2: Array, of_point_px2: Array) -> SpotParts | None:
    """Images of a point through single points of the lens; None where one of them does not see the mirror.

    Chords across the longer axis of the aperture's image, by Chebyshev's rule of the second kind, whose weights are
    their lengths; points on each by Gauss and Legendre. A ray through the lens point L that leaves in the direction
    (x, y, 1) meets the plane of focus at L + z_f (x, y), which the film shows at the place of (x, y) + L / z_f.
    """
    camera = view.rig.camera
    variance, axes = np.linalg.eigh(lens_px2)
    reach = 2.0 * np.sqrt(np.maximum(variance, 0.0)) / camera.blur_sigma_px  # of the disc's image, in blurs
    chords, on_each = (_FEWEST - k + math.ceil(_PER_BLUR * extent) for k, extent in enumerate(reach[::-1]))
    angle = np.pi * np.arange(1, chords + 1) / (chords + 1)
    y, weight = leggauss(on_each)
    disc = np.stack(np.broadcast_arrays(np.cos(angle)[:, None], np.sin(angle)[:, None] * y), axis=-1).reshape(-1, 2)
    weights = np.outer(np.sin(angle) ** 2, weight).ravel()
    lens_m = camera.aperture_radius_m * disc @ axes[:, ::-1].T
    if point_m is None:
        ray = reflect(view, uv_px)
        point_m = ray.origin_world_m + _FAR_M * ray.direction_world
    places, shares = (np.array(x) for x in zip(*(_through(view, place_m, point_m) for place_m in lens_m), strict=True))
    if not np.isfinite(places).all():
        return None
    weights = weights * shares
    return SpotParts(places - uv_px, weights / weights.sum(), SpotBlur.of(of_point_px2))


def _through(view: View, lens_xy_m: Array, point_m: Array) -> tuple[Array, float]:
    """Film position (2,) of a world point through a point (2,) of the lens, after the mirror; and its light.

    That is in proportion to the area that an upright wall there has in the image.
    """
    rig, T, lens_m = view.rig, view.T_world_camera, np.append(lens_xy_m, 0.0)
    moved = replace(
        rig,
        T_world_camera=replace(T, translation_m=as_vector(T.points(lens_m))),
        T_camera_sphere=replace(rig.T_camera_sphere, translation_m=as_vector(rig.T_camera_sphere.t - lens_m)),
    )
    image = image_of(moved.at(0.0), point_m)
    xy = rig.camera.normalised(image.uv_px)
    area = _area_px2_per_m2(image.px_per_m, _towards_axis(view, point_m))
    return rig.camera.to_pixel(xy + lens_xy_m / rig.camera.focus_distance_m), float(area)


def _towards_axis(view: View, point_m: Array) -> Array:
    """Normal (3,) of an upright wall at a point that faces the axis."""
    outward = (point_m - view.sphere_centre_m) * [1.0, 1.0, 0.0]
    return np.asarray(-outward / np.linalg.norm(outward))


def _point_m(view: View, uv_px: Array, depth_m: float) -> Array | None:
    """Point at which the ray of a pixel is so far from the mirror's axis, shape (3,); None where it never is."""
    ray, axis = reflect(view, uv_px), view.sphere_centre_m[:2]
    start, along = ray.origin_world_m[:2] - axis, ray.direction_world[:2]
    a, b, c = along @ along, start @ along, start @ start - depth_m**2
    with np.errstate(invalid="ignore", divide="ignore"):
        point = ray.origin_world_m + (np.sqrt(b * b - a * c) - b) / a * ray.direction_world
    return point if np.isfinite(point).all() else None


def _defocus_px2(view: View, uv_px: Array, point_m: Array | None) -> Array:
    """Second moments that defocus and astigmatism add, shape (2, 2); NaN where the pixel does not see the mirror."""
    camera, into_camera = view.rig.camera, view.T_world_camera.inverse()
    hit = reflect(view, uv_px)
    cosine = np.cos(float(hit.incidence_rad))
    vergence = 0.0 if point_m is None else 1.0 / float(np.linalg.norm(point_m - hit.origin_world_m))
    with np.errstate(divide="ignore"):  # a cone is flat along its side
        behind = 1.0 / (vergence + 2.0 * _curvatures(view, hit) * np.array([1.0 / cosine, cosine]))
    ahead_m = into_camera.points(hit.origin_world_m)[2] + behind * camera.rays(uv_px)[2]
    disc = camera.fx_px * camera.aperture_radius_m * (1.0 / ahead_m - 1.0 / camera.focus_distance_m)
    away = uv_px - camera.project(into_camera.points(view.sphere_centre_m))
    # on the axis no direction is radial
    along = np.outer(away, away) / max(float(away @ away), 1e-12)  # the radial direction
    # a disc of radius r: r^2 / 4 an axis
    return np.asarray(0.25 * (disc[0] ** 2 * along + disc[1] ** 2 * (np.eye(2) - along)))


def _curvatures(view: View, hit: Reflection) -> Array:
    """Curvatures of the mirror, 1/m, shape (2,), in the plane of incidence and across it, where a ray meets it."""
    mirror = view.rig.mirror
    if mirror.radius_m is not None:
        return np.full(2, 1.0 / mirror.radius_m)
    axes, n = view.T_world_sphere.R, hit.normal_world
    surface = mirror.level((hit.origin_world_m - view.sphere_centre_m) @ axes)
    K = axes @ surface.hessian_per_m @ axes.T / np.linalg.norm(surface.gradient)
    across = np.cross(n, hit.direction_world)
    if np.linalg.norm(across) < ON_AXIS_SINE:
        across = np.cross(n, axes[:, 0])
    across = across / np.linalg.norm(across)
    along = np.cross(across, n)
    return np.array([along @ K @ along, across @ K @ across])


def _beam_px2(view: View, point_m: Array, diameter_m: float) -> Array:
    """Second moments of the image of a spot of this size."""
    normal = _towards_axis(view, point_m)
    image = image_of(view, point_m).px_per_m @ (np.eye(3) - np.outer(normal, normal))
    moments = (diameter_m / 4.0) ** 2 * image @ image.T
    return np.asarray(moments if np.isfinite(moments).all() else np.zeros((2, 2)))


@dataclass(frozen=True)
class Laser:
    """Laser and the wall that it hits.

    Parameters
    ----------
    albedo : float, of the wall at the wavelength; the wall scatters like a Lambertian one
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
