"""Spot layer: the laser spot's image in electrons per second, derivatives and centre; light paths over a rough mirror.

The light on the film comes as a cloud of weighted points: from `spot_samples` for a smooth mirror, from here for a
rough one (Beckmann distribution, Smith shadowing). For each pair (spot point, aperture point) film positions are drawn
around the specular one with the lobe's own width and traced to the mirror. The weight is the BRDF D F G / (4 cos_i
cos_o), so that the weights are smooth and quasi-random points converge fast. As alpha goes to 0 the cloud becomes that
of `specular_cloud` (tested).

Windows have the shape (3, h, w), planes R, G, B; integer (u, v) are pixel centres.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import scipy

from phibench.render.optics.beam_deposit import Deposit, deposit
from phibench.render.optics.ray_tracer import MirrorRays, lens_rays, reflect, trace_pixels
from phibench.render.optics.reflection_point import MirrorPoints, mirror_points, onward_ways
from phibench.render.optics.room_tracer import GeometryLike, RoomGeometry, as_geometry, blocked_by
from phibench.render.optics.spot_samples import FilmCloud, disc_points, film_position, slices, specular_cloud
from phibench.render.optics.truth import mirror_angles
from phibench.scenes.frames import Array, as_vector
from phibench.scenes.laser import LaserSpot
from phibench.scenes.random_streams import sobol
from phibench.scenes.rig import View

_TAIL_SIGMAS = 6.5  # a Gaussian's flux beyond it is 8e-11
_POINTS_AT_ONCE = 16384
_WIDE = 3.5  # reaches of a blur: a window that is wider pays for finding out where each point lies


@dataclass(frozen=True)
class SpotLayer:
    """Image of one spot in one view, after optics and blur, before exposure.

    The window may reach beyond the image; what lies outside is not on the sensor.

    Attributes
    ----------
    u0_px, v0_px : int
        Image pixel of the window's first column and row.
    electrons_per_s : array, shape (3, h, w)
        Expected photo-electrons per second per pixel behind the filters R, G, B.
    du_electrons_per_s_px, dv_electrons_per_s_px : arrays, shape (3, h, w)
        Derivatives with respect to a shift of the whole image of the spot by +u, +v.
    centroid_uv_px : array, shape (2,)
        Energy centroid over spot and aperture before pixel sampling; NaN when dark.
    total_electrons_per_s : array, shape (3,)
        Electrons per second of the whole spot, window or not.
    place_m : array, shape (3,)
        Place of that light on the room's surfaces: the mean, weighted by power, world; NaN when dark.
    """

    u0_px: int
    v0_px: int
    electrons_per_s: Array
    du_electrons_per_s_px: Array
    dv_electrons_per_s_px: Array
    centroid_uv_px: Array
    total_electrons_per_s: Array
    place_m: Array


@dataclass(frozen=True)
class SpotLight:
    """Centre of the light of a spot that reaches the image: what a perfect method finds.

    Attributes
    ----------
    u_px, v_px : float
        Centre of the light in the image.
    phi_ray_rad, phi_normal_rad, phi_incidence_rad, azimuth_rad : float
        `MirrorAngles` of the ray through (u_px, v_px) and the lens centre.
    place_world_m : 3 floats
        Place of the light on the surfaces, weighted by power.
    """

    u_px: float
    v_px: float
    phi_ray_rad: float
    phi_normal_rad: float
    phi_incidence_rad: float
    azimuth_rad: float
    place_world_m: tuple[float, ...]


def spot_light(view: View, layer: SpotLayer) -> SpotLight | None:
    """Centre of the light of a layer of this view; None where none reaches the lens."""
    uv = layer.centroid_uv_px
    if not np.isfinite(uv).all():
        return None
    rays = trace_pixels(view, uv[None])
    angles = {name: float(value[0]) for name, value in vars(mirror_angles(rays.normals, rays.directions)).items()}
    return SpotLight(float(uv[0]), float(uv[1]), **angles, place_world_m=as_vector(layer.place_m))


def spot_layer(view: View, spot: LaserSpot, room: GeometryLike, log2_pairs: int | None = None) -> SpotLayer:
    """Render the spot by specular connection (ideal mirror) or microfacet sampling (rough mirror).

    `log2_pairs` takes so many quasi-random pairs of an ideal mirror, whatever the spot seems to need (a rough mirror
    has its own number).
    """
    geometry = as_geometry(room)
    if view.rig.mirror.roughness_alpha > 0.0:
        cloud = rough_cloud(view, spot, geometry)
    else:
        cloud = specular_cloud(view, spot, geometry, log2_pairs)
    gain = np.array(view.rig.camera.detector.laser_electrons_per_joule(spot.wavelength_nm))
    return splat(cloud, view.rig.camera.blur_sigma_px, gain)


def splat(cloud: FilmCloud, sigma_px: float, electrons_per_joule: Array) -> SpotLayer:
    """Blur the film points by a Gaussian and integrate over each pixel, exactly (erf).

    Parameters
    ----------
    electrons_per_joule : array, shape (3,)
    """
    bright = cloud.watts > 0.0
    if not bright.any():
        return _dark_layer()
    uv, watts = cloud.uv_px[bright], cloud.watts[bright]
    low = np.floor(uv.min(axis=0) - _TAIL_SIGMAS * sigma_px).astype(int)
    high = np.ceil(uv.max(axis=0) + _TAIL_SIGMAS * sigma_px).astype(int)
    images = np.zeros((3, high[1] - low[1] + 1, high[0] - low[0] + 1))
    for part in slices(len(uv), _POINTS_AT_ONCE):
        across, d_across = _pixel_integrals(uv[part, 0], low[0], high[0], sigma_px)
        down, d_down = _pixel_integrals(uv[part, 1], low[1], high[1], sigma_px)
        down *= watts[part, None]
        d_down *= watts[part, None]
        images += np.stack([down.T @ across, down.T @ d_across, d_down.T @ across])
    layer, du, dv = images[:, None] * electrons_per_joule[:, None, None]
    total = watts.sum() * electrons_per_joule
    return SpotLayer(int(low[0]), int(low[1]), layer, du, dv, cloud.centroid_px(), total, cloud.place_m())


def _pixel_integrals(centre: Array, low: int, high: int, sigma: float) -> tuple[Array, Array]:
    """Integral of a unit Gaussian over pixels low..high, shape (N, pixels), and its derivative by the centre.

    In a window that is much wider than a blur, as that of a streak, only the pixels that a point reaches are computed.
    """
    reach = math.ceil(_TAIL_SIGMAS * sigma)
    if high - low < _WIDE * reach:
        return _integrals(np.arange(low, high + 2) - 0.5 - centre[:, None], sigma)
    first = np.clip(np.floor(centre).astype(int) - reach, low, high - 2 * reach - 1)  # 2 reach + 2 pixels
    near = _integrals(np.arange(2 * reach + 3) + (first - 0.5 - centre)[:, None], sigma)
    columns = np.arange(2 * reach + 2) + (first - low)[:, None]
    whole = np.zeros((2, len(centre), high - low + 1))
    for image, part in zip(whole, near, strict=True):
        np.put_along_axis(image, columns, part, axis=1)
    return whole[0], whole[1]


def _integrals(edges_px: Array, sigma: float) -> tuple[Array, Array]:
    """The same between neighbours of edges, shape (N, n + 1), relative to the centre: shapes (N, n)."""
    edges = edges_px / sigma
    density = np.exp(-0.5 * edges**2) / (sigma * math.sqrt(2.0 * math.pi))
    return np.diff(scipy.special.ndtr(edges), axis=1), -np.diff(density, axis=1)


def _dark_layer() -> SpotLayer:
    zeros = np.zeros((3, 1, 1))
    return SpotLayer(0, 0, zeros, zeros, zeros, np.full(2, np.nan), np.zeros(3), np.full(3, np.nan))


# Rough mirror.


_LOG2_SAMPLES, _LOG2_MOST = 14, 20  # for a lobe as narrow as the blur; a wider one needs more in proportion to its area
_WIDER = 1.2  # film positions are drawn this much wider than the lobe: bounded weights
_STEP_PX = 0.01


@dataclass(frozen=True)
class _Samples:
    """Quasi-random places on the spot, points of the aperture (N, 2) and normal deviates for the film (N, 2)."""

    light: Deposit
    lens_m: Array
    film: Array


def rough_cloud(view: View, spot: LaserSpot, room: RoomGeometry) -> FilmCloud:
    """Film points and powers for a mirror with roughness_alpha > 0; empty where the spot has no reflection point."""
    centre_uv = _specular(view, np.array([spot.position_world_m]), np.zeros((1, 2)))
    if not np.isfinite(centre_uv).all():
        return FilmCloud(np.empty((0, 2)), np.empty(0))
    spread = _lobe_px(view, np.array(spot.position_world_m), centre_uv[0])
    log2_samples = _log2_samples(spread, view.rig.camera.blur_sigma_px)
    samples = _draw(view, spot, room, log2_samples)
    uv = _specular(view, samples.light.points_m, samples.lens_m) + samples.film @ (_WIDER * spread).T
    lit = np.flatnonzero(np.all(np.isfinite(uv), axis=1))
    uv, light, lens, film = uv[lit], samples.light[lit], samples.lens_m[lit], samples.film[lit]
    density = np.exp(-0.5 * (film**2).sum(axis=1)) / (2.0 * math.pi * _WIDER**2 * abs(np.linalg.det(spread)))
    watts = _power(view, spot, room, uv, lens, light) / density / 2**log2_samples
    seen = np.isfinite(watts)
    return FilmCloud(uv[seen], watts[seen], light.points_m[seen])


def _log2_samples(spread_px: Array, blur_px: float) -> int:
    """Number of samples, as a power of two, that keeps the same number of them in each blur's area."""
    area = abs(float(np.linalg.det(spread_px))) / blur_px**2
    return min(_LOG2_SAMPLES + max(0, math.ceil(math.log2(max(area, 1.0)))), _LOG2_MOST)


def _draw(view: View, spot: LaserSpot, room: RoomGeometry, log2_samples: int) -> _Samples:
    x = sobol(6, 2**log2_samples)
    light = deposit(spot, room, disc_points(spot.profile, x[:, :2]))
    lens = view.rig.camera.aperture_radius_m * disc_points("uniform", x[:, 2:4])
    lit = light.lit
    return _Samples(light[lit], lens[lit], disc_points("gaussian", x[lit, 4:]))


def _specular(view: View, points: Array, lens: Array) -> Array:
    """Film position of the specular connection, shape (N, 2)."""
    pose = view.T_world_camera
    eyes = np.concatenate([lens, np.zeros((len(lens), 1))], axis=-1)
    mirror = mirror_points(view, points, pose.points(eyes)).points_m
    return film_position(view, eyes, pose.inverse().points(mirror))


def _lobe_px(view: View, point: Array, uv: Array) -> Array:
    """Square root of the lobe's covariance on the film: slopes of variance alpha^2/2 through d(uv)/d(slope)."""
    shifts = _STEP_PX * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
    rays = reflect(view, *lens_rays(view, uv + shifts))
    tangents = _tangent_frame(rays.normals[0])
    half = _half_vector(rays, point[None])
    slope = half @ tangents.T / np.einsum("ni,ni->n", half, rays.normals)[:, None] - rays.normals @ tangents.T
    jacobian = np.stack([slope[0] - slope[1], slope[2] - slope[3]], axis=-1) / (2.0 * _STEP_PX)
    return np.asarray(np.linalg.inv(jacobian) * view.rig.mirror.roughness_alpha / math.sqrt(2.0), float)


def _tangent_frame(normal: Array) -> Array:
    helper = np.array([1.0, 0.0, 0.0]) if abs(normal[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    a = np.cross(normal, helper)
    a /= np.linalg.norm(a)
    return np.stack([a, np.cross(normal, a)])


def _half_vector(rays: MirrorRays, points: Array) -> Array:
    """Unit half vectors between the way back to the camera and the way to the points, shape (N, 3)."""
    back = 2.0 * rays.cos_incidence[:, None] * rays.normals - rays.directions
    to_point = points - rays.points_m
    half = back + to_point / np.linalg.norm(to_point, axis=-1, keepdims=True)
    return half / np.linalg.norm(half, axis=-1, keepdims=True)


def _power(view: View, spot: LaserSpot, room: RoomGeometry, uv: Array, lens: Array, light: Deposit) -> Array:
    """Watts per square pixel that reach the film at uv from the whole spot's power concentrated in each place."""
    camera, points = view.rig.camera, light.points_m
    origins, directions = lens_rays(view, uv, lens)
    rays = reflect(view, origins, directions)
    found, growth = _seen_from(view, rays, points)
    way, to_point = onward_ways(view, found, points), found.apparent_m - rays.points_m
    s2 = np.einsum("ni,ni->n", to_point, to_point)
    leaving = to_point / np.sqrt(s2)[:, None]
    reached = leaving if view.tube is None else way.directions
    cos_lens = directions @ view.T_world_camera.R[:, 2]
    etendue = camera.solid_angle_density(camera.normalised(uv)) * cos_lens**4 * math.pi * camera.aperture_radius_m**2
    reflected = _reflection(view, spot, rays, found.apparent_m, leaving) * way.transmittance
    radiance = spot.power_w * light.scattered(-reached) / (s2 * growth) * reflected
    free = np.ones(len(uv), dtype=bool)
    hit = np.isfinite(radiance)
    legs = ((start[hit], end[hit]) for start, end in (*way.legs, (origins, rays.points_m)))
    free[hit] = np.all([blocked_by(room, start, end) < 0 for start, end in legs], axis=0)
    return np.where(free, etendue * radiance, 0.0)


def _seen_from(view: View, rays: MirrorRays, points: Array) -> tuple[MirrorPoints, Array | float]:
    """Points as they are seen from where rays meet a rough mirror, and the growth of areas across the way to them."""
    if view.tube is None:
        return MirrorPoints(rays.points_m, rays.normals, np.isfinite(rays.cos_incidence), points), 1.0
    bent = view.tube.outside(points)
    seen, growth = view.tube.seen_from(rays.points_m, points)
    seen, growth = np.where(bent[:, None], seen, points), np.where(bent, growth, 1.0)
    lit = np.asarray(np.isfinite(seen).all(axis=1))
    return MirrorPoints(rays.points_m, rays.normals, lit, seen, bent), growth


def _reflection(view: View, spot: LaserSpot, rays: MirrorRays, points: Array, leaving: Array) -> Array:
    """BRDF times cos_i: D F G / (4 cos_o), shape (N,)."""
    alpha = view.rig.mirror.roughness_alpha
    half = _half_vector(rays, points)
    cos_h = np.einsum("ni,ni->n", half, rays.normals)
    cos_i = np.einsum("ni,ni->n", leaving, rays.normals)
    tan2 = np.maximum(1.0 - cos_h**2, 0.0) / cos_h**2
    facets = np.exp(-tan2 / alpha**2) / (math.pi * alpha**2 * cos_h**4)
    fresnel = view.rig.mirror.reflectance(np.einsum("ni,ni->n", half, leaving), spot.wavelength_nm)
    shadow = _smith(cos_i, alpha) * _smith(rays.cos_incidence, alpha)
    return facets * fresnel * shadow / (4.0 * rays.cos_incidence)


def _smith(cos: Array, alpha: float) -> Array:
    """Smith's masking G1 for Beckmann's distribution; 0 below the horizon."""
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        a = cos / (alpha * np.sqrt(np.maximum(1.0 - cos * cos, 1e-300)))
        hidden = 0.5 * (scipy.special.erf(a) - 1.0) + np.exp(-a * a) / (2.0 * a * math.sqrt(math.pi))
        return np.where(cos > 0.0, 1.0 / (1.0 + hidden), 0.0)
